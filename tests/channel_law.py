"""A law that sends to all its peers and to each of them, for tests."""

from typing import ClassVar

from trilat_net.core.plug.user_law import LawContext, LawInput


class Talking:
    """P+d whose spring pulls towards the messages of peers; it tells all peers its energy, and
    each peer a target.

    `told` is cumulative, so that a wrong number, once used, stays in every later record.
    """

    sends: ClassVar = {
        "target": {"unit": "rad", "length": "joints", "per_peer": True},
        "energy": {"unit": "J", "length": 1},
    }
    remembers = ("told",)

    def __init__(self, facts: LawContext, K: float = 20.0, d: float = 8.0) -> None:
        self.K, self.d = K, d
        self.told = [0.0] * len(facts.peers)

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.d * now.qd[i]
        energy = 0.0
        for j in range(len(now.peers)):
            peer, heard = now.peers[j], now.received[j]
            self.told[j] += now.h_s * heard.energy[0]
            for i in range(now.joints):
                pull = (
                    peer.alpha * self.K * (heard.target[i] - now.q[i])
                    if peer.tick >= 0
                    else 0.0
                )
                now.tau[i] += pull
                energy += 0.5 * peer.alpha * self.K * (heard.target[i] - now.q[i]) ** 2
                now.sent[j].target[i] = now.q[i] + 0.01 * (j + 1) + 1e-3 * self.told[j]
        now.to_all.energy[0] = energy
