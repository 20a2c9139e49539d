"""A law that sends to all its peers and to each of them, for tests."""

from typing import ClassVar

from trilat_net.core.plug.user_law import LawContext, LawInput


class Talking:
    """P+d whose spring pulls towards the targets that peers send.

    The law sends its energy to all peers, and a target to each peer. `energy_sums` accumulate, so
    that a wrong number, once used, stays in every later record.
    """

    sends: ClassVar = {
        "target": {"unit": "rad", "length": "joints", "per_peer": True},
        "energy": {"unit": "J", "length": 1},
    }
    remembers = ("energy_sums",)

    def __init__(self, facts: LawContext, K: float = 20.0, d: float = 8.0) -> None:
        self.K = K
        self.d = d
        self.energy_sums = [0.0] * len(facts.peers)

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.d * now.qd[i]
        energy = 0.0
        for j in range(len(now.peers)):
            peer = now.peers[j]
            heard = now.received[j]
            self.energy_sums[j] += now.h_s * heard.energy[0]
            for i in range(now.joints):
                pull = (
                    peer.alpha * self.K * (heard.target[i] - now.q[i])
                    if peer.tick >= 0
                    else 0.0
                )
                now.tau[i] += pull
                energy += 0.5 * peer.alpha * self.K * (heard.target[i] - now.q[i]) ** 2
                now.sent[j].target[i] = now.q[i] + 0.01 * (j + 1) + 1e-3 * self.energy_sums[j]
        now.to_all.energy[0] = energy
