"""The linear loop of sites in task space: against equivalent loops in joint space, and against runs."""

from typing import Any

import numpy as np
import pytest

from tests.core.chain_references import ARMS
from tests.scenario.builders import planar_task_text, posed_task_text
from tests.theory.loops import Array
from tests.theory.tick_recursion import build_recursion
from trilat_net.analysis.theory import LinearAnalysis, find_equilibrium, iterate_linear_edges
from trilat_net.analysis.theory.characteristic_roots import Spectrum, find_moving_part
from trilat_net.analysis.theory.equilibrium import find_mean_pose
from trilat_net.analysis.theory.floquet import SampledLoop
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import Equilibrium, OperatingConditions
from trilat_net.analysis.theory.port_analysis import PortAnalysis, linearise_teleoperator
from trilat_net.analysis.theory.port_response import build_admittance
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.execution.fused import FusedRun
from trilat_net.presentation.linear_text import describe_ports
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

SLIDERS = """<robot name="sliders"><link name="base"/>
{links}
</robot>"""
SLIDER = """<link name="l{n}"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="{mass}"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="j{n}" type="prismatic"><parent link="{parent}"/><child link="l{n}"/>
<axis xyz="{axis}"/><limit lower="-9" upper="9" effort="900" velocity="9"/></joint>"""
CARTESIAN = """
name = "cartesian"
[arm]
urdf = "sliders.urdf"
[link]
delay_ms = 60
[sites.m]
q0_rad = [0.3, 0.1, 0.2]
[sites.s]
role = "slave"
[dominance]
m = { s = 1.0 }
s = { m = 1.0 }
"""
ROWS = ["1 0 0", "0 1 0", "0 0 1"]
LAWS: dict[str, dict[str, Any]] = {
    "adaptive": {
        "law": "adaptive",
        "Lambda": [1.5, 2.0, 1.0],
        "Kp": [9, 7, 5],
        "Kd": [4, 3, 6],
        "Gamma": 2.0,
    },
    "pd_d": {
        "law": "pd_d",
        "K": [60.0, 40.0, 50.0],
        "Kd": [3.0, 5.0, 4.0],
        "d": [9.0, 8.0, 7.0],
    },
    "p_f": {
        "law": "p_f",
        "K": [60.0, 40.0, 50.0],
        "d": [9.0, 8.0, 7.0],
        "k_f": [0.2, 0.3, 0.1],
    },
}
HAND = {
    "kind": "spring",
    "stiffness_nm_rad": [20.0, 30.0, 10.0],
    "damping_nm_s_rad": 2.0,
    "to_rad": 0.0,
}


def make_cartesian_scenario(law: str, space: str) -> Scenario:
    """Returns two arms of three sliders, heavier from slider to slider, with an operator who is felt."""
    links = "\n".join(
        SLIDER.format(n=n, mass=3 - 0.5 * n, parent=f"l{n - 1}" if n else "base", axis=axis)
        for n, axis in enumerate(ROWS)
    )
    changes: dict[str, Any] = {
        "control": LAWS[law],
        "sites.s.hands": [HAND],
        "urdf": {"sliders.urdf": SLIDERS.format(links=links)},
    }
    return parse_scenario(CARTESIAN, "cartesian", changes | {"task.space": space})


@pytest.mark.parametrize("law", LAWS)
def test_sliders_have_equal_joint_and_task_loops(law: str) -> None:
    """For arms that slide along x, y and z the Jacobian is 1, so that loop, roots, sampled roots and ports are equal."""
    loops = []
    for space in ("joints", "position"):
        scenario = make_cartesian_scenario(law, space)
        rest = find_equilibrium(scenario, (0.2, -0.1, 0.3))
        conditions = OperatingConditions.derive(scenario)
        loop = LinearLoop.of_conditions(conditions, rest)
        spectrum = Spectrum.of_loop(loop, 12)
        sampled = SampledLoop(conditions).compute_spectrum(rest, 12)
        Y = build_admittance(linearise_teleoperator(conditions, rest))(
            np.array([0.1, 3.0, 40.0])
        )
        loops.append((rest.q, loop, spectrum, sampled, Y))
    (q, loop, in_joints, sampled, Y), (q_task, loop_task, other, sampled_task, Y_task) = loops
    assert q_task == pytest.approx(q, abs=1e-12)
    assert loop_task.names == loop.names
    assert (other.zeros, other.drifting) == (in_joints.zeros, in_joints.drifting)
    assert sampled is not None
    assert sampled_task is not None
    for a, b in ((in_joints, other), (sampled, sampled_task)):
        assert len(a.roots) == len(b.roots)
        for first, second in zip(a.roots, b.roots, strict=True):
            assert abs(first.s - second.s) <= 1e-9 * (1.0 + abs(first.s))
    assert np.abs(Y - Y_task).max() <= 1e-9 * np.abs(Y).max()


def start_near(scenario: Scenario, rest: Equilibrium, off: dict[str, float]) -> Scenario:
    """Returns the scenario with its sites at a rest but for deviations of its states, by their names."""
    changes: dict[str, Any] = {}
    for name, q, theta_hat in zip(scenario.names, rest.q, rest.theta_hat, strict=True):
        counts = scenario.arms[name].counts

        def put(kind: str, values: Array, name: str = name) -> list[float]:
            return [
                value + off.get(f"{name}.{kind}{n}", 0.0)
                for n, value in enumerate(values.tolist(), 1)
            ]

        changes[f"sites.{name}.q0_rad"] = put("q", q[: counts.joints])
        changes[f"sites.{name}.qd0_rad_s"] = put("qd", 0.0 * q[: counts.joints])
        changes[f"sites.{name}.control.theta_hat0"] = put(
            "theta", theta_hat[: counts.parameters]
        )
        if scenario.sites[name].task.posture_rate_1_s:
            changes[f"sites.{name}.task.posture_rad"] = q[: counts.joints].tolist()
    return load_scenario(scenario, changes)


def trace_deviations(scenario: Scenario, rest: Equilibrium, step_s: float, steps: int) -> Array:
    """Returns deviations of all joints from a rest along a run, shape (steps, joints of all sites)."""
    run = FusedRun(scenario)
    rows = []
    for k in range(1, steps + 1):
        run.advance_to(k * step_s)
        rows.append((run.q - rest.q).ravel())
    motion = np.array(rows)
    return motion[:, motion.any(axis=0)]


def realise_system(outputs: Array, step_s: float, order: int) -> Array:
    """Returns the exponents in a free motion of many signals: Juang and Pappa's eigensystem
    realisation (1985).
    """
    half = len(outputs) // 2
    hankel = np.stack([np.concatenate(outputs[k : k + half]) for k in range(half)], axis=1)
    U, sizes, V = np.linalg.svd(hankel[:, :-1], full_matrices=False)
    U = U[:, :order]
    sizes = np.sqrt(sizes[:order])
    V = V[:order]
    step = (U / sizes).T @ hankel[:, 1:] @ (V / sizes[:, np.newaxis]).T
    return np.log(np.linalg.eigvals(step).astype(complex)) / step_s


def make_settled_scenario(name: str) -> tuple[Scenario, Equilibrium]:
    """Returns a scenario at the mean of its start poses, with estimates that are true."""
    texts = {"planar": planar_task_text(), "posed": posed_task_text()}
    light = {"control.Kp": 2.0, "control.Gamma": 5.0} if name == "posed" else {}
    scenario = (
        parse_scenario(texts[name], name, light, ARMS) if name in texts else load_scenario(name)
    )
    rest = find_equilibrium(scenario, find_mean_pose(scenario))
    return start_near(scenario, rest, {}), rest


cases = pytest.mark.parametrize(
    "name",
    [
        "planar",
        *(pytest.param(name, marks=pytest.mark.long) for name in ("unlike_arms", "posed")),
    ],
)


@cases
def test_small_deviations_follow_the_companion_matrix(name: str) -> None:
    """The companion matrix advances the deviation; theta_0 = eta_0 + h/2 f_0, and tau_-1 = tau_0."""
    scenario, rest = make_settled_scenario(name)
    rng = np.random.default_rng(1)
    size = 1e-6
    counts = [scenario.arms[site].counts.joints for site in scenario.names]
    angles = [
        f"{site}.q{n + 1}"
        for site, n in zip(scenario.names, counts, strict=True)
        for n in range(n)
    ]
    off = {angle: size * rng.normal() for angle in angles}
    whole, names, late, _ = build_recursion(OperatingConditions.derive(scenario), rest)
    start = np.array([off.get(name, 0.0) for name in names])
    X = np.concatenate([start, np.tile(start[late], (len(whole) - len(names)) // len(late))])
    learnt, torques = (
        [n for n, state_name in enumerate(names) if kind in state_name]
        for kind in (".gravity", ".tau")
    )
    X[learnt] -= 0.5 * ((whole @ X)[learnt] - X[learnt])
    X[torques] = (whole @ X)[torques]
    motion_of_run = trace_deviations(start_near(scenario, rest, off), rest, 1e-3, 300)
    places = [names.index(angle) for angle in angles]
    for row in motion_of_run:
        X = whole @ X
        assert np.abs(X[places] - row).max() <= 2e-5 * size


@cases
def test_runs_decay_and_swing_at_their_roots(name: str) -> None:
    """Started along the vector of each of the three rightmost roots that swing."""
    scenario, rest = make_settled_scenario(name)
    conditions = OperatingConditions.derive(scenario)
    near = Spectrum.of_loop(LinearLoop.of_conditions(conditions, rest), 14)
    spectrum = SampledLoop(conditions).compute_spectrum(rest, 14)
    assert spectrum.verdict == near.verdict == "stable"
    swings = [root.s for root in spectrum.roots if root.s.imag > 0.7 * abs(root.s)][:3]
    assert swings
    loop = LinearLoop.of_conditions(conditions, rest, all_estimates=True)
    pencil, names, _ = find_moving_part(loop)
    for s in swings:
        vector = np.linalg.svd(pencil.evaluate(s)[0])[2][-1].conj()
        vector *= 1e-5 / vector[np.abs(vector).argmax()]
        off = dict(zip(names, vector.real.tolist(), strict=True))
        step_s = 0.3 / abs(s)
        measured = realise_system(
            trace_deviations(start_near(scenario, rest, off), rest, step_s, 60), step_s, 16
        )
        assert np.abs(measured - s).min() <= 0.01 * abs(s), (s, measured)


@cases
def test_the_law_is_passive_at_end_effectors(name: str) -> None:
    """The proof holds for places, also with open axes and redundant joints; for poses there is none."""
    scenario, rest = make_settled_scenario(name)
    ports = PortAnalysis.of_scenario(scenario, rest, band_hz=(0.01, 20.0))
    assert ports.estimates_true
    assert (ports.proof is None) == (name == "posed")
    assert ports.proof is None or ports.proof.passive
    followed = {"planar": 2, "unlike_arms": 3, "posed": 6}[name]
    assert len(ports.axes) == len(ports.joints) == followed
    text = "\n".join(describe_ports(ports))
    assert "axis x alone" in text
    assert ("N s/m", "N m s/rad" in text) == ("N s/m", name == "posed")


def test_edges_margins_and_verdict_share_one_loop() -> None:
    """P+d in task space: the margin's frequency is a root, and the edge of d is where the
    verdict changes.
    """
    law = {"law": "p_d", "K": 120.0, "d": 12.0}
    scenario = parse_scenario(planar_task_text(), "planar", {"control": law})
    pose = find_mean_pose(scenario)
    analysis = LinearAnalysis.compute(scenario, pose=pose)
    end = analysis.margin.intervals[0].high
    assert end is not None
    rightmost = Spectrum.of_loop(analysis.loop.set_common_delay(end.delay_s), 1).rightmost
    assert rightmost is not None
    assert rightmost.s == pytest.approx(1j * end.omega_rad_s, abs=1e-6 * end.omega_rad_s)
    edge = next(
        iterate_linear_edges(scenario, "control.d", 2.0, 20.0, analysis.rest, points=5), None
    )
    assert edge is not None
    for d, verdict in ((0.99 * edge.value, "unstable"), (1.01 * edge.value, "stable")):
        beside = load_scenario(scenario, {"control.d": d})
        assert LinearAnalysis.compute(beside, pose=pose, roots=1).continuous.verdict == verdict


def test_poses_without_loop_are_refused_by_name() -> None:
    scenario = parse_scenario(planar_task_text(), "planar", {"task.singular_value": 1e-6})
    with pytest.raises(ScenarioError, match="rests in a singular pose") as refused:
        find_equilibrium(scenario, (2.0, 0.0, 0.0))
    assert refused.value.path == "sites.m.task.axes"
    with pytest.raises(
        ScenarioError, match=r"sites\.m\.q0_rad: the end effector does not reach the pose"
    ):
        find_equilibrium(scenario, (2.5, 0.0, 0.0))
    with pytest.raises(UsageError, match="pose must be a position in m of the end effectors"):
        find_equilibrium(scenario, (2.5, 0.0))


def test_rests_near_singular_poses_include_damping() -> None:
    scenario = parse_scenario(planar_task_text(), "planar", {"task.singular_value": 0.9})
    analysis = LinearAnalysis.compute(scenario, pose=find_mean_pose(scenario), roots=1)
    assert any("rests near a singular pose" in note for note in analysis.notes)
