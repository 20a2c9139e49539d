"""Figures of a linear loop: its roots; transmitted impedance and passivity of its ports over
frequency.

Invariant: free is solid and clamped dashed, in the colour of the operator's site; bands that
fail are shaded.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from ...core.vectors import Array
from ...theory.characteristic_roots import Spectrum
from ...theory.delay_margin import MAX_COMMON_DELAY_S
from ...theory.frequency_search import Minima
from ...theory.linear_analysis import LinearAnalysis
from ...theory.port_analysis import PortAnalysis
from ...theory.port_response import Transparency
from .. import style
from ..appearance import COLUMN_IN, REPORT_SIZE, SITE_COLOURS, FigureSize, list_site_colours

_CLAMPED: tuple[int, tuple[float, float]] = (0, (4.0, 1.6))
_FAILS: dict[str, Any] = {"color": "#cc3311", "alpha": 0.12, "linewidth": 0.0, "zorder": 0.3}
_BAND: dict[str, Any] = {"color": style.FAINT, "alpha": 0.12, "linewidth": 0.0, "zorder": 0.2}
_ALL: dict[str, Any] = {"color": SITE_COLOURS[0], "linewidth": 1.6}
_PROOF: dict[str, Any] = {
    "color": style.REFERENCE,
    "linewidth": 1.0,
    "linestyle": (0, (5, 1.5, 1, 1.5)),
}
_MAX_SHOWN_PARAMETER = 2.5
"""Llewellyn's parameter is drawn up to here: values far above 1 do not differ in meaning."""


def draw_port_impedance(ports: PortAnalysis, size: FigureSize = REPORT_SIZE) -> Figure:
    """Returns magnitude and phase of the transmitted impedance, free and clamped, a column for
    each joint.

    The joints of larger arms stand in several rows of both.
    """
    if "unstable" in (ports.verdict, ports.clamped_verdict):
        return style.empty_figure("The loop is unstable: it has no impedance.", size)
    joints = sorted({one.joint for one in ports.transparency})
    sites = dict.fromkeys(one.operator_site for one in ports.transparency)
    rows = style.arrange_joints(len(joints), size.narrow)
    blocks = len(rows)
    columns = min(len(rows[0]), len(joints))
    crowded = size.narrow or columns > 2
    with style.styled_figure(size, 3.8 * blocks) as figure:
        grid = style.add_panels(figure, 2 * blocks, columns, sharex=True, sharey="row")
        for place, joint in enumerate(joints):
            top = 2 * (place // columns)
            column = place % columns
            of_joint = [one for one in ports.transparency if one.joint == joint]
            magnitude, phase = grid[top : top + 2, column]
            _plot_impedance(ports, of_joint, magnitude, phase)
            magnitude.set_title(
                ports.name_port(joint) + ("" if crowded else _describe_ratios(of_joint))
            )
            if place + columns >= len(joints):
                phase.set_xlabel("frequency (Hz)")
                phase.xaxis.set_tick_params(labelbottom=True)
            if crowded:
                phase.set_xticks((0.1, 1.0, 10.0))  # those at the ends meet the next panel's
            if not column:
                magnitude.set_ylabel(f"|Z| ({ports.impedance_unit(joint)})")
                phase.set_ylabel("phase (degrees)")
                phase.yaxis.set_major_locator(MultipleLocator(45.0))
        for column in range(len(joints) - columns * (blocks - 1), columns):
            grid[-2, column].set_visible(False)
            grid[-1, column].set_visible(False)
        of = ports.transparency[0].other_site
        entries: list[tuple[str, dict[str, Any]]] = [
            *((f"felt at {site}", {"color": _colour(ports, site)}) for site in sites),
            (f"{of} free", {"color": style.REFERENCE}),
            (f"{of} clamped", {"color": style.REFERENCE, "linestyle": _CLAMPED}),
            ("band of the ratio", {**_BAND, "alpha": 0.4, "linewidth": 6.0}),
        ]
        style.add_legend(figure, entries)
    return figure


def _plot_impedance(
    ports: PortAnalysis, transparency: Sequence[Transparency], magnitude: Axes, phase: Axes
) -> None:
    for n, one in enumerate(transparency):
        hz = one.w_rad_s / (2.0 * np.pi)
        for Z, dashes in ((one.free, "-"), (one.clamped, _CLAMPED)):
            line: dict[str, Any] = {
                "color": _colour(ports, one.operator_site),
                "linestyle": dashes,
            }
            line["linewidth"] = (
                2.0 - 1.2 * n / (len(transparency) - 1) if len(transparency) > 1 else 1.1
            )
            magnitude.loglog(hz, np.abs(Z), **line)
            # from -180 to 180 degrees on
            phase.semilogx(hz, np.rad2deg(np.unwrap(np.angle(Z))), **line)
    for axes in (magnitude, phase):
        axes.axvspan(*transparency[0].band_hz, **_BAND)
        axes.set_xlim(hz[0], hz[-1])


def _describe_ratios(transparency: Sequence[Transparency]) -> str:
    ratios = ", ".join(f"{one.operator_site} {one.ratio_db:+.1f} dB" for one in transparency)
    return f"\nclamped / free {ratios}".replace("-", "\N{MINUS SIGN}")


def _colour(ports: PortAnalysis, site: str) -> str:
    return list_site_colours(ports.scenario)[ports.sites.index(site) % len(SITE_COLOURS)]


def draw_port_passivity(ports: PortAnalysis, size: FigureSize = REPORT_SIZE) -> Figure:
    """Returns the least eigenvalue of Y + Y^H, and below it the criterion for any passive
    operators.

    The eigenvalue is drawn over 2 norm(Y), its bound: -1 is a network that returns all energy.
    The criterion is Llewellyn's parameter of each joint for two sites, and the margin under the
    best weights for more.
    """
    if ports.verdict == "unstable":
        return style.empty_figure(
            "The loop without operators is unstable: it cannot be passive.", size
        )
    with style.styled_figure(size, 3.9) as figure:
        above, below = style.add_panels(figure, 2, 1, sharex=True)[:, 0]
        _plot_eigenvalues(ports, above)
        (_plot_parameters if len(ports.sites) == 2 else _plot_margin)(ports, below)
        below.set(xlim=ports.band_hz, xlabel="frequency (Hz)")
        figure.align_ylabels()
        every = "axes" if ports.axes else "joints"
        proof = [] if ports.proof is None else [(f"all {every}, in r (weighted)", _PROOF)]
        joints = [
            (f"{ports.name_port(joint)} alone", _joint_line(joint)) for joint in ports.joints
        ]
        fails = ("fails", {**_FAILS, "linewidth": 6.0})
        style.add_legend(figure, [(f"all {every}", _ALL), *joints, *proof, fails])
    return figure


def _joint_line(joint: int) -> dict[str, Any]:
    colour = SITE_COLOURS[joint % len(SITE_COLOURS)]
    return {
        "color": colour,
        "linestyle": style.DASHES[joint % len(style.DASHES)],
        "linewidth": 1.0,
    }


def _plot(axes: Axes, minima: Minima, values: Array, **options: Any) -> None:
    axes.semilogx(minima.w_rad_s / (2.0 * np.pi), values, **options)


def _shade(axes: Axes, minima: Minima) -> None:
    for span in minima.below:
        axes.axvspan(*span, **_FAILS)


def _plot_eigenvalues(ports: PortAnalysis, axes: Axes) -> None:
    curves = [(one, _joint_line(joint)) for joint, one in ports.joints.items()]
    curves += [] if ports.proof is None else [(ports.proof, _PROOF)]
    for one, line in [*curves, (ports.velocity, _ALL)]:
        _plot(axes, one.minima, one.minima.values / (2.0 * one.size), **line)
    _shade(axes, ports.velocity.minima)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set(ylim=(-1.08, 1.08), ylabel=r"$\lambda_{\min}(Y+Y^{\mathrm{H}})\,/\,2\|Y\|$")


def _plot_parameters(ports: PortAnalysis, axes: Axes) -> None:
    for one in ports.two_ports:
        _plot(axes, one.minima, one.minima.values, **_joint_line(one.joint))
        _shade(axes, one.minima)
    axes.axhline(1.0, **style.LIMIT_LINE)
    axes.set(ylim=(-1.2, _MAX_SHOWN_PARAMETER), ylabel="Llewellyn's parameter")


def _plot_margin(ports: PortAnalysis, axes: Axes) -> None:
    _plot(axes, ports.absolute, ports.absolute.values, **_ALL)
    _shade(axes, ports.absolute)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set_ylabel("margin, best weights")


_SIZE = REPORT_SIZE._replace(width_in=COLUMN_IN)
_HEIGHT_IN = 3.2
_UNSTABLE: Any = {"color": "#cc3311", "alpha": 0.08, "linewidth": 0.0, "zorder": 0.3}


def draw_root_map(analysis: LinearAnalysis) -> Figure:
    """Returns the map of continuous and sampled roots."""
    with style.styled_figure(_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        _plot_roots(
            axes=axes,
            spectrum=analysis.continuous,
            mark="o",
            colour=SITE_COLOURS[0],
            label="continuous",
        )
        if analysis.sampled is not None:
            _plot_roots(
                axes=axes,
                spectrum=analysis.sampled,
                mark="x",
                colour=SITE_COLOURS[1],
                label="as computed",
            )
        if zeros := analysis.decisive.zeros:
            label = f"zero by structure ({zeros})"
            axes.plot(
                [0.0],
                [0.0],
                "s",
                markersize=9.0,
                fillstyle="none",
                color=style.FAINT,
                label=label,
            )
        low, high = axes.get_xlim()
        high = max(high, 0.06 * (high - low), 0.0)
        axes.axvline(0.0, **style.LIMIT_LINE)
        axes.axvspan(0.0, high, **_UNSTABLE)
        axes.set(xlim=(low, high), xlabel="real part (1/s)", ylabel="imaginary part (rad/s)")
        figure.legend(loc="outside upper center", ncols=3, handlelength=1.0, columnspacing=1.0)
    return figure


def _plot_roots(axes: Axes, spectrum: Spectrum, mark: str, colour: str, label: str) -> None:
    roots = [root.s for root in spectrum.roots]
    both = np.array([*roots, *(s.conjugate() for s in roots if s.imag)])
    axes.plot(
        both.real, both.imag, mark, markersize=4.5, fillstyle="none", color=colour, label=label
    )


_MARKS = ("o", "s", "^", "v")
_LOST: Any = {"marker": "x", "color": "#cc3311", "linestyle": "none", "markersize": 5.0}


def draw_network_delays(facts: Mapping[str, Any]) -> Figure:
    """Returns the figure of a benchmark's values, see `NetworkBenchmark.to_dict`."""
    rows = facts["rows"]
    needs = facts["needs"]
    cases = list(dict.fromkeys((row["bytes"], row["rate_hz"]) for row in rows))
    transports = list(dict.fromkeys(row["transport"] for row in rows))
    with style.styled_figure(REPORT_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        for row in rows:
            number = transports.index(row["transport"])
            at = cases.index((row["bytes"], row["rate_hz"])) + 0.22 * (
                number - (len(transports) - 1) / 2
            )
            _plot_case(axes, at, row, number)
        _plot_bounds(axes, facts)
        axes.set_yscale("log")
        labels = [f"{size} B\n{rate:g} Hz" for size, rate in cases]
        own = cases.index((needs["sample_bytes"], needs["rate_hz"]))
        axes.axvspan(
            own - 0.45, own + 0.45, color=style.FAINT, alpha=0.15, linewidth=0.0, zorder=0.3
        )
        labels[own] += f"\n{facts['scenario']}"
        axes.set_xticks(range(len(cases)), labels)
        axes.set(xlim=(-0.5, len(cases) - 0.5), ylabel="one way: p50, p99, largest (ms)")
        axes.grid(visible=False, axis="x")
        handles = [
            Line2D(
                [], [], label=name, color=SITE_COLOURS[n], marker=_MARKS[n % 4], linewidth=1.1
            )
            for n, name in enumerate(transports)
        ]
        lost = (
            [Line2D([], [], label="lost some", **_LOST)]
            if any(row["lost"] for row in rows)
            else []
        )
        style.place_legend(figure, [*handles, *lost])
    return figure


def _plot_case(axes: Axes, at: float, row: Mapping[str, Any], number: int) -> None:
    times = row["one_way_us"]
    if times is not None:
        p50, p99, most = (times[key] / 1e3 for key in ("p50", "p99", "max"))
        colour = SITE_COLOURS[number % len(SITE_COLOURS)]
        axes.plot([at, at], [p50, most], color=colour, linewidth=0.8)
        axes.plot([at, at], [p50, p99], color=colour, linewidth=2.6, solid_capstyle="butt")
        axes.plot([at], [p50], marker=_MARKS[number % 4], color=colour, markersize=4.5)
        axes.plot([at], [most], marker="_", color=colour, markersize=6.0)
    if row["lost"]:
        axes.plot([at], [0.04], transform=axes.get_xaxis_transform(), **_LOST)


def _plot_bounds(axes: Axes, facts: Mapping[str, Any]) -> None:
    needs = facts["needs"]
    bounds = [
        ("one period", 1e3 / needs["rate_hz"], "center"),
        ("held by links", needs["held_ms"], "top"),
    ]
    ages = [one["age_ms"] for one in facts["transports"] if one["age_ms"] is not None]
    for low, high in needs["stable_ms"] or []:
        if any(low <= age <= high for age in ages) or [low, high] == needs["stable_ms"][0]:
            bounds.append((f"stable from {low:.4g} ms", low, "top"))
            shown = high if high < 1e3 * MAX_COMMON_DELAY_S else 0.0
            bounds.append((f"stable up to {high:.4g} ms", shown, "bottom"))
    for label, at, where in bounds:
        if at:
            axes.axhline(at, **style.LIMIT_LINE)
            axes.annotate(
                label,
                (1.01, at),
                xycoords=("axes fraction", "data"),
                va=where,
                fontsize=REPORT_SIZE.tick_pt,
            )


def draw_arm_gains(facts: Mapping[str, Any]) -> Figure:
    """Returns k at the edge over the delay, with the gains and the runs, see
    `ArmGains.to_dict`.
    """
    edge = facts["edge"]
    margin = facts["margin"]
    delay_ms, k = np.array(facts["curve"]).T * [[1e3], [1.0]]
    runs = [run for run in facts["runs"] if run["share"]]
    marks = {
        True: ("o", "run decays"),
        False: ("x", "run grows"),
        None: ("s", "run tells nothing"),
    }
    with style.styled_figure(_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        axes.loglog(
            delay_ms, k, color=SITE_COLOURS[0], linewidth=1.4, label="edge, constant delay"
        )
        axes.fill_between(delay_ms, k, 10.0 * k.max(), **_UNSTABLE)
        used = (edge["used_per_s2"] / margin, "D", f"the gains, margin {margin:g}")
        shown = [(run["share"] * edge["k_per_s2"], *marks[run["stable"]]) for run in runs]
        for at, mark, label in (used, *shown):
            axes.plot(
                facts["age_ms"], at, mark, color=SITE_COLOURS[1], markersize=4.5, label=label
            )
        axes.set(xlim=(delay_ms[0], delay_ms[-1]), ylim=(0.3 * k.min(), 3.0 * k.max()))
        axes.set(xlabel="delay of each link (ms)", ylabel=r"K / inertia (1/s$^2$)")
        figure.legend(loc="outside upper center", ncols=2, handlelength=1.2, columnspacing=1.0)
    return figure
