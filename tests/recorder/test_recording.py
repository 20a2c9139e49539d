"""The output of the recorder: stored, refused and counted messages, and known losses."""

import io
from pathlib import Path

import msgpack
import msgspec
import pytest

from recorder import site_reception as tap_module
from recorder.record_process import FLUSH_NS, POLL_NS, Recorder
from recorder.session_recording import LAST_NS, RECONNECT_NS, SETTLE_NS
from recorder.site_reception import AWAY_NS, EVENT_BYTES
from tests.net.local_bus import LocalNetwork
from tests.net.waiting import sleep_for_ns
from tests.recorder.desk import encode_end, encode_event, encode_states, encode_statistics
from tests.sites.relay import Relay, RelayClock
from trilat_net.app.recorded_session import make_scenario_reader
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogStorage
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.messages import Event
from trilat_net.net.wire import encode, encode_state
from trilat_net.scenario import load_scenario

from .desk import (
    BOOTS,
    EPOCH,
    MONO_NS,
    MS,
    SCENARIO,
    SESSION,
    TICKS,
    UNIX_NS,
    Desk,
    Memory,
    answer_info,
)


def after_the_end() -> bytes:
    site = Site(SCENARIO.setup("m"))
    return encode_state(
        "m", BOOTS["m"], site.peers, site.step(TickInput(0))._replace(tick=TICKS), [], 0, 0
    )


OTHERS_WORD = encode(Event(member=topics.RECORDER, boot=99, n=0, kind="stored", text=""))
REFUSED = {
    "another start of the site": (
        "stranger",
        "m",
        topics.STATE,
        encode_states("m", boot=99)[3],
    ),
    "another site's record": ("stranger", "m", topics.STATE, encode_states("s")[3]),
    "an unknown site": ("stranger", "nobody", topics.STATE, encode_states("m")[3]),
    "an unknown member's event": ("stranger", "nobody", topics.EVENT, encode_end("m")),
    "an end of another start": ("stranger", "m", topics.EVENT, encode_end("m", boot=99)),
    "an end in the recorder's name": (
        "stranger",
        topics.RECORDER,
        topics.EVENT,
        encode_end("m"),
    ),
    "another site's statistics": ("stranger", "m", topics.LINK, encode_statistics("s")),
    "a word of another recorder": (
        "another recorder",
        topics.RECORDER,
        topics.EVENT,
        OTHERS_WORD,
    ),
    "a record after the end": ("out of range", "m", topics.STATE, after_the_end()),
    "statistics after the end": ("out of range", "m", topics.LINK, encode_statistics("m", 100)),
    "an end after the end": ("out of range", "m", topics.EVENT, encode_end("m", TICKS + 1)),
    "an end before the beginning": ("out of range", "m", topics.EVENT, encode_end("m", -1)),
    "nothing": ("malformed", "m", topics.STATE, b""),
    "no message": ("malformed", "m", topics.LINK, b"\xc1"),
    "no fields": ("malformed", "m", topics.EVENT, b"\x80"),
    "too much": ("oversized", "m", topics.EVENT, bytes(70_000)),
}


@pytest.mark.parametrize(
    ("reason", "name", "channel", "payload"), REFUSED.values(), ids=REFUSED.keys()
)
def test_foreign_messages_are_dropped_and_others_kept(
    reason: str, name: str, channel: str, payload: bytes
) -> None:
    desk = Desk()
    desk.take(name, channel, payload)
    assert desk.recording.dropped == {reason: 1}
    assert desk.stored() == []
    assert not desk.over()
    desk.whole("m")
    assert not desk.over()
    desk.whole("s")
    assert desk.over()
    assert desk.recording.describe_problem() is None
    written = [message for topic, message in desk.messages() if topic == "m/state"]
    log = open_log(io.BytesIO(desk.stream.getvalue()))
    assert verify_log(log).identical == 2 * TICKS
    assert (log.complete, log.driver, log.session["session"]) == (True, "live", SESSION)
    assert log.accounts[f"dropped: {reason}"] == "1"
    assert [message.data for message in written] == encode_states("m")
    assert [message.publish_time - UNIX_NS for message in written] == [
        MS * k for k in range(TICKS)
    ]


LONG = load_scenario("two_sites", {"duration_s": 60.0})


def encode_early_state(tick: int) -> bytes:
    site = Site(LONG.setup("m"))
    return encode_state(
        "m", BOOTS["m"], site.peers, site.step(TickInput(0))._replace(tick=tick), [], 0, 0
    )


@pytest.mark.parametrize(
    ("reason", "channel", "payload"),
    [
        ("m is ahead of the clock", topics.STATE, encode_early_state(50_000)),
        ("m is ahead of the clock", topics.STATE, encode_early_state(2_100)),
        ("m is ahead of the clock", topics.LINK, encode_statistics("m", 50_000, LONG)),
        ("m is ahead of the clock", topics.EVENT, encode_end("m", 50_000)),
        ("m is ahead of the clock", topics.EVENT, encode_event("m", -1, "join", ticks=50_000)),
        ("out of range", topics.EVENT, encode_event("m", 100_000)),
    ],
    ids=[
        "a record",
        "just too early",
        "statistics",
        "an end",
        "a beginning",
        "the number of an event",
    ],
)
def test_claims_beyond_the_clock_are_refused(reason: str, channel: str, payload: bytes) -> None:
    """The member has valid keys and claims 50 s of records after some milliseconds."""
    desk = Desk(LONG)
    records = encode_states("m")
    desk.take("m", topics.STATE, *records[:10])
    desk.take("m", channel, payload)
    assert desk.recording.dropped == {reason: 1}
    desk.take("m", topics.STATE, *records[10:])
    desk.take("m", topics.LINK, encode_statistics("m"))
    desk.take("m", topics.EVENT, encode_end("m", n=0))
    account = desk.recording.accounts[topics.key(SESSION, "m", topics.STATE)]
    assert (account.expected, account.received, account.missing) == (TICKS, TICKS, 0)
    desk.whole("s")
    assert desk.recording.describe_problem() is None
    assert any(
        f"1 message dropped: {reason}" in line for line in desk.recording.render_summary()
    )


def test_answers_beyond_the_clock_are_refused() -> None:
    desk = Desk(LONG)
    memory = Memory(desk.network, "m")
    memory.made["state"] = [b""] * 50_000
    desk.take("m", topics.STATE, encode_states("m")[0], encode_states("m")[2])
    desk.rounds(60, memory)
    assert memory.asked
    account = desk.recording.accounts[topics.key(SESSION, "m", topics.STATE)]
    assert account.expected <= 2_000 + 60 * 10 + 10


def test_clocks_may_differ_within_tolerance() -> None:
    """Two seconds, and a thousandth of the time."""
    desk = Desk(LONG)
    desk.wait(40 * 1_000_000_000)
    desk.take("m", topics.STATE, encode_early_state(42_000))
    assert desk.recording.dropped == {}


@pytest.mark.parametrize("t_ns", [-(2**63), 2**64 - 1])
@pytest.mark.parametrize("kind", ["state", "link", "event"])
def test_no_time_stamp_ends_the_recording(kind: str, t_ns: int) -> None:
    desk = Desk()
    message = {
        "state": encode_states("m")[0],
        "link": encode_statistics("m"),
        "event": encode_end("m"),
    }[kind]
    fields = msgpack.unpackb(message)
    desk.take("m", kind, msgpack.packb({**fields, "t_ns": t_ns}))
    desk.whole("s")
    assert len(desk.log()["s"]) == TICKS


def test_gaps_are_counted_and_named_problems() -> None:
    desk = Desk()
    records = encode_states("m")
    desk.take("m", topics.STATE, *records[:10], *records[13:30], *records[31:-2])
    desk.take("m", topics.LINK, encode_statistics("m"))
    desk.take("m", topics.EVENT, encode_end("m"))
    desk.whole("s")
    log = desk.log()
    assert (
        desk.recording.describe_problem()
        == f"missing of m: 6 of {TICKS} records (10-12 30-30 48-49)"
    )
    assert "missing 6" in log.account("m")
    assert "largest gap 3" in log.account("m")
    assert f"(10-12 30-30 {TICKS - 2}-{TICKS - 1})" in log.account("m")
    assert any(
        "m: 44 of 50 records, 6 missing" in line for line in desk.recording.render_summary()
    )


def test_overflow_is_counted_in_file_and_summary(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tap_module, "CAPACITY", 20)
    desk = Desk()
    for payload in encode_states("m"):
        desk.tap.receive(topics.key(SESSION, "m", topics.STATE), payload)
    log = desk.log()
    assert len(log["m"]) == 20
    assert f"overflowed {TICKS - 20}" in log.account("m")
    assert any(
        str(TICKS - 20) in line and "the queue was full" in line
        for line in desk.recording.render_summary()
    )


def test_floods_of_events_leave_usable_logs() -> None:
    """Highly compressible messages must not take the reader's memory, nor the room of the end."""
    desk = Desk()
    desk.take("m", topics.STATE, *encode_states("m"))
    desk.take("m", topics.LINK, encode_statistics("m"))
    desk.take("m", topics.EVENT, *(encode_event("m", n, text="x" * 60_000) for n in range(300)))
    desk.take("m", topics.EVENT, encode_end("m", n=300))
    desk.whole("s")
    written = EVENT_BYTES // 60_000
    assert desk.recording.dropped["flood of events"] >= 299 - written
    log = desk.log()
    assert verify_log(log).identical == 2 * TICKS
    assert len([event for event in log.events if event.member == "m"]) <= written + 2
    assert {event.member for event in log.events if event.kind == "end"} == {"m", "s"}
    assert "missing" in (desk.recording.describe_problem() or "")


def test_stored_means_every_record_is_stored() -> None:
    desk = Desk()
    records = encode_states("m")
    desk.take("m", topics.STATE, *records[:-1])
    desk.take("m", topics.EVENT, encode_event("m", 0), encode_end("m", n=2))
    assert desk.stored() == []
    desk.take("m", topics.STATE, records[-1])
    desk.take("m", topics.EVENT, encode_event("m", 1))
    assert desk.stored() == []
    desk.take("m", topics.LINK, encode_statistics("m"))
    assert desk.stored() == [("m", TICKS)]
    desk.write()
    assert desk.stored() == []
    assert [e.about for e in desk.log().events if e.kind == "stored"] == ["m"]
    account = desk.recording.accounts[topics.key(SESSION, topics.RECORDER, topics.EVENT)]
    assert (account.expected, account.received) == (1, 1)


def alive_key(name: str, boot: int | str) -> str:
    return topics.key(SESSION, name, topics.ALIVE) + f"/{boot}"


def test_dying_sites_end_recording_and_are_named() -> None:
    desk = Desk()
    desk.whole("m")
    desk.take("s", topics.STATE, *encode_states("s")[:20])
    desk.recording.note_presence(alive_key("s", BOOTS["s"]), False)
    assert not desk.over()
    # a site stays no longer after its last tick
    desk.clock.sleep_until(MONO_NS + 50_000_000 + LAST_NS)
    assert not desk.over()
    sleep_for_ns(desk.clock, 1)
    assert desk.over()
    assert desk.recording.describe_problem() == "s disappeared after 20 records"
    assert "s: 20 records, its end is unknown" in desk.recording.render_summary()[1]
    log = desk.log()
    assert (len(log["m"]), len(log["s"])) == (TICKS, 20)


@pytest.mark.parametrize(
    ("said_its_end", "patience_ns"), [(True, RECONNECT_NS), (False, AWAY_NS)]
)
def test_long_cut_off_sites_are_awaited(said_its_end: bool, patience_ns: int) -> None:
    """Sites are awaited even if the recorder itself is cut off, so that all sites disappear at once."""
    desk = Desk(load_scenario("two_sites", {"duration_s": 100.0}))
    if said_its_end:
        for name in ("m", "s"):
            desk.take(name, topics.EVENT, encode_end(name, 1))
    for name in ("m", "s", "m"):
        desk.recording.note_presence(alive_key(name, BOOTS[name]), False)
        assert not desk.over()
    sleep_for_ns(desk.clock, patience_ns)
    assert not desk.over()
    desk.recording.note_presence(alive_key("m", BOOTS["m"]), True)
    sleep_for_ns(desk.clock, 1)
    assert not desk.over()
    desk.recording.note_presence(alive_key("m", BOOTS["m"]), False)
    assert not desk.over()
    sleep_for_ns(desk.clock, patience_ns + 1)
    assert desk.over()


@pytest.mark.parametrize(
    "key",
    [alive_key("s", 99), alive_key("s", "x"), alive_key("nobody", 1), "trilat", "", "a/b"],
)
def test_foreign_tokens_end_nothing(key: str) -> None:
    desk = Desk()
    desk.whole("m")
    desk.recording.note_presence(key, False)
    sleep_for_ns(desk.clock, 2 * SETTLE_NS)
    desk.over()
    sleep_for_ns(desk.clock, 2 * SETTLE_NS)
    assert not desk.over()


def test_a_crash_keeps_flushed_data() -> None:
    desk = Desk()
    records = encode_states("m")
    desk.take("m", topics.STATE, *records[:30])
    desk.recording.flush()
    desk.take("m", topics.STATE, *records[30:])
    log = open_log(io.BytesIO(desk.stream.getvalue()))  # nobody finishes
    assert not log.complete
    assert log.accounts == {}
    assert [state.tick for state in log["m"].states][:30] == list(range(30))
    assert verify_log(log).agreed


def test_waiting_messages_are_written_at_the_end() -> None:
    desk = Desk()
    for payload in encode_states("m"):
        desk.tap.receive(topics.key(SESSION, "m", topics.STATE), payload)
    desk.tap.receive("nonsense", b"")
    log = desk.log()
    assert len(log["m"]) == TICKS
    assert log.accounts["dropped: stranger"] == "1"


def start_recorder(
    network: LocalNetwork, clock: RelayClock, folder: Path, stop_ns: int
) -> Recorder:
    """Returns a recorder that has met site m, and is asked to stop at a time."""
    recorder = Recorder(
        bus=network.join(),
        clock=clock,
        session=SESSION,
        boot=BOOTS[topics.RECORDER],
        storage=LogStorage(folder / "run.mcap"),
        read_scenario=make_scenario_reader(),
        provenance=collect_provenance(),
        stopped=lambda: clock.monotonic_ns() > stop_ns,
        say=str,
    )
    recorder._joining.membership.others["m"] = answer_info("m")
    return recorder


def recorder_alone(folder: Path, relay: Relay, stop_ns: int) -> None:
    """Returns a recorder whose session begins, and whose sites then are silent; it is asked to
    stop at a time.
    """
    network = LocalNetwork()

    def run(clock: RelayClock) -> None:
        recorder = start_recorder(network, clock, folder, stop_ns)
        met = recorder._joining.membership.others
        stranger = msgspec.structs.replace(
            answer_info("m"), member="x", boot=5, scenario="garbage"
        )
        recorder._joining.membership.others = {"x": stranger, **met}
        recorder.record(EPOCH)

    def publish(clock: RelayClock) -> None:
        send = network.join().publisher(topics.key(SESSION, "m", topics.STATE))
        for k, payload in enumerate(encode_states("m")):
            clock.sleep_until(MONO_NS + k * 5_000_000)
            send(payload)

    relay.add("recorder", run)
    relay.add("m", publish)
    relay.run()


def test_stopped_recorders_finish_their_file(tmp_path: Path) -> None:
    recorder_alone(tmp_path, Relay(), MONO_NS + 150_500_000)
    log = open_log(tmp_path / "run.mcap")
    assert log.complete
    assert 30 <= len(log["m"]) < TICKS
    assert verify_log(log).agreed


def test_lagging_recorders_catch_up(tmp_path: Path) -> None:
    """The next request follows an answer at once, before the next write to the file."""
    network = LocalNetwork()
    relay = Relay()
    ended_ns = MONO_NS + 50 * MS
    grace_ns = 50 * MS
    answer_ns = 2 * POLL_NS
    stop_ns = ended_ns + grace_ns + TICKS * answer_ns + 2 * FLUSH_NS
    memory = Memory(network, "m", chunk=1)
    memory.made["state"] = encode_states("m")
    memory.made["link"] = [encode_statistics("m")]

    def publish(clock: RelayClock) -> None:
        send = network.join().publisher(topics.key(SESSION, "m", topics.EVENT))
        clock.sleep_until(ended_ns)
        send(encode_end("m"))
        while clock.monotonic_ns() < stop_ns:
            sleep_for_ns(clock, MS)
            memory.answer()

    relay.add(
        "recorder",
        lambda clock: start_recorder(network, clock, tmp_path, stop_ns).record(EPOCH),
    )
    relay.add("m", publish)
    relay.run()
    assert len(open_log(tmp_path / "run.mcap")["m"]) == TICKS


def test_scenarios_come_from_members_only(tmp_path: Path) -> None:
    recorder_alone(tmp_path, Relay(), MONO_NS + 10_000_000)
    assert open_log(tmp_path / "run.mcap").scenario.sha256 == SCENARIO.sha256


def test_ending_recorders_wait_for_held_records() -> None:
    """The recorder waits for a running site only until no record is missing."""
    desk = Desk()
    ending_ns = desk.clock.monotonic_ns()
    desk.whole("m")
    desk.take("s", topics.STATE, *encode_states("s")[:20], *encode_states("s")[25:])
    assert not desk.recording.is_up_to_date(ending_ns, desk.clock.monotonic_ns())
    desk.clock.sleep_until(ending_ns + 2 * SETTLE_NS)
    assert not desk.recording.is_up_to_date(ending_ns, desk.clock.monotonic_ns())
    desk.take("s", topics.STATE, *encode_states("s")[20:25])
    assert desk.recording.is_up_to_date(ending_ns, desk.clock.monotonic_ns())


def test_silent_sites_may_still_hold_records() -> None:
    desk = Desk()
    desk.whole("m")
    desk.take("s", topics.STATE, *encode_states("s")[:20])
    ending_ns = desk.clock.monotonic_ns()
    desk.clock.sleep_until(ending_ns + 3 * SETTLE_NS)
    assert not desk.recording.is_up_to_date(ending_ns, desk.clock.monotonic_ns())
