"""Users' own hands and plants, as scenarios name them: `tests.own_code:Circle`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from trilat_net.core.life.own_hand import HandContext, HandView
from trilat_net.scenario.plant_player import PlantContext
from trilat_net.scenario.simulated_arm import SimulatedArm


class Circle:
    """Moves the end effector along a circle, which starts slowly."""

    def __init__(self, facts: HandContext, radius_m: float = 0.1, turn_s: float = 1.5) -> None:
        self.radius_m = radius_m
        self.turn_s = turn_s
        self.facts = facts
        self.start: Any = None

    def act(self, now: HandView) -> Sequence[float] | None:
        if self.start is None:
            self.start = now.pose
        angle = 2.0 * math.pi * now.t_s / self.turn_s
        size = self.radius_m * min(1.0, now.t_s / self.turn_s)
        moved: Sequence[float] = self.start + size * np.array(
            [math.cos(angle) - 1.0, math.sin(angle)]
        )
        return moved


class Follower:
    """Moves towards its peers' samples, so that the result depends on every input."""

    def __init__(self, facts: HandContext) -> None:
        self.seen: list[HandView] = []
        self.facts = facts

    def act(self, now: HandView) -> Sequence[float] | None:
        self.seen.append(now)
        way = sum(
            (peer.alpha * (peer.q - now.q) * math.exp(-peer.age_s) for peer in now.peers),
            np.zeros(2),
        )
        goal: Sequence[float] = now.pose + 0.3 * way + 0.01 * now.grip * (now.target - now.pose)
        return goal


class Failing(Circle):
    """Fails at a time, in a given way."""

    def __init__(self, facts: HandContext, how: str = "raise", at_s: float = 0.3) -> None:
        super().__init__(facts)
        self.how = how
        self.at_s = at_s

    def act(self, now: HandView) -> Any:
        if now.t_s < self.at_s:
            return super().act(now)
        if self.how == "raise":
            raise RuntimeError("no idea")
        return {
            "nan": [math.nan, 0.0],
            "many": [0.0, 0.0, 0.0],
            "far": [1e9, 0.0],
            "text": ["here", "there"],
            "let go": None,
        }[self.how]


class Arm:
    """The scenario's own arm, written as a plant."""

    def __init__(self, facts: PlantContext) -> None:
        self.arm = SimulatedArm(facts.scenario, facts.site)

    def step(self, tau: Any, h_s: float) -> Sequence[Any]:
        self.arm.move(tau, h_s)
        return self.arm.q, self.arm.qd


class Carousel(Arm):
    """Moves the scenario's arm, and turns some bodies about the base."""

    def __init__(self, facts: PlantContext, how: str = "") -> None:
        super().__init__(facts)
        self.count = len(facts.bodies_m)
        self.how = how
        self.t_s = 0.0

    def step(self, tau: Any, h_s: float) -> Sequence[Any]:
        self.t_s += h_s
        return super().step(tau, h_s)

    def poses(self) -> Any:
        if self.how and self.t_s > 0.1:
            return {
                "few": [[0.0] * 7],
                "nan": [[float("nan")] * 7] * self.count,
                "short": [[0.0]],
            }[self.how]
        half = [0.5 * (self.t_s + n) for n in range(self.count)]
        return [[n, 0.1 * n, 0.0, np.cos(a), 0.0, 0.0, np.sin(a)] for n, a in enumerate(half)]


class Torn(Arm):
    """A plant that fails at its 200th step, in a given way."""

    def __init__(self, facts: PlantContext, how: str = "raise") -> None:
        super().__init__(facts)
        self.how = how
        self.steps = 0

    def step(self, tau: Any, h_s: float) -> Any:
        self.steps += 1
        q, qd = super().step(tau, h_s)
        if self.steps < 200:
            return q, qd
        if self.how == "raise":
            raise RuntimeError("the belt is torn")
        return {
            "nan": (q, [math.nan, 0.0]),
            "one": (q[:1], qd),
            "alone": (q,),
            "nothing": None,
            "touch": (q, qd, [0.0]),
        }[self.how]


MOTOR_S = 0.005
"""Time constant with which a motor's torque follows the law's torque, so that no acceleration jumps."""
PARTS = 5
"""The number of integration steps in a tick."""


class HeldArm:
    """The planar arm without gravity, held by a hand that also moves on its own."""

    def __init__(
        self,
        facts: PlantContext,
        M: list[float],
        B: list[float],
        K: list[float],
        unrest_n: float = 0.3,
    ) -> None:
        arm = facts.scenario.arms[facts.site]
        self.theta = arm.theta.tolist()
        self.lengths = arm.lengths_m
        self.M, self.B, self.K = (np.reshape(matrix, (2, 2)) for matrix in (M, B, K))
        self.q = np.array(facts.q0_rad)
        self.qd = np.zeros(2)
        self.at = self.look()[0]
        self.unrest_n = unrest_n
        self.own = np.zeros(2)
        self.tau = np.zeros(2)
        self.random = np.random.default_rng(facts.seed)

    def look(self) -> tuple[Any, Any, Any]:
        """Returns the position of the end effector, its Jacobian, and the Jacobian's derivative."""
        l1, l2 = self.lengths
        q1, q12 = np.cumsum(self.q)
        w1, w12 = np.cumsum(self.qd)
        s1 = l1 * np.sin(q1)
        c1 = l1 * np.cos(q1)
        s2 = l2 * np.sin(q12)
        c2 = l2 * np.cos(q12)
        J = np.array([[-s1 - s2, -s2], [c1 + c2, c2]])
        Jd = np.array([[-c1 * w1 - c2 * w12, -c2 * w12], [-s1 * w1 - s2 * w12, -s2 * w12]])
        return np.array([c1 + c2, s1 + s2]), J, Jd

    def move(self) -> tuple[Any, Any]:
        """Returns the acceleration, and the hand's torque ON the arm, in the present state."""
        at, J, Jd = self.look()
        bend = self.theta[1] * math.cos(self.q[1])
        swing = -self.theta[1] * math.sin(self.q[1])
        inner = self.theta[2] + bend
        inertia = np.array([[self.theta[0] + 2.0 * bend, inner], [inner, self.theta[2]]])
        w1, w2 = self.qd
        turning = swing * np.array([w2 * (2.0 * w1 + w2), -w1 * w1])
        force = (
            self.own
            - self.K @ (at - self.at)
            - self.B @ (J @ self.qd)
            - self.M @ (Jd @ self.qd)
        )
        qdd = np.linalg.solve(inertia + J.T @ self.M @ J, self.tau - turning + J.T @ force)
        return qdd, J.T @ (force - self.M @ (J @ qdd))

    def step(self, tau: Any, h_s: float) -> Sequence[Any]:
        part_s = h_s / PARTS
        keep = math.exp(-part_s / 0.1)
        follow = math.exp(-part_s / MOTOR_S)
        for _ in range(PARTS):
            self.qd = self.qd + part_s * self.move()[0]
            self.q = self.q + part_s * self.qd
            moved = math.sqrt(1.0 - keep * keep) * self.unrest_n * self.random.normal(size=2)
            self.own = keep * self.own + moved
            self.tau = tau + follow * (self.tau - tau)
        return self.q, self.qd, -self.move()[1]


class NoHand:
    """A class without `act`."""
