"""Threads of the linear algebra: as they were, and no number changed."""

import numpy as np
import pytest

from trilat_net.linear import threads
from trilat_net.linear.threads import one_thread


def test_the_number_of_threads_is_put_back_whatever_happens() -> None:
    found = threads._functions()
    if found is None:
        pytest.skip("this NumPy has no OpenBLAS that can be asked")
    get, _ = found
    before = get()
    with one_thread():
        assert get() == 1
    assert get() == before
    with pytest.raises(ValueError, match="within"), one_thread():
        raise ValueError("within")
    assert get() == before


def test_where_nobody_can_be_asked_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "_functions", lambda: None)
    with one_thread():
        assert np.linalg.eigvals(np.eye(2)).tolist() == [1.0, 1.0]
