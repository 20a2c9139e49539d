"""Many trials on many processes: the same results in the same order, and no process left behind."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import trilat_net
from tests.net.waiting import until
from trilat_net.studies.trials import trial_runner
from trilat_net.studies.trials.trial import TrialResult
from trilat_net.studies.trials.trial_runner import run_trials

from .results import TOO_MUCH, quick

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def workers() -> list[int]:
    """Ids of this process's children that run trials."""
    threads = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    pids = [pid for thread in threads for pid in thread.read_text().split()]
    lines = {int(pid): Path(f"/proc/{pid}/cmdline").read_bytes() for pid in pids}
    return [pid for pid, line in lines.items() if b"trilat_net.studies.trials.trial_worker" in line]


def facts(results: list[TrialResult]) -> list[tuple[int, list[tuple[str, str]], float]]:
    return [
        (r.trial.scenario.seed, [(o.key, o.measured) for o in r.outcomes], r.simulated_s) for r in results
    ]


def test_two_processes_give_the_results_of_one_in_the_same_order() -> None:
    batch = trilat_net.trials(quick(), [5, 2, 9, 4])
    told: list[TrialResult] = []
    report = run_trials(batch, 2, told.append)
    assert sys.platform != "linux" or workers() == []
    assert facts(report.results) == facts(run_trials(batch, 1).results)
    assert sorted(facts(told)) == sorted(facts(report.results))
    assert report.held
    assert report.wall_s > 0.0


@on_linux
def test_a_worker_that_dies_costs_its_trial_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process is killed once it has its first trial; the next trial gets another one."""
    killed: list[int] = []
    started = trial_runner._Worker._started

    def fatal(hand: trial_runner._Worker) -> object:
        process = started(hand)
        if process is not None and not killed:
            killed.append(process.pid)
            os.kill(process.pid, signal.SIGKILL)
        return process

    monkeypatch.setattr(trial_runner._Worker, "_started", fatal)
    report = run_trials(trilat_net.trials(quick(), range(1, 5)), 2)
    lost = [result for result in report.results if result.error]
    assert len(lost) == len(killed) == 1
    assert "code -9" in lost[0].error
    assert all(result.held for result in report.results if result is not lost[0])


def test_what_goes_wrong_beside_a_trial_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    """No process can be started: nobody waits for results that will not come."""
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(FileNotFoundError):
        run_trials(trilat_net.trials(quick(), range(1, 5)), 2)


@on_linux
def test_an_interrupt_leaves_no_process_behind() -> None:
    seen: list[int] = []

    def interrupted(_: TrialResult) -> None:
        seen.extend(workers())
        raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        run_trials(trilat_net.trials(quick(), range(1, 9)), 2, interrupted)
    assert seen
    assert workers() == []


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


@on_linux
def test_a_worker_ends_when_its_parent_is_gone(quick_file: Path, tmp_path: Path) -> None:
    text = (
        "import os, sys, trilat_net\n"
        "from trilat_net.studies.trials.trial_runner import run_trials\n"
        "from tests.studies.trials.test_running import workers\n"
        "def gone(_):\n"
        "    print(*workers(), flush=True)\n"
        "    os._exit(0)\n"
        "run_trials(trilat_net.trials(sys.argv[1], range(1, 99)), 2, gone)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(text)
    pids = [int(pid) for pid in printed(script, quick_file, cwd=Path.cwd()).split()]
    assert pids
    until(lambda: not any(running_worker(pid) for pid in pids), 30)


def running_worker(pid: int) -> bool:
    try:
        return b"trilat_net.studies.trials.trial_worker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


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
