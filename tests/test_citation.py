"""CITATION.cff, pyproject.toml and LICENSE tell the same."""

import re
import tomllib
from pathlib import Path

import trilat_net

ROOT = Path(trilat_net.__file__).parents[1]
CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def said(key: str) -> str:
    """A value at the top of the file."""
    (value,) = re.findall(rf"^{key}: \"?(.*?)\"?$", CITATION, re.MULTILINE)
    return str(value)


def test_they_name_the_same_program() -> None:
    assert said("cff-version") == "1.2.0"
    assert said("type") == "software"
    assert said("title") == PROJECT["name"]
    assert said("version") == PROJECT["version"]
    assert said("abstract") == PROJECT["description"]
    listed = re.findall(
        r"^  - \"?(.*?)\"?$",
        CITATION.split("keywords:")[1].split("references:")[0],
        re.MULTILINE,
    )
    assert listed == PROJECT["keywords"]


def test_they_name_the_same_licence_and_holder() -> None:
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert said("license") == PROJECT["license"] == "MIT"
    assert licence.startswith("MIT License")
    (holder,) = re.findall(r"^Copyright \(c\) \d{4} (.+)$", licence, re.MULTILINE)
    (author,) = re.findall(r"^authors:\n  - name: \"(.+)\"$", CITATION, re.MULTILINE)
    assert author == holder


def test_the_paper_is_a_reference() -> None:
    reference = CITATION.split("references:")[1]
    assert "type: article" in reference
    assert (
        "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty"
        in reference
    )
