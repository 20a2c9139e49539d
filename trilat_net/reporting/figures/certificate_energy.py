"""Figures of the certificate's energies.

V and its parts, dissipation and work, and the residual of the balance; the energies that laws
declare.

Invariant: energies in J over the time of the whole run; spans without complete records are
shaded, the largest rise is marked.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis.certificate.energy_balance import EnergyBalance
from ...analysis.certificate.observed_energy import ObservedEnergy, observe_energies
from ...analysis.certificate.premises import explain_no_functional, find_unjudged_spans
from ...analysis.certificate.stability_certificate import Certificate, certify
from ...core.vectors import Array
from ...log.log_reader import Log
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from .figure_entry import draws, unless

_PARTS = {
    "kinetic": "r'Mr / 2",
    "parameter": "parameter error",
    "position": "e'ΛKd e / 2",
    "delay": "under way",
}
_TAKEN = {"damping": "taken: r'Kp r", "disagreement": "taken: disagreement"}
_COLOURS = ("#117733", "#aa4499", "#999933", "#882255", "#44aa99", "#661100")
_TOTAL: dict[str, Any] = {"color": style.REFERENCE, "linewidth": 1.6}
_ONES: dict[str, Any] = {"color": style.REFERENCE, "linewidth": 0.9, "linestyle": (0, (4, 2))}
_RISE: dict[str, Any] = {"color": "#cc3311", "alpha": 0.25, "linewidth": 0.0, "zorder": 0.4}
_UNJUDGED: dict[str, Any] = {
    "color": style.FAINT,
    "alpha": 0.3,
    "linewidth": 0.0,
    "zorder": 0.3,
}
_HEIGHTS = (1.5, 1.2, 1.3, 1.0)
_OBSERVED_PANELS = {
    "line": "in the lines (J)",
    "known": "known of them (J)",
    "store": "stored (J)",
    "given": "given, taken (J)",
}


def draw_functional(
    log: Log, certificate: Certificate, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Returns V with its sites, its parts, dissipation and work, and the residual of the
    balance, J.

    A certificate without a balance gives a figure with the reason.
    """
    balance = certificate.balance
    if balance is None:
        return style.empty_figure(certificate.verdict.text, form)
    with style.time_figure(log, form, 7.2 if form.narrow else 6.4) as plot:
        rows = style.add_panels(plot.figure, 4, 1, sharex=True, height_ratios=_HEIGHTS)[:, 0]
        _draw(balance, rows[0], balance.V, **_TOTAL)
        if (ones := certificate.paper_balance) is not None:
            _draw(ones, rows[0], ones.V, **_ONES)
        for site, values in balance.sites.items():
            _draw(balance, rows[0], values, **style.site_line(log, site, 1.0))
        rows[0].set_ylim(bottom=0.0)
        rows[0].set_ylabel(r"V and its $\beta_i V_i$ (J)")
        for (name, values), line in zip(balance.parts.items(), style.DASHES, strict=True):
            _draw(
                balance,
                rows[1],
                values,
                label=_PARTS[name],
                color=style.REFERENCE,
                linestyle=line,
            )
        rows[1].set_ylabel("parts of V (J)")
        _add_panel_legend(rows[1], form)
        _draw_work(balance, rows[2], form)
        _draw_residual(balance, rows[3], form)
        for axes in rows:
            plot.mark(axes, log.sites, numbered=axes is rows[0])  # others have a legend there
            for from_s, to_s in find_unjudged_spans(balance):
                axes.axvspan(from_s, to_s, **_UNJUDGED)
        rise = certificate.verdict.rise
        if rise is not None:
            rows[0].axvspan(rise.from_s, rise.at_s, **_RISE)
            rows[0].axvline(rise.at_s, color=_RISE["color"], linewidth=0.8)
        by_ones = [] if ones is None else [("V with the paper's ones", _ONES)]
        plot.finish(
            [rows[-1]], [*style.site_legend_entries(log, log.sites), ("V", _TOTAL), *by_ones]
        )
    return plot.figure


draws(
    "certificate",
    "V, its parts, who changed it, the energy balance",
    lambda log: explain_no_functional(log.scenario),
    in_report=True,
)(lambda log, form: draw_functional(log, certify(log), form))


def draw_observed_energy(
    log: Log, observed: ObservedEnergy, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Returns the energies that the laws declare: lines and what is known of them, stores,
    arms' work, J.

    A line has the color of the site that it comes to.
    """
    kinds = {one.kind for one in observed.curves}
    panels = [kind for kind in _OBSERVED_PANELS if kind in kinds]
    with style.time_figure(
        log, form, (1.6 if form.narrow else 1.4) * len(panels) + 0.8
    ) as plot:
        rows = style.add_panels(plot.figure, len(panels), 1, sharex=True)[:, 0]
        at = dict(zip(panels, rows, strict=True))
        for one in observed.curves:
            taken = {"linestyle": style.DASHES[1]} if one.kind == "taken" else {}
            axes = at["given" if taken else one.kind]
            line = {**style.site_line(log, one.site), **taken}
            style.plot_decimated(axes, np.arange(len(one.t_s)), one.t_s, one.energy_j, **line)
        for kind, axes in at.items():
            axes.set_ylabel(_OBSERVED_PANELS[kind])
            plot.mark(axes, log.sites, numbered=axes is rows[0])
        dashed = ("taken by the law", {"color": style.REFERENCE, "linestyle": style.DASHES[1]})
        plot.finish([rows[-1]], [*style.site_legend_entries(log, log.sites), dashed])
    return plot.figure


@draws(
    "observed_energy",
    "energies that the control laws declare: lines, observers, tanks",
    unless(
        lambda log: (found := observe_energies(log)) and found.curves,
        "the laws of this run declare no energies",
    ),
    in_report=True,
)
def _draw_observed(log: Log, form: FigureSize) -> Figure:
    found = observe_energies(log)
    assert found is not None
    return draw_observed_energy(log, found, form)


def _draw(balance: EnergyBalance, axes: Axes, values: Array, **options: Any) -> None:
    style.plot_decimated(axes, np.arange(len(balance.t_s)), balance.t_s, values, **options)


def _add_panel_legend(axes: Axes, form: FigureSize) -> None:
    low, high = axes.get_ylim()
    columns = 2 if form.narrow else 4
    rows = -(-len(axes.get_legend_handles_labels()[0]) // columns)
    room = 0.25 * rows if form.narrow else 0.35
    axes.set_ylim(low, high + room * (high - low))
    axes.legend(loc="upper left", ncols=columns, fontsize=_legend_pt(form))


def _legend_pt(form: FigureSize) -> float:
    return form.small_pt if form.small_pt == form.tick_pt else form.small_pt + 0.5


def _draw_work(balance: EnergyBalance, axes: Axes, form: FigureSize) -> None:
    for (name, values), line in zip(balance.dissipation.items(), style.DASHES, strict=False):
        label = _TAKEN.get(name, f"taken: {name}")
        _draw(balance, axes, values, label=label, color=style.REFERENCE, linestyle=line)
    links = np.sum([x for name, x in balance.work.items() if "->" in name], axis=0)
    given = {name: x for name, x in balance.work.items() if "->" not in name}
    shown = {"hands": given.pop("hands"), "walls": given.pop("walls"), "links": links, **given}
    shown["sampling"] = balance.sampling
    least = 1e-4 * balance.scale
    for (name, values), colour in zip(shown.items(), (*_COLOURS, *_COLOURS), strict=False):
        if np.abs(values).max() > least:
            _draw(balance, axes, values, label=f"given: {name}", color=colour)
    _add_panel_legend(axes, form)
    axes.set_ylabel("taken and given (J)")


def _draw_residual(balance: EnergyBalance, axes: Axes, form: FigureSize) -> None:
    scale = balance.scale or 1.0
    floor = 1e-9 * scale
    for label, values, line in (
        ("V - V(0) + taken - given", balance.residual, "-"),
        ("with sampling booked", balance.unexplained, (0, (1, 1))),
    ):
        positive = np.maximum(np.abs(values), floor)
        _draw(balance, axes, positive, label=label, color=style.REFERENCE, linestyle=line)
    axes.axhline(scale, color=style.FAINT, linewidth=0.9, label="largest energy")
    axes.set(
        yscale="log",
        ylabel="residual (J)",
        ylim=(floor, (1e12 if form.narrow else 1e4) * scale),
    )
    axes.legend(loc="upper left", ncols=1 if form.narrow else 3, fontsize=_legend_pt(form))
