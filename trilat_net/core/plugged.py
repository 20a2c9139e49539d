"""Compiles functions of operators and delay models, which the kernel calls by their address.

The kernel is the compiled code that computes a tick, one period of a control loop. A model
describes, for example, an operator who moves an arm, or the delays of a network. It consists of
a few numbers and of a function. The function computes with these numbers and with a row of the
kernel's arrays.

Invariant:
    - A function is compiled for the layout of its numbers and of its row. The numbers
      themselves are stored in a table, so new values need no compilation.
    - A new function does not recompile the kernel, because the kernel knows only its address.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .jit import compile_named
from .vectors import Array

_OPTIONS: Any = {"_nrt": False, "error_model": "numpy"}
_config: Any = numba.config
_PLAIN: dict[int, Callable[..., None]] = {}
"""The functions by the numbers that replace their addresses if Numba is disabled."""


@intrinsic
def _call_compiled(_context: Any, address: Any, arguments: Any) -> Any:
    """Generates the call of a compiled function, which returns nothing, by its address.

    An exception of the function propagates to the caller.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        convention = context.call_conv
        address_value, tuple_value = values
        argument_types = tuple(signature.args[1])
        function_type = convention.get_function_type(types.none, argument_types)
        pointer = builder.inttoptr(address_value, function_type.as_pointer())
        unpack: Any = cgutils.unpack_tuple
        argument_values = unpack(builder, tuple_value)
        status, _ = convention.call_function(
            builder, pointer, types.none, argument_types, argument_values
        )
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.none(address, arguments), generate


def _call_plain(address: int, arguments: tuple[Any, ...]) -> None:
    """Calls a function by the number that replaces its address while Numba is disabled."""
    function = _PLAIN[address]
    function(*arguments)


call_address: Any = _call_plain if _config.DISABLE_JIT else _call_compiled
"""Calls the function at an address with a tuple of arguments; its exceptions propagate."""


def digest_sibling_sources(function: Callable[..., Any]) -> str:
    """Returns a hash of all source files in the folder of a function.

    The hash names the compiled function on disk, so that a change of the source compiles it
    again.

    Args:
        function: The function.

    Returns:
        The hash. Empty for a function outside of this package, which is not stored.
    """
    folder = Path(function.__code__.co_filename).parent
    if not folder.is_relative_to(Path(__file__).parents[1]):
        return ""
    sources = [file.read_bytes() for file in sorted(folder.glob("*.py"))]
    return hashlib.sha256(b"".join(sources)).hexdigest()


def find_address(compiled: Any) -> int:
    """Returns the address of a compiled function, at which machine code can call it.

    Args:
        compiled: Function that Numba compiled for one signature.
    """
    result = compiled.get_compile_result(compiled.nopython_signatures[0])
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _find_numbers(model: Any) -> dict[str, Array]:
    """Returns the fields of a model that are numbers, by name, as arrays of floats."""
    numbers = {}
    for name in model.__struct_fields__:
        value = np.asarray(getattr(model, name))
        is_number = value.dtype.kind in "fiub"
        if is_number:
            numbers[name] = value.astype(np.float64)
    return numbers


def list_numbers(model: Any) -> Array:
    """Returns the numbers of a model one after another, in the order of its fields.

    Args:
        model: An operator, an environment or a delay model.
    """
    fields = [value.ravel() for value in _find_numbers(model).values()]
    # A model without numbers gives an empty array.
    return np.concatenate([np.zeros(0), *fields])


@cache
def _compile(
    function: Callable[..., None], form: np.dtype[np.void], row: np.dtype[np.void]
) -> Any:
    """Returns the compiled form of a function, called with an array of numbers and a row.

    Args:
        function: The function.
        form: Layout of the numbers of its model.
        row: Layout of the row.
    """
    count = form.itemsize // 8
    compute = numba.njit(**_OPTIONS)(function)

    def call(numbers: Any, now: Any) -> None:
        compute(numbers[:count].view(form)[0], now)

    if _config.DISABLE_JIT:
        return call
    numba_types: Any = numba
    row_type = numba_types.from_dtype(row)
    signature = types.none(types.float64[::1], row_type)
    sources = digest_sibling_sources(function)
    if sources:
        text = f"{sources} {function.__module__} {function.__qualname__} {form} {row}"
        digest = hashlib.sha256(text.encode()).hexdigest()
        return compile_named(call, f"own_{digest[:32]}", signature, **_OPTIONS)
    return numba.njit(signature, **_OPTIONS)(call)


def compile_to_address(model: Any, name: str, row: np.dtype[np.void]) -> int:
    """Compiles a function of a model, and returns the address of the machine code.

    While Numba is disabled, the result is a number under which the plain function is
    registered.

    Args:
        model: An operator, an environment or a delay model. The function is called with the
            model's numbers and a row.
        name: Name of the function.
        row: Layout of the row.
    """
    fields: Any = []
    for field, value in _find_numbers(model).items():
        fields.append((field, value.dtype, value.shape))
    if not fields:
        fields.append(("nothing", "f8"))
    function = getattr(type(model), name)
    form = np.dtype((np.record, fields))
    call = _compile(function, form, row)
    if _config.DISABLE_JIT:
        _PLAIN[id(call)] = call
        return id(call)
    return find_address(call)
