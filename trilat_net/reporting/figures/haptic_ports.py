"""Figures of the haptic ports: transmitted impedance, and passivity over frequency.

Invariant: free is solid and clamped dashed, in the colour of the operator's site; bands that fail are shaded.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from ...core.vectors import Array
from ...theory.frequency_search import Minima
from ...theory.port_analysis import PortAnalysis
from ...theory.port_response import Complex
from ...theory.port_transparency import Transparency
from .. import style
from ..figure_size import REPORT_SIZE, FigureSize

_CLAMPED: tuple[int, tuple[float, float]] = (0, (4.0, 1.6))
_FAILS: dict[str, Any] = {"color": "#cc3311", "alpha": 0.12, "linewidth": 0.0, "zorder": 0.3}
_BAND: dict[str, Any] = {"color": style.FAINT, "alpha": 0.12, "linewidth": 0.0, "zorder": 0.2}
_ALL: dict[str, Any] = {"color": style.SITE_COLOURS[0], "linewidth": 1.6}
_PROOF: dict[str, Any] = {"color": style.REFERENCE, "linewidth": 1.0, "linestyle": (0, (5, 1.5, 1, 1.5))}
_MOST_PARAMETER = 2.5
"""Llewellyn's parameter is drawn up to here: far above 1 its value says nothing."""


def draw_port_impedance(section: PortAnalysis, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns magnitude and phase of what hands feel, free and clamped, a column for each joint.

    Args:
        section: what there is to say of the ports.
        form: what it is drawn for.
    """
    if "unstable" in (section.verdict, section.clamped_verdict):
        return style.empty_figure("The loop is unstable: there is no impedance to be felt.", form)
    joints = sorted({one.joint for one in section.felt})
    with style.figure_style(form):
        figure = style.new_figure(3.8, form.width_in)
        grid = style.add_panels(figure, 2, len(joints), sharex=True, sharey="row")
        for column, joint in enumerate(joints):
            of_joint = [one for one in section.felt if one.joint == joint]
            _impedance(section, of_joint, *grid[:, column])
            grid[0, column].set_title(f"joint {joint}" + ("" if form.narrow else _widths(of_joint)))
            grid[1, column].set_xlabel("frequency (Hz)")
            if form.narrow:
                grid[1, column].set_xticks((0.1, 1.0, 10.0))  # those at the ends meet the next panel's
        grid[0, 0].set_ylabel("|Z| (N m s/rad)")
        grid[1, 0].set_ylabel("phase (degrees)")
        grid[1, 0].yaxis.set_major_locator(MultipleLocator(45.0))
        style.add_legend(figure, _felt_entries(section))
    return figure


def _impedance(section: PortAnalysis, felt: Sequence[Transparency], size: Axes, phase: Axes) -> None:
    for n, one in enumerate(felt):
        hz = one.w_rad_s / (2.0 * np.pi)
        for Z, dashes in ((one.free, "-"), (one.clamped, _CLAMPED)):
            line: dict[str, Any] = {"color": _colour(section, one.at), "linestyle": dashes}
            line["linewidth"] = 2.0 - 1.2 * n / (len(felt) - 1) if len(felt) > 1 else 1.1
            size.loglog(hz, np.abs(Z), **line)
            phase.semilogx(hz, _degrees(Z), **line)
    for axes in (size, phase):
        axes.axvspan(*felt[0].band_hz, **_BAND)
        axes.set_xlim(hz[0], hz[-1])


def _widths(felt: Sequence[Transparency]) -> str:
    widths = ", ".join(f"{one.at} {one.width_db:+.1f} dB" for one in felt)
    return f"\nZ-width {widths}".replace("-", "\N{MINUS SIGN}").replace("Z\N{MINUS SIGN}", "Z-")


def _degrees(Z: Complex) -> Array:
    """Returns the phase without jumps, its start between -180 and 180 degrees."""
    degrees: Array = np.rad2deg(np.unwrap(np.angle(Z)))
    return degrees


def _colour(section: PortAnalysis, site: str) -> str:
    return style.SITE_COLOURS[section.sites.index(site) % len(style.SITE_COLOURS)]


def _felt_entries(section: PortAnalysis) -> list[tuple[str, dict[str, Any]]]:
    hands = dict.fromkeys(one.at for one in section.felt)
    of = section.felt[0].of
    return [
        *((f"felt at {site}", {"color": _colour(section, site)}) for site in hands),
        (f"{of} free", {"color": style.REFERENCE}),
        (f"{of} clamped", {"color": style.REFERENCE, "linestyle": _CLAMPED}),
        ("band of the Z-width", {**_BAND, "alpha": 0.4, "linewidth": 6.0}),
    ]


def draw_port_passivity(section: PortAnalysis, form: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the least eigenvalue of Y + Y^H, and below it the criterion for any passive hands.

    The eigenvalue is drawn over 2 norm(Y), its bound: -1 is a network that gives back all that it can. The
    criterion is Llewellyn's parameter of each joint for two sites, and what the best weights leave for more.

    Args:
        section: what there is to say of the ports.
        form: what it is drawn for.
    """
    if section.verdict == "unstable":
        return style.empty_figure("The loop without hands is unstable: it cannot be passive.", form)
    with style.figure_style(form):
        figure = style.new_figure(3.9, form.width_in)
        above, below = style.add_panels(figure, 2, 1, sharex=True)[:, 0]
        _eigenvalues(section, above)
        if len(section.sites) == 2:
            _parameters(section, below)
        else:
            _margin(section, below)
        below.set_xlim(*section.band_hz)
        below.set_xlabel("frequency (Hz)")
        figure.align_ylabels()
        style.add_legend(figure, _passivity_entries(section))
    return figure


def _passivity_entries(section: PortAnalysis) -> list[tuple[str, dict[str, Any]]]:
    proof = [] if section.proof is None else [("all joints, in r (weighted)", _PROOF)]
    joints = [(f"joint {joint} alone", _joint_line(joint)) for joint in section.joints]
    return [("all joints", _ALL), *joints, *proof, ("fails", {**_FAILS, "linewidth": 6.0})]


def _joint_line(joint: int) -> dict[str, Any]:
    colour = style.SITE_COLOURS[joint % len(style.SITE_COLOURS)]
    return {"color": colour, "linestyle": style.DASHES[joint % len(style.DASHES)], "linewidth": 1.0}


def _draw(axes: Axes, dips: Minima, values: Array, **options: Any) -> None:
    axes.semilogx(dips.w_rad_s / (2.0 * np.pi), values, **options)


def _shade(axes: Axes, dips: Minima) -> None:
    for span in dips.below:
        axes.axvspan(*span, **_FAILS)


def _eigenvalues(section: PortAnalysis, axes: Axes) -> None:
    for joint, one in section.joints.items():
        _draw(axes, one.dips, one.dips.values / (2.0 * one.size), **_joint_line(joint))
    if section.proof is not None:
        _draw(axes, section.proof.dips, section.proof.dips.values / (2.0 * section.proof.size), **_PROOF)
    own = section.velocity
    _draw(axes, own.dips, own.dips.values / (2.0 * own.size), **_ALL)
    _shade(axes, own.dips)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set_ylim(-1.08, 1.08)
    axes.set_ylabel(r"$\lambda_{\min}(Y+Y^{\mathrm{H}})\,/\,2\|Y\|$")


def _parameters(section: PortAnalysis, axes: Axes) -> None:
    for one in section.two_ports:
        _draw(axes, one.dips, one.dips.values, **_joint_line(one.joint))
        _shade(axes, one.dips)
    axes.axhline(1.0, **style.LIMIT_LINE)
    axes.set_ylim(-1.2, _MOST_PARAMETER)
    axes.set_ylabel("Llewellyn's parameter")


def _margin(section: PortAnalysis, axes: Axes) -> None:
    _draw(axes, section.absolute, section.absolute.values, **_ALL)
    _shade(axes, section.absolute)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set_ylabel("margin, best weights")
