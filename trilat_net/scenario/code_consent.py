"""Which code from outside may run: that of one's own scenario, and for a log that whose file one names.

Invariant: what a log or a member of a session names may run if a person names its file, and that has the hash
that the log names, unless another version is asked for.
"""

import json
import os
import re
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ..errors import ScenarioError, UsageError
from ..files import make_folder, write_whole
from .imported_code import CodeConsent, ImportedLaw, allowed_code, check_class, read_code
from .operators.program_hand import ProgramHand
from .own_plant import OwnPlant

if TYPE_CHECKING:
    from .scenario_types import Scenario

LawFiles = str | Path | Sequence[str | Path]
"""The file of a law, or those of several."""


ImportedCode = ImportedLaw | ProgramHand | OwnPlant
"""What a scenario may have that is a class from outside."""


def list_imported_code(scenarios: "Iterable[Scenario]") -> list[ImportedCode]:
    """Returns the laws, hands and plants of users' own that some scenarios need."""
    sites = [site for scenario in scenarios for site in scenario.sites.values()]
    found = (one for site in sites for one in (site.control, *site.hands, site.plant))
    return [one for one in found if isinstance(one, ImportedCode)]


def allow_own_code(scenario: "Scenario", codes: Container[Any] | None = None) -> "Scenario":
    """Returns a scenario of which code may run: all, of one that a person names, or that which they name."""
    for one in list_imported_code([scenario]):
        if codes is None or one.code in codes:
            allowed_code[one.code, one.source_sha256] = CodeConsent(None, one.source_sha256)
    return scenario


def allow_logged_code(
    scenario: "Scenario", law: LawFiles = (), *, other_version: bool = False, remember: bool = False
) -> None:
    """Lets that code of a log run that is in files, or in remembered ones, see `open_log`.

    Raises:
        UsageError: a file is none that the log names, or another version of it; or there is none.
        ScenarioError: a file cannot be read, or defines no such law. Nothing has run.
    """
    files = [Path(law)] if isinstance(law, str | Path) else list(map(Path, law))
    if (other_version or remember) and not files:
        raise UsageError("--other-version and --remember are about a file: give --law FILE too")
    named = {(one.code, one.source_sha256): one.method for one in list_imported_code([scenario])}
    known: dict[str, str] = {}
    with suppress(OSError, ValueError, RuntimeError):  # the last: there is no home
        known = msgspec.json.decode(_find_store().read_bytes(), type=dict[str, str]) if named else {}
    for code, sha256 in named:
        if sha256 in known:
            allowed_code.setdefault((code, sha256), CodeConsent(Path(known[sha256]), sha256))
    for file in files:
        sha256 = _allow_file(file, named, other_version=other_version)
        if remember:
            make_folder(_find_store().parent)
            known[sha256] = str(file.resolve())
            write_whole(_find_store(), json.dumps(known, indent=1))


def _allow_file(file: Path, named: Mapping[tuple[str, str], str], *, other_version: bool) -> str:
    """Lets a file run as the code that has its hash, or else its name; returns its hash."""
    source = read_code("", "--law", file.resolve())
    now = source.sha256
    stem = (source.file.parent if file.stem == "__init__" else file).stem
    alike = [key for key in named if re.split(r"[.:]", key[0])[-2] == stem]
    meant = [key for key in named if key[1] == now] or alike
    if not meant:
        names = ", ".join(sorted({code for code, _ in named})) or "none from outside"
        raise UsageError(f"--law {file}: is no law that the log names: these are {names}")
    for code, sha256 in meant:
        if sha256 != now and not other_version:
            versions = f"its sha256 is {now[:16]}, and was {sha256[:16]}"
            problem = f"is not the file that ran as {code}: {versions}"
            raise UsageError(f"--law {file}: {problem}; --other-version takes it all the same")
        check_class(source, code, "--law", named[code, sha256])
        allowed_code[code, sha256] = CodeConsent(source.file, now)
    return now


def _find_store() -> Path:
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config", "trilat-net", "laws.json")


class LoggedUserLaw(NamedTuple):
    """A user law that a log names, and its sites.

    Attributes:
        allowed: whether its file may run.
        file: that file, else what Python finds by the name of its module; None: nothing.
        changed: how the file differs from the one that ran, or "".
    """

    code: str
    sites: tuple[str, ...]
    allowed: bool
    file: Path | None
    changed: str

    def __str__(self) -> str:
        of = f"{self.code} of {', '.join(self.sites)}"
        state = f"was changed, {self.changed}" if self.changed else "is the one that ran"
        if self.allowed:
            return f"{of}; its file {state}"
        hint = f"{self.file}{' --other-version' * bool(self.changed)} (it {state})" if self.file else "FILE"
        return f"{of} is code from outside, which may not run; if you trust it: --law {hint}"


def find_user_laws(scenario: "Scenario") -> list[LoggedUserLaw]:
    """Returns the user laws of a scenario without running any code of theirs."""
    sites: dict[tuple[str, str], tuple[str, ...]] = {}
    for name, spec in scenario.sites.items():
        if isinstance(law := spec.control, ImportedLaw):
            key = law.code, law.source_sha256
            sites[key] = (*sites.get(key, ()), name)
    found = []
    for (code, sha256), owners in sites.items():
        consent, now, file = allowed_code.get((code, sha256)), "", None
        with suppress(ScenarioError):
            source = read_code(code, "", consent and consent.file)
            check_class(source, code, "")
            now, file = source.sha256, source.file
        allowed = consent is not None and consent.sha256 == now
        changed = "" if now in ("", sha256) else f"its sha256 is {now[:16]}, and was {sha256[:16]}"
        found.append(LoggedUserLaw(code, owners, allowed, file, changed))
    return found
