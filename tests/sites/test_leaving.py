"""Sites that leave a running session, return or come late: the other sites continue, and the
log explains it.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.sites.sessions import make_gliding_scenario
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.certificate.verdict_facts import StabilityFinding
from trilat_net.analysis.link_summary import LinkSummary
from trilat_net.errors import PeerLeft, SessionError
from trilat_net.execution.log_checks import LogCheckReport
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogStorage
from trilat_net.log.session_check import check_file
from trilat_net.net import topics

from .relay import RelayClock
from .sessions import SESSION, Session

S = 1_000_000_000


def measure_engagement_s(log: Log, site: str, tick: int) -> float:
    part = log[site]
    after = (part.tick >= tick) & (part.mode == "run")
    return float(part.tick[np.argmax(after)] - tick) / part.rate_hz


def test_killed_sites_return_and_logs_are_whole(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(7.0), tmp_path, ends={})
    session.clocks["m"].dies_ns = 4 * S
    session.site("m", at_ns=5 * S)
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    ((first, boot),) = log.starts["m"]
    assert log.absences["m"] == [(log["m"].tick[log["m"].tick < first][-1] + 1, first - 1)]
    assert {state.boot for state in log["m"].states if state.tick >= first} == {boot}
    assert log["s"].tick.tolist() == list(range(1400))
    held = log["s"].mode[log.absences["m"][0][0] + 20 : first]
    assert set(held) == {"hold"}
    for site in ("m", "s"):
        assert measure_engagement_s(log, site, first) < 2.0
        assert log.missing(site) == 0
        assert log[site].mode[-1] == "run"
    result = verify_log(log)
    assert (result.differing, result.unjudged, result.gaps) == (0, 0, [])
    assert result.passed
    assert result.absences == [("m", *log.absences["m"][0])]
    assert LogCheckReport.of_log(log, virtual=True).passed


def kinds_about(log: Log, member: str, about: str) -> list[str]:
    return [
        event.kind for event in log.events if event.member == member and event.about == about
    ]


def test_ended_sites_are_named_to_the_others(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(4.0), tmp_path, ends={})
    session.interrupt("s", 3 * S)
    log = session.run()
    assert session.ends is not None
    assert session.ends["s"] == 130
    failed = session.ends["m"]
    assert isinstance(failed, PeerLeft)
    assert failed.exit_code == 3
    assert "s made" in str(failed)
    assert "SIGINT" in str(failed)
    (end,) = (event for event in log.events if (event.member, event.kind) == ("s", "end"))
    assert end.about == "s"
    assert end.ticks < 800
    assert kinds_about(log, "m", "s") == ["left"]
    assert len(log["m"]) == 800
    assert log["m"].mode[-1] == "hold"
    assert verify_log(log).passed
    assert log.expected_ticks("s") == end.ticks


def test_departed_sites_are_awaited_only_as_configured(tmp_path: Path) -> None:
    session = Session.whole(
        make_gliding_scenario(30.0), tmp_path, ends={}, options={"m": {"leave_timeout_s": 1.0}}
    )
    session.clocks["s"].dies_ns = 3 * S
    log = session.run()
    assert session.ends is not None
    assert isinstance(session.ends["m"], PeerLeft)
    (lost,) = (event for event in log.events if event.kind == "lost")
    (end,) = (event for event in log.events if event.kind == "end")
    assert end.about == "s"
    assert 1.0 < end.ticks / 200 - lost.t_ns / S < 1.3


@pytest.mark.long
def test_a_departed_site_may_return_and_leave_again(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(9.0), tmp_path, ends={})
    session.interrupt("s", 3 * S, 15)
    session.site("s", at_ns=4 * S)
    session.clocks["s"].dies_ns = 6 * S
    session.site("s", at_ns=7 * S)
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    assert len(log.starts["s"]) == len(log.absences["s"]) == 2
    (early,) = (event for event in log.events if event.kind == "end" and event.about == "s")
    assert log.absences["s"][0][0] == early.ticks
    result = verify_log(log)
    assert (result.differing, result.unjudged, result.gaps) == (0, 0, [])
    assert "missing 0" in log.account("s")
    check = check_file(session.path)
    assert check.passed, check.findings


def test_late_sites_may_join_a_flexible_start(tmp_path: Path) -> None:
    scenario = make_gliding_scenario(5.0, "asymmetric")
    session = Session(
        scenario,
        tmp_path / "run.mcap",
        ends={},
        options={"m1": {"without": (scenario.names[2],)}},
    )
    session.recorder()
    for n, name in enumerate(scenario.names):
        session.site(name, at_ns=(n // 2) * 3 * S)
    log = session.run()
    assert session.ends == dict.fromkeys(scenario.names, 0)
    late = scenario.names[2]
    ((first, _),) = log.starts[late]
    assert log.absences[late] == [(0, first - 1)]
    assert set(log["m1"].mode[:first]) == {"waiting"}
    assert {str(log[name].mode[-1]) for name in log.sites} == {"run"}
    assert verify_log(log).passed
    assert check_file(session.path).passed


@pytest.mark.parametrize("dies", ["m1", pytest.param("s", marks=pytest.mark.long)])
def test_sites_on_other_clocks_find_the_grid(dies: str, tmp_path: Path) -> None:
    """The first site, whose grid the others follow, as well as another."""
    skews = {"m1": (7 * S, 60_000), "s": (-500_000_000, -100_000)}
    session = Session.whole(
        make_gliding_scenario(8.0, "asymmetric"), tmp_path, ends={}, skews=skews
    )
    session.clocks[dies].dies_ns = 4 * S
    session.site(dies, at_ns=5 * S)
    log = session.run()
    assert session.ends == dict.fromkeys(log.sites, 0)
    assert {str(log[name].mode[-1]) for name in log.sites} == {"run"}
    result = verify_log(log)
    assert (result.differing, result.unjudged, result.gaps) == (0, 0, [])
    for name in log.sites:
        dropped = {
            reason: n
            for reason, n in log.link_stats(name)[-1].dropped.items()
            if reason != "stranger"
        }
        assert dropped == {}
    assert "clock fault" not in {event.kind for event in log.events}


def test_second_starts_wait_for_present_ones(tmp_path: Path) -> None:
    """A present site that answers is reported at once.

    A frozen one does not answer, but its token keeps its place.
    """
    session = Session.whole(make_gliding_scenario(4.0), tmp_path, ends={})
    refused: list[object] = []

    def second(clock: RelayClock) -> None:
        try:
            session.live("m", clock)
        except SessionError as error:
            refused.append(str(error))

    session.relay.add("second", second, 2 * S)
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    assert len(refused) == 1
    assert not log.starts
    assert len(log["m"]) == 800


def test_late_recorders_learn_of_ticks_not_made(tmp_path: Path) -> None:
    session = Session(make_gliding_scenario(8.0), tmp_path / "run.mcap", ends={})
    for name in ("m", "s"):
        session.site(name, needs_recorder=False)
    session.clocks["m"].dies_ns = 3 * S
    session.site("m", at_ns=4 * S, needs_recorder=False)
    session.recorder(at_ns=7 * S)
    log = session.run()
    ((first, _),) = log.starts["m"]
    ((absence, last),) = log.absences["m"]
    assert (absence, last) == (log["s"].used["m"][log["s"].tick < first].max() + 1, first - 1)
    # the memory of the first start went with it; the other site heard all
    assert log.missing("m") == absence
    assert len(log["s"]) == 1600
    assert log.missing("s") == 0
    assert "agree with the messages" in [
        finding.text for finding in check_file(session.path).findings
    ]


def test_samples_without_record_leave_few_ticks_open(tmp_path: Path) -> None:
    """The peer used such a sample until it held, so that those ticks cannot be executed."""
    session = Session.whole(make_gliding_scenario(7.0), tmp_path, ends={})
    session.lose("m", "trilat/t/m/state", 4 * S - 14_000_000, 5 * S)
    session.clocks["m"].dies_ns = 4 * S
    session.site("m", at_ns=5 * S)
    log = session.run()
    used = log["s"].used["m"][log["s"].mode == "hold"]
    assert not set(used.tolist()) & set(log["m"].tick.tolist())
    result = verify_log(log)
    assert (result.differing, result.gaps) == (0, [])
    assert 0 < result.unjudged <= 3 + 4


def test_one_way_cuts_are_in_last_messages(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(3.0), tmp_path, ends={})
    session.lose("m", "trilat/t/m/sample", 3 * S, 60 * S)
    log = session.run()
    ends = {event.member: event.text for event in log.events if event.kind == "end"}
    assert ends == {
        "m": "m made 600 ticks; s did not confirm its last samples",
        "s": "s made 600 ticks",
    }


def test_a_site_not_admitted_names_the_refusers(tmp_path: Path) -> None:
    """The site's messages do not reach one peer; the site waits, and reports why it does not join."""
    session = Session.whole(make_gliding_scenario(9.0, "asymmetric"), tmp_path, ends={})
    session.clocks["s"].dies_ns = 3 * S
    failed: list[str] = []

    def again(clock: RelayClock) -> None:
        session.lose("m2", "trilat/t/m2/event", 4 * S, 60 * S)
        try:
            session.live("s", clock, timeout_s=3.0)
        except SessionError as error:
            failed.append(str(error))

    session.relay.add("s again", again, 4 * S)
    session.run()
    assert len(failed) == 1
    assert "m2 did not admit s to the running session" in failed[0]


def test_sites_report_peers_that_cannot_hear_them(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(4.0), tmp_path, ends={})
    session.lose("m", "trilat/t/m/sample", 3 * S, 3 * S + 600_000_000)
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    texts = [
        (event.kind, event.about, event.t_ns) for event in log.events if "hear" in event.kind
    ]
    assert [kind for kind, _, _ in texts] == ["unheard", "heard"]
    assert {about for _, about, _ in texts} == {"s"}
    cut_s = 3.0 - log.events[0].epoch_mono_ns / S if log.events[0].epoch_mono_ns else 0.0
    assert 0.2 <= texts[0][2] / S - cut_s <= 0.4
    assert "hold" in log["s"].mode
    assert "hold" not in log["m"].mode
    assert verify_log(log).passed


@pytest.mark.long
def test_certificates_of_left_sessions_judge_the_rest(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(7.0, "paper"), tmp_path, ends={})
    session.clocks["m1"].dies_ns = 4 * S
    session.site("m1", at_ns=5 * S)
    log = session.run()
    certificate = Certificate.of_log(log)
    premises = {premise.name: premise for premise in certificate.premises}
    assert premises["presence"].holds is False
    first, last = log.absences["m1"][0]
    rate_hz = 200
    assert (
        f"m1 {first / rate_hz:.4g} to {(last + 1) / rate_hz:.4g} s" in premises["presence"].text
    )
    assert premises["presence"].text.count("all follow from") == 2
    assert premises["presence"].text.count("delays are constant") == 2
    assert premises["records"].holds
    assert certificate.evidence.functional_share == 1.0
    assert certificate.verdict.finding is StabilityFinding.DID_NOT_RISE
    link = next(
        link_of_log
        for link_of_log in LinkSummary.list_of_log(log)
        if (link_of_log.peer, link_of_log.site) == ("m1", "s")
    )
    assert link.loss == 0.0


@pytest.mark.parametrize(
    ("dies_ms", "again_ms"), [pytest.param(4300, 5000, marks=pytest.mark.long), (4050, 4060)]
)
def test_starts_dead_before_tick_0_free_places(
    dies_ms: int, again_ms: int, tmp_path: Path
) -> None:
    """The place is free also if the other site admits the dead start only after the next start has come."""
    session = Session.whole(make_gliding_scenario(7.0), tmp_path, ends={})
    session.clocks["m"].dies_ns = 3 * S
    session.site("m", at_ns=4 * S)
    session.clocks["m"].dies_ns = dies_ms * 1_000_000  # it has said `coming` alone
    session.site("m", at_ns=again_ms * 1_000_000)
    log = session.run()
    assert session.ends == {"m": 0, "s": 0}
    admitted = [event for event in log.events if event.kind == "admit"]
    assert len({event.boots["m"] for event in admitted}) == 2
    assert [last + 1 for _, last in log.absences["m"]] == [log.starts["m"][-1][0]]
    assert verify_log(log).passed
    assert check_file(session.path).passed


def test_returning_sites_ignore_leaving_ones(tmp_path: Path) -> None:
    session = Session.whole(make_gliding_scenario(6.0, "asymmetric"), tmp_path, ends={})
    session.clocks["m1"].dies_ns = 3 * S
    session.site("m1", at_ns=4 * S)
    # its token was seen, and it has answered nothing
    session.clocks["s"].dies_ns = 4 * S + 2_000_000
    log = session.run()
    (coming,) = (event for event in log.events if event.kind == "coming")
    (gone_ns,) = (
        event.t_ns
        for event in log.events
        if (event.member, event.kind, event.about) == ("m2", "lost", "s")
    )
    assert coming.t_ns - gone_ns < 200_000_000
    assert log.starts.keys() == {"m1"}


@pytest.mark.parametrize("later_ms", [60, pytest.param(140, marks=pytest.mark.long)])
def test_two_sites_returning_together_admit_each_other(later_ms: int, tmp_path: Path) -> None:
    """The second site learns of the first start from those that admit both, which know of that
    start only since then.
    """
    session = Session.whole(make_gliding_scenario(6.0, "asymmetric"), tmp_path, ends={})
    for name, wait_ms in (("m2", 0), ("m1", later_ms)):
        session.interrupt(name, 3 * S + wait_ms * 1_000_000, 15)
        session.site(name, at_ns=3 * S + (140 + wait_ms) * 1_000_000)
    log = session.run()
    assert {name: log[name].mode[-1] for name in log.sites} == dict.fromkeys(
        ("m1", "m2", "s"), "run"
    )
    assert verify_log(log).passed


def test_frozen_starts_end_after_their_replacement(tmp_path: Path) -> None:
    """The token of the frozen start went, like that of a process that is stopped for longer
    than its lease.
    """
    session = Session.whole(make_gliding_scenario(8.0), tmp_path, ends={})
    session.clocks["m"].stall(3 * S, 3 * S)
    session.clocks["s"].at(3 * S + 500_000_000, lambda: session.lose_token("m"))
    session.site("m", at_ns=4 * S)
    log = session.run()
    assert len(log.starts["m"]) == 1
    frozen, _, again = (end for _, end in session.start_ends)
    assert "another start of m has replaced this site" in str(frozen)
    assert again == 0
    assert log["m"].mode[-1] == "run"
    assert verify_log(log).differing == 0


@pytest.mark.long
def test_successive_recorders_agree_on_ticks_not_made(tmp_path: Path) -> None:
    """The first recorder is gone before a site returns, the second begins while the site is away."""
    stops_ns = 3 * S + 500_000_000
    session = Session(make_gliding_scenario(8.0), tmp_path / "run.mcap", ends={})
    session.recorder(lambda: session.relay.now_ns >= stops_ns)
    for name in ("m", "s"):
        session.site(name)
    session.clocks["m"].dies_ns = 3 * S
    session.site("m", at_ns=5 * S)
    session.storage = LogStorage(session.path, carry_on=True)
    session.recorder(at_ns=4 * S, boot=78)
    session.play()
    parts = sorted(tmp_path.glob("run*.mcap"))
    log = open_log(*parts)
    ((first, _),) = log.starts["m"]
    (absence,) = log.absences["m"]
    assert absence[1] == first - 1
    assert 0 < absence[0] < first - 200
    assert log.missing("m") == log.missing("s") == 0
    assert "missing 0" in log.account("m")
    assert verify_log(log).passed
    assert check_file(*parts).passed


def test_lost_tokens_alone_are_no_departure(tmp_path: Path) -> None:
    """A reconnection may report the end of a connection after its return."""
    session = Session.whole(
        make_gliding_scenario(5.0), tmp_path, ends={}, options={"s": {"leave_timeout_s": 2.0}}
    )
    session.clocks["s"].at(3 * S, lambda: session.lose_token("m"))
    log = session.run()
    assert kinds_about(log, "s", "m") == ["lost"]
    assert session.ends == {"m": 0, "s": 0}


def test_ending_sites_await_disconnected_recorders(tmp_path: Path) -> None:
    """The recorder's token is gone, and it received neither the last records nor the end; then
    it asks for them.
    """
    session = Session.whole(make_gliding_scenario(2.0), tmp_path, ends={})
    session.clocks["s"].at(3 * S + 600_000_000, lambda: session.lose_token("recorder"))
    for name in ("m", "s"):
        for channel in (topics.STATE, topics.EVENT, topics.LINK):
            session.lose("s", topics.key(SESSION, name, channel), 3 * S + 600_000_000, 6 * S)
    log = session.run()
    assert [len(log[name]) for name in log.sites] == [400, 400]
    assert log.missing("m") == log.missing("s") == 0
