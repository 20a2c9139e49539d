"""Draws the results of linear analyses and network measurements, which need no recorded run.

A linear model describes small motions of the coupled arms around a rest pose.

- `draw_port_impedance` draws the impedance that operators feel at the joints they move, and
  `draw_port_passivity` shows whether the arms could supply energy to the operators.
- `draw_root_map` draws the characteristic roots of the linear model, both in continuous time
  and as executed in ticks. A root with a positive real part means that the arms are unstable.
- `draw_network_delays` draws the measured one-way delays of a network.
- `draw_arm_gains` draws the largest stable stiffness of an arm as a function of the delay.

Invariant:
    - Each impedance curve has the colour of the arm held by the operator. It is solid if the
      other arm can move freely, and dashed if the other arm is clamped.
    - Frequencies at which a passivity or stability criterion fails are shaded.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator

from ...analysis import MAX_COMMON_DELAY_S, LinearAnalysis, PortAnalysis
from ...core import Array
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
"""Upper end of the axis of Llewellyn's parameter. Differences between values far above 1 are
irrelevant.
"""
_CROWDED_TICKS_HZ = (0.1, 1.0, 10.0)
"""Axis ticks of a narrow panel, without labels at the ends, which would overlap those of the
next panel.
"""


def draw_port_impedance(ports: PortAnalysis, size: FigureSize = REPORT_SIZE) -> Figure:
    """Draws the impedance that operators feel at every joint, over frequency.

    The impedance is the ratio of force to velocity. Each joint has a magnitude panel above a
    phase panel. If there are many joints, the panels wrap into several rows.

    Args:
        ports: Analysis of the ports at which operators hold the arms.
        size: Width, font sizes and resolution of the figure.
    """
    if "unstable" in (ports.verdict, ports.clamped_verdict):
        return style.empty_figure("The loop is unstable: it has no impedance.", size)

    joints = sorted({response.joint for response in ports.transparency})
    rows = style.arrange_joints(len(joints), size.narrow)
    columns = min(len(rows[0]), len(joints))
    is_crowded = size.narrow or columns > 2
    with style.styled_figure(size, 3.8 * len(rows)) as figure:
        grid = style.add_panels(figure, 2 * len(rows), columns, sharex=True, sharey="row")
        for index, joint in enumerate(joints):
            row, column = divmod(index, columns)
            magnitude = grid[2 * row, column]
            phase = grid[2 * row + 1, column]
            _plot_impedance(ports, joint, magnitude, phase)

            title = ports.name_port(joint)
            if is_crowded:
                phase.set_xticks(_CROWDED_TICKS_HZ)
            else:
                title += _describe_ratios(ports, joint)
            magnitude.set_title(title)
            is_lowest_in_column = index + columns >= len(joints)
            if is_lowest_in_column:
                phase.set_xlabel("frequency (Hz)")
                phase.xaxis.set_tick_params(labelbottom=True)
            if column == 0:
                magnitude.set_ylabel(f"|Z| ({ports.impedance_unit(joint)})")
                phase.set_ylabel("phase (degrees)")
                phase.yaxis.set_major_locator(MultipleLocator(45.0))

        # The last row can have fewer joints than columns.
        joints_in_last_row = len(joints) - columns * (len(rows) - 1)
        unused: list[Axes] = [*grid[-2:, joints_in_last_row:].flat]
        for axes in unused:
            axes.set_visible(False)
        style.add_legend(figure, _list_impedance_entries(ports))
    return figure


def _list_impedance_entries(ports: PortAnalysis) -> list[tuple[str, dict[str, Any]]]:
    """Returns the labels and line styles for the legend of an impedance figure.

    The impedance that an operator feels at one arm depends on whether another arm is free or
    clamped.
    """
    operator_sites = dict.fromkeys(response.operator_site for response in ports.transparency)
    entries: list[tuple[str, dict[str, Any]]] = [
        (f"felt at {site}", {"color": _site_colour(ports, site)}) for site in operator_sites
    ]

    other_site = ports.transparency[0].other_site
    clamped_line = {"color": style.REFERENCE, "linestyle": _CLAMPED}
    entries.append((f"{other_site} free", {"color": style.REFERENCE}))
    entries.append((f"{other_site} clamped", clamped_line))
    entries.append(("band of the ratio", {**_BAND, "alpha": 0.4, "linewidth": 6.0}))
    return entries


def _plot_impedance(ports: PortAnalysis, joint: int, magnitude: Axes, phase: Axes) -> None:
    """Plots the impedance that each operator feels at one joint, over frequency.

    Each arm has two lines: the impedance while another arm is free, and while it is clamped.

    Args:
        ports: Analysis of the ports at which operators hold the arms.
        joint: Number of the joint or axis, starting from 1.
        magnitude: Panel of the magnitude.
        phase: Panel of the phase.
    """
    responses = [response for response in ports.transparency if response.joint == joint]
    for number, response in enumerate(responses):
        frequency_hz = _convert_to_hz(response.w_rad_s)
        width = 1.1
        if len(responses) > 1:
            # Later lines are thinner, so that lines that coincide all stay visible.
            width = 2.0 - 1.2 * number / (len(responses) - 1)
        for impedance, dashes in ((response.free, "-"), (response.clamped, _CLAMPED)):
            line_style: dict[str, Any] = {
                "color": _site_colour(ports, response.operator_site),
                "linestyle": dashes,
                "linewidth": width,
            }
            magnitude.loglog(frequency_hz, np.abs(impedance), **line_style)
            # The phase is continuous, and starts between -180 and 180 degrees.
            angle_rad = np.unwrap(np.angle(impedance))
            phase.semilogx(frequency_hz, np.rad2deg(angle_rad), **line_style)
    for axes in (magnitude, phase):
        axes.axvspan(*responses[0].band_hz, **_BAND)
        axes.set_xlim(frequency_hz[0], frequency_hz[-1])


def _describe_ratios(ports: PortAnalysis, joint: int) -> str:
    """Returns a title line with each site's ratio of clamped to free impedance, in dB."""
    ratios = [
        f"{response.operator_site} {response.ratio_db:+.1f} dB"
        for response in ports.transparency
        if response.joint == joint
    ]
    text = f"\nclamped / free {', '.join(ratios)}"
    return text.replace("-", "\N{MINUS SIGN}")


def _site_colour(ports: PortAnalysis, site: str) -> str:
    """Returns the colour of a site."""
    index = ports.sites.index(site) % len(SITE_COLOURS)
    return list_site_colours(ports.scenario)[index]


def _convert_to_hz(w_rad_s: Array) -> Array:
    """Converts angular frequencies from rad/s to Hz."""
    return w_rad_s / (2.0 * np.pi)


def draw_port_passivity(ports: PortAnalysis, size: FigureSize = REPORT_SIZE) -> Figure:
    """Draws measures of passivity and of stability with passive operators, over frequency.

    The upper panel shows the smallest eigenvalue of Y + Y^H divided by its bound 2 norm(Y),
    where Y is the admittance matrix of the ports (velocity per force). A negative value means
    that the loop can generate energy. At -1, it returns all the energy that an operator
    supplies.

    The lower panel shows the criterion for stability with any passive operators. For two sites,
    this is Llewellyn's parameter of each joint, which must be at least 1. For more sites, it is
    the margin under the best weights, which must be positive.

    Args:
        ports: Analysis of the ports at which operators hold the arms.
        size: Width, font sizes and resolution of the figure.
    """
    if ports.verdict == "unstable":
        return style.empty_figure(
            "The loop without operators is unstable: it cannot be passive.", size
        )

    with style.styled_figure(size, 3.9) as figure:
        above, below = style.add_panels(figure, 2, 1, sharex=True)[:, 0]
        _plot_eigenvalues(ports, above)
        if len(ports.sites) == 2:
            _plot_parameters(ports, below)
        else:
            _plot_margin(ports, below)
        below.set(xlim=ports.band_hz, xlabel="frequency (Hz)")
        figure.align_ylabels()
        style.add_legend(figure, _list_passivity_entries(ports))
    return figure


def _list_passivity_entries(ports: PortAnalysis) -> list[tuple[str, dict[str, Any]]]:
    """Returns the legend entries for the passivity figure."""
    noun = "axes" if ports.axes else "joints"
    entries = [(f"all {noun}", _ALL)]
    entries += [
        (f"{ports.name_port(joint)} alone", _style_joint(joint)) for joint in ports.joints
    ]
    if ports.proof is not None:
        entries.append((f"all {noun}, in r (weighted)", _PROOF))
    entries.append(("fails", {**_FAILS, "linewidth": 6.0}))
    return entries


def _style_joint(joint: int) -> dict[str, Any]:
    """Returns the line options of a joint."""
    return {
        "color": SITE_COLOURS[joint % len(SITE_COLOURS)],
        "linestyle": style.DASHES[joint % len(style.DASHES)],
        "linewidth": 1.0,
    }


def _plot_over_hz(axes: Axes, w_rad_s: Array, values: Array, **options: Any) -> None:
    """Plots values over angular frequencies, both of shape (F,), on an axis in Hz."""
    axes.semilogx(_convert_to_hz(w_rad_s), values, **options)


def _shade_failures(axes: Axes, bands: Iterable[tuple[float, float]]) -> None:
    """Shades the frequency bands, in Hz, in which a curve is below its limit."""
    for band in bands:
        axes.axvspan(*band, **_FAILS)


def _plot_eigenvalues(ports: PortAnalysis, axes: Axes) -> None:
    """Plots the smallest eigenvalue of Y + Y^H over frequency, per joint and for all joints.

    Y is the admittance matrix of the ports at which operators hold the arms. Eigenvalues below
    0 mean that the arms could supply energy to an operator. They are divided by their bound,
    which is twice the norm of Y.
    """
    curves = [(passivity, _style_joint(joint)) for joint, passivity in ports.joints.items()]
    if ports.proof is not None:
        curves.append((ports.proof, _PROOF))
    curves.append((ports.velocity, _ALL))
    for passivity, line_style in curves:
        minima = passivity.minima
        relative = minima.values / (2.0 * passivity.size)
        _plot_over_hz(axes, minima.w_rad_s, relative, **line_style)
    _shade_failures(axes, ports.velocity.minima.below)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set(ylim=(-1.08, 1.08), ylabel=r"$\lambda_{\min}(Y+Y^{\mathrm{H}})\,/\,2\|Y\|$")


def _plot_parameters(ports: PortAnalysis, axes: Axes) -> None:
    """Plots Llewellyn's parameter of every joint, with the limit 1."""
    for two_port in ports.two_ports:
        line = _style_joint(two_port.joint)
        minima = two_port.minima
        _plot_over_hz(axes, minima.w_rad_s, minima.values, **line)
        _shade_failures(axes, minima.below)
    axes.axhline(1.0, **style.LIMIT_LINE)
    axes.set(ylim=(-1.2, _MAX_SHOWN_PARAMETER), ylabel="Llewellyn's parameter")


def _plot_margin(ports: PortAnalysis, axes: Axes) -> None:
    """Plots the smallest eigenvalue under the best weights, with the limit 0."""
    minima = ports.absolute
    _plot_over_hz(axes, minima.w_rad_s, minima.values, **_ALL)
    _shade_failures(axes, minima.below)
    axes.axhline(0.0, **style.LIMIT_LINE)
    axes.set_ylabel("margin, best weights")


_SIZE = REPORT_SIZE._replace(width_in=COLUMN_IN)
_HEIGHT_IN = 3.2
_UNSTABLE: Any = {"color": "#cc3311", "alpha": 0.08, "linewidth": 0.0, "zorder": 0.3}


def draw_root_map(analysis: LinearAnalysis) -> Figure:
    """Draws the characteristic roots of the linearised control loop in the complex plane.

    A root with a positive real part belongs to a growing motion, which means that the loop is
    unstable. This half of the plane is shaded. Different markers distinguish the roots of the
    loop in continuous time from those of the loop as executed in ticks.

    Args:
        analysis: The linear analysis.
    """
    with style.styled_figure(_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        _plot_roots(
            axes=axes,
            roots=[root.s for root in analysis.continuous.roots],
            mark="o",
            colour=SITE_COLOURS[0],
            label="continuous",
        )
        if analysis.sampled is not None:
            _plot_roots(
                axes=axes,
                roots=[root.s for root in analysis.sampled.roots],
                mark="x",
                colour=SITE_COLOURS[1],
                label="as computed",
            )
        # Some roots are 0 in every such loop, for example because all arms may move together.
        zero_count = analysis.decisive.zeros
        if zero_count:
            axes.plot(
                [0.0],
                [0.0],
                "s",
                markersize=9.0,
                fillstyle="none",
                color=style.FAINT,
                label=f"zero by structure ({zero_count})",
            )

        # The unstable half is visible even if all roots are stable.
        low, high = axes.get_xlim()
        high = max(high, 0.06 * (high - low), 0.0)
        axes.axvline(0.0, **style.LIMIT_LINE)
        axes.axvspan(0.0, high, **_UNSTABLE)
        axes.set(xlim=(low, high), xlabel="real part (1/s)", ylabel="imaginary part (rad/s)")
        figure.legend(loc="outside upper center", ncols=3, handlelength=1.0, columnspacing=1.0)
    return figure


def _plot_roots(
    axes: Axes, roots: Sequence[complex], mark: str, colour: str, label: str
) -> None:
    """Plots characteristic roots of a linear system in the complex plane.

    The system is unstable if any root has a positive real part. For each complex root, its
    conjugate is plotted too.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        roots: The roots. Each complex pair is listed only once.
        mark: Matplotlib marker.
        colour: Colour of the markers.
        label: Label in the legend.
    """
    conjugates = [root.conjugate() for root in roots if root.imag]
    all_roots = np.array([*roots, *conjugates])
    axes.plot(
        all_roots.real,
        all_roots.imag,
        mark,
        markersize=4.5,
        fillstyle="none",
        color=colour,
        label=label,
    )


_MARKS = ("o", "s", "^", "v")
_LOST: Any = {"marker": "x", "color": "#cc3311", "linestyle": "none", "markersize": 5.0}
_TRANSPORT_STEP = 0.22
"""Distance between the transports of a case, relative to the distance between cases."""


def draw_network_delays(facts: Mapping[str, Any]) -> Figure:
    """Draws the measured one-way delays of a network, in ms, for several loads and transports.

    Each load combines a message size in bytes with a message rate per second. The load of the
    benchmarked scenario is shaded. The transports are the network protocols whose delays were
    measured.

    Args:
        facts: Results of the network benchmark, from `NetworkBenchmark.to_dict`.
    """
    rows = facts["rows"]
    needs = facts["needs"]
    cases = list(dict.fromkeys((row["bytes"], row["rate_hz"]) for row in rows))
    transports = list(dict.fromkeys(row["transport"] for row in rows))
    middle_transport = (len(transports) - 1) / 2

    with style.styled_figure(REPORT_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        for row in rows:
            transport = transports.index(row["transport"])
            case = cases.index((row["bytes"], row["rate_hz"]))
            # The transports of a case stand side by side around the middle of the case.
            x = case + _TRANSPORT_STEP * (transport - middle_transport)
            _plot_case(axes, x, row, transport)
        _plot_bounds(axes, facts)
        axes.set_yscale("log")

        labels = [f"{size} B\n{rate:g} Hz" for size, rate in cases]
        needed_case = cases.index((needs["sample_bytes"], needs["rate_hz"]))
        labels[needed_case] += f"\n{facts['scenario']}"
        axes.axvspan(
            needed_case - 0.45,
            needed_case + 0.45,
            color=style.FAINT,
            alpha=0.15,
            linewidth=0.0,
            zorder=0.3,
        )
        axes.set_xticks(range(len(cases)), labels)
        axes.set(xlim=(-0.5, len(cases) - 0.5), ylabel="one way: p50, p99, largest (ms)")
        axes.grid(visible=False, axis="x")
        style.place_legend(figure, _list_network_handles(rows, transports))
    return figure


def _list_network_handles(
    rows: Sequence[Mapping[str, Any]], transports: Sequence[str]
) -> list[Line2D]:
    """Returns the Matplotlib artists for the legend of network delays."""
    handles = []
    for number, name in enumerate(transports):
        handles.append(
            Line2D(
                [],
                [],
                label=name,
                color=SITE_COLOURS[number],
                marker=_MARKS[number % len(_MARKS)],
                linewidth=1.1,
            )
        )
    if any(row["lost"] for row in rows):
        handles.append(Line2D([], [], label="some lost", **_LOST))
    return handles


def _plot_case(axes: Axes, x: float, row: Mapping[str, Any], transport: int) -> None:
    """Plots the delays of one transport in one case, with a cross if messages were lost.

    The marker is the median. A thick line extends from the median to the 99th percentile, and a
    thin line to the maximum.

    Args:
        axes: Panel of the figure, as Matplotlib axes.
        x: Position along the axis of cases.
        row: Row of the benchmark.
        transport: Index of the transport, which determines its colour and marker.
    """
    times_us = row["one_way_us"]
    if times_us is not None:  # None if all messages were lost
        p50_ms = times_us["p50"] / 1e3
        p99_ms = times_us["p99"] / 1e3
        largest_ms = times_us["max"] / 1e3
        colour = SITE_COLOURS[transport % len(SITE_COLOURS)]
        mark = _MARKS[transport % len(_MARKS)]
        axes.plot([x, x], [p50_ms, largest_ms], color=colour, linewidth=0.8)
        axes.plot([x, x], [p50_ms, p99_ms], color=colour, linewidth=2.6, solid_capstyle="butt")
        axes.plot([x], [p50_ms], marker=mark, color=colour, markersize=4.5)
        axes.plot([x], [largest_ms], marker="_", color=colour, markersize=6.0)
    if row["lost"]:
        axes.plot([x], [0.04], transform=axes.get_xaxis_transform(), **_LOST)


def _plot_bounds(axes: Axes, facts: Mapping[str, Any]) -> None:
    """Draws horizontal lines at the times with which the delays should be compared, in ms.

    These are the tick period of the scenario, the time for which its links hold samples, and
    the ends of intervals of stable delays: of the first interval, and of those that contain a
    measured age.
    """
    needs = facts["needs"]
    stable_ms = needs["stable_ms"] or []
    ages_ms = [
        transport["age_ms"]
        for transport in facts["transports"]
        if transport["age_ms"] is not None
    ]
    bounds = [
        ("one period", 1e3 / needs["rate_hz"], "center"),
        ("held by links", needs["held_ms"], "top"),
    ]

    for interval in stable_ms:
        low_ms, high_ms = interval
        has_age = any(low_ms <= age_ms <= high_ms for age_ms in ages_ms)
        if not has_age and interval != stable_ms[0]:
            continue
        bounds.append((f"stable from {low_ms:.4g} ms", low_ms, "top"))
        # An interval that ends where the search ended has no upper edge.
        if high_ms < 1e3 * MAX_COMMON_DELAY_S:
            bounds.append((f"stable up to {high_ms:.4g} ms", high_ms, "bottom"))

    for label, time_ms, alignment in bounds:
        if time_ms:  # a logarithmic axis has no zero
            axes.axhline(time_ms, **style.LIMIT_LINE)
            axes.annotate(
                label,
                (1.01, time_ms),
                xycoords=("axes fraction", "data"),
                va=alignment,
                fontsize=REPORT_SIZE.tick_pt,
            )


_RUN_MARKS = {
    True: ("o", "run decays"),
    False: ("x", "run grows"),
    None: ("s", "run undecided"),
}
"""Marker and label of a run, keyed by `stable`."""


def draw_arm_gains(facts: Mapping[str, Any]) -> Figure:
    """Draws the largest stable stiffness of an arm that follows another arm over delayed links.

    The horizontal axis is the delay. The vertical axis is the stiffness K of a joint divided by
    its inertia, in 1/s^2. Markers show the chosen gains, and the simulated runs with which the
    largest stable stiffness was checked.

    Args:
        facts: Results of the search for gains, from `ArmGains.to_dict`.
    """
    stability_edge = facts["edge"]
    margin = facts["margin"]
    curve = np.array(facts["curve"])
    delay_ms = 1e3 * curve[:, 0]
    largest_k_per_s2 = curve[:, 1]
    used_k_per_s2 = stability_edge["used_per_s2"] / margin
    # Each mark is a stiffness over inertia, a marker of Matplotlib, and a text.
    marks = [(used_k_per_s2, "D", f"the gains, margin {margin:g}")]
    for run in facts["runs"]:
        if run["share"]:
            mark, label = _RUN_MARKS[run["stable"]]
            marks.append((run["share"] * stability_edge["k_per_s2"], mark, label))

    with style.styled_figure(_SIZE, _HEIGHT_IN) as figure:
        axes = figure.add_subplot()
        axes.loglog(
            delay_ms,
            largest_k_per_s2,
            color=SITE_COLOURS[0],
            linewidth=1.4,
            label="edge, constant delay",
        )

        # The region above the edge is unstable.
        axes.fill_between(
            delay_ms, largest_k_per_s2, 10.0 * largest_k_per_s2.max(), **_UNSTABLE
        )

        for marked_k_per_s2, mark, label in marks:
            axes.plot(
                facts["age_ms"],
                marked_k_per_s2,
                mark,
                color=SITE_COLOURS[1],
                markersize=4.5,
                label=label,
            )
        axes.set(
            xlim=(delay_ms[0], delay_ms[-1]),
            ylim=(0.3 * largest_k_per_s2.min(), 3.0 * largest_k_per_s2.max()),
        )
        axes.set(xlabel="delay of each link (ms)", ylabel=r"K / inertia (1/s$^2$)")
        figure.legend(loc="outside upper center", ncols=2, handlelength=1.2, columnspacing=1.0)
    return figure
