"""A recorder's report on its own work: true, once a second, bounded, and in its log."""

from recorder.session_recording import REPORT_EVERY_NS
from tests.recorder.desk import encode_states
from trilat_net.net import topics
from trilat_net.net.messages import RecorderStats
from trilat_net.net.wire import MAX_BYTES, decode, encode
from trilat_net.scenario import load_scenario

from .desk import MS, SESSION, Desk, S


def read_reports(desk: Desk) -> list[RecorderStats]:
    return [decode(message[1], RecorderStats) for message in iter(desk.reports.poll, None)]


def test_reports_give_stored_and_missing_records() -> None:
    desk = Desk()
    records = encode_states("m")
    desk.take("m", topics.STATE, *records[:10], *records[13:30], records[29], records[12])
    desk.take("nobody", topics.STATE, records[0])
    desk.report.note_flush(3 * MS)
    desk.report.note_flush(2 * MS)
    desk.tap.receive("somewhere", b"")
    desk.report.publish()
    (stats,) = read_reports(desk)
    assert stats.queued == 1
    assert (stats.expected["m/state"], stats.received["m/state"]) == (30, 28)
    assert (stats.missing["m/state"], stats.gaps) == (2, {"m/state": ["10-11"]})
    assert (stats.duplicate["m/state"], stats.reordered["m/state"]) == (1, 1)
    assert stats.silence_us["m/state"] == 1000
    assert stats.dropped == {"stranger": 1}
    assert stats.flush_max_us == 3000
    assert stats.written_bytes == desk.stream.tell()
    assert (stats.mono_ns, stats.unix_ns) == (desk.clock.monotonic_ns(), desk.clock.unix_ns())
    assert set(stats.expected) == {
        *(f"{site}/{channel}" for site in ("m", "s") for channel in ("state", "link", "event")),
        "recorder/event",
        "recorder/stats",
    }
    desk.report.publish()
    assert read_reports(desk)[0].flush_max_us == 0


def test_reports_come_once_a_second_in_logs() -> None:
    desk = Desk()
    for _ in range(350):
        desk.wait(10 * MS)
        desk.write()
        desk.report.poll()
    said = read_reports(desk)
    assert [stats.t_ns for stats in said] == [
        REPORT_EVERY_NS,
        2 * REPORT_EVERY_NS,
        3 * REPORT_EVERY_NS,
    ]
    assert desk.written()["recorder/stats"] == [encode(stats) for stats in said]


def test_sleeping_recorders_skip_reports() -> None:
    desk = Desk()
    desk.wait(10 * S + 300 * MS)
    for _ in range(160):
        desk.report.poll()
        desk.wait(10 * MS)
    assert [stats.t_ns // MS for stats in read_reports(desk)] == [10_300, 11_300]


def test_reports_always_fit_a_message() -> None:
    desk = Desk(load_scenario("two_sites"))
    for key in desk.recording.accounts:
        for number in range(0, 10_000, 2):
            desk.recording.accounts[key].receive(number + 2**39)
    for n in range(12):
        name = f"site-with-a-long-name-{n}"
        desk.recording.accounts[topics.key(SESSION, name, "state")] = desk.recording.accounts[
            key
        ]
    desk.report.publish()
    (stats,) = read_reports(desk)
    assert sum(map(len, stats.gaps.values())) <= 600
    assert len(encode(stats)) < MAX_BYTES
