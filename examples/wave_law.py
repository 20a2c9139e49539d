"""Wave variables in plain Python, as a law of your own: the built-in `wave` where no sample is late or lost.

In this folder:  trilat sim two_sites --set control.law=wave_law:Wave --set sites.s.control.K=100
                 --set sites.s.control.B=10 -o wave.mcap;  trilat verify wave.mcap --law wave_law.py

Sites are joined by lines of impedance b, c = sqrt(2 b). A site without a spring of its own is pushed by -F,
F = b qd - c v, where v is the wave that comes out of the line, and sends u = c qd - v into it, a tick later,
when the arm's step is known. One with a spring K and a damper B follows q_sd, whose velocity solves
c v = b qd_sd + F, and sends v - (c / b) F. See docs/laws.md.
"""

import math
from typing import ClassVar

import trilat_net as tn


class Wave:
    """One end of a line to each peer."""

    sends: ClassVar = {"u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True}}
    remembers = ("q_sd", "played")

    def __init__(
        self, facts: tn.LawContext, b: float = 10.0, K: float = 0.0, B: float = 0.0
    ) -> None:
        self.b, self.K, self.B = b, K, B
        self.c = math.sqrt(2.0 * b)
        self.q_sd = [[0.0] * facts.joints for _ in facts.peers]
        self.played = [[0.0] * facts.joints for _ in facts.peers]

    def torque(self, now: tn.LawInput) -> list[float]:
        """Returns the torque of each joint, and sends the waves."""
        if now.k == 0:
            self.q_sd = [list(peer.q) for peer in now.peers]  # they begin where they stand
        tau = list(now.gravity)
        for j, peer in enumerate(now.peers):
            for i in range(now.joints):
                # a wave that does not come is none
                v = now.received[j].u[i] if peer.new else 0.0
                if self.K == 0.0:  # the line pushes the arm
                    step = now.q[i] - now.q_before[i]
                    force, wave = (
                        self.c * v - self.b * now.qd[i],
                        self.c * step / now.h_s - self.played[j][i],
                    )
                    self.played[j][i] = v
                else:
                    force, wave = self.follow(now, j, i, v)
                now.sent[j].u[i] = wave
                tau[i] += force
        return tau

    def follow(self, now: tn.LawInput, j: int, i: int, v: float) -> tuple[float, float]:
        """Returns the torque of a spring whose far end the line moves, and the wave that goes back."""
        stretch = self.q_sd[j][i] - now.q[i]
        qd_sd = (self.c * v - self.K * stretch + self.B * now.qd[i]) / (self.b + self.B)
        force = self.K * stretch + self.B * (qd_sd - now.qd[i])
        self.q_sd[j][i] += now.h_s * qd_sd
        return force, v - self.c / self.b * force
