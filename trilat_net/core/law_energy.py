"""The energies by which a control law is proved passive, as functions of what its site
recorded.

Invariant: of energy that a law gives to a peer the peer takes no more than came; what a law
stores is never below zero, and what it has taken for good never falls. Then the arms get no
more than they gave.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .vectors import Array, IntArray


class PeerRecords(NamedTuple):
    """A peer as the law saw it at K ticks, a row each, and what the law sent to it.

    Attributes:
        tick: of the sample in use, shape (K,); -1 before the first.
        received: what the peer's law sent with that sample, by name, shape (K, length); zeros
            before one.
        sent: what went to this peer alone at that tick, by name.
    """

    tick: IntArray
    received: Mapping[str, Array]
    sent: Mapping[str, Array]


class LawRecords(NamedTuple):
    """What a site recorded of its law, a row per tick, K of them.

    Attributes:
        h_s: the period, s.
        q, qd: joint angles and velocities, shape (K, n), rad and rad/s.
        tau: control torque within its limits, shape (K, n), N m.
        tau_x: exogenous torque; ON the arm acts its negative.
        to_all: what went to all peers, by name, shape (K, length).
        memory: what the law remembered after the tick, by the names of `remembers`, shape (K,
            length).
        peers: in scenario order.
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
    """Energies of a law at K ticks, J, shape (K,) each, or (K, parts); flows are sums since the
    beginning.

    Each part, a joint's for instance, must not be below zero by itself.

    Attributes:
        gave: per peer, what was sent to it.
        took: per peer, what was taken of what it sent, part by part.
        port: what the arm gave to the law by the law's own books; None: what it gave indeed.
        store: what the law stores.
        taken: what it has taken for good, by its own formula; None: what is left of the others.
        observed: per peer, what the site knows to be left of what the peer sent; (): nothing of
            that kind.
        weight: by which its arm's energy counts in the sum over all sites.
        gravity: share of gravity that the law carries, whose work is not its own.
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
    """Returns the work of torques that are held from tick to tick, up to each tick, shape (K,),
    J.
    """
    steps: Array = np.einsum("kj,kj->k", tau[:-1], np.diff(q, axis=0))
    return np.concatenate([[0.0], np.cumsum(steps)])
