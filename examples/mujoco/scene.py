"""Simulates an arm in MuJoCo that touches a box, a door with a spring, or a slot.

    make extras EXTRAS=sim  # after the first release: pip install 'trilat-net[sim]'
    cd examples/mujoco
    trilat sim push.toml -o push.mcap  # or: trilat demo push.toml
    trilat report push.mcap

The MuJoCo model is generated from the arm in the scenario, planar or from a URDF, so that no
parameter is stated twice. The torque of a contact is `tau_x` in the records of the site. The
control laws react to it, and so users feel it, in proportion to their dominance factors.
"""

from typing import Any

import numpy as np

import trilat_net as tn

try:
    import mujoco
except ImportError:
    raise ImportError("this plant needs MuJoCo: make extras EXTRAS=sim") from None

THINGS = ("nothing", "box", "door", "slot")
SIZES_M = {
    "box": (0.2, 0.2, 0.2),
    "door": (0.04, 1.0, 0.2),
    "above": (0.2, 0.12, 0.2),
    "below": (0.2, 0.12, 0.2),
}
TIP_M = 0.03


class Scene:
    """An arm and an object that it can touch, simulated by MuJoCo with the tick of the site.

    Args:
        facts: the site, its scenario and its initial state.
        thing: the object, one of `THINGS`. It is placed in front of the end effector, in the
            direction +x. If the scenario states its size, as in
            bodies = { box = [0.2, 0.2, 0.2] }, its pose is recorded and drawn.
        mass_kg: mass of the box.
        friction: friction coefficient of box, floor and end effector.
        spring_nm_rad: stiffness of the door's spring.
        ahead_m: distance of the object from the end effector.
    """

    def __init__(
        self,
        facts: tn.PlantContext,
        thing: str = "box",
        mass_kg: float = 1.0,
        friction: float = 0.4,
        spring_nm_rad: float = 20.0,
        ahead_m: float = 0.2,
    ) -> None:
        if thing not in THINGS:
            raise ValueError(f"thing is one of {', '.join(THINGS)}, not {thing!r}")
        arm = tn.SimulatedArm(facts.scenario, facts.site)
        start_m = np.zeros(3)
        tip_m = facts.scenario.arms[facts.site].end_effector(facts.q0_rad)
        start_m[: len(tip_m)] = tip_m
        x_m, y_m, z_m = start_m + np.array([ahead_m, 0.0, 0.0])
        half = {
            name: np.array(facts.bodies_m.get(name, size)) / 2.0
            for name, size in SIZES_M.items()
        }
        text = (
            describe_arm(arm.chain, arm.theta, facts.h_s)
            + {
                "nothing": "",
                "box": f"""
                <geom type="plane" pos="0 {y_m - half["box"][1]} 0" zaxis="0 1 0"
                    size="9 9 1" friction="{friction}"/>
                <body pos="{x_m} {y_m} {z_m}"><freejoint/><geom name="box" type="box"
                    size="{_list(half["box"])}" mass="{mass_kg}" friction="{friction}"/></body>""",
                "door": f"""
                <body pos="{x_m} {y_m - half["door"][1]} {z_m}">
                    <joint type="hinge" axis="0 0 1" stiffness="{spring_nm_rad}" damping="1"/>
                    <geom name="door" type="box" pos="0 {half["door"][1]} 0"
                    size="{_list(half["door"])}" mass="2"/></body>""",
                "slot": f"""
                <geom name="above" type="box"
                    pos="{x_m} {y_m + TIP_M + 0.01 + half["above"][1]} {z_m}" size="{_list(half["above"])}" friction="{friction}"/>
                <geom name="below" type="box"
                    pos="{x_m} {y_m - TIP_M - 0.01 - half["below"][1]} {z_m}" size="{_list(half["below"])}" friction="{friction}"/>""",
            }[thing]
        )
        self.model: Any = mujoco.MjModel.from_xml_string(text + "</worldbody></mujoco>")
        self.data: Any = mujoco.MjData(self.model)
        self.joints = len(facts.q0_rad)
        self.data.qpos[: self.joints] = facts.q0_rad
        self.bodies = [self.data.geom(name) for name in facts.bodies_m]
        mujoco.mj_forward(self.model, self.data)

    def step(self, tau: np.ndarray, h_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulates one tick with a constant control torque.

        Returns:
            Joint angles, joint velocities, and the torque of contacts with the sign of `tau_x`.
        """
        n = self.joints
        self.model.opt.timestep = h_s
        self.data.qfrc_applied[:n] = tau
        mujoco.mj_step(self.model, self.data)
        return self.data.qpos[:n], self.data.qvel[:n], -self.data.qfrc_constraint[:n]

    def poses(self) -> list[list[float]]:
        """Returns position (m) and orientation (quaternion) of each body in the scenario."""
        return [[*body.xpos, *_to_quaternion(body.xmat)] for body in self.bodies]


def describe_arm(chain: Any, theta: np.ndarray, h_s: float) -> str:
    """Returns the beginning of a MuJoCo model: the arm of a scenario, with a body per link.

    For each link, theta contains ten numbers: its mass, its first moments, and its inertia
    about the joint. MuJoCo expects the inertia about the centre of mass, which follows from
    Steiner's theorem.

    Args:
        chain: joints and frames of the arm.
        theta: inertial parameters of all links, shape (10 n,).
        h_s: time step, in s.
    """
    gravity = " ".join(map(str, chain.gravity_m_s2))
    text = f"""<mujoco>
        <compiler angle="radian" boundmass="1e-6" boundinertia="1e-6" balanceinertia="true"/>
        <option timestep="{h_s}" gravity="{gravity}" integrator="implicitfast" cone="elliptic"/>
        <default><geom solref="0.005 1"/></default>
        <worldbody>"""
    for n, joint in enumerate(chain.joints):
        mass, *rest = theta[10 * n : 10 * n + 10]
        first_moments = np.array(rest[:3])
        xx, xy, yy, xz, yz, zz = rest[3:]
        centre = first_moments / mass if mass > 0.0 else first_moments
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia -= mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        inertia += 1e-9 * np.eye(3)  # MuJoCo refuses a link without inertia
        has_stops = bool(np.isfinite([joint.lower, joint.upper]).all())
        stops = _list((joint.lower, joint.upper)) if has_stops else "0 1"
        text += f"""
            <body pos="{_list(joint.origin_m)}" quat="{_list(_to_quaternion(joint.rotation))}">
                <inertial pos="{_list(centre)}" mass="{max(mass, 1e-6)}"
                    fullinertia="{_list(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])}"/>
                <joint type="{"slide" if joint.prismatic else "hinge"}" axis="{_list(joint.axis)}"
                    armature="{joint.armature_kg_m2}" damping="{joint.viscous}"
                    frictionloss="{joint.coulomb}" limited="{str(has_stops).lower()}" range="{stops}"/>"""
    return (
        text
        + f'<geom type="sphere" pos="{_list(chain.tip_m)}" size="{TIP_M}" mass="0"/>'
        + ("</body>" * len(chain.joints))
    )


def _list(numbers: Any) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _to_quaternion(rotation: Any) -> np.ndarray:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.array(rotation, dtype=np.float64).reshape(-1))
    return quaternion
