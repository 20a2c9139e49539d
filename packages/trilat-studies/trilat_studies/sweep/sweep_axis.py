"""Parses the axes of a sweep. An axis is a scenario key together with its swept values.

Users write an axis as a string, such as "link.delay_ms=0:400:50". This module also defines the
names and units that label an axis in figures and tables.

Invariant:
    - The value of an axis is the text of an override, as a user would write it.
    - Ranges are computed in decimal arithmetic: 0.2:3:0.1 contains 0.3, not
      0.30000000000000004.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from typing import Any, NamedTuple

import numpy as np

from trilat_net.errors import ScenarioError
from trilat_net.fields import split_unit
from trilat_net.scenario import Scenario, is_number

from ..run_commands import format_toml_value

_ON_GRID = Decimal("1e-9")
"""Distance from the end of a range, in steps, within which a value is treated as equal to it.
"""
_KEYS_WITH_OPTIONS = {
    "seed": "seeds have their own option, as in --seeds 1..20",
    "duration_s": "the duration of a cell depends on its verdict: --duration sets the first "
    "duration, --longest the limit",
}
"""Keys that cannot be swept, mapped to the option that sets each of them instead."""
_MAX_AXIS_VALUES = 10**12
"""Largest number of values of an axis."""
_VALUES_EXAMPLE = "as in KEY=0:1600:50 (from, to, step) or KEY=1,2,5"
"""Example of an axis for error messages."""


class _Steps:
    """Sequence of equally spaced numbers, as strings.

    Strings are created only when they are accessed, because those of a long range might not fit
    into memory.

    Args:
        first: First value.
        step: Difference between neighbouring values.
        count: Number of values.
    """

    def __init__(self, first: Decimal, step: Decimal, count: int) -> None:
        self._first = first
        self._step = step
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> str:
        n = range(self._count)[index]  # range checks the bounds and resolves negative indices
        return f"{self._first + n * self._step:f}"


class SweepAxis(NamedTuple):
    """A scenario key that a sweep varies, with its values, such as "link.delay_ms=0:400:50".

    Attributes:
        description: The axis as the user wrote it, "KEY=a:b:step" or "KEY=v1,v2,v3".
        key: Scenario key that varies along the axis.
        texts: Values of the axis, as the strings that follow "KEY=" in an override.
    """

    description: str
    key: str
    texts: tuple[str, ...] | _Steps

    def value(self, number: int) -> float | str:
        """Returns the value of the swept key at an index, such as 50.0 for a delay.

        Args:
            number: Index of the value, from 0.

        Returns:
            A float if the value is a number, its text otherwise.
        """
        text = self.texts[number]
        value = _parse_value(text)
        return float(value) if is_number(value) else text

    @property
    def numeric(self) -> bool:
        """True if all values on the axis are numbers, as required for an axis of a map."""
        if isinstance(self.texts, _Steps):
            return True
        return all(is_number(_parse_value(text)) for text in self.texts)

    def override(self, number: int) -> str:
        """Returns the override for one value on the axis, such as "link.delay_ms=50".

        Args:
            number: Index of the value, from 0.
        """
        return f"{self.key}={self.texts[number]}"

    @classmethod
    def parse(cls, description: str) -> "SweepAxis":
        """Parses an axis as a user writes it, such as "link.delay_ms=0:200:10".

        Args:
            description: Either a range "KEY=a:b:step", which includes b if b is a whole number
                of steps from a; or a list "KEY=v1,v2,v3" of numbers, words or other TOML
                values.

        Raises:
            ScenarioError: The key or the values are missing, or the values are not valid.
        """
        key, equals, text = (part.strip() for part in str(description).partition("="))
        if not equals or not key:
            raise ScenarioError(
                f"--over must have the form KEY=VALUES, {_VALUES_EXAMPLE}, not {description!r}"
            )
        if key in _KEYS_WITH_OPTIONS:
            raise ScenarioError(f"cannot be an axis: {_KEYS_WITH_OPTIONS[key]}", path=key)

        parts = _split_outside_brackets(text, ":")
        if len(parts) not in (1, 3):
            example = _VALUES_EXAMPLE.removeprefix("as in ")
            raise ScenarioError(
                f"the values must have a form such as {example}, not {text!r}", path=key
            )

        texts: tuple[str, ...] | _Steps
        if len(parts) == 1:
            texts = _parse_list(key, text)
        else:
            first, last, step = (_parse_decimal(key, part) for part in parts)
            texts = _build_range(key, first, last, step)
        return cls(f"{key}={text}", key, texts)

    @staticmethod
    def list_descriptions(over: str | Sequence[str] | Mapping[str, Any]) -> list[str]:
        """Converts the axes passed by a Python program to strings KEY=VALUES.

        Args:
            over: A string, a list of strings, or a mapping from key to values. The values are a
                list, an array, or the text that would follow "KEY=".

        Returns:
            Strings for `parse`.
        """
        if isinstance(over, Mapping):
            return [f"{key}={_join_values(values)}" for key, values in over.items()]
        return list(over) if isinstance(over, list | tuple) else [str(over)]


def _join_values(values: Any) -> str:
    """Formats the values of a swept parameter as the text after "KEY=" in a command.

    Args:
        values: A finished text, a list, an array or a single value. A string that is a bare
            word, such as in_order, is not quoted.
    """
    if isinstance(values, str):
        return values
    entries = values if isinstance(values, list | tuple) else np.atleast_1d(values)
    texts = list[str]()
    for entry in entries:
        is_word = isinstance(entry, str) and entry.isidentifier()
        texts.append(entry if is_word else format_toml_value(entry))
    return ",".join(texts)


def _build_range(key: str, first: Decimal, last: Decimal, step: Decimal) -> _Steps:
    """Returns the values of a swept parameter that is written as "first:last:step".

    Args:
        key: Scenario key of the axis, for error messages.
        first: First value.
        last: Largest possible value, or the smallest value if the step is negative.
        step: Difference between neighbouring values.

    Raises:
        ScenarioError: The step is 0 or has the wrong sign, or there are too many values.
    """
    if step == 0:
        raise ScenarioError(f"a step of 0 does not lead from {first:f} to {last:f}", path=key)
    has_wrong_sign = (last - first) * step < 0
    if has_wrong_sign:
        suggestion = f"{min(first, last):f}:{max(first, last):f}:{abs(step):f}"
        problem = f"a step of {step:f} does not lead from {first:f} to {last:f}"
        raise ScenarioError(f"is empty: {problem}; did you mean {suggestion}?", path=key)
    count = int((last - first) / step + _ON_GRID) + 1
    if count > _MAX_AXIS_VALUES:
        raise ScenarioError(f"has {Decimal(count):.3g} values: take a larger step", path=key)
    return _Steps(first, step, count)


def _parse_decimal(key: str, text: str) -> Decimal:
    """Parses a number of a range as an exact decimal number.

    Args:
        key: Scenario key of the axis, for error messages.
        text: Text of the number.

    Raises:
        ScenarioError: The text is not a number, or the number is not finite or out of range.
    """
    text = text.strip()
    try:
        number = Decimal(text)
    except InvalidOperation:
        problem = (
            f"a range a:b:step must consist of numbers, and {text!r} is not a number; "
            "list words as in KEY=first,second"
        )
        raise ScenarioError(problem, path=key) from None

    if not number.is_finite():
        raise ScenarioError(f"a range must consist of finite numbers, not {text!r}", path=key)
    size = abs(number)
    if size > Decimal("1e18") or 0 < size < Decimal("1e-18"):
        raise ScenarioError(
            f"the magnitudes in a range must be from 1e-18 to 1e18, not {text}", path=key
        )
    return number


def _parse_list(key: str, text: str) -> tuple[str, ...]:
    """Splits the values of a swept parameter, written as "v1,v2,v3", into separate strings.

    Args:
        key: Scenario key of the axis, for error messages.
        text: Text of the list.

    Raises:
        ScenarioError: A value is empty, is not finite, or appears twice.
    """
    texts = tuple(part.strip() for part in _split_outside_brackets(text, ","))
    if "" in texts:
        raise ScenarioError(f"is empty: list the values, {_VALUES_EXAMPLE}", path=key)
    values = list[Any]()
    for value_text in texts:
        value = _parse_value(value_text)
        if value in values:
            raise ScenarioError(f"has {value_text} twice", path=key)
        if isinstance(value, float) and not math.isfinite(value):
            raise ScenarioError(f"must be finite numbers, not {value_text}", path=key)
        values.append(value)
    return texts


def _split_outside_brackets(text: str, separator: str) -> list[str]:
    """Splits a string at the separators outside of brackets and quotation marks.

    A value of a list may itself be a list or a string that contains the separator.
    """
    parts = [""]
    open_brackets = 0
    open_quote = ""  # the quotation mark that is open; empty outside of quotation marks
    for letter in text:
        if open_quote:
            open_quote = "" if letter == open_quote else open_quote
        elif letter in "\"'":
            open_quote = letter
        if not open_quote:
            open_brackets += (letter in "[{") - (letter in "]}")

        is_separator = letter == separator and not open_brackets and not open_quote
        if is_separator:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _parse_value(text: str) -> Any:
    """Parses a value: "0.2" becomes 0.2, and "true" becomes True.

    Text that is not valid TOML, such as gamma without quotes, is returned unchanged.
    """
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


_GAINS = {
    "K": "N m/rad",
    "d": "N m s/rad",
    "Kp": "N m s/rad",
    "Kd": "N m s/rad",
    "Lambda": "1/s",
}
"""Units of the gains, whose keys do not end in a unit."""


def label_axis(key: str, scenario: Scenario | None = None) -> str:
    """Returns the label of an axis in a figure, such as "delay (ms)" for link.delay_ms.

    If link delays are random, the label says "stated delay": newer samples may overtake older
    ones, so the samples in use are younger than the stated delay suggests.

    Args:
        key: Scenario key of the axis.
        scenario: Scenario in which the names of operators and walls are looked up.
    """
    quantity, unit = _describe_key(key, scenario)
    if scenario is not None and key.startswith("link") and key.endswith("delay_ms"):
        _, *names, _ = key.split(".")
        links = [scenario.links[name] for name in names or scenario.links]
        if any(link.random and link.moments().deviation_ms > 0.0 for link in links):
            quantity = f"stated {quantity}"
    return f"{quantity} ({unit})" if unit else quantity


def label_setting(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a setting as a label with its unit, such as "delay 200 ms".

    Args:
        key: Scenario key, such as link.delay_ms.
        value: Value of the key.
        scenario: Scenario in which the names of operators and walls are looked up.
    """
    quantity, unit = _describe_key(key, scenario)
    if isinstance(value, bool):
        text = str(value).lower()
    elif is_number(value):
        text = f"{value:g}"
    else:
        text = str(value).replace("_", " ")
    return " ".join(part for part in (quantity, text, unit) if part)


def _describe_key(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Splits a scenario key, such as delay_ms, into a name and a unit for labels.

    Args:
        key: Scenario key, such as "sites.s.control.K" or "link.delay_ms".
        scenario: Scenario in which the names of operators and walls are looked up.

    Returns:
        The name in words, such as "K of s", and the unit, which may be empty.
    """
    *tables, name = key.split(".")
    subscript = ""
    if name.isdigit() and tables:  # an element of a list over joints or parameters
        subscript = f"[{name}]"
        name = tables.pop()
    quantity, unit = split_unit(name)
    is_symbol = not unit and len(name) <= 3
    if is_symbol:
        quantity = name  # symbols such as Kp keep their capital letters
    owner = _describe_owner(tables, scenario)
    return f"{quantity}{subscript}{owner}", _GAINS.get(name) or unit.replace("^2", "²")


def _describe_owner(tables: list[str], scenario: Scenario | None) -> str:
    """Returns the part of a label that names the site, link or actor of a setting.

    Args:
        tables: Names of the tables that contain the key, from the outermost table.
        scenario: Scenario in which the kind of an operator or a wall is looked up.

    Returns:
        A string such as " of s". Empty if the key applies to all sites or links.
    """
    match tables:
        case ["sites", site, ("hands" | "environment") as group, number]:
            kind = "hand" if group == "hands" else "environment"
            if scenario is not None and site in scenario.sites and number.isdigit():
                actors = getattr(scenario.sites[site], group)
                if int(number) < len(actors):
                    tag = actors[int(number)].__struct_config__.tag
                    kind = str(tag).replace("_", " ")
            return f", {kind} of {site}"
        case ["sites", site, *_]:
            return f" of {site}"
        case ["links", link, *_]:
            return f" {link}"
        case ["dominance", site]:
            return f"'s share in {site}"
        case _:
            return ""
