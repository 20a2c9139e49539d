"""Small matrices on one thread.

Law: it changes how long a computation takes, and nothing else; where the library of NumPy cannot be asked,
nothing happens.

OpenBLAS shares out products of matrices of a hundred rows to all cores and waits for them in a loop. With
another process on one of the cores an eigenvalue problem then takes a hundred times as long.
"""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import numpy.linalg

_NAMES = ("scipy_openblas_{}_num_threads64_", "openblas_{}_num_threads64_", "openblas_{}_num_threads")


@contextmanager
def one_thread() -> Iterator[None]:
    """Lets NumPy's linear algebra use one thread for a while."""
    found = _functions()
    if found is None:
        yield
        return
    get, put = found
    before = get()
    put(1)
    try:
        yield
    finally:
        put(before)


@cache
def _functions() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """Returns how the number of threads is read and written, or None."""
    module = getattr(numpy.linalg, "_umath_linalg", None)
    try:
        library = ctypes.CDLL(module.__file__)  # type: ignore[union-attr]
    except (AttributeError, OSError, TypeError):
        return None
    for name in _NAMES:
        try:
            return getattr(library, name.format("get")), getattr(library, name.format("set"))
        except AttributeError:
            continue
    return None
