"""Figures of the arms' signals: torques, angles, errors, settling, estimates, paths, shares,
contact.

Invariant: torques of operators are those ON the arm, the negative of the record's tau_x.
Settling times are those of `analysis.site_signals`. Dominance factors follow from the scenario
and the changes in the records, Eq. (6) and (7), wall forces from the scenario's walls at the
logged states; `analysis.torque_sources` has the equations.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import site_signals
from ...analysis.arm_rows import build_arm_rows
from ...analysis.dominance_history import trace_dominance
from ...analysis.site_signals import SETTLED_ERROR_RAD
from ...analysis.timeline import list_changes
from ...analysis.torque_sources import list_walls, wall_depth, wall_force
from ...core.chain import LINK_PARAMETERS
from ...core.vectors import Array
from ...execution.virtual_comparison import simulate_without_operators
from ...log.log_reader import Log
from ...scenario.code_consent import find_user_laws
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws, unless

_ROW_IN = 1.2
"""Height of a row of panels, where there are several."""
_ACROSS = {"col": "row", "none": "none"}
"""What shares an axis of values if rows and columns change places."""
_LEAST_RAD = 1e-3 * SETTLED_ERROR_RAD
"""Lower end of the axis of errors, rad."""
_PLANES = ((0, 1), (0, 2), (1, 2))
_LOOP_PT = 0.8
"""Width of a line that crosses itself."""
_STEP = 0.01
"""Of its extent, between two points of a path."""
NO_OPERATOR = "no site has an operator in this run"

explain_absent_operator = unless(site_signals.sites_with_operator, NO_OPERATOR)
"""Returns why there is no torque of an operator to draw; "" if there is one."""


@draws(
    "operator_torques", "torque on the arms (Fig. 3)", explain_absent_operator, in_report=True
)
def draw_operator_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques of the operators ON the arms over time, N m; Fig. 3 of the paper."""
    signal = style.site_records(log, site_signals.external_torques)
    return _draw_joints(
        log=log,
        form=form,
        sites=site_signals.sites_with_operator(log),
        signal=signal,
        label="torque on the arm (N m)",
    )


def _explain_no_twin(log: Log) -> str:
    withheld = (str(law) for law in find_user_laws(log.scenario) if not law.allowed)
    return (
        next(withheld, "")
        if any(site.hands for site in log.scenario.sites.values())
        else NO_OPERATOR
    )


@draws(
    "hands_moved",
    "the log minus the same run without operators",
    _explain_no_twin,
    in_report=True,
)
def draw_operator_displacement(
    log: Log, form: FigureSize = REPORT_SIZE, *, twin: Log | None = None
) -> Figure:
    """Returns how far the operators moved every site over time, rad: the log minus a run
    without operators.

    That run, `twin`, is simulated if it is not given.
    """
    other = simulate_without_operators(log) if twin is None else twin
    signal = partial(site_signals.operator_displacement, log, other)
    return _draw_joints(
        log=log, form=form, sites=log.sites, signal=signal, label="moved by operators (rad)"
    )


@draws("control_torques", "torque of the controllers")
def draw_control_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns tau of Eq. (13) of every site over time, N m, with the limit where a site reached
    it.
    """
    limits = list[Array]()
    for site in log.sites:
        largest = np.abs(site_signals.controller_torques(log[site])).max(axis=0, initial=0.0)
        stated = np.broadcast_to(log.scenario.sites[site].limits.tau_limit_nm, largest.shape)
        if (largest >= stated).any():
            limits.append(stated)
    signal = style.site_records(log, site_signals.controller_torques)
    return _draw_joints(
        log=log,
        form=form,
        sites=log.sites,
        signal=signal,
        label="control torque (N m)",
        limits=limits,
    )


def _draw_joints(
    log: Log,
    form: FigureSize,
    sites: Sequence[str],
    signal: style.SiteSignal,
    label: str,
    limits: Sequence[Array] = (),
) -> Figure:
    count = len(style.name_joints(log))
    rows = len(style.arrange_joints(count, form.narrow))
    with style.time_figure(log, form, 2.2 + _ROW_IN * (rows - 1)) as plot:
        panels = style.add_joint_panels(plot.figure, count, form)
        style.title_joints(log, panels.joints)
        plot.joint_row(panels.joints, sites, signal)
        for joint, axes in enumerate(panels.joints):
            for limit in sorted({float(each[joint]) for each in limits if joint < len(each)}):
                axes.axhline(limit, **style.LIMIT_LINE)
                axes.axhline(-limit, **style.LIMIT_LINE)
        if rows == 1:
            panels.joints[0].set_ylabel(label)
        else:
            plot.figure.supylabel(label, fontsize=panels.joints[0].yaxis.label.get_fontsize())
        entries = [("limit", style.LIMIT_LINE)] if limits else []
        plot.finish(panels.lowest, [*style.site_legend_entries(log, sites), *entries])
    return plot.figure


def _add_joint_rows(
    plot: style.TimeFigure,
    form: FigureSize,
    heads: Sequence[str],
    labels: Sequence[str],
    sharey: str,
) -> tuple[list[list[Axes]], list[Axes]]:
    """Returns panels per quantity and joint, and the lowest of them.

    Two joints have columns beside each other, and a row per quantity, see `labels`; more have a
    row each, and a column per quantity, see `heads`. `sharey` says which two joints share their
    axes of values.
    """
    titles = style.name_joints(plot.log)
    if len(titles) == 2:
        grid = style.add_panels(plot.figure, len(labels), 2, sharex=True, sharey=sharey)
        style.title_joints(plot.log, grid[0])
        for row, label in zip(grid, labels, strict=True):
            row[0].set_ylabel(label)
        return [[*row] for row in grid], [*grid[-1]]
    grid = style.add_panels(
        plot.figure, len(titles), len(heads), sharex=True, sharey=_ACROSS[sharey]
    )
    for row, title in zip(grid, titles, strict=True):
        style.label_row(row[0], title, form)
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head)
    return [[*column] for column in grid.T], [*grid[-1]]


@draws("operation", "torque on the arms above their angles", explain_absent_operator)
def draw_operation(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the torques ON the arms, N m, above the angles of all arms, rad: a column per
    joint.

    Arms of more joints have a row per joint, with both quantities beside each other.
    """
    heads = ("torque (N m)", "angle (rad)")
    if not form.narrow:
        heads = ("torque on the arm (N m)", "joint angle (rad)")
    height_in = 2.9 if form.narrow else 3.4
    with style.time_figure(log, form, _height_in(log, height_in)) as plot:
        (upper, lower), lowest = _add_joint_rows(
            plot=plot, form=form, heads=heads, labels=heads, sharey="none"
        )
        if len(upper) == 2:
            upper[1].sharey(upper[0])
            upper[1].tick_params(labelleft=False)
        torques = style.site_records(log, site_signals.external_torques)
        plot.joint_row(upper, site_signals.sites_with_operator(log), torques)
        plot.joint_row(lower, log.sites, style.site_records(log, site_signals.joint_angles))
        plot.finish(lowest, style.site_legend_entries(log, log.sites))
    return plot.figure


def _height_in(log: Log, of_two: float) -> float:
    """Returns the height of a figure that has a row per joint if there are more than two."""
    count = len(style.name_joints(log))
    return of_two if count == 2 else 0.8 + 0.9 * count


@draws("positions", "actual and desired angles (Fig. 4)", in_report=True)
def draw_positions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns desired and actual joint angles of every site over time, rad; Fig. 4 of the
    paper.
    """
    labels = [
        ("{}: q (rad)" if form.narrow else "angle of {} (rad)").format(site)
        for site in log.sites
    ]
    heads = [f"{site}: q (rad)" for site in log.sites]
    entries = [
        (f"{style.site_title(log, s)}, actual", style.site_line(log, s, 1.6)) for s in log.sites
    ]
    height_in = 0.7 + (0.95 if form.narrow else 1.25) * len(log.sites)
    with style.time_figure(log, form, _height_in(log, height_in)) as plot:
        grid, lowest = _add_joint_rows(
            plot=plot, form=form, heads=heads, labels=labels, sharey="col"
        )
        for site, row in zip(log.sites, grid, strict=True):
            actual = site_signals.joint_angles(log[site])
            desired = site_signals.reference_angles(log[site])
            for joint, axes in enumerate(row[: actual.shape[1]]):
                plot.trace(axes, site, actual[:, joint], 1.6)
                plot.trace(axes, site, desired[:, joint], **style.LIMIT_LINE)
                plot.mark(axes, [site])
                if not len(log[site]):
                    style.annotate_empty_panel(axes, f"no records of {site}")
        plot.finish(lowest, [*entries, ("desired", style.LIMIT_LINE)])
    return plot.figure


@draws("tracking_errors", "errors, and the largest one still to come (Fig. 5)", in_report=True)
def draw_tracking_errors(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns e = q - q_des of every site over time, rad, Fig. 5 of the paper, and how it
    settles.

    In task space it is that of the place along each axis, m. The lowest panel shows, at every
    time, the largest error of any joint that is still to come: where it crosses the dashed
    line, the site has settled.
    """
    titles = style.name_shared(log)
    unit = site_signals.shared_unit(log)
    count = len(titles)
    rows = len(style.arrange_joints(count, form.narrow))
    with style.time_figure(log, form, 3.6 + _ROW_IN * (rows - 1)) as plot:
        panels = style.add_joint_panels(plot.figure, count, form, below="all")
        settling = panels.below
        assert settling is not None
        style.title_joints(log, panels.joints, titles)
        plot.joint_row(
            panels.joints, log.sites, style.site_records(log, site_signals.joint_errors)
        )
        for axes in panels.joints[:: panels.columns]:
            axes.set_ylabel(f"tracking error ({unit})")
        low = high = SETTLED_ERROR_RAD
        for site in log.sites:
            remaining = site_signals.largest_remaining_error(log[site])
            positive = style.positive(remaining)
            plot.trace(settling, site, positive)
            low = np.nanmin(positive, initial=low)
            high = np.nanmax(positive, initial=high)
        settling.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        settling.set(
            yscale="log",
            ylim=(0.5 * low, 2.0 * high),
            ylabel=f"largest error\nstill to come ({unit})",
        )
        plot.mark(settling, log.sites)
        limit = (f"settled: {SETTLED_ERROR_RAD:g} {unit}", style.LIMIT_LINE)
        plot.finish(
            [*panels.lowest, settling], [*style.site_legend_entries(log, log.sites), limit]
        )
    return plot.figure


@draws("settling", "size of the errors on a log axis, settling times")
def draw_settling(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the largest error of any joint of every site over time, rad, on a logarithmic
    axis.

    A triangle marks the time at which a site settles; the legend has its value.
    """
    entries = []
    unit = site_signals.shared_unit(log)
    with style.time_figure(log, form, 2.4) as plot:
        axes = style.add_panels(plot.figure, 1, 1)[0, 0]
        low = high = SETTLED_ERROR_RAD
        for site in log.sites:
            line = style.site_line(log, site)
            size = site_signals.largest_magnitude(site_signals.joint_errors(log[site]))
            positive = style.positive(size)
            plot.trace(axes, site, positive)
            if size.any():
                least, most = np.nanpercentile(positive, (2.0, 100.0)).tolist()
                low = min(low, least)
                high = max(high, most)
            settled = site_signals.settling_time_s(log[site])
            if settled is not None:
                mark = {
                    "marker": "v",
                    "markersize": 6.0,
                    "color": line["color"],
                    "clip_on": False,
                }
                axes.plot(settled, SETTLED_ERROR_RAD, **mark)
            when = "not settled" if settled is None else f"settled at {settled:.1f} s"
            entries.append((f"{site}: {when}", line))
        axes.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        axes.set(
            yscale="log",
            ylim=(max(0.5 * low, _LEAST_RAD), 2.0 * high),
            ylabel=f"largest error ({unit})",
        )
        plot.mark(axes, log.sites)
        plot.finish(
            [axes], [*entries, (f"limit {SETTLED_ERROR_RAD:g} {unit}", style.LIMIT_LINE)]
        )
    return plot.figure


def _learns(log: Log) -> bool:
    return any(
        len(log[site]) and np.ptp(log[site].theta_hat, axis=0).any() for site in log.sites
    )


@draws(
    "parameter_estimates",
    "estimates and true values (Fig. 6)",
    unless(_learns, "no estimate changed in this run"),
    in_report=True,
)
def draw_parameter_estimates(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the estimates of the parameters over time with the true values; Fig. 6 of the
    paper.

    They are those of all sites; the paper shows master 1. A chain has a row per link, two in a
    narrow figure.
    """
    if log.scenario.arms[log.sites[0]].chain is not None:
        return _draw_link_estimates(log, form)
    rows = ["12", "34", "55"] if form.narrow else ["112233", "444555"]
    with style.time_figure(log, form, 4.4 if form.narrow else 3.6) as plot:
        panels = plot.figure.subplot_mosaic([[*row] for row in rows])
        for index, (_, unit) in enumerate(log.scenario.arms[log.sites[0]].parameters):
            axes = panels[str(index + 1)]
            _draw_estimate(plot, log.sites, index, axes)
            symbol = rf"$\theta_{index + 1}$ ({style.typeset_unit(unit)})"
            axes.set_ylabel(symbol if form.narrow else f"estimate of {symbol}")
            plot.mark(axes, log.sites)
        entries = [*style.site_legend_entries(log, log.sites), ("true value", style.LIMIT_LINE)]
        plot.finish(list(panels.values()), entries)
    return plot.figure


def _draw_link_estimates(log: Log, form: FigureSize) -> Figure:
    arm = max(
        (log.scenario.arms[site] for site in log.sites), key=lambda each: each.counts.joints
    )
    columns = LINK_PARAMETERS // (2 if form.narrow else 1)
    rows = len(arm.theta) // columns
    with style.time_figure(log, form, 0.8 + 0.74 * rows) as plot:
        grid = style.add_panels(plot.figure, rows, columns, sharex=True)
        panels: list[Axes] = [*grid.flat]
        for index, (axes, (name, unit)) in enumerate(zip(panels, arm.parameters, strict=True)):
            known = [s for s in log.sites if index < len(log.scenario.arms[s].theta)]
            _draw_estimate(plot=plot, sites=known, index=index, axes=axes, width=0.9)
            plot.mark(axes, log.sites, numbered=False)
            link, _, symbol = name.rpartition(".")
            axes.set_title(
                f"{style.typeset_symbol(symbol)} ({style.typeset_unit(unit)})",
                fontsize=5.5,
                pad=3.5,
            )
            axes.tick_params(labelsize=5.0, length=1.5, pad=1.0)
            axes.locator_params(axis="y", nbins=2)
            style.flatten_rounding(axes)
            if not index % LINK_PARAMETERS:
                style.label_row(axes, f"{1 + index // LINK_PARAMETERS}: {link}", form)
        entries = [*style.site_legend_entries(log, log.sites), ("true value", style.LIMIT_LINE)]
        plot.finish([*grid[-1]], entries)
        for axes in grid[-1]:
            axes.set_xlabel("t (s)", fontsize=5.5, labelpad=1.0)
    return plot.figure


def _draw_estimate(
    plot: style.TimeFigure,
    sites: Sequence[str],
    index: int,
    axes: Axes,
    width: float | None = None,
) -> None:
    """Draws the estimates of one parameter, and its true value once if all sites share it."""
    truths = {site: float(plot.log.scenario.arms[site].theta[index]) for site in sites}
    for site in sites:
        plot.trace(
            axes, site, site_signals.parameter_estimates(plot.log[site])[:, index], width
        )
    if len(set(truths.values())) == 1:
        axes.axhline(truths[sites[0]], **style.LIMIT_LINE)
        return
    for site, truth in truths.items():
        axes.axhline(truth, **{**style.LIMIT_LINE, "color": style.site_colour(plot.log, site)})


@draws("phase", "errors against their rates")
def draw_phase_portrait(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the phase portrait of the errors: e over the run against qd - qd_des, a panel per
    joint.

    A ring marks the start of a site, a disc its end.
    """
    titles = style.name_shared(log)
    unit = site_signals.shared_unit(log)
    places = style.arrange_joints(len(titles), form.narrow)
    height_in = 0.72 * form.width_in / len(places[0])
    with style.styled_figure(form, 1.0 + len(places) * height_in) as figure:
        panels = figure.subplot_mosaic([[*row] for row in places])
        row = [axes for name, axes in panels.items() if name != "."]
        for site in log.sites:
            part = log[site]
            line = style.site_line(log, site, _LOOP_PT)
            e = site_signals.joint_errors(part)
            ed = site_signals.joint_error_rates(part)
            for joint, axes in enumerate(row[: e.shape[1]] if len(part) else ()):
                _draw_path(axes, np.stack([e[:, joint], ed[:, joint]], axis=1), line)
        style.title_joints(log, row, titles)
        for axes in row:
            axes.set_xlabel(f"error ({unit})")
            if form.narrow:
                axes.locator_params(axis="x", nbins=3)
        for axes in row[:: len(places[0])]:
            axes.set_ylabel(f"its rate ({unit.replace(',', '/s,')}/s)")
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


@draws(
    "paths",
    "paths of the end effectors in three planes",
    unless(
        lambda log: all(arm.chain for arm in log.scenario.arms.values()), "its arms are planar"
    ),
    in_report=True,
)
def draw_end_effector_paths(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the paths of the end effectors of chains, m, in three planes of the frame that
    all sites share.

    Of sites in task space in the metres of the task. A ring marks the start of a site, a disc
    its end.
    """
    places = style.arrange_joints(len(_PLANES), form.narrow)
    height_in = 0.9 * form.width_in / len(places[0])
    with style.styled_figure(form, 0.4 + len(places) * height_in) as figure:
        panels = figure.subplot_mosaic([[*row] for row in places])
        for site in log.sites:
            part = log[site]
            line = style.site_line(log, site)
            path = (
                build_arm_rows(log.scenario, site).place_end_effector(part.q, part.qd).position
            )
            path = path * log.scenario.sites[site].task.scale
            for axes, plane in zip(panels.values() if len(part) else (), _PLANES, strict=False):
                _draw_path(axes, path[:, plane], line)
        for axes, (across, up) in zip(panels.values(), _PLANES, strict=True):
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)")
            axes.locator_params(nbins=4)
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


def _draw_path(axes: Axes, path: Array, line: dict[str, Any]) -> None:
    """Draws a path, shape (K, 2), K > 0, with a ring at its start and a disc at its end."""
    path = thin_path(path)
    axes.plot(*path.T, **line)
    ends = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": line["color"]}
    axes.plot(*path[0], **{**ends, "markerfacecolor": "white"}, zorder=3)
    axes.plot(*path[-1], **ends, zorder=3)


def thin_path(path: Array) -> Array:
    """Returns points of a path, shape (K, 2), K > 0, at about equal distances along it, ends
    included.

    A path in a plane is thinned by its length and not by time, so that fast parts keep as many
    points.
    """
    extent = np.ptp(path, axis=0)
    scaled = path / np.where(extent > 0.0, extent, 1.0)
    length = np.cumsum(np.hypot(*np.diff(scaled, axis=0, prepend=scaled[:1]).T))
    _, first = np.unique(np.floor(length / _STEP), return_index=True)
    kept: Array = path[np.union1d(first, [0, len(path) - 1])]
    return kept


def list_sites_with_changing_dominance(log: Log) -> list[str]:
    """Returns the sites whose shares change during the run, in scenario order."""
    changing = {changed.change.dominance for changed in list_changes(log)}
    return [site for site in log.sites if site in changing]


@draws(
    "authority",
    "shares that change, and the motion of the arms",
    unless(list_sites_with_changing_dominance, "the shares of all sites are constant"),
)
def draw_authority(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the shares that change, and how far every arm is from where it started, rad."""
    owners = list_sites_with_changing_dominance(log)
    titles = style.name_joints(log)
    rows = len(owners) + len(titles)
    low = len(titles) > 2
    with style.time_figure(log, form, 0.8 + (0.8 if low else 1.05) * rows) as plot:
        column = style.add_panels(plot.figure, rows, 1, sharex=True)[:, 0]
        for site, axes in zip(owners, column, strict=False):
            part = log[site]
            peers = log.scenario.peers(site)
            alpha = trace_dominance(log, site, part.t_s).alpha
            for peer, share in zip(peers, alpha.T, strict=True):
                plot.trace(axes, site, share, **style.site_line(log, peer))
            axes.set(ylim=(-0.05, 1.05), ylabel=f"share in {site} (1)")
            plot.mark(axes, [site])
        for site in log.sites:
            moved = site_signals.joint_angles(log[site]) - np.array(
                log.scenario.sites[site].q0_rad
            )
            for axes, values in zip(column[len(owners) :], moved.T, strict=False):
                plot.trace(axes, site, values)
        for title, axes in zip(titles, column[len(owners) :], strict=True):
            style.label_row(axes, title, form) if low else axes.set_ylabel(f"{title} (rad)")
            plot.mark(axes, log.sites)
        plot.finish([column[-1]], style.site_legend_entries(log, log.sites))
    return plot.figure


def list_sites_with_walls(log: Log) -> list[str]:
    """Returns the sites that have a wall in their way, in scenario order."""
    return [site for site in log.sites if list_walls(log.scenario.sites[site])]


@draws(
    "contact",
    "force of the walls, and depth in them",
    unless(list_sites_with_walls, "no site has a wall in this run"),
)
def draw_contact(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the normal force of every wall over time, N, above the depth of the end effector
    in it, mm.
    """
    sites = list_sites_with_walls(log)
    with style.time_figure(log, form, 2.9) as plot:
        column = style.add_panels(plot.figure, 2, 1, sharex=True)[:, 0]
        for site in sites:
            part = log[site]
            spec = log.scenario.sites[site]
            end_effector = build_arm_rows(log.scenario, site).place_end_effector(
                part.q, part.qd
            )
            walls = list_walls(spec)
            for wall, dashes in zip(walls, [*style.DASHES] * len(walls), strict=False):
                depth_mm = 1e3 * np.maximum(wall_depth(wall, end_effector), 0.0)
                force = wall_force(wall, part.t_s, end_effector)
                plot.trace(column[0], site, force, 1.1, linestyle=dashes)
                plot.trace(column[1], site, depth_mm, 1.1, linestyle=dashes)
        column[0].set_ylabel("force of wall (N)")
        column[1].set_ylabel("depth in it (mm)")
        for axes in column:
            axes.set_ylim(bottom=0.0)
            plot.mark(axes, sites)
        plot.finish([column[-1]], style.site_legend_entries(log, sites))
    return plot.figure
