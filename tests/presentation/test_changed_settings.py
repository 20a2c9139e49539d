"""The head of a report names settings that differ from the scenario whose title it has."""

import pytest

from trilat_net.presentation.page_origin import describe_changes
from trilat_net.scenario import load_scenario


def test_changed_link_is_named() -> None:
    changed = load_scenario("two_people", {"link.delay_ms": 800})
    assert describe_changes(changed) == "every link: 800 ms instead of 400 ms"


@pytest.mark.parametrize("overrides", [{}, {"seed": 7}, {"duration_s": 3.0}])
def test_unchanged_scenario_has_no_changes(overrides: dict[str, float]) -> None:
    assert describe_changes(load_scenario("two_people", overrides)) == ""


def test_scenario_of_another_title_is_not_compared() -> None:
    changed = load_scenario("two_people", {"title": "Mine", "link.delay_ms": 800})
    assert describe_changes(changed) == ""


def test_many_changes_are_counted() -> None:
    overrides = {"control.Kd": 3.0, "control.Lambda": 2.0, "link.loss": 0.1, "rate_hz": 500}
    text = describe_changes(load_scenario("paper", {**overrides, "scheme": "digital"}))
    assert text.count(" instead of ") == 3
    assert "more setting" in text
