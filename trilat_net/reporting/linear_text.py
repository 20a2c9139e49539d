"""A linear analysis as terminal text: equilibrium, delays, root table, verdict and delay margin.

Invariant: numbers have four digits and their units; roots that are zero by structure are counted, not listed.
"""

import math
from collections.abc import Iterator

import numpy as np

from ..theory.linear_analysis import LinearAnalysis
from .text_table import TextTable


def describe_equilibrium(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields the equilibrium and the way it was found."""
    rest = analysis.rest
    yield f"rest: {rest.how}; residual {rest.residual:.1g}"
    if float(np.ptp(rest.q, axis=0).max()) < 5e-5:
        yield f"  all sites at ({', '.join(f'{angle:.4f}' for angle in rest.q[0])}) rad"
        return
    for name, q in zip(analysis.scenario.names, rest.q, strict=True):
        yield f"  {name} at ({', '.join(f'{angle:.4f}' for angle in q)}) rad"


def describe_effective_delays(analysis: LinearAnalysis) -> Iterator[str]:
    """Yields the effective delays, in one line if they are equal."""
    names, age_s = analysis.scenario.names, analysis.conditions.age_s
    links = list(zip(*np.nonzero(analysis.conditions.alpha), strict=True))
    values = {float(age_s[i, j]) for i, j in links}
    if len(values) == 1:
        yield f"delay in use on every link: {1e3 * values.pop():.4g} ms"
        return
    for i, j in links:
        yield f"delay in use on {names[j]}->{names[i]}: {1e3 * age_s[i, j]:.4g} ms"


def tabulate_roots(analysis: LinearAnalysis) -> TextTable:
    """Returns the rightmost roots, with those of the sampled loop next to them if any differs."""
    roots = analysis.continuous.roots
    sampled = [analysis.find_sampled_root(root) for root in roots]
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
    count = analysis.continuous.zeros
    if not count:
        return "no root at zero"
    are = "root is" if count == 1 else "roots are"
    return f"{count} {are} zero by structure: shared poses, and estimates without excitation"


def describe_linear_verdict(analysis: LinearAnalysis) -> str:
    """Returns the verdict with the growth rate and frequency of the rightmost root."""
    rightmost = analysis.decisive.rightmost
    if rightmost is None:
        return f"{analysis.verdict}: nothing moves"
    rate = f"exp({rightmost.s.real:.4g} t / s)"
    at = f" at {rightmost.s.imag:.4g} rad/s" if rightmost.s.imag else ""
    which = "" if analysis.sampled is None else ", as computed tick by tick"
    return f"{analysis.verdict}: the slowest motion goes as {rate}{at}{which}"


def describe_delay_margin(analysis: LinearAnalysis) -> str:
    """Returns the common delays for which the continuous loop is stable, in words."""
    return f"delay margin, continuous loop, one delay on all links: {analysis.margin.words}"
