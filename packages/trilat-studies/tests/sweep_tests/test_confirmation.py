"""Confirmation of cells beside edges by live runs: the choice of cells, and which verdicts are equal."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from trilat_studies.sweep import sweep_cell
from trilat_studies.sweep.live_confirmation import (
    SessionRunner,
    choose_cells_near_edges,
    confirm_cell,
    tabulate_confirmations,
)
from trilat_studies.sweep.sweep_cell import CellClass

from trilat_net.errors import UsageError
from trilat_net.execution import virtual
from trilat_net.scenario import Scenario, load_scenario

from .maps import KEYS, Row, judge_by_condition, rows

BRIEF = {"link.delay_ms": 0.0, "rate_hz": 200, "duration_s": 12.0}
CALM = load_scenario("p_d_margin", {**BRIEF, "control.d": 4.0})
WILD = load_scenario(
    "p_d_margin",
    {**BRIEF, "control.d": 0.2, "link.delay_ms": 500.0, "limits.qd_limit_rad_s": 12.0},
)


def cell(scenario: Scenario) -> Row:
    """Returns a cell's row as its own run makes it."""
    outcome = sweep_cell.classify_cell(scenario.text, scenario.duration_s)
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


def runner(folder: Path, *problems: str, instead: Scenario | None = None) -> SessionRunner:
    """Stands for the network: sessions are runs in virtual time."""

    def run(scenario: Scenario, name: str) -> tuple[Path, Sequence[str]]:
        log = folder / f"{name}.mcap"
        with log.open("wb") as stream:
            virtual.write_virtual_log(instead or scenario, stream)
        return log, problems

    return run


@pytest.mark.parametrize("scenario", [CALM, WILD], ids=["calm", "wild"])
def test_equal_runs_have_equal_verdicts(scenario: Scenario, tmp_path: Path) -> None:
    row = cell(scenario)
    confirmation = confirm_cell(row, runner(tmp_path))
    assert confirmation.same
    assert confirmation.live is confirmation.virtual is CellClass(row["verdict"])
    assert confirmation.log == tmp_path / "cell-3.mcap"


def test_different_runs_have_different_verdicts(tmp_path: Path) -> None:
    confirmation = confirm_cell(cell(CALM), runner(tmp_path, instead=WILD))
    assert not confirmation.same
    assert (confirmation.virtual, confirmation.live) == (
        CellClass.CONVERGED,
        CellClass.DIVERGED,
    )


def test_a_session_lasts_as_long_as_its_cell(tmp_path: Path) -> None:
    """This also holds for an extended cell; a diverged cell has half a second more in order to diverge."""
    durations_s: list[float] = []

    def run(scenario: Scenario, _: str) -> tuple[Path, Sequence[str]]:
        durations_s.append(scenario.duration_s)
        return tmp_path / "none.mcap", ["failed"]

    for changes in ({"ran_s": 8.0}, {"ran_s": 2.5, "diverged_s": 2.5}):
        confirm_cell({**cell(CALM), **changes}, run)
    assert durations_s == [8.0, 3.0]


def test_a_failed_run_confirms_nothing(tmp_path: Path) -> None:
    row = cell(CALM)
    confirmation = confirm_cell(row, runner(tmp_path, "s was killed by SIGKILL"))
    assert (confirmation.same, confirmation.live, confirmation.text) == (
        False,
        None,
        "s was killed by SIGKILL",
    )

    def torn(_: Scenario, name: str) -> tuple[Path, Sequence[str]]:
        (tmp_path / name).write_bytes(b"no log")
        return tmp_path / name, []

    confirmation = confirm_cell(row, torn)
    assert (confirmation.same, confirmation.live) == (False, None)
    assert "cell-3" in confirmation.text
    missing = confirm_cell(row, lambda *_, **__: (tmp_path / "missing.mcap", []))
    assert (missing.same, missing.log) == (False, None)


def stable(row: Row) -> bool | None:
    return CellClass(row["verdict"]).stable


def test_equally_many_cells_lie_on_either_side() -> None:
    all_rows = list(rows())
    cells = choose_cells_near_edges(all_rows, KEYS, 3)
    assert [stable(row) for row in cells] == [True] * 3 + [False] * 3
    assert len({row["cell"] for row in cells}) == 6
    for row in cells:
        delay, d = row[KEYS[0]], row[KEYS[1]]
        near = [
            one
            for one in all_rows
            if (abs(one[KEYS[0]] - delay), round(abs(one[KEYS[1]] - d), 9))
            in ((100, 0.0), (0, 0.5))
        ]
        assert any(stable(neighbour) is not stable(row) for neighbour in near)


def test_cells_are_spread_over_the_edge() -> None:
    cells = choose_cells_near_edges(list(rows()), KEYS, 2)
    delays = [row[KEYS[0]] for row in cells if stable(row)]
    assert max(delays) - min(delays) >= 300


def test_undecided_cells_move_the_edge_beyond_them() -> None:
    def band(delay_ms: float, d: float, *_: Any) -> CellClass:
        return (
            CellClass.UNDECIDED
            if abs(d - 5e-3 * delay_ms) < 0.3
            else judge_by_condition(delay_ms, d)
        )

    cells = choose_cells_near_edges(list(rows(band)), KEYS, 3)
    assert [stable(row) for row in cells] == [True] * 3 + [False] * 3
    with pytest.raises(UsageError, match="no edge"):
        choose_cells_near_edges(list(rows(lambda *_, **__: CellClass.UNDECIDED)), KEYS, 1)


def test_another_seed_or_law_is_no_neighbour() -> None:
    def by(row: Row) -> Row:
        side = (
            CellClass.CONVERGED
            if (row["seed"], row["law"]) == (1, "p_d")
            else CellClass.DIVERGED
        )
        return {**row, "verdict": side.value}

    many = [by(row) for row in rows(seeds=2)] + [by({**row, "law": "pd_d"}) for row in rows()]
    with pytest.raises(UsageError, match="no edge"):
        choose_cells_near_edges(many, KEYS, 1)


def lasting(row: Row, ran_s: Callable[[Row], float]) -> Row:
    return {**row, "ran_s": ran_s(row)}


def test_long_cells_give_way_to_the_next() -> None:
    """Stable cells right at the edge ran long: cells a step further from the edge are taken."""
    edge = {row["cell"] for row in choose_cells_near_edges(list(rows()), KEYS, 4)}
    late = [
        lasting(row, lambda row: 160.0 if stable(row) and row["cell"] in edge else 20.0)
        for row in rows()
    ]
    rows_taken = [row for row in choose_cells_near_edges(late, KEYS, 2) if stable(row)]
    assert len(rows_taken) == 2
    assert all(row["ran_s"] == 20.0 for row in rows_taken)
    with pytest.raises(UsageError, match="stable side of an edge ran longer than 60 s"):
        choose_cells_near_edges([lasting(row, lambda _: 160.0) for row in rows()], KEYS, 10)


def test_zero_is_no_number_of_cells() -> None:
    with pytest.raises(UsageError, match="at least 1, not 0"):
        choose_cells_near_edges(list(rows()), KEYS, 0)


def test_table_has_both_verdicts_and_the_log(tmp_path: Path) -> None:
    confirmations = [
        confirm_cell(cell(CALM), runner(tmp_path, instead=run)) for run in (CALM, WILD)
    ]
    grid = tabulate_confirmations(confirmations, KEYS)
    assert [row[grid.headers.index("virtual")] for row in grid.rows] == ["converged"] * 2
    assert [row[grid.headers.index("live")] for row in grid.rows] == ["converged", "diverged"]
    assert [row[-3] for row in grid.rows] == ["same", "DIFFERS"]
    assert all(row[-1] == str(tmp_path / "cell-3.mcap") for row in grid.rows)


@pytest.mark.live
@pytest.mark.long
@pytest.mark.parametrize("scenario", [CALM, WILD], ids=["calm", "wild"])
def test_zenoh_sessions_have_the_verdict_of_virtual_time(
    scenario: Scenario, tmp_path: Path
) -> None:
    from rich.console import Console

    from trilat_net.app.demo_session import run_demo

    def run(wanted: Scenario, _: str) -> tuple[Path, Sequence[str]]:
        outcome = run_demo(wanted, tmp_path, Console(quiet=True))
        return outcome.log, outcome.problems

    confirmation = confirm_cell(cell(scenario), run)
    assert confirmation.same, confirmation.text
