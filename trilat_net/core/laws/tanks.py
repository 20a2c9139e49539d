"""Two layers: a transparency layer that may do anything, over a tank of energy that pays for it.

Invariant: a tank is filled by the work that the arm does on its controller and by the energy packets of the
peers, and pays the work that the torque does on the arm, tau times the step in q; where it is empty, there is
no torque of the transparency layer. Packets are cumulative: lost samples cost nothing.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from ..compiled_law import compiled
from ..law_energy import LawEnergies, LawRecords, sum_work
from ..user_law import LawContext, LawInput


@compiled
class Tanks:
    """Springs and dampers to the reference of Eq. (6), paid from a tank per site.

    Args:
        facts: of its site.
        K: stiffness of the transparency layer per joint, N m/rad.
        Kd: its damping of the error's velocity, N m s/rad.
        d: its damping of the arm's velocity, N m s/rad.
        level_J: level to which a tank is kept.
        fill_nm_s_rad_J: damping per energy that is missing, N m s/rad/J.
        packet_1_s: rate at which a tank is emptied towards its peers, 1/s.
        by_shares: true: peers get parts by this site's dominance factors; false: equal ones.
        acceleration_rad_s2: most by which a joint accelerates, as far as the tank is to cover it.
        gravity: share of gravity that it knows.
        guarded: false: the transparency layer alone, for comparison.
    """

    sends: ClassVar[Any] = {
        "H": {"unit": "J", "length": 1},  # what is in the tank: peers have no use for it, logs have
        "E": {"unit": "J", "length": 1, "per_peer": True},
    }
    remembers = ("E_seen", "carried")
    schemes = ("digital",)

    def __init__(
        self,
        facts: LawContext,
        K: Sequence[float],
        Kd: Sequence[float],
        d: Sequence[float],
        level_J: float,
        fill_nm_s_rad_J: float,
        packet_1_s: float,
        by_shares: bool,
        acceleration_rad_s2: float,
        gravity: float,
        guarded: bool = True,
    ) -> None:
        n = facts.joints
        self.K, self.Kd, self.d = list(K), list(Kd), list(d)
        self.level, self.fill, self.gravity = float(level_J), float(fill_nm_s_rad_J), float(gravity)
        self.packet = float(packet_1_s) / facts.rate_hz
        self.farther = 0.5 * acceleration_rad_s2 / facts.rate_hz**2
        self.by_shares, self.guarded = by_shares, guarded
        self.E_seen = [0.0] * len(facts.peers)
        self.carried = [0.0] * n

    def torque(self, now: LawInput) -> None:
        """Writes the torque, and sends the packets."""
        n, peers = now.joints, len(now.peers)
        H = now.to_all.H[0]
        for i in range(n):
            H -= (now.tau_before[i] - self.carried[i]) * (now.q[i] - now.q_before[i])
        for j in range(peers):
            H += now.received[j].E[0] - self.E_seen[j]
            self.E_seen[j] = now.received[j].E[0]
        packet = self.packet * max(H, 0.0)
        H -= packet
        for j in range(peers):
            part = now.peers[j].alpha if self.by_shares else 1.0 / peers
            now.sent[j].E[0] += part * packet
        now.to_all.H[0] = H
        power = force = 0.0
        for i in range(n):
            error, rate = now.q[i] - now.q_des[i], now.qd[i] - now.qd_des[i]
            now.tau[i] = -self.K[i] * error - self.Kd[i] * rate - self.d[i] * now.qd[i]
            power += now.tau[i] * now.qd[i]
            force += abs(now.tau[i])
        affordable, damping = 1.0, 0.0
        if self.guarded:
            affordable = (
                0.0 if H <= 0.0 else min(1.0, H / max(abs(power) * now.h_s + force * self.farther, H))
            )
            damping = self.fill * max(self.level - H, 0.0)
        for i in range(n):
            self.carried[i] = self.gravity * now.gravity[i]
            now.tau[i] = self.carried[i] + affordable * now.tau[i] - damping * now.qd[i]

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns the packets, and what is in the tank: it loses nothing."""
        gave = [peer.sent["E"] for peer in seen.peers]
        took = [seen.memory["E_seen"][:, j : j + 1] for j in range(len(gave))]
        port = -sum_work(seen.tau - seen.memory["carried"], seen.q)
        taken = np.zeros(len(port))
        return LawEnergies(gave, took, port, seen.to_all["H"], taken, gravity=self.gravity)
