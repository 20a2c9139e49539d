"""Tables that an author writes: their keys, their types, and the words that refuse others."""

from typing import Any

import msgspec
import pytest

from trilat_net.errors import ScenarioError
from trilat_net.recorded_change import RecordedChange
from trilat_net.scenario import Scenario, SiteSpec, field_names, list_shipped, load_scenario
from trilat_net.scenario.refusals import check_table
from trilat_net.scenario.scenario_types import SITE_GROUPS
from trilat_net.scenario.written_kinds import written_kind
from trilat_net.scenario.written_tables import WrittenChange, WrittenScenario, WrittenSite


def refusal(overrides: dict[str, Any]) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper", overrides)
    return caught.value


def test_authors_may_write_every_key() -> None:
    assert set(field_names(WrittenSite)) == set(field_names(SiteSpec))
    assert set(field_names(WrittenScenario)) >= {*field_names(Scenario), *SITE_GROUPS}
    assert set(field_names(WrittenChange)) < set(field_names(RecordedChange))
    for kind in SITE_GROUPS.values():
        assert field_names(written_kind(kind)) == field_names(kind)


@pytest.mark.parametrize("name", list_shipped())
def test_complete_groups_may_be_written(name: str) -> None:
    for site in load_scenario(name).sites.values():
        for group, kind in SITE_GROUPS.items():
            complete = msgspec.to_builtins(getattr(site, group))
            written = {key: value for key, value in complete.items() if value is not None}
            check_table(written, written_kind(kind), group)


@pytest.mark.parametrize(
    ("key", "value", "path", "problem"),
    [
        ("arm.l1_m", {}, "arm.l1_m", "expected a number, got a table"),
        ("arm.l1_m", [1.0], "arm.l1_m", "expected a number, got a list"),
        ("arm.known", {"normal": [1, 1]}, "arm.known", "expected true or false, got a table"),
        (
            "control.Kd",
            {"mean": 1.0},
            "control.Kd",
            "expected a number, or a list with one for each coordinate that the sites share, "
            "got a table",
        ),
        ("control.Kd", [1.0, {"normal": [1]}], "control.Kd[1]", "must be { normal = [mean,"),
        ("on_stale.action", "stop", "on_stale.action", "is 'stop', but must be 'use' or"),
        (
            "arm.links",
            {"a": {"mass_kg": 1}, "b": {"mass_kg": "1 kg"}},
            "arm.links.b.mass_kg",
            "e",
        ),
        ("expect.end_pose_rad", {"m1": 1.0}, "expect.end_pose_rad.m1", "expected a list"),
        ("sites", 5, "sites", "must be tables [sites.NAME], but is 5"),
        ("drawn", {"a": {"value": 1.0}, "b": {}}, "drawn.b.value", "is missing"),
        ("timeline", [{"link": "m1->s"}], "timeline[0].at_s", "the value must be a time in s"),
        ("control.law", "x" * 300, "control.law", "must be one of"),
    ],
)
def test_wrong_values_are_refused_where_written(
    key: str, value: Any, path: str, problem: str
) -> None:
    error = refusal({key: value})
    assert (error.path, problem in error.problem) == (path, True), error


@pytest.mark.parametrize(
    "key", ["x - at y", "x` - at `$.sites", "x` - at `$.y[...].z[9]", "`$"]
)
def test_keys_like_messages_are_unknown_keys(key: str) -> None:
    """A key that looks like the end of a message of msgspec does not hide the refusal."""
    with pytest.raises(ScenarioError, match="unknown key"):
        check_table({key: 1}, WrittenScenario, "")


def test_random_tasks_keep_the_vectors_complete() -> None:
    """The coordinates that sites share do not depend on the random numbers of the task."""
    drawn = load_scenario("unlike_arms", {"sites.m1.task.scale": {"uniform": [1.0, 2.0]}})
    certain = load_scenario("unlike_arms")
    assert 1.0 < drawn.sites["m1"].task.scale < 2.0
    assert len(drawn.sites["m1"].control.Kd) == len(certain.sites["m1"].control.Kd)
    assert load_scenario(drawn.text) == drawn
