"""Every key of every table of a scenario: values of other types or ranges, and misspelt keys.

The keys and their types are those of the structures that describe the tables, so that a new key
needs no case of its own.
"""

import math
from typing import Any, NamedTuple

import msgspec
import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_models import DELAY_MODELS
from trilat_net.scenario.expect import Expect
from trilat_net.scenario.key_checks import StructType, list_fields
from trilat_net.scenario.laws import LAWS
from trilat_net.scenario.operators import ENVIRONMENTS, OPERATORS
from trilat_net.scenario.site_spec import SITE_GROUPS
from trilat_net.scenario.written_kinds import written_kind
from trilat_net.scenario.written_tables import WrittenChange, WrittenScenario, WrittenSite

VALUES = (True, "odd text", -1, 0, 2**40, 0.5, 1e300, -1e300, {"odd": 1}, [["odd"]])
"""Values of all TOML types, of which each key accepts some."""


class Table(NamedTuple):
    """A table of a scenario.

    Attributes:
        path: Dotted path of the table, with a dot at the end.
        kind: Structure type with the keys that an author may write.
        chosen: Keys that the table needs, such as the name of the control law.
        is_entry: Whether the table is the first entry of a list of tables.
    """

    path: str
    kind: StructType
    chosen: dict[str, Any]
    is_entry: bool = False

    def write(self, key: str, value: object) -> dict[str, Any]:
        """Returns the overrides that set one key of the table."""
        if not self.chosen:
            return {f"{self.path}{key}": value}
        table = {**self.chosen, key: value}
        if self.is_entry:
            return {self.path.removesuffix("[0]."): [table]}
        return {self.path.removesuffix("."): table}


def list_tables() -> list[Table]:
    """Returns the tables of a scenario, with one table for each law, model and operator."""
    tables = [
        Table("", WrittenScenario, {}),
        Table("sites.m1.", WrittenSite, {}),
        Table("expect.", written_kind(Expect, takes_distributions=False), {}),
        Table("timeline[0].", WrittenChange, {"at_s": 1.0, "link": "m1->s"}, is_entry=True),
    ]
    for name, kind in SITE_GROUPS.items():
        tables.append(Table(f"{name}.", written_kind(kind), {}))
        tables.append(Table(f"sites.m1.{name}.", written_kind(kind), {}))
    for model, kind in DELAY_MODELS.items():
        written = written_kind(kind, takes_distributions=False)
        tables.append(Table("link.", written, {"model": model}))
        tables.append(Table("links.m1->s.", written, {"model": model}))
    for law, kind in LAWS.items():
        tables.append(Table("control.", written_kind(kind), {"law": law}))
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        for name, kind in kinds.items():
            path = f"sites.m1.{group}[0]."
            tables.append(Table(path, written_kind(kind), {"kind": name}, is_entry=True))
    return tables


TABLES = list_tables()


def describe(table: Table) -> str:
    """Returns the name of a table for the test, as in "control.law = p_d"."""
    chosen = [f"{key} = {value}" for key, value in table.chosen.items()]
    return table.path + ", ".join(chosen)


def is_accepted(value: object, hint: Any) -> bool:
    """Returns True if a type of a key accepts a value."""
    try:
        msgspec.convert(value, hint)
    except msgspec.ValidationError:
        return False
    return True


def find_refusal(table: Table, key: str, value: object) -> ScenarioError:
    """Returns the error of a scenario with one wrong key, and asserts that it names the key."""
    with pytest.raises(ScenarioError) as caught:
        load_scenario("paper", table.write(key, value))
    path = caught.value.path
    written = f"{table.path}{key}"
    is_inside = path.startswith((f"{written}.", f"{written}["))
    assert path == written or is_inside, (written, value, str(caught.value))
    assert caught.value.problem
    assert caught.value.exit_code == 2
    return caught.value


@pytest.mark.parametrize("table", TABLES, ids=describe)
def test_values_that_no_key_takes_name_it(table: Table) -> None:
    """Every key refuses a value of another type or range, and the error has its path."""
    for field in list_fields(table.kind):
        refused = [value for value in VALUES if not is_accepted(value, field.type)]
        assert refused, field.name
        for value in refused:
            find_refusal(table, field.encode_name, value)


@pytest.mark.parametrize("table", TABLES, ids=describe)
def test_infinite_numbers_of_every_key_name_it(table: Table) -> None:
    """Numbers that are not finite, and whole numbers of more than 64 bits, are refused."""
    for field in list_fields(table.kind):
        for value in (math.nan, math.inf, -math.inf):
            assert "finite" in find_refusal(table, field.encode_name, value).problem
        assert "64 bits" in find_refusal(table, field.encode_name, 2**64).problem


@pytest.mark.parametrize("table", TABLES, ids=describe)
def test_misspelt_keys_name_a_key(table: Table) -> None:
    """A key with one letter too many is unknown, and the error suggests another one."""
    for field in list_fields(table.kind):
        key = field.encode_name
        problem = find_refusal(table, f"{key}x", 1.0).problem
        assert problem.startswith("unknown key; did you mean '"), problem
