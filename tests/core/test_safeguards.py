"""Limits, faults and stops bound every arm, whatever law, peer or order."""

import re

import numpy as np
import pytest

import trilat_net
from tests.core.guarded_runs import (
    LIMITS,
    RATE_NM_S,
    TEXT,
    adaptive_text,
    find_largest_step,
    list_reasons,
    make_guarded_scenario,
    make_ordered_log,
    make_stopped_log,
)
from tests.core.rests import compute_rest_torque, gravity_of
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.core.life.safeguards import BLEND_S
from trilat_net.core.plug.user_law import LawContext, LawInput
from trilat_net.core.step.ticks import LifeReason
from trilat_net.errors import ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.execution.what_if import rerun
from trilat_net.log.log_reader import Log
from trilat_net.scenario import load_scenario


@pytest.mark.long
def test_logs_with_orders_verify_in_every_way() -> None:
    log = make_stopped_log()
    assert verify_log(log).identical == 12_000
    assert compare_with_virtual(log).fed.identical == 12_000
    again = rerun(log, ["s"])
    assert again.sites["s"].identical == 6000


def test_stopped_sites_go_on_learning() -> None:
    log = make_stopped_log(adaptive_text(), 3000)
    theta_hat = log["s"].theta_hat
    assert np.ptp(theta_hat[2000:3000], axis=0).max() > 1e-3
    assert verify_log(log).identical == 12_000
    assert log["s"].mode[-1] == "run"


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"q_max_rad": [0.5, 1.2]}, LifeReason.LIMIT_Q),
        pytest.param({"q_min_rad": [-0.2, -4.0]}, LifeReason.LIMIT_Q, marks=pytest.mark.long),
        ({"qd_limit_rad_s": 0.4}, LifeReason.LIMIT_QD),
    ],
)
def test_a_passed_limit_is_a_lasting_fault(
    limits: dict[str, object], reason: LifeReason
) -> None:
    scenario = make_guarded_scenario(limits, where="sites.s.")
    log = make_ordered_log(
        scenario, {"m": {4500: "enable"}, "s": {4500: "stop", 5000: "reset"}}
    )
    modes = list_reasons(log, "s")
    assert ("fault", reason) in modes
    at = list(log["s"].mode).index("fault")
    assert set(log["s"].mode[at:5000]) == {"fault"}  # no other order ends it
    assert "diverged" not in set(log["m"].mode)
    assert any(
        re.search("s is in FAULT from .*: a joint is", event.text) for event in log.events
    )
    assert verify_log(log).differing == 0
    assert len(log["s"]) == 6000


def test_rate_limits_keep_reference_jumps_out() -> None:
    """A peer 3 rad away that is used at once, under the default rule, with and without its limits."""
    text = TEXT.replace('action = "glide"', 'action = "use"').replace(
        "q0_rad = [0.1, 0.4]", "q0_rad = [2.6, 0.4]"
    )
    text = text.replace("align_speed_rad_s = {speed}\nalign_limit_rad = {limit}\n", "")
    keys = {key: LIMITS[key] for key in ("tau_rate_limit_nm_s", "qd_des_limit_rad_s")}
    free, held = (
        trilat_net.simulate(make_guarded_scenario(limits, text, duration_s=1.0))
        for limits in ({}, keys)
    )
    assert find_largest_step(free, "s") > 50.0
    assert find_largest_step(held, "s") <= RATE_NM_S * 1e-3 * (1.0 + 1e-9)
    steps = np.abs(np.diff(held["s"].q_des, axis=0))
    assert steps.max() <= 6.0e-3 * (1.0 + 1e-9)
    assert np.abs(held["s"].qd_des).max() == 6.0
    assert verify_log(held).identical == 2000


@pytest.mark.parametrize(
    ("limits", "phrase"),
    [
        ({"q_min_rad": 1.0, "q_max_rad": 0.5}, "above q_min_rad"),
        ({"q_max_rad": 0.2}, "start at most"),
        ({"q_min_rad": [1.0, 2.0, 3.0]}, "has 3 numbers, and the arm has 2 joints"),
        ({"tau_rate_limit_nm_s": 0.0}, "tau_rate_limit_nm_s"),
    ],
)
def test_impossible_limits_are_refused(limits: dict[str, object], phrase: str) -> None:
    with pytest.raises(ScenarioError, match=phrase):
        make_guarded_scenario(limits)


def test_position_limits_need_a_rule() -> None:
    with pytest.raises(
        ScenarioError, match=r"limits.q_max_rad: applies only with on_stale.action = 'glide'"
    ):
        load_scenario("free", {"limits.q_max_rad": 9.0})


@pytest.mark.parametrize(
    ("missed", "mode"),
    [
        pytest.param(5, "run", marks=pytest.mark.long),
        (20, "run"),
        (21, "hold"),
        pytest.param(200, "hold", marks=pytest.mark.long),
        (201, "fault"),
    ],
)
def test_missed_ticks_are_held_or_a_fault(missed: int, mode: str) -> None:
    """A simulated arm stands still meanwhile.

    The log is whole, and is executed again without the missed ticks.
    """
    scenario = make_guarded_scenario(text=adaptive_text(), duration_s=4.0)
    at = 2000 + missed
    log = make_ordered_log(scenario, {"s": {at: "overrun"}}, ticks=missed)
    part = log["s"]
    assert part.tick.tolist() == [*range(2000), *range(at, 4000)]
    assert part.mode[2000] == mode
    assert find_largest_step(log, "s") <= RATE_NM_S * 1e-3 * (1.0 + 1e-9)
    theta_hat = part.theta_hat
    assert (
        np.abs(theta_hat[2001] - theta_hat[1999]).max() <= 0.01 * np.abs(theta_hat[1999]).max()
    )
    assert part.skipped == missed
    assert log.missing("s") == 0
    assert log.expected_ticks("s") == 4000 - missed
    verdict = verify_log(log)
    assert verdict.identical == 8000 - missed
    assert verdict.passed
    assert not verdict.gaps
    assert compare_with_virtual(log).fed.identical == 8000 - missed
    if mode == "hold":
        assert part.mode[-1] == "run"


def test_sites_of_other_rules_know_no_orders() -> None:
    with pytest.raises(ScenarioError, match=r"has on_stale\.action = 'use'"):
        load_scenario("free").make_site_order("s", "stop", 0)


@pytest.mark.long
def test_stops_and_returns_add_no_steps() -> None:
    """Arms that begin 3 rad apart, without a limit of the torque's rate."""
    text = adaptive_text().replace("q0_rad = [0.8, 0.3]", "q0_rad = [2.9, -1.1]")
    text = text.replace("q0_rad = [0.1, 0.4]", "q0_rad = [-0.1, 1.9]")
    scenario = make_guarded_scenario({}, text, duration_s=8.0)
    orders = {"s": {5000: "stop", 6000: "enable"}, "m": {6500: "stop", 6540: "enable"}}
    log = make_ordered_log(scenario, orders)
    free = trilat_net.simulate(scenario)
    for site in log.sites:
        assert find_largest_step(log, site, 100) <= 1.1 * find_largest_step(free, site, 100)
    (jump,) = np.flatnonzero(
        (log["s"].mode[1:] == "return") & (log["s"].mode[:-1] == "stopped")
    )
    assert (log["s"].tau[jump + 1] == log["s"].tau[jump]).all()
    assert verify_log(log).identical == 16_000
    balance = EnergyBalance.of_energies(SiteEnergy.by_site(log))
    assert np.abs(balance.residual).max() <= 1e-3 * balance.scale


class Pull:
    """A law of springs to the peers themselves, which pulls towards their last samples, however old."""

    remembers = ()

    def __init__(self, _facts: LawContext, K: float = 60.0, d: float = 12.0) -> None:
        self.K = K
        self.d = d

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = (
                now.gravity[i] - self.d * now.qd[i] - self.K * (now.q[i] - now.peers[0].q[i])
            )


class PullHeld(Pull):
    holds = True


def simulate_own_law(name: str) -> Log:
    text = TEXT.replace(
        'law = "pd_d"\nK = 60.0\nKd = 4.0\nd = 12.0', f'law = "{__name__}:{name}"'
    )
    return trilat_net.simulate(
        make_guarded_scenario({}, text, outages_s="[[2.0, 2.6]]", duration_s=4.0)
    )


def test_own_laws_yield_to_gravity_while_holding() -> None:
    """The slave holds from 2.12 to 2.7 s."""
    log = simulate_own_law("Pull")
    part = log["s"]
    q = part.q
    qd = part.qd
    held = slice(2120, 2700)
    assert set(part.mode[held]) == {"hold"}
    gravity = gravity_of(log.scenario.arms["s"].theta, q)
    setup = log.scenario.setup("s")
    wanted, _ = compute_rest_torque(
        setup.rest, part, gravity[held], 2120, np.array(setup.tau_limit_nm)
    )
    assert np.abs(part.tau[held] - wanted).max() <= 1e-9
    law = gravity - 12.0 * qd - 60.0 * (q - log["m"].q[np.maximum(np.arange(4000) - 100, 0)])
    share = np.minimum(np.arange(200) * 1e-3 / BLEND_S, 1.0)[:, None]
    wanted = (1.0 - share) * part.tau[2699] + share * law[2700:2900]
    assert np.abs(part.tau[2700:2900] - wanted).max() <= 1e-9
    assert np.abs(part.tau[0]).max() <= 1.0  # it waits from 0 s on, and its rate is limited
    assert verify_log(log).identical == 8000
    assert compare_with_virtual(log).fed.identical == 8000


def test_a_holding_law_is_still_called() -> None:
    log = simulate_own_law("PullHeld")
    part = log["s"]
    q = log["s"].q[2120:2700]
    gravity = gravity_of(log.scenario.arms["s"].theta, q)
    law = gravity - 12.0 * part.qd[2120:2700] - 60.0 * (q - log["m"].q[1999])
    setup = log.scenario.setup("s")
    wanted, _ = compute_rest_torque(setup.rest, part, law, 2120, np.array(setup.tau_limit_nm))
    assert np.abs(part.tau[2120:2700] - wanted).max() <= 1e-9
