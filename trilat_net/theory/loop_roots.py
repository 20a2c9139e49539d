"""Decides which characteristic roots a control loop has at the end of a run, for every command.

The coupled arms are linearised at the pose at which a run ended. If all roots have a negative
real part, small motions about this pose die away. The roots belong to the final loop: the
delays, dominance factors (weights with which the arms follow each other), operators and
environments that are in force at the end, after all planned changes and all commands.

The delays of the final loop are known if they are constant, or follow sinusoids or traces that
repeat. If a trace has ended, its last delay is constant. Random and measured delays are known
from the records only. The roots are then those of the samples that were used in the last
quarter of the records.

Invariant:
    - Roots are called exact only if every delay is constant or repeats after the analysed
      period, and if the loop is analysed with its ticks, the periods of its controllers.
    - A command that leaves a link or a dominance factor as it was changes nothing.
    - The code of imported control laws is executed only with permission. Without it, such a
      loop has no roots. With it, unstable roots count as exact and stable ones do not: the law
      may contain thresholds that its derivative at the pose does not show.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import permutations
from typing import NamedTuple

import msgspec
import numpy as np

from ..analysis.run_end import SETTLED_SPEED_RAD_S, RunTrace, trace_log
from ..analysis.stability_decision import LoopRoots
from ..analysis.timeline import list_effective_commands, recorded_end_s
from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..errors import ScenarioError
from ..execution.fused import FusedRun
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..scenario import Scenario
from ..scenario.delay_models import LinkBase
from ..scenario.delay_models.kernel_delays import ConstantDelay
from ..scenario.delay_period import find_final_link, is_ending_trace
from ..scenario.imported_code import ImportedLaw
from .characteristic_roots import Spectrum, compute_delay_spectrum
from .equilibrium import follow_equilibrium, pad_rows, settle_memories
from .floquet import DRAWN_SPAN_S, SamplesInUse, compute_sampled_spectrum
from .linear_edge import find_deepest_contact
from .linear_loop import linearise_loop
from .operating_point import Equilibrium, derive_operating_conditions

_ROOTS = 2
"""Number of rightmost roots that are computed at the end of a run."""


def find_log_roots(log: Log, *, own_laws: bool = False) -> LoopRoots:
    """Computes whether small motions about the end pose of a recorded run die away.

    Args:
        log: The log of the run.
        own_laws: True if the code of imported control laws may be executed. Otherwise a loop
            with such a law has no roots.

    Returns:
        The roots of the final loop, or the reason why there are none.
    """
    site_logs = [log[site] for site in log.sites]
    if not all(map(len, site_logs)):
        return _explain_no_roots("a site has no records")
    for site_log in site_logs:
        mode = site_log.mode[-1]
        if mode == "diverged":
            return _explain_no_roots("the run diverged")
        if mode != "run":
            return _explain_no_roots(f"{site_log.name} ends in the mode {mode!r}")

    final = _fix_delays(resolve_final_scenario(log), site_logs)
    trace = trace_log(log)
    state = _find_state_in_wall(final.scenario, site_logs)
    if state is None:
        theta_hat = [site_log.theta_hat[-1] for site_log in site_logs]
        state = _choose_end_state(final.scenario, trace, theta_hat)
    q, estimates = state
    last_q = _find_last_angles(final.scenario, trace)
    return _compute_roots(final, q, estimates, last_q=last_q, own_laws=own_laws)


def find_run_roots(scenario: Scenario, run: FusedRun) -> LoopRoots:
    """Computes whether small motions about the end pose of a simulated run die away.

    Args:
        scenario: The experiment.
        run: Its run in the fused loop.

    Returns:
        The roots of the loop at the end of the run, or the reason why there are none.
    """
    if run.diverged_s is not None:
        return _explain_no_roots("the run diverged")
    ended = msgspec.structs.replace(scenario, duration_s=run.ran_s)
    final = _FixedDelays(_end_traces(ended), None, {})
    trace = RunTrace(run.buckets, run.tau_x, run.diverged_s)
    q, estimates = _choose_end_state(scenario, trace, run.theta_hat)
    last_q = _find_last_angles(scenario, trace)
    return _compute_roots(final, q, estimates, last_q=last_q, own_laws=True)


def resolve_final_scenario(log: Log) -> Scenario:
    """Returns the scenario of a log with the commands of the run as planned changes.

    Its duration is the recorded one, so that the settings in force at its end are those of the
    final loop.

    Args:
        log: The log of the run.
    """
    commands = [change for change in list_effective_commands(log) if not change.order]
    timeline = sorted([*log.scenario.timeline, *commands], key=lambda change: change.at_s)
    return msgspec.structs.replace(
        log.scenario, timeline=tuple(timeline), duration_s=recorded_end_s(log)
    )


class _FixedDelays(NamedTuple):
    """A scenario in which every delay is known.

    Attributes:
        scenario: The scenario up to the end of the run. A link whose delays only the records
            show has its constant mean delay.
        uses: The samples in use in the last quarter of the run. None if the scenario determines
            all delays, or if no sample was received over some link.
        mean_age_s: Mean age of the samples on links with unknown delays, in s, by (index of the
            receiver, index of the sender).
    """

    scenario: Scenario
    uses: SamplesInUse | None
    mean_age_s: dict[tuple[int, int], float]


def _compute_roots(
    final: _FixedDelays, q: Array, estimates: Array, *, last_q: Array, own_laws: bool
) -> LoopRoots:
    """Computes the roots of a loop at the equilibrium nearest to a state.

    Args:
        final: The final loop.
        q: Joint angles, shape (N, n), in rad.
        estimates: Estimates of the parameters of the arms, shape (N, P).
        last_q: Joint angles at the end of the run, shape (N, n), in rad.
        own_laws: True if the code of imported control laws may be executed.
    """
    try:
        conditions = derive_operating_conditions(final.scenario, own_laws=own_laws)
        for pair, age_s in final.mean_age_s.items():
            conditions.age_s[pair] = age_s
        end = Equilibrium(q, estimates, "the end of the run", 0.0)
        rest = follow_equilibrium(final.scenario, settle_memories(conditions, end))
    except ScenarioError as error:
        return _explain_no_roots(error.problem)

    sampled = compute_sampled_spectrum(conditions, rest, _ROOTS, final.uses)
    if sampled is not None:
        laws = final.scenario.controls
        has_imported_law = any(isinstance(law, ImportedLaw) for law in laws)
        # differences of a user's law show growth, but may miss what happens beyond a threshold
        is_proof_possible = not has_imported_law or sampled.verdict == "unstable"
        exact = sampled.is_exact and is_proof_possible
        roots = _describe_roots(sampled, sampled.basis, exact=exact)
        distance_rad = float(np.abs(last_q - rest.q).max())
        return roots._replace(distance_rad=distance_rad)
    continuous = compute_delay_spectrum(linearise_loop(conditions, rest), _ROOTS)
    basis = ", in continuous time"
    if conditions.varying or final.mean_age_s:
        basis += ", of the mean ages"
    return _describe_roots(continuous, basis, exact=False)


def _describe_roots(spectrum: Spectrum, basis: str, *, exact: bool) -> LoopRoots:
    """Returns the rightmost root and the verdict, as a certificate states them.

    Args:
        spectrum: The roots at the end pose.
        basis: A phrase that states over which ticks the roots are computed.
        exact: True if no delay is averaged or assumed to repeat.
    """
    root = spectrum.rightmost
    verdict = spectrum.verdict
    if root is None:
        return LoopRoots(verdict, None, exact, f"this rest: {verdict}, without roots")

    omega = f" at {abs(root.s.imag):.4g} rad/s" if root.s.imag else ""
    drift = ""
    if spectrum.drifting:
        drift = f"{spectrum.drifting} of its motions keep their speed, the others "
    text = f"this rest: {verdict}, {drift}{root.s.real:+.3g} /s{omega}{basis}"
    return LoopRoots(verdict, root.s.real, exact, text)


def _explain_no_roots(reason: str) -> LoopRoots:
    """Returns a result without roots, with the reason."""
    return LoopRoots("", None, False, f"this rest: no roots: {reason}")


def _end_traces(scenario: Scenario) -> Scenario:
    """Returns a scenario in which traces that have ended at its end are constant delays."""
    end_us = 1e6 * scenario.duration_s
    links: dict[str, LinkBase] = dict(scenario.links)
    timeline = list(scenario.timeline)
    for name in scenario.links:
        link = find_final_link(scenario, name)
        points = link.points
        if not is_ending_trace(link) or points is None or not points[-1, 0] <= end_us:
            continue
        links[name] = ConstantDelay(delay_ms=1e-3 * float(points[-1, 1]))
        timeline = [change for change in timeline if change.link != name]
    return msgspec.structs.replace(scenario, links=links, timeline=tuple(timeline))


def _fix_delays(scenario: Scenario, sites: Sequence[SiteLog]) -> _FixedDelays:
    """Returns a scenario with the delays that the records of its run show.

    A tick without a record is assumed to use the samples of the tick before.

    Args:
        scenario: The scenario up to the end of the records.
        sites: Logs of all sites.
    """
    scenario = _end_traces(scenario)
    has_unknown_delay = {}
    for name in scenario.links:
        link = find_final_link(scenario, name)
        has_unknown_delay[name] = link.random or link.measured or is_ending_trace(link)
    if not any(has_unknown_delay.values()):
        return _FixedDelays(scenario, None, {})

    links: dict[str, LinkBase] = dict(scenario.links)
    rates_hz = [site.rate_hz for site in sites]
    common_hz = math.gcd(*rates_hz)
    # start and end of the last quarter, in ticks of the common rate
    last_ticks = [int(site.tick[-1]) * common_hz // site.rate_hz for site in sites]
    end = max(1, min(last_ticks))
    start = max(3 * end // 4, end - round(DRAWN_SPAN_S * common_hz))

    used = {}
    mean_age_s = {}
    timeline = list(scenario.timeline)
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
            timeline = [change for change in timeline if change.link != name]

    span_s = (end - start) / common_hz
    uses = SamplesInUse(span_s, used)
    fixed_scenario = msgspec.structs.replace(scenario, links=links, timeline=tuple(timeline))
    return _FixedDelays(fixed_scenario, uses, mean_age_s)


def _choose_end_state(
    scenario: Scenario, trace: RunTrace, theta_hat: Sequence[Array] | Array
) -> tuple[Array, Array]:
    """Chooses the angles and the estimates of all sites at the end of a run.

    The angles of a site at rest are the last ones. Those of a site that still moves are the
    mean over the last quarter of the run, in intervals of 50 ms.

    Args:
        scenario: Scenario of the run.
        trace: The reduced data of the run.
        theta_hat: Last estimates of each site.

    Returns:
        Angles, shape (N, n), in rad.
        Estimates, shape (N, P).
    """
    angles = []
    for q, speeds in _iterate_motions(scenario, trace):
        if speeds[-BUCKETS_PER_S:].max() <= SETTLED_SPEED_RAD_S:
            angles.append(q[-1])
        else:
            last_quarter = slice(3 * len(q) // 4, len(q))
            angles.append(q[last_quarter].mean(axis=0))
    return pad_rows(angles), pad_rows(list(theta_hat))


def _find_last_angles(scenario: Scenario, trace: RunTrace) -> Array:
    """Returns the last recorded joint angles of all sites, shape (N, n), in rad."""
    return pad_rows([q[-1] for q, _ in _iterate_motions(scenario, trace)])


def _iterate_motions(scenario: Scenario, trace: RunTrace) -> Iterator[tuple[Array, Array]]:
    """Yields the joint angles and the largest speeds of each site, in intervals of 50 ms.

    Args:
        scenario: Scenario of the run.
        trace: The reduced data of the run, whose columns `RunTrace` describes.

    Yields:
        Last angles of the intervals, shape (K, n), in rad, and largest speeds, in rad/s.
    """
    for name, buckets in zip(scenario.names, trace.buckets, strict=True):
        joints = scenario.layout(name).joints
        columns = buckets.shape[1] // 3
        q = buckets[:, 2 * columns : 2 * columns + joints]
        speeds = buckets[:, columns : 2 * columns]
        yield q, speeds


def _find_state_in_wall(
    scenario: Scenario, site_logs: Sequence[SiteLog]
) -> tuple[Array, Array] | None:
    """Finds the deepest state of arms that chatter at a sampled wall, in the last quarter.

    Args:
        scenario: Scenario of the run.
        site_logs: Logs of all sites.

    Returns:
        Angles, shape (N, n), in rad, and estimates, shape (N, P). None if all sites are at
        rest, or if no arm touches a sampled wall.
    """
    count = min(map(len, site_logs))
    rows = slice(3 * count // 4, count)
    first_times = site_logs[0].t_s[rows]
    have_same_times = True
    for site_log in site_logs:
        have_same_times &= np.array_equal(site_log.t_s[rows], first_times)
    if not have_same_times or all(map(_is_at_rest, site_logs)):
        return None

    joints = max(site_log.q.shape[1] for site_log in site_logs)
    padded = []
    for site_log in site_logs:
        missing_joints = joints - site_log.q.shape[1]
        padding = ((0, 0), (0, missing_joints))
        padded.append(np.pad(site_log.q[rows], padding))
    q = np.stack(padded, axis=1)
    deepest = find_deepest_contact(scenario, q)
    if deepest is None:
        return None
    estimates = [site_log.theta_hat[rows][deepest] for site_log in site_logs]
    return q[deepest], pad_rows(estimates)


def _is_at_rest(site_log: SiteLog) -> bool:
    """Returns True if no joint moved faster than `SETTLED_SPEED_RAD_S` in the last second."""
    t_s = site_log.t_s
    in_last_second = t_s > t_s[-1] - 1.0
    last_speeds = np.abs(site_log.qd[in_last_second])
    return float(last_speeds.max()) <= SETTLED_SPEED_RAD_S
