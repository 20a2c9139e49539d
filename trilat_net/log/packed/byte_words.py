"""Loads eight bytes from an array as one integer, in compiled code.

This lets compiled code compare and copy encoded messages eight bytes at a time instead of byte
by byte.

Invariant:
    - The caller ensures that the eight bytes lie within the array.
    - All integers are signed, because Numba converts a sum of signed and unsigned numbers to a
      floating-point number.
"""

import sys
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.extending import intrinsic

_config: Any = numba.config
_WORD_BYTES = 8
_SIGN = 1 << 63


def _generate_load(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Generates the code that loads eight bytes at any offset of a byte array."""
    data, offset = args
    array = context.make_array(signature.args[0])(context, builder, data)
    pointer = builder.gep(array.data, [offset])
    word_pointer = builder.bitcast(pointer, ir.IntType(64).as_pointer())
    return builder.load(word_pointer, align=1)


@intrinsic
def _load_compiled(_context: Any, data: Any, _place: Any) -> Any:
    """Generates the code that loads a word in the byte order of the processor."""
    return types.int64(data, types.intp), _generate_load


@intrinsic
def _load_swapped(_context: Any, data: Any, _place: Any) -> Any:
    """Generates the code that loads a word in the opposite byte order."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bswap(_generate_load(context, builder, signature, args))

    return types.int64(data, types.intp), generate


@intrinsic
def _copy_compiled(
    _context: Any, source: Any, _place: Any, target: Any, _first: Any, _length: Any
) -> Any:
    """Generates the machine code that copies bytes from one array to another.

    Numba calls this function when it compiles a call of `copy_bytes`. A block copy is faster
    than a compiled loop over the bytes.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source_data, offset, target_data, first, length = args
        source_array = context.make_array(signature.args[0])(context, builder, source_data)
        target_array = context.make_array(signature.args[2])(context, builder, target_data)
        source_pointer = builder.gep(source_array.data, [offset])
        target_pointer = builder.gep(target_array.data, [first])
        copy: Any = cgutils.raw_memcpy
        copy(builder, target_pointer, source_pointer, length, 1)
        return context.get_dummy_value()

    return types.none(source, types.intp, target, types.intp, types.intp), generate


def _copy_plain(source: Any, offset: int, target: Any, first: int, length: int) -> None:
    """Copies bytes when Numba is disabled."""
    target[first : first + length] = source[offset : offset + length]


def _load_plain(data: Any, offset: int, byte_order: Any) -> int:
    """Loads a word when Numba is disabled."""
    word = int.from_bytes(bytes(data[offset : offset + _WORD_BYTES]), byte_order)
    return (word ^ _SIGN) - _SIGN  # the same bits as a signed number


def _load_plain_little(data: Any, offset: int) -> int:
    return _load_plain(data, offset, "little")


def _load_plain_big(data: Any, offset: int) -> int:
    return _load_plain(data, offset, "big")


_is_little = sys.byteorder == "little"
_little: Any = _load_compiled if _is_little else _load_swapped
_big: Any = _load_swapped if _is_little else _load_compiled
load_little: Any = _load_plain_little if _config.DISABLE_JIT else _little
"""Loads a word from an array, least significant byte first: `load_little(data, offset)`."""
load_big: Any = _load_plain_big if _config.DISABLE_JIT else _big
"""Loads a word from an array, most significant byte first: `load_big(data, offset)`."""
copy_bytes: Any = _copy_plain if _config.DISABLE_JIT else _copy_compiled
"""Copies bytes between arrays that do not overlap: `copy_bytes(source, offset, target, first,
length)`.
"""
