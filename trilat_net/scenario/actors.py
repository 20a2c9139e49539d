"""What an author says of operators and environments: who pushes an arm, and what it meets.

Law: torques and forces are those ON the arm. Times are seconds after the epoch; keys end in their unit.
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from ..core.exogenous import Actor, Acts
from .frozen import Frozen
from .quantities import LARGEST, Joints, NotNegative, NotNegativeJoints, Positive, Real

Plane = Annotated[tuple[Real, ...], Meta(min_length=2, max_length=2)]
Row = Annotated[tuple[Real, ...], Meta(min_length=3, max_length=3)]


class Pulse(Frozen, frozen=True, tag_field="kind", tag="pulse"):
    """A smooth push of an operator: peak * sin^2(pi (t - start) / (end - start)).

    Attributes:
        start_s: when it begins.
        end_s: when it ends.
        peak_nm: its peak on each joint, N m.
    """

    start_s: NotNegative
    end_s: Positive
    peak_nm: Joints

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        return Actor(Acts.PULSE, self.start_s, self.end_s, a=self.peak_nm)


class Spring(Frozen, frozen=True, tag_field="kind", tag="spring"):
    """An operator's hand: a spring and a damper on every joint, towards a pose that moves (minimum jerk).

    Attributes:
        to_rad: the pose that it moves to, rad.
        from_rad: the pose before, rad; left out: the arm's start pose.
        move_start_s: when it begins to move.
        move_end_s: when it is there.
        stiffness_nm_rad: per joint, N m/rad.
        damping_nm_s_rad: per joint, N m s/rad.
        start_s: when the hand takes hold.
        end_s: when it lets go.
        sampled: whether it is computed once a tick and held.
    """

    to_rad: Joints
    from_rad: Joints
    stiffness_nm_rad: NotNegativeJoints
    damping_nm_s_rad: NotNegativeJoints = (0.0, 0.0)
    move_start_s: NotNegative = 0.0
    move_end_s: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = LARGEST
    sampled: bool = False

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        return Actor(
            Acts.HAND,
            self.start_s,
            self.end_s,
            self.move_start_s,
            self.move_end_s,
            self.from_rad,
            self.to_rad,
            self.stiffness_nm_rad,
            self.damping_nm_s_rad,
            self.sampled,
        )


class TipSpring(Frozen, frozen=True, tag_field="kind", tag="tip_spring"):
    """An operator's hand at the tip: a spring and a damper in the plane, towards a point that moves.

    Attributes:
        to_m: the point that it moves to, x and y, m.
        from_m: the point before, m; left out: where the tip is at the start.
        move_start_s: when it begins to move.
        move_end_s: when it is there.
        stiffness_n_m: along x and y, N/m.
        damping_n_s_m: along x and y, N s/m.
        start_s: when the hand takes hold.
        end_s: when it lets go.
        sampled: whether it is computed once a tick and held.
    """

    to_m: Plane
    from_m: Plane
    stiffness_n_m: NotNegativeJoints
    damping_n_s_m: NotNegativeJoints = (0.0, 0.0)
    move_start_s: NotNegative = 0.0
    move_end_s: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = LARGEST
    sampled: bool = False

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        return Actor(
            Acts.TASK_HAND,
            self.start_s,
            self.end_s,
            self.move_start_s,
            self.move_end_s,
            self.from_m,
            self.to_m,
            self.stiffness_n_m,
            self.damping_n_s_m,
            self.sampled,
        )


class Recorded(Frozen, frozen=True, tag_field="kind", tag="recorded"):
    """A torque that was recorded, linear between its points; nothing before the first and after the last.

    Attributes:
        points: rows of time, s, and the torque on each joint, N m, in order of time.
    """

    points: Annotated[tuple[Row, ...], Meta(min_length=1, max_length=1_000_000)]

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        return Actor(Acts.RECORDED, table=np.array(self.points, dtype=np.float64))


class Viscous(Frozen, frozen=True, tag_field="kind", tag="viscous"):
    """An environment that resists motion of the joints.

    Attributes:
        damping_nm_s_rad: per joint, N m s/rad.
        start_s: from when on.
        end_s: until when.
        sampled: whether it is computed once a tick and held.
    """

    damping_nm_s_rad: NotNegativeJoints
    start_s: NotNegative = 0.0
    end_s: Positive = LARGEST
    sampled: bool = False

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        return Actor(Acts.VISCOUS, self.start_s, self.end_s, B=self.damping_nm_s_rad, sampled=self.sampled)


class Wall(Frozen, frozen=True, tag_field="kind", tag="wall"):
    """A unilateral wall for the tip: it pushes out of itself, along its normal, and never pulls.

    Attributes:
        point_m: a point of its surface, x and y, m.
        normal: where the free side is; its length does not matter.
        stiffness_n_m: N/m.
        damping_n_s_m: N s/m.
        start_s: from when on.
        end_s: until when.
        sampled: whether it is computed once a tick and held, as a digital haptic wall is.
    """

    point_m: Plane
    normal: Plane
    stiffness_n_m: NotNegative
    damping_n_s_m: NotNegative = 0.0
    start_s: NotNegative = 0.0
    end_s: Positive = LARGEST
    sampled: bool = False

    @property
    def actor(self) -> Actor:
        """The same, as the core has it."""
        length = math.hypot(*self.normal)
        unit = tuple(x / length for x in self.normal)
        stiffness, damping = (self.stiffness_n_m, 0.0), (self.damping_n_s_m, 0.0)
        return Actor(
            Acts.WALL,
            self.start_s,
            self.end_s,
            a=self.point_m,
            b=unit,
            K=stiffness,
            B=damping,
            sampled=self.sampled,
        )


Hand = Pulse | Spring | TipSpring | Recorded
HANDS: dict[str, type[Frozen]] = {
    "pulse": Pulse,
    "spring": Spring,
    "tip_spring": TipSpring,
    "recorded": Recorded,
}
"""What an operator can be, by the name of its kind."""
Surrounding = Viscous | Wall
SURROUNDINGS: dict[str, type[Frozen]] = {"viscous": Viscous, "wall": Wall}
"""What an environment can be, by the name of its kind."""
