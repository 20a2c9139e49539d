"""Mistakes of authors in hands and environments: one sentence, at the key, with the valid choice."""

import re
from typing import Any

import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.operators import ENVIRONMENTS, OPERATORS

PULSE = {"kind": "pulse", "start_s": 1.0, "end_s": 2.0, "peak_nm": [1.0, 1.0]}
SPRING = {"kind": "spring", "stiffness_nm_rad": 100.0}
TIP = {"kind": "tip_spring", "stiffness_n_m": 100.0}
RECORDED = {"kind": "recorded", "points": [[0.0, 1.0, 1.0], [1.0, 1.0, 1.0]]}
VISCOUS = {"kind": "viscous", "damping_nm_s_rad": 1.0}
WALL = {"kind": "wall", "point_m": [1.3, 0.0], "normal": [-1.0, 0.0], "stiffness_n_m": 2000.0}
CHIRP = {"kind": "chirp", "peak_nm": 1.0, "from_hz": 0.5, "to_hz": 5.0, "sweep_s": 4.0}
MULTISINE = {"kind": "multisine", "amplitude_nm": 1.0, "frequencies_hz": [0.5, 1.25]}
BODY = {
    "kind": "hunt_crossley",
    "point_m": [1.3, 0.0],
    "normal": [-1.0, 0.0],
    "stiffness_n_m15": 2000.0,
}
GROUPS = {
    "hands": [PULSE, SPRING, TIP, RECORDED, CHIRP, MULTISINE],
    "environment": [BODY, VISCOUS, WALL],
}


def refused(group: str, entry: Any) -> str:
    with pytest.raises(ScenarioError) as error:
        load_scenario("free", {f"sites.s.{group}": [entry]})
    path, _, problem = str(error.value).removeprefix("free: ").partition(": ")
    return path.removeprefix(f"sites.s.{group}[0]") + ": " + problem


def test_every_kind_has_a_valid_example() -> None:
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        kinds_of_file = [kind for kind in kinds if kind not in ("live", "own")]
        assert [entry["kind"] for entry in GROUPS[group]] == kinds_of_file
        assert len(
            getattr(
                load_scenario("free", {f"sites.s.{group}": GROUPS[group]}).sites["s"], group
            )
        ) == len(GROUPS[group])


@pytest.mark.parametrize(
    ("group", "entry", "key"),
    [
        (group, {k: v for k, v in entry.items() if k != key}, key)
        for group, entries in GROUPS.items()
        for entry in entries
        for key in entry
    ],
    ids=str,
)
def test_missing_keys_name_their_meaning(group: str, entry: Any, key: str) -> None:
    said = refused(group, entry)
    assert said.startswith(f".{key}: is missing; the value must be ")
    assert len(said) > len(f".{key}: is missing; the value must be ") + 10


@pytest.mark.parametrize(
    ("group", "entry", "key"),
    [
        (group, {**entry, key: "x"}, key)
        for group, entries in GROUPS.items()
        for entry in entries
        for key in {**OPERATORS, **ENVIRONMENTS}[entry["kind"]].__struct_fields__
    ],
    ids=str,
)
def test_wrong_types_name_the_wanted_one(group: str, entry: Any, key: str) -> None:
    said = refused(group, entry)
    assert said.startswith(f".{key}: must be ")
    assert key == "points" or said.endswith("is 'x'")


@pytest.mark.parametrize(
    ("group", "entry", "said"),
    [
        (
            "hands",
            {"kind": "pluse"},
            ".kind: is 'pluse', but must be one of 'pulse', .*; did you mean 'pulse'",
        ),
        ("hands", WALL, ".kind: is 'wall', which belongs to environment"),
        ("environment", PULSE, ".kind: is 'pulse', which belongs to hands"),
        ("hands", {**PULSE, "peak": 1.0}, ".peak: unknown key; did you mean 'peak_nm'"),
        ("hands", {**SPRING, "stiffness_n_m": 1.0}, ".*; did you mean 'stiffness_nm_rad'"),
        (
            "hands",
            {**PULSE, "end_s": 0.5},
            ".end_s: must be later than start_s = 1, but is 0.5",
        ),
        (
            "hands",
            {**SPRING, "move_start_s": 4.0},
            ".move_end_s: must not be before move_start_s = 4, but is 0",
        ),
        (
            "hands",
            {**CHIRP, "to_hz": 0.0},
            ".to_hz: must be a frequency above 0 and up to 1000 Hz, but is 0.0",
        ),
        (
            "hands",
            {**MULTISINE, "phases_rad": [1.0]},
            ".phases_rad: must be 2 angles, one for each frequency",
        ),
        (
            "hands",
            {**PULSE, "peak_nm": [1.0]},
            ".peak_nm: must be one torque for both joints or two, ON",
        ),
        ("hands", {**SPRING, "stiffness_nm_rad": -5.0}, ".*at least 0, N m/rad, but is -5.0"),
        ("hands", {**SPRING, "sampled": 1}, ".sampled: must be true or false, but is 1"),
        (
            "hands",
            {**RECORDED, "points": [[0.0, 1.0]]},
            r".points\[0\]: must be a row \[time in s, torque",
        ),
        (
            "hands",
            {**RECORDED, "points": [[1.0, 0.0, 0.0]] * 2},
            ".points: must be in the order of",
        ),
        (
            "environment",
            {**WALL, "normal": [0.0, 0.0]},
            ".normal: must be a vector other than zero",
        ),
        (
            "environment",
            {**WALL, "normal": "left"},
            ".normal: .*to which side the wall is free, but is 'left'",
        ),
        (
            "environment",
            {**WALL, "stiffness_n_m": [1.0, 2.0]},
            ".stiffness_n_m: must be a number of",
        ),
        (
            "environment",
            {**WALL, "end_s": -1.0},
            ".end_s: must be a time of at least 0 s, but is -1.0",
        ),
        ("environment", [WALL], ": must be a table"),
    ],
    ids=str,
)
def test_mistakes_are_refused_at_their_key(group: str, entry: Any, said: str) -> None:
    assert re.match(said, refused(group, entry))


def test_invalid_start_poses_are_refused_at_keys() -> None:
    with pytest.raises(ScenarioError, match=r"sites.m1.q0_rad"):
        load_scenario("free", {"sites.m1.q0_rad": ["x", 0.0], "sites.m1.hands": [SPRING, TIP]})
