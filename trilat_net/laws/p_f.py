"""Direct force reflection: a master feels the external torque on the slave.

A spring pulls the slave towards the master, and the torque that the environment exerts on the
slave is sent back and added to the master's torque. Both arms are damped, and their gravity
torque, computed from known masses, is compensated for.

The compiled control loop computes this law (`core.step.control.damped_torque`).
`PF.compute_torque` implements the same law in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same torques.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains, Law
from ..errors import ScenarioError, count_nouns
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints
from .conditions import LawSituation
from .interface import DAMPING, STIFFNESS, ControlLaw, TuningSite


class PF(ControlLaw):
    """Direct force reflection with known gravity: tau = G(q) - K e - d qd + k_f felt.

    G(q) is the gravity torque. The error e is the position minus the reference (the mean
    position of the peers, weighted by the dominance factors). `felt` is the external torque on
    the peers' arms as received, with the same weights.

    The law couples one master (K = 0 and k_f > 0) and one slave (K > 0 and k_f = 0). The loop
    is stable in free motion. To be stable for any passive operator and any wall, the master
    requires at least

        d >= k_f (2 K T + d_s)^2 / (4 d_s)

    where K and d_s are the slave's gains. This stability limit is exact for a light slave,
    whose inertia M_s per joint is at most d_s^2 / (4 K). For a heavier slave, the limit is
    higher and has no closed form; the larger of this value and k_f K (2 M_s + T d_s)^2 / (4 M_s
    d_s) is sufficient (docs/theory/port-conditions.md, 15).

    Attributes:
        K: Stiffness per joint, N m/rad.
        d: Damping per joint, N m s/rad.
        k_f: Gain of the reflected force, per joint, dimensionless.
        gravity: Ratio of the compensated to the true gravity torque; 1 is exact.
    """

    K: NotNegativeCoordinates = (0.0,)
    d: NotNegativeJoints = (5.0,)
    k_f: NotNegativeCoordinates = (0.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {
        "K": (*STIFFNESS, "slave"),
        "d_slave": (*DAMPING, "slave"),
        "d_master": (*DAMPING, "master"),
        "k_f": (0.05, 2.0, "", "master"),
    }

    def compute_torque(self, G: Array, e: Array, qd: Array, felt: Array) -> Array:
        """Computes the torque of each joint before limiting, N m.

            tau = G - K e - d qd + k_f felt

        K is the stiffness (N m/rad), d the damping (N m s/rad) and k_f the dimensionless gain
        of the reflected force.

        Args:
            G: Gravity compensation torque, shape (n,) for n joints, N m.
            e: Position error (position minus reference), shape (n,), rad.
            qd: Joint velocities, shape (n,), rad/s.
            felt: External torque on the other arm as received, multiplied by the dominance
                factor, shape (n,), N m.
        """
        spring = np.array(self.K) * e
        damper = np.array(self.d) * qd
        reflected = np.array(self.k_f) * felt
        return G - spring - damper + reflected

    def gains(self, theta: Array) -> Gains:
        """Converts the gains of this law to the record that the compiled control loop reads.

        The record contains the stiffness, the damping, the gain of the reflected force, and the
        parameters needed to compute the gravity torque.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque.
        known = (theta * self.gravity).tolist()
        return Gains(
            Law.KNOWN,
            K=self.K,
            d=self.d,
            k_f=self.k_f,
            known=known,
        )

    def check(self, path: str, sites: int) -> None:
        """Raises ScenarioError if the scenario does not have exactly two arms.

        With more arms, it would be ambiguous which contact force is reflected to the user of a
        master.

        Args:
            path: Path of the law's settings in the scenario file, for error messages.
            sites: Number of sites in the scenario.

        Raises:
            ScenarioError: The number of sites is not two.
        """
        if sites != 2:
            raise ScenarioError(
                "p_f reflects the force of one slave to one master, but the scenario has "
                f"{count_nouns(sites, 'site')}: with more than two, the contact that a site "
                "feels is ambiguous; choose p_d, pd_d or adaptive, or two sites",
                path=f"{path}.law",
            )

    def explain_idle_shares(self, situation: LawSituation) -> str:  # noqa: ARG002 - used by other laws
        """Explains to the user that the dominance factors of an arm have no effect.

        This is the case if the stiffness K and the force gain k_f are both zero: the arm
        neither follows nor feels the other arms.

        Returns:
            A sentence for the user. Empty if either gain is not zero.
        """
        if any(self.K) or any(self.k_f):
            return ""
        return "with K = 0 and k_f = 0, an arm does not follow others"

    @classmethod
    def explain_misfit(cls, roles: Sequence[str]) -> str:
        """Explains to the user why force reflection cannot couple the arms of a scenario.

        This law requires exactly one master and one slave.

        Args:
            roles: Role of each site, "master" or "slave".

        Returns:
            A sentence for the user. Empty for one master and one slave.
        """
        is_one_pair = sorted(roles) == ["master", "slave"]
        if is_one_pair:
            return ""
        sites = count_nouns(len(roles), "site")
        masters = roles.count("master")
        return (
            "reflects force between one master and one slave; this scenario has "
            f"{sites}, {masters} of them masters: leave p_f out, or choose the task contact"
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The table depends on the role of the arm, because only the slave has a spring and only
        the master feels forces.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        if site.role == "master":
            return {
                "K": 0.0,
                "d": gains["d_master"],
                "k_f": gains["k_f"],
                "gravity": site.gravity,
            }
        return {"K": gains["K"], "d": gains["d_slave"], "k_f": 0.0, "gravity": site.gravity}
