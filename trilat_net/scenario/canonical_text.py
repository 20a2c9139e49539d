"""Writes a complete scenario as TOML in canonical form.

The SHA-256 hash of the canonical text identifies the experiment.

Invariant:
    - Keys that have no effect are omitted, so they do not change the hash of a scenario.
"""

import re
from typing import Any

import msgspec
import tomli_w

from ..core import ArmLinks
from .arms import Arm

_ABSENT_VALUES: dict[str, tuple[Any, ...]] = {
    **dict.fromkeys(("timeline", "environment"), ((), [])),
    **dict.fromkeys(("expect", "drawn", "urdf", "on_stale", "task", "sends"), ({},)),
    "plant": ("simulated",),
    **dict.fromkeys(
        ("tau_rate_limit_nm_s", "qd_des_limit_rad_s", "q_min_rad", "q_max_rad", "view"), (None,)
    ),
}
"""Values equivalent to a missing key, for keys that were added in later versions.

They are omitted from the canonical text; otherwise, the text and hash of an older scenario
would change.
"""
_NUMBER_LIST = re.compile(r"\[\n(?:    [-+.\de]+,\n)+\]")
"""Matches a list with each number on its own line, as written by `tomli_w`."""


def write_canonical_text(tables: dict[str, Any]) -> str:
    """Formats a complete scenario as TOML in canonical form.

    Args:
        tables: All keys of the scenario as nested tables. Keys that have no effect are omitted
            from the text.
    """
    descriptions = {key: tables.pop(key) for key in ("name", "title", "about", "assumed")}
    descriptions = {key: value for key, value in descriptions.items() if value}
    for site in tables["sites"].values():
        _drop_unused_keys(site["arm"])

    _drop_absent_values(tables)
    for site in tables["sites"].values():
        _drop_absent_values(site)
        _drop_absent_values(site["control"])
        _drop_absent_values(site["limits"])

    # Texts for people may have several lines. Lists of numbers are written on one line.
    urdf_texts = tables.pop("urdf", None)
    description_text = tomli_w.dumps(descriptions, multiline_strings=True)
    number_text = _NUMBER_LIST.sub(_join_number_list, tomli_w.dumps(tables))
    urdf_text = ""
    if urdf_texts:
        urdf_text = tomli_w.dumps({"urdf": urdf_texts}, multiline_strings=True)
    return description_text + number_text + urdf_text


def _drop_unused_keys(arm: dict[str, Any]) -> None:
    """Removes keys that have no effect from the table of an arm, in place.

    These are keys of the other kind of arm, and keys of a chain that have their default values.
    """
    defaults = msgspec.to_builtins(Arm())
    is_chain = bool(arm["urdf"])
    unused_keys = ArmLinks._fields if is_chain else ()
    kept_keys = () if is_chain else (*ArmLinks._fields, "g_m_s2")
    for key, value in list(arm.items()):
        if key in unused_keys or (key not in kept_keys and value == defaults[key]):
            del arm[key]


def _drop_absent_values(table: dict[str, Any]) -> None:
    """Removes values that are equivalent to a missing key from a table, in place."""
    for key, absent_values in _ABSENT_VALUES.items():
        if key in table and table[key] in absent_values:
            del table[key]


def _join_number_list(match: re.Match[str]) -> str:
    """Joins a list of numbers that spans several lines of TOML into one line."""
    return " ".join(match[0].split()).replace("[ ", "[").replace(", ]", "]")
