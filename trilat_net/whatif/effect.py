"""What a rerun changed: per site its motion, its error and its torque, per link how old samples were.

Law: both sides of every figure are of the same times: of records of the log that the rerun has executed too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..core.grid import NS_PER_S
from ..core.tick import Mode
from ..log.reader import Ints, Log, SiteLog
from ..replay.difference import Difference
from .actor import Actor, Made
from .delivery import Deliveries
from .premise import Premise


class Pair(NamedTuple):
    """One figure in the log and in the rerun."""

    before: float
    after: float


class SiteEffect(NamedTuple):
    """What became of one site. Figures are None where nothing could be compared.

    Attributes:
        site: which site.
        executed: ticks that were executed.
        compared: of those, the ones of whose time there is a record in the log.
        identical: of those, the ones of which every computed field has the same bits (where something is
            changed: but for the sum of what arrived).
        stands: records of the log that stand, since too little is known to execute them.
        assumed: ticks executed that have no record: what arrived then is assumed.
        lacking: samples that arrived and are not in the log: without them.
        first: the first difference, or None; where rates changed there is none to tell.
        diverged_at_s: when it left its limits; None where it did not.
        q_rms_rad: root mean square of q here minus q in the log, of the joint where it is largest.
        q_max_rad: the largest such difference.
        q_max_at_s: when that was.
        error_rms_rad: root mean square of e, Eq. (9), of the joint where it is largest.
        error_max_rad: largest |e|.
        torque_max_nm: largest |tau|, Eq. (13).
    """

    site: str
    executed: int
    compared: int
    identical: int
    stands: int
    assumed: int
    lacking: int
    first: Difference | None
    diverged_at_s: float | None
    q_rms_rad: float | None = None
    q_max_rad: float | None = None
    q_max_at_s: float | None = None
    error_rms_rad: Pair | None = None
    error_max_rad: Pair | None = None
    torque_max_nm: Pair | None = None


class LinkEffect(NamedTuple):
    """How old the sample in use was on one link of a site that was executed, where both had one.

    Attributes:
        link: as in "m1->s".
        age_mean_ms: averaged over the ticks, ms.
        age_max_ms: the largest, ms.
    """

    link: str
    age_mean_ms: Pair
    age_max_ms: Pair

    @property
    def differs(self) -> bool:
        """True where samples were of another age than in the log."""
        return any(pair.before != pair.after for pair in (self.age_mean_ms, self.age_max_ms))


def effects(
    log: Log, premise: Premise, actor: Actor, came: Deliveries, made: Sequence[Made]
) -> tuple[SiteEffect, list[LinkEffect]]:
    """Returns what became of one site, and of the links that it receives over.

    Args:
        log: the log.
        premise: what was asked of it.
        actor: the site, at the end.
        came: what came to it.
        made: its ticks, in order.
    """
    before, executed = log[actor.name], [one for one in made if not one.stands]
    rate_hz = premise.scenario.sites[actor.name].rate_hz
    after = SiteLog(actor.name, before.peers, rate_hz, [one.payload for one in executed], "rerun")
    _, rows, rows_here = np.intersect1d(before.t_ns, after.t_ns, return_indices=True)
    last = executed[-1] if executed else None
    counted = SiteEffect(
        actor.name,
        executed=len(executed),
        compared=len(rows),
        identical=sum(one.same for one in executed),
        stands=len(made) - len(executed),
        assumed=sum(one.tick in came.unrecorded for one in executed),
        lacking=actor.lacking,
        first=actor.first,
        diverged_at_s=last.t_ns / NS_PER_S if last is not None and last.mode is Mode.DIVERGED else None,
    )
    if not len(rows):
        return counted, []
    links = _links(log, premise, before, after, rows, rows_here)
    with np.errstate(over="ignore"):  # a stranger's log holds any finite numbers
        return _with_figures(counted, before, after, rows, rows_here), links


def _rms(values: Array) -> float:
    """Returns the root mean square of the column where it is largest; squares of no number overflow."""
    largest = _largest(values)
    if not 0.0 < largest < np.inf:
        return largest
    return largest * float(np.sqrt(np.mean(np.square(values / largest), axis=0)).max())


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _with_figures(
    counted: SiteEffect, before: SiteLog, after: SiteLog, rows: Ints, rows_here: Ints
) -> SiteEffect:
    """Returns a site's effect with its figures, of the rows of both that are of the same times."""
    moved = after.q[rows_here] - before.q[rows]
    place = int(np.abs(moved).max(axis=1).argmax())
    errors = (before.e[rows], after.e[rows_here])
    return counted._replace(
        q_rms_rad=_rms(moved),
        q_max_rad=_largest(moved),
        q_max_at_s=float(before.t_s[rows[place]]),
        error_rms_rad=Pair(*map(_rms, errors)),
        error_max_rad=Pair(*map(_largest, errors)),
        torque_max_nm=Pair(_largest(before.tau[rows]), _largest(after.tau[rows_here])),
    )


def _links(
    log: Log, premise: Premise, before: SiteLog, after: SiteLog, rows: Ints, rows_here: Ints
) -> list[LinkEffect]:
    """Returns how old samples were on the links of a site; nothing of one that had none in use."""
    found = []
    for peer in before.peers:
        then_ms = 1e3 * before.age_s(peer, log.scenario.sites[peer].rate_hz)[rows]
        now_ms = 1e3 * after.age_s(peer, premise.scenario.sites[peer].rate_hz)[rows_here]
        both = ~(np.isnan(then_ms) | np.isnan(now_ms))
        if not both.any():
            continue
        mean = Pair(float(then_ms[both].mean()), float(now_ms[both].mean()))
        largest = Pair(float(then_ms[both].max()), float(now_ms[both].max()))
        found.append(LinkEffect(f"{peer}->{before.name}", mean, largest))
    return found
