"""Models contact between the end effector of an arm and a soft body, such as tissue.

The contact force consists of an elastic part that grows with depth and a damping part that
grows with depth and with the speed of pressing (Hunt and Crossley, 1975). The force is
therefore zero at the start and end of contact, whereas a spring with a constant damper would
make it jump at contact.
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ... import fields
from ...core import Array
from . import OwnActor


class HuntCrossley(OwnActor, frozen=True, kw_only=True, tag="hunt_crossley"):
    """Compliant body, such as tissue or rubber, whose damping grows with depth.

        F = K d^(3/2) (1 + lambda d') along the surface normal, never pulling

    d is the depth and d' its rate of change. The elastic part is Hertzian contact with a
    sphere. The damping term is from Hunt and Crossley, "Coefficient of restitution interpreted
    as damping in vibroimpact", J. Applied Mechanics 42 (1975). It makes the force start and end
    at zero, whereas the force of a linear spring and damper jumps at contact and pulls at
    release. The body is passive, since the damping dissipates energy at every depth.

    Attributes:
        point_m: A point on the surface, in m.
        normal: Surface normal, pointing away from the body. Need not be normalised.
        stiffness_n_m15: K, in N/m^1.5.
        damping_s_m: lambda, in s/m: 3/2 times the rate at which the coefficient of restitution
            decreases with impact speed.
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
        """Computes the contact force on the end effector, in N, and stores it in `now`.

        Stores nothing while the end effector is outside the body.

        Args:
            now: Position and speed of the end effector. The field `effort` receives the force.
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
        """Computes the contact force on the end effector, in N.

        Uses the same formula as `act`, but evaluates it at many positions at once.

        Args:
            t_s: Times, in s. Not used, since the force does not depend on time.
            position: Positions of the end effector, in m, shape (..., n), where n is the number
                of coordinates. Leading dimensions are independent cases.
            speed: Velocities of the end effector, in m/s, shape (..., n).

        Returns:
            Forces in N, shape (..., n). Zero while the end effector is outside the body.
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
