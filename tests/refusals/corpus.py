"""The corpus of refusals: wrong input, and what the message that refuses the input must contain.

Each TOML file of this folder holds the cases of one part of the program, and one test runs them
all. To add a case, add one entry to the file; no code changes:

    [[case]]
    name = "a negative delay"
    scenario = "paper"
    set = { "link.delay_ms" = -1.0 }
    path = "link.delay_ms"
    words = [">= 0"]

The name says what is wrong, and becomes the name of the test. Every case has the fields of
`Case`. The fields that describe the input are those of the class that the part's test gives to
`read_cases`, for example `ScenarioCase` for `scenarios.toml`.

Invariant:
    - A file with an unknown, missing or mistyped field is not read. The error names the file and
      the case.
    - No two cases of a file have the same name or the same input.
"""

import tomllib
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import pytest

FOLDER = Path(__file__).parent
INPUTS = FOLDER / "inputs"
"""Scenarios and robots that cases name, beside the shipped ones."""


class Case(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A refusal: the fields that cases of every part have."""

    name: str
    """What is wrong, in a few words."""
    path: str
    """Key, option, file or other place that the message names. Empty if there is no such place."""
    words: tuple[str, ...]
    """Further texts that the message contains."""
    absent: tuple[str, ...] = ()
    """Texts that the message must not contain, such as a secret."""
    exit_code: int = 2
    """Code with which a command ends after this refusal."""

    def check_message(self, message: str, exit_code: int = 2) -> None:
        """Asserts that a message is one line with the place and all words of the case."""
        assert exit_code == self.exit_code, message
        assert len(message.splitlines()) == 1, message
        missing = [text for text in (self.path, *self.words) if text not in message]
        assert missing == [], message
        assert [text for text in self.absent if text in message] == [], message


CaseKind = TypeVar("CaseKind", bound=Case)


def read_cases(file: str, kind: type[CaseKind], folder: Path = FOLDER) -> list[CaseKind]:
    """Returns the cases of a file.

    Args:
        file: Name of the file, as in "scenarios.toml".
        kind: Class of the cases, which has the fields of the input.
        folder: Folder of the file.
    """
    tables = tomllib.loads((folder / file).read_text(encoding="utf-8"))
    assert list(tables) == ["case"], f"{file}: the file must consist of tables [[case]]"
    cases: list[CaseKind] = []
    for number, table in enumerate(tables["case"], start=1):
        location = f"{file}, case {number} ({table.get('name', 'without a name')})"
        try:
            case = msgspec.convert(table, kind)
        except msgspec.ValidationError as error:
            raise AssertionError(f"{location}: {error}") from None
        assert case.name, f"{location}: the name is empty"
        assert any([case.path, *case.words]), f"{location}: path and words are empty"
        for earlier in cases:
            assert earlier.name != case.name, f"{location}: an earlier case has this name"
            is_repeated = _list_inputs(earlier) == _list_inputs(case)
            assert not is_repeated, f"{location}: has the input of the case {earlier.name}"
        cases.append(case)
    return cases


def parametrize_cases(file: str, kind: type[Case]) -> pytest.MarkDecorator:
    """Returns the mark with which a test runs once for each case of a file."""
    cases = read_cases(file, kind)
    return pytest.mark.parametrize("case", cases, ids=[case.name for case in cases])


def names_file(message: str, path: Path) -> bool:
    """Returns True if a message begins with a path, as "PATH: ..." or as subject of a sentence."""
    rest = message.removeprefix(str(path))
    return rest != message and rest.startswith((": ", " is not ", " cannot be read: "))


def _list_inputs(case: Case) -> dict[str, Any]:
    """Returns the fields of a case that describe its input."""
    return {
        field: getattr(case, field)
        for field in case.__struct_fields__
        if field not in Case.__struct_fields__
    }
