"""Wave variables in plain Python: the built-in law `wave`, written as a law of your own.

If no sample is late or lost, the results equal those of the built-in law. In this folder:

    trilat sim two_sites --set control.law=wave_law:Wave --set sites.s.control.K=100 \
        --set sites.s.control.B=10 -o wave.mcap
    trilat verify wave.mcap --law wave_law.py

Two sites exchange waves over a line with the impedance b, and c = sqrt(2 b). At each end of the
line, the incoming wave v gives a force on the arm, and an outgoing wave u is sent back:

- A site without a spring applies F = b qd - c v to the arm, with the opposite sign. It sends
  u = c qd - v one tick later, when the motion of the arm in the tick is known.
- A site with a spring K and a damper B moves the far end of the spring, q_sd, so that
  c v = b qd_sd + F. It sends u = v - (c / b) F.

docs/reference/laws.md derives these equations.
"""

import math
from typing import ClassVar

import trilat_net as tn


class Wave:
    """Control law of one site, with a wave line to each peer.

    Args:
        facts: numbers of joints and peers.
        b: impedance of the lines, N m s/rad.
        K: stiffness of the spring between arm and line, N m/rad. 0: no spring.
        B: damping beside the spring, N m s/rad.
    """

    sends: ClassVar = {"u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True}}
    remembers = ("q_sd", "played")

    def __init__(
        self, facts: tn.LawContext, b: float = 10.0, K: float = 0.0, B: float = 0.0
    ) -> None:
        self.b = b
        self.K = K
        self.B = B
        self.c = math.sqrt(2.0 * b)
        self.q_sd = [[0.0] * facts.joints for _ in facts.peers]
        self.played = [[0.0] * facts.joints for _ in facts.peers]

    def torque(self, now: tn.LawInput) -> list[float]:
        """Returns the torque of each joint, and sends a wave to each peer."""
        if now.k == 0:
            # the springs start without tension
            self.q_sd = [list(peer.q) for peer in now.peers]
        tau = list(now.gravity)
        for j, peer in enumerate(now.peers):
            for i in range(now.joints):
                # a tick without a new sample brings no wave
                received_wave = now.received[j].u[i] if peer.new else 0.0
                if self.K == 0.0:
                    force, sent_wave = self.push(now, j, i, received_wave)
                else:
                    force, sent_wave = self.pull(now, j, i, received_wave)
                now.sent[j].u[i] = sent_wave
                tau[i] += force
        return tau

    def push(self, now: tn.LawInput, j: int, i: int, v: float) -> tuple[float, float]:
        """Returns the torque of a line without a spring, and the wave that is sent back.

        Args:
            now: the state of the site in this tick.
            j: index of the peer.
            i: index of the joint.
            v: the received wave.
        """
        moved = now.q[i] - now.q_before[i]
        force = self.c * v - self.b * now.qd[i]
        sent_wave = self.c * moved / now.h_s - self.played[j][i]
        self.played[j][i] = v
        return force, sent_wave

    def pull(self, now: tn.LawInput, j: int, i: int, v: float) -> tuple[float, float]:
        """Returns the torque of a line with a spring, and the wave that is sent back.

        The arguments are those of `push`.
        """
        stretch = self.q_sd[j][i] - now.q[i]
        qd_sd = (self.c * v - self.K * stretch + self.B * now.qd[i]) / (self.b + self.B)
        force = self.K * stretch + self.B * (qd_sd - now.qd[i])
        self.q_sd[j][i] += now.h_s * qd_sd
        return force, v - self.c / self.b * force
