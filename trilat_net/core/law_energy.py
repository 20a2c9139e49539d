"""Describes the energies that prove a control law passive, as functions of its site's records.

A law is passive if it never gives more energy than it received. Some laws keep accounts of
energy: what they sent to peers (the sites that they follow), what they took, and what they
store. Such a law computes these accounts from the records of a run, the stored results of each
tick. The certificate, a check after the run, compares them with the motion of the arms.

Invariant:
    - A peer takes no more energy than has arrived from the law that gave it.
    - The stored energy of a law is never below zero, and its dissipated energy never falls.
    - From these rules it follows that the arms get no more energy than they gave.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .vectors import Array, IntArray


class PeerRecords(NamedTuple):
    """Peer as the law saw it in K ticks, one row per tick, and the vectors sent to it.

    Attributes:
        tick: Stamp of the sample in use, shape (K,); -1 before the first sample.
        received: Vectors of that sample by name, shape (K, length); zeros before the first
            sample.
        sent: Vectors that went to this peer alone, by name, shape (K, length).
    """

    tick: IntArray
    received: Mapping[str, Array]
    sent: Mapping[str, Array]


class LawRecords(NamedTuple):
    """Records of the site of a law: K ticks, one row per tick.

    Attributes:
        h_s: The period, s.
        q: Joint angles, shape (K, n), rad.
        qd: Joint velocities, shape (K, n), rad/s.
        tau: Control torque within its limits, shape (K, n), N m.
        tau_x: Exogenous torque, shape (K, n), N m; the torque ON the arm is its negative.
        to_all: Vectors that went to all peers, by name, shape (K, length).
        memory: The law's memory after the tick, by the names of `remembers`, shape (K, length).
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


class LawEnergies(NamedTuple):
    """Energies of a law in K ticks, J, shape (K,) or (K, parts) each.

    Flows are sums since the beginning. Each part, for instance that of a joint, must not be
    below zero by itself.

    Attributes:
        gave: Per peer, the energy that was sent to it.
        took: Per peer, the energy that the law took out of the energy that the peer sent, part
            by part.
        port: Energy that the arm gave to the law, by the law's own account; None: the energy
            is computed from the records.
        store: Energy that the law stores.
        taken: Energy that the law has dissipated, by its own formula; None: the remainder of
            the other energies.
        observed: Per peer, the energy that the site knows to remain of the energy sent by the
            peer; () if the law does not observe it.
        weight: Weight of the arm's energy in the sum over all sites.
        gravity: Factor of gravity that the law compensates; the work of this torque is no work
            of the law.
    """

    gave: Sequence[Array]
    took: Sequence[Array]
    port: Array | None = None
    store: Array | None = None
    taken: Array | None = None
    observed: Sequence[Array] = ()
    weight: float = 1.0
    gravity: float = 1.0


def sum_work(tau: Array, q: Array) -> Array:
    """Returns the work of a joint torque since the first tick, for each tick, J, shape (K,).

    A torque is held from each tick to the next. Its work in this period is the torque times the
    step of the joint angles, summed over the joints. The first number is 0.

    Args:
        tau: Torque held from each tick to the next, shape (K, n), N m.
        q: Joint angles at each tick, shape (K, n), rad.
    """
    steps: Array = np.einsum("kj,kj->k", tau[:-1], np.diff(q, axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])
