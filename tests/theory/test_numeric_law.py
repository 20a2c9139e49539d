"""Users' own laws, linearised by differences: their roots are those of the built-in laws that
they repeat.
"""

from typing import Any

import numpy as np
import pytest

import trilat_net as tn
from tests.laws import Adaptive
from tests.own_laws import PD, Backward, CompiledPD, Forces, PeerPD, Remembering
from tests.plugged_laws import Line
from tests.unit_arm import CLAMP
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.equilibrium import find_equilibrium, follow_equilibrium
from trilat_net.analysis.theory.floquet import SampledLoop
from trilat_net.analysis.theory.linear_analysis import LinearAnalysis
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.core.step.vectors import Array
from trilat_net.errors import ScenarioError

POSE = (0.3, 0.2)


def analyse_law(law: Any, name: str = "p_d_margin", **more: Any) -> LinearAnalysis:
    return tn.linear(
        name, {"control": {"law": law, **more.pop("gains", {})}, **more}, pose=POSE, ports=False
    )


def list_roots(spectrum: Spectrum) -> Array:
    return np.array([root.s for root in spectrum.roots])


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
@pytest.mark.parametrize("law", [PD, PeerPD])
def test_own_p_d_has_p_d_roots(law: type, scheme: str) -> None:
    ours = analyse_law("p_d", scheme=scheme)
    theirs = analyse_law(law, scheme=scheme)
    assert ours.sampled is not None
    assert theirs.sampled is not None
    assert np.allclose(
        list_roots(theirs.sampled), list_roots(ours.sampled), rtol=0.0, atol=1e-8
    )
    assert np.allclose(
        list_roots(theirs.continuous), list_roots(ours.continuous), rtol=0.0, atol=1e-8
    )
    assert theirs.margin.intervals[0].high_s == pytest.approx(
        ours.margin.intervals[0].high_s, rel=1e-8
    )
    assert (
        f"tests.own_laws:{law.__name__} of m1, m2, s is differentiated numerically"
        in theirs.notes[0]
    )


def test_forces_are_those_of_the_four_channel_law() -> None:
    """The forces are those of the peers, as a sum and separately, and that of the own arm, with an operator at a master."""
    hand = [{**CLAMP, "to_rad": list(POSE), "stiffness_nm_rad": 40.0, "damping_nm_s_rad": 5.0}]
    held: dict[str, Any] = {"sites.m1.hands": hand, "link.delay_ms": 30.0}
    ours = analyse_law("four_channel", gains={"K": 100.0, "B": 20.0, "force_own": 0.5}, **held)
    for alone in (False, True):
        theirs = analyse_law(Forces, gains={"alone": alone}, **held)
        assert np.allclose(
            list_roots(theirs.continuous), list_roots(ours.continuous), rtol=1e-7, atol=1e-7
        )


def test_the_last_tick_is_memory() -> None:
    analysis = analyse_law(Backward)
    remembered = analyse_law(Remembering)
    assert analysis.sampled is not None
    assert remembered.sampled is not None
    assert np.allclose(
        list_roots(analysis.sampled), list_roots(remembered.sampled), rtol=0.0, atol=1e-6
    )
    late = list_roots(analysis.sampled)[0]
    exact = list_roots(analyse_law("p_d").decisive)[0]
    assert 1e-4 < abs(late - exact) < 1e-2, "half a tick of delay in the damping"


@pytest.mark.parametrize("scheme", ["second_order", "digital"])
def test_memory_is_linearised_as_it_is_sampled(scheme: str) -> None:
    """The adaptive law that users write keeps Y'r and the estimates, by the trapezoid rule."""
    more = {"scheme": scheme, "link.delay_ms": 0.0}
    ours, theirs = (
        tn.load_scenario("free", {**more, "control.law": law}) for law in ("adaptive", Adaptive)
    )
    rest = find_equilibrium(ours, POSE)
    memory = np.hstack([np.zeros_like(rest.theta_hat), rest.theta_hat])
    same = follow_equilibrium(theirs, rest._replace(theta_hat=memory))
    roots_of_memory = list_roots(
        SampledLoop(OperatingConditions.derive(theirs)).compute_spectrum(same)
    )
    known = list_roots(SampledLoop(OperatingConditions.derive(ours)).compute_spectrum(rest))
    same_bits = scheme == "second_order"
    assert np.allclose(
        roots_of_memory[:3], known[:3], rtol=0.0, atol=1e-6 if same_bits else 2e-2
    )


def test_unlinearised_features_are_refused() -> None:
    with pytest.raises(ScenarioError, match="sends vectors that the law defines"):
        analyse_law(Line)


def test_a_certificate_runs_no_code_from_outside() -> None:
    log = tn.simulate("two_sites", {"control.law": PD}, duration_s=0.1)
    loop_roots = tn.certify(log).roots
    assert loop_roots is not None
    assert "known by its code only" in loop_roots.text


@pytest.mark.long
def test_a_run_decays_at_its_roots() -> None:
    """The run goes from the poses of its sites to rest, and its edge lies at that of p_d."""
    analysis = tn.linear(
        "p_d_margin",
        {"control.law": CompiledPD, "control.d": 1.5},
        over=["control.d=0.3:3"],
        ports=True,
    )
    built_in = tn.linear("p_d_margin", {"control.d": 1.5}, over=["control.d=0.3:3"], ports=True)
    assert analysis.scans[0].edges[0].value == pytest.approx(
        built_in.scans[0].edges[0].value, rel=1e-5
    )
    assert np.allclose(analysis.rest.q, built_in.rest.q, atol=1e-5)
    assert analysis.ports is not None
    assert analysis.ports.verdict == "stable"
