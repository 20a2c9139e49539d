"""Data of the page's interactive charts: tables of decimated columns, and charts that refer to
them.

Invariant:
- Every spike of the log is on the page.
- Every line of a chart has a value to draw. A chart without any line is left out, and
  `PageCharts.missing` names it.
- Numbers are base64 of little-endian int32 and float32, a third of their length as text.
- What the scripts of the page get has the types of `page_data`.
"""

import base64
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..analysis import site_signals
from ..analysis.arm_rows import joint_positions_m
from ..analysis.site_signals import decimate
from ..analysis.timeline import (
    find_mode_intervals,
    list_changes,
    list_stated_models,
    recorded_end_s,
)
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from . import style
from .appearance import DARK_SITE_COLOURS, list_site_colours
from .figures import age_and_lateness, arm_poses
from .page_data import (
    ChainArm,
    Chart,
    ColumnTable,
    DistributionChart,
    DistributionSeries,
    HistogramChart,
    HistogramSeries,
    MarkedChange,
    ModeSpan,
    PageData,
    Palettes,
    PlanarArm,
    StatedLine,
    TableSeries,
    TimeChart,
)

BUCKET_BUDGET = 48_000
"""Buckets of all columns together: what keeps a page near a megabyte, however many sites there
are.
"""
_FRAMES = 400
"""Instants at which the page knows where the joints of a chain are."""
PICTURE_SIDE = 4.0
"""Width of a picture of a chain, in the units in which the page's lines have their widths."""


class PageCharts(NamedTuple):
    """The charts of a page.

    Attributes:
        data: what the scripts of the page draw.
        missing: by section, the titles of charts that are left out because the log has no value
            for them.
    """

    data: PageData
    missing: dict[str, list[str]]


class Charts:
    """The charts of a log; `twin` is the same experiment without operators, or None.

    Attributes:
        bounds_m: left, right, bottom and top of a box around the motion of all arms, m.
        factor: units per m of pictures of the arms: 1 for planar arms, whatever their size.
    """

    def __init__(self, log: Log, twin: Log | None) -> None:
        self._log = log
        self._twin = twin
        times = np.linspace(0.0, recorded_end_s(log), 60)
        poses = [arm_poses.find_pose(log, site, t) for site in log.sites for t in times]
        self.bounds_m = left, right, bottom, top = arm_poses.compute_pose_box_m(poses)
        planar = all(arm.chain is None for arm in log.scenario.arms.values())
        self.factor = 1.0 if planar else PICTURE_SIDE / max(right - left, top - bottom)
        self._changes = list_changes(log)
        self._end_s = recorded_end_s(log)
        self._tables: list[ColumnTable] = []
        self._known: list[list[bool]] = []  # per table and column, whether there is any value
        self._titles = [
            f"joint {title.removeprefix('joint ')}" for title in style.name_joints(log)
        ]
        counts = max(arm.counts for arm in log.scenario.arms.values())
        self._small = counts.joints > 2
        columns_per_site = 9 * counts.joints + counts.parameters + len(log.sites)
        self._buckets = max(
            100, min(1200, BUCKET_BUDGET // (columns_per_site * len(log.sites)))
        )

    def data(self) -> PageCharts:
        """Returns the data of the page, and which charts are left out."""
        log = self._log
        drawn: list[Chart] = []
        missing: dict[str, list[str]] = {}
        for chart in [*self._motion(), *self._timing()]:
            if chart.series:
                drawn.append(chart)
            else:
                missing.setdefault(chart.section, []).append(chart.title)
        data = PageData(
            end_s=self._end_s,
            colours=Palettes(
                list_site_colours(log.scenario),
                list_site_colours(log.scenario, DARK_SITE_COLOURS),
            ),
            arms=[
                self._arm(index, site) for index, site in enumerate(log.sites) if len(log[site])
            ],
            tables=self._tables,
            charts=drawn,
            changes=[
                MarkedChange(n, applied.change.at_s, applied.site, applied.change.link)
                for n, applied in enumerate(self._changes, 1)
            ],
            spans={
                site: [
                    ModeSpan(index, *interval) for interval in find_mode_intervals(log[site])
                ]
                for index, site in enumerate(log.sites)
            },
            bounds_m=[self.factor * bound for bound in self.bounds_m],
        )
        return PageCharts(data, missing)

    def _table(self, site: str, tick: Ints, t_s: Array, values: NDArray[Any]) -> int:
        trace = decimate(tick, t_s, values, self._buckets)
        return self._store(site, trace.tick, trace.values)

    def _store(self, site: str, tick: Ints, values: NDArray[Any]) -> int:
        columns = [_packed(column, "<f4") for column in values.T]
        rate_hz = self._log.scenario.sites[site].rate_hz
        self._tables.append(ColumnTable(rate_hz, _packed(tick, "<i4"), columns))
        self._known.append(np.isfinite(values).any(axis=0).tolist())
        return len(self._tables) - 1

    def _site_table(self, site: str, values: NDArray[Any]) -> int:
        return self._table(site, self._log[site].tick, self._log[site].t_s, values)

    def _series(self, site: str, table: int, column: int, label: str = "") -> TableSeries:
        colour = self._log.sites.index(site)
        return TableSeries(label=label or site, colour=colour, table=table, column=column)

    def _chart(
        self,
        section: str,
        title: str,
        unit: str,
        series: Sequence[TableSeries],
        sites: Sequence[str] = (),
        **options: Any,
    ) -> TimeChart:
        """Returns a chart over time of those series that have a value; `sites`: by default all."""
        known = [line for line in series if self._known[line.table][line.column]]
        marked = list(sites or self._log.sites)
        return TimeChart(
            section=section, title=title, unit=unit, series=known, sites=marked, **options
        )

    def _motion(self) -> Iterator[TimeChart]:
        log = self._log
        operated = site_signals.sites_with_operator(log)
        if operated:
            tables = self._tables_of(site_signals.external_torques, operated)
            yield from self._per_joint("torques", "operator torque on the arm", "N m", tables)
        yield from self._positions()
        tables = self._tables_of(site_signals.joint_errors)
        unit = site_signals.shared_unit(log)
        axes = (
            style.name_shared(log) if site_signals.follows_in_task_space(log) else self._titles
        )
        yield from self._per_joint(
            section="errors", title="tracking error", unit=unit, tables=tables, titles=axes
        )
        yield from self._estimates()
        if self._twin is not None:
            moved = {
                s: site_signals.operator_displacement(log, self._twin, s) for s in log.sites
            }
            tables = {s: self._columns(s, *columns) for s, columns in moved.items()}
            yield from self._per_joint("moved", "moved by the operators", "rad", tables)
        tables = self._tables_of(site_signals.controller_torques)
        yield from self._per_joint("control", "control torque", "N m", tables)

    def _tables_of(
        self, signal: Callable[[SiteLog], NDArray[Any]], sites: list[str] | None = None
    ) -> dict[str, list[TableSeries]]:
        parts = {site: self._log[site] for site in sites or self._log.sites}
        return {
            s: self._columns(s, part.tick, part.t_s, signal(part)) for s, part in parts.items()
        }

    def _columns(
        self, site: str, tick: Ints, t_s: Array, values: NDArray[Any]
    ) -> list[TableSeries]:
        count = values.shape[1]
        if not self._small:
            table = self._table(site, tick, t_s, values)
            return [self._series(site, table, column) for column in range(count)]
        return [
            self._series(site, self._table(site, tick, t_s, one[:, np.newaxis]), 0)
            for one in values.T
        ]

    def _per_joint(
        self,
        section: str,
        title: str,
        unit: str,
        tables: dict[str, list[TableSeries]],
        titles: Sequence[str] = (),
    ) -> Iterator[TimeChart]:
        for joint, name in enumerate(titles or self._titles):
            series = [columns[joint] for columns in tables.values() if joint < len(columns)]
            yield self._chart(section, f"{title}, {name}", unit, series)

    def _positions(self) -> Iterator[TimeChart]:
        for site in self._log.sites:
            part = self._log[site]
            both = np.stack(
                [site_signals.joint_angles(part), site_signals.reference_angles(part)], axis=2
            )
            for joint, name in enumerate(self._titles[: both.shape[1]]):
                table = self._site_table(site, both[:, joint])
                desired = TableSeries(
                    label="desired", colour="limit", table=table, column=1, dash=True
                )
                series = [self._series(site, table, 0), desired]
                yield self._chart("positions", f"{site}, {name}", "rad", series, sites=[site])

    def _estimates(self) -> Iterator[TimeChart]:
        log = self._log
        tables = self._tables_of(site_signals.parameter_estimates)
        arm = max(log.scenario.arms.values(), key=lambda each: each.counts)
        for index, (name, unit) in enumerate(arm.parameters):
            series = [columns[index] for columns in tables.values() if index < len(columns)]
            every = [log.scenario.arms[site].theta for site in log.sites]
            truths = [float(theta[index]) for theta in every if index < len(theta)]
            lines = [StatedLine(truth, n, 0.0, self._end_s) for n, truth in enumerate(truths)]
            if len(set(truths)) == 1:
                lines = [StatedLine(truths[0], "limit", 0.0, self._end_s)]
            title = name if arm.chain else f"estimate of θ{'₁₂₃₄₅'[index]}"
            yield self._chart("estimates", title, style.typeset_unit(unit), series, lines=lines)

    def _timing(self) -> Iterator[Chart]:
        log = self._log
        yield from self._ages()
        if age_and_lateness.has_varying_delay(log):
            yield from self._distributions()
        if not age_and_lateness.explain_missing_loop_times(log):
            tables = self._tables_of(lambda part: part.late_us[:, np.newaxis] * 1e-3)
            series = [columns[0] for columns in tables.values()]
            yield self._chart("timing", "wake-up after the deadline", "ms", series, zero=True)
            yield from self._histograms()

    def _ages(self) -> Iterator[TimeChart]:
        log = self._log
        for site in log.sites:
            age_ms = site_signals.sample_ages_ms(log, site)
            peers = log[site].peers
            table = self._site_table(site, age_ms)
            series = [
                self._series(peer, table, n, f"{peer} → {site}") for n, peer in enumerate(peers)
            ]
            lines = self._stated(site)
            drawn = np.concatenate([age_ms.ravel(), [line.value for line in lines]])
            yield self._chart(
                "ages",
                f"age of the samples that {site} uses",
                "ms",
                series,
                sites=[site],
                lines=lines,
                links=True,
                log=age_and_lateness.needs_log_axis(drawn),
                margin=0.025,
            )

    def _stated(self, site: str) -> list[StatedLine]:
        log = self._log
        lines: list[StatedLine] = []
        for peer in log[site].peers:
            states = list_stated_models(log, f"{peer}->{site}", self._changes)
            t_s, mean_ms = age_and_lateness.trace_stated_delay(log, states)
            for start, end, value in zip(t_s[::3], t_s[1::3], mean_ms[::3], strict=True):
                if np.isfinite(value):
                    colour = log.sites.index(peer)
                    lines.append(StatedLine(float(value), colour, float(start), float(end)))
        if len({line.value for line in lines}) == 1:
            return [StatedLine(lines[0].value, "limit", 0.0, self._end_s)]
        return lines

    def _distributions(self) -> Iterator[DistributionChart]:
        measured = age_and_lateness.measure_delay_distributions(self._log)
        x_ms = age_and_lateness.choose_delay_axis_ms(measured)
        for site in self._log.sites:
            series = []
            for link in (link for link in measured if link.site == site):
                colour = self._log.sites.index(link.peer)
                for name, values, dash in (
                    ("age", link.age_ms, False),
                    ("delay", link.delay_ms, True),
                ):
                    percent = age_and_lateness.compute_cumulative_percent(values, x_ms)
                    if np.isfinite(percent).any():
                        label = f"{name}, {link.peer}"
                        series.append(
                            DistributionSeries(label, colour, dash, _packed(percent, "<f4"))
                        )
            yield DistributionChart(
                section="delays",
                title=f"delay and age on the way to {site}",
                unit="ms",
                series=series,
                x=_packed(x_ms, "<f4"),
                log=bool(x_ms[0] > 0.0),
            )

    def _histograms(self) -> Iterator[HistogramChart]:
        log = self._log
        edges = age_and_lateness.choose_bin_edges_us(log)
        periods = sorted({1e6 / log.scenario.sites[site].rate_hz for site in log.sites})
        titles = {
            "late_us": "wake-up after the deadline",
            "busy_us": "computing time of a tick",
        }
        for field, title in titles.items():
            series = [
                HistogramSeries(
                    site,
                    colour,
                    age_and_lateness.bin_loop_times(getattr(log[site], field), edges).tolist(),
                )
                for colour, site in enumerate(log.sites)
                if len(log[site])
            ]
            yield HistogramChart(
                section="timing",
                title=f"{title}, histogram",
                unit="µs",
                series=series,
                edges=edges.tolist(),
                periods=periods,
            )

    def _arm(self, index: int, site: str) -> PlanarArm | ChainArm:
        part = self._log[site]
        arm = self._log.scenario.arms[site]
        if arm.chain is not None:
            return self._projected(index, site)
        values = np.hstack(
            [site_signals.joint_angles(part), site_signals.reference_angles(part)]
        )
        edges = self._edges(site, np.arange(len(part)))
        table = self._site_table(site, np.hstack([values, *edges]))
        return PlanarArm(
            site=site, colour=index, table=table, bodies=len(edges), links_m=list(arm.lengths_m)
        )

    def _edges(self, site: str, rows: NDArray[np.int64]) -> list[NDArray[np.float64]]:
        """Returns the edges of the bodies of a site's plant in some records, shape (K, 2 P)
        each.
        """
        sizes_m = self._log.scenario.bodies_m(site).values()
        arm = self._log.scenario.arms[site]
        if not sizes_m:
            return []
        traced = arm_poses.trace_bodies_m(arm, sizes_m, self._log[site].bodies[rows])
        return [self.factor * path.reshape(len(rows), -1) for path in traced]

    def _projected(self, index: int, site: str) -> ChainArm:
        part = self._log[site]
        arm = self._log.scenario.arms[site]
        rows = np.unique(np.linspace(0, max(len(part) - 1, 0), _FRAMES).astype(np.int64))[
            : len(part)
        ]
        actual, desired = (
            joint_positions_m(arm, q[rows])
            for q in (part.q, site_signals.reference_angles(part))
        )
        pictures = (
            arm_poses.project_arm_m(arm, actual),
            arm_poses.project_arm_m(arm, desired),
            arm_poses.project_arm_m(arm, actual, onto_floor=True),
        )
        points = np.stack([picture[:, 1:] for picture in pictures], axis=1) * self.factor
        edges = self._edges(site, rows)
        table = self._store(
            site, part.tick[rows], np.hstack([points.reshape(len(rows), -1), *edges])
        )
        return ChainArm(
            site=site, colour=index, table=table, bodies=len(edges), points=points.shape[2]
        )


def _packed(column: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(column.astype(kind)).tobytes()).decode()
