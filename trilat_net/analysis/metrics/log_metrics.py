"""All metrics of a log, their JSON, and the comparison of several logs.

Invariant: every entry of the catalogue is present for every place it applies to, as a number or with the
reason for its absence; in JSON the number is null and `unknown` has the reason. Link and loop metrics add
no definition to those of docs/definitions.md. A comparison has one column per log and one row per metric
of the whole run.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...log.log_reader import Log
from ..aligned import AlignedRecords, align_records
from ..dominance_history import DominanceHistory, trace_dominance
from ..health import describe_site_health
from ..link_summary import LinkSummary, summarise_links
from ..torque_split import TorqueSplit, attribute_torque
from . import force_sharing, parameter_error, port_energy, tracking_metrics, wall_contact
from .force_sharing import JointLoad, SharingRatio
from .impedance import ImpedanceEstimate, estimate_impedances
from .metric_catalogue import QUANTITIES, Metric, MetricValues, Quantity, metric, unavailable
from .static_windows import StaticWindow, StiffnessEstimate, estimate_stiffness, find_static_windows

LINK_METRIC_KEYS = ("age_mean_ms", "age_p99_ms", "age_max_ms", "silence_ms", "loss", "burst", "late_samples")
NO_CLOCK = "no clock was read"
LOOP_METRIC_KEYS = ("late_p99_us", "late_max_us", "busy_p99_us", "overruns", "missing")


def measure_link(use: LinkSummary) -> MetricValues:
    """Returns effective delay, loss and bursts of a link."""
    age, never = use.age_ms, "no sample ever came into use"
    ages = {
        "age_mean_ms": metric(age.mean if age else None, never),
        "age_p99_ms": metric(age.p99 if age else None, never),
        "age_max_ms": metric(age.max if age else None, never),
        "silence_ms": metric(use.silence_ms, never),
    }
    unknown = "of no sample it is known whether it came"
    lost = Metric(None, "nothing was lost", applies=False) if use.loss == 0.0 else metric(use.burst, unknown)
    return {
        **ages,
        "loss": metric(use.loss, unknown),
        "burst": lost,
        "late_samples": metric(use.counts.late if use.counts else None, f"no records of {use.site}"),
    }


def measure_loop(log: Log, site: str) -> MetricValues:
    """Returns lateness, computing time and overruns of a site's loop, and its missing records."""
    missing = {"missing": metric(log.missing(site))}
    if log.driver != "live":
        return {**unavailable(LOOP_METRIC_KEYS[:-1], NO_CLOCK, applies=False), **missing}
    if not len(log[site]):
        return {**unavailable(LOOP_METRIC_KEYS[:-1], f"no records of {site}"), **missing}
    facts = describe_site_health(log, site)
    busy = facts["busy_us"]
    return {
        "late_p99_us": metric(facts["late_us"]["p99"]),
        "late_max_us": metric(facts["late_us"]["max"]),
        "busy_p99_us": metric(busy["p99"]) if busy else Metric(None, "no second record"),
        "overruns": metric(facts["overruns"]),
        **missing,
    }


class LogMetrics(NamedTuple):
    """A log in numbers.

    Attributes:
        run: of the whole, by key.
        sites: per site.
        links: per link "j->i".
        walls: per wall "s/1": a site, and which of its walls.
        learnt: per site with records, its estimates one by one.
        rest: how many windows at rest there are, in which statics can be read off; or why there is none.
        levers: their loaded joints, with the torques of all loaded sites.
        shared: who felt what of them, where two sites are loaded.
        stiffness: what hands felt from one of them to the next.
        felt: impedances and reflections over frequency.
    """

    run: MetricValues
    sites: dict[str, MetricValues]
    links: dict[str, MetricValues]
    walls: dict[str, MetricValues]
    learnt: dict[str, parameter_error.ParameterEstimates]
    rest: Metric
    levers: list[force_sharing.JointLoad]
    shared: list[force_sharing.SharingRatio]
    stiffness: list[StiffnessEstimate]
    felt: list[ImpedanceEstimate]

    def places(self, quantity: Quantity) -> dict[str, Metric]:
        """Returns a quantity of every place that has it; of the run by the name ""."""
        if quantity.of == "run":
            return {"": self.run[quantity.key]}
        found: dict[str, MetricValues] = getattr(self, f"{quantity.of}s")
        return {name: facts[quantity.key] for name, facts in found.items()}

    def whole(self, quantity: Quantity) -> Metric:
        """Returns a quantity of the run: the largest of its places, or their sum.

        A place that can have none does not count; where one has none that could, there is none of the run.
        """
        places = {name: one for name, one in self.places(quantity).items() if one.applies}
        lacking = {name: one for name, one in places.items() if one.value is None}
        if lacking:
            whys = [f"{name}: {one.why}" if name else one.why for name, one in lacking.items()]
            return Metric(None, "; ".join(whys))
        values = [one.value for one in places.values() if one.value is not None]
        if not values:
            nowhere = dict.fromkeys(one.why for one in self.places(quantity).values())
            return Metric(None, "; ".join(nowhere) or f"there is no {quantity.of}", applies=False)
        return Metric(sum(values) if quantity.whole == "sum" else max(values))


def compute_log_metrics(log: Log) -> LogMetrics:
    """Returns all quantities of a log; of torn, short and empty ones too.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is no number
        return _measure_aligned(log, align_records(log))


def _measure_aligned(log: Log, found: dict[str, AlignedRecords]) -> LogMetrics:
    specs = log.scenario.sites
    by = {site: attribute_torque(track, specs[site]) for site, track in found.items()}
    owned = {site: trace_dominance(log, site, track.t_s) for site, track in found.items()}
    absent = [site for site in log.sites if site not in found]
    windows: list[StaticWindow] = [] if absent else find_static_windows(found, by, owned)
    levers = force_sharing.find_joint_loads(log.scenario, windows)
    pairs = force_sharing.find_sharing_ratios(log.scenario, windows, levers)
    return LogMetrics(
        {
            **tracking_metrics.measure_spread(log, found),
            **force_sharing.measure_force_sharing(absent, windows, pairs),
        },
        {site: _measure_site(log, site, found.get(site), by.get(site)) for site in log.sites},
        _measure_links(log, found, owned),
        _measure_walls(log, found, by),
        {site: parameter_error.read_parameter_estimates(specs[site], track) for site, track in found.items()},
        force_sharing.count_static_windows(absent, windows),
        levers,
        pairs,
        estimate_stiffness(windows),
        estimate_impedances(found, by),
    )


def _measure_site(log: Log, site: str, track: AlignedRecords | None, by: TorqueSplit | None) -> MetricValues:
    ports = unavailable(port_energy.PORT_ENERGY_KEYS, f"no records of {site}")
    if track is not None and by is not None:
        ports = port_energy.measure_port_energy(log.scenario, track, by)
    return {
        **tracking_metrics.measure_tracking(log, site),
        **tracking_metrics.measure_effort(log, site),
        **ports,
        **parameter_error.measure_parameter_error(log.scenario.sites[site], track),
        **measure_loop(log, site),
    }


def _measure_links(
    log: Log, found: Mapping[str, AlignedRecords], owned: Mapping[str, DominanceHistory]
) -> dict[str, MetricValues]:
    return {
        use.name: {
            **tracking_metrics.measure_following(log, found, use.peer, use.site),
            **port_energy.measure_delay_energy(log, found, owned, use.peer, use.site),
            **measure_link(use),
        }
        for use in summarise_links(log)
    }


def _measure_walls(
    log: Log, found: Mapping[str, AlignedRecords], by: Mapping[str, TorqueSplit]
) -> dict[str, MetricValues]:
    facts = {}
    for site in log.sites:
        for n, wall in enumerate(wall_contact.list_walls(log.scenario.sites[site]), 1):
            tip = by[site].end_effector if site in by else None
            facts[f"{site}/{n}"] = wall_contact.measure_wall_contact(wall, found.get(site), tip)
    return facts


METRICS_JSON_VERSION = 1
"""Of this layout: keys may be added under it, none is taken away or changes its meaning."""


def metrics_to_json(log: Log, measured: LogMetrics) -> dict[str, Any]:
    """Returns the quantities of a log, ready for JSON.

    Args:
        log: the log.
        measured: what was measured of it.
    """
    places: dict[str, Mapping[str, MetricValues]] = {
        "sites": measured.sites,
        "links": measured.links,
        "walls": measured.walls,
    }
    found: dict[str, Any] = {
        "version": METRICS_JSON_VERSION,
        "log": Path(log.source).name,
        "scenario": log.scenario.name,
        "driver": log.driver,
        "complete": log.complete,
        "run": _values(measured.run),
        **{kind: {name: _values(one) for name, one in found.items()} for kind, found in places.items()},
        "parameters": {site: learnt._asdict() for site, learnt in measured.learnt.items()},
        "windows_at_rest": None if measured.rest.value is None else int(measured.rest.value),
        "levers": [_joint_load(lever) for lever in measured.levers],
        "force_sharing": [_sharing_ratio(pair) for pair in measured.shared],
        "stiffness": [one._asdict() for one in measured.stiffness],
        "felt": [
            {
                **one._asdict(),
                "ratio": {**one.ratio._asdict(), "why": one.ratio.why or None, "unit": one.unit},
            }
            for one in measured.felt
        ],
        "unknown": {
            **_whys("run", measured.run),
            **{
                path: why
                for kind, found in places.items()
                for name, one in found.items()
                for path, why in _whys(f"{kind}.{name}", one).items()
            },
            **_whys("", {"windows_at_rest": measured.rest}),
        },
    }
    return {key: _finite(value) for key, value in found.items()}


def _finite(value: Any) -> Any:
    """Returns a value with null for every number that is not finite, as of logs that left the physics."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list | tuple) else value


def _values(found: MetricValues) -> dict[str, float | None]:
    return {key: one.value for key, one in found.items()}


def _whys(path: str, found: MetricValues) -> dict[str, str]:
    """Returns why there are no numbers, by their paths."""
    start = f"{path}." if path else ""
    return {f"{start}{key}": one.why for key, one in found.items() if one.value is None}


def _joint_load(lever: JointLoad) -> dict[str, Any]:
    weights = {site: one.value for site, one in lever.weight.items()}
    why = lever.imbalance.why or None
    return {**lever._asdict(), "weight": weights, "imbalance": lever.imbalance.value, "why": why}


def _sharing_ratio(pair: SharingRatio) -> dict[str, Any]:
    expected = pair.expected_nm
    return {
        **pair._asdict(),
        "expected_nm": expected.value,
        "off": pair.off,
        "why": expected.why or None,
    }


class ComparisonRow(NamedTuple):
    """A quantity of every run.

    Attributes:
        quantity: what it is: its key, its name, its unit, its group.
        entries: per column the number, or why there is none.
    """

    quantity: Quantity
    entries: tuple[Metric, ...]

    @property
    def values(self) -> tuple[float | None, ...]:
        """The numbers, None where there is none."""
        return tuple(entry.value for entry in self.entries)


class MetricComparison(NamedTuple):
    """Runs side by side.

    Attributes:
        columns: the names of the runs.
        rows: the quantities of which at least one run could have one, in the order of the catalogue.
    """

    columns: tuple[str, ...]
    rows: tuple[ComparisonRow, ...]

    def row(self, key: str) -> ComparisonRow:
        """Returns a quantity's row by its key; KeyError where there is none."""
        for row in self.rows:
            if row.quantity.key == key:
                return row
        raise KeyError(key)


def compare_metrics(logs: Sequence[Log], names: Sequence[str] = ()) -> MetricComparison:
    """Returns logs side by side.

    Args:
        logs: the logs; torn, short and empty ones too.
        names: what the columns are called; left out: by the logs' files.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    return tabulate_metrics(
        [compute_log_metrics(log) for log in logs], tuple(names) or tuple(map(_name, logs))
    )


def tabulate_metrics(measured: Sequence[LogMetrics], names: Sequence[str]) -> MetricComparison:
    """Returns measurements side by side.

    Args:
        measured: one per run.
        names: of the columns.
    """
    rows = [
        ComparisonRow(quantity, tuple(one.whole(quantity) for one in measured)) for quantity in QUANTITIES
    ]
    kept = tuple(row for row in rows if any(entry.applies for entry in row.entries))
    return MetricComparison(tuple(names), kept)


def comparison_to_json(comparison: MetricComparison) -> dict[str, Any]:
    """Returns a comparison, ready for JSON: finite numbers, and null with its reason in `unknown`."""
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


def _name(log: Log) -> str:
    return Path(log.source).stem
