"""Registers functions as metrics, which tables and commands then look up by name.

A metric is a number that describes a run or a part of it, for example the RMS error of an arm.
Each module of this folder contains functions that compute such numbers. The decorator
`measures` registers a function together with the quantities that it returns (their names, units
and meanings). A new metric therefore requires no change of the commands that print metrics.

Invariant:
    - A value is a finite number, or `None` with a reason.
    - A quantity is defined next to its function in this folder and explained in
      docs/reference/metrics.md. All code that shows, compares or requests a metric uses this
      definition.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import POSITION, Array
from ..run_view import RunView

_NOT_FINITE = "the number is not finite"


class Metric(NamedTuple):
    """Value of a metric, such as the largest error of an arm, or the reason why it is missing.

    Attributes:
        value: The finite value, or `None` if it is missing.
        why: The reason why the value is missing. Empty if it is not missing.
        applies: False if the quantity cannot exist for this subject in any run of this
            scenario. A missing value is then to be expected.
    """

    value: float | None
    why: str = ""
    applies: bool = True

    @classmethod
    def of_value(cls, value: float | None, why: str = _NOT_FINITE) -> "Metric":
        """Wraps a value in a metric, with a reason if the value is missing or not finite.

        For example, NaN and the reason "no contact" give a metric with the value `None` and
        this reason.

        Args:
            value: The value, or `None` if it is missing.
            why: The reason stated if the value is `None` or not finite.
        """
        if value is None or not math.isfinite(value):
            return cls(None, why)
        return cls(float(value))


MetricValues = dict[str, Metric]
"""Metrics of one subject, by the keys of their quantities."""


def unavailable(
    group: str,
    why: str,
    *,
    of: str = "",
    applies: bool = True,
) -> MetricValues:
    """Returns metrics without values, all with the same reason, for the quantities of a group.

    For example, a function that measures tracking returns them if an arm has no records.

    Args:
        group: Group (heading) of the quantities.
        why: The reason why there are no values.
        of: If not empty, only quantities of this kind of subject are returned: "run", "site",
            "link" or "wall".
        applies: False if the quantities cannot exist in any run of this scenario (see
            `Metric`).

    Returns:
        The metrics, keyed by quantity.
    """
    return {
        quantity.key: Metric(None, why, applies)
        for quantity in Quantity.list_all()
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
    """Measures how much the motions of two sites differ: RMS, peak, and peak at the end.

    Sites share joint angles in rad, positions of their end effectors in m, or complete poses,
    which have both units. Quantities whose unit does not occur are marked as not applicable.

    Args:
        group: Group of the quantities.
        space: What the sites share: "joints", "position" or "pose".
        keys: Keys of the three quantities, without the unit.
        differences: Differences in every row, shape (K, n).
        at_end: True for rows of the last second, shape (K,).
        why_not_at_end: The reason stated if no row is at the end.

    Returns:
        The metrics, keyed by quantity.
    """
    columns_by_unit = {"rad": slice(None)}
    why_excluded = "sites share angles, not places"
    if space != "joints":
        columns_by_unit = {"m": slice(0, POSITION)}
        why_excluded = "sites share places, not angles"
        if space == "pose":
            columns_by_unit["rad"] = slice(POSITION, None)

    values = unavailable(group, why_excluded, applies=False)
    for unit, columns in columns_by_unit.items():
        unit_differences = differences[:, columns]
        unit_metrics = (
            Metric.of_value(rms(unit_differences)),
            Metric.of_value(peak(unit_differences)),
            Metric.of_value(peak(unit_differences[at_end]), why_not_at_end),
        )
        for key, value in zip(keys, unit_metrics, strict=True):
            values[f"{key}_{unit}"] = value
    return values


def rms(values: ArrayLike) -> float:
    """Returns the largest root mean square over time among the columns, one per joint.

    Args:
        values: Values of n quantities over time, shape (K, n).

    Returns:
        The largest root mean square, or NaN if there are no rows.
    """
    numbers = np.asarray(values, dtype=np.float64)
    if not numbers.size:
        return math.nan
    square_sums = np.einsum("kj,kj->j", numbers, numbers)
    root_mean_squares = np.sqrt(square_sums / len(numbers))
    return float(root_mean_squares.max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value, such as the peak torque. For [1, -3] it is 3.

    Args:
        values: The values, of any shape.

    Returns:
        The largest absolute value, or NaN if there are no values.
    """
    magnitudes = np.asarray(values, dtype=np.float64)
    return float(np.abs(magnitudes).max()) if magnitudes.size else math.nan


class Quantity(NamedTuple):
    """Definition of a metric: its key, name, unit, and the kind of subject to which it applies.

    For example, the RMS error has the unit rad and applies to each arm.

    Attributes:
        key: Key in tables and JSON output. It ends in the unit if the quantity has a unit.
        name: Name that users read.
        unit: Unit. Empty for a dimensionless number.
        reduction: How the value of the run is computed from those of its subjects: "max" or
            "sum".
        of: Kind of subject: "run", "site", "link" or "wall".
        group: Heading under which the quantity is shown.
    """

    key: str
    name: str
    unit: str = ""
    reduction: str = "max"
    of: str = ""
    group: str = ""

    @staticmethod
    def list_all() -> list["Quantity"]:
        """Returns name, unit and meaning of all metrics of a run, such as the largest error.

        Tables and docs/reference/metrics.md list them in this order.
        """
        return [quantity for measure in Measure.list_all() for quantity in measure.quantities]

    @classmethod
    def list_shared(cls, names: Mapping[str, str]) -> list["Quantity"]:
        """Defines quantities both for shared joint angles and for shared positions.

        Arms share either their joint angles, in rad, or the positions of their end effectors,
        in m. Each quantity is therefore defined twice.

        Args:
            names: A mapping from key to the name that the user reads. The unit is appended to
                each key. "{0}" in a name is replaced by the symbol q for angles or x for
                positions.

        Returns:
            The quantities of angles, followed by those of positions.
        """
        symbols = {"rad": "q", "m": "x"}
        return [
            cls(f"{key}_{unit}", name.format(symbol), unit)
            for unit, symbol in symbols.items()
            for key, name in names.items()
        ]


Measuring = Callable[[RunView, str], MetricValues]
"""Function that measures a subject of a run, given by its name, and returns its metrics."""
_DeclaredMeasuring = TypeVar("_DeclaredMeasuring", bound=Measuring)


class Measure(NamedTuple):
    """A function that computes some metrics of a run, together with their heading in tables.

    Modules of this folder register such functions with the decorator `measures`.

    Attributes:
        of: Kind of subject that is measured: "run", "site", "link" or "wall".
        group: Heading under which the quantities are shown.
        quantities: Definitions of the quantities.
        measure: The function, which returns the values for one subject.
    """

    of: str
    group: str
    quantities: tuple[Quantity, ...]
    measure: Measuring

    @classmethod
    def list_all(cls) -> "list[Measure]":
        """Returns all registered functions that compute metrics, ordered by group.

        Groups are sorted in the order in which they are shown to the user. Unknown groups, such
        as those of a new file, come last.
        """
        rank = {group: n for n, group in enumerate(_GROUP_ORDER)}
        return sorted(_MEASURES, key=lambda measure: rank.get(measure.group, len(rank)))


_MEASURES: list[Measure] = []
TRACKING = "tracking"
UNDELAYED = "tracking without delay"
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
    UNDELAYED,
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


def measures(
    of: str, group: str, *quantities: Quantity
) -> Callable[[_DeclaredMeasuring], _DeclaredMeasuring]:
    """Decorator that registers a function that computes some metrics.

    The function is called for each run, site, link or wall, depending on `of`, and must return
    a metric for each of the quantities.

    Args:
        of: Kind of subject that the function measures: "run", "site", "link" or "wall".
        group: Heading under which the quantities are shown.
        quantities: The quantities. Their attributes `of` and `group` are filled in.

    Raises:
        ValueError: Another function already computes one of the quantities.
    """

    def declare(measure: _DeclaredMeasuring) -> _DeclaredMeasuring:
        """Registers a function that computes metrics. A metric may be registered only once."""
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
