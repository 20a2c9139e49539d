"""What a metric is: the quantities of a kind of place, and the function that measures them.

Invariant: a value is a finite number, or None with a reason. A key has one definition, beside
its function in one file of this folder, and in docs/metrics.md; whoever shows, compares or asks
finds it by its file.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.task_space import POSITION
from ...core.vectors import Array
from ..run_view import RunView


class Metric(NamedTuple):
    """A number, or the reason why there is none.

    Attributes:
        value, why: the number, finite, or None; the reason, or "".
        applies: False if no log of this experiment could have one: then nothing is unknown.
    """

    value: float | None
    why: str = ""
    applies: bool = True


MetricValues = dict[str, Metric]
"""Metrics by the keys of their quantities."""

_NOT_FINITE = "it is no finite number"


def metric(value: float | None, why: str = _NOT_FINITE) -> Metric:
    """Returns a metric of a number; with the reason if it is None or not finite."""
    return (
        Metric(None, why) if value is None or not math.isfinite(value) else Metric(float(value))
    )


def unavailable(group: str, why: str, *, of: str = "", applies: bool = True) -> MetricValues:
    """Returns the quantities of a group, or those of it that are `of` a kind of place, without
    a number.
    """
    return {
        q.key: Metric(None, why, applies)
        for q in quantities()
        if q.group == group and of in ("", q.of)
    }


def measure_shared(
    group: str,
    space: str,
    keys: Iterable[str],
    off: Array,
    at_end: NDArray[np.bool_],
    none: str = _NOT_FINITE,
) -> MetricValues:
    """Returns what sites share, angles, rad, or places, m, or both of a pose: RMS, peak, peak
    at the end.

    Args:
        group: that of the quantities.
        space: in which sites share.
        keys: of the three quantities, without the unit.
        off: by how much it is off, shape (K, n).
        at_end: which rows are of the last second, shape (K,).
        none: why there may be none of them.
    """
    found = unavailable(group, "sites share angles, not places", applies=False)
    if space == "joints":
        parts = [("rad", slice(None))]
    else:
        found = unavailable(group, "sites share places, not angles", applies=False)
        parts = [("m", slice(0, POSITION)), ("rad", slice(POSITION, None))][
            : 1 + (space == "pose")
        ]
    for unit, columns in parts:
        part = off[:, columns]
        values = metric(rms(part)), metric(peak(part)), metric(peak(part[at_end]), none)
        found |= {f"{key}_{unit}": value for key, value in zip(keys, values, strict=True)}
    return found


def rms(values: ArrayLike) -> float:
    """Returns the root mean square over rows of the column with the largest; NaN of no rows,
    shape (K, n).
    """
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return math.nan
    return float(np.sqrt(np.einsum("kj,kj->j", array, array) / len(array)).max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value; NaN of none."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.abs(array).max()) if array.size else math.nan


class Quantity(NamedTuple):
    """A number that a run, or each of its sites, links or walls has.

    Attributes:
        key: its name in programs; ends in its unit, if any.
        name: its name for people.
        unit: its unit; "" for a number without.
        reduction: reduction to the run: "max" or "sum" over all places.
        of: the kind of place that has one: "run", "site", "link" or "wall".
        group: its heading.
    """

    key: str
    name: str
    unit: str = ""
    reduction: str = "max"
    of: str = ""
    group: str = ""


def list_shared_quantities(names: Mapping[str, str]) -> list[Quantity]:
    """Returns what sites share by key and name: of their angles q, rad, and then of their
    places x, m.

    A key lacks its unit; "{0}" in a name stands for q or x.
    """
    symbols = {"rad": "q", "m": "x"}
    return [
        Quantity(f"{key}_{unit}", name.format(symbol), unit)
        for unit, symbol in symbols.items()
        for key, name in names.items()
    ]


Measuring = Callable[[RunView, str], MetricValues]
"""Returns the quantities of a place, by their keys; each a number or the reason why there is
none.
"""


class Measure(NamedTuple):
    """Quantities of a kind of place, and what measures them."""

    of: str
    group: str
    quantities: tuple[Quantity, ...]
    measure: Measuring


_MEASURES: list[Measure] = []
TRACKING = "tracking"
SPREAD = "apart"
FOLLOWING = "slave and master"
EFFORT = "effort"
ENERGY = "energy"
CONTACT = "walls"
LEARNING = "learning"
SHARING = "force sharing"
USERS = "users"
NETWORK = "network"
LOOP = "loop"
_SHOWN = (
    TRACKING,
    SPREAD,
    FOLLOWING,
    EFFORT,
    ENERGY,
    CONTACT,
    SHARING,
    USERS,
    LEARNING,
    NETWORK,
    LOOP,
)
"""Headings in the order in which they are shown; others follow."""


def measures(of: str, group: str, *quantities: Quantity) -> Callable[[Measuring], Measuring]:
    """Declares that a function measures these quantities of every "run", "site", "link" or
    "wall".

    Raises:
        ValueError: another function measures one of them.
    """

    def declare(measure: Measuring) -> Measuring:
        known = {one.key: other for other in _MEASURES for one in other.quantities}
        for one in quantities:
            if other := known.get(one.key):
                homes = f"{other.measure.__module__} and {measure.__module__}"
                raise ValueError(f"metric {one.key} has two definitions, in {homes}")
        told = tuple(one._replace(of=of, group=group) for one in quantities)
        _MEASURES.append(Measure(of, group, told, measure))
        return measure

    return declare


def list_measures() -> list[Measure]:
    """Returns what is measured, in the order in which it is shown."""
    place = {group: n for n, group in enumerate(_SHOWN)}
    return sorted(_MEASURES, key=lambda one: place.get(one.group, len(place)))


def quantities() -> list[Quantity]:
    """Returns all quantities, in that order."""
    return [quantity for one in list_measures() for quantity in one.quantities]
