"""Command lines that are refused: one line on stderr, the exit code, and no file left behind."""

from pathlib import Path

import pytest

from tests.chains import six_joints
from tests.log_editing import edited, recorded
from tests.refusals.command_cases import CommandCase
from tests.refusals.corpus import parametrize_cases
from tests.task_arms import planar_task


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files that cases copy, by the names that the corpus gives them."""
    folder = tmp_path_factory.mktemp("inputs")
    log = recorded("paper", {"duration_s": 0.5})
    contents = {
        "log": log,
        "log of 4 s": recorded("two_sites", {"duration_s": 4.0, "rate_hz": 100}),
        "log without records": edited(log, record=lambda _: None),
        "log of version 99": edited(log, record=lambda record: {**record, "v": 99}),
        "garbage": b"garbage" * 100,
        "zeros": bytes(10_000),
        "six": six_joints(1.0).encode(),
        "planar_task": planar_task().encode(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return {name: folder / name for name in contents}


@parametrize_cases("commands.toml", CommandCase)
def test_wrong_commands_are_refused(
    case: CommandCase, inputs: dict[str, Path], tmp_path: Path
) -> None:
    case.check_commands(tmp_path, inputs)
