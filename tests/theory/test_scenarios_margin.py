"""P+d at its margin, and jitter: scenarios `p_d_margin`, `p_d_margin_two`, `jitter`.

A figure "at t" is the largest |e| of the two seconds from t on.
"""

import numpy as np
import pytest

from tests.theory.figures_of_runs import measured, peak, printed
from trilat_net.analysis.envelope_trend import EnvelopeTrend
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario

CONSTANT = {"link.model": "constant", "link.delay_ms": 200.0}


@pytest.mark.parametrize(("name", "margin"), [("p_d_margin", 1.0), ("p_d_margin_two", 2.0)])
def test_margin_is_smallest_eigenvalue_of_alpha_times_k_t(name: str, margin: float) -> None:
    """d = abs(lambda_min(alpha)) K T."""
    scenario = load_scenario(name)
    (delay_ms,) = {link.delay_ms for link in scenario.links.values()}
    alpha = np.array([[scenario.dominance[i].get(j, 0.0) for j in scenario.sites] for i in scenario.sites])
    assert -np.linalg.eigvals(alpha).real.min() * 10.0 * delay_ms * 1e-3 == pytest.approx(margin)


@pytest.mark.long
@pytest.mark.parametrize(("name", "d"), [("p_d_margin", 0.9), ("p_d_margin_two", 1.8)])
def test_below_its_margin_p_d_grows(name: str, d: float) -> None:
    """Above it, at 1.1 and 2.1, it decays: that is what both scenarios expect as they are shipped."""
    shipped = load_scenario(name)
    assert {site.control.d[0] for site in shipped.sites.values()} <= {1.1, 2.1}  # type: ignore[union-attr]
    assert measured(name, {"control.d": d, "duration_s": 40.0}).end.error.trend is EnvelopeTrend.GROWS


@pytest.mark.long
def test_margin_with_unequal_shares_is_that_of_their_smallest_eigenvalue() -> None:
    """-0.8, so 1.6: as `docs/lab.md` asks."""
    row = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.8, "s": 0.2}, "s": {"m1": 0.8, "m2": 0.2}}
    alpha = np.array([[row[i].get(j, 0.0) for j in row] for i in row])
    assert np.linalg.eigvals(alpha).real.min() == pytest.approx(-0.8)
    changes = {"dominance": row, "duration_s": 40.0}
    assert measured("p_d_margin", {**changes, "control.d": 1.4}).end.error.trend is EnvelopeTrend.GROWS
    assert measured("p_d_margin", {**changes, "control.d": 1.8}).end.error.trend is EnvelopeTrend.DECAYS


@pytest.mark.long
def test_half_of_the_margin_grows_to_10_rad() -> None:
    made = measured("p_d_margin", {"control.d": 0.5, "duration_s": 40.0}, (10.0, 12.0, ""), (38.0, 40.0, ""))
    assert [peak(made, 0), peak(made, 1)] == [printed(1.6, 0.1), printed(10.0, 1.0)]


@pytest.mark.long
def test_two_and_a_half_times_the_margin_decays_to_milliradians() -> None:
    made = measured("p_d_margin", {"control.d": 2.5, "duration_s": 21.0}, (19.0, 21.0, ""))
    assert peak(made) == printed(3e-3, 1e-3)


@pytest.mark.long
def test_jitter_of_the_same_mean_delay_turns_the_verdict() -> None:
    jitter = measured("jitter", {}, (38.0, 40.0, ""))
    constant = measured("jitter", CONSTANT, (38.0, 40.0, ""))
    assert (jitter.end.error.trend, constant.end.error.trend) == (EnvelopeTrend.DECAYS, EnvelopeTrend.GROWS)
    assert peak(jitter) == printed(0.022, 0.001)
    assert peak(constant) == printed(5.3, 0.1)
    ages = [age.mean_ms for age in jitter.ages.values()]
    assert ages == [printed(25.0, 1.0)] * len(ages)
    assert {age.mean_ms for age in constant.ages.values()} == {200.0}


@pytest.mark.long
def test_play_out_makes_jitter_constant_and_the_run_diverge() -> None:
    limits = {"limits.tau_limit_nm": 1e6, "limits.qd_limit_rad_s": 10_000.0}
    free = measured("jitter", {"link.playout_ms": 400.0, **limits}, (38.0, 40.0, ""))
    assert peak(free) == printed(339.0, 1.0)
    assert {age.max_ms for age in free.ages.values()} == {400.0}
    assert free.peak_speed_rad_s is not None
    assert free.peak_speed_rad_s > load_scenario("jitter").sites["s"].limits.qd_limit_rad_s


@pytest.mark.parametrize(
    ("changes", "leaves"),
    [({"link.order": "in_order"}, True), ({"rate_hz": 100}, False)],
    ids=["order", "rate"],
)
def test_order_makes_jitter_leave_its_limits_unlike_slower_rates(
    changes: dict[str, str | int], leaves: bool
) -> None:
    made = FusedRun(load_scenario("jitter", changes))
    made.advance(40.0)
    assert (made.diverged_s is not None) is leaves
