"""Restricts the linear algebra of NumPy and SciPy (OpenBLAS) to one thread.

The matrices of this package are small, but OpenBLAS distributes even small matrices over all
processors, and its idle threads busy-wait. As a result, computing a characteristic root takes
twice the processor time, and the processes of a parameter sweep slow each other down.

NumPy and SciPy each contain their own copy of OpenBLAS with its own thread count.
"""

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import NamedTuple

_MODULES = ("numpy.linalg._umath_linalg", "scipy.linalg._fblas")
"""Modules that are linked to the OpenBLAS of NumPy and to that of SciPy."""
_SYMBOLS = (
    "scipy_openblas_{}_num_threads64_",
    "scipy_openblas_{}_num_threads",
    "openblas_{}_num_threads64_",
    "openblas_{}_num_threads",
)
"""Names of OpenBLAS's functions in its builds; "{}" stands for "get" or "set"."""


class _BlasFunctions(NamedTuple):
    """Functions that read and set the number of threads of OpenBLAS.

    OpenBLAS is the library behind the linear algebra of NumPy. NumPy and SciPy each contain a
    copy, and each copy has its own number of threads.

    Attributes:
        get_threads: Returns the number of threads.
        set_threads: Sets the number of threads.
    """

    get_threads: Callable[[], int]
    set_threads: Callable[[int], None]


@contextmanager
def limit_blas_threads() -> Iterator[None]:
    """Limits the linear algebra of NumPy and SciPy to one thread within the context.

    Can also be used as a decorator. The previous thread counts are restored on exit, even after
    an exception. SciPy is limited only if it has already been imported. A library that provides
    no functions to set the thread count is left alone.
    """
    libraries = []
    for module_name in _MODULES:
        functions = _find_blas_functions(module_name) if module_name in sys.modules else None
        if functions is not None:
            libraries.append((functions, functions.get_threads()))
    for functions, _ in libraries:
        functions.set_threads(1)
    try:
        yield
    finally:
        for functions, previous_count in libraries:
            functions.set_threads(previous_count)


@cache
def _find_blas_functions(module_name: str) -> _BlasFunctions | None:
    """Finds the functions that control the threads of the OpenBLAS library of a module.

    NumPy and SciPy are such modules. Their wheels contain a copy of OpenBLAS each.

    Args:
        module_name: Name of an imported module that is linked to the library.

    Returns:
        The functions. `None` if the module uses another library.
    """
    try:
        library = ctypes.CDLL(sys.modules[module_name].__file__)
    except (OSError, TypeError):
        return None
    for symbol in _SYMBOLS:
        try:
            return _BlasFunctions(
                get_threads=getattr(library, symbol.format("get")),
                set_threads=getattr(library, symbol.format("set")),
            )
        except AttributeError:
            continue
    return None
