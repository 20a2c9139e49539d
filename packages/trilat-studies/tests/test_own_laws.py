"""Users' own laws in studies: given as classes, in scenarios that are tables, or loaded."""

from pathlib import Path
from typing import Any

import pytest
from trilat_studies.sweep import plan_sweep
from trilat_studies.sweep.fixed_gains import describe_fixed_gains
from trilat_studies.tuning.search_space import ModelInformation, SearchSpace
from trilat_studies.tuning.tuning_plan import plan_tuning

import trilat_net as tn
from tests.own_laws import PD, CompiledPD
from trilat_net.errors import UsageError

TABLES: dict[str, Any] = {
    "name": "mine",
    "duration_s": 1.0,
    "control": {"law": PD, "K": 20.0},
    "link": {"delay_ms": 20.0},
    "sites": {"m": {"role": "master", "q0_rad": [0.3, 0.1]}, "s": {"role": "slave"}},
    "dominance": {"m": {"s": 1.0}, "s": {"m": 1.0}},
}


def test_fixed_gains_include_defaults_of_own_laws() -> None:
    """Gains that neither the scenario nor an axis states are those of `__init__`, also inherited."""
    for law in (PD, CompiledPD):
        plan = plan_sweep(TABLES, over=["control.K=10,20"], laws=[law])
        assert describe_fixed_gains(plan) == [f"tests.own_laws:{law.__name__}: d 3, gravity 1"]
    stated = load_own_gains({"law": PD, "gravity": 0.5})
    assert stated == ["tests.own_laws:PD: K 10, d 3, gravity 0.5"]


def load_own_gains(control: dict[str, Any]) -> list[str]:
    """Returns the description of the gains that a sweep of the delay leaves fixed."""
    plan = plan_sweep({**TABLES, "control": control}, over=["link.delay_ms=10,20"])
    return describe_fixed_gains(plan)


def test_studies_take_tables_or_a_scenario() -> None:
    """Sweeps and tunings of a user's law take a mapping as well as a loaded scenario."""
    scenario = tn.load_scenario(TABLES)
    assert {site.control.code for site in scenario.sites.values()} == {"tests.own_laws:PD"}

    for source in (TABLES, scenario):
        swept = plan_sweep(source, ["control.d=4"], over=["control.K=10,30"], laws=[PD, "p_d"])
        cells = [swept.scenario(*swept.cell(n).overrides) for n in range(4)]
        controls = [cell.sites["s"].control for cell in cells]
        assert [control.settings for control in controls[:2]] == [
            {"K": K, "d": 4} for K in (10, 30)
        ]
        assert [(control.K[0], control.d[0]) for control in controls[2:]] == [
            (10.0, 4.0),
            (30.0, 4.0),
        ]

        tuned = plan_tuning(source, laws=[PD], budget=2)
        candidate = tuned.base.with_gains(
            tuned.spaces[0], tuned.knowledge, {"K": 11.0, "d": 2.0}
        )
        assert {site.control.settings["K"] for site in candidate.scenario.sites.values()} == {
            11.0
        }
        assert candidate.scenario.duration_s == 1.0


def test_trials_take_tables() -> None:
    (trial,) = tn.trials({**TABLES, "expect": {"stable": True}}, set={"control.law": PD})
    assert trial.source == "./mine.toml"
    assert trial.scenario.sites["m"].control.code == "tests.own_laws:PD"


def test_ranges_come_from_the_class() -> None:
    (space,) = SearchSpace.select(["tests.own_laws:PD"], tn.load_scenario("free"))
    assert [tuple(knob) for knob in space.knobs] == [
        ("K", "N m/rad", 5.0, 50.0, ""),
        ("d", "N m s/rad", 1.0, 20.0, ""),
    ]
    controls = space.controls(
        tn.load_scenario("free"), ModelInformation.of_gravity(90.0), {"K": 7.0, "d": 2.0}
    )
    assert controls["s"] == {"law": "tests.own_laws:PD", "K": 7.0, "d": 2.0, "gravity": 0.9}


def test_invalid_ranges_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for entry in ((3.0, 1.0), (0.0, 1.0), "wide", (1.0, 2.0, 3.0), (1.0,)):
        monkeypatch.setattr(PD, "tune", {"K": entry})
        with pytest.raises(UsageError, match=r"tune\['K'\] must be"):
            SearchSpace.of_user_law("tests.own_laws:PD")


@pytest.mark.long
def test_users_laws_are_tuned_like_built_in_ones(tmp_path: Path) -> None:
    """The user's law computes p_d, so both laws get the same numbers."""
    tuning = tn.tune("free", [CompiledPD, "p_d"], budget=2, duration_s=2, jobs=1)
    ours, theirs = (law.scores for law in tuning.found)
    assert tuning.found[0].space.law == "tests.own_laws:CompiledPD"
    assert all(score.error_rad is not None for score in [*ours, *theirs])

    swept = tn.sweep(
        "p_d_margin",
        ["control.d=0.3,3"],
        laws=["p_d", CompiledPD],
        duration_s=4,
        out=tmp_path / "grid",
        jobs=1,
    )
    verdicts = [row["verdict"] for row in swept.rows]
    assert verdicts[:2] == verdicts[2:]
    assert {row["law"] for row in swept.rows} == {"p_d", "tests.own_laws:CompiledPD"}

    edges = tn.margin(
        tn.load_scenario("p_d_margin"), "control.d=0.2:3", laws=[CompiledPD, "p_d"], tolerance=0.2, jobs=1,
        duration_s=4,
    )  # fmt: skip
    our_edge, their_edge = (edge.margin.spans[0].low for edge in edges.found)
    assert our_edge == their_edge
