"""Statements about laws and twins that were once false, each with other numbers.

A statement is checked against numbers that do not come from the program's own judgement: a
formula, a recursion with NumPy alone, or the energies that the records contain.
"""

from typing import Any

import numpy as np
import pytest

import trilat_net as tn
from tests.certificate.sampled_loops import make_constant_delay, make_sine_delay
from tests.unit_arm import make_unit_scenario
from trilat_net.analysis.judge import list_law_proofs
from trilat_net.analysis.run_end import Stability
from trilat_net.analysis.twins.twin_runs import Push, Twins
from trilat_net.presentation.observed_text import NEGATIVE_ENERGY_MEANING
from trilat_net.scenario import Scenario, load_scenario

from .sampled_loops import SampledLoop

PAIR = ((0.0, 1.0), (1.0, 0.0))
THREE = ((0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0))

# Row 8: energies below zero under time-domain passivity control.


def write_tdpa(
    delay_ms: float, K: float, B: float, reserve_J: float | None, **more: Any
) -> Scenario:
    """Returns a pair under `tdpa` whose sites start apart; something resists their motion.

    Args:
        delay_ms: Delay of both links, in ms.
        K: Stiffness of both sites, in N m/rad.
        B: Damping of both sites, in N m s/rad.
        reserve_J: Energy that every connection may lend, in J. The usual one if None.
        more: Further keys of the scenario.
    """
    law = {"law": "tdpa", "K": K, "B": B}
    if reserve_J is not None:
        law["reserve_J"] = reserve_J
    around = {"environment": [{"kind": "viscous", "damping_nm_s_rad": 4.0}]}
    sites = {"m": {"q0_rad": [0.3, 0.1], **around}, "s": {"q0_rad": [0.8, 0.5], **around}}
    link = {"model": "constant", "delay_ms": delay_ms}
    return make_unit_scenario(sites, law, link=link, rate_hz=200, duration_s=12.0, **more)


TDPA_RUNS = [
    (200.0, 60.0, 6.0),
    pytest.param(120.0, 50.0, 6.0, marks=pytest.mark.long),
    pytest.param(350.0, 30.0, 4.0, marks=pytest.mark.long),
]
"""Delay in ms, stiffness and damping."""


def find_least_known_j(log: Any) -> float:
    """Returns the least energy that an end of a connection knew to be left, in J."""
    least = []
    for site in log.sites:
        for key, values in log[site].sent.items():
            if key.partition("[")[0] in ("W_led", "W_followed"):
                least.append(float(values.min()))
    return min(least)


@pytest.mark.parametrize(("delay_ms", "K", "B"), TDPA_RUNS)
def test_negative_energy_leaves_a_run_open_that_decays(
    delay_ms: float, K: float, B: float
) -> None:
    log = tn.simulate(write_tdpa(delay_ms, K, B, 0.0))
    assert find_least_known_j(log) < -1e-6
    certificate = tn.certify(log)
    assert certificate.observed is not None
    assert certificate.observed.finding == "negative"
    assert certificate.stability is Stability.OPEN
    assert certificate.observed.text in certificate.reasons
    assert NEGATIVE_ENERGY_MEANING.startswith("an observed energy below zero")


@pytest.mark.parametrize(("delay_ms", "K", "B"), TDPA_RUNS)
def test_energy_within_the_reserve_proves_no_decay(delay_ms: float, K: float, B: float) -> None:
    log = tn.simulate(write_tdpa(delay_ms, K, B, None))
    assert find_least_known_j(log) >= 0.0
    certificate = tn.certify(log)
    assert certificate.observed is not None
    assert certificate.observed.finding == "passive"
    assert certificate.stability in (Stability.SETTLED, Stability.OPEN)
    assert certificate.decision.rests_on == "" or "pushes" in certificate.decision.rests_on


# Row 12: what the conditions of laws prove.


@pytest.mark.parametrize("law", ["wave", "tdpa", "tanks"])
def test_passive_laws_prove_bounded_motion_and_no_decay(law: str) -> None:
    for delay_ms in (20.0, 300.0):
        link = {"model": "constant", "delay_ms": delay_ms}
        scenario = make_unit_scenario(
            {"m": {}, "s": {}}, {"law": law}, link=link, duration_s=5.0
        )
        conditions = scenario.describe_law_conditions()
        assert conditions
        for line in conditions:
            assert "holds: motion stays bounded (decay is not proved)" in line
        assert list_law_proofs(scenario) == []


def write_slow_pair(d: float) -> Scenario:
    """Returns a session of P+d at 30 Hz, whose condition of continuous time holds."""
    return load_scenario(
        "two_sites",
        {
            "control.law": "p_d",
            "control.K": 50.0,
            "control.d": d,
            "rate_hz": 30,
            "link.delay_ms": 0.0,
            "duration_s": 0.5,
        },
    )


SAMPLING = "but sampling breaks it here: the roots of the sampled loop grow"


@pytest.mark.parametrize(("d", "grows"), [(5.0, False), (5.6, True)])
def test_conditions_say_where_sampling_breaks_them(d: float, grows: bool) -> None:
    """A condition of continuous time holds at any rate, and beside growing roots says so."""
    scenario = write_slow_pair(d)
    (alone,) = scenario.describe_law_conditions()
    assert " holds: " in alone
    assert "sufficient in continuous time" in alone
    analysis = tn.linear(scenario, ports=False)
    assert (analysis.sampled.verdict == "unstable") is grows
    (beside,) = [note for note in analysis.notes if note.startswith(alone)]
    assert (SAMPLING in beside) is grows
    certificate = tn.certify(tn.simulate(scenario), twins=0)
    assert certificate.roots.is_refutation is grows
    assert certificate.law_conditions == (beside,)


SLIDING = [
    SampledLoop(PAIR, make_constant_delay(80.0), 0.0, 0.0, (2.9,), 100),
    SampledLoop(THREE, make_constant_delay(200.0), 0.0, 0.0, (2.2,), 100),
    SampledLoop(PAIR, make_constant_delay(30.0), 0.0, 0.0, (1.5,), 200),
]
ADAPTIVE = {"law": "adaptive", "Lambda": 1.0, "Kp": 4.0, "Kd": 5.0, "Gamma": 1.0}


def write_sliding(loop: SampledLoop, duration_s: float) -> Scenario:
    """Returns the run of arms with prismatic joints under the adaptive law."""
    controls = {f"sites.{name}.control": ADAPTIVE for name in loop.names}
    return loop.write_scenario(duration_s, 0.1, **controls)


@pytest.mark.parametrize(
    "loop",
    [SLIDING[0], *(pytest.param(loop, marks=pytest.mark.long) for loop in SLIDING[1:])],
)
def test_theorem_covers_prismatic_joints(loop: SampledLoop) -> None:
    """M, C and G of sliding joints are constant, so that every step of the proof holds."""
    certificate = tn.certify(tn.simulate(write_sliding(loop, 20.0)))
    assert certificate.stability is Stability.STABLE
    assert (
        "the theorem (continuous time; every premise checked here holds)"
        in certificate.decision.rests_on
    )


def test_theorem_excludes_prismatic_joints_over_varying_delay() -> None:
    swinging = SLIDING[0]._replace(delays=make_sine_delay(80.0, 60.0, 1.5))
    certificate = tn.certify(tn.simulate(write_sliding(swinging, 20.0)))
    assert "the theorem" not in certificate.decision.rests_on


# Row 14: a push at 0 s is not another start.

PUSHED_LOOPS = [
    SampledLoop(PAIR, make_constant_delay(200.0), 10.0, 1.2, (), 100),
    SampledLoop(THREE, make_constant_delay(300.0), 12.0, 1.9, (2.9,), 100),
    SampledLoop(PAIR, make_constant_delay(250.0), 8.0, 2.1, (1.7,), 200, "digital"),
]
PUSH_RAD = 1e-6


def write_run(loop: SampledLoop, pushed_rad: float, duration_s: float) -> Scenario:
    """Returns a run in which site a starts at a small distance from all others."""
    start = [0.1 + pushed_rad] * len(loop.inertia)
    return loop.write_scenario(duration_s, 0.0, **{"sites.a.q0_rad": start})


def measure_twin(loop: SampledLoop, duration_s: float) -> Any:
    """Returns the effect of a push at 0 s on the velocities of a twin, in its last tick.

    Args:
        loop: The loop.
        duration_s: Duration of the run, a multiple of 50 ms.

    Returns:
        Difference of velocity from the run, shape (N, n), in rad/s.
    """
    by = np.zeros((len(loop.names), len(loop.inertia)))
    by[0] = PUSH_RAD
    push = Push("push of a", "q", by, again=False, largest=np.inf)
    (path,) = Twins.of_scenario(write_run(loop, 0.0, duration_s), [push], duration_s).paths
    return path.last[round(20.0 * duration_s) - 1].reshape(by.shape)


def measure_start(loop: SampledLoop, ticks: int) -> Any:
    """Returns the velocities of a run that starts at the pushed pose, shape (N, n)."""
    log = tn.simulate(write_run(loop, PUSH_RAD, (ticks + 1) / loop.rate_hz))
    return np.array([log[name].qd[ticks] for name in loop.names])


@pytest.mark.parametrize("loop", PUSHED_LOOPS)
def test_push_at_zero_keeps_the_runs_history(loop: SampledLoop) -> None:
    """The peers of a twin see the old pose for one delay, those of another start never do."""
    still = np.zeros((len(loop.names), len(loop.inertia)))
    pushed = still.copy()
    pushed[0] = PUSH_RAD
    last = 2 * loop.rate_hz - 1
    twin = loop.compute_velocities(pushed, still, last)
    start = loop.compute_velocities(pushed, pushed, last)
    assert np.abs(twin - start).max() > 0.05 * np.abs(start).max()
    np.testing.assert_allclose(measure_twin(loop, 2.0), twin, rtol=1e-3, atol=1e-11)
    np.testing.assert_allclose(measure_start(loop, last), start, rtol=1e-3, atol=1e-11)


def test_push_without_delay_nearly_equals_another_start() -> None:
    """The peers see the old pose for one tick only."""
    loop = SampledLoop(PAIR, make_constant_delay(0.0), 10.0, 2.6, (), 1000)
    twin = measure_twin(loop, 0.5)
    start = measure_start(loop, 499)
    np.testing.assert_allclose(twin, start, rtol=0.02, atol=1e-9)
