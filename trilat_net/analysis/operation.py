"""Figures of an operation: what the hands did and where the arms went, and what the controllers did.

Law: figures speak of the torque ON the arm, which is the negative of the record's tau_x.
"""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.arm import JOINTS, Array
from ..log.reader import Log
from . import quantities, style
from .form import REPORT, Form
from .marks import Marks
from .motion import NO_HANDS

_WORDS = ("torque on the arm (N m)", "joint angle (rad)")
_SHORT = ("torque (N m)", "angle (rad)")


def operation(log: Log, form: Form = REPORT) -> Figure:
    """Returns the torques ON the arms, N m, above the angles of all arms, rad: a column per joint."""
    pushed = quantities.sites_with_hands(log)
    if not pushed:
        return style.says(NO_HANDS, form)
    marks = Marks(log, form)
    says = _SHORT if form.narrow else _WORDS
    with style.paper(form):
        figure = style.new_figure(2.9 if form.narrow else 3.4, form.width_in)
        grid = style.panels(figure, 2, JOINTS, sharex=True)
        grid[0, 1].sharey(grid[0, 0])
        grid[0, 1].tick_params(labelleft=False)
        for joint, (above, below) in enumerate(grid.T):
            above.set_title(f"joint {joint + 1}")
            for site in pushed:
                _trace(log, site, above, quantities.hand_torques(log[site])[:, joint])
            for site in log.sites:
                _trace(log, site, below, quantities.angles(log[site])[:, joint])
            marks.draw(above, pushed)
            marks.draw(below, log.sites)
        for axes, text in zip(grid[:, 0], says, strict=True):
            axes.set_ylabel(text)
        style.time_axis(log, grid[1])
        style.legend(figure, style.site_entries(log, log.sites))
        marks.explain(figure)
    return figure


def control_torques(log: Log, form: Form = REPORT) -> Figure:
    """Returns tau of Eq. (13) of every site over time, N m, with the limit where a site reached it."""
    marks = Marks(log, form)
    reached = set()
    with style.paper(form):
        figure = style.new_figure(2.2, form.width_in)
        row = style.panels(figure, 1, JOINTS, sharex=True, sharey=True)[0]
        for site in log.sites:
            tau, limit = quantities.control_torques(log[site]), log.scenario.sites[site].limits.tau_limit_nm
            if len(tau) and abs(tau).max() >= limit:
                reached.add(limit)
            for joint, axes in enumerate(row):
                _trace(log, site, axes, tau[:, joint])
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            marks.draw(axes, log.sites)
            for limit in sorted(reached):
                axes.axhline(limit, **style.LIMIT)
                axes.axhline(-limit, **style.LIMIT)
        row[0].set_ylabel("control torque (N m)")
        style.time_axis(log, row)
        limits = [("limit", style.LIMIT)] if reached else []
        style.legend(figure, [*style.site_entries(log, log.sites), *limits])
        marks.explain(figure)
    return figure


def _trace(log: Log, site: str, axes: Axes, values: Array) -> None:
    style.draw(axes, log[site].tick, log[site].t_s, values, **style.line(log, site))
