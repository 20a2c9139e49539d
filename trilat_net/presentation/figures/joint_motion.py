"""Draws the signals of the arms, such as torques, angles, errors and contact forces.

Each function decorated with `draws` is one figure. Most signals are read from the log of the
run. Some are computed:

- Dominance factors are computed from the scenario and its recorded changes.
- Contact forces are computed from the walls of the scenario and the recorded motion, by
  `analysis.torque_sources`.
- The settling time, after which an error stays small, is computed by `analysis.site_signals`.

Invariant:
    - Operator torques are drawn as they act on the arm. The log contains the opposite sign, the
      torque exerted by the arm on the operator.
"""

import textwrap
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import (
    SETTLED_ERROR_RAD,
    DominanceHistory,
    Timeline,
    VirtualWall,
    build_arm_rows,
    site_signals,
)
from ...core import LINK_PARAMETERS, Array
from ...execution import SimulatedLog
from ...log import Log, SiteLog
from .. import plot_signals, style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws, unless

_ROW_IN = 1.2
"""Height of each additional row of panels, in inches."""
_TRANSPOSED = {"col": "row", "none": "none"}
"""Setting for shared value axes after swapping rows and columns."""
_LEAST_RAD = 1e-3 * SETTLED_ERROR_RAD
"""Minimum for the lower end of the error axis, in rad."""
_PLANES = ((0, 1), (0, 2), (1, 2))
"""Horizontal and vertical axis of each plane in which paths are drawn."""
_LOOP_PT = 0.8
"""Width of a line that may cross itself, in pt."""
_PATH_STEP = 0.01
"""Distance between two points of a thinned path, relative to the extent of the path."""
_LINK_PANEL_PT = 5.5
"""Font size of titles and time labels in the figure of link parameters, in pt."""
NO_OPERATOR = "no site has an operator in this run"

explain_absent_operator = unless(plot_signals.sites_with_operator, NO_OPERATOR)
"""Returns the reason why a log has no operator torque. Empty if it has one."""


@draws(
    "operator_torques",
    "torque of operators and walls on the arms (Fig. 3 of the paper)",
    explain_absent_operator,
    in_report=True,
)
def _draw_operator_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the operator torques on the arms over time, in N m, as in Fig. 3 of the paper.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    return _draw_joints(
        log=log,
        form=form,
        sites=plot_signals.sites_with_operator(log),
        signal=style.site_records(log, site_signals.external_torques),
        label="torque on the arm (N m)",
    )


def _explain_absent_displacement(log: Log) -> str:
    """Returns the reason why a run cannot be repeated without its operators.

    The repetition is needed to compute how far the operators displaced the arms.

    Returns:
        The reason: there are no operators, or the code of a user's control law is not allowed
            to run here. Empty if the run can be repeated.
    """
    if not any(site.hands for site in log.scenario.sites.values()):
        return NO_OPERATOR
    for law in log.scenario.inspect_user_laws():
        if not law.allowed:
            return str(law)
    return ""


@draws(
    "hands_moved",
    "the log minus the same run without operators",
    _explain_absent_displacement,
    in_report=True,
)
def draw_operator_displacement(
    log: Log, form: FigureSize = REPORT_SIZE, *, twin: Log | None = None
) -> Figure:
    """Draws how far the operators displaced every arm, in rad over time.

    The displacement is the difference between the recorded run and a simulation of the same run
    without operators.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
        twin: The run without operators. `None` to simulate it.
    """
    run_without_operators = SimulatedLog.without_operators(log) if twin is None else twin
    return _draw_joints(
        log=log,
        form=form,
        sites=log.sites,
        signal=partial(site_signals.operator_displacement, log, run_without_operators),
        label="moved by operators (rad)",
    )


@draws("control_torques", "torque of the controllers")
def _draw_control_torques(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the torques that the controllers command at the joints of all arms, in N m.

    Operator and wall torques are not included. If a controller reached its torque limit, the
    limit is drawn too.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    reached_limits = list[Array]()
    for site in log.sites:
        torques = site_signals.controller_torques(log[site])
        largest = np.abs(torques).max(axis=0, initial=0.0)  # of each joint
        site_limits_nm = log.scenario.sites[site].limits.tau_limit_nm
        joint_limits_nm = np.broadcast_to(site_limits_nm, largest.shape)
        if (largest >= joint_limits_nm).any():
            reached_limits.append(joint_limits_nm)
    return _draw_joints(
        log=log,
        form=form,
        sites=log.sites,
        signal=style.site_records(log, site_signals.controller_torques),
        label="control torque (N m)",
        limits=reached_limits,
    )


def _draw_joints(
    log: Log,
    form: FigureSize,
    sites: Sequence[str],
    signal: style.SiteSignal,
    label: str,
    limits: Sequence[Array] = (),
) -> Figure:
    """Draws a signal over time, with one panel per joint and one line per site.

    Figures of angles, torques and errors share this function, so that they look alike.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
        sites: Names of the sites that have the signal.
        signal: Function that returns the signal of a site.
        label: Label of the value axis.
        limits: Limits of the signal, shape (n,) each, drawn with both signs.
    """
    joint_count = len(style.name_joints(log))
    row_count = len(style.arrange_joints(joint_count, form.narrow))
    with style.time_figure(log, form, 2.2 + _ROW_IN * (row_count - 1)) as plot:
        panels = plot.add_joint_panels(joint_count)
        _title_joints(log, panels.joints)
        plot.joint_row(panels.joints, sites, signal)
        for joint, axes in enumerate(panels.joints):
            # Equal limits of several sites are drawn once. Arms may have fewer joints.
            values_of_joint = {float(limit[joint]) for limit in limits if joint < len(limit)}
            for value in sorted(values_of_joint):
                axes.axhline(value, **style.LIMIT_LINE)
                axes.axhline(-value, **style.LIMIT_LINE)

        first_panel = panels.joints[0]
        if row_count == 1:
            first_panel.set_ylabel(label)
        else:
            plot.figure.supylabel(label, fontsize=first_panel.yaxis.label.get_fontsize())

        entries = style.site_legend_entries(log, sites)
        if limits:
            entries.append(("limit", style.LIMIT_LINE))
        plot.finish(panels.lowest, entries)
    return plot.figure


def add_joint_rows(
    figure: Figure,
    log: Log,
    form: FigureSize,
    heads: Sequence[str],
    labels: Sequence[str],
    sharey: str,
    titles: Sequence[str] = (),
) -> tuple[list[list[Axes]], list[Axes]]:
    """Adds a grid of panels to a figure, with one panel per quantity and joint.

    Arms with two joints have one column per joint and one row per quantity. Arms with more
    joints have one row per joint and one column per quantity, because a row with many joints
    would not fit.

    Args:
        figure: The figure.
        log: Log with the joints.
        form: Width, font sizes and resolution of the figure.
        heads: Titles of the quantities, used above columns.
        labels: Labels of the quantities, used beside rows.
        sharey: "col" if the quantities of a joint share their value axis, otherwise "none".
        titles: Titles of the joints. Empty to use the joint names.

    Returns:
        The panels, indexed by quantity and then by joint, and the bottom panel of each column.
    """
    titles = titles or style.name_joints(log)
    if len(titles) == 2:
        grid = style.add_panels(figure, len(labels), 2, sharex=True, sharey=sharey)
        _title_joints(log, grid[0], titles)
        for row, label in zip(grid, labels, strict=True):
            row[0].set_ylabel(label)
        return [list(row) for row in grid], list(grid[-1])

    grid = style.add_panels(
        figure, len(titles), len(heads), sharex=True, sharey=_TRANSPOSED[sharey]
    )
    for row, title in zip(grid, titles, strict=True):
        _label_row(row[0], title, form)
    for axes, head in zip(grid[0], heads, strict=True):
        axes.set_title(head)
    # The caller gets the panels by quantity and joint, in either arrangement.
    return [list(column) for column in grid.T], list(grid[-1])


@draws("operation", "torque on the arms above their angles", explain_absent_operator)
def _draw_operation(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the operator torques on the arms, in N m, and the joint angles, in rad.

    The torques are above the angles, or beside them if the arms have more than two joints.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    heads = ("torque on the arm (N m)", "joint angle (rad)")
    if form.narrow:
        heads = ("torque (N m)", "angle (rad)")
    height_in = choose_height_in(log, 2.9 if form.narrow else 3.4)
    with style.time_figure(log, form, height_in) as plot:
        (torques, angles), lowest = add_joint_rows(
            figure=plot.figure, log=log, form=form, heads=heads, labels=heads, sharey="none"
        )
        if len(torques) == 2:  # the two torques are side by side, and share one value axis
            torques[1].sharey(torques[0])
            torques[1].tick_params(labelleft=False)

        operated_sites = plot_signals.sites_with_operator(log)
        torque_signal = style.site_records(log, site_signals.external_torques)
        angle_signal = style.site_records(log, site_signals.joint_angles)
        plot.joint_row(torques, operated_sites, torque_signal)
        plot.joint_row(angles, log.sites, angle_signal)
        plot.finish(lowest, style.site_legend_entries(log, log.sites))
    return plot.figure


def choose_height_in(log: Log, two_joints_in: float) -> float:
    """Returns the height of a figure with panels per joint, in inches.

    Arms with more than two joints have one row of panels per joint, see `add_joint_rows`.

    Args:
        log: Log of the run.
        two_joints_in: Height of the figure for arms with two joints, in inches.
    """
    joint_count = len(style.name_joints(log))
    if joint_count == 2:
        return two_joints_in
    legend_and_axis_in = 0.8
    row_in = 0.9
    return legend_and_axis_in + row_in * joint_count


@draws("positions", "actual and desired angles (Fig. 4 of the paper)", in_report=True)
def _draw_positions(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the desired and the actual joint angles over time, as in Fig. 4 of the paper.

    The desired angles of a site are the mean of the other sites' angles, weighted by the
    dominance factors. All angles are in rad.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    heads = [f"{site}: q (rad)" for site in log.sites]
    labels = heads if form.narrow else [f"angle of {site} (rad)" for site in log.sites]
    row_in = 0.95 if form.narrow else 1.25
    height_in = choose_height_in(log, 0.7 + row_in * len(log.sites))

    with style.time_figure(log, form, height_in) as plot:
        grid, lowest = add_joint_rows(
            figure=plot.figure, log=log, form=form, heads=heads, labels=labels, sharey="col"
        )
        for site, row in zip(log.sites, grid, strict=True):
            actual = site_signals.joint_angles(log[site])
            desired = plot_signals.reference_angles(log[site])
            joint_count = actual.shape[1]
            for joint, axes in enumerate(row[:joint_count]):
                plot.trace(axes, site, actual[:, joint], 1.6)
                plot.trace(axes, site, desired[:, joint], **style.LIMIT_LINE)
                plot.mark(axes, [site])
                if not len(log[site]):
                    style.annotate_empty_panel(axes, f"no records of {site}")

        entries = []
        for site in log.sites:
            label = f"{style.site_title(log, site)}, actual"
            entries.append((label, style.site_line(log, site, 1.6)))
        entries.append(("desired", style.LIMIT_LINE))
        plot.finish(lowest, entries)
    return plot.figure


@draws(
    "tracking_errors",
    "errors, and the largest one still to come (Fig. 5 of the paper)",
    in_report=True,
)
def _draw_tracking_errors(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the tracking errors of every site over time, as in Fig. 5 of the paper.

    The error is e = q - q_des, the actual minus the desired joint angles. The panel below
    shows, for each time, the largest error of any joint from then on. The settling time is when
    this line falls below the dashed limit.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    titles = style.name_shared(log)
    unit = plot_signals.shared_unit(log)
    row_count = len(style.arrange_joints(len(titles), form.narrow))
    with style.time_figure(log, form, 3.6 + _ROW_IN * (row_count - 1)) as plot:
        panels = plot.add_joint_panels(len(titles), below="all")
        settling_panel = panels.below
        assert settling_panel is not None
        _title_joints(log, panels.joints, titles)
        error_signal = style.site_records(log, site_signals.joint_errors)
        plot.joint_row(panels.joints, log.sites, error_signal)
        first_in_rows = panels.joints[:: panels.columns]
        for axes in first_in_rows:
            axes.set_ylabel(f"tracking error ({unit})")

        lowest_drawn = SETTLED_ERROR_RAD
        highest_drawn = SETTLED_ERROR_RAD
        for site in log.sites:
            remaining = style.positive(site_signals.largest_remaining_error(log[site]))
            plot.trace(settling_panel, site, remaining)
            lowest_drawn = np.nanmin(remaining, initial=lowest_drawn)
            highest_drawn = np.nanmax(remaining, initial=highest_drawn)
        settling_panel.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        settling_panel.set(
            yscale="log",
            ylim=(0.5 * lowest_drawn, 2.0 * highest_drawn),
            ylabel=f"largest error\nstill to come ({unit})",
        )
        plot.mark(settling_panel, log.sites)

        entries = style.site_legend_entries(log, log.sites)
        entries.append((f"settling limit: {SETTLED_ERROR_RAD:g} {unit}", style.LIMIT_LINE))
        plot.finish([*panels.lowest, settling_panel], entries)
    return plot.figure


@draws("settling", "size of the errors on a log axis, settling times")
def _draw_settling(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the largest error of any joint of every site over time, on a logarithmic axis.

    A triangle marks the settling time of each site, which is also given in the legend.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    unit = plot_signals.shared_unit(log)
    entries = []
    with style.time_figure(log, form, 2.4) as plot:
        axes = style.add_panels(plot.figure, 1, 1)[0, 0]
        lowest_drawn = SETTLED_ERROR_RAD
        highest_drawn = SETTLED_ERROR_RAD
        for site in log.sites:
            errors = site_signals.largest_magnitude(site_signals.joint_errors(log[site]))
            drawn_errors = style.positive(errors)
            plot.trace(axes, site, drawn_errors)
            if errors.any():
                # The 2nd percentile excludes the dips at zero crossings, which would stretch
                # the logarithmic axis.
                site_lowest, site_highest = np.nanpercentile(
                    drawn_errors, (2.0, 100.0)
                ).tolist()
                lowest_drawn = min(lowest_drawn, site_lowest)
                highest_drawn = max(highest_drawn, site_highest)

            line_style = style.site_line(log, site)
            settled_s = site_signals.settling_time_s(log[site])
            if settled_s is None:
                entries.append((f"{site}: no settling time", line_style))
            else:
                axes.plot(
                    settled_s,
                    SETTLED_ERROR_RAD,
                    marker="v",
                    markersize=6.0,
                    color=line_style["color"],
                    clip_on=False,
                )
                entries.append((f"{site}: settling time {settled_s:.1f} s", line_style))

        axes.axhline(SETTLED_ERROR_RAD, **style.LIMIT_LINE)
        axes.set(
            yscale="log",
            ylim=(max(0.5 * lowest_drawn, _LEAST_RAD), 2.0 * highest_drawn),
            ylabel=f"largest error ({unit})",
        )
        plot.mark(axes, log.sites)
        entries.append((f"limit {SETTLED_ERROR_RAD:g} {unit}", style.LIMIT_LINE))
        plot.finish([axes], entries)
    return plot.figure


def _has_changing_estimates(log: Log) -> bool:
    """Returns True if the estimates of at least one site change during the run."""
    for site in log.sites:
        records = log[site]
        if len(records) and np.ptp(records.theta_hat, axis=0).any():
            return True
    return False


@draws(
    "parameter_estimates",
    "estimates and true values (Fig. 6 of the paper)",
    unless(_has_changing_estimates, "no estimate changed in this run"),
    in_report=True,
)
def _draw_parameter_estimates(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the estimates of the arms' inertial parameters over time, with the true values.

    Adaptive control laws estimate these parameters while the arm moves. The figure shows the
    estimates of all sites, whereas Fig. 6 of the paper shows only those of master 1. Arms in
    space (chains) have one row of panels per link, or two rows per link in a narrow figure.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    arm = log.scenario.arms[log.sites[0]]
    if arm.chain is not None:
        return _draw_link_estimates(log, form)

    # Each text is a row of panels. A digit is the number of a parameter and its panel.
    mosaic = ["12", "34", "55"] if form.narrow else ["112233", "444555"]
    with style.time_figure(log, form, 4.4 if form.narrow else 3.6) as plot:
        panels = plot.figure.subplot_mosaic([[*row] for row in mosaic])
        for index, (_, unit) in enumerate(arm.parameters):
            axes = panels[str(index + 1)]
            _draw_estimate(plot, log.sites, index, axes)
            symbol = rf"$\theta_{index + 1}$ ({style.typeset_unit(unit)})"
            axes.set_ylabel(symbol if form.narrow else f"estimate of {symbol}")
            plot.mark(axes, log.sites)
        plot.finish(list(panels.values()), _list_estimate_entries(log))
    return plot.figure


def _draw_link_estimates(log: Log, form: FigureSize) -> Figure:
    """Draws the estimates of the inertial parameters of arms in space, over time.

    A link has `LINK_PARAMETERS` parameters, such as its mass, with one panel each. The panels
    of a link fill one row, or two rows of a narrow figure. A panel shows the estimates of all
    sites whose arms have that link.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    arms = log.scenario.arms
    longest_arm = max((arms[site] for site in log.sites), key=lambda arm: arm.counts.joints)
    columns = LINK_PARAMETERS // 2 if form.narrow else LINK_PARAMETERS
    rows = len(longest_arm.theta) // columns  # theta are the parameters of all links
    height_in = 0.8 + 0.74 * rows
    with style.time_figure(log, form, height_in) as plot:
        grid = style.add_panels(plot.figure, rows, columns, sharex=True)
        panels: list[Axes] = [*grid.flat]
        panel_parameters = zip(panels, longest_arm.parameters, strict=True)
        for index, (axes, parameter) in enumerate(panel_parameters):
            name, unit = parameter  # a name such as "upper.m", the mass of the link "upper"
            link, _, symbol = name.rpartition(".")
            sites = [site for site in log.sites if index < len(arms[site].theta)]
            _draw_estimate(plot=plot, sites=sites, index=index, axes=axes, width=0.9)
            plot.mark(axes, log.sites, numbered=False)

            # The panels are small. Therefore titles, ticks and labels are small too.
            title = f"{_typeset_symbol(symbol)} ({style.typeset_unit(unit)})"
            axes.set_title(title, fontsize=_LINK_PANEL_PT, pad=3.5)
            axes.tick_params(labelsize=5.0, length=1.5, pad=1.0)
            axes.locator_params(axis="y", nbins=2)
            style.flatten_rounding(axes)

            is_first_panel_of_link = index % LINK_PARAMETERS == 0
            if is_first_panel_of_link:
                link_number = 1 + index // LINK_PARAMETERS
                _label_row(axes, f"{link_number}: {link}", form)

        bottom_panels = grid[-1]
        plot.finish(list(bottom_panels), _list_estimate_entries(log))
        for axes in bottom_panels:
            axes.set_xlabel("t (s)", fontsize=_LINK_PANEL_PT, labelpad=1.0)
    return plot.figure


def _list_estimate_entries(log: Log) -> list[tuple[str, dict[str, Any]]]:
    """Returns the legend entries for figures of estimates."""
    entries = style.site_legend_entries(log, log.sites)
    return [*entries, ("true value", style.LIMIT_LINE)]


def _draw_estimate(
    plot: style.TimeFigure,
    sites: Sequence[str],
    index: int,
    axes: Axes,
    width: float | None = None,
) -> None:
    """Draws the estimates of one parameter and its true value.

    The true value is drawn only once if it is the same for all sites, otherwise in the colour
    of each site.

    Args:
        plot: The figure.
        sites: Names of the sites that have the parameter.
        index: Index of the parameter.
        axes: Panel of the figure, as Matplotlib axes.
        width: Width of the lines, see `style.site_line`.
    """
    true_values = {}
    for site in sites:
        true_values[site] = float(plot.log.scenario.arms[site].theta[index])
        estimates = site_signals.parameter_estimates(plot.log[site])
        plot.trace(axes, site, estimates[:, index], width)

    all_are_equal = len(set(true_values.values())) == 1
    if all_are_equal:
        axes.axhline(true_values[sites[0]], **style.LIMIT_LINE)
        return

    for site, true_value in true_values.items():
        line = {**style.LIMIT_LINE, "color": style.site_colour(plot.log, site)}
        axes.axhline(true_value, **line)


@draws("phase", "errors against their rates")
def _draw_phase_portrait(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the tracking errors of each joint against their rates of change (phase portrait).

    There is one panel per joint. The horizontal axis shows the error q - q_des, the actual
    minus the desired joint angle, and the vertical axis the velocity error qd - qd_des. A
    stable motion spirals towards the origin. A ring marks the start of a site's motion, and a
    disc its end.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    titles = style.name_shared(log)
    unit = plot_signals.shared_unit(log)
    rate_unit = f"{unit.replace(',', '/s,')}/s"  # "m, rad" becomes "m/s, rad/s"

    # Square panels: the height of a row follows from the width of a column.
    mosaic = style.arrange_joints(len(titles), form.narrow)
    columns = len(mosaic[0])
    row_in = 0.72 * form.width_in / columns
    with style.styled_figure(form, 1.0 + len(mosaic) * row_in) as figure:
        panels = list(figure.subplot_mosaic([[*row] for row in mosaic]).values())
        for site in log.sites:
            records = log[site]
            if not len(records):
                continue

            line_style = style.site_line(log, site, _LOOP_PT)
            errors = site_signals.joint_errors(records)
            rates = _compute_error_rates(records)
            joint_count = errors.shape[1]
            for joint, axes in enumerate(panels[:joint_count]):
                path = np.stack([errors[:, joint], rates[:, joint]], axis=1)
                _draw_path(axes, path, line_style)

        _title_joints(log, panels, titles)
        for axes in panels:
            axes.set_xlabel(f"error ({unit})")
            if form.narrow:
                axes.locator_params(axis="x", nbins=3)

        for axes in panels[::columns]:  # the first panel of each row
            axes.set_ylabel(f"its rate ({rate_unit})")
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


def _compute_error_rates(records: SiteLog) -> Array:
    """Returns the velocity error of an arm: its velocity minus that of its reference.

    Args:
        records: The K records of the arm.

    Returns:
        Velocity errors of the n joints, in rad/s, shape (K, n). If the arms follow each other's
        end effectors, the velocity errors of the m task coordinates, shape (K, m).
    """
    if records.layout.task:
        # in task space the column qd_des holds xd_des
        velocity_error = records.xd - records.qd_des
        followed_axes = np.array(records.axes)
        rates: Array = velocity_error * followed_axes
        return rates
    return records.qd - records.qd_des


def _has_only_chains(log: Log) -> bool:
    """Returns True if no arm of a run is planar."""
    return all(arm.chain for arm in log.scenario.arms.values())


@draws(
    "paths",
    "paths of the end effectors in three planes",
    unless(_has_only_chains, "its arms are planar"),
    in_report=True,
)
def _draw_end_effector_paths(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the end effector paths of arms in space, projected onto three planes, in m.

    All sites share one coordinate frame. If the sites exchange end effector poses (task space),
    each path is scaled to the common task. A ring marks the start of a path, and a disc its
    end.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    mosaic = style.arrange_joints(len(_PLANES), form.narrow)
    row_in = 0.9 * form.width_in / len(mosaic[0])
    with style.styled_figure(form, 0.4 + len(mosaic) * row_in) as figure:
        panels = list(figure.subplot_mosaic([[*row] for row in mosaic]).values())
        for site in log.sites:
            records = log[site]
            if not len(records):
                continue
            arm_rows = build_arm_rows(log.scenario, site)
            end_effector = arm_rows.place_end_effector(records.q, records.qd)
            task_scale = log.scenario.sites[site].task.scale
            positions = end_effector.position * task_scale

            for axes, plane in zip(panels, _PLANES, strict=True):
                _draw_path(axes, positions[:, plane], style.site_line(log, site))

        for axes, (across, upwards) in zip(panels, _PLANES, strict=True):
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[upwards]} (m)")
            axes.locator_params(nbins=4)
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
    return figure


def _draw_path(axes: Axes, path: Array, line: dict[str, Any]) -> None:
    """Draws a path in a plane, with a ring at its start and a disc at its end.

    The path can also be a pair of signals plotted against each other, such as an error and its
    rate.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        path: Points of the path, shape (K, 2), K > 0.
        line: Options of the line.
    """
    path = thin_path(path)
    axes.plot(*path.T, **line)
    disc = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": line["color"]}
    ring = {**disc, "markerfacecolor": "white"}
    axes.plot(*path[0], **ring, zorder=3)
    axes.plot(*path[-1], **disc, zorder=3)


def thin_path(path: Array) -> Array:
    """Returns points at approximately equal distances along a path, including both ends.

    Figures need far fewer points than a log has records. Thinning by path length rather than by
    time keeps as many points in the fast parts of the path as in the slow ones.

    Args:
        path: Points of the path, shape (K, 2), K > 0. Distances along each axis are measured as
            fractions of the extent of the path along that axis.

    Returns:
        A subset of the points, shape (P, 2).
    """
    extent = np.ptp(path, axis=0)
    scaled_path = path / np.where(extent > 0.0, extent, 1.0)
    steps = np.diff(scaled_path, axis=0, prepend=scaled_path[:1])
    length = np.cumsum(np.hypot(*steps.T))

    # The first point of each step of length `_PATH_STEP` remains.
    step_numbers = np.floor(length / _PATH_STEP)
    _, first_in_step = np.unique(step_numbers, return_index=True)
    remaining = np.union1d(first_in_step, [0, len(path) - 1])
    thinned: Array = path[remaining]
    return thinned


def _list_sites_with_changing_dominance(log: Log) -> list[str]:
    """Lists the sites whose dominance factors change during the run, in scenario order.

    Args:
        log: Log of the run.
    """
    changed_sites = {changed.change.dominance for changed in Timeline(log).changes}
    return [site for site in log.sites if site in changed_sites]


@draws(
    "authority",
    "shares that change, and the motion of the arms",
    unless(_list_sites_with_changing_dominance, "the shares of all sites are constant"),
)
def _draw_authority(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws how the authority over the arms changes during a run, and how the arms move.

    The upper panels show the dominance factors, and the lower panels the joint displacements
    from the start, in rad. The figure shows whether the arms move smoothly while authority
    passes from one operator to another.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    changing_sites = _list_sites_with_changing_dominance(log)
    titles = style.name_joints(log)
    row_count = len(changing_sites) + len(titles)
    has_low_rows = len(titles) > 2
    row_in = 0.8 if has_low_rows else 1.05
    with style.time_figure(log, form, 0.8 + row_in * row_count) as plot:
        panels = style.add_panels(plot.figure, row_count, 1, sharex=True)[:, 0]
        share_panels = panels[: len(changing_sites)]
        joint_panels = panels[len(changing_sites) :]
        for site, axes in zip(changing_sites, share_panels, strict=True):
            factors = DominanceHistory.of_log(log, site, log[site].t_s).alpha
            for peer, factor in zip(log.scenario.peers(site), factors.T, strict=True):
                plot.trace(axes, site, factor, **style.site_line(log, peer))
            axes.set(ylim=(-0.05, 1.05), ylabel=f"share in {site} (1)")
            plot.mark(axes, [site])

        for site in log.sites:
            start_angles = np.array(log.scenario.sites[site].q0_rad)
            displacements = site_signals.joint_angles(log[site]) - start_angles
            for axes, values in zip(joint_panels, displacements.T, strict=False):
                plot.trace(axes, site, values)

        for title, axes in zip(titles, joint_panels, strict=True):
            if has_low_rows:
                _label_row(axes, title, form)
            else:
                axes.set_ylabel(f"{title} (rad)")
            plot.mark(axes, log.sites)
        plot.finish([panels[-1]], style.site_legend_entries(log, log.sites))
    return plot.figure


def _list_sites_with_walls(log: Log) -> list[str]:
    """Lists the sites whose arms can touch a wall, in scenario order.

    Args:
        log: Log of the run.
    """
    return [site for site in log.sites if VirtualWall.list_of_site(log.scenario, site)]


@draws(
    "contact",
    "force of the walls, and depth in them",
    unless(_list_sites_with_walls, "no site has a wall in this run"),
)
def _draw_contact(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the force and the depth of the contact between the arms and the virtual walls.

    The panels show the normal force of every wall, in N, and how deep the end effector has
    penetrated the wall, in mm.

    Args:
        log: Log of the run.
        form: Width, font sizes and resolution of the figure.
    """
    sites = _list_sites_with_walls(log)
    with style.time_figure(log, form, 2.9) as plot:
        force_panel, depth_panel = style.add_panels(plot.figure, 2, 1, sharex=True)[:, 0]
        for site in sites:
            records = log[site]
            arm_rows = build_arm_rows(log.scenario, site)
            end_effector = arm_rows.place_end_effector(records.q, records.qd)
            walls = VirtualWall.list_of_site(log.scenario, site)
            for wall_number, wall in enumerate(walls):
                dashes = style.DASHES[wall_number % len(style.DASHES)]
                force_n = wall.find_force(records.t_s, end_effector)
                depth_mm = 1e3 * np.maximum(wall.find_depth(end_effector), 0.0)
                plot.trace(force_panel, site, force_n, 1.1, linestyle=dashes)
                plot.trace(depth_panel, site, depth_mm, 1.1, linestyle=dashes)

        force_panel.set_ylabel("force of wall (N)")
        depth_panel.set_ylabel("depth in it (mm)")
        for axes in (force_panel, depth_panel):
            axes.set_ylim(bottom=0.0)
            plot.mark(axes, sites)
        plot.finish([depth_panel], style.site_legend_entries(log, sites))
    return plot.figure


def _title_joints(log: Log, row: Sequence[Axes], titles: Sequence[str] = ()) -> None:
    """Adds a joint name, or another title, above each panel of a row.

    Args:
        log: Log with the joints.
        row: One panel per title.
        titles: The titles. Empty to use the joint names.
    """
    for title, axes in zip(titles or style.name_joints(log), row, strict=True):
        axes.set_title(title)


def _label_row(axes: Axes, text: str, form: FigureSize) -> None:
    """Adds a label with several lines beside a row of low panels.

    A long label on a single line would not fit beside a low panel.

    Args:
        axes: First panel of the row, beside which the label is written.
        text: The label. It is wrapped after 12 characters.
        form: Size of the figure, which determines the font size.
    """
    lines = textwrap.wrap(text, 12)
    axes.set_ylabel("\n".join(lines), fontsize=form.tick_pt)


def _typeset_symbol(parameter: str) -> str:
    """Returns the Matplotlib symbol of an inertial parameter, with its index as a subscript.

    Adaptive control laws estimate such parameters, for example a mass or an inertia.

    Args:
        parameter: Name of the parameter: a moment of inertia such as "Ixx", a first moment such
            as "mc_x", or the mass.
    """
    if parameter[0] == "I":
        stem = parameter[:1]
        index = parameter[1:]
    else:
        stem = parameter[:2]
        index = parameter[3:]  # behind the underscore
    return f"${stem.strip()}_{{{index}}}$" if index else f"${stem}$"
