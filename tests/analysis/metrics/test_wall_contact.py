"""Contact with walls, in closed form and against the figures in a scenario's text."""

import math

import pytest

from tests.analysis.builders import make_pair_log, make_run
from tests.log.builders import rewrite_log
from trilat_net.analysis.aligned import AlignedRecords
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.torque_sources import VirtualWall
from trilat_net.core.arms.two_link_arm import JOINTS

WALL = """
[[sites.s.environment]]
kind = "wall"
point_m = [1.9, 0.0]
normal = [-1.0, 0.0]
stiffness_n_m = 1000.0
damping_n_s_m = 20.0
"""


def swing_arm(_: str, t_s: float) -> dict[str, list[float]]:
    """The stretched arm turns through the horizontal: its tip is at 2 cos q."""
    angle = 0.5 * math.cos(2.0 * math.pi * t_s)
    return {"q": [angle, 0.0], "qd": [-math.pi * math.sin(2.0 * math.pi * t_s), 0.0]}


def test_force_depth_and_hits_of_a_swing() -> None:
    """2 cos q > 1.9 m twice a period; K depth - B outward speed, never pulling."""
    log = make_pair_log(swing_arm, more=WALL)
    figures = LogMetrics.of_log(log).walls["s/1"]
    force = []
    for t_s in log["s"].t_s.tolist():
        pose = swing_arm("s", t_s)
        depth = 2.0 * math.cos(pose["q"][0]) - 1.9
        inward = -2.0 * math.sin(pose["q"][0]) * pose["qd"][0]
        force.append(max(0.0, 1000.0 * depth + 20.0 * inward) if depth > 0.0 else 0.0)
    mean = sum(force) / len(force)
    assert figures["force_mean_n"].value == pytest.approx(mean, rel=1e-9)
    deviation = math.sqrt(sum((sample - mean) ** 2 for sample in force) / len(force))
    assert figures["force_deviation_n"].value == pytest.approx(deviation, rel=1e-9)
    assert figures["force_peak_n"].value == pytest.approx(max(force), rel=1e-9)
    assert figures["depth_max_m"].value == pytest.approx(0.1, rel=1e-4)
    assert figures["hits"].value == 8.0
    assert figures["contact_share"].value == pytest.approx(
        sum(sample > 0.0 for sample in force) / len(force)
    )


def test_contact_from_the_first_record_is_no_hit() -> None:
    metrics = LogMetrics.of_log(
        make_pair_log(lambda _, __: {"q": [0.0] * JOINTS, "qd": [0.0] * JOINTS}, more=WALL)
    ).walls["s/1"]
    assert metrics["hits"].value == 0.0
    assert metrics["contact_share"].value == 1.0
    assert metrics["end_force_mean_n"].value == pytest.approx(100.0)


def test_contact_that_began_in_gaps_is_no_hit() -> None:
    """A contact with an unknown beginning counts no hit, and missing records give no numbers."""
    whole = make_pair_log(swing_arm, more=WALL)
    torn = rewrite_log(
        whole, lambda state: not (state.site == "s" and 120 <= state.tick % 200 < 140)
    )
    before, after = (LogMetrics.of_log(log).walls["s/1"]["hits"].value for log in (whole, torn))
    assert (before, after) == (8.0, 4.0)


def test_contact_matches_the_scenario_text() -> None:
    """20 ms: one hit, then 3.3 N."""
    metrics = LogMetrics.of_log(
        make_run("contact", {"link.delay_ms": 20.0, "duration_s": 11.0, "rate_hz": 200}).log
    ).walls["s/1"]
    assert metrics["hits"].value == 1.0
    assert metrics["end_force_mean_n"].value == pytest.approx(3.3, abs=0.05)
    assert metrics["end_force_deviation_n"].value < 0.01


def test_contact_at_200_ms_hammers() -> None:
    """8 +- 14 N, peak 52 N."""
    figures = LogMetrics.of_log(make_run("contact", {"rate_hz": 200}).log).walls["s/1"]
    assert figures["force_peak_n"].value == pytest.approx(52.0, abs=0.5)
    assert figures["end_force_mean_n"].value == pytest.approx(8.0, rel=0.15)
    assert figures["end_force_deviation_n"].value == pytest.approx(14.0, rel=0.05)
    assert figures["end_hits"].value >= 2.0


def test_the_force_of_windup_creeps() -> None:
    """4.3 and 8.5 N at 10 and 20 s."""
    log = make_run("windup", {"duration_s": 40.0, "rate_hz": 50}).log
    track = AlignedRecords.by_site(log)["s"]
    end_effector = build_arm_rows(log.scenario, "s").place_end_effector(track.q, track.qd)
    (wall,) = VirtualWall.list_of_site(log.scenario, "s")
    force = wall.find_force(track.nominal_s, end_effector)
    assert force[50 * 10] == pytest.approx(4.3, abs=0.05)
    assert force[50 * 20] == pytest.approx(8.5, abs=0.1)
