"""Defines the account of energy by which a control law shows that it never produces energy.

Such a law is called passive: a delay in the network cannot feed energy into the arms. Some laws
count the energy that they sent to other arms, took from other arms, stored and dissipated. They
have a method that computes this account from the records of a run, one record per control
period. A check then compares the account with the motion of the arms.

Invariant:
    - The energy that arm i takes from arm j is never more than the energy that the law of arm j
      sent and that has arrived.
    - The stored energy of a law is never below zero, and its dissipated energy never falls.
    - From these two rules it follows that the arms get no more energy than they gave.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..step.vectors import Array, IntArray


class PeerRecords(NamedTuple):
    """Values that a control law received from another arm and sent to that arm, in K periods.

    In each period of the control loop, every arm's process sends a message (sample) with its
    state. The receiving law uses the newest message that has arrived.

    Attributes:
        tick: Number of the period in which the used sample was sent, shape (K,). -1 before the
            first sample.
        received: Vectors that came with this sample, by name, each of shape (K, length). Zeros
            before the first sample.
        sent: Vectors that the law sent to this arm alone, by name, each of shape (K, length).
    """

    tick: IntArray
    received: Mapping[str, Array]
    sent: Mapping[str, Array]


class LawRecords(NamedTuple):
    """Recorded motion, torques and messages of one arm in K control periods.

    From them, a control law computes an account of energies, which shows whether it was
    passive.

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

    def sum_work(self, tau: Array) -> Array:
        """Returns the work of a joint torque since the start of the run, in each period.

        A torque is constant from each tick (start of a period) to the next. Its work in the
        period is the torque times the step of the joint angles, summed over the joints.

        Args:
            tau: Torque held from each tick to the next, shape (K, n), N m.

        Returns:
            The work at each tick, J, shape (K,). The first number is 0.
        """
        angle_steps = np.diff(self.q, axis=0)
        work_steps: Array = np.einsum("kj,kj->k", tau[:-1], angle_steps)
        return np.concatenate([[0.0], np.cumsum(work_steps)])


class LawEnergies(NamedTuple):
    """Account of the energy that a control law gave, took, stored and dissipated.

    The account covers K control periods. All energies are in J and have the shape (K,) or (K,
    parts). Flows are sums since the start of the run. Each part, for instance that of a joint,
    must not be below zero by itself.

    Attributes:
        gave: Per peer, the energy that was sent to it.
        took: Per peer, the energy that the law took out of the energy that the peer sent, part
            by part.
        port: Energy that the arm gave to the law, by the law's own account. None if the energy
            is computed from the records.
        store: Energy that the law stores.
        taken: Energy that the law has dissipated, by its own formula. None if it is the
            remainder of the other energies.
        observed: Per peer, the energy sent by the peer that this site knows not to have been
            taken yet; () if the law does not observe this energy.
        weight: Weight of the arm's energy in the sum over all sites.
        gravity: Fraction of the gravity torque that the law compensates. The work of this part
            of the torque is not counted as work of the law.
    """

    gave: Sequence[Array]
    took: Sequence[Array]
    port: Array | None = None
    store: Array | None = None
    taken: Array | None = None
    observed: Sequence[Array] = ()
    weight: float = 1.0
    gravity: float = 1.0
