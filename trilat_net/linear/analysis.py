"""A scenario, linearised: where it rests, its roots, its margin, and a word for all that.

Law: the verdict is that of the loop as it is computed, tick by tick, where all sites have one rate; that of
the continuous loop otherwise. It speaks of small motions about the rest, and of nothing else.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import UsageError
from ..scenario import Scenario, load
from .conditions import Conditions, conditions
from .loop import Loop, Rest, loop_of
from .margin import Margin, margin
from .rest import rest_of
from .rightmost import digital
from .roots import spectrum
from .sampled import rate_of, sampled_spectrum
from .spectrum import Root, Spectrum

ROOTS = 6
MOST_ROOTS = 60
APART = 0.01
"""Continuous and sampled roots that differ by more, of abs(s), are told apart."""


@dataclass(frozen=True)
class Analysis:
    """What linear analysis says of a scenario.

    Attributes:
        scenario: the experiment.
        now: what holds at its end: shares, ages, who is at the arms.
        rest: where it rests.
        loop: the linear loop there.
        continuous: roots of the delay-differential equation.
        sampled: roots of the loop as it is computed; None where the sites have several rates.
        margin: for which common delay the continuous loop is stable.
        notes: what is to be said of all that.
    """

    scenario: Scenario
    now: Conditions
    rest: Rest
    loop: Loop
    continuous: Spectrum
    sampled: Spectrum | None
    margin: Margin
    notes: tuple[str, ...]

    @property
    def judged(self) -> Spectrum:
        """The roots that the verdict is about."""
        return self.continuous if self.sampled is None else self.sampled

    @property
    def verdict(self) -> str:
        """stable, unstable, or at the edge: of small motions about the rest."""
        return self.judged.verdict

    @property
    def digital(self) -> bool:
        """True where the controllers are plain digital ones, which the continuous loop only approximates."""
        return digital(self.scenario)

    def as_computed(self, root: Root) -> Root | None:
        """Returns the sampled root next to a continuous one, where they differ by more than `APART`."""
        if self.sampled is None or not self.sampled.roots:
            return None
        near = min(self.sampled.roots, key=lambda one: abs(one.s - root.s))
        return near if abs(near.s - root.s) > APART * abs(root.s) else None


def analyse(
    source: str | Path | Scenario,
    overrides: Sequence[str] = (),
    *,
    pose: tuple[float, float] | None = None,
    roots: int = ROOTS,
) -> Analysis:
    """Returns what linear analysis says of a scenario.

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        overrides: what is to be changed of it, as texts KEY=VALUE.
        pose: a pose for all sites, rad, with estimates that are the truth; None: where a run of it ends.
        roots: how many roots, rightmost first.

    Raises:
        ScenarioError: the scenario is none, or has no linear loop.
        UsageError: another argument cannot be right.
    """
    if not 1 <= roots <= MOST_ROOTS:
        raise UsageError(f"--roots is how many roots are shown, 1 to {MOST_ROOTS}, not {roots}")
    scenario = load(source, overrides)
    now = conditions(scenario)
    rest = rest_of(scenario, pose)
    loop = loop_of(now, rest)
    continuous = spectrum(loop, roots)
    near = np.array([root.s for root in continuous.roots], dtype=np.complex128)
    sampled = sampled_spectrum(now, rest, near, roots)
    found = Analysis(scenario, now, rest, loop, continuous, sampled, margin(loop), ())
    return Analysis(scenario, now, rest, loop, continuous, sampled, found.margin, tuple(_notes(found)))


def _notes(found: Analysis) -> list[str]:
    notes = [*found.now.notes, *found.rest.notes]
    if rate_of(found.now) is None:
        notes.append(
            "sites tick at several rates: the loop as it is computed is not linearised, the continuous one is"
        )
    elif found.sampled is not None and found.sampled.verdict != found.continuous.verdict:
        notes.append(
            f"the continuous loop is {found.continuous.verdict}, the loop as it is computed is "
            f"{found.sampled.verdict}: the tick rate decides"
        )
    if found.judged.drifting:
        notes.append(
            f"{found.judged.drifting} of the roots at zero only drift: what they belong to goes on at the "
            "speed that it has"
        )
    return notes
