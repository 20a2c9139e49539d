"""Figures of the links: the age of the samples in use, and the delay that was stated.

Law: what is not stated is not drawn: a measured link has no line, constant links have no distribution.
"""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from ..core.arm import Array
from ..log.reader import Log
from . import quantities, style
from .arrivals import arrivals, sent
from .fates import fates
from .form import REPORT, Form
from .happenings import Stated, changes, end_s, stated
from .link_use import ages_ns, all_constant
from .marks import Marks

NO_JITTER = "every link is said to give one constant delay: nothing is distributed"
_POINTS = 400
_TALL = 6.0


class Distribution(NamedTuple):
    """What a link gave, and what its controller saw.

    Attributes:
        peer: who sends.
        site: who receives.
        delay_ms: delays of the samples: what the model gave them, or else what was measured, ms.
        age_ms: ages of the sample in use at the receiver's ticks, ms.
    """

    peer: str
    site: str
    delay_ms: Array
    age_ms: Array


def sample_age(log: Log, form: Form = REPORT) -> Figure:
    """Returns the age of the sample in use on every link over time, ms: a row per receiver."""
    marks, changed = Marks(log, form), changes(log)
    lines = {link: stated_line(log, stated(log, link, changed)) for link in log.scenario.links}
    with style.paper(form):
        figure = style.new_figure(0.6 + 1.05 * len(log.sites), form.width_in)
        grid = style.panels(figure, len(log.sites), len(log.sites) - 1, sharex=True, sharey=True)
        drawn: list[Array] = []
        for site, row in zip(log.sites, grid, strict=True):
            part = log[site]
            for peer, age_ms, axes in zip(part.peers, quantities.ages_ms(log, site).T, row, strict=True):
                line = lines[f"{peer}->{site}"]
                marks.draw(axes, [site], f"{peer}->{site}")
                style.draw(axes, part.tick, part.t_s, age_ms, **style.line(log, peer, 1.4))
                axes.plot(*line, **style.LIMIT)
                axes.set_title(f"{peer} → {site}", loc="left", pad=2.0)
                if not np.any(np.isfinite(age_ms)):
                    style.note(axes, "no sample in use")
                drawn += [age_ms, line[1]]
        for axes in grid[:, 0]:
            axes.set_ylabel("age (ms)")
        _age_axis(grid[0, 0], np.concatenate(drawn))
        style.time_axis(log, grid[-1])
        known = any(np.any(np.isfinite(values)) for _, values in lines.values())
        style.legend(figure, [*_senders(log), *([("mean delay as stated", style.LIMIT)] if known else [])])
        marks.explain(figure, links=True)
    return figure


def delay_distributions(log: Log, form: Form = REPORT) -> Figure:
    """Returns the distributions of delay and age on every link: a row per receiver.

    A curve says how many samples, or ticks, have no more than so much, %.
    """
    if not varied(log):
        return style.says(NO_JITTER, form)
    found = {(d.peer, d.site): d for d in distributions(log)}
    with style.paper(form):
        figure = style.new_figure(0.6 + 1.05 * len(log.sites), form.width_in)
        grid = style.panels(figure, len(log.sites), len(log.sites) - 1, sharex=True, sharey=True)
        x_ms = delay_axis(list(found.values()))
        for site, row in zip(log.sites, grid, strict=True):
            for peer, axes in zip(log[site].peers, row, strict=True):
                link = found[peer, site]
                axes.plot(x_ms, percent_up_to(link.age_ms, x_ms), **style.line(log, peer, 1.8))
                axes.plot(x_ms, percent_up_to(link.delay_ms, x_ms), **style.LIMIT)
                axes.set_title(f"{peer} → {site}", loc="left", pad=2.0)
        for axes in grid[:, 0]:
            axes.set_ylabel("cumulative (%)")
        for axes in grid[-1]:
            axes.set_xlabel("delay or age (ms)")
        grid[0, 0].set(ylim=(0.0, 104.0), xlim=(0.0, x_ms[-1]))
        entries = [(f"age, {text}", options) for text, options in _senders(log)]
        style.legend(figure, [*entries, ("delay of the samples", style.LIMIT)])
    return figure


def varied(log: Log) -> bool:
    """True where some link was said to do more than give one constant delay."""
    changed = changes(log)
    return not all(all_constant(stated(log, link, changed)) for link in log.scenario.links)


def distributions(log: Log) -> list[Distribution]:
    """Returns delays and ages of every link, by receiver and then by peer."""
    found = []
    for site in log.sites:
        for peer, came in arrivals(log, site).items():
            count = sent(log, peer, int(came.sample.max(initial=-1)))
            delay_ms = fates(log, peer, site, count).drawn_ms
            if not len(delay_ms) and log.driver == "live":
                delay_ms = came.delay_us / 1e3
            found.append(Distribution(peer, site, delay_ms, ages_ns(log, peer, site) / 1e6))
    return found


def delay_axis(found: list[Distribution]) -> Array:
    """Returns the delays at which distributions are drawn, ms: what an outage leads to lies beyond."""
    ends = [np.percentile(d.delay_ms, 99.5) for d in found if len(d.delay_ms)]
    ends += [np.percentile(d.age_ms, 90.0) for d in found if len(d.age_ms)]
    return np.linspace(0.0, 1.15 * max([*ends, 1.0]), _POINTS)


def percent_up_to(values: Array, limits: Array) -> Array:
    """Returns how many of some values are at most as large as each limit, %; NaN where there are none."""
    if not len(values):
        return np.full(len(limits), np.nan)
    percent: Array = 100.0 * np.searchsorted(np.sort(values), limits, side="right") / len(values)
    return percent


def stated_line(log: Log, states: list[Stated]) -> tuple[Array, Array]:
    """Returns the stated mean delay over time as a line: times, s, and delays, ms; NaN between states."""
    starts = [state.from_s for state in states]
    ends = [*starts[1:], max(end_s(log), starts[-1])]
    times = [t for start, end in zip(starts, ends, strict=True) for t in (start, end, end)]
    means = [mean for state in states for mean in (*(state.link.moments().mean_ms,) * 2, np.nan)]
    return np.array(times), np.array(means)


def is_tall(ages_ms: Array) -> bool:
    """True where a few ages, as after an outage, would press all others into a line at the bottom."""
    known = ages_ms[np.isfinite(ages_ms)]
    return len(known) > 0 and bool(known.max() > _TALL * np.percentile(known, 95.0))


def _age_axis(axes: Axes, values: Array) -> None:
    """Gives panels their axis of ages."""
    known = values[np.isfinite(values)]
    if is_tall(known):
        axes.set(yscale="log", ylim=(0.7 * float(known[known > 0.0].min()), 2.0 * float(known.max())))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    else:
        axes.set_ylim(0.0, 1.25 * max(float(known.max(initial=0.0)), 1.0))


def _senders(log: Log) -> list[tuple[str, dict[str, Any]]]:
    return [(f"from {style.title(log, site)}", style.line(log, site, 1.8)) for site in log.sites]
