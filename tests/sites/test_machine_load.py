"""The load of a machine before a session begins on it."""

from pathlib import Path

import pytest

from tests.net.manual_clock import ManualClock
from trilat_net.app import machine_load
from trilat_net.app.machine_load import MEASURED_NS, check_machine_load

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
        ("cpu  190 0 60 800 50 0 0 0 0 0\n", "100%"),
        ("cpu  184 0 60 805 51 0 0 0 0 0\n", "94%"),
        ("cpu  180 0 50 810 60 0 0 0 0 0\n", "80%"),
        ("cpu  170 0 55 820 55 0 0 0 0 0\n", ""),
        ("cpu  110 0 50 880 60 0 0 0 0 0\n", ""),
        ("cpu  100 0 50 800 50 0 0 0 0 0\n", ""),  # no time has passed
        ("nonsense\n", ""),
    ],
)
def test_the_share_of_time_is_measured(
    after: str, share: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "stat"
    path.write_text(BEFORE)
    monkeypatch.setattr(machine_load, "_STATISTICS", path)
    clock = MeteredClock(path, after)
    warning = check_machine_load(clock)
    assert f"{share} busy" in warning if share else warning == ""
    assert clock.monotonic_ns() == MEASURED_NS


def test_without_statistics_no_load_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_load, "_STATISTICS", Path("/nowhere"))
    assert check_machine_load(ManualClock()) == ""


def test_warnings_are_one_sentence_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "stat"
    path.write_text(BEFORE)
    monkeypatch.setattr(machine_load, "_STATISTICS", path)
    warning = check_machine_load(MeteredClock(path, "cpu  197 0 50 803 50 0 0 0 0 0\n"))
    assert "97% busy" in warning
    assert "end those programs, or lower the rate" in warning
    assert ". " not in warning
