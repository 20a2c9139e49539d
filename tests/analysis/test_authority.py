"""Shares over time, as lines."""

import numpy as np
import pytest

import trilat_net
from trilat_net.reporting.figures import authority

from . import logs

RAMPS = {
    "duration_s": 6.0,
    "rate_hz": 100,
    "timeline": [
        {"at_s": 1.0, "dominance": "s", "to": {"m1": 1.0, "m2": 0.0}, "ramp_s": 2.0},
        {"at_s": 2.0, "dominance": "s", "to": {"m1": 0.0, "m2": 1.0}, "ramp_s": 1.5},
        {"at_s": 5.0, "dominance": "s", "to": {"m1": 0.5, "m2": 0.5}},
    ],
}
"""The second ramp begins half-way through the first one, at 0.75."""


@pytest.fixture(scope="module")
def ramped():
    return trilat_net.simulate("paper", RAMPS)


def test_a_ramp_begins_where_the_one_before_it_is(ramped):
    t_s, shares = authority.dominance_lines(ramped, "s")
    at = [0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.9, 5.1]
    assert np.interp(at, t_s, shares["m1"]) == pytest.approx([0.5, 0.5, 0.625, 0.75, 0.375, 0.0, 0.0, 0.5])
    assert shares["m1"] + shares["m2"] == pytest.approx(np.ones(len(t_s)))


def test_they_are_the_shares_that_the_references_were_made_of(ramped):
    """Eq. (6) with the drawn shares and the samples in use gives the recorded reference."""
    part = ramped["s"]
    t_s, shares = authority.dominance_lines(ramped, "s")
    reference = np.zeros_like(part.q)
    for peer, share in shares.items():
        used, q = part.used[peer], ramped[peer].q
        seen = np.where(used[:, None] >= 0, q[np.maximum(used, 0)], ramped.scenario.sites[peer].q0_rad)
        reference += np.interp(part.t_s, t_s, share)[:, None] * seen
    steps = np.isin(part.t_s, [5.0])  # at a step a line has both values
    assert reference[~steps] == pytest.approx(part.q_des[~steps], abs=1e-9)


def test_only_sites_whose_shares_change_are_shown(ramped):
    assert authority.sites_with_changing_dominance(ramped) == ["s"]
    assert len(authority.draw_authority(ramped).axes) == 3
    assert authority.sites_with_changing_dominance(logs.simulated("paper")) == []
    (text,) = authority.draw_authority(logs.simulated("paper")).texts
    assert text.get_text() == authority.CONSTANT_DOMINANCE
