"""Requests for studies that are refused, by commands and by Python functions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from trilat_studies.bench.bench_plan import plan_bench
from trilat_studies.study_commands import parse_seeds
from trilat_studies.sweep.margin_search import SearchRange
from trilat_studies.sweep.sweep_axis import SweepAxis
from trilat_studies.sweep.sweep_plan import plan_sweep
from trilat_studies.tuning import plan_tuning

import trilat_net as tn
from tests.cli.running import trilat
from tests.log.builders import make_log_bytes
from tests.refusals.command_cases import CommandCase
from tests.refusals.corpus import INPUTS, Case, parametrize_cases
from trilat_net.errors import ScenarioError, UsageError

FUNCTIONS: dict[str, Callable[..., object]] = {
    "make_env": tn.make_env,
    "parse_axis": SweepAxis.parse,
    "SearchRange.parse": SearchRange.parse,
    "parse_seeds": parse_seeds,
    "plan_bench": plan_bench,
    "plan_sweep": plan_sweep,
    "plan_tuning": plan_tuning,
    "trials": tn.trials,
}


class CallCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A call of one of `FUNCTIONS` in the folder `inputs`, which contains trio.toml."""

    function: str
    arguments: tuple[Any, ...] = ()
    settings: dict[str, Any] = msgspec.field(default_factory=dict)
    """Arguments by name."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files that cases copy, by the names that the corpus gives them."""
    folder = tmp_path_factory.mktemp("inputs")
    short = {"rate_hz": 100, "duration_s": 0.5}
    expectations = (INPUTS / "expectations.toml").read_text(encoding="utf-8")
    contents = {
        "log": make_log_bytes("free", short),
        "another log": make_log_bytes("free", {**short, "link.delay_ms": 50.0}),
        "trio.toml": (INPUTS / "trio.toml").read_bytes(),
        "scenario without expectations": expectations.partition("[expect]")[0].encode(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    over = ("--over", "link.delay_ms=0:40:20", "--over", "control.Kd=1:4:1")
    sweep = ("sweep", "trio.toml", *over, "-o", "finished sweep", "--jobs", "1")
    trilat(*sweep, cwd=folder).succeeds()
    files = {path.stem: path for path in INPUTS.iterdir()}
    return {name: folder / name for name in (*contents, "finished sweep")} | files


@parametrize_cases("studies.toml", CommandCase)
def test_impossible_studies_are_refused(
    case: CommandCase, inputs: dict[str, Path], tmp_path: Path
) -> None:
    case.check_commands(tmp_path, inputs)


@parametrize_cases("study_calls.toml", CallCase)
def test_impossible_calls_are_refused(case: CallCase, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(INPUTS)
    with pytest.raises((ScenarioError, UsageError)) as caught:
        FUNCTIONS[case.function](*case.arguments, **case.settings)
    case.check_message(str(caught.value), caught.value.exit_code)
