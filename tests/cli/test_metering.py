"""`trilat metrics`: a table for people, JSON for programs."""

import json
from pathlib import Path

from tests.cli.running import simulate_by_command

from .running import trilat


def test_sites_links_and_walls_are_columns(tmp_path: Path) -> None:
    file = simulate_by_command(tmp_path, "contact", "rate_hz=200", seconds="4")
    output = trilat("metrics", file, "--all", cwd=tmp_path).succeeds()
    lines = output.splitlines()
    heads = [line.split() for line in lines]
    assert ["tracking", "m", "s"] in heads
    assert ["walls", "s/1"] in heads
    assert ["network", "s->m", "m->s"] in heads
    assert any(line.startswith("effort, int |tau|^2") and "N²m²s" in line for line in lines)
    assert "– settling time of m" in output
    assert "impedance at m, joint 1" in output
    assert "learning" not in output  # nobody learns


def test_json_is_for_programs(tmp_path: Path) -> None:
    file = simulate_by_command(tmp_path, "free", "rate_hz=100")
    facts = json.loads(trilat("metrics", "--json", file, cwd=tmp_path).succeeds())
    assert facts["version"] == 1
    assert facts["scenario"] == "free"
    assert facts["sites"]["m1"]["settle_s"] is None
    assert "exceeds" in facts["unknown"]["sites.m1.settle_s"]


def test_felt_torques_are_reported(tmp_path: Path) -> None:
    file = simulate_by_command(tmp_path, "force_sharing", "rate_hz=100", seconds="15")
    output = trilat("metrics", file, "--all", cwd=tmp_path).succeeds()
    (line,) = (line for line in output.splitlines() if line.startswith("14.0 - 15.0 s"))
    assert line.split()[4:9] == ["1", "s", "5", "m1", "4.792"]
