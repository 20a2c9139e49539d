"""Springs with reactions: the force with which a site pulls at a peer is sent to it, and acts there too.

    cd examples
    trilat sim paper --set control.law=reaction_law:Reaction --set control.K=30 -o reaction.mcap
    trilat verify reaction.mcap --law reaction_law.py
    trilat sweep paper --over control.K=10:60:10 --set control.law=reaction_law:Reaction

Between each two sites there are two springs, one computed at either end, and each acts at both ends: at
once at its own, and after the delay at the other. The energy in a site's springs goes to all peers; it stands
in the record too, under `ch`, and every tool shows it by its name.
"""

import trilat_net as tn


@tn.compiled
class Reaction:
    """tau_i = G - d qd_i + the pulls of the site's springs + those of the peers' springs, as received."""

    sends = {  # noqa: RUF012 - a declaration
        "energy": {"unit": "J", "length": 1},  # the same to all peers
        "pull": {"unit": "N m", "length": "joints", "per_peer": True},  # another one to each
    }
    remembers = ("felt_most",)

    def __init__(self, facts: tn.LawContext, K: float = 20.0, d: float = 12.0) -> None:
        self.K, self.d = K, d
        self.felt_most = [0.0] * facts.joints  # the largest pull of peers so far, per joint

    def torque(self, now: tn.LawInput) -> None:
        """Writes now.tau, and what the peers get."""
        energy = 0.0
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.d * now.qd[i]
            felt = 0.0
            for j in range(len(now.peers)):
                peer = now.peers[j]
                apart = now.q[i] - peer.q[i]
                stiffness = self.K * peer.alpha
                energy += 0.5 * stiffness * apart * apart
                now.sent[j].pull[i] = stiffness * apart
                now.tau[i] -= stiffness * apart
                felt += now.received[j].pull[i]
            now.tau[i] += felt
            self.felt_most[i] = max(self.felt_most[i], abs(felt))
        now.to_all.energy[0] = energy
