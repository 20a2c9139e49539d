"""A linear analysis as terminal text: equilibrium, delays, root table, verdict and delay margin.

Invariant: numbers have four digits and their units; roots that are zero by structure are counted, not listed.
"""

import math
from collections.abc import Iterator

import numpy as np

from ..theory.characteristic_roots import CharacteristicRoot
from ..theory.linear_analysis import LinearAnalysis
from .text_table import TextTable

ROOT_HEADS = ("re 1/s", "im rad/s", "Hz", "damping", "modes", "what moves")
SAMPLED_ROOT_HEADS = ("re as computed", "im as computed")


def describe_equilibrium(found: LinearAnalysis) -> Iterator[str]:
    """Yields where the sites rest, and how that was found."""
    rest = found.rest
    yield f"rest: {rest.how}; residual {rest.residual:.1g}"
    same = float(np.ptp(rest.q, axis=0).max()) < 5e-5
    if same:
        yield f"  all sites at ({rest.q[0, 0]:.4f}, {rest.q[0, 1]:.4f}) rad"
        return
    for name, q in zip(found.scenario.names, rest.q, strict=True):
        yield f"  {name} at ({q[0]:.4f}, {q[1]:.4f}) rad"


def describe_effective_delays(found: LinearAnalysis) -> Iterator[str]:
    """Yields how old samples are when they are used."""
    pairs = list(zip(*np.nonzero(found.now.alpha), strict=True))
    values = {float(found.now.age_s[i, j]) for i, j in pairs}
    if len(values) == 1:
        yield f"delay in use on every link: {1e3 * values.pop():.4g} ms"
        return
    names = found.scenario.names
    for i, j in pairs:
        yield f"delay in use on {names[j]}->{names[i]}: {1e3 * found.now.age_s[i, j]:.4g} ms"


def tabulate_roots(found: LinearAnalysis) -> TextTable:
    """Returns the rightmost roots, and beside them those of the loop as it is computed where they differ."""
    roots = found.continuous.roots
    others = [found.as_computed(root) for root in roots]
    both = any(other is not None for other in others)
    rows = []
    for root, other in zip(roots, others, strict=True):
        row = [
            f"{root.s.real:.4g}",
            f"{root.s.imag:.4g}" if root.s.imag else "0",
            f"{root.s.imag / (2.0 * math.pi):.4g}" if root.s.imag else "0",
            f"{root.damping:.4g}",
            str(root.multiplicity),
            root.words,
        ]
        rows.append((*row[:5], *(_computed(other) if both else ()), row[5]))
    heads = (*ROOT_HEADS[:5], *(SAMPLED_ROOT_HEADS if both else ()), ROOT_HEADS[5])
    return TextTable(heads, rows, align="r" * (len(heads) - 1) + "l")


def _computed(root: CharacteristicRoot | None) -> tuple[str, str]:
    return ("same", "same") if root is None else (f"{root.s.real:.4g}", f"{root.s.imag:.4g}")


def describe_zero_roots(found: LinearAnalysis) -> str:
    """Says how many roots are zero by structure."""
    count = found.continuous.zeros
    if not count:
        return "no root at zero"
    are = "root is" if count == 1 else "roots are"
    return f"{count} {are} zero by structure: poses that can be shared, estimates that nothing excites"


def describe_linear_verdict(found: LinearAnalysis) -> str:
    """Says whether small motions about the rest die away, and how fast."""
    rightmost = found.judged.rightmost
    if rightmost is None:
        return f"{found.verdict}: nothing moves"
    goes = f"exp({rightmost.s.real:.4g} t / s)"
    at = f" at {rightmost.s.imag:.4g} rad/s" if rightmost.s.imag else ""
    which = "" if found.sampled is None else ", as computed tick by tick"
    return f"{found.verdict}: the slowest motion goes as {goes}{at}{which}"


def describe_delay_margin(found: LinearAnalysis) -> str:
    """Says for which common delay the continuous loop is stable."""
    return f"delay margin, continuous loop, one delay on all links: {found.margin.words}"
