"""Computes how several users share one slave arm: authority, disagreement and takeovers.

In trilateral teleoperation, for example, two users (a trainer and a trainee) move two master
arms, and one slave arm follows both. It follows each master with a dominance factor, which may
change during the run. The slave is the first one of the scenario.

Invariant:
    - The user with the largest dominance factor leads.
    - Only the torques with which the operators push their arms count, not the torques of walls
      and other environments. In task space, forces at the end effectors replace them.
    - Ticks without a record are ignored.
"""

import math

import numpy as np

from ...core import POSITION
from ..aligned import AlignedRecords, find_common_rows
from ..dominance_history import RAMP_TIME_TOLERANCE_S, DominanceHistory
from ..run_view import RunView, SiteRun
from ..shared_slave import SharedSlave, UserShares
from .measures import USERS, Metric, MetricValues, Quantity, measures, peak, rms, unavailable

JACKKNIFE_BLOCKS = 8
"""Number of blocks of ticks that the jackknife leaves out, one at a time."""
LARGEST_HALF_WIDTH = 0.25
"""Largest half-width of the 95 % interval at which a share in the motion is reported."""
STUDENT_T = 2.3646
"""The 0.975 quantile of Student's t with `JACKKNIFE_BLOCKS` - 1 = 7 degrees of freedom."""
LEAST_INDEPENDENCE = 1e-9
"""Smallest singular value of the users' relative velocities, relative to the slave's motion.

With a smaller value the users' motions count as dependent.
"""


def _not_applicable(reason: str) -> Metric:
    """Returns the metric of a quantity that cannot exist in this scenario, with the reason."""
    return Metric(None, reason, applies=False)


def _read_user_shares(view: RunView) -> UserShares | Metric:
    """Reads the weights with which the slave arm followed each of its users over time.

    Each user moves a master arm, and the slave follows the masters with weights, the dominance
    factors.

    Args:
        view: The recorded run.

    Returns:
        The weights and the leading user at every tick of the slave. If no two users share a
        slave, or records are missing, the result is a metric without a value, which contains
        the reason.
    """
    slave = SharedSlave(view.log)
    if not slave.name or len(slave.users) < 2:
        return _not_applicable("no two users share a slave")
    missing = [site for site in (*slave.users, slave.name) if site not in view.sites]
    if missing:
        return Metric(None, f"no records of {', '.join(missing)}")
    alpha = view.sites[slave.name].dominance.alpha
    return slave.find_shares(alpha, slave.program)


@measures(
    "site",
    USERS,
    Quantity("authority_effort_nm2_s", "the hand's effort by share", "N²m²s", "sum"),
    Quantity("motion_share", "share in the slave's motion"),
)
def _measure_authority(view: RunView, site: str) -> MetricValues:
    """Measures how much a user determines the motion of the slave arm.

    There are two metrics. The first is the weighted effort h sum_k a_k |tau_k|^2, in (N m)^2 s.
    Here h is the tick period, a_k the weight with which the slave follows the user's master arm
    at tick k, and tau_k the torque with which the user pushes the master. The second is the
    user's share of the slave's motion, estimated from the recorded velocities.

    Args:
        view: The recorded run.
        site: Name of the site that runs the user's master arm.

    Returns:
        The metrics, by key. A metric without a value contains the reason.
    """
    shared = view.compute_once(_read_user_shares)
    slave = SharedSlave(view.log)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="site", applies=shared.applies)
    if site not in slave.users:
        why = "the arm of this site is not the master arm of a user"
        return unavailable(USERS, why, of="site", applies=False)

    records = view.sites[site].records
    torque = view.sites[site].torque
    user = slave.users.index(site)
    slave_row, is_slave_recorded = view.sites[slave.name].records.find_latest_rows(records.t_s)

    share = shared.shares[slave_row, user]
    squared_torque = np.square(torque.operator).sum(axis=1)
    weighted_squares = share * squared_torque
    counted_squares = weighted_squares[records.known & is_slave_recorded]
    effort = counted_squares.sum() * records.h_s

    motion_shares = view.compute_once(_identify_shares)
    if isinstance(motion_shares, Metric):
        motion_share = motion_shares
    else:
        motion_share = Metric.of_value(motion_shares[user])
    return {
        "authority_effort_nm2_s": Metric.of_value(float(effort)),
        "motion_share": motion_share,
    }


def _identify_shares(view: RunView) -> list[float] | Metric:
    """Estimates by least squares how much each user contributes to the slave's motion.

    The shares a_i minimise sum_k |qd_k - sum_i a_i qd_i(s_k)|^2 subject to sum_i a_i = 1. Here
    qd_k is the slave's velocity at tick k (in task space the velocity of its end effector), and
    qd_i(s_k) is the velocity of user i's master at the time at which the sample that the slave
    uses was sent.

    The constraint is met by subtracting the last user's velocity from all others. The last
    user's share is one minus the sum of the other shares. The standard error of the shares is
    estimated by the jackknife over blocks of ticks, since velocities at successive ticks are
    not independent.

    Returns:
        The shares in the order of the users. A metric with the reason if the motion does not
        determine them.
    """
    slave = SharedSlave(view.log)
    slave_records = view.sites[slave.name].records
    is_valid = slave_records.known & slave_records.follows
    user_rates = []
    for user in slave.users:
        records = view.sites[user].records
        used_row = slave_records.used[user] - records.first
        clipped_row = used_row.clip(0, len(records.known) - 1)
        is_valid &= (used_row == clipped_row) & records.known[clipped_row]
        user_rates.append(records.shared_rate[clipped_row])

    # subtract the last user's velocity to meet the constraint
    slave_rate = slave_records.shared_rate[is_valid].ravel()
    valid_rates = [rate[is_valid].ravel() for rate in user_rates]
    *other_rates, last_rate = valid_rates
    relative_rates = np.column_stack([rate - last_rate for rate in other_rates])
    relative_slave_rate = slave_rate - last_rate

    unknown = Metric(None, "the users' motions are not independent, or no arm moves")
    if not len(slave_rate):
        return unknown
    singular_values = np.linalg.svd(relative_rates, compute_uv=False)
    slave_motion = np.linalg.norm(slave_rate)
    if singular_values[-1] <= LEAST_INDEPENDENCE * slave_motion:
        return unknown

    shares = np.linalg.lstsq(relative_rates, relative_slave_rate)[0]
    all_rows = np.arange(len(slave_rate))
    jackknife_shares = []
    for block in np.array_split(all_rows, JACKKNIFE_BLOCKS):
        rows = np.delete(all_rows, block)
        solution = np.linalg.lstsq(relative_rates[rows], relative_slave_rate[rows])
        jackknife_shares.append(solution[0])
    # jackknife (Quenouille 1956): (n - 1) / n times the sum of squared deviations, n blocks
    variance = (JACKKNIFE_BLOCKS - 1) * np.var(jackknife_shares, axis=0).max()
    half_width = STUDENT_T * math.sqrt(variance)
    # negated, so that NaN is refused too
    if not half_width <= LARGEST_HALF_WIDTH:
        why = f"the motion does not determine the shares: only within +- {half_width:.2g}"
        return Metric(None, why)

    last_share = 1.0 - float(shares.sum())
    return [*shares.tolist(), last_share]


@measures(
    "run",
    USERS,
    Quantity("internal_rms_nm", "RMS torque that cancels", "N m"),
    Quantity("internal_rms_n", "RMS force that cancels", "N"),
    Quantity("internal_share", "part of the users' efforts that cancels"),
    Quantity("intervention_share", "time in which a user other than the program leads"),
    Quantity("takeovers", "changes of the leader"),
    Quantity("takeover_s", "longest takeover", "s"),
    Quantity("lead_jump", "largest step of q_id while shares change / other steps"),
)
def _measure_sharing(view: RunView, _run: str) -> MetricValues:
    """Measures how the users of a slave arm disagree, intervene and take over.

    Each user moves a master arm, and the slave follows the masters with weights. The user with
    the largest weight leads. A change of the leader is a takeover. The log states whether a
    program moved the arm of a user. If no program did, the last user counts as the program. If
    any other user leads, this user is said to intervene.

    Args:
        view: The recorded run.

    Returns:
        The metrics, by key. A metric without a value contains the reason.
    """
    shared = view.compute_once(_read_user_shares)
    slave = SharedSlave(view.log)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="run", applies=shared.applies)

    records = view.sites[slave.name].records
    intervenes = shared.leader[records.known] != shared.program
    ramp_spans_s = sorted(DominanceHistory.list_ramp_spans_s(view.log, slave.name))

    leader_changes = np.diff(shared.leader) != 0
    takeover_times_s = records.t_s[1:][leader_changes]
    durations_s = [
        _measure_takeover_s(change_s, records.h_s, ramp_spans_s)
        for change_s in takeover_times_s.tolist()
    ]
    longest_s = _not_applicable("the leader never changes")
    if durations_s:
        longest_s = Metric.of_value(max(durations_s))

    user_runs = [view.shared[user] for user in slave.users]
    return {
        **_measure_disagreement(user_runs),
        "intervention_share": Metric.of_value(float(intervenes.mean())),
        "takeovers": Metric.of_value(float(len(takeover_times_s))),
        "takeover_s": longest_s,
        "lead_jump": _compare_steps(records, ramp_spans_s),
    }


def _measure_disagreement(runs: list[SiteRun]) -> MetricValues:
    """Returns the part of the users' torques that cancels, as an RMS and as a share.

    Torques tau_i of the users i in a joint or along an axis cancel by
    (sum_i |tau_i| - |sum_i tau_i|) / 2.

    Args:
        runs: The masters of the users.
    """
    rows, known = find_common_rows([run.records for run in runs])
    torques = []
    for run, row in zip(runs, rows, strict=True):
        common_torque = run.torque.operator[row]
        torques.append(common_torque[known])

    sum_of_sizes = np.abs(torques).sum(axis=0)
    size_of_sum = np.abs(np.sum(torques, axis=0))
    cancelled = 0.5 * (sum_of_sizes - size_of_sum)
    total = sum_of_sizes.sum()

    internal_share = _not_applicable("no user pushes")
    if total:
        internal_share = Metric.of_value(2.0 * cancelled.sum() / total)
    values = {"internal_share": internal_share}
    # in task space, forces along the axes of the position come first
    force_columns = POSITION if runs[0].records.x.size else 0
    forces = cancelled[:, :force_columns]
    joint_torques = cancelled[:, force_columns:]
    for unit, amounts in {"n": forces, "nm": joint_torques}.items():
        if amounts.shape[1]:
            values[f"internal_rms_{unit}"] = Metric.of_value(rms(amounts))
        else:
            values[f"internal_rms_{unit}"] = _not_applicable(
                "the users share no such coordinate"
            )
    return values


def _measure_takeover_s(
    change_s: float,
    h_s: float,
    ramp_spans_s: list[tuple[float, float]],
) -> float:
    """Returns the time from the start of a change of the weights to the change of the leader.

    The leader is the user whose arm the slave arm follows with the largest weight.

    Args:
        change_s: Time at which the leader changed, in s.
        h_s: Tick period of the slave, in s.
        ramp_spans_s: (start, end) of every ramp of the dominance factors, in s, sorted.

    Returns:
        The time since the start of the latest ramp that can have caused the change, in s. 0 if
        there is no such ramp.
    """
    latest_start_s = None
    for start_s, end_s in ramp_spans_s:
        has_started = start_s <= change_s + RAMP_TIME_TOLERANCE_S
        has_just_ended = change_s <= end_s + h_s
        if has_started and has_just_ended:
            latest_start_s = start_s
    if latest_start_s is None:
        return 0.0
    return change_s - latest_start_s


def _compare_steps(records: AlignedRecords, ramp_spans_s: list[tuple[float, float]]) -> Metric:
    """Compares steps of the slave's reference during a change of weights with other steps.

    Changing the weights of the users should not make the reference of the slave arm jump.

    Args:
        records: Records of the slave.
        ramp_spans_s: (start, end) of every gradual change (ramp) of the weights, in s.

    Returns:
        The largest step from tick to tick while a ramp lasts, divided by the largest other
        step.
    """
    q_des = records.q_des[:, :POSITION] if records.x.size else records.q_des
    follows = records.known & records.follows
    differences = np.abs(np.diff(q_des, axis=0))
    steps = differences.max(axis=1)
    period_start_s = records.t_s[:-1] - RAMP_TIME_TOLERANCE_S
    period_end_s = records.t_s[1:] + RAMP_TIME_TOLERANCE_S
    is_changing = np.zeros(len(steps), dtype=np.bool_)
    # periods that overlap a ramp
    for start_s, end_s in ramp_spans_s:
        is_changing |= (period_end_s >= start_s) & (period_start_s <= end_s)

    is_judged = follows[:-1] & follows[1:]
    judged_changing = is_judged & is_changing
    judged_otherwise = is_judged & ~is_changing
    if not judged_changing.any():
        return _not_applicable("no share changes")

    largest_while_changing = peak(steps[judged_changing])
    largest_otherwise = peak(steps[judged_otherwise])
    ratio = None
    if largest_otherwise:
        ratio = largest_while_changing / largest_otherwise
    return Metric.of_value(ratio, "the reference rests while no share changes")
