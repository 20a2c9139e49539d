"""Time-domain passivity control: each end of a coupling watches what it takes out, and limits it.

Invariant: in every directed coupling of a follower to a leader each end books, cumulatively and per joint,
the energy that it puts in; the other end takes out no more than it knows of.

A follower is moved by F = K (q_sd - q) + B (v - qd), where v mixes the leaders' velocities by dominance and
q_sd is its integral; the leader feels -F by the same factor.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ..compiled_law import compiled
from ..law_energy import LawEnergies, LawRecords, sum_work
from ..user_law import LawContext, LawInput

_SLACK_NM = 1e-9
"""A torque that gives a follower's controller nothing to act on."""


@compiled
def book(now: LawInput, j: int, i: int, torque: float, step: float) -> float:
    """Books what a leader's arm gives to a coupling; returns what it takes out, as a negative number."""
    now.sent[j].E_led[i] += max(torque * step, 0.0)
    taken: float = min(torque * step, 0.0)
    return taken


@compiled
def lead(law: Any, now: LawInput, j: int, i: int) -> float:
    """Returns the torque that the leader's end of the coupling feels by which peer j follows.

    The controller leaves of the follower's torque what the known energy pays for in the period to come.
    """
    at, sent = j * now.joints + i, now.sent[j]
    torque, velocity, h = now.received[j].F[i], now.qd[i], now.h_s
    observed = sent.W_led[i] if now.k > 0 else law.reserve
    observed += now.received[j].E_followed[i] - law.E_known[at]
    law.E_known[at] = now.received[j].E_followed[i]
    if law.by_step:  # of the period before, which is over
        observed += book(now, j, i, law.F_led[at], now.q[i] - now.q_before[i])
    sign = 1.0 if torque > 0.0 else -1.0
    away = max(-sign * velocity * h + 0.5 * law.acceleration * h * h, 0.0)
    if law.controlled and away > 0.0 and abs(torque) * away > observed:
        torque = sign * max(observed, 0.0) / away
    law.F_led[at], sent.W_led[i] = torque, observed
    return float(torque)


@compiled
def control_follower(law: Any, now: LawInput, j: int, i: int, force: float) -> float:
    """Returns the velocity by which peer j is followed: its own, less what cannot be paid for, and drift."""
    at, h, peer = j * now.joints + i, now.h_s, now.peers[j]
    velocity: float = peer.qd[i]
    known = now.received[j].E_led[i] + 0.5 * law.reserve - law.E_moved[at] + law.E_yielded[at]
    if law.by_step:  # half of the reserve is for what steps cost more than planned
        known = max(known, 0.0)
    spare = known - max(force * velocity * h, 0.0)
    if law.controlled and spare < 0.0 and abs(force) > _SLACK_NM:
        velocity += spare / (force * h)
    elif law.drift_rad_s > 0.0 and spare > 0.0:
        more = (peer.q[i] - law.q_led[at]) / h - velocity
        more = max(-law.drift_rad_s, min(law.drift_rad_s, more))
        damper = peer.alpha * peer.alpha * law.B[i] if law.by_step else 0.0  # it acts on what is added, too
        against = abs(force) * (force * more > 0.0) + damper * (abs(velocity) + law.drift_rad_s)
        if against > 0.0:
            most = spare / (against * h)
            more = max(-most, min(most, more))
        velocity += more
    return velocity


@compiled
def follow(law: Any, now: LawInput, j: int, i: int, force: float) -> None:
    """Books the follower's end of the coupling to peer j, and moves what it follows.

    By steps, the torque is that of the velocity in use, and the energy too; as it is published, both are
    those of the leader's velocity, and what the controller changes is booked apart.
    """
    at, h = j * now.joints + i, now.h_s
    velocity = law.v_led[at] if law.by_step else now.peers[j].qd[i]
    led = now.received[j].E_led[i] + law.reserve
    known = max(led - law.E_moved[at] + law.E_yielded[at] - 0.5 * law.reserve, 0.0)
    if law.by_step and law.controlled and force * velocity * h > known:
        velocity = law.v_led[at] = known / (force * h)  # several peers share one torque
    energy = force * velocity * h
    if energy >= 0.0:
        law.E_moved[at] += energy
    else:
        now.sent[j].E_followed[i] -= energy
    law.E_yielded[at] += force * (velocity - law.v_led[at]) * h
    now.sent[j].W_followed[i] = led - law.E_moved[at] + law.E_yielded[at]
    law.q_led[at] += h * law.v_led[at]


@compiled
def charge_unpaid(law: Any, now: LawInput, i: int, spring: float) -> None:
    """Charges what the spring and the arm got in the period before, beyond what couplings paid, to them."""
    unpaid = law.force[i] * (now.q[i] - now.q_before[i]) + spring - law.spring[i] - law.paid[i]
    for j in range(len(now.peers)):
        at = j * now.joints + i
        if law.by_step and unpaid > 0.0 and now.k > 0:
            law.E_moved[at] += now.peers[j].alpha * unpaid
        law.E_settled[at] = law.E_moved[at] - law.E_yielded[at]
    law.spring[i] = spring


@compiled
class Tdpa:
    """A leader's end, a follower's, or both, of a coupling with each peer.

    Args:
        facts: of its site.
        K: spring by which it follows, per joint, N m/rad; 0: it follows nobody.
        B: damper by which it follows, N m s/rad.
        acceleration_rad_s2: most by which an arm accelerates, as far as a leader's controller is to cover it.
        drift_rad_s: largest velocity by which positions are made to agree again; 0: they drift.
        reserve_J: energy that an end begins with, per joint and peer.
        energy: "step": torque times the step in q; "velocity": times velocity and period.
        gravity: share of gravity that it knows.
        beta: the torque is divided by it.
        controlled: false: it watches only, for comparison.
    """

    sends: ClassVar[Any] = {
        "F": {"unit": "N m", "length": "joints", "per_peer": True},
        "E_led": {"unit": "J", "length": "joints", "per_peer": True},
        "E_followed": {"unit": "J", "length": "joints", "per_peer": True},
        "W_led": {"unit": "J", "length": "joints", "per_peer": True},  # observed here, for logs
        "W_followed": {"unit": "J", "length": "joints", "per_peer": True},
    }
    remembers = (
        *("q_led", "F_led", "E_known", "E_moved", "E_yielded"),
        *("carried", "spring", "force", "paid", "E_settled"),
    )
    schemes = ("digital",)

    def __init__(
        self,
        facts: LawContext,
        K: Sequence[float],
        B: Sequence[float],
        acceleration_rad_s2: float,
        drift_rad_s: float,
        reserve_J: float,
        energy: str,
        gravity: float,
        beta: float = 1.0,
        controlled: bool = True,
    ) -> None:
        size = facts.joints * len(facts.peers)
        self.K, self.B = list(K), list(B)
        self.acceleration, self.drift_rad_s = float(acceleration_rad_s2), float(drift_rad_s)
        self.reserve, self.gravity = float(reserve_J), float(gravity)
        self.by_step, self.controlled = energy == "step", controlled
        self.q_led, self.F_led = [0.0] * size, [0.0] * size
        self.E_known = [0.0] * size
        self.E_moved, self.E_yielded = [0.0] * size, [0.0] * size
        self.beta, self.tau_limit = float(beta), (np.zeros(facts.joints) + facts.tau_limit_nm).tolist()
        self.carried, self.spring = [0.0] * facts.joints, [0.0] * facts.joints
        self.v_led, self.E_settled = [0.0] * size, [0.0] * size
        self.force, self.paid = [0.0] * facts.joints, [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque; sends torques and energies."""
        n, peers = now.joints, len(now.peers)
        for i in range(n):
            goal = velocity = 0.0
            for j in range(peers):
                at, peer = j * n + i, now.peers[j]
                if now.k == 0:
                    self.q_led[at] = peer.q[i]
                goal += peer.alpha * self.q_led[at]
                velocity += peer.alpha * peer.qd[i]
            stretch, self.carried[i] = goal - now.q[i], self.gravity * now.gravity[i]
            low = self.beta * (-self.tau_limit[i] - self.carried[i])
            high = self.beta * (self.tau_limit[i] - self.carried[i])
            pull = max(low, min(high, self.K[i] * stretch))
            spring = pull * (stretch - 0.5 * pull / self.K[i]) if self.K[i] > 0.0 else 0.0
            charge_unpaid(self, now, i, spring)
            force = self.K[i] * stretch + self.B[i] * (velocity - now.qd[i])
            force = max(low, min(high, force))
            moved = felt = 0.0
            for j in range(peers):
                alpha = now.peers[j].alpha
                now.sent[j].F[i] = alpha * force
                self.v_led[j * n + i] = control_follower(self, now, j, i, alpha * force)
                moved += alpha * self.v_led[j * n + i]
            if self.by_step:
                force = max(low, min(high, self.K[i] * stretch + self.B[i] * (moved - now.qd[i])))
            moved = 0.0
            for j in range(peers):
                follow(self, now, j, i, now.peers[j].alpha * force)
                moved += now.peers[j].alpha * self.v_led[j * n + i]
                felt += lead(self, now, j, i)
            self.force[i], self.paid[i] = force, force * moved * now.h_s
            within = max(force - high, min(force - low, felt))
            share = 1.0 if within == felt else within / felt
            for j in range(peers):
                self.F_led[j * n + i] *= share
                if not self.by_step:
                    now.sent[j].W_led[i] += book(now, j, i, self.F_led[j * n + i], now.qd[i] * now.h_s)
            now.tau[i] = self.carried[i] + (force - within) / self.beta

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns the energies of both ends of all couplings, those of following up to the period before."""
        gave, took, observed = [], [], []
        n = seen.q.shape[1]
        for j, peer in enumerate(seen.peers):
            came, sent = peer.received, peer.sent
            followed = np.vstack([np.zeros(n), sent["E_followed"][:-1]])
            gave.append(np.hstack([sent["E_led"], followed]))
            settled = seen.memory["E_settled"][:, j * n : (j + 1) * n]
            took.append(np.hstack([settled - self.reserve, came["E_followed"] - sent["W_led"]]))
            observed.append(np.hstack([sent["W_led"], sent["W_followed"]]))
        port = -self.beta * sum_work(seen.tau - seen.memory["carried"], seen.q)
        return LawEnergies(
            *(gave, took, port, seen.memory["spring"]),
            observed=observed,
            weight=self.beta,
            gravity=self.gravity,
        )
