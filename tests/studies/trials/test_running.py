"""Many trials on many processes: the same results in the same order."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import trilat_net
from trilat_net.studies.trials.trial import TrialResult
from trilat_net.studies.trials.trial_runner import run_trials

from .results import TOO_MUCH, quick


def facts(results: list[TrialResult]) -> list[tuple[int, list[tuple[str, str]], float]]:
    return [
        (r.trial.scenario.seed, [(o.key, o.measured) for o in r.outcomes], r.simulated_s) for r in results
    ]


def test_two_processes_give_the_results_of_one_in_the_same_order() -> None:
    batch = trilat_net.trials(quick(), [5, 2, 9, 4])
    told: list[TrialResult] = []
    report = run_trials(batch, 2, told.append)
    assert facts(report.results) == facts(run_trials(batch, 1).results)
    assert sorted(facts(told)) == sorted(facts(report.results))
    assert report.held
    assert report.wall_s > 0.0


def test_check_returns_the_results_or_tells_all_that_failed(quick_file: Path) -> None:
    assert trilat_net.check(quick_file, [1, 2], jobs=1).held
    with pytest.raises(AssertionError) as failed:
        trilat_net.check(quick_file, [1, 2], TOO_MUCH, jobs=1)
    text = str(failed.value)
    assert "FAIL" in text
    assert "0/2" in text
    for seed in (1, 2):
        assert f"trilat test {quick_file} --seeds {seed} " in text


SCRIPT = """
import sys
import trilat_net
assert "second" not in sys.argv, "ran twice"
sys.argv.append("second")
print(len(trilat_net.check(sys.argv[1], seeds=[1, 2, 3], jobs=2).results), "held")
"""


def test_it_works_in_a_script_without_a_guarded_main_part(quick_file: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    assert printed(script, quick_file, cwd=tmp_path) == "3 held\n"


def printed(script: Path, *arguments: str | Path, cwd: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        cwd=cwd,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")]),
        },
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
