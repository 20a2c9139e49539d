"""What the fields of a message mean, and in which unit they are: as its type says.

Law: there is no second list. Units stand in the schema, meanings in the type's documentation.
"""

import inspect
import re
from functools import cache
from typing import Any, NamedTuple

import msgspec

from ..net.messages import json_schema

_FIELD = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
_NAMED = {"t_ns": "ns", "sent_ns": "ns", "tick": "tick"}
"""Units of fields whose name says them, or that count ticks."""
_ALONE = {
    "qd_des": "derivative of the reference, Eq. (6)",
    "delay_max_us": "per peer, largest one-way delay since the last statistics; -1 where nothing came",
    "late": "per peer, samples that came after they were due",
    "duplicate": "per peer, samples that came twice",
    "refused": "per peer, samples whose stamp was out of range",
    "lost": "per peer, samples that the link's model lost",
}
"""Where the documentation leans on the line before: the same without that line."""


class Meaning(NamedTuple):
    """What a field is.

    Attributes:
        unit: its unit, "" where it has none.
        text: a sentence's worth.
        kind: its type, as JSON Schema has it.
    """

    unit: str
    text: str
    kind: str


@cache
def meanings(kind: type[msgspec.Struct]) -> dict[str, Meaning]:
    """Returns what every field of a message type is, in the order of its definition."""
    texts = dict(_FIELD.findall(inspect.getdoc(kind) or ""))
    texts |= {name: _ALONE[name] for name in texts.keys() & _ALONE.keys()}
    properties: dict[str, dict[str, Any]] = json_schema(kind)["properties"]
    return {
        name: Meaning(
            entry.get("x-unit", _NAMED.get(name, _ending(name))),
            " ".join(texts.get(name, entry.get("description", "")).split()).rstrip("."),
            entry["type"],
        )
        for name, entry in properties.items()
    }


def _ending(name: str) -> str:
    """Returns the unit that a field's name ends in."""
    ending = name.rpartition("_")[2]
    return {"ns": "ns", "us": "us", "ppb": "ns/s"}.get(ending, "")
