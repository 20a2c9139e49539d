"""The figure of authority that passes on: shares over time, and where the arms went with them.

Law: shares are what the scenario and the commands in the records make of them, Eq. (6) and (7).
"""

import numpy as np
from matplotlib.figure import Figure

from ..core.arm import JOINTS, Array
from ..log.reader import Log
from . import quantities, style
from .form import REPORT, Form
from .happenings import changes
from .marks import Marks

CONSTANT = "the shares of all sites are constant"


def changing(log: Log) -> list[str]:
    """Returns the sites whose shares change during the run, in scenario order."""
    found = {changed.change.dominance for changed in changes(log)}
    return [site for site in log.sites if site in found]


def shares(log: Log, site: str) -> tuple[Array, dict[str, Array]]:
    """Returns the shares of a site's peers over the run, as lines between points.

    Returns:
        t_s: times, shape (P,), s.
        shares: per peer, shape (P,), dimensionless.
    """
    peers = log.scenario.peers(site)
    now = np.array([log.scenario.dominance[site].get(peer, 0.0) for peer in peers])
    times, values = [0.0], [now]
    for one in (changed.change for changed in changes(log) if changed.change.dominance == site):
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
    times.append(max(style.span_s(log), times[-1]))
    values.append(now)
    return np.array(times), dict(zip(peers, np.array(values).T, strict=True))


def authority(log: Log, form: Form = REPORT) -> Figure:
    """Returns the shares that change, and how far every arm is from where it started, rad."""
    owners = changing(log)
    if not owners:
        return style.says(CONSTANT, form)
    marks = Marks(log, form)
    with style.paper(form):
        rows = len(owners) + JOINTS
        figure = style.new_figure(0.8 + 1.05 * rows, form.width_in)
        column = style.panels(figure, rows, 1, sharex=True)[:, 0]
        for site, axes in zip(owners, column, strict=False):
            t_s, lines = shares(log, site)
            for peer, values in lines.items():
                axes.plot(t_s, values, **style.line(log, peer))
            axes.set(ylim=(-0.05, 1.05), ylabel=f"share in {site} (1)")
            marks.draw(axes, [site])
        for joint, axes in enumerate(column[len(owners) :]):
            for site in log.sites:
                part, q0 = log[site], log.scenario.sites[site].q0_rad[joint]
                moved = quantities.angles(part)[:, joint] - q0
                style.draw(axes, part.tick, part.t_s, moved, **style.line(log, site))
            axes.set_ylabel(f"joint {joint + 1} (rad)")
            marks.draw(axes, log.sites)
        style.time_axis(log, [column[-1]])
        style.legend(figure, style.site_entries(log, log.sites))
        marks.explain(figure)
    return figure
