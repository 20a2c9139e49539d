"""The basis of the words stable, settled, not stable and open (docs/reference/stability.md)."""

import math

import pytest

from trilat_net.analysis.certificate.verdict_facts import UnsuppliedGrowth
from trilat_net.analysis.run_end import EndBehaviour, EndDoubt, RunEnd, Stability
from trilat_net.analysis.stability_decision import LoopRoots, RunFindings, StabilityDecision
from trilat_net.analysis.twins.envelope_trend import EnvelopeFit, EnvelopeTrend
from trilat_net.analysis.twins.twin_growth import PushGrowth, RestDeparture, TwinGrowth
from trilat_net.analysis.twins.twin_runs import Push
from trilat_net.presentation.verdict_text import THEOREM
from trilat_net.scenario import load_scenario

PUSHES = Push.choose(load_scenario("two_sites"))
STABLE_ROOTS = LoopRoots("stable", -0.163, True)
UNSTABLE_ROOTS = LoopRoots("unstable", 0.0424, True)
NO_ROOTS = LoopRoots("", None, False, reason="its code may not run")


def make_run_end(behaviour: EndBehaviour = EndBehaviour.CONVERGED, **more: object) -> RunEnd:
    trend = EnvelopeTrend.STEADY
    if behaviour in (EndBehaviour.CONVERGED, EndBehaviour.DECAYS):
        trend = EnvelopeTrend.DECAYS
    if behaviour is EndBehaviour.GROWS:
        trend = EnvelopeTrend.GROWS
    fit = EnvelopeFit(trend, -0.1, True)
    whole = RunEnd(behaviour, fit, fit, end_error_rad=1e-4, end_speed_rad_s=0.5)
    return whole._replace(**more)


def make_twin_growth(
    trend: EnvelopeTrend = EnvelopeTrend.DECAYS, rate_per_s: float = -0.2, **more: object
) -> TwinGrowth:
    factor = math.exp(10.0 * rate_per_s)
    pushes = tuple(
        PushGrowth(push, trend, rate_per_s, factor, "m joint 1", 0, 1e-7) for push in PUSHES
    )
    return TwinGrowth("", from_s=10.0, to_s=20.0, pushes=pushes)._replace(**more)


GROWING = make_twin_growth(EnvelopeTrend.GROWS, 0.2)


def decide(**findings: object) -> StabilityDecision:
    return RunFindings(**{"end": make_run_end(), **findings}).decide()  # type: ignore[arg-type]


def test_stable_needs_a_proof() -> None:
    assert decide().stability is Stability.OPEN
    assert decide(twins=make_twin_growth()).stability is Stability.SETTLED
    assert decide(twins=make_twin_growth(), roots=NO_ROOTS).stability is Stability.SETTLED
    assert decide(twins=make_twin_growth(), roots=STABLE_ROOTS).stability is Stability.STABLE
    assert decide(twins=make_twin_growth(), is_covered=True).stability is Stability.STABLE
    assert decide(is_covered=True).stability is Stability.STABLE


def test_the_decision_names_its_basis() -> None:
    assert decide(roots=STABLE_ROOTS).rests_on == "exact roots, slowest -0.163 /s"
    both = decide(roots=STABLE_ROOTS, is_covered=True)
    assert both.rests_on == f"{THEOREM}; exact roots, slowest -0.163 /s"
    settled = decide(twins=make_twin_growth(), roots=NO_ROOTS)
    expected = f"{len(PUSHES)} pushes over 20 s, all of which died away; {NO_ROOTS.text}"
    assert settled.rests_on == expected
    moving = make_run_end(EndBehaviour.UNDECIDED)
    assert decide(end=moving, twins=GROWING).rests_on == GROWING.text


@pytest.mark.parametrize(
    "roots", [STABLE_ROOTS._replace(exact=False), STABLE_ROOTS._replace(verdict="at the edge")]
)
def test_inexact_or_unstable_roots_prove_nothing(roots: LoopRoots) -> None:
    assert decide(twins=make_twin_growth(), roots=roots).stability is Stability.SETTLED


@pytest.mark.parametrize(
    "behaviour", [b for b in EndBehaviour if b is not EndBehaviour.DIVERGED]
)
def test_exact_roots_exclude_the_opposite_word(behaviour: EndBehaviour) -> None:
    """This holds for any end and any twins of a run within its limits."""
    for twins in (
        None,
        make_twin_growth(),
        GROWING,
        make_twin_growth(EnvelopeTrend.STEADY, 0.0),
    ):
        stable = decide(end=make_run_end(behaviour), twins=twins, roots=STABLE_ROOTS)
        assert stable.stability is not Stability.NOT_STABLE
        unstable = decide(end=make_run_end(behaviour), twins=twins, roots=UNSTABLE_ROOTS)
        assert unstable.stability is Stability.NOT_STABLE
        assert unstable.rests_on == "exact roots, fastest growing +0.0424 /s"


def test_unstable_roots_of_distant_rest_raise_doubt() -> None:
    """The run may come to rest in another pose, whose roots may be stable."""
    distant = UNSTABLE_ROOTS._replace(distance_rad=0.3)
    decision = decide(twins=make_twin_growth(), roots=distant)
    assert decision.stability is Stability.OPEN
    assert decision.reasons == (distant.text,)
    assert decide(twins=make_twin_growth(delay_period_s=145.2), roots=distant).stability is (
        Stability.NOT_STABLE
    )


def test_a_diverged_run_is_never_stable() -> None:
    diverged = make_run_end(EndBehaviour.DIVERGED, diverged_at_s=3.0)
    decision = decide(
        end=diverged, twins=make_twin_growth(), roots=STABLE_ROOTS, is_covered=True
    )
    assert decision.stability is Stability.NOT_STABLE


@pytest.mark.parametrize(
    "behaviour", [EndBehaviour.BOUNDED, EndBehaviour.DRIFTS, EndBehaviour.GROWS]
)
def test_unstable_ends_stand_unless_pushes_contradict(
    behaviour: EndBehaviour,
) -> None:
    bad = make_run_end(behaviour)
    assert decide(end=bad).stability is Stability.NOT_STABLE
    assert decide(end=bad, twins=make_twin_growth()).stability is Stability.OPEN
    assert decide(end=bad, twins=GROWING).stability is Stability.NOT_STABLE
    beat = make_twin_growth(EnvelopeTrend.STEADY, 0.0, delay_period_s=592.9)
    assert decide(end=bad, twins=beat).stability is Stability.OPEN


def test_few_loss_bursts_need_growing_pushes() -> None:
    bad = make_run_end(EndBehaviour.BOUNDED)
    steady = make_twin_growth(EnvelopeTrend.STEADY, 0.01, burst_interval_s=3.0)
    decision = decide(end=bad, twins=steady)
    assert decision.stability is Stability.OPEN
    assert "has 3.3 bursts of lost samples" in decision.reasons[0]
    frequent = steady._replace(burst_interval_s=0.05)
    assert decide(end=bad, twins=frequent).stability is Stability.NOT_STABLE
    growing = GROWING._replace(burst_interval_s=3.0)
    assert decide(end=bad, twins=growing).stability is Stability.NOT_STABLE


def test_an_acting_operator_leaves_a_run_open() -> None:
    acting = make_run_end(operator_acts=True, doubts=(EndDoubt("operator acts", until_s=9.0),))
    for roots in (None, STABLE_ROOTS, UNSTABLE_ROOTS):
        assert decide(end=acting, twins=GROWING, roots=roots).stability is Stability.OPEN


def test_slow_runs_agree_with_confirmed_slow_roots() -> None:
    """P+d at 190 ms and d = 0.93: -0.00134 /s, for which 40 s show a factor of 0.97."""
    slow_root = STABLE_ROOTS._replace(rate_per_s=-0.00134)
    swinging = make_run_end(EndBehaviour.BOUNDED)
    confirming = make_twin_growth(EnvelopeTrend.STEADY, -0.00131)
    assert decide(end=swinging, twins=confirming, roots=slow_root).stability is Stability.STABLE
    flat = make_twin_growth(EnvelopeTrend.STEADY, 1e-5)
    open_run = decide(end=swinging, twins=flat, roots=slow_root)
    assert open_run.stability is Stability.OPEN
    assert "a run of 4.14e+03 s would" in open_run.reasons[0]


def test_departure_from_rest_needs_proof_for_stable() -> None:
    leaving = make_twin_growth(departure=RestDeparture(1.0, 9.0, 0.3, "m joint 1"))
    assert decide(twins=leaving).stability is Stability.NOT_STABLE
    assert decide(twins=leaving, roots=STABLE_ROOTS).stability is not Stability.NOT_STABLE


def test_doubts_and_hidden_periods_leave_a_run_open() -> None:
    doubt = UnsuppliedGrowth(2.0, from_s=3.0)
    decision = decide(twins=make_twin_growth(), roots=STABLE_ROOTS, doubts=[doubt])
    assert decision.stability is Stability.OPEN
    assert decision.reasons == (doubt.text,)
    hidden = make_twin_growth(delay_period_s=145.2)
    open_run = decide(twins=hidden)
    assert open_run.stability is Stability.OPEN
    assert "the delays repeat after 145.2 s" in open_run.reasons[0]
    assert decide(twins=hidden, roots=STABLE_ROOTS).stability is Stability.STABLE


def test_twins_may_exclude_inexact_unstable_roots() -> None:
    """Pushes that decay over 10 s exclude growth by a hundredfold: 0.46 /s."""
    slow = UNSTABLE_ROOTS._replace(exact=False)
    assert decide(twins=make_twin_growth(), roots=slow).stability is Stability.OPEN
    fast = slow._replace(rate_per_s=0.5)
    assert decide(twins=make_twin_growth(), roots=fast).stability is Stability.SETTLED


def test_missing_twins_are_explained() -> None:
    no_twins = TwinGrowth("its law may not run")
    decision = decide(twins=no_twins)
    assert decision.stability is Stability.OPEN
    assert "its law may not run" in decision.reasons[0]


@pytest.mark.parametrize("behaviour", [EndBehaviour.BOUNDED, EndBehaviour.DRIFTS])
@pytest.mark.parametrize("pushes", [None, make_twin_growth(EnvelopeTrend.STEADY, 0.0)])
def test_a_slow_numerical_decay_stays_open(
    behaviour: EndBehaviour, pushes: TwinGrowth | None
) -> None:
    """The word depends on whether the roots would halve the motion in the judged part."""
    judged_s = 20.0
    steady = EnvelopeFit(EnvelopeTrend.STEADY, 0.0, False)
    lasting = make_run_end(behaviour, error=steady, speed=steady, lasts_s=2.0 * judged_s)
    for share in (0.01, 0.5, 0.99, 1.01, 3.0, 100.0):
        rate_per_s = -share * math.log(2.0) / judged_s
        roots = LoopRoots(
            "stable", rate_per_s, False, is_numerical=True, swing_rate_per_s=rate_per_s
        )
        slow = decide(end=lasting, twins=pushes, roots=roots)
        assert slow.stability is (Stability.OPEN if share <= 1.0 else Stability.NOT_STABLE)
        assert ("too slow to be distinguished from" in "".join(slow.reasons)) == (share <= 1.0)
        agreeing = EnvelopeFit(EnvelopeTrend.HARDLY, 1.2 * rate_per_s, True)
        decaying = lasting._replace(error=agreeing, speed=agreeing)
        assert decide(end=decaying, twins=pushes, roots=roots).stability is Stability.OPEN


@pytest.mark.parametrize(
    "changes",
    [
        {"is_numerical": False},
        {"verdict": "at the edge"},
        {"swing_rate_per_s": None},
        {"swing_rate_per_s": -3.0},
    ],
)
def test_only_slow_numerical_swings_excuse_oscillations(changes: dict[str, object]) -> None:
    """A slow root that does not oscillate explains no oscillation."""
    roots = LoopRoots("stable", -0.001, False, is_numerical=True, swing_rate_per_s=-0.001)
    lasting = make_run_end(EndBehaviour.BOUNDED, lasts_s=40.0)
    assert decide(end=lasting, roots=roots).stability is Stability.OPEN
    changed = roots._replace(**changes)  # type: ignore[arg-type]
    assert decide(end=lasting, roots=changed).stability is Stability.NOT_STABLE


def test_growing_motion_is_not_excused_by_roots() -> None:
    roots = LoopRoots("stable", -0.001, False, is_numerical=True, swing_rate_per_s=-0.001)
    growing = EnvelopeFit(EnvelopeTrend.GROWS, 0.01, False)
    for run_end in (
        make_run_end(EndBehaviour.GROWS, lasts_s=40.0),
        make_run_end(EndBehaviour.BOUNDED, lasts_s=40.0, error=growing),
        make_run_end(EndBehaviour.BOUNDED, lasts_s=40.0, speed=growing),
    ):
        assert decide(end=run_end, roots=roots).stability is Stability.NOT_STABLE
    lasting = make_run_end(EndBehaviour.BOUNDED, lasts_s=40.0)
    assert decide(end=lasting, roots=roots, twins=GROWING).stability is Stability.NOT_STABLE
