"""A scenario of three arms of six joints, as an author writes it."""

from typing import Any

from trilat_net.scenario import Scenario, parse_scenario

SIX = """
name = "six"
[arm]
urdf = "arm6.urdf"
armature_kg_m2 = [0.2, 0.2, 0.2, 0.05, 0.05, 0.05]
[control]
Kp = [10, 10, 10, 2, 2, 2]
Kd = [2, 2, 2, 0.5, 0.5, 0.5]
[link]
delay_ms = 200
[sites.m1]
q0_rad = [0.3, -1.0, 1.2, -0.6, 0.5, 0.2]
[sites.m2]
q0_rad = [-0.4, -1.3, 1.5, -0.2, 0.1, 0.0]
[sites.s]
role = "slave"
q0_rad = [0.0, -1.1, 1.0, -0.4, 0.3, 0.1]
[dominance]
m1 = { m2 = 0.5, s = 0.5 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.5, m2 = 0.5 }
"""


def six(**changes: Any) -> Scenario:
    """The scenario with changes by dotted keys."""
    return parse_scenario(SIX, overrides=changes)
