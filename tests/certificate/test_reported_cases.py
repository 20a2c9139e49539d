"""Verdicts that were once wrong: each kind of run with other numbers, and its mirror image.

Every kind has three variants. For runs that were wrongly called stable, the mirror image is a
stable run that must be called stable or settled; for runs that were wrongly called unstable it
is an unstable one. A test checks the word and what it rests on.

The tables state the true rate at which the slowest motion grows, in 1/s. Where the loop is
linear, `SampledLoop.compute_rates` computes it with NumPy alone. Otherwise a run of eight times
the length shows whether the motion lasts.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

import trilat_net as tn
from tests.certificate.sampled_loops import (
    make_burst_delay,
    make_constant_delay,
    make_sine_delay,
)
from tests.execution.builders import make_log_with_commands, run_fused
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.run_end import Stability
from trilat_net.analysis.timeline import Timeline
from trilat_net.own_code.code_consent import allow_own_code
from trilat_net.scenario import Scenario

from .sampled_loops import SampledLoop

PAIR = ((0.0, 1.0), (1.0, 0.0))
THREE = ((0.0, 0.5, 0.5), (0.5, 0.0, 0.5), (0.5, 0.5, 0.0))
UNEQUAL = ((0.0, 0.2, 0.8), (0.5, 0.0, 0.5), (0.8, 0.2, 0.0))
TWO_PAIRS = (
    (0.0, 1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
    (0.0, 0.0, 1.0, 0.0),
)
PAIR_AND_THREE = (
    (0.0, 1.0, 0.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.5, 0.5),
    (0.0, 0.0, 0.5, 0.0, 0.5),
    (0.0, 0.0, 0.5, 0.5, 0.0),
)
LONGER = 8
"""Length of the run that shows the truth, in lengths of the judged run."""


class Case(NamedTuple):
    """A run whose loop is linear.

    Attributes:
        loop: The loop.
        rate_per_s: True rate of its slowest motion, in 1/s.
        duration_s: Duration of the run, in s.
        apart_rad: Distance of the start poses of two successive sites, in rad.
    """

    loop: SampledLoop
    rate_per_s: float
    duration_s: float
    apart_rad: float = 0.02

    @property
    def word(self) -> Stability:
        """The word that is right for the run."""
        return Stability.NOT_STABLE if self.rate_per_s > 0.0 else Stability.STABLE


def certify_case(case: Case) -> Certificate:
    """Returns the certificate of the run of a case."""
    return tn.certify(tn.simulate(case.loop.write_scenario(case.duration_s, case.apart_rad)))


def assert_roots_decide(certificate: Certificate, rate_per_s: float) -> None:
    """Asserts that a verdict rests on exact roots with a rate, and that it is right.

    Args:
        found: The certificate of a run.
        rate_per_s: True rate of the slowest motion, in 1/s.
    """
    assert certificate.roots is not None
    assert certificate.roots.exact
    assert certificate.roots.rate_per_s == pytest.approx(rate_per_s, abs=5e-5)
    if rate_per_s > 0.0:
        assert certificate.stability is Stability.NOT_STABLE
        assert "fastest growing +" in certificate.decision.rests_on
        assert certificate.roots.text in certificate.reasons
    else:
        assert certificate.stability is Stability.STABLE
        assert "exact roots, slowest -" in certificate.decision.rests_on
        assert certificate.reasons == ()


@pytest.mark.parametrize(
    "loop",
    [
        pytest.param(
            SampledLoop(PAIR, make_sine_delay(180.0, 150.0, 0.7), 10.0, 1.5, (2.9,), 200),
            marks=pytest.mark.long,
        ),
        SampledLoop(
            THREE, make_burst_delay(50.0, 450.0, 1.0, 1.5), 9.0, 2.0, (), 100, "digital"
        ),
    ],
)
def test_linear_loop_moves_as_the_run_does(loop: SampledLoop) -> None:
    """The recursion that states the truth gives the angles of the simulated run."""
    delay = loop.find_delay(0, 1)
    period_s = 1e-6 * (delay.period_us or 0)
    log = tn.simulate(loop.write_scenario(2.0 * period_s + 0.1, 0.1))
    ticks = round(period_s * loop.rate_hz)
    first = np.stack([log[name].q[0] for name in loop.names])
    for periods in (1, 2):
        expected = loop.compute_angles(first, periods)
        angles = np.stack([log[name].q[periods * ticks] for name in loop.names])
        np.testing.assert_allclose(angles, expected, atol=1e-9)


# Row 1: a joint that grows slowly beside one that decays fast from a larger distance.

SLOW_JOINT = {
    "two pairs": (
        SampledLoop(
            TWO_PAIRS,
            {
                (0, 1): make_constant_delay(100.0),
                (1, 0): make_constant_delay(100.0),
                (2, 3): make_constant_delay(30.0),
                (3, 2): make_constant_delay(30.0),
            },
            [[25.0, 25.0]] * 2 + [[5.0, 90.0]] * 2,
            [[8.0, 8.0]] * 2 + [[-0.21, 2.944]] * 2,
            (5.0, 1.0),
            100,
        ),
        20.0,
        0.0300,
    ),
    "a pair and three": (
        SampledLoop(
            PAIR_AND_THREE,
            make_constant_delay(40.0),
            [[25.0, 25.0]] * 2 + [[6.0, 60.0]] * 3,
            [[8.0, 8.0]] * 2 + [[-0.519, 1.789]] * 3,
            (6.0, 2.0),
            100,
        ),
        16.0,
        0.0399,
    ),
    "a longer run": (
        SampledLoop(
            TWO_PAIRS,
            make_constant_delay(80.0),
            [[25.0, 25.0]] * 2 + [[12.0, 50.0]] * 2,
            [[8.0, 8.0]] * 2 + [[0.7759, 4.405]] * 2,
            (2.5, 1.5),
            100,
        ),
        24.0,
        0.0221,
    ),
}


def write_hidden_joint(loop: SampledLoop, duration_s: float) -> Scenario:
    """Returns the run of two groups under a user's law; only joint 2 of the second starts apart."""
    starts = {"sites.c.q0_rad": [0.1, 0.1], "sites.d.q0_rad": [0.1, 0.3]}
    if len(loop.names) == 5:
        starts["sites.e.q0_rad"] = [0.1, 0.2]
    law = {"law": "tests.own_laws:JointPD"}
    return allow_own_code(loop.write_scenario(duration_s, law=law, **starts))


@pytest.mark.parametrize(
    "name",
    [
        "two pairs",
        *(pytest.param(name, marks=pytest.mark.long) for name in [*SLOW_JOINT][1:]),
    ],
)
def test_growing_joint_is_found_beside_a_decaying_one(name: str) -> None:
    loop, duration_s, rate_per_s = SLOW_JOINT[name]
    assert loop.compute_rates(1)[0] == pytest.approx(rate_per_s, abs=1e-4)
    log = tn.simulate(write_hidden_joint(loop, duration_s))
    certificate = tn.certify(log, own_laws=True)
    assert certificate.end.stability is Stability.SETTLED
    assert_roots_decide(certificate, rate_per_s)

    # The pushes show the growth too, without the roots.
    assert certificate.twins is not None
    worst = certificate.twins.worst
    assert worst is not None
    assert worst.joint in {f"{site} joint 1" for site in "cde"}
    assert worst.rate_per_s == pytest.approx(rate_per_s, rel=0.15)
    by_pushes = replace(certificate, roots=None).decision
    assert by_pushes.stability in (Stability.NOT_STABLE, Stability.OPEN)
    assert certificate.twins.text in (by_pushes.rests_on, *by_pushes.reasons)

    forbidden = tn.certify(log)
    assert forbidden.stability is Stability.OPEN
    assert "the imported control laws may not run" in forbidden.reasons[0]


def test_two_decaying_joints_are_settled() -> None:
    loop, duration_s, _ = SLOW_JOINT["two pairs"]
    damped = loop._replace(d=[[8.0, 8.0]] * 2 + [[2.0, 2.944]] * 2)
    assert damped.compute_rates(1)[0] == pytest.approx(-0.1511, abs=1e-4)
    certificate = tn.certify(tn.simulate(write_hidden_joint(damped, duration_s)), own_laws=True)
    assert certificate.stability is Stability.SETTLED
    assert certificate.decision.rests_on.startswith(
        "10 pushes over 20 s, all of which died away"
    )


# Row 2: two sinusoidal delays whose common period is much longer than the run.


def two_sines(first_s: float, second_s: float) -> dict[tuple[int, int], Any]:
    """Returns delays of a pair that swing about 200 ms by 195 ms with two periods."""
    return {
        (0, 1): make_sine_delay(200.0, 195.0, first_s),
        (1, 0): make_sine_delay(200.0, 195.0, second_s, np.pi),
    }


def three_sines() -> dict[tuple[int, int], Any]:
    """Returns delays of three sites that swing with periods of 1.2 s and 1.22 s."""
    early = make_sine_delay(200.0, 190.0, 1.2)
    late = make_sine_delay(200.0, 190.0, 1.22, np.pi)
    last = make_sine_delay(200.0, 190.0, 1.22)
    return {
        (0, 1): early,
        (0, 2): early,
        (1, 0): late,
        (1, 2): late,
        (2, 0): early,
        (2, 1): last,
    }


COMMON_PERIODS = [
    Case(SampledLoop(PAIR, two_sines(1.3, 1.31), 9.0, 2.107, (2.9,), 100), 0.00972, 40.0),
    Case(SampledLoop(PAIR, two_sines(0.9, 0.91), 6.0, 0.9867, (), 100), 0.00898, 30.0, 0.01),
    Case(SampledLoop(THREE, three_sines(), 10.0, 0.8836, (2.9,), 100), 0.01063, 30.0),
    Case(SampledLoop(PAIR, two_sines(1.3, 1.31), 9.0, 2.248, (2.9,), 100), -0.01258, 40.0),
    Case(SampledLoop(PAIR, two_sines(0.9, 0.91), 6.0, 1.038, (), 100), -0.01332, 30.0, 0.01),
    Case(SampledLoop(THREE, three_sines(), 10.0, 1.021, (2.9,), 100), -0.01199, 30.0),
]


@pytest.mark.parametrize("case", COMMON_PERIODS)
def test_two_sinusoids_are_judged_over_their_common_period(case: Case) -> None:
    assert case.loop.compute_rates(1)[0] == pytest.approx(case.rate_per_s, abs=1e-5)
    certificate = certify_case(case)
    assert_roots_decide(certificate, case.rate_per_s)
    assert certificate.twins is not None
    assert certificate.twins.hides_period
    assert certificate.roots is not None
    assert (
        f"over the period of {certificate.twins.delay_period_s:.6g} s" in certificate.roots.text
    )


# Row 3: looped traces of delays, of which a run shows little more than one period.

ONE_LATE_LINK = {
    (0, 1): make_burst_delay(60.0, 500.0, 21.0, 24.0),
    (1, 0): make_constant_delay(60.0),
}
LATE_PAIR = make_burst_delay(80.0, 380.0, 11.5, 13.0)
LATE_THREE = make_burst_delay(50.0, 450.0, 14.0, 16.0)
LOOPED_TRACES = [
    Case(SampledLoop(PAIR, LATE_PAIR, 12.0, 1.028, (2.2,), 100), 0.03493, 18.0),
    Case(SampledLoop(THREE, LATE_THREE, 9.0, 0.2637, (), 100), 0.03445, 22.0),
    Case(SampledLoop(PAIR, ONE_LATE_LINK, 8.0, 0.6092, (), 100, "digital"), 0.03559, 33.0),
    Case(SampledLoop(PAIR, ONE_LATE_LINK, 8.0, 0.7565, (), 100, "digital"), -0.03561, 33.0),
]
ENDS_LATE = [
    Case(SampledLoop(PAIR, LATE_PAIR, 12.0, 1.348, (2.2,), 100), -0.03513, 18.0),
    Case(SampledLoop(THREE, LATE_THREE, 9.0, 0.4053, (), 100), -0.03441, 22.0),
]
"""Runs that decay, and that end after the burst of a period with a bounded oscillation."""


@pytest.mark.parametrize("case", LOOPED_TRACES)
def test_looped_trace_is_judged_over_its_period(case: Case) -> None:
    assert case.loop.compute_rates(1)[0] == pytest.approx(case.rate_per_s, abs=1e-5)
    certificate = certify_case(case)
    assert_roots_decide(certificate, case.rate_per_s)
    scenario = case.loop.write_scenario(case.duration_s, case.apart_rad)
    for duration_s in (0.5 * case.duration_s, 3.0 * case.duration_s):
        verdict = tn.linear(scenario, {"duration_s": duration_s}, ports=False).verdict
        assert verdict == ("unstable" if case.rate_per_s > 0.0 else "stable")


@pytest.mark.parametrize(("loop_case", "share"), [(0, 0.5), (1, 0.4), (3, 0.5)])
def test_runs_before_their_first_burst_count_it(loop_case: int, share: float) -> None:
    """All delays of the run are equal; those of the period are not."""
    case = LOOPED_TRACES[loop_case]
    short = case._replace(duration_s=share * case.duration_s)
    assert_roots_decide(certify_case(short), case.rate_per_s)


# Row 4: commands that change nothing.


class CommandedCase(NamedTuple):
    """A run with commands.

    Attributes:
        loop: The loop at the end of the run.
        rate_per_s: True rate of its slowest motion, in 1/s.
        duration_s: Duration of the run, in s.
        apart_rad: Distance of the start poses of two successive sites, in rad.
        law: Keys of the control law beside the gains.
        commands: Times, in s, and commands to site b.
        starts_ms: Delay at the start, in ms. That of the loop if None.
    """

    loop: SampledLoop
    rate_per_s: float
    duration_s: float
    apart_rad: float
    law: Mapping[str, Any]
    commands: tuple[tuple[float, dict[str, Any]], ...]
    starts_ms: float | None = None


def set_delay(delay_ms: float, link: str = "a->b") -> dict[str, Any]:
    """Returns the command that gives a link a constant delay."""
    return {"link": link, "to": {"model": "constant", "delay_ms": delay_ms}}


SATURATED = SampledLoop(PAIR, make_constant_delay(250.0), 16.0, 3.37, (2.0,), 100)
SATURATED_THREE = SampledLoop(THREE, make_constant_delay(200.0), 20.0, 1.718, (2.9,), 100)
PLANAR = SampledLoop(PAIR, make_constant_delay(220.0), 12.0, 2.192, (), 100)
SAME_250 = ((6.0, set_delay(250.0)),)
SAME_THREE = (
    (5.0, set_delay(200.0)),
    (8.0, {"dominance": "b", "to": {"a": 0.5, "c": 0.5}, "ramp_s": 0.0}),
)
SAME_PLANAR = (
    (3.0, set_delay(220.0)),
    (4.0, {"dominance": "b", "to": {"a": 1.0}, "ramp_s": 1.0}),
)
LIMIT = {"law": "saturated_pd", "P": 1.5}
LOW_LIMIT = {"law": "saturated_pd", "P": 1.0}
IDLE_COMMANDS = [
    CommandedCase(SATURATED, 0.02267, 16.0, -4.0, LIMIT, SAME_250),
    CommandedCase(SATURATED_THREE, 0.02513, 14.0, -1.5, LOW_LIMIT, SAME_THREE),
    CommandedCase(PLANAR, 0.02509, 14.0, -0.02, {}, SAME_PLANAR),
    CommandedCase(SATURATED._replace(d=3.626), -0.02976, 16.0, -4.0, LIMIT, SAME_250),
    CommandedCase(
        SATURATED_THREE._replace(d=2.058), -0.02996, 24.0, -1.5, LOW_LIMIT, SAME_THREE
    ),
    CommandedCase(PLANAR._replace(d=2.329), -0.0296, 14.0, -0.02, {}, SAME_PLANAR),
]


@pytest.mark.parametrize("case", IDLE_COMMANDS)
def test_command_without_effect_leaves_the_roots(case: CommandedCase) -> None:
    assert case.loop.compute_rates(1)[0] == pytest.approx(case.rate_per_s, abs=1e-5)
    scenario = case.loop.write_scenario(case.duration_s, case.apart_rad, case.law)
    log = make_log_with_commands(scenario, "b", *case.commands)
    assert len(log.changes("b")) == len(case.commands)
    assert Timeline(log).effective_commands == []
    certificate = tn.certify(log)
    assert_roots_decide(certificate, case.rate_per_s)
    planned = tn.certify(tn.simulate(scenario)).decision
    assert planned.stability is certificate.stability
    assert (planned.rests_on, planned.reasons) == (
        certificate.decision.rests_on,
        certificate.reasons,
    )


def test_effective_commands_decide_by_later_roots() -> None:
    stable = SATURATED._replace(d=3.626)
    later = stable._replace(
        delays={(0, 1): make_constant_delay(250.0), (1, 0): make_constant_delay(300.0)}
    )
    rate_per_s = later.compute_rates(1)[0]
    assert (stable.compute_rates(1)[0], rate_per_s) == pytest.approx(
        (-0.02976, 0.0222), abs=1e-5
    )
    scenario = stable.write_scenario(16.0, -0.02)
    log = make_log_with_commands(scenario, "b", (6.0, set_delay(300.0)))
    assert_roots_decide(tn.certify(log), rate_per_s)


# Row 5: a user's law that may not run.

ONE_SLIDES = [
    (
        UNEQUAL,
        make_sine_delay(180.0, 175.0, 1.6),
        [6.0, 30.0],
        (1.5, 1.4),
        (0.5312, 1.554),
        20.0,
    ),
    (PAIR, make_constant_delay(150.0), [11.0, 20.0], (1.5, 0.8), (1.401, 2.175), 16.0),
    (
        PAIR,
        make_burst_delay(60.0, 420.0, 3.0, 4.0),
        [11.0, 15.0],
        (0.5, 1.5),
        (0.9598, 1.776),
        24.0,
    ),
]
"""Shares, delay, stiffness, masses, damping of joint 1 that lacks and that suffices, duration."""
LACKING_RATES = (0.0499, 0.0400, 0.0498)
ENOUGH_RATES = (-0.1202, -0.1200, -0.1201)


def simulate_own_law(number: int, *, damped: bool, apart_rad: float) -> tuple[SampledLoop, Any]:
    """Returns the loop and the log of a run under a user's law.

    Args:
        number: Index of the run in `ONE_SLIDES`.
        damped: True if the damping of joint 1 suffices.
        apart_rad: Distance of the start poses of two successive sites, in rad.
    """
    shares, delay, K, masses, damping, duration_s = ONE_SLIDES[number]
    sites = len(shares)
    gains = [[damping[damped], 9.0]] * sites
    loop = SampledLoop(shares, delay, [K] * sites, gains, masses, 100)
    law = {"law": "tests.own_laws:JointPD"}
    return loop, tn.simulate(allow_own_code(loop.write_scenario(duration_s, apart_rad, law)))


@pytest.mark.parametrize("number", [0, 1, pytest.param(2, marks=pytest.mark.long)])
def test_own_law_that_grows_is_never_stable(number: int) -> None:
    loop, log = simulate_own_law(number, damped=False, apart_rad=1e-4)
    rate_per_s = LACKING_RATES[number]
    assert loop.compute_rates(1)[0] == pytest.approx(rate_per_s, abs=1e-4)
    forbidden = tn.certify(log)
    assert forbidden.roots is not None
    assert forbidden.roots.verdict == ""
    assert "may not run" in forbidden.roots.text
    assert forbidden.stability in (Stability.NOT_STABLE, Stability.OPEN)
    assert_roots_decide(tn.certify(log, own_laws=True), rate_per_s)


@pytest.mark.parametrize("number", [0, 1, pytest.param(2, marks=pytest.mark.long)])
def test_own_law_that_decays_is_settled_with_permission(number: int) -> None:
    loop, log = simulate_own_law(number, damped=True, apart_rad=0.02)
    assert loop.compute_rates(1)[0] == pytest.approx(ENOUGH_RATES[number], abs=1e-4)
    forbidden = tn.certify(log)
    assert forbidden.stability is Stability.OPEN
    assert "the imported control laws may not run" in forbidden.reasons[0]
    certificate = tn.certify(log, own_laws=True)
    assert certificate.stability is Stability.SETTLED
    assert "all of which died away; its roots are not exact" in certificate.decision.rests_on


# Row 6: beats and bursts in runs that decay.

BEAT = SampledLoop(
    PAIR,
    {(0, 1): make_sine_delay(200.0, 195.0, 1.2), (1, 0): make_sine_delay(200.0, 195.0, 1.26)},
    10.0,
    2.33,
    (2.5,),
    100,
)
LONG_BEAT = SampledLoop(
    PAIR,
    {(0, 1): make_sine_delay(200.0, 195.0, 4.9), (1, 0): make_sine_delay(200.0, 150.0, 1.21)},
    10.0,
    1.942,
    (2.9,),
    100,
)
DECAYING_BEATS = [
    *ENDS_LATE,
    Case(BEAT, -0.02003, 32.0, -0.5),
    pytest.param(Case(LONG_BEAT, -0.01489, 60.0, -0.5), marks=pytest.mark.long),
]


@pytest.mark.parametrize("case", DECAYING_BEATS)
def test_decaying_beat_is_stable_however_its_record_ends(case: Case) -> None:
    assert case.loop.compute_rates(1)[0] == pytest.approx(case.rate_per_s, abs=1e-5)
    certificate = certify_case(case)
    assert certificate.end.stability is Stability.NOT_STABLE
    assert_roots_decide(certificate, case.rate_per_s)


def test_growing_beat_is_not_stable() -> None:
    loop = BEAT._replace(d=2.0)
    rate_per_s = loop.compute_rates(1)[0]
    assert rate_per_s > 0.01
    assert_roots_decide(certify_case(Case(loop, rate_per_s, 32.0)), rate_per_s)


LOSSY = SampledLoop(THREE, make_constant_delay(150.0), 10.0, 1.4, (2.9,), 100)


def write_lossy(loop: SampledLoop, duration_s: float, seed: int) -> Scenario:
    """Returns a run that loses a fifth of all samples in bursts of 0.6 s, in which arms hold.

    Args:
        loop: The loop, with the delays of samples that are not lost.
        duration_s: Duration of the run, in s.
        seed: Seed of the losses.
    """
    losses = {"loss": 0.2, "loss_burst": 60.0}
    links = {}
    for i, j in loop.list_links():
        name = f"links.{loop.names[j]}->{loop.names[i]}"
        links[name] = {**loop.find_delay(i, j).table(), **losses}
    stale = {"action": "hold", "age_ms": 350.0, "return_s": 0.5}
    return loop.write_scenario(duration_s, -0.3, on_stale=stale, seed=seed, **links)


def lasts(scenario: Scenario) -> bool:
    """Returns True if a run moves in its last eighth as it did in its second eighth.

    Args:
        scenario: The run, which has the length that shows the truth.
    """
    run = run_fused(scenario)
    if run.diverged_s is not None:
        return True
    joints = run.buckets[0].shape[1] // 3
    speeds = np.max([part[:, joints : 2 * joints].max(axis=1) for part in run.buckets], axis=0)
    eighths = np.array_split(speeds, LONGER)
    return bool(eighths[-1].max() > 0.1 * eighths[1].max())


@pytest.mark.parametrize(
    "seed", [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (5, 11, 18))]
)
def test_last_burst_of_loss_does_not_decide(seed: int) -> None:
    """The arms hold in a burst, and swing after it; the pushes grow at no more than one joint."""
    assert not lasts(write_lossy(LOSSY, LONGER * 30.0, seed))
    certificate = tn.certify(tn.simulate(write_lossy(LOSSY, 30.0, seed)))
    assert certificate.end.stability is Stability.NOT_STABLE
    assert certificate.stability is Stability.OPEN
    assert "has 5 bursts of lost samples, too few" in certificate.reasons[0]


def test_growth_over_bursts_of_loss_is_not_stable() -> None:
    loop = LOSSY._replace(d=0.6)
    assert lasts(write_lossy(loop, LONGER * 30.0, 1))
    certificate = tn.certify(tn.simulate(write_lossy(loop, 30.0, 1)))
    assert certificate.stability is Stability.NOT_STABLE
    assert certificate.decision.rests_on.startswith("twins: ")


# Row 7: motions that decay so slowly that the run shows no decay.

SLOW_MOTIONS = [
    Case(SampledLoop(THREE, make_constant_delay(160.0), 12.0, 0.8953, (), 100), -0.00120, 40.0),
    Case(
        SampledLoop(PAIR, make_constant_delay(240.0), 9.0, 1.946, (), 100, "digital"),
        -0.00084,
        30.0,
    ),
    Case(
        SampledLoop(PAIR, make_constant_delay(130.0), 15.0, 1.866, (1.7,), 200), -0.00142, 40.0
    ),
]
SLOW_GROWTH = [
    Case(
        SampledLoop(THREE, make_constant_delay(160.0), 12.0, 0.8899, (), 100),
        0.00132,
        40.0,
        0.005,
    ),
    Case(
        SampledLoop(PAIR, make_constant_delay(240.0), 9.0, 1.941, (), 100, "digital"),
        0.00119,
        30.0,
    ),
    Case(
        SampledLoop(PAIR, make_constant_delay(130.0), 15.0, 1.854, (1.7,), 200), 0.00188, 40.0
    ),
]


@pytest.mark.parametrize("case", [*SLOW_MOTIONS, *SLOW_GROWTH])
def test_roots_judge_motion_near_the_edge(case: Case) -> None:
    assert case.loop.compute_rates(1)[0] == pytest.approx(case.rate_per_s, abs=1e-5)
    certificate = certify_case(case)
    assert certificate.end.stability is Stability.NOT_STABLE
    assert "bounded oscillation" in certificate.end.text
    assert_roots_decide(certificate, case.rate_per_s)
