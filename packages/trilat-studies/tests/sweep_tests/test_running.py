"""Runs of a sweep: results do not depend on how they were made, and every run is made and counted once."""

import re
import resource
from collections import Counter
from pathlib import Path

import pytest
from study_builders import DELAYS, Judge, StopError, plan_quick_sweep, run_plan, stop_after
from trilat_studies.sweep import prepare_sweep_folder, read_results, run_sweep
from trilat_studies.sweep.sweep_cell import RUN_CLASSES
from trilat_studies.sweep.sweep_plan import plan_sweep
from trilat_studies.sweep.sweep_results import RESULTS_FILE
from trilat_studies.sweep.sweep_run import DurationEstimate, open_sweep_folder

from trilat_net.errors import LogRefused, UsageError


@pytest.mark.long
def test_the_number_of_processes_changes_no_byte(tmp_path: Path) -> None:
    """The judge of the package, in this process and in two others."""
    sweep = plan_quick_sweep(tmp_path, "link.loss=0.2", seeds=2, over=[DELAYS])
    single = run_plan(sweep, tmp_path / "single")
    shared = run_sweep(prepare_sweep_folder(sweep, tmp_path / "shared"), jobs=2)
    table = (single.folder.path / RESULTS_FILE).read_bytes()
    assert (shared.folder.path / RESULTS_FILE).read_bytes() == table
    assert [row["cell"] for row in shared.results.rows] == [0, 0, 1, 1, 2, 2]
    assert (single.runs, shared.jobs) == (6, 2)


def test_interrupted_work_is_not_done_again(tmp_path: Path, judge: Judge) -> None:
    """A sweep that is interrupted four times runs each cell once and writes the same table."""
    sweep = plan_quick_sweep(tmp_path, "link.loss=0.2", seeds=2)
    run_plan(sweep, tmp_path / "whole")
    whole = (tmp_path / "whole" / RESULTS_FILE).read_bytes()

    texts = judge.texts.copy()
    assert len(texts) == 24
    judge.texts.clear()

    folder = prepare_sweep_folder(sweep, tmp_path / "parts")
    for count in (1, 2, 7, 20):
        with pytest.raises(StopError):
            run_sweep(folder, 1, stop_after(count))
        assert not (folder.path / RESULTS_FILE).exists()
        folder = open_sweep_folder(folder.path)

    swept = run_sweep(folder, 1)
    assert (folder.path / RESULTS_FILE).read_bytes() == whole
    assert Counter(judge.texts) == Counter(texts)
    assert run_sweep(folder, 1).runs == 0
    assert Counter(judge.texts) == Counter(texts)
    assert 0 < swept.runs < 24


def test_without_randomness_one_seed_is_run(tmp_path: Path, judge: Judge) -> None:
    """Cells without drawn numbers run one seed, and the progress counts further seeds later."""
    progress: list[tuple[int, int]] = []

    def report_progress(done: int, total: int) -> None:
        progress.append((done, total))

    sweep = plan_quick_sweep(tmp_path, over=["link.loss=0,0.1,1"], seeds=5)
    folder = prepare_sweep_folder(sweep, tmp_path / "o")
    rows = run_sweep(folder, 1, report_progress).results.rows
    seeds_of = [(row["cell"], row["seed"]) for row in rows]
    assert seeds_of == [(0, 1), *((1, seed) for seed in range(1, 6)), (2, 1)]
    assert [row["random"] for row in rows] == [False, *[True] * 5, False]
    assert progress == [(1, 3), (2, 3), (3, 3), (4, 7), (5, 7), (6, 7), (7, 7)]
    assert len(judge.texts) == 7


def test_runs_of_an_estimate_are_not_repeated(tmp_path: Path, judge: Judge) -> None:
    """The runs that measured the time of a sweep are among its results."""
    sweep = plan_quick_sweep(tmp_path)
    expected = DurationEstimate.of_sweep(sweep, jobs=1)
    assert [entry.cell for entry in expected.entries] == [0, 1, 3, 5, 7, 9, 11]
    assert expected.runs == 12
    assert expected.seconds > 0.0

    judge.texts.clear()
    run_sweep(prepare_sweep_folder(sweep, tmp_path / "o"), 1, known=expected.entries)
    assert len(judge.texts) == 5


@pytest.mark.usefixtures("judge")
def test_an_estimate_leaves_finished_runs_out(tmp_path: Path) -> None:
    """An estimate measures the first cells that have not run, and nothing after the last cell."""
    sweep = plan_quick_sweep(tmp_path)
    assert DurationEstimate.of_sweep(sweep, [(0, 1), (1, 1)], 1).entries[0].cell == 3
    assert DurationEstimate.of_sweep(sweep, [(n, 1) for n in range(12)], 1) == DurationEstimate(
        0, 0.0, []
    )


@pytest.mark.usefixtures("judge")
def test_an_estimate_counts_seeds_of_random_links(tmp_path: Path) -> None:
    constant = plan_quick_sweep(tmp_path, seeds=10)
    lossy = plan_quick_sweep(tmp_path, "link.loss=0.1", seeds=10)
    assert DurationEstimate.of_sweep(constant, jobs=1).runs == 12
    assert DurationEstimate.of_sweep(lossy, jobs=1).runs == 120


def test_enormous_sweeps_are_refused_with_count_and_time(judge: Judge) -> None:
    over = ["link.delay_ms=0:9999:1", "control.d=0.1:20:0.1"]
    sweep = plan_sweep("p_d_margin", over=over)
    estimate = DurationEstimate.of_sweep(sweep, jobs=2)._replace(seconds=90_000.0)
    with pytest.raises(UsageError) as error:
        estimate.refuse_oversized_sweep(sweep, jobs=2)
    assert error.value.exit_code == 2
    for word in (
        "2000000 cells (10000 x 200)",
        "25 h on 2 cores",
        "larger steps",
        "with yes",
    ):
        assert word in str(error.value)

    many = DurationEstimate(1_000_001, 60.0, [])
    with pytest.raises(UsageError, match="would take about 60 s"):
        many.refuse_oversized_sweep(sweep)
    DurationEstimate(1_000_000, 86_400.0, []).refuse_oversized_sweep(sweep)
    assert len(judge.texts) == 8


def test_only_cells_that_cannot_run_are_refused(tmp_path: Path, judge: Judge) -> None:
    """The ends of both axes are valid alone and together; one pair between them is not."""
    sweep = plan_quick_sweep(
        tmp_path, over=["link.loss=0.1,0.7,0.2", "link.loss_burst=5,1.5,6"]
    )
    folder = prepare_sweep_folder(sweep, tmp_path / "o")
    results = run_sweep(folder, 1).results
    (refused,) = (row for row in results.rows if row["verdict"] == "refused")
    assert len(results.rows) == 9
    assert refused["cell"] == 4
    name = r"cell 4 \(link.loss=0.7, link.loss_burst=1.5\): .*too short"
    assert re.match(name, refused["reasons"])
    assert read_results(folder.path).rows == results.rows
    assert len(judge.texts) == 8
    first, second, *_ = results.summarize()
    assert first.endswith(", 1 refused")
    assert re.match(f"  {name}", second)


def test_a_full_disk_names_the_finished_runs(tmp_path: Path, judge: Judge) -> None:
    """A limit on the size of files stands for the disk; with room, the sweep goes on."""
    folder = prepare_sweep_folder(plan_quick_sweep(tmp_path), tmp_path / "o")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, limits[1]))
    try:
        with pytest.raises(LogRefused) as error:
            run_sweep(folder, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    finished = len(folder.read_done())
    assert 0 < finished < 12
    assert f"{finished} of 12 runs had finished" in str(error.value)
    assert "make room, and continue with: trilat sweep --resume" in str(error.value)
    assert not (folder.path / RESULTS_FILE).exists()

    judge.texts.clear()
    results = run_sweep(folder, 1).results
    assert (len(results.rows), len(judge.texts)) == (12, 12 - finished)


def test_a_full_disk_at_the_table_says_so(tmp_path: Path, judge: Judge) -> None:
    folder = run_plan(plan_quick_sweep(tmp_path), tmp_path / "o").folder
    (folder.path / RESULTS_FILE).unlink()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, limits[1]))
    try:
        with pytest.raises(LogRefused, match="all runs had finished"):
            run_sweep(folder, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(path.name for path in folder.path.iterdir()) == ["cells.journal", "plan.json"]
    assert len(judge.texts) == 12


def test_the_opening_names_axes_laws_and_seeds(tmp_path: Path) -> None:
    sweep = plan_quick_sweep(
        tmp_path,
        over=["control.Kd=0.2:3:0.1", DELAYS],
        laws=["pd_d", "adaptive"],
        seeds=10,
        longest_s=1.0,
    )
    assert sweep.describe() == [
        "trio: 174 cells (29 x 3 x laws pd_d, adaptive), 10 seeds each where anything is random",
        "  over control.Kd=0.2:3:0.1: 0.2, 0.3, ..., 3.0",
        "  over link.delay_ms=0:40:20: 0, 20, 40",
        "  0.5 s each, undecided runs up to 1 s",
    ]


@pytest.mark.usefixtures("judge")
def test_a_summary_counts_every_run_once(tmp_path: Path) -> None:
    """The first line counts the runs of each verdict, and further lines say what stands out."""
    sweep = plan_quick_sweep(tmp_path, over=["link.loss=0:0.9:0.05"], seeds=8)
    results = run_plan(sweep, tmp_path / "o").results

    first, *others = results.summarize()
    assert first.startswith(f"{1 + 18 * 8} runs of 19 cells: ")
    counts = [int(part.split()[0]) for part in first.partition(": ")[2].split(", ")]
    assert counts == [
        sum(row["verdict"] == verdict for row in results.rows) for verdict in RUN_CLASSES
    ]
    assert sum(counts) == len(results.rows)

    text = "\n".join(others)
    assert "undecided after 0.5 s and continued, the longest to 4 s" in text
    assert "nothing is random in 1 cell: only one seed was run there" in text
    assert "stable with some seeds and not with others" in text
    assert "95 % interval" in text
    assert "all in places.csv" in text
