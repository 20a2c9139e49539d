"""Results: every run, number for number, in a file that other programs read; shares with intervals."""

import csv
import json
import math
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from study_builders import (
    DELAYS,
    Judge,
    make_cell_result,
    plan_quick_sweep,
    replace_judge,
    run_plan,
)
from trilat_studies.sweep import prepare_sweep_folder, read_results, result_table
from trilat_studies.sweep.result_table import ResultTable
from trilat_studies.sweep.sweep_cell import RUN_CLASSES, CellRun, diff_lines
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep
from trilat_studies.sweep.sweep_results import GRID_POINTS_FILE, SweepResults

from trilat_net.errors import UsageError
from trilat_net.work.intervals import wilson_interval

ORDERS = "link.order=newest,in_order"


def encode_runs(plan: SweepPlan, runs: Iterable[CellRun]) -> str:
    """Returns the table of finished runs as text, as a sweep writes it."""
    table = ResultTable(plan)
    cells = table.iterate_cells({(run.cell, run.seed): run for run in runs})
    rows = (row for cell_runs in cells for row in table.build_rows(cell_runs))
    return "".join(table.encode(rows))


@pytest.fixture(scope="module")
def finished_sweep(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, SweepResults, Judge]:
    """A sweep of numbers and words, two laws, and two seeds where links are random: its folder,
    and its judge.
    """
    path = tmp_path_factory.mktemp("swept")
    sweep = plan_quick_sweep(
        path, over=["link.loss=0,0.1", ORDERS], laws=["adaptive", "p_d"], seeds=2
    )
    judge = Judge()
    with pytest.MonkeyPatch.context() as patch:
        replace_judge(patch, judge)
        results = run_plan(sweep, path / "o").results
    return path / "o", results, judge


def test_the_read_runs_are_the_written_ones(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    path, results, judge = finished_sweep
    again = read_results(path)
    assert list(again.rows) == list(results.rows)
    assert again.plan.facts() == results.plan.facts()
    assert read_results(path / "results.csv") == again
    for row in again.rows:
        assert again.outcome(row) == judge(row["scenario"], 4.0)
        assert f"seed = {row['seed']}" in row["scenario"]
        assert (
            f'order = "{row["link.order"]}"' in row["scenario"] or row["link.order"] == "newest"
        )


def test_a_large_table_stays_in_its_file(
    finished_sweep: tuple[Path, SweepResults, Judge], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that are read from the file on demand equal those in memory."""
    path, results, _ = finished_sweep
    monkeypatch.setattr(result_table, "ROWS_IN_MEMORY", 3)

    stored = read_results(path)
    assert isinstance(stored.rows, result_table.StoredRows)
    assert stored.rows == results.rows
    assert list(stored.rows) == list(results.rows)
    assert [stored.rows[n] for n in range(-1, len(stored.rows))] == [
        results.rows[n] for n in range(-1, len(results.rows))
    ]
    assert stored.rows[2:5] == results.rows[2:5]

    assert stored.of_cell(3) == results.of_cell(3)
    assert list(stored.blocks()) == list(results.blocks())
    assert stored.list_grid_points() == results.list_grid_points()
    with pytest.raises(IndexError):
        stored.rows[len(stored.rows)]


def test_rows_are_ordered_by_cells_and_seeds(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    """Rows follow the numbers of cells, with two seeds for cells that draw numbers."""
    _, results, _ = finished_sweep
    assert [(row["cell"], row["seed"]) for row in results.rows] == [
        (cell, seed) for cell in range(8) for seed in ((1, 2) if cell % 4 >= 2 else (1,))
    ]
    assert [row["law"] for row in results.rows] == ["adaptive"] * 6 + ["p_d"] * 6
    assert [row["seed"] for row in results.of_cell(3)] == [1, 2]
    assert "cell-0.mcap" in results.of_cell(0)[0]["command"]
    assert "cell-3-seed-2.mcap" in results.of_cell(3)[1]["command"]
    with pytest.raises(UsageError, match="from 0 to 7"):
        results.of_cell(8)


def test_the_order_of_finished_runs_changes_no_byte(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    path, results, _ = finished_sweep
    with prepare_sweep_folder(results.plan, path).journal() as journal:
        entries = list(journal.done.values())
    for order in (entries, entries[::-1]):
        table = encode_runs(results.plan, order)
        assert table.encode() == (path / "results.csv").read_bytes()


def test_csv_readers_find_every_number(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    path, results, _ = finished_sweep
    with (path / "results.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    for line, row in zip(lines, results.rows, strict=True):
        for name, value in row.items():
            if name == "scenario":
                continue
            if value is None or isinstance(value, bool):
                assert line[name] == {None: "", True: "true", False: "false"}[value]
            elif isinstance(value, float):
                assert float(line[name]) == value
            else:
                assert line[name] == str(value)


def test_pandas_reads_the_types_of_columns(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    pandas = pytest.importorskip("pandas")
    path, results, _ = finished_sweep
    frame = pandas.read_csv(path / "results.csv")
    kinds = [str(frame.dtypes[name]) for name in ("link.loss", "cell", "random")]
    assert kinds == ["float64", "int64", "bool"]
    peaks_rad = [row["peak_error_rad"] for row in results.rows]
    assert list(frame["peak_error_rad"]) == pytest.approx(peaks_rad, rel=1e-15)


def test_the_request_stands_beside_the_table(
    finished_sweep: tuple[Path, SweepResults, Judge],
) -> None:
    path, results, _ = finished_sweep
    facts = json.loads((path / "plan.json").read_text())
    assert facts["scenario_sha256"] == results.plan.base.sha256
    assert facts["text"] == results.plan.written.text
    assert set(facts["versions"]) == {"version_trilat-net", "version_numba", "version_numpy"}


@pytest.mark.usefixtures("judge")
def test_a_sweep_needs_no_optional_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pandas", "polars", "pyarrow"):
        monkeypatch.setitem(sys.modules, name, None)
    run_plan(plan_quick_sweep(tmp_path, over=[DELAYS], seeds=2), tmp_path / "o")
    assert len(read_results(tmp_path / "o").rows) == 3


@pytest.mark.usefixtures("judge")
def test_a_very_long_scenario_is_read_back(tmp_path: Path) -> None:
    plan = plan_quick_sweep(tmp_path, over=[DELAYS])
    rows = list(run_plan(plan, tmp_path / "o").results.rows)
    rows[1] = {**rows[1], "scenario": '# "letters", and\r\n' + "x" * 300_000}
    (tmp_path / "o" / "results.csv").write_text(
        "".join(ResultTable(plan).encode(rows)), newline=""
    )
    assert read_results(tmp_path / "o").rows == rows


@pytest.mark.long
def test_ten_thousand_scenarios_take_little_room(tmp_path: Path) -> None:
    """Differences to the base keep the table of a large sweep below 10 MB."""
    sweep = plan_sweep("p_d_margin", over=["link.delay_ms=0:1980:20", "control.d=0.2:10.1:0.1"])
    base = sweep.base.text
    entries = []
    for number in range(sweep.cells):
        delay, damping = sweep.cell(number).values
        text = base.replace("delay_ms = 200.0", f"delay_ms = {delay}")
        text = text.replace("1.1", f"{damping}")
        digest = f"{number:064x}"
        parts = diff_lines(text, base)
        entries.append(CellRun(number, 1, False, "p_d", digest, parts, make_cell_result(text)))

    table = encode_runs(sweep, entries)
    assert len(entries) == 10_000
    assert len(table) < 10e6

    (tmp_path / "results.csv").write_text(table)
    (tmp_path / "plan.json").write_text(json.dumps(sweep.facts()))
    assert read_results(tmp_path).rows[1234]["scenario"].count("delay_ms = 240.0") == 6


def test_a_diverged_run_gets_time_to_diverge_again(tmp_path: Path) -> None:
    sweep = plan_quick_sweep(tmp_path, over=[DELAYS])
    outcomes = [make_cell_result(str(n)) for n in range(100)]
    for outcome in outcomes:
        duration_s = sweep.reproduction_duration_s(outcome)
        if outcome.diverged_s is None:
            assert duration_s == outcome.ran_s
        else:
            assert duration_s == min(4.0, 0.5 * 2.0**outcome.extended) > outcome.diverged_s


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    def refused(path: Path, *phrases: str) -> None:
        with pytest.raises(UsageError) as error:
            read_results(path)
        for word in (str(path), *phrases):
            assert word in str(error.value)

    begun = prepare_sweep_folder(plan_quick_sweep(tmp_path), tmp_path / "o").path
    refused(begun, "no results", f"trilat sweep --resume {begun}")
    refused(tmp_path / "none.csv", "no results")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    refused(tmp_path / "other.csv", "contains no results of a sweep", "plan.json")


@pytest.mark.usefixtures("judge")
@pytest.mark.parametrize(
    ("damage", "word"),
    [
        (lambda text: text.replace("verdict", "verdicts", 1), "'verdict' is missing"),
        (lambda text: text[:-60], "cannot be read"),
        (lambda text: text.replace("0,", "zero,", 1), "cannot be read"),
        (lambda text: text.replace("false", "yes", 1), "'yes' is neither true nor false"),
        (lambda text: text[: text.rindex("[")], "cannot be read"),
        (lambda _: "PAR1 nothing PAR1\n\0", "contains no results"),
    ],
)
def test_a_damaged_table_is_refused(
    damage: Callable[[str], str], word: str, tmp_path: Path
) -> None:
    folder = run_plan(plan_quick_sweep(tmp_path, over=[DELAYS]), tmp_path / "o").folder.path
    table = folder / "results.csv"
    table.write_text(damage(table.read_text()))
    with pytest.raises(UsageError, match=word) as error:
        read_results(folder)
    assert str(table) in str(error.value)


@pytest.fixture
def random_sweep(tmp_path: Path, judge: Judge) -> SweepResults:
    """The results of a sweep in which twelve seeds of random cells are judged by chance."""
    sweep = plan_quick_sweep(tmp_path, over=["link.loss=0:0.5:0.1", DELAYS], seeds=12)
    results = run_plan(sweep, tmp_path / "o").results
    assert len(judge.texts) == 3 + 15 * 12
    return results


def test_every_run_is_counted_once(random_sweep: SweepResults) -> None:
    points = random_sweep.list_grid_points()
    assert [point.cell for point in points] == list(range(18))
    assert [sum(point.counts) for point in points] == [1] * 3 + [12] * 15
    for point in points:
        converged, bounded, diverged, undecided = point.counts
        assert (point.stable, point.decided) == (converged, converged + bounded + diverged)
        assert point.decided + undecided == sum(point.counts)
        assert point.doubtful == (0 < converged < point.decided)
        assert point.interval == wilson_interval(converged, converged + bounded + diverged)


def test_random_cells_have_rows_of_shares(random_sweep: SweepResults, tmp_path: Path) -> None:
    with (tmp_path / "o" / GRID_POINTS_FILE).open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    for line, point in zip(lines, random_sweep.list_grid_points(), strict=True):
        row = {
            name: float(text) if text and name != "law" else None for name, text in line.items()
        }
        assert tuple(row[verdict.value] for verdict in RUN_CLASSES) == point.counts
        assert (row["link.loss"], row["link.delay_ms"]) == point.values
        assert (row["stable_share_low"], row["stable_share_high"]) == point.interval
        if point.decided:
            assert row["stable_share_low"] <= row["stable_share"] <= row["stable_share_high"]
        else:
            assert row["stable_share"] is None


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_intervals_are_those_of_a_published_table(
    successes: int, runs: int, low: float, high: float
) -> None:
    """Newcombe, Statistics in Medicine 17 (1998), table I, the score method without continuity correction."""
    assert wilson_interval(successes, runs) == pytest.approx((low, high), abs=5.1e-5)


@pytest.mark.parametrize("runs", [10, 20, 100])
def test_intervals_hold_the_truth_in_95_percent(runs: int) -> None:
    """Coverage by the binomial sums, over even shares: 0.95 within 0.01; nowhere below 0.83."""
    shares = np.linspace(0.0005, 0.9995, 1000)
    held = np.zeros(len(shares))
    for seen in range(runs + 1):
        weight = math.comb(runs, seen) * shares**seen * (1.0 - shares) ** (runs - seen)
        low, high = wilson_interval(seen, runs)
        held += np.where((low <= shares) & (shares <= high), weight, 0.0)
    assert held.mean() == pytest.approx(0.95, abs=0.01)
    assert held.min() > 0.83


def test_without_runs_no_share_is_known() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
