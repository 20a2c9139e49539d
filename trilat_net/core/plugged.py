"""Functions that the kernel calls by their address: of operators and delay models in files of
their own.

Invariant: a function is compiled for the layout of its numbers and of its row; the numbers
themselves stand in a table, so that no value compiles anything and no function recompiles the
kernel.
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
"""Without a compiler: the functions by the numbers that stand for their addresses."""


@intrinsic
def _call_compiled(_context: Any, address: Any, arguments: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = tuple(signature.args[1])
        form = context.call_conv.get_function_type(types.none, kinds)
        place = builder.inttoptr(values[0], form.as_pointer())
        given: Any = cgutils.unpack_tuple(builder, values[1])  # type: ignore[no-untyped-call]
        status, _ = context.call_conv.call_function(builder, place, types.none, kinds, given)
        with builder.if_then(status.is_error, likely=False):
            context.call_conv.return_status_propagate(builder, status)
        return context.get_dummy_value()

    return types.none(address, arguments), generate


def _call_plain(address: int, arguments: tuple[Any, ...]) -> None:
    _PLAIN[address](*arguments)


call_address: Any = _call_plain if _config.DISABLE_JIT else _call_compiled
"""Calls the function at an address with a tuple of arguments; what it raises goes on to the
caller.
"""


def digest_sibling_sources(function: Callable[..., Any]) -> str:
    """Returns a hash of the sources beside a function of this package; "": it is from
    elsewhere.
    """
    folder = Path(function.__code__.co_filename).parent
    if not folder.is_relative_to(Path(__file__).parents[1]):
        return ""
    return hashlib.sha256(
        b"".join(one.read_bytes() for one in sorted(folder.glob("*.py")))
    ).hexdigest()


def find_address(compiled: Any) -> int:
    """Returns the address of the machine code of a function that was compiled for one
    signature.
    """
    result = compiled.get_compile_result(compiled.nopython_signatures[0])
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


def _numbers_of(model: Any) -> dict[str, Array]:
    """Returns the numbers of a model by name; what is no number is left out."""
    named = {name: np.asarray(getattr(model, name)) for name in model.__struct_fields__}
    return {
        name: value.astype(np.float64)
        for name, value in named.items()
        if value.dtype.kind in "fiub"
    }


def list_numbers(model: Any) -> Array:
    """Returns the numbers of a model one after another, as its compiled function finds them."""
    return np.concatenate(
        [np.zeros(0), *(value.ravel() for value in _numbers_of(model).values())]
    )


@cache
def _compile(
    function: Callable[..., None], form: np.dtype[np.void], row: np.dtype[np.void]
) -> Any:
    count = form.itemsize // 8
    compute = numba.njit(**_OPTIONS)(function)

    def call(numbers: Any, now: Any) -> None:
        compute(numbers[:count].view(form)[0], now)

    if _config.DISABLE_JIT:
        return call
    kinds: Any = numba
    signature = types.none(types.float64[::1], kinds.from_dtype(row))
    if made_of := digest_sibling_sources(function):
        name = hashlib.sha256(
            f"{made_of} {function.__module__} {function.__qualname__} {form} {row}".encode()
        )
        return compile_named(call, f"own_{name.hexdigest()[:32]}", signature, **_OPTIONS)
    return numba.njit(signature, **_OPTIONS)(call)


def compile_to_address(model: Any, name: str, row: np.dtype[np.void]) -> int:
    """Returns the address of a function of a model, called with its numbers and a row of that
    layout.
    """
    fields: Any = [(key, value.dtype, value.shape) for key, value in _numbers_of(model).items()]
    function = getattr(type(model), name)
    call = _compile(function, np.dtype((np.record, fields or [("nothing", "f8")])), row)
    if _config.DISABLE_JIT:
        _PLAIN[id(call)] = call
        return id(call)
    return find_address(call)
