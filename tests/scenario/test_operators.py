"""Mistakes of authors in hands and environments: one sentence, at the key, with the valid choice."""

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
