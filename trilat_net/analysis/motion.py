"""Figures of what the arms did: pushes, positions, errors, estimates, and what the pushes left behind.

Law: figures speak of the torque ON the arm, which is the negative of the record's tau_x.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.arm import JOINTS, PARAMETERS
from ..log.reader import Log
from . import quantities, style
from .form import REPORT, Form
from .marks import Marks

THETA_UNITS = ("kg m²", "kg m²", "kg m²", "kg m", "kg m")
"""Of the five parameters of Eq. (24)."""

NO_HANDS = "nobody at the arms: no site has hands in this run"
NO_TWIN = "no run without hands to compare with"


def operator_torques(log: Log, form: Form = REPORT) -> Figure:
    """Returns the torques of the operators' hands ON the arms over time, N m; Fig. 3 of the paper."""
    sites = quantities.sites_with_hands(log)
    if not sites:
        return style.says(NO_HANDS, form)
    marks = Marks(log, form)
    with style.paper(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            for site in sites:
                part = log[site]
                torque = quantities.hand_torques(part)[:, joint]
                style.draw(axes, part.tick, part.t_s, torque, **style.line(log, site))
            marks.draw(axes, sites)
        row[0].set_ylabel("torque on the arm (N m)")
        style.time_axis(log, row)
        style.legend(figure, style.site_entries(log, sites))
        marks.explain(figure)
    return figure


def positions(log: Log, form: Form = REPORT) -> Figure:
    """Returns desired and actual joint angles of every site over time, rad; Fig. 4 of the paper."""
    marks = Marks(log, form)
    says = "{}: q (rad)" if form.narrow else "angle of {} (rad)"
    with style.paper(form):
        figure = style.new_figure(0.7 + (0.95 if form.narrow else 1.25) * len(log.sites), form.width_in)
        grid = style.panels(figure, len(log.sites), JOINTS, sharex=True, sharey="col")
        for site, row in zip(log.sites, grid, strict=True):
            part = log[site]
            actual, desired = quantities.angles(part), quantities.references(part)
            for joint, axes in enumerate(row):
                style.draw(axes, part.tick, part.t_s, actual[:, joint], **style.line(log, site, 1.6))
                style.draw(axes, part.tick, part.t_s, desired[:, joint], **style.LIMIT)
                marks.draw(axes, [site])
                _note_absence(log, site, axes)
            row[0].set_ylabel(says.format(site))
        _joint_titles(grid[0])
        style.time_axis(log, grid[-1])
        actual_entries = [(f"{style.title(log, s)}, actual", style.line(log, s, 1.6)) for s in log.sites]
        style.legend(figure, [*actual_entries, ("desired", style.LIMIT)])
        marks.explain(figure)
    return figure


def tracking_errors(log: Log, form: Form = REPORT) -> Figure:
    """Returns e = q - q_des of every site over time, rad, Fig. 5 of the paper, and how it settles.

    The lowest panel shows, at every time, the largest error of any joint that is still to come: where it
    crosses the dashed line, the site has settled.
    """
    marks = Marks(log, form)
    with style.paper(form):
        figure = style.new_figure(3.6, form.width_in)
        panels = figure.subplot_mosaic([["1", "2"], ["all", "all"]])
        row, settling = [panels["1"], panels["2"]], panels["all"]
        row[1].sharey(row[0])
        row[1].tick_params(labelleft=False)
        for site in log.sites:
            part, e = log[site], quantities.errors(log[site])
            for joint, axes in enumerate(row):
                style.draw(axes, part.tick, part.t_s, e[:, joint], **style.line(log, site))
        _joint_titles(row)
        row[0].set_ylabel("tracking error (rad)")
        _settling(log, settling)
        for axes in (*row, settling):
            marks.draw(axes, log.sites)
        style.time_axis(log, [*row, settling])
        limit = (f"settled: {quantities.SETTLED_RAD:g} rad", style.LIMIT)
        style.legend(figure, [*style.site_entries(log, log.sites), limit])
        marks.explain(figure)
    return figure


def parameter_estimates(log: Log, sites: Sequence[str] | None = None, form: Form = REPORT) -> Figure:
    """Returns the estimates of the five parameters over time with the true values; Fig. 6 of the paper.

    Args:
        log: the log.
        sites: whose estimates; None for all. The paper shows master 1.
        form: what it is drawn for.
    """
    chosen = log.sites if sites is None else tuple(sites)
    marks = Marks(log, form)
    rows = ["12", "34", "55"] if form.narrow else ["112233", "444555"]
    with style.paper(form):
        figure = style.new_figure(4.4 if form.narrow else 3.6, form.width_in)
        panels = figure.subplot_mosaic([[*row] for row in rows])
        for index in range(PARAMETERS):
            _estimate(log, chosen, index, panels[str(index + 1)], form)
            marks.draw(panels[str(index + 1)], chosen)
        style.time_axis(log, list(panels.values()))
        style.legend(figure, [*style.site_entries(log, chosen), ("true value", style.LIMIT)])
        marks.explain(figure)
    return figure


def hands_moved(log: Log, twin: Log | None, form: Form = REPORT) -> Figure:
    """Returns how far the hands moved every site over time, rad: the log minus a run without hands.

    Args:
        log: the log.
        twin: the same experiment with nobody at the arms, or None.
        form: what it is drawn for.
    """
    if twin is None:
        return style.says(NO_TWIN if quantities.sites_with_hands(log) else NO_HANDS, form)
    marks = Marks(log, form)
    with style.paper(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for site in log.sites:
            tick, t_s, moved = quantities.moved_by_hands(log, twin, site)
            for joint, axes in enumerate(row):
                style.draw(axes, tick, t_s, moved[:, joint], **style.line(log, site))
        for axes in row:
            marks.draw(axes, log.sites)
        _joint_titles(row)
        row[0].set_ylabel("moved by hands (rad)")
        style.time_axis(log, row)
        style.legend(figure, style.site_entries(log, log.sites))
        marks.explain(figure)
    return figure


def _settling(log: Log, axes: Axes) -> None:
    """Draws the largest error still to come of every site, on a logarithmic axis that holds the limit."""
    low = high = quantities.SETTLED_RAD
    for site in log.sites:
        part, remaining = log[site], quantities.remaining_error(log[site])
        positive = np.where(remaining > 0.0, remaining, np.nan)
        style.draw(axes, part.tick, part.t_s, positive, **style.line(log, site))
        low, high = np.nanmin(positive, initial=low), np.nanmax(positive, initial=high)
    axes.axhline(quantities.SETTLED_RAD, **style.LIMIT)
    axes.set(yscale="log", ylim=(0.5 * low, 2.0 * high), ylabel="largest error\nstill to come (rad)")


def _estimate(log: Log, sites: Sequence[str], index: int, axes: Axes, form: Form) -> None:
    """Draws the estimates of one parameter, and its true value once where all sites have the same."""
    truths = {site: float(quantities.true_parameters(log, site)[index]) for site in sites}
    for site in sites:
        part = log[site]
        style.draw(axes, part.tick, part.t_s, quantities.estimates(part)[:, index], **style.line(log, site))
    if len(set(truths.values())) == 1:
        axes.axhline(truths[sites[0]], **style.LIMIT)
    else:
        for site, truth in truths.items():
            axes.axhline(truth, **{**style.LIMIT, "color": style.colour(log, site)})
    words = "" if form.narrow else "estimate of "
    axes.set_ylabel(rf"{words}$\theta_{index + 1}$ ({THETA_UNITS[index]})")


def _joint_titles(row: Sequence[Axes]) -> None:
    for joint, axes in enumerate(row):
        axes.set_title(f"joint {joint + 1}")


def _note_absence(log: Log, site: str, axes: Axes) -> None:
    if not len(log[site]):
        style.note(axes, f"no records of {site}")
