"""Shows whether a run is stable, by repeating it with small disturbances.

A repetition is called a twin, and its disturbance a push: a small displacement of the state at
one instant. If the distance between the twin and the run grows, the run is unstable.

When the distance becomes large, it is scaled down again (Benettin, Galgani, Giorgilli and
Strelcyn, Meccanica 15, 1980). Let x be a component of the twin's state, which includes the
samples in transit on the network, and x_run the same component in the run. Then x is replaced
by x_run + factor (x - x_run), with the same factor for all components. The sum of the
logarithms of all factors gives the total growth. If the distance has decayed to rounding
errors, the twin is pushed again.

Invariant:
    - The run is re-executed from its recorded inputs, and compared with its records.
    - A twin receives the same arrivals, changes, operator actions and random delays as the run,
      so any difference is caused by the push alone.
    - The difference is computed from two complete nonlinear runs, not from a linear model.
"""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from ...core import BUCKETS_PER_S, Array, RunInputs
from ...errors import NotRepeatable, UsageError, count_nouns
from ...execution import FusedRun
from ...log import Ints, Log
from ...records import NS_PER_S
from ...scenario import Scenario

MAX_PUSHES = 32
"""Maximum number of pushes that are chosen if the user states no number."""
PUSH_RAD = 1e-6
"""Default size of a push, in rad."""
LARGEST = 1e-4
"""Maximum difference at the end of a window, in rad or rad/s.

A larger difference is scaled down if it also exceeds ten times the size of the push.
"""
SMALLEST = 1e-12
"""Difference below which rounding errors dominate, in rad/s."""
WINDOWS = 16
"""Number of windows in a run. At the end of each, differences are scaled down or renewed."""


class Push(NamedTuple):
    """Small displacement of the state of a run, for example by 1e-6 rad at one joint.

    The run is executed a second time with this displacement. This second execution is called a
    twin.

    Attributes:
        name: Description for the user, for example "1e-06 rad at m1 joint 1".
        field: Displaced part of the state: joint angles "q" in rad, joint velocities "qd" in
            rad/s, or estimated arm parameters "theta_hat".
        by: Displacement of every element of this part, shape (N, n), with one row per site.
        at_s: Time of the push, in s after the epoch (the common start time).
        again: If True, the twin is pushed again when its difference from the run has decayed to
            rounding errors. Otherwise the twin ends then.
        largest: Difference from the run, in rad or rad/s, above which the difference is scaled
            down to the size of the push; see `LARGEST`. Infinite if it is never scaled down.
        direction: Number of the random direction, from 1, if all joints are pushed together
            because there are too few pushes for one per joint. Otherwise 0.
    """

    name: str
    field: str
    by: Array
    at_s: float = 0.0
    again: bool = True
    largest: float = LARGEST
    direction: int = 0

    @classmethod
    def parse(
        cls, scenario: Scenario, target: str, size: float = PUSH_RAD, at_s: float = 0.0
    ) -> "Push":
        """Converts a user's description of a push to a `Push` object.

        Examples of descriptions are "m1.q1" (joint 1 of site m1), "s.qd2" (velocity of joint
        2), "m2.theta3" (estimate 3) and "m1.q". Without an index, all joints or estimates of
        the site are pushed in a random direction. Without a site, the joints or estimates of
        all sites are pushed.

        The twin is pushed only once. If the size of the push is at least `LARGEST`, the
        resulting difference is never scaled down.

        Args:
            scenario: The scenario.
            target: Description of what is pushed, for example "m1.q1".
            size: Size of the push, in rad, rad/s, or the unit of an estimate.
            at_s: Time of the push, in s after the epoch (the common start time).

        Raises:
            UsageError: The target does not exist in the scenario, or the size is out of range.
        """
        match = _TARGET.fullmatch(target)
        if match is None:
            raise UsageError(_describe_targets(scenario, target))

        site, kind, number = match.groups()
        counts = _count_estimates(scenario) if kind == "theta" else _count_joints(scenario)
        owners = []  # indices of the sites that are pushed
        for i, name in enumerate(scenario.names):
            if site in (None, name) and counts[i] >= int(number or 1):
                owners.append(i)
        if not owners or (number and not site):
            raise UsageError(_describe_targets(scenario, target))
        if not LEAST_PUSH <= abs(size) <= MOST_PUSH:
            raise UsageError(
                f"--push {target}={size:g}: the size of a push must be from {LEAST_PUSH:g} "
                f"to {MOST_PUSH:g}"
            )

        generator = np.random.Generator(np.random.Philox(0))
        displacements = np.zeros((len(counts), max(counts)))
        for i in owners:
            if number:
                direction = np.arange(counts[i]) == int(number) - 1
            else:
                direction = generator.uniform(-1.0, 1.0, counts[i])
            displacements[i, : counts[i]] = size * direction

        return cls(
            name=f"{size:g} {_describe_target(site, kind, number)}",
            field="theta_hat" if kind == "theta" else kind,
            by=displacements,
            at_s=at_s,
            again=False,
            largest=LARGEST if abs(size) < LARGEST else math.inf,
        )

    @classmethod
    def choose(cls, scenario: Scenario, count: int | None = None) -> "list[Push]":
        """Chooses pushes that together can reveal every kind of instability.

        The pushes are:

        - one push of all estimated parameters, if the control law of any site estimates
          parameters;
        - up to three pushes of all joints in a random direction, with sizes of 1, 1e-3 and 1e3
          times `PUSH_RAD`. The sizes differ because growth may depend on the amplitude;
        - one push per joint, because growth at a joint that does not act on the others is
          clearly visible only if that joint itself is pushed.

        If `count` is too small for one push per joint, all joints are pushed together instead,
        in several random directions.

        Args:
            scenario: The scenario.
            count: Largest number of pushes. If None, two more than there are joints, but at
                most `MAX_PUSHES`.
        """
        # The target of "m1 joint 1" is "m1.q1".
        joint_targets = [joint.replace(" joint ", ".q") for joint in _list_joints(scenario)]
        has_estimates = any(scenario.gains(name).is_adaptive for name in scenario.names)
        # One push for each joint, and two for the estimates and for a random direction.
        complete_count = len(joint_targets) + 2
        if count is None:
            count = min(complete_count, MAX_PUSHES)

        pushes = []
        if has_estimates and count > 2:
            pushes.append(cls.parse(scenario, "theta"))
        has_push_for_each_joint = count >= complete_count
        if has_push_for_each_joint:
            random_count = min(3, count - len(joint_targets) - len(pushes))
            factors = (1.0, 1e-3, 1e3)[:random_count]
            pushes += [cls.parse(scenario, "q", factor * PUSH_RAD) for factor in factors]
            pushes += [cls.parse(scenario, target) for target in joint_targets]
        else:
            numbers = range(1, count - len(pushes) + 1)
            pushes += [_push_in_random_direction(scenario, number) for number in numbers]
        return [push._replace(again=True, largest=LARGEST) for push in pushes]


class TwinPath(NamedTuple):
    """Difference over time between a run and a slightly displaced copy of it (a twin).

    A large difference is scaled down. When the difference has decayed, the twin is pushed again
    (see `Push`). The run has K intervals of 50 ms, and all sites together have J joints.

    Attributes:
        push: Push of the twin.
        t_s: Ends of the intervals, in s, shape (K,).
        largest: Natural logarithm of the largest velocity difference of each joint in each
            interval, in rad/s, shape (K, J). It is computed as if the difference had never been
            scaled down. -inf if the twin and the run are equal.
        last: Velocity difference in the last tick of each interval, in rad/s, shape (K, J).
            This is the actual difference, which may have been scaled down.
        scale: Natural logarithm of the factor by which `last` must be multiplied to undo the
            scaling, shape (K,).
        pushed: Indices of the intervals in which the twin was pushed.
        died: Index of the interval from which onwards the difference consists only of rounding
            errors. None if there is no such interval, or if the twin was pushed again.
    """

    push: Push
    t_s: Array
    largest: Array
    last: Array
    scale: Array
    pushed: tuple[int, ...]
    died: int | None = None


class Twins(NamedTuple):
    """A run and slightly displaced copies of it (twins), which show whether the run is stable.

    A twin is a second execution of the run in which the state received a small push. The twins
    show whether small disturbances grow or die away. Use `of_log` or `of_scenario` to create
    the object.

    Attributes:
        paths: Difference between each twin and the run, over time.
        joints: Names of the joints of all sites, for example "m1 joint 1".
        speed: Largest speed of each joint of the run in each interval of 50 ms, in rad/s, shape
            (K, J), for comparison with the differences.
        same: True if the repeated run is bit-identical to the records of the log.
    """

    paths: Sequence[TwinPath]
    joints: tuple[str, ...]
    speed: Array
    same: bool

    @classmethod
    def of_log(cls, log: Log, pushes: Sequence[Push], *, own_laws: bool = False) -> "Twins":
        """Repeats the run of a log, once unchanged and once with each of the pushes.

        Args:
            log: Log of the run.
            pushes: Small displacements of the state, one per twin.
            own_laws: True if control laws written by users may run.

        Raises:
            NotRepeatable: The run cannot be repeated, or the repeated run differs from the
                records by more than rounding errors.
            LogError: A record cannot be read.
        """
        reason = FusedRun.explain_not_repeatable(log, own_laws=own_laws)
        if reason:
            raise NotRepeatable(f"twins cannot be run: {reason}")
        return _run_twins(
            scenario=log.scenario,
            pushes=pushes,
            ticks=[len(log[name]) for name in log.scenario.names],
            inputs=FusedRun.read_inputs(log),
            log=log,
        )

    @classmethod
    def of_scenario(
        cls, scenario: Scenario, pushes: Sequence[Push], duration_s: float
    ) -> "Twins":
        """Simulates an experiment, and repeats it to see if the effects of small pushes grow.

        The run and its twins (one per push) are simulated faster than real time.

        Args:
            scenario: The scenario.
            pushes: Small displacements of the state of the arms, one per twin.
            duration_s: Duration of the run, in s.

        Returns:
            The run and its twins, with the difference of each twin over time.

        Raises:
            ScenarioError: The scenario cannot be simulated.
            NotRepeatable: A push is before the start or after the end of the run.
        """
        rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
        ticks = [max(1, round(duration_s * rate_hz)) for rate_hz in rates_hz]
        return _run_twins(scenario, pushes, ticks)


def _list_joints(scenario: Scenario) -> tuple[str, ...]:
    """Returns the names of the joints of all arms, for example "m1 joint 1" for the arm m1.

    The arms are in scenario order.
    """
    joints = []
    for name in scenario.names:
        joint_count = scenario.layout(name).joints
        joints += [f"{name} joint {number}" for number in range(1, joint_count + 1)]
    return tuple(joints)


def _push_in_random_direction(scenario: Scenario, number: int) -> Push:
    """Returns a small displacement of all joints in a random direction.

    It is applied to a copy of the run, to see whether the difference grows.

    Args:
        scenario: The scenario.
        number: Number of the direction, counted from 1. Each number gives a different
            direction.
    """
    push = Push.parse(scenario, "q")
    generator = np.random.Generator(np.random.Philox(number))
    directions = generator.uniform(-1.0, 1.0, push.by.shape)
    displacements = np.where(push.by != 0.0, PUSH_RAD * directions, 0.0)
    return push._replace(
        name=f"{push.name}, direction {number}", by=displacements, direction=number
    )


LEAST_PUSH = 1e-11
"""Minimum size of a push. A smaller push would be lost in rounding errors."""
MOST_PUSH = 1.0
"""Maximum size of a push. A larger push would not be a small disturbance."""
_TARGET = re.compile(r"(?:([a-z][a-z0-9_]*)\.)?(qd?|theta)([1-9]\d*)?")
"""Matches the target of a push: optional site, kind, and optional number, counted from 1."""


def _describe_target(site: str | None, kind: str, number: str | None) -> str:
    """Returns the unit and target of a push, for example "rad at m1 joint 1"."""
    noun = "estimate" if kind == "theta" else "joint"
    unit = {"q": "rad at", "qd": "rad/s at", "theta": "of"}[kind]
    if number:
        return f"{unit} {site} {noun} {number}"
    if site:
        return f"{unit} all {noun}s of {site}"
    return f"{unit} all {noun}s"


def _count_joints(scenario: Scenario) -> list[int]:
    """Returns the number of joints of each site."""
    return [scenario.layout(name).joints for name in scenario.names]


def _count_estimates(scenario: Scenario) -> list[int]:
    """Returns the number of estimated parameters of each site, 0 for laws that do not learn."""
    counts = []
    for name in scenario.names:
        learns = scenario.gains(name).is_adaptive
        counts.append(scenario.layout(name).parameters if learns else 0)
    return counts


def _describe_targets(scenario: Scenario, target: str) -> str:
    """Returns the error message for an invalid target, which lists the valid ones."""
    descriptions = []
    for name, estimates in zip(scenario.names, _count_estimates(scenario), strict=True):
        joints = scenario.layout(name).joints
        counts = f"{count_nouns(joints, 'joint')}, {count_nouns(estimates, 'estimate')}"
        descriptions.append(f"{name} ({counts})")
    first_site = scenario.names[0]
    examples = ", ".join(
        f"{first_site}.{variable}" for variable in ("q1", "qd1", "theta1", "q")
    )
    all_descriptions = ", ".join(descriptions)
    return (
        f"--push {target}: the state has no such number; name a number as in {examples}, or q; "
        f"the sites are {all_descriptions}"
    )


LANE_SITE_TICKS = 100_000_000
"""Least number of site ticks for which compiling the code for side-by-side twins pays off.

Compilation takes about ten seconds. Once compiled, the code is used for any number of ticks.
"""


def _run_twins(
    scenario: Scenario,
    pushes: Sequence[Push],
    ticks: Sequence[int],
    inputs: RunInputs | None = None,
    log: Log | None = None,
) -> Twins:
    """Executes a run and its twins (copies that start slightly displaced).

    If possible, all of them are computed side by side with vector instructions (one per lane).
    Otherwise they are executed one after another, with the same results.

    Args:
        scenario: The scenario.
        pushes: Push of each twin.
        ticks: Number of ticks of each site.
        inputs: Inputs of a recorded run that is repeated. None for a new run.
        log: Log of the recorded run, with which the repeated run is compared.
    """
    # Imported here, so that programs that need no twins do not load this code.
    from ...core import TwinLanes

    run = FusedRun(scenario, inputs=inputs)
    has_changes = inputs is not None and bool(inputs.changes)
    count = 1 + len(pushes)
    if not has_changes and TwinLanes.suits(run, count, ticks, LANE_SITE_TICKS):
        # If an arm leaves its limits, all runs are executed again, one by one.
        with suppress(TwinLanes.EndedError):
            return _LaneTwinRuns(scenario, pushes, ticks, inputs, log).run()
    return _TwinRuns(scenario, pushes, ticks, inputs, log).run()


class _SiteVelocities(NamedTuple):
    """Joint velocities of one arm over part of a run, divided into intervals of 50 ms.

    Attributes:
        cells: Index that selects the intervals and joints of this site from an array with one
            row per interval and one column per joint of all sites.
        starts: Index of the first tick of each interval.
        qd: Velocities of the run, in rad/s, with one row per tick and one column per joint.
        twin_qd: Velocities of the displaced copy of the run (twin), in the same format.
    """

    cells: tuple[Ints, ...]
    starts: Ints
    qd: Array
    twin_qd: Array


class _TwinRuns:
    """Executes a run together with its twins (copies that are slightly displaced, or pushed).

    The run is divided into time windows. At the end of each window, the difference between a
    twin and the run is scaled down if it has become large, and the twin is pushed again if the
    difference has decayed.

    Args:
        scenario: The scenario.
        pushes: Push of each twin.
        ticks: Number of ticks of each site.
        inputs: Inputs of a recorded run that is repeated. None for a new run.
        log: Log of the recorded run, with which the repeated run is compared.
    """

    def __init__(
        self,
        scenario: Scenario,
        pushes: Sequence[Push],
        ticks: Sequence[int],
        inputs: RunInputs | None = None,
        log: Log | None = None,
    ) -> None:
        """Creates a run and slightly displaced copies of it (twins), with empty results.

        No tick is executed yet.
        """
        self._log = log
        self._pushes = pushes
        self._joints = _list_joints(scenario)
        self._layouts = [scenario.layout(name) for name in scenario.names]
        rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
        durations_s = [count / rate_hz for count, rate_hz in zip(ticks, rates_hz, strict=True)]
        self._ends_s = _plan_windows(max(durations_s), pushes)
        longest_window_s = float(np.diff(self._ends_s, prepend=0.0).max())
        # The records of a whole window, with a margin for rounding.
        record_count = math.ceil(longest_window_s * max(rates_hz)) + 2
        runs = self._make_runs(scenario, ticks, inputs, record_count)
        self._run = runs[0]
        self._twins = runs[1:]

        twin_count = len(pushes)
        bucket_count = math.ceil(self._ends_s[-1] * BUCKETS_PER_S) + 1
        joint_count = len(self._joints)

        # Arrays of the paths of all twins, see `TwinPath`. A bucket is an interval of 50 ms.
        self._largest = np.full((twin_count, bucket_count, joint_count), -np.inf)
        self._last = np.zeros((twin_count, bucket_count, joint_count))
        self._scales = np.zeros((twin_count, bucket_count))
        # Present scale of each twin.
        self._scale = np.zeros(twin_count)
        self._speed = np.zeros((bucket_count, joint_count))
        self._pushed: list[list[int]] = [[] for _ in pushes]
        self._died: list[int | None] = [None for _ in pushes]
        self._same = True

    def _make_runs(
        self,
        scenario: Scenario,
        ticks: Sequence[int],
        inputs: RunInputs | None,
        record_count: int,
    ) -> list[Any]:
        """Creates a run and copies of it (twins), before their first tick.

        Args:
            scenario: The scenario.
            ticks: Number of ticks of each site.
            inputs: Inputs of a recorded run that is repeated, or None.
            record_count: Number of records of each site that must be kept.
        """
        run_count = 1 + len(self._pushes)
        runs = [FusedRun(scenario, keep=record_count, inputs=inputs) for _ in range(run_count)]
        for run in runs:
            run.plan(ticks)
        return runs

    def run(self) -> Twins:
        """Simulates a run and slightly displaced copies of it, and returns their differences.

        Growing differences show that the system is unstable.
        """
        for twin_index, push in enumerate(self._pushes):
            if push.at_s == 0.0:
                self._push(twin_index, 0.0)
        # The logarithm of a difference of 0 is -inf, which is no error.
        with np.errstate(divide="ignore", invalid="ignore"):
            for end_s in self._ends_s.tolist():
                self._execute_window(end_s)

        t_s = (np.arange(len(self._speed)) + 1.0) / BUCKETS_PER_S
        paths = []
        for twin_index, push in enumerate(self._pushes):
            path = TwinPath(
                push=push,
                t_s=t_s,
                largest=self._largest[twin_index],
                last=self._last[twin_index],
                scale=self._scales[twin_index],
                pushed=tuple(self._pushed[twin_index]),
                died=self._died[twin_index],
            )
            paths.append(path)
        return Twins(paths, self._joints, self._speed, self._same)

    def _execute_window(self, end_s: float) -> None:
        """Continues a run and its displaced copies (twins), and measures their differences.

        A twin that has not been displaced yet is identical to the run. It is therefore not
        executed, but copied from the run when its displacement is due.

        Args:
            end_s: End of the window, in s.
        """
        last_ns = math.ceil(end_s * NS_PER_S) - 1
        self._run.step_to(last_ns)
        records = self._run.pop_records()
        if self._log is not None:
            self._compare_with_log(self._log, records)
        for cells, starts, qd, _ in self._split_buckets(records, records):
            peak_speeds = np.maximum.reduceat(np.abs(qd), starts, axis=0)
            self._speed[cells] = np.maximum(self._speed[cells], peak_speeds)

        for twin_index, twin in enumerate(self._twins):
            is_pushed = bool(self._pushed[twin_index])
            if is_pushed and self._died[twin_index] is None:
                twin.step_to(last_ns)
                self._measure_difference(twin_index, records, twin.pop_records())
                # The state of a user's program cannot be copied or scaled.
                if not twin.has_programs:
                    self._renew_difference(twin_index, end_s)
            elif not is_pushed and self._pushes[twin_index].at_s <= end_s:
                twin.copy_state(self._run)
                self._push(twin_index, end_s)

    def _push(self, twin_index: int, at_s: float) -> None:
        """Slightly displaces the state of a copy of the run (twin), and stores the time.

        The subsequent growth or decay of the difference shows whether the system is stable.

        Args:
            twin_index: Index of the twin.
            at_s: Time of the push, in s.
        """
        push = self._pushes[twin_index]
        self._twins[twin_index].displace(push.field, push.by)
        self._pushed[twin_index].append(round(at_s * BUCKETS_PER_S))
        self._scale[twin_index] = 0.0

    def _compare_with_log(self, log: Log, records: Sequence[tuple[Ints, Array]]) -> None:
        """Raises NotRepeatable if the repeated run deviates from its log.

        Rounding errors are allowed. If the deviation is larger, the twins would not describe
        the run in the log.

        Args:
            log: The log.
            records: Times and records of each site since the last call.

        Raises:
            NotRepeatable: A joint angle, velocity or torque differs.
        """
        for name, layout, (t_ns, rows) in zip(log.sites, self._layouts, records, strict=True):
            site_log = log[name]
            columns = layout.columns()
            first_index = int(np.searchsorted(site_log.t_ns, t_ns[0])) if len(t_ns) else 0
            window = slice(first_index, first_index + len(t_ns))
            logged_signals = {
                "q": site_log.q[window],
                "qd": site_log.qd[window],
                "tau": site_log.tau[window],
            }
            for signal, values in logged_signals.items():
                difference = np.abs(rows[:, columns[signal]] - values).max(initial=0.0)
                self._same &= bool(difference == 0.0)
                if not difference <= SAME_RUN:  # also if the difference is NaN
                    raise NotRepeatable(
                        f"twins cannot be run: in the repeated run, {signal} of {name} differs "
                        f"by {difference:.2g} from the recorded values, so the run could not "
                        "be repeated (see trilat verify)"
                    )

    def _split_buckets(
        self,
        records: Sequence[tuple[Ints, Array]],
        twin_records: Sequence[tuple[Ints, Array]],
    ) -> Iterator[_SiteVelocities]:
        """Yields the joint velocities of each arm over part of a run, in intervals of 50 ms.

        Args:
            records: Times and records of each site of the run.
            twin_records: Times and records of each site of a twin.
        """
        first_joint = 0  # index of the site's first joint among the joints of all sites
        sites = zip(self._layouts, records, twin_records, strict=True)
        for layout, (t_ns, rows), (twin_ns, twin_rows) in sites:
            end_joint = first_joint + layout.joints
            # If the run or the twin diverged, it ends before the other.
            tick_count = min(len(t_ns), len(twin_ns))
            if tick_count:
                intervals = t_ns[:tick_count] * BUCKETS_PER_S // NS_PER_S
                starts = np.flatnonzero(np.diff(intervals, prepend=-1))
                velocity_columns = layout.columns()["qd"]
                yield _SiteVelocities(
                    cells=np.ix_(intervals[starts], np.arange(first_joint, end_joint)),
                    starts=starts,
                    qd=rows[:tick_count, velocity_columns],
                    twin_qd=twin_rows[:tick_count, velocity_columns],
                )
            first_joint = end_joint

    def _measure_difference(
        self,
        twin_index: int,
        records: Sequence[tuple[Ints, Array]],
        twin_records: Sequence[tuple[Ints, Array]],
    ) -> None:
        """Stores the difference between a twin and the run in one time window.

        The difference may be scaled down at the end of a window. The largest differences are
        stored as logarithms, as if they had never been scaled down.

        Args:
            twin_index: Index of the twin.
            records: Times and records of each site of the run.
            twin_records: Times and records of each site of the twin.
        """
        for cells, starts, qd, twin_qd in self._split_buckets(records, twin_records):
            difference = twin_qd - qd
            peaks = np.maximum.reduceat(np.abs(difference), starts, axis=0)  # per interval
            log_peaks = np.log(peaks) + self._scale[twin_index]
            self._largest[twin_index][cells] = np.maximum(
                self._largest[twin_index][cells], log_peaks
            )
            ends = np.append(starts[1:], len(difference))
            self._last[twin_index][cells] = difference[ends - 1]
            self._scales[twin_index, cells[0].reshape(-1)] = self._scale[twin_index]

    def _renew_difference(self, n: int, end_s: float) -> None:
        """Keeps the difference between a twin and the run from becoming too large or too small.

        A large difference is scaled down to the size of the push. A decayed difference consists
        only of rounding errors; the twin is then pushed again, or ends.

        Args:
            n: Index of the twin.
            end_s: End of the window, in s.
        """
        twin = self._twins[n]
        push = self._pushes[n]
        has_decayed = self._find_recent_peak(n, end_s) < math.log(SMALLEST)
        if has_decayed and push.again:
            twin.copy_state(self._run)
            self._push(n, end_s)
            return
        if has_decayed and twin.diverged_s is None:
            self._end_path(n)
            return

        is_ever_scaled = push.largest < math.inf
        push_size = float(np.abs(push.by).max())
        largest_distance = max(push.largest, 10.0 * push_size)
        distance_q = twin.measure_distance(self._run, "q")
        distance_qd = twin.measure_distance(self._run, "qd")
        distance = max(distance_q, distance_qd)
        is_too_large = not distance <= largest_distance  # also if the distance is NaN
        if is_ever_scaled and is_too_large:
            factor = push_size / distance
            twin.scale_difference(self._run, factor)
            self._scale[n] -= math.log(factor)

    def _find_recent_peak(self, n: int, end_s: float) -> float:
        """Returns the distance between a run and its displaced copy (twin) in the last second.

        The distance is the logarithm of the largest velocity difference. Positions do not show
        decay, because the twin may come to rest at a different position.

        Args:
            n: Index of the twin.
            end_s: Present time, in s.
        """
        end_interval = round(end_s * BUCKETS_PER_S)
        first_interval = max(0, end_interval - BUCKETS_PER_S)
        last_second = self._largest[n, first_interval:end_interval]
        # `_largest` is independent of the scaling, which is undone here.
        return float(last_second.max(initial=-np.inf) - self._scale[n])

    def _end_path(self, n: int) -> None:
        """Stores that the difference between a twin and the run has decayed to rounding errors.

        Args:
            n: Index of the twin, a displaced copy of the run.
        """
        actual_peaks = self._largest[n].max(axis=1) - self._scales[n]
        larger_intervals = np.flatnonzero(actual_peaks >= math.log(SMALLEST))
        if len(larger_intervals):
            first_decayed = int(larger_intervals[-1]) + 1
        else:
            first_decayed = self._pushed[n][0]
        self._died[n] = first_decayed
        self._largest[n, first_decayed:] = -np.inf


class _LaneTwinRuns(_TwinRuns):
    """Executes a run and its twins side by side, with the same results as `_TwinRuns`.

    Each run occupies one lane (an element of the vector registers), so one instruction computes
    a value for several runs.
    """

    def _make_runs(
        self,
        scenario: Scenario,
        ticks: Sequence[int],
        inputs: RunInputs | None,
        record_count: int,
    ) -> list[Any]:
        """Creates the run and its twins (displaced copies), each in one lane of the vectors."""
        from ...core import TwinLanes

        run = FusedRun(scenario, inputs=inputs)
        count = 1 + len(self._pushes)
        self._lanes = TwinLanes(
            run, count=count, ticks=ticks, feed=run.memory.feed, kept=record_count
        )
        return self._lanes.list_runs()

    def _execute_window(self, end_s: float) -> None:
        """Continues a run and its displaced copies (twins), and measures their differences.

        Args:
            end_s: End of the window, in s.
        """
        lanes = self._lanes
        lanes.step_to(math.ceil(end_s * NS_PER_S) - 1)
        if self._log is not None:
            everything = slice(None)
            run = slice(0, 1)
            records = [
                (lanes.read_times(i), lanes.read_records(i, everything, run)[:, :, 0])
                for i in range(len(self._layouts))
            ]
            self._compare_with_log(self._log, records)

        measured = []
        for n, pushed in enumerate(self._pushed):
            if pushed and self._died[n] is None:
                measured.append(n)
        self._measure_window(measured)
        for n, push in enumerate(self._pushes):
            if n in measured:
                self._renew_difference(n, end_s)
            elif not self._pushed[n] and push.at_s <= end_s:
                # A twin without a push has the state of the run.
                self._push(n, end_s)

    def _measure_window(self, measured: Sequence[int]) -> None:
        """Stores the speeds of the run and the differences of the twins in a time window.

        Args:
            measured: Indices of the twins that are measured.
        """
        twins = np.array(measured, dtype=np.int64)
        runs = slice(0, 1 + len(self._pushes))
        column = 0
        for i, layout in enumerate(self._layouts):
            columns = slice(column, column + layout.joints)
            column += layout.joints
            t_ns = self._lanes.read_times(i)
            if not len(t_ns):
                continue
            buckets = t_ns * BUCKETS_PER_S // NS_PER_S
            starts = np.flatnonzero(np.diff(buckets, prepend=-1))
            rows = buckets[starts]
            ends = np.append(starts[1:], len(t_ns))
            qd = self._lanes.read_records(i, layout.columns()["qd"], runs)
            speed = np.maximum.reduceat(np.abs(qd[:, :, 0]), starts, axis=0)
            self._speed[rows, columns] = np.maximum(self._speed[rows, columns], speed)
            difference = qd[:, :, 1 + twins] - qd[:, :, :1]
            peaks = np.maximum.reduceat(np.abs(difference), starts, axis=0)
            log_peaks = np.log(peaks) + self._scale[twins]
            for position, n in enumerate(measured):
                known = self._largest[n][rows, columns]
                self._largest[n][rows, columns] = np.maximum(known, log_peaks[:, :, position])
                self._last[n][rows, columns] = difference[ends - 1, :, position]
                self._scales[n, rows] = self._scale[n]


def _plan_windows(end_s: float, pushes: Sequence[Push]) -> Array:
    """Returns the times at which differences between runs are measured, in s, ascending.

    They are the ends of `WINDOWS` windows of equal length, rounded up to multiples of 50 ms,
    and the times at which copies of the run are displaced.

    Args:
        end_s: Duration of the run, in s.
        pushes: Push of each twin.

    Raises:
        NotRepeatable: The time of a push is not within the run.
    """
    if any(not 0.0 <= push.at_s < end_s for push in pushes):
        raise NotRepeatable(
            f"twins cannot be run: a push must start within the run, at or after 0 s and "
            f"before {end_s:g} s"
        )
    equal_windows_s = np.linspace(0.0, end_s, WINDOWS + 1)[1:]
    window_ends_s = np.ceil(equal_windows_s * BUCKETS_PER_S) / BUCKETS_PER_S
    push_times_s = {push.at_s for push in pushes} - {0.0}
    return np.array(sorted({*window_ends_s.tolist(), *push_times_s}))


SAME_RUN = 1e-7
"""Maximum difference between a repeated run and its records, in rad, rad/s or N m.

Rounding errors differ if the log was recorded on another platform.
"""
