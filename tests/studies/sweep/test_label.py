"""What an axis is called: the word of its key, and the unit that the key ends in."""

import pytest

from trilat_net.scenario import load_scenario
from trilat_net.scenario.scenario_reader import list_shipped
from trilat_net.studies.sweep.map_plane import label_axis, label_setting


@pytest.mark.parametrize(
    ("key", "text"),
    [
        ("link.delay_ms", "delay (ms)"),
        ("link.half_width_ms", "half width (ms)"),
        ("link.loss", "loss"),
        ("rate_hz", "rate (Hz)"),
        ("control.K", "K (N m/rad)"),
        ("control.d", "d (N m s/rad)"),
        ("control.Gamma", "Gamma"),
        ("arm.I1_kg_m2", "I1 (kg m²)"),
        ("limits.qd_limit_rad_s", "qd limit (rad/s)"),
        ("sites.m.control.k_f", "k_f of m"),
        ("links.m1->s.delay_ms", "delay m1->s (ms)"),
        ("dominance.s.m1", "m1's share in s"),
        ("sites.s.q0_rad.1", "q0[1] of s (rad)"),
    ],
)
def test_a_key_is_told_in_its_words_and_its_unit(key: str, text: str) -> None:
    assert label_axis(key) == text


def test_what_a_number_means_is_told_by_the_scenario() -> None:
    key = "sites.s.environment.0.stiffness_n_m"
    assert label_axis(key, load_scenario("contact")) == "stiffness, wall of s (N/m)"
    assert (
        label_axis("sites.m.hands.0.damping_nm_s_rad", load_scenario("contact"))
        == "damping, spring of m (N m s/rad)"
    )


def test_every_suffix_of_a_shipped_arm_and_its_limits_is_a_unit() -> None:
    """No label shows a piece of a unit as if it were a word."""
    spec = next(iter(load_scenario(list_shipped()[0]).sites.values()))
    for table in (spec.arm, spec.limits):
        for field in table.__struct_fields__:
            if field not in ("known",):
                assert label_axis(f"arm.{field}").endswith(")"), field


def test_a_place_is_its_value_in_its_unit() -> None:
    assert label_setting("link.playout_ms", 400.0) == "playout 400 ms"
    assert label_setting("link.loss", 0.25) == "loss 0.25"
    assert label_setting("link.order", "in_order") == "order in order"
