"""A recorder that joins a running session gets the remembered messages, and reports its lateness."""

from pathlib import Path

import pytest

from recorder.record_process import Recorder
from tests.recorder.desk import encode_end, encode_event, encode_states, encode_statistics
from tests.sites.relay import RelayClock
from tests.sites.sessions import SESSION as REAL
from tests.sites.sessions import Session, execute_packed, pack_log
from trilat_net.app.recorded_session import make_scenario_reader
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.log.log_writer import LogStorage
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.scenario import load_scenario

from .desk import BOOTS, SESSION, TICKS, Desk, Memory, S


def late_desk(*names: str) -> tuple[Desk, dict[str, Memory]]:
    """Returns a recorder that comes 40 s late into a session in which these sites remain."""
    desk = Desk()
    sites = {name: Memory(desk.network, name) for name in names}
    for name, site in sites.items():
        events = [
            encode_event(name, 0, "ready", t_ns=-1),
            encode_event(name, 1),
            encode_end(name, n=2),
        ]
        site.made = {
            "state": encode_states(name),
            "link": [encode_statistics(name)],
            "event": events,
        }
    desk.wait(40 * S)
    desk.recording.assume_gone()
    for name in names:
        desk.recording.note_presence(
            topics.key(SESSION, name, topics.ALIVE) + f"/{BOOTS[name]}", True
        )
    desk.recording.join_late(desk.clock.monotonic_ns())
    return desk, sites


def test_late_recorders_ask_for_everything() -> None:
    desk, sites = late_desk("m", "s")
    desk.rounds(30, *sites.values())
    said = desk.said()
    assert [(event.kind, event.about) for event in said] == [
        ("late", ""),
        ("stored", "m"),
        ("stored", "s"),
    ]
    assert said[0].t_ns == 40 * S
    assert "at t = 40.000 s" in said[0].text
    assert desk.over()
    assert desk.recording.describe_problem() is None
    log = desk.log()
    assert [state.tick for state in log["m"].states] == list(range(TICKS))
    assert [event.kind for event in log.events if event.member == "s"] == [
        "ready",
        "mode",
        "end",
    ]


def test_missing_sites_are_named_without_waiting() -> None:
    desk, sites = late_desk("m")
    desk.rounds(30, *sites.values())
    assert [(event.kind, event.about) for event in desk.said()] == [
        ("late", ""),
        ("lost", "s"),
        ("stored", "m"),
    ]
    assert not desk.over()
    desk.wait(20 * S)
    assert desk.over()
    assert desk.recording.describe_problem() == "s disappeared after 0 records"


def test_forgotten_messages_stay_missing() -> None:
    desk, sites = late_desk("m", "s")
    for site in sites.values():
        site.oldest["state"] = 20
    desk.rounds(30, *sites.values())
    stored = [event.text for event in desk.said() if event.kind == "stored"]
    assert (
        stored[0]
        == f"all that can be had of m is stored; missing for good: 20 of {TICKS} records (0-19)"
    )
    assert desk.recording.describe_problem() == f"missing of m: 20 of {TICKS} records (0-19)"


@pytest.mark.parametrize("ahead_ns", [0, 5 * S])
def test_recorders_take_over_from_ended_ones(tmp_path: Path, ahead_ns: int) -> None:
    """Real sites, real recorders, in one process; the second one with another clock, too."""
    scenario = load_scenario("two_sites", {"duration_s": 3.0, "rate_hz": 100})
    session = Session(scenario, tmp_path / "first.mcap")
    for name in scenario.names:
        session.site(name)
    begun_ns = session.relay.now_ns
    session.recorder(lambda: session.relay.now_ns > begun_ns + S)
    if ahead_ns:
        session.skews["later"] = (ahead_ns, 0)
    later = tmp_path / "later.mcap"

    def second(clock: RelayClock) -> str | None:
        late_recorder = session._own("later", clock)
        said = session.said.append
        recorder = Recorder(
            session.network.join(),
            late_recorder,
            REAL,
            99,
            LogStorage(later),
            make_scenario_reader(),
            collect_provenance(),
            lambda: False,
            said,
        )
        epoch = recorder.join(30.0)
        assert epoch is not None
        return recorder.record(epoch).describe_problem()

    session.relay.add("second", second, begun_ns + 3 * S // 2)
    session.play()
    assert session.relay.results["second"] is None
    log = open_log(later)
    assert pack_log(log) == execute_packed(scenario)
    assert verify_log(log).whole_run
    (late_event,) = [event for event in log.events if event.kind == "late"]
    assert 0 < late_event.t_ns < 3 * S
    assert any("joins the session" in sentence for sentence in session.said)
    assert 0 < len(open_log(tmp_path / "first.mcap")["m"]) < scenario.ticks("m")
