"""Command lines that are refused: one line on stderr, the exit code, and no file left behind."""

from pathlib import Path

import pytest

from tests.log.builders import edit_log_bytes, make_log_bytes
from tests.refusals.command_cases import CommandCase
from tests.refusals.corpus import INPUTS, parametrize_cases


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files that cases copy, by the names that the corpus gives them."""
    folder = tmp_path_factory.mktemp("inputs")
    log = make_log_bytes("paper", {"duration_s": 0.5})
    contents = {
        "log": log,
        "log of 4 s": make_log_bytes("two_sites", {"duration_s": 4.0, "rate_hz": 100}),
        "log without records": edit_log_bytes(log, record=lambda _: None),
        "log of version 99": edit_log_bytes(log, record=lambda record: {**record, "v": 99}),
        "garbage": b"garbage" * 100,
        "zeros": bytes(10_000),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    scenarios = {path.stem: path for path in INPUTS.glob("*.toml")}
    return {name: folder / name for name in contents} | scenarios


@parametrize_cases("commands.toml", CommandCase)
def test_wrong_commands_are_refused(
    case: CommandCase, inputs: dict[str, Path], tmp_path: Path
) -> None:
    case.check_commands(tmp_path, inputs)
