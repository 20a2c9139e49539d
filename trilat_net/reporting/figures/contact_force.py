"""Figure of contact: the force of every wall, and the depth of the end effector in it.

Invariant: wall forces follow from the scenario's walls at the logged states; `analysis.torque_sources` has
the equations.
"""

import numpy as np
from matplotlib.figure import Figure

from ...analysis.arm_rows import compute_end_effector
from ...analysis.torque_sources import wall_depth, wall_force
from ...core.exogenous import TorqueKind
from ...log.log_reader import Log
from .. import style
from ..event_markers import EventMarkers
from ..figure_size import REPORT_SIZE, FigureSize

NO_SITE_WITH_WALL = "no site has a wall in this run"


def sites_with_walls(log: Log) -> list[str]:
    """Returns the sites that have a wall in their way, in scenario order."""
    sites = log.scenario.sites
    return [
        name
        for name in log.sites
        if any(one.actor.acts is TorqueKind.WALL for one in sites[name].environment)
    ]


def draw_contact(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the force along the normal of every wall over time, N, above the depth of the tip in it, mm."""
    sites = sites_with_walls(log)
    if not sites:
        return style.empty_figure(NO_SITE_WITH_WALL, form)
    marks = EventMarkers(log, form)
    with style.figure_style(form):
        figure = style.new_figure(2.9, form.width_in)
        column = style.add_panels(figure, 2, 1, sharex=True)[:, 0]
        for site in sites:
            part, spec = log[site], log.scenario.sites[site]
            tip = compute_end_effector(
                (spec.arm.l1_m, spec.arm.l2_m), part.q.reshape(-1, 2), part.qd.reshape(-1, 2)
            )
            walls = [one.actor for one in spec.environment if one.actor.acts is TorqueKind.WALL]
            for wall, dashes in zip(walls, [*style.DASHES] * len(walls), strict=False):
                line = {**style.site_line(log, site, 1.1), "linestyle": dashes}
                depth_mm = 1e3 * np.maximum(wall_depth(wall, tip), 0.0)
                style.plot_decimated(column[0], part.tick, part.t_s, wall_force(wall, part.t_s, tip), **line)
                style.plot_decimated(column[1], part.tick, part.t_s, depth_mm, **line)
        column[0].set_ylabel("force of wall (N)")
        column[1].set_ylabel("depth in it (mm)")
        for axes in column:
            axes.set_ylim(bottom=0.0)
            marks.draw(axes, sites)
        style.set_time_axis(log, [column[-1]])
        style.add_legend(figure, style.site_legend_entries(log, sites))
        marks.explain(figure)
    return figure
