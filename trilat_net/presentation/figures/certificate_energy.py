"""Draws the energies that show whether a run was stable, in J over time.

There are two figures:

- `draw_functional` draws V, the energy function used to prove the stability of the coupled
  arms, which must not rise on its own (docs/theory/certificate-energy.md). It also draws the
  components of V, the contribution of each arm, the dissipated energy, the work done on the
  arms, and the residual, which is the change of V not explained by dissipation and work.
- `draw_observed_energy` is for control laws that prove their passivity through energy
  accounting, by recording how much energy they have received and supplied. The figure draws
  these energies.

Invariant:
    - Times at which V is unknown because of missing records are shaded.
    - The largest rise of V is marked, because V must not rise in a stable run.
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...analysis import Certificate, EnergyBalance, ObservedEnergy
from ...core import Array
from ...log import Log
from .. import style
from ..appearance import REPORT_SIZE, FigureSize
from ..verdict_text import explain_no_functional
from .figure_entry import draws, unless

_PART_LABELS = {
    "kinetic": "r'Mr / 2",
    "parameter": "parameter error",
    "position": "e'ΛKd e / 2",
    "delay": "in transit",
}
_DISSIPATION_LABELS = {
    "damping": "taken: r'Kp r",
    "disagreement": "taken: disagreement",
}
_WORK_COLOURS = ("#117733", "#aa4499", "#999933", "#882255", "#44aa99", "#661100")
_TOTAL: dict[str, Any] = {"color": style.REFERENCE, "linewidth": 1.6}
_PAPER_TOTAL: dict[str, Any] = {
    "color": style.REFERENCE,
    "linewidth": 0.9,
    "linestyle": (0, (4, 2)),
}
_RISE: dict[str, Any] = {"color": "#cc3311", "alpha": 0.25, "linewidth": 0.0, "zorder": 0.4}
_UNJUDGED: dict[str, Any] = {
    "color": style.FAINT,
    "alpha": 0.3,
    "linewidth": 0.0,
    "zorder": 0.3,
}
_DISSIPATED: dict[str, Any] = {"color": style.REFERENCE, "linestyle": style.DASHES[1]}
_HEIGHTS = (1.5, 1.2, 1.3, 1.0)
"""Relative heights of the panels of V."""
_OBSERVED_PANELS = {
    "line": "in transit (J)",
    "known": "known in transit (J)",
    "store": "stored (J)",
    "given": "given, taken (J)",
}
"""Panel label for each kind of declared energy.

The panel "given" also shows the kind "taken", the energy dissipated by a law.
"""


def draw_functional(
    log: Log, certificate: Certificate, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Draws the energy function V of the stability proof and its balance, in J over time.

    V decreases if the controllers dissipate more energy than the operators supply. From top to
    bottom, the panels show V and the contribution of each site; the components of V;
    dissipation and work; and the residual of the balance, the part that these energies do not
    explain. If there is no balance, the figure shows the reason.

    Args:
        log: Log of the run.
        certificate: Stability certificate of the run, which contains the balance.
        form: Width, font sizes and resolution of the figure.
    """
    balance = certificate.balance
    if balance is None:
        return style.empty_figure(certificate.verdict.text, form)

    height_in = 7.2 if form.narrow else 6.4
    with style.time_figure(log, form, height_in) as plot:
        panels = style.add_panels(plot.figure, 4, 1, sharex=True, height_ratios=_HEIGHTS)
        total_panel, parts_panel, work_panel, residual_panel = panels[:, 0]
        _draw_total(total_panel, log, certificate, balance)
        _draw_parts(parts_panel, balance, form)
        _draw_work(work_panel, balance, form)
        _draw_residual(residual_panel, balance, form)
        for axes in (total_panel, parts_panel, work_panel, residual_panel):
            # The lower panels have a legend in place of the numbers of the changes.
            plot.mark(axes, log.sites, numbered=axes is total_panel)
            for from_s, to_s in balance.unjudged_spans:
                axes.axvspan(from_s, to_s, **_UNJUDGED)

        rise = certificate.verdict.rise
        if rise is not None:
            total_panel.axvspan(rise.from_s, rise.at_s, **_RISE)
            total_panel.axvline(rise.at_s, color=_RISE["color"], linewidth=0.8)

        entries = [*style.site_legend_entries(log, log.sites), ("V", _TOTAL)]
        if certificate.paper_balance is not None:
            entries.append(("V with the paper's weights", _PAPER_TOTAL))
        plot.finish([residual_panel], entries)
    return plot.figure


@draws(
    "certificate",
    "V, its parts and causes, the energy balance",
    lambda log: explain_no_functional(log.scenario),
    in_report=True,
)
def _draw_certificate(log: Log, form: FigureSize) -> Figure:
    """Draws the energy function V of the stability proof over the time of a run, in J.

    V must never rise unless energy is supplied. This function is called through the figure
    registry.
    """
    own_laws = log.may_run_user_laws
    return draw_functional(log, Certificate.of_log(log, own_laws=own_laws), form)


def draw_observed_energy(
    log: Log, observed: ObservedEnergy, form: FigureSize = REPORT_SIZE
) -> Figure:
    """Draws the energies that the control laws keep track of, in J over time.

    Some control laws ensure stability by never returning more energy than they received. There
    is one panel per kind of energy: the energy in transit between sites, the part of this
    energy that the receivers know of, the energy stored by the laws, and the energy that the
    arms gave to the laws, together with the energy that the laws dissipated. Curves of energy
    in transit use the colour of the receiving site.

    Args:
        log: Log of the run.
        observed: The declared energies, at least one.
        form: Width, font sizes and resolution of the figure.
    """
    kinds = {curve.kind for curve in observed.curves}
    panel_kinds = [kind for kind in _OBSERVED_PANELS if kind in kinds]
    panel_in = 1.6 if form.narrow else 1.4
    height_in = panel_in * len(panel_kinds) + 0.8
    with style.time_figure(log, form, height_in) as plot:
        panel_axes = style.add_panels(plot.figure, len(panel_kinds), 1, sharex=True)[:, 0]
        panels = dict(zip(panel_kinds, panel_axes, strict=True))
        for curve in observed.curves:
            panel_kind = curve.kind
            line_style = style.site_line(log, curve.site)
            if curve.kind == "taken":  # drawn dashed beside the given energy, for comparison
                panel_kind = "given"
                line_style["linestyle"] = _DISSIPATED["linestyle"]
            axes = panels[panel_kind]
            ticks = np.arange(len(curve.t_s))
            style.plot_decimated(axes, ticks, curve.t_s, curve.energy_j, **line_style)

        for kind, axes in panels.items():
            axes.set_ylabel(_OBSERVED_PANELS[kind])
            plot.mark(axes, log.sites, numbered=axes is panel_axes[0])

        entries = style.site_legend_entries(log, log.sites)
        plot.finish([panel_axes[-1]], [*entries, ("taken by the law", _DISSIPATED)])
    return plot.figure


def _has_declared_energies(log: Log) -> bool:
    """Returns True if at least one control law of the run declares energies."""
    observed = ObservedEnergy.of_log(log, own_laws=log.may_run_user_laws)
    return observed is not None and bool(observed.curves)


@draws(
    "observed_energy",
    "energies that the control laws declare: lines, observers, tanks",
    unless(_has_declared_energies, "the laws of this run declare no energies"),
    in_report=True,
)
def _draw_observed(log: Log, form: FigureSize) -> Figure:
    """Draws the energies declared by a log's control laws, for the figure registry."""
    observed = ObservedEnergy.of_log(log, own_laws=log.may_run_user_laws)
    assert observed is not None
    return draw_observed_energy(log, observed, form)


def _draw_line(balance: EnergyBalance, axes: Axes, values: Array, **options: Any) -> None:
    """Plots values at the ticks of a balance, shape (T,)."""
    ticks = np.arange(len(balance.t_s))
    style.plot_decimated(axes, ticks, balance.t_s, values, **options)


def _add_panel_legend(axes: Axes, form: FigureSize) -> None:
    """Adds a legend inside a panel, and extends the value axis to make room for it."""
    handles, _ = axes.get_legend_handles_labels()
    columns = 2 if form.narrow else 4
    rows = math.ceil(len(handles) / columns)
    room = 0.25 * rows if form.narrow else 0.35
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + room * (high - low))
    axes.legend(loc="upper left", ncols=columns, fontsize=_choose_legend_pt(form))


def _choose_legend_pt(form: FigureSize) -> float:
    """Returns the font size for a legend inside a panel, in pt."""
    is_uniform = form.small_pt == form.tick_pt
    return form.small_pt if is_uniform else form.small_pt + 0.5


def _draw_total(axes: Axes, log: Log, certificate: Certificate, balance: EnergyBalance) -> None:
    """Draws the energy V of the stability proof, and the contribution of each arm.

    If the arm weights given in the paper do not apply, V with these weights is drawn as a
    dashed line for comparison.
    """
    _draw_line(balance, axes, balance.V, **_TOTAL)
    paper_balance = certificate.paper_balance
    if paper_balance is not None:
        _draw_line(paper_balance, axes, paper_balance.V, **_PAPER_TOTAL)
    for site, values in balance.sites.items():
        _draw_line(balance, axes, values, **style.site_line(log, site, 1.0))
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel(r"V and its $\beta_i V_i$ (J)")


def _draw_parts(axes: Axes, balance: EnergyBalance, form: FigureSize) -> None:
    """Draws the components of the energy function V over time, in J.

    These are the kinetic energy, the energies of the parameter and position errors, and the
    energy of samples in transit.
    """
    for (name, values), dashes in zip(balance.parts.items(), style.DASHES, strict=True):
        _draw_line(
            balance,
            axes,
            values,
            label=_PART_LABELS[name],
            color=style.REFERENCE,
            linestyle=dashes,
        )
    axes.set_ylabel("parts of V (J)")
    _add_panel_legend(axes, form)


def _draw_work(axes: Axes, balance: EnergyBalance, form: FigureSize) -> None:
    """Draws the energy dissipated in a run, and the work that supplied energy, in J.

    The work of all links is drawn as a single line. Sources with negligible work are omitted.
    """
    dissipations = balance.dissipation.items()
    for (name, values), line_pattern in zip(dissipations, style.DASHES, strict=False):
        label = _DISSIPATION_LABELS.get(name, f"taken: {name}")
        _draw_line(
            balance, axes, values, label=label, color=style.REFERENCE, linestyle=line_pattern
        )

    link_works = [work for name, work in balance.work.items() if "->" in name]
    other_works = {name: work for name, work in balance.work.items() if "->" not in name}
    works = {
        "hands": other_works.pop("hands"),
        "walls": other_works.pop("walls"),
        "links": np.sum(link_works, axis=0),
        **other_works,
        "sampling": balance.sampling,
    }
    smallest_drawn_j = 1e-4 * balance.scale
    for (name, values), colour in zip(works.items(), 2 * _WORK_COLOURS, strict=False):
        if np.abs(values).max() > smallest_drawn_j:
            _draw_line(balance, axes, values, label=f"given: {name}", color=colour)
    _add_panel_legend(axes, form)
    axes.set_ylabel("taken and given (J)")


def _draw_residual(axes: Axes, balance: EnergyBalance, form: FigureSize) -> None:
    """Draws the residual of the energy balance, which shows whether the log fits the model.

    The solid line is the residual: the change of the energy function V that is explained
    neither by dissipation ("taken") nor by work on the arms ("given"). Part of the residual is
    caused by executing the control law in ticks ("sampling"). The dotted line is the residual
    without this part. The value axis is logarithmic, so that the residual can be compared with
    the largest energy.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        balance: V and all energies that change it, in J over time.
        form: Width, font sizes and resolution of the figure.
    """
    largest_energy = balance.scale or 1.0
    floor = 1e-9 * largest_energy  # smaller magnitudes are drawn at this height
    solid = "-"
    dotted = (0, (1, 1))
    residuals = (
        ("V - V(0) + taken - given", balance.residual, solid),
        ("without sampling", balance.unexplained, dotted),
    )
    for label, values, dashes in residuals:
        magnitude = np.maximum(np.abs(values), floor)
        _draw_line(
            balance, axes, magnitude, label=label, color=style.REFERENCE, linestyle=dashes
        )
    axes.axhline(largest_energy, color=style.FAINT, linewidth=0.9, label="largest energy")
    # The legend is above the lines. In a narrow figure it is higher, and needs 12 decades of
    # the axis instead of 4.
    room = 1e12 if form.narrow else 1e4
    axes.set(yscale="log", ylabel="residual (J)", ylim=(floor, room * largest_energy))
    columns = 1 if form.narrow else 3
    axes.legend(loc="upper left", ncols=columns, fontsize=_choose_legend_pt(form))
