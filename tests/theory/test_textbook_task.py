"""Task space in plain NumPy: rotations against SciPy, sites and their derivatives against compiled ticks."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.core.chain_references import ARMS
from tests.scenario.builders import planar_task_text, posed_task_text
from trilat_net.analysis.theory.site_dynamics import (
    COMPLEX_STEP,
    ArgumentLayout,
    SiteRates,
    place_arm,
)
from trilat_net.analysis.theory.textbook_arm import (
    PlacedChain,
    evaluate_reference,
    rotation_from_vector,
    vector_from_rotation,
)
from trilat_net.core.step.kernel import site_tick
from trilat_net.core.step.site_arrays import SiteArrays, TickBuffers
from trilat_net.core.step.site_setup import SiteSetup
from trilat_net.core.step.vectors import Array
from trilat_net.scenario import parse_scenario

angles = st.one_of(
    st.floats(0.0, np.pi), st.floats(0.0, 1e-3), st.floats(np.pi - 1e-3, np.pi - 1e-9)
)


@given(direction=st.tuples(*[st.floats(-1.0, 1.0)] * 3), angle=angles)
def test_rotations_and_their_derivatives_are_those_of_scipy(
    direction: tuple[float, float, float], angle: float
) -> None:
    size = np.linalg.norm(direction)
    vector = angle * (np.array(direction) / size if size > 1e-3 else np.array([0.0, 0.6, 0.8]))
    R = rotation_from_vector(vector)
    assert np.abs(R - Rotation.from_rotvec(vector).as_matrix()).max() <= 1e-15
    assert np.abs(vector_from_rotation(R) - vector).max() <= 1e-8
    stepped = rotation_from_vector(vector[:, np.newaxis] + 1j * COMPLEX_STEP * np.eye(3))
    assert np.abs(vector_from_rotation(stepped).imag / COMPLEX_STEP - np.eye(3)).max() <= 1e-6


LAWS: dict[str, dict[str, Any]] = {
    "adaptive": {"law": "adaptive", "Lambda": 1.5, "Kp": 8.0, "Kd": 5.0, "Gamma": 0.7},
    "pd_d": {"law": "pd_d", "K": 40.0, "Kd": 6.0, "d": 3.0},
}
SITES = [
    ("planar", "m", "adaptive"),
    ("planar", "s", "p_f"),
    *(
        pytest.param("posed", site, law, marks=pytest.mark.long)
        for site in ("m1", "s")
        for law in LAWS
    ),
]


def make_task_setup(text: str, site: str, law: str, **overrides: Any) -> SiteSetup:
    """Returns a site whose torques have no limit, under a plain digital scheme."""
    control = LAWS.get(law, {"law": "p_f", "K": 30.0, "d": 4.0, "k_f": 0.4})
    given_changes = {"control": control, "scheme": "digital", **overrides}
    written = planar_task_text() if text == "planar" else posed_task_text()
    scenario = parse_scenario(written, text, given_changes, ARMS)
    return scenario.setup(site)._replace(tau_limit_nm=(1e9,), qd_limit_rad_s=(1e9,))


def draw_state(site: SiteSetup, seed: int, distance: float) -> tuple[Array, list[Array]]:
    """Draws the state of a site, and of each peer its pose, velocity and torque, with poses
    about `apart` away.
    """
    rng = np.random.default_rng(seed)
    at = ArgumentLayout.of_site(site)
    state = np.zeros(at.states)
    state[at.q] = np.array(site.q0) + rng.normal(0.0, 0.1, at.joints)
    state[at.qd] = rng.normal(0.0, 0.3, at.joints)
    state[at.estimate] = rng.normal(0.0, 1.0, at.parameters)
    own_rates = SiteRates.evaluate(
        site, np.concatenate([state, np.zeros(at.arguments - at.states)])
    ).x
    peers = []
    for _ in site.links:
        pose = own_rates + np.concatenate(
            [rng.normal(0.0, distance, 3), np.zeros(len(own_rates) - 3)]
        )
        if len(own_rates) > 3:
            turned = Rotation.from_rotvec(rng.normal(0.0, distance, 3)) * Rotation.from_rotvec(
                own_rates[3:]
            )
            pose[3:] = turned.as_rotvec()
        peers.append(
            np.concatenate(
                [
                    pose,
                    rng.normal(0.0, 0.2, len(own_rates)),
                    rng.normal(0.0, 2.0, len(own_rates)),
                ]
            )
        )
    return state, peers


def by_theory(site: SiteSetup, state: Array, peers: list[Array]) -> SiteRates:
    at = ArgumentLayout.of_site(site)
    alpha = np.array([0.0, *(link.alpha for link in site.links)])
    m = at.coordinates
    x = np.concatenate([state, np.zeros(at.arguments - at.states)])
    derivative = SiteRates.evaluate(site, x).x
    x[at.q_des] = evaluate_reference(
        alpha, derivative, [derivative, *(peer[:m] for peer in peers)]
    )
    x[at.qd_des] = sum(a * peer[m : 2 * m] for a, peer in zip(alpha[1:], peers, strict=True))
    x[at.peer_torque] = sum(
        -a * peer[2 * m :] for a, peer in zip(alpha[1:], peers, strict=True)
    )
    return SiteRates.evaluate(site, x)


def by_tick(site: SiteSetup, state: Array, peers: list[Array]) -> dict[str, Array]:
    """Returns torque, estimates and accelerations of one compiled tick, the accelerations as h
    goes to 0.
    """
    at = ArgumentLayout.of_site(site)
    accelerations = []
    records = []
    for rate_hz in (10_000, 20_000):
        faster_site = site._replace(rate_hz=rate_hz)
        arrays = SiteArrays.build(faster_site, pages=8)
        buffers = TickBuffers.build(faster_site)
        s = arrays.site[0]
        s.q = state[at.q]
        s.qd = state[at.qd]
        s.theta_hat = state[at.estimate]
        for link, peer in zip(arrays.links, peers, strict=True):
            link.q, link.qd, link.tau_x = np.split(peer, 3)
        site_tick(0, 0, 0, *arrays, *buffers)
        accelerations.append((s.qd - state[at.qd]) * rate_hz)
        rates = (s.theta_hat - state[at.estimate]) * rate_hz
        columns = {
            name: buffers.record[column].copy()
            for name, column in faster_site.layout.columns().items()
        }
        records.append({**columns, "estimate": rates})
    return {**records[1], "qdd": 2.0 * accelerations[1] - accelerations[0]}


@pytest.mark.parametrize(("text", "name", "law"), SITES)
@pytest.mark.parametrize("distance", [0.3, 0.0])
def test_a_site_equals_a_compiled_tick(text: str, name: str, law: str, distance: float) -> None:
    """Torque, messages, motion and learning are equal, for peers that are apart and for peers that agree."""
    site = make_task_setup(text, name, law)
    for seed in range(3):
        state, peers = draw_state(site, seed, distance)
        rates = by_theory(site, state, peers)
        wanted = by_tick(site, state, peers)
        names = {"tau": rates.tau, "x": rates.x, "xd": rates.xd, "wrench": -rates.reflected}
        for key, value in names.items():
            assert np.abs(value - wanted[key]).max() <= 1e-9 * (
                1.0 + np.abs(wanted[key]).max()
            ), key
        if law == "adaptive":
            size = 1.0 + np.abs(rates.estimate).max()
            assert np.abs(rates.estimate - wanted["estimate"]).max() <= 1e-7 * size
        size = 1.0 + np.abs(rates.qdd).max()
        assert np.abs(rates.qdd - wanted["qdd"]).max() <= 2e-5 * size


@pytest.mark.parametrize(("text", "name", "law"), SITES)
def test_task_jacobian_is_the_difference_of_ticks(text: str, name: str, law: str) -> None:
    site = make_task_setup(text, name, law)
    step = 1e-6
    at = ArgumentLayout.of_site(site)
    state, peers = draw_state(site, 4, 0.0)
    x = np.concatenate([state, np.zeros(at.arguments - at.states)])
    derivative = SiteRates.evaluate(site, x).x
    x[at.q_des] = derivative + 0.05
    x[at.qd_des] = 0.1
    x[at.peer_torque] = 0.3
    exact = SiteRates.differentiate(site, x)
    places = [*range(2 * at.joints), *range(at.states, at.inputs.stop)]

    def tau(place: int, by: float) -> Array:
        """Returns the torque of a tick with one of its arguments off; all peers send the sample
        of the first.
        """
        moved = x.copy()
        moved[place] += by
        sent = np.concatenate([moved[at.q_des], moved[at.qd_des], -moved[at.peer_torque]])
        return by_tick(site, moved[: at.states], [sent] * len(peers))["tau"]

    for place in places:
        difference = (tau(place, step) - tau(place, -step)) / (2.0 * step)
        size = 1.0 + np.abs(exact.tau).max()
        assert np.abs(difference - exact.tau[:, place]).max() <= 1e-6 * size, place


@pytest.mark.parametrize("seed", range(3))
def test_rate_of_jacobian_is_its_derivative_along_motion(seed: int) -> None:
    site = make_task_setup("posed", "s", "pd_d")
    rng = np.random.default_rng(seed)
    q, qd = rng.normal(0.0, 1.0, (2, len(site.q0)))
    moved = place_arm(site, q + 1j * COMPLEX_STEP * qd)
    placed_arm = place_arm(site, q)
    assert isinstance(moved, PlacedChain)
    assert isinstance(placed_arm, PlacedChain)
    wanted = moved.pose_jacobian().imag / COMPLEX_STEP
    assert np.abs(placed_arm.pose_jacobian_rate(qd) - wanted).max() <= 1e-13 * (
        1.0 + np.abs(wanted).max()
    )
    R = placed_arm.end_effector_orientation()
    turned = moved.end_effector_orientation().imag / COMPLEX_STEP
    across = turned @ R.T
    w = placed_arm.pose_jacobian()[3:] @ qd
    assert np.array([across[2, 1], across[0, 2], across[1, 0]]) == pytest.approx(w, abs=1e-12)
