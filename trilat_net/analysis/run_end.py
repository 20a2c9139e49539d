"""The judgement of a run: stable, not stable, or open, and what it rests on.

Invariant: every command takes its word from here (docs/definitions.md, "Stable"). Each joint of
each site is judged by itself, and the worst decides; a word states what the record shows and
predicts nothing. What else is known of a whole log (V, the roots at its end pose) may make a
stable run open, never the reverse.

The judged part is the second half of the run, or what follows the last act of an operator and
the last change of the loop if that is less and long enough. Trends of |e| and |qd| over it are
those of `envelope_trend`. A sustained oscillation of any size is steady; a joint that is steady
while a faster one of the coupled sites falls may live on that (modes that decay beat), and is
undecided.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.dominance import find_reach
from ..core.exogenous import LIVE_KINDS, OWN_KINDS, TorqueKind
from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from ..scenario import Scenario
from .arm_rows import HANGING_RAD, build_arm_rows
from .envelope_trend import FLOOR_RAD, EnvelopeFit, EnvelopeTrend, fit_envelopes
from .site_signals import SETTLED_ERROR_RAD
from .torque_sources import compute_operator_script

SETTLED_SPEED_RAD_S = 1e-2
"""The largest speed of the last second of a converged run, rad/s: the arms have come to rest.
"""

STATIC_SPEED_RAD_S = 2e-3
"""The largest speed in a static window of a log, rad/s: the torques on an arm balance each
other.
"""

EQUILIBRIUM_SPEED_RAD_S = 1e-5
"""The largest speed of the last second of a run whose end is an equilibrium, rad/s: the loop
can be linearised there.
"""

AGREEMENT_RAD = 2e-2
"""Sites whose angles of a joint differ by more do not agree, rad."""

THROWN_RAD = 0.5 * math.pi
"""Arms that nobody pushed and that end further from every start pose were thrown there, rad."""

DRIFT_RAD = 0.05
"""A joint that goes by more in one direction over the judged half may drift, rad; for one that
is as slow as at rest, `SETTLED_ERROR_RAD` leaves that undecided.
"""

FORCE_NM = 1e-3
"""A larger torque of an operator or environment at the end may hold sites apart, N m, and"""
HELD_SHARE = 0.02
"""an error of so much of their distance says that it does: what is pulled at has one."""

LEAST_JUDGED_S = 2.0
"""What follows the last act of an operator or change of the loop is judged by itself if it
lasts so long, s, and
"""
LEAST_JUDGED_SHARE = 0.1
"""this share of the run; else the second half is, with the act or the change in it."""

MIN_SIGN_CHANGES = 6
"""Fewer changes of sign in the second half of a run show no period."""


class Stability(StrEnum):
    """The one judgement of a run; the text is the word for people."""

    STABLE = "stable"
    NOT_STABLE = "not stable"
    OPEN = "open"


class EndBehaviour(StrEnum):
    """Behaviour of a run at its end, from the best to the worst; the text is the word for
    people.
    """

    CONVERGED = "converged"
    DECAYS = "decaying"
    HARDLY = "hardly decaying"
    UNDECIDED = "undecided (record longer)"
    COASTS = "coasting, as nobody holds the arm, and it follows nobody or what coasts too"
    BOUNDED = "bounded oscillation"
    DRIFTS = "drifting"
    GROWS = "growing"
    DIVERGED = "diverged"

    @property
    def stability(self) -> Stability:
        """The judgement of a run of which nothing else is known."""
        if self in (EndBehaviour.CONVERGED, EndBehaviour.DECAYS):
            return Stability.STABLE
        undecided = self in (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED, EndBehaviour.COASTS)
        return Stability.OPEN if undecided else Stability.NOT_STABLE


_MOVES_ON = (EndBehaviour.BOUNDED, EndBehaviour.HARDLY, EndBehaviour.UNDECIDED)


class RunEnd(NamedTuple):
    """End of a run, of all of its sites or of some.

    Attributes:
        behaviour: the class of the worst joint.
        error, speed: trends of that joint's |e| and |qd|.
        end_error_rad, end_speed_rad_s: largest |e| and |qd| of the last second, of all joints.
        where: that joint, in words; "" if there is none.
        reasons: what leaves the run open, in words.
        operator_acts: True if an operator acts in the judged part, and not only holds.
        diverged_at_s: when the first site left its limits, or None.
        frequency_hz: frequency of a bounded oscillation; None without one.
        missing_sites: sites without any record, which leave the run undecided.
        error_unit: of |e|: that of angles, or of places in task space.
        counts_from_s: since when the run counts; the second half from there on is judged, s.
        quiet_from_s: since when nobody acts on it, and its loop does not change, s.
    """

    behaviour: EndBehaviour
    error: EnvelopeFit
    speed: EnvelopeFit
    end_error_rad: float
    end_speed_rad_s: float
    where: str = ""
    reasons: tuple[str, ...] = ()
    operator_acts: bool = False
    diverged_at_s: float | None = None
    frequency_hz: float | None = None
    missing_sites: tuple[str, ...] = ()
    error_unit: str = "rad"
    counts_from_s: float = 0.0
    quiet_from_s: float = 0.0

    @property
    def stability(self) -> Stability:
        """The judgement; what may be an operator's doing is open, unless a site left its
        limits.
        """
        own = self.behaviour.stability
        if own is Stability.NOT_STABLE:
            excused = self.operator_acts and self.behaviour is not EndBehaviour.DIVERGED
            return Stability.OPEN if excused else own
        return Stability.OPEN if self.reasons else own

    @property
    def text(self) -> str:
        """The class with its numbers and reasons; part of the certificate's JSON."""
        return "; ".join([self._behaviour_text, *self.reasons])

    @property
    def _behaviour_text(self) -> str:
        behaviour = self.behaviour
        error = self.error
        speed = self.speed
        error_text = f"|e| {self.end_error_rad:.3g} {self.error_unit}"
        end = f"{error_text} and |qd| {self.end_speed_rad_s:.3g} rad/s in the last second"
        if self.diverged_at_s is not None:
            return f"diverged at {self.diverged_at_s:.4g} s: a joint passed its qd_limit_rad_s"
        if self.missing_sites:
            return f"undecided: no record of {', '.join(self.missing_sites)}"
        if behaviour is EndBehaviour.CONVERGED:
            apart = self.end_error_rad > SETTLED_ERROR_RAD
            return f"{'at rest, with errors that stay' if apart else 'converged'}: {end}"
        at = f" at {self.where}" if self.where else ""
        if behaviour is EndBehaviour.BOUNDED:
            hertz = self.frequency_hz
            word = (
                "bounded motion" if hertz is None else f"bounded oscillation at {hertz:.3g} Hz"
            )
            return f"{word}{at}: {end}"
        if behaviour is EndBehaviour.UNDECIDED:
            return f"undecided, record longer{at}: |e| {error.text}, |qd| {speed.text}; {end}"
        return f"{behaviour.value}{at} (|e| {error.rate_text}, |qd| {speed.rate_text}): {end}"


class RunTrace(NamedTuple):
    """What the judgement of a run rests on, per site in scenario order.

    Attributes:
        buckets: of every `BUCKETS_PER_S`-th of a second since the epoch the largest |e| and
            |qd| and the last q of every joint, shape (K, 3 n); -1 if it has no record. There
            may be columns for more joints than the site has. A site's last bucket may be
            incomplete: it enters no trend.
        tau_x: the torque of operator and environment at its last record, shape (n,), N m.
        diverged_at_s: when the first site left its limits, or None.
        pushed_until_s: when an operator whom the scenario does not know last pushed, s; 0 for
            never.
        changed_until_s: when a command last changed the loop, s; 0 for never.
    """

    buckets: Sequence[Array]
    tau_x: Sequence[Array]
    diverged_at_s: float | None = None
    pushed_until_s: float = 0.0
    changed_until_s: float = 0.0


NO_BUCKETS = np.zeros((0, 3))
"""The buckets of a site without records."""


def reduce_to_buckets(bucket: Ints, e: Array, qd: Array, q: Array, into: Array) -> Array:
    """Returns buckets with some more records of a site, which follow those in it; there may be
    spare rows.

    In task space e has as many columns as the task; the fewer of e and q are filled up with
    zeros.
    """
    if not len(bucket):
        return into
    joints = max(q.shape[1], e.shape[1])
    e, qd, q = (np.pad(one, ((0, 0), (0, joints - one.shape[1]))) for one in (e, qd, q))
    if not len(into):
        into = np.zeros((0, 3 * joints))
    lacking = int(bucket[-1]) + 1 - len(into)
    if lacking > 0:  # by half as much again: a long run is not copied for every batch
        into = np.vstack([into, np.full((lacking + len(into) // 2, 3 * joints), -1.0)])
    starts = np.flatnonzero(np.diff(bucket, prepend=-1))
    rows = bucket[starts]
    peaks = np.maximum.reduceat(np.abs(np.hstack([e, qd])), starts, axis=0)
    into[rows, : 2 * joints] = np.maximum(into[rows, : 2 * joints], peaks)
    into[rows, 2 * joints :] = q[np.append(starts[1:], len(q)) - 1]
    return into


def trace_log(log: Log) -> RunTrace:
    """Returns what the judgement of a log rests on."""
    parts = [log[site] for site in log.sites]
    recorded = [part for part in parts if len(part)]
    outside = [part for part in recorded if part.name in log.scenario.external]
    pushed = [(part.t_s, part.tau_x.any(axis=1)) for part in outside]
    pushed += [(part.t_s, part.hand[:, 0] > 0.0) for part in recorded if part.layout.hand]
    return RunTrace(
        buckets=[
            reduce_to_buckets(
                bucket=part.tick * BUCKETS_PER_S // part.rate_hz,
                e=part.e,
                qd=part.qd,
                q=part.q,
                into=NO_BUCKETS,
            )
            for part in parts
        ],
        tau_x=[part.tau_x[-1] if len(part) else np.zeros(1) for part in parts],
        diverged_at_s=log.diverged_s,
        pushed_until_s=max(
            (float(t_s[rows].max(initial=0.0)) for t_s, rows in pushed), default=0.0
        ),
        changed_until_s=max(
            (tick / log[site].rate_hz for site in log.sites for tick in log.changes(site)),
            default=0.0,
        ),
    )


def classify_log_end(log: Log) -> RunEnd:
    """Returns the end of a log's run; torn and empty logs are undecided."""
    end = classify_run_end(log.scenario, trace_log(log))
    bounded = end.behaviour is EndBehaviour.BOUNDED
    return end._replace(
        frequency_hz=_frequency_hz([log[site] for site in log.sites]) if bounded else None
    )


def classify_run_end(scenario: Scenario, trace: RunTrace) -> RunEnd:
    """Returns the end of a run from its trace."""
    joints = [max(arm.counts.joints, arm.counts.shared) for arm in scenario.arms.values()]
    sites = [  # by kind and joint, shape (K, 3, n): |e|, |qd| and q
        site.reshape(len(site), 3, -1)[:, :, :n] if len(site) else np.zeros((0, 3, n))
        for n, site in zip(joints, trace.buckets, strict=True)
    ]
    count = max(min(map(len, sites)) - 1, 0)
    kept = np.flatnonzero(np.all([site[:count, 0, 0] >= 0.0 for site in sites], axis=0))
    span_s = count / BUCKETS_PER_S
    t_s = kept / BUCKETS_PER_S
    acted_s = max(trace.pushed_until_s, find_last_operator_action(scenario, span_s))
    changed_s = max(trace.changed_until_s, find_last_change(scenario, span_s))
    first, late = _choose_judged_part(t_s, max(acted_s, changed_s))
    acts = late and _choose_judged_part(t_s, acted_s)[1]
    t_s = t_s[first:]
    columns = [site[kept[first:]] for site in sites]
    missing = tuple(
        name for name, site in zip(scenario.names, sites, strict=True) if not len(site)
    )
    end = _find_worst_joint(scenario, t_s, columns, sites)
    counts_from_s = float(t_s[0]) if len(t_s) else 0.0
    quiet_from_s = max(acted_s, changed_s)
    end = end._replace(
        missing_sites=missing, counts_from_s=counts_from_s, quiet_from_s=quiet_from_s
    )
    if scenario.sites[scenario.names[0]].task.space == "position":
        end = end._replace(error_unit="m")
    if trace.diverged_at_s is not None:
        return end._replace(behaviour=EndBehaviour.DIVERGED, diverged_at_s=trace.diverged_at_s)
    if end.behaviour.stability is Stability.STABLE:
        reasons = (
            *_find_disagreement(scenario, trace, t_s, columns),
            *_find_odd_pose(scenario, sites),
        )
        if late and not acts:
            reasons += (f"the loop changes until {changed_s:.4g} s, within the judged part",)
        return end._replace(reasons=reasons)
    why = f"an operator acts until {acted_s:.4g} s, within the judged part"
    return end._replace(operator_acts=True, reasons=(why,)) if acts else end


def _choose_judged_part(t_s: Array, acted_s: float) -> tuple[int, bool]:
    """Returns from which time on a run counts, of which the second half is judged, and if an
    operator acts.

    An operator that acts in the second half and then lets go for long enough shortens the
    judged part.
    """
    if not len(t_s) or acted_s <= 0.5 * (t_s[0] + t_s[-1]):
        return 0, False
    if t_s[-1] - acted_s < max(LEAST_JUDGED_S, LEAST_JUDGED_SHARE * (t_s[-1] - t_s[0])):
        return 0, True
    return int(np.searchsorted(t_s, 2.0 * acted_s - t_s[-1])), False


def _find_worst_joint(
    scenario: Scenario, t_s: Array, columns: Sequence[Array], sites: Sequence[Array]
) -> RunEnd:
    """Returns the end of the joint of the worst class, the fastest of those; the maxima are of
    all.
    """
    signals = [site[:, kind] for site in columns for kind in (0, 1)]
    fits = iter(fit_envelopes(t_s, np.hstack(signals)))
    joints = []
    for name, judged, site in zip(scenario.names, columns, sites, strict=True):
        ends = site[-BUCKETS_PER_S:, :2].max(axis=0, initial=0.0).tolist()
        trends = [[next(fits) for _ in kind] for kind in ends]
        for joint, (end_error, end_speed) in enumerate(zip(*ends, strict=True)):
            error, speed = (kind[joint] for kind in trends)
            # too slow for a trend
            still = speed.trend is EnvelopeTrend.DECAYS or end_speed <= FLOOR_RAD
            settles = speed.trend is EnvelopeTrend.HARDLY or bool(scenario.external)
            rests = end_speed <= SETTLED_SPEED_RAD_S and (still or (speed.calm and settles))
            behaviour = _classify_joint(
                error, speed, end_error, end_speed, still=still, rests=rests
            )
            behaviour = _name_motion(
                behaviour, judged[:, 2, joint], judged[:, 1, joint], t_s, still=still
            )
            where = f"{name} joint {joint + 1}" if len(t_s) else ""
            joints.append(
                RunEnd(
                    behaviour=behaviour,
                    error=error,
                    speed=speed,
                    end_error_rad=end_error,
                    end_speed_rad_s=end_speed,
                    where=where,
                )
            )
    end_s = float(t_s[-1]) if len(t_s) else 0.0
    owners = np.repeat(np.arange(len(sites)), [site.shape[2] for site in sites])
    for group in find_coupled_sites(scenario):
        for n in _find_fed_joints(joints, owners, group):
            joints[n] = joints[n]._replace(behaviour=EndBehaviour.UNDECIDED)
        for n in _find_coasting_joints(
            scenario=scenario, joints=joints, owners=owners, group=group, end_s=end_s
        ):
            joints[n] = joints[n]._replace(behaviour=EndBehaviour.COASTS)
    worst = max(
        joints, key=lambda one: (list(EndBehaviour).index(one.behaviour), one.end_speed_rad_s)
    )
    return worst._replace(
        end_error_rad=max(one.end_error_rad for one in joints),
        end_speed_rad_s=max(one.end_speed_rad_s for one in joints),
    )


def _find_fed_joints(joints: Sequence[RunEnd], owners: Ints, group: Sequence[int]) -> list[int]:
    """Returns the bounded joints of coupled sites of which a faster joint falls: they may live
    on that.

    Modes that decay at several frequencies beat, and hand their energy on: some joint is steady
    for a while.
    """
    own = np.flatnonzero(np.isin(owners, group)).tolist()
    falling = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)
    fastest = max(
        (joints[n].end_speed_rad_s for n in own if joints[n].speed.trend in falling),
        default=0.0,
    )
    bounded = [n for n in own if joints[n].behaviour is EndBehaviour.BOUNDED]
    return [n for n in bounded if joints[n].end_speed_rad_s < fastest]


def _find_coasting_joints(
    scenario: Scenario,
    joints: Sequence[RunEnd],
    owners: Ints,
    group: Sequence[int],
    end_s: float,
) -> list[int]:
    """Returns the drifting joints of coupled sites that nothing brakes.

    That is so if the law of a site that nobody holds or resists at the end has no spring to a
    peer, and the others follow it; or if that is so of all sites, and their laws take energy
    from the links alone.
    """
    specs = [scenario.sites[scenario.names[site]] for site in group]
    alone = [
        spec.control
        for spec in specs
        if not any(
            one.actor.start_s <= end_s < one.actor.end_s
            for one in (*spec.hands, *spec.environment)
        )
    ]
    brakeless = [law for law in alone if law.books_energy and not any(getattr(law, "d", ()))]
    free = len(brakeless) == len(specs) or not all(
        any(getattr(law, "K", (1.0,))) for law in alone
    )
    own = np.flatnonzero(np.isin(owners, group)).tolist() if free else []
    return [
        n
        for n in own
        if joints[n].behaviour is EndBehaviour.DRIFTS
        and joints[n].speed.trend is not EnvelopeTrend.GROWS
    ]


def _classify_joint(
    error: EnvelopeFit,
    speed: EnvelopeFit,
    end_error_rad: float,
    end_speed_rad_s: float,
    *,
    still: bool,
    rests: bool,
) -> EndBehaviour:
    """Returns the class that the trends of a joint's |e| and |qd| have together.

    Errors that grow while the joint gets no faster may start a drift, or follow from what an
    operator has just done: undecided. The reverse is growth: arms that swing in unison have no
    error. A joint is `still` if its speed decays, and `rests` if it is slow and falls, however
    little; what goes on at a small speed may go on for ever, or grow. That of arms outside of
    the program need not fall.
    """
    if speed.trend is EnvelopeTrend.GROWS:
        return EndBehaviour.GROWS
    if error.trend is EnvelopeTrend.GROWS:
        return EndBehaviour.UNDECIDED
    if not rests and not still:
        # it hardly moves, and its trend says nothing
        if end_speed_rad_s <= SETTLED_SPEED_RAD_S:
            return EndBehaviour.UNDECIDED
        goes_on = {
            EnvelopeTrend.HARDLY: EndBehaviour.HARDLY,
            EnvelopeTrend.STEADY: EndBehaviour.BOUNDED,
        }
        return goes_on.get(speed.trend, EndBehaviour.UNDECIDED)
    if error.calm and (
        end_error_rad <= SETTLED_ERROR_RAD or error.trend is EnvelopeTrend.STEADY
    ):
        return EndBehaviour.CONVERGED if rests else EndBehaviour.DECAYS
    if error.trend is EnvelopeTrend.DECAYS:
        near = rests and end_error_rad <= SETTLED_ERROR_RAD
        return EndBehaviour.CONVERGED if near else EndBehaviour.DECAYS
    return (
        EndBehaviour.HARDLY if error.trend is EnvelopeTrend.HARDLY else EndBehaviour.UNDECIDED
    )


def _name_motion(
    behaviour: EndBehaviour, q: Array, fastest: Array, t_s: Array, *, still: bool
) -> EndBehaviour:
    """Returns the class of a joint, and of one that moves on by where it goes in the judged
    half.

    It drifts if every quarter takes half of its share or more in one way, and its mean speed is
    at least half of the largest: what swings on its way is no drift. A bounded oscillation
    changes its sign. What is as slow as at rest, and goes one way, is undecided before that.
    """
    moves = behaviour in _MOVES_ON or (behaviour is EndBehaviour.CONVERGED and not still)
    if not moves or len(t_s) < BUCKETS_PER_S:
        return behaviour
    first = int(np.searchsorted(t_s, 0.5 * (t_s[0] + t_s[-1])))
    marks = np.linspace(first, len(t_s) - 1, 5).round().astype(int)
    way = np.diff(q[marks])
    total = abs(float(way.sum()))
    steady = float((way * np.sign(way.sum())).min()) >= 0.125 * total
    if steady and total >= 0.5 * (t_s[-1] - t_s[first]) * fastest[first:].max():
        if total >= DRIFT_RAD:
            return EndBehaviour.DRIFTS
        if total >= SETTLED_ERROR_RAD and behaviour is EndBehaviour.CONVERGED:
            return EndBehaviour.UNDECIDED
    swings = (
        behaviour is not EndBehaviour.BOUNDED
        or _count_sign_changes(q[first:]) >= MIN_SIGN_CHANGES
    )
    return behaviour if swings else EndBehaviour.UNDECIDED


def _count_sign_changes(values: Array) -> int:
    signs = np.sign(values - values.mean())
    return int(np.count_nonzero(np.diff(signs[signs != 0.0])))


def find_coupled_sites(scenario: Scenario) -> list[list[int]]:
    """Returns the groups of sites that shares connect, at any time and in either direction."""
    joined = scenario.alpha.copy()
    for change in scenario.timeline:
        for peer, share in (change.to if change.dominance else {}).items():
            joined[scenario.names.index(change.dominance), scenario.names.index(peer)] += share
    reach = find_reach(joined + joined.T)
    return [
        list(map(int, rows))
        for rows in {tuple(np.flatnonzero(row).tolist()): None for row in reach}
    ]


def _find_disagreement(
    scenario: Scenario, trace: RunTrace, t_s: Array, columns: Sequence[Array]
) -> Iterable[str]:
    for group in find_coupled_sites(scenario):
        names = [scenario.names[n] for n in group]
        places = any(scenario.sites[name].control.compares_positions for name in names)
        if len(group) < 2 or places or any(scenario.arms[name].shares_pose for name in names):
            continue  # e says if they agree
        q = np.array([columns[n][:, 2] for n in group])
        apart = np.ptp(q, axis=0)
        joint = int(apart[-1].argmax())
        nearer = (
            fit_envelopes(t_s, apart.max(axis=1, keepdims=True))[0].trend
            is EnvelopeTrend.DECAYS
        )
        pulled = max(np.abs(trace.tau_x[n]).max() for n in group) > FORCE_NM
        held = (
            pulled
            and max(columns[n][-1, 0].max() for n in group) > HELD_SHARE * apart[-1, joint]
        )
        at = q[_find_held_sites(scenario, trace, joint, float(t_s[-1]))[group], -1, joint]
        held |= len(at) > 0 and apart[-1, joint] - np.ptp(at) < AGREEMENT_RAD
        if apart[-1, joint] > AGREEMENT_RAD and not (nearer or held):
            ends = [
                scenario.names[group[int(pick(q[:, -1, joint]))]]
                for pick in (np.argmin, np.argmax)
            ]
            yield f"{' and '.join(ends)} stand {apart[-1, joint]:.3g} rad apart, and nothing holds them there"


def _find_held_sites(
    scenario: Scenario, trace: RunTrace, joint: int, end_s: float
) -> NDArray[np.bool_]:
    """Returns at which sites a joint is held at the end, by the stiffness of a hand, or of what
    is touched.

    A hand at the place that it wants needs no torque, and holds all the same. An own kind is
    taken to hold.
    """
    held = np.zeros(len(scenario.names), dtype=np.bool_)
    for n, (spec, tau_x) in enumerate(zip(scenario.sites.values(), trace.tau_x, strict=True)):
        touched = spec.environment if np.abs(tau_x).max() > FORCE_NM else ()
        for actor in (one.actor for one in (*spec.hands, *touched)):
            stiffness = actor.K[joint : joint + 1] if actor.kind == TorqueKind.HAND else actor.K
            stiff = any(stiffness) or actor.kind in OWN_KINDS
            held[n] |= actor.start_s <= end_s < actor.end_s and stiff
    return held


def _find_odd_pose(scenario: Scenario, sites: Sequence[Array]) -> Iterable[str]:
    starts = [np.array(spec.q0_rad) for spec in scenario.sites.values()]
    ends = [site[-1, 2, : len(start)] for site, start in zip(sites, starts, strict=True)]
    hanging = find_hanging_sites(scenario, dict(zip(scenario.names, ends, strict=True)))
    away = []  # of each site the joint that is furthest from where any start pose of such an arm has it
    for end in ends:
        alike = np.array([q for q in starts if len(q) == len(end)])
        away.append(float(np.maximum(alike.min(axis=0) - end, end - alike.max(axis=0)).max()))
    n = int(np.argmax(away))
    if hanging:
        yield f"{', '.join(hanging)} {'hangs' if len(hanging) == 1 else 'hang'}: the arms fell"
    elif away[n] > THROWN_RAD and not (
        scenario.external or any(s.hands for s in scenario.sites.values())
    ):
        yield f"{scenario.names[n]} ends {away[n]:.3g} rad away from every start pose, and nobody pushed"


def find_hanging_sites(scenario: Scenario, ends: Mapping[str, Array]) -> list[str]:
    """Returns the sites, of those whose last angles are given, whose arms hang and did not at
    the start.
    """
    arms = {name: build_arm_rows(scenario, name) for name in ends}
    starts = {name: np.array(scenario.sites[name].q0_rad) for name in ends}
    return [
        name
        for name, q in ends.items()
        if arms[name].hanging_angle(q) < HANGING_RAD <= arms[name].hanging_angle(starts[name])
    ]


def find_last_operator_action(scenario: Scenario, span_s: float) -> float:
    """Returns when an operator last changed what it does before the end of a run, s; 0 if none
    ever did.
    """
    t_s = np.arange(0.0, span_s, 1.0 / BUCKETS_PER_S)
    last_s = 0.0
    for name, spec in scenario.sites.items():
        start = np.array([spec.q0_rad])
        J = build_arm_rows(scenario, name).place_end_effector(start, 0.0 * start).J[0]
        for source in (one.actor for one in spec.hands if one.actor.kind not in LIVE_KINDS):
            script = compute_operator_script(
                source, t_s, np.eye(len(source.a)) if source.a else J
            )
            changed = np.abs(np.diff(script, axis=0)).max(axis=1, initial=0.0) > 0.0
            edges = [at_s for at_s in (source.start_s, source.end_s) if at_s < span_s]
            last_s = max(last_s, *edges, float(t_s[1:][changed].max(initial=0.0)))
    return last_s


def find_last_change(scenario: Scenario, span_s: float) -> float:
    """Returns when the loop last changed before the end of a run, s: by its timeline or an
    environment.
    """
    ends_s = [
        change.at_s + change.ramp_s for change in scenario.timeline if change.at_s < span_s
    ]
    for spec in scenario.sites.values():
        edges = (
            at_s for one in spec.environment for at_s in (one.actor.start_s, one.actor.end_s)
        )
        ends_s += [at_s for at_s in edges if at_s < span_s]
    return max([0.0, *ends_s])


def _frequency_hz(parts: list[SiteLog]) -> float | None:
    """Returns the frequency of the fastest joint in the second half, by its changes of sign, or
    None.
    """
    halves = [(part, part.qd[len(part) // 2 :]) for part in parts]
    part, half = max(halves, key=lambda pair: float(np.abs(pair[1]).max()))
    column = half[:, int(np.abs(half).max(axis=0).argmax())]
    crossings = _count_sign_changes(column)
    span_s = float(part.tick[-1] - part.tick[len(part) // 2]) / part.rate_hz
    return None if crossings < MIN_SIGN_CHANGES else 0.5 * crossings / span_s
