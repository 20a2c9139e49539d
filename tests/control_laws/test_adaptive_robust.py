"""`adaptive_robust`: its torque, its mean-square bound under a disturbance, its energy, its
linear loop.

Let d be the disturbance, abs(d_j) <= rho_j, and D the dissipation in V without the robust term.
Then V' = - D + sum_i beta_i r'(d - rho r / sqrt(r^2 + w^2)). With x = abs(r) / w the last term
is at most rho w (x - x^2 / sqrt(1 + x^2)).
"""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import trilat_net
from tests.scenario.builders import rough_arm_text
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.core.step.control import ROBUST_RESIDUE, robust_torque
from trilat_net.log.log_reader import Log
from trilat_net.scenario import parse_scenario

RHO_NM = 3.0
WIDTH_RAD_S = 0.03
SHAKEN = """name = "shaken"
duration_s = 20.0
[link]
delay_ms = 100
[arm]
[control]
law = "{law}"
theta_low = -1.0
theta_high = 10.0
{more}
[sites.m1]
q0_rad = [0.5, 0.2]
hands = [{{ kind = "multisine", amplitude_nm = [1.4, 1.4], frequencies_hz = [0.31, 0.83] }}]
[sites.m2]
q0_rad = [0.1, 0.1]
hands = [{{ kind = "multisine", amplitude_nm = [1.4, 1.4], frequencies_hz = [0.47, 1.1] }}]
[sites.s]
role = "slave"
q0_rad = [0.3, 0.4]
[dominance]
m1 = {{ m2 = 0.5, s = 0.5 }}
m2 = {{ m1 = 0.5, s = 0.5 }}
s = {{ m1 = 0.5, m2 = 0.5 }}
"""
ROBUST = f"rho_nm = {RHO_NM}\nwidth_rad_s = {WIDTH_RAD_S}"


def simulate_law(law: str, more: str = "") -> Log:
    return trilat_net.simulate(parse_scenario(SHAKEN.format(law=law, more=more)))


def mean_dissipation(log: Log, without: float) -> float:
    """Returns the mean over time of sum beta (r'Kp r + disagreement), and V at the start
    divided by the time, W.
    """
    energies = SiteEnergy.by_site(log)
    beta = EnergyBalance.of_energies(energies).beta[0]
    total = 0.0
    for weight, energy in zip(beta, energies.values(), strict=True):
        motion = energy.motion
        dissipation = {
            name: power.total.sum() for name, power in motion.compute_dissipation().items()
        }
        opposed = (
            motion.r * motion.constants.robust_torque(motion.r)
        ).sum() * motion.records.h_s
        total += weight * (
            dissipation["damping"] + dissipation["disagreement"] - without * opposed
        )
    return float(total / log.scenario.duration_s)


def test_residue_is_the_maximum_of_its_function() -> None:
    minimum = minimize_scalar(
        lambda x: x * x / np.sqrt(1.0 + x * x) - x, bounds=(0.0, 5.0), method="bounded"
    )
    assert -minimum.fun == pytest.approx(ROBUST_RESIDUE, rel=1e-9)
    r = np.linspace(-30.0, 30.0, 2001)
    worst = max(abs(x) * 2.0 - x * robust_torque(2.0, 0.4, x) for x in r)
    assert worst <= ROBUST_RESIDUE * 2.0 * 0.4


@pytest.mark.long
def test_robust_dissipation_stays_bounded_unlike_the_box() -> None:
    def bound(log: Log) -> float:
        balance = EnergyBalance.of_energies(SiteEnergy.by_site(log))
        robust_w = ROBUST_RESIDUE * float(balance.beta[0].sum()) * 2 * RHO_NM * WIDTH_RAD_S
        return robust_w + float(balance.V[0] - balance.V[-1]) / log.scenario.duration_s

    robust = simulate_law("adaptive_robust", ROBUST)
    box = simulate_law("adaptive_box")
    assert mean_dissipation(robust, 1.0) <= bound(robust)
    assert mean_dissipation(box, 0.0) > bound(box)


def test_energy_closes_with_unknown_friction() -> None:
    robust = 'law = "adaptive_robust"\nrho_nm = 1.5\nwidth_rad_s = 0.1\nfriction = 0.25'
    text = rough_arm_text().replace('law = "adaptive"', robust)
    log = trilat_net.simulate(parse_scenario(text))
    energies = SiteEnergy.by_site(log)
    balance = EnergyBalance.of_energies(energies)
    friction = sum(
        power.total
        for power in (e.motion.compute_work()["friction"] for e in energies.values())
    )
    assert np.abs(np.cumsum(friction)).max() >= 0.01 * balance.V.max()
    assert np.abs(balance.unexplained).max() <= 2e-4 * balance.V.max()


def test_small_motions_see_a_larger_kp() -> None:
    """The slope of the robust term where r = 0 is rho / width."""

    def static(law: str, more: str) -> np.ndarray:
        scenario = parse_scenario(SHAKEN.format(law=law, more=more))
        return LinearLoop.of_conditions(
            OperatingConditions.derive(scenario), find_equilibrium(scenario, (0.3, 0.2))
        ).A

    robust = static("adaptive_robust", f"Kp = 1.0\n{ROBUST}")
    larger = static("adaptive_box", f"Kp = {1.0 + RHO_NM / WIDTH_RAD_S}")
    np.testing.assert_allclose(robust, larger, rtol=1e-12, atol=1e-12)
