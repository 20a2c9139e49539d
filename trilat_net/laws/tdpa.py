"""Time-domain passivity control: each end of a coupling watches what it takes out, and limits
it.

Invariant: in every directed coupling of a follower to a leader each end books, cumulatively and
per joint, the energy that it puts in; the other end takes out no more than it knows of.

A follower is moved by F = K (goal - q) + B (v - qd), goal += h v, v = sum alpha_j v_j: the
velocities of the peers by dominance. Peer j feels -alpha_j F. Where all sites follow there is a
coupling each way. While a site waits, aligns or holds, what its reference lacks of the way to
the peers adds to the goal, at no cost.
"""

import math
from typing import Any, ClassVar, Literal

import numpy as np

from ..core.compiled_law import compiled
from ..core.law_energy import LawEnergies, LawRecords, sum_work
from ..core.user_law import LawContext, LawInput
from ..fields import NotNegative, NotNegativeJoints, Positive
from .conditions import PASSIVE_OUTSIDE, LawSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, EnergyLaw

SWEEPS = 3
"""How often joints and couplings settle what each leaves of its torque, as these move one
another.
"""
AHEAD = 2.0
"""Ticks of a leader's motion that are paid for beforehand: in one a joint turns back, in two it
rests.
"""
SPENT_S = 0.1
"""Drift compensation spends what is left at such a rate that it lasts for this time, s."""
_SLACK_NM = 1e-9
"""A torque that gives a follower's controller nothing to act on."""


@compiled
def book(now: LawInput, j: int, i: int, torque: float, step: float) -> float:
    """Books what a leader's arm gives to a coupling; returns what it takes out, as a negative
    number.
    """
    now.sent[j].E_led[i] += max(torque * step, 0.0)
    taken: float = min(torque * step, 0.0)
    return taken


@compiled
def observe_leader(law: Any, now: LawInput, j: int, i: int) -> None:
    """Brings what the leader's end knows of the coupling by which peer j follows up to the
    present.
    """
    at = j * now.joints + i
    sent = now.sent[j]
    observed = sent.W_led[i] if now.k > 0 else law.reserve_J
    observed += now.received[j].E_followed[i] - law.E_known[at]
    law.E_known[at] = now.received[j].E_followed[i]
    if law.by_step:  # of the period before, which is over
        observed += book(
            now=now, j=j, i=i, torque=law.F_led[at], step=now.q[i] - now.q_before[i]
        )
    sent.W_led[i] = observed


@compiled
def invert_inertia(law: Any, now: LawInput) -> None:
    """Writes M^-1 by elimination; zeros where the arm's parameters are unknown."""
    n = now.joints
    inverse = law.inverse
    for i in range(n):
        for j in range(n):
            inverse[i * n + j] = now.inertia[i][j]
    for p in range(n):
        pivot = inverse[p * n + p]
        if pivot == 0.0:
            return
        inverse[p * n + p] = 1.0
        for j in range(n):
            inverse[p * n + j] /= pivot
        for i in range(n):
            if i != p:
                factor = inverse[i * n + p]
                inverse[i * n + p] = 0.0
                for j in range(n):
                    inverse[i * n + j] -= factor * inverse[p * n + j]


@compiled
def lead(law: Any, now: LawInput, j: int, i: int) -> None:
    """Writes the torque that the leader's end of that coupling feels.

    The controller leaves of the follower's torque what the known energy pays for in the time
    ahead. In it the joint goes on as before, and farther by what torques of this tick add to
    those of the tick before, its own included. A deficit is repaid by damping.
    """
    n = now.joints
    h = now.h_s
    asked = now.received[j].F[i]
    at = j * n + i
    spare = max(now.sent[j].W_led[i] - law.floor, 0.0)
    sign = 1.0 if asked > 0.0 else -1.0
    most = abs(asked)
    step = now.qd[i] * h
    own = 0.0
    half = 0.5 * h * h
    if law.by_step:
        half *= AHEAD * AHEAD
        own = half * law.inverse[i * n + i] / law.beta
        step = AHEAD * step + AHEAD**2 * (law.ahead[i] - step)
        for one in range(n):
            step += half * law.inverse[i * n + one] * law.change[one]
    # without a torque here
    away = half * law.acceleration_rad_s2 - sign * step - own * sign * law.F_now[at]
    if most * (away + own * most) > spare:
        if own > 0.0:
            most = max(math.sqrt(away * away + 4.0 * own * spare) - away, 0.0) / (2.0 * own)
        else:
            most = spare / away
    torque = asked if not law.controlled else sign * most
    owed = law.floor - now.sent[j].W_led[i]
    if law.controlled and own > 0.0 and owed > 0.0 and now.qd[i] * law.ahead[i] > 0.0:
        damping = 0.25 * h * AHEAD**2 / (n * len(now.peers) * own)
        torque += now.qd[i] * min(0.1 * owed / (now.qd[i] * law.ahead[i]), damping)
    law.change[i] -= (torque - law.F_now[at]) / law.beta
    law.F_now[at] = torque


@compiled
def control_follower(
    law: Any, now: LawInput, j: int, i: int, force: float, price: float
) -> float:
    """Sets the velocity by which peer j is followed: its own, less what cannot be paid; returns
    what is left.

    `price` is what the period is expected to cost beyond the work of that velocity.
    """
    at = j * now.joints + i
    h = now.h_s
    peer = now.peers[j]
    known = now.received[j].E_led[i] + 0.5 * law.reserve_J - law.E_moved[at] + law.E_yielded[at]
    if law.by_step:  # half of the reserve is for what steps cost more than planned
        known = max(known - price, 0.0)
    law.v_led[at] = peer.qd[i]
    left: float = known - max(force * peer.qd[i] * h, 0.0)
    if law.controlled and left < 0.0 and abs(force) > _SLACK_NM:
        law.v_led[at] += left / (force * h)
    return left


@compiled
def correct_drift(law: Any, now: LawInput, i: int, error: float, room: float) -> float:
    """Returns the velocity that takes the goal to where the peers are, as far as couplings pay
    for it.

    `room` is what they have left together. The goal moves for all peers: the work of the torque
    counts, by steps that of the damper and the spring which answer, and what these do with the
    peers' velocities too.
    """
    h = now.h_s
    more = max(-law.drift_rad_s, min(law.drift_rad_s, error / now.h_s))
    linear = law.force[i] * (1.0 if more > 0.0 else -1.0)
    square = 0.0
    most = abs(more)
    power = room / h
    if law.by_step:
        power = room / max(SPENT_S, h)
        square = law.B[i] + 0.5 * law.K[i] * h
        for j in range(len(now.peers)):
            linear += law.B[i] * now.peers[j].alpha * abs(now.peers[j].qd[i])
    if square > 0.0:
        most = (math.sqrt(linear * linear + 4.0 * square * power) - linear) / (2.0 * square)
    elif linear > 0.0:
        most = power / linear
    return float(max(-most, min(most, more)))


@compiled
def afford(law: Any, now: LawInput, j: int, i: int, force: float) -> float:
    """Returns the velocity of the goal by peer j, less where that costs more than is known."""
    at = j * now.joints + i
    work = now.peers[j].alpha * force * now.h_s
    known = now.received[j].E_led[i] + 0.5 * law.reserve_J - law.E_moved[at] + law.E_yielded[at]
    known = max(known, 0.0)
    velocity = float(law.v_led[at])
    return known / work if law.controlled and work * velocity > known else velocity


@compiled
def book_follower(law: Any, now: LawInput, j: int, i: int, force: float, drift: float) -> None:
    """Books the follower's end of the coupling to peer j, and its part of what drift
    compensation takes.

    By steps, the torque is that of the velocity in use, and the energy too; as it is published,
    both are those of the leader's velocity, and what the controller changes is booked apart.
    What drift compensation gives back stays here.
    """
    at = j * now.joints + i
    h = now.h_s
    velocity = law.v_led[at] if law.by_step else now.peers[j].qd[i]
    energy = force * velocity * h
    if energy >= 0.0:
        law.E_moved[at] += energy
    else:
        now.sent[j].E_followed[i] -= energy
    law.E_yielded[at] += force * (velocity - law.v_led[at]) * h - drift
    now.sent[j].W_followed[i] = (
        now.received[j].E_led[i] + law.reserve_J - law.E_moved[at] + law.E_yielded[at]
    )


@compiled
def charge_unpaid(law: Any, now: LawInput, i: int, spring: float) -> None:
    """Charges what the spring and the arm got in the period before, beyond what couplings paid,
    to them.

    What the damper takes in other periods repays that, and no more.
    """
    moved = now.q[i] - now.q_before[i] - law.aligned[i]
    unpaid = law.force[i] * moved + spring - law.spring[i] - law.paid[i]
    for j in range(len(now.peers)):
        at = j * now.joints + i
        if law.by_step and now.k > 0:
            charged = max(now.peers[j].alpha * unpaid, -law.lent[at])
            law.E_moved[at] += charged
            law.lent[at] += charged
        law.E_settled[at] = law.E_moved[at] - law.E_yielded[at]
    law.spring[i] = spring


@compiled
def settle_follower(
    law: Any, now: LawInput, i: int, stretch: float, more: float, room: float
) -> None:
    """Settles torque and velocities of a joint that follows, `more` that of drift compensation,
    and books.

    By steps, the torque is that of velocities which pay for it; several peers share one torque.
    """
    n = now.joints
    h = now.h_s
    force = law.force[i]
    velocity = 0.0
    for sweep in range(1 + SWEEPS * law.by_step):
        if sweep > 0:
            force = law.K[i] * stretch + law.B[i] * (velocity - now.qd[i])
            force = max(law.low[i], min(law.high[i], force))
            more = room / (force * h) if force * more * h > room else more
        velocity = more
        for j in range(len(now.peers)):
            if sweep > 0:
                law.v_led[j * n + i] = afford(law=law, now=now, j=j, i=i, force=force)
            velocity += now.peers[j].alpha * law.v_led[j * n + i]
    for j in range(len(now.peers)):
        part = law.left[j * n + i] / room if room > 0.0 else 0.0
        book_follower(
            law=law,
            now=now,
            j=j,
            i=i,
            force=now.peers[j].alpha * force,
            drift=part * force * more * h,
        )
    law.goal[i] += h * velocity
    law.force[i] = force
    law.paid[i] = force * velocity * h + force * law.aligned[i]


@compiled
def follow(law: Any, now: LawInput, i: int) -> None:
    """Moves the goal of a joint by the velocities of the peers, and writes the torque that
    follows it.
    """
    n = now.joints
    h = now.h_s
    K = law.K[i]
    B = law.B[i]
    target = velocity = 0.0
    for j in range(len(now.peers)):
        target += now.peers[j].alpha * now.peers[j].q[i]
        velocity += now.peers[j].alpha * now.peers[j].qd[i]
    if now.k == 0:
        law.goal[i] = target
    way = now.q_des[i] - target
    # in half a period
    law.aligned[i] = 0.5 * h * (now.qd_des[i] - velocity) if way != 0.0 else 0.0
    stretch = law.goal[i] + way - now.q[i]
    pull = max(law.low[i], min(law.high[i], K * stretch))
    charge_unpaid(law, now, i, pull * (stretch - 0.5 * pull / K) if K > 0.0 else 0.0)
    law.force[i] = max(law.low[i], min(law.high[i], K * stretch + B * (velocity - now.qd[i])))
    gap = velocity * h - law.ahead[i]  # by which the spring is expected to become longer
    price = max((0.5 * K * gap - B * (velocity - now.qd[i])) * gap, 0.0)
    more = room = least = 0.0
    for j in range(len(now.peers)):
        alpha = now.peers[j].alpha
        now.sent[j].F[i] = alpha * law.force[i]
        left = control_follower(
            law=law, now=now, j=j, i=i, force=alpha * law.force[i], price=alpha * price
        )
        law.left[j * n + i] = max(left, 0.0) * (alpha > 0.0)
        room += law.left[j * n + i]
        least = min(least, left)
    if law.drift_rad_s > 0.0 and room > 0.0 and least >= 0.0:
        more = correct_drift(
            law=law, now=now, i=i, error=target - law.goal[i] - h * velocity, room=room
        )
    settle_follower(law=law, now=now, i=i, stretch=stretch, more=more, room=room)


@compiled
class Tdpa(EnergyLaw):
    """Time-domain passivity control with delay: each end watches the energy of its coupling,
    and damps.

    Every site follows by K and B towards the integral of its peers' velocities, mixed by
    dominance, and the peers feel that torque; K = 0 and B = 0 make a site lead only. After Ryu,
    Artigas and Preusche (2010); of several sites after Panzirsch and others (2012).

    Attributes:
        K: spring by which the site follows, per joint, N m/rad; 0: it follows nobody.
        B: damper by which it follows, per joint, N m s/rad.
        acceleration_rad_s2: by which torques that are not the law's change a joint's
            acceleration from tick to tick, as far as leaders' controllers cover it beforehand;
            half of the reserve covers it too.
        drift_rad_s: largest velocity by which positions are made to agree again; 0: they drift.
        reserve_J: energy per joint and peer with which an end begins.
        energy: "step": what the arm gets, torque times the step in q; "velocity": torque times
            velocity times period, as it is published.
        beta: the site's torque is divided by it, dimensionless: who feels whom.
    """

    K: NotNegativeJoints = (100.0,)
    B: NotNegativeJoints = (10.0,)
    acceleration_rad_s2: NotNegative = 0.0
    drift_rad_s: NotNegative = 0.5
    reserve_J: NotNegative = 1e-3
    energy: Literal["step", "velocity"] = "step"
    beta: Positive = 1.0

    sends: ClassVar[Any] = {
        "F": {"unit": "N m", "length": "joints", "per_peer": True},
        "E_led": {"unit": "J", "length": "joints", "per_peer": True},
        "E_followed": {"unit": "J", "length": "joints", "per_peer": True},
        "W_led": {"unit": "J", "length": "joints", "per_peer": True},  # observed here, for logs
        "W_followed": {"unit": "J", "length": "joints", "per_peer": True},
    }
    remembers: ClassVar = (
        *("goal", "F_led", "E_known", "E_moved", "E_yielded", "lent"),
        *("carried", "spring", "force", "paid", "E_settled"),
    )
    needs_model: ClassVar = True
    tune: ClassVar = {"K": STIFFNESS, "B": DAMPING}
    known_facts: ClassVar = "gravity, and inertia for two ticks"
    controlled = True
    """False: it watches only, for comparison."""

    def begin(self, facts: LawContext) -> None:
        """Makes the books of both ends of each coupling."""
        n = facts.joints
        peers = len(facts.peers)
        self.by_step = self.energy == "step"
        self.controlled = bool(self.controlled)
        self.floor = 0.5 * self.reserve_J if self.by_step else 0.0
        self.tau_limit = (np.zeros(n) + facts.tau_limit_nm).tolist()
        self.goal = [0.0] * n
        self.ahead = [0.0] * n
        self.low = [0.0] * n
        self.high = [0.0] * n
        self.change = [0.0] * n
        self.aligned = [0.0] * n
        self.F_led, self.F_now, self.v_led, self.E_known = (
            [0.0] * (n * peers) for _ in range(4)
        )
        self.E_moved, self.E_yielded, self.lent, self.E_settled = (
            [0.0] * (n * peers) for _ in range(4)
        )
        self.carried, self.spring, self.force, self.paid = ([0.0] * n for _ in range(4))
        self.inverse = [0.0] * (n * n)
        self.left = [0.0] * (n * peers)

    def torque(self, now: LawInput) -> None:
        """Writes the torque; sends torques and energies."""
        n = now.joints
        peers = len(now.peers)
        invert_inertia(self, now)
        for i in range(n):
            self.change[i] = self.carried[i] - now.tau_before[i]
            self.carried[i] = self.gravity * now.gravity[i]
            self.low[i] = self.beta * (-self.tau_limit[i] - self.carried[i])
            self.high[i] = self.beta * (self.tau_limit[i] - self.carried[i])
            self.ahead[i] = now.qd[i] * now.h_s
            if now.k > 0:
                self.ahead[i] += self.ahead[i] - (now.q[i] - now.q_before[i])
            follow(self, now, i)
            self.change[i] += self.force[i] / self.beta
            for j in range(peers):
                observe_leader(self, now, j, i)
                self.F_now[j * n + i] = self.F_led[j * n + i]
                self.change[i] -= self.F_now[j * n + i] / self.beta
        for _ in range(SWEEPS):
            for i in range(n):
                for j in range(peers):
                    lead(self, now, j, i)
        for i in range(n):
            felt = 0.0
            force = self.force[i]
            for j in range(peers):
                felt += self.F_now[j * n + i]
            within = max(force - self.high[i], min(force - self.low[i], felt))
            share = 1.0 if within == felt else within / felt
            for j in range(peers):
                at = j * n + i
                self.F_led[at] = share * self.F_now[at]
                if not self.by_step:
                    now.sent[j].W_led[i] += book(
                        now=now, j=j, i=i, torque=self.F_led[at], step=now.qd[i] * now.h_s
                    )
            now.tau[i] = self.carried[i] + (force - within) / self.beta

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns the energies of both ends of all couplings, those of following up to the
        period before.
        """
        gave = []
        took = []
        observed = []
        n = seen.q.shape[1]
        for j, peer in enumerate(seen.peers):
            came = peer.received
            sent = peer.sent
            followed = np.vstack([np.zeros(n), sent["E_followed"][:-1]])
            gave.append(np.hstack([sent["E_led"], followed]))
            settled = seen.memory["E_settled"][:, j * n : (j + 1) * n]
            took.append(
                np.hstack([settled - self.reserve_J, came["E_followed"] - sent["W_led"]])
            )
            observed.append(np.hstack([sent["W_led"], sent["W_followed"]]))
        port = -self.beta * sum_work(seen.tau - seen.memory["carried"], seen.q)
        return LawEnergies(
            *(gave, took, port, seen.memory["spring"]),
            observed=observed,
            weight=self.beta,
            gravity=self.gravity,
        )

    def explain_no_linear_form(self) -> str:
        """Returns why it cannot be linearised."""
        return (
            "its controllers act by the energy observed, which is of second order in the motion"
        )

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns that a site without K and B follows nobody."""
        return "" if any(self.K) or any(self.B) else "K = 0 and B = 0 follow nobody"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns that the couplings are passive, as far as motion can be foretold."""
        text = f"couplings are passive for any delays, jitter, loss and shares, where {PASSIVE_OUTSIDE}, "
        if self.energy == "velocity":
            return StabilityCondition(True, f"{text}in books that leak tau qdd h^2 / 2 a tick")
        beyond = (
            f" beyond {self.acceleration_rad_s2:g} rad/s^2" if self.acceleration_rad_s2 else ""
        )
        paid = f"while half of reserve_J pays for what other torques change accelerations by in a tick{beyond}"
        return StabilityCondition(True, f"{text}{paid}")
