"""The trials of a scenario, messages of failed trials, and the command that repeats a trial.

A live trial is judged by its log: by the same expectations, and by those that need a log.
"""

import shlex
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import UNMET_LIMIT, make_quick_scenario
from trilat_studies.run_commands import list_assignments
from trilat_studies.trials import Trial, TrialResult

import trilat_net
from tests.log.builders import drop_records, edit_log_bytes, make_log_bytes
from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.override import ScenarioOverrides

CONSTANT = {"link": {"model": "constant", "delay_ms": 60.0}}


def test_a_random_scenario_has_a_trial_per_seed(quick_file: Path) -> None:
    batch = trilat_net.trials(quick_file, [3, 1, 3, 2])
    assert [trial.scenario.seed for trial in batch] == [3, 1, 2]
    assert len({trial.scenario.sha256 for trial in batch}) == 3
    assert [str(trial) for trial in batch] == ["quick-seed3", "quick-seed1", "quick-seed2"]
    assert len({trial.run().outcomes[-1].measured for trial in batch}) == 3


def test_without_chance_one_run_decides() -> None:
    constant = make_quick_scenario(**CONSTANT)
    assert [trial.scenario.seed for trial in trilat_net.trials(constant, range(4, 9))] == [4]
    assert len(trilat_net.trials(constant, range(4, 9), live=True)) == 5


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_out_of_range_is_refused(seed: int) -> None:
    with pytest.raises(ScenarioError, match="seed"):
        trilat_net.trials(make_quick_scenario(), [seed])


def test_a_scenario_without_expectations_is_refused(quick_file: Path) -> None:
    quick_file.write_text(quick_file.read_text().partition("[expect]")[0])
    for source in (quick_file, load_scenario(quick_file)):
        with pytest.raises(ScenarioError, match=r"quick.*\[expect\].*stable = true"):
            trilat_net.trials(source)


def test_an_expectation_of_an_unreached_time_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"synchronised_by_s.*0\.5 s"):
        trilat_net.trials(make_quick_scenario(), set={"expect.synchronised_by_s": 0.5})
    window = {"from_s": 0.4, "to_s": 0.6, "error_peak_rad": [0.0, 1.0]}
    with pytest.raises(ScenarioError, match=r"expect\.windows\[0\]\.to_s: .*0\.5 s, not 0\.6"):
        trilat_net.trials(make_quick_scenario(), set={"expect.windows": [window]})


def test_a_passed_trial_returns_what_held(quick_file: Path) -> None:
    result = trilat_net.trials(quick_file)[0].check()
    assert result.held
    assert result.simulated_s == 0.5
    assert [outcome.key for outcome in result.outcomes] == [
        "peak_error_max_rad",
        "mean_age_max_ms",
    ]


def test_a_failed_trial_names_its_excess(quick_file: Path) -> None:
    (trial,) = trilat_net.trials(quick_file, [7], UNMET_LIMIT)
    with pytest.raises(AssertionError) as failed:
        trial.check()
    lines = [line.strip() for line in str(failed.value).splitlines()]
    assert lines[0].startswith("quick-seed7: mean_age_max_ms: ")  # the line of pytest's summary
    assert lines[0].endswith(" ms, expected ≤ 1 ms")
    assert lines[1:] == [
        f"trilat test {quick_file} --seeds 7 --set expect.mean_age_max_ms=1",
        f"trilat sim {quick_file} --seed 7 -o quick-seed7.mcap --set expect.mean_age_max_ms=1",
    ]


texts = st.sampled_from(["it's", "a b", '"x"', "", "=", "é", "true", "a\nb\t"])
values = st.one_of(st.integers(-5, 5), st.floats(-1e3, 1e3), st.booleans(), texts)
tables = st.dictionaries(
    st.sampled_from(["a", "b.c", "d.e-f"]),
    st.one_of(values, st.lists(values, max_size=3)),
    max_size=3,
)


@given(overrides=tables)
def test_the_command_line_has_the_same_overrides(overrides: dict[str, Any]) -> None:
    by_text: dict[str, Any] = {}
    by_value: dict[str, Any] = {}
    texts = shlex.split(shlex.join(list_assignments(overrides)))
    ScenarioOverrides.parse(texts).apply_to(by_text)
    ScenarioOverrides.parse(overrides).apply_to(by_value)
    assert by_text == by_value


def test_a_table_override_is_shown_by_key() -> None:
    (trial,) = trilat_net.trials(make_quick_scenario(), set=CONSTANT)
    assert shlex.split(trial.again)[-4:] == [
        "--set",
        'link.model="constant"',
        "--set",
        "link.delay_ms=60",
    ]


def test_an_unsaved_scenario_is_named_by_file() -> None:
    assert (
        trilat_net.trials(make_quick_scenario())[0].again
        == "trilat test ./quick.toml --seeds 1"
    )


LIMITS = {"expect": {"peak_error_max_rad": 2.0, "no_gaps": True}}


@pytest.fixture
def trial() -> Trial:
    """A live trial of a short version of `free`."""
    scenario = load_scenario("free", {"duration_s": 0.12, "link.delay_ms": 20.0, **LIMITS})
    (live_trial,) = trilat_net.trials(scenario, live=True)
    return live_trial


def list_failed_keys(result: TrialResult) -> list[str]:
    """Returns the keys of the expectations that do not hold."""
    return [outcome.key for outcome in result.outcomes if not outcome.held]


def write_log(folder: Path, data: bytes) -> Path:
    """Writes the bytes of a log into a folder, and returns the file."""
    path = folder / "run.mcap"
    path.write_bytes(data)
    return path


def test_an_orderly_session_is_judged_by_its_records(trial: Trial, tmp_path: Path) -> None:
    log = write_log(tmp_path, make_log_bytes("free"))
    result = trial.evaluate_live_log(log, [], 1.0)
    assert result.held
    assert [o.key for o in result.outcomes] == [
        "peak_error_max_rad",
        "no_gaps",
        "session",
        "executed again",
    ]
    assert result.log == log
    assert result.simulated_s == pytest.approx(0.12)


def test_a_session_problem_fails_the_trial(trial: Trial, tmp_path: Path) -> None:
    result = trial.evaluate_live_log(
        write_log(tmp_path, make_log_bytes("free")), ["s was killed by SIGKILL"], 1.0
    )
    assert list_failed_keys(result) == ["session"]
    assert "SIGKILL" in result.failures[0]


def test_missing_records_fail_the_trial(trial: Trial, tmp_path: Path) -> None:
    log = write_log(
        tmp_path, edit_log_bytes(make_log_bytes("free"), record=drop_records("s", {50}))
    )
    result = trial.evaluate_live_log(log, [], 1.0)
    assert list_failed_keys(result) == ["no_gaps", "executed again"]


def test_a_record_that_contradicts_its_inputs_fails(trial: Trial, tmp_path: Path) -> None:
    def change_torque(record: dict[str, Any]) -> dict[str, Any]:
        if record["site"] == "s" and record["tick"] == 50:
            return {**record, "tau": [0.0, 1.0]}
        return record

    log = write_log(tmp_path, edit_log_bytes(make_log_bytes("free"), record=change_torque))
    assert list_failed_keys(trial.evaluate_live_log(log, [], 1.0)) == ["executed again"]


@pytest.mark.parametrize("content", [None, b"no log", "empty"])
def test_without_records_there_is_only_a_reason(
    content: bytes | str | None, trial: Trial, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    if content == "empty":
        write_log(tmp_path, edit_log_bytes(make_log_bytes("free"), record=lambda _: None))
    elif isinstance(content, bytes):
        write_log(tmp_path, content)
    result = trial.evaluate_live_log(log, ["m1 ended with code 2"], 1.0)
    assert not result.held
    assert "m1 ended with code 2" in result.error
    assert "run.mcap" in result.error
    assert (result.log is None) == (content is None)
