"""Time-domain passivity control: each end of a coupling watches what it takes out, and limits it.

Invariant: in every directed coupling of a follower to a leader each end books, cumulatively and per joint,
the energy that it puts in; the other end takes out no more than it knows of.

A follower is moved by F = K (q_sd - q) + B (v - qd), where v mixes the leaders' velocities by dominance and
q_sd is its integral; the leader feels -F by the same factor.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
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
    """Books the leader's end of the coupling by which peer j follows; returns the torque that it feels.

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
    if not law.by_step:
        observed += book(now, j, i, torque, velocity * h)
    law.F_led[at], sent.W_led[i] = torque, observed
    return float(torque)


@compiled
def follow(law: Any, now: LawInput, j: int, i: int, force: float) -> None:
    """Books the follower's end of the coupling to peer j, and moves what it follows."""
    at, h, peer = j * now.joints + i, now.h_s, now.peers[j]
    velocity = peer.qd[i]
    energy = force * velocity * h
    if energy >= 0.0:
        law.E_moved[at] += energy
    else:
        now.sent[j].E_followed[i] -= energy
    spare = now.received[j].E_led[i] - law.E_moved[at] + law.E_yielded[at]
    if law.controlled and spare < 0.0 and abs(force) > _SLACK_NM:
        velocity += spare / (force * h)
        law.E_yielded[at] -= spare
        spare = 0.0
    elif law.drift_rad_s > 0.0 and spare > 0.0:
        more = (peer.q[i] - law.q_led[at]) / h - velocity
        more = max(-law.drift_rad_s, min(law.drift_rad_s, more))
        if force * more > 0.0:
            most = spare / (abs(force) * h)
            more = max(-most, min(most, more))
        velocity += more
        law.E_yielded[at] -= force * more * h
        spare -= force * more * h
    now.sent[j].W_followed[i] = spare
    law.q_led[at] += h * velocity


@compiled
class Tdpa:
    """A leader's end, a follower's, or both, of a coupling with each peer.

    Args:
        facts: of its site.
        K: spring by which it follows, per joint, N m/rad; 0: it follows nobody.
        B: damper by which it follows, N m s/rad.
        acceleration_rad_s2: most by which an arm accelerates, as far as a leader's controller is to cover it.
        drift_rad_s: largest velocity by which positions are made to agree again; 0: they drift.
        reserve_J: energy that a leader's end begins with, per joint and peer.
        energy: "step": torque times the step in q; "velocity": times velocity and period.
        gravity: share of gravity that it knows.
        controlled: false: it watches only, for comparison.
    """

    sends: ClassVar[Any] = {
        "F": {"unit": "N m", "length": "joints", "per_peer": True},
        "E_led": {"unit": "J", "length": "joints", "per_peer": True},
        "E_followed": {"unit": "J", "length": "joints", "per_peer": True},
        "W_led": {"unit": "J", "length": "joints", "per_peer": True},  # observed here, for logs
        "W_followed": {"unit": "J", "length": "joints", "per_peer": True},
    }
    remembers = (*("q_led", "F_led", "E_known", "E_moved", "E_yielded"),)
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
            force = self.K[i] * (goal - now.q[i]) + self.B[i] * (velocity - now.qd[i])
            now.tau[i] = self.gravity * now.gravity[i] + force
            for j in range(peers):
                now.sent[j].F[i] = now.peers[j].alpha * force
                follow(self, now, j, i, now.peers[j].alpha * force)
                now.tau[i] -= lead(self, now, j, i)
