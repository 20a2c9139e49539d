"""What linear analysis says of the places of a map: the same as it says of each by itself."""

from typing import Any

import numpy as np
import pytest

from trilat_net.scenario import Scenario, load_scenario
from trilat_net.theory import analyse_linear_loop, find_linear_edge
from trilat_net.theory.linear_edge import (
    ASSUMED_EQUILIBRIUM_REMARK,
    compute_growth_rates,
    find_root_crossings,
)


def damped(d: float) -> Scenario:
    return load_scenario("p_d_margin", {"control.d": d})


def test_the_real_part_is_that_of_the_analysis() -> None:
    found, remarks = compute_growth_rates([damped(d) for d in (0.8, 0.9, 1.0, 1.1)])
    assert remarks == []
    for d, growth in zip((0.8, 0.9, 1.0, 1.1), found, strict=True):
        root = analyse_linear_loop(damped(d), pose=(1.0 / 15.0, 7.0 / 30.0)).continuous.rightmost
        assert root is not None
        assert growth == pytest.approx(root.s.real, abs=1e-9)


def test_an_edge_is_where_the_sign_changes() -> None:
    (found,), remark = find_root_crossings(damped(3.0), "control.d", 0.3, 3.0)
    assert remark == ""
    (below, above), _ = compute_growth_rates([damped(found - 1e-4), damped(found + 1e-4)])
    assert below > 0.0 > above
    alone = find_linear_edge(damped(3.0), "control.d", 0.3, 3.0)
    assert alone is not None
    assert found == pytest.approx(alone.value, rel=1e-6)


def test_the_scheme_decides_which_loop_counts() -> None:
    """Without delay the continuous loop of the paper's law is stable at any rate; as computed it is not."""
    slow: dict[str, Any] = {"link.delay_ms": 0.0, "rate_hz": 50}
    (continuous, digital), remarks = compute_growth_rates(
        [load_scenario("free", slow), load_scenario("free", {**slow, "scheme": "digital"})]
    )
    assert continuous < 0.0 < digital
    assert remarks == [ASSUMED_EQUILIBRIUM_REMARK]


def test_what_has_no_linear_loop_is_told_and_not_known() -> None:
    found, remarks = compute_growth_rates(
        [load_scenario("p_d_margin", {"link.model": "measured"}), damped(3.0)]
    )
    assert np.isnan(found[0])
    assert found[1] < 0.0
    assert len(remarks) == 1
    assert remarks[0].startswith("no linear analysis: ")
    edges, remark = find_root_crossings(
        load_scenario("p_d_margin", {"link.model": "measured"}), "control.d", 0.3, 3.0
    )
    assert edges == ()
    assert remark.startswith("no linear analysis: ")
