"""The linear loop of arms of six joints: against runs, a solver of delay equations, SciPy, and the leaves."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigvals
from trilat_studies.sweep.stability_criteria import StabilityCriterion

from tests.core.chain_references import ARMS
from tests.scenario.builders import two_arm_text
from tests.theory.loops import Array, compute_residual, roots_within
from trilat_net.analysis.theory import find_equilibrium, iterate_linear_edges
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.equilibrium import predict_equilibrium
from trilat_net.analysis.theory.floquet import SampledLoop
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import Equilibrium, OperatingConditions
from trilat_net.analysis.theory.port_analysis import PortAnalysis, linearise_teleoperator
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.analysis.theory.site_dynamics import ArgumentLayout, SiteRates
from trilat_net.core.arms.chain import (
    MAX_JOINTS,
    build_chain,
    find_acceleration,
    inverse_dynamics,
    parameter_gradient,
    place_joints,
    propagate_motion,
)
from trilat_net.core.arms.exogenous import (
    TorqueKind,
    TorqueSource,
    put_torque_on_chain,
    torque_source_rows,
)
from trilat_net.core.step.site_setup import SiteSetup
from trilat_net.errors import UsageError
from trilat_net.execution.fused import FusedRun
from trilat_net.presentation.linear_text import describe_ports
from trilat_net.scenario import Scenario
from trilat_net.scenario.scenario_reader import parse_scenario

POSE = (0.0, -1.1, 1.2, -0.4, 0.3, 0.1)
LOADED = [2, 3, 4, 5, 6]
"""Joints of arm6 that gravity loads: not the first, whose axis is upright."""
TEXT = two_arm_text("arm6.urdf", POSE, 20.0, 50.0, [0.2, 0.2, 0.2, 0.05, 0.05, 0.05])
LAWS: dict[str, dict[str, Any]] = {
    "adaptive": {
        "law": "adaptive",
        "Gamma": 3.0,
        "Lambda": 2.0,
        "Kp": [8, 0.5, 3, 1, 1, 1],
        "Kd": 1.0,
    },
    "p_d": {
        "law": "p_d",
        "K": [60.0, 60.0, 60.0, 12.0, 12.0, 12.0],
        "d": [6.0, 6.0, 6.0, 0.7, 0.7, 0.7],
    },
}
"""Laws in which something swings: learnt gravity, or a spring with little damping."""


class Linear(NamedTuple):
    """A scenario with both sites near one pose, its estimates true, and the loop at that pose."""

    scenario: Scenario
    conditions: OperatingConditions
    rest: Equilibrium

    def loop(self, **options: bool) -> LinearLoop:
        return LinearLoop.of_conditions(self.conditions, self.rest, **options)


def make_six_joint_loop(law: str, off: Array | None = None, **overrides: Any) -> Linear:
    """Returns sites that start at the pose, or off it by (2, 6) rad."""
    start = POSE + (np.zeros((2, 6)) if off is None else off)
    keys = {
        "control": LAWS[law],
        "sites.m.q0_rad": start[0].tolist(),
        "sites.s.q0_rad": start[1].tolist(),
    }
    plain = parse_scenario(TEXT, "six", keys | overrides, ARMS)
    theta = plain.arms["m"].theta.tolist()
    learns = {"control": {**LAWS[law], "theta_hat0": theta}} if law == "adaptive" else {}
    scenario = parse_scenario(TEXT, "six", keys | overrides | learns, ARMS)
    return Linear(
        scenario, OperatingConditions.derive(scenario), find_equilibrium(scenario, POSE)
    )


def trace_angles(scenario: Scenario, ticks: int) -> Array:
    """Returns the angles of both sites at each tick, shape (ticks, 12)."""
    run = FusedRun(scenario)
    rate_hz = scenario.sites["m"].rate_hz
    angles = []
    for k in range(1, ticks + 1):
        run.advance_to(k / rate_hz)
        angles.append(run.q.ravel())
    return np.array(angles)


def by_leaves(site: SiteSetup, x: Array, at: ArgumentLayout) -> Array:
    """Returns accelerations and rates of the estimate as a tick computes them, by the compiled leaves."""
    assert site.chain is not None
    gains = site.gains
    gravity = np.array(site.chain.gravity_m_s2)
    q = x[at.q]
    qd = x[at.qd]
    rows = build_chain(site.chain.joints, MAX_JOINTS)
    place_joints(rows, q)
    e = q - x[at.q_des]
    ed = qd - x[at.qd_des]
    v = -np.asarray(gains.Lambda) * e
    a = -np.asarray(gains.Lambda) * ed
    tau = np.zeros(6)
    gradient = np.zeros(60)
    qdd = np.zeros(6)
    acted = np.zeros((2, 6))
    propagate_motion(rows, gravity, qd, v, a)
    parameter_gradient(rows, gradient)
    inverse_dynamics(rows, x[at.estimate], v, a, tau)
    tau -= np.asarray(gains.Kp) * (qd - v) + np.asarray(gains.Kd) * ed
    actors, table = torque_source_rows(site.actors, 6)
    for sampled in (0, 1):
        tip = np.array(site.chain.tip_m)
        put_torque_on_chain(100.0, q, qd, tip, rows, actors, table, sampled, acted[sampled])
    total = tau + acted.sum(axis=0) + x[at.external_torque]
    find_acceleration(rows, site.theta, gravity, q, qd, total, qdd)
    return np.concatenate([qdd, -np.asarray(gains.Gamma) * gradient])


@pytest.mark.long
def test_rates_and_derivatives_equal_compiled_leaves() -> None:
    """Hands act on the joints and on the end effector, and one of the walls of any direction is touched."""
    rng = np.random.default_rng(14)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    wall = {"a": (0.0, 0.0, 0.5), "K": (300.0,), "B": (5.0,)}
    actors = (
        TorqueSource(TorqueKind.HAND, b=tuple(rng.normal(size=6)), K=(20.0,) * 6, B=(2.0,) * 6),
        TorqueSource(
            TorqueKind.TASK_HAND, b=(0.3, 0.2, 0.4), K=(90.0, 60.0, 30.0), B=(9.0, 6.0, 3.0)
        ),
        TorqueSource(TorqueKind.VISCOUS, B=(0.5,) * 6, sampled=True),
        TorqueSource(TorqueKind.WALL, b=tuple(normal), **wall),
        TorqueSource(TorqueKind.WALL, b=tuple(-normal), **wall, sampled=True),
    )
    site = make_six_joint_loop("adaptive").scenario.setup("m")._replace(actors=actors)
    at = ArgumentLayout(6, 60)
    for _ in range(3):
        x = rng.uniform(-1.0, 1.0, at.arguments)
        rates = SiteRates.evaluate(site, x)
        exact = SiteRates.differentiate(site, x)
        derivatives = np.concatenate([rates.qdd, rates.estimate])
        wanted = by_leaves(site, x, at)
        assert np.abs(derivatives - wanted).max() <= 1e-12 * (1.0 + np.abs(wanted).max())
        jacobian = np.vstack([exact.qdd, exact.estimate])
        for k in range(at.arguments):
            off = 1e-5 * np.eye(at.arguments)[k]
            difference = (by_leaves(site, x + off, at) - by_leaves(site, x - off, at)) / 2e-5
            assert np.abs(difference - jacobian[:, k]).max() <= 1e-6 * (
                1.0 + np.abs(wanted).max()
            )


def test_learnt_gravity_stands_for_all_estimates() -> None:
    """Five combinations of sixty: SciPy finds the same roots of both loops, and ports answer alike."""
    case = make_six_joint_loop("adaptive")
    whole = case.loop(all_estimates=True)
    short = case.loop()
    assert [name for name in short.names if "gravity" in name] == [
        f"{site}.gravity{joint}" for site in "ms" for joint in LOADED
    ]
    assert short.omitted_states == 2 * (60 - len(LOADED)) == len(whole.names) - len(short.names)
    values = [eigvals(loop.set_common_delay(0.0).A) for loop in (whole, short)]
    moving = [np.sort_complex(np.round(value[np.abs(value) > 1e-4], 7)) for value in values]
    assert len(moving[0]) == len(moving[1])
    assert np.abs(moving[0] - moving[1]).max() <= 1e-6
    w_rad_s = np.array([0.01, 1.0, 13.0, 200.0])
    Y = build_admittance(short)(w_rad_s)
    assert np.abs(build_admittance(whole)(w_rad_s) - Y).max() <= 1e-9 * np.abs(Y).max()


@pytest.mark.long
def test_no_root_at_zero_hides_the_rightmost_one() -> None:
    """Each omitted state counts as a root at zero; the shared pose gives the others."""
    case = make_six_joint_loop("adaptive")
    loop = case.loop()
    spectrum = Spectrum.of_loop(loop, 3)
    assert (spectrum.zeros, spectrum.drifting) == (loop.omitted_states + 6, 0)
    assert all(
        compute_residual(case.loop(all_estimates=True), root.s) <= 1e-12
        for root in spectrum.roots
    )
    # no other root is to the right of the third
    edge = spectrum.roots[2].s.real - 0.05
    right = sum(2 if root.s.imag else 1 for root in spectrum.roots)
    assert roots_within(loop, complex(edge, -60.0), complex(20.0, 60.0)) == right + 6
    sampled = SampledLoop(case.conditions).compute_spectrum(case.rest, 3)
    assert (sampled.zeros, sampled.drifting) == (spectrum.zeros, 0)
    for sampled_root, other in zip(sampled.roots, spectrum.roots, strict=True):
        assert abs(sampled_root.s - other.s) <= 2e-3 * abs(other.s)


OFF = np.array([[1.0, -0.7, 0.5, 0.8, -0.6, 0.9], [-0.8, 0.6, -0.9, 0.3, 0.7, -0.4]])


@pytest.mark.parametrize("law", LAWS)
def test_a_run_follows_the_delay_equation(law: str) -> None:
    """SciPy's DOP853 by the method of steps, from the same deviation; a run of 1 kHz."""
    small = 1e-6
    case = make_six_joint_loop(law, small * OFF)
    loop = case.loop()
    delay_s = 0.05
    ((at_s, A_d, _),) = loop.delayed
    assert at_s == delay_s
    start = np.zeros(len(loop.names))
    for (i, site), joint in itertools.product(enumerate("ms"), range(6)):
        start[loop.names.index(f"{site}.q{joint + 1}")] = small * OFF[i, joint]
    pieces: list[Callable[[float], Array]] = [lambda _: start]
    for n in range(10):
        before = pieces[-1]
        done = solve_ivp(
            lambda t, x, before=before: loop.A @ x + A_d @ before(t - delay_s),
            (n * delay_s, (n + 1) * delay_s),
            pieces[-1](n * delay_s),
            "DOP853",
            dense_output=True,
            rtol=1e-10,
            atol=1e-14 * small,
        )
        pieces.append(done.sol)
    places = [loop.names.index(f"{site}.q{joint + 1}") for site in "ms" for joint in range(6)]
    motion_of_run = trace_angles(case.scenario, 500) - np.tile(POSE, 2)
    for k in range(100, 501, 100):
        wanted = pieces[min(1 + (k - 1) // 50, 10)](1e-3 * k)[places]
        assert np.abs(motion_of_run[k - 1] - wanted).max() <= 3e-4 * np.abs(wanted).max(), k


@pytest.mark.parametrize("law", LAWS)
def test_a_run_decays_at_its_rightmost_root(law: str) -> None:
    """Late in a run of 200 Hz one mode remains: its root is fitted to joint 2, a recurrence of
    two steps.
    """
    pushed = {
        "sites.m.qd0_rad_s": (1e-3 * OFF[0]).tolist(),
        "sites.s.qd0_rad_s": (5e-4 * OFF[0]).tolist(),
    }
    case = make_six_joint_loop(law, rate_hz=200, **pushed)
    spectrum = SampledLoop(case.conditions).compute_spectrum(case.rest, 2)
    root, following = (root_found.s for root_found in spectrum.roots)
    from_s = 6.0 / (root.real - following.real)  # by then the next mode has a part in 400 left
    motion_of_run = trace_angles(case.scenario, round(200 * (from_s + 2.0)))
    late = np.diff(motion_of_run[round(200 * from_s) :: 10, 1])
    (a, b), *_ = np.linalg.lstsq(np.column_stack([late[1:-1], late[:-2]]), late[2:], rcond=None)
    z = np.roots([1.0, -a, -b])
    s = np.log(z[np.argmax(z.imag)].astype(complex)) / (10 / 200)
    assert s.real == pytest.approx(root.real, rel=2e-3)
    assert s.imag == pytest.approx(root.imag, rel=3e-4)


def test_joints_answer_sinusoids_by_their_admittance() -> None:
    """A torque on joint 3 of m in a run of P+d: the motion of all twelve joints."""
    w_rad_s = 2.0 * np.pi
    amplitude_nm = 0.05
    rate_hz = 500
    settled_s = 14.0
    case = make_six_joint_loop("p_d", rate_hz=rate_hz)
    Y = build_admittance(linearise_teleoperator(case.conditions, case.rest))(
        np.array([w_rad_s])
    )[0, :, 2]
    t_s = np.arange(0.0, 21.0, 0.002)
    points = np.zeros((len(t_s), 7))
    points[:, 0] = t_s
    points[:, 3] = amplitude_nm * np.sin(w_rad_s * t_s)
    hands = [{"kind": "recorded", "points": points.tolist()}]
    motion_of_joints = trace_angles(
        make_six_joint_loop("p_d", rate_hz=rate_hz, **{"sites.m.hands": hands}).scenario,
        18 * rate_hz,
    )
    late = np.arange(round(settled_s * rate_hz), len(motion_of_joints))
    turned = w_rad_s * (late + 1) / rate_hz
    columns = np.column_stack([np.sin(turned), np.cos(turned), np.ones_like(turned), turned])
    sine, cosine, *_ = np.linalg.lstsq(columns, motion_of_joints[late], rcond=None)[0]
    admittance = 1j * w_rad_s * (sine + 1j * cosine) / amplitude_nm
    assert np.abs(admittance - Y).max() <= 0.01 * np.abs(Y).max()


def test_six_joint_laws_are_passive_in_r() -> None:
    """This holds also with learnt gravity, which is not passive in qd at the joints that gravity loads."""
    case = make_six_joint_loop("adaptive")
    ports = PortAnalysis.of_scenario(case.scenario, case.rest, band_hz=(0.01, 20.0))
    assert ports.estimates_true
    assert ports.proof is not None
    assert ports.proof.passive
    assert [joint for joint, port in ports.joints.items() if not port.passive] == LOADED
    assert [transparency.joint for transparency in ports.transparency] == [1, 2, 3, 4, 5, 6]
    assert len(ports.two_ports) == 6
    assert (
        sum("joint 2, 3, 4, 5, 6: fails within" in line for line in describe_ports(ports)) == 1
    )


def test_a_pose_has_an_angle_for_each_joint() -> None:
    with pytest.raises(UsageError, match="6 angles in rad, one per joint"):
        find_equilibrium(make_six_joint_loop("p_d").scenario, (0.1, 0.3))


@pytest.mark.long
def test_the_p_d_bound_holds_for_chains() -> None:
    """4 d1 d2 = (T1 + T2)^2 K1 K2 whatever the arms weigh, if their drives weigh enough for the tick."""

    def damped(d: float, **overrides: Any) -> Linear:
        return make_six_joint_loop("p_d", **{"control.K": 20.0, "control.d": d, **overrides})

    criterion = StabilityCriterion.evaluate(damped(1.05).scenario)
    assert criterion is not None
    assert criterion.excess == pytest.approx(0.1)
    assert Spectrum.of_loop(damped(1.05).loop(), 1).verdict == "stable"
    edge = next(
        iterate_linear_edges(
            damped(1.0).scenario, "control.d", 0.3, 1.2, damped(1.0).rest, points=4
        ),
        None,
    )
    assert edge is not None
    assert 0.8 < edge.value < 1.0
    assert (
        StabilityCriterion.evaluate(damped(1.05, **{"arm.armature_kg_m2": 0.001}).scenario)
        is None
    )


@pytest.mark.long
def test_diverging_runs_keep_their_predicted_rest() -> None:
    """For equal arms with equal gains the rest is near the mean of the start poses."""
    case = make_six_joint_loop("adaptive", 0.3 * OFF)
    equilibrium = predict_equilibrium(case.scenario)
    assert equilibrium.residual <= 1e-10
    assert np.ptp(equilibrium.q, axis=0).max() <= 1e-9
    assert equilibrium.q[0] == pytest.approx(np.add(POSE, 0.15 * (OFF[0] + OFF[1])), abs=0.05)
