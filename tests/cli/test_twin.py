"""`trilat twin`: one line for every mistake, words for every push, a figure."""

import json
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import pytest

import trilat_net as tn
from tests.cli.running import simulate_by_command, trilat
from tests.execution.builders import make_log_without
from trilat_net.app.cli.runs import certify_command
from trilat_net.errors import NotRepeatable
from trilat_net.execution.fused import FusedRun

OWN_LAW = Path(__file__).parents[1] / "golden" / "own-law.mcap"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("twin")
    simulate_by_command(folder, "two_sites", seconds="4")
    return folder


def test_pushes_are_described_and_drawn(folder: Path) -> None:
    arguments = (
        "twin",
        "run.mcap",
        "--at",
        "1",
        "--push",
        "m.q1=1e-6",
        "--push",
        "s.qd2",
        "-o",
        "twin.png",
    )
    lines = trilat(*arguments, cwd=folder).succeeds().splitlines()
    assert lines[0].startswith("a push of 1e-06 rad at m joint 1 at 1 s becomes ")
    assert lines[1].startswith("a push of 1e-06 rad/s at s joint 2 at 1 s becomes ")
    assert lines[2].strip() == "twin.png"
    first = (folder / "twin.png").read_bytes()
    assert first.startswith(b"\x89PNG")
    trilat(*arguments, cwd=folder).refuses("twin.png", "--force")
    trilat(*arguments, "--force", cwd=folder).succeeds()
    assert (folder / "twin.png").read_bytes() == first


def test_two_sizes_push_one_joint(folder: Path) -> None:
    arguments = ("twin", "run.mcap", "--push", "m.q1=1e-6", "--push", "m.q1=-1e-3")
    lines = trilat(*arguments, cwd=folder).succeeds().splitlines()
    assert [line.split()[3] for line in lines] == ["1e-06", "-0.001"]


def test_sizes_are_separated_from_linear_growth(folder: Path) -> None:
    facts = json.loads(
        trilat("twin", "run.mcap", "--delta", "1e-9:1e-3", "--json", cwd=folder).succeeds()
    )
    assert facts["linear"]["smallest"] == 1e-9
    assert facts["linear"]["text"].startswith("linear from 1e-09 to 0.001 rad at all joints")
    assert [push["push"].split()[0] for push in facts["pushes"]] == [
        f"{10.0**n:g}" for n in range(-9, -2)
    ]


def test_two_logs_are_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / simulate_by_command(tmp_path, "two_sites", "seed=2", seconds="1")
    trilat("twin", "run.mcap", other, cwd=folder).refuses("not a part of the session")


def test_a_forbidden_law_has_no_twin(folder: Path) -> None:
    done = trilat("twin", OWN_LAW, cwd=folder)
    assert done.code == 4
    assert done.err.splitlines()[-1].startswith("error: ")


def test_unexecutable_logs_have_no_twin() -> None:
    lost = make_log_without({"m1": [7]})
    log = tn.simulate("two_sites", duration_s=0.2)
    with pytest.raises(NotRepeatable, match="records of m1 are missing"):
        tn.twin(lost)
    with pytest.raises(
        NotRepeatable, match="the sites whose records were copied did not react"
    ):
        tn.twin(tn.rerun(log, ["s"], {"control.Kd": 5}).after)
    external = SimpleNamespace(
        scenario=tn.load_scenario("free", {"sites.m1.plant": "external"})
    )
    assert "the external arm of m1" in FusedRun.explain_not_repeatable(external)


@pytest.mark.parametrize("command", ["certify", "twin"])
def test_help_mentions_twins(command: str, folder: Path) -> None:
    assert "twin" in trilat(command, "--help", cwd=folder).succeeds()


def test_a_certificate_without_twins_has_none(folder: Path) -> None:
    without = json.loads(
        trilat("certify", "run.mcap", "--twins", "0", "--json", cwd=folder).out
    )
    three = json.loads(trilat("certify", "run.mcap", "--twins", "3", "--json", cwd=folder).out)
    assert without["twins"] is None
    assert signature(certify_command).parameters["twins"].default is None
    assert len(three["twins"]["pushes"]) == 3
