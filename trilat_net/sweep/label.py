"""What an axis of a map is called.

Law: the word is that of the scenario's key, and the unit is the one that the key ends in; a gain, whose key
is the paper's symbol alone, has the unit that its law states.
"""

from typing import Any

from ..scenario import Scenario
from ..scenario.tables import is_number

_UNITS = {
    "_nm_s_rad": "N m s/rad",
    "_nm_rad": "N m/rad",
    "_n_s_m": "N s/m",
    "_kg_m2": "kg m²",
    "_n_m": "N/m",
    "_m_s2": "m/s²",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_ms": "ms",
    "_hz": "Hz",
    "_nm": "N m",
    "_kg": "kg",
    "_m": "m",
    "_s": "s",
}
"""The longest that a key ends in counts."""
_GAINS = {
    "K": "N m/rad",
    "d": "N m s/rad",
    "Kp": "N m s/rad",
    "Kd": "N m s/rad",
    "Lambda": "1/s",
}


def label(key: str, scenario: Scenario | None = None) -> str:
    """Returns the label of an axis, as "delay (ms)" for link.delay_ms.

    Args:
        key: dotted, as an override names it.
        scenario: whose key, for the words of what is told by a number, as a wall.
    """
    words, unit = described(key, scenario)
    return f"{words} ({unit})" if unit else words


def place(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a key with its value, as "delay 200 ms" for link.delay_ms = 200."""
    words, unit = described(key, scenario)
    if isinstance(value, bool):
        value = str(value).lower()
    number = f"{value:g}" if is_number(value) else str(value).replace("_", " ")
    return " ".join(word for word in (words, number, unit) if word)


def described(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Returns what a key sets, in words, and its unit, "" where it has none."""
    *folders, last = key.split(".")
    number = ""
    if last.isdigit() and folders:  # one of several joints or parameters
        *folders, last, number = *folders, f"[{last}]"
    word, unit = _parts(last)
    return f"{word}{number}{_owner(folders, scenario)}", unit


def _parts(last: str) -> tuple[str, str]:
    """Returns the words of a key, and its unit or ""."""
    if last in _GAINS:
        return last, _GAINS[last]
    for ending, unit in sorted(_UNITS.items(), key=lambda pair: -len(pair[0])):
        if last.endswith(ending):
            return last.removesuffix(ending).replace("_", " "), unit
    return last if len(last) <= 3 else last.replace("_", " "), ""


def _owner(folders: list[str], scenario: Scenario | None) -> str:
    """Returns whose key it is, in words; "" for a group's."""
    match folders:
        case ["sites", site, ("hands" | "environment") as group, number]:
            return f", {_kind(site, group, number, scenario)} of {site}"
        case ["sites", site, *_]:
            return f" of {site}"
        case ["links", link, *_]:
            return f" {link}"
        case ["dominance", site]:
            return f"'s share in {site}"
        case _:
            return ""


def _kind(site: str, group: str, number: str, scenario: Scenario | None) -> str:
    """Returns what kind of hand or environment a number means; the group's word where that is not known."""
    if scenario is not None and site in scenario.sites and number.isdigit():
        spec = scenario.sites[site]
        some = spec.hands if group == "hands" else spec.environment
        if int(number) < len(some):
            return str(some[int(number)].__struct_config__.tag).replace("_", " ")
    return "hand" if group == "hands" else "environment"
