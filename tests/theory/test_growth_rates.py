"""What linear analysis says of the places of a map: the same as it says of each by itself."""

from typing import Any

import numpy as np
import pytest

from trilat_net.scenario import Scenario, load_scenario
from trilat_net.theory import analyse_linear_loop, iterate_linear_edges
from trilat_net.theory.linear_edge import (
    ASSUMED_EQUILIBRIUM_REMARK,
    compute_growth_column,
    find_root_crossings,
)

D = (0.8, 0.9, 1.0, 1.1)


def damped(d: float) -> Scenario:
    return load_scenario("p_d_margin", {"control.d": d})


def test_the_real_part_is_that_of_the_analysis() -> None:
    found, _, remarks = compute_growth_column([damped(d) for d in D], "control.d", D)
    assert remarks == []
    for d, growth in zip(D, found, strict=True):
        root = analyse_linear_loop(damped(d), pose=(1.0 / 15.0, 7.0 / 30.0)).continuous.rightmost
        assert root is not None
        assert growth == pytest.approx(root.s.real, abs=1e-9)


@pytest.mark.long
def test_an_edge_is_where_the_sign_changes() -> None:
    (found,), remark = find_root_crossings(damped(3.0), "control.d", 0.3, 3.0)
    assert remark == ""
    places = (found - 1e-4, found + 1e-4)
    (below, above), edges, _ = compute_growth_column([*map(damped, places)], "control.d", places)
    assert below > 0.0 > above
    assert edges == {0: pytest.approx(found, rel=1e-6)}
    alone = next(iterate_linear_edges(damped(3.0), "control.d", 0.3, 3.0), None)
    assert alone is not None
    assert found == pytest.approx(alone.value, rel=1e-6)


def test_the_scheme_decides_which_loop_counts() -> None:
    """Without delay the continuous loop of the paper's law is stable at any rate; as computed it is not."""
    slow: dict[str, Any] = {"link.delay_ms": 0.0, "rate_hz": 50}
    schemes = [load_scenario("free", {**slow, "scheme": scheme}) for scheme in ("second_order", "digital")]
    found = [compute_growth_column([one], "link.delay_ms", (0.0,)) for one in schemes]
    (continuous,), (digital,) = (one.growth_per_s for one in found)
    assert continuous < 0.0 < digital
    assert found[0].remarks == found[1].remarks == [ASSUMED_EQUILIBRIUM_REMARK]


def test_what_has_no_linear_loop_is_told_and_not_known() -> None:
    unknown = load_scenario("p_d_margin", {"link.model": "measured"})
    found, edges, remarks = compute_growth_column([unknown, damped(3.0)], "control.d", (2.9, 3.0))
    assert edges == {}
    assert np.isnan(found[0])
    assert found[1] < 0.0
    assert len(remarks) == 1
    assert remarks[0].startswith("no linear analysis: ")
    crossings, remark = find_root_crossings(unknown, "control.d", 0.3, 3.0)
    assert crossings == ()
    assert remark.startswith("no linear analysis: ")
