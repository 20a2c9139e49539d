"""The figures of how errors go away."""

import numpy as np
import pytest

from trilat_net.analysis import site_signals
from trilat_net.reporting.figures import joint_motion

from . import logs


def test_a_path_is_thinned_by_its_length_and_keeps_its_ends():
    turns = np.linspace(0.0, 6.0, 20_001) ** 3  # ever faster
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    kept = joint_motion.thin_path(circle)
    assert len(kept) < 0.6 * len(circle)
    assert kept[0].tolist() == circle[0].tolist()
    assert kept[-1].tolist() == circle[-1].tolist()
    gaps = np.hypot(*np.diff(kept, axis=0).T)
    assert gaps.max() < 2 * 0.01 * 2 + np.hypot(*np.diff(circle, axis=0).T).max()


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_an_arm_that_never_moves_is_a_point(rows):
    kept = joint_motion.thin_path(np.ones((rows, 2)))
    assert np.unique(kept, axis=0).tolist() == [[1.0, 1.0]]


def test_a_triangle_stands_where_a_site_settles():
    log = logs.simulated("two_sites")
    (axes,) = joint_motion.draw_settling(log).axes
    marks = [line.get_data() for line in axes.lines if line.get_marker() == "v"]
    settled = [site_signals.settling_time_s(log[site]) for site in log.sites]
    assert [float(t) for (t,), _ in marks] == pytest.approx([t for t in settled if t is not None])
    assert all(float(y) == site_signals.SETTLED_ERROR_RAD for _, (y,) in marks)


def test_a_phase_portrait_is_of_e_and_its_rate():
    log = logs.simulated("paper")
    line = joint_motion.draw_phase_portrait(log).axes[1].lines[0]
    part = log["m1"]
    both = np.stack([part.e[:, 1], (part.qd - part.qd_des)[:, 1]], axis=1)
    assert {tuple(row) for row in np.transpose(line.get_data()).tolist()} <= {tuple(r) for r in both.tolist()}


def test_the_limit_of_a_torque_is_drawn_where_it_was_reached():
    import trilat_net

    free = joint_motion.draw_control_torques(logs.simulated("paper"))
    assert [text.get_text() for text in free.legends[0].get_texts()][-1] != "limit"
    held = trilat_net.simulate("paper", {"duration_s": 1, "rate_hz": 200, "limits.tau_limit_nm": 20})
    figure = joint_motion.draw_control_torques(held)
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "limit"
    levels = {
        line.get_ydata()[0]
        for line in figure.axes[0].lines
        if line.get_transform() != figure.axes[0].transData
    }
    assert levels == {20.0, -20.0}
