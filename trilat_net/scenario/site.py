"""What an author says of one manipulator: arm, law, limits, who pushes it, what to do about a silent peer.

Law: keys end in their unit; symbols are the paper's.
"""

from typing import Annotated, Literal

from msgspec import Meta

from ..core.arm import Array, Links, parameters
from ..core.setup import Stale, StaleRule
from .actors import Hand, Surrounding
from .frozen import Frozen
from .laws import Control
from .quantities import Joints, NotNegative, Positive, Rate


class Arm(Frozen, frozen=True):
    """The two links of a planar arm; defaults are the paper's, as point masses at the link ends.

    Attributes:
        l1_m: length of link 1, m.
        m1_kg: mass of link 1, kg.
        lc1_m: distance of its centre of mass from joint 1, m.
        I1_kg_m2: inertia about its centre of mass, kg m^2.
        l2_m: length of link 2, m.
        m2_kg: mass of link 2, kg.
        lc2_m: distance of its centre of mass from joint 2, m.
        I2_kg_m2: inertia about its centre of mass, kg m^2.
        g_m_s2: gravitational acceleration, m/s^2.
        known: false where nobody knows masses and inertias, as of a real arm that was not identified: they
            are then in no formula. Only for an arm outside of the program.
    """

    l1_m: Positive = 1.0
    m1_kg: Positive = 1.0
    lc1_m: NotNegative = 1.0
    I1_kg_m2: NotNegative = 0.0
    l2_m: Positive = 1.0
    m2_kg: Positive = 1.0
    lc2_m: Positive = 1.0
    I2_kg_m2: NotNegative = 0.0
    g_m_s2: NotNegative = 9.81
    known: bool = True

    @property
    def theta(self) -> Array:
        """True parameters of Eq. (24), shape (5,)."""
        return parameters(Links(**{name: getattr(self, name) for name in Links._fields}))


class OnStale(Frozen, frozen=True, omit_defaults=True):
    """What a site does about a peer whose sample in use is too old.

    Attributes:
        action: "use": goes on with it; "hold": stays at the last reference; "brake": stays where the arm is.
        age_ms: older than this is too old, ms.
        return_s: how long the way back takes once a fresh sample is in use, s.
    """

    action: Literal["use", "hold", "brake"] = "use"
    age_ms: Annotated[float, Meta(gt=0.0, le=1e6)] = 350.0
    return_s: Annotated[float, Meta(gt=0.0, le=1e3)] = 1.0

    @property
    def rule(self) -> StaleRule:
        """The same, as the core has it."""
        return StaleRule(Stale[self.action.upper()], round(self.age_ms * 1e6), round(self.return_s * 1e9))


class Limits(Frozen, frozen=True):
    """Where a run stops being physics.

    Attributes:
        tau_limit_nm: largest control torque of a joint, N m; more is cut off.
        qd_limit_rad_s: joint speed beyond which a run counts as diverged and ends, rad/s.
    """

    tau_limit_nm: Positive = 200.0
    qd_limit_rad_s: Annotated[float, Meta(gt=0.0, le=10_000.0)] = 100.0


class SiteSpec(Frozen, frozen=True):
    """One manipulator.

    Attributes:
        role: what it is to a reader of figures; enters no formula.
        rate_hz: tick rate of its loop, Hz.
        q0_rad: start pose, rad.
        qd0_rad_s: start velocity, rad/s.
        arm: its links.
        control: its law and gains.
        limits: where it stops.
        on_stale: what it does about a peer whose samples are too old.
        hands: what its operator does.
        environment: what it meets.
        plant: "simulated"; or "external": an arm outside of the program, whose measured state comes in.
    """

    role: Literal["master", "slave"]
    rate_hz: Rate
    q0_rad: Joints
    qd0_rad_s: Joints
    arm: Arm
    control: Control
    limits: Limits
    on_stale: OnStale = OnStale()
    hands: tuple[Hand, ...] = ()
    environment: tuple[Surrounding, ...] = ()
    plant: Literal["simulated", "external"] = "simulated"
