"""Data of the page's interactive charts: tables of decimated columns, and charts that refer to them.

Invariant: every spike of the log is on the page. Numbers are base64 of little-endian int32 and float32, a
third of their length as text.
"""

import base64
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..analysis import site_signals
from ..analysis.arm_rows import joint_positions_m
from ..analysis.site_signals import decimate
from ..analysis.timeline import find_mode_intervals, list_changes, list_stated_models, recorded_end_s
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from ..results import JsonObject
from . import style
from .appearance import DARK_SITE_COLOURS, list_site_colours
from .figures import age_and_lateness, arm_poses

BUCKET_BUDGET = 48_000
"""Buckets of all columns together: what keeps a page near a megabyte, however many sites there are."""
_FRAMES = 400
"""Instants at which the page knows where the joints of a chain are."""
PICTURE_SIDE = 4.0
"""Width of a picture of a chain, in the units in which the page's lines have their widths."""
LIMIT_COLOUR = "limit"
"""Colour of references, true values and limits."""


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
        poses = [arm_poses.pose_at(log, site, t) for site in log.sites for t in times]
        self.bounds_m = left, right, bottom, top = arm_poses.pose_box_m(poses)
        planar = all(arm.chain is None for arm in log.scenario.arms.values())
        self.factor = 1.0 if planar else PICTURE_SIDE / max(right - left, top - bottom)
        self._changes = list_changes(log)
        self._tables: list[JsonObject] = []
        self._titles = [f"joint {title.removeprefix('joint ')}" for title in style.name_joints(log)]
        counts = max(arm.counts for arm in log.scenario.arms.values())
        self._small = counts.joints > 2
        columns_per_site = 9 * counts.joints + counts.parameters + len(log.sites)
        self._buckets = max(100, min(1200, BUCKET_BUDGET // (columns_per_site * len(log.sites))))

    def data(self) -> JsonObject:
        """Returns tables and charts, ready for JSON."""
        charts = [*self._motion(), *self._timing()]
        return {
            "end_s": recorded_end_s(self._log),
            "colours": {
                "light": list_site_colours(self._log.scenario),
                "dark": list_site_colours(self._log.scenario, DARK_SITE_COLOURS),
            },
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
            "bounds_m": [self.factor * bound for bound in self.bounds_m],
        }

    def _table(self, site: str, tick: Ints, t_s: Array, values: NDArray[Any]) -> int:
        trace = decimate(tick, t_s, values, self._buckets)
        return self._store(site, trace.tick, trace.values)

    def _store(self, site: str, tick: Ints, values: NDArray[Any]) -> int:
        table = {
            "rate_hz": self._log.scenario.sites[site].rate_hz,
            "tick": _packed(tick, "<i4"),
            "columns": [_packed(column, "<f4") for column in values.T],
        }
        self._tables.append(table)
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
        tables, unit = self._tables_of(site_signals.joint_errors), site_signals.shared_unit(log)
        axes = style.name_shared(log) if site_signals.follows_in_task_space(log) else self._titles
        yield from self._per_joint("errors", "tracking error", unit, tables, axes)
        yield from self._estimates()
        if self._twin is not None:
            moved = {s: site_signals.operator_displacement(log, self._twin, s) for s in log.sites}
            tables = {s: self._columns(s, *columns) for s, columns in moved.items()}
            yield from self._per_joint("moved", "moved by the operators", "rad", tables)
        tables = self._tables_of(site_signals.controller_torques)
        yield from self._per_joint("control", "control torque", "N m", tables)

    def _tables_of(
        self, signal: Callable[[SiteLog], NDArray[Any]], sites: list[str] | None = None
    ) -> dict[str, list[JsonObject]]:
        parts = {site: self._log[site] for site in sites or self._log.sites}
        return {s: self._columns(s, part.tick, part.t_s, signal(part)) for s, part in parts.items()}

    def _columns(self, site: str, tick: Ints, t_s: Array, values: NDArray[Any]) -> list[JsonObject]:
        count = values.shape[1]
        if not self._small:
            table = self._table(site, tick, t_s, values)
            return [self._series(site, table, column) for column in range(count)]
        return [self._series(site, self._table(site, tick, t_s, one[:, np.newaxis]), 0) for one in values.T]

    def _per_joint(
        self,
        section: str,
        title: str,
        unit: str,
        tables: dict[str, list[JsonObject]],
        titles: Sequence[str] = (),
    ) -> Iterator[JsonObject]:
        for joint, name in enumerate(titles or self._titles):
            series = [columns[joint] for columns in tables.values() if joint < len(columns)]
            yield _chart(section, f"{title}, {name}", unit, series)

    def _positions(self) -> Iterator[JsonObject]:
        for site in self._log.sites:
            part = self._log[site]
            both = np.stack([site_signals.joint_angles(part), site_signals.reference_angles(part)], axis=2)
            for joint, name in enumerate(self._titles[: both.shape[1]]):
                table = self._site_table(site, both[:, joint])
                desired = {**self._series(site, table, 1, "desired"), "colour": LIMIT_COLOUR, "dash": True}
                series = [self._series(site, table, 0), desired]
                yield _chart("positions", f"{site}, {name}", "rad", series, sites=[site])

    def _estimates(self) -> Iterator[JsonObject]:
        log = self._log
        tables = self._tables_of(site_signals.parameter_estimates)
        arm = max(log.scenario.arms.values(), key=lambda each: each.counts)
        for index, (name, unit) in enumerate(arm.parameters):
            series = [columns[index] for columns in tables.values() if index < len(columns)]
            every = [log.scenario.arms[site].theta for site in log.sites]
            truths = [float(theta[index]) for theta in every if index < len(theta)]
            lines: list[JsonObject] = [{"value": truth, "colour": n} for n, truth in enumerate(truths)]
            if len(set(truths)) == 1:
                lines = [{"value": truths[0], "colour": LIMIT_COLOUR}]
            title = name if arm.chain else f"estimate of θ{'₁₂₃₄₅'[index]}"
            yield _chart("estimates", title, style.typeset_unit(unit), series, lines=lines)

    def _timing(self) -> Iterator[JsonObject]:
        log = self._log
        yield from self._ages()
        if age_and_lateness.has_varying_delay(log):
            yield from self._distributions()
        if not age_and_lateness.explain_missing_loop_times(log):
            tables = self._tables_of(lambda part: part.late_us[:, np.newaxis] * 1e-3)
            series = [columns[0] for columns in tables.values()]
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
            axis = {"margin": 0.025, "log": age_and_lateness.needs_log_axis(drawn)}
            title = f"age of the samples that {site} uses"
            yield _chart("ages", title, "ms", series, lines=lines, sites=[site], links=True, **axis)

    def _stated(self, site: str) -> list[JsonObject]:
        log = self._log
        lines: list[JsonObject] = []
        for peer in log[site].peers:
            states = list_stated_models(log, f"{peer}->{site}", self._changes)
            t_s, mean_ms = age_and_lateness.stated_delay_line(log, states)
            for start, end, value in zip(t_s[::3], t_s[1::3], mean_ms[::3], strict=True):
                if np.isfinite(value):
                    line = {"value": value, "colour": log.sites.index(peer), "from": start, "to": end}
                    lines.append(line)
        same = len({line["value"] for line in lines}) == 1
        return [{"value": lines[0]["value"], "colour": LIMIT_COLOUR}] if same else lines

    def _distributions(self) -> Iterator[JsonObject]:
        found = age_and_lateness.measure_delay_distributions(self._log)
        x_ms = age_and_lateness.delay_axis_ms(found)
        for site in self._log.sites:
            series = []
            for link in (link for link in found if link.site == site):
                for name, values, dash in (("age", link.age_ms, False), ("delay", link.delay_ms, True)):
                    percent = _packed(age_and_lateness.cumulative_percent(values, x_ms), "<f4")
                    entry = {"label": f"{name}, {link.peer}", "values": percent, "dash": dash}
                    series.append({**entry, "colour": self._log.sites.index(link.peer)})
            title = f"delay and age on the way to {site}"
            yield _chart("delays", title, "ms", series, x=_packed(x_ms, "<f4"), log=bool(x_ms[0] > 0.0))

    def _histograms(self) -> Iterator[JsonObject]:
        log = self._log
        edges = age_and_lateness.loop_time_bin_edges(log)
        periods = sorted({1e6 / log.scenario.sites[site].rate_hz for site in log.sites})
        titles = {"late_us": "wake-up after the deadline", "busy_us": "computing time of a tick"}
        for field, title in titles.items():
            series: list[JsonObject] = []
            for n, site in enumerate(log.sites):
                counts = age_and_lateness.bin_loop_times(getattr(log[site], field), edges).tolist()
                series.append({"label": site, "colour": n, "counts": counts})
            axis = {"edges": edges.tolist(), "periods": periods}
            yield _chart("timing", f"{title}, histogram", "µs", series, **axis)

    def _arm(self, index: int, site: str) -> JsonObject:
        part, arm = self._log[site], self._log.scenario.arms[site]
        if arm.chain is not None:
            return {"site": site, "colour": index, **self._projected(site)}
        values = np.hstack([site_signals.joint_angles(part), site_signals.reference_angles(part)])
        edges = self._edges(site, np.arange(len(part)))
        table = self._site_table(site, np.hstack([values, *edges]))
        links = {"links_m": list(arm.lengths_m), "bodies": len(edges)}
        return {"site": site, "colour": index, **links, "table": table}

    def _edges(self, site: str, rows: NDArray[np.int64]) -> list[NDArray[np.float64]]:
        """Returns the edges of the bodies of a site's plant in some records, shape (K, 2 P) each."""
        sizes_m, arm = self._log.scenario.bodies_m(site).values(), self._log.scenario.arms[site]
        if not sizes_m:
            return []
        traced = arm_poses.trace_bodies_m(arm, sizes_m, self._log[site].bodies[rows])
        return [self.factor * path.reshape(len(rows), -1) for path in traced]

    def _projected(self, site: str) -> JsonObject:
        part, arm = self._log[site], self._log.scenario.arms[site]
        rows = np.unique(np.linspace(0, max(len(part) - 1, 0), _FRAMES).astype(np.int64))[: len(part)]
        actual, desired = (
            joint_positions_m(arm, q[rows]) for q in (part.q, site_signals.reference_angles(part))
        )
        pictures = (
            arm_poses.project_arm_m(arm, actual),
            arm_poses.project_arm_m(arm, desired),
            arm_poses.project_arm_m(arm, actual, onto_floor=True),
        )
        points = np.stack([picture[:, 1:] for picture in pictures], axis=1) * self.factor
        edges = self._edges(site, rows)
        table = self._store(site, part.tick[rows], np.hstack([points.reshape(len(rows), -1), *edges]))
        return {"points": points.shape[2], "bodies": len(edges), "table": table}


def _chart(section: str, title: str, unit: str, series: list[JsonObject], **options: Any) -> JsonObject:
    return {"section": section, "title": title, "unit": unit, "series": series, **options}


def _packed(column: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(column.astype(kind)).tobytes()).decode()
