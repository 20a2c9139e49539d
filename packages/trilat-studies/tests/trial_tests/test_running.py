"""Many trials: equal results in equal order; the shipped scenarios, and the recipe for pytest."""

import os
import subprocess
import sys
import textwrap
import xml.etree.ElementTree as Xml
from pathlib import Path

import pytest
import trilat_studies.trials
from study_builders import UNMET_LIMIT, make_quick_scenario
from trilat_studies.trials import TrialResult, run_trials

import trilat_net
from trilat_net.scenario import list_shipped, load_scenario


def facts(results: list[TrialResult]) -> list[tuple[int, list[tuple[str, str]], float]]:
    """Returns seeds, measured values and simulated times of results."""
    return [
        (r.trial.scenario.seed, [(o.key, o.measured) for o in r.outcomes], r.simulated_s)
        for r in results
    ]


@pytest.mark.long
def test_two_processes_give_equal_results_in_order() -> None:
    batch = trilat_net.trials(make_quick_scenario(), [5, 2, 9, 4])
    results: list[TrialResult] = []
    report = run_trials(batch, 2, results.append)
    assert facts(report.results) == facts(run_trials(batch, 1).results)
    assert sorted(facts(results)) == sorted(facts(report.results))
    assert report.held
    assert report.wall_s > 0.0


def test_check_returns_results_or_reports_all_failures(quick_file: Path) -> None:
    assert trilat_net.check(quick_file, [1, 2], jobs=1).held
    with pytest.raises(AssertionError) as failed:
        trilat_net.check(quick_file, [1, 2], UNMET_LIMIT, jobs=1)
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


@pytest.mark.long
def test_trials_work_in_an_unguarded_script(quick_file: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    assert run_script(script, quick_file, cwd=tmp_path) == "3 held\n"


def run_script(script: Path, *arguments: str | Path, cwd: Path) -> str:
    """Runs a script with this program, and returns what it prints."""
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


TICKS = {
    name: sum(map(load_scenario(name).ticks, load_scenario(name).names))
    for name in list_shipped()
}


@pytest.mark.parametrize(
    ("most", "left_out", "least"),
    [
        (45_000, {"seven_joints", "unlike_arms"}, 3),
        pytest.param(10**9, set(), 7, marks=pytest.mark.long),
    ],
)
def test_all_shipped_scenarios_meet_their_expectations(
    most: int, left_out: set[str], least: int
) -> None:
    assert all(load_scenario(name).expect.has_expectations for name in TICKS)
    names = [name for name, ticks in TICKS.items() if ticks <= most and name not in left_out]
    batch = [trial for name in names for trial in trilat_net.trials(name)]
    assert len(batch) >= least
    report = run_trials(batch)
    assert report.held, report.summary()


RECIPE = textwrap.dedent(
    str(trilat_studies.trials.__doc__).split("per seed:\n")[1].split("\nAll seeds")[0]
)


@pytest.mark.long
def test_pytest_recipe_gives_one_test_per_seed(quick_file: Path, tmp_path: Path) -> None:
    """The same lines are run on a scenario that holds, and on one that does not."""
    assert len(RECIPE.strip().splitlines()) <= 10
    for holds, limit_ms in ((True, 100.0), (False, 1.0)):
        source = tmp_path / f"scenario_{holds}.toml"
        text = quick_file.read_text().replace("max_ms = 100.0", f"max_ms = {limit_ms}")
        source.write_text(text)
        recipe = RECIPE.replace('"jitter"', repr(str(source)))
        (tmp_path / f"test_{holds}.py").write_text(recipe)

    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--junitxml=out.xml"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(trilat_net.__path__[0]).parent)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1, done.stdout + done.stderr

    cases = list(Xml.parse(tmp_path / "out.xml").iter("testcase"))
    failed = {
        (case.get("classname"), case.get("name"))
        for case in cases
        if case.find("failure") is not None
    }
    assert len(cases) == 10
    assert failed == {("test_False", f"test_jitter[quick-seed{seed}]") for seed in range(1, 6)}
    assert "mean_age_max_ms: " in done.stdout
    assert "trilat sim " in done.stdout
