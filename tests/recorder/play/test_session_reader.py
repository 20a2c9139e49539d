"""Reading a log for a replay."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.log.builders import write_log
from tests.recorder.play.logs import encode_event, preload_paths, read_payloads, write_event_log
from trilat_net.app.play.session_reader import PlaySelection, SessionReader
from trilat_net.errors import LogError, UsageError
from trilat_net.log.log_layout import ChannelFilter
from trilat_net.log.message_identity import compute_virtual_boot

from .logs import BOOT

TmpFactory = pytest.TempPathFactory
GOLDEN = Path(__file__).parents[2] / "golden"
LARGE = 1 << 28


def test_site_messages_are_read_byte_for_byte(log_file: Path) -> None:
    facts, block = preload_paths(log_file)
    played: dict[str, list[bytes]] = {topic: [] for topic in facts.topics}
    for _, channel, _, payload in block.messages():
        played[facts.topics[channel]].append(payload)
    published = {
        topic: payload_list
        for topic, payload_list in read_payloads(log_file).items()
        if topic.startswith("/trilat/")
    }
    assert played == published
    assert facts.session == "paper"
    assert facts.boots == {
        name: compute_virtual_boot(facts.scenario.sha256, name) for name in ("m1", "m2", "s")
    }
    assert facts.torn == {}


def test_numbers_are_record_ticks_or_places(log_file: Path) -> None:
    facts, block = preload_paths(log_file)
    for channel, topic in enumerate(facts.topics):
        numbers = block.numbers[block.channels == channel].tolist()
        assert numbers == list(range(len(numbers))), topic


@pytest.mark.parametrize("version", [1, 2])
def test_older_log_versions_are_read(version: int) -> None:
    path = GOLDEN / f"v{version}.mcap"
    facts, block = preload_paths(path)
    assert facts.version == version
    assert set(facts.boots) == {"m1", "m2", "s"}
    read = sorted(payload for _, _, _, payload in block.messages())
    assert read == sorted(
        p for payload_list in read_payloads(path).values() for p in payload_list
    )


@given(start_ms=st.integers(-10, 250), length_ms=st.integers(11, 320))
def test_only_the_window_is_read(
    start_ms: int, length_ms: int, tmp_path_factory: TmpFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "window.mcap"
    if not path.exists():
        write_event_log(path, [("m1", n, n, n) for n in range(300)])
    start_ns = start_ms * 1_000_000
    stop_ns = (start_ms + length_ms) * 1_000_000
    _, block = preload_paths(path, start_ns=start_ns, stop_ns=stop_ns)
    first = max(0, start_ms)
    last = min(299, start_ms + length_ms)
    assert block.numbers.tolist() == list(range(first, last + 1))


def test_times_are_sent_or_received(tmp_path: Path) -> None:
    path = write_event_log(
        tmp_path / "run.mcap", [("m1", 0, -20, 5), ("s", 0, 1, 6), ("m1", 1, 3, 90)]
    )
    for time, expected in (("publish", [-20, 1, 3]), ("log", [5, 6, 90])):
        _, block = preload_paths(path, time=time)
        assert block.times_ns.tolist() == [t * 1_000_000 for t in expected]


def test_parts_of_one_session_are_one_log(tmp_path: Path) -> None:
    first_part = write_event_log(tmp_path / "1.mcap", [("m1", 0, 0, 0), ("m1", 2, 20, 20)])
    two = write_event_log(
        tmp_path / "2.mcap", [("m1", 1, 10, 30), ("m1", 2, 20, 30), ("m1", 3, 40, 40)]
    )
    facts, block = preload_paths(first_part, two)
    assert [payload for _, _, _, payload in block.messages()] == [
        encode_event("m1", n) for n in range(4)
    ]
    assert facts.boots == {"m1": BOOT}
    other = write_event_log(tmp_path / "3.mcap", [("m1", 0, 0, 0)], "other")
    with pytest.raises(
        LogError, match=r"3\.mcap belongs to a different session from .*1\.mcap"
    ):
        SessionReader([first_part, other], PlaySelection()).preload(LARGE)


def test_torn_files_are_read_while_whole(short_log: bytes, tmp_path: Path) -> None:
    path = write_log(tmp_path, short_log[: len(short_log) * 95 // 100], "torn.mcap")
    facts, block = preload_paths(path)
    assert len(block) > 100
    assert facts.torn == {path: "the file was not finished"}


def test_large_logs_are_read_while_playing(log_file: Path) -> None:
    for limit_bytes in (0, 50_000):
        facts, block = SessionReader([log_file], PlaySelection()).preload(limit_bytes)
        assert block is None
        assert facts.session == "paper"
        assert set(facts.boots) == {"m1", "m2", "s"}


@pytest.mark.parametrize(
    ("selection", "problem"),
    [
        (
            PlaySelection(start_ns=5 * 10**9),
            r"start=5 s is after the end; .* from 0\.000 s to 0\.299 s",
        ),
        (PlaySelection(stop_ns=-(10**9)), r"stop -1 s is before the beginning"),
        (
            PlaySelection(ChannelFilter(include=("a/b",))),
            r"no message for this selection; .* form trilat/paper/m1/state",
        ),
    ],
)
def test_empty_selections_explain_the_choice(
    selection: PlaySelection, problem: str, log_file: Path
) -> None:
    with pytest.raises(UsageError, match=problem):
        SessionReader([log_file], selection).preload(LARGE)


def test_nonsense_stamps_are_replaced_by_arrival_times(tmp_path: Path) -> None:
    path = write_event_log(
        tmp_path / "run.mcap",
        [("m1", 0, 0, 0), ("m1", 1, 10**9, 5), ("s", 2**63 - 1, -(10**9), 7)],
    )
    _, block = preload_paths(path)
    assert block.times_ns.tolist() == [0, 5_000_000, 7_000_000]
