"""A cell as a log: the printed command repeats exactly the judged run."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from study_builders import SHORT, plan_quick_sweep, run_plan
from trilat_studies.sweep.sweep_cell import CellClass
from trilat_studies.sweep.sweep_results import SweepResults

from tests.cli.running import trilat
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.run_end import RunEnd
from trilat_net.log.log_reader import open_log

AT_REST_OR_LOST = ("limits.qd_limit_rad_s=6", "link.loss=0.1")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SweepResults:
    """Returns cells that settle, that are extended, and that diverge."""
    path = tmp_path_factory.mktemp("again")
    over = ["control.d=0.1,1,8", "link.delay_ms=0,400"]
    sweep = plan_quick_sweep(
        path, "control.law=p_d", "control.K=40", *AT_REST_OR_LOST, over=over
    )
    return run_plan(sweep, path / "o").results


def test_command_of_cell_gives_its_numbers_bitwise(
    results: SweepResults, tmp_path: Path
) -> None:
    """The log of a cell's command ends as its run did, with the same verdict and errors."""
    assert any(row["diverged_s"] is not None for row in results.rows)
    assert any(row["extended"] for row in results.rows)

    for row in results.rows:
        command, note = results.build_reproduce_command(row, tmp_path)
        arguments = shlex.split(command)
        done = trilat(*arguments[1:], cwd=tmp_path)
        outcome = results.outcome(row)
        assert done.code == (0 if outcome.diverged_s is None else 1), done

        log = open_log(tmp_path / arguments[-1])
        run_end = RunEnd.of_log(log)
        assert run_end.end_error_rad == outcome.end_error_rad
        assert run_end.end_speed_rad_s == outcome.end_speed_rad_s
        stability = certify_run(log).stability
        assert outcome.stability == stability
        assert CellClass.of_decision(stability, run_end.behaviour) is outcome.verdict

        peak = max(float(np.abs(log[name].e).max()) for name in log.sites)
        assert peak == outcome.peak_error_rad
        ended_s = max(float(log[name].t_s[-1]) for name in log.sites)
        ran_s = outcome.ran_s if outcome.diverged_s is not None else outcome.ran_s - 0.01
        assert ended_s == pytest.approx(ran_s)
        assert (note, row["command"]) == ("", command)


def test_a_changed_scenario_names_the_rows_own(results: SweepResults, tmp_path: Path) -> None:
    """If the source has changed or is gone, the command runs the text that the row contains."""
    source = Path(results.plan.written.label)
    row = results.rows[-1]
    source.write_text(SHORT.replace("0.3, -0.2", "0.3, -0.3"))
    try:
        command, note = results.build_reproduce_command(row, tmp_path)
    finally:
        source.write_text(SHORT)
    assert "has changed since the sweep" in note
    assert (tmp_path / "cell-5-seed-1.toml").read_text() == row["scenario"]

    arguments = shlex.split(command)
    trilat(*arguments[1:], cwd=tmp_path)
    assert (
        RunEnd.of_log(open_log(tmp_path / "cell-5-seed-1.mcap")).end_error_rad
        == row["end_error_rad"]
    )

    source.rename(source.with_suffix(".away"))
    assert "or is missing" in results.build_reproduce_command(row, tmp_path)[1]
    source.with_suffix(".away").rename(source)
