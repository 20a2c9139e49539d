"""All metrics of a log, their JSON, and the comparison of several logs.

Invariant: every quantity is present for every place it applies to, as a number or with the
reason for its absence; in JSON the number is null and `unknown` has the reason. Whatever a file
of this folder measures belongs to it. A comparison has one column per log and one row per
metric of the whole run.
"""

import math
import pkgutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...core.task_space import POSITION
from ...errors import count_nouns
from ...fields import suggest_nearest
from ...log.log_reader import Log
from ...results import Result
from ...scenario.arms import TASK_AXES
from ..run_view import RunView
from ..site_signals import follows_in_task_space
from . import static_windows
from .measured_impedance import FrequencyResponse, ImpedanceEstimate, estimate_impedances
from .measures import Measure, Metric, MetricValues, Quantity, list_measures, quantities
from .motion_metrics import ParameterEstimates, read_all_estimates
from .static_windows import JointLoad, SharingRatio, StiffnessEstimate

for _found in pkgutil.iter_modules(import_module(__package__).__path__):
    import_module(f"{__package__}.{_found.name}")

_ALONG_AXES = {"N m": "N", "rad": "m", "N m/rad": "N/m", "N m s/rad": "N s/m"}
"""Units along an axis in place of those of a joint."""

METRICS_JSON_VERSION = 1
"""Of this layout: keys may be added under it, none is taken away or changes its meaning."""


@dataclass(frozen=True, repr=False)
class LogMetrics(Result):
    """All metrics of a log.

    Attributes:
        log, scenario, driver, complete: the name of its file, and what it says of itself. run,
        sites, links, walls: of the whole, per site, per link "j->i", per wall "s/1" (the first
        of s).
        estimates: per site with records, its parameter estimates.
        static_windows, stiffness: their number, and the stiffness from one of them to the next.
        joint_loads: the loaded joints in them, with the torques of all loaded sites.
        sharing_ratios: the force sharing of those at which two sites are loaded.
        responses: impedances and reflections over frequency.
        axes: names of what sites share in task space, where a joint's number is that of an
            axis; else ().
        joint_names: names that the files of the arms give their joints, if they agree; else ().
    """

    log: str
    scenario: str
    driver: str
    complete: bool
    run: MetricValues
    sites: dict[str, MetricValues]
    links: dict[str, MetricValues]
    walls: dict[str, MetricValues]
    estimates: dict[str, ParameterEstimates]
    static_windows: Metric
    joint_loads: list[JointLoad]
    sharing_ratios: list[SharingRatio]
    stiffness: list[StiffnessEstimate]
    responses: list[ImpedanceEstimate]
    axes: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()

    def label(self, number: int) -> str:
        """Returns what the number of a joint stands for, from 1: "1", "3 elbow", or the name of
        an axis.
        """
        if self.axes:
            return self.axes[number - 1]
        return f"{number} {self.joint_names[number - 1]}" if self.joint_names else str(number)

    def unit(self, of_joint: str, number: int) -> str:
        """Returns the unit of a joint's quantity, or of that along an axis of a place."""
        return (
            _ALONG_AXES.get(of_joint, of_joint)
            if self.axes and number <= POSITION
            else of_joint
        )

    def headline(self) -> str:
        """Returns what was measured, in one line."""
        known = sum(one.value is not None for _, one in self._each())
        return f"{self.log}: {count_nouns(known, 'number')} of {self.scenario}, {', '.join(self.sites)}"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat metrics --json`."""
        places = {"sites": self.sites, "links": self.links, "walls": self.walls}
        windows = self.static_windows.value
        named = {
            f"{kind}.{name}.": one
            for kind, found in places.items()
            for name, one in found.items()
        }
        metrics_by_path = {
            "run.": self.run,
            **named,
            "": {"windows_at_rest": self.static_windows},
        }
        content: dict[str, Any] = {
            "version": METRICS_JSON_VERSION,
            "log": self.log,
            "scenario": self.scenario,
            "driver": self.driver,
            "complete": self.complete,
            "run": _values(self.run),
            **{
                kind: {name: _values(one) for name, one in found.items()}
                for kind, found in places.items()
            },
            "parameters": {
                site: estimates.to_json() for site, estimates in self.estimates.items()
            },
            "windows_at_rest": None if windows is None else int(windows),
            **_details_to_json(self),
            "unknown": {
                path + key: one.why
                for path, found in metrics_by_path.items()
                for key, one in found.items()
                if one.value is None
            },
        }
        return {key: _finite(value) for key, value in content.items()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per quantity and place."""
        return [
            {**row, "value": one.value, "why": one.why}
            for row, one in self._each()
            if one.applies
        ]

    def _each(self) -> Iterator[tuple[dict[str, str], Metric]]:
        for quantity in quantities():
            words = {"group": quantity.group, "key": quantity.key, "name": quantity.name}
            for place, one in self.values_of(quantity).items():
                yield {**words, "of": place or "run", "unit": quantity.unit}, one

    def values_of(self, quantity: Quantity) -> dict[str, Metric]:
        """Returns a quantity of every place that has it; of the run by the name ""."""
        if quantity.of == "run":
            return {"": self.run[quantity.key]}
        found: dict[str, MetricValues] = getattr(self, f"{quantity.of}s")
        return {name: metrics[quantity.key] for name, metrics in found.items()}

    def run_value(self, quantity: Quantity) -> Metric:
        """Returns a quantity of the run, see `reduce_to_run`."""
        return reduce_to_run(quantity, self.values_of(quantity))


def reduce_to_run(quantity: Quantity, places: Mapping[str, Metric]) -> Metric:
    """Returns a quantity of the run, of that of its places: the largest of them, or their sum.

    A place that can have none does not count; if one lacks a number that it could have, so does
    the run.
    """
    counted = {name: one for name, one in places.items() if one.applies}
    whys = [
        f"{name}: {one.why}" if name else one.why for name, one in counted.items() if one.why
    ]
    if whys:
        return Metric(None, "; ".join(whys))
    values = [one.value for one in counted.values() if one.value is not None]
    if not values:
        nowhere = dict.fromkeys(one.why for one in places.values())
        return Metric(None, "; ".join(nowhere) or f"there is no {quantity.of}", applies=False)
    return Metric(sum(values) if quantity.reduction == "sum" else max(values))


# what is not finite is no number
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def compute_log_metrics(log: Log) -> LogMetrics:
    """Returns all quantities of a log; of torn, short and empty ones too.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    view = RunView(log)
    scenario = log.scenario
    found = _measure_places(view, list_measures())
    names = {
        arm.joint_names if scenario.sites[site].arm.urdf else ()
        for site, arm in scenario.arms.items()
    }
    return LogMetrics(
        *(Path(log.source).name, scenario.name, log.driver, log.complete),
        found["run"][""],
        *(found["site"], found["link"], found["wall"]),
        view.compute_once(read_all_estimates),
        static_windows.count_static_windows(view),
        view.compute_once(static_windows.find_joint_loads),
        view.compute_once(static_windows.find_sharing_ratios),
        static_windows.estimate_stiffness(view),
        estimate_impedances(view),
        TASK_AXES[: scenario.arms[log.sites[0]].counts.shared]
        if follows_in_task_space(log)
        else (),
        names.pop() if len(names) == 1 else (),
    )


def _measure_places(
    view: RunView, wanted: Iterable[Measure]
) -> dict[str, dict[str, MetricValues]]:
    found: dict[str, dict[str, MetricValues]] = {
        of: {place: {} for place in view.places(of)} for of in ("run", "site", "link", "wall")
    }
    for one in wanted:
        for place, values in found[one.of].items():
            values.update(one.measure(view, place))
    return found


def find_quantity(key: str) -> Quantity:
    """Returns the quantity of a key.

    Raises:
        KeyError: there is none; the message names the nearest.
    """
    known = {one.key: one for one in quantities()}
    if key not in known:
        near = suggest_nearest(key, list(known))
        raise KeyError(f"no metric {key!r}{near}; docs/metrics.md has them all")
    return known[key]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # as there
def measure_run(log: Log, keys: Iterable[str]) -> dict[str, Metric]:
    """Returns quantities of the whole run by their keys; nothing else is computed."""
    asked = {key: find_quantity(key) for key in keys}
    wanted = [
        one
        for one in list_measures()
        if any(quantity.key in asked for quantity in one.quantities)
    ]
    found = _measure_places(RunView(log), wanted)
    return {
        key: reduce_to_run(one, {place: values[key] for place, values in found[one.of].items()})
        for key, one in asked.items()
    }


def _details_to_json(metrics: LogMetrics) -> dict[str, Any]:

    def units(one: ImpedanceEstimate) -> str:
        return metrics.unit(one.unit, one.joint)

    found = {
        "levers": [
            load._asdict()
            | {"weight": _values(load.weight)}
            | _value_and_why("imbalance", load.imbalance)
            for load in metrics.joint_loads
        ],
        "force_sharing": [
            pair._asdict() | {"off": pair.off} | _value_and_why("expected_nm", pair.expected_nm)
            for pair in metrics.sharing_ratios
        ],
        "stiffness": [one._asdict() for one in metrics.stiffness],
        "felt": [
            {
                **one._asdict(),
                "ratio": _response_to_json(one.ratio, units(one)),
                "spectrum": [_response_to_json(line, units(one)) for line in one.spectrum],
            }
            for one in metrics.responses
        ],
    }
    if not metrics.axes:
        for entry in (
            one for entries in found.values() for one in entries if metrics.joint_names
        ):
            entry["joint_name"] = metrics.joint_names[entry["joint"] - 1]
        return found
    return {
        name: [_name_axis(metrics, one) for one in entries] for name, entries in found.items()
    }


def _name_axis(metrics: LogMetrics, entry: dict[str, Any]) -> dict[str, Any]:
    number = entry.pop("joint")
    endings = (("_nm_rad", "_n_m"), ("_nm", "_n"), ("_rad", "_m")) if number <= POSITION else ()
    renamed = {}
    for key, value in entry.items():
        ending = next((pair for pair in endings if key.endswith(pair[0])), ("", ""))
        renamed[key.removesuffix(ending[0]) + ending[1]] = value
    return {"axis": metrics.label(number), **renamed}


def _response_to_json(response: FrequencyResponse, unit: str) -> dict[str, Any]:
    return {**response._asdict(), "why": response.why or None, "unit": unit}


def _value_and_why(key: str, one: Metric) -> dict[str, Any]:
    return {key: one.value, "why": one.why or None}


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list | tuple) else value


def _values(metrics: MetricValues) -> dict[str, float | None]:
    return {key: one.value for key, one in metrics.items()}


class ComparisonRow(NamedTuple):
    """A quantity of every run, by its entry in the catalogue and the metric of each column."""

    quantity: Quantity
    entries: tuple[Metric, ...]

    @property
    def values(self) -> tuple[float | None, ...]:
        """The numbers; None for missing ones."""
        return tuple(entry.value for entry in self.entries)


class MetricComparison(NamedTuple):
    """Runs side by side, by name: the quantities that one could have, in the order of the
    catalogue.
    """

    columns: tuple[str, ...]
    rows: tuple[ComparisonRow, ...]

    def row(self, key: str) -> ComparisonRow:
        """Returns a quantity's row by its key; KeyError without one."""
        return {row.quantity.key: row for row in self.rows}[key]


def compare_metrics(logs: Sequence[Log], names: Sequence[str] = ()) -> MetricComparison:
    """Returns logs side by side, torn, short and empty ones too; columns bear their files'
    names by default.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    measured = [compute_log_metrics(log) for log in logs]
    rows = [
        ComparisonRow(one, tuple(metrics.run_value(one) for metrics in measured))
        for one in quantities()
    ]
    kept = tuple(row for row in rows if any(entry.applies for entry in row.entries))
    return MetricComparison(tuple(names) or tuple(Path(log.source).stem for log in logs), kept)


def comparison_to_json(comparison: MetricComparison) -> dict[str, Any]:
    """Returns a comparison, ready for JSON: finite numbers, and null with its reason in
    `unknown`.
    """
    return {
        "columns": list(comparison.columns),
        "rows": [
            {
                "key": row.quantity.key,
                "name": row.quantity.name,
                "unit": row.quantity.unit,
                "group": row.quantity.group,
                "values": list(row.values),
                "unknown": [entry.why or None for entry in row.entries],
            }
            for row in comparison.rows
        ],
    }
