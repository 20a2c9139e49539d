"""Energy account with which a control law shows that it never produces energy.

Such a law is called passive: a network delay cannot feed energy into the arms. Some laws keep
track of the energy that they sent to other arms, took from other arms, stored and dissipated. A
method of these laws computes the account from the records of a run, one record per tick. The
account is then checked against the motion of the arms.

Invariant:
    - The energy that arm i takes from arm j never exceeds the energy that the law of arm j sent
      and that has arrived.
    - The stored energy of a law is never negative, and its dissipated energy never decreases.
    - These two rules imply that the arms receive no more energy than they supplied.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..step.vectors import Array, IntArray


class PeerRecords(NamedTuple):
    """Values that a control law exchanged with one peer in K ticks.

    In each tick, a law uses the newest sample that has arrived from the peer.

    Attributes:
        tick: Tick at which the sample in use was sent, shape (K,). -1 before the first sample.
        received: Mapping from name to the vectors that came with this sample, shape (K,
            length). Zeros before the first sample.
        sent: Mapping from name to the vectors that the law sent to this peer alone, shape (K,
            length).
    """

    tick: IntArray
    received: Mapping[str, Array]
    sent: Mapping[str, Array]


class LawRecords(NamedTuple):
    """Recorded motion, torques and messages of one arm in K ticks.

    A control law computes its energy account from these records. The account shows whether the
    law was passive, which means that it produced no energy.

    Attributes:
        h_s: The control period, s.
        q: Joint angles, shape (K, n), rad.
        qd: Joint velocities, shape (K, n), rad/s.
        tau: Control torque after limiting, shape (K, n), N m.
        tau_x: External torque, shape (K, n), N m; the torque ON the arm is its negative.
        to_all: Mapping from name to the vectors sent to all peers, shape (K, length).
        memory: The law's memory after the tick, a mapping from the names in `remembers` to
            arrays of shape (K, length).
        peers: The peers in scenario order.
    """

    h_s: float
    q: Array
    qd: Array
    tau: Array
    tau_x: Array
    to_all: Mapping[str, Array]
    memory: Mapping[str, Array]
    peers: Sequence[PeerRecords]

    @staticmethod
    def select_messages(
        site: str,
        peer: str,
        tick: IntArray,
        sent: Mapping[str, Array],
        sent_by_peer: Mapping[str, Array],
    ) -> PeerRecords:
        """Selects the values that the law of a site exchanged with one peer in K ticks.

        The key of a vector sent to all peers is its name. The key of a vector for a single peer
        also contains the name of this peer, for example "wave[s]".

        Args:
            site: Name of the site.
            peer: Name of the peer.
            tick: Tick of the sample in use from the peer, shape (K,). -1 for none.
            sent: All vectors sent by the site, by key, shape (K, length).
            sent_by_peer: All vectors sent by the peer, by key, one row per tick of the peer.
        """
        has_sample = tick[:, np.newaxis] >= 0
        row = np.maximum(tick, 0)

        received = {}
        for key, values in sent_by_peer.items():
            name = key.removesuffix(f"[{site}]")
            is_for_another_site = "[" in name
            if not is_for_another_site:
                received[name] = np.where(has_sample, values[row], 0.0)

        sent_to_peer = {}
        for key, values in sent.items():
            if key.endswith(f"[{peer}]"):
                name = key.partition("[")[0]
                sent_to_peer[name] = values
        return PeerRecords(tick, received, sent_to_peer)

    def sum_work(self, tau: Array) -> Array:
        """Returns the work done by a joint torque since the start of the run, at each tick.

        The torque is constant from one tick to the next. The work done between two ticks is the
        torque times the change in the joint angles, summed over the joints.

        Args:
            tau: Torque held from each tick to the next, shape (K, n), N m.

        Returns:
            The work at each tick, J, shape (K,). The first entry is 0.
        """
        angle_steps = np.diff(self.q, axis=0)
        work_steps: Array = np.einsum("kj,kj->k", tau[:-1], angle_steps)
        return np.concatenate([[0.0], np.cumsum(work_steps)])


class LawEnergies(NamedTuple):
    """Account of the energy that a control law sent, took, stored and dissipated.

    The account covers K ticks. All energies are in J and have the shape (K,) or (K, parts).
    Flows are accumulated from the start of the run. Each part, for example that of a single
    joint, must be non-negative.

    Attributes:
        gave: For each peer, the energy sent to it.
        took: For each peer, the energy that the law took out of the energy sent by the peer,
            split into parts.
        port: Energy that the arm supplied to the law, according to the law's own account. None
            if the energy is computed from the records.
        store: Energy stored by the law.
        taken: Energy dissipated by the law, according to the law's own formula. None if it is
            the remainder of the other energies.
        observed: For each peer, the energy sent by the peer that this site knows has not been
            taken yet; () if the law does not observe this energy.
        weight: Weight of the arm's energy in the sum over all sites.
        gravity: Fraction of the gravity torque that the law compensates for. The work of this
            part of the torque does not count as work of the law.
    """

    gave: Sequence[Array]
    took: Sequence[Array]
    port: Array | None = None
    store: Array | None = None
    taken: Array | None = None
    observed: Sequence[Array] = ()
    weight: float = 1.0
    gravity: float = 1.0
