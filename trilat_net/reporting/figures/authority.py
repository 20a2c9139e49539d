"""Figure of changing authority: dominance factors over time, and the motion of the arms.

Invariant: dominance factors follow from the scenario and the changes in the records, Eq. (6) and (7).
"""

import numpy as np
from matplotlib.figure import Figure

from ...analysis import site_signals
from ...analysis.timeline import list_changes
from ...core.two_link_arm import JOINTS
from ...core.vectors import Array
from ...log.log_reader import Log
from .. import style
from ..event_markers import EventMarkers
from ..figure_size import REPORT_SIZE, FigureSize

CONSTANT_DOMINANCE = "the shares of all sites are constant"


def sites_with_changing_dominance(log: Log) -> list[str]:
    """Returns the sites whose shares change during the run, in scenario order."""
    found = {changed.change.dominance for changed in list_changes(log)}
    return [site for site in log.sites if site in found]


def dominance_lines(log: Log, site: str) -> tuple[Array, dict[str, Array]]:
    """Returns the shares of a site's peers over the run, as lines between points.

    Returns:
        t_s: times, shape (P,), s.
        shares: per peer, shape (P,), dimensionless.
    """
    peers = log.scenario.peers(site)
    now = np.array([log.scenario.dominance[site].get(peer, 0.0) for peer in peers])
    times, values = [0.0], [now]
    for one in (changed.change for changed in list_changes(log) if changed.change.dominance == site):
        at_s, end_s = one.at_s, one.at_s + one.ramp_s
        kept = [n for n, t_s in enumerate(times) if t_s <= at_s]
        if len(kept) < len(times):  # one that is not over yet ends where the next one begins
            (t0, t1), (v0, v1) = times[kept[-1] : kept[-1] + 2], values[kept[-1] : kept[-1] + 2]
            now = v0 + (v1 - v0) * (at_s - t0) / (t1 - t0)
            times, values = times[: len(kept)], values[: len(kept)]
        after = np.array([one.shares.get(peer, 0.0) for peer in peers])
        times += [at_s, end_s]
        values += [now, after]
        now = after
    times.append(max(style.time_axis_end_s(log), times[-1]))
    values.append(now)
    return np.array(times), dict(zip(peers, np.array(values).T, strict=True))


def draw_authority(log: Log, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the shares that change, and how far every arm is from where it started, rad."""
    owners = sites_with_changing_dominance(log)
    if not owners:
        return style.empty_figure(CONSTANT_DOMINANCE, form)
    marks = EventMarkers(log, form)
    with style.figure_style(form):
        rows = len(owners) + JOINTS
        figure = style.new_figure(0.8 + 1.05 * rows, form.width_in)
        column = style.add_panels(figure, rows, 1, sharex=True)[:, 0]
        for site, axes in zip(owners, column, strict=False):
            t_s, lines = dominance_lines(log, site)
            for peer, values in lines.items():
                axes.plot(t_s, values, **style.site_line(log, peer))
            axes.set(ylim=(-0.05, 1.05), ylabel=f"share in {site} (1)")
            marks.draw(axes, [site])
        for joint, axes in enumerate(column[len(owners) :]):
            for site in log.sites:
                part, q0 = log[site], log.scenario.sites[site].q0_rad[joint]
                moved = site_signals.joint_angles(part)[:, joint] - q0
                style.plot_decimated(axes, part.tick, part.t_s, moved, **style.site_line(log, site))
            axes.set_ylabel(f"joint {joint + 1} (rad)")
            marks.draw(axes, log.sites)
        style.set_time_axis(log, [column[-1]])
        style.add_legend(figure, style.site_legend_entries(log, log.sites))
        marks.explain(figure)
    return figure
