"""Measured delays against the truth: members on clocks that are seconds apart and drift, on one machine.

All clocks are one underneath, so that the true delay of every sample is known to the nanosecond.
"""

import json
import re

import numpy as np
import pytest

from tests.cli.running import trilat
from tests.live.processes import connection_options
from tests.truth import judge_link, list_members, offset_errors

from .processes import PAPER, Session, Stage

SKEWS = {
    "m2": ("--clock-offset-s", "3", "--clock-drift-ppm", "100"),
    "s": ("--clock-offset-s", "-2", "--clock-drift-ppm", "-50"),
    "recorder": ("--clock-offset-s", "86400", "--clock-drift-ppm", "-100"),
}
IDLE_US = 200.0
"""A bound that a machine with nothing else to do reaches; then the estimates must be as good as promised."""


@pytest.mark.long
def test_delays_lie_in_bounds_and_clocks_are_found(stage: Stage) -> None:
    session = Session(stage, "paper", PAPER, "--duration", "12")
    session.recorder(*SKEWS["recorder"])
    for name in ("s", "m2", "m1"):  # the leader comes last
        session.site(name, "--needs-recorder", *SKEWS.get(name, ()))
    session.begun()
    seen = trilat(
        "ping",
        "--session",
        "t",
        "--json",
        *connection_options(session.endpoints),
        cwd=stage.folder,
    )
    log = session.is_reproduced()
    for site in PAPER:
        for peer in log.scenario.peers(site):
            samples = judge_link(log, site, peer)
            assert len(samples.tick) > 6_000
            assert samples.inside >= 0.999
            assert samples.delay_us.min() > 0.0
            errors = offset_errors(log, site, peer)
            if np.median(samples.bound_us) <= IDLE_US:
                assert np.abs(errors[errors[:, 0] >= 10.0, 1]).max() <= 100.0
                assert np.abs(errors[errors[:, 0] >= 10.0, 2]).max() <= 20.0
    clocks = list_members(log)
    for own, other, about_s in (("m1", "m2", 3.0), ("recorder", "m1", -86_400.0)):
        found = re.search(
            rf"clock of {other}: another one, offset (\S+) s \+- (\d+) us",
            session.processes[own].text(),
        )
        assert found is not None, session.processes[own]
        true_s = clocks[own].offset_to_ns(clocks[other], 0) / 1e9
        assert true_s == pytest.approx(about_s, abs=0.1)
        # it prints whole us
        assert float(found[1]) == pytest.approx(true_s, abs=1e-6 * (float(found[2]) + 1.0))
    told = json.loads(seen.succeeds())
    pinged = {member["member"]: member for member in told["members"]}
    assert set(pinged) == {*PAPER}
    assert pinged["m1"]["same_clock"]
    assert abs(pinged["m2"]["offset_ns"] - 3_000_000_000) <= 20_000_000
    assert pinged["m2"]["rtt_us"]["min"] > 0
    assert {(link["from"], link["to"]) for link in told["links"]} == {
        (peer, site) for site in PAPER for peer in log.scenario.peers(site)
    }


def test_unanswered_pings_say_where_they_looked(stage: Stage) -> None:
    done = trilat("ping", "--session", "nobody-here", "--timeout", "0.5", cwd=stage.folder)
    done.refuses(
        "no site of session 'nobody-here' answered at tcp/127.0.0.1:", "--connect", code=1
    )
