"""Wave variables: every pair of sites is joined by a line of some impedance, in which waves travel.

Invariant: an end takes no more energy out of a line than the other end is known to have put in, whatever
becomes of samples; so the energy that a line stores is never negative (but for the reception `hold`).

Of one line and joint, with c = sqrt(2 b) and v the wave that an end plays:

    without a spring of its own (K = 0)    F = b qd - c v, pushed by -F, sends c qd - v
    with K and B                           qd_sd = (c v - K (q_sd - q) + B qd) / (b + B), q_sd follows,
                                           F = K (q_sd - q) + B (qd_sd - qd), pushed by F, sends v - (c / b) F
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from ..compiled_law import compiled
from ..user_law import LawContext, LawInput

RECEPTIONS = ("replay", "zero", "scaled", "hold")
"""How waves are played, by number. `hold` repeats the last wave; it is not passive, and for comparison."""
_REPLAY, _SCALED, _HOLD = 0, 2, 3
STAMP_FILTER_TICKS = 20.0
"""Time constant of the rate at which stamps advance, ticks."""


@compiled
def replay_wave(law: Any, at: int, fresh: float, energy: float, h: float) -> float:
    """Returns a wave that makes up for those which never came, as far as their energy allows.

    Their integral is owed. It is played at its mean or slower; per unit of it at most its part of the energy
    is spent.
    """
    owed = abs(law.owed_U[at])
    if owed == 0.0:
        return fresh
    sign = 1.0 if law.owed_U[at] > 0.0 else -1.0
    mean = owed / max(law.owed_s[at], h)
    extra: float = max(0.0, min(2.0 * (energy / owed - sign * fresh), mean))
    law.owed_U[at] -= sign * extra * h
    law.owed_s[at] -= extra / mean * h
    return fresh + sign * extra


@compiled
def take_wave(law: Any, now: LawInput, j: int, i: int, missed: float) -> float:
    """Returns the wave of line j that an end plays at a tick, and books its energy.

    `missed` counts the samples between the one in use and the one before it; -1: no new one came.
    """
    received, sent, at, h = now.received[j], now.sent[j], j * now.joints + i, now.h_s
    fresh = own = 0.0
    if missed >= 0.0:
        fresh = law.wave[at] = received.u[i]
        own = 0.5 * fresh * fresh * h
        if missed > 0.0:
            energy = max(received.E[i] - law.E_seen[at] - own, 0.0)
            law.owed_U[at] += received.U[i] - law.U_seen[at] - fresh * h
            law.owed_s[at] += missed * h if energy > 0.0 else 0.0
            sent.W[i] += energy
        law.U_seen[at], law.E_seen[at] = received.U[i], received.E[i]
    played = fresh
    if law.reception == _REPLAY:
        played = replay_wave(law, at, fresh, sent.W[i], h)
    elif law.reception == _SCALED:
        most = math.sqrt(2.0 * max(sent.W[i] + own, 0.0) / h)
        played = max(-most, min(most, math.sqrt(law.rate[j]) * law.wave[at]))
    elif law.reception == _HOLD:
        played = law.wave[at]
    sent.W[i] += own - 0.5 * played * played * h
    return played


def find_line(lines: Mapping[str, float], site: str, peer: str) -> float | None:
    """Returns the impedance that a table such as {"m1-s": 18.0} has for a line, or None."""
    return lines.get(f"{site}-{peer}", lines.get(f"{peer}-{site}"))


@compiled
class Wave:
    """One end of a line to each peer, or of several.

    Args:
        facts: of its site.
        b: impedance of the lines per joint, N m s/rad.
        K: spring of an end that moves its arm by one, per joint, N m/rad; 0: none.
        B: damper of such an end, N m s/rad; b matches it to the line.
        lines: impedances of single lines, all joints alike, as in {"m1-s": 18.0}.
        beta: the torque is divided by it.
        reception: one of `RECEPTIONS`.
        gravity: share of gravity that it knows.
    """

    sends: ClassVar[Any] = {
        "u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True},
        "U": {"unit": "sqrt(W) s", "length": "joints", "per_peer": True},
        "E": {"unit": "J", "length": "joints", "per_peer": True},
        "W": {"unit": "J", "length": "joints", "per_peer": True},  # known and not played: for logs
    }
    remembers = ("q_sd", "wave", "U_seen", "E_seen", "owed_U", "owed_s", "stamp", "rate")

    def __init__(
        self,
        facts: LawContext,
        b: Sequence[float],
        K: Sequence[float],
        B: Sequence[float],
        lines: Mapping[str, float],
        beta: float,
        reception: str,
        gravity: float,
    ) -> None:
        n, peers = facts.joints, len(facts.peers)
        self.K, self.B, self.beta, self.gravity = list(K), list(B), float(beta), float(gravity)
        self.b: list[float] = []
        for peer in facts.peers:
            line = find_line(lines, facts.site, peer)
            self.b += b if line is None else [line] * n
        self.reception = RECEPTIONS.index(reception)
        self.q_sd, self.wave = [0.0] * (n * peers), [0.0] * (n * peers)
        self.U_seen, self.E_seen = [0.0] * (n * peers), [0.0] * (n * peers)
        self.owed_U, self.owed_s = [0.0] * (n * peers), [0.0] * (n * peers)
        self.stamp, self.rate = [-1.0] * peers, [1.0] * peers

    def torque(self, now: LawInput) -> None:
        """Writes the torque, and sends the waves."""
        for i in range(now.joints):
            now.tau[i] = self.gravity * now.gravity[i]
        for j in range(len(now.peers)):
            peer, sent = now.peers[j], now.sent[j]
            missed = -1.0
            if peer.new:
                missed = peer.tick - self.stamp[j] - 1.0
                self.stamp[j] = peer.tick
            if self.stamp[j] >= 0.0:
                self.rate[j] += (missed + 1.0 - self.rate[j]) / STAMP_FILTER_TICKS
            for i in range(now.joints):
                at = j * now.joints + i
                b = self.b[at]
                if b == 0.0:
                    continue
                c = math.sqrt(2.0 * b)
                played = take_wave(self, now, j, i, missed)
                if self.K[i] == 0.0:
                    force = c * played - b * now.qd[i]
                    u = c * now.qd[i] - played
                else:
                    if now.k == 0:
                        self.q_sd[at] = peer.q[i]
                    stretch = self.q_sd[at] - now.q[i]
                    qd_sd = (c * played - self.K[i] * stretch + self.B[i] * now.qd[i]) / (b + self.B[i])
                    force = self.K[i] * stretch + self.B[i] * (qd_sd - now.qd[i])
                    u = played - c / b * force
                    self.q_sd[at] += now.h_s * qd_sd
                now.tau[i] += force / self.beta
                sent.u[i] = u
                sent.U[i] += u * now.h_s
                sent.E[i] += 0.5 * u * u * now.h_s
