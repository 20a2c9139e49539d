"""A compliant body that the end effector presses into, with damping that grows with the depth."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ... import fields
from ...core.vectors import Array
from ..operators import OwnActor


class HuntCrossley(OwnActor, frozen=True, kw_only=True, tag="hunt_crossley"):
    """Tissue or rubber: F = K d^(3/2) (1 + lambda d') along its normal, d the depth, and it
    never pulls.

    The contact of a sphere after Hertz with the damping of Hunt and Crossley, "Coefficient of
    restitution interpreted as damping in vibroimpact", J. Applied Mechanics 42 (1975): the
    force begins and ends at zero, where a spring and a damper jump and pull. It is passive: its
    damping takes energy at every depth.

    Attributes:
        point_m: a point of its surface, m.
        normal: towards the free side; its length does not matter.
        stiffness_n_m15: K, N/m^1.5.
        damping_s_m: lambda, s/m; 3/2 of the coefficient's loss of speed per speed of impact.
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
        """Writes the force, N."""
        square = depth = inward = 0.0
        for i in range(now.coordinates):
            square += self.normal[i] * self.normal[i]
            depth += (self.point_m[i] - now.at[i]) * self.normal[i]
            inward -= now.speed[i] * self.normal[i]
        if depth > 0.0:
            length = math.sqrt(square)
            depth = depth / length
            inward = inward / length
            push = (
                self.stiffness_n_m15
                * depth
                * math.sqrt(depth)
                * (1.0 + self.damping_s_m * inward)
            )
            if push > 0.0:
                for i in range(now.coordinates):
                    now.effort[i] = push * self.normal[i] / length

    def effort(self, t_s: Array, at: Array, speed: Array) -> Array:  # noqa: ARG002 - it does not change
        """Returns the force of many rows, N."""
        normal = np.array(self.normal) / np.linalg.norm(self.normal)
        depth = (np.array(self.point_m) - at) @ normal
        touched = np.where(depth.real > 0.0, depth, 0.0)
        push = (
            self.stiffness_n_m15
            * touched
            * np.sqrt(touched)
            * (1.0 - self.damping_s_m * (speed @ normal))
        )
        force: Array = np.where(push.real > 0.0, push, 0.0)[..., None] * normal
        return force
