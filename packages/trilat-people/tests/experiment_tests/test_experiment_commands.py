"""`trilat experiment`: from a protocol to its table, and refusals in a sentence."""

import json
import re
from pathlib import Path

from tests.cli.running import shorten, trilat


def test_a_protocol_becomes_a_table(tmp_path: Path) -> None:
    assert (
        "trilat experiment run reaching.toml"
        in trilat("experiment", "new", "reaching.toml", cwd=tmp_path).succeeds()
    )
    assert (
        "12 participants"
        in trilat("experiment", "check", "reaching.toml", cwd=tmp_path).succeeds()
    )
    shorten(tmp_path / "reaching.toml")
    run_output = trilat(
        "experiment", "run", "reaching.toml", "--jobs", "1", cwd=tmp_path
    ).succeeds()
    folder = "runs/experiment-reaching-001"
    assert f"4 trials, into {folder}; after Ctrl-C, continue with" in run_output
    assert "reaching: 4 of 4 trials" in run_output
    again = json.loads(trilat("experiment", "run", folder, "--json", cwd=tmp_path).out)
    assert (again["done"], again["conditions"]) == (4, ["no_delay", "delay_300"])
    assert "4 of 4" in trilat("experiment", "status", folder, cwd=tmp_path).succeeds()
    output = trilat(
        "experiment", "analyse", folder, "--exclude", "P2=late", cwd=tmp_path
    ).succeeds()
    assert "excluded: 1\nexclusions: P2 late\n" in output
    assert f"{folder}/analysis/analysis.json" in output
    next((tmp_path / folder / "logs").iterdir()).unlink()
    assert "is missing" in trilat("experiment", "status", folder, cwd=tmp_path).err


def test_errors_are_one_sentence(tmp_path: Path) -> None:
    trilat("experiment", "new", "reaching.toml", cwd=tmp_path).succeeds()
    file = tmp_path / "reaching.toml"
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("participants = 12", "participants = 11"), encoding="utf-8")
    refused = trilat("experiment", "check", "reaching.toml", cwd=tmp_path)
    assert refused.code == 2
    assert "the number of participants must be a multiple of 4, not 11" in " ".join(
        refused.err.split()
    )
    assert "contains no experiment" in trilat("experiment", "status", ".", cwd=tmp_path).err
    assert (
        "reaching.toml already exists"
        in trilat("experiment", "new", "reaching.toml", cwd=tmp_path).err
    )


def test_two_person_protocols_run_as_written(tmp_path: Path) -> None:
    trilat("experiment", "new", "two-people.toml", "--pair", cwd=tmp_path).succeeds()
    output = trilat("experiment", "check", "two-people.toml", cwd=tmp_path).succeeds()
    assert "3 conditions of 1 + 10 trials: 33 trials" in output
    file = tmp_path / "two-people.toml"
    text = re.sub(r"\[conditions\.delay_\d00\]\n[^\[]*", "", file.read_text(encoding="utf-8"))
    file.write_text(text.replace("trials = 10", "trials = 1"), encoding="utf-8")
    output = trilat(
        "experiment", "run", "two-people.toml", "--out", "models", "--jobs", "1", cwd=tmp_path
    ).succeeds()
    assert "two_people: 2 of 2 trials, in models" in output
    refused = trilat("experiment", "run", "models", "--live", "--no-browser", cwd=tmp_path)
    assert refused.code == 2
    assert "trials were done by synthetic participants" in " ".join(refused.err.split())
    refused = trilat(
        "experiment", "run", "two-people.toml", "--live", "--host", "0.0.0.0", cwd=tmp_path
    )
    assert "give --insecure" in " ".join(refused.err.split())
