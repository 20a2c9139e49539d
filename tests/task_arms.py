"""Scenarios of arms that follow with their end effectors."""

PLANAR = """
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


def planar_task(duration_s: float = 2.0, rate_hz: int = 1000, elbow_rad: float = 1.7) -> str:
    """Returns the text of two planar arms in task space."""
    return PLANAR.format(duration_s=duration_s, rate_hz=rate_hz, elbow_rad=elbow_rad)


POSED = """
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


def posed_arms(duration_s: float = 2.0) -> str:
    """Returns the text of three arms that agree on a place and an orientation; two of them have
    a redundant joint.
    """
    return POSED.format(duration_s=duration_s)
