"""Builders of scenarios: chains of joints, arms in task space, and any shipped scenario with overrides."""

import functools
from collections.abc import Sequence
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from trilat_net.scenario import Scenario, load_scenario, parse_scenario


def make_overrides(**keys: Any) -> dict[str, Any]:
    """Returns overrides of a scenario; `__` stands for the dot of a key."""
    return {key.replace("__", "."): value for key, value in keys.items()}


def make_scenario(source: str | Scenario, **keys: Any) -> Scenario:
    """Returns a scenario, shipped or not, with overrides; `__` stands for the dot of a key."""
    return load_scenario(source, make_overrides(**keys))


SIX_TEMPLATE = """
name = "six"
title = "Three arms of six joints"
duration_s = {duration_s}
[arm]
urdf = "{urdf}"
armature_kg_m2 = [0.2, 0.2, 0.2, 0.05, 0.05, 0.05]
[control]
law = "adaptive"
Lambda = 1.0
Kp = [10, 10, 10, 2, 2, 2]
Kd = [2, 2, 2, 0.5, 0.5, 0.5]
Gamma = 1.0
[link]
model = "constant"
delay_ms = {delay_ms}
[sites.m1]
q0_rad = [0.3, -1.0, 1.2, -0.6, 0.5, 0.2]
[sites.m2]
q0_rad = [-0.4, -1.3, 1.5, -0.2, 0.1, 0.0]
[sites.s]
role = "slave"
q0_rad = [0.0, -1.1, 1.0, -0.4, 0.3, 0.1]
[dominance]
m1 = {{ m2 = 0.5, s = 0.5 }}
m2 = {{ m1 = 0.5, s = 0.5 }}
s = {{ m1 = 0.5, m2 = 0.5 }}
"""
TWO_TEMPLATE = """
name = "two"
duration_s = {duration_s}
[arm]
urdf = "{urdf}"
armature_kg_m2 = {armature}
[control]
law = "adaptive"
Lambda = 1.0
Kp = 10.0
Kd = 2.0
Gamma = 1.0
[link]
model = "constant"
delay_ms = {delay_ms}
[sites.m]
q0_rad = {q0}
[sites.s]
role = "slave"
q0_rad = {q0}
[dominance]
m = {{ s = 1.0 }}
s = {{ m = 1.0 }}
"""


def six_joint_text(duration_s: float, delay_ms: float = 20.0, urdf: str = "arm6.urdf") -> str:
    """Returns the text of three arms of six joints."""
    return SIX_TEMPLATE.format(duration_s=duration_s, delay_ms=delay_ms, urdf=urdf)


def two_arm_text(
    urdf: str,
    q0: Sequence[float],
    duration_s: float = 1.0,
    delay_ms: float = 40.0,
    armature: float | list[float] = 0.2,
) -> str:
    """Returns the text of two arms of one file in one pose."""
    return TWO_TEMPLATE.format(
        urdf=urdf, q0=list(q0), duration_s=duration_s, delay_ms=delay_ms, armature=armature
    )


@functools.cache
def find_robot_files() -> dict[str, Path]:
    """Returns the files of `example-robot-data`, if it is installed, by their path in its folder of robots."""
    files = [
        str(file)
        for file in metadata.files("example-robot-data") or ()
        if file.suffix == ".urdf"
    ]
    places = {
        name.partition("/robots/")[2]: metadata.distribution("example-robot-data").locate_file(
            name
        )
        for name in files
    }
    return {name: Path(str(path)) for name, path in places.items()}


ROUGH_PARTS = """
[[sites.m1.hands]]
kind = "tip_spring"
to_m = [-0.4, -0.2, 0.1]
move_start_s = 0.5
move_end_s = 2.0
stiffness_n_m = 100.0
damping_n_s_m = 20.0
end_s = 3.0
[[sites.m2.hands]]
kind = "pulse"
start_s = 0.1
end_s = 0.9
peak_nm = [0.0, 0.0, 60.0, 0.0, 1.0, 0.0]
[sites.s.limits]
tau_limit_nm = [150.0, 30.0, 150.0, 28.0, 28.0, 28.0]
[[sites.s.environment]]
kind = "wall"
point_m = [0.0, 0.0, 0.27]
normal = [0.1, 0.0, 1.0]
stiffness_n_m = 500.0
[[sites.s.environment]]
kind = "viscous"
damping_nm_s_rad = 0.5
sampled = true
"""
"""An operator, a pulse, limits, a wall in space and a damper for three arms of six joints."""


def rough_arm_text() -> str:
    """Returns the text of three arms of six joints with everything that a chain supports.

    Each joint has friction, and the elbow stops at 1.55 rad.
    """
    file = resources.files("trilat_net") / "scenarios" / "arm6.urdf"
    dynamics = '<dynamics damping="0.8" friction="1.5"/>'
    urdf = file.read_text(encoding="utf-8").replace("<limit ", f"{dynamics}<limit ")
    elbow = urdf.index('<joint name="elbow"')
    stopped = urdf[elbow:].replace('upper="6.283185307179586"', 'upper="1.55"', 1)
    table = f"[urdf]\n\"rough.urdf\" = '''\n{urdf[:elbow]}{stopped}'''\n"
    return six_joint_text(4.0, 50.0, "rough.urdf") + ROUGH_PARTS + table


PLANAR_TEMPLATE = """
name = "planar"
title = "Two planar arms agree on a place"
duration_s = {duration_s}
rate_hz = {rate_hz}
[control]
law = "adaptive"
Lambda = 1.5
Kp = [6, 4]
Kd = [8.0, 5.0, 1.0]
Gamma = 0.5
[task]
space = "position"
axes = ["x", "y"]
[link]
model = "constant"
delay_ms = 60
[sites.m]
q0_rad = [0.3, 1.2]
[sites.s]
role = "slave"
q0_rad = [0.1, {elbow_rad}]
[dominance]
m = {{ s = 1.0 }}
s = {{ m = 1.0 }}
"""


def planar_task_text(
    duration_s: float = 2.0, rate_hz: int = 1000, elbow_rad: float = 1.7
) -> str:
    """Returns the text of two planar arms in task space."""
    return PLANAR_TEMPLATE.format(duration_s=duration_s, rate_hz=rate_hz, elbow_rad=elbow_rad)


POSED_TEMPLATE = """
name = "posed"
title = "Arms of six and seven joints agree on a pose"
duration_s = {duration_s}
[control]
law = "adaptive"
Lambda = 1.5
Kp = 10.0
Kd = [20.0, 20.0, 20.0, 4.0, 4.0, 4.0]
Gamma = 1.0
[task]
space = "pose"
[link]
model = "constant"
delay_ms = 40
[sites.m1]
q0_rad = [0.3, -0.2, -1.5, 0.2, -1.5, 1.6]
arm = {{ urdf = "arm6.urdf", armature_kg_m2 = 0.2, base_xyz_m = [0.9, 0.2, 0.4] }}
[sites.m2]
q0_rad = [0.1, -0.4, 0.1, -1.7, 0.1, 1.5, 0.3]
arm = {{ urdf = "arm7.urdf", armature_kg_m2 = 0.2 }}
task = {{ posture_rate_1_s = 0.6 }}
[sites.s]
role = "slave"
q0_rad = [0.0, -0.3, 0.0, -1.6, 0.0, 1.4, 0.0]
arm = {{ urdf = "arm7.urdf", armature_kg_m2 = 0.2 }}
task = {{ posture_rate_1_s = 0.6, scale = 1.1 }}
[dominance]
m1 = {{ m2 = 0.4, s = 0.6 }}
m2 = {{ m1 = 0.5, s = 0.5 }}
s = {{ m1 = 0.7, m2 = 0.3 }}
"""


def posed_task_text(duration_s: float = 2.0) -> str:
    """Returns the text of three arms that agree on a place and an orientation; two of them have
    a redundant joint.
    """
    return POSED_TEMPLATE.format(duration_s=duration_s)


SIX_JOINTS = six_joint_text(20.0, delay_ms=200.0)


def make_six_joint_scenario(**changes: Any) -> Scenario:
    return parse_scenario(SIX_JOINTS, overrides=changes)
