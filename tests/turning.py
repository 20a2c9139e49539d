"""Motions through singular orientations, with SciPy's rotations as the truth, and logs that have them."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.log.builders import Record, edit_log_bytes, open_bytes, simulate_bytes
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario

CASE = Path(__file__).parent / "presentation" / "cases" / "tool_down.toml"
MOTIONS = range(30)
RECORDS = 150
AXES = (
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 1, 0),
    (1, 0, -1),
    (0, 1, 1),
    (1, 1, 1),
    (-1, 2, 0.5),
)
ALLOWED = 1.5
"""The largest permitted step of a series, relative to the largest step of the true motion."""


class Motion(NamedTuple):
    """The rotating bodies: the shared orientations of a site and of its reference, and the
    joints of its arm, rad.
    """

    turned: Rotation
    reference: Rotation
    q: Array


def make_rotation(number: int, records: int = RECORDS) -> Rotation:
    """Returns a tool that points down, half turns about every axis, or several turns about an
    axis that moves.
    """
    random = np.random.default_rng(number)
    s = np.linspace(0.0, 1.0, records)[:, np.newaxis]
    axis = np.array(AXES[number // 3 % len(AXES)], dtype=np.float64)
    axis /= np.linalg.norm(axis)
    sway = 0.3 * random.normal(size=3) * np.sin(2.0 * np.pi * s + random.uniform(0.0, 6.0, 3))
    down = Rotation.from_rotvec(np.pi * axis)
    if number % 3 == 0:
        return Rotation.from_rotvec(sway) * Rotation.from_rotvec(0.8 * (s - 0.5) * axis) * down
    if number % 3 == 1:
        return Rotation.from_rotvec((1.3 * np.pi * s + random.uniform(0.0, 0.6)) * axis)
    turns = Rotation.from_rotvec(2.0 * np.pi * random.uniform(1.5, 3.5) * s * axis)
    return Rotation.from_rotvec(2.0 * sway) * turns


def make_motion(number: int, site: str, start: Array, records: int = RECORDS) -> Motion:
    """Returns the motion of one site; sites move alike, one later than the other."""
    random = np.random.default_rng([number, *map(ord, site)])
    s = np.linspace(0.0, 1.0, records)[:, np.newaxis]
    reach = random.uniform(-2.5, 2.5, len(start)) * np.pi
    whole = make_rotation(number, records + 2)
    first = 1 if site == "m" else 0
    return Motion(
        whole[first : first + records], whole[2:], start + reach * s**2 * (3.0 - 2.0 * s)
    )


def count_wraps(turned: Rotation) -> int:
    """Counts the jumps of the rotation vectors, which are at most half a turn long."""
    steps = np.linalg.norm(np.diff(turned.as_rotvec(), axis=0), axis=1)
    return int(np.count_nonzero(steps > np.pi))


def find_largest_turn(turned: Rotation) -> float:
    """Returns the largest angle from one orientation to the next, rad."""
    return float((turned[1:] * turned[:-1].inv()).magnitude().max())


def place_links(scenario: Scenario, site: str, q: Array) -> list[Rotation]:
    """Returns the orientations of the links of an arm in its base."""
    chain = scenario.arms[site].chain
    assert chain is not None
    links = list[Rotation]()
    whole = Rotation.identity()
    for joint, angle in zip(chain.joints, q.T, strict=True):
        whole = (
            whole
            * Rotation.from_matrix(joint.rotation)
            * Rotation.from_rotvec(np.outer(angle, joint.axis))
        )
        links.append(whole)
    return links


@cache
def load_case() -> Scenario:
    return load_scenario(str(CASE), {"duration_s": RECORDS / 1000})


@cache
def _simulate() -> bytes:
    return simulate_bytes(load_case())


def make_turning_log(number: int) -> tuple[Log, dict[str, Motion]]:
    """Returns a log of two arms whose records have one of the motions, and the motions by site."""
    scenario = load_case()
    motions = {
        site: make_motion(number, site, np.array(scenario.sites[site].q0_rad))
        for site in scenario.names
    }
    vectors = {
        site: [rotation.as_rotvec() for rotation in motion[:2]]
        for site, motion in motions.items()
    }

    def record(fields: Record) -> Record:
        site = fields["site"]
        k = min(fields["tick"], RECORDS - 1)
        for field, vector in zip(("x", "q_des"), vectors[site], strict=True):
            fields[field] = [*fields[field][:3], *vector[k].tolist()]
        return {**fields, "q": motions[site].q[k].tolist()}

    return open_bytes(edit_log_bytes(_simulate(), record=record)), motions
