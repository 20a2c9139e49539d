"""Linear analysis of a scenario: equilibrium, roots, delay margin, verdict and notes, also as JSON values.

Invariant: the verdict is that of the sampled loop, at any tick rates and delays; of the continuous loop where
a law is linearised in continuous time alone. It holds for small motions about the equilibrium only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.vectors import Array
from ..errors import UsageError
from ..results import Result
from ..scenario import Scenario, load_scenario
from ..scenario.describe import IRREVERSIBLE_SHARES, describe_law_conditions, lacks_detailed_balance
from .characteristic_roots import CharacteristicRoot, Spectrum, compute_delay_spectrum
from .delay_margin import DelayMargin, find_delay_margin
from .equilibrium import find_equilibrium
from .floquet import compute_sampled_spectrum
from .linear_edge import EdgeScan, iterate_linear_edges, parse_edge_range
from .linear_loop import LinearLoop, linearise_loop
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .port_analysis import PortAnalysis, analyse_ports, ports_to_json
from .site_dynamics import share_own_pose

DEFAULT_ROOTS = 6
MAX_ROOTS = 60
SAMPLED_ROOT_DIFFERENCE = 0.01
"""Continuous and sampled roots that differ by more, relative to abs(s), are both reported."""


@dataclass(frozen=True, repr=False)
class LinearAnalysis(Result):
    """The linear analysis of a scenario.

    Attributes:
        scenario: the experiment.
        conditions: the numbers of the loop: dominance factors, ages, actors in force.
        rest: the equilibrium.
        loop: the linear loop there.
        continuous: roots of the delay-differential equation.
        sampled: roots of the sampled loop; None if a law is linearised in continuous time alone.
        margin: the common delays for which the continuous loop is stable.
        scans: where stability changes along keys, of `analyse_linear_loop`.
        ports: the haptic ports of the operators, likewise; None if nobody asked.
    """

    scenario: Scenario
    conditions: OperatingConditions
    rest: Equilibrium
    loop: LinearLoop
    continuous: Spectrum
    sampled: Spectrum | None
    margin: DelayMargin
    scans: tuple[EdgeScan, ...] = ()
    ports: PortAnalysis | None = None

    @property
    def end_effectors(self) -> tuple[Array, ...]:
        """What each site shares of its pose at the equilibrium in task space; nothing in joint space."""
        sites, q = self.conditions.sites, self.rest.q
        if not sites[0].layout.task:
            return (np.zeros(0),) * len(sites)
        return tuple(
            share_own_pose(site, own[: site.layout.joints]) for site, own in zip(sites, q, strict=True)
        )

    @property
    def decisive(self) -> Spectrum:
        """The roots on which the verdict is based."""
        return self.continuous if self.sampled is None else self.sampled

    @property
    def verdict(self) -> str:
        """stable, unstable, or at the edge: of small motions about the equilibrium."""
        return self.decisive.verdict

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on conditions, equilibrium and roots."""
        notes = [*self.conditions.notes, *self.rest.notes]
        if self.sampled is not None and self.sampled.verdict != self.continuous.verdict:
            decides = "the tick rate decides" if self.sampled.span_s is None else "ticks and delays decide"
            notes.append(
                f"the continuous loop is {self.continuous.verdict}, the sampled loop is "
                f"{self.sampled.verdict}: {decides}"
            )
        if self.decisive.drifting:
            notes.append(
                f"{self.decisive.drifting} of the roots at zero only drift: their modes keep their speed"
            )
        if lacks_detailed_balance(self.scenario):
            notes.append(IRREVERSIBLE_SHARES)
        return (*notes, *describe_law_conditions(self.scenario))

    def headline(self) -> str:
        """Returns the verdict in one line."""
        return f"{self.scenario.name}: {self.verdict}; delay margin {self.margin.words}"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat linear --json`."""
        ports = None if self.ports is None else ports_to_json(self.ports)
        edges = {scan.key: [one._asdict() for one in scan.edges] for scan in self.scans}
        return {**linear_to_json(self), "ports": ports, "edges": edges}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per root: of the continuous loop, and as computed tick by tick."""
        spectra = {"continuous": self.continuous, "as computed": self.sampled}
        return [
            {"loop": loop, **root, "states": ", ".join(root["states"])}
            for loop, spectrum in spectra.items()
            if spectrum is not None
            for root in _spectrum_to_json(spectrum)["roots"]
        ]

    def find_sampled_root(self, root: CharacteristicRoot) -> CharacteristicRoot | None:
        """Returns the sampled root nearest to a continuous one; None if they differ by 1 % or less."""
        if self.sampled is None or not self.sampled.roots:
            return None
        near = min(self.sampled.roots, key=lambda one: abs(one.s - root.s))
        return near if abs(near.s - root.s) > SAMPLED_ROOT_DIFFERENCE * abs(root.s) else None


def analyse_linear_loop(
    source: str | Path | Scenario,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    *,
    pose: tuple[float, ...] | None = None,
    roots: int = DEFAULT_ROOTS,
    over: Sequence[str] = (),
    ports: bool = False,
) -> LinearAnalysis:
    """Returns the linear analysis of a scenario.

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        overrides: what is to be changed of it.
        pose: the joint angles of all sites, rad, with true estimates; None for those at which a run ends.
        roots: how many roots, the rightmost ones.
        over: keys along which stability may change, and their ranges, as in "control.d=0.1:3".
        ports: whether to analyse the ports of the operators.

    Raises:
        ScenarioError: the scenario is not valid, or has no linear loop.
        UsageError: another argument is not valid.
    """
    ranges = [parse_edge_range(text) for text in over]
    if not 1 <= roots <= MAX_ROOTS:
        raise UsageError(f"--roots is a number of roots, 1 to {MAX_ROOTS}, not {roots}")
    scenario = load_scenario(source, overrides)
    conditions = derive_operating_conditions(scenario)
    rest = find_equilibrium(scenario, pose)
    loop = linearise_loop(conditions, rest)
    continuous = compute_delay_spectrum(loop, roots)
    sampled = compute_sampled_spectrum(conditions, rest, roots)
    found = LinearAnalysis(scenario, conditions, rest, loop, continuous, sampled, find_delay_margin(loop))
    scans = tuple(
        EdgeScan(key, low, high, tuple(iterate_linear_edges(scenario, key, low, high, rest)))
        for key, low, high in ranges
    )
    return replace(found, scans=scans, ports=analyse_ports(scenario, rest) if ports else None)


def linear_to_json(analysis: LinearAnalysis) -> dict[str, Any]:
    """Returns an analysis as plain values."""
    names, conditions, rest = analysis.scenario.names, analysis.conditions, analysis.rest
    layouts = [site.layout for site in conditions.sites]
    learns = [not isinstance(site.own, NumericLaw) for site in conditions.sites]
    q = [own[: layout.joints].tolist() for own, layout in zip(rest.q, layouts, strict=True)]
    theta_hat = [
        own[: layout.parameters * one].tolist()
        for own, layout, one in zip(rest.theta_hat, layouts, learns, strict=True)
    ]
    poses = dict(zip(names, (pose.tolist() for pose in analysis.end_effectors), strict=True))
    return {
        "scenario": analysis.scenario.name,
        "scenario_sha256": analysis.scenario.sha256,
        "verdict": analysis.verdict,
        "rest": {
            "how": rest.how,
            "residual": rest.residual,
            "q_rad": dict(zip(names, q, strict=True)),
            "theta_hat": dict(zip(names, theta_hat, strict=True)),
            **({"x": poses} if layouts[0].task else {}),
        },
        "delay_in_use_ms": {
            f"{names[j]}->{names[i]}": 1e3 * float(conditions.age_s[i, j])
            for i, j in zip(*np.nonzero(conditions.alpha), strict=True)
        },
        "continuous": _spectrum_to_json(analysis.continuous),
        "as_computed": None if analysis.sampled is None else _spectrum_to_json(analysis.sampled),
        "margin": {
            "words": analysis.margin.words,
            "stable": [{"from_s": one.low_s, "to_s": one.high_s} for one in analysis.margin.intervals],
            "crossings": [
                {"delay_s": one.delay_s, "omega_rad_s": one.omega_rad_s, "pairs_to_the_right": one.pairs}
                for one in analysis.margin.crossings
            ],
        },
        "notes": list(analysis.notes),
    }


def _spectrum_to_json(spectrum: Spectrum) -> dict[str, Any]:
    return {
        "verdict": spectrum.verdict,
        "roots": [
            {
                "re_per_s": root.s.real,
                "im_rad_s": root.s.imag,
                "damping": root.damping,
                "modes": root.multiplicity,
                "states": list(root.states),
            }
            for root in spectrum.roots
        ],
        "zeros_by_structure": spectrum.zeros,
        "of_those_drifting": spectrum.drifting,
        "dropped_candidates": spectrum.dropped,
        "order": spectrum.order,
        "span_s": spectrum.span_s,
        "deviation_per_s": spectrum.deviation_per_s,
    }
