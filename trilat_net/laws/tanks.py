"""Couples arms with springs that may only use the energy stored in a tank.

Delays can make a spring between two arms active, that is, make it produce energy. Each site
therefore keeps an account of the energy that its controller may still spend: the tank. The
controller has two layers. The transparency layer computes the torque of a spring and dampers
that couple the arm to its peers. The passivity layer reduces this torque such that its work
does not exceed the energy in the tank.

Invariant:
    - The tank is filled by the work that the arm does on its controller, and by energy sent by
      the peers. It is emptied by the work of the controller on the arm. This work is the torque
      times the motion of the joint in a control period.
    - While the tank is empty, the torque of the transparency layer is zero.
    - A message states the cumulative energy sent so far, so no energy is lost when a message is
      lost.
"""

from typing import Any, ClassVar

import numpy as np

from ..core import LawContext, LawEnergies, LawInput, LawRecords, compiled
from ..fields import NotNegative, NotNegativeJoints, Positive, PositiveJoints
from .conditions import PASSIVE_OUTSIDE, LawSituation, StabilityCondition
from .interface import ERROR_DAMPING, STIFFNESS, EnergyLaw


@compiled
class Tanks(EnergyLaw):
    """Couples arms with springs whose work is limited by one energy tank per arm.

    A tank is the amount of energy that the controller of an arm may still spend. The law is
    passive for any delays and any dominance factors.

    Source: Franken, Stramigioli, Misra, Secchi and Macchelli, IEEE Transactions on Robotics 27
    (4), 2011.

    Attributes:
        K: Stiffness of the spring to the reference, per joint, N m/rad.
        Kd: Damping of the error, per joint, N m s/rad.
        d: Damping of the arm's motion, per joint, N m s/rad.
        level_J: Level to which a tank is refilled, J.
        fill_nm_s_rad_J: Damping of the arm per unit of energy missing from the tank, N m
            s/rad/J. This damping refills the tank from the motion of the arm.
        packet_1_s: Rate at which the energy in a tank is sent to the peers, 1/s.
        by_shares: If True, the energy for the peers is divided by the dominance factors of this
            arm. If False, all peers get equal parts.
        acceleration_rad_s2: Largest acceleration a of a joint for which the tank reserves
            energy, rad/s^2. With the velocity qd, the joint is assumed to move by up to qd h +
            a h^2 / 2 in the next control period h.
    """

    K: PositiveJoints = (100.0,)
    Kd: NotNegativeJoints = (2.0,)
    d: NotNegativeJoints = (0.0,)
    level_J: Positive = 0.1
    fill_nm_s_rad_J: NotNegative = 50.0
    packet_1_s: NotNegative = 10.0
    by_shares: bool = False
    acceleration_rad_s2: NotNegative = 100.0

    sends: ClassVar[Any] = {
        # The energy in the tank. Peers do not need it, but the log shows it.
        "H": {"unit": "J", "length": 1},
        "E": {"unit": "J", "length": 1, "per_peer": True},
    }
    remembers: ClassVar = ("E_seen", "carried")
    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING}
    guarded = True
    """False disables the tank of the transparency layer, for comparison."""

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run by creating its state and constants.

        The state consists of the total energy received from each peer, and the gravity torque
        of the previous tick.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        # Whether the tank limits the torque, as a bool of this instance.
        self.guarded = bool(self.guarded)
        # Part of the tank's energy that is sent to the peers in each control period.
        self.packet = float(self.packet_1_s) / facts.rate_hz
        # Motion of a joint in a control period h because of its acceleration, a h^2 / 2, rad.
        self.extra_step = 0.5 * self.acceleration_rad_s2 / facts.rate_hz**2
        # State: sum of the energy received from each peer so far, J.
        self.E_seen = [0.0] * len(facts.peers)
        # State: gravity torque in the previous control torque, per joint, N m. It carries the
        # weight of the arm, and its work does not count.
        self.carried = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and sends energy packets to the other arms.

        First, the work of the previous control period and the received packets are entered into
        the energy account, and packets are sent. Then the torque of the coupling springs is
        computed, and reduced until the energy in the tank covers its work. Damping is added
        while the tank is below its target level.

        Args:
            now: Inputs and outputs of the law in this tick.
        """
        n = now.joints
        peers = len(now.peers)
        H = now.to_all.H[0]
        # The work of the previous period, and the packets of the peers.
        for i in range(n):
            coupling_torque = now.tau_before[i] - self.carried[i]
            step = now.q[i] - now.q_before[i]
            H -= coupling_torque * step
        for j in range(peers):
            E = now.received[j].E[0]
            H += E - self.E_seen[j]
            self.E_seen[j] = E

        packet = self.packet * max(H, 0.0)
        H -= packet
        for j in range(peers):
            share = now.peers[j].alpha if self.by_shares else 1.0 / peers
            now.sent[j].E[0] += share * packet
        now.to_all.H[0] = H

        # The torque of the transparency layer.
        power = 0.0
        torque_sum = 0.0
        for i in range(n):
            qd = now.qd[i]
            error = now.q[i] - now.q_des[i]
            error_rate = qd - now.qd_des[i]
            spring = -self.K[i] * error
            error_damper = self.Kd[i] * error_rate
            damper = self.d[i] * qd
            tau = spring - error_damper - damper
            now.tau[i] = tau
            power += tau * qd
            torque_sum += abs(tau)

        affordable = 1.0
        damping = 0.0
        if self.guarded:
            # The largest work of the transparency layer's torque in the coming period.
            predicted_work = abs(power) * now.h_s
            acceleration_work = torque_sum * self.extra_step
            cost = predicted_work + acceleration_work
            affordable = 0.0 if H <= 0.0 else min(1.0, H / max(cost, H))
            lacking_J = max(self.level_J - H, 0.0)
            damping = self.fill_nm_s_rad_J * lacking_J

        for i in range(n):
            carried = self.gravity * now.gravity[i]
            self.carried[i] = carried
            coupling_torque = affordable * now.tau[i]
            damper = damping * now.qd[i]
            now.tau[i] = carried + coupling_torque - damper

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Computes the energies that show whether the law was passive in a run.

        All energies are in J. The records contain, for each tick:

        - "E": the total energy sent to a peer so far;
        - "E_seen": the total energy received so far, one column per peer;
        - "H": the energy in the tank (the energy that the controller may still spend);
        - "carried": the part of the torque that compensates for gravity, N m. It is subtracted
          from the torque, because its work does not come from the tank.

        Args:
            seen: Records of the site in the run.

        Returns:
            The energy sent to each peer (`gave`) and received from it (`took`), the energy that
            the arm supplied to the controller (`port`), and the energy in the tank (`store`).
            No energy counts as dissipated (`taken`), because damping transfers energy to the
            tank.
        """
        sent_energies = [peer.sent["E"] for peer in seen.peers]
        E_seen = seen.memory["E_seen"]
        # A slice of one column keeps the shape (K, 1), where K is the number of records.
        received_energies = [E_seen[:, j : j + 1] for j in range(len(sent_energies))]
        coupling_torque = seen.tau - seen.memory["carried"]
        # `sum_work` is the work of the controller on the arm; the arm gave the opposite.
        energy_from_arm = -seen.sum_work(coupling_torque)
        dissipated_energy = np.zeros(len(energy_from_arm))
        return LawEnergies(
            gave=sent_energies,
            took=received_energies,
            port=energy_from_arm,
            store=seen.to_all["H"],
            taken=dissipated_energy,
            gravity=self.gravity,
        )

    def explain_no_linear_form(self) -> str:
        """Explains to the user why `trilat linear` cannot linearise this law."""
        return "the energy in the tank switches its torque on and off"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the energy tanks keep the coupled arms passive.

        Passive means that they never supply more energy than they received. In each tick, the
        controller sends a fixed fraction of the energy in its tank to the other arms. The
        condition is satisfied if this fraction is at most 1, provided that operators and
        environments are passive.

        Args:
            situation: This arm and its tick rate.
        """
        part_per_tick = self.packet_1_s / situation.rate_hz
        if part_per_tick > 1.0:
            text = (
                f"a tank sends {part_per_tick:.3g} times its energy per tick, "
                "which is more than it has"
            )
            return StabilityCondition(False, text)
        text = (
            "motion stays bounded (decay is not proved): tanks are passive for any shares, "
            f"delays and loss, where {PASSIVE_OUTSIDE}, and "
            f"joints accelerate by {self.acceleration_rad_s2:g} rad/s^2 at most"
        )
        return StabilityCondition(True, text)
