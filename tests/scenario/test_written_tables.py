"""Tables that an author writes: their keys, their types, and the words that refuse others."""

import msgspec
import pytest

from trilat_net.errors import ScenarioError
from trilat_net.recorded_change import RecordedChange
from trilat_net.scenario import Scenario, list_shipped, load_scenario
from trilat_net.scenario.key_checks import field_names
from trilat_net.scenario.refusals import check_table
from trilat_net.scenario.site_spec import SITE_GROUPS, SiteSpec
from trilat_net.scenario.written_kinds import written_kind
from trilat_net.scenario.written_tables import WrittenChange, WrittenScenario, WrittenSite


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
