"""Computes the characteristic roots of the control loop at the end of a run, for all commands.

If all roots have a negative real part, small motions about the final pose of the run decay. The
control loop of the coupled arms may change during a run, through planned changes or commands.
This module therefore first finds the final loop: the delays, weights, operators and
environments in effect at the end. It then linearises this loop at the final pose.

The delays of the final loop are known if they are constant, or follow sinusoids or tables that
repeat. If a table has ended, its last delay remains in effect. Random and measured delays are
known only from the records. The roots are then those for the delays that occurred in the last
quarter of the records.

Invariant:
    - Roots are called exact only if every delay is constant or repeats after the analysed
      period, if the loop is analysed with its ticks, and if the rightmost root has the same
      sign at the final pose and at the nearest equilibrium.
    - A command that sets a link or a dominance factor to its present value is not counted as a
      change.
    - The code of imported control laws is executed only with permission. Without permission, no
      roots are computed for such a loop.
    - With permission, unstable roots count as exact and stable ones do not, because the law may
      contain thresholds that its derivative at the pose does not show. The same rule applies to
      sampled walls, because an arm may oscillate at a wall although the equilibrium next to the
      wall is stable.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, permutations
from typing import NamedTuple

import msgspec
import numpy as np

from ...core import BUCKETS_PER_S, Array
from ...errors import ScenarioError
from ...execution import FusedRun
from ...log import Ints, Log
from ...records import NS_PER_S, Mode
from ...scenario import Scenario
from ..blas_threads import limit_blas_threads
from ..run_end import SETTLED_SPEED_RAD_S, RunTrace
from ..shared_slave import list_program_sites
from ..stability_decision import LoopRoots
from ..timeline import Timeline
from .characteristic_roots import Spectrum
from .equilibrium import follow_equilibrium, pad_rows, settle_memories
from .floquet import DRAWN_SPAN_S, SampledLoop, SamplesInUse
from .linear_edge import find_deepest_contact
from .linear_loop import LinearLoop
from .operating_point import Equilibrium, OperatingConditions

_SAME_POSE_RAD = 1e-6
"""Poses that differ by less than this, in rad, are assumed to have the same roots."""
_ZERO_SHARE = 0.1
"""Share of the rightmost root at the pose of rest below which a root at the last pose counts as
zero.
"""
_ROOTS = 2
"""Number of rightmost roots that are computed at the end of a run."""
_BATCH_RECORDS = 4096
"""Number of records of each site that are read from a simulated run at a time."""


class EndLoop(NamedTuple):
    """Control loop of all arms at the end of a run, with its equilibrium.

    The loop is linearised about the equilibrium to decide whether small motions decay.

    Attributes:
        scenario: The scenario up to the end of the run. Delays that are known only from the run
            are replaced by their mean.
        conditions: The data from which the loop is built.
        rest: The equilibrium nearest to the end of the run.
        uses: The samples in use in the last quarter of the run, if delays are random or
            measured. `None` if the scenario determines all delays.
        has_mean_ages: True if the age of the samples on some link is a mean over the last
            quarter of the run.
        distance_rad: Largest difference between the final angle of a joint and its angle at the
            equilibrium, in rad.
        last_pose: The final pose of the run, or `None` if it is the equilibrium. Arms that no
            operator holds may come to rest anywhere between the two.
        programs: Sites whose arms are moved by a user's program. The reaction of the program to
            the arms is not part of the linearised loop.
    """

    scenario: Scenario
    conditions: OperatingConditions
    rest: Equilibrium
    uses: SamplesInUse | None
    has_mean_ages: bool
    distance_rad: float
    last_pose: Equilibrium | None = None
    programs: tuple[str, ...] = ()

    @classmethod
    def of_log(cls, log: Log, *, own_laws: bool = False) -> "EndLoop":
        """Finds the control loop at the end of a recorded run, and the nearest equilibrium.

        The linear analysis of this loop shows whether the run is stable.

        Args:
            log: The log of the run.
            own_laws: True if the code of imported control laws may be executed.

        Raises:
            ScenarioError: The loop cannot be linearised, or the run did not end near an
                equilibrium.
        """
        site_logs = [log[site] for site in log.sites]
        if not all(map(len, site_logs)):
            raise ScenarioError("a site has no records", source=log.source)
        for site_log in site_logs:
            _check_mode(site_log.name, site_log.mode[-1], log.source)

        def read_used_samples(i: int, j: int, ticks: Ints) -> Ints:
            """Returns which samples of another arm were in use at given ticks.

            Samples are numbered from 0. For a tick without a record, the samples of the last
            preceding record are returned.

            Args:
                i: Index of the receiving site.
                j: Index of the peer that sent the samples.
                ticks: Ticks of the receiving site, shape (K,).

            Returns:
                Numbers of the samples, shape (K,). Negative before the first sample.
            """
            site_log = site_logs[i]
            rows_after = np.searchsorted(site_log.tick, ticks, side="right")
            rows = np.maximum(rows_after - 1, 0)
            used: Ints = site_log.used[log.sites[j]][rows]
            return used

        last_ticks = [int(site_log.tick[-1]) for site_log in site_logs]
        final = _fix_delays(Timeline(log).final_scenario, last_ticks, read_used_samples)
        trace = RunTrace.of_log(log)
        state = None
        if _has_sampled_wall(final.scenario):
            motions = [
                _SiteMotion(part.t_s, part.q, part.qd, part.theta_hat) for part in site_logs
            ]
            state = _find_state_in_wall(final.scenario, motions)
        if state is None:
            theta_hat = [site_log.theta_hat[-1] for site_log in site_logs]
            state = _choose_end_state(final.scenario, trace, theta_hat)
        loop = _build_end_loop(final, state, trace, own_laws=own_laws)
        return loop._replace(programs=tuple(list_program_sites(log)))

    @classmethod
    def of_run(cls, scenario: Scenario, run: FusedRun) -> "EndLoop":
        """Finds the control loop at the end of a simulated run, and the nearest equilibrium.

        The linear analysis of this loop shows whether the run is stable. The code of imported
        control laws is executed.

        Args:
            scenario: The scenario of the run.
            run: The run in the fused loop.

        Raises:
            ScenarioError: The loop cannot be linearised, or the run did not end near an
                equilibrium.
        """
        if run.diverged_s is not None:
            _check_mode(scenario.names[0], "diverged", scenario.name)
        for i, name in enumerate(scenario.names):
            mode = Mode(int(run.arrays(i).site[0]["mode"]))
            _check_mode(name, mode.name.lower(), scenario.name)
        ended = msgspec.structs.replace(scenario, duration_s=run.ran_s)
        last_ticks = [ended.ticks(name) - 1 for name in ended.names]

        def draw_samples(i: int, j: int, ticks: Ints) -> Ints:
            """Returns which samples of another arm were in use, according to the delay model.

            This corresponds to `read_used_samples` in `of_log`. A simulated run without a log
            has no records, but the random delays of the link can be drawn again from its seed.
            The drawn delays include the planned changes and outages of the link.

            Args:
                i: Index of the receiving site.
                j: Index of the peer that sent the samples.
                ticks: Ticks of the receiving site, shape (K,).

            Returns:
                Numbers of the samples, shape (K,). -1 before the first sample.
            """
            used = run.read_samples_in_use(i, last_ticks[i] + 1)
            # A site is not its own peer, so the peers after it move up by one column.
            samples: Ints = used[ticks, j - (j > i)]
            return samples

        final = _fix_delays(ended, last_ticks, draw_samples)
        trace = RunTrace.of_run(run)
        state = None
        if _has_sampled_wall(ended):
            state = _find_state_in_wall(ended, _record_motions(ended))
        if state is None:
            theta_hat = []
            for name, record in zip(ended.names, run.records, strict=True):
                columns = ended.layout(name).columns()
                theta_hat.append(record[columns["theta_hat"]])
            state = _choose_end_state(ended, trace, theta_hat)
        loop = _build_end_loop(final, state, trace, own_laws=True)
        programs = [site for site in scenario.names if scenario.sites[site].has_program_hand]
        return loop._replace(programs=tuple(programs))


@limit_blas_threads()
def find_log_roots(log: Log, *, own_laws: bool = False) -> LoopRoots:
    """Decides by linear analysis whether small motions at the end of a recorded run decay.

    The coupled arms are linearised at the equilibrium nearest to the final pose. The result may
    prove that these motions decay, or that they grow.

    Args:
        log: The log of the run.
        own_laws: True if the code of imported control laws may be executed. Otherwise no roots
            are computed for a loop with such a law.

    Returns:
        The roots of the final loop, or the reason why there are none.
    """
    try:
        loop = EndLoop.of_log(log, own_laws=own_laws)
    except ScenarioError as error:
        return _explain_no_roots(error.problem)
    return _compute_roots(loop)


@limit_blas_threads()
def find_run_roots(scenario: Scenario, run: FusedRun) -> LoopRoots:
    """Decides by linear analysis whether small motions at the end of a simulated run decay.

    The result equals that of `find_log_roots` for a log of the same run, but no log is needed.
    Studies with many runs use this function.

    Args:
        scenario: The scenario of the run.
        run: The run in the fused loop.

    Returns:
        The roots of the loop at the end of the run, or the reason why there are none.
    """
    try:
        loop = EndLoop.of_run(scenario, run)
    except ScenarioError as error:
        return _explain_no_roots(error.problem)
    return _compute_roots(loop)


def _check_mode(site: str, mode: str, source: str) -> None:
    """Checks that an arm followed the others in the last control period of a run.

    Args:
        site: Name of the site, the process that runs the arm.
        mode: Last mode of the site, as a log states it.
        source: Name of the log or scenario for the error message.

    Raises:
        ScenarioError: The run diverged, or the arm did not follow the others.
    """
    if mode == "diverged":
        raise ScenarioError("the run diverged", source=source)
    if mode != "run":
        raise ScenarioError(f"{site} ends in the mode {mode!r}", source=source)


class _FixedDelays(NamedTuple):
    """A scenario in which the delay of every network link is known at every time.

    A linear analysis needs known delays, but measured delays are known only after the run.

    Attributes:
        scenario: The scenario up to the end of the run. Delays that are known only from the run
            are replaced by their mean.
        uses: The samples in use in the last quarter of the run. `None` if the scenario
            determines all delays, or if no sample was received over some link.
        mean_age_s: Mean age of the samples on links with unknown delays, in s, by (index of the
            receiver, index of the sender).
    """

    scenario: Scenario
    uses: SamplesInUse | None
    mean_age_s: dict[tuple[int, int], float]


class _EndState(NamedTuple):
    """Poses of all arms at the end of a run, from which the search for a pose of rest starts.

    Attributes:
        q: Joint angles, shape (N, n), in rad.
        estimates: Estimates of the parameters of the arms, shape (N, P).
        how: Phrase for the user that describes the state.
    """

    q: Array
    estimates: Array
    how: str


def _build_end_loop(
    final: _FixedDelays, state: _EndState, trace: RunTrace, *, own_laws: bool
) -> EndLoop:
    """Returns the control loop at the end of a run, with the nearest pose of rest.

    Args:
        final: The final loop.
        state: The state of all arms.
        trace: The reduced data of the run.
        own_laws: True if the code of imported control laws may be executed.

    Raises:
        ScenarioError: The loop cannot be linearised, or has no equilibrium near the state.
    """
    conditions = OperatingConditions.derive(final.scenario, own_laws=own_laws)
    for pair, age_s in final.mean_age_s.items():
        conditions.age_s[pair] = age_s
    end = Equilibrium(state.q, state.estimates, state.how, 0.0)
    rest = follow_equilibrium(final.scenario, settle_memories(conditions, end))
    last_q = _find_last_angles(final.scenario, trace)
    distance_rad = float(np.abs(last_q - rest.q).max())
    return EndLoop(
        scenario=final.scenario,
        conditions=conditions,
        rest=rest,
        uses=final.uses,
        has_mean_ages=bool(final.mean_age_s),
        distance_rad=distance_rad,
        last_pose=None if distance_rad <= _SAME_POSE_RAD else rest._replace(q=last_q),
    )


def _compute_roots(loop: EndLoop) -> LoopRoots:
    """Computes the fastest growing (rightmost) roots of the loop at the end of a run.

    A root is the complex growth rate of a small motion. A stability certificate states these
    roots.

    Args:
        loop: The loop at the end of a run.
    """
    if not loop.conditions.has_forms:
        sampled_loop = SampledLoop(loop.conditions, loop.uses)
        sampled = sampled_loop.compute_spectrum(loop.rest, _ROOTS)
        # Roots show growth, but may miss what happens beyond a threshold: in a user's law, or
        # when an arm touches a sampled wall again.
        has_user_law = bool(loop.scenario.user_laws)
        has_threshold = has_user_law or _has_sampled_wall(loop.scenario)
        is_proof_possible = not has_threshold or sampled.verdict == "unstable"
        # A program that reacts to the arms may make a loop unstable, or stable.
        exact = sampled.is_exact and is_proof_possible and not loop.programs
        if exact and loop.last_pose is not None:
            # The arms still move, and it is not known where in between they will rest.
            exact = _has_same_sign(sampled_loop, sampled, loop.last_pose)
        roots = _summarise_roots(sampled, exact=exact)
        return roots._replace(
            distance_rad=loop.distance_rad,
            programs=loop.programs,
            is_numerical=has_user_law,
            span_s=sampled.span_s,
            repeats=sampled.is_exact,
            deviation_per_s=sampled.deviation_per_s,
        )
    continuous = Spectrum.of_loop(LinearLoop.of_conditions(loop.conditions, loop.rest), _ROOTS)
    roots = _summarise_roots(continuous, exact=False)
    return roots._replace(
        programs=loop.programs,
        is_continuous=True,
        has_mean_ages=loop.conditions.varying or loop.has_mean_ages,
    )


def _has_same_sign(loop: SampledLoop, at_rest: Spectrum, last_pose: Equilibrium) -> bool:
    """Returns True if the rightmost roots at rest and at the last pose have the same sign.

    At a pose that is not a pose of rest, the roots at zero are slightly displaced. Therefore a
    root at the last pose counts as zero if it is below a tenth of the root at the pose of rest.

    Args:
        loop: The loop at the end of the run.
        at_rest: The roots at the pose of rest nearest to the end of the run.
        last_pose: The last pose of the run.
    """
    if at_rest.rightmost is None:
        return True
    rate_per_s = at_rest.rightmost.s.real
    last_rate_per_s = loop.measure_rightmost_rate(last_pose, rate_per_s)
    if last_rate_per_s is None:
        return True
    grows_at_last = last_rate_per_s > _ZERO_SHARE * abs(rate_per_s)
    return grows_at_last == (rate_per_s > 0.0)


def _summarise_roots(spectrum: Spectrum, *, exact: bool) -> LoopRoots:
    """Returns the fastest growing root, and its verdict on the stability of the run.

    Args:
        spectrum: The roots at the end pose.
        exact: True if no delay is averaged or assumed to repeat.
    """
    root = spectrum.rightmost
    if root is None:
        return LoopRoots(spectrum.verdict, None, exact)
    swing_rates_per_s = [other.s.real for other in spectrum.roots if other.s.imag]
    return LoopRoots(
        verdict=spectrum.verdict,
        rate_per_s=root.s.real,
        exact=exact,
        swing_rate_per_s=max(swing_rates_per_s, default=None),
        omega_rad_s=abs(root.s.imag),
        drifting=spectrum.drifting,
    )


def _explain_no_roots(reason: str) -> LoopRoots:
    """Returns a result without roots, with the reason why they could not be computed.

    Args:
        reason: The reason, as a phrase for the user.
    """
    return LoopRoots("", None, False, reason=reason)


def _end_traces(scenario: Scenario) -> Scenario:
    """Returns a scenario in which tables of delays that have ended are constant delays.

    After the end of such a table its last delay stays in force, so the final loop has a
    constant delay. The constant delay also replaces the planned changes of the link.

    Args:
        scenario: The scenario up to the end of the run.
    """
    end_us = 1e6 * scenario.duration_s
    last_delays_ms = {}
    for name in scenario.links:
        link = scenario.find_final_link(name)
        points = link.points
        if link.has_ending_trace and points is not None and points[-1, 0] <= end_us:
            last_delays_ms[name] = 1e-3 * float(points[-1, 1])
    return scenario.with_constant_delays(last_delays_ms)


def _list_unknown_delays(scenario: Scenario) -> dict[str, bool]:
    """Finds the network links whose delays are random or measured, and known only after a run.

    Returns:
        For each link, by its name, True if its delays are unknown before a run.
    """
    has_unknown_delay = {}
    for name in scenario.links:
        link = scenario.find_final_link(name)
        has_unknown_delay[name] = link.random or link.measured or link.has_ending_trace
    return has_unknown_delay


def _fix_delays(
    scenario: Scenario,
    last_ticks: Sequence[int],
    find_used: Callable[[int, int, Ints], Ints],
) -> _FixedDelays:
    """Returns a scenario in which random and measured delays are replaced by those of its run.

    These delays cannot be predicted. The messages in use in the last quarter of the run stand
    for all later ones.

    Args:
        scenario: The scenario up to the end of the run.
        last_ticks: Last tick of each site.
        find_used: Function that returns the numbers of the samples that a site used. Its
            arguments are the index of the site, the index of the peer that sent the samples,
            and the ticks of the site. A number is negative before the first sample. For a tick
            without a record, the samples of the previous tick are returned.
    """
    scenario = _end_traces(scenario)
    has_unknown_delay = _list_unknown_delays(scenario)
    if not any(has_unknown_delay.values()):
        return _FixedDelays(scenario, None, {})

    rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
    common_hz = math.gcd(*rates_hz)
    # start and end of the last quarter, in ticks of the common rate
    common_ticks = [
        tick * common_hz // rate_hz for tick, rate_hz in zip(last_ticks, rates_hz, strict=True)
    ]
    end = max(1, min(common_ticks))
    start = max(3 * end // 4, end - round(DRAWN_SPAN_S * common_hz))

    used = {}
    mean_age_s = {}
    delays_ms = {}
    for (i, site), (j, peer) in permutations(enumerate(scenario.names), 2):
        first_tick = start * rates_hz[i] // common_hz
        end_tick = end * rates_hz[i] // common_hz
        ticks = np.arange(first_tick, end_tick)
        samples = find_used(i, j, ticks)
        if samples.min() < 0:
            # the peer had not sent a sample yet, or never sent a sample
            return _FixedDelays(scenario, None, {})

        first_sample = start * rates_hz[j] // common_hz
        used[i, j] = samples - first_sample
        name = f"{peer}->{site}"
        if has_unknown_delay[name]:
            ages_s = ticks / rates_hz[i] - samples / rates_hz[j]
            mean_age_s[i, j] = float(ages_s.mean())
            delays_ms[name] = 1e3 * mean_age_s[i, j]

    span_s = (end - start) / common_hz
    uses = SamplesInUse(span_s, used)
    return _FixedDelays(scenario.with_constant_delays(delays_ms), uses, mean_age_s)


def _choose_end_state(
    scenario: Scenario, trace: RunTrace, theta_hat: Sequence[Array]
) -> _EndState:
    """Chooses the joint angles and parameter estimates of all arms at the end of a run.

    For an arm at rest, the last angles are used. For an arm that still moves, the angles are
    the mean over the last quarter of the run, in intervals of 50 ms.

    Args:
        scenario: Scenario of the run.
        trace: The reduced data of the run.
        theta_hat: Last estimates of each site.
    """
    angles = []
    fastest_rad_s = 0.0
    for q, speeds in _iterate_motions(scenario, trace):
        speed_rad_s = float(speeds[-BUCKETS_PER_S:].max())
        fastest_rad_s = max(fastest_rad_s, speed_rad_s)
        if speed_rad_s <= SETTLED_SPEED_RAD_S:
            angles.append(q[-1])
        else:
            last_quarter = slice(3 * len(q) // 4, len(q))
            angles.append(q[last_quarter].mean(axis=0))

    end_s = min(map(len, trace.buckets)) / BUCKETS_PER_S
    how = (
        f"the run still moves at {end_s:.4g} s ({fastest_rad_s:.2g} rad/s): "
        "the equilibrium nearest to the mean of its last quarter"
    )
    if fastest_rad_s <= SETTLED_SPEED_RAD_S:
        how = f"the run is at rest at {end_s:.4g} s (slower than {SETTLED_SPEED_RAD_S:g} rad/s)"
    return _EndState(pad_rows(angles), pad_rows(theta_hat), how)


def _find_last_angles(scenario: Scenario, trace: RunTrace) -> Array:
    """Returns the last recorded joint angles of all arms, shape (N, n), in rad.

    Args:
        scenario: Scenario of the run.
        trace: The reduced data of the run.
    """
    return pad_rows([q[-1] for q, _ in _iterate_motions(scenario, trace)])


def _iterate_motions(scenario: Scenario, trace: RunTrace) -> Iterator[tuple[Array, Array]]:
    """Yields the joint angles and largest speeds of each arm, in intervals of 50 ms.

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


class _SiteMotion(NamedTuple):
    """Recorded motion of one arm, with the estimates of its control law.

    Attributes:
        t_s: Times of the K records, shape (K,), in s.
        q: Joint angles, shape (K, n), in rad.
        qd: Joint velocities, shape (K, n), in rad/s.
        theta_hat: Estimates of the parameters of the arm, shape (K, P).
    """

    t_s: Array
    q: Array
    qd: Array
    theta_hat: Array

    @property
    def is_at_rest(self) -> bool:
        """True if no joint exceeded `SETTLED_SPEED_RAD_S` in the last second of the run."""
        in_last_second = self.t_s > self.t_s[-1] - 1.0
        last_speeds = np.abs(self.qd[in_last_second])
        return float(last_speeds.max()) <= SETTLED_SPEED_RAD_S


def _record_motions(scenario: Scenario) -> list[_SiteMotion]:
    """Simulates a scenario again, and returns the motion of each site.

    The judged run has kept only reduced data and its last records. The state of an arm that
    chatters at a wall needs all records of the last quarter. The records are read in batches,
    so that a long run does not need memory for whole records.

    Args:
        scenario: The scenario up to the end of the run.
    """
    run = FusedRun(scenario, keep=_BATCH_RECORDS + 1)
    batches: list[list[_SiteMotion]] = [[] for _ in scenario.names]
    for records in run.iterate_batches():
        for n, (t_ns, rows) in enumerate(records):
            columns = scenario.layout(scenario.names[n]).columns()
            batch = _SiteMotion(
                t_s=t_ns / NS_PER_S,
                q=rows[:, columns["q"]],
                qd=rows[:, columns["qd"]],
                theta_hat=rows[:, columns["theta_hat"]],
            )
            batches[n].append(batch)
    return [
        _SiteMotion(
            t_s=np.concatenate([part.t_s for part in parts]),
            q=np.concatenate([part.q for part in parts]),
            qd=np.concatenate([part.qd for part in parts]),
            theta_hat=np.concatenate([part.theta_hat for part in parts]),
        )
        for parts in batches
    ]


def _has_sampled_wall(scenario: Scenario) -> bool:
    """Returns True if the force of some wall is computed once per control period and held.

    An arm may then chatter at the wall, and its mean pose may lie outside the wall although the
    arm hits the wall in every cycle.

    Args:
        scenario: Scenario of the run.
    """
    environments = chain.from_iterable(spec.environment for spec in scenario.sites.values())
    return any(environment.actor.sampled for environment in environments)


def _find_state_in_wall(scenario: Scenario, motions: Sequence[_SiteMotion]) -> _EndState | None:
    """Finds the deepest state of arms that chatter at a wall in the last quarter of a run.

    The mean of such a motion may lie outside the wall, where the loop is different. The deepest
    state is inside the wall, so the wall's stiffness is part of the linearised loop.

    Args:
        scenario: Scenario of the run.
        motions: Motion of each site.

    Returns:
        The state. `None` if all sites are at rest, or if no arm touches a sampled wall.
    """
    count = min(len(motion.t_s) for motion in motions)
    rows = slice(3 * count // 4, count)
    first_times_s = motions[0].t_s[rows]
    have_same_times = True
    for motion in motions:
        have_same_times &= np.array_equal(motion.t_s[rows], first_times_s)
    if not have_same_times or all(motion.is_at_rest for motion in motions):
        return None

    joints = max(motion.q.shape[1] for motion in motions)
    padded = []
    for motion in motions:
        missing_joints = joints - motion.q.shape[1]
        padding = ((0, 0), (0, missing_joints))
        padded.append(np.pad(motion.q[rows], padding))
    q = np.stack(padded, axis=1)
    deepest = find_deepest_contact(scenario, q)
    if deepest is None:
        return None
    estimates = [motion.theta_hat[rows][deepest] for motion in motions]
    how = (
        f"an arm chatters at a wall, and is deepest in it at {first_times_s[deepest]:.4g} s: "
        "the equilibrium nearest to this state"
    )
    return _EndState(q[deepest], pad_rows(estimates), how)
