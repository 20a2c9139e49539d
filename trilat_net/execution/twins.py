"""Twins of a run: copies that are displaced a little and executed together with the run.

The difference between a twin and its run shows whether small displacements grow or decay.

A difference that has grown is scaled down again (Benettin, Galgani, Giorgilli and Strelcyn,
Meccanica 15, 1980): every number x of the twin's state, past samples included, becomes
x_run + factor (x - x_run), and the logarithm of the factor is added to the growth. A twin whose
difference has decayed to the rounding of the numbers is displaced again.

Invariant:
    - The run is executed again from its own inputs and compared with its records, bit for bit.
    - A twin gets the same arrivals, changes, hands and random delays as the run. The difference
      is therefore the effect of the push alone.
    - The difference is computed by two complete runs, not by a linear model.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..core.site_setup import Law
from ..core.ticks import BUCKETS_PER_S, NS_PER_S
from ..core.vectors import Array
from ..errors import NotRepeatable, UsageError, count_nouns
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..scenario import Scenario
from .fused import FusedRun, RunInputs, explain_not_repeatable, read_run_inputs

PUSH_RAD = 1e-6
"""The usual size of a push, rad."""
LARGEST = 1e-4
"""Largest difference, rad or rad/s, at the end of a window.

A larger difference is scaled down if it also exceeds ten times its push.
"""
SMALLEST = 1e-12
"""A difference smaller than this is lost in the rounding of the numbers."""
WINDOWS = 16
"""Number of windows of a run. Differences are scaled down or displaced again at their ends."""


class Push(NamedTuple):
    """A displacement of the state of a twin.

    Attributes:
        name: description of the push, as "1e-06 rad at m1 joint 1".
        field: the displaced field: "q", rad; "qd", rad/s; or "theta_hat".
        by: the displacement of each site and number, shape (N, n).
        at_s: time of the push, s since the epoch.
        again: True if a twin whose difference has decayed is pushed again at the end of a
            window; otherwise the twin ends there.
        largest: a difference larger than this is scaled down; math.inf: never.
    """

    name: str
    field: str
    by: Array
    at_s: float = 0.0
    again: bool = True
    largest: float = LARGEST


class TwinPath(NamedTuple):
    """The difference of a twin from its run, in intervals of 50 ms.

    Attributes:
        push: the push of the twin.
        t_s: ends of the intervals, shape (K,), s.
        largest: logarithm of the largest difference of velocity in an interval, rad/s, of each
            of the J joints of all sites, as if the difference had never been scaled down, shape
            (K, J); -inf where the twin and the run are equal.
        last: difference at the last tick of an interval as it was computed, shape (K, J),
            rad/s.
        scale: logarithm of the factor that converts `last` to the unscaled difference, shape
            (K,).
        pushed: indices in `t_s` of the intervals in which the twin was pushed.
        died: index in `t_s` from which the difference is only rounding; None if the twin was
            pushed again or its difference is larger.
    """

    push: Push
    t_s: Array
    largest: Array
    last: Array
    scale: Array
    pushed: tuple[int, ...]
    died: int | None = None


class Twins(NamedTuple):
    """The twins of a run.

    Attributes:
        paths: the difference of each twin from the run.
        joints: names of the joints of all sites, as in "m1 joint 1".
        speed: largest speed of each joint of the run in an interval, shape (K, J), rad/s.
        same: True if the run that was executed again has the bits of the records.
    """

    paths: Sequence[TwinPath]
    joints: tuple[str, ...]
    speed: Array
    same: bool


def list_joints(scenario: Scenario) -> tuple[str, ...]:
    """Returns the names of all joints, site by site."""
    joints = []
    for name in scenario.names:
        count = scenario.layout(name).joints
        joints += [f"{name} joint {number}" for number in range(1, count + 1)]
    return tuple(joints)


def choose_pushes(scenario: Scenario, count: int) -> list[Push]:
    """Returns `count` pushes of different joints and estimates.

    The pushes are: one of all estimates, if a site learns; up to three of all joints in a
    random direction, with sizes around `PUSH_RAD`; and one of each joint. Random pushes of
    different sizes reveal growth that depends on the size of the motion.
    """
    joint_targets = [joint.replace(" joint ", ".q") for joint in list_joints(scenario)]
    targets = []
    learns = any(scenario.gains(name).law is Law.ADAPTIVE for name in scenario.names)
    if learns and count > 2:
        targets.append(("theta", PUSH_RAD))
    random_count = max(1, min(3, count - len(joint_targets) - len(targets)))
    random_factors = (1.0, 1e-3, 1e3)[:random_count]
    targets += [("q", factor * PUSH_RAD) for factor in random_factors]
    targets += [(target, PUSH_RAD) for target in joint_targets]
    pushes = []
    for target, size in targets[:count]:
        push = parse_push(scenario, target, size)
        pushes.append(push._replace(again=True, largest=LARGEST))
    return pushes


LEAST_PUSH = 1e-11
"""A smaller push is lost in the rounding of the numbers."""
MOST_PUSH = 1.0
"""A larger push makes another run."""
_TARGET = re.compile(r"(?:([a-z][a-z0-9_]*)\.)?(qd?|theta)([1-9]\d*)?")
"""Target of a push: optional site, kind, and optional number from 1."""


def parse_push(
    scenario: Scenario, target: str, size: float = PUSH_RAD, at_s: float = 0.0
) -> Push:
    """Returns the push of a target such as "m1.q1", "s.qd2", "m2.theta3" or "m1.q".

    A target without a number means all numbers of that kind, in a random direction. A target
    without a site means all sites. The twin is pushed once. A difference that begins larger
    than `LARGEST` is never scaled down.

    Args:
        scenario: the scenario.
        target: the target.
        size: size of the push: rad, rad/s, or the unit of an estimate.
        at_s: time of the push, s since the epoch.

    Raises:
        UsageError: the scenario has no such target, or the size is out of range.
    """
    match = _TARGET.fullmatch(target)
    if match is None:
        raise UsageError(_describe_targets(scenario, target))
    site, kind, number = match.groups()
    counts = _count_estimates(scenario) if kind == "theta" else _count_joints(scenario)
    owners = []
    for i, name in enumerate(scenario.names):
        if site in (None, name) and counts[i] >= int(number or 1):
            owners.append(i)
    if not owners or (number and not site):
        raise UsageError(_describe_targets(scenario, target))
    if not LEAST_PUSH <= abs(size) <= MOST_PUSH:
        raise UsageError(
            f"--push {target}={size:g}: the size of a push is from {LEAST_PUSH:g} to "
            f"{MOST_PUSH:g}"
        )
    generator = np.random.Generator(np.random.Philox(0))
    displacements = np.zeros((len(counts), max(counts)))
    for i in owners:
        if number:
            direction = np.arange(counts[i]) == int(number) - 1
        else:
            direction = generator.uniform(-1.0, 1.0, counts[i])
        displacements[i, : counts[i]] = size * direction
    return Push(
        name=f"{size:g} {_describe_target(site, kind, number)}",
        field="theta_hat" if kind == "theta" else kind,
        by=displacements,
        at_s=at_s,
        again=False,
        largest=LARGEST if abs(size) < LARGEST else math.inf,
    )


def _describe_target(site: str | None, kind: str, number: str | None) -> str:
    """Returns the target of a push behind its size, as in "rad at m1 joint 1"."""
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
    """Returns the number of estimated parameters of each site; 0 for laws that do not learn."""
    counts = []
    for name in scenario.names:
        learns = scenario.gains(name).law is Law.ADAPTIVE
        counts.append(scenario.layout(name).parameters if learns else 0)
    return counts


def _describe_targets(scenario: Scenario, target: str) -> str:
    """Returns an error text that names the targets of a push in a scenario."""
    sites = []
    for name, estimates in zip(scenario.names, _count_estimates(scenario), strict=True):
        joints = scenario.layout(name).joints
        numbers = f"{count_nouns(joints, 'joint')}, {count_nouns(estimates, 'estimate')}"
        sites.append(f"{name} ({numbers})")
    first = scenario.names[0]
    examples = ", ".join(f"{first}.{number}" for number in ("q1", "qd1", "theta1", "q"))
    sites_text = ", ".join(sites)
    return f"--push {target}: no such number; as in {examples}, or q, of {sites_text}"


def run_twins(log: Log, pushes: Sequence[Push], *, own_laws: bool = False) -> Twins:
    """Executes the run of a log again, and a twin of the run for every push.

    Args:
        log: the log.
        pushes: the pushes.
        own_laws: True if laws that are code from outside may run.

    Raises:
        NotRepeatable: the run cannot be executed again, or differs from its records here.
        LogError: a record cannot be read.
    """
    reason = explain_not_repeatable(log, own_laws=own_laws)
    if reason:
        raise NotRepeatable(f"no twins: {reason}")
    runs = _TwinRuns(
        scenario=log.scenario,
        pushes=pushes,
        ticks=[len(log[name]) for name in log.scenario.names],
        inputs=read_run_inputs(log),
        log=log,
    )
    return runs.run()


def run_virtual_twins(scenario: Scenario, pushes: Sequence[Push], duration_s: float) -> Twins:
    """Runs a scenario in virtual time, and a twin of the run for every push.

    Raises:
        ScenarioError: virtual time cannot run the scenario.
        NotRepeatable: a push is not within the run.
    """
    rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
    ticks = [max(1, round(duration_s * rate_hz)) for rate_hz in rates_hz]
    return _TwinRuns(scenario, pushes, ticks).run()


class _TwinRuns:
    """A run and its twins, executed side by side.

    Args:
        scenario: the scenario.
        pushes: the push of each twin.
        ticks: number of ticks of each site.
        inputs: inputs of a recorded run.
        log: the log of the recorded run, whose records the run has to equal.
    """

    def __init__(
        self,
        scenario: Scenario,
        pushes: Sequence[Push],
        ticks: Sequence[int],
        inputs: RunInputs | None = None,
        log: Log | None = None,
    ) -> None:
        self._log = log
        self._pushes = pushes
        self._joints = list_joints(scenario)
        self._layouts = [scenario.layout(name) for name in scenario.names]
        rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
        durations_s = [count / rate_hz for count, rate_hz in zip(ticks, rates_hz, strict=True)]
        self._ends_s = _plan_windows(max(durations_s), pushes)
        longest_window_s = float(np.diff(self._ends_s, prepend=0.0).max())
        keep = math.ceil(longest_window_s * max(rates_hz)) + 2
        runs = [FusedRun(scenario, keep=keep, inputs=inputs) for _ in range(1 + len(pushes))]
        for run in runs:
            run.plan(ticks)
        self._run = runs[0]
        self._twins = runs[1:]
        twins = len(pushes)
        buckets = math.ceil(self._ends_s[-1] * BUCKETS_PER_S) + 1
        joints = len(self._joints)
        # The arrays of the paths of all twins, see `TwinPath`.
        self._largest = np.full((twins, buckets, joints), -np.inf)
        self._last = np.zeros((twins, buckets, joints))
        self._scales = np.zeros((twins, buckets))
        # Present scale of each twin.
        self._scale = np.zeros(twins)
        self._speed = np.zeros((buckets, joints))
        self._pushed: list[list[int]] = [[] for _ in pushes]
        self._died: list[int | None] = [None for _ in pushes]
        self._same = True

    def run(self) -> Twins:
        """Executes all runs and returns the differences of the twins."""
        for n, push in enumerate(self._pushes):
            if push.at_s == 0.0:
                self._push(n, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            for end_s in self._ends_s.tolist():
                self._execute_window(end_s)
        t_s = (np.arange(len(self._speed)) + 1.0) / BUCKETS_PER_S
        paths = []
        for n, push in enumerate(self._pushes):
            path = TwinPath(
                push=push,
                t_s=t_s,
                largest=self._largest[n],
                last=self._last[n],
                scale=self._scales[n],
                pushed=tuple(self._pushed[n]),
                died=self._died[n],
            )
            paths.append(path)
        return Twins(paths, self._joints, self._speed, self._same)

    def _execute_window(self, end_s: float) -> None:
        """Executes the run and its twins to the end of a window."""
        last_ns = math.ceil(end_s * NS_PER_S) - 1
        self._run.step_to(last_ns)
        records = self._run.pop_records()
        if self._log is not None:
            self._compare_with_log(self._log, records)
        for cells, starts, qd, _ in self._split_buckets(records, records):
            speed = np.maximum.reduceat(np.abs(qd), starts, axis=0)
            self._speed[cells] = np.maximum(self._speed[cells], speed)
        for n, twin in enumerate(self._twins):
            is_pushed = bool(self._pushed[n])
            if is_pushed and self._died[n] is None:
                twin.step_to(last_ns)
                self._measure_difference(n, records, twin.pop_records())
                # the state of a program cannot be copied
                if not twin.has_programs:
                    self._renew_difference(n, end_s)
            elif not is_pushed and self._pushes[n].at_s <= end_s:
                twin.copy_state(self._run)
                self._push(n, end_s)

    def _push(self, n: int, at_s: float) -> None:
        """Displaces the state of twin `n` at a time, s."""
        push = self._pushes[n]
        self._twins[n].displace(push.field, push.by)
        self._pushed[n].append(round(at_s * BUCKETS_PER_S))
        self._scale[n] = 0.0

    def _compare_with_log(self, log: Log, records: Sequence[tuple[Ints, Array]]) -> None:
        """Refuses a run that differs from the records of its log by more than rounding."""
        for name, layout, (t_ns, rows) in zip(log.sites, self._layouts, records, strict=True):
            part = log[name]
            columns = layout.columns()
            first = int(np.searchsorted(part.t_ns, t_ns[0])) if len(t_ns) else 0
            window = slice(first, first + len(t_ns))
            logged = {"q": part.q[window], "qd": part.qd[window], "tau": part.tau[window]}
            for signal, values in logged.items():
                difference = np.abs(rows[:, columns[signal]] - values).max(initial=0.0)
                self._same &= bool(difference == 0.0)
                if not difference <= SAME_RUN:
                    raise NotRepeatable(
                        f"no twins: in the repeated run, {signal} of {name} differs by "
                        f"{difference:.2g} from the records, so it is another run (see trilat "
                        "verify)"
                    )

    def _split_buckets(
        self,
        records: Sequence[tuple[Ints, Array]],
        twin_records: Sequence[tuple[Ints, Array]],
    ) -> Iterator[tuple[tuple[Ints, ...], Ints, Array, Array]]:
        """Yields the velocities of each site in a window, with the intervals of 50 ms.

        Args:
            records: times and records of each site of the run.
            twin_records: times and records of each site of a twin.

        Yields:
            The cells of an array (K, J) that the site fills, the first row of each interval,
            and the velocities of the run and of the twin, rad/s, a row per tick.
        """
        column = 0
        sites = zip(self._layouts, records, twin_records, strict=True)
        for layout, (t_ns, rows), (twin_ns, twin_rows) in sites:
            qd = layout.columns()["qd"]
            # a run that diverged ends before its twin, or after it
            count = min(len(t_ns), len(twin_ns))
            if count:
                buckets = t_ns[:count] * BUCKETS_PER_S // NS_PER_S
                starts = np.flatnonzero(np.diff(buckets, prepend=-1))
                columns = np.arange(column, column + layout.joints)
                cells = np.ix_(buckets[starts], columns)
                yield cells, starts, rows[:count, qd], twin_rows[:count, qd]
            column += layout.joints

    def _measure_difference(
        self,
        n: int,
        records: Sequence[tuple[Ints, Array]],
        twin_records: Sequence[tuple[Ints, Array]],
    ) -> None:
        """Adds the differences of a twin in a window to its path."""
        for cells, starts, qd, twin_qd in self._split_buckets(records, twin_records):
            difference = twin_qd - qd
            peaks = np.maximum.reduceat(np.abs(difference), starts, axis=0)
            unscaled = np.log(peaks) + self._scale[n]
            self._largest[n][cells] = np.maximum(self._largest[n][cells], unscaled)
            ends = np.append(starts[1:], len(difference))
            self._last[n][cells] = difference[ends - 1]
            self._scales[n, cells[0].reshape(-1)] = self._scale[n]

    def _renew_difference(self, n: int, end_s: float) -> None:
        """Scales down a large difference; pushes or ends a twin without a difference.

        Args:
            n: index of the twin.
            end_s: end of the window, s.
        """
        twin = self._twins[n]
        push = self._pushes[n]
        bucket = round(end_s * BUCKETS_PER_S)
        distance_q = twin.measure_distance(self._run, "q")
        distance_qd = twin.measure_distance(self._run, "qd")
        distance = max(distance_q, distance_qd)
        size = float(np.abs(push.by).max())
        largest = max(push.largest, 10.0 * size)
        # velocities alone decide on a decay: a twin may rest at another position
        last_second = self._largest[n, max(0, bucket - BUCKETS_PER_S) : bucket]
        recent = last_second.max(initial=-np.inf) - self._scale[n]
        decayed = recent < math.log(SMALLEST)
        if decayed and push.again:
            twin.copy_state(self._run)
            self._push(n, end_s)
        elif decayed and twin.diverged_s is None:
            unscaled = self._largest[n].max(axis=1) - self._scales[n]
            larger = np.flatnonzero(unscaled >= math.log(SMALLEST))
            died = int(larger[-1]) + 1 if len(larger) else self._pushed[n][0]
            self._died[n] = died
            self._largest[n, died:] = -np.inf
        elif push.largest < math.inf and not distance <= largest:
            factor = size / distance
            twin.scale_difference(self._run, factor)
            self._scale[n] -= math.log(factor)


def _plan_windows(end_s: float, pushes: Sequence[Push]) -> Array:
    """Returns the ends of the windows of a run, s, ascending.

    The windows end at multiples of 50 ms and at the times of the pushes.

    Raises:
        NotRepeatable: a push is not within the run.
    """
    if any(not 0.0 <= push.at_s < end_s for push in pushes):
        raise NotRepeatable(
            f"no twins: a push lies within the run, from 0 s until before {end_s:g} s"
        )
    equal_windows_s = np.linspace(0.0, end_s, WINDOWS + 1)[1:]
    window_ends_s = np.ceil(equal_windows_s * BUCKETS_PER_S) / BUCKETS_PER_S
    push_times_s = {push.at_s for push in pushes} - {0.0}
    return np.array(sorted({*window_ends_s.tolist(), *push_times_s}))


SAME_RUN = 1e-7
"""Largest difference, rad, rad/s or N m, of a run from its records.

The last bits differ if the run is executed on another platform.
"""
