"""Figures of joint signals: torques, angles, errors, settling, phase portrait and parameter estimates.

Invariant: torques of operators are those ON the arm, the negative of the record's tau_x. Settling times are
those of `analysis.site_signals`.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import site_signals
from ...core.two_link_arm import JOINTS, PARAMETERS
from ...core.vectors import Array
from ...log.log_reader import Log
from .. import style
from ..event_markers import EventMarkers
from ..figure_size import REPORT_SIZE, FigureSize

THETA_UNITS = ("kg m²", "kg m²", "kg m²", "kg m", "kg m")
"""Of the five parameters of Eq. (24)."""

NO_OPERATOR = "nobody at the arms: no site has hands in this run"
NO_RUN_WITHOUT_OPERATOR = "no run without hands to compare with"


def draw_operator_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques of the operators' hands ON the arms over time, N m; Fig. 3 of the paper."""
    sites = site_signals.sites_with_operator(log)
    if not sites:
        return style.empty_figure(NO_OPERATOR, form)
    marks = EventMarkers(log, form)
    with style.figure_style(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.add_panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            for site in sites:
                part = log[site]
                torque = site_signals.external_torques(part)[:, joint]
                style.plot_decimated(axes, part.tick, part.t_s, torque, **style.site_line(log, site))
            marks.draw(axes, sites)
        row[0].set_ylabel("torque on the arm (N m)")
        style.set_time_axis(log, row)
        style.add_legend(figure, style.site_legend_entries(log, sites))
        marks.explain(figure)
    return figure


def draw_positions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns desired and actual joint angles of every site over time, rad; Fig. 4 of the paper."""
    marks = EventMarkers(log, form)
    says = "{}: q (rad)" if form.narrow else "angle of {} (rad)"
    with style.figure_style(form):
        figure = style.new_figure(0.7 + (0.95 if form.narrow else 1.25) * len(log.sites), form.width_in)
        grid = style.add_panels(figure, len(log.sites), JOINTS, sharex=True, sharey="col")
        for site, row in zip(log.sites, grid, strict=True):
            part = log[site]
            actual, desired = site_signals.joint_angles(part), site_signals.reference_angles(part)
            for joint, axes in enumerate(row):
                style.plot_decimated(
                    axes, part.tick, part.t_s, actual[:, joint], **style.site_line(log, site, 1.6)
                )
                style.plot_decimated(axes, part.tick, part.t_s, desired[:, joint], **style.LIMIT_LINE)
                marks.draw(axes, [site])
                _note_absence(log, site, axes)
            row[0].set_ylabel(says.format(site))
        _joint_titles(grid[0])
        style.set_time_axis(log, grid[-1])
        actual_entries = [
            (f"{style.site_title(log, s)}, actual", style.site_line(log, s, 1.6)) for s in log.sites
        ]
        style.add_legend(figure, [*actual_entries, ("desired", style.LIMIT_LINE)])
        marks.explain(figure)
    return figure


def draw_tracking_errors(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns e = q - q_des of every site over time, rad, Fig. 5 of the paper, and how it settles.

    The lowest panel shows, at every time, the largest error of any joint that is still to come: where it
    crosses the dashed line, the site has settled.
    """
    marks = EventMarkers(log, form)
    with style.figure_style(form):
        figure = style.new_figure(3.6, form.width_in)
        panels = figure.subplot_mosaic([["1", "2"], ["all", "all"]])
        row, settling = [panels["1"], panels["2"]], panels["all"]
        row[1].sharey(row[0])
        row[1].tick_params(labelleft=False)
        for site in log.sites:
            part, e = log[site], site_signals.joint_errors(log[site])
            for joint, axes in enumerate(row):
                style.plot_decimated(axes, part.tick, part.t_s, e[:, joint], **style.site_line(log, site))
        _joint_titles(row)
        row[0].set_ylabel("tracking error (rad)")
        _settling(log, settling)
        for axes in (*row, settling):
            marks.draw(axes, log.sites)
        style.set_time_axis(log, [*row, settling])
        limit = (f"settled: {site_signals.SETTLED_ERROR_RAD:g} rad", style.LIMIT_LINE)
        style.add_legend(figure, [*style.site_legend_entries(log, log.sites), limit])
        marks.explain(figure)
    return figure


def draw_parameter_estimates(
    log: Log, sites: Sequence[str] | None = None, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Returns the estimates of the five parameters over time with the true values; Fig. 6 of the paper.

    Args:
        log: the log.
        sites: whose estimates; None for all. The paper shows master 1.
        form: what it is drawn for.
    """
    chosen = log.sites if sites is None else tuple(sites)
    marks = EventMarkers(log, form)
    rows = ["12", "34", "55"] if form.narrow else ["112233", "444555"]
    with style.figure_style(form):
        figure = style.new_figure(4.4 if form.narrow else 3.6, form.width_in)
        panels = figure.subplot_mosaic([[*row] for row in rows])
        for index in range(PARAMETERS):
            _estimate(log, chosen, index, panels[str(index + 1)], form)
            marks.draw(panels[str(index + 1)], chosen)
        style.set_time_axis(log, list(panels.values()))
        style.add_legend(figure, [*style.site_legend_entries(log, chosen), ("true value", style.LIMIT_LINE)])
        marks.explain(figure)
    return figure


def draw_operator_displacement(log: Log, twin: Log | None, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns how far the hands moved every site over time, rad: the log minus a run without hands.

    Args:
        log: the log.
        twin: the same experiment with nobody at the arms, or None.
        form: what it is drawn for.
    """
    if twin is None:
        return style.empty_figure(
            NO_RUN_WITHOUT_OPERATOR if site_signals.sites_with_operator(log) else NO_OPERATOR, form
        )
    marks = EventMarkers(log, form)
    with style.figure_style(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.add_panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for site in log.sites:
            tick, t_s, moved = site_signals.operator_displacement(log, twin, site)
            for joint, axes in enumerate(row):
                style.plot_decimated(axes, tick, t_s, moved[:, joint], **style.site_line(log, site))
        for axes in row:
            marks.draw(axes, log.sites)
        _joint_titles(row)
        row[0].set_ylabel("moved by hands (rad)")
        style.set_time_axis(log, row)
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
        marks.explain(figure)
    return figure


def _settling(log: Log, axes: Axes) -> None:
    """Draws the largest error still to come of every site, on a logarithmic axis that holds the limit."""
    low = high = site_signals.SETTLED_ERROR_RAD
    for site in log.sites:
        part, remaining = log[site], site_signals.largest_remaining_error(log[site])
        positive = np.where(remaining > 0.0, remaining, np.nan)
        style.plot_decimated(axes, part.tick, part.t_s, positive, **style.site_line(log, site))
        low, high = np.nanmin(positive, initial=low), np.nanmax(positive, initial=high)
    axes.axhline(site_signals.SETTLED_ERROR_RAD, **style.LIMIT_LINE)
    axes.set(yscale="log", ylim=(0.5 * low, 2.0 * high), ylabel="largest error\nstill to come (rad)")


def _estimate(log: Log, sites: Sequence[str], index: int, axes: Axes, form: FigureSize) -> None:
    """Draws the estimates of one parameter, and its true value once where all sites have the same."""
    truths = {site: float(site_signals.true_parameters(log, site)[index]) for site in sites}
    for site in sites:
        part = log[site]
        style.plot_decimated(
            axes,
            part.tick,
            part.t_s,
            site_signals.parameter_estimates(part)[:, index],
            **style.site_line(log, site),
        )
    if len(set(truths.values())) == 1:
        axes.axhline(truths[sites[0]], **style.LIMIT_LINE)
    else:
        for site, truth in truths.items():
            axes.axhline(truth, **{**style.LIMIT_LINE, "color": style.site_colour(log, site)})
    words = "" if form.narrow else "estimate of "
    axes.set_ylabel(rf"{words}$\theta_{index + 1}$ ({THETA_UNITS[index]})")


def _joint_titles(row: Sequence[Axes]) -> None:
    for joint, axes in enumerate(row):
        axes.set_title(f"joint {joint + 1}")


def _note_absence(log: Log, site: str, axes: Axes) -> None:
    if not len(log[site]):
        style.annotate_empty_panel(axes, f"no records of {site}")


_WORDS = ("torque on the arm (N m)", "joint angle (rad)")
_SHORT = ("torque (N m)", "angle (rad)")


def draw_operation(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques ON the arms, N m, above the angles of all arms, rad: a column per joint."""
    pushed = site_signals.sites_with_operator(log)
    if not pushed:
        return style.empty_figure(NO_OPERATOR, form)
    marks = EventMarkers(log, form)
    says = _SHORT if form.narrow else _WORDS
    with style.figure_style(form):
        figure = style.new_figure(2.9 if form.narrow else 3.4, form.width_in)
        grid = style.add_panels(figure, 2, JOINTS, sharex=True)
        grid[0, 1].sharey(grid[0, 0])
        grid[0, 1].tick_params(labelleft=False)
        for joint, (above, below) in enumerate(grid.T):
            above.set_title(f"joint {joint + 1}")
            for site in pushed:
                _trace(log, site, above, site_signals.external_torques(log[site])[:, joint])
            for site in log.sites:
                _trace(log, site, below, site_signals.joint_angles(log[site])[:, joint])
            marks.draw(above, pushed)
            marks.draw(below, log.sites)
        for axes, text in zip(grid[:, 0], says, strict=True):
            axes.set_ylabel(text)
        style.set_time_axis(log, grid[1])
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
        marks.explain(figure)
    return figure


def draw_control_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns tau of Eq. (13) of every site over time, N m, with the limit where a site reached it."""
    marks = EventMarkers(log, form)
    reached = set()
    with style.figure_style(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.add_panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for site in log.sites:
            tau, limit = (
                site_signals.controller_torques(log[site]),
                log.scenario.sites[site].limits.tau_limit_nm,
            )
            if len(tau) and abs(tau).max() >= limit:
                reached.add(limit)
            for joint, axes in enumerate(row):
                _trace(log, site, axes, tau[:, joint])
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            marks.draw(axes, log.sites)
            for limit in sorted(reached):
                axes.axhline(limit, **style.LIMIT_LINE)
                axes.axhline(-limit, **style.LIMIT_LINE)
        row[0].set_ylabel("control torque (N m)")
        style.set_time_axis(log, row)
        limits = [("limit", style.LIMIT_LINE)] if reached else []
        style.add_legend(figure, [*style.site_legend_entries(log, log.sites), *limits])
        marks.explain(figure)
    return figure


def _trace(log: Log, site: str, axes: Axes, values: Array) -> None:
    style.plot_decimated(axes, log[site].tick, log[site].t_s, values, **style.site_line(log, site))


_LEAST_RAD = 1e-3 * site_signals.SETTLED_ERROR_RAD
"""As far down as an axis goes, rad."""
_LOOP_PT = 0.8
"""Width of a line that crosses itself."""
_STEP = 0.01
"""Of its extent, between two points of a path."""


def draw_settling(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the largest error of any joint of every site over time, rad, on a logarithmic axis.

    A triangle stands where a site settles, with its time in the legend.
    """
    marks, limit = EventMarkers(log, form), site_signals.SETTLED_ERROR_RAD
    entries = []
    with style.figure_style(form):
        figure = style.new_figure(2.4, form.width_in)
        axes = style.add_panels(figure, 1, 1)[0, 0]
        low = high = limit
        for site in log.sites:
            part, line = log[site], style.site_line(log, site)
            size = np.abs(site_signals.joint_errors(part)).max(axis=1, initial=0.0)
            positive = np.where(size > 0.0, size, np.nan)
            style.plot_decimated(axes, part.tick, part.t_s, positive, **line)
            if size.any():
                least, most = np.nanpercentile(positive, (2.0, 100.0)).tolist()
                low, high = min(low, least), max(high, most)
            settled = site_signals.settling_time_s(part)
            if settled is not None:
                axes.plot(settled, limit, marker="v", markersize=6.0, color=line["color"], clip_on=False)
            when = "not settled" if settled is None else f"settled at {settled:.1f} s"
            entries.append((f"{site}: {when}", line))
        axes.axhline(limit, **style.LIMIT_LINE)
        axes.set(yscale="log", ylim=(max(0.5 * low, _LEAST_RAD), 2.0 * high), ylabel="largest error (rad)")
        marks.draw(axes, log.sites)
        style.set_time_axis(log, [axes])
        style.add_legend(figure, [*entries, (f"limit {limit:g} rad", style.LIMIT_LINE)])
        marks.explain(figure)
    return figure


def draw_phase_portrait(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the phase portrait of the errors: e over the run against qd - qd_des, a panel per joint.

    A ring is where a site begins, a disc where it ends.
    """
    with style.figure_style(form):
        figure = style.new_figure(1.0 + 0.36 * form.width_in, form.width_in)
        row = style.add_panels(figure, 1, JOINTS)[0]
        for site in log.sites:
            part, line = log[site], style.site_line(log, site, _LOOP_PT)
            e, ed = site_signals.joint_errors(part), site_signals.joint_error_rates(part)
            for joint, axes in enumerate(row if len(part) else ()):
                path = thin_path(np.stack([e[:, joint], ed[:, joint]], axis=1))
                axes.plot(*path.T, **line)
                ends = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": line["color"]}
                axes.plot(*path[0], **{**ends, "markerfacecolor": "white"}, zorder=3)
                axes.plot(*path[-1], **ends, zorder=3)
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            axes.set_xlabel("error (rad)")
            if form.narrow:
                axes.locator_params(axis="x", nbins=3)
        row[0].set_ylabel("its rate (rad/s)")
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


def thin_path(path: Array) -> Array:
    """Returns the points of a path at about equal distances along it, ends included, shape (P, 2).

    A path in a plane is thinned by its length and not by time: what is fast has no fewer points.

    Args:
        path: shape (K, 2), K > 0, of finite numbers.
    """
    extent = np.ptp(path, axis=0)
    scaled = path / np.where(extent > 0.0, extent, 1.0)
    length = np.cumsum(np.hypot(*np.diff(scaled, axis=0, prepend=scaled[:1]).T))
    _, first = np.unique(np.floor(length / _STEP), return_index=True)
    kept: Array = path[np.union1d(first, [0, len(path) - 1])]
    return kept
