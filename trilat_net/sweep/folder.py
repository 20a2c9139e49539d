"""The folder of a sweep: its plan, the journal of its runs, and at the end its results.

Law: a folder is of one sweep, on one kind of arithmetic: what another one would add is refused and never
mixed in.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ..core.fingerprint import fingerprint
from ..errors import UsageError
from ..log.provenance import provenance
from ..results import results_folder
from .journal import JOURNAL, Journal
from .plan import Plan, plan_of
from .table import RESULTS, write_whole

PLAN = "plan.json"
_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")
_CALLED = {
    "text": "another text of the scenario",
    "scenario_sha256": "another scenario",
    "overrides": "other settings",
    "over": "other axes",
    "laws": "other laws",
    "seeds": "other seeds",
    "longest_s": "another longest time",
    "arithmetic": "another kind of arithmetic",
    "versions": "another version of the program",
}
"""What two sweeps may differ in, in words, in the order in which it is said."""


class Folder(NamedTuple):
    """A folder of results.

    Attributes:
        path: where it is.
        plan: the sweep.
        facts: what names it, with the arithmetic and the versions that it is made with.
    """

    path: Path
    plan: Plan
    facts: Mapping[str, Any]

    @property
    def results(self) -> Path:
        """Where the results are, once all runs are done."""
        return self.path / RESULTS

    def journal(self) -> Journal:
        """Opens the journal."""
        return Journal(self.path / JOURNAL, hashlib.sha256(_text(self.facts).encode()).hexdigest())


def new_folder(asked: Plan, path: Path | None) -> Folder:
    """Returns the folder of a sweep, made, or as it was left.

    Args:
        asked: the sweep.
        path: where; None for the next free one below runs.

    Raises:
        UsageError: it holds something else, or another sweep, or cannot be made.
    """
    facts = {**asked.facts(), **_made_with()}
    if path is not None and (path / PLAN).exists():
        return _the_same(path, facts)
    chosen = results_folder(path, f"sweep-{asked.base.name}", force=False)
    write_whole(chosen / PLAN, _text(facts).encode())
    return Folder(chosen, asked, facts)


def old_folder(path: Path) -> Folder:
    """Returns the folder of a sweep that was begun.

    Raises:
        UsageError: there is none, or it was made with another arithmetic.
        ScenarioError: its scenario cannot run here.
    """
    facts = _read(path)
    asked = plan_of(facts)
    now = {**asked.facts(), **_made_with()}
    _refuse_other(path, facts, now)
    return Folder(path, asked, facts)


def _the_same(path: Path, facts: Mapping[str, Any]) -> Folder:
    """Returns a folder that holds this very sweep."""
    before = _read(path)
    _refuse_other(path, before, facts)
    return Folder(path, plan_of(before), before)


def _refuse_other(path: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    for key, words in _CALLED.items():
        if before.get(key) != now[key]:
            there, here = (_shown(key, facts) for facts in (before, now))
            raise UsageError(
                f"{path}: holds a sweep of {words}: there {there}, here {here}; results are not mixed: "
                "choose another folder"
            )


def _shown(key: str, facts: Mapping[str, Any]) -> str:
    value = facts.get(key)
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
    file = path / PLAN
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no sweep was begun there: it has no {PLAN}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file}: cannot be read: {reason}") from None
    if not isinstance(facts, dict) or not {"source", "folder", "name", *_CALLED} <= facts.keys():
        raise UsageError(f"{file}: is no plan of a sweep")
    return facts


def _made_with() -> dict[str, Any]:
    """Returns what results depend on besides the plan."""
    known = provenance()
    return {"arithmetic": fingerprint(), "versions": {name: known[name] for name in _VERSIONS}}


def _text(facts: Mapping[str, Any]) -> str:
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"
