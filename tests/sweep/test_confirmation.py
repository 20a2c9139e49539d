"""Cells beside edges, run once more: which are taken, and what counts as the same."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from trilat_net.errors import UsageError
from trilat_net.scenario import Scenario, load
from trilat_net.sim import virtual
from trilat_net.sweep import judging
from trilat_net.sweep.confirmation import Runner, Session, beside_edges, confirm, confirmed_table
from trilat_net.sweep.outcome import Verdict

from .maps import KEYS, Row, by_the_line, rows

BRIEF = {"link.delay_ms": 0.0, "rate_hz": 200, "duration_s": 4.0}
CALM = load("p_d_margin", {**BRIEF, "control.d": 20.0})
WILD = load("p_d_margin", {**BRIEF, "control.d": 0.2, "link.delay_ms": 500.0, "limits.qd_limit_rad_s": 12.0})


def cell(scenario: Scenario) -> Row:
    """A cell's row, as its own run makes it."""
    outcome = judging.judge(scenario.text, scenario.duration_s)
    return {
        "cell": 3,
        **dict.fromkeys(KEYS, 1.0),
        "law": "p_d",
        "seed": 1,
        "verdict": outcome.verdict.value,
        "ran_s": outcome.ran_s,
        "diverged_s": outcome.diverged_s,
        "scenario": scenario.text,
    }


def runner(folder: Path, *problems: str, instead: Scenario | None = None) -> Runner:
    """A network that is none: sessions are runs in virtual time."""

    def run(scenario: Scenario, name: str) -> Session:
        log = folder / f"{name}.mcap"
        with log.open("wb") as stream:
            virtual.record(instead or scenario, stream)
        return Session(log, problems)

    return run


@pytest.mark.parametrize("scenario", [CALM, WILD], ids=["calm", "wild"])
def test_a_log_of_the_same_run_has_the_same_verdict(scenario: Scenario, tmp_path: Path) -> None:
    row = cell(scenario)
    found = confirm(row, runner(tmp_path))
    assert found.same
    assert found.live is found.virtual is Verdict(row["verdict"])
    assert found.log == tmp_path / "cell-3.mcap"


def test_the_cells_of_this_test_are_on_both_sides() -> None:
    assert [cell(one)["verdict"] for one in (CALM, WILD)] == ["converged", "diverged"]


def test_another_run_differs(tmp_path: Path) -> None:
    found = confirm(cell(CALM), runner(tmp_path, instead=WILD))
    assert not found.same
    assert (found.virtual, found.live) == (Verdict.CONVERGED, Verdict.DIVERGED)


def test_a_session_is_as_long_as_the_cell_ran(tmp_path: Path) -> None:
    """Also where the cell had been extended; one that diverged has half a second more, to get there."""
    asked: list[float] = []

    def run(scenario: Scenario, _: str) -> Session:
        asked.append(scenario.duration_s)
        return Session(tmp_path / "none.mcap", ["failed"])

    for changes in ({"ran_s": 8.0}, {"ran_s": 2.5, "diverged_s": 2.5}):
        confirm({**cell(CALM), **changes}, run)
    assert asked == [8.0, 3.0]


def test_what_failed_confirms_nothing(tmp_path: Path) -> None:
    row = cell(CALM)
    found = confirm(row, runner(tmp_path, "s was killed by SIGKILL"))
    assert (found.same, found.live, found.text) == (False, None, "s was killed by SIGKILL")

    def torn(_: Scenario, name: str) -> Session:
        (tmp_path / name).write_bytes(b"no log")
        return Session(tmp_path / name, [])

    found = confirm(row, torn)
    assert (found.same, found.live) == (False, None)
    assert "cell-3" in found.text
    missing = confirm(row, lambda *_: Session(tmp_path / "missing.mcap", []))
    assert (missing.same, missing.log) == (False, None)


def stable(row: Row) -> bool | None:
    return Verdict(row["verdict"]).stable


def test_cells_are_beside_an_edge_as_many_on_either_side() -> None:
    every = list(rows())
    found = beside_edges(every, KEYS, 3)
    assert [stable(row) for row in found] == [True] * 3 + [False] * 3
    assert len({row["cell"] for row in found}) == 6
    for row in found:
        delay, d = row[KEYS[0]], row[KEYS[1]]
        near = [
            one
            for one in every
            if (abs(one[KEYS[0]] - delay), round(abs(one[KEYS[1]] - d), 9)) in ((100, 0.0), (0, 0.5))
        ]
        assert any(stable(one) is not stable(row) for one in near)


def test_cells_are_spread_over_the_edge() -> None:
    found = beside_edges(list(rows()), KEYS, 2)
    delays = [row[KEYS[0]] for row in found if stable(row)]
    assert max(delays) - min(delays) >= 300


def test_few_cells_are_all_there_are() -> None:
    found = beside_edges(list(rows()), KEYS, 100)
    assert len({row["cell"] for row in found}) == len(found) < 25


def test_undecided_cells_are_not_run_and_the_edge_is_beyond_them() -> None:
    def band(delay_ms: float, d: float, *_: Any) -> Verdict:
        return Verdict.UNDECIDED if abs(d - 5e-3 * delay_ms) < 0.3 else by_the_line(delay_ms, d)

    found = beside_edges(list(rows(band)), KEYS, 3)
    assert [stable(row) for row in found] == [True] * 3 + [False] * 3
    with pytest.raises(UsageError, match="no edge"):
        beside_edges(list(rows(lambda *_: Verdict.UNDECIDED)), KEYS, 1)


def test_another_seed_or_law_is_no_neighbour() -> None:
    def by(row: Row) -> Row:
        side = Verdict.CONVERGED if (row["seed"], row["law"]) == (1, "p_d") else Verdict.DIVERGED
        return {**row, "verdict": side.value}

    many = [by(row) for row in rows(seeds=2)] + [by({**row, "law": "pd_d"}) for row in rows()]
    with pytest.raises(UsageError, match="no edge"):
        beside_edges(many, KEYS, 1)


def lasting(row: Row, ran_s: Callable[[Row], float]) -> Row:
    return {**row, "ran_s": ran_s(row)}


def test_long_cells_are_passed_over_for_the_next_ones() -> None:
    """Stable cells right at the edge ran long: those a step further are taken."""
    edge = {row["cell"] for row in beside_edges(list(rows()), KEYS, 4)}
    late = [
        lasting(row, lambda row: 160.0 if stable(row) and row["cell"] in edge else 20.0) for row in rows()
    ]
    found = [row for row in beside_edges(late, KEYS, 2) if stable(row)]
    assert len(found) == 2
    assert all(row["ran_s"] == 20.0 for row in found)
    with pytest.raises(UsageError, match="stable side of an edge ran longer than 60 s"):
        beside_edges([lasting(row, lambda _: 160.0) for row in rows()], KEYS, 10)


def test_none_is_no_number_of_cells() -> None:
    with pytest.raises(UsageError, match="from 1 on, not 0"):
        beside_edges(list(rows()), KEYS, 0)


def test_the_table_tells_both_verdicts_and_where_the_log_is(tmp_path: Path) -> None:
    found = [confirm(cell(CALM), runner(tmp_path, instead=one)) for one in (CALM, WILD)]
    grid = confirmed_table(found, KEYS)
    assert [row[grid.heads.index("virtual")] for row in grid.rows] == ["converged"] * 2
    assert [row[grid.heads.index("live")] for row in grid.rows] == ["converged", "diverged"]
    assert [row[-3] for row in grid.rows] == ["same", "DIFFERS"]
    assert all(row[-1] == str(tmp_path / "cell-3.mcap") for row in grid.rows)


@pytest.mark.live
@pytest.mark.parametrize("scenario", [CALM, WILD], ids=["calm", "wild"])
def test_a_session_over_zenoh_has_the_verdict_of_virtual_time(scenario: Scenario, tmp_path: Path) -> None:
    from rich.console import Console

    from sites.demo import run_demo
    from sites.display import Display

    def run(wanted: Scenario, _: str) -> Session:
        with Display(wanted, Console(quiet=True)) as display:
            outcome = run_demo(wanted, tmp_path, display)
        return Session(outcome.log, outcome.problems)

    found = confirm(cell(scenario), run)
    assert found.same, found.text
