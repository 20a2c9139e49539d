"""Direct force reflection with known gravity; the kernel computes it
(`core.control.damped_torque`).
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..errors import ScenarioError, count_nouns
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints
from .conditions import LawSituation
from .interface import DAMPING, STIFFNESS, ControlLaw, TuningSite


class PF(ControlLaw):
    """Direct force reflection with known gravity: tau = G(q) - K e - d qd + k_f felt.

    `felt` is the torque of operators and environments on the peers' arms as received, weighted
    by dominance. A slave has K and k_f = 0, a master K = 0 and k_f. It is stable in free
    motion; for any passive operator and wall the master needs d >= k_f (2 K T + d_s)^2 / (4
    d_s), K and d_s of the slave. It is for one master and one slave.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        k_f: gain of the reflected force, per joint, dimensionless.
        gravity: share of gravity that it knows, 1: exactly.
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

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(
            Law.KNOWN, K=self.K, d=self.d, k_f=self.k_f, known=(theta * self.gravity).tolist()
        )

    def check(self, path: str, sites: int) -> None:
        """Refuses more sites than two: nobody could tell whose contact is felt."""
        if sites != 2:
            raise ScenarioError(
                "p_f reflects the force of one slave to one master, and here are "
                f"{count_nouns(sites, 'site')}: with more "
                "of them the contact that a site feels is ambiguous; "
                "choose p_d, pd_d or adaptive, or two sites",
                path=f"{path}.law",
            )

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002 - as the other laws
        """Returns that a site with neither gain follows nobody."""
        return "" if any(self.K) or any(self.k_f) else "K = 0 and k_f = 0 follow nobody"

    @classmethod
    def explain_misfit(cls, roles: Sequence[str]) -> str:
        """Returns that it is for one master and one slave."""
        if sorted(roles) == ["master", "slave"]:
            return ""
        masters = roles.count("master")
        return (
            "reflects force between one master and one slave; this has "
            f"{count_nouns(len(roles), 'site')}, {masters} of "
            "them masters: leave p_f out, or take contact"
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the gains of a site by its role."""
        if at.role == "master":
            return {
                "K": 0.0,
                "d": gains["d_master"],
                "k_f": gains["k_f"],
                "gravity": at.gravity,
            }
        return {"K": gains["K"], "d": gains["d_slave"], "k_f": 0.0, "gravity": at.gravity}
