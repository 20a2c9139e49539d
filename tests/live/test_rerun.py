"""What if, asked of a session over a network: with nothing changed, any of its sites is the log."""

from itertools import combinations

import pytest

from tests.cli.running import trilat
from tests.live.processes import connection_options, open_whole_log
from trilat_net.execution.virtual_comparison import find_absent_samples
from trilat_net.execution.what_if import rerun

from .processes import PAPER, Session, Stage

LINKS = (
    "link.delay_ms=1",  # some samples come late
    "links.m2->s.model=measured",
    "links.s->m1.preset=4g",
    "links.s->m1.loss=0.2",
    "links.s->m1.loss_burst=5",
    "links.m1->m2.duplicate=0.3",
    "links.s->m2.outages_s=[[1.0, 1.3]]",
    "sites.m2.on_stale.action=hold",
    "sites.m2.on_stale.age_ms=100.0",
)


@pytest.mark.long
def test_rerun_sites_of_a_session_are_unchanged(stage: Stage) -> None:
    """Late samples, losses, duplicates, an outage, a stale peer, a measured link, and a change by command."""
    options = [word for text in LINKS for word in ("--set", text)]
    session = Session(stage, "paper", PAPER, "--duration", "4", *options)
    session.all()
    session.begun()
    session.recording()
    to = ("set", "--session", "t", *connection_options(session.endpoints))
    trilat(*to, "link", "m1->s", "--delay", "30ms", cwd=stage.folder).succeeds()
    session.ends_well()
    log = open_whole_log(session.log)
    assert any(sample.arrived_tick is not None for sample in find_absent_samples(log))
    assert "hold" in {state.mode for state in log["m2"].states}
    assert log.changes("s")
    for count in (1, 2, 3):
        for replace in combinations(PAPER, count):
            again = rerun(log, replace)
            assert again.identical
            assert all(effect.executed == 4000 for effect in again.sites.values())
    # what the network did stays: a delay above its worst makes every sample of the link as old as that
    slower = rerun(log, ["s"], {"links.m2->s.model": "constant", "links.m2->s.delay_ms": 900.0})
    assert slower.links["m2->s"].age_max_ms.after == 900.0
    assert slower.links["m1->s"].age_mean_ms.before == slower.links["m1->s"].age_mean_ms.after
