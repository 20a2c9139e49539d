"""A scenario of three arms of six joints."""

SIX = """
name = "six"
title = "Three arms of six joints"
duration_s = {duration_s}
[arm]
urdf = "arm6.urdf"
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


def six_joints(duration_s: float, delay_ms: float = 20.0) -> str:
    """The scenario's text."""
    return SIX.format(duration_s=duration_s, delay_ms=delay_ms)
