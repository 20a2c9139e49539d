"""Declares metrics: the quantities of a kind of subject, and the function that measures them.

A subject is the run, a site, a link or a wall.

Invariant:
    - A value is a finite number, or None with a reason.
    - A key has one definition, beside its function in one file of this folder, and in
      docs/metrics.md. Everything that shows, compares or requests a metric finds it there.
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
        value: the number, finite; None if there is none.
        why: the reason why there is no number; "" otherwise.
        applies: False if no log of this experiment could have a number: nothing is unknown
            then.
    """

    value: float | None
    why: str = ""
    applies: bool = True


MetricValues = dict[str, Metric]
"""Metrics by the keys of their quantities."""

_NOT_FINITE = "it is no finite number"


def metric(value: float | None, why: str = _NOT_FINITE) -> Metric:
    """Returns the metric of a number, or of the reason `why` if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return Metric(None, why)
    return Metric(float(value))


def unavailable(
    group: str,
    why: str,
    *,
    of: str = "",
    applies: bool = True,
) -> MetricValues:
    """Returns the quantities of a group, all without a number.

    Args:
        group: the group of the quantities.
        why: the reason why there are no numbers.
        of: kind of subject to which the quantities are limited; "" for every kind.
        applies: see `Metric`.
    """
    return {
        quantity.key: Metric(None, why, applies)
        for quantity in quantities()
        if quantity.group == group and of in ("", quantity.of)
    }


def measure_shared(
    group: str,
    space: str,
    keys: Iterable[str],
    differences: Array,
    at_end: NDArray[np.bool_],
    why_not_at_end: str = _NOT_FINITE,
) -> MetricValues:
    """Returns the RMS, the peak and the peak at the end of differences in a shared coordinate.

    Sites share angles in rad, positions in m, or both in a pose.

    Args:
        group: the group of the quantities.
        space: the space in which sites share: "joints", "position" or "pose".
        keys: the keys of the three quantities, without the unit.
        differences: the differences in every row, shape (K, n).
        at_end: True for rows of the last second, shape (K,).
        why_not_at_end: the reason if no row is at the end.
    """
    columns_by_unit = {"rad": slice(None)}
    excluded = "sites share angles, not places"
    if space != "joints":
        columns_by_unit = {"m": slice(0, POSITION)}
        excluded = "sites share places, not angles"
        if space == "pose":
            columns_by_unit["rad"] = slice(POSITION, None)
    values = unavailable(group, excluded, applies=False)
    for unit, columns in columns_by_unit.items():
        part = differences[:, columns]
        part_metrics = (
            metric(rms(part)),
            metric(peak(part)),
            metric(peak(part[at_end]), why_not_at_end),
        )
        for key, value in zip(keys, part_metrics, strict=True):
            values[f"{key}_{unit}"] = value
    return values


def rms(values: ArrayLike) -> float:
    """Returns the largest of the columns' root mean squares, shape (K, n); NaN without rows."""
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return math.nan
    square_sums = np.einsum("kj,kj->j", array, array)
    root_mean_squares = np.sqrt(square_sums / len(array))
    return float(root_mean_squares.max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value; NaN without values."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.abs(array).max()) if array.size else math.nan


class Quantity(NamedTuple):
    """A number that a run, or each of its sites, links or walls has.

    Attributes:
        key: key in programs; ends in its unit, if any.
        name: name for people.
        unit: unit; "" for a pure number.
        reduction: reduction to the run: "max" or "sum" over all subjects.
        of: kind of subject: "run", "site", "link" or "wall".
        group: heading under which the quantity is shown.
    """

    key: str
    name: str
    unit: str = ""
    reduction: str = "max"
    of: str = ""
    group: str = ""


def list_shared_quantities(names: Mapping[str, str]) -> list[Quantity]:
    """Returns quantities of shared angles q, in rad, and then of shared positions x, in m.

    Args:
        names: names for people by key; a key lacks its unit, and "{0}" in a name stands for q
            or x.
    """
    symbols = {"rad": "q", "m": "x"}
    return [
        Quantity(f"{key}_{unit}", name.format(symbol), unit)
        for unit, symbol in symbols.items()
        for key, name in names.items()
    ]


Measuring = Callable[[RunView, str], MetricValues]
"""Measures a subject of a run: returns its quantities by key, each a number or a reason."""


class Measure(NamedTuple):
    """Quantities of a kind of subject, and the function that measures them."""

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
_GROUP_ORDER = (
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
"""Groups in the order in which they are shown; other groups follow."""


def measures(of: str, group: str, *quantities: Quantity) -> Callable[[Measuring], Measuring]:
    """Declares that a function measures some quantities of every subject of a kind.

    Args:
        of: kind of subject: "run", "site", "link" or "wall".
        group: heading under which the quantities are shown.
        quantities: the quantities, without kind and group.

    Raises:
        ValueError: another function measures one of the quantities.
    """

    def declare(measure: Measuring) -> Measuring:
        definitions = {
            quantity.key: declared for declared in _MEASURES for quantity in declared.quantities
        }
        for quantity in quantities:
            other = definitions.get(quantity.key)
            if other is not None:
                modules = f"{other.measure.__module__} and {measure.__module__}"
                raise ValueError(f"metric {quantity.key} has two definitions, in {modules}")
        complete = tuple(quantity._replace(of=of, group=group) for quantity in quantities)
        _MEASURES.append(Measure(of, group, complete, measure))
        return measure

    return declare


def list_measures() -> list[Measure]:
    """Returns all measures, in the order in which they are shown."""
    rank = {group: n for n, group in enumerate(_GROUP_ORDER)}
    return sorted(_MEASURES, key=lambda measure: rank.get(measure.group, len(rank)))


def quantities() -> list[Quantity]:
    """Returns all quantities, in the order in which they are shown."""
    return [quantity for measure in list_measures() for quantity in measure.quantities]
