"""What a wall tells apart: scenarios `contact` and `windup`."""

import pytest

from tests.theory.figures_of_runs import measured, printed, value

LATE = (9.0, 15.0, "s")


def test_direct_force_reflection_hammers_at_200_ms() -> None:
    made = measured("contact", {}, LATE)
    assert value(made, "wall_mean_n") == printed(8.0, 1.0)
    assert value(made, "wall_deviation_n") == printed(14.0, 1.0)
    assert value(made, "wall_peak_n") == printed(52.0, 1.0)
    assert value(made, "wall_hits") == 3


def test_at_20_ms_there_is_one_hit() -> None:
    made = measured("contact", {"link.delay_ms": 20.0}, (0.0, 15.0, "s"), (14.0, 15.0, "s"))
    assert value(made, "wall_hits") == 1
    assert value(made, "wall_mean_n", 1) == printed(3.3, 0.1)
    assert value(made, "wall_deviation_n", 1) < 0.01


def test_a_fifth_of_the_force_settles() -> None:
    made = measured("contact", {"sites.m.control.k_f": 0.2}, (14.0, 15.0, "s"))
    assert value(made, "wall_mean_n") == printed(8.5, 0.1)
    assert value(made, "wall_deviation_n") < 0.05


def test_free_motion_is_calm_at_200_ms() -> None:
    made = measured("contact", {"sites.s.environment": []}, (14.0, 15.0, "s"))
    assert value(made, "speed_peak_rad_s") < 1e-6
    assert made.end_error_rad is not None
    assert made.end_error_rad < 1e-6


@pytest.mark.parametrize(
    "law",
    [{"law": "pd_d"}, pytest.param({"law": "p_d", "K": 100.0, "d": 40.0}, marks=pytest.mark.long)],
    ids=str,
)
def test_laws_that_exchange_positions_pass_the_same_wall(law: dict[str, object]) -> None:
    """Both sites under one law of positions, in place of force reflection: the contact comes to rest."""
    made = measured(
        "contact",
        {"control": law, "sites.m.control": {}, "sites.s.control": {}, "duration_s": 25.0},
        (24.0, 25.0, "s"),
    )
    assert value(made, "wall_mean_n") > 1.0
    assert value(made, "wall_deviation_n") < 0.05


@pytest.mark.long
def test_without_learning_gravity_nothing_winds_up() -> None:
    made = measured(
        "windup",
        {"control.Gamma": [1.0, 1.0, 1.0, 0.0, 0.0], "duration_s": 20.0},
        (10.0, 10.2, "s"),
        (19.8, 20.0, "s"),
    )
    assert value(made, "wall_mean_n", 1) == pytest.approx(value(made, "wall_mean_n", 0), abs=0.02)
