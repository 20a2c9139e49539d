"""Commands, options, keys of JSON and exit codes stay; what is new may join them.

`surface.json` was written before the house was put in order. Since then `certify` ends with 1 for an open
judgement, as of the 0.4 s of v1.mcap.
"""

import json
import subprocess
from pathlib import Path

import pytest

from tests.golden.surface import list_keys

from .digests import COMMAND
from .surface import all_options

HERE = Path(__file__).parent
BEFORE = json.loads((HERE / "surface.json").read_text())
LONG = (
    "report live-4g.mcap",
    "report v2.mcap",
    "linear free",
    "linear training",
    "certify v2.mcap",
    "linear p_d_margin",
    "metrics v2.mcap",
    "compare live-4g.mcap",
    "rerun live-4g.mcap",
    "verify live-4g.mcap",
    "log info",
)
"""Cases beside which another one says nearly the same."""


def _params(cases: list[dict]) -> list:
    """The cases as parameters of a test, named by what was asked."""
    return [
        pytest.param(case, id=" ".join(case["asked"]) or "nothing", marks=_marks(case["asked"]))
        for case in cases
    ]


def _marks(arguments: list[str]) -> tuple:
    return (pytest.mark.long,) if " ".join(arguments[:2]) in LONG else ()


def test_every_command_and_option_is_still_there() -> None:
    now = all_options()
    assert not BEFORE["options"].keys() - now.keys()
    assert not {
        c: gone for c, names in BEFORE["options"].items() if (gone := set(names) - set(now[c]))
    }


@pytest.mark.parametrize("case", _params(BEFORE["json"]))
def test_every_json_key_and_exit_code_is_still_there(case: dict, tmp_path: Path) -> None:
    arguments = [str(HERE / word) if word.endswith(".mcap") else word for word in case["asked"]]
    process = subprocess.run(
        [*COMMAND, *arguments], cwd=tmp_path, capture_output=True, text=True
    )
    text = process.stdout if case["file"] is None else (tmp_path / case["file"]).read_text()
    assert not set(case["keys"]) - set(list_keys(json.loads(text)))
    assert process.returncode == case["exit"], process.stderr


@pytest.mark.long
@pytest.mark.parametrize("case", _params(BEFORE["exit"]))
def test_every_exit_code_stays(case: dict, tmp_path: Path) -> None:
    arguments = [str(HERE / word) if word.endswith(".mcap") else word for word in case["asked"]]
    assert (
        subprocess.run([*COMMAND, *arguments], cwd=tmp_path, capture_output=True).returncode
        == case["exit"]
    )
