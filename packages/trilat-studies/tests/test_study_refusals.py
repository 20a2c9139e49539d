"""Requests for studies that are refused, by commands and by Python functions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from sweep_tests.quick import SHORT
from trial_tests.results import QUICK
from trilat_studies.bench.bench_plan import plan_bench
from trilat_studies.study_commands import parse_seeds
from trilat_studies.sweep.margin_search import parse_search_range
from trilat_studies.sweep.sweep_plan import parse_axis, plan_sweep
from trilat_studies.tuning import plan_tuning
from tuning_tests.experiments import TRIO
from tuning_tests.odd_arms import SHOULDER, write_arm

import trilat_net as tn
from tests.cli.running import trilat
from tests.log_editing import recorded
from tests.refusals.command_cases import CommandCase
from tests.refusals.corpus import Case, parametrize_cases
from trilat_net.errors import ScenarioError, UsageError

FUNCTIONS: dict[str, Callable[..., object]] = {
    "make_env": tn.make_env,
    "parse_axis": parse_axis,
    "parse_search_range": parse_search_range,
    "parse_seeds": parse_seeds,
    "plan_bench": plan_bench,
    "plan_sweep": plan_sweep,
    "plan_tuning": plan_tuning,
    "trials": tn.trials,
}


class CallCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A call of one of `FUNCTIONS` in a folder that contains the scenario trio.toml."""

    function: str
    arguments: tuple[Any, ...] = ()
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    """Arguments by name."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files that cases copy, by the names that the corpus gives them."""
    folder = tmp_path_factory.mktemp("inputs")
    quick = {"rate_hz": 100, "duration_s": 0.5}
    contents = {
        "log": recorded("free", quick),
        "another log": recorded("free", {**quick, "link.delay_ms": 50.0}),
        "trio": TRIO.encode(),
        "short trio": SHORT.encode(),
        "scenario with expectations": QUICK.encode(),
        "scenario without expectations": QUICK.partition("[expect]")[0].encode(),
        "arm of one joint": write_arm([SHOULDER]).encode(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (folder / "trio.toml").write_bytes(contents["short trio"])
    over = ("--over", "link.delay_ms=0:40:20", "--over", "control.Kd=1:4:1")
    sweep = ("sweep", "trio.toml", *over, "-o", "finished sweep", "--jobs", "1")
    trilat(*sweep, cwd=folder).succeeds()
    return {name: folder / name for name in (*contents, "finished sweep")}


@parametrize_cases("studies.toml", CommandCase)
def test_impossible_studies_are_refused(
    case: CommandCase, inputs: dict[str, Path], tmp_path: Path
) -> None:
    case.check_commands(tmp_path, inputs)


@parametrize_cases("study_calls.toml", CallCase)
def test_impossible_calls_are_refused(
    case: CallCase, inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(inputs["trio"].parent)
    with pytest.raises((ScenarioError, UsageError)) as caught:
        FUNCTIONS[case.function](*case.arguments, **case.settings)
    case.check_message(str(caught.value), caught.value.exit_code)
