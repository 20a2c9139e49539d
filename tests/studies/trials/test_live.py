"""A live trial, judged by its log: by the same expectations, and by what only a log shows."""

from pathlib import Path

import pytest

import trilat_net
from tests.log_editing import edited, recorded, without
from trilat_net.scenario import load_scenario
from trilat_net.studies.trials import Trial, evaluate_live_log

LIMITS = {"expect": {"peak_error_max_rad": 2.0, "no_gaps": True}}


@pytest.fixture
def trial() -> Trial:
    (made,) = trilat_net.trials(
        load_scenario("free", {"duration_s": 0.12, "link.delay_ms": 20.0, **LIMITS}), live=True
    )
    return made


def written(folder: Path, data: bytes) -> Path:
    path = folder / "run.mcap"
    path.write_bytes(data)
    return path


def test_session_that_ended_in_order_is_judged_by_its_records(trial: Trial, tmp_path: Path) -> None:
    log = written(tmp_path, recorded("free"))
    result = evaluate_live_log(trial, log, [], 1.0)
    assert result.held
    assert [o.key for o in result.outcomes] == ["peak_error_max_rad", "no_gaps", "session", "executed again"]
    assert result.log == log
    assert result.simulated_s == pytest.approx(0.12)


def test_a_problem_of_the_session_fails_it(trial: Trial, tmp_path: Path) -> None:
    result = evaluate_live_log(trial, written(tmp_path, recorded("free")), ["s was killed by SIGKILL"], 1.0)
    assert [o.key for o in result.outcomes if not o.held] == ["session"]
    assert "SIGKILL" in result.failures[0]


def test_missing_records_fail_it(trial: Trial, tmp_path: Path) -> None:
    log = written(tmp_path, edited(recorded("free"), record=without("s", {50})))
    assert [o.key for o in evaluate_live_log(trial, log, [], 1.0).outcomes if not o.held] == [
        "no_gaps",
        "executed again",
    ]


def test_record_that_is_not_what_its_inputs_give_fails_it(trial: Trial, tmp_path: Path) -> None:
    def bent(record: dict) -> dict:  # type: ignore[type-arg]
        return {**record, "tau": [0.0, 1.0]} if (record["site"], record["tick"]) == ("s", 50) else record

    log = written(tmp_path, edited(recorded("free"), record=bent))
    assert [o.key for o in evaluate_live_log(trial, log, [], 1.0).outcomes if not o.held] == [
        "executed again"
    ]


@pytest.mark.parametrize("content", [None, b"no log", "empty"])
def test_without_records_there_is_no_result_and_reason_is_told(
    content: bytes | str | None, trial: Trial, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    if content == "empty":
        written(tmp_path, edited(recorded("free"), record=lambda _: None))
    elif isinstance(content, bytes):
        written(tmp_path, content)
    result = evaluate_live_log(trial, log, ["m1 ended with code 2"], 1.0)
    assert not result.held
    assert "m1 ended with code 2" in result.error
    assert "run.mcap" in result.error
    assert (result.log is None) == (content is None)
