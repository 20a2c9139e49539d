"""Changes while a session runs, by `trilat set` and by Python: the run is reproduced bit for bit."""

import pytest

import trilat_net as tn
from tests.cli.running import trilat
from tests.live.processes import assert_executed_again, connection_options, open_whole_log
from trilat_net.errors import RunFailed

from .processes import PAPER, Session, Stage


@pytest.mark.long
def test_python_and_commands_change_sessions_alike(stage: Stage) -> None:
    """Every change is answered with its first tick, and stands in the log in this form."""
    glide = ("--set", "on_stale.action=glide", "--set", "on_stale.align_limit_rad=3")
    running = Session(stage, "paper", PAPER, "--duration", "60", *glide)
    running.all()
    running.begun()
    running.recording()
    to = ("set", "--session", "t", *connection_options(running.endpoints))
    cwd = stage.folder
    link = trilat(*to, "link", "m1->s", "--delay", "350ms", "--loss", "5%", cwd=cwd)
    assert "takes effect at tick" in link.succeeds()
    shares = trilat(*to, "dominance", "s", "m1=0.9", "m2=0.1", "--ramp", "0.5s", cwd=cwd)
    assert "takes effect at tick" in shares.succeeds()
    trilat(*to, "dominance", "s", "m1=0.9", "m2=0.2", cwd=cwd).refuses("sum to 1")
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
    assert "s executes stop at tick" in session.stop("s")[0]
    assert "s executes enable at tick" in session.enable("s")[0]
    assert {row["member"] for row in session.ping(count=5).to_rows()} >= set(PAPER)
    session.end()
    running.ends_well()
    log = open_whole_log(running.log, in_full=False)
    assert_executed_again(log)
    taken = {tick: text for tick, texts in log.changes("s").items() for text in texts}
    assert [len(log.changes(name)) for name in PAPER] == [0, 0, len(taken)]
    in_order = [taken[tick] for tick in sorted(taken)]
    kinds = ("link", "dominance", "link", "dominance", "stop", "enable")
    for kind, text in zip(kinds, in_order, strict=True):
        assert f'"{kind}"' in text
    announced = [event.command for event in log.events if event.kind == "change"]
    assert announced == in_order
