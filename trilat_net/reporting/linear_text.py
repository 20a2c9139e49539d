"""A linear analysis as terminal text: equilibrium, delays, root table, verdict, delay margin
and ports.

Invariant: numbers have four digits and their units; roots that are zero by structure are
counted, not listed.
"""

import math
from collections.abc import Iterator

import numpy as np

from ..core.vectors import Array
from ..errors import count_nouns
from ..theory.frequency_search import FrequencyBand
from ..theory.linear_analysis import LinearAnalysis
from ..theory.linear_edge import EdgeScan
from ..theory.port_analysis import PortAnalysis, TwoPort
from ..theory.port_passivity import Passivity
from ..theory.port_response import QUOTED_AT_HZ, Transparency
from .result_text import Block, MarkedText, TextTable

_COLOURS = {"stable": "green", "unstable": "red", "at the edge": "yellow"}


def compose_linear(found: LinearAnalysis) -> Iterator[Block]:
    """Yields equilibrium, delays, roots, verdict, margin and notes, then the ports, then the
    edges.
    """
    yield from (*describe_equilibrium(found), *describe_effective_delays(found), "")
    yield tabulate_roots(found)
    yield describe_zero_roots(found)
    verdict, _, rest = describe_linear_verdict(found).partition(": ")
    yield MarkedText(f"[{_COLOURS[verdict]}]{verdict}[/]:", rest)
    yield f"delay margin, continuous loop, one delay on all links: {found.margin.description}"
    yield from (f"note: {note}" for note in found.notes)
    if found.ports is not None:
        yield from describe_ports(found.ports)
    yield from (_describe_scan(scan, found.scenario.name) for scan in found.scans)


def _describe_scan(scan: EdgeScan, name: str) -> str:
    edges = [
        f"{'stable' if one.stable_above else 'unstable'} from {one.value:.6g} on "
        f"({one.omega_rad_s:.4g} rad/s)"
        for one in scan.edges
    ]
    found = ", ".join(edges) or f"stability of {name} does not change"
    return f"{scan.key} from {scan.low:g} to {scan.high:g}: {found}"


def describe_equilibrium(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields the equilibrium and the way it was found."""
    rest = analysis.rest
    yield f"rest: {rest.how}; residual {rest.residual:.1g}"
    sites = analysis.conditions.sites
    angles = [q[: site.layout.joints] for site, q in zip(sites, rest.q, strict=True)]
    if not sites[0].layout.task and float(np.ptp(rest.q, axis=0).max()) < 5e-5:
        yield f"  all sites at ({_list_numbers(angles[0])}) rad"
        return
    for site, q, pose in zip(sites, angles, analysis.end_effectors, strict=True):
        at = (
            f", its end effector at ({_list_numbers(pose)}) m{' and rad' * (len(pose) > 3)}"
            * bool(len(pose))
        )
        yield f"  {site.name} at ({_list_numbers(q)}) rad{at}"


def _list_numbers(values: Array) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


def describe_effective_delays(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields the effective delays, in one line if they are equal; the means of those that vary."""
    names = analysis.scenario.names
    age_s = analysis.conditions.age_s
    what = "mean delay in use" if analysis.conditions.varying else "delay in use"
    links = list(zip(*np.nonzero(analysis.conditions.alpha), strict=True))
    values = {float(age_s[i, j]) for i, j in links}
    if len(values) == 1:
        yield f"{what} on every link: {1e3 * values.pop():.4g} ms"
        return
    for i, j in links:
        yield f"{what} on {names[j]}->{names[i]}: {1e3 * age_s[i, j]:.4g} ms"


def tabulate_roots(analysis: LinearAnalysis) -> TextTable:
    """Returns the rightmost roots, with those of the sampled loop next to them if any differs.

    Those of the sampled loop alone where ticks differ from each other: the continuous loop has
    mean delays.
    """
    spanned = analysis.decisive.span_s is not None
    roots = analysis.decisive.roots if spanned else analysis.continuous.roots
    sampled = [None if spanned else analysis.find_sampled_root(root) for root in roots]
    differ = any(other is not None for other in sampled)
    rows = []
    for root, other in zip(roots, sampled, strict=True):
        numbers = (
            f"{root.s.real:.4g}",
            f"{root.s.imag:.4g}" if root.s.imag else "0",
            f"{root.s.imag / (2.0 * math.pi):.4g}" if root.s.imag else "0",
            f"{root.damping:.4g}",
            str(root.multiplicity),
        )
        other_s = (
            ("same", "same")
            if other is None
            else (f"{other.s.real:.4g}", f"{other.s.imag:.4g}")
        )
        rows.append((*numbers, *(other_s if differ else ()), root.description))
    computed = ("re as computed", "im as computed") if differ else ()
    heads = ("re 1/s", "im rad/s", "Hz", "damping", "modes", *computed, "what moves")
    return TextTable(heads, rows, align="r" * (len(heads) - 1) + "l")


def describe_zero_roots(analysis: LinearAnalysis) -> str:
    """Returns the number of roots that are zero by structure, in words."""
    count = analysis.decisive.zeros
    if not count:
        return "no root at zero"
    are = "root is" if count == 1 else "roots are"
    free = ", joints that the task leaves free" * analysis.conditions.sites[0].layout.task
    return (
        f"{count} {are} zero by structure: shared poses{free}, and estimates without excitation"
    )


def describe_linear_verdict(analysis: LinearAnalysis) -> str:
    """Returns the verdict with the growth rate and frequency of the rightmost root."""
    rightmost = analysis.decisive.rightmost
    drifting = analysis.decisive.drifting
    keeps = f"{drifting} {'motions keep their' if drifting > 1 else 'motion keeps its'} speed"
    if rightmost is None:
        return f"{analysis.verdict}: {keeps if drifting else 'nothing moves'}"
    rate = f"exp({rightmost.s.real:.4g} t / s)"
    at = f" at {rightmost.s.imag:.4g} rad/s" if rightmost.s.imag else ""
    computed = analysis.decisive.basis or " tick by tick"
    which = "" if analysis.sampled is None else f", as computed{computed.removeprefix(',')}"
    slowest = f"{keeps}, and the slowest of the others" if drifting else "the slowest motion"
    return f"{analysis.verdict}: {slowest} goes as {rate}{at}{which}"


_SHOWN_BANDS = 3
_JOINTS_BY_LINE = 2
WEIGHTS_ALIKE = 1e-9


def describe_ports(ports: PortAnalysis) -> list[str]:
    """Returns a port analysis as lines."""
    low, high = ports.band_hz
    lines = [
        f"Ports of {', '.join(ports.sites)}, operators and environments off, {low:g}-{high:g} Hz "
        "(a grid refined at minima: evidence, no proof)"
    ]
    if ports.resolved_hz < high:
        beyond = f"above {ports.resolved_hz:.3g} Hz"
        lines.append(f"  {beyond} the grid does not follow the phase of the longest delay")
    if ports.verdict == "unstable":
        return [
            *lines,
            "  the loop without operators is unstable: not passive, and without an impedance",
        ]
    if ports.pole.order:
        kind = "as of free masses" if ports.pole.passive else "which no passive network has"
        lines.append(f"  at zero frequency Y has a pole of order {ports.pole.order}, {kind}")
    unit = ports.impedance_unit()
    kind = ports.kind
    whole = _describe_passivity(ports.velocity, unit, kind)
    lines.append(f"  operators passive in {ports.speed}, coupled or not: {whole}")
    for joint, one in ports.joints.items():
        alone = _describe_passivity(one, ports.impedance_unit(joint), kind)
        lines.append(f"    {ports.name_port(joint)} alone: {alone}")
    if ports.proof is not None:
        proof = _describe_proof(ports, ports.proof)
        lines.append(
            f"  operators passive in r = {ports.speed} + Lambda e, the proof's premise: {proof}"
        )
    absolute = _describe_absolute_stability(ports)
    lines.append(f"  a passive operator in {ports.speed} per site, best weights: {absolute}")
    lines += [f"    Llewellyn, {text}" for text in _describe_two_ports(ports)]
    if ports.measured is not None:
        bands = ports.measured.below
        found = (
            f"not shown {_list_bands(bands)}, where they damp too little" if bands else "stable"
        )
        lines.append(f"  the measured operators at the masters, any at each: {found}")
    if ports.clamped_verdict == "unstable":
        clamped = ports.transparency[0].other_site
        return [
            *lines,
            f"  with {clamped} clamped the loop is unstable: it has no steady impedance",
        ]
    return [*lines, *(f"  {_describe_transparency(ports, one)}" for one in ports.transparency)]


def _describe_proof(ports: PortAnalysis, proof: Passivity) -> str:
    beta = ", ".join(f"{weight:.3g}" for weight in ports.beta)
    text = f"{_describe_passivity(proof)}; sites weighted {beta}"
    if np.ptp(ports.beta) > WEIGHTS_ALIKE:
        text += ", which is nothing for operators coupled to one another"
    if proof.passive or ports.estimates_true:
        return text
    return (
        f"{text}; estimates here are not true, and the proof counts the energy that they store"
    )


def _describe_passivity(one: Passivity, unit: str = "", kind: str = "") -> str:
    """Returns a passivity in words; with a unit, also the damping that each joint or axis
    lacks.
    """
    if one.passive:
        return "passive"
    minima = one.minima
    least = f"least eigenvalue {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    text = f"not passive {_list_bands(minima.below)}; {least}"
    if not unit:
        return text
    if math.isinf(one.lacking_nm_s_rad):
        return f"{text}; no damping at the {'axes' if kind == 'axis' else 'joints'} would make it so"
    return f"{text}; {one.lacking_nm_s_rad:.3g} {unit} more at each {kind} would make it so"


def _list_bands(bands: tuple[FrequencyBand, ...]) -> str:
    shown = [f"{band.from_hz:.3g}-{band.to_hz:.3g}" for band in bands[:_SHOWN_BANDS]]
    more = (
        f" and {count_nouns(len(bands) - _SHOWN_BANDS, 'range')} more"
        if len(bands) > _SHOWN_BANDS
        else ""
    )
    return f"at {', '.join(shown)} Hz{more}"


def _describe_absolute_stability(ports: PortAnalysis) -> str:
    minima = ports.absolute
    if not minima.below:
        return "stable"
    can = "some make" if len(ports.sites) <= 3 else "some may make"
    margin = f"margin {minima.least:.3g} at {minima.least_hz:.3g} Hz"
    return f"{can} it unstable {_list_bands(minima.below)}; {margin}"


def _describe_two_ports(ports: PortAnalysis) -> list[str]:
    failing = [one for one in ports.two_ports if one.minima.below]
    holding = len(ports.two_ports) - len(failing)
    third = (
        ", the third site free or clamped"
        if any(one.clamped for one in ports.two_ports)
        else ""
    )
    every = f"every pair and {ports.kind}{third}" if not failing else "the others"
    groups: dict[tuple[object, ...], list[TwoPort]] = {}
    for one in failing:  # of arms of many joints those of one pair share a line
        joint = one.joint if len(ports.joints) <= _JOINTS_BY_LINE else ""
        groups.setdefault((one.sites, one.clamped, joint), []).append(one)
    lines = []
    for group in groups.values():
        worst = min(group, key=lambda one: one.minima.least)
        sites, _, clamped, minima = worst
        joints = ", ".join(str(ports.axes.get(one.joint, one.joint)) for one in group)
        bands = [b for one in group for b in one.minima.below]
        within = (
            f"within {min(b.from_hz for b in bands):.3g}-{max(b.to_hz for b in bands):.3g} Hz"
        )
        which = f"{' and '.join(sites)}{f', {clamped} clamped' if clamped else ''}, {ports.kind} {joints}"
        least = f"least {minima.least:.3g} at {minima.least_hz:.3g} Hz"
        lines.append(
            f"{which}: fails {_list_bands(minima.below) if len(group) == 1 else within}; {least}"
        )
    return [*lines, *([f"{every}: holds ({holding} two-ports)"] if holding else [])]


def _describe_transparency(ports: PortAnalysis, one: Transparency) -> str:
    unit = ports.impedance_unit(one.joint)
    free, clamped = one.interpolate_magnitudes(QUOTED_AT_HZ)
    low, high = one.band_hz
    return (
        f"{one.operator_site} feels of {one.other_site}, {ports.name_port(one.joint)}: {free:.4g} {unit} free and {clamped:.4g} "
        f"clamped at {QUOTED_AT_HZ:g} Hz; over {low:g}-{high:g} Hz the ratio is {one.ratio_db:.3g} dB, the "
        f"difference {one.difference_nm_s_rad:.3g} {unit}"
    )
