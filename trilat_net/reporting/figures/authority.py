"""Figure of changing authority: dominance factors over time, and the motion of the arms.

Invariant: dominance factors follow from the scenario and the changes in the records, Eq. (6) and (7).
"""

import numpy as np
from matplotlib.figure import Figure

from ...analysis.dominance_history import trace_dominance
from ...analysis.site_signals import joint_angles
from ...analysis.timeline import list_changes
from ...log.log_reader import Log
from .. import style
from ..figure_size import REPORT_SIZE, FigureSize
from .time_figure import time_figure


def sites_with_changing_dominance(log: Log) -> list[str]:
    """Returns the sites whose shares change during the run, in scenario order."""
    changing = {changed.change.dominance for changed in list_changes(log)}
    return [site for site in log.sites if site in changing]


def draw_authority(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the shares that change, and how far every arm is from where it started, rad."""
    owners = sites_with_changing_dominance(log)
    titles = style.name_joints(log)
    rows = len(owners) + len(titles)
    low = len(titles) > 2
    with time_figure(log, form, 0.8 + (0.8 if low else 1.05) * rows) as plot:
        column = style.add_panels(plot.figure, rows, 1, sharex=True)[:, 0]
        for site, axes in zip(owners, column, strict=False):
            part, peers = log[site], log.scenario.peers(site)
            alpha = trace_dominance(log, site, part.t_s).alpha
            for peer, share in zip(peers, alpha.T, strict=True):
                plot.trace(axes, site, share, **style.site_line(log, peer))
            axes.set(ylim=(-0.05, 1.05), ylabel=f"share in {site} (1)")
            plot.mark(axes, [site])
        for site in log.sites:
            moved = joint_angles(log[site]) - np.array(log.scenario.sites[site].q0_rad)
            for axes, values in zip(column[len(owners) :], moved.T, strict=False):
                plot.trace(axes, site, values)
        for title, axes in zip(titles, column[len(owners) :], strict=True):
            style.label_row(axes, title, form) if low else axes.set_ylabel(f"{title} (rad)")
            plot.mark(axes, log.sites)
        plot.finish([column[-1]], style.site_legend_entries(log, log.sites))
    return plot.figure
