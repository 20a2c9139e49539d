"""Metrics of users who share a slave: authority, disagreement, interventions, takeovers.

Invariant: the users are the masters of the scenario, the slave its first one; a user leads whose share in the
slave's reference is the largest. Torques are those of hands ON arms, without the environment's; in task space
they are forces at end effectors. Rows without a record do not count.
"""

import numpy as np

from ...core.task_space import PLACE
from ...core.vectors import Array
from ..aligned import AlignedRecords, find_common_rows, find_latest_rows
from ..dominance_history import RAMP_TIME_TOLERANCE_S, UserShares, find_user_shares, find_users, list_ramps
from ..run_view import RunView
from .measures import USERS, Metric, MetricValues, Quantity, measures, metric, peak, rms, unavailable

_NONE = "users share no such coordinate"
_NO_INSTANT = "no instant of which every user has a record"


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
    "site", USERS, Quantity("authority_effort_nm2_s", "effort of the hand, by its share", "N²m²s", "sum")
)
def measure_authority_effort(view: RunView, site: str) -> MetricValues:
    """Returns h sum_k a_k |tau_h,k|^2 of a user, a being its share in the slave's reference at that time."""
    shared = view.once(read_user_shares)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="site", applies=shared.applies)
    if site not in shared.users:
        return unavailable(USERS, "its hand is no user's", of="site", applies=False)
    records, torque, _ = view.sites[site]
    row, recorded = find_latest_rows(view.sites[find_users(view.scenario)[0]].records, records.t_s)
    share = shared.shares[row, shared.users.index(site)]
    squares = np.einsum("kj,kj->k", torque.operator, torque.operator)
    effort = np.where(records.known & recorded, share * squares, 0.0)
    return {"authority_effort_nm2_s": metric(float(effort.sum()) * records.h_s)}


def cancelled_part(torques: Array) -> Array:
    """Returns (sum |tau_i| - |sum tau_i|) / 2 of the torques of U users, shape (U, K, n), N m."""
    cancelled: Array = 0.5 * (np.abs(torques).sum(axis=0) - np.abs(torques.sum(axis=0)))
    return cancelled


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
    shared = view.once(read_user_shares)
    if isinstance(shared, Metric):
        return unavailable(USERS, shared.why, of="run", applies=shared.applies)
    known = view.sites[find_users(view.scenario)[0]].records.known
    return {
        **_measure_disagreement(view, shared),
        "intervention_share": metric(float(shared.intervention[known].mean())),
        **_measure_takeovers(view, shared),
    }


def _measure_disagreement(view: RunView, shared: UserShares) -> MetricValues:
    runs = [view.shared[user] for user in shared.users]
    rows, known = find_common_rows([run.records for run in runs])
    pushes = [run.torque.operator[row] for run, row in zip(runs, rows, strict=True)]
    torques = np.stack(pushes)[:, known]
    cancels, whole = cancelled_part(torques), np.abs(torques).sum()
    places = 0 if view.scenario.sites[shared.users[0]].task.space == "joints" else PLACE
    found = {"internal_share": metric(2.0 * cancels.sum() / whole) if whole else _unasked("no user pushes")}
    for unit, part in (("n", cancels[:, :places]), ("nm", cancels[:, places:])):
        found[f"internal_rms_{unit}"] = (
            metric(rms(part), _NO_INSTANT) if part.shape[1] else _unasked("sites share no such coordinate")
        )
    return found


def _measure_takeovers(view: RunView, shared: UserShares) -> MetricValues:
    records = view.sites[find_users(view.scenario)[0]].records
    ramps = sorted(list_ramps(view.log, records.site)[1], key=lambda ramp: ramp.start_ns)
    spans = [(ramp.start_ns * 1e-9, ramp.end_ns * 1e-9) for ramp in ramps]
    changed = np.flatnonzero(np.diff(shared.lead)) + 1
    taken = [_time_taken(float(records.t_s[row]), records.h_s, spans) for row in changed]
    return {
        "takeovers": metric(float(len(changed))),
        "takeover_s": metric(max(taken)) if taken else _unasked("the lead never changes"),
        "lead_jump": _compare_steps(records, spans),
    }


def _time_taken(at_s: float, h_s: float, spans: list[tuple[float, float]]) -> float:
    """Returns how long before a change of the lead the ramp began that made it; 0 if no ramp did."""
    within = [start for start, end in spans if start <= at_s + RAMP_TIME_TOLERANCE_S and at_s <= end + h_s]
    return at_s - within[-1] if within else 0.0


def _compare_steps(records: AlignedRecords, spans: list[tuple[float, float]]) -> Metric:
    """Returns the largest step of q_id from tick to tick while shares change, over that of the rest."""
    ends, follows = records.t_s, records.known & records.follows
    places = records.q_des[:, :PLACE] if records.x.size else records.q_des
    steps = np.abs(np.diff(places, axis=0)).max(axis=1)
    changing = np.zeros(len(steps), dtype=np.bool_)
    for start, end in spans:
        changing |= (ends[1:] >= start - RAMP_TIME_TOLERANCE_S) & (ends[:-1] <= end + RAMP_TIME_TOLERANCE_S)
    judged = follows[:-1] & follows[1:]
    if not (judged & changing).any():
        return Metric(None, "no share changes", applies=False)
    rest = peak(steps[judged & ~changing])
    return metric(
        peak(steps[judged & changing]) / rest if rest else None, "the reference rests outside of it"
    )
