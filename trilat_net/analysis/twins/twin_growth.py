"""Measures whether small disturbances of a run grow or decay, by repeating the run.

A repetition of the run that receives a small push, for example at one joint, is called a twin.
Without the push, it would be identical to the run. The differences d of the joint velocities
between the twin and the run are computed 20 times per second. The size of the disturbance is
their amplitude A, with

    A^2 = sum over joints of d^2 + (a / w)^2

where a is the time derivative of d. The frequency w, in rad/s, is chosen to make both terms
equal on average. If d is an oscillation that grows or decays at a certain rate, A does not
oscillate, but is proportional to exp(rate t) over the time t. The rate is therefore the slope
of log A over the judged part of the run. `envelope_trend` defines the bounds of the slope, and
the classes such as "grows" and "decays".

Invariant:
    - Velocities are compared. If a push merely shifts all arms to another equilibrium, the
      difference becomes zero.
    - In a scenario whose arms form groups that are not coupled to each other, each group is
      judged separately. Growth in one group is therefore not hidden by another group.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ...core import BUCKETS_PER_S, Array
from ...errors import NotRepeatable, UsageError
from ...hooks import find_hook
from ...log import Log
from ...results import Result, finite_or_none
from ...scenario import Scenario
from ..delay_period import DelayPeriod, find_burst_interval_s
from ..run_end import RunEnd, find_coupled_sites
from ..torque_sources import VirtualWall
from .envelope_trend import EnvelopeFit, EnvelopeTrend
from .twin_runs import LEAST_PUSH, MOST_PUSH, PUSH_RAD, SMALLEST, Push, TwinPath, Twins

LEAST_LEFT_S = 5.0
"""Shortest departure from a rest position that counts, in s."""
DOUBLES = 2.0
"""Smallest factor by which the speed must grow during a departure from rest.

If delays are random, the effects of pushes must grow by the same factor, to exclude chance.
"""
CLEAR_GROWTH = 100.0
"""Growth of an unstable mode, as a factor, that a push in any direction reveals.

A push excites all modes. Growth of one mode by this factor outweighs the decay of the others.
"""
_TRENDS_FROM_BEST = (
    EnvelopeTrend.DECAYS,
    EnvelopeTrend.HARDLY,
    EnvelopeTrend.UNDECIDED,
    EnvelopeTrend.STEADY,
    EnvelopeTrend.GROWS,
)
_AMPLITUDE_FLOOR = 1e-300
"""Smallest amplitude in a fit. The amplitudes are scaled and have no unit."""
SAME_SCALED = math.log(1.1)
"""Largest difference between the logarithms of two scaled twins that count as equal: 10 %."""
_MOST_LOG = 700.0
"""Largest argument of the exponential function that certainly does not overflow."""


class PushGrowth(NamedTuple):
    """How the effect of one push develops over the judged part of a run.

    A push is a small disturbance in a repetition of the run, which is called a twin. Its effect
    is the difference between the twin and the run. If some arms of the scenario are not coupled
    to the others, a push has one `PushGrowth` for each group of coupled arms.

    Attributes:
        push: The push: what was changed, when and by how much.
        trend: Class of the trend of the difference, such as growing.
        rate_per_s: Rate of the difference, which is proportional to exp(rate t), in 1/s. NaN if
            the judged part is too short.
        factor: Factor by which the difference changed over the judged part. 0 if it decayed to
            the level of rounding errors.
        joint: Name of the joint with the worst trend: the joint at which the difference is
            largest at the end, or a joint whose difference grows or persists although the
            largest difference decays.
        group: Index of the group of sites.
        becomes_rad_s: Largest difference in the last second, in rad/s, with all scalings of the
            difference undone.
        ended_s: Time at which the twin ended before the run, in s, because the difference
            decayed to the level of rounding errors or the twin diverged. `None` if the twin did
            not end early.
        leads: True if the difference at the end is largest at this joint, or if the difference
            of all joints together also grows.
    """

    push: Push
    trend: EnvelopeTrend
    rate_per_s: float
    factor: float
    joint: str
    group: int
    becomes_rad_s: float
    ended_s: float | None = None
    leads: bool = True


class _MissChance(NamedTuple):
    """Probability that pushes in random directions miss a mode that grows.

    Attributes:
        directions: Number of random directions.
        growth: Growth of the mode in the judged part of the run, as a factor.
        probability: The probability.
    """

    directions: int
    growth: float
    probability: float

    @classmethod
    def of_directions(cls, directions: int) -> "_MissChance":
        """Estimates how likely pushes in random directions are to miss a clearly growing mode.

        A mode that grows by `CLEAR_GROWTH` is missed if its share in every push is less than 1
        / `CLEAR_GROWTH` of the root-mean-square share. The share in a push with many random
        components is nearly normally distributed. In units of the root-mean-square share, its
        density at zero is 1 / sqrt(2 pi).

        Args:
            directions: Number of independent random directions.
        """
        largest_missed_share = 1.0 / CLEAR_GROWTH
        # probability that a standard normal number lies between - and + this share
        miss_by_one_push = 2.0 * largest_missed_share / math.sqrt(2.0 * math.pi)
        probability = math.pow(miss_by_one_push, directions)
        return cls(directions, CLEAR_GROWTH, probability)


class RestDeparture(NamedTuple):
    """Time interval in which a run departed from an unstable pose of rest by itself.

    Its twins (repeated runs with a small push) did the same. No operator or wall acted on the
    arms during this time.

    Attributes:
        from_s: Start, in s.
        to_s: End, in s.
        rate_per_s: Rate at which the speed of the run grew, in 1/s.
        joint: Name of the fastest joint.
    """

    from_s: float
    to_s: float
    rate_per_s: float
    joint: str


class TwinGrowth(NamedTuple):
    """Whether the effects of small pushes on a run grow or decay (see `TwinGrowth.of_twins`).

    Each push is made in a repetition of the run, which is called a twin. The difference between
    the twin and the run is then observed.

    Attributes:
        why: The reason why there are no twins. Empty if there are twins.
        from_s: Start of the judged part of the run, in s.
        to_s: End of this part, in s.
        pushes: Growth of the effect of every push, in every group of coupled sites.
        departure: Fastest departure of the run from rest, or `None` if the run did not depart
            from rest.
        same_platform: False if the run was recorded on another platform. The last bits of the
            repeated run may then differ from the log.
        links_random: True if some link draws its delays at random. Slow trends may then be due
            to chance.
        delay_period_s: Time after which varying delays and the ticks of all sites repeat, in s,
            or `None` if delays are constant, random, or never repeat.
        burst_interval_s: Mean time between two bursts of lost samples, in s, or `None` if no
            link loses samples in bursts.
        twins: The twins themselves, for figures, or `None` if there are none.
    """

    why: str
    from_s: float = 0.0
    to_s: float = 0.0
    pushes: tuple[PushGrowth, ...] = ()
    departure: RestDeparture | None = None
    same_platform: bool = True
    links_random: bool = False
    delay_period_s: float | None = None
    burst_interval_s: float | None = None
    twins: Twins | None = None

    @property
    def hides_period(self) -> bool:
        """True if the period of the delays is longer than the judged part of the run.

        Effects of pushes that decayed in this part might then grow in the rest of the period. A
        decision without a proof therefore stays open.
        """
        judged_s = self.to_s - self.from_s
        return self.delay_period_s is not None and self.delay_period_s > judged_s

    @property
    def trend(self) -> EnvelopeTrend:
        """Trend of the effect of the worst push, for example growing or decaying.

        The worst push is the one whose effect grows most or decays most slowly. The trend is
        undecided if there are no pushes.
        """
        return EnvelopeTrend.UNDECIDED if self.worst is None else self.worst.trend

    @property
    def worst(self) -> PushGrowth | None:
        """The small push whose effect on the run grew most, or decayed most slowly.

        Each push was made in a repetition of the run. The trend of this push is taken as the
        trend of the whole run. `None` if there are no pushes.
        """
        return max(self.pushes, key=_rank_badness, default=None)

    @property
    def grows(self) -> bool:
        """True if small disturbances of the run grow, which means that the run is unstable.

        A push is a small disturbance in a repetition of the run. Coupled arms form a group. The
        disturbances of a group grow if the effects of at least half of its pushes grow
        throughout, from `from_s` to `to_s`. They also count as growing if the motion of the
        same joint grows throughout after at least two pushes, and is the fastest motion after
        one of these pushes. This second rule exists because a joint that does not act on the
        others moves only after the pushes that reach it. If network delays are random, the
        effects must grow by a factor of two, to rule out chance.
        """
        least_factor = DOUBLES if self.links_random else 1.0
        grown = []
        for push in self.pushes:
            grows_throughout = push.trend is EnvelopeTrend.GROWS
            if grows_throughout and push.factor >= least_factor:
                grown.append(push)

        for group in {push.group for push in self.pushes}:
            pushes = [push for push in self.pushes if push.group == group]
            grown_in_group = [push for push in grown if push.group == group and push.leads]
            if 2 * len(grown_in_group) >= len(pushes):
                return True
        for joint in {push.joint for push in grown}:
            with_joint = [push for push in grown if push.joint == joint]
            if len(with_joint) >= 2 and any(push.leads for push in with_joint):
                return True
        return False

    @property
    def miss_chance(self) -> _MissChance | None:
        """Probability that random pushes fail to reveal that a run is unstable.

        `None` if each joint was pushed individually, because the directions of the pushes are
        then not random.
        """
        directions = {push.push.direction for push in self.pushes if push.push.direction}
        if not directions:
            return None
        return _MissChance.of_directions(len(directions))

    @property
    def judged_bursts(self) -> float:
        """Mean number of bursts of lost samples in the judged part of the run.

        A trend over few bursts says little about a run with more bursts. The number refers to
        the network link with the fewest bursts. It is infinite if no link loses samples in
        bursts.
        """
        if self.burst_interval_s is None:
            return math.inf
        return (self.to_s - self.from_s) / self.burst_interval_s

    @property
    def needs_s(self) -> float | None:
        """Length of a run that would clearly show that the effects of pushes decay, in s.

        In a run of this length, the effect that decays most slowly can halve four more times at
        its present rate. `None` if the effects do not decay, or if the run is already long
        enough.
        """
        worst = self.worst
        if worst is None or not worst.rate_per_s < 0.0 or self.trend is EnvelopeTrend.DECAYS:
            return None
        return self.to_s + 4.0 * math.log(2.0) / -worst.rate_per_s

    @property
    def excluded_rate_per_s(self) -> float:
        """Rate in 1/s above which no disturbance of the run can grow.

        A disturbance with a larger rate would have grown by the factor `CLEAR_GROWTH` from
        `from_s` to `to_s`, which the repeated runs would have shown. Unless the effect of every
        push decays, no rate is excluded, and the value is infinite.
        """
        judged_s = self.to_s - self.from_s
        dies = self.trend is EnvelopeTrend.DECAYS and judged_s > 0.0
        return math.log(CLEAR_GROWTH) / judged_s if dies else math.inf

    def to_json(self) -> dict[str, Any]:
        """Converts the trends of each push and of all pushes together to plain JSON values.

        The trend of a push states how its effect developed, with its rate in 1/s and the factor
        by which it grew or fell. Values that are not finite become `None`.
        """
        pushes = [
            {
                "push": growth.push.name,
                "trend": growth.trend.name.lower(),
                "rate_per_s": finite_or_none(growth.rate_per_s),
                "factor": finite_or_none(growth.factor),
                "joint": growth.joint,
                "becomes_rad_s": finite_or_none(growth.becomes_rad_s),
                "ended_s": growth.ended_s,
            }
            for growth in self.pushes
        ]

        return {
            "trend": None if self.worst is None else self.trend.name.lower(),
            "from_s": self.from_s,
            "to_s": self.to_s,
            "pushes": pushes,
            "left": None if self.departure is None else self.departure._asdict(),
            "needs_s": self.needs_s,
            "same_bits": self.same_platform,
            "text": self.text,
        }

    @property
    def text(self) -> str:
        """A sentence for the user on whether the effects of small pushes grow or decay.

        The sentence describes the push whose effect grows most or decays most slowly. If the
        arms departed from rest by themselves, the sentence describes that motion instead. If
        the run was not repeated with pushes, the sentence states the reason. The package
        `presentation` generates it.
        """
        return str(find_hook("describe a finding")(self))

    @classmethod
    def of_log(
        cls,
        log: Log,
        end: RunEnd,
        count: int | None = None,
        *,
        own_laws: bool = False,
    ) -> "TwinGrowth":
        """Repeats a recorded run with small pushes, and judges whether their effects grow.

        If they grow, the run is not stable. Each repetition with a push is called a twin.

        Args:
            log: The log of the run.
            end: How the run ended, and from what time on it is judged.
            count: Number of twins. If `None`, enough to push each joint (`Push.choose`).
            own_laws: True to execute the code of control laws that are not part of this
                program.

        Returns:
            How the effects of the pushes grow. If the run cannot be repeated, the result
            contains no pushes and states the reason.

        Raises:
            LogError: A record cannot be read.
        """
        try:
            twins = Twins.of_log(log, Push.choose(log.scenario, count), own_laws=own_laws)
        except NotRepeatable as error:
            return TwinGrowth(str(error).removeprefix("twins cannot be run: "))
        return TwinGrowth.of_twins(log.scenario, twins, end.counts_from_s, end.quiet_from_s)

    @classmethod
    def of_scenario(
        cls,
        scenario: Scenario,
        end: RunEnd,
        duration_s: float,
        count: int | None = None,
    ) -> "TwinGrowth":
        """Simulates a scenario with small pushes, and judges whether their effects grow.

        No log is needed: both the run and its repetitions with a push (the twins) are
        simulated.

        Args:
            scenario: The scenario.
            end: How the run ended, and from what time on it is judged.
            duration_s: Length of the run, in s.
            count: Number of twins. If `None`, enough to push each joint (`Push.choose`).

        Raises:
            ScenarioError: The scenario cannot run in virtual time.
        """
        twins = Twins.of_scenario(scenario, Push.choose(scenario, count), duration_s)
        return TwinGrowth.of_twins(scenario, twins, end.counts_from_s, end.quiet_from_s)

    @classmethod
    def of_twins(
        cls,
        scenario: Scenario,
        twins: Twins,
        counts_from_s: float,
        quiet_from_s: float,
    ) -> "TwinGrowth":
        """Judges whether the effects of small pushes on a run grow or decay.

        Each push is made in a repetition of the run, a twin. The difference between twin and
        run is evaluated over the judged part of the run.

        Args:
            scenario: The scenario.
            twins: The twins.
            counts_from_s: Only the run after this time is considered, in s. The second half of
                the time after it is judged.
            quiet_from_s: Time after which no operator acts on the run and its control loop does
                not change, in s. Only departures from rest after this time are searched for.
        """
        t_s = twins.paths[0].t_s
        has_motion = twins.speed.any(axis=1) | np.isfinite(twins.paths[0].largest).any(axis=1)
        rows = np.flatnonzero(has_motion)
        # The last interval is left out, because it may be a single tick.
        end = int(rows[-1]) if len(rows) else 0
        period_s = _find_varying_period_s(scenario)
        counts_from_s = _fit_to_period(counts_from_s, float(t_s[end]), period_s)
        first = min(int(np.searchsorted(t_s, counts_from_s)), end)
        quiet = slice(int(np.searchsorted(t_s, quiet_from_s)), end)

        joint_counts = [scenario.layout(site).joints for site in scenario.names]
        first_joints = np.cumsum([0, *joint_counts]).tolist()
        pushes = []
        departures = []
        for group, sites in enumerate(find_coupled_sites(scenario)):
            joints: list[int] = []
            for site in sites:
                joints += range(first_joints[site], first_joints[site + 1])
            amplitudes = [_measure_amplitude(path, joints) for path in twins.paths]
            for path, amplitude in zip(twins.paths, amplitudes, strict=True):
                is_affected = np.isfinite(amplitude[first:end]).any()
                if is_affected:
                    growth = _judge_worst_joint(
                        path=path,
                        amplitude=amplitude,
                        joints=joints,
                        part=slice(first, end),
                        joint_names=twins.joints,
                    )
                    pushes.append(growth._replace(group=group))
            departures += list(_find_departures(twins, amplitudes, joints, quiet))

        is_too_short = end <= first
        no_pushes = (
            "too short a record to follow a push" if is_too_short else "no push moved an arm"
        )
        return cls(
            "" if pushes else no_pushes,
            from_s=0.5 * float(t_s[first] + t_s[end]),
            to_s=float(t_s[end]),
            pushes=tuple(pushes),
            departure=max(departures, key=lambda departure: departure.rate_per_s, default=None),
            same_platform=twins.same,
            links_random=scenario.links_random,
            delay_period_s=period_s,
            burst_interval_s=find_burst_interval_s(scenario),
            twins=twins,
        )


def _find_varying_period_s(scenario: Scenario) -> float | None:
    """Returns the time after which varying delays repeat at the end of a scenario, in s.

    Pushes are judged over whole periods, because they may grow in one part of a period and die
    away in another. The period is that of all links and of the ticks of all sites. The result
    is `None` if all delays are constant, or if some delay never repeats.
    """
    links = [scenario.find_final_link(name) for name in scenario.links]
    if all(link.constant_delay_ms is not None for link in links):
        return None
    return DelayPeriod.of_scenario(scenario).true_s


def _fit_to_period(counts_from_s: float, end_s: float, period_s: float | None) -> float:
    """Moves the start of the judged part such that its second half contains whole periods.

    Otherwise the judgement would depend on the part of the period in which the run ends.

    Args:
        counts_from_s: Start of the part to consider, in s.
        end_s: End of the part, in s.
        period_s: Period of the delays, in s. `None` if they are constant or never repeat.

    Returns:
        The later start, in s. It is unchanged if the second half is shorter than a period.
    """
    half_s = 0.5 * (end_s - counts_from_s)
    if period_s is None or period_s > half_s:
        return counts_from_s
    whole_periods = math.floor(half_s / period_s)
    return end_s - 2.0 * whole_periods * period_s


def _measure_amplitude(path: TwinPath, group: Sequence[int]) -> Array:
    """Computes the effect of a small push on a run over time, as a logarithm.

    A twin is a repetition of the run with a small push. The effect is the amplitude A of the
    difference between twin and run, which the module's docstring defines. A push whose effect
    died down to the rounding errors is repeated. The times between two pushes are evaluated
    separately.

    Args:
        path: The twin's difference from its run at K times.
        group: Indices of the joints to consider.

    Returns:
        log A, shape (K,), with A in rad/s. It is -inf where the difference is zero. It is never
        less than the logarithm of the largest velocity difference of a joint.
    """
    amplitude: Array = path.largest[:, group].max(axis=1)
    interval_ends = [*path.pushed[1:], len(amplitude)]
    for start, end in zip(path.pushed, interval_ends, strict=True):
        if end - start <= 2:
            continue  # too short for a time derivative
        rows = slice(start, end)
        largest = amplitude[rows]
        differences = path.last[rows][:, group]
        log_A = _measure_interval(differences, path.scale[rows], largest)
        larger = np.maximum(log_A, largest)
        amplitude[rows] = np.where(np.isfinite(log_A), larger, largest)
    return amplitude


def _measure_interval(differences: Array, scale: Array, largest: Array) -> Array:
    """Returns log A between two pushes, where A is the size of the effect of a push.

    The module's docstring defines A. Twins store their differences from the run in scaled form,
    because the differences may become too small or too large for floating-point numbers.
    Therefore the differences are first scaled by their largest value.

    Args:
        differences: Scaled velocity differences of the joints, shape (K, n).
        scale: Logarithm of the scale of each row, shape (K,).
        largest: Logarithm of the largest difference of a joint, shape (K,).

    Returns:
        log A, shape (K,). Not finite where the difference is zero or unknown.
    """
    with np.errstate(
        divide="ignore",
        invalid="ignore",
        over="ignore",
        under="ignore",
    ):
        is_finite = np.isfinite(largest)
        peak = np.max(largest, where=is_finite, initial=-np.inf)
        rescaling = np.exp(scale - peak)
        d = differences * rescaling[:, np.newaxis]
        d_rate = np.gradient(d, 1.0 / BUCKETS_PER_S, axis=0)

        # w is the ratio of d' to d over the whole interval. Each row is divided by the local
        # size of the difference, so that rows with a large difference do not dominate.
        log_local_size = _running_maximum(largest) - peak
        local_size_squared = np.exp(2.0 * log_local_size)
        is_weighted = np.isfinite(largest) & (local_size_squared > 0.0)
        weights = np.where(is_weighted, 1.0 / local_size_squared, 0.0)[:, np.newaxis]
        rate_sum = (weights * d_rate**2).sum()
        difference_sum = (weights * d**2).sum()
        w_squared = float(rate_sum / difference_sum)

        squares = (d**2 + d_rate**2 / w_squared).sum(axis=1)
        log_amplitude: Array = np.log(squares) / 2.0 + peak
    return log_amplitude


def _running_maximum(values: Array) -> Array:
    """Returns the maximum over half a second before and after each value, shape (K,).

    It turns an oscillation into its amplitude, without the zero crossings.
    """
    padded = np.pad(values, BUCKETS_PER_S // 2, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, BUCKETS_PER_S + 1)
    maximum: Array = windows.max(axis=1)
    return maximum


def _fit_trend(t_s: Array, amplitude: Array) -> EnvelopeFit:
    """Determines whether a small difference between two runs grows, decays or persists.

    Args:
        t_s: Times, shape (K,), in s.
        amplitude: Logarithm of the amplitude, shape (K,). Values that are not finite are
            treated as an amplitude of zero.

    Returns:
        The trend. Undecided with fewer than two finite values.
    """
    is_finite = np.isfinite(amplitude)
    if is_finite.sum() < 2:
        return EnvelopeFit(EnvelopeTrend.UNDECIDED, float("nan"))
    # divided by the largest amplitude, so that the exponential cannot overflow
    finite_log = np.where(is_finite, amplitude, -np.inf)
    scaled_amplitude = np.exp(finite_log - amplitude[is_finite].max())
    one_column = scaled_amplitude[:, np.newaxis]
    (fit,) = EnvelopeFit.fit_columns(t_s, one_column, _AMPLITUDE_FLOOR, falls_first=True)
    return fit


def _judge_push(
    path: TwinPath,
    amplitude: Array,
    joints: Sequence[int],
    part: slice,
    joint_names: Sequence[str],
) -> PushGrowth:
    """Evaluates how the effect of a push developed over the judged part of a run.

    A push whose effect died down to the rounding errors was repeated. If the last repetition is
    long enough before the end, the push is judged from that time. The caller sets the group of
    the result.

    Args:
        path: The difference of the pushed repetition (twin) from the run.
        amplitude: Logarithm of the amplitude of the difference, shape (K,).
        joints: Indices of the joints to consider.
        part: Rows whose second half is judged.
        joint_names: Names of all joints.
    """
    t_s = path.t_s
    first = part.start
    end = part.stop
    if not path.push.again:  # a push that is not repeated may have died, or left its limits
        finite_rows = np.flatnonzero(np.isfinite(amplitude))
        end = min(end, int(finite_rows[-1]) + 1)
    push_rows = [row for row in path.pushed if row < end]
    last_push = push_rows[-1]
    last_second = slice(max(first, end - BUCKETS_PER_S), end)
    largest = path.largest[last_second, joints].max(axis=0)
    start = max(first, last_push)
    fit = _fit_trend(t_s[start:end], amplitude[start:end])
    leading_joint = joints[int(largest.argmax())]
    growth = PushGrowth(
        push=path.push,
        trend=fit.trend,
        rate_per_s=fit.rate_per_s,
        factor=0.0,
        joint=joint_names[leading_joint],
        group=0,
        becomes_rad_s=_exp(float(largest.max())),
    )

    ended_early = path.died is not None or end < part.stop - BUCKETS_PER_S
    if ended_early:
        trend = EnvelopeTrend.GROWS if path.died is None else EnvelopeTrend.DECAYS
        return growth._replace(trend=trend, ended_s=float(t_s[end - 1]))

    died_in_judged_part = len(push_rows) > 1 and last_push > (first + end) // 2
    is_too_recent = end - last_push < (end - first) // 4
    if died_in_judged_part and (fit.trend is not EnvelopeTrend.GROWS or is_too_recent):
        # The time since the last repetition is too short to show the rate. Therefore the rate
        # is that of the time before, at the end of which the effect of the push had died.
        previous_interval = slice(push_rows[-2], last_push)
        rate_per_s = _fit_trend(t_s[previous_interval], amplitude[previous_interval]).rate_per_s
        return growth._replace(trend=EnvelopeTrend.DECAYS, rate_per_s=rate_per_s)

    half_s = 0.5 * float(t_s[end - 1] - t_s[start])
    return growth._replace(factor=_exp(fit.rate_per_s * half_s))


def _judge_worst_joint(
    path: TwinPath,
    amplitude: Array,
    joints: Sequence[int],
    part: slice,
    joint_names: Sequence[str],
) -> PushGrowth:
    """Evaluates the effect of a push at all joints of a group together, or at the worst joint.

    Slow growth at one joint is invisible in the amplitude of the group while a faster joint
    still decays from a larger amplitude. Therefore each joint is also judged separately.

    Args:
        path: The twin's difference from its run.
        amplitude: Logarithm of the amplitude of the difference of all joints, shape (K,).
        joints: Indices of the joints to consider.
        part: Rows of the judged part, and of the part before it.
        joint_names: Names of all joints.
    """
    worst = _judge_push(path, amplitude, joints, part, joint_names)
    leading_joint = worst.joint
    grows_together = worst.trend is EnvelopeTrend.GROWS
    if len(joints) == 1 or worst.ended_s is not None:
        return worst
    for joint in joints:
        joint_amplitude = _measure_amplitude(path, [joint])
        unscaled_amplitude = joint_amplitude - path.scale
        # a difference of the size of the rounding errors says nothing about the push
        joint_amplitude[unscaled_amplitude < math.log(SMALLEST)] = -np.inf
        last_start = max(part.start, part.stop - BUCKETS_PER_S)
        last_second = joint_amplitude[last_start : part.stop]
        has_died = not np.isfinite(last_second).any()
        if has_died:
            continue
        growth = _judge_push(path, joint_amplitude, [joint], part, joint_names)
        stays = growth.trend in (EnvelopeTrend.STEADY, EnvelopeTrend.GROWS)
        if stays and _rank_badness(growth) > _rank_badness(worst):
            leads = grows_together or growth.joint == leading_joint
            worst = growth._replace(leads=leads)
    return worst


def _rank_badness(growth: PushGrowth) -> tuple[int, float]:
    """Returns a sort key that orders pushes from the fastest decay to the fastest growth."""
    return _TRENDS_FROM_BEST.index(growth.trend), growth.rate_per_s


def _exp(logarithm: float) -> float:
    """Returns the exponential of a number, or infinity if it would overflow."""
    return math.exp(logarithm) if not logarithm > _MOST_LOG else math.inf


def _find_departures(
    twins: Twins,
    amplitudes: Sequence[Array],
    joints: Sequence[int],
    quiet: slice,
) -> Iterator[RestDeparture]:
    """Yields the spans of time in which a run moves away from a position of rest by itself.

    Such a motion shows that the position of rest is unstable. The speed of the run and the
    differences from at least half of its pushed repetitions (twins) must grow. Windows of
    several lengths are tried, from the whole undisturbed part to a quarter of it. The second
    half of each window is judged.

    Args:
        twins: The run and its twins.
        amplitudes: Logarithm of the amplitude of each twin's difference, shape (K,) each.
        joints: Indices of the joints to consider.
        quiet: Rows in which no operator acts on the run.
    """
    t_s = twins.paths[0].t_s
    with np.errstate(divide="ignore"):
        log_speed = np.log(twins.speed[:, joints].max(axis=1))
    length = quiet.stop - quiet.start
    for divisor in (2, 4, 8):
        half = length // divisor
        if half < LEAST_LEFT_S * BUCKETS_PER_S:
            return
        # Consecutive windows overlap by three quarters.
        for start in range(quiet.start, quiet.stop - 2 * half + 1, max(1, half // 2)):
            rows = slice(start, start + 2 * half)
            run_fit = _fit_trend(t_s[rows], log_speed[rows])
            if run_fit.trend is not EnvelopeTrend.GROWS:
                continue
            if run_fit.rate_per_s * half < math.log(DOUBLES) * BUCKETS_PER_S:
                continue  # the speed does not double within the half
            twin_fits = [_fit_trend(t_s[rows], amplitude[rows]) for amplitude in amplitudes]
            growing = sum(fit.trend is EnvelopeTrend.GROWS for fit in twin_fits)
            if 2 * growing >= len(twin_fits):
                last_second = slice(rows.stop - BUCKETS_PER_S, rows.stop)
                speed = twins.speed[last_second, joints].max(axis=0)
                yield RestDeparture(
                    from_s=float(t_s[start + half]),
                    to_s=float(t_s[rows.stop - 1]),
                    rate_per_s=run_fit.rate_per_s,
                    joint=twins.joints[joints[int(speed.argmax())]],
                )


class _NonlinearPush(NamedTuple):
    """The smallest push whose effect is not proportional to its size.

    Attributes:
        size: Size of the push.
        saturates: True if the effect grows with the size, but less than proportionally.
        has_wall: True if some site has a wall, because contact with a wall makes the run
            nonlinear.
        ratio: Ratio of the effect to a proportional one at the time of the largest deviation.
        at_s: Time of the largest deviation, in s.
    """

    size: float
    saturates: bool
    has_wall: bool
    ratio: float
    at_s: float


class _LinearSizes(NamedTuple):
    """The range of sizes for which the effect of a push is proportional to its size.

    A push is a small disturbance in a repetition of the run. Its size is in rad, in rad/s or in
    the unit of a parameter estimate, depending on what is pushed.

    Attributes:
        smallest: The smallest size of the push in this range.
        largest: The largest size of the push in this range.
        unit: Unit of the sizes, with the quantity that is pushed.
        beyond: The next larger push, whose effect is not proportional. `None` if the effect of
            every push is proportional.
    """

    smallest: float
    largest: float
    unit: str
    beyond: _NonlinearPush | None


@dataclass(frozen=True, repr=False)
class PushedTwins(Result):
    """Result of `trilat twin`: how small disturbances (pushes) of a recorded run grow or decay.

    A push changes, for example, the angle of one joint at a given time in a repetition of the
    run. The repetition is called a twin. The result shows whether the difference between the
    twin and the run grows or decays.

    Attributes:
        log: The log of the run.
        at_s: Time of the pushes, in s.
        growth: Growth of the differences that the pushes cause.
        linear: Range of sizes for which the effect of a push is proportional to its size, or
            `None` if the user did not ask for several sizes.
    """

    log: Log
    at_s: float
    growth: TwinGrowth
    linear: _LinearSizes | None = None

    @classmethod
    def of_log(
        cls,
        log: Log,
        at_s: float = 0.0,
        push: Mapping[str, float] | Sequence[str] = (),
        delta: str = "",
    ) -> "PushedTwins":
        """Repeats a recorded run with small pushes at a given time.

        Args:
            log: The log.
            at_s: Time of the pushes, in s.
            push: Sizes by target, as in `{"m1.q1": 1e-6}`, or strings such as "m1.q1=1e-6".
                Each push is made in a separate repetition of the run. By default, the pushes
                are the same as for a certificate.
            delta: Range of sizes of a single push, as in "1e-9:1e-3". The run is repeated once
                per decade.

        Raises:
            UsageError: A target does not exist, or a time, size or range is not allowed.
            LogError: The log cannot be read, or its run cannot be repeated.
            CodeWithheld: The run used a control law whose code is not permitted to run.
        """
        scenario = log.scenario
        targets = list(push.items()) if isinstance(push, Mapping) else [*map(_parse_push, push)]
        end_s = max(len(log[site]) / log[site].rate_hz for site in log.sites)
        if not 0.0 <= at_s < end_s and end_s > 0.0:
            raise UsageError(
                f"--at must be from 0 s to before the end of the run, {end_s:g} s, "
                f"not {at_s:g} s"
            )
        if delta and len(targets) > 1:
            names = ", ".join(target for target, _ in targets)
            raise UsageError(
                f"--delta varies the size of a single push, but --push names {names}"
            )

        # Without options, the twins and the judged part are those of a certificate.
        is_of_certificate = not targets and not delta and at_s == 0.0
        counts_from_s = at_s
        quiet_from_s = math.inf
        sizes = []
        if delta:
            target, _ = next(iter(targets), ("q", 0.0))
            sizes = _parse_sizes(delta)
            pushes = [
                Push.parse(scenario, target, size, at_s)._replace(largest=math.inf)
                for size in sizes
            ]
        elif targets:
            pushes = [Push.parse(scenario, target, size, at_s) for target, size in targets]
        elif is_of_certificate:
            pushes = Push.choose(scenario)
            end = RunEnd.of_log(log)
            counts_from_s = end.counts_from_s
            quiet_from_s = end.quiet_from_s
        else:
            pushes = [
                default._replace(at_s=at_s, again=False) for default in Push.choose(scenario)
            ]
        twins = Twins.of_log(log, pushes, own_laws=True)
        growth = TwinGrowth.of_twins(scenario, twins, counts_from_s, quiet_from_s)
        linear = _find_linear_sizes(scenario, growth, sizes) if delta else None
        return cls(log, at_s, growth, linear)

    def measure_amplitudes(self, joints: Sequence[int]) -> list[Array]:
        """Computes the effect of each push on some joints over time, as logarithms.

        The docstring of the module defines the amplitude A of the difference between a twin and
        the run.

        Args:
            joints: Indices of the joints.

        Returns:
            log A for each twin, in the order of the pushes, shape (K,) each, with A in rad/s.
            It is -inf where the difference is zero. Empty if there are no twins.
        """
        if self.growth.twins is None:
            return []
        return [_measure_amplitude(path, joints) for path in self.growth.twins.paths]

    def describe(self, pushed: PushGrowth) -> str:
        """Returns a sentence for the user on whether the effect of a push grows or decays.

        The sentence states the push (for example its joint and size) and the rate.

        Args:
            pushed: The push and its effect.
        """
        return str(find_hook("describe a push")(self, pushed))

    def headline(self) -> str:
        """Returns a sentence for the user on how the effects of the pushes develop.

        The sentence describes the worst push, whose effect grows most or decays most slowly. If
        the user requested pushes of several sizes, it states instead for which sizes the effect
        is proportional to the size.
        """
        return str(find_hook("describe a finding")(self))

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one table row per small push, with the pushed quantity and the effect.

        Each push was made in a repetition of the run. The keys are those of an entry of
        `pushes` in `trilat twin --json`.
        """
        rows = self.growth.to_json()["pushes"]
        return [
            {**row, "text": self.describe(push)}
            for row, push in zip(rows, self.growth.pushes, strict=True)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Converts pushes and their effects to the plain values of `trilat twin --json`.

        The entry "linear" is `None` if the user did not ask for several sizes of a push.
        """
        growth = self.growth.to_json()
        text = self.headline()
        linear = None
        if self.linear is not None:
            linear = {
                "smallest": self.linear.smallest,
                "largest": self.linear.largest,
                "text": text,
            }
        return {
            "log": self.log.source,
            "at_s": self.at_s,
            "from_s": growth["from_s"],
            "to_s": growth["to_s"],
            "same_bits": growth["same_bits"],
            "pushes": self.to_rows(),
            "linear": linear,
            "text": text,
        }


def _parse_push(text: str) -> tuple[str, float]:
    """Parses the small push with which a run is repeated, such as "m1.q1=1e-6".

    The example moves joint 1 of arm m1 by 1e-6 rad.

    Args:
        text: The text that the user gave.
    """
    target, separator, size = text.partition("=")
    try:
        size_value = float(size) if separator else PUSH_RAD
    except ValueError:
        raise UsageError(
            f"the size in --push {text} must be a number, as in m1.q1=1e-6, not {size!r}"
        ) from None
    return target.strip(), size_value


def _parse_sizes(text: str) -> list[float]:
    """Parses a range of push sizes such as "1e-9:1e-3".

    A run is repeated with each size, to see whether the growth depends on the size.

    Args:
        text: The text that the user gave.
    """
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        low = high = math.nan  # refused by the comparison below
    if not LEAST_PUSH <= low < high / 9.99 <= MOST_PUSH / 9.99:
        allowed = f"from {LEAST_PUSH:g} to {MOST_PUSH:g}, a decade apart or more"
        raise UsageError(f"--delta must be two sizes {allowed}, as in 1e-9:1e-3, not {text!r}")
    decades = math.floor(math.log10(high / low) + 1e-3)
    return [float(f"{low * 10.0**n:.6g}") for n in range(decades + 1)]


def _find_linear_sizes(
    scenario: Scenario,
    growth: TwinGrowth,
    sizes: Sequence[float],
) -> _LinearSizes:
    """Finds the sizes of a push up to which its effect is proportional to its size.

    Two pushes of neighbouring sizes are compared at all times. Their effect is proportional if
    the ratio of their amplitudes differs from the ratio of their sizes by at most 10 %.

    Args:
        scenario: Scenario of the run.
        growth: Growth of the pushes, whose twins are in the order of the sizes.
        sizes: Increasing sizes of the push.
    """
    assert growth.twins is not None
    paths = growth.twins.paths
    all_joints = range(len(growth.twins.joints))
    envelopes = [_running_maximum(_measure_amplitude(path, all_joints)) for path in paths]
    unit = paths[0].push.name.partition(" ")[2]
    largest_linear = sizes[-1]
    beyond = None
    for n, (smaller, larger) in enumerate(pairwise(envelopes)):
        log_scale = np.full(len(larger), math.log(sizes[n + 1] / sizes[n]))
        # Amplitudes below this limit are dominated by rounding errors and count as
        # proportional.
        known = (smaller > math.log(10.0 * SMALLEST)) & np.isfinite(larger)
        log_ratio = np.subtract(larger, smaller, out=log_scale.copy(), where=known)
        deviation = log_ratio - log_scale
        row = int(np.abs(deviation).argmax())
        if abs(deviation[row]) > SAME_SCALED:
            largest_linear = sizes[n]
            grows = any(
                push.trend is EnvelopeTrend.GROWS and push.push is paths[n].push
                for push in growth.pushes
            )
            beyond = _NonlinearPush(
                size=sizes[n + 1],
                saturates=grows and bool(deviation[row] < 0.0),
                has_wall=_has_wall(scenario),
                ratio=_exp(float(deviation[row])),
                at_s=float(paths[0].t_s[row]),
            )
            break
    return _LinearSizes(sizes[0], largest_linear, unit, beyond)


def _has_wall(scenario: Scenario) -> bool:
    """Returns True if some site has a wall, because contact makes the run nonlinear."""
    return any(VirtualWall.list_of_site(scenario, site) for site in scenario.names)
