"""Reports of arms of six joints: positions of joints in pictures, names and units, panels and the page."""

import json
import re
from functools import cache

import numpy as np
import pytest

import trilat_net as tn
from tests.core.chain_references import chain_references
from tests.presentation.figure_content import list_misplaced
from tests.scenario.builders import six_joint_text
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.log.log_reader import Log
from trilat_net.log.ros2.ros2_messages import Ros2SiteChannels
from trilat_net.presentation import charts
from trilat_net.presentation.appearance import REPORT_SIZE, FigureSize
from trilat_net.presentation.figures import arm_poses
from trilat_net.presentation.figures.registry import FIGURES
from trilat_net.presentation.style import arrange_joints
from trilat_net.scenario import parse_scenario

SIX = six_joint_text(1.0, delay_ms=40.0)
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]


@cache
def simulate_six_joints() -> Log:
    return SimulatedLog(parse_scenario(SIX, overrides={"rate_hz": 200}))


def test_chains_end_where_pinocchio_says():
    arm = build_arm_rows(simulate_six_joints().scenario, "m1")
    states = chain_references()["arm6"].states
    points = arm.joint_positions_m(np.array([state.q for state in states]))
    assert points[:, -1] == pytest.approx(
        np.array([state.tip_position for state in states]), abs=1e-12
    )
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=2)
    assert lengths == pytest.approx(np.tile(lengths[0], (len(states), 1)), abs=1e-12)
    assert not points[:, 0].any()


def test_pictures_of_chains_have_shadows_below():
    arm = build_arm_rows(simulate_six_joints().scenario, "m1")
    origin, above, aside = arm_poses.project_arm_m(
        arm.upright_axes, np.array([[0.0, 0, 0], [0, 0, 1], [0.3, 0.2, 0]])
    )
    assert not origin.any()
    assert above[0] == pytest.approx(0.0)
    assert 0.8 < above[1] < 1.0
    shadow = arm_poses.project_arm_m(
        arm.upright_axes, np.array([0.3, 0.2, 0.9]), onto_floor=True
    )
    assert shadow == pytest.approx(aside)


def test_panels_of_joints_fill_their_rows():
    assert arrange_joints(2, narrow=False) == [["0", "1"]]
    assert [len(row) for row in arrange_joints(6, narrow=False)] == [3, 3]
    assert arrange_joints(7, narrow=False) == [["0", "1", "2", "3"], ["4", "5", "6", "."]]
    assert len(arrange_joints(7, narrow=True)) == 4


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(REPORT_SIZE, id="report"),
        pytest.param(FigureSize.for_print(3.5), id="narrow", marks=pytest.mark.long),
    ],
)
@pytest.mark.parametrize(
    ("name", "panels"),
    [
        ("positions", 18),
        ("tracking_errors", 7),
        ("control_torques", 6),
        pytest.param("parameter_estimates", 60, marks=pytest.mark.long),
        ("phase", 6),
        ("paths", 3),
        ("arms", None),
    ],
)
def test_every_joint_has_its_panel(form, name, panels):
    figure = FIGURES[name].draw(simulate_six_joints(), form)
    assert panels in (None, len(figure.axes))
    assert list_misplaced(figure) == []
    text = " ".join(
        axes.get_title() + axes.get_ylabel().replace("\n", "") for axes in figure.axes
    )
    if panels in (6, 7):
        assert all(f"{n}: {joint}" in text for n, joint in enumerate(JOINTS, 1))


def test_tip_paths_appear_in_three_planes():
    log = simulate_six_joints()
    panels = FIGURES["paths"].draw(log, REPORT_SIZE).axes
    names = [(axes.get_xlabel()[0], axes.get_ylabel()[0]) for axes in panels]
    assert names == [("x", "y"), ("x", "z"), ("y", "z")]
    for site, line in (("m1", 0), ("s", 6)):  # a path, its ring and its disc
        part = log[site]
        points = build_arm_rows(log.scenario, site).joint_positions_m(part.q[[0, -1]])[:, -1]
        for axes, plane in zip(panels, ([0, 1], [0, 2], [1, 2]), strict=True):
            path = axes.lines[line].get_xydata()
            assert path[[0, -1]] == pytest.approx(points[:, plane], abs=1e-12)


def test_wall_forces_equal_the_recorded_torques():
    """The wall's torque is the force times the end effector's motion along the normal, by
    differences of poses.
    """
    arm = build_arm_rows(simulate_six_joints().scenario, "s")
    start = arm.joint_positions_m(np.array([[0.0, -1.1, 1.0, -0.4, 0.3, 0.1]]))[0, -1]
    normal = np.array([0.6, -0.3, 0.74])
    wall = {
        "kind": "wall",
        "point_m": (start + 0.01 * normal).tolist(),
        "normal": normal.tolist(),
    }
    push = {"sites.s.environment": [{**wall, "stiffness_n_m": 800.0, "damping_n_s_m": 5.0}]}
    log = SimulatedLog(parse_scenario(SIX, overrides={"rate_hz": 200, **push}))
    part = log["s"]
    force_panel, depth_panel = FIGURES["contact"].draw(log).axes
    t_s, force = force_panel.lines[0].get_data()
    rows = np.rint(t_s * part.rate_hz).astype(int)
    assert force.max() > 5.0
    across = normal / np.linalg.norm(normal)
    lever = np.empty((len(rows), 6))
    for joint, off in enumerate(1e-6 * np.eye(6)):
        ends = [arm.joint_positions_m(part.q[rows] + s * off)[:, -1] for s in (1, -1)]
        lever[:, joint] = (ends[0] - ends[1]) @ across / 2e-6
    assert force[:, None] * lever == pytest.approx(-part.tau_x[rows], abs=1e-5)
    at = arm.joint_positions_m(part.q[rows])[:, -1]
    depth_mm = 1e3 * np.maximum((start + 0.01 * normal - at) @ across, 0.0)
    assert depth_panel.lines[0].get_ydata() == pytest.approx(depth_mm, abs=1e-9)


def test_columns_and_messages_name_joints_and_links():
    table = simulate_six_joints().table("m1")
    assert table["q3_rad"].meaning.endswith("joint 3, elbow")
    inertia = table["theta_hat3_Izz_kg_m2"]
    assert (inertia.unit, inertia.source) == ("kg m^2", "theta_hat[29]")
    assert (inertia.values == simulate_six_joints()["m1"].theta_hat[:, 29]).all()
    assert table["theta_hat1_m_kg"].unit == "kg"
    channels = Ros2SiteChannels(simulate_six_joints().scenario, "m1")
    assert channels.joints == JOINTS
    names = channels.arrays["theta_hat"].channel.about["names"].split(" ")
    assert (len(names), names[0], names[29]) == (60, "shoulder.m", "forearm.Izz")


@pytest.mark.parametrize(
    ("scenario", "side"),
    [("two_people", charts.PICTURE_SIDE), ("paper", None)],
)
def test_small_planar_arms_have_lines_as_thin(scenario, side):
    log = tn.simulate(scenario, duration_s=0.5)
    builder = charts.ChartBuilder(log, None)
    data = builder.build().data.to_builtins()
    left, right, bottom, top = data["bounds_m"]
    arm_m = log.scenario.arms["s"].lengths_m
    assert data["arms"][-1]["links_m"] == [builder.units_per_m * link_m for link_m in arm_m]
    if side is None:
        assert builder.units_per_m == 1.0
    else:
        assert max(right - left, top - bottom) == pytest.approx(side)


@pytest.mark.long
def test_the_page_draws_chains_from_their_joints():
    log = simulate_six_joints()
    builder = charts.ChartBuilder(log, None)
    data = builder.build().data.to_builtins()
    assert [arm["points"] for arm in data["arms"]] == [7, 7, 7]
    table = data["tables"][data["arms"][0]["table"]]
    assert len(table["columns"]) == 3 * 7 * 2
    titles = [chart["title"] for chart in data["charts"] if chart["section"] == "estimates"]
    assert titles[29] == "forearm.Izz"
    svg = arm_poses.render_arms_svg(log, builder.bounds_m, builder.units_per_m)
    box = [float(x) for x in re.search(r'viewBox="([^"]*)"', svg).group(1).split()]
    assert max(box[2:]) == pytest.approx(charts.PICTURE_SIDE, abs=2e-3)
    assert svg.count('class="shadow"') == svg.count('class="desired"') > 4
    assert len(json.dumps(data)) < 3_000_000
