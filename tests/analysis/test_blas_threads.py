"""The linear algebra of NumPy and SciPy has one thread within a context, and its own number after it."""

import sys
from collections.abc import Iterator

import numpy as np
import pytest
import scipy.linalg

from trilat_net.analysis import blas_threads
from trilat_net.analysis.blas_threads import limit_blas_threads


@pytest.fixture(params=["numpy.linalg._umath_linalg", "scipy.linalg._fblas"])
def library(request: pytest.FixtureRequest) -> Iterator[blas_threads._BlasFunctions]:
    """The functions of a library, with two threads, as on a machine with two processors."""
    functions = blas_threads._find_blas_functions(request.param)
    if functions is None:
        pytest.skip(f"{request.param} has no OpenBLAS whose threads can be read")
    before = functions.get_threads()
    functions.set_threads(2)
    yield functions
    functions.set_threads(before)


def test_the_number_of_threads_is_restored(library: blas_threads._BlasFunctions) -> None:
    with limit_blas_threads():
        assert library.get_threads() == 1
    assert library.get_threads() == 2


def test_an_exception_restores_the_threads(library: blas_threads._BlasFunctions) -> None:
    with pytest.raises(ValueError, match="within"), limit_blas_threads():
        raise ValueError("within")
    assert library.get_threads() == 2


def test_nested_contexts_keep_one_thread(library: blas_threads._BlasFunctions) -> None:
    with limit_blas_threads():
        with limit_blas_threads():
            pass
        assert library.get_threads() == 1


def test_without_thread_control_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blas_threads, "_find_blas_functions", lambda _: None)
    with limit_blas_threads():
        assert np.linalg.eigvals(np.eye(2)).tolist() == [1.0, 1.0]
        assert scipy.linalg.expm(np.zeros((2, 2))).tolist() == np.eye(2).tolist()


def test_an_unloaded_library_stays_unloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "scipy.linalg._fblas")
    with limit_blas_threads():
        pass
    assert "scipy.linalg._fblas" not in sys.modules
