"""Computes the data for the interactive charts in the report of a run, a web page.

Scripts in the page draw the charts from signals of the run, such as joint angles and torques. A
log typically contains one value per millisecond, which is far too much for a page, so
`ChartBuilder` decimates the signals: it divides the time axis into intervals and keeps the
minimum and maximum of each interval. The result consists of tables of columns, and of charts
whose lines refer to these columns by index. The data types are defined in `page_data`.

Invariant:
    - Every spike in the log is visible on the page, because decimation keeps the minimum and
      maximum of each interval.
    - Every line of a chart has at least one value to draw. Charts without any lines are
      omitted, and their titles are listed in `_PageCharts.missing` so that the page can mention
      them.
    - Numbers are stored as base64-encoded little-endian int32 and float32, which takes a third
      of the space of decimal text.
"""

import base64
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..analysis import DelayDistribution, Timeline, build_arm_rows, site_signals
from ..core import Array
from ..log import Ints, Log, SiteLog
from ..scenario import Scenario
from . import plot_signals, style
from .appearance import DARK_SITE_COLOURS, list_site_colours
from .figures import age_and_lateness, arm_poses
from .page_data import Chart, DistributionChart, HistogramChart, PageData, TimeChart
from .page_leaders import SlaveLead
from .plot_signals import decimate

Values = NDArray[Any]
"""Numerical array of any type."""

BUCKET_BUDGET = 48_000
"""Total number of buckets of all columns. This limit keeps a page near 1 MB for any number of
sites.
"""
_MIN_BUCKETS = 100
"""Minimum number of buckets per column, whatever the budget."""
_MAX_BUCKETS = 1200
"""Maximum number of buckets per column."""
_BOX_INSTANTS = 60
"""Number of instants used to compute the bounding box of the arms' motion."""
_CHAIN_INSTANTS = 400
"""Maximum number of instants for which the page contains the joint positions of a chain."""
_MAXIMA = 400
"""Number of time intervals in a line of maxima."""
_LEAST_DRAWN = 1e-6
"""Smallest maximum that is drawn. Smaller maxima are drawn at this value, because a logarithmic
axis has no zero.
"""
PICTURE_SIDE = 4.0
"""Longer side of a scaled picture, in the unit of line widths on the page."""


class _PageCharts(NamedTuple):
    """All charts of a run's report page, as returned by `ChartBuilder.build`.

    Attributes:
        data: Data that the scripts of the page draw.
        missing: Mapping from page section to the titles of charts that are omitted because the
            log has no data for them.
    """

    data: PageData
    missing: dict[str, list[str]]


class ChartBuilder:
    """Computes the charts of a run's report page from its log.

    The signals are stored in tables, from which scripts draw the charts in the browser.

    Args:
        log: Log of the run.
        twin: Log of the same run without operators. If `None`, the chart of the motion caused
            by operators is omitted.

    Attributes:
        bounds_m: Left, right, bottom and top of the bounding box of the motion of all arms, in
            m.
        units_per_m: Scale of the pictures of the arms, in picture units per m. It is 1 if all
            arms are planar and the longer side of the bounding box is at least half of
            `PICTURE_SIDE`. Otherwise, the longer side is scaled to `PICTURE_SIDE`, because line
            widths are fixed.
        leads: Weights with which each slave follows the other arms over time.
    """

    def __init__(self, log: Log, twin: Log | None) -> None:
        self._log = log
        self._twin = twin
        self._timeline = Timeline(log)
        self._end_s = self._timeline.end_s
        self._tables: list[PageData.Table] = []
        self._has_values: list[list[bool]] = []  # by table and column
        self.leads = SlaveLead.list_of_log(log)

        # The pictures of the arms show the whole motion, which is sampled at a few times.
        times_s = np.linspace(0.0, self._end_s, _BOX_INSTANTS)
        poses = [arm_poses.find_pose(log, site, t_s) for site in log.sites for t_s in times_s]
        self.bounds_m = arm_poses.compute_pose_box_m(poses)
        self.units_per_m = 1.0
        arms = log.scenario.arms.values()
        left, right, bottom, top = self.bounds_m
        longer_side_m = max(right - left, top - bottom)
        has_chain = any(arm.chain is not None for arm in arms)
        if has_chain or longer_side_m < PICTURE_SIDE / 2.0:
            self.units_per_m = PICTURE_SIDE / longer_side_m

        self._joint_titles = []
        for title in style.name_joints(log):
            self._joint_titles.append(f"joint {title.removeprefix('joint ')}")

        # Tables are decimated so that the page stays below a total number of values.
        counts = max(arm.counts for arm in arms)
        # Each bucket of a table keeps the rows with the extremes of all its columns. Therefore
        # one table with many columns is larger than many tables with one column.
        self._has_table_per_column = counts.joints > 2
        # Nine signals have a column per joint. The ages of samples have a column per peer.
        columns_per_site = 9 * counts.joints + counts.parameters + len(log.sites)
        buckets = BUCKET_BUDGET // (columns_per_site * len(log.sites))
        self._buckets = max(_MIN_BUCKETS, min(_MAX_BUCKETS, buckets))

    def build(self) -> _PageCharts:
        """Computes all charts of the page: overview, motion of the arms, and timing.

        A chart without any curves is omitted, for example the chart of the estimates if the
        control laws estimate nothing. The page lists the titles of omitted charts by section.

        Returns:
            The page data, including the titles of omitted charts.
        """
        log = self._log
        charts: list[Chart] = []
        missing: dict[str, list[str]] = {}

        candidates = [
            *self._build_overview_charts(),
            *self._build_motion_charts(),
            *self._build_timing_charts(),
        ]
        for chart in candidates:
            if chart.series:
                charts.append(chart)
            else:
                missing.setdefault(chart.section, []).append(chart.title)

        arms = []
        spans = {}
        for index, site in enumerate(log.sites):
            if len(log[site]):
                arms.append(self._build_arm(index, site))
            intervals = self._timeline.find_mode_intervals(site)
            spans[site] = [PageData.ModeSpan(index, *interval) for interval in intervals]

        changes = []
        for number, applied in enumerate(self._timeline.changes, 1):
            change = applied.change
            changes.append(
                PageData.MarkedChange(number, change.at_s, applied.site, change.link)
            )

        light = list_site_colours(log.scenario)
        dark = list_site_colours(log.scenario, DARK_SITE_COLOURS)
        data = PageData(
            end_s=self._end_s,
            colours=PageData.Palettes(light, dark),
            arms=arms,
            leads=[lead.bar for lead in self.leads if not lead.is_constant],
            tables=self._tables,
            charts=charts,
            changes=changes,
            spans=spans,
            bounds_m=[self.units_per_m * bound for bound in self.bounds_m],
        )
        return _PageCharts(data, missing)

    def _build_overview_charts(self) -> Iterator[TimeChart]:
        """Yields the two charts at the top of the page: the error and the delay of each site.

        Each chart has one line per site: the largest error of any joint, or the age of the
        oldest sample used by the controller.
        """
        log = self._log
        unit = plot_signals.shared_unit(log)
        settled_line = self._draw_limit(site_signals.SETTLED_ERROR_RAD)
        stated_delays: list[TimeChart.StatedLine] = []
        for site in log.sites:
            stated_delays += self._list_stated_delays(site)
        has_one_delay = len({line.value for line in stated_delays}) == 1
        delay_lines = [self._draw_limit(stated_delays[0].value)] if has_one_delay else []

        yield self._make_chart(
            section="overview",
            title="Largest error |e| by site",
            note=f"Dashed: {settled_line.value:g} {unit}.{self._note_floor(unit)}",
            unit=unit,
            series=self._add_maxima(lambda site: np.abs(site_signals.joint_errors(log[site]))),
            lines=[settled_line],
            log=True,
        )
        yield self._make_chart(
            section="overview",
            title="Delay that each controller experienced",
            note="Dashed: the stated delay." if has_one_delay else "",
            unit="ms",
            series=self._add_maxima(lambda site: plot_signals.sample_ages_ms(log, site)),
            lines=delay_lines,
            zero=True,
            margin=0.05,
        )

    def _note_floor(self, unit: str) -> str:
        """Returns a note that small errors are drawn at the bottom of the logarithmic axis.

        A logarithmic axis cannot show an error of zero.

        Args:
            unit: Unit of the errors.

        Returns:
            The sentence, preceded by a space. Empty if no site has such small errors.
        """
        for site in self._log.sites:
            largest = site_signals.largest_magnitude(site_signals.joint_errors(self._log[site]))
            if (largest < _LEAST_DRAWN).any():
                return f" Errors below {_LEAST_DRAWN:g} {unit} are drawn at this value."
        return ""

    def _add_maxima(self, read_values: Callable[[str], Array]) -> list[TimeChart.Series]:
        """Adds one line per arm with the largest value of a signal in each short time interval.

        The line is constant within an interval. Plotting the values themselves would result in
        a broad band wherever they oscillate.

        Args:
            read_values: Function that takes the name of a site and returns its values, with one
                row per record.
        """
        series = []
        for site in self._log.sites:
            values = read_values(site)
            # NaN marks an unknown value, which must not hide the known values of the same
            # record.
            values_without_nan = np.where(np.isnan(values), -np.inf, values)
            largest = values_without_nan.max(axis=1, initial=-np.inf)

            # A new interval begins wherever the index of the interval changes.
            records = self._log[site]
            interval_numbers = np.floor(records.t_s * (_MAXIMA / self._end_s)).astype(np.int64)
            first_records = np.flatnonzero(np.diff(interval_numbers, prepend=-1))
            maxima = largest
            if len(first_records):
                record_counts = np.diff(np.append(first_records, len(interval_numbers)))
                maxima = np.repeat(np.maximum.reduceat(largest, first_records), record_counts)

            # The value axis is logarithmic. Therefore 0 is drawn at its lower bound.
            drawn_values = np.where(
                np.isfinite(maxima), np.maximum(maxima, _LEAST_DRAWN), np.nan
            )
            table = self._add_records(site, drawn_values[:, None])
            series.append(self._make_series(site, table, column=0))
        return series

    def _build_motion_charts(self) -> Iterator[TimeChart]:
        """Yields charts of the arms' torques, positions, errors, estimates and displacements.

        Charts of quantities that the run does not have, such as an operator torque, are
        omitted.
        """
        log = self._log
        operated_sites = plot_signals.sites_with_operator(log)
        if operated_sites:
            series = self._add_signal(site_signals.external_torques, operated_sites)
            title = "operator torque on the arm"
            yield from self._chart_joints("torques", title, "N m", series)
        yield from self._chart_positions()

        errors = self._add_signal(site_signals.joint_errors)
        axis_names = self._joint_titles
        if site_signals.follows_in_task_space(log):
            axis_names = style.name_shared(log)
        yield from self._chart_joints(
            section="errors",
            title="tracking error",
            unit=plot_signals.shared_unit(log),
            series_by_site=errors,
            titles=axis_names,
        )
        yield from self._chart_estimates()

        if self._twin is not None:
            series = {}
            for site in log.sites:
                tick, t_s, displacements = site_signals.operator_displacement(
                    log, self._twin, site
                )
                series[site] = self._add_columns(site, tick, t_s, displacements)
            yield from self._chart_joints("moved", "moved by the operators", "rad", series)

        torques = self._add_signal(site_signals.controller_torques)
        yield from self._chart_joints("control", "control torque", "N m", torques)

    def _build_timing_charts(self) -> Iterator[Chart]:
        """Yields charts of the network delays and of the timing of the control loops.

        Delay charts require a delay that varies, and loop charts require a run in real time.
        """
        log = self._log
        yield from self._chart_ages()
        if age_and_lateness.has_varying_delay(log):
            yield from self._chart_distributions()
        if not age_and_lateness.explain_missing_loop_times(log):
            lateness = self._add_signal(_lateness_ms)
            yield self._make_chart(
                section="timing",
                title="wake-up after the deadline",
                unit="ms",
                series=[columns[0] for columns in lateness.values()],
                zero=True,
            )
            yield from self._chart_histograms()

    def _add_table(self, site: str, tick: Ints, values: Values) -> int:
        """Adds a table of values to the report, from which its scripts draw curves.

        The values are encoded in binary form, which is more compact than decimal text.

        Args:
            site: Name of the site, whose tick rate converts ticks to times.
            tick: Ticks of the values, shape (P,).
            values: The values, one column per quantity, shape (P, C).

        Returns:
            The index of the table.
        """
        columns = [_encode(column, "<f4") for column in values.T]
        rate_hz = self._log.scenario.sites[site].rate_hz
        table = PageData.Table(rate_hz=rate_hz, tick=_encode(tick, "<i4"), columns=columns)
        self._tables.append(table)
        has_values = [bool(np.isfinite(column).any()) for column in values.T]
        self._has_values.append(has_values)
        return len(self._tables) - 1

    def _add_decimated(self, site: str, tick: Ints, t_s: Array, values: Values) -> int:
        """Decimates values to the extremes of each interval, and adds them as a table.

        Each interval keeps its minimum and maximum, so that no spike is lost.

        Args:
            site: Name of the site.
            tick: Ticks of the values, shape (K,).
            t_s: Times of the values, in s, shape (K,).
            values: The values, shape (K, C).

        Returns:
            The index of the table.
        """
        trace = decimate(tick, t_s, values, self._buckets)
        return self._add_table(site, trace.tick, trace.values)

    def _add_records(self, site: str, values: Values) -> int:
        """Adds as many recorded values of one arm as a page can show, as a table.

        A long run has more records than the page can show. In that case, the extremes of the
        values are kept.

        Args:
            site: Name of the site.
            values: One row of values per record, shape (K, C).

        Returns:
            The index of the table.
        """
        records = self._log[site]
        return self._add_decimated(site, records.tick, records.t_s, values)

    def _add_signal(
        self, signal: Callable[[SiteLog], Values], sites: Sequence[str] = ()
    ) -> dict[str, list[TimeChart.Series]]:
        """Adds the values of a signal, such as joint torques, to the report for several arms.

        Args:
            signal: Function that computes the values of the signal, shape (K, C), from the K
                records of a site.
            sites: Names of the sites. Empty for all sites.

        Returns:
            For each site, the lines of the chart, one per column of the signal.
        """
        series = {}
        for site in sites or self._log.sites:
            records = self._log[site]
            values = signal(records)
            series[site] = self._add_columns(site, records.tick, records.t_s, values)
        return series

    def _add_columns(
        self, site: str, tick: Ints, t_s: Array, values: Values
    ) -> list[TimeChart.Series]:
        """Adds as many values of one arm to the page as a screen can show.

        If there are only a few columns, they share one table. Otherwise each column has its own
        table, which is smaller in total, see `__init__`.

        Args:
            site: Name of the site.
            tick: Ticks of the values, shape (K,).
            t_s: Times of the values, in s, shape (K,).
            values: The values, shape (K, C).

        Returns:
            One line per column.
        """
        if self._has_table_per_column:
            tables = [
                self._add_decimated(site, tick, t_s, column[:, np.newaxis])
                for column in values.T
            ]
            return [self._make_series(site, table, column=0) for table in tables]
        table = self._add_decimated(site, tick, t_s, values)
        columns = range(values.shape[1])
        return [self._make_series(site, table, column) for column in columns]

    def _make_series(
        self, site: str, table: int, column: int, label: str = ""
    ) -> TimeChart.Series:
        """Returns a chart line in the colour of an arm.

        Args:
            site: Name of the site.
            table: Index of the table with the values of the line.
            column: Index of the column in this table.
            label: Label in the legend. Empty to use the name of the site.
        """
        colour = self._log.sites.index(site)
        return TimeChart.Series(label=label or site, colour=colour, table=table, column=column)

    def _make_chart(
        self,
        section: str,
        title: str,
        unit: str,
        series: Sequence[TimeChart.Series],
        sites: Sequence[str] = (),
        **options: Any,
    ) -> TimeChart:
        """Returns a chart over time, excluding lines that have no values to draw.

        Args:
            section: Key of the page section, as in `report.toml`.
            title: Title of the chart.
            unit: Unit of the values.
            series: The lines.
            sites: Names of the sites whose changes and modes are marked in the chart. Empty for
                all sites.
            **options: Further fields of `TimeChart`.
        """
        drawable = [line for line in series if self._has_values[line.table][line.column]]
        return TimeChart(
            section=section,
            title=title,
            unit=unit,
            series=drawable,
            sites=list(sites or self._log.sites),
            **options,
        )

    def _chart_joints(
        self,
        section: str,
        title: str,
        unit: str,
        series_by_site: dict[str, list[TimeChart.Series]],
        titles: Sequence[str] = (),
    ) -> Iterator[TimeChart]:
        """Yields one chart per joint, with one line per arm.

        Args:
            section: Key of the page section, as in `report.toml`.
            title: Name of the quantity.
            unit: Unit of the quantity.
            series_by_site: For each site, one line per joint. Sites may have different numbers
                of joints.
            titles: Names of the joints, or of the task-space axes. Empty to use the joint
                names.
        """
        for joint, name in enumerate(titles or self._joint_titles):
            series = [lines[joint] for lines in series_by_site.values() if joint < len(lines)]
            yield self._make_chart(section, f"{title}, {name}", unit, series)

    def _chart_positions(self) -> Iterator[TimeChart]:
        """Yields one chart per arm and joint, with the actual and the desired angle over time.

        The desired angle is computed from the received states of the other arms.
        """
        for site in self._log.sites:
            records = self._log[site]
            actual = site_signals.joint_angles(records)
            desired = plot_signals.reference_angles(records)

            for joint, name in enumerate(self._joint_titles[: actual.shape[1]]):
                angles = np.stack([actual[:, joint], desired[:, joint]], axis=1)
                table = self._add_records(site, angles)
                actual_line = self._make_series(site, table, column=0)
                desired_line = TimeChart.Series(
                    label="desired", colour="limit", table=table, column=1, dash=True
                )

                yield self._make_chart(
                    section="positions",
                    title=f"{site}, {name}",
                    unit="rad",
                    series=[actual_line, desired_line],
                    sites=[site],
                )

    def _chart_estimates(self) -> Iterator[TimeChart]:
        """Yields one chart per inertial parameter of the arms.

        Adaptive control laws estimate the inertial parameters of their arm while it moves. Each
        chart has one line per site, and dashed lines at the true values from the scenario.
        """
        log = self._log
        estimates = self._add_signal(site_signals.parameter_estimates)
        arms = log.scenario.arms
        largest_arm = max(arms.values(), key=lambda arm: arm.counts)
        true_parameters = [arms[site].theta for site in log.sites]
        for index, (name, unit) in enumerate(largest_arm.parameters):
            series = [lines[index] for lines in estimates.values() if index < len(lines)]
            # Arms with fewer joints have fewer parameters.
            true_values = [
                float(theta[index]) for theta in true_parameters if index < len(theta)
            ]
            title = name if largest_arm.chain else f"estimate of θ{'₁₂₃₄₅'[index]}"
            yield self._make_chart(
                section="estimates",
                title=title,
                unit=style.typeset_unit(unit),
                series=series,
                lines=self._draw_truths(true_values),
            )

    def _draw_truths(self, truths: Sequence[float]) -> list[TimeChart.StatedLine]:
        """Returns lines at the true values of a parameter over the whole run.

        The lines show how close the estimates of an adaptive control law come to the true
        values.

        Args:
            truths: The true value at each site.

        Returns:
            One line per site in its colour. If all values are equal, a single line in a neutral
            colour.
        """
        if len(set(truths)) == 1:
            return [self._draw_limit(truths[0])]
        lines = []
        for colour, truth in enumerate(truths):
            lines.append(
                TimeChart.StatedLine(value=truth, colour=colour, from_s=0.0, to_s=self._end_s)
            )
        return lines

    def _draw_limit(self, value: float) -> TimeChart.StatedLine:
        """Returns a line at a constant value over the whole run, in a neutral colour."""
        return TimeChart.StatedLine(value=value, colour="limit", from_s=0.0, to_s=self._end_s)

    def _chart_ages(self) -> Iterator[TimeChart]:
        """Yields one chart per site with the ages of the samples that its controller uses.

        The age of a sample is the time since it was sent, which is the delay experienced by the
        controller. Dashed lines show the delays specified in the scenario.
        """
        log = self._log
        for site in log.sites:
            ages_ms = plot_signals.sample_ages_ms(log, site)
            table = self._add_records(site, ages_ms)
            series = [
                self._make_series(peer, table, column, label=f"{peer} → {site}")
                for column, peer in enumerate(log[site].peers)
            ]

            lines = self._list_stated_delays(site)
            stated_ms = [line.value for line in lines]
            shown_ms = np.concatenate([ages_ms.ravel(), stated_ms])

            yield self._make_chart(
                section="ages",
                title=f"age of the samples that {site} uses",
                unit="ms",
                series=series,
                sites=[site],
                lines=lines,
                links=True,
                log=age_and_lateness.needs_log_axis(shown_ms),
                margin=0.025,
            )

    def _list_stated_delays(self, site: str) -> list[TimeChart.StatedLine]:
        """Returns lines at the mean delays that the scenario specifies for the links to a site.

        They are drawn next to the measured delays, to show whether the network had the
        specified delays.

        Args:
            site: Name of the receiving site.

        Returns:
            One line per peer and link model, from the start to the end of the model. If all
            delays are equal, a single line in a neutral colour.
        """
        log = self._log
        lines: list[TimeChart.StatedLine] = []
        for peer in log[site].peers:
            colour = log.sites.index(peer)
            link = f"{peer}->{site}"
            t_s, mean_ms = age_and_lateness.trace_stated_delay(self._timeline, link)
            # The trace has three points per model: its start, its end, and a gap.
            models = zip(t_s[::3], t_s[1::3], mean_ms[::3], strict=True)
            for start_s, end_s, delay_ms in models:
                if np.isfinite(delay_ms):
                    line = TimeChart.StatedLine(
                        value=float(delay_ms),
                        colour=colour,
                        from_s=float(start_s),
                        to_s=float(end_s),
                    )
                    lines.append(line)

        delays_ms = {line.value for line in lines}
        if len(delays_ms) == 1:
            return [self._draw_limit(lines[0].value)]
        return lines

    def _chart_distributions(self) -> Iterator[DistributionChart]:
        """Yields one chart per receiving site with the distributions of sample ages and delays.

        A curve at x shows the percentage of ages, or of delays, that are at most x ms. The age
        of a sample is its delay plus the time until a newer sample replaces it.
        """
        distributions = DelayDistribution.list_of_log(self._log)
        axis = age_and_lateness.DelayAxis.of_links(distributions)
        for site in self._log.sites:
            series = []
            for link in distributions:
                if link.site != site:
                    continue
                colour = self._log.sites.index(link.peer)
                curves = (("age", link.age_ms, False), ("delay", link.delay_ms, True))
                for quantity, values_ms, dash in curves:
                    # A link without any message has no curve.
                    percent = axis.compute_percent(values_ms)
                    if not np.isfinite(percent).any():
                        continue

                    curve = DistributionChart.Series(
                        label=f"{quantity}, {link.peer}",
                        colour=colour,
                        dash=dash,
                        values=_encode(percent, "<f4"),
                    )
                    series.append(curve)

            yield DistributionChart(
                section="delays",
                title=f"delay and age on the way to {site}",
                unit="ms",
                series=series,
                x=_encode(axis.x_ms, "<f4"),
                log=axis.is_logarithmic,
            )

    def _chart_histograms(self) -> Iterator[HistogramChart]:
        """Yields histograms that show whether the control loops kept their timing.

        One histogram shows how late the loops woke up for their ticks, the other how long the
        computation of a tick took.
        """
        log = self._log
        bins = age_and_lateness.LoopTimeBins.of_log(log)
        rates_hz = {log.scenario.sites[site].rate_hz for site in log.sites}
        periods_us = sorted(1e6 / rate_hz for rate_hz in rates_hz)

        titles = {
            "late_us": "wake-up after the deadline",
            "busy_us": "computing time of a tick",
        }
        for field, title in titles.items():
            series = []
            for colour, site in enumerate(log.sites):
                if len(log[site]):
                    times_us = getattr(log[site], field)
                    counts = bins.count_times(times_us)
                    series.append(HistogramChart.Series(site, colour, counts.tolist()))

            yield HistogramChart(
                section="timing",
                title=f"{title}, histogram",
                unit="µs",
                series=series,
                edges=bins.edges_us.tolist(),
                periods=periods_us,
            )

    def _build_arm(self, index: int, site: str) -> PageData.PlanarArm | PageData.ChainArm:
        """Adds the motion of an arm, and of bodies that it touches, for the animated picture.

        The script of the page draws planar arms from their joint angles and link lengths. All
        other arms are chains and handled by `_build_chain`.

        Args:
            index: Index of the site, which is also its colour index.
            site: Name of the site, which must have at least one record.

        Returns:
            Description of the arm, which refers to the table of its motion.
        """
        arm = self._log.scenario.arms[site]
        if arm.chain is not None:
            return self._build_chain(index, site)

        # The table has the joint angles, the desired angles and the corners of the bodies.
        records = self._log[site]
        actual = site_signals.joint_angles(records)
        desired = plot_signals.reference_angles(records)
        bodies = self._trace_bodies(site, np.arange(len(records)))
        table = self._add_records(site, np.hstack([actual, desired, *bodies]))
        return PageData.PlanarArm(
            site=site,
            caption=_caption_site(self._log.scenario, site),
            colour=index,
            table=table,
            bodies=len(bodies),
            links_m=[self.units_per_m * length_m for length_m in arm.lengths_m],
        )

    def _build_chain(self, index: int, site: str) -> PageData.ChainArm:
        """Adds the motion of a chain, an arm with any number of joints in space.

        The page cannot compute the forward kinematics of chains. The table therefore contains
        projected joint positions of the actual arm, of the reference and of the arm's shadow on
        the floor, for up to `_CHAIN_INSTANTS` records.

        Args:
            index: Index of the site, which is also its colour index.
            site: Name of the site, which must have at least one record.

        Returns:
            Description of the chain, which refers to the table of its motion.
        """
        records = self._log[site]
        arm = build_arm_rows(self._log.scenario, site)
        last_record = len(records) - 1
        record_indices = np.linspace(0, last_record, _CHAIN_INSTANTS).astype(np.int64)
        rows = np.unique(record_indices)  # a short log has fewer records than `_CHAIN_INSTANTS`

        desired_q = plot_signals.reference_angles(records)
        axes = arm.upright_axes
        actual_m = arm.joint_positions_m(records.q[rows])
        desired_m = arm.joint_positions_m(desired_q[rows])
        pictures = (
            arm_poses.project_arm_m(axes, actual_m),
            arm_poses.project_arm_m(axes, desired_m),
            arm_poses.project_arm_m(axes, actual_m, onto_floor=True),
        )
        # The first point is the base, which does not move.
        moving_points_m = [picture[:, 1:] for picture in pictures]
        points = np.stack(moving_points_m, axis=1) * self.units_per_m
        bodies = self._trace_bodies(site, rows)
        values = np.hstack([points.reshape(len(rows), -1), *bodies])
        table = self._add_table(site, records.tick[rows], values)
        return PageData.ChainArm(
            site=site,
            caption=_caption_site(self._log.scenario, site),
            colour=index,
            table=table,
            bodies=len(bodies),
            points=points.shape[2],
        )

    def _trace_bodies(self, site: str, rows: NDArray[np.int64]) -> list[NDArray[np.float64]]:
        """Returns the edges of each body that a site's arm can touch, as lines in the picture.

        The page draws them together with the arm, for example a box pushed by the arm.

        Args:
            site: Name of the site.
            rows: Indices of K records.

        Returns:
            For each body, the coordinates of the P corners along its edge path, in picture
            units, shape (K, 2 P). Empty if the site has no bodies.
        """
        sizes_m = self._log.scenario.bodies_m(site).values()
        if not sizes_m:
            return []
        arm = build_arm_rows(self._log.scenario, site)
        poses = self._log[site].bodies[rows]
        paths_m = arm_poses.trace_bodies_m(arm.upright_axes, sizes_m, poses)
        return [self.units_per_m * path.reshape(len(rows), -1) for path in paths_m]


def _lateness_ms(records: SiteLog) -> Values:
    """Returns the lateness of each tick in ms, shape (K, 1)."""
    return records.late_us[:, np.newaxis] * 1e-3


def _encode(column: Values, kind: str) -> str:
    """Encodes numbers as a base64 string, for compact storage in a web page.

    Args:
        column: The numbers, shape (P,).
        kind: NumPy type of each number, such as "<f4" for little-endian float32.
    """
    numbers = np.ascontiguousarray(column.astype(kind))
    return base64.b64encode(numbers.tobytes()).decode()


def _caption_site(scenario: Scenario, site: str) -> str:
    """Returns the caption of an arm in the drawing, for example "m1, master 1"."""
    return f"{site}, {_name_role(scenario, site)}"


def _name_role(scenario: Scenario, site: str) -> str:
    """Returns the role of an arm in words: "master 2", or "slave" if there is only one slave.

    Args:
        scenario: Scenario of the run.
        site: Name of the site.
    """
    role = scenario.sites[site].role
    with_role = [name for name, spec in scenario.sites.items() if spec.role == role]
    return role if len(with_role) == 1 else f"{role} {with_role.index(site) + 1}"
