"""Figure of contact: the force of every wall, and the depth of the end effector in it.

Invariant: wall forces follow from the scenario's walls at the logged states; `analysis.torque_sources` has
the equations.
"""

import numpy as np
from matplotlib.figure import Figure

from ...analysis.arm_rows import build_arm_rows
from ...analysis.torque_sources import list_walls, wall_depth, wall_force
from ...log.log_reader import Log
from .. import style
from ..figure_size import REPORT_SIZE, FigureSize
from .time_figure import time_figure


def sites_with_walls(log: Log) -> list[str]:
    """Returns the sites that have a wall in their way, in scenario order."""
    return [site for site in log.sites if list_walls(log.scenario.sites[site])]


def draw_contact(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the normal force of every wall over time, N, above the depth of the end effector in it, mm."""
    sites = sites_with_walls(log)
    with time_figure(log, form, 2.9) as plot:
        column = style.add_panels(plot.figure, 2, 1, sharex=True)[:, 0]
        for site in sites:
            part, spec = log[site], log.scenario.sites[site]
            end_effector = build_arm_rows(log.scenario, site).place_end_effector(part.q, part.qd)
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
