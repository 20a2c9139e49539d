"""Data of the page's interactive charts: tables of decimated columns, and charts that refer to them.

Invariant: every spike of the log is on the page. Numbers are base64 of little-endian int32 and float32, a
third of their length as text.
"""

import base64
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..analysis import site_signals
from ..analysis.json_values import JsonObject
from ..analysis.timeline import find_mode_intervals, list_changes, list_stated_models, recorded_end_s
from ..analysis.trace_decimation import decimate
from ..core.two_link_arm import JOINTS, PARAMETERS
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from . import style
from .figures import arm_poses, loop_timing, sample_age
from .figures.joint_motion import THETA_UNITS

BUCKET_BUDGET = 48_000
"""Buckets of all columns together: what keeps a page near a megabyte, however many sites there are."""
LIMIT_COLOUR = "limit"
"""Colour of references, true values and limits."""


class Charts:
    """The charts of a log; `twin` is the same experiment without operators, or None."""

    def __init__(self, log: Log, twin: Log | None) -> None:
        self._log = log
        self._twin = twin
        self._changes = list_changes(log)
        self._tables: list[JsonObject] = []
        columns_per_site = 9 * JOINTS + PARAMETERS + len(log.sites)
        self._buckets = max(100, min(1200, BUCKET_BUDGET // (columns_per_site * len(log.sites))))

    def data(self) -> JsonObject:
        """Returns tables and charts, ready for JSON."""
        charts = [*self._motion(), *self._timing()]
        return {
            "end_s": recorded_end_s(self._log),
            "colours": {"light": list(style.SITE_COLOURS), "dark": list(style.DARK_SITE_COLOURS)},
            "tables": self._tables,
            "charts": charts,
            "changes": [
                {"n": n, "t": c.change.at_s, "site": c.site, "link": c.change.link}
                for n, c in enumerate(self._changes, 1)
            ],
            "spans": {
                site: [(index, *span) for span in find_mode_intervals(self._log[site])]
                for index, site in enumerate(self._log.sites)
            },
            "arms": [self._arm(index, site) for index, site in enumerate(self._log.sites)],
        }

    def _table(self, site: str, tick: Ints, t_s: Array, values: NDArray[Any]) -> int:
        """Stores the columns of a site, decimated together, and returns the number of the table."""
        trace = decimate(tick, t_s, values, self._buckets)
        self._tables.append(
            {
                "rate_hz": self._log.scenario.sites[site].rate_hz,
                "tick": _packed(trace.tick.astype("<i4")),
                "columns": [_packed(column.astype("<f4")) for column in trace.values.T],
            }
        )
        return len(self._tables) - 1

    def _site_table(self, site: str, values: NDArray[Any]) -> int:
        return self._table(site, self._log[site].tick, self._log[site].t_s, values)

    def _series(self, site: str, table: int, column: int, label: str = "") -> JsonObject:
        colour = self._log.sites.index(site)
        return {"label": label or site, "colour": colour, "table": table, "column": column}

    def _motion(self) -> Iterator[JsonObject]:
        log = self._log
        operated = site_signals.sites_with_operator(log)
        if operated:
            tables = self._tables_of(site_signals.external_torques, operated)
            yield from self._per_joint("torques", "operator torque on the arm", "N m", tables)
        yield from self._positions()
        tables = self._tables_of(site_signals.joint_errors)
        yield from self._per_joint("errors", "tracking error", "rad", tables)
        yield from self._estimates()
        if self._twin is not None:
            moved = {s: site_signals.operator_displacement(log, self._twin, s) for s in log.sites}
            tables = {s: self._table(s, *columns) for s, columns in moved.items()}
            yield from self._per_joint("moved", "moved by the operators", "rad", tables)
        tables = self._tables_of(site_signals.controller_torques)
        yield from self._per_joint("control", "control torque", "N m", tables)

    def _tables_of(
        self, signal: Callable[[SiteLog], NDArray[Any]], sites: list[str] | None = None
    ) -> dict[str, int]:
        return {s: self._site_table(s, signal(self._log[s])) for s in sites or self._log.sites}

    def _per_joint(self, section: str, title: str, unit: str, tables: dict[str, int]) -> Iterator[JsonObject]:
        for joint in range(JOINTS):
            series = [self._series(site, table, joint) for site, table in tables.items()]
            yield _chart(section, f"{title}, joint {joint + 1}", unit, series)

    def _positions(self) -> Iterator[JsonObject]:
        for site in self._log.sites:
            part = self._log[site]
            both = np.stack([site_signals.joint_angles(part), site_signals.reference_angles(part)], axis=2)
            for joint in range(JOINTS):
                table = self._site_table(site, both[:, joint])
                desired = {**self._series(site, table, 1, "desired"), "colour": LIMIT_COLOUR, "dash": True}
                series = [self._series(site, table, 0), desired]
                yield _chart("positions", f"{site}, joint {joint + 1}", "rad", series, sites=[site])

    def _estimates(self) -> Iterator[JsonObject]:
        log = self._log
        tables = self._tables_of(site_signals.parameter_estimates)
        for index in range(PARAMETERS):
            series = [self._series(site, table, index) for site, table in tables.items()]
            truths = [float(site_signals.true_parameters(log, site)[index]) for site in log.sites]
            lines: list[JsonObject] = [{"value": truth, "colour": n} for n, truth in enumerate(truths)]
            if len(set(truths)) == 1:
                lines = [{"value": truths[0], "colour": LIMIT_COLOUR}]
            title = f"estimate of θ{'₁₂₃₄₅'[index]}"
            yield _chart("estimates", title, THETA_UNITS[index], series, lines=lines)

    def _timing(self) -> Iterator[JsonObject]:
        log = self._log
        yield from self._ages()
        if sample_age.has_varying_delay(log):
            yield from self._distributions()
        if not loop_timing.explain_missing_loop_times(log):
            tables = self._tables_of(lambda part: part.late_us[:, np.newaxis] * 1e-3)
            series = [self._series(site, table, 0) for site, table in tables.items()]
            yield _chart("timing", "wake-up after the deadline", "ms", series, zero=True)
            yield from self._histograms()

    def _ages(self) -> Iterator[JsonObject]:
        log = self._log
        for site in log.sites:
            age_ms, peers = site_signals.sample_ages_ms(log, site), log[site].peers
            table = self._site_table(site, age_ms)
            series = [self._series(peer, table, n, f"{peer} → {site}") for n, peer in enumerate(peers)]
            lines = self._stated(site)
            drawn = np.concatenate([age_ms.ravel(), [line["value"] for line in lines]])
            axis = {"margin": 0.025, "log": sample_age.needs_log_axis(drawn)}
            title = f"age of the samples that {site} uses"
            yield _chart("ages", title, "ms", series, lines=lines, sites=[site], links=True, **axis)

    def _stated(self, site: str) -> list[JsonObject]:
        """Returns the stated mean delays of the links to a site, as lines while they held."""
        log = self._log
        lines: list[JsonObject] = []
        for peer in log[site].peers:
            states = list_stated_models(log, f"{peer}->{site}", self._changes)
            t_s, mean_ms = sample_age.stated_delay_line(log, states)
            for start, end, value in zip(t_s[::3], t_s[1::3], mean_ms[::3], strict=True):
                if np.isfinite(value):
                    line = {"value": value, "colour": log.sites.index(peer), "from": start, "to": end}
                    lines.append(line)
        same = len({line["value"] for line in lines}) == 1
        return [{"value": lines[0]["value"], "colour": LIMIT_COLOUR}] if same else lines

    def _distributions(self) -> Iterator[JsonObject]:
        found = sample_age.measure_delay_distributions(self._log)
        x_ms = sample_age.delay_axis_ms(found)
        for site in self._log.sites:
            series = []
            for link in (link for link in found if link.site == site):
                for name, values, dash in (("age", link.age_ms, False), ("delay", link.delay_ms, True)):
                    percent = _packed(sample_age.cumulative_percent(values, x_ms).astype("<f4"))
                    entry = {"label": f"{name}, {link.peer}", "values": percent, "dash": dash}
                    series.append({**entry, "colour": self._log.sites.index(link.peer)})
            title = f"delay and age on the way to {site}"
            yield _chart("delays", title, "ms", series, points=len(x_ms), end=float(x_ms[-1]))

    def _histograms(self) -> Iterator[JsonObject]:
        log = self._log
        edges = loop_timing.loop_time_bin_edges(log)
        periods = sorted({1e6 / log.scenario.sites[site].rate_hz for site in log.sites})
        titles = {"late_us": "wake-up after the deadline", "busy_us": "computing time of a tick"}
        for field, title in titles.items():
            series: list[JsonObject] = []
            for n, site in enumerate(log.sites):
                counts = loop_timing.bin_loop_times(getattr(log[site], field), edges).tolist()
                series.append({"label": site, "colour": n, "counts": counts})
            axis = {"edges": edges.tolist(), "periods": periods}
            yield _chart("timing", f"{title}, histogram", "µs", series, **axis)

    def _arm(self, index: int, site: str) -> JsonObject:
        part, arm = self._log[site], self._log.scenario.sites[site].arm
        values = np.hstack([site_signals.joint_angles(part), site_signals.reference_angles(part)])
        table = self._site_table(site, values)
        return {"site": site, "colour": index, "links_m": [arm.l1_m, arm.l2_m], "table": table}


def _chart(section: str, title: str, unit: str, series: list[JsonObject], **options: Any) -> JsonObject:
    return {"section": section, "title": title, "unit": unit, "series": series, **options}


def workspace_box_m(log: Log) -> tuple[float, float, float, float]:
    """Returns left, right, bottom and top of a box around the motion of all arms, m."""
    times = np.linspace(0.0, recorded_end_s(log), 60)
    return arm_poses.pose_box_m([arm_poses.pose_at(log, site, t) for site in log.sites for t in times])


def _packed(column: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(column).tobytes()).decode()
