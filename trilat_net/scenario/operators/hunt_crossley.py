"""Models a soft body, such as tissue, into which the end effector of an arm presses.

The contact force has an elastic part, which grows with the depth, and a damping part, which
grows with the depth and with the speed of pressing (the model of Hunt and Crossley, 1975).
Therefore the force begins and ends at zero. A spring with a constant damper would make the
force jump at contact.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ... import fields
from ...core import Array
from . import OwnActor


class HuntCrossley(OwnActor, frozen=True, kw_only=True, tag="hunt_crossley"):
    """Compliant body, such as tissue or rubber, with a damping that grows with the depth.

        F = K d^(3/2) (1 + lambda d') along the normal of the surface, and never pulling

    d is the depth and d' its rate of change. The elastic part is the contact of a sphere after
    Hertz. The damping is that of Hunt and Crossley, "Coefficient of restitution interpreted as
    damping in vibroimpact", J. Applied Mechanics 42 (1975). With this damping, the force begins
    and ends at zero. The force of a linear spring and damper would jump at contact and pull at
    release. The body is passive, because its damping dissipates energy at every depth.

    Attributes:
        point_m: A point of the surface, in m.
        normal: Direction of the free side. Its length does not matter.
        stiffness_n_m15: K, in N/m^1.5.
        damping_s_m: lambda, in s/m: 3/2 of the rate at which the coefficient of restitution
            falls with the speed of impact.
    """

    group: ClassVar[str] = "environment"
    at_tip: ClassVar[bool] = True
    value_texts: ClassVar[Mapping[str, str]] = {
        "stiffness_n_m15": "a number of at least 0, N/m^1.5",
        "damping_s_m": "a number of at least 0, s/m",
    }

    point_m: fields.Point
    normal: fields.Point
    stiffness_n_m15: fields.NotNegative
    damping_s_m: fields.NotNegative = 0.0

    def act(self, now: Any) -> None:
        """Computes the force of the body on the end effector in N, and stores it in `now`.

        Nothing is stored while the end effector is outside of the body.

        Args:
            now: Position and speed of the end effector. Its field `effort` receives the force.
        """
        normal_squared = 0.0
        depth = 0.0
        depth_rate = 0.0
        for i in range(now.coordinates):
            normal_squared += self.normal[i] * self.normal[i]
            depth += (self.point_m[i] - now.at[i]) * self.normal[i]
            depth_rate -= now.speed[i] * self.normal[i]
        # The normal is normalised only in contact, which saves a square root in free motion.
        if depth > 0.0:
            length = math.sqrt(normal_squared)
            depth = depth / length
            depth_rate = depth_rate / length
            force = (
                self.stiffness_n_m15
                * depth
                * math.sqrt(depth)
                * (1.0 + self.damping_s_m * depth_rate)
            )
            if force > 0.0:
                for i in range(now.coordinates):
                    now.effort[i] = force * self.normal[i] / length

    # The force does not depend on the time.
    def effort(self, t_s: Array, position: Array, speed: Array) -> Array:  # noqa: ARG002
        """Computes the contact force of a compliant body on the end effector, in N.

        It is the formula of `act` for many positions at once.

        Args:
            t_s: Times, in s. The force does not depend on them.
            position: Positions of the end effector, in m, shape (..., n), where n is the number
                of coordinates. Leading dimensions are independent cases.
            speed: Velocities of the end effector, in m/s, shape (..., n).

        Returns:
            Forces in N, shape (..., n). Zero while the end effector is outside of the body.
        """
        normal = np.array(self.normal) / np.linalg.norm(self.normal)
        depth = (np.array(self.point_m) - position) @ normal
        contact_depth = np.where(depth.real > 0.0, depth, 0.0)
        magnitude = (
            self.stiffness_n_m15
            * contact_depth
            * np.sqrt(contact_depth)
            * (1.0 - self.damping_s_m * (speed @ normal))
        )
        force: Array = np.where(magnitude.real > 0.0, magnitude, 0.0)[..., None] * normal
        return force
