"""Scenarios that are refused: each message names the key as its author wrote the key."""

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.cli.running import trilat
from tests.refusals.corpus import INPUTS, Case, parametrize_cases, read_cases
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, list_shipped, load_scenario, parse_scenario


class ScenarioCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scenario with a wrong key. The path of the case is that of the error, in full."""

    scenario: str = ""
    """A shipped scenario, or one of the folder `inputs`."""
    text: str = ""
    """The scenario as a TOML text, in place of a name."""
    set: dict[str, Any] = msgspec.field(default_factory=dict)
    """Changed values, by dotted path."""
    options: tuple[str, ...] = ()
    """Changes as `--set` takes them, as in "control.Kd=5"."""
    files: dict[str, str] = msgspec.field(default_factory=dict)
    """Texts of files beside the scenario, by name."""
    by_command: bool = False
    """Whether `trilat scenario check` is run as well."""

    def load(self, folder: Path) -> Scenario:
        """Returns the scenario, unless the scenario is refused."""
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        changes = self.set or self.options
        file = INPUTS / f"{self.scenario}.toml"
        if file.exists():
            return load_scenario(file, changes)
        if self.scenario:
            return load_scenario(self.scenario, changes)
        return parse_scenario(self.text, "", changes, folder)


@parametrize_cases("scenarios.toml", ScenarioCase)
def test_wrong_scenarios_are_refused(
    case: ScenarioCase, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ScenarioError) as caught:
        case.load(tmp_path)
    error = caught.value
    assert error.path == case.path, error
    case.check_message(f"{error.path}: {error.problem}", error.exit_code)
    if case.by_command:
        changes = [f"{key}={json.dumps(value)}" for key, value in case.set.items()]
        settings = [word for change in (*changes, *case.options) for word in ("--set", change)]
        done = trilat("scenario", "check", case.scenario, *settings, cwd=tmp_path)
        done.refuses(case.path, *case.words)
        assert done.out == "", done


NAMED_ALIKE = [
    case
    for case in read_cases("scenarios.toml", ScenarioCase)
    if case.scenario in list_shipped() and case.words[0].startswith(("expected", "unknown key"))
]
"""Cases of a wrong type, range or key of a shipped scenario."""


@pytest.mark.parametrize("case", NAMED_ALIKE, ids=[case.name for case in NAMED_ALIKE])
def test_resolved_scenarios_name_the_same_keys(case: ScenarioCase) -> None:
    """A wrong value or key has the same path whether it changes a file or a resolved scenario."""
    resolved = load_scenario(case.scenario)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(resolved, case.set or case.options)
    assert caught.value.path == case.path
