"""Composes the output of `trilat linear`: whether small motions of the coupled arms decay.

The text contains the rest pose at which the arms are linearised, the delays, a table of the
rightmost characteristic roots, the verdict, the largest stable delay, what operators feel, and
the values at which settings such as gains change the stability.

Invariant:
    - Every number has its unit.
    - Roots that are structurally zero, whatever the parameters, are counted but not listed,
      because they are irrelevant to stability.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from ..analysis import QUOTED_AT_HZ, LinearAnalysis, Passivity, PortAnalysis
from ..core import Array
from ..errors import count_nouns
from .decision_text import describe_tick_span
from .result_text import Block, MarkedText, TextTable

_COLOURS = {"stable": "green", "unstable": "red", "at the edge": "yellow"}


def compose_linear(analysis: LinearAnalysis) -> Iterator[Block]:
    """Yields the text that says whether small motions of the coupled arms decay.

    The arms, their controllers and the network delays form a loop, which the analysis has
    linearised at a rest pose (equilibrium). The text contains, in order, the equilibrium, the
    delays, the characteristic roots, the stability verdict, the delay margin, notes, what
    operators feel at the arms, and the values of settings at which the stability changes.

    Args:
        analysis: The linear analysis.
    """
    yield from _describe_equilibrium(analysis)
    yield from _describe_effective_delays(analysis)
    yield ""
    yield _tabulate_roots(analysis)
    yield _describe_zero_roots(analysis)

    verdict, _, explanation = _describe_linear_verdict(analysis).partition(": ")
    yield MarkedText(f"[{_COLOURS[verdict]}]{verdict}[/]:", explanation)

    margin = analysis.margin.description
    yield f"delay margin, continuous loop, one delay on all links: {margin}"
    yield from (f"note: {note}" for note in analysis.notes)
    if analysis.ports is not None:
        yield from describe_ports(analysis.ports)
    yield from _describe_scans(analysis)


def _describe_scans(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields lines with the values of settings at which the loop becomes stable or unstable.

    An example is "control.Kd from 0 to 10: stable from 1.2 on (3.4 rad/s)".

    Args:
        analysis: The analysis, with one scan per setting.
    """
    for scan in analysis.scans:
        edge_texts = []
        for edge in scan.edges:
            state = "stable" if edge.stable_above else "unstable"
            edge_texts.append(
                f"{state} from {edge.value:.6g} on ({edge.omega_rad_s:.4g} rad/s)"
            )
        unchanged = f"stability of {analysis.scenario.name} does not change"
        result = ", ".join(edge_texts) or unchanged
        yield f"{scan.key} from {scan.low:g} to {scan.high:g}: {result}"


def _describe_equilibrium(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields lines that describe the equilibrium pose at which the arms were linearised.

    The lines state how the equilibrium was computed, its residual, and the pose of each arm. If
    all arms have the same joint angles, these are given on a single line.

    Args:
        analysis: The analysis.
    """
    rest = analysis.rest
    yield f"rest: {rest.how}; residual {rest.residual:.1g}"
    sites = analysis.conditions.sites
    # The rows of `rest.q` have the length of the longest arm.
    joint_angles = [q[: site.layout.joints] for site, q in zip(sites, rest.q, strict=True)]

    is_joint_space = not sites[0].layout.task
    largest_difference_rad = float(np.ptp(rest.q, axis=0).max())
    half_last_digit_rad = 5e-5  # angles are printed with four decimals
    if is_joint_space and largest_difference_rad < half_last_digit_rad:
        yield f"  all sites at ({_list_numbers(joint_angles[0])}) rad"
        return

    for site, q, pose in zip(sites, joint_angles, analysis.end_effectors, strict=True):
        text = f"  {site.name} at ({_list_numbers(q)}) rad"
        if len(pose):
            units = "m and rad" if len(pose) > 3 else "m"
            text += f", its end effector at ({_list_numbers(pose)}) {units}"
        yield text


def _list_numbers(values: Array) -> str:
    """Formats numbers with four decimals, separated by commas."""
    return ", ".join(f"{value:.4f}" for value in values)


def _describe_effective_delays(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields lines for the user about the delays with which arms follow each other.

    There is one line per link, or a single line if all delays are equal. For a delay that
    varies during a run, the mean is given.

    Args:
        analysis: Result of the linear stability analysis.
    """
    names = analysis.scenario.names
    age_s = analysis.conditions.age_s
    quantity = "mean delay in use" if analysis.conditions.varying else "delay in use"
    # Site i follows site j over a link if the weight alpha[i, j] is not 0.
    links = list(zip(*np.nonzero(analysis.conditions.alpha), strict=True))
    distinct_ages_s = {float(age_s[i, j]) for i, j in links}
    if len(distinct_ages_s) == 1:
        [common_age_s] = distinct_ages_s
        yield f"{quantity} on every link: {1e3 * common_age_s:.4g} ms"
        return

    for i, j in links:
        yield f"{quantity} on {names[j]}->{names[i]}: {1e3 * age_s[i, j]:.4g} ms"


def _tabulate_roots(analysis: LinearAnalysis) -> TextTable:
    """Returns a table of the rightmost characteristic roots, which determine stability.

    A motion with root s evolves as exp(s t), and grows if the real part of s is positive. The
    table describes the motion of each root.

    The roots are those of the continuous loop, whose controllers act in continuous time. If any
    root of the sampled loop, whose controllers compute once per tick, is different, two more
    columns contain the roots of the sampled loop. If the delays differ from tick to tick, the
    table contains only the roots of the sampled loop over a span of ticks, because the
    continuous loop uses mean delays.

    Args:
        analysis: The analysis.

    Returns:
        The table with one row per root: real part in 1/s, imaginary part in rad/s, frequency in
            Hz, damping ratio, number of equal roots ("modes"), and the states that move most.
    """
    ticks_differ = analysis.decisive.span_s is not None
    roots = analysis.decisive.roots if ticks_differ else analysis.continuous.roots
    # For each root, the root of the sampled loop if it is to be shown beside it.
    sampled_roots = [
        None if ticks_differ else analysis.find_sampled_root(root) for root in roots
    ]
    has_sampled_columns = any(sampled is not None for sampled in sampled_roots)

    rows = []
    for root, sampled in zip(roots, sampled_roots, strict=True):
        # The imaginary part of a real root may be -0.0, which would be printed as "-0".
        row = [
            f"{root.s.real:.4g}",
            f"{root.s.imag:.4g}" if root.s.imag else "0",
            f"{root.s.imag / (2.0 * math.pi):.4g}" if root.s.imag else "0",
            f"{root.damping:.4g}",
            str(root.multiplicity),
        ]

        if has_sampled_columns and sampled is None:
            row += ["same", "same"]
        elif sampled is not None:
            row += [f"{sampled.s.real:.4g}", f"{sampled.s.imag:.4g}"]
        rows.append([*row, describe_moving_states(root.states)])

    heads = ["re 1/s", "im rad/s", "Hz", "damping", "modes"]
    if has_sampled_columns:
        heads += ["re as computed", "im as computed"]
    heads.append("what moves")
    return TextTable(heads, rows, align="r" * (len(heads) - 1) + "l")


def describe_moving_states(states: Sequence[str]) -> str:
    """Returns a phrase that lists the states that take part in a motion, with their sites.

    Each state is listed once, with all of its sites: "q2 of m1, m2, s" stands for the second
    joint angle of three sites.

    Args:
        states: Names of the states, each prefixed with the name of its site, such as "m1.q2".
    """
    sites: dict[str, list[str]] = {}
    for state in states:
        site, _, name = state.partition(".")
        sites.setdefault(name, []).append(site)
    phrases = [f"{name} of {', '.join(sorted(owners))}" for name, owners in sites.items()]
    return "; ".join(phrases)


def _describe_zero_roots(analysis: LinearAnalysis) -> str:
    """Returns a sentence about the roots that are structurally zero.

    For example, if all arms were moved to another common pose, no torque would bring them back.
    Such roots are irrelevant to the stability of the loop.

    Args:
        analysis: The analysis.
    """
    zero_count = analysis.decisive.zeros
    if not zero_count:
        return "no root at zero"

    subject = "root is" if zero_count == 1 else "roots are"

    origins = "shared poses"
    if analysis.conditions.sites[0].layout.task:
        origins += ", joints that the task leaves free"
    return (
        f"{zero_count} {subject} zero by structure: {origins}, and estimates without excitation"
    )


def _describe_linear_verdict(analysis: LinearAnalysis) -> str:
    """Returns a sentence that says whether small motions of the coupled arms decay.

    The sentence states the growth rate and the frequency of the slowest decaying, or fastest
    growing, motion, which are given by the characteristic root with the largest real part.
    Motions that neither decay nor grow but keep a constant speed ("drifting") are only counted.
    An example is "stable: the slowest motion goes as exp(-1.2 t / s) at 3.4 rad/s, as computed
    tick by tick".

    Args:
        analysis: Result of the linear stability analysis. Stability is determined by the roots
            in `decisive`: those of the sampled loop if it could be analysed, otherwise those of
            the continuous loop.

    Returns:
        The sentence, which starts with the verdict "stable", "unstable" or "at the edge".
    """
    rightmost = analysis.decisive.rightmost
    drifting_count = analysis.decisive.drifting
    motions = "motions keep their" if drifting_count > 1 else "motion keeps its"
    drift = f"{drifting_count} {motions} speed"
    if rightmost is None:
        return f"{analysis.verdict}: {drift if drifting_count else 'nothing moves'}"

    growth = f"exp({rightmost.s.real:.4g} t / s)"
    if rightmost.s.imag:
        growth += f" at {rightmost.s.imag:.4g} rad/s"
    is_of_sampled_loop = analysis.sampled is not None
    if is_of_sampled_loop:
        spectrum = analysis.decisive
        span = describe_tick_span(
            spectrum.span_s, spectrum.deviation_per_s, repeats=spectrum.is_exact
        )
        ticks = span.removeprefix(",") or " tick by tick"
        growth += f", as computed{ticks}"

    motion = "the slowest motion"
    if drifting_count:
        motion = f"{drift}, and the slowest of the other motions"
    return f"{analysis.verdict}: {motion} goes as {growth}"


_MAX_BANDS = 3
"""Maximum number of frequency bands to list."""
_MAX_SEPARATE_JOINTS = 2
"""Maximum number of joints for which each failing two-port is printed on its own line."""
WEIGHTS_ALIKE = 1e-9
"""Maximum difference between weights that are considered equal."""


def describe_ports(ports: PortAnalysis) -> list[str]:
    """Returns lines that tell the user what operators feel and whether the arms stay stable.

    The lines cover three properties:

    - passivity: the arms never supply more energy to the operators than they have received,
    - absolute stability: the arms are stable with any passive operators,
    - transparency: the impedance that an operator feels while another arm is free or clamped.

    If the arms are unstable even without operators, the text says so and omits the lines about
    these properties. If the arms are unstable while one of them is clamped, the lines about
    transparency are omitted.

    Args:
        ports: Results for the joints at which the operators act.
    """
    lines = _describe_conditions(ports)
    if ports.verdict == "unstable":
        lines.append(
            "  the loop without operators is unstable: it is not passive, and has no impedance"
        )
        return lines

    lines += _describe_port_passivity(ports)
    absolute = _describe_absolute_stability(ports)
    lines.append(f"  a passive operator in {ports.speed} per site, best weights: {absolute}")
    lines += [f"    Llewellyn, {text}" for text in _describe_two_ports(ports)]

    if ports.measured is not None:
        bands = ports.measured.below
        result = "stable"
        if bands:
            result = f"not shown {_list_bands(bands)}, where the operators damp too little"
        lines.append(f"  any of the measured operators at each master: {result}")

    if ports.clamped_verdict == "unstable":
        clamped = ports.transparency[0].other_site
        lines.append(
            f"  with {clamped} clamped the loop is unstable: it has no steady impedance"
        )
        return lines

    return [*lines, *_describe_transparency(ports)]


def _describe_conditions(ports: PortAnalysis) -> list[str]:
    """Returns lines about the analysed ports and the frequency grid."""
    low_hz, high_hz = ports.band_hz
    conditions = f"operators and environments off, {low_hz:g}-{high_hz:g} Hz"
    grid = "(a grid refined at minima: evidence, no proof)"
    lines = [f"Ports of {', '.join(ports.sites)}, {conditions} {grid}"]
    if ports.resolved_hz < high_hz:
        beyond = f"above {ports.resolved_hz:.3g} Hz"
        lines.append(f"  {beyond} the grid does not follow the phase of the longest delay")
    return lines


def _describe_port_passivity(ports: PortAnalysis) -> list[str]:
    """Returns lines about the passivity of all ports together, of each joint, and in the proof.

    A port is a joint or axis at which an operator holds an arm. The arms are passive if they
    never supply more energy to the operators than they have received. The stability proof
    requires operators that are passive with respect to r, the velocity plus Lambda times the
    error e, instead of the velocity.

    At zero frequency, the admittance Y (velocity per torque) may have a pole, because a
    constant torque makes a velocity grow. For free masses, this is compatible with passivity.

    Args:
        ports: Results for the ports.
    """
    lines = []
    pole = ports.pole
    if pole.order:
        meaning = "as free masses have" if pole.passive else "which no passive network has"
        lines.append(f"  at zero frequency Y has a pole of order {pole.order}, {meaning}")

    all_ports_text = _describe_passivity(ports.velocity, ports.impedance_unit(), ports.kind)
    lines.append(f"  operators passive in {ports.speed}, coupled or not: {all_ports_text}")

    # Each joint alone, without operators at the others.
    for joint, passivity in ports.joints.items():
        unit = ports.impedance_unit(joint)
        joint_text = _describe_passivity(passivity, unit, ports.kind)
        lines.append(f"    {ports.name_port(joint)} alone: {joint_text}")

    if ports.proof is not None:
        premise = f"r = {ports.speed} + Lambda e, the proof's premise"
        proof_text = _describe_proof(ports, ports.proof)
        lines.append(f"  operators passive in {premise}: {proof_text}")
    return lines


def _describe_proof(ports: PortAnalysis, proof: Passivity) -> str:
    """Returns a sentence about the condition on operators that the stability proof assumes.

    The proof assumes that operators are passive with respect to r, the velocity plus Lambda
    times the error e. A passive operator never returns more energy than it has received.

    Args:
        ports: Results for the joints or axes at which operators act.
        proof: Passivity with respect to r, with the joints of each site weighted as in the
            proof.
    """
    beta = ", ".join(f"{weight:.3g}" for weight in ports.beta)
    text = f"{_describe_passivity(proof)}; sites weighted {beta}"
    have_different_weights = np.ptp(ports.beta) > WEIGHTS_ALIKE
    if have_different_weights:
        text += ", which says nothing about operators coupled to each other"
    if proof.passive or ports.estimates_true:
        return text
    return (
        f"{text}; the estimates are not true, and the proof counts the energy that they store"
    )


def _describe_passivity(passivity: Passivity, unit: str = "", kind: str = "") -> str:
    """Returns a sentence on whether the arms are passive, and how much damping is missing.

    Passive arms never supply energy to an operator. An example of a negative result is "not
    passive at 2-5 Hz; least eigenvalue -0.1 at 3 Hz; adding 0.05 N m s/rad at each joint would
    make it passive".

    Args:
        passivity: Result for one joint or for all joints at which operators act.
        unit: Unit of the missing damping. Empty to omit the damping.
        kind: "joint" or "axis", depending on where operators act.
    """
    if passivity.passive:
        return "passive"

    minima = passivity.minima
    least_text = f"least eigenvalue {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    text = f"not passive {_list_bands(minima.below)}; {least_text}"

    if not unit:
        return text
    if math.isinf(passivity.lacking_nm_s_rad):
        plural = "axes" if kind == "axis" else "joints"
        return f"{text}; no damping at the {plural} would make it passive"

    damping = f"{passivity.lacking_nm_s_rad:.3g} {unit}"
    return f"{text}; adding {damping} at each {kind} would make it passive"


def _list_bands(bands: Sequence[tuple[float, float]]) -> str:
    """Formats frequency bands as text, at most `_MAX_BANDS` of them."""
    ranges = [f"{from_hz:.3g}-{to_hz:.3g}" for from_hz, to_hz in bands[:_MAX_BANDS]]
    text = f"at {', '.join(ranges)} Hz"
    if len(bands) > _MAX_BANDS:
        text += f" and {count_nouns(len(bands) - _MAX_BANDS, 'range')} more"
    return text


def _describe_absolute_stability(ports: PortAnalysis) -> str:
    """Returns a sentence on whether passive operators can make the loop unstable.

    The sentence includes the margin.
    """
    minima = ports.absolute
    if not minima.below:
        return "stable"
    operators = "some make" if len(ports.sites) <= 3 else "some may make"
    margin = f"margin {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    return f"{operators} it unstable {_list_bands(minima.below)}; {margin}"


def _describe_two_ports(ports: PortAnalysis) -> list[str]:
    """Returns lines about Llewellyn's criterion, which determines stability for two sites.

    A two-port is one joint of two sites, with an operator at each site. The arm of a third site
    is free or clamped. The criterion fails if Llewellyn's parameter is below 1 in some
    frequency band, in which case some passive operators make the two-port unstable. There is
    one line per failing two-port, or group of them, and a last line gives the number of
    two-ports that satisfy the criterion.

    Args:
        ports: Results for the joints at which the operators act.
    """
    # For arms with many joints, the failing two-ports of a pair of sites share a line.
    has_line_per_joint = len(ports.joints) <= _MAX_SEPARATE_JOINTS
    lines = []
    failing_count = 0
    for group in ports.group_failing_two_ports(by_joint=has_line_per_joint):
        failing_count += len(group)
        worst = min(group, key=lambda two_port: two_port.minima.least)

        # In task space, the numbers of the ports stand for axes with names.
        port_names = [str(ports.axes.get(port.joint, port.joint)) for port in group]
        subject = " and ".join(worst.sites)
        if worst.clamped:
            subject += f", {worst.clamped} clamped"
        subject += f", {ports.kind} {', '.join(port_names)}"

        frequencies = _list_bands(worst.minima.below)
        if len(group) > 1:
            # Several two-ports have too many bands to list, but one range contains them.
            bands = list(chain.from_iterable(port.minima.below for port in group))
            from_hz = min(band.from_hz for band in bands)
            to_hz = max(band.to_hz for band in bands)
            frequencies = f"within {from_hz:.3g}-{to_hz:.3g} Hz"
        least = f"least {worst.minima.least:.3g} at {worst.minima.least_hz:.3g} Hz"
        lines.append(f"{subject}: fails {frequencies}; {least}")

    holding_count = len(ports.two_ports) - failing_count
    if not holding_count:
        return lines

    subject = "the others"
    if not failing_count:
        subject = f"every pair and {ports.kind}"
        if any(two_port.clamped for two_port in ports.two_ports):
            subject += ", the third site free or clamped"
    return [*lines, f"{subject}: holds ({holding_count} two-ports)"]


def _describe_transparency(ports: PortAnalysis) -> Iterator[str]:
    """Yields a sentence about the impedance that an operator feels at each joint.

    The impedance (force over velocity) is given both for a free and for a clamped other arm.
    The larger the ratio of the two, the better the operator can feel what the other arm
    touches.
    """
    for transparency in ports.transparency:
        unit = ports.impedance_unit(transparency.joint)
        port_name = ports.name_port(transparency.joint)
        free, clamped = transparency.interpolate_magnitudes(QUOTED_AT_HZ)
        low_hz, high_hz = transparency.band_hz
        yield (
            f"  {transparency.operator_site} feels of {transparency.other_site}, {port_name}: "
            f"{free:.4g} {unit} free and {clamped:.4g} clamped at {QUOTED_AT_HZ:g} Hz; "
            f"over {low_hz:g}-{high_hz:g} Hz the ratio is {transparency.ratio_db:.3g} dB, "
            f"the difference {transparency.difference_nm_s_rad:.3g} {unit}"
        )
