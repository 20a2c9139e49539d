"""Judges from the motion at the end of a run whether it is settled, not stable, or open.

The verdict is based on the error e of each site (the difference between its motion and its
reference) and on the joint velocities qd, not on any theory. The largest |e| and |qd| of each
joint in intervals of 50 ms are called envelopes. Their trends over the second half of the run,
which `envelope_trend` determines, show whether the joint converges, decays, oscillates, drifts
or grows. If the record does not show which, the joint is undecided, and the verdict is open.

If an operator acts or the control loop changes within the second half, only the time after the
last action or change is judged, provided that it is long enough.

A lasting oscillation makes a run not stable, with one exception: a joint may oscillate steadily
for a while because it receives energy from a faster joint. If the faster joint decays, the
joint is undecided.

Invariant:
    - All commands use the verdict of this module (docs/reference/stability.md).
    - Each joint of each site is judged separately, and the worst joint determines the verdict.
    - A verdict describes the record and predicts nothing.
    - Further knowledge, such as the energy function V of the stability proof or the
      characteristic roots, may turn a stable run into an open run, but never the reverse.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import BUCKETS_PER_S, LIVE_KINDS, OWN_KINDS, Array, DominanceMatrix, TorqueKind
from ..execution import FusedRun
from ..hooks import find_hook
from ..log import Ints, Log, SiteLog
from ..scenario import Scenario
from .arm_rows import HANGING_RAD, build_arm_rows
from .site_signals import SETTLED_ERROR_RAD, JointError
from .timeline import Timeline
from .torque_sources import SourceRows
from .twins.envelope_trend import FLOOR_RAD, EnvelopeFit, EnvelopeTrend

SETTLED_SPEED_RAD_S = 1e-2
"""Largest speed in the last second at which the arms of a run count as resting, in rad/s."""

STATIC_SPEED_RAD_S = 2e-3
"""Largest speed of an arm at which its torques count as balanced, in rad/s."""

EQUILIBRIUM_SPEED_RAD_S = 1e-5
"""Largest speed in the last second of a run that ends in an equilibrium, in rad/s.

The loop can be linearised at such an end.
"""

AGREEMENT_RAD = 2e-2
"""Largest difference between the angles of a joint at which sites count as agreeing, in rad."""

THROWN_RAD = 0.5 * math.pi
"""Largest distance from all start poses at which an arm may end without an operator, in rad.

An arm that ends further away was thrown by its controller.
"""

DRIFT_RAD = 0.05
"""Least motion in one direction over the judged half that counts as a drift, in rad.

A joint that is slow enough to be at rest, but moves by more than `SETTLED_ERROR_RAD`, is
undecided.
"""

FORCE_NM = 1e-3
"""Smallest torque of an operator or environment at the end that may hold sites apart, in N m.
"""
HELD_SHARE = 0.02
"""Smallest error of sites that are held apart by a torque, as a share of their distance."""

LEAST_JUDGED_S = 2.0
"""Shortest time after the last action or change that is judged by itself, in s."""
LEAST_JUDGED_SHARE = 0.1
"""Shortest time after the last action or change that is judged by itself, as a share of the
run.

If the time is shorter, the second half is judged, although it contains the action or change.
"""

MIN_SIGN_CHANGES = 6
"""Smallest number of sign changes in the second half of a run that shows an oscillation."""


class Stability(StrEnum):
    """The four verdicts on a run. The value of each member is the word that users read.

    STABLE requires a proof, and a run that does not contradict the proof. SETTLED means that
    the motion became slow or decays, without a proof. OPEN means that the findings are
    inconclusive.
    """

    STABLE = "stable"
    SETTLED = "settled"
    NOT_STABLE = "not stable"
    OPEN = "open"


class EndBehaviour(StrEnum):
    """How the arms move at the end of a run, from the best to the worst behaviour.

    The order matters, because the worst joint determines the verdict on the run. `stability`
    maps the behaviour to a verdict. The value of each member is a phrase for the user.
    """

    CONVERGED = "converged"
    DECAYS = "decaying"
    HARDLY = "hardly decaying"
    UNDECIDED = "undecided (record longer)"
    COASTS = "coasting, because neither an operator nor a followed arm holds the arm"
    BOUNDED = "bounded oscillation"
    DRIFTS = "drifting"
    GROWS = "growing"
    DIVERGED = "diverged"

    @property
    def stability(self) -> Stability:
        """The verdict suggested by the final motion alone.

        Arms at rest or with decaying motion give SETTLED, motion without a clear trend gives
        OPEN, and oscillating, drifting or growing motion gives NOT_STABLE. `stability_decision`
        may change the verdict because of other evidence, such as proofs.
        """
        if self in (EndBehaviour.CONVERGED, EndBehaviour.DECAYS):
            return Stability.SETTLED
        if self in (EndBehaviour.HARDLY, EndBehaviour.UNDECIDED, EndBehaviour.COASTS):
            return Stability.OPEN
        return Stability.NOT_STABLE


_MAY_DRIFT = (EndBehaviour.BOUNDED, EndBehaviour.HARDLY, EndBehaviour.UNDECIDED)
_FALLING = (EnvelopeTrend.DECAYS, EnvelopeTrend.HARDLY)


class EndDoubt(NamedTuple):
    """Finding that leaves open whether a run is stable.

    Attributes:
        name: Name of the finding. "sites apart": coupled sites do not agree, although nothing
            holds them apart. "arms fell": arms hang down at the end, but did not at the start.
            "arm thrown": an arm ends far away from every start pose, although no operator
            pushed it. "loop changes": the control loop changes within the judged part.
            "operator acts": an operator changes its action within the judged part.
        sites: Names of the affected sites. For "sites apart", the sites with the smallest and
            the largest angle.
        distance_rad: Distance between the sites that are apart, or distance of the thrown arm
            from the start poses, in rad.
        until_s: Time of the last change or action, in s.
    """

    name: Literal["sites apart", "arms fell", "arm thrown", "loop changes", "operator acts"]
    sites: tuple[str, ...] = ()
    distance_rad: float = 0.0
    until_s: float = 0.0


class RunEnd(NamedTuple):
    """How the motion of a run ends, such as at rest or growing, with the data that show it.

    The behaviour is determined by the trends of the tracking error e and of the joint velocity
    qd over the last part of the run. The object describes all arms of the run, or a single
    joint while the joints are compared.

    Attributes:
        behaviour: Behaviour of the worst joint, such as settled or growing.
        error: Trend of that joint's |e|.
        speed: Trend of that joint's |qd|.
        end_error_rad: Largest |e| of all joints in the last second, in the unit `error_unit`.
        end_speed_rad_s: Largest |qd| of all joints in the last second, in rad/s.
        end_error_where: Name of the joint, or of the axis of the end effector, with this |e|.
            Empty if the joint is not known.
        end_speed_where: Name of the joint with this |qd|. Empty if the joint is not known.
        where: Name of the worst joint. Empty if there are no records.
        doubts: Findings that leave the stability of the run open. Empty if there are none.
        operator_acts: True if an operator changes its action in the judged part, instead of
            only holding an arm.
        diverged_at_s: When the first site exceeded its limits, in s, or `None` if no site did.
        divergence: Phrase that names the joint that exceeded its limit, and the time. Empty if
            no log contains this information.
        frequency_hz: Frequency of a bounded oscillation, in Hz, or `None` if there is none.
        missing_sites: Sites without any record, which leave the run undecided.
        error_unit: Unit of |e|: "rad", or "m" if the sites follow positions in task space.
        counts_from_s: Only the run after this time is considered, in s. The judged part is the
            second half of the time after it.
        quiet_from_s: Time from which no operator acts and the control loop does not change, in
            s.
        lasts_s: Length of the record, in s.
    """

    behaviour: EndBehaviour
    error: EnvelopeFit
    speed: EnvelopeFit
    end_error_rad: float
    end_speed_rad_s: float
    where: str = ""
    doubts: tuple[EndDoubt, ...] = ()
    operator_acts: bool = False
    diverged_at_s: float | None = None
    divergence: str = ""
    frequency_hz: float | None = None
    missing_sites: tuple[str, ...] = ()
    error_unit: str = "rad"
    counts_from_s: float = 0.0
    quiet_from_s: float = 0.0
    end_error_where: str = ""
    end_speed_where: str = ""
    lasts_s: float = 0.0

    @property
    def stability(self) -> Stability:
        """The verdict on the run from its end: settled, not stable, or open.

        A run that appears to have settled is open if there are `doubts`. A run that appears
        unstable is open if an operator acts, because the operator may have caused the motion.
        If the motion exceeded the limits of an arm, the run is not stable in any case.
        """
        stability = self.behaviour.stability
        if stability is not Stability.NOT_STABLE:
            return Stability.OPEN if self.doubts else stability
        has_diverged = self.behaviour is EndBehaviour.DIVERGED
        if self.operator_acts and not has_diverged:
            return Stability.OPEN
        return stability

    @property
    def text(self) -> str:
        """A sentence for the user on how the motion ends, with the values that show it.

        The sentence also states the reasons why the run cannot be called stable. The package
        `presentation` generates it.
        """
        return str(find_hook("describe a finding")(self))

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences on why the stability of the run remains open, one per doubt.

        Empty if there are no doubts. The package `presentation` generates the sentences.
        """
        return tuple(find_hook("list the sentences of a finding")(self))

    @classmethod
    def of_log(cls, log: Log) -> "RunEnd":
        """Judges from a log whether the motion of the arms decayed at the end of the run.

        A truncated log is judged by the records that it contains. If the log is empty, the
        behaviour is undecided. If the run ends in a bounded oscillation, its frequency is also
        computed.

        Args:
            log: The log of the run.
        """
        end = RunTrace.of_log(log).classify_end(log.scenario)
        error = JointError.find_last_of_all(log)
        if error is not None:
            end = end._replace(end_error_rad=error.value, end_error_where=error.joint)
        if end.behaviour is EndBehaviour.DIVERGED:
            return end._replace(divergence=log.describe_divergence())
        if end.behaviour is not EndBehaviour.BOUNDED:
            return end
        site_logs = [log[site] for site in log.sites]
        return end._replace(frequency_hz=_find_frequency_hz(site_logs))

    @classmethod
    def of_run(cls, run: FusedRun, scenario: Scenario) -> "RunEnd":
        """Judges whether the motion of the arms decayed at the end of a simulated run.

        The result is the same as that of `of_log` for a log of the run, but without the
        quantities that require records.

        Args:
            run: The run in the fused loop.
            scenario: Scenario of the run, whose duration may differ from that of the run.
        """
        return RunTrace.of_run(run).classify_end(scenario)

    @classmethod
    def of_reduced_records(
        cls,
        scenario: Scenario,
        buckets: Sequence[Array],
        tau_x: Sequence[Array],
        diverged_at_s: float | None = None,
    ) -> "RunEnd":
        """Judges whether the motion of the arms decayed, from records that were reduced before.

        Args:
            scenario: Scenario of the run.
            buckets: The reduced records of each site, from `reduce_records`, in scenario order.
            tau_x: Torque of operator and environment in the last record of each site, shape
                (n,) each, in N m.
            diverged_at_s: When the first site exceeded its limits, in s, or `None` if no site
                did.
        """
        return RunTrace(buckets, tau_x, diverged_at_s).classify_end(scenario)

    @staticmethod
    def reduce_records(
        bucket: Ints,
        e: Array,
        qd: Array,
        q: Array,
        into: Array,
    ) -> Array:
        """Adds further records of a site to the data from which the end of its run is judged.

        The records of an interval (bucket) are reduced to the largest |e|, the largest |qd| and
        the last q of each joint (see `RunTrace`). In task space, e has as many columns as the
        task has coordinates. Missing columns of e, qd or q are filled with zeros.

        Args:
            bucket: Interval index of each record, in ascending order, shape (K,).
            e: Synchronisation errors, shape (K, n).
            qd: Joint velocities, shape (K, n), in rad/s.
            q: Joint angles, shape (K, n), in rad.
            into: Data of all earlier records, which may be modified in place and may have spare
                rows.

        Returns:
            The data including the new records.
        """
        if not len(bucket):
            return into
        joints = max(q.shape[1], e.shape[1])

        def pad(x: Array) -> Array:
            missing = joints - x.shape[1]
            return np.pad(x, ((0, 0), (0, missing)))

        magnitudes = np.abs(np.hstack([pad(e), pad(qd)]))
        if not len(into):
            into = np.zeros((0, 3 * joints))
        lacking = int(bucket[-1]) + 1 - len(into)
        if lacking > 0:
            # half as much again, so that a long run is not copied for every batch
            spare = len(into) // 2
            extra = np.full((lacking + spare, 3 * joints), -1.0)
            into = np.vstack([into, extra])

        starts = np.flatnonzero(np.diff(bucket, prepend=-1))
        last_records = np.append(starts[1:], len(q)) - 1
        rows = bucket[starts]
        peaks = np.maximum.reduceat(magnitudes, starts, axis=0)
        earlier_peaks = into[rows, : 2 * joints]
        into[rows, : 2 * joints] = np.maximum(earlier_peaks, peaks)
        into[rows, 2 * joints :] = pad(q)[last_records]
        return into

    @staticmethod
    def find_hanging_sites(scenario: Scenario, ends: Mapping[str, Array]) -> list[str]:
        """Finds the sites whose arms fell: they hang down at the end, but did not at the start.

        An arm that its controller does not hold also comes to rest, but must not be considered
        stable.

        Args:
            scenario: The scenario, with the start poses.
            ends: Final joint angles of the sites to be judged, keyed by site name, shape (n,)
                each, in rad.

        Returns:
            Names of these sites. Empty if no arm fell.
        """
        hanging = []
        for site, q in ends.items():
            arm = build_arm_rows(scenario, site)
            start = np.array(scenario.sites[site].q0_rad)
            hangs = arm.hanging_angle(q) < HANGING_RAD
            if hangs and arm.hanging_angle(start) >= HANGING_RAD:
                hanging.append(site)
        return hanging


class RunTrace(NamedTuple):
    """The reduced data from which the end of a run is judged, per site in scenario order.

    To save memory, the records of a site are reduced to one row per interval of 1 /
    `BUCKETS_PER_S` seconds since the start of the session.

    Attributes:
        buckets: For each site, an array with one row per interval, shape (K, 3 n). A row
            contains the largest |e|, the largest |qd|, and the last angle q of every joint, or
            -1 in an interval without a record. There may be columns for more joints than the
            site has. The last interval may be incomplete, and is not used for trends.
        tau_x: For each site, the torque of operator and environment at the last record, shape
            (n,), in N m.
        diverged_at_s: When the first site exceeded its limits, in s, or `None` if no site did.
        pushed_until_s: When an operator whose action is not part of the scenario last pushed an
            arm, in s, or 0 if no such operator pushed.
        changed_until_s: When a command last changed the control loop, in s, or 0 if no command
            did.
    """

    buckets: Sequence[Array]
    tau_x: Sequence[Array]
    diverged_at_s: float | None = None
    pushed_until_s: float = 0.0
    changed_until_s: float = 0.0

    @classmethod
    def of_log(cls, log: Log) -> "RunTrace":
        """Reduces a log to the data needed to judge the end of its run.

        The reduced data of a long log fit into memory. Simulations without a log produce data
        of the same kind.

        Args:
            log: The log of the run.

        Returns:
            For each joint and each interval of 50 ms, the largest magnitude of its error and of
            its velocity, and its last angle. Also the external torques at the end, and the
            times of the last push and the last change.
        """
        buckets = []
        tau_x = []
        push_times_s = []
        for site in log.sites:
            site_log = log[site]
            site_buckets = RunEnd.reduce_records(
                bucket=site_log.tick * BUCKETS_PER_S // site_log.rate_hz,
                e=site_log.e,
                qd=site_log.qd,
                q=site_log.q,
                into=NO_BUCKETS,
            )
            buckets.append(site_buckets)
            tau_x.append(site_log.tau_x[-1] if len(site_log) else np.zeros(1))
            push_times_s.append(_find_unscripted_push_s(log, site_log))

        change_times_s = [change.at_s for change in Timeline(log).effective_commands]
        return cls(
            buckets=buckets,
            tau_x=tau_x,
            diverged_at_s=log.diverged_s,
            pushed_until_s=max(push_times_s, default=0.0),
            changed_until_s=max(change_times_s, default=0.0),
        )

    @classmethod
    def of_run(cls, run: FusedRun) -> "RunTrace":
        """Returns the data needed to judge the end of a simulated run.

        The fused loop reduces the records of a run while it simulates the run.

        Args:
            run: The run in the fused loop.
        """
        return cls(run.buckets, run.tau_x, run.diverged_s)

    def classify_end(self, scenario: Scenario) -> RunEnd:
        """Judges from reduced data whether the motion decayed at the end of a run.

        The worst joint of all sites determines the result. Even if the motion of all joints
        decays, the run is left open if its sites do not agree, if arms fell, or if the control
        loop changed until shortly before the end.

        Args:
            scenario: The scenario.
        """
        sites = _split_buckets(scenario, self)
        # the last interval may be incomplete
        count = max(min(map(len, sites)) - 1, 0)
        recorded_by_site = [site[:count, 0, 0] >= 0.0 for site in sites]
        recorded = np.all(recorded_by_site, axis=0)
        rows = np.flatnonzero(recorded)
        span_s = count / BUCKETS_PER_S
        all_t_s = rows / BUCKETS_PER_S

        acted_s = max(self.pushed_until_s, _find_last_operator_action(scenario, span_s))
        changed_s = max(self.changed_until_s, _find_last_change(scenario, span_s))
        quiet_from_s = max(acted_s, changed_s)
        first, is_disturbed = _choose_judged_part(all_t_s, quiet_from_s)
        _, operator_disturbs = _choose_judged_part(all_t_s, acted_s)
        operator_acts = is_disturbed and operator_disturbs
        t_s = all_t_s[first:]
        judged_rows = rows[first:]
        columns = [site[judged_rows] for site in sites]

        worst = _find_worst_joint(scenario, t_s, columns, sites)
        missing = []
        for name, data in zip(scenario.names, sites, strict=True):
            if not len(data):
                missing.append(name)
        end = worst._replace(
            missing_sites=tuple(missing),
            counts_from_s=float(t_s[0]) if len(t_s) else 0.0,
            quiet_from_s=quiet_from_s,
            lasts_s=span_s,
        )
        first_site = scenario.sites[scenario.names[0]]
        if first_site.task.space == "position":
            end = end._replace(error_unit="m")

        if self.diverged_at_s is not None:
            return end._replace(
                behaviour=EndBehaviour.DIVERGED, diverged_at_s=self.diverged_at_s
            )
        if end.behaviour.stability is Stability.SETTLED:
            doubts = list(_find_disagreement(scenario, self, t_s, columns))
            doubts += _find_odd_pose(scenario, sites)
            if is_disturbed and not operator_acts:
                doubts.append(EndDoubt("loop changes", until_s=changed_s))
            return end._replace(doubts=tuple(doubts))
        if operator_acts:
            doubt = EndDoubt("operator acts", until_s=acted_s)
            return end._replace(operator_acts=True, doubts=(doubt,))
        return end


NO_BUCKETS = np.zeros((0, 3))
"""The buckets of a site without records."""


def _find_unscripted_push_s(log: Log, site_log: SiteLog) -> float:
    """Returns the last time at which an operator outside the scenario pushed an arm, in s.

    That operator does not cause the motion after this time. Operators outside the scenario move
    an arm that is not simulated, or act live. The result is 0 if no such operator pushed.

    Args:
        log: Log of the run.
        site_log: The part of the log with the records of the site.
    """
    is_pushed = np.zeros(len(site_log), dtype=np.bool_)
    if site_log.name in log.scenario.external:
        is_pushed |= site_log.tau_x.any(axis=1)
    if len(site_log) and site_log.layout.hand:
        is_pushed |= site_log.hand[:, 0] > 0.0
    return float(site_log.t_s[is_pushed].max(initial=0.0))


def _split_buckets(scenario: Scenario, trace: RunTrace) -> list[Array]:
    """Returns |e|, |qd| and q of each arm in every 50 ms interval, shape (K, 3, n) each.

    Here e is the error, qd the joint velocity and q the joint angle. `RunTrace.buckets` stores
    the three side by side in one row, and may have columns for more joints than the arm has.
    These columns are removed.
    """
    sites = []
    for arm, buckets in zip(scenario.arms.values(), trace.buckets, strict=True):
        joints = max(arm.counts.joints, arm.counts.shared)
        by_kind = np.zeros((0, 3, joints))
        if len(buckets):
            all_columns = buckets.reshape(len(buckets), 3, -1)
            by_kind = all_columns[:, :, :joints]
        sites.append(by_kind)
    return sites


def _choose_judged_part(t_s: Array, acted_s: float) -> tuple[int, bool]:
    """Chooses the part of a run whose second half is judged.

    Normally the whole run is used. If an operator acts in the second half of the run, the part
    starts later, so that the judged half begins after the action. If too little time follows
    the action, the whole run is judged nevertheless.

    Args:
        t_s: Times of the run, in s.
        acted_s: Time of the last action, in s.

    Returns:
        Row at which the part starts.
        True if the action falls in the judged half.
    """
    if not len(t_s):
        return 0, False
    end_s = t_s[-1]
    middle_s = 0.5 * (t_s[0] + end_s)
    if acted_s <= middle_s:
        return 0, False
    run_s = end_s - t_s[0]
    least_s = max(LEAST_JUDGED_S, LEAST_JUDGED_SHARE * run_s)
    if end_s - acted_s < least_s:
        return 0, True
    # the action is in the middle of the part from this time on
    start_s = 2.0 * acted_s - end_s
    return int(np.searchsorted(t_s, start_s)), False


def _find_worst_joint(
    scenario: Scenario,
    t_s: Array,
    columns: Sequence[Array],
    sites: Sequence[Array],
) -> RunEnd:
    """Returns how the motion of the joint with the worst behaviour ends.

    For example, growing is worse than oscillating. If several joints have the worst behaviour,
    the fastest of them is returned. The largest |e| and |qd| of the last second are those of
    all joints.

    Args:
        scenario: Scenario of the run.
        t_s: Times of the judged part and the part before it, shape (K,), in s.
        columns: |e|, |qd| and q at these times by site, shape (K, 3, n) each.
        sites: |e|, |qd| and q over the whole run by site, shape (K, 3, n) each.
    """
    # All envelopes are fitted together: |e| and then |qd| of each site.
    envelopes = []
    for site in columns:
        envelopes += [site[:, 0], site[:, 1]]
    fits = iter(EnvelopeFit.fit_columns(t_s, np.hstack(envelopes)))

    ends = []
    for name, judged, whole in zip(scenario.names, columns, sites, strict=True):
        last_second = whole[-BUCKETS_PER_S:, :2]
        peaks = last_second.max(axis=0, initial=0.0)
        end_errors, end_speeds = peaks.tolist()
        error_fits = [next(fits) for _ in end_errors]
        speed_fits = [next(fits) for _ in end_speeds]
        for joint in range(len(end_errors)):
            end = RunEnd(
                behaviour=EndBehaviour.UNDECIDED,
                error=error_fits[joint],
                speed=speed_fits[joint],
                end_error_rad=end_errors[joint],
                end_speed_rad_s=end_speeds[joint],
                where=f"{name} joint {joint + 1}" if len(t_s) else "",
            )
            behaviour = _judge_joint(scenario, end, judged[:, :, joint], t_s)
            ends.append(end._replace(behaviour=behaviour))

    # Some behaviours depend on the other joints of coupled sites.
    end_s = float(t_s[-1]) if len(t_s) else 0.0
    joint_counts = [site.shape[2] for site in sites]
    site_of_joint = np.repeat(np.arange(len(sites)), joint_counts)
    for group in find_coupled_sites(scenario):
        for n in _find_fed_joints(ends, site_of_joint, group):
            ends[n] = ends[n]._replace(behaviour=EndBehaviour.UNDECIDED)
        coasting = _find_coasting_joints(
            scenario=scenario,
            joints=ends,
            site_of_joint=site_of_joint,
            group=group,
            end_s=end_s,
        )
        for n in coasting:
            ends[n] = ends[n]._replace(behaviour=EndBehaviour.COASTS)

    from_best_to_worst = list(EndBehaviour)

    def rank(end: RunEnd) -> tuple[int, float]:
        return from_best_to_worst.index(end.behaviour), end.end_speed_rad_s

    worst = max(ends, key=rank)
    farthest = max(ends, key=lambda end: end.end_error_rad)
    fastest = max(ends, key=lambda end: end.end_speed_rad_s)
    return worst._replace(
        end_error_rad=farthest.end_error_rad,
        end_speed_rad_s=fastest.end_speed_rad_s,
        end_error_where=farthest.where,
        end_speed_where=fastest.where,
    )


def _judge_joint(
    scenario: Scenario,
    end: RunEnd,
    motion: Array,
    t_s: Array,
) -> EndBehaviour:
    """Judges how the motion of a single joint ends: at rest, decaying, oscillating or growing.

    The other joints are not considered.

    Args:
        scenario: Scenario of the run.
        end: Trends and last values of the joint.
        motion: |e|, |qd| and q of the joint over the judged part, shape (K, 3).
        t_s: Times of the judged part, shape (K,), in s.
    """
    speed = end.speed
    # a joint below the floor is too slow for a trend
    is_still = speed.trend is EnvelopeTrend.DECAYS or end.end_speed_rad_s <= FLOOR_RAD
    # the speed of arms outside the program is measured with noise, and need not decay
    may_stay = speed.trend is EnvelopeTrend.HARDLY or bool(scenario.external)
    is_slow = end.end_speed_rad_s <= SETTLED_SPEED_RAD_S
    rests = is_slow and (is_still or (speed.calm and may_stay))

    behaviour = _classify_joint(
        error=end.error,
        speed=speed,
        end_error_rad=end.end_error_rad,
        end_speed_rad_s=end.end_speed_rad_s,
        is_still=is_still,
        is_resting=rests,
    )
    return _refine_by_motion(
        behaviour,
        q=motion[:, 2],
        speed=motion[:, 1],
        t_s=t_s,
        is_still=is_still,
    )


def _find_fed_joints(
    joints: Sequence[RunEnd], site_of_joint: Ints, group: Sequence[int]
) -> list[int]:
    """Finds steadily moving joints that a faster, decaying joint may keep in motion.

    Modes that decay at several frequencies exchange energy (they beat). A joint may therefore
    be steady for a while although all modes decay, and must not count as a lasting oscillation.

    Args:
        joints: Trends at the end of all joints.
        site_of_joint: Index of each joint's site.
        group: Indices of coupled sites.

    Returns:
        Indices of these joints. Each is slower than some joint of the group whose speed falls.
    """
    joints_of_group = np.flatnonzero(np.isin(site_of_joint, group)).tolist()
    decaying = [joints[n] for n in joints_of_group if joints[n].speed.trend in _FALLING]
    decaying_speeds = [joint.end_speed_rad_s for joint in decaying]
    fastest = max(decaying_speeds, default=0.0)
    steady = [n for n in joints_of_group if joints[n].behaviour is EndBehaviour.BOUNDED]
    return [n for n in steady if joints[n].end_speed_rad_s < fastest]


def _find_coasting_joints(
    scenario: Scenario,
    joints: Sequence[RunEnd],
    site_of_joint: Ints,
    group: Sequence[int],
    end_s: float,
) -> list[int]:
    """Finds the drifting joints of coupled sites that nothing brakes.

    An arm is free if no operator and no environment acts on it at the end. Nothing brakes the
    sites if the law of a free arm has no spring to a peer, since the other sites follow this
    arm. Nothing brakes them either if all arms are free and all laws dissipate energy in the
    links only.

    Args:
        scenario: Scenario of the run.
        joints: Ends of all joints.
        site_of_joint: Index of each joint's site.
        group: Indices of the coupled sites.
        end_s: End of the run, in s.

    Returns:
        Indices of these joints. Empty if something brakes the sites.
    """
    site_specs = [scenario.sites[scenario.names[site]] for site in group]
    free_laws = []
    for spec in site_specs:
        actors = spec.actors
        if not any(actor.start_s <= end_s < actor.end_s for actor in actors):
            free_laws.append(spec.control)

    # without damping, a law that dissipates energy in the links only does not brake the arms
    brakeless = []
    all_have_springs = True
    for law in free_laws:
        has_damping = any(getattr(law, "d", ()))
        if law.books_energy and not has_damping:
            brakeless.append(law)
        has_spring = any(getattr(law, "K", (1.0,)))  # laws without a gain K have springs
        all_have_springs &= has_spring
    if len(brakeless) != len(site_specs) and all_have_springs:
        return []

    coasting = []
    for n in np.flatnonzero(np.isin(site_of_joint, group)).tolist():
        drifts = joints[n].behaviour is EndBehaviour.DRIFTS
        grows = joints[n].speed.trend is EnvelopeTrend.GROWS
        if drifts and not grows:
            coasting.append(n)
    return coasting


def _classify_joint(
    error: EnvelopeFit,
    speed: EnvelopeFit,
    end_error_rad: float,
    end_speed_rad_s: float,
    *,
    is_still: bool,
    is_resting: bool,
) -> EndBehaviour:
    """Returns the behaviour of a joint according to the trends of its |e| and |qd|.

    - A growing speed counts as growth even without an error, because arms that swing in unison
      have no error.
    - Errors that grow while the joint gets no faster are undecided: a drift may start, or the
      errors follow from an operator's last action.
    - The speed of a joint that hardly moves has no meaningful trend.

    Args:
        error: Trend of |e|.
        speed: Trend of |qd|.
        end_error_rad: Largest |e| of the last second.
        end_speed_rad_s: Largest |qd| of the last second.
        is_still: True if the speed decays, or is at the floor of its rounding errors.
        is_resting: True if the joint is slow, and its speed falls, even if only slightly. The
            speed of an arm that is not simulated need not fall.
    """
    if speed.trend is EnvelopeTrend.GROWS:
        return EndBehaviour.GROWS
    if error.trend is EnvelopeTrend.GROWS:
        return EndBehaviour.UNDECIDED

    if not is_resting and not is_still:
        if end_speed_rad_s <= SETTLED_SPEED_RAD_S:
            return EndBehaviour.UNDECIDED
        if speed.trend is EnvelopeTrend.HARDLY:
            return EndBehaviour.HARDLY
        if speed.trend is EnvelopeTrend.STEADY:
            return EndBehaviour.BOUNDED
        return EndBehaviour.UNDECIDED

    is_small = end_error_rad <= SETTLED_ERROR_RAD
    if error.calm and (is_small or error.trend is EnvelopeTrend.STEADY):
        return EndBehaviour.CONVERGED if is_resting else EndBehaviour.DECAYS
    if error.trend is EnvelopeTrend.DECAYS:
        return EndBehaviour.CONVERGED if is_resting and is_small else EndBehaviour.DECAYS
    if error.trend is EnvelopeTrend.HARDLY:
        return EndBehaviour.HARDLY
    return EndBehaviour.UNDECIDED


def _refine_by_motion(
    behaviour: EndBehaviour,
    q: Array,
    speed: Array,
    t_s: Array,
    *,
    is_still: bool,
) -> EndBehaviour:
    """Refines the behaviour of a joint by the direction of its motion.

    - A joint drifts if it moves in one direction in each quarter of the judged half, by at
      least an eighth of the whole way in each quarter. Its mean speed must be at least half of
      its largest speed: a joint that swings on its way does not drift.
    - A bounded oscillation must change its sign often enough, and is undecided otherwise.
    - A joint that is slow enough to be at rest, but moves in one direction, is undecided.

    Args:
        behaviour: Behaviour according to the trends.
        q: Joint angle, shape (K,), in rad.
        speed: Largest |qd| since the previous time, shape (K,), in rad/s.
        t_s: Times, shape (K,), in s.
        is_still: True if the speed decays, or is at the floor of its rounding errors.
    """
    may_rest = behaviour is EndBehaviour.CONVERGED and not is_still
    may_move = behaviour in _MAY_DRIFT or may_rest
    if not may_move or len(t_s) < BUCKETS_PER_S:
        return behaviour

    middle_s = 0.5 * (t_s[0] + t_s[-1])
    half_row = int(np.searchsorted(t_s, middle_s))
    # rows of the five ends of the four quarters of the judged half
    quarters = np.linspace(half_row, len(t_s) - 1, 5).round().astype(int)
    steps = np.diff(q[quarters])
    travel = steps.sum()
    distance = abs(float(travel))
    steps_along_travel = steps * np.sign(travel)
    least_step = float(steps_along_travel.min())
    is_one_way = least_step >= 0.125 * distance
    # a joint that swings on its way has a mean speed far below its largest speed
    half_s = t_s[-1] - t_s[half_row]
    largest_speed = speed[half_row:].max()
    is_fast_enough = distance >= 0.5 * half_s * largest_speed

    if is_one_way and is_fast_enough:
        if distance >= DRIFT_RAD:
            return EndBehaviour.DRIFTS
        if distance >= SETTLED_ERROR_RAD and behaviour is EndBehaviour.CONVERGED:
            return EndBehaviour.UNDECIDED
    if behaviour is not EndBehaviour.BOUNDED:
        return behaviour
    oscillates = _count_sign_changes(q[half_row:]) >= MIN_SIGN_CHANGES
    return behaviour if oscillates else EndBehaviour.UNDECIDED


def _count_sign_changes(values: Array) -> int:
    """Returns how often a signal crosses its mean. An oscillation does so twice per period."""
    signs = np.sign(values - values.mean())
    nonzero_signs = signs[signs != 0.0]
    changes = np.diff(nonzero_signs)
    return int(np.count_nonzero(changes))


def find_coupled_sites(scenario: Scenario) -> list[list[int]]:
    """Groups the sites that are coupled at any time, directly or through other sites.

    Two sites are coupled if one of them follows the other. Only sites of the same group are
    expected to agree at the end of a run. For example, m1, m2 and s form one group if s follows
    both masters.

    Args:
        scenario: Scenario of the run, with the changes of its dominance factors.

    Returns:
        For each group, the indices of its sites.
    """
    total_shares = scenario.alpha.copy()
    for change in scenario.timeline:
        if not change.dominance:
            continue
        site = scenario.names.index(change.dominance)
        for peer, share in change.to.items():
            total_shares[site, scenario.names.index(peer)] += share
    # a share in either direction couples two sites
    coupling = DominanceMatrix(total_shares + total_shares.T)
    return [list(group) for group in coupling.closed_groups]


def _find_disagreement(
    scenario: Scenario,
    trace: RunTrace,
    t_s: Array,
    columns: Sequence[Array],
) -> Iterable[EndDoubt]:
    """Yields a doubt for each group of coupled sites that do not agree at the end.

    Sites agree if the angles of their joints are nearly equal. Sites that are still approaching
    each other, or that an operator or environment holds apart, are not reported.

    Args:
        scenario: Scenario of the run.
        trace: Envelopes of the run, see `RunTrace`.
        t_s: Times of the judged part, shape (K,), in s.
        columns: |e|, |qd| and q at these times by site, shape (K, 3, n) each.
    """
    for group in find_coupled_sites(scenario):
        names = [scenario.names[n] for n in group]
        # The tracking error |e| shows whether two arms agree if the law compares positions, or
        # if the arms follow end effectors. Otherwise the joint angles must be compared.
        shown_by_error = [
            name
            for name in names
            if scenario.sites[name].control.compares_positions
            or scenario.arms[name].shares_pose
        ]
        if len(group) < 2 or shown_by_error:
            continue
        q = np.array([columns[n][:, 2] for n in group])
        spread = np.ptp(q, axis=0)
        joint = int(spread[-1].argmax())
        end_spread = spread[-1, joint]
        envelope = spread.max(axis=1, keepdims=True)
        (distance_fit,) = EnvelopeFit.fit_columns(t_s, envelope)
        is_approaching = distance_fit.trend is EnvelopeTrend.DECAYS

        # A torque at the end holds the sites apart if the errors are large enough, or if the
        # sites that it holds are nearly as far apart as all sites.
        largest_torque = max(np.abs(trace.tau_x[n]).max() for n in group)
        largest_error = max(columns[n][-1, 0].max() for n in group)
        is_held = largest_torque > FORCE_NM and largest_error > HELD_SHARE * end_spread
        end_q = q[:, -1, joint]
        holds = _find_held_sites(scenario, trace, joint, float(t_s[-1]))
        held_q = end_q[holds[group]]
        if len(held_q):
            is_held |= bool(end_spread - np.ptp(held_q) < AGREEMENT_RAD)

        if end_spread > AGREEMENT_RAD and not (is_approaching or is_held):
            lowest = names[int(np.argmin(end_q))]
            highest = names[int(np.argmax(end_q))]
            yield EndDoubt("sites apart", (lowest, highest), distance_rad=float(end_spread))


def _find_held_sites(
    scenario: Scenario,
    trace: RunTrace,
    joint: int,
    end_s: float,
) -> NDArray[np.bool_]:
    """Finds the sites at which an operator or environment holds a joint at the end of the run.

    A source of torque holds an arm if it has a stiffness. An operator does so even if its
    torque is zero, because the arm is then at the operator's target. An environment holds an
    arm only while the arm touches the environment. Sources that a user wrote are assumed to
    hold the arm.

    Args:
        scenario: Scenario of the run.
        trace: Envelopes of the run, see `RunTrace`.
        joint: Index of the joint.
        end_s: End of the run, in s.

    Returns:
        True for each site at which the joint is held, in scenario order.
    """
    held = np.zeros(len(scenario.names), dtype=np.bool_)
    for n, (spec, tau_x) in enumerate(zip(scenario.sites.values(), trace.tau_x, strict=True)):
        sources = [*spec.hands]
        if np.abs(tau_x).max() > FORCE_NM:
            sources += spec.environment
        for source in sources:
            actor = source.actor
            stiffness = actor.K
            if actor.kind == TorqueKind.HAND:
                stiffness = actor.K[joint : joint + 1]
            is_stiff = any(stiffness) or actor.kind in OWN_KINDS
            acts_at_end = actor.start_s <= end_s < actor.end_s
            held[n] |= acts_at_end and is_stiff
    return held


def _find_odd_pose(scenario: Scenario, sites: Sequence[Array]) -> Iterable[EndDoubt]:
    """Yields a doubt if arms end in a pose to which a working controller would not bring them.

    Such arms hang down, or are far from every start pose although no operator pushed them.

    Args:
        scenario: Scenario of the run.
        sites: |e|, |qd| and q over the whole run by site, shape (K, 3, n) each.
    """
    starts = [np.array(spec.q0_rad) for spec in scenario.sites.values()]
    ends = [site[-1, 2, : len(start)] for site, start in zip(sites, starts, strict=True)]
    end_by_site = dict(zip(scenario.names, ends, strict=True))
    hanging = RunEnd.find_hanging_sites(scenario, end_by_site)
    if hanging:
        yield EndDoubt("arms fell", tuple(hanging))
        return

    # largest distance of a joint of each site from the start poses of all arms of its size
    distances = []
    for end in ends:
        similar = np.array([q for q in starts if len(q) == len(end)])
        below = similar.min(axis=0) - end
        above = end - similar.max(axis=0)
        distances.append(float(np.maximum(below, above).max()))
    worst = int(np.argmax(distances))
    has_operator = any(spec.hands for spec in scenario.sites.values())
    if distances[worst] > THROWN_RAD and not (scenario.external or has_operator):
        thrown = scenario.names[worst]
        yield EndDoubt("arm thrown", (thrown,), distance_rad=distances[worst])


def _find_last_operator_action(scenario: Scenario, span_s: float) -> float:
    """Returns the last time before `span_s` at which an operator changed its action, in s.

    The actions are known from the scenario, which states the action of each operator over time.
    Operators who act live are not part of the scenario. An operator who only holds an arm does
    not act.

    Args:
        scenario: Scenario of the run.
        span_s: Length of the run, in s.

    Returns:
        The time. 0 if no operator ever changed its action.
    """
    t_s = np.arange(0.0, span_s, 1.0 / BUCKETS_PER_S)
    last_s = 0.0
    for site, spec in scenario.sites.items():
        arm = build_arm_rows(scenario, site)
        start = np.array([spec.q0_rad])
        at_start = arm.place_end_effector(start, 0.0 * start)
        for operator in spec.hands:
            actor = operator.actor
            if actor.kind in LIVE_KINDS:
                continue
            # an action on joints has the identity in place of the end effector's Jacobian
            source_J = np.eye(len(actor.a)) if actor.a else at_start.J[0]
            planned_action = SourceRows(actor).compute_script(t_s, source_J)
            action_steps = np.abs(np.diff(planned_action, axis=0))
            is_change = action_steps.max(axis=1, initial=0.0) > 0.0
            last_change_s = float(t_s[1:][is_change].max(initial=0.0))
            last_s = max(last_s, last_change_s)
            for limit_s in (actor.start_s, actor.end_s):
                if limit_s < span_s:
                    last_s = max(last_s, limit_s)
    return last_s


def _find_last_change(scenario: Scenario, span_s: float) -> float:
    """Returns the time of the last planned change in the control of the arms, in s.

    These changes are the scenario's changes of settings, and the start and end of environments,
    such as virtual walls. A gradual change counts at its end.

    Args:
        scenario: The description of the experiment.
        span_s: Length of the run, in s. Changes that start later are ignored.

    Returns:
        The time. 0 if there is no change.
    """
    changes = [change for change in scenario.timeline if change.at_s < span_s]
    change_times_s = [0.0, *(change.at_s + change.ramp_s for change in changes)]
    for spec in scenario.sites.values():
        for source in spec.environment:
            edges_s = (source.actor.start_s, source.actor.end_s)
            change_times_s += [edge_s for edge_s in edges_s if edge_s < span_s]
    return max(change_times_s)


def _find_frequency_hz(site_logs: list[SiteLog]) -> float | None:
    """Estimates the frequency at which the arms oscillate, from the fastest joint.

    Args:
        site_logs: Logs of all sites. The second half of each is used.

    Returns:
        The frequency in Hz, from the sign changes of the joint's velocity. `None` if they are
        too few.
    """

    def find_speeds(site_log: SiteLog) -> Array:
        """Returns the largest speed of each joint in the second half of the log, in rad/s."""
        second_half = site_log.qd[len(site_log) // 2 :]
        speeds: Array = np.abs(second_half).max(axis=0)
        return speeds

    fastest = max(site_logs, key=lambda site_log: float(find_speeds(site_log).max()))
    fastest_joint = int(find_speeds(fastest).argmax())
    middle = len(fastest) // 2
    crossings = _count_sign_changes(fastest.qd[middle:, fastest_joint])
    if crossings < MIN_SIGN_CHANGES:
        return None

    # an oscillation crosses its mean twice per period
    ticks = float(fastest.tick[-1] - fastest.tick[middle])
    span_s = ticks / fastest.rate_hz
    return 0.5 * crossings / span_s
