"""What became of small pushes in a run: by how much they grew or died, at the end and in
between.

Invariant: a push is judged by the velocities of its twin minus those of the run, which a shift
of all arms to another rest leaves at zero. Sites that no shares connect are judged by
themselves: what one does hides no other.

The amplitude of a difference d at 20 Hz is A, A^2 = sum over joints of d^2 + (d' / w)^2, with w
the frequency that makes both parts equal on average: of a single mode it goes as exp(rate t),
without its swing. The rate is the slope of log A over the judged part, with the bounds and
words of `envelope_trend`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.exogenous import TorqueKind
from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..errors import NotRepeatable, UsageError
from ..execution.twins import (
    LEAST_PUSH,
    MOST_PUSH,
    PUSH_RAD,
    SMALLEST,
    Push,
    TwinPath,
    Twins,
    choose_pushes,
    parse_push,
    run_twins,
    run_virtual_twins,
)
from ..log.log_reader import Log, open_log
from ..results import Result, finite_or_none
from ..scenario import Scenario
from .envelope_trend import FLOOR_RAD, EnvelopeFit, EnvelopeTrend, fit_envelopes
from .run_end import EndBehaviour, RunEnd, Stability, find_coupled_sites
from .site_signals import SETTLED_ERROR_RAD

TWINS = 8
"""Twins of a run, unless asked for others."""
LEAST_LEFT_S = 5.0
"""A run that leaves a rest by itself does so for this time or longer, s,"""
DOUBLES = 2.0
"""faster by this factor at the end of it than at its beginning."""
CLEAR_GROWTH = 100.0
"""What grows by this factor is seen in a push of any direction that dies away otherwise."""
_ORDER = (
    EnvelopeTrend.DECAYS,
    EnvelopeTrend.HARDLY,
    EnvelopeTrend.UNDECIDED,
    EnvelopeTrend.STEADY,
    EnvelopeTrend.GROWS,
)
_NOTHING = 1e-300
SAME_SCALED = math.log(1.1)
"""Twins are the same but for their scale if they differ by less than 10 %."""
MOST_LOG = 700.0
"""A number with a larger logarithm is beyond all that there are."""


class PushGrowth(NamedTuple):
    """What became of one push in sites that shares connect, over the judged part of a run.

    Attributes:
        push: the push.
        trend: of the difference.
        rate_per_s: it goes as exp(rate t), 1/s; NaN if the part is too short.
        factor: by how much it changed over the part; 0: it died down to the rounding of the
            numbers.
        joint: the joint at which it is largest at the end.
        group: the place of those sites among the groups.
        becomes_rad_s: the largest difference of the last second, rad/s, as if nothing was made
            small again.
        ended_s: when its twin ended before the run, s: it died down to the rounding, or it grew
            and diverged.
    """

    push: Push
    trend: EnvelopeTrend
    rate_per_s: float
    factor: float
    joint: str
    group: int
    becomes_rad_s: float
    ended_s: float | None = None


class RestDeparture(NamedTuple):
    """A time in which a run went away from a rest, and from its twins, while nobody acted on
    it.
    """

    from_s: float
    to_s: float
    rate_per_s: float
    joint: str


class TwinGrowth(NamedTuple):
    """What became of all pushes of a run.

    Attributes:
        why: why there are no twins; "" if there are.
        from_s, to_s: the judged part, s.
        pushes: of each push and group of sites what became of it.
        departure: when it left a rest by itself; None: it did not.
        same: False if the run was repeated on another platform, whose last bits differ.
        random: True if anything in the run's links is drawn: slow trends are chance then.
        twins: the twins themselves, to be drawn.
    """

    why: str
    from_s: float = 0.0
    to_s: float = 0.0
    pushes: tuple[PushGrowth, ...] = ()
    departure: RestDeparture | None = None
    same: bool = True
    random: bool = False
    twins: Twins | None = None

    @property
    def worst(self) -> PushGrowth | None:
        """The push that grew most, or died most slowly."""
        return max(
            self.pushes, key=lambda one: (_ORDER.index(one.trend), one.rate_per_s), default=None
        )

    @property
    def trend(self) -> EnvelopeTrend:
        """Of the worst push; undecided without twins."""
        return EnvelopeTrend.UNDECIDED if self.worst is None else self.worst.trend

    @property
    def grows(self) -> bool:
        """True if half of the pushes of some sites or more grow; by a factor of two if links
        are random.
        """
        return self.grows_by(DOUBLES if self.random else 1.0, always=True)

    def grows_by(self, factor: float, *, always: bool) -> bool:
        """True if half of the pushes of some sites or more grow by a factor; `always`: all the
        time.
        """
        for place in {one.group for one in self.pushes}:
            group = [one for one in self.pushes if one.group == place]
            grown = [one for one in group if one.factor >= factor]
            if 2 * sum(one.trend is EnvelopeTrend.GROWS or not always for one in grown) >= len(
                group
            ):
                return True
        return False

    @property
    def needs_s(self) -> float | None:
        """How long a run would have to be for a fall at this rate to be clear, s; None if
        nothing falls.
        """
        worst = self.worst
        if worst is None or not worst.rate_per_s < 0.0 or self.trend is EnvelopeTrend.DECAYS:
            return None
        return self.to_s + 4.0 * math.log(2.0) / -worst.rate_per_s

    @property
    def excluded_rate_per_s(self) -> float:
        """A push at a larger rate had grown by `CLEAR_GROWTH`, 1/s; infinite unless every push
        dies away.
        """
        judged_s = self.to_s - self.from_s
        dies = self.trend is EnvelopeTrend.DECAYS and judged_s > 0.0
        return math.log(CLEAR_GROWTH) / judged_s if dies else math.inf

    def to_json(self) -> dict[str, Any]:
        """Returns what is found, ready for JSON."""
        return {
            "trend": None if self.worst is None else self.trend.name.lower(),
            "from_s": self.from_s,
            "to_s": self.to_s,
            "pushes": [
                {
                    "push": one.push.name,
                    "trend": one.trend.name.lower(),
                    "rate_per_s": finite_or_none(one.rate_per_s),
                    "factor": finite_or_none(one.factor),
                    "joint": one.joint,
                    "becomes_rad_s": finite_or_none(one.becomes_rad_s),
                    "ended_s": one.ended_s,
                }
                for one in self.pushes
            ],
            "left": None if self.departure is None else self.departure._asdict(),
            "needs_s": self.needs_s,
            "same_bits": self.same,
            "text": self.text,
        }

    @property
    def text(self) -> str:
        """What is found, in one sentence."""
        worst = self.worst
        if worst is None:
            return f"twins: {self.why}"
        if (left := self.departure) is not None:
            when = f"from {left.from_s:.4g} to {left.to_s:.4g} s"
            rate = f"{left.rate_per_s:+.3g} /s"
            return f"twins: {when} the run and its twins left a rest by themselves, {rate} at {left.joint}"
        if worst.factor == 0.0:
            return "twins: every push died down to the rounding of the numbers"
        if math.isnan(worst.rate_per_s):
            return "twins: the run is too short to tell"
        what = worst.push.name
        in_s = f"in {self.to_s - self.from_s:.4g} s ({worst.rate_per_s:+.3g} /s)"
        changed = f"x {worst.factor:.3g} {in_s}, most at {worst.joint}"
        if self.trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY):
            return f"twins: every push dies away; the slowest, {what}, to {worst.factor:.3g} of its size {in_s}"
        if self.trend is EnvelopeTrend.GROWS:
            return f"twins: a push of {what} grows {changed}"
        more = "" if self.needs_s is None else f"; a run of {self.needs_s:.3g} s would tell"
        return f"twins: a push of {what} shows no clear trend: it changes {changed}{more}"


class TwinVerdict(NamedTuple):
    """The judgement of a run's end and of its twins together; the reason, if twins changed or
    doubt it.
    """

    stability: Stability
    reason: str = ""


def judge_end_by_twins(
    end: RunEnd, twins: TwinGrowth, *, settles: bool | None, rises: bool
) -> TwinVerdict:
    """Returns the judgement of a run by its end and by its twins.

    What grows away from its twins is not stable, wherever it is; what comes together with them
    is not said to grow. A stable run needs pushes that die away; where small motions are known
    to settle, none that grows. Arms too slow to get anywhere, all of whose pushes die away,
    need no trend of the motion that is left.

    Args:
        end: the end of the run.
        twins: what became of small pushes.
        settles: whether small motions settle, by roots that are exact or by the theorem; None:
            not known.
        rises: V rose by what nobody gave.
    """
    own = end.stability
    trend = twins.trend
    if not twins.pushes or end.behaviour is EndBehaviour.DIVERGED:
        return TwinVerdict(own)
    falls = (
        end.speed.trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
        and end.end_speed_rad_s > FLOOR_RAD
    )
    grows = (
        twins.grows or (settles is False and twins.grows_by(DOUBLES, always=False))
    ) and not falls
    left = twins.departure is not None and end.behaviour is not EndBehaviour.COASTS
    if (grows or left) and not end.operator_acts:
        return TwinVerdict(Stability.NOT_STABLE, twins.text)
    dies = trend is EnvelopeTrend.DECAYS or (trend is EnvelopeTrend.HARDLY and bool(settles))
    if own is Stability.STABLE and not (dies or trend is EnvelopeTrend.HARDLY):
        doubtful = trend is EnvelopeTrend.GROWS or not settles
        return TwinVerdict(Stability.OPEN, twins.text) if doubtful else TwinVerdict(own)
    if own is Stability.NOT_STABLE:
        alone = (
            end.behaviour is EndBehaviour.GROWS
            and trend is not EnvelopeTrend.GROWS
            and not rises
        )
        return TwinVerdict(Stability.OPEN, twins.text) if dies or alone else TwinVerdict(own)
    trendless = (
        end.behaviour in (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED) and not end.missing_sites
    )
    stays = end.end_speed_rad_s * (twins.to_s - twins.from_s) <= SETTLED_ERROR_RAD
    rests = stays and trend is EnvelopeTrend.DECAYS
    if trendless and dies and (settles or rests) and not (end.reasons or end.operator_acts):
        return TwinVerdict(Stability.STABLE)
    return TwinVerdict(own)


def measure_twins(
    log: Log, end: RunEnd, count: int = TWINS, *, own_laws: bool = False
) -> TwinGrowth:
    """Returns what became of small pushes in a run, of which its end is known already.

    Raises:
        LogError: a record cannot be read.
    """
    try:
        twins = run_twins(log, choose_pushes(log.scenario, count), own_laws=own_laws)
    except NotRepeatable as why:
        return TwinGrowth(str(why).removeprefix("no twins: "))
    return judge_twins(log.scenario, twins, end.counts_from_s, end.quiet_from_s)


def measure_virtual_twins(
    scenario: Scenario, end: RunEnd, duration_s: float, count: int
) -> TwinGrowth:
    """Returns the same of a run in virtual time, of so many seconds, without a log.

    Raises:
        ScenarioError: virtual time cannot run it.
    """
    twins = run_virtual_twins(scenario, choose_pushes(scenario, count), duration_s)
    return judge_twins(scenario, twins, end.counts_from_s, end.quiet_from_s)


def judge_twins(
    scenario: Scenario, twins: Twins, counts_from_s: float, quiet_from_s: float
) -> TwinGrowth:
    """Returns what became of the twins of a run.

    Args:
        scenario: of the run.
        twins: its twins.
        counts_from_s: since when the run counts: the second half from there on is judged, s.
        quiet_from_s: since when nobody acts on it, and its loop does not change, s.
    """
    t_s = twins.paths[0].t_s
    rows = np.flatnonzero(
        twins.speed.any(axis=1) | np.isfinite(twins.paths[0].largest).any(axis=1)
    )
    end = int(rows[-1]) if len(rows) else 0  # the last interval may be of one tick
    first = min(int(np.searchsorted(t_s, counts_from_s)), end)
    pushes = []
    left = []
    firsts = np.cumsum([0, *(scenario.layout(name).joints for name in scenario.names)]).tolist()
    for place, sites in enumerate(find_coupled_sites(scenario)):
        group = [joint for site in sites for joint in range(firsts[site], firsts[site + 1])]
        amplitudes = [measure_amplitude(path, group) for path in twins.paths]
        for path, amplitude in zip(twins.paths, amplitudes, strict=True):
            if np.isfinite(amplitude[first:end]).any():
                judged = _judge_push(
                    path=path,
                    amplitude=amplitude,
                    group=group,
                    part=slice(first, end),
                    joints=twins.joints,
                )
                pushes.append(judged._replace(group=place))
        quiet = slice(int(np.searchsorted(t_s, quiet_from_s)), end)
        left += list(_find_departures(twins, amplitudes, group, quiet))
    return TwinGrowth(
        "" if pushes else "no push moved anything",
        from_s=0.5 * float(t_s[first] + t_s[end]),
        to_s=float(t_s[end]),
        pushes=tuple(pushes),
        departure=max(left, key=lambda one: one.rate_per_s, default=None),
        same=twins.same,
        random=scenario.links_random,
        twins=twins,
    )


def measure_amplitude(path: TwinPath, group: Sequence[int]) -> Array:
    """Returns the logarithm of the amplitude of a difference at some joints, shape (K,); -inf:
    none.
    """
    amplitude: Array = path.largest[:, group].max(axis=1)
    for leg in map(slice, path.pushed, [*path.pushed[1:], len(amplitude)]):
        if leg.stop - leg.start > 2:
            whole = _measure_leg(path.last[leg][:, group], path.scale[leg], amplitude[leg])
            amplitude[leg] = np.where(
                np.isfinite(whole), np.maximum(whole, amplitude[leg]), amplitude[leg]
            )
    return amplitude


def _measure_leg(last: Array, scale: Array, largest: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        peak = np.max(largest, where=np.isfinite(largest), initial=-np.inf)
        d = last * np.exp(scale - peak)[:, np.newaxis]
        rate = np.gradient(d, 1.0 / BUCKETS_PER_S, axis=0)
        around = np.exp(2.0 * (_running_maximum(largest) - peak))
        weights = np.where(np.isfinite(largest) & (around > 0.0), 1.0 / around, 0.0)[
            :, np.newaxis
        ]
        omega2 = float((weights * rate**2).sum() / (weights * d**2).sum())
        whole: Array = np.log((d**2 + rate**2 / omega2).sum(axis=1)) / 2.0 + peak
    return whole


def _running_maximum(values: Array) -> Array:
    padded = np.pad(values, BUCKETS_PER_S // 2, constant_values=-np.inf)
    found: Array = np.lib.stride_tricks.sliding_window_view(padded, BUCKETS_PER_S + 1).max(
        axis=1
    )
    return found


def _fit(t_s: Array, amplitude: Array) -> EnvelopeFit:
    known = np.isfinite(amplitude)
    if known.sum() < 2:
        return EnvelopeFit(EnvelopeTrend.UNDECIDED, float("nan"))
    values = np.exp(np.where(known, amplitude, -np.inf) - amplitude[known].max())
    return fit_envelopes(t_s, values[:, np.newaxis], _NOTHING, falls_first=True)[0]


def _judge_push(
    path: TwinPath, amplitude: Array, group: Sequence[int], part: slice, joints: Sequence[str]
) -> PushGrowth:
    """Returns what became of a push.

    One that died down and was pushed anew counts from the last time, if that is long enough
    ago.
    """
    t_s = path.t_s
    first = part.start
    end = part.stop
    if not path.push.again:  # it may have died, or left its limits
        end = min(end, int(np.flatnonzero(np.isfinite(amplitude))[-1]) + 1)
    legs = [*(at for at in path.pushed if at < end), end]
    largest = path.largest[max(first, end - BUCKETS_PER_S) : end, group].max(axis=0)
    joint = joints[group[int(largest.argmax())]]
    since = max(first, legs[-2])
    fit = _fit(t_s[since:end], amplitude[since:end])
    found = PushGrowth(
        push=path.push,
        trend=fit.trend,
        rate_per_s=fit.rate_per_s,
        factor=0.0,
        joint=joint,
        group=0,
        becomes_rad_s=_exp(float(largest.max())),
    )
    if path.died is not None or end < part.stop - BUCKETS_PER_S:
        trend = EnvelopeTrend.GROWS if path.died is None else EnvelopeTrend.DECAYS
        return found._replace(trend=trend, ended_s=float(t_s[end - 1]))
    died = len(legs) > 2 and legs[-2] > (first + end) // 2  # within the judged part
    if died and (fit.trend is not EnvelopeTrend.GROWS or end - legs[-2] < (end - first) // 4):
        before = slice(legs[-3], legs[-2])  # when it died: since then there is too little of it
        rate_per_s = _fit(t_s[before], amplitude[before]).rate_per_s
        return found._replace(trend=EnvelopeTrend.DECAYS, rate_per_s=rate_per_s)
    half_s = 0.5 * float(t_s[end - 1] - t_s[since])
    return found._replace(factor=_exp(fit.rate_per_s * half_s))


def _exp(logarithm: float) -> float:
    """Returns what has a logarithm; infinity beyond all numbers."""
    return math.exp(logarithm) if not logarithm > MOST_LOG else math.inf


def _find_departures(
    twins: Twins, amplitudes: Sequence[Array], group: Sequence[int], quiet: slice
) -> Iterator[RestDeparture]:
    t_s = twins.paths[0].t_s
    with np.errstate(divide="ignore"):
        speed = np.log(twins.speed[:, group].max(axis=1))
    length = quiet.stop - quiet.start
    for part in (2, 4, 8):
        size = length // part
        if size < LEAST_LEFT_S * BUCKETS_PER_S:
            return
        for start in range(quiet.start, quiet.stop - 2 * size + 1, max(1, size // 2)):
            rows = slice(start, start + 2 * size)  # of which the second half is judged
            own = _fit(t_s[rows], speed[rows])
            rate_per_s = own.rate_per_s
            if (
                own.trend is not EnvelopeTrend.GROWS
                or rate_per_s * size < math.log(DOUBLES) * BUCKETS_PER_S
            ):
                continue
            fits = [_fit(t_s[rows], amplitude[rows]) for amplitude in amplitudes]
            if 2 * sum(fit.trend is EnvelopeTrend.GROWS for fit in fits) >= len(fits):
                last = twins.speed[rows.stop - BUCKETS_PER_S : rows.stop, group].max(axis=0)
                joint = twins.joints[group[int(last.argmax())]]
                yield RestDeparture(
                    float(t_s[start + size]), float(t_s[rows.stop - 1]), rate_per_s, joint
                )


class LinearSizes(NamedTuple):
    """Sizes of a push between which twins are the same but for their scale, and what is beyond,
    in words.
    """

    smallest: float
    largest: float
    text: str


@dataclass(frozen=True, repr=False)
class PushedTwins(Result):
    """Twins of a log that were pushed at an instant, s; what became of them; for which sizes it
    is linear.
    """

    log: Log
    at_s: float
    growth: TwinGrowth
    linear: LinearSizes | None = None

    def describe(self, one: PushGrowth) -> str:
        """Returns what became of a push, in one sentence."""
        rate = "" if math.isnan(one.rate_per_s) else f" ({one.rate_per_s:+.3g} /s)"
        pushed = f"a push of {one.push.name} at {self.at_s:.4g} s"
        to_s = self.growth.to_s
        if one.ended_s is not None:
            died = "dies down to the rounding of the numbers"
            ends = died if one.trend is EnvelopeTrend.DECAYS else "makes the run diverge"
            return f"{pushed} {ends} in {one.ended_s - self.at_s:.3g} s{rate}"
        if one.trend is EnvelopeTrend.GROWS:
            grows = f"grows x {one.factor:.3g} in {to_s - self.growth.from_s:.4g} s"
            return f"{pushed} {grows}{rate}, most at {one.joint}"
        falls = one.trend in (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
        becomes = f"becomes {one.becomes_rad_s:.3g} rad/s in {to_s - self.at_s:.4g} s{rate}"
        return f"{pushed} {becomes}, most at {one.joint}{'' if falls else '; it shows no clear trend'}"

    def headline(self) -> str:
        """Returns for which sizes a push is linear, or what became of the worst one."""
        worst = self.growth.worst
        return (
            self.linear.text
            if self.linear
            else self.describe(worst)
            if worst
            else self.growth.text
        )

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per push."""
        both = zip(self.growth.to_json()["pushes"], self.growth.pushes, strict=True)
        return [{**row, "text": self.describe(one)} for row, one in both]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat twin --json`."""
        part = {key: self.growth.to_json()[key] for key in ("from_s", "to_s", "same_bits")}
        linear = self.linear and self.linear._asdict()
        found = {"pushes": self.to_rows(), "linear": linear, "text": self.headline()}
        return {"log": self.log.source, "at_s": self.at_s, **part, **found}


def twin(
    log: str | Path | Log,
    at_s: float = 0.0,
    push: Mapping[str, float] | Sequence[str] = (),
    delta: str = "",
) -> PushedTwins:
    """Executes a run again, beside twins that are pushed at an instant; the command is `trilat
    twin`.

    >>> found = tn.twin(tn.simulate("two_sites", duration_s=4), at_s=1, push={"m.q1": 1e-6})
    >>> found.growth.pushes[0].rate_per_s < 0.0
    True

    Args:
        log: the log, or its path.
        at_s: when, s.
        push: sizes by what is pushed: a joint's angle, `{"m1.q1": 1e-6}`, its speed, `m1.qd1`,
            an estimate, `m1.theta1`, or many in a drawn direction, `m1.q`, `q`; a twin each. By
            default as `certify` does.
        delta: sizes of one push, as in "1e-9:1e-3", of which each decade has a twin.

    Raises:
        UsageError: there is no such push, instant or range.
        LogError: the log cannot be read, or not be executed again.
        CodeWithheld: a law of it may not run.
    """
    log = log if isinstance(log, Log) else open_log(log)
    scenario = log.scenario
    asked = push.items() if isinstance(push, Mapping) else [*map(_read_push, push)]
    end_s = max(len(log[name]) / log[name].rate_hz for name in log.sites)
    if not 0.0 <= at_s < end_s and end_s > 0.0:
        raise UsageError(
            f"--at {at_s:g}: a push is within the run, from 0 s until before {end_s:g} s"
        )
    if delta and len(asked) > 1:
        raise UsageError(
            f"--delta sweeps the size of one push, not of {', '.join(what for what, _ in asked)}"
        )
    if delta:
        (what, _) = next(iter(asked), ("q", 0.0))
        sizes = _read_sizes(delta)
        pushes = [
            parse_push(scenario, what, size, at_s)._replace(largest=math.inf) for size in sizes
        ]
    else:
        usual = [one._replace(at_s=at_s, again=False) for one in choose_pushes(scenario, TWINS)]
        pushes = [parse_push(scenario, what, size, at_s) for what, size in asked] or usual
    growth = judge_twins(scenario, run_twins(log, pushes, own_laws=True), at_s, math.inf)
    return PushedTwins(
        log, at_s, growth, _find_linear_sizes(scenario, growth, sizes) if delta else None
    )


def _read_push(text: str) -> tuple[str, float]:
    what, stated, size = text.partition("=")
    try:
        return what.strip(), float(size) if stated else PUSH_RAD
    except ValueError:
        raise UsageError(
            f"--push {text}: its size is a number, as in m1.q1=1e-6, not {size!r}"
        ) from None


def _read_sizes(text: str) -> list[float]:
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = math.nan
    if not LEAST_PUSH <= low < high / 9.99 <= MOST_PUSH / 9.99:
        allowed = f"from {LEAST_PUSH:g} to {MOST_PUSH:g}, a decade apart or more"
        raise UsageError(f"--delta is two sizes {allowed}, as in 1e-9:1e-3, not {text!r}")
    return [
        float(f"{low * 10.0**n:.6g}")
        for n in range(math.floor(math.log10(high / low) + 1e-3) + 1)
    ]


def _find_linear_sizes(
    scenario: Scenario, growth: TwinGrowth, sizes: Sequence[float]
) -> LinearSizes:
    assert growth.twins is not None
    paths = growth.twins.paths
    every = range(len(growth.twins.joints))
    largest = [_running_maximum(measure_amplitude(path, every)) for path in paths]
    unit = paths[0].push.name.partition(" ")[2]
    beyond = ""
    for n, (small, big) in enumerate(pairwise(largest)):
        ratio = np.full(len(big), math.log(sizes[n + 1] / sizes[n]))
        known = (small > math.log(10.0 * SMALLEST)) & np.isfinite(big)
        apart = np.subtract(big, small, out=ratio.copy(), where=known) - ratio
        at = int(np.abs(apart).argmax())
        if abs(apart[at]) > SAME_SCALED:
            grows = any(
                one.trend is EnvelopeTrend.GROWS and one.push is paths[n].push
                for one in growth.pushes
            )
            acts = {
                one.actor.kind for site in scenario.sites.values() for one in site.environment
            }
            does = "saturates" if grows and apart[at] < 0.0 else "goes another way"
            does += " (there is a wall)" if TorqueKind.WALL in acts else ""
            times = f"x {_exp(float(apart[at])):.3g} of that at {paths[0].t_s[at]:.4g} s"
            beyond = f"; a push of {sizes[n + 1]:g} {does}: {times}"
            break
    last = sizes[n] if beyond else sizes[-1]
    linear = f"linear from {sizes[0]:g} to {last:g} {unit}"
    return LinearSizes(
        sizes[0],
        last,
        (linear if last > sizes[0] else f"not linear, from {last:g} {unit} on") + beyond,
    )
