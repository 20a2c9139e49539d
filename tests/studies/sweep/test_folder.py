"""The folder of a sweep: it goes on with its own, and mixes in nothing of another one."""

import json
from pathlib import Path
from typing import Any

import pytest

from trilat_net.core.fingerprint import compute_fingerprint
from trilat_net.errors import UsageError
from trilat_net.log.log_layout import collect_provenance
from trilat_net.studies.sweep import sweep_folder as folders
from trilat_net.studies.sweep.sweep_folder import PLAN_FILE, open_sweep_folder, prepare_sweep_folder

from .quick import DAMPING, SHORT, asked


def refused(path: Path, *overrides: str, **settings: Any) -> str:
    with pytest.raises(UsageError) as error:
        prepare_sweep_folder(asked(path.parent, *overrides, **settings), path)
    assert error.value.exit_code == 2
    return str(error.value)


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    """The folder of a sweep that was begun."""
    return prepare_sweep_folder(asked(tmp_path), tmp_path / "o").path


def test_the_same_sweep_goes_on_in_its_folder(begun: Path) -> None:
    plan = (begun / PLAN_FILE).read_bytes()
    again = prepare_sweep_folder(asked(begun.parent), begun)
    assert open_sweep_folder(begun).facts == again.facts == json.loads(plan)
    assert (begun / PLAN_FILE).read_bytes() == plan
    assert [path.name for path in begun.iterdir()] == [PLAN_FILE]


@pytest.mark.parametrize(
    ("overrides", "settings", "words"),
    [
        (["control.Kp=2"], {}, ("another scenario", "trio (sha256 ")),
        (["control.Kd=3"], {}, ("other settings", "there none, here control.Kd=3")),
        ([], {"over": [DAMPING]}, ("other axes", "there link.delay_ms=0:40:20, control.Kd=1:4:1, here")),
        ([], {"seeds": 3}, ("other seeds", "there 1..1, here 1..3")),
        ([], {"seeds": [5, 1]}, ("other seeds", "here 5, 1")),
        ([], {"laws": ["adaptive"]}, ("other laws", "there none, here adaptive")),
        ([], {"longest_s": 2.0}, ("another longest time", "there 4 s, here 2 s")),
    ],
)
def test_another_sweep_is_refused_with_what_differs(
    begun: Path, overrides: list[str], settings: dict[str, Any], words: tuple[str, ...]
) -> None:
    problem = refused(begun, *overrides, **settings)
    for word in (str(begun), "results are not mixed", "choose another folder", *words):
        assert word in problem


def test_a_scenario_that_was_edited_since_is_refused(begun: Path) -> None:
    (begun.parent / "trio.toml").write_text(SHORT.replace("delay_ms = 50.0", "delay_ms = 50.0 # ms"))
    assert "another text of the scenario" in refused(begun)


def test_another_arithmetic_or_program_is_refused(begun: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(folders, "compute_fingerprint", lambda: "0" * 16)
        words = f"another kind of arithmetic: there {compute_fingerprint()}, here 0000"
        assert words in refused(begun)
    older = {**collect_provenance(), "version_numba": "0.1"}
    monkeypatch.setattr(folders, "collect_provenance", lambda: older)
    with pytest.raises(UsageError, match=r"another version of the program: .*numba 0\.1"):
        open_sweep_folder(begun)


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "o"
    other.mkdir()
    (other / "precious").write_text("precious")
    assert "holds something; choose another folder" in refused(other)
    assert [path.name for path in other.iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no sweep was begun there"), ("{", "is not JSON"), ("[]", "is no plan"), ("{}", "is no plan")],
)
def test_a_folder_without_a_plan_is_refused(tmp_path: Path, content: str | None, words: str) -> None:
    if content is not None:
        (tmp_path / PLAN_FILE).write_text(content)
    with pytest.raises(UsageError, match=words):
        open_sweep_folder(tmp_path)
