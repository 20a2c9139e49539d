"""Springs with reactions: a site sends each peer the torque of the spring between them.

    cd examples
    trilat sim paper --set control.law=reaction_law:Reaction --set control.K=30 -o reaction.mcap
    trilat verify reaction.mcap --law reaction_law.py
    trilat sweep paper --over control.K=10:60:10 --set control.law=reaction_law:Reaction

Two sites are connected by two springs, one of which is computed at each of them. A spring acts
on the arm of its own site at once, and on the arm of the peer after the delay of the link. Each
site also sends the energy of its springs to all peers. The numbers that a law sends are part of
each record, under `ch`, and all tools show them by their names.
"""

import trilat_net as tn


@tn.compiled
class Reaction:
    """Springs between the sites that act at both of their ends.

    tau_i = gravity - d qd_i - torques of the site's springs + torques of the peers' springs

    Args:
        facts: numbers of joints and peers.
        K: stiffness of the springs to all peers together, N m/rad.
        d: damping of each joint, N m s/rad.
    """

    sends = {  # noqa: RUF012 - a declaration
        "energy": {"unit": "J", "length": 1},  # one number for all peers
        "pull": {"unit": "N m", "length": "joints", "per_peer": True},  # one vector per peer
    }
    remembers = ("largest_pull",)

    def __init__(self, facts: tn.LawContext, K: float = 20.0, d: float = 12.0) -> None:
        self.K = K
        self.d = d
        self.largest_pull = [0.0] * facts.joints  # of the peers so far, by joint

    def torque(self, now: tn.LawInput) -> None:
        """Writes the torques to `now.tau`, and the numbers for the peers to `now.sent`."""
        energy = 0.0
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.d * now.qd[i]
            pull_of_peers = 0.0
            for j in range(len(now.peers)):
                peer = now.peers[j]
                stretch = now.q[i] - peer.q[i]
                stiffness = self.K * peer.alpha
                energy += 0.5 * stiffness * stretch * stretch
                now.sent[j].pull[i] = stiffness * stretch
                now.tau[i] -= stiffness * stretch
                pull_of_peers += now.received[j].pull[i]
            now.tau[i] += pull_of_peers
            self.largest_pull[i] = max(self.largest_pull[i], abs(pull_of_peers))
        now.to_all.energy[0] = energy
