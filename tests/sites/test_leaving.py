"""Sites that leave a running session, come back or come late: the others go on, and the log explains it."""

from pathlib import Path
from typing import Any

import numpy as np

from trilat_net.execution.log_checks import run_log_checks
from trilat_net.execution.verify import verify
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario

from .sessions import Session

S = 1_000_000_000
GLIDE = {"on_stale.action": "glide", "on_stale.align_limit_rad": 3.0, "link.delay_ms": 50, "rate_hz": 200}


def gliding(duration_s: float, scenario: str = "two_sites", **keys: Any) -> Scenario:
    return load_scenario(scenario, {"duration_s": duration_s, **GLIDE, **keys})


def engaged_after_s(log: Log, site: str, tick: int) -> float:
    """How long after a tick a site follows its peers, s."""
    part = log[site]
    after = (part.tick >= tick) & (part.mode == "run")
    return float(part.tick[np.argmax(after)] - tick) / part.rate_hz


def test_a_site_that_is_killed_comes_back_and_the_log_is_whole(tmp_path: Path) -> None:
    session = Session.whole(gliding(7.0), tmp_path, ends={})
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
        assert engaged_after_s(log, site, first) < 2.0
        assert log.missing(site) == 0
        assert log[site].mode[-1] == "run"
    result = verify(log)
    assert (result.differing, result.unjudged, result.gaps) == (0, 0, [])
    assert result.passed
    assert result.absences == [("m", *log.absences["m"][0])]
    assert run_log_checks(log, virtual=True).passed
