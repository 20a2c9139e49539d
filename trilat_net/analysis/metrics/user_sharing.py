"""Metrics of users who share a slave: authority, disagreement, interventions, takeovers.

Invariant: the users are the masters of the scenario, the slave its first one; a user leads
whose share in the slave's reference is the largest. Torques are those of hands ON arms, without
the environment's; in task space they are forces at end effectors. Rows without a record do not
count.
"""

import math

import numpy as np

from ...core.task_space import POSITION
from ..aligned import AlignedRecords, find_common_rows, find_latest_rows
from ..dominance_history import (
    RAMP_TIME_TOLERANCE_S,
    UserShares,
    find_user_shares,
    find_users,
    list_ramps,
)
from ..run_view import RunView, SiteRun
from .measures import (
    USERS,
    Metric,
    MetricValues,
    Quantity,
    measures,
    metric,
    peak,
    rms,
    unavailable,
)

PARTS = 8
WIDEST = 0.25
"""Of a share in motion: parts that the jackknife leaves out in turn, and the widest half
interval, 95 %.
"""
STUDENT_T = 2.3646
"""The 0.975 quantile of Student's t with one degree of freedom less than parts, 7."""


def _unasked(why: str) -> Metric:
    return Metric(None, why, applies=False)


def read_user_shares(view: RunView) -> UserShares | Metric:
    """Returns the shares of the users at the slave's ticks, or why there are none."""
    slave, users = find_users(view.scenario)
    if not slave or len(users) < 2:
        return _unasked("no two users share a slave")
    if absent := [site for site in (*users, slave) if site not in view.sites]:
        return Metric(None, f"no records of {', '.join(absent)}")
    return find_user_shares(view.scenario, view.sites[slave].dominance.alpha)


@measures(
    "site",
    USERS,
    Quantity("authority_effort_nm2_s", "the hand's effort by share", "N²m²s", "sum"),
    Quantity("motion_share", "share in the slave's motion"),
)
def measure_authority(view: RunView, site: str) -> MetricValues:
    """Returns a user's share in the slave's motion, and h sum_k a_k |tau_h,k|^2 by its
    dominance a_k.
    """
    shared = view.compute_once(read_user_shares)
    (slave, users) = find_users(view.scenario)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="site", applies=shared.applies)
    if site not in users:
        return unavailable(USERS, "its hand is no user's", of="site", applies=False)
    records, torque, _ = view.sites[site]
    row, recorded = find_latest_rows(view.sites[slave].records, records.t_s)
    squares = shared.shares[row, users.index(site)] * np.square(torque.operator).sum(axis=1)
    effort = squares[records.known & recorded].sum() * records.h_s
    found = view.compute_once(_identify_shares)
    share = found if isinstance(found, Metric) else metric(found[users.index(site)])
    return {"authority_effort_nm2_s": metric(float(effort)), "motion_share": share}


def _identify_shares(view: RunView) -> list[float] | Metric:
    """Returns by user the a that minimise sum_k |qd_k - sum_i a_i qd_i(used_k)|^2, their sum
    being 1.

    qd is the slave's velocity, that of task space where it is, and used_k the sample of user i
    in use.
    """
    slave, users = find_users(view.scenario)
    own = view.sites[slave].records
    judged = own.known & own.follows
    rates = []
    for other in (view.sites[user].records for user in users):
        row = own.used[other.site] - other.first
        there = row.clip(0, len(other.known) - 1)
        judged &= (row == there) & other.known[there]
        rates.append(other.shared_rate[there])
    *firsts, last = (rate[judged].ravel() for rate in rates)
    apart = np.column_stack([one - last for one in firsts])
    moves = own.shared_rate[judged].ravel()
    if not len(moves) or np.linalg.svd(apart, compute_uv=False)[-1] <= 1e-9 * np.linalg.norm(
        moves
    ):
        return Metric(None, "the users move alike, or nobody moves")
    every = np.arange(len(moves))
    rows = [every, *(np.delete(every, part) for part in np.array_split(every, PARTS))]
    shares, *others = (np.linalg.lstsq(apart[row], (moves - last)[row])[0] for row in rows)
    half = STUDENT_T * math.sqrt((PARTS - 1) * np.var(others, axis=0).max())
    if not half <= WIDEST:
        return Metric(None, f"the motion does not tell: shares within +- {half:.2g}")
    return [*shares.tolist(), 1.0 - float(shares.sum())]


@measures(
    "run",
    USERS,
    Quantity("internal_rms_nm", "RMS torque that cancels", "N m"),
    Quantity("internal_rms_n", "RMS force that cancels", "N"),
    Quantity("internal_share", "part of the users' efforts that cancels"),
    Quantity("intervention_share", "time in which another user than the program leads"),
    Quantity("takeovers", "changes of who leads"),
    Quantity("takeover_s", "longest takeover", "s"),
    Quantity("lead_jump", "largest step of q_id while shares change, to that of the rest"),
)
def measure_sharing(view: RunView, _run: str) -> MetricValues:
    """Returns disagreement, interventions and takeovers of the users of a slave."""
    shared = view.compute_once(read_user_shares)
    (slave, users) = find_users(view.scenario)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="run", applies=shared.applies)
    records = view.sites[slave].records
    intervenes = shared.leader[records.known] != shared.program
    spans = sorted(
        (ramp.start_ns * 1e-9, ramp.end_ns * 1e-9) for ramp in list_ramps(view.log, slave)[1]
    )
    changed = records.t_s[1:][np.diff(shared.leader) != 0]
    taken = [_time_taken(at_s, records.h_s, spans) for at_s in changed.tolist()]
    return {
        **_measure_disagreement([view.shared[user] for user in users]),
        "intervention_share": metric(float(intervenes.mean())),
        "takeovers": metric(float(len(changed))),
        "takeover_s": metric(max(taken)) if taken else _unasked("the lead never changes"),
        "lead_jump": _compare_steps(records, spans),
    }


def _measure_disagreement(runs: list[SiteRun]) -> MetricValues:
    rows, known = find_common_rows([run.records for run in runs])
    torques = np.stack([run.torque.operator[row] for run, row in zip(runs, rows, strict=True)])[
        :, known
    ]
    sizes = np.abs(torques).sum(axis=0)
    cancels = 0.5 * (sizes - np.abs(torques.sum(axis=0)))
    whole = sizes.sum()
    places = POSITION if runs[0].records.x.size else 0
    found = {
        "internal_share": metric(2.0 * cancels.sum() / whole)
        if whole
        else _unasked("nobody pushes")
    }
    for unit, part in (("n", cancels[:, :places]), ("nm", cancels[:, places:])):
        found[f"internal_rms_{unit}"] = (
            metric(rms(part)) if part.shape[1] else _unasked("none is shared")
        )
    return found


def _time_taken(at_s: float, h_s: float, spans: list[tuple[float, float]]) -> float:
    """Returns how long before a change of the lead the ramp began that made it; 0 if no ramp
    did.
    """
    within = [
        start
        for start, end in spans
        if start <= at_s + RAMP_TIME_TOLERANCE_S and at_s <= end + h_s
    ]
    return at_s - within[-1] if within else 0.0


def _compare_steps(records: AlignedRecords, spans: list[tuple[float, float]]) -> Metric:
    """Returns the largest step of q_id from tick to tick while shares change, over that of the
    rest.
    """
    places = records.q_des[:, :POSITION] if records.x.size else records.q_des
    follows = records.known & records.follows
    steps = np.abs(np.diff(places, axis=0)).max(axis=1)
    begins = records.t_s[:-1] - RAMP_TIME_TOLERANCE_S
    ends = records.t_s[1:] + RAMP_TIME_TOLERANCE_S
    changing = np.any(
        [(ends >= start) & (begins <= end) for start, end in [*spans, (np.inf, 0.0)]], axis=0
    )
    judged = follows[:-1] & follows[1:]
    if not (judged & changing).any():
        return _unasked("no share changes")
    largest = peak(steps[judged & changing])
    rest = peak(steps[judged & ~changing])
    return metric(largest / rest if rest else None, "the reference rests outside of it")
