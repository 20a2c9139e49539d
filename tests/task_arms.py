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
    """The text of two planar arms in task space."""
    return PLANAR.format(duration_s=duration_s, rate_hz=rate_hz, elbow_rad=elbow_rad)
