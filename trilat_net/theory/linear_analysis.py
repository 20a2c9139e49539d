"""Linear analysis of a scenario, or where a run ended: equilibrium, roots, delay margin,
verdict, JSON.

Invariant: the verdict is that of the sampled loop, at any tick rates and delays; of the
continuous loop where a law is linearised in continuous time alone. It holds for small motions
about the equilibrium only.

Where a recorded run ended the roots are those at the log's own end pose and estimates, under
the conditions at its end. Where delays are drawn or measured they are those over the very
samples that the last quarter of the records has in use; mean ages serve for laws that are
linearised in continuous time alone. Only twins are executed.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..analysis.certificate.stability_certificate import Certificate, EndPoseRoots, certify
from ..analysis.run_end import SETTLED_SPEED_RAD_S
from ..analysis.timeline import recorded_end_s
from ..analysis.twin_growth import TWINS, measure_twins
from ..core.vectors import Array
from ..errors import ScenarioError, UsageError
from ..log.accounting import MIN_COVERAGE
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..results import Result
from ..scenario import Scenario, load_scenario
from ..scenario.delay_models.kernel_delays import ConstantDelay
from ..scenario.describe import (
    IRREVERSIBLE_SHARES,
    describe_law_conditions,
    lacks_detailed_balance,
)
from .characteristic_roots import CharacteristicRoot, Spectrum, compute_delay_spectrum
from .delay_margin import DelayMargin, find_delay_margin
from .equilibrium import find_equilibrium, follow_equilibrium, pad_rows
from .floquet import DRAWN_SPAN_S, SamplesInUse, compute_sampled_spectrum
from .linear_edge import EdgeScan, find_deepest_contact, iterate_linear_edges, parse_edge_range
from .linear_loop import LinearLoop, compute_shared_poses, linearise_loop
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .port_analysis import PortAnalysis, analyse_ports, ports_to_json
from .port_passivity import HandMatrices

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
        sampled: roots of the sampled loop; None if a law is linearised in continuous time
            alone.
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
        """What each site shares of its pose at the equilibrium in task space; nothing in joint
        space.
        """
        sites = self.conditions.sites
        if not sites[0].layout.task:
            return (np.zeros(0),) * len(sites)
        return tuple(compute_shared_poses(self.conditions, self.rest))

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
            decides = (
                "the tick rate decides"
                if self.sampled.span_s is None
                else "ticks and delays decide"
            )
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
        return f"{self.scenario.name}: {self.verdict}; delay margin {self.margin.description}"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat linear --json`."""
        names = self.scenario.names
        conditions = self.conditions
        rest = self.rest
        layouts = [site.layout for site in conditions.sites]
        learns = [not isinstance(site.law_factory, NumericLaw) for site in conditions.sites]
        q = [own[: layout.joints].tolist() for own, layout in zip(rest.q, layouts, strict=True)]
        theta_hat = [
            own[: layout.parameters * one].tolist()
            for own, layout, one in zip(rest.theta_hat, layouts, learns, strict=True)
        ]
        poses = dict(zip(names, (pose.tolist() for pose in self.end_effectors), strict=True))
        return {
            "scenario": self.scenario.name,
            "scenario_sha256": self.scenario.sha256,
            "verdict": self.verdict,
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
            "continuous": _spectrum_to_json(self.continuous),
            "as_computed": None if self.sampled is None else _spectrum_to_json(self.sampled),
            "margin": {
                "words": self.margin.description,
                "stable": [
                    {"from_s": one.low_s, "to_s": one.high_s} for one in self.margin.intervals
                ],
                "crossings": [
                    {
                        "delay_s": one.delay_s,
                        "omega_rad_s": one.omega_rad_s,
                        "pairs_to_the_right": one.pairs,
                    }
                    for one in self.margin.crossings
                ],
            },
            "notes": list(self.notes),
            "ports": None if self.ports is None else ports_to_json(self.ports),
            "edges": {scan.key: [one._asdict() for one in scan.edges] for scan in self.scans},
        }

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
        """Returns the sampled root nearest to a continuous one; None if they differ by 1 % or
        less.
        """
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
    hands: Sequence[HandMatrices] = (),
) -> LinearAnalysis:
    """Returns the linear analysis of a scenario; its arguments are those of
    `trilat_net.linear`.

    `pose` is that of all sites, rad; of the measured operators, `hands`, any may hold any
    master.

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
    found = LinearAnalysis(
        scenario, conditions, rest, loop, continuous, sampled, find_delay_margin(loop)
    )
    scans = tuple(
        EdgeScan(
            key,
            low,
            high,
            tuple(
                iterate_linear_edges(scenario=scenario, key=key, low=low, high=high, rest=rest)
            ),
        )
        for key, low, high in ranges
    )
    return replace(
        found, scans=scans, ports=analyse_ports(scenario, rest, hands=hands) if ports else None
    )


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


_ROOTS = 2
"""Roots that are looked for: the rightmost ones."""


def certify_run(
    log: Log, *, min_coverage: float = MIN_COVERAGE, own_laws: bool = False, twins: int = TWINS
) -> Certificate:
    """Returns the certificate of a log, with the roots of the loop where the run ended, and so
    many twins.

    See `certify`.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    found = certify(log, min_coverage=min_coverage, own_laws=own_laws)
    growth = measure_twins(log, found.end, twins, own_laws=own_laws) if twins else None
    return replace(found, roots=find_end_pose_roots(log), twins=growth)


def find_end_pose_roots(log: Log) -> EndPoseRoots:
    """Returns the roots of the loop where a run ended, or why there are none."""
    parts = [log[site] for site in log.sites]
    if not all(map(len, parts)):
        return _no_roots("a site has no records")
    if any(part.mode[-1] == "diverged" for part in parts):
        return _no_roots("the run diverged")
    if any(log.changes(site) for site in log.sites):
        return _no_roots("commands changed the loop while it ran")
    scenario, uses, mean_s = _fix_delays(log)
    try:
        conditions = derive_operating_conditions(scenario, own_laws=False)
        for at, age_s in mean_s.items():
            conditions.age_s[at] = age_s
        q, theta_hat = _choose_state(scenario, parts)
        rest = follow_equilibrium(
            scenario, Equilibrium(q, theta_hat, "the end of the log", 0.0)
        )
    except ScenarioError as error:
        return _no_roots(error.problem)
    sampled = compute_sampled_spectrum(conditions, rest, _ROOTS, uses)
    decisive = sampled or compute_delay_spectrum(linearise_loop(conditions, rest), _ROOTS)
    root = decisive.rightmost
    verdict = decisive.verdict
    about = decisive.basis
    if sampled is None:  # a law in continuous time, whose ticks are left out
        about = ", in continuous time" + ", of the mean ages" * bool(
            conditions.varying or mean_s
        )
    exact = sampled is not None and sampled.deviation_per_s is None
    if root is None:
        return EndPoseRoots(verdict, None, exact, f"this rest: {verdict}, without roots")
    omega = f" at {abs(root.s.imag):.4g} rad/s" if root.s.imag else ""
    drift = f"{decisive.drifting} of its motions keep their speed, the others " * bool(
        decisive.drifting
    )
    text = f"this rest: {verdict}, {drift}{root.s.real:+.3g} /s{omega}{about}"
    return EndPoseRoots(verdict, root.s.real, exact, text)


def _fix_delays(log: Log) -> tuple[Scenario, SamplesInUse | None, dict[tuple[int, int], float]]:
    """Returns the scenario that a log ran, with constant delays where its records alone know
    them.

    And if there are such links the samples in use in its last quarter, a missing tick's being
    those before, and per (receiver, sender) of such a link their mean age, s.
    """
    known = msgspec.structs.replace(log.scenario, duration_s=recorded_end_s(log))
    unknown = [
        one.random or one.measured or one.points is not None for one in known.links.values()
    ]
    if not any(unknown):
        return known, None, {}
    sites = [log[name] for name in known.names]
    links = dict(known.links)
    common_hz = math.gcd(*(site.rate_hz for site in sites))
    end = max(1, min(int(site.tick[-1]) * common_hz // site.rate_hz for site in sites))
    start = max(3 * end // 4, end - round(DRAWN_SPAN_S * common_hz))
    used = {}
    mean_s = {}
    for (i, own), (j, peer) in permutations(enumerate(sites), 2):
        ticks = np.arange(start * own.rate_hz // common_hz, end * own.rate_hz // common_hz)
        rows = np.maximum(np.searchsorted(own.tick, ticks, side="right") - 1, 0)
        samples = own.used[peer.name][rows]
        name = f"{peer.name}->{own.name}"
        if samples.min() < 0:  # of a peer that never sent, or not yet
            return known, None, {}
        used[i, j] = samples - start * peer.rate_hz // common_hz
        if unknown[[*links].index(name)]:
            mean_s[i, j] = float((ticks / own.rate_hz - samples / peer.rate_hz).mean())
            links[name] = ConstantDelay(delay_ms=1e3 * mean_s[i, j])
    fixed = msgspec.structs.replace(known, links=links)
    return fixed, SamplesInUse((end - start) / common_hz, used), mean_s


def _no_roots(why: str) -> EndPoseRoots:
    return EndPoseRoots("", None, False, f"this rest: no roots: {why}")


def _choose_state(scenario: Scenario, parts: Sequence[SiteLog]) -> tuple[Array, Array]:
    """Returns angles and estimates of all sites: at the end of those at rest, else the last
    quarter's mean.

    Of arms that chatter at a sampled wall, it is the state of the last quarter that is deepest
    in it.
    """
    count = min(map(len, parts))
    rows = slice(3 * count // 4, count)
    together = all(np.array_equal(part.t_s[rows], parts[0].t_s[rows]) for part in parts)
    if together and not all(map(_rests, parts)):
        joints = max(part.q.shape[1] for part in parts)
        q = np.stack(
            [np.pad(part.q[rows], ((0, 0), (0, joints - part.q.shape[1]))) for part in parts],
            axis=1,
        )
        deepest = find_deepest_contact(scenario, q)
        if deepest is not None:
            return q[deepest], pad_rows([part.theta_hat[rows][deepest] for part in parts])
    ends = [(_end_of(part, part.q), _end_of(part, part.theta_hat)) for part in parts]
    return pad_rows([q for q, _ in ends]), pad_rows([theta_hat for _, theta_hat in ends])


def _rests(part: SiteLog) -> bool:
    t_s = part.t_s
    return float(np.abs(part.qd[t_s > t_s[-1] - 1.0]).max()) <= SETTLED_SPEED_RAD_S


def _end_of(part: SiteLog, values: Array) -> Array:
    """Returns a signal at the last record of an arm at rest, else its mean over the last
    quarter.
    """
    return np.asarray(
        values[-1] if _rests(part) else values[part.t_s >= 0.75 * part.t_s[-1]].mean(axis=0)
    )
