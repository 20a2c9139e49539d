"""A linear analysis as terminal text: equilibrium, delays, root table, verdict and delay margin.

Invariant: numbers have four digits and their units; roots that are zero by structure are counted, not listed.
"""

import math
from collections.abc import Iterator

import numpy as np

from ..core.vectors import Array
from ..theory.linear_analysis import LinearAnalysis
from ..theory.linear_edge import EdgeScan
from .port_text import describe_ports
from .result_text import Block, MarkedText
from .text_table import TextTable

_COLOURS = {"stable": "green", "unstable": "red", "at the edge": "yellow"}


def compose_linear(found: LinearAnalysis) -> Iterator[Block]:
    """Yields equilibrium, delays, roots, verdict, margin and notes, then the ports, then the edges."""
    yield from (*describe_equilibrium(found), *describe_effective_delays(found), "")
    yield tabulate_roots(found)
    yield describe_zero_roots(found)
    verdict, _, rest = describe_linear_verdict(found).partition(": ")
    yield MarkedText(f"[{_COLOURS[verdict]}]{verdict}[/]:", rest)
    yield describe_delay_margin(found)
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
        at = f", its end effector at ({_list_numbers(pose)}) m{' and rad' * (len(pose) > 3)}" * bool(
            len(pose)
        )
        yield f"  {site.name} at ({_list_numbers(q)}) rad{at}"


def _list_numbers(values: Array) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


def describe_effective_delays(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields the effective delays, in one line if they are equal; the means of those that vary."""
    names, age_s = analysis.scenario.names, analysis.conditions.age_s
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

    Those of the sampled loop alone where ticks differ from each other: the continuous loop has mean delays.
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
        other_s = ("same", "same") if other is None else (f"{other.s.real:.4g}", f"{other.s.imag:.4g}")
        rows.append((*numbers, *(other_s if differ else ()), root.words))
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
    return f"{count} {are} zero by structure: shared poses{free}, and estimates without excitation"


def describe_linear_verdict(analysis: LinearAnalysis) -> str:
    """Returns the verdict with the growth rate and frequency of the rightmost root."""
    rightmost, drifting = analysis.decisive.rightmost, analysis.decisive.drifting
    keeps = f"{drifting} {'motions keep their' if drifting > 1 else 'motion keeps its'} speed"
    if rightmost is None:
        return f"{analysis.verdict}: {keeps if drifting else 'nothing moves'}"
    rate = f"exp({rightmost.s.real:.4g} t / s)"
    at = f" at {rightmost.s.imag:.4g} rad/s" if rightmost.s.imag else ""
    computed = analysis.decisive.basis or " tick by tick"
    which = "" if analysis.sampled is None else f", as computed{computed.removeprefix(',')}"
    slowest = f"{keeps}, and the slowest of the others" if drifting else "the slowest motion"
    return f"{analysis.verdict}: {slowest} goes as {rate}{at}{which}"


def describe_delay_margin(analysis: LinearAnalysis) -> str:
    """Returns the common delays for which the continuous loop is stable, in words."""
    return f"delay margin, continuous loop, one delay on all links: {analysis.margin.words}"
