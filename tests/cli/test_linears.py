import json
from importlib.resources import files
from pathlib import Path

import pytest

from tests.documentation import find_blocks

from .running import trilat

AT = ("--pose", "0.07,0.23")


def test_output_has_rest_roots_verdict_and_margin(tmp_path: Path) -> None:
    output = trilat(
        "linear", "p_d_margin", "--set", "control.d=0.9", *AT, cwd=tmp_path
    ).succeeds()
    for text in (
        "all sites at (0.0700, 0.2300) rad",
        "re 1/s",
        "what moves",
        "q1 of m1, m2, s",
        "unstable:",
    ):
        assert text in output
    assert "stable for common delays up to" in output
    assert "2 roots are zero by structure" in output


@pytest.mark.long
def test_output_says_where_stability_changes_over_keys(tmp_path: Path) -> None:
    over = ("--over", "control.d=0.1:3", "--over", "link.delay_ms=1:50")
    output = trilat(
        "linear", "p_d_margin", "--no-ports", "--pose=-0.1,0.3", *over, cwd=tmp_path
    ).succeeds()
    assert "all sites at (-0.1000, 0.3000) rad" in output
    assert "control.d from 0.1 to 3: stable from 0.96" in output
    assert "link.delay_ms from 1 to 50: stability of p_d_margin does not change" in output


@pytest.mark.long
def test_json_has_all_results(tmp_path: Path) -> None:
    over = ("--over", "control.d=0.5:2")
    facts = json.loads(
        trilat("linear", "p_d_margin", *AT, *over, "--json", cwd=tmp_path).succeeds()
    )
    assert facts["verdict"] == "stable"
    assert len(facts["continuous"]["roots"]) == 6
    (edge,) = facts["edges"]["control.d"]
    assert edge["stable_above"] is True


def test_figures_are_reproducible_files(tmp_path: Path) -> None:
    for name in ("one.svg", "two.svg"):
        trilat(
            "linear", "p_d_margin", "--no-ports", *AT, "--figure", name, cwd=tmp_path
        ).succeeds()
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_an_identified_hand_holds_the_ports(tmp_path: Path) -> None:
    """The commands are those of docs/studies/measured-hands.md, with the sines of that page."""
    (sines,) = (
        block.text
        for block in find_blocks("docs/studies/measured-hands.md")
        if block.language == "toml"
    )
    shipped = (files("trilat_net") / "scenarios" / "p_d_margin_two.toml").read_text(
        encoding="utf-8"
    )
    (tmp_path / "moved.toml").write_text(f"{shipped}\n{sines}", encoding="utf-8")
    spring = 'sites.m.hands=[{kind="tip_spring",stiffness_n_m=[50,50],damping_n_s_m=[4,4]}]'
    settings = ("--set", "control.d=30", "--set", spring, "--set", "rate_hz=250")
    # the sines move s at 11.5 rad/s
    fast = (
        "--set",
        "limits.qd_limit_rad_s=20",
        "-o",
        "run.mcap",
    )
    trilat("sim", "moved.toml", "--duration", "30", *settings, *fast, cwd=tmp_path).succeeds()
    arguments = ("identify", "hand", "run.mcap", "--site", "m")
    assert "coherence" in trilat(*arguments, cwd=tmp_path).succeeds()
    (tmp_path / "m.json").write_text(
        trilat(*arguments, "--json", cwd=tmp_path).succeeds(), encoding="utf-8"
    )
    held = ("linear", "p_d_margin_two", *AT, "--set", "control.d=1.96", "--operators", "m.json")
    line = "any of the measured operators at each master: not shown at 0.001-"
    assert line in trilat(*held, cwd=tmp_path).succeeds()
    trilat(*held, "--operators", "run.mcap", cwd=tmp_path).refuses(
        "run.mcap: does not contain the output"
    )
