"""P+d whose coupling torque saturates, towards each peer by itself.

Invariant: no peer pulls with more than alpha_ij P, whatever it does.
"""

from typing import ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.elementary import tanh
from ..core.site_setup import Gains, Law
from ..core.user_law import LawInput
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .conditions import LawSituation, StabilityCondition, judge_position_exchange
from .interface import DAMPING, STIFFNESS, ControlLaw


@compiled
class SaturatedPd(ControlLaw):
    """P+d whose pull towards each peer saturates: tau = G - sum alpha_ij P tanh(K (q - q_j) /
    P) - d qd.

    Zakerimanesh, Hashemzadeh and Ghiasi, "Dual-user nonlinear teleoperation subjected to
    varying time delay and bounded inputs", ISA Transactions 68, 2017.

    Attributes:
        K: stiffness of small errors, per joint, N m/rad.
        P: largest pull of all peers together, per joint, N m.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0,)
    P: PositiveJoints = (5.0,)
    d: NotNegativeJoints = (3.0,)
    gravity: NotNegative = 1.0

    linear_note: ClassVar = "saturated_pd has the slope K of small errors: where sites disagree at rest it pulls less"
    tune: ClassVar = {"K": STIFFNESS, "P": (0.5, 50.0, "N m"), "d": DAMPING}
    needs_theta: ClassVar = True

    def torque(self, now: LawInput) -> None:
        """Writes the torque."""
        for i in range(now.joints):
            tau = self.gravity * now.gravity[i] - self.d[i] * now.qd[i]
            for j in range(len(now.peers)):
                peer = now.peers[j]
                tau -= (
                    peer.alpha
                    * self.P[i]
                    * tanh(self.K[i] * (now.q[i] - peer.q[i]) / self.P[i])
                )
            now.tau[i] = tau

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns P+d, with the stiffness of small errors."""
        return Gains(Law.KNOWN, K=self.K, d=self.d, known=(theta * self.gravity).tolist())

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d (the slope is nowhere above K), and what the torque
        limit leaves.
        """
        found = judge_position_exchange(situation, "K", "d")
        if not situation.gravity_nm:
            return found._replace(
                text=f"{found.text}; and tau_limit_nm above gravity + P + d |qd|"
            )
        gravity = self.gravity * np.array(situation.gravity_nm)
        room = np.array(situation.tau_limit_nm) - gravity - np.array(self.P)
        if room.min() <= 0.0:
            n = int(room.argmin())
            lacks = f"tau_limit_nm of joint {n + 1} is {-room[n]:.3g} N m below gravity + P"
            return StabilityCondition(False, f"{lacks}: it would cut the pull off")
        with np.errstate(divide="ignore"):
            most = float(np.min(room / np.array(self.d)))
        within = f"; gravity + P + d |qd| is within tau_limit_nm up to {most:.3g} rad/s"
        return found._replace(text=found.text + within)
