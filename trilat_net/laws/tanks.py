"""Two layers: a transparency layer that may do anything, over a tank of energy that pays for
it.

Invariant: a tank is filled by the work that the arm does on its controller and by the energy
packets of the peers, and pays the work that the torque does on the arm, tau times the step in
q; where it is empty, there is no torque of the transparency layer. Packets are cumulative: lost
samples cost nothing.
"""

from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.law_energy import LawEnergies, LawRecords, sum_work
from ..core.user_law import LawContext, LawInput
from ..fields import NotNegative, NotNegativeJoints, Positive, PositiveJoints
from .conditions import PASSIVE_OUTSIDE, LawSituation, StabilityCondition
from .interface import ERROR_DAMPING, STIFFNESS, EnergyLaw


@compiled
class Tanks(EnergyLaw):
    """Two layers: springs to the reference, over a tank per site that pays for what they do.

    Any shares, any delays: the tanks are passive. Franken, Stramigioli, Misra, Secchi and
    Macchelli, IEEE Transactions on Robotics 27 (4), 2011.

    Attributes:
        K: stiffness of the transparency layer per joint, N m/rad.
        Kd: its damping of the error's velocity per joint, N m s/rad.
        d: its damping of the arm's velocity per joint, N m s/rad.
        level_J: level to which a tank is kept, J.
        fill_nm_s_rad_J: damping of the arm per energy that is missing from it, N m s/rad/J.
        packet_1_s: rate at which a tank is emptied towards the peers, 1/s.
        by_shares: true: peers get parts by this site's dominance factors; false: equal ones.
        acceleration_rad_s2: most by which a joint accelerates, as far as tanks cover it: in the
            period to come it moves by qd h and half of this times h^2 more.
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
        "H": {
            "unit": "J",
            "length": 1,
        },  # what is in the tank: peers have no use for it, logs have
        "E": {"unit": "J", "length": 1, "per_peer": True},
    }
    remembers: ClassVar = ("E_seen", "carried")
    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING}
    guarded = True
    """False: the transparency layer alone, for comparison."""

    def begin(self, facts: LawContext) -> None:
        """Makes what is booked, and the rates of a tick."""
        self.guarded = bool(self.guarded)
        self.packet = float(self.packet_1_s) / facts.rate_hz
        self.farther = 0.5 * self.acceleration_rad_s2 / facts.rate_hz**2
        self.E_seen = [0.0] * len(facts.peers)
        self.carried = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        """Writes the torque, and sends the packets."""
        n = now.joints
        peers = len(now.peers)
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
            error = now.q[i] - now.q_des[i]
            rate = now.qd[i] - now.qd_des[i]
            now.tau[i] = -self.K[i] * error - self.Kd[i] * rate - self.d[i] * now.qd[i]
            power += now.tau[i] * now.qd[i]
            force += abs(now.tau[i])
        affordable = 1.0
        damping = 0.0
        if self.guarded:
            affordable = (
                0.0
                if H <= 0.0
                else min(1.0, H / max(abs(power) * now.h_s + force * self.farther, H))
            )
            damping = self.fill_nm_s_rad_J * max(self.level_J - H, 0.0)
        for i in range(n):
            self.carried[i] = self.gravity * now.gravity[i]
            now.tau[i] = self.carried[i] + affordable * now.tau[i] - damping * now.qd[i]

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns the packets, and what is in the tank: it loses nothing."""
        gave = [peer.sent["E"] for peer in seen.peers]
        took = [seen.memory["E_seen"][:, j : j + 1] for j in range(len(gave))]
        port = -sum_work(seen.tau - seen.memory["carried"], seen.q)
        taken = np.zeros(len(port))
        return LawEnergies(
            gave=gave,
            took=took,
            port=port,
            store=seen.to_all["H"],
            taken=taken,
            gravity=self.gravity,
        )

    def explain_no_linear_form(self) -> str:
        """Returns why it cannot be linearised."""
        return "it is the layer where a tank is full enough, and none where it is empty: energy switches it"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that tanks are passive, if no more than all of a tank is sent in a tick."""
        most = f"joints accelerate by {self.acceleration_rad_s2:g} rad/s^2 at most"
        text = f"tanks are passive for any shares, delays and loss, where {PASSIVE_OUTSIDE}, and {most}"
        share = self.packet_1_s / situation.rate_hz
        if share > 1.0:
            return StabilityCondition(
                False, f"a tank sends {share:.3g} of its energy a tick, more than it has"
            )
        return StabilityCondition(True, text)
