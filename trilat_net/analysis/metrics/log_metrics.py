"""Computes all metrics of a log, converts them to JSON, and compares several logs.

A metric is a number that describes a run or a part of it, for example the largest motor torque
of one arm. The other modules of this folder define the metrics. `LogMetrics` collects their
values, and `trilat metrics` prints them.

Invariant:
    - Each metric is present for each arm, link, wall or run to which it applies, either as a
      number or with the reason why it is missing.
    - In JSON a missing value is null, and the key `unknown` contains the reason.
    - A comparison has one column per log and one row per metric of the whole run.
"""

import math
import pkgutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ...core import POSITION
from ...errors import count_nouns, suggest_nearest
from ...log import Log
from ...results import Result
from ...scenario import TASK_AXES, Scenario
from ..run_view import RunView
from ..site_signals import follows_in_task_space
from . import static_windows
from .measured_impedance import FrequencyResponse, ImpedanceEstimate
from .measures import Measure, Metric, MetricValues, Quantity
from .motion_metrics import ParameterEstimates, measure_undelayed_error
from .static_windows import JointLoad, SharingRatio, StiffnessEstimate

# every file of this folder declares its metrics when it is imported
for _module in pkgutil.iter_modules(import_module(__package__).__path__):
    import_module(f"{__package__}.{_module.name}")

_ALONG_AXES = {
    "N m": "N",
    "rad": "m",
    "N m/rad": "N/m",
    "N m s/rad": "N s/m",
}
"""Units of quantities along an axis, by the units of the same quantities of a joint."""

_SubjectValues = dict[str, MetricValues]
"""Metrics of all subjects of one kind, such as all sites, by name of the subject."""
_JsonEntry = dict[str, Any]
"""Plain values of a joint load, a sharing ratio or a frequency response, by key."""

METRICS_JSON_VERSION = 1
"""Version of the JSON: keys may be added, but no key is removed or changes its meaning."""


@dataclass(frozen=True, repr=False)
class LogMetrics(Result):
    """All metrics of a run, such as the largest error of each arm and the delay of each link.

    A metric is a number with a name and a unit. `LogMetrics.of_log` computes all metrics.

    Attributes:
        log: File name of the log.
        scenario: Name of the scenario.
        driver: How the run was executed: "live" or "virtual".
        complete: True if the log was closed properly.
        run: Metrics of the whole run.
        sites: Metrics of each site, keyed by site name.
        links: Metrics of each link, keyed by a name such as "m1->s".
        walls: Metrics of each wall. "s/1" is the first wall of site s.
        estimates: Estimates of the arm parameters, for each site with records.
        static_windows: Number of time windows in which all arms are at rest.
        joint_loads: Torques of all loaded sites at each loaded joint, in each static window.
        sharing_ratios: Force sharing at each joint at which two sites are loaded.
        stiffness: Stiffness that an operator felt between consecutive static windows.
        responses: Impedances and reflections over frequency.
        axes: Names of the shared coordinates in task space, where joint numbers stand for
            coordinates. Empty in joint space.
        joint_names: Names of the joints, if they are the same in the files of all arms. Empty
            otherwise.
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

    # overflow and NaN do not warn: a metric that is not finite becomes a reason
    @classmethod
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def of_log(cls, log: Log) -> "LogMetrics":
        """Computes all metrics of a recorded run, such as the largest error of each arm.

        The log may be truncated, short or empty. If the log does not determine a value, the
        reason is stated in place of the value.

        Args:
            log: The log of the run.

        Raises:
            LogError: A record cannot be read, or a recorded change is invalid.
        """
        view = RunView(log)
        scenario = log.scenario
        values = _measure_subjects(view, Measure.list_all())

        axes: tuple[str, ...] = ()
        if follows_in_task_space(log):
            first_site = log.sites[0]
            axis_count = scenario.arms[first_site].counts.shared
            axes = TASK_AXES[:axis_count]

        return cls(
            log=Path(log.source).name,
            scenario=scenario.name,
            driver=log.driver,
            complete=log.complete,
            run=values["run"][""],
            sites=values["site"],
            links=values["link"],
            walls=values["wall"],
            estimates=view.compute_once(ParameterEstimates.by_site),
            static_windows=static_windows.count_static_windows(view),
            joint_loads=view.compute_once(static_windows.JointLoad.list_of_run),
            sharing_ratios=view.compute_once(static_windows.SharingRatio.list_of_run),
            stiffness=static_windows.StiffnessEstimate.list_of_run(view),
            responses=ImpedanceEstimate.list_of_run(view),
            axes=axes,
            joint_names=_find_common_joint_names(scenario),
        )

    @classmethod
    def find_quantity(cls, key: str) -> Quantity:
        """Returns the name, unit and meaning of a metric, given a key such as "rms_error_rad".

        Args:
            key: Key of the metric in JSON output and tables.

        Raises:
            KeyError: No metric has this key. The message suggests the most similar key.
        """
        known = {quantity.key: quantity for quantity in Quantity.list_all()}
        if key not in known:
            nearest = suggest_nearest(key, list(known))
            raise KeyError(
                f"there is no metric {key!r}{nearest}; docs/reference/metrics.md lists all "
                "metrics"
            )
        return known[key]

    @staticmethod
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # as in of_log
    def measure_run(log: Log, keys: Iterable[str]) -> dict[str, Metric]:
        """Computes only some quantities of a run, which is faster than computing all of them.

        Commands use this to compare a few quantities across many runs, for example the points
        of a sweep.

        Args:
            log: The log of the run.
            keys: Keys of the quantities.

        Returns:
            The metrics of the run, by key.

        Raises:
            KeyError: One of the keys is not the key of a quantity.
            LogError: A record cannot be read, or a recorded change is invalid.
        """
        requested = {key: LogMetrics.find_quantity(key) for key in keys}
        needed_measures = []
        for measure in Measure.list_all():
            measured_keys = {quantity.key for quantity in measure.quantities}
            if not measured_keys.isdisjoint(requested):
                needed_measures.append(measure)

        values = _measure_subjects(RunView(log), needed_measures)
        run_values = {}
        for key, quantity in requested.items():
            values_by_subject = {}
            for subject, metrics in values[quantity.of].items():
                values_by_subject[subject] = metrics[key]
            run_values[key] = _reduce_to_run(quantity, values_by_subject)
        return run_values

    @staticmethod
    def find_undelayed_maxima(
        log: Log, sites: Iterable[str], other: Log | None = None
    ) -> dict[str, float]:
        """Finds the largest distance between each site and its peers at any one time.

        For the tracking error, a site is compared with samples that its peers sent some time
        ago. For this distance, the site is compared with its peers at the same time. The
        distance therefore includes the effect of the delay.

        Args:
            log: The log of the run.
            sites: Names of the sites.
            other: Log of a run with the same sites, such as a rerun. If given, only times at
                which both runs have a record of the site are used.

        Returns:
            The largest distance by site, in rad, or in m if the sites share positions. Sites
            for which this distance does not exist, for example because they follow no other
            site, are missing.

        Raises:
            LogError: A record cannot be read, or a recorded change is invalid.
        """
        view = RunView(log)
        maxima = {}
        for site in sites:
            is_angle = log.scenario.sites[site].task.space == "joints"
            key = "undelayed_max_rad" if is_angle else "undelayed_max_m"
            distance = measure_undelayed_error(view, site, other)[key].value
            if distance is not None:
                maxima[site] = distance
        return maxima

    def label(self, number: int) -> str:
        """Returns the name of a joint or axis for a table, such as "1", "3 elbow" or "x".

        The name of a joint is appended to its number if all arms have the same joint names.

        Args:
            number: Number of the joint or axis, from 1.
        """
        if self.axes:
            return self.axes[number - 1]
        if self.joint_names:
            return f"{number} {self.joint_names[number - 1]}"
        return str(number)

    def unit(self, joint_unit: str, number: int) -> str:
        """Returns the unit of a quantity at a joint or along a spatial axis.

        If the arms follow each other with their end effectors, the first three numbers stand
        for spatial axes. A torque in N m at a joint then becomes a force in N along an axis.

        Args:
            joint_unit: Unit of the quantity at a joint.
            number: Number of the joint or axis, from 1.
        """
        if self.axes and number <= POSITION:
            return _ALONG_AXES.get(joint_unit, joint_unit)
        return joint_unit

    def headline(self) -> str:
        """Returns one line with the log, the number of known values, and the sites.

        An example is "run.mcap: 84 numbers of paper, m1, m2, s", where "paper" is the scenario.
        """
        known = 0
        for _, metric in self._list_values():
            known += metric.value is not None
        numbers = count_nouns(known, "number")
        sites = ", ".join(self.sites)
        return f"{self.log}: {numbers} of {self.scenario}, {sites}"

    def to_dict(self) -> dict[str, Any]:
        """Returns the metrics as plain values, with the keys of `trilat metrics --json`.

        Each site, link or wall has its own dictionary: `["sites"]["m1"]` maps the keys of
        metrics to their values for site m1. An unknown value is `None`, and the entry "unknown"
        contains the reason.
        """
        content: dict[str, Any] = {
            "version": METRICS_JSON_VERSION,
            "log": self.log,
            "scenario": self.scenario,
            "driver": self.driver,
            "complete": self.complete,
            "run": _values_to_json(self.run),
        }
        for kind, metrics_by_name in self._subjects.items():
            values_by_name = {}
            for name, metrics in metrics_by_name.items():
                values_by_name[name] = _values_to_json(metrics)
            content[kind] = values_by_name

        parameters = {}
        for site, estimates in self.estimates.items():
            parameters[site] = estimates.to_json()
        window_count = self.static_windows.value
        content["parameters"] = parameters
        content["windows_at_rest"] = None if window_count is None else int(window_count)
        content |= _details_to_json(self)
        content["unknown"] = self._list_reasons()
        finite_content: dict[str, Any] = _replace_not_finite(content)
        return finite_content

    @property
    def _subjects(self) -> dict[str, _SubjectValues]:
        """The metrics by name of the subject, for each kind of subject except the run."""
        return {
            "sites": self.sites,
            "links": self.links,
            "walls": self.walls,
        }

    def _list_reasons(self) -> dict[str, str]:
        """Returns the reason why each missing number is missing, by its path in the JSON.

        The number itself is null in the JSON.
        """
        metrics_by_path = {"run.": self.run}
        for kind, metrics_by_name in self._subjects.items():
            for name, metrics in metrics_by_name.items():
                metrics_by_path[f"{kind}.{name}."] = metrics
        metrics_by_path[""] = {"windows_at_rest": self.static_windows}

        reasons = {}
        for path, metrics in metrics_by_path.items():
            for key, metric in metrics.items():
                if metric.value is None:
                    reasons[path + key] = metric.why
        return reasons

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table with one row per quantity and subject.

        A subject is the run, a site, a link or a wall. Each row has the keys "group", "key",
        "name", "of" (the subject), "unit", "value", and "why" (the reason if the value is
        `None`).
        """
        rows: list[dict[str, Any]] = []
        for description, metric in self._list_values():
            if metric.applies:
                rows.append({**description, "value": metric.value, "why": metric.why})
        return rows

    def _list_values(self) -> Iterator[tuple[dict[str, str], Metric]]:
        """Yields each metric with a description of its quantity and its subject."""
        for quantity in Quantity.list_all():
            values_by_subject = self.values_of(quantity)
            for subject, metric in values_by_subject.items():
                description = {
                    "group": quantity.group,
                    "key": quantity.key,
                    "name": quantity.name,
                    "of": subject or "run",
                    "unit": quantity.unit,
                }
                yield description, metric

    def values_of(self, quantity: Quantity) -> dict[str, Metric]:
        """Returns the values of one metric, keyed by subject.

        A subject is an arm, a link, a wall, or the whole run, whose name is empty.

        Args:
            quantity: The quantity.
        """
        if quantity.of == "run":
            return {"": self.run[quantity.key]}
        key = quantity.key
        metrics_by_name = self._subjects[f"{quantity.of}s"]
        return {name: metrics[key] for name, metrics in metrics_by_name.items()}

    def run_value(self, quantity: Quantity) -> Metric:
        """Returns the value of a metric for the whole run, such as the largest of all errors.

        The values of arms, links or walls are reduced to their maximum or sum (see
        `_reduce_to_run`).

        Args:
            quantity: The quantity.
        """
        return _reduce_to_run(quantity, self.values_of(quantity))


def _reduce_to_run(quantity: Quantity, values_by_subject: Mapping[str, Metric]) -> Metric:
    """Reduces the values of a quantity to one value for the whole run.

    The value is the largest of all subjects (sites, links or walls), or their sum. Subjects to
    which the quantity does not apply are left out. If the number of any other subject is
    missing, the number of the run is missing as well.

    Args:
        quantity: The quantity, which states whether the maximum or the sum is used.
        values_by_subject: The metric of each subject, by name.
    """
    numbers = []
    reasons = []
    for subject, metric in values_by_subject.items():
        if not metric.applies:
            continue
        if metric.why:
            reasons.append(f"{subject}: {metric.why}" if subject else metric.why)
        if metric.value is not None:
            numbers.append(metric.value)

    if reasons:
        return Metric(None, "; ".join(reasons))
    if not numbers:
        all_reasons = [metric.why for metric in values_by_subject.values()]
        # each reason once, in order
        different_reasons = dict.fromkeys(all_reasons)
        why = "; ".join(different_reasons) or f"there is no {quantity.of}"
        return Metric(None, why, applies=False)

    if quantity.reduction == "sum":
        return Metric(sum(numbers))
    return Metric(max(numbers))


def _find_common_joint_names(scenario: Scenario) -> tuple[str, ...]:
    """Returns the joint names that the files of all arms share, or () if the names differ."""
    all_names: set[tuple[str, ...]] = set()
    for site, arm in scenario.arms.items():
        has_file = bool(scenario.sites[site].arm.urdf)
        all_names.add(arm.joint_names if has_file else ())
    if len(all_names) != 1:
        return ()
    return all_names.pop()


def _measure_subjects(
    view: RunView, selected_measures: Iterable[Measure]
) -> dict[str, _SubjectValues]:
    """Computes the selected metrics for the run and for each of its arms, links and walls.

    A metric is a number with a name and a unit, such as the largest error in rad.

    Args:
        view: The run.
        selected_measures: The functions that measure these metrics.

    Returns:
        The metrics by kind of subject, name of the subject, and key.
    """
    values: dict[str, _SubjectValues] = {}
    for kind in ("run", "site", "link", "wall"):
        subjects = view.list_subjects(kind)
        values[kind] = {name: {} for name in subjects}
    for measure in selected_measures:
        metrics_by_name = values[measure.of]
        for name, metrics in metrics_by_name.items():
            measured = measure.measure(view, name)
            metrics.update(measured)
    return values


def _details_to_json(metrics: LogMetrics) -> dict[str, Any]:
    """Returns joint loads, force sharing, stiffness and frequency responses as plain values.

    If the arms follow with their end effectors, the entries have an axis in place of the joint,
    and the units of this axis.
    """
    details: dict[str, list[_JsonEntry]] = {
        "levers": [_load_to_json(load) for load in metrics.joint_loads],
        "force_sharing": [_sharing_to_json(ratio) for ratio in metrics.sharing_ratios],
        "stiffness": [estimate._asdict() for estimate in metrics.stiffness],
        "felt": [_impedance_to_json(metrics, estimate) for estimate in metrics.responses],
    }

    if metrics.axes:
        by_axis = {}
        for name, entries in details.items():
            by_axis[name] = [_name_axis(metrics, entry) for entry in entries]
        return by_axis

    if metrics.joint_names:
        for entries in details.values():
            for entry in entries:
                index = entry["joint"] - 1
                entry["joint_name"] = metrics.joint_names[index]
    return details


def _load_to_json(load: JointLoad) -> _JsonEntry:
    """Converts the external torques at a joint at rest, with their weights, to plain values."""
    content = load._asdict()
    content["weight"] = _values_to_json(load.weight)
    return content | _value_and_reason("imbalance", load.imbalance)


def _sharing_to_json(ratio: SharingRatio) -> _JsonEntry:
    """Returns the torque that an operator feels, and the expected torque, as plain values."""
    content = ratio._asdict()
    content["off"] = ratio.off
    return content | _value_and_reason("expected_nm", ratio.expected_nm)


def _impedance_to_json(metrics: LogMetrics, estimate: ImpedanceEstimate) -> _JsonEntry:
    """Returns an estimated impedance as plain values, with the units of its coordinate."""
    unit = metrics.unit(estimate.unit, estimate.joint)
    spectrum = estimate.spectrum
    content = estimate._asdict()
    content["ratio"] = _response_to_json(estimate.ratio, unit)
    content["spectrum"] = [_response_to_json(response, unit) for response in spectrum]
    return content


def _name_axis(metrics: LogMetrics, entry: _JsonEntry) -> _JsonEntry:
    """Converts the entry of a joint to that of an axis, for arms that follow end effectors.

    The key "joint" becomes "axis". In keys that end in a unit of torque or angle, the unit is
    replaced by that along the axis. For example, "force_nm" becomes "force_n".
    """
    number = entry.pop("joint")
    axis_entry = {"axis": metrics.label(number)}
    for key, value in entry.items():
        new_key = _name_along_axis(key) if number <= POSITION else key
        axis_entry[new_key] = value
    return axis_entry


def _name_along_axis(key: str) -> str:
    """Replaces the unit at the end of a joint's key by the unit along a position axis."""
    # the longest ending first
    endings = {"_nm_rad": "_n_m", "_nm": "_n", "_rad": "_m"}
    for ending, replacement in endings.items():
        if key.endswith(ending):
            return key.removesuffix(ending) + replacement
    return key


def _response_to_json(response: FrequencyResponse, unit: str) -> _JsonEntry:
    """Returns the frequency response at one frequency as plain values."""
    content = response._asdict()
    content["why"] = response.why or None
    content["unit"] = unit
    return content


def _value_and_reason(key: str, value: Metric) -> _JsonEntry:
    """Returns a metric as two JSON keys: its number, and "why", the reason if it is missing."""
    return {key: value.value, "why": value.why or None}


def _replace_not_finite(value: Any) -> Any:
    """Replaces all numbers that are not finite by `None`, in nested dictionaries and lists."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _replace_not_finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_not_finite(inner) for inner in value]
    return value


def _values_to_json(metrics: MetricValues) -> dict[str, float | None]:
    """Returns the values of metrics by key. Missing values are `None`."""
    return {key: metric.value for key, metric in metrics.items()}
