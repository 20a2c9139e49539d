"""CITATION.cff, pyproject.toml, LICENSE and the BibTeX of `trilat certify --cite` agree."""

import csv
import re
import tomllib
from pathlib import Path

import pytest

import trilat_net
from tests.own_laws import PD
from trilat_net.log.provenance import collect_provenance
from trilat_net.presentation.citation import compose_citation

ROOT = Path(trilat_net.__file__).parents[1]
CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
PAPER_TITLE = (
    "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty"
)
PAPER_AUTHORS = ["Motaharifar", "Bataleblu", "Taghirad"]
PAPER_YEAR = "2016"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def read_field(key: str) -> str:
    """Returns a value at the top of the file."""
    (value,) = re.findall(rf"^{key}: \"?(.*?)\"?$", CITATION, re.MULTILINE)
    return str(value)


def test_all_files_name_the_same_program() -> None:
    assert read_field("cff-version") == "1.2.0"
    assert read_field("type") == "software"
    assert read_field("title") == PROJECT["name"]
    assert read_field("version") == PROJECT["version"]
    assert read_field("abstract") == PROJECT["description"]
    listed = re.findall(
        r"^  - \"?(.*?)\"?$",
        CITATION.split("keywords:")[1].split("references:")[0],
        re.MULTILINE,
    )
    assert listed == PROJECT["keywords"]


def test_all_files_name_one_licence_and_holder() -> None:
    licence = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert read_field("license") == PROJECT["license"] == "MIT"
    assert licence.startswith("MIT License")
    (holder,) = re.findall(r"^Copyright \(c\) \d{4} (.+)$", licence, re.MULTILINE)
    (author,) = re.findall(r"^authors:\n  - name: \"(.+)\"$", CITATION, re.MULTILINE)
    assert author == holder


def test_the_paper_is_a_reference() -> None:
    reference = CITATION.split("references:")[1]
    assert "type: conference-paper" in reference
    assert f'title: "{PAPER_TITLE}"' in reference
    assert re.findall(r"family-names: (\w+)", reference) == PAPER_AUTHORS
    assert f"year: {PAPER_YEAR}" in reference


def test_the_references_list_their_stated_number() -> None:
    with (ROOT / "docs/data/references.csv").open(encoding="utf-8", newline="") as file:
        works = list(csv.DictReader(file))
    page = (ROOT / "docs/reference/references.md").read_text(encoding="utf-8")
    assert re.findall(r"lists all (\d+) works", page) == [str(len(works))]
    (paper,) = (work for work in works if work["title"].lower() == PAPER_TITLE.lower())
    assert [name.split()[-1] for name in paper["authors"].split(", ")] == PAPER_AUTHORS
    assert paper["year"] == PAPER_YEAR


@pytest.mark.parametrize(
    ("scenario", "works"),
    [("paper", {"Motaharifar2016"}), ("p_d_margin", {"Nuno2009"})],
)
def test_the_paragraph_cites_its_listed_works(scenario: str, works: set[str]) -> None:
    log = trilat_net.simulate(scenario, duration_s=2.0)
    paragraph, _, *entries = compose_citation(log, trilat_net.certify(log))
    cited = set(re.findall(r"\\cite\{(\w+)\}", paragraph))
    listed = {key for entry in entries for key in re.findall(r"^@\w+\{(\w+),", entry)}
    assert cited == listed
    assert listed & {"Motaharifar2016", "Nuno2009"} == works


def test_the_papers_entry_is_the_citation_files() -> None:
    log = trilat_net.simulate("paper", duration_s=1.0)
    (entry,) = (
        entry
        for entry in compose_citation(log, trilat_net.certify(log))
        if "{Motaharifar2016," in entry
    )
    fields = dict(re.findall(r"(\w+) = \{([^{}]+)\}", " ".join(entry.split())))
    assert fields["title"].lower() == PAPER_TITLE.lower()
    assert re.findall(r"(\w+), [A-Z]", fields["author"]) == PAPER_AUTHORS
    assert fields["year"] == PAPER_YEAR


@pytest.mark.parametrize(
    ("settings", "phrases"),
    [
        (
            {"control.K": 12.5},
            ["p_d (K 12.5, d 2.1, gravity 1)", "Delays of the links: 200 ms."],
        ),
        ({"sites.m.control.d": 9.5, "seed": 4}, ["m: p_d (K 10, d 9.5", "seed 4"]),
        ({"links.m->s.delay_ms": 35}, ["m->s: 35 ms", "s->m: 200 ms"]),
        (
            {"control.law": PD, "control.K": 7.0},
            ["tests.own_laws:PD (K 7), other settings as "],
        ),
    ],
)
def test_citation_states_laws_gains_delays_and_seed(
    settings: dict[str, object], phrases: list[str]
) -> None:
    log = trilat_net.simulate("p_d_margin_two", settings, duration_s=1.0)
    paragraph = next(compose_citation(log, trilat_net.certify(log)))
    for phrase in [*phrases, f"seed {log.scenario.seed}"]:
        assert phrase in paragraph
    for law in log.scenario.controls:
        sha256 = getattr(law, "source_sha256", "")
        assert sha256[:16] in paragraph


def test_software_entry_states_version_and_commit() -> None:
    log = trilat_net.simulate("p_d_margin_two", duration_s=1.0)
    _, _, entry, *_ = compose_citation(log, trilat_net.certify(log))
    facts = collect_provenance()
    assert f"{{{facts['version_trilat-net']}}}" in entry
    assert (facts["commit"] in entry) == (facts["commit"] != "unknown")
