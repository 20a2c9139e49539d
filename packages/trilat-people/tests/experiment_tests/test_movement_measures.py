"""Measures of people's movements, against numbers that their authors publish, and laws of physics."""

import numpy as np
import pytest
from trilat_people.experiment.movement_measures import (
    TLX_SCALES,
    energy_j,
    find_internal_force,
    measure_pair,
    measure_throughput,
    movement_time_s,
    path_length_m,
    raw_tlx,
    sparc,
    sus_score,
    weighted_tlx,
)

from trilat_net.errors import UsageError

T_S = np.arange(-1.0, 1.0, 0.01)
BELL = np.exp(-5.0 * T_S**2)
"""The example in the docstrings of github.com/siva82kb/SPARC, scripts/smoothness.py, at 100 Hz."""


def test_smoothness_has_the_numbers_of_its_authors() -> None:
    assert f"{sparc(BELL, 100.0):.5f}" == "-1.41403"


def make_minimum_jerk_speed(duration_s: float, rate_hz: float) -> np.ndarray:
    """Returns the speed of a movement of minimum jerk over 1 m."""
    tau = np.linspace(0.0, 1.0, int(duration_s * rate_hz) + 1)
    return 30.0 * tau**2 * (1.0 - tau) ** 2 / duration_s


def test_smoothness_ignores_amplitude_and_falls_with_submovements() -> None:
    """Smoothness depends on neither amplitude nor duration, and two movements are less smooth."""
    speed = make_minimum_jerk_speed(1.0, 200.0)
    smoothness = sparc(speed, 200.0)
    slower = make_minimum_jerk_speed(2.0, 100.0)
    assert sparc(7.0 * speed, 200.0) == pytest.approx(smoothness, abs=1e-9)
    assert sparc(slower, 100.0) == pytest.approx(smoothness, abs=0.02)
    assert sparc(np.concatenate([speed, speed]), 200.0) < smoothness - 0.2


def test_rest_has_neither_smoothness_nor_movement_time() -> None:
    rest = np.zeros(50)
    assert sparc(rest, 100.0) is movement_time_s(rest, 100.0) is None


def test_movement_lasts_while_speed_is_above_its_threshold() -> None:
    speed = np.concatenate([np.zeros(30), make_minimum_jerk_speed(0.8, 1000.0), np.zeros(100)])
    tau = np.linspace(0.0, 1.0, 100_001)
    above = tau[16.0 * tau**2 * (1.0 - tau) ** 2 >= 0.05]
    assert movement_time_s(speed, 1000.0) == pytest.approx(
        0.8 * (above[-1] - above[0]), abs=2e-3
    )


def test_path_of_a_circle() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 2001)
    places = 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert path_length_m(places) == pytest.approx(0.6 * np.pi, rel=1e-5)


def test_force_work_is_a_masss_kinetic_energy() -> None:
    t_s = np.arange(0.0, 1.0, 1e-3)
    velocity = np.column_stack([np.sin(3.0 * t_s), t_s**2])
    force = 2.0 * np.column_stack([3.0 * np.cos(3.0 * t_s), 2.0 * t_s])
    kinetic = float(velocity[-1] @ velocity[-1])
    assert energy_j(force, velocity, 1000.0) == pytest.approx(kinetic, rel=1e-5)


# The example in the documentation of MacKenzie's class Throughput (yorku.ca/mack/FittsLawSoftware, GoFitts):
# one dimension, serial, targets at 540 and 227 pixels; its output with -s says Ae 327.05, We 105.692130,
# IDe 2.033640, MT 251.85 ms, throughput 8.074805.
SELECTED = "218 529 195 533 209 607 231 540 231 560 207 524 239 515 180 501 215 571 215 521"
HEIGHTS = "534 496 608 547 651 554 650 568 642 567 653 604 704 610 675 606 666 621 690 641"
TIMES_MS = "262 268 248 233 251 252 283 214 301 266 258 258 248 242 241 252 243 255 252 210"


def read_published_movements() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns starts, targets, ends and times (s) of the published example."""
    starts = np.array([[540.0, 592.0], [227.0, 592.0]] * 10)
    targets = np.array([[227.0, 592.0], [540.0, 592.0]] * 10)
    ends = np.column_stack(
        [np.array(text.split(), dtype=float) for text in (SELECTED, HEIGHTS)]
    )
    return starts, targets, ends, np.array(TIMES_MS.split(), dtype=float) / 1e3


def test_throughput_equals_the_published_example() -> None:
    throughput = measure_throughput(*read_published_movements(), serial=True)
    assert throughput.distance_m == pytest.approx(327.05, abs=5e-7)
    assert throughput.width_m == pytest.approx(105.692130, abs=5e-7)
    assert throughput.difficulty_bits == pytest.approx(2.033640, abs=5e-7)
    assert throughput.time_s == pytest.approx(0.25185, abs=5e-9)
    assert throughput.bits_s == pytest.approx(8.074805, abs=5e-7)


def test_throughput_depends_on_no_frame_and_no_unit() -> None:
    starts, targets, ends, times_s = read_published_movements()
    angle = 0.7
    turn = 2.5e-4 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = measure_throughput(
        *(points @ turn.T + 3.0 for points in (starts, targets, ends)), times_s
    )
    plain = measure_throughput(starts, targets, ends, times_s)
    assert turned.bits_s == pytest.approx(plain.bits_s, rel=1e-9)
    assert turned.width_m == pytest.approx(2.5e-4 * plain.width_m, rel=1e-9)
    assert plain.distance_m == pytest.approx(313.0 + 6.55)


def test_end_points_without_spread_have_no_throughput() -> None:
    starts, targets, _, times_s = read_published_movements()
    assert measure_throughput(starts, targets, targets, times_s) is None
    assert measure_throughput(starts[:1], targets[:1], targets[:1] + 1.0, times_s[:1]) is None


def test_useful_forces_oppose_each_other_nowhere() -> None:
    rng = np.random.default_rng(4)
    first, second = rng.normal(size=(2, 400, 3))
    internal = find_internal_force(first, second)
    assert ((first - internal) * (second + internal) >= 0.0).all()
    smaller = np.minimum(np.abs(first), np.abs(second))
    np.testing.assert_array_equal(
        np.abs(internal), np.where(first * second < 0.0, smaller, 0.0)
    )


def test_users_who_oppose_each_other_move_nothing() -> None:
    push_n = np.full((101, 1), 3.0)
    at_rest = np.zeros((101, 1))
    measures = measure_pair(push_n, -push_n, at_rest, 100.0)
    assert measures.internal_rms_n == 3.0
    assert measures.useful_rms_n == 0.0
    assert measures.internal_share == 1.0
    assert measure_pair(at_rest, at_rest, at_rest, 100.0).first_effort_share is None


def test_users_who_push_together_share_the_work() -> None:
    """Forces of 3 N and 6 N at 0.5 m/s over 1 s do 1.5 J and 3 J, and none of them is internal."""
    push_n = np.full((101, 1), 3.0)
    speed_m_s = np.full((101, 1), 0.5)
    measures = measure_pair(push_n, 2.0 * push_n, speed_m_s, 100.0)
    assert measures.internal_share == 0.0
    assert measures.first_effort_share == pytest.approx(1.0 / 5.0)
    assert measures.first_work_j == pytest.approx(1.5)
    assert measures.second_work_j == pytest.approx(3.0)


def test_power_flows_from_the_user_who_leads() -> None:
    t_s = np.linspace(0.0, 1.0, 1001)
    velocity = np.sin(np.pi * t_s)[:, None]
    measures = measure_pair(4.0 * velocity, -1.0 * velocity, velocity, 1000.0)
    assert measures.first_taken_j == pytest.approx(0.0, abs=1e-5)
    assert measures.second_taken_j == pytest.approx(0.5, abs=1e-5)
    work_j = measures.first_work_j + measures.second_work_j
    assert work_j == pytest.approx(energy_j(3.0 * velocity, velocity, 1000.0))


def test_samples_that_do_not_belong_together_are_named() -> None:
    with pytest.raises(UsageError, match=r"force \(5, 2\), velocity \(4, 2\)"):
        energy_j(np.zeros((5, 2)), np.zeros((4, 2)), 100.0)
    with pytest.raises(UsageError, match="speed: a sample is not a finite number"):
        sparc([0.0, np.nan, 1.0], 100.0)
    with pytest.raises(UsageError, match="give a time above 0 for each of 20"):
        measure_throughput(*read_published_movements()[:3], np.zeros(20))


# The demonstration of github.com/nicoversity/tlx-vis-r: weights and ratings in tlx_individual_demo.R; the bar
# of its published figure is 243.29 points high on an axis of 532.76 points for 100.
RATINGS = dict(zip(TLX_SCALES, (45.0, 30.0, 5.0, 95.0, 25.0, 50.0), strict=True))
WEIGHTS = dict(zip(TLX_SCALES, (3, 1, 3, 4, 3, 1), strict=True))


def test_task_load_equals_the_published_example() -> None:
    assert weighted_tlx(RATINGS, WEIGHTS) == pytest.approx(100.0 * 243.29 / 532.76, abs=2e-3)
    assert raw_tlx(RATINGS) == pytest.approx(250.0 / 6.0)


@pytest.mark.parametrize(
    "weights", [(5, 5, 5, 0, 0, 0), (3, 3, 3, 3, 2, 2), (6, 4, 3, 2, 0, 0), (3, 1, 3, 4, 3)]
)
def test_weights_that_no_comparisons_give_are_refused(weights: tuple[int, ...]) -> None:
    given = dict(zip(TLX_SCALES, weights, strict=False))
    with pytest.raises(UsageError, match="15 pairwise comparisons"):
        weighted_tlx(RATINGS, given)


def test_ratings_out_of_range_are_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"effort = 101\.0: .* between 0 and 100"):
        raw_tlx({**RATINGS, "effort": 101.0})
    with pytest.raises(UsageError, match="for each of mental, physical"):
        raw_tlx({"mental": 3.0})


def test_usability_score_has_its_example_and_its_ends() -> None:
    """Brooke (1996), from memory: contributions of 22 times 2.5."""
    assert sus_score([5, 4, 2, 1, 2, 3, 2, 4, 5, 2]) == 55.0
    assert sus_score([5, 1] * 5) == 100.0
    assert sus_score([1, 5] * 5) == 0.0
    assert sus_score([3] * 10) == 50.0
    with pytest.raises(UsageError, match="answer 4 = 6"):
        sus_score([1, 2, 3, 6, 1, 1, 1, 1, 1, 1])
    with pytest.raises(UsageError, match="SUS has 10"):
        sus_score([1, 2])
