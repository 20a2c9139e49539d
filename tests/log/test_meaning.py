"""Every field of every message says what it is; where a name has a unit, the schema has the same."""

import msgspec
import pytest

from trilat_net.log.data_tables import read_field_docs
from trilat_net.net.messages import Event, LinkStats, RecorderStats, State

KINDS = (State, LinkStats, Event, RecorderStats)


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_has_a_meaning(kind: type[msgspec.Struct]) -> None:
    said = read_field_docs(kind)
    assert list(said) == list(kind.__struct_fields__)
    for field, (_, text, json_type) in said.items():
        assert len(text) > 5, field
        assert "  " not in text
        assert json_type in ("integer", "string", "array", "object")


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_that_ends_in_a_unit_has_that_unit(kind: type[msgspec.Struct]) -> None:
    units = {"us": "us", "ns": "ns", "ppb": "ns/s", "bytes": "byte"}
    for field, (unit, _, _) in read_field_docs(kind).items():
        if ending := units.get(field.rpartition("_")[2]):
            assert unit == ending, field


def test_units_are_the_schemas() -> None:
    said = read_field_docs(State)
    assert [said[field].unit for field in ("q", "qd", "q_des", "qd_des", "tau", "tau_x")] == [
        "rad", "rad/s", "rad", "rad/s", "N m", "N m",
    ]  # fmt: skip
    assert said["q_des"].text == "reference, Eq. (6)"
