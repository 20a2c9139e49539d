from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import pytest

from trilat_net.errors import RunFailed
from trilat_net.studies.tuning.candidate import measure_candidate, open_candidate_pool

from .experiments import trio


class _Lost:
    """Stands for processes that somebody killed."""

    def map(self, *_: Any) -> Iterator[Any]:
        raise BrokenProcessPool

    def shutdown(self, *, cancel_futures: bool) -> None:
        assert cancel_futures


def test_scores_come_in_the_order_of_the_candidates_and_each_is_told() -> None:
    texts = [trio(f"control.Kp={Kp}", "duration_s=0.2").text for Kp in (1.0, 5.0, 2.0)]
    told: list[int] = []
    with open_candidate_pool(1) as runners:
        scores = runners.scores([(text, None) for text in texts], lambda: told.append(len(told)))
        assert runners.scores([], lambda: None) == []
    assert scores == [measure_candidate(text, None) for text in texts]
    assert told == [0, 1, 2]


def test_processes_that_end_are_told_of_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    with open_candidate_pool(1) as runners:
        monkeypatch.setattr(runners, "_pool", _Lost())
        with pytest.raises(RunFailed, match="a process of the search was ended"):
            runners.scores([("", None)], lambda: None)
