"""Predicts whether small motions of coupled arms die away, for a scenario or a log.

The control loop is linearised about an equilibrium, a pose in which all arms rest. Its
characteristic roots decide: the loop is stable if all roots have a negative real part. They are
computed for the sampled loop, whose controllers compute once per tick (period of the control
loop), and for its continuous approximation. The analysis also contains the delay margin and, if
requested, the settings at the edge of stability and what operators feel.

For a recorded run, the equilibrium is the last pose, with the last parameter estimates. Delays
and operators are as at the end of the run. If delays are random or measured, the sampled loop
uses the delays that occurred in the last quarter of the run. The continuous loop uses their
means. The recorded run is not executed again, except to see whether small pushes grow.

Invariant:
    - The verdict is based on the sampled loop, at any tick rates and delays. If a control law
      can be linearised in continuous time only, the verdict is based on the continuous loop.
    - The verdict holds for small motions about the equilibrium only.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

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
"""Number of roots that are computed unless another number is requested."""
MAX_ROOTS = 60
"""Largest number of roots that can be requested."""
SAMPLED_ROOT_DIFFERENCE = 0.01
"""Largest difference of a continuous and a sampled root that is ignored, relative to abs(s)."""


@dataclass(frozen=True, repr=False)
class LinearAnalysis(Result):
    """Result of the linear stability analysis of a scenario, see `analyse_linear_loop`.

    Attributes:
        scenario: The description of the experiment.
        conditions: The numbers from which the loop is built: dominance factors, delays,
            operators and environments in force.
        rest: The equilibrium about which the loop is linearised.
        loop: The loop linearised at the equilibrium.
        continuous: Characteristic roots of the continuous loop, a delay-differential equation.
        sampled: Characteristic roots of the loop with its ticks. None if a law can be
            linearised in continuous time only.
        margin: The delays, common to all links, for which the continuous loop is stable.
        scans: For each requested key of the scenario, the values at which the loop becomes
            stable or unstable.
        ports: Analysis of the joints at which operators act, the haptic ports. None if it was
            not requested.
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
        """The pose of each end effector at the equilibrium, if end effectors follow each other.

        There is an array for each site (process that runs one arm), with the pose that the site
        sends to the other sites. The arrays are empty if joints follow each other instead.
        """
        sites = self.conditions.sites
        if not sites[0].layout.task:
            return (np.zeros(0),) * len(sites)
        return tuple(compute_shared_poses(self.conditions, self.rest))

    @property
    def decisive(self) -> Spectrum:
        """The characteristic roots on which the verdict about stability is based.

        They belong to the sampled loop, whose controllers compute once per tick. If a control
        law can be linearised in continuous time only, they belong to the continuous loop.
        """
        return self.continuous if self.sampled is None else self.sampled

    @property
    def verdict(self) -> str:
        """Stability of small motions: "stable", "unstable" or "at the edge"."""
        return self.decisive.verdict

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user that qualify the verdict of the linear analysis.

        They concern the analysed conditions (such as delays and operators), the pose of rest
        about which the arms are linearised, and the characteristic roots.
        """
        notes = [*self.conditions.notes, *self.rest.notes]
        if self.sampled is not None and self.sampled.verdict != self.continuous.verdict:
            decides = "ticks and delays decide"
            if self.sampled.span_s is None:
                decides = "the tick rate decides"
            notes.append(
                f"the continuous loop is {self.continuous.verdict}, the sampled loop is "
                f"{self.sampled.verdict}: {decides}"
            )

        if self.decisive.drifting:
            notes.append(
                f"{self.decisive.drifting} of the roots at zero only drift: "
                "their modes keep their speed"
            )
        if lacks_detailed_balance(self.scenario):
            notes.append(IRREVERSIBLE_SHARES)
        return (*notes, *describe_law_conditions(self.scenario))

    def headline(self) -> str:
        """Returns the verdict and the delay margin in one line."""
        return f"{self.scenario.name}: {self.verdict}; delay margin {self.margin.description}"

    def to_dict(self) -> dict[str, Any]:
        """Returns the analysis as plain values, with the keys of `trilat linear --json`."""
        sampled = None
        if self.sampled is not None:
            sampled = _spectrum_to_json(self.sampled)
        ports = None
        if self.ports is not None:
            ports = ports_to_json(self.ports)
        edges = {}
        for scan in self.scans:
            edges[scan.key] = [edge._asdict() for edge in scan.edges]

        return {
            "scenario": self.scenario.name,
            "scenario_sha256": self.scenario.sha256,
            "verdict": self.verdict,
            "rest": self._rest_to_json(),
            "delay_in_use_ms": self._delays_to_json(),
            "continuous": _spectrum_to_json(self.continuous),
            "as_computed": sampled,
            "margin": _margin_to_json(self.margin),
            "notes": list(self.notes),
            "ports": ports,
            "edges": edges,
        }

    def _rest_to_json(self) -> dict[str, Any]:
        """Returns the equilibrium as plain values, without the zeros that pad its arrays."""
        rest = self.rest
        q = {}
        theta_hat = {}
        for n, site in enumerate(self.conditions.sites):
            q[site.name] = rest.q[n][: site.layout.joints].tolist()
            # the memory of an imported law is no estimate
            is_imported = isinstance(site.law_factory, NumericLaw)
            parameters = 0 if is_imported else site.layout.parameters
            theta_hat[site.name] = rest.theta_hat[n][:parameters].tolist()

        values: dict[str, Any] = {
            "how": rest.how,
            "residual": rest.residual,
            "q_rad": q,
            "theta_hat": theta_hat,
        }
        if self.conditions.sites[0].layout.task:
            poses = [pose.tolist() for pose in self.end_effectors]
            values["x"] = dict(zip(self.scenario.names, poses, strict=True))
        return values

    def _delays_to_json(self) -> dict[str, float]:
        """Returns the age of the samples in use, in ms, by link."""
        conditions = self.conditions
        names = self.scenario.names
        receivers, senders = np.nonzero(conditions.alpha)
        delays_ms = {}
        for i, j in zip(receivers, senders, strict=True):
            link = f"{names[j]}->{names[i]}"
            delays_ms[link] = 1e3 * float(conditions.age_s[i, j])
        return delays_ms

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of the characteristic roots, with a row per root.

        The roots of the continuous loop come first. Then follow the roots of the sampled loop,
        whose controllers compute once per tick, if they were computed.
        """
        spectra = {"continuous": self.continuous, "as computed": self.sampled}
        rows: list[dict[str, Any]] = []
        for loop, spectrum in spectra.items():
            if spectrum is None:
                continue
            for root in _spectrum_to_json(spectrum)["roots"]:
                row = {"loop": loop, **root}
                row["states"] = ", ".join(root["states"])
                rows.append(row)
        return rows

    def find_sampled_root(self, root: CharacteristicRoot) -> CharacteristicRoot | None:
        """Finds the root of the sampled loop that corresponds to a root of the continuous loop.

        It is the nearest one. It is worth showing only if both differ.

        Args:
            root: A root of the continuous loop.

        Returns:
            The sampled root. None if both differ by less than 1 %, or if there is no sampled
            root.
        """
        if self.sampled is None or not self.sampled.roots:
            return None
        nearest = min(self.sampled.roots, key=lambda sampled: abs(sampled.s - root.s))
        difference = abs(nearest.s - root.s)
        if difference <= SAMPLED_ROOT_DIFFERENCE * abs(root.s):
            return None
        return nearest


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
    """Predicts whether small motions of the coupled arms of a scenario die away.

    The control loop is linearised about a pose in which all arms rest.

    Args:
        source: A scenario (description of an experiment), its file, or the name of a shipped
            scenario.
        overrides: Settings of the scenario that are replaced.
        pose: Pose of rest that all arms share, in rad. None for the pose at the end of a run.
        roots: Number of characteristic roots to compute.
        over: Ranges of settings in which to search the values where stability changes, such as
            "control.d=0.1:3".
        ports: True to analyse also what operators feel when they hold an arm.
        hands: Measured impedances of operators. Any of them may hold the arm of any master.

    Raises:
        ScenarioError: The scenario is not valid, or cannot be linearised.
        UsageError: Another argument is not valid.
    """
    ranges = [parse_edge_range(text) for text in over]
    if not 1 <= roots <= MAX_ROOTS:
        raise UsageError(f"--roots is a number of roots, 1 to {MAX_ROOTS}, not {roots}")

    scenario = load_scenario(source, overrides)
    conditions = derive_operating_conditions(scenario)
    rest = find_equilibrium(scenario, pose)
    loop = linearise_loop(conditions, rest)

    analysis = LinearAnalysis(
        scenario=scenario,
        conditions=conditions,
        rest=rest,
        loop=loop,
        continuous=compute_delay_spectrum(loop, roots),
        sampled=compute_sampled_spectrum(conditions, rest, roots),
        margin=find_delay_margin(loop),
    )

    scans = []
    for key, low, high in ranges:
        edges = iterate_linear_edges(scenario, key, low=low, high=high, rest=rest)
        scans.append(EdgeScan(key, low, high, tuple(edges)))
    port_analysis = analyse_ports(scenario, rest, hands=hands) if ports else None
    return replace(analysis, scans=tuple(scans), ports=port_analysis)


def _margin_to_json(margin: DelayMargin) -> dict[str, Any]:
    """Returns a delay margin as plain values."""
    intervals = []
    for interval in margin.intervals:
        ends = {"from_s": interval.low_s, "to_s": interval.high_s}
        intervals.append(ends)
    crossings = []
    for crossing in margin.crossings:
        values = {
            "delay_s": crossing.delay_s,
            "omega_rad_s": crossing.omega_rad_s,
            "pairs_to_the_right": crossing.pairs,
        }
        crossings.append(values)
    return {"words": margin.description, "stable": intervals, "crossings": crossings}


def _spectrum_to_json(spectrum: Spectrum) -> dict[str, Any]:
    """Returns the roots of a loop as plain values."""
    roots = []
    for root in spectrum.roots:
        values = {
            "re_per_s": root.s.real,
            "im_rad_s": root.s.imag,
            "damping": root.damping,
            "modes": root.multiplicity,
            "states": list(root.states),
        }
        roots.append(values)

    return {
        "verdict": spectrum.verdict,
        "roots": roots,
        "zeros_by_structure": spectrum.zeros,
        "of_those_drifting": spectrum.drifting,
        "dropped_candidates": spectrum.dropped,
        "order": spectrum.order,
        "span_s": spectrum.span_s,
        "deviation_per_s": spectrum.deviation_per_s,
    }


_ROOTS = 2
"""Number of rightmost roots that are computed at the end of a run."""


def certify_run(
    log: Log,
    *,
    min_coverage: float = MIN_COVERAGE,
    own_laws: bool = False,
    twins: int = TWINS,
) -> Certificate:
    """Certifies whether a recorded run was stable, with all available checks.

    In addition to the checks of `certify`, the run is repeated with small pushes, to see
    whether disturbances grow. The characteristic roots of the coupled arms are computed at the
    end pose.

    Args:
        log: The log of the run.
        min_coverage: Least fraction of the ticks (periods of the control loop) of each arm's
            process that must be recorded.
        own_laws: True if the code of users' control laws may be executed.
        twins: Number of repeated runs with a push. 0 for none.

    Raises:
        LogError: A record cannot be read, or names a change that does not exist.
    """
    certificate = certify(log, min_coverage=min_coverage, own_laws=own_laws)
    growth = None
    if twins:
        growth = measure_twins(log, certificate.end, twins, own_laws=own_laws)
    return replace(certificate, roots=find_end_pose_roots(log), twins=growth)


def find_end_pose_roots(log: Log) -> EndPoseRoots:
    """Computes whether small motions about the end pose of a recorded run die away.

    The control loop is linearised at this pose, and its characteristic roots are computed.

    Args:
        log: The log of the run.

    Returns:
        The roots, or the reason why there are none.
    """
    site_logs = [log[site] for site in log.sites]
    if not all(map(len, site_logs)):
        return _explain_no_roots("a site has no records")
    if any(site_log.mode[-1] == "diverged" for site_log in site_logs):
        return _explain_no_roots("the run diverged")
    if any(log.changes(site) for site in log.sites):
        return _explain_no_roots("commands changed the loop while it ran")

    fixed = _fix_delays(log)
    try:
        conditions = derive_operating_conditions(fixed.scenario, own_laws=False)
        for pair, age_s in fixed.mean_age_s.items():
            conditions.age_s[pair] = age_s
        q, theta_hat = _choose_end_state(fixed.scenario, site_logs)
        end = Equilibrium(q, theta_hat, "the end of the log", 0.0)
        rest = follow_equilibrium(fixed.scenario, end)
    except ScenarioError as error:
        return _explain_no_roots(error.problem)

    sampled = compute_sampled_spectrum(conditions, rest, _ROOTS, fixed.uses)
    if sampled is not None:
        return _describe_end_pose_roots(
            sampled, sampled.basis, exact=sampled.deviation_per_s is None
        )

    continuous = compute_delay_spectrum(linearise_loop(conditions, rest), _ROOTS)
    basis = ", in continuous time"
    if conditions.varying or fixed.mean_age_s:
        basis += ", of the mean ages"
    return _describe_end_pose_roots(continuous, basis, exact=False)


def _describe_end_pose_roots(spectrum: Spectrum, basis: str, *, exact: bool) -> EndPoseRoots:
    """Returns the rightmost root and the verdict, as the certificate states them.

    Args:
        spectrum: The roots at the end pose.
        basis: A phrase that states over which ticks the roots are computed.
        exact: True if no delay is averaged or assumed to repeat.
    """
    root = spectrum.rightmost
    verdict = spectrum.verdict
    if root is None:
        return EndPoseRoots(verdict, None, exact, f"this rest: {verdict}, without roots")

    omega = f" at {abs(root.s.imag):.4g} rad/s" if root.s.imag else ""
    drift = ""
    if spectrum.drifting:
        drift = f"{spectrum.drifting} of its motions keep their speed, the others "
    text = f"this rest: {verdict}, {drift}{root.s.real:+.3g} /s{omega}{basis}"
    return EndPoseRoots(verdict, root.s.real, exact, text)


class _FixedDelays(NamedTuple):
    """A recorded scenario in which every delay is known.

    Attributes:
        scenario: The scenario up to the end of the records. A link whose delays only the
            records show has its constant mean delay.
        uses: The samples in use in the last quarter of the run. None if the scenario determines
            all delays, or if no sample was received over some link.
        mean_age_s: Mean age of the samples on links with unknown delays, in s, by (index of the
            receiver, index of the sender).
    """

    scenario: Scenario
    uses: SamplesInUse | None
    mean_age_s: dict[tuple[int, int], float]


def _fix_delays(log: Log) -> _FixedDelays:
    """Returns the scenario of a log with the delays that the records show.

    A tick without a record is assumed to use the samples of the tick before.
    """
    scenario = msgspec.structs.replace(log.scenario, duration_s=recorded_end_s(log))
    has_unknown_delay = {}
    for name, link in scenario.links.items():
        has_trace = link.points is not None
        has_unknown_delay[name] = link.random or link.measured or has_trace
    if not any(has_unknown_delay.values()):
        return _FixedDelays(scenario, None, {})

    sites = [log[name] for name in scenario.names]
    links = dict(scenario.links)
    rates_hz = [site.rate_hz for site in sites]
    common_hz = math.gcd(*rates_hz)
    # start and end of the last quarter, in ticks of the common rate
    last_ticks = [int(site.tick[-1]) * common_hz // site.rate_hz for site in sites]
    end = max(1, min(last_ticks))
    start = max(3 * end // 4, end - round(DRAWN_SPAN_S * common_hz))

    used = {}
    mean_age_s = {}
    for (i, site), (j, peer) in permutations(enumerate(sites), 2):
        first_tick = start * site.rate_hz // common_hz
        end_tick = end * site.rate_hz // common_hz
        ticks = np.arange(first_tick, end_tick)
        rows_after = np.searchsorted(site.tick, ticks, side="right")
        rows = np.maximum(rows_after - 1, 0)
        samples = site.used[peer.name][rows]
        if samples.min() < 0:
            # the peer had not sent a sample yet, or never sent a sample
            return _FixedDelays(scenario, None, {})

        first_sample = start * peer.rate_hz // common_hz
        used[i, j] = samples - first_sample
        name = f"{peer.name}->{site.name}"
        if has_unknown_delay[name]:
            ages_s = ticks / site.rate_hz - samples / peer.rate_hz
            mean_age_s[i, j] = float(ages_s.mean())
            links[name] = ConstantDelay(delay_ms=1e3 * mean_age_s[i, j])

    span_s = (end - start) / common_hz
    uses = SamplesInUse(span_s, used)
    fixed_scenario = msgspec.structs.replace(scenario, links=links)
    return _FixedDelays(fixed_scenario, uses, mean_age_s)


def _explain_no_roots(reason: str) -> EndPoseRoots:
    """Returns a result without roots, with the reason."""
    return EndPoseRoots("", None, False, f"this rest: no roots: {reason}")


def _choose_end_state(scenario: Scenario, site_logs: Sequence[SiteLog]) -> tuple[Array, Array]:
    """Chooses the angles and the estimates of all sites at the end of a run.

    For a site at rest they are those of the last record, for any other site the mean of the
    last quarter. If arms chatter at a sampled wall, the state of the last quarter that is
    deepest in the wall is chosen.

    Args:
        scenario: Scenario of the run.
        site_logs: Logs of all sites.

    Returns:
        Angles, shape (N, n), in rad.
        Estimates, shape (N, P).
    """
    count = min(map(len, site_logs))
    rows = slice(3 * count // 4, count)
    first_times = site_logs[0].t_s[rows]
    have_same_times = True
    for site_log in site_logs:
        have_same_times &= np.array_equal(site_log.t_s[rows], first_times)

    if have_same_times and not all(map(_is_at_rest, site_logs)):
        joints = max(site_log.q.shape[1] for site_log in site_logs)
        padded = []
        for site_log in site_logs:
            missing_joints = joints - site_log.q.shape[1]
            padding = ((0, 0), (0, missing_joints))
            padded.append(np.pad(site_log.q[rows], padding))
        q = np.stack(padded, axis=1)
        deepest = find_deepest_contact(scenario, q)
        if deepest is not None:
            estimates = [site_log.theta_hat[rows][deepest] for site_log in site_logs]
            return q[deepest], pad_rows(estimates)

    angles = [_find_end_value(site_log, site_log.q) for site_log in site_logs]
    estimates = [_find_end_value(site_log, site_log.theta_hat) for site_log in site_logs]
    return pad_rows(angles), pad_rows(estimates)


def _is_at_rest(site_log: SiteLog) -> bool:
    """Returns True if no joint moved faster than `SETTLED_SPEED_RAD_S` in the last second."""
    t_s = site_log.t_s
    in_last_second = t_s > t_s[-1] - 1.0
    last_speeds = np.abs(site_log.qd[in_last_second])
    return float(last_speeds.max()) <= SETTLED_SPEED_RAD_S


def _find_end_value(site_log: SiteLog, values: Array) -> Array:
    """Returns a signal's last value if the arm is at rest, else its last quarter's mean."""
    if _is_at_rest(site_log):
        return np.asarray(values[-1])
    t_s = site_log.t_s
    in_last_quarter = t_s >= 0.75 * t_s[-1]
    mean = values[in_last_quarter].mean(axis=0)
    return np.asarray(mean)
