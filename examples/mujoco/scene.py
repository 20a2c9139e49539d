"""The arm of a scenario in MuJoCo, with something to touch: a box to push, a door with a spring, a slot.

    pip install 'trilat-net[sim]'
    cd examples/mujoco
    trilat sim push.toml -o push.mcap  # or: trilat demo push.toml
    trilat report push.mcap

The model is made of the scenario's own arm, planar or of a URDF, so that nothing is said twice. What touches
the arm is `tau_x` of its records: every law feels it, and its users do by dominance.
"""

from typing import Any

import numpy as np

import trilat_net as tn

try:
    import mujoco
except ImportError:
    raise ImportError("this plant needs MuJoCo: pip install 'trilat-net[sim]'") from None

THINGS = ("nothing", "box", "door", "slot")
SIZES_M = {
    "box": (0.2, 0.2, 0.2),
    "door": (0.04, 1.0, 0.2),
    "above": (0.2, 0.12, 0.2),
    "below": (0.2, 0.12, 0.2),
}
TIP_M = 0.03


class Scene:
    """An arm and a thing, moved by MuJoCo in steps of the site's tick.

    Args:
        facts: the site, its scenario and its start.
        thing: one of `THINGS`; it stands before the end effector's start, towards +x. The scenario gives its
            size and has its pose recorded and drawn: bodies = { box = [0.2, 0.2, 0.2] }.
        mass_kg: of the box.
        friction: between box, floor and end effector.
        spring_nm_rad: of the door.
        ahead_m: how far from the end effector the thing stands.
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
        start = np.zeros(3)
        place = facts.scenario.arms[facts.site].end_effector(facts.q0_rad)
        start[: len(place)] = place
        x_m, y_m, z_m = start + np.array([ahead_m, 0.0, 0.0])
        half = {
            name: np.array(facts.bodies_m.get(name, size)) / 2.0
            for name, size in SIZES_M.items()
        }
        text = (
            describe_arm(arm.chain, arm.theta, facts.h_s)
            + {
                "nothing": "",
                "box": f"""
                <geom type="plane" pos="0 {y_m - half["box"][1]} 0" zaxis="0 1 0" size="9 9 1"
                    friction="{friction}"/>
                <body pos="{x_m} {y_m} {z_m}"><freejoint/><geom name="box" type="box"
                    size="{_list(half["box"])}" mass="{mass_kg}" friction="{friction}"/></body>""",
                "door": f"""
                <body pos="{x_m} {y_m - half["door"][1]} {z_m}">
                    <joint type="hinge" axis="0 0 1" stiffness="{spring_nm_rad}" damping="1"/>
                    <geom name="door" type="box" pos="0 {half["door"][1]} 0" size="{_list(half["door"])}"
                    mass="2"/></body>""",
                "slot": f"""
                <geom name="above" type="box" pos="{x_m} {y_m + TIP_M + 0.01 + half["above"][1]} {z_m}"
                    size="{_list(half["above"])}" friction="{friction}"/>
                <geom name="below" type="box" pos="{x_m} {y_m - TIP_M - 0.01 - half["below"][1]} {z_m}"
                    size="{_list(half["below"])}" friction="{friction}"/>""",
            }[thing]
        )
        self.model: Any = mujoco.MjModel.from_xml_string(text + "</worldbody></mujoco>")
        self.data: Any = mujoco.MjData(self.model)
        self.joints = len(facts.q0_rad)
        self.data.qpos[: self.joints] = facts.q0_rad
        self.bodies = [self.data.geom(name) for name in facts.bodies_m]
        mujoco.mj_forward(self.model, self.data)

    def step(self, tau: np.ndarray, h_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Moves on by a tick under the control torque; returns q, qd, and tau_x of what it touched."""
        n = self.joints
        self.model.opt.timestep = h_s
        self.data.qfrc_applied[:n] = tau
        mujoco.mj_step(self.model, self.data)
        return self.data.qpos[:n], self.data.qvel[:n], -self.data.qfrc_constraint[:n]

    def poses(self) -> list[list[float]]:
        """Returns where the bodies are that the scenario names, m, and their orientations."""
        return [[*body.xpos, *_to_quaternion(body.xmat)] for body in self.bodies]


def describe_arm(chain: Any, theta: np.ndarray, h_s: float) -> str:
    """Returns the beginning of a model, up to its world: a scenario's arm, a body for each link.

    Each link's mass, first moments and inertia about its joint stand in theta, ten numbers; MuJoCo takes the
    inertia about the centre of mass.
    """
    gravity = " ".join(map(str, chain.gravity_m_s2))
    text = f"""<mujoco>
        <compiler angle="radian" boundmass="1e-6" boundinertia="1e-6" balanceinertia="true"/>
        <option timestep="{h_s}" gravity="{gravity}" integrator="implicitfast" cone="elliptic"/>
        <default><geom solref="0.005 1"/></default>
        <worldbody>"""
    for n, joint in enumerate(chain.joints):
        mass, *rest = theta[10 * n : 10 * n + 10]
        first, (xx, xy, yy, xz, yz, zz) = np.array(rest[:3]), rest[3:]
        centre = first / mass if mass > 0.0 else first
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        about -= mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        about += 1e-9 * np.eye(3)
        stops = bool(np.isfinite([joint.lower, joint.upper]).all())
        ends = _list((joint.lower, joint.upper)) if stops else "0 1"
        text += f"""
            <body pos="{_list(joint.origin_m)}" quat="{_list(_to_quaternion(joint.rotation))}">
                <inertial pos="{_list(centre)}" mass="{max(mass, 1e-6)}"
                    fullinertia="{_list(about[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])}"/>
                <joint type="{"slide" if joint.prismatic else "hinge"}" axis="{_list(joint.axis)}"
                    armature="{joint.armature_kg_m2}" damping="{joint.viscous}" frictionloss="{joint.coulomb}"
                    limited="{str(stops).lower()}" range="{ends}"/>"""
    return (
        text
        + f'<geom type="sphere" pos="{_list(chain.tip_m)}" size="{TIP_M}" mass="0"/>'
        + ("</body>" * len(chain.joints))
    )


def _list(numbers: Any) -> str:
    return " ".join(repr(float(one)) for one in numbers)


def _to_quaternion(rotation: Any) -> np.ndarray:
    found = np.zeros(4)
    mujoco.mju_mat2Quat(found, np.array(rotation, dtype=np.float64).reshape(-1))
    return found
