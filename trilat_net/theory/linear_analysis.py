"""Linear analysis of a scenario: equilibrium, roots, delay margin, verdict and notes, also as JSON values.

Invariant: the verdict is that of the sampled loop where all sites have one rate, of the continuous loop
otherwise. It holds for small motions about the equilibrium only.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UsageError
from ..scenario import Scenario, load_scenario
from .characteristic_roots import CharacteristicRoot, Spectrum
from .delay_margin import AxisCrossing, DelayMargin, find_delay_margin
from .delay_roots import compute_delay_spectrum
from .equilibrium import find_equilibrium
from .linear_edge import is_digital
from .linear_loop import LinearLoop, linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .tick_map import compute_sampled_spectrum, find_common_rate_hz

DEFAULT_ROOTS = 6
MAX_ROOTS = 60
SAMPLED_ROOT_DIFFERENCE = 0.01
"""Continuous and sampled roots that differ by more, of abs(s), are told apart."""


@dataclass(frozen=True)
class LinearAnalysis:
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
    now: OperatingConditions
    rest: Equilibrium
    loop: LinearLoop
    continuous: Spectrum
    sampled: Spectrum | None
    margin: DelayMargin
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
        return is_digital(self.scenario)

    def as_computed(self, root: CharacteristicRoot) -> CharacteristicRoot | None:
        """Returns the sampled root next to a continuous one, where they differ by more than `APART`."""
        if self.sampled is None or not self.sampled.roots:
            return None
        near = min(self.sampled.roots, key=lambda one: abs(one.s - root.s))
        return near if abs(near.s - root.s) > SAMPLED_ROOT_DIFFERENCE * abs(root.s) else None


def analyse_linear_loop(
    source: str | Path | Scenario,
    overrides: Sequence[str] = (),
    *,
    pose: tuple[float, float] | None = None,
    roots: int = DEFAULT_ROOTS,
) -> LinearAnalysis:
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
    if not 1 <= roots <= MAX_ROOTS:
        raise UsageError(f"--roots is how many roots are shown, 1 to {MAX_ROOTS}, not {roots}")
    scenario = load_scenario(source, overrides)
    now = derive_operating_conditions(scenario)
    rest = find_equilibrium(scenario, pose)
    loop = linearise_loop(now, rest)
    continuous = compute_delay_spectrum(loop, roots)
    near = np.array([root.s for root in continuous.roots], dtype=np.complex128)
    sampled = compute_sampled_spectrum(now, rest, near, roots)
    found = LinearAnalysis(scenario, now, rest, loop, continuous, sampled, find_delay_margin(loop), ())
    return LinearAnalysis(scenario, now, rest, loop, continuous, sampled, found.margin, tuple(_notes(found)))


def _notes(found: LinearAnalysis) -> list[str]:
    notes = [*found.now.notes, *found.rest.notes]
    if find_common_rate_hz(found.now) is None:
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


def linear_to_json(found: LinearAnalysis) -> dict[str, Any]:
    """Returns all of an analysis as plain values."""
    return {
        "scenario": found.scenario.name,
        "scenario_sha256": found.scenario.sha256,
        "verdict": found.verdict,
        "rest": {
            "how": found.rest.how,
            "residual": found.rest.residual,
            "q_rad": dict(zip(found.scenario.names, found.rest.q.tolist(), strict=True)),
            "theta_hat": dict(zip(found.scenario.names, found.rest.theta_hat.tolist(), strict=True)),
        },
        "delay_in_use_ms": _ages(found),
        "continuous": _spectrum(found.continuous),
        "as_computed": None if found.sampled is None else _spectrum(found.sampled),
        "margin": {
            "words": found.margin.words,
            "stable": [{"from_s": span.low_s, "to_s": span.high_s} for span in found.margin.spans],
            "crossings": [_crossing(one) for one in found.margin.crossings],
        },
        "notes": list(found.notes),
    }


def _ages(found: LinearAnalysis) -> dict[str, float]:
    names, alpha, age_s = found.scenario.names, found.now.alpha, found.now.age_s
    return {
        f"{names[j]}->{names[i]}": 1e3 * float(age_s[i, j])
        for i in range(len(names))
        for j in range(len(names))
        if alpha[i, j]
    }


def _spectrum(found: Spectrum) -> dict[str, Any]:
    return {
        "verdict": found.verdict,
        "roots": [_root(root) for root in found.roots],
        "zeros_by_structure": found.zeros,
        "of_those_drifting": found.drifting,
        "dropped_candidates": found.dropped,
        "order": found.order,
    }


def _root(root: CharacteristicRoot) -> dict[str, Any]:
    return {
        "re_per_s": root.re_per_s,
        "im_rad_s": root.im_rad_s,
        "damping": root.damping,
        "modes": root.multiplicity,
        "states": list(root.states),
    }


def _crossing(one: AxisCrossing) -> dict[str, Any]:
    return {"delay_s": one.delay_s, "omega_rad_s": one.omega_rad_s, "pairs_to_the_right": one.pairs}
