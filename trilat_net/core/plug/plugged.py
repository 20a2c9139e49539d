"""Compiles models that users write in Python, so that the simulation can call them.

A model describes an operator who moves an arm, an environment that the arm touches, or the
delays of a network. It consists of numerical parameters and a function. The simulation calls
the function with the parameters and a row of an array. The function reads its input from the
row and writes its result into it.

Invariant:
    - A function is recompiled only if the shapes of its parameters or the fields of the row
      change. The parameter values are stored in a table, so changing them requires no
      compilation.
    - The simulation itself is never recompiled for a new function, because it calls the
      function by address.
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

from ..step.jit import compile_named
from ..step.vectors import Array

_OPTIONS: Any = {"_nrt": False, "error_model": "numpy"}
_config: Any = numba.config
_PLAIN: dict[int, Callable[..., None]] = {}
"""Python functions, keyed by the numbers that replace their addresses if Numba is disabled."""


@intrinsic
def _call_compiled(_context: Any, address: Any, arguments: Any) -> Any:
    """Generates a call to a compiled function at an address. The function returns nothing.

    Numba calls this while compiling a caller of `call_address`. An exception raised by the
    called function propagates to its caller.

    Args:
        _context: Numba's typing context.
        address: Numba's type of the address, an integer.
        arguments: Numba's type of the tuple of arguments.

    Returns:
        The signature and the function that generates the LLVM code of the call, as Numba
        requires from an intrinsic.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        """Generates LLVM code that calls a function at an address, as `function(*arguments)`.

        Because the address is a runtime value, the compiled caller does not depend on the
        function and need not be recompiled for another function. Numba calls `generate` while
        compiling the caller. Arguments, result and exceptions are passed as in any function
        compiled by Numba.

        Args:
            context: Numba's description of the target processor.
            builder: Appends LLVM instructions to the caller.
            signature: Types of the two arguments of the intrinsic: an integer, and a tuple with
                one type per argument of the function.
            values: LLVM values of the same two arguments: the address of the function, and the
                tuple of its arguments.

        Returns:
            The LLVM value that represents None, because the called function returns nothing.
        """
        convention = context.call_conv
        address_value, tuple_value = values
        argument_types = tuple(signature.args[1])
        # Convert the address, an integer, to a pointer to a function that returns None.
        function_type = convention.get_function_type(types.none, argument_types)
        pointer = builder.inttoptr(address_value, function_type.as_pointer())
        unpack: Any = cgutils.unpack_tuple
        argument_values = unpack(builder, tuple_value)
        # A compiled function returns a status, which states whether it raised an exception. If
        # so, the caller returns at once with the same status.
        status, _ = convention.call_function(
            builder, pointer, types.none, argument_types, argument_values
        )
        with builder.if_then(status.is_error, likely=False):
            convention.return_status_propagate(builder, status)
        return context.get_dummy_value()  # Numba represents None by an arbitrary value

    # Calling a Numba type with types of arguments gives a signature, here with the result None.
    return types.none(address, arguments), generate


def _call_plain(address: int, arguments: tuple[Any, ...]) -> None:
    """Calls a Python function by its number in `_PLAIN`. Used when Numba is disabled.

    Without Numba, there is no machine code and hence no address. `UserModel` then registers the
    Python function under a number and returns this number instead of an address.

    Args:
        address: The number.
        arguments: Arguments of the function.
    """
    function = _PLAIN[address]
    function(*arguments)


call_address: Any = _call_plain if _config.DISABLE_JIT else _call_compiled
"""Calls the function at an address with a tuple of arguments. Exceptions propagate."""


def digest_sibling_sources(function: Callable[..., Any]) -> str:
    """Returns a hash of all source files in a function's folder.

    Compiled code is cached on disk under this hash. If any of the files changes, the hash
    changes too, and the function is compiled again.

    Args:
        function: A function.

    Returns:
        The hash, or an empty string if the function is not part of this package, in which case
        its code is not cached.
    """
    folder = Path(function.__code__.co_filename).parent
    if not folder.is_relative_to(Path(__file__).parents[2]):
        return ""
    files = sorted(folder.glob("*.py"))
    sources = [file.read_bytes() for file in files]
    return hashlib.sha256(b"".join(sources)).hexdigest()


def find_address(compiled: Any) -> int:
    """Returns the memory address at which machine code can call a compiled function.

    Args:
        compiled: Function compiled by Numba for exactly one signature.
    """
    result = compiled.get_compile_result(compiled.nopython_signatures[0])
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


@cache
def _compile(
    function: Callable[..., None], form: np.dtype[np.void], row: np.dtype[np.void]
) -> Any:
    """Compiles a function of a user's model, so that machine code can call it.

    The function expects the parameters of its model as a record, whereas the simulation stores
    them as an array of floats. The result therefore takes this array, and passes the function a
    view of it as a record.

    Args:
        function: The function of the model, called with the parameters and with a row.
        form: Layout of the parameters: the name and shape of each parameter, all floats.
        row: Layout of the row that contains the input of the function and receives its result.

    Returns:
        The compiled function, whose arguments are the parameter array and the row. A Python
        function if Numba is disabled.
    """
    count = form.itemsize // 8  # floats of 8 bytes
    compute = numba.njit(**_OPTIONS)(function)

    def call(numbers: Any, now: Any) -> None:
        """Calls the user's function with the parameters of its model as a record.

        The simulation stores the parameters of all models as floats in one table. The record is
        a view of this model's part of the table, with the parameter names as field names.

        Args:
            numbers: The parameters, possibly followed by other floats.
            now: Row that contains the input of the function and receives its result.
        """
        model = numbers[:count].view(form)[0]
        compute(model, now)

    if _config.DISABLE_JIT:
        return call
    numba_types: Any = numba
    row_type = numba_types.from_dtype(row)
    signature = types.none(types.float64[::1], row_type)
    sources = digest_sibling_sources(function)
    is_part_of_this_package = bool(sources)
    if is_part_of_this_package:
        # The machine code is cached on disk, under a hash of everything that it depends on.
        text = f"{sources} {function.__module__} {function.__qualname__} {form} {row}"
        digest = hashlib.sha256(text.encode()).hexdigest()
        return compile_named(call, f"own_{digest[:32]}", signature, **_OPTIONS)
    # A user's function may depend on files that are unknown: it is compiled in each process.
    return numba.njit(signature, **_OPTIONS)(call)


class UserModel:
    """A user's model in the form that the simulation requires: parameters and machine code.

    Args:
        model: A model of an operator, an environment or network delays.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    @property
    def numbers(self) -> Array:
        """All numerical parameters of the model, concatenated into one array.

        The compiled simulation stores the parameters of all models in this form. The array is
        empty if the model has no parameters.
        """
        fields = [value.ravel() for value in self._find_parameters().values()]
        # A model without parameters yields an empty array.
        return np.concatenate([np.zeros(0), *fields])

    def compile_to_address(self, name: str, row: np.dtype[np.void]) -> int:
        """Compiles a function of the model, and returns the address of its machine code.

        The compiled simulation uses the address to call the function without Python. The
        arguments of the function are the parameters of the model and a row of an array.

        Args:
            name: Name of the function in the class of the model.
            row: Data type of the row.

        Returns:
            The address. If Numba is disabled, a number under which the Python function is
            registered.
        """
        fields: Any = []
        for field, value in self._find_parameters().items():
            fields.append((field, value.dtype, value.shape))
        if not fields:
            fields.append(("nothing", "f8"))
        function = getattr(type(self._model), name)
        form = np.dtype((np.record, fields))
        call = _compile(function, form, row)
        if _config.DISABLE_JIT:
            _PLAIN[id(call)] = call
            return id(call)
        return find_address(call)

    def _find_parameters(self) -> dict[str, Array]:
        """Returns the numerical fields of the model, a mapping from name to array.

        The compiled function of the model receives them as a row with these field names. Fields
        of other types, such as strings, are omitted. For example, a field `stiffness_n_m = 200`
        becomes {"stiffness_n_m": array(200.0)}.
        """
        parameters = {}
        for name in self._model.__struct_fields__:
            value = np.asarray(getattr(self._model, name))
            is_number = value.dtype.kind in "fiub"
            if is_number:
                parameters[name] = value.astype(np.float64)
        return parameters
