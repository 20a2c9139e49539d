"""The selection of a log's messages for a replay."""

import pytest

from trilat_net.app.play.session_reader import PlaySelection
from trilat_net.errors import UsageError

SITES = ("m1", "m2", "s")
TOPICS = [
    "/trilat/paper/m1/state",
    "/trilat/paper/m1/link",
    "/trilat/paper/s/event",
    "/trilat/paper/recorder/event",
    "/trilat/paper/recorder/stats",
    "/viz/m1/joint_states",
]


def select_channels(include: tuple[str, ...] = (), exclude: tuple[str, ...] = ()) -> list[str]:
    selection = PlaySelection.parse(include, exclude, None, None, None, "publish")
    return [topic for topic in TOPICS if selection.accepts(topic, SITES)]


def test_default_is_all_messages_of_sites() -> None:
    assert select_channels() == TOPICS[:3]


def test_included_channels_are_played_alone() -> None:
    assert select_channels(("/viz/**",)) == TOPICS[5:]
    assert select_channels(("**/state", "trilat/*/s/*")) == [TOPICS[0], TOPICS[2]]
    assert select_channels(("**",)) == TOPICS


def test_exclusion_overrides_inclusion() -> None:
    assert select_channels(exclude=("**/link",)) == [TOPICS[0], TOPICS[2]]
    assert select_channels(("**",), ("/trilat/**",)) == TOPICS[5:]


def test_durations_count_from_start_or_tick_0() -> None:
    window = PlaySelection.parse((), (), 2.0, None, 0.5, "log")
    assert (window.start_ns, window.stop_ns, window.time) == (
        2_000_000_000,
        2_500_000_000,
        "log",
    )
    window = PlaySelection.parse((), (), None, None, 0.5, "publish")
    assert (window.start_ns, window.stop_ns) == (None, 500_000_000)


@pytest.mark.parametrize(
    ("start_s", "stop_s", "duration_s", "problem"),
    [
        (None, 1.0, 1.0, "stop and duration_s set the same limit"),
        (2.0, 2.0, None, r"stop must be after start \(2 s\), not 2 s"),
        (None, None, 0.0, "duration_s must be more than 0 s"),
        (float("nan"), None, None, "start must be a number of seconds"),
        (None, float("inf"), None, "stop must be a number of seconds"),
        (1e300, None, None, "start must be a number of seconds"),
    ],
)
def test_invalid_windows_are_refused(
    start_s: float | None, stop_s: float | None, duration_s: float | None, problem: str
) -> None:
    with pytest.raises(UsageError, match=problem):
        PlaySelection.parse((), (), start_s, stop_s, duration_s, "publish")
