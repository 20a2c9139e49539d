"""What the shipped scenarios expect are the figures, within their last printed digit or 2 %.

That they meet what they expect is tested in `tests/studies/trials/test_shipped.py`.
"""

import pytest

from trilat_net.scenario import load_scenario

FIGURES = [
    ("contact", "wall_mean_n", (9.0, 15.0), 8.0, 1.0),
    ("contact", "wall_deviation_n", (9.0, 15.0), 14.0, 1.0),
    ("contact", "wall_peak_n", (9.0, 15.0), 52.0, 1.0),
    ("windup", "wall_mean_n", (5.8, 6.2), 1.0, 0.1),
    ("windup", "wall_mean_n", (9.9, 10.1), 4.3, 0.1),
    ("windup", "wall_mean_n", (19.9, 20.1), 8.5, 0.1),
    ("windup", "wall_mean_n", (58.9, 59.1), 10.7, 0.1),
    ("box", "q1_rad", (12.0, 60.0), 0.502, 1e-3),
    ("box", "q2_rad", (12.0, 60.0), -0.496, 1e-3),
    ("training", "q1_rad", (9.0, 10.0), -0.6 + 0.203, 1e-3),
    ("training", "q1_rad", (25.0, 30.0), -0.6 - 0.203, 1e-3),
    ("force_sharing", "push1_mean_nm", (13.0, 15.0), -4.79, 0.01),
    ("force_sharing", "push1_mean_nm", (38.0, 40.0), -16.4, 0.1),
    ("force_sharing", "push1_mean_nm", (52.0, 54.0), -5.0, 0.01),
    ("jitter", "error_peak_rad", (38.0, 40.0), 0.022, 1e-3),
    ("outage", "speed_peak_rad_s", (6.0, 15.0), 0.41, 0.01),
    ("outage", "torque_peak_nm", (6.0, 15.0), 35.0, 1.0),
]
"""Scenario, quantity, window, figure, its last printed digit.

A wall's force at a time is its mean over 0.2 or 0.4 s about it; with a force that hammers, over three hits.
"""


@pytest.mark.parametrize(("name", "key", "window", "figure", "digit"), FIGURES)
def test_limits_of_window_are_figure_within_its_bar(
    name: str, key: str, window: tuple[float, float], figure: float, digit: float
) -> None:
    asked = {(w.from_s, w.to_s): dict(w.asked) for w in load_scenario(name).expect.windows}
    least, most = asked[window][key]
    bar = max(digit, 0.02 * abs(figure))
    assert figure - bar <= least + 1e-12
    assert most <= figure + bar + 1e-12
    assert least <= figure <= most


@pytest.mark.parametrize(("name", "settled_s"), [("free", 11.9), ("outage", 12.4)])
def test_so_are_the_times_at_which_they_settle(name: str, settled_s: float) -> None:
    by_s = load_scenario(name).expect.synchronised_by_s
    assert by_s is not None
    assert settled_s <= by_s <= 1.02 * settled_s


def test_paper_ends_where_the_anchor_is() -> None:
    expect = load_scenario("paper").expect
    assert set(expect.end_pose_rad.values()) == {(-0.1729, 0.0874)}
    assert expect.end_pose_within_rad <= 0.02 * 0.0874
