"""Figures of how errors go away, or do not: their size over time, and their phase portrait.

Law: a site has settled when `quantities.settle_s` says so; the figure marks that time and no other.
"""

import numpy as np
from matplotlib.figure import Figure

from ..core.arm import JOINTS, Array
from ..log.reader import Log
from . import quantities, style
from .form import REPORT, Form
from .marks import Marks

_LEAST_RAD = 1e-3 * quantities.SETTLED_RAD
"""As far down as an axis goes, rad."""
_LOOP_PT = 0.8
"""Width of a line that crosses itself."""
_STEP = 0.01
"""Of its extent, between two points of a path."""


def settling(log: Log, form: Form = REPORT) -> Figure:
    """Returns the largest error of any joint of every site over time, rad, on a logarithmic axis.

    A triangle stands where a site settles, with its time in the legend.
    """
    marks, limit = Marks(log, form), quantities.SETTLED_RAD
    entries = []
    with style.paper(form):
        figure = style.new_figure(2.4, form.width_in)
        axes = style.panels(figure, 1, 1)[0, 0]
        low = high = limit
        for site in log.sites:
            part, line = log[site], style.line(log, site)
            size = np.abs(quantities.errors(part)).max(axis=1, initial=0.0)
            positive = np.where(size > 0.0, size, np.nan)
            style.draw(axes, part.tick, part.t_s, positive, **line)
            if size.any():
                least, most = np.nanpercentile(positive, (2.0, 100.0)).tolist()
                low, high = min(low, least), max(high, most)
            settled = quantities.settle_s(part)
            if settled is not None:
                axes.plot(settled, limit, marker="v", markersize=6.0, color=line["color"], clip_on=False)
            when = "not settled" if settled is None else f"settled at {settled:.1f} s"
            entries.append((f"{site}: {when}", line))
        axes.axhline(limit, **style.LIMIT)
        axes.set(yscale="log", ylim=(max(0.5 * low, _LEAST_RAD), 2.0 * high), ylabel="largest error (rad)")
        marks.draw(axes, log.sites)
        style.time_axis(log, [axes])
        style.legend(figure, [*entries, (f"limit {limit:g} rad", style.LIMIT)])
        marks.explain(figure)
    return figure


def phase(log: Log, form: Form = REPORT) -> Figure:
    """Returns the phase portrait of the errors: e over the run against qd - qd_des, a panel per joint.

    A ring is where a site begins, a disc where it ends.
    """
    with style.paper(form):
        figure = style.new_figure(1.0 + 0.36 * form.width_in, form.width_in)
        row = style.panels(figure, 1, JOINTS)[0]
        for site in log.sites:
            part, line = log[site], style.line(log, site, _LOOP_PT)
            e, ed = quantities.errors(part), quantities.error_rates(part)
            for joint, axes in enumerate(row if len(part) else ()):
                path = walked(np.stack([e[:, joint], ed[:, joint]], axis=1))
                axes.plot(*path.T, **line)
                ends = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": line["color"]}
                axes.plot(*path[0], **{**ends, "markerfacecolor": "white"}, zorder=3)
                axes.plot(*path[-1], **ends, zorder=3)
        for joint, axes in enumerate(row):
            axes.set_title(f"joint {joint + 1}")
            axes.set_xlabel("error (rad)")
            if form.narrow:
                axes.locator_params(axis="x", nbins=3)
        row[0].set_ylabel("its rate (rad/s)")
        style.legend(figure, style.site_entries(log, log.sites))
    return figure


def walked(path: Array) -> Array:
    """Returns the points of a path at about equal distances along it, ends included, shape (P, 2).

    A path in a plane is thinned by its length and not by time: what is fast has no fewer points.

    Args:
        path: shape (K, 2), K > 0, of finite numbers.
    """
    extent = np.ptp(path, axis=0)
    scaled = path / np.where(extent > 0.0, extent, 1.0)
    length = np.cumsum(np.hypot(*np.diff(scaled, axis=0, prepend=scaled[:1]).T))
    _, first = np.unique(np.floor(length / _STEP), return_index=True)
    kept: Array = path[np.union1d(first, [0, len(path) - 1])]
    return kept
