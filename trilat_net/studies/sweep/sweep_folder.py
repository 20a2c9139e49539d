"""The folder of a sweep: its plan, the journal of finished runs, and at the end the results.

Invariant: a folder belongs to one sweep on one arithmetic; any other is refused and never mixed in.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ...core.fingerprint import compute_fingerprint
from ...errors import UsageError
from ...files import make_results_folder, write_whole
from ...log.log_layout import collect_provenance
from ..commands import format_command
from ..run_journal import RunJournal
from .sweep_cell import CellRun
from .sweep_plan import JUDGES, SweepPlan, plan_from_json
from .sweep_results import RESULTS_FILE

JOURNAL_FILE = "cells.journal"


def build_resume_hint(folder: Path) -> str:
    """Returns how to go on with a sweep that the disk interrupted."""
    command = format_command("sweep", "--resume", str(folder))
    return f"what is done is kept: make room, and go on with: {command}"


PLAN_FILE = "plan.json"
_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")
_DIFFERENCES = {
    "text": "another text of the scenario",
    "scenario_sha256": "another scenario",
    "overrides": "other settings",
    "over": "other axes",
    "laws": "other laws",
    "seeds": "other seeds",
    "longest_s": "another longest time",
    "judge": "another judge",
    "arithmetic": "another kind of arithmetic",
    "versions": "another version of the program",
}
"""What two sweeps may differ in, in words, in the order of messages."""


class SweepFolder(NamedTuple):
    """A folder of results; its facts name the sweep, its arithmetic, and the versions it is made with."""

    path: Path
    plan: SweepPlan
    facts: Mapping[str, Any]

    @property
    def results(self) -> Path:
        """Where the results are, once all runs are done."""
        return self.path / RESULTS_FILE

    def journal(self) -> RunJournal[CellRun]:
        """Opens the journal."""
        study = hashlib.sha256(_text(self.facts).encode()).hexdigest()
        return RunJournal(self.path / JOURNAL_FILE, study, CellRun, build_resume_hint(self.path))


def prepare_sweep_folder(plan: SweepPlan, path: Path | None) -> SweepFolder:
    """Returns the folder of a sweep, made, or as it was left.

    Raises:
        UsageError: it holds something else, or another sweep, or cannot be made.
    """
    facts = _describe(plan)
    if path is not None and (path / PLAN_FILE).exists():
        before = _read(path)
        _refuse_other(path, before, facts)
        return SweepFolder(path, plan_from_json(before), before)
    chosen = make_results_folder(path, f"sweep-{plan.base.name}", force=None)
    write_whole(chosen / PLAN_FILE, _text(facts), remedy=build_resume_hint(chosen))
    return SweepFolder(chosen, plan, facts)


def open_sweep_folder(path: Path) -> SweepFolder:
    """Returns the folder of a sweep that was begun.

    Raises:
        UsageError: there is none, or it was made with another arithmetic.
        ScenarioError: its scenario cannot run here.
    """
    facts = _read(path)
    plan = plan_from_json(facts)
    _refuse_other(path, facts, _describe(plan))
    return SweepFolder(path, plan, facts)


def _refuse_other(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    for key, words in _DIFFERENCES.items():
        if before.get(key) != now.get(key):
            there, here = (_shown(key, facts) for facts in (before, now))
            raise UsageError(
                f"{path}: holds a sweep of {words}: there {there}, here {here}; results are not mixed: "
                "choose another folder"
            )


def _shown(key: str, facts: Mapping[str, Any]) -> str:
    value = facts.get(key, JUDGES[0])
    if key in ("text", "scenario_sha256"):
        digest = hashlib.sha256(str(value).encode()).hexdigest() if key == "text" else str(value)
        return f"{facts.get('name')} (sha256 {digest[:12]})"
    if isinstance(value, dict):
        return ", ".join(f"{name.removeprefix('version_')} {one}" for name, one in value.items())
    if key == "seeds" and isinstance(value, list) and value == list(range(value[0], value[-1] + 1)):
        return f"{value[0]}..{value[-1]}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g} s" if isinstance(value, float) else str(value)


def _read(path: Path) -> dict[str, Any]:
    file = path / PLAN_FILE
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no sweep was begun there: it has no {PLAN_FILE}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file}: cannot be read: {reason}") from None
    needed = {"source", "folder", "name", *_DIFFERENCES} - {"judge"}  # older plans name none
    if not isinstance(facts, dict) or not needed <= facts.keys():
        raise UsageError(f"{file}: is no plan of a sweep")
    return facts


def _describe(plan: SweepPlan) -> dict[str, Any]:
    """Returns all that results depend on."""
    known = collect_provenance()
    versions = {name: known[name] for name in _VERSIONS}
    return {**plan.facts(), "arithmetic": compute_fingerprint(), "versions": versions}


def _text(facts: Mapping[str, Any]) -> str:
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"
