"""The figure of contact: the force of the walls, and how deep the tips were in them.

Law: a wall is as its scenario says, at the logged states; `analysis.actors` has its equations.
"""

import numpy as np
from matplotlib.figure import Figure

from ..analysis import style
from ..analysis.actors import tip_of, wall_depth, wall_force
from ..analysis.form import REPORT, Form
from ..analysis.marks import Marks
from ..core.exogenous import Acts
from ..log.reader import Log

NO_WALLS = "no site has a wall in this run"


def sites_with_walls(log: Log) -> list[str]:
    """Returns the sites that have a wall in their way, in scenario order."""
    sites = log.scenario.sites
    return [name for name in log.sites if any(one.actor.acts is Acts.WALL for one in sites[name].environment)]


def contact(log: Log, form: Form = REPORT) -> Figure:
    """Returns the force along the normal of every wall over time, N, above the depth of the tip in it, mm."""
    sites = sites_with_walls(log)
    if not sites:
        return style.says(NO_WALLS, form)
    marks = Marks(log, form)
    with style.paper(form):
        figure = style.new_figure(2.9, form.width_in)
        column = style.panels(figure, 2, 1, sharex=True)[:, 0]
        for site in sites:
            part, spec = log[site], log.scenario.sites[site]
            tip = tip_of((spec.arm.l1_m, spec.arm.l2_m), part.q.reshape(-1, 2), part.qd.reshape(-1, 2))
            walls = [one.actor for one in spec.environment if one.actor.acts is Acts.WALL]
            for wall, dashes in zip(walls, [*style.DASHES] * len(walls), strict=False):
                line = {**style.line(log, site, 1.1), "linestyle": dashes}
                depth_mm = 1e3 * np.maximum(wall_depth(wall, tip), 0.0)
                style.draw(column[0], part.tick, part.t_s, wall_force(wall, part.t_s, tip), **line)
                style.draw(column[1], part.tick, part.t_s, depth_mm, **line)
        column[0].set_ylabel("force of wall (N)")
        column[1].set_ylabel("depth in it (mm)")
        for axes in column:
            axes.set_ylim(bottom=0.0)
            marks.draw(axes, sites)
        style.time_axis(log, [column[-1]])
        style.legend(figure, style.site_entries(log, sites))
        marks.explain(figure)
    return figure
