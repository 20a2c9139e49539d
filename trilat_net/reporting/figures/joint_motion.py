"""Figures of joint signals: torques, angles, errors, settling, phase portrait and parameter estimates.

Invariant: torques of operators are those ON the arm, the negative of the record's tau_x. Settling times are
those of `analysis.site_signals`.
"""

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis.site_signals import (
    SETTLED_ERROR_RAD,
    controller_torques,
    external_torques,
    joint_angles,
    joint_error_rates,
    joint_errors,
    largest_remaining_error,
    operator_displacement,
    parameter_estimates,
    reference_angles,
    settling_time_s,
    sites_with_operator,
    true_parameters,
)
from ...core.two_link_arm import JOINTS, PARAMETERS
from ...core.vectors import Array
from ...execution.virtual_comparison import simulate_without_operators
from ...log.log_reader import Log
from .. import style
from ..figure_size import REPORT_SIZE, FigureSize
from .time_figure import SiteSignal, TimeFigure, site_records, time_figure

THETA_UNITS = ("kg m²", "kg m²", "kg m²", "kg m", "kg m")
"""Of the five parameters of Eq. (24)."""

_LEAST_RAD = 1e-3 * SETTLED_ERROR_RAD
"""Lower end of the axis of errors, rad."""
_LOOP_PT = 0.8
"""Width of a line that crosses itself."""
_STEP = 0.01
"""Of its extent, between two points of a path."""


def draw_operator_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques of the operators ON the arms over time, N m; Fig. 3 of the paper."""
    signal = site_records(log, external_torques)
    return _draw_joints(log, form, sites_with_operator(log), signal, "torque on the arm (N m)")


def draw_operator_displacement(
    log: Log, form: FigureSize = REPORT_SIZE, *, twin: Log | None = None
) -> Figure:
    """Returns how far the operators moved every site over time, rad: the log minus a run without operators.

    That run, `twin`, is simulated if it is not given.
    """
    other = simulate_without_operators(log) if twin is None else twin
    signal = partial(operator_displacement, log, other)
    return _draw_joints(log, form, log.sites, signal, "moved by operators (rad)")


def draw_control_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns tau of Eq. (13) of every site over time, N m, with the limit where a site reached it."""
    largest = {site: np.abs(controller_torques(log[site])).max(initial=0.0) for site in log.sites}
    limits = {site: float(np.max(log.scenario.sites[site].limits.tau_limit_nm)) for site in log.sites}
    reached = sorted({limit for site, limit in limits.items() if largest[site] >= limit})
    signal = site_records(log, controller_torques)
    return _draw_joints(log, form, log.sites, signal, "control torque (N m)", reached)


def _draw_joints(
    log: Log,
    form: FigureSize,
    sites: Sequence[str],
    signal: SiteSignal,
    label: str,
    limits: Sequence[float] = (),
) -> Figure:
    """Returns a signal over time: a panel per joint, a line per site, dashed ones at its limits."""
    with time_figure(log, form, 2.2) as plot:
        row = style.add_panels(plot.figure, 1, JOINTS, sharex=True, sharey=True)[0]
        style.title_joints(row)
        plot.joint_row(row, sites, signal, label)
        for axes, limit in product(row, (sign * limit for limit in limits for sign in (1, -1))):
            axes.axhline(limit, **style.LIMIT_LINE)
        entries = [("limit", style.LIMIT_LINE)] if limits else []
        plot.finish(row, [*style.site_legend_entries(log, sites), *entries])
    return plot.figure


def draw_operation(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques ON the arms, N m, above the angles of all arms, rad: a column per joint."""
    with time_figure(log, form, 2.9 if form.narrow else 3.4) as plot:
        grid = style.add_panels(plot.figure, 2, JOINTS, sharex=True)
        grid[0, 1].sharey(grid[0, 0])
        grid[0, 1].tick_params(labelleft=False)
        style.title_joints(grid[0])
        torque, angle = "torque (N m)", "angle (rad)"
        if not form.narrow:
            torque, angle = "torque on the arm (N m)", "joint angle (rad)"
        plot.joint_row(grid[0], sites_with_operator(log), site_records(log, external_torques), torque)
        plot.joint_row(grid[1], log.sites, site_records(log, joint_angles), angle)
        plot.finish(grid[1], style.site_legend_entries(log, log.sites))
    return plot.figure


def draw_positions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns desired and actual joint angles of every site over time, rad; Fig. 4 of the paper."""
    label = "{}: q (rad)" if form.narrow else "angle of {} (rad)"
    entries = [(f"{style.site_title(log, s)}, actual", style.site_line(log, s, 1.6)) for s in log.sites]
    with time_figure(log, form, 0.7 + (0.95 if form.narrow else 1.25) * len(log.sites)) as plot:
        grid = style.add_panels(plot.figure, len(log.sites), JOINTS, sharex=True, sharey="col")
        for site, row in zip(log.sites, grid, strict=True):
            actual, desired = joint_angles(log[site]), reference_angles(log[site])
            for joint, axes in enumerate(row):
                plot.trace(axes, site, actual[:, joint], 1.6)
                plot.trace(axes, site, desired[:, joint], **style.LIMIT_LINE)
                plot.mark(axes, [site])
                if not len(log[site]):
                    style.annotate_empty_panel(axes, f"no records of {site}")
            row[0].set_ylabel(label.format(site))
        style.title_joints(grid[0])
        plot.finish(grid[-1], [*entries, ("desired", style.LIMIT_LINE)])
    return plot.figure


def draw_tracking_errors(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns e = q - q_des of every site over time, rad, Fig. 5 of the paper, and how it settles.

    The lowest panel shows, at every time, the largest error of any joint that is still to come: where it
    crosses the dashed line, the site has settled.
    """
    with time_figure(log, form, 3.6) as plot:
        panels = plot.figure.subplot_mosaic([["1", "2"], ["all", "all"]])
        row, settling = [panels["1"], panels["2"]], panels["all"]
        row[1].sharey(row[0])
        row[1].tick_params(labelleft=False)
        style.title_joints(row)
        plot.joint_row(row, log.sites, site_records(log, joint_errors), "tracking error (rad)")
        low = high = SETTLED_ERROR_RAD
        for site in log.sites:
            remaining = largest_remaining_error(log[site])
            positive = np.where(remaining > 0.0, remaining, np.nan)
            plot.trace(settling, site, positive)
            low, high = np.nanmin(positive, initial=low), np.nanmax(positive, initial=high)
        settling.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        settling.set(yscale="log", ylim=(0.5 * low, 2.0 * high), ylabel="largest error\nstill to come (rad)")
        plot.mark(settling, log.sites)
        limit = (f"settled: {SETTLED_ERROR_RAD:g} rad", style.LIMIT_LINE)
        plot.finish([*row, settling], [*style.site_legend_entries(log, log.sites), limit])
    return plot.figure


def draw_settling(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the largest error of any joint of every site over time, rad, on a logarithmic axis.

    A triangle marks the time at which a site settles; the legend has its value.
    """
    entries = []
    with time_figure(log, form, 2.4) as plot:
        axes = style.add_panels(plot.figure, 1, 1)[0, 0]
        low = high = SETTLED_ERROR_RAD
        for site in log.sites:
            line = style.site_line(log, site)
            size = np.abs(joint_errors(log[site])).max(axis=1, initial=0.0)
            positive = np.where(size > 0.0, size, np.nan)
            plot.trace(axes, site, positive)
            if size.any():
                least, most = np.nanpercentile(positive, (2.0, 100.0)).tolist()
                low, high = min(low, least), max(high, most)
            settled = settling_time_s(log[site])
            if settled is not None:
                mark = {"marker": "v", "markersize": 6.0, "color": line["color"], "clip_on": False}
                axes.plot(settled, SETTLED_ERROR_RAD, **mark)
            when = "not settled" if settled is None else f"settled at {settled:.1f} s"
            entries.append((f"{site}: {when}", line))
        axes.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        axes.set(yscale="log", ylim=(max(0.5 * low, _LEAST_RAD), 2.0 * high), ylabel="largest error (rad)")
        plot.mark(axes, log.sites)
        plot.finish([axes], [*entries, (f"limit {SETTLED_ERROR_RAD:g} rad", style.LIMIT_LINE)])
    return plot.figure


def draw_parameter_estimates(
    log: Log, form: FigureSize = REPORT_SIZE, *, sites: Sequence[str] | None = None
) -> Figure:
    """Returns the estimates of the five parameters over time with the true values; Fig. 6 of the paper.

    They are those of all sites unless `sites` are given; the paper shows master 1.
    """
    chosen = log.sites if sites is None else tuple(sites)
    rows = ["12", "34", "55"] if form.narrow else ["112233", "444555"]
    with time_figure(log, form, 4.4 if form.narrow else 3.6) as plot:
        panels = plot.figure.subplot_mosaic([[*row] for row in rows])
        for index in range(PARAMETERS):
            axes = panels[str(index + 1)]
            _draw_estimate(plot, chosen, index, axes)
            symbol = rf"$\theta_{index + 1}$ ({THETA_UNITS[index]})"
            axes.set_ylabel(symbol if form.narrow else f"estimate of {symbol}")
            plot.mark(axes, chosen)
        entries = [*style.site_legend_entries(log, chosen), ("true value", style.LIMIT_LINE)]
        plot.finish(list(panels.values()), entries)
    return plot.figure


def _draw_estimate(plot: TimeFigure, sites: Sequence[str], index: int, axes: Axes) -> None:
    """Draws the estimates of one parameter, and its true value once if all sites share it."""
    truths = {site: float(true_parameters(plot.log, site)[index]) for site in sites}
    for site in sites:
        plot.trace(axes, site, parameter_estimates(plot.log[site])[:, index])
    if len(set(truths.values())) == 1:
        axes.axhline(truths[sites[0]], **style.LIMIT_LINE)
        return
    for site, truth in truths.items():
        axes.axhline(truth, **{**style.LIMIT_LINE, "color": style.site_colour(plot.log, site)})


def draw_phase_portrait(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the phase portrait of the errors: e over the run against qd - qd_des, a panel per joint.

    A ring marks the start of a site, a disc its end.
    """
    with style.styled_figure(form, 1.0 + 0.36 * form.width_in) as figure:
        row = style.add_panels(figure, 1, JOINTS)[0]
        for site in log.sites:
            part, line = log[site], style.site_line(log, site, _LOOP_PT)
            e, ed = joint_errors(part), joint_error_rates(part)
            for joint, axes in enumerate(row if len(part) else ()):
                path = thin_path(np.stack([e[:, joint], ed[:, joint]], axis=1))
                axes.plot(*path.T, **line)
                ends = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": line["color"]}
                axes.plot(*path[0], **{**ends, "markerfacecolor": "white"}, zorder=3)
                axes.plot(*path[-1], **ends, zorder=3)
        style.title_joints(row)
        for axes in row:
            axes.set_xlabel("error (rad)")
            if form.narrow:
                axes.locator_params(axis="x", nbins=3)
        row[0].set_ylabel("its rate (rad/s)")
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


def thin_path(path: Array) -> Array:
    """Returns points of a path, shape (K, 2), K > 0, at about equal distances along it, ends included.

    A path in a plane is thinned by its length and not by time, so that fast parts keep as many points.
    """
    extent = np.ptp(path, axis=0)
    scaled = path / np.where(extent > 0.0, extent, 1.0)
    length = np.cumsum(np.hypot(*np.diff(scaled, axis=0, prepend=scaled[:1]).T))
    _, first = np.unique(np.floor(length / _STEP), return_index=True)
    kept: Array = path[np.union1d(first, [0, len(path) - 1])]
    return kept
