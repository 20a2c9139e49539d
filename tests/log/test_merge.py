"""Parts of a session read as one log, whatever they are; what is no part of it is refused."""

import io
from functools import cache
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.log.builders import make_log_bytes, open_bytes
from tests.log.split_logs import (
    Message,
    change_message,
    make_bytes_of_messages,
    make_parts,
    read_messages,
)
from trilat_net.errors import LogError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.messages import Event, RecorderStats
from trilat_net.net.wire import encode
from trilat_net.scenario import load_scenario


@cache
def make_whole_bytes() -> bytes:
    return make_log_bytes("paper")


@cache
def count_records() -> int:
    return len(read_messages(make_whole_bytes()))


def open_parts(*parts: bytes) -> Log:
    return open_log(*map(io.BytesIO, parts))


def list_content(log: Log) -> dict[str, object]:
    """All that a log holds, as its file has it."""
    return {
        "records": {name: list(log[name].payloads) for name in log.sites},
        "came": {name: log[name].log_time_ns.tolist() for name in log.sites},
        "statistics": {name: log.link_stats(name) for name in log.sites},
        "events": log.events,
        "missing": [log.missing(name) for name in log.sites],
    }


@st.composite
def deal_places(draw: st.DrawFn) -> list[set[int]]:
    """Every message in one of the hands at least, some in several."""
    n = draw(st.integers(1, 4))
    bounds = sorted(
        draw(st.lists(st.integers(0, count_records()), min_size=n - 1, max_size=n - 1))
    )
    edges = [0, *bounds, count_records()]
    overlap = st.sets(st.integers(0, count_records() - 1), max_size=20)
    return [set(range(edges[k], edges[k + 1])) | draw(overlap) for k in range(n)]


@settings(max_examples=12)
@given(deal_places(), st.randoms(use_true_random=False))
def test_parts_in_any_order_read_as_the_whole(dealing, chance) -> None:
    parts = make_parts(make_whole_bytes(), dealing)
    chance.shuffle(parts)
    log = open_parts(*parts)
    assert list_content(log) == list_content(open_bytes(make_whole_bytes()))
    assert log.complete


def test_a_log_of_parts_verifies_as_the_whole() -> None:
    parts = make_parts(make_whole_bytes(), [range(200), range(150, count_records())])
    verdict = verify_log(open_parts(*parts))
    assert (verdict.identical, verdict.first) == (360, None)
    assert verdict.gaps == []


def place_of(topic_end: str, number: int = 0) -> int:
    return [
        n for n, m in enumerate(read_messages(make_whole_bytes())) if m[0].endswith(topic_end)
    ][number]


@pytest.mark.parametrize(
    ("where", "fields", "named"),
    [
        ("m1/state", {"q": [9.0, 9.0]}, "record of tick 0 of m1"),
        ("m2/link", {"overruns": 9}, "statistics of tick 0 of m2"),
        ("s/event", {"text": "no"}, "event 0 of s"),
    ],
)
def test_contradicting_parts_are_refused_by_name(
    where: str, fields: dict[str, object], named: str, tmp_path: Path
) -> None:
    messages = read_messages(make_whole_bytes())
    other: list[Message] = [change_message(messages[place_of(where)], **fields)]
    paths = [tmp_path / "run-001.mcap", tmp_path / "run-002.mcap"]
    paths[0].write_bytes(make_whole_bytes())
    paths[1].write_bytes(make_bytes_of_messages(make_whole_bytes(), other))
    with pytest.raises(LogError, match=named) as raised:
        open_log(*paths)
    assert all(str(path) in str(raised.value) for path in paths)


@pytest.mark.parametrize(
    ("session", "scenario", "named"),
    [
        ({"session": "lab"}, None, "session is lab, not paper"),
        ({"epoch_unix_ns": "7"}, None, "epoch_unix_ns is 7, not 0"),
        ({"driver": "live"}, None, "driver is live, not virtual"),
        ({}, load_scenario("free").text, "scenario is [0-9a-f]{16}, not "),
    ],
)
def test_other_sessions_are_refused_with_differences(
    session: dict[str, str], scenario: str | None, named: str, tmp_path: Path
) -> None:
    first = tmp_path / "one.mcap"
    two = tmp_path / "two.mcap"
    first.write_bytes(make_whole_bytes())
    two.write_bytes(
        make_bytes_of_messages(make_whole_bytes(), [], session=session, scenario=scenario)
    )
    with pytest.raises(
        LogError, match=rf"two\.mcap is not a part of the session in .*one\.mcap: {named}"
    ):
        open_log(first, two)


def test_parts_fill_holes_of_torn_parts() -> None:
    messages = read_messages(make_whole_bytes())
    torn = make_bytes_of_messages(make_whole_bytes(), messages[:150], finished=False)
    carried_on = make_bytes_of_messages(make_whole_bytes(), messages[100:], part=2)
    assert not open_bytes(torn).complete
    assert not open_bytes(carried_on).complete
    assert open_parts(torn, carried_on).complete


def test_a_record_missing_in_all_parts_is_missing() -> None:
    messages = read_messages(make_whole_bytes())
    torn = make_bytes_of_messages(make_whole_bytes(), messages[:150], finished=False)
    log = open_parts(torn, make_bytes_of_messages(make_whole_bytes(), messages[151:], part=2))
    assert not log.complete
    assert sum(map(log.missing, log.sites)) == 1
    assert sum("missing 1" in log.account(name) for name in log.sites) == 1


def test_unfinished_parts_leave_the_whole_incomplete() -> None:
    parts = make_parts(
        make_whole_bytes(), [range(100), range(100, 200), range(200, count_records())]
    )
    assert open_parts(*parts).complete
    assert not open_parts(parts[0], parts[2]).complete
    assert not open_bytes(parts[2]).complete
    messages = read_messages(make_whole_bytes())
    assert not open_parts(
        make_bytes_of_messages(make_whole_bytes(), messages[:50]),
        make_bytes_of_messages(make_whole_bytes(), messages[50:], finished=False),
    ).complete


def make_recorder_part(recorder: int, *, at_ns: int, dropped: int, part: int) -> bytes:
    """A part that a recorder wrote, with what it counted so far."""
    stream = io.BytesIO()
    scenario = load_scenario("free")
    writer = LogWriter(
        stream,
        scenario,
        "lab",
        "live",
        10**18,
        collect_provenance(),
        part={"index": str(part), "previous": ""},
    )
    stats = RecorderStats(boot=recorder, t_ns=at_ns, expected={}, received={}, missing={})
    event = Event(member="recorder", boot=recorder, kind="late", text="late", n=0)
    for channel, message in ((topics.STATS, stats), (topics.EVENT, event)):
        payload = encode(message)
        writer.add(
            topics.key("lab", topics.RECORDER, channel), payload, at_ns, 10**18 + at_ns, 0
        )
    writer.finish({"dropped: stranger": str(dropped), "/trilat/lab/m1/state": "received 7"})
    return stream.getvalue()


def test_drops_counted_across_parts_are_counted_once() -> None:
    log = open_parts(
        make_recorder_part(1, at_ns=0, dropped=2, part=1),
        make_recorder_part(1, at_ns=10, dropped=5, part=2),
        make_recorder_part(2, at_ns=20, dropped=1, part=3),
    )
    assert log.accounts["dropped: stranger"] == "6"
    assert log.account("m1").startswith("expected 0, received 0")
    assert [stats.boot for stats in log.recorder_stats()] == [1, 1, 2]
    assert [event.boot for event in log.events] == [1, 2]


def test_unnumbered_events_differ_by_content() -> None:
    messages = read_messages(make_whole_bytes())
    event_index = place_of("m1/event")
    old = [change_message(messages[event_index], n=-1, text=text) for text in ("a", "b")]
    log = open_parts(
        make_bytes_of_messages(make_whole_bytes(), old),
        make_bytes_of_messages(
            make_whole_bytes(), [*old, messages[place_of("m1/state")]], part=2
        ),
    )
    assert [event.text for event in log.events] == ["a", "b"]


def test_progress_covers_all_parts(tmp_path: Path) -> None:
    parts = make_parts(make_whole_bytes(), [range(200), range(200, count_records())])
    paths = [tmp_path / f"run-{n}.mcap" for n in range(2)]
    for path, data in zip(paths, parts, strict=True):
        path.write_bytes(data)
    reported: list[tuple[int, int]] = []
    open_log(*paths, progress=lambda done, total: reported.append((done, total)))
    total = sum(map(len, parts))
    assert {of for _, of in reported} == {total}
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    assert total - 100 < reported[-1][0] <= total


def test_parts_with_invalid_messages_are_named(tmp_path: Path) -> None:
    messages = read_messages(make_whole_bytes())
    first = tmp_path / "run-001.mcap"
    second = tmp_path / "run-002.mcap"
    first.write_bytes(make_bytes_of_messages(make_whole_bytes(), messages[:100]))
    second.write_bytes(
        make_bytes_of_messages(
            make_whole_bytes(), [(messages[place_of("m1/state")][0], b"\x80", 0, 0, 0)], part=2
        )
    )
    with pytest.raises(
        LogError, match=r"run-002\.mcap: a message on /trilat/paper/m1/state cannot be read"
    ):
        open_log(first, second)


def test_an_opened_session_states_its_parts() -> None:
    parts = make_parts(make_whole_bytes(), [range(200), range(200, count_records())])
    log = open_parts(*parts)
    assert repr(log) == (
        "<Log log and 1 more part: virtual session paper of m1, m2, s; 0.119 s, 360 records, none missing>"
    )
    assert repr(log["m1"]) == "<m1: 120 records of 1000 Hz, 0.000 s to 0.119 s, none missing>"
    assert msgspec.structs.asdict(log.events[0])["kind"] == "end"
