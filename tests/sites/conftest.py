import pytest

from sites import realtime


@pytest.fixture
def unprepared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves the test's own process as it is: no real-time priority, no locked memory."""
    monkeypatch.setattr(realtime, "prepare", lambda _cpu: {"scheduling": "as it was", "memory": "as it was"})
