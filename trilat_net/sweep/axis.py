"""One axis of a sweep: a key of the scenario, and the values that it takes.

Law: a value is the text that an override would have; steps are counted in decimals, so that 0.2:3:0.1 has 0.3
and not 0.30000000000000004, and the same text is the same number wherever it is read.
"""

import math
import tomllib
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from typing import Any, NamedTuple, overload

from ..errors import ScenarioError
from ..scenario.tables import is_number

_ON_GRID = Decimal("1e-9")
"""An end that is no further than this from the grid, in steps, lies on it."""
_ELSEWHERE = {
    "seed": "seeds have an option of their own, as in --seeds 1..20",
    "duration_s": "how long a cell runs follows from its verdict: --duration says how long at first, "
    "--longest how long at most",
}
_MOST = 10**12
_HOW = "as in KEY=0:1600:50 (from, to, step) or KEY=1,2,5"


class Axis(NamedTuple):
    """One axis.

    Attributes:
        asked: as a person wrote it, "KEY=a:b:step" or "KEY=v1,v2,v3".
        key: dotted, as an override names it.
        texts: its values, each as an override's text.
    """

    asked: str
    key: str
    texts: Sequence[str]

    def value(self, number: int) -> float | str:
        """Returns one value: a number where it is one, else its text."""
        value = _read(self.texts[number])
        return float(value) if is_number(value) else self.texts[number]

    @property
    def numeric(self) -> bool:
        """True where every value is a number."""
        return isinstance(self.texts, _Steps) or all(is_number(_read(text)) for text in self.texts)

    def override(self, number: int) -> str:
        """Returns the override that sets one value."""
        return f"{self.key}={self.texts[number]}"


class _Steps(Sequence[str]):
    """The values a, a + step, ... as texts, made as they are asked for."""

    def __init__(self, first: Decimal, step: Decimal, count: int) -> None:
        self._first, self._step, self._count = first, step, count

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, place: int) -> str: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[str]: ...
    def __getitem__(self, place: int | slice) -> str | Sequence[str]:
        if isinstance(place, slice):
            return [self[n] for n in range(*place.indices(self._count))]
        n = range(self._count)[place]
        return f"{self._first + n * self._step:f}"


def axis(asked: str) -> Axis:
    """Returns the axis that a text describes.

    Args:
        asked: "KEY=a:b:step", with b where it lies on the grid, or "KEY=v1,v2,v3" with numbers, words or
            other TOML values.

    Raises:
        ScenarioError: it has no key, no values, or values that make no grid.
    """
    key, equals, text = (part.strip() for part in asked.partition("="))
    if not equals or not key:
        raise ScenarioError(f"--over reads KEY=VALUES, {_HOW}, not {asked!r}")
    if key in _ELSEWHERE:
        raise ScenarioError(f"is no axis: {_ELSEWHERE[key]}", path=key)
    parts = _split(text, ":")
    if len(parts) == 1:
        return Axis(f"{key}={text}", key, _listed(key, text))
    if len(parts) != 3:
        raise ScenarioError(f"values read {_HOW.removeprefix('as in ')}, not {text!r}", path=key)
    return Axis(f"{key}={text}", key, _steps(key, *(_decimal(key, part.strip()) for part in parts)))


def _steps(key: str, first: Decimal, last: Decimal, step: Decimal) -> _Steps:
    if step == 0:
        raise ScenarioError(f"a step of 0 never comes from {first:f} to {last:f}", path=key)
    count = int((last - first) / step + _ON_GRID) + 1
    if (last - first) * step < 0:
        size = abs(step)
        right = f"{min(first, last):f}:{max(first, last):f}:{size:f}"
        raise ScenarioError(
            f"is empty: a step of {step:f} does not lead from {first:f} to {last:f}; did you mean {right}?",
            path=key,
        )
    if count > _MOST:
        raise ScenarioError(f"has {Decimal(count):.3g} values: take a larger step", path=key)
    return _Steps(first, step, count)


def _decimal(key: str, text: str) -> Decimal:
    try:
        number = Decimal(text)
    except InvalidOperation:
        raise ScenarioError(
            f"a range is of numbers, a:b:step, and {text!r} is none; words go as in KEY=first,second",
            path=key,
        ) from None
    if not number.is_finite():
        raise ScenarioError(f"a range is of finite numbers, and {text!r} is none", path=key)
    if abs(number) > Decimal("1e18") or (number and abs(number) < Decimal("1e-18")):
        raise ScenarioError(f"{text} is beyond what a range is for: from 1e-18 to 1e18", path=key)
    return number


def _listed(key: str, text: str) -> tuple[str, ...]:
    texts = tuple(part.strip() for part in _split(text, ","))
    if "" in texts:
        raise ScenarioError(f"is empty: say which values, {_HOW}", path=key)
    values = list(map(_read, texts))
    for n, (one, value) in enumerate(zip(texts, values, strict=True)):
        if value in values[:n]:
            raise ScenarioError(f"has {one} twice", path=key)
        if isinstance(value, float) and not math.isfinite(value):
            raise ScenarioError(f"must be finite numbers, one is {one}", path=key)
    return texts


def _split(text: str, mark: str) -> list[str]:
    """Returns the parts between marks that stand in no bracket and in no quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        depth += (letter in "[{") - (letter in "]}") if not quote else 0
        if letter == mark and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _read(text: str) -> Any:
    """Returns the value of an override's text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
