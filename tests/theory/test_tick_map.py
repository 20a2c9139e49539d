"""The sampled loop against runs tick by tick, and against the continuous loop in the limit."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.execution.builders import make_trajectories
from tests.theory.loops import Array
from tests.theory.tick_recursion import build_recursion
from trilat_net.analysis.theory import find_equilibrium
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.floquet import SampledLoop, discretise_zero_order_hold
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.scenario import Scenario, load_scenario

POSE = (-0.1729, 0.0874)


def compute_spectra(scenario: Scenario, wanted: int = 4) -> tuple[Spectrum, Spectrum]:
    """Returns the continuous and the sampled spectrum, about one pose."""
    now = OperatingConditions.derive(scenario)
    rest = find_equilibrium(scenario, POSE)
    continuous = Spectrum.of_loop(LinearLoop.of_conditions(now, rest), wanted)
    spectrum = SampledLoop(now).compute_spectrum(rest, wanted)
    return continuous, spectrum


HANDS = [
    {
        "kind": "spring",
        "stiffness_nm_rad": 20.0,
        "damping_nm_s_rad": 2.0,
    },
    {
        "kind": "spring",
        "stiffness_nm_rad": 9.0,
        "damping_nm_s_rad": 1.0,
        "sampled": True,
    },
]
LAWS = {
    "adaptive": {"law": "adaptive", "theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]},
    "pd_d": {"law": "pd_d", "K": 10.0, "Kd": 2.0, "d": 1.0},
    "p_f": {"law": "p_f", "K": 12.0, "d": 3.0, "k_f": 0.3},
    "sync": {"law": "sync", "K": 3.0, "theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]},
    "saturated_pd": {"law": "saturated_pd"},
    "smith": {"law": "smith"},
    "lee_spong": {"law": "lee_spong"},
    "four_channel": {"law": "four_channel"},
}
REFLECTS_FORCE = ("p_f", "four_channel")
RESTS_AT_ZERO = ("sync",)
"""Laws under which arms without a hand that holds them rest at q = 0."""


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("scheme", ["second_order", "digital"])
@pytest.mark.parametrize("delay_ms", [0.0, 30.0])
def test_small_deviations_follow_runs_tick_by_tick(
    law: str, scheme: str, delay_ms: float
) -> None:
    """The companion matrix advances the deviation; the run begins there, its peers' histories
    at their start poses.
    """
    small = 1e-6
    pose = (0.0, 0.0) if law in RESTS_AT_ZERO else POSE
    hands = [{**hand, "from_rad": list(pose)} for hand in HANDS]
    off = small * np.array([[1.0, -0.5], [-0.7, 0.3]])
    scenario = load_scenario(
        "two_sites",
        {
            "rate_hz": 100,
            "duration_s": 1.0,
            "scheme": scheme,
            "control": LAWS[law],
            "link.delay_ms": delay_ms,
            # before the first sample a peer feels nothing: a spring off its rest would be felt
            "sites.m.hands": [{**hand, "stiffness_nm_rad": 0.0} for hand in hands]
            if law in REFLECTS_FORCE
            else hands,
            "sites.m.q0_rad": (pose + off[0]).tolist(),
            "sites.s.q0_rad": (pose + off[1]).tolist(),
        },
    )
    now = OperatingConditions.derive(scenario)
    rest = find_equilibrium(scenario, pose)
    assert rest.residual < 1e-10
    whole, names, late, _ = build_recursion(now, rest)
    start = {
        f"{site}.q{j + 1}": off[i, j]
        for (i, site), j in itertools.product(enumerate("ms"), range(2))
    }
    X = start_state(
        whole,
        late,
        names,
        np.array([start.get(name, 0.0) for name in names]),
        uses_trapezoid=law == "sync" or scheme == "second_order",
    )
    run = make_trajectories(scenario)
    q = np.array([run.sites[site].q[:, j] for site in "ms" for j in range(2)]).T - np.tile(
        pose, 2
    )
    places = [names.index(f"{site}.q{j + 1}") for site in "ms" for j in range(2)]
    for k in range(1, 60):
        X = whole @ X
        size = np.abs(q[: k + 1]).max()
        if size > 100.0 * small:
            break  # an unstable loop: its motion is no longer small
        assert np.abs(X[places] - q[k]).max() <= 4e-4 * size, k


def start_state(
    whole: Array,
    late: NDArray[np.intp],
    names: Sequence[str],
    start: Array,
    *,
    uses_trapezoid: bool,
) -> Array:
    """Returns the state at tick 0: the past as the start, tau_-1 = tau_0, and theta_0 = theta_hat0."""
    X = np.concatenate(
        [start, np.tile(start[late], (len(whole) - len(names)) // max(1, len(late)))]
    )
    thetas = [index for index, name in enumerate(names) if ".theta" in name]
    taus = [index for index, name in enumerate(names) if ".tau" in name]
    if uses_trapezoid:  # theta_0 = eta_0 + h/2 f_0, and a tick adds h f to eta
        X[thetas] -= 0.5 * ((whole @ X)[thetas] - X[thetas])
    if taus:
        X[taus] = (whole @ X)[taus]
    return X


@pytest.mark.parametrize(("scheme", "order"), [("second_order", 2), ("digital", 1)])
@pytest.mark.parametrize("delay_ms", [0.0, 100.0])
def test_sampled_loops_converge_with_their_schemes_order(
    scheme: str, order: int, delay_ms: float
) -> None:
    """Both loops have the same delay in use, and the rightmost root is compared at rates that halve the period."""
    distances = []
    for rate_hz in (100, 200, 400):
        scenario = load_scenario(
            "paper", {"scheme": scheme, "link.delay_ms": delay_ms, "rate_hz": rate_hz}
        )
        continuous, computed = compute_spectra(scenario, 2)
        distances.append(abs(continuous.roots[0].s - computed.roots[0].s))
    for coarse, fine in itertools.pairwise(distances):
        assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize(
    ("rate_hz", "stable"), [(80, False), (100, False), (125, True), (200, True)]
)
def test_a_digital_controller_without_delay_needs_its_rate(rate_hz: int, stable: bool) -> None:
    """About Gamma g^2 h > Kp it oscillates by itself; the extrapolated torque does not."""
    changes = {"link.delay_ms": 0.0, "rate_hz": rate_hz}
    _, digital = compute_spectra(load_scenario("paper", {"scheme": "digital", **changes}))
    assert (digital.verdict == "stable") == stable
    _, second = compute_spectra(load_scenario("paper", changes))
    assert second.verdict == "stable"


def test_a_growing_swing_matches_a_run() -> None:
    """P+d just below its edge at 50 Hz: the run's swing grows at the sampled root."""
    scenario = load_scenario(
        "p_d_margin_two",
        {
            "scheme": "digital",
            "rate_hz": 50,
            "control.d": 1.5,
            "duration_s": 20.0,
            "sites.m.q0_rad": [0.301, 0.0],
            "sites.s.q0_rad": [0.3, 0.0],
        },
    )
    now = OperatingConditions.derive(scenario)
    rest = find_equilibrium(scenario, (0.3005, 0.0))
    spectrum = SampledLoop(now).compute_spectrum(rest, 2)
    root = spectrum.roots[0].s
    run = make_trajectories(scenario).sites["m"]
    late = run.t_s > 8.0
    distance = np.abs(run.q - run.q_des)[late, 0]
    half = round(np.pi / root.imag * 50)
    peaks = [distance[k : k + half].max() for k in range(0, len(distance) - half, half)]
    slope, _ = np.polyfit(np.arange(len(peaks)) * half / 50, np.log(peaks), 1)
    assert slope == pytest.approx(root.real, rel=0.03)


def test_held_pushes_move_masses_exactly() -> None:
    Phi, Gamma = discretise_zero_order_hold(
        np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [2.0]]), 0.1
    )
    assert Phi == pytest.approx(np.array([[1.0, 0.1], [0.0, 1.0]]), abs=1e-15)
    assert Gamma == pytest.approx(np.array([[0.01], [0.2]]), abs=1e-15)
