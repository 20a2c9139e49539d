"""Scenarios of chains: three arms of six joints, and two alike arms of any file; files of robots."""

import functools
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

SIX = """
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
TWO = """
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


def six_joints(duration_s: float, delay_ms: float = 20.0, urdf: str = "arm6.urdf") -> str:
    """Returns the text of three arms of six joints."""
    return SIX.format(duration_s=duration_s, delay_ms=delay_ms, urdf=urdf)


def two_arms(
    urdf: str,
    q0: Sequence[float],
    duration_s: float = 1.0,
    delay_ms: float = 40.0,
    armature: float | list[float] = 0.2,
) -> str:
    """Returns the text of two arms of one file in one pose."""
    return TWO.format(
        urdf=urdf, q0=list(q0), duration_s=duration_s, delay_ms=delay_ms, armature=armature
    )


@functools.cache
def robot_files() -> dict[str, Path]:
    """Returns the files of `example-robot-data`, which long tests have, by their path in its
    folder of robots.
    """
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
