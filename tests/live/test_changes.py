"""Changes while a session runs, by its timeline and by `trilat set`: the run is reproduced bit for bit."""

import pytest

import trilat_net as tn
from tests.cli.running import trilat
from tests.live.processes import assert_executed_again, connection_options, open_whole_log
from trilat_net.core.step.ticks import Mode
from trilat_net.errors import RunFailed

from .processes import PAPER, Session, Stage

SCRIPT = """
timeline=[
{at_s=0.5, link="m1->s", to={delay_ms=250.0, loss=0.1}},
{at_s=1.0, dominance="s", to={m1=0.9, m2=0.1}, ramp_s=1.0},
{at_s=1.5, link="s->m1", to={model="gamma", delay_ms=200.0, deviation_ms=20.0, playout_ms=150.0}},
{at_s=2.0, link="m2->m1", to={model="ar1", delay_ms=200.0, deviation_ms=10.0, correlation=0.99}},
{at_s=2.5, dominance="m1", to={m2=0.2, s=0.8}, ramp_s=0.5},
{at_s=2.7, dominance="m1", to={m2=1.0}},
{at_s=3.0, link="m1->s", to={loss=0.2, loss_burst=50.0, loss_bad=0.99}},
{at_s=3.5, link="s->m2", to={model="sine", delay_ms=300.0, amplitude_ms=100.0, period_s=0.5}},
{at_s=4.0, link="m1->m2", to={duplicate=0.5, order="in_order"}},
{at_s=4.5, link="m1->s", to={model="constant", delay_ms=200.0, loss=1.0}},
]"""


@pytest.mark.long
def test_ten_timed_changes_are_executed_again_exactly(stage: Stage) -> None:
    """At the end a peer is stale, and a site holds its arm."""
    options = (
        "--set",
        SCRIPT.strip().replace("\n", ""),
        "--set",
        "on_stale.action=hold",
        "--duration",
        "6",
    )
    session = Session(stage, "paper", PAPER, *options)
    session.all()
    log = session.is_reproduced()
    assert len(log.scenario.timeline) == 10
    assert {state.mode for state in log["s"].states} == {
        Mode.RUN.name.lower(),
        Mode.HOLD.name.lower(),
    }


@pytest.mark.long
def test_changes_in_a_session_are_answered_and_reproduced(
    stage: Stage,
) -> None:
    session = Session(stage, "paper", PAPER, "--duration", "6")
    session.all()
    session.begun()
    session.recording()
    to = ("set", "--session", "t", *connection_options(session.endpoints))
    link = trilat(
        *to, "link", "m1->s", "--delay", "350ms", "--loss", "5%", cwd=stage.folder
    ).succeeds()
    shares = trilat(
        *to, "dominance", "s", "m1=0.9", "m2=0.1", "--ramp", "0.5s", cwd=stage.folder
    ).succeeds()
    assert "takes effect at tick" in link
    assert "takes effect at tick" in shares
    trilat(*to, "dominance", "s", "m1=0.9", "m2=0.2", cwd=stage.folder).refuses("sum to 1")
    log = session.is_reproduced()
    taken = {tick: text for tick, texts in log.changes("s").items() for text in texts}
    assert [len(log.changes(name)) for name in PAPER] == [0, 0, 2]
    said = [event.command for event in log.events if event.kind == "change"]
    assert said == [taken[tick] for tick in sorted(taken)]


@pytest.mark.long
def test_python_and_commands_change_sessions_alike(stage: Stage) -> None:
    glide = ("--set", "on_stale.action=glide", "--set", "on_stale.align_limit_rad=3")
    running = Session(stage, "paper", PAPER, "--duration", "60", *glide)
    running.all()
    running.begun()
    running.recording()
    session = tn.session("t", connect=running.endpoints)
    with session:
        assert "takes effect at tick" in session.set_link("m1->s", delay_ms=250.0, loss=0.05)
    assert "takes effect at tick" in session.set_dominance(
        "s", {"m1": 0.9, "m2": 0.1}, ramp_s=0.5
    )
    with pytest.raises(RunFailed, match="sum to 1"):
        session.set_dominance("s", {"m1": 0.9, "m2": 0.2})
    with pytest.raises(RunFailed, match="reset is possible only in mode fault"):
        session.reset("s")
    assert "s: stop at tick" in session.stop("s")[0]
    assert "s: enable at tick" in session.enable("s")[0]
    assert {row["member"] for row in session.ping(count=5).to_rows()} >= set(PAPER)
    session.end()
    running.ends_well()
    log = open_whole_log(running.log, in_full=False)
    assert_executed_again(log)
    taken = [text for texts in log.changes("s").values() for text in texts]
    for kind, text in zip(("link", "dominance", "stop", "enable"), taken, strict=True):
        assert f'"{kind}"' in text
