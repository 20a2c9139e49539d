"""Twins of a run: the same run again, pushed by a little at an instant.

Invariant: the run is executed again from its own inputs and compared with its records, bit for
bit. A twin gets the same arrivals, changes, hands and random delays; so what differs is the
push and what became of it, and nothing else. Nothing of the difference is a model.

A difference that has grown is made small again along itself (Benettin, Galgani, Giorgilli and
Strelcyn, Meccanica 15, 1980): all numbers of the twin's state, past samples included, go back
to the run's plus a fraction of the difference, and what is counted goes on from where it was.
One that has died down to the rounding of the numbers is pushed anew.
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
"""The usual push, rad."""
LARGEST = 1e-4
"""A difference larger than this, rad or rad/s, and than ten times its push, is made small again
at the end of its window.
"""
SMALLEST = 1e-12
"""One smaller than this is lost in the rounding of the numbers."""
WINDOWS = 16
"""Windows of a run, at whose ends differences are looked at."""


class Push(NamedTuple):
    """A push of a twin.

    Attributes:
        name: what it is, in words, as "1e-06 rad at m1 joint 1".
        field: "q", rad; "qd", rad/s; or "theta_hat".
        by: of each site and number the push, shape (N, n).
        at_s: the instant, s since the epoch.
        again: a twin that died down is pushed again, at the end of a window; else it ends
            there.
        largest: a difference larger than this is made small again; math.inf: none is.
    """

    name: str
    field: str
    by: Array
    at_s: float = 0.0
    again: bool = True
    largest: float = LARGEST


class TwinPath(NamedTuple):
    """What became of a push.

    Attributes:
        push: the push.
        t_s: ends of intervals of 50 ms, shape (K,), s.
        largest: logarithm of the largest difference of velocities in an interval, rad/s, of
            every joint of all sites, as if nothing had been made small again, shape (K, J);
            -inf where there is none.
        last: the difference at the last tick of an interval, shape (K, J), rad/s, with
        scale: the logarithm of the factor by which it was made small, shape (K,).
        pushed: the places in `t_s` at which it was pushed.
        died: the place from which on there is nothing but rounding; None: it is pushed anew, or
            lives.
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
        paths: of each push.
        joints: names of the joints, as in "m1 joint 1".
        speed: the largest speed of every joint of the run itself in an interval, shape (K, J),
            rad/s.
        same: True if the run that was executed again has the bits of the records.
    """

    paths: Sequence[TwinPath]
    joints: tuple[str, ...]
    speed: Array
    same: bool


def list_joints(scenario: Scenario) -> tuple[str, ...]:
    """Returns the names of all joints, site by site."""
    return tuple(
        f"{name} joint {joint + 1}"
        for name in scenario.names
        for joint in range(scenario.layout(name).joints)
    )


def choose_pushes(scenario: Scenario, count: int) -> list[Push]:
    """Returns so many pushes: each joint, as far as they go, the estimates, and random ones of
    all joints.

    The random ones are by less and more than `PUSH_RAD`: growth that is not of small motions
    alone differs.
    """
    each = [(joint.replace(" joint ", ".q"), PUSH_RAD) for joint in list_joints(scenario)]
    learns = any(scenario.gains(name).law is Law.ADAPTIVE for name in scenario.names)
    chosen = [("theta", PUSH_RAD)] * (learns and count > 2)
    random = max(1, min(3, count - len(each) - len(chosen)))
    chosen += [("q", factor * PUSH_RAD) for factor in (1.0, 1e-3, 1e3)[:random]]
    pushes = [parse_push(scenario, *one) for one in (chosen + each)[:count]]
    return [one._replace(again=True, largest=LARGEST) for one in pushes]


LEAST_PUSH = 1e-11
MOST_PUSH = 1.0
"""A smaller push is lost in the rounding of the numbers; a larger one is another run."""
_TARGET = re.compile(r"(?:([a-z][a-z0-9_]*)\.)?(qd?|theta)([1-9]\d*)?")


def parse_push(
    scenario: Scenario, target: str, size: float = PUSH_RAD, at_s: float = 0.0
) -> Push:
    """Returns the push of a number, "m1.q1", "s.qd2", "m2.theta3", or of many in a drawn
    direction, "m1.q".

    Its twin is pushed once. One that is not small is never made small again.

    Raises:
        UsageError: there is no such number, or no such size.
    """
    site, kind, number = (
        found.groups() if (found := _TARGET.fullmatch(target)) else (None, "", "1")
    )
    layouts = {name: scenario.layout(name) for name in scenario.names}
    adaptive = Law.ADAPTIVE
    joints = [one.joints for one in layouts.values()]
    estimates = [
        one.parameters * (scenario.gains(name).law is adaptive) for name, one in layouts.items()
    ]
    part, counts = ("estimate", estimates) if kind == "theta" else ("joint", joints)
    owners = [
        n
        for n, name in enumerate(layouts)
        if site in (None, name) and counts[n] >= int(number or 1)
    ]
    if not owners or (number and not site):
        each = zip(layouts, joints, estimates, strict=True)
        there = ", ".join(
            f"{name} ({count_nouns(n, 'joint')}, {count_nouns(m, 'estimate')})"
            for name, n, m in each
        )
        names = ", ".join(f"{scenario.names[0]}.{one}" for one in ("q1", "qd1", "theta1", "q"))
        raise UsageError(f"--push {target}: no such number; as in {names}, or q, of {there}")
    if not LEAST_PUSH <= abs(size) <= MOST_PUSH:
        raise UsageError(
            f"--push {target}={size:g}: a push is of a size from {LEAST_PUSH:g} to {MOST_PUSH:g}"
        )
    chance = np.random.Generator(np.random.Philox(0))
    by = np.zeros((len(counts), max(counts)))
    for n in owners:
        one = np.arange(counts[n]) == int(number or 0) - 1
        by[n, : counts[n]] = size * (one if number else chance.uniform(-1.0, 1.0, counts[n]))
    unit = {"q": "rad at", "qd": "rad/s at", "theta": "of"}[kind]
    of = f"{site} {part} {number}" if number else f"all {part}s{f' of {site}' if site else ''}"
    field = "theta_hat" if kind == "theta" else kind
    largest = LARGEST if abs(size) < LARGEST else math.inf
    return Push(
        name=f"{size:g} {unit} {of}",
        field=field,
        by=by,
        at_s=at_s,
        again=False,
        largest=largest,
    )


def run_twins(log: Log, pushes: Sequence[Push], *, own_laws: bool = False) -> Twins:
    """Executes a run again, and a twin of it for every push.

    Raises:
        NotRepeatable: it cannot be executed again, or is another run here.
        LogError: a record cannot be read.
    """
    if why := explain_not_repeatable(log, own_laws=own_laws):
        raise NotRepeatable(f"no twins: {why}")
    ticks = [len(log[name]) for name in log.scenario.names]
    return _TwinRuns(
        scenario=log.scenario, pushes=pushes, ticks=ticks, inputs=read_run_inputs(log), log=log
    ).run()


def run_virtual_twins(scenario: Scenario, pushes: Sequence[Push], duration_s: float) -> Twins:
    """Makes a run of a scenario in virtual time, and a twin of it for every push.

    Raises:
        ScenarioError: virtual time cannot run it.
        NotRepeatable: a push is beyond its end.
    """
    ticks = [
        max(1, round(duration_s * scenario.sites[name].rate_hz)) for name in scenario.names
    ]
    return _TwinRuns(scenario, pushes, ticks).run()


class _TwinRuns:
    """A run of so many ticks of each site and its twins, side by side; of a log, if there is
    one.
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
        self._layouts = [scenario.layout(name) for name in scenario.names]
        rates_hz = [scenario.sites[name].rate_hz for name in scenario.names]
        end_s = max(n / hz for n, hz in zip(ticks, rates_hz, strict=True))
        if any(not 0.0 <= push.at_s < end_s for push in pushes):
            raise NotRepeatable(
                f"no twins: a push lies within the run, from 0 s until before {end_s:g} s"
            )
        equal = (
            np.ceil(np.linspace(0.0, end_s, WINDOWS + 1)[1:] * BUCKETS_PER_S) / BUCKETS_PER_S
        )
        self._ends = np.array(
            sorted({*equal.tolist(), *({push.at_s for push in pushes} - {0.0})})
        )
        keep = math.ceil(float(np.diff(self._ends, prepend=0.0).max()) * max(rates_hz)) + 2
        runs = [FusedRun(scenario, keep=keep, inputs=inputs) for _ in range(1 + len(pushes))]
        for run in runs:
            run.plan(ticks)
        self._run = runs[0]
        self._twins = runs[1:]
        self._joints = list_joints(scenario)
        shape = math.ceil(self._ends[-1] * BUCKETS_PER_S) + 1, len(self._joints)
        self._largest = np.full((len(pushes), *shape), -np.inf)
        self._last = np.zeros((len(pushes), *shape))
        self._scales = np.zeros((len(pushes), shape[0]))
        self._scale = np.zeros(len(pushes))
        self._speed = np.zeros(shape)
        self._pushed: list[list[int]] = [[] for _ in pushes]
        self._died: list[int | None] = [None for _ in pushes]
        self._same = True

    def run(self) -> Twins:
        for n, push in enumerate(self._pushes):
            if push.at_s == 0.0:
                self._push(n, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            for end_s in self._ends.tolist():
                self._make_window(end_s)
        t_s = (np.arange(len(self._speed)) + 1.0) / BUCKETS_PER_S
        kept = zip(
            self._largest,
            self._last,
            self._scales,
            map(tuple, self._pushed),
            self._died,
            strict=True,
        )
        paths = [
            TwinPath(push, t_s, *found) for push, found in zip(self._pushes, kept, strict=True)
        ]
        return Twins(paths, self._joints, self._speed, self._same)

    def _make_window(self, end_s: float) -> None:
        last_ns = math.ceil(end_s * NS_PER_S) - 1
        self._run.step_to(last_ns)
        kept = self._run.pop_records()
        if self._log is not None:
            self._compare(self._log, kept)
        for at, starts, qd, _ in self._cut(kept, kept):
            self._speed[at] = np.maximum(
                self._speed[at], np.maximum.reduceat(np.abs(qd), starts, axis=0)
            )
        for n, twin in enumerate(self._twins):
            if self._pushed[n] and self._died[n] is None:
                twin.step_to(last_ns)
                self._measure(n, kept, twin.pop_records())
                if not twin.has_programs:  # whose state no twin can take over
                    self._renew(n, end_s)
            elif not self._pushed[n] and self._pushes[n].at_s <= end_s:
                twin.copy_state(self._run)
                self._push(n, end_s)

    def _push(self, n: int, at_s: float) -> None:
        push = self._pushes[n]
        self._twins[n].displace(push.field, push.by)
        self._pushed[n].append(round(at_s * BUCKETS_PER_S))
        self._scale[n] = 0.0

    def _compare(self, log: Log, kept: Sequence[tuple[Ints, Array]]) -> None:
        for name, layout, (t_ns, rows) in zip(log.sites, self._layouts, kept, strict=True):
            part = log[name]
            columns = layout.columns()
            first = int(np.searchsorted(part.t_ns, t_ns[0])) if len(t_ns) else 0
            here = slice(first, first + len(t_ns))
            for signal, recorded in (
                ("q", part.q[here]),
                ("qd", part.qd[here]),
                ("tau", part.tau[here]),
            ):
                apart = np.abs(rows[:, columns[signal]] - recorded).max(initial=0.0)
                self._same &= bool(apart == 0.0)
                if not apart <= SAME_RUN:
                    raise NotRepeatable(
                        f"no twins: executed again, {signal} of {name} is off by {apart:.2g}: it is not the "
                        "run of these records (trilat verify)"
                    )

    def _cut(
        self, kept: Sequence[tuple[Ints, Array]], own: Sequence[tuple[Ints, Array]]
    ) -> Iterator[tuple[tuple[Ints, ...], Ints, Array, Array]]:
        place = 0
        for layout, (t_ns, rows), (own_ns, own_rows) in zip(
            self._layouts, kept, own, strict=True
        ):
            qd = layout.columns()["qd"]
            made = min(len(t_ns), len(own_ns))
            if made:
                buckets = t_ns[:made] * BUCKETS_PER_S // NS_PER_S
                starts = np.flatnonzero(np.diff(buckets, prepend=-1))
                at = np.ix_(buckets[starts], np.arange(place, place + layout.joints))
                yield at, starts, rows[:made, qd], own_rows[:made, qd]
            place += layout.joints

    def _measure(
        self, n: int, kept: Sequence[tuple[Ints, Array]], own: Sequence[tuple[Ints, Array]]
    ) -> None:
        for at, starts, qd, own_qd in self._cut(kept, own):
            apart = own_qd - qd
            largest = (
                np.log(np.maximum.reduceat(np.abs(apart), starts, axis=0)) + self._scale[n]
            )
            self._largest[n][at] = np.maximum(self._largest[n][at], largest)
            self._last[n][at] = apart[np.append(starts[1:], len(apart)) - 1]
            self._scales[n, at[0].reshape(-1)] = self._scale[n]

    def _renew(self, n: int, end_s: float) -> None:
        twin = self._twins[n]
        last = round(end_s * BUCKETS_PER_S)
        push = self._pushes[n]
        q, qd = (twin.measure_distance(self._run, field) for field in ("q", "qd"))
        pushed = float(np.abs(push.by).max())  # nothing is made larger than it is
        recent = (
            self._largest[n, max(0, last - BUCKETS_PER_S) : last].max(initial=-np.inf)
            - self._scale[n]
        )
        dead = recent < math.log(SMALLEST)  # whatever is left of it as a shift to another rest
        if dead and push.again:
            twin.copy_state(self._run)
            self._push(n, end_s)
        elif dead and twin.diverged_s is None:
            alive = self._largest[n].max(axis=1) - self._scales[n] >= math.log(SMALLEST)
            self._died[n] = (
                int(np.flatnonzero(alive)[-1]) + 1 if alive.any() else self._pushed[n][0]
            )
            self._largest[n, self._died[n] :] = -np.inf
        elif push.largest < math.inf and not max(q, qd) <= max(push.largest, 10.0 * pushed):
            factor = pushed / max(q, qd)
            twin.scale_difference(self._run, factor)
            self._scale[n] -= math.log(factor)


SAME_RUN = 1e-7
"""Executed on another platform, where the last bits differ, a run may be so far from its
records, rad.
"""
