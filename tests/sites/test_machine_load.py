"""The load of a machine before a session begins on it."""

from pathlib import Path

import pytest

from sites import machine_load
from sites.machine_load import MEASURED_NS, describe_load, measure_busy_share
from tests.net.manual_clock import ManualClock

BEFORE = "cpu  100 0 50 800 50 0 0 0 0 0\ncpu0 1 1 1 1 1 1 1 1 1 1\n"


class MeteredClock(ManualClock):
    """A clock that writes the next statistics of the system at each sleep."""

    def __init__(self, path: Path, after: str) -> None:
        super().__init__()
        self._path = path
        self._after = after

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns)
        self._path.write_text(self._after)


@pytest.mark.parametrize(
    ("after", "share"),
    [
        ("cpu  190 0 60 800 50 0 0 0 0 0\n", 1.0),
        ("cpu  110 0 50 880 60 0 0 0 0 0\n", 0.1),
        ("cpu  100 0 50 800 50 0 0 0 0 0\n", None),  # no time has passed
        ("nonsense\n", None),
    ],
)
def test_the_share_of_time_is_measured(
    after: str, share: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "stat"
    path.write_text(BEFORE)
    monkeypatch.setattr(machine_load, "_STATISTICS", path)
    clock = MeteredClock(path, after)
    assert measure_busy_share(clock) == (share if share is None else pytest.approx(share))
    assert clock.monotonic_ns() == MEASURED_NS


def test_without_statistics_no_load_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_load, "_STATISTICS", Path("/nowhere"))
    assert describe_load(measure_busy_share(ManualClock())) == ""


def test_warnings_are_one_sentence_with_advice() -> None:
    assert describe_load(0.5) == ""
    warning = describe_load(0.97)
    assert "97% busy" in warning or "97 % busy" in warning
    assert "end those programs, or lower the rate" in warning
    assert ". " not in warning
