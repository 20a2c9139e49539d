"""Which code from outside may run: that of one's own scenario, and for a log that whose file
one names.

Invariant:
- What a log or a member of a session names may run if a person names its file, and that file
  has the hash that the log names, unless another version is asked for.
- A permission, remembered or not, covers one class of that file with the settings of that log.
  A log with other settings needs a permission of its own, and the refusal says which settings
  differ.
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
from .imported_code import (
    CodeConsent,
    CodeKey,
    ImportedLaw,
    allowed_code,
    check_class,
    describe_new_settings,
    describe_setting,
    find_consent,
    read_code,
    remembered_settings,
)
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


def allow_own_code(
    scenario: "Scenario",
    codes: Container[Any] | None = None,
    changed_from: "Scenario | None" = None,
) -> "Scenario":
    """Returns a scenario after its code was allowed to run.

    Args:
        scenario: the scenario.
        codes: the places of the classes that a person names; None: a person wrote the whole
            scenario.
        changed_from: the scenario that a person changed into this one. Code that may run there
            may also run here, with the settings that the person has given it.
    """
    sources = (
        [] if changed_from is None else map(CodeKey.of, list_imported_code([changed_from]))
    )
    consents = {
        key[:2]: consent for key in sources if (consent := find_consent(key)) is not None
    }
    for key in map(CodeKey.of, list_imported_code([scenario])):
        if codes is None or key.code in codes:
            allowed_code[key] = CodeConsent(None, key.sha256)
        elif key[:2] in consents:
            allowed_code[key] = consents[key[:2]]
    return scenario


class RememberedFile(msgspec.Struct):
    """A file that a person has remembered.

    Attributes:
        file: where the file is.
        classes: by the name of a class, the settings with which it may run.
    """

    file: str
    classes: dict[str, list[dict[str, Any]]] = {}


def allow_logged_code(
    scenario: "Scenario",
    law: LawFiles = (),
    *,
    other_version: bool = False,
    remember: bool = False,
) -> None:
    """Lets that code of a log run that is in files, or in remembered ones, see `open_log`.

    Raises:
        UsageError: a file is none that the log names, or another version of it; or there is
            none.
        ScenarioError: a file cannot be read, or defines no such law. Nothing has run.
    """
    files = [Path(law)] if isinstance(law, str | Path) else list(map(Path, law))
    if (other_version or remember) and not files:
        raise UsageError("--other-version and --remember are about a file: give --law FILE too")
    named = {CodeKey.of(imported): imported for imported in list_imported_code([scenario])}
    known = _read_store() if named else {}
    remembered_settings.clear()
    for sha256, entry in known.items():
        for name, settings in entry.classes.items():
            texts = [json.dumps(one, sort_keys=True, default=str) for one in settings]
            remembered_settings[sha256, name] = texts
    for key in named:
        texts = remembered_settings.get((key.sha256, _class_of(key)), [])
        if key.sha256 in known and key.settings in texts:
            allowed_code.setdefault(key, CodeConsent(Path(known[key.sha256].file), key.sha256))
    for file in files:
        sha256, meant = _allow_file(file, named, other_version=other_version)
        if remember:
            entry = known.setdefault(sha256, RememberedFile(""))
            entry.file = str(file.resolve())
            for key in meant:
                settings = entry.classes.setdefault(_class_of(key), [])
                if named[key].settings not in settings:
                    settings.append(named[key].settings)
            make_folder(_find_store().parent)
            store = _find_store().resolve()  # people link their own settings
            write_whole(store, msgspec.json.format(msgspec.json.encode(known), indent=1))


def _class_of(key: CodeKey) -> str:
    return key.code.partition(":")[2]


def _read_store() -> dict[str, RememberedFile]:
    """Returns the remembered files by their hash.

    An entry without settings, which earlier versions wrote, allows nothing.
    """
    with suppress(OSError, ValueError, RuntimeError):  # the last: there is no home
        entries = msgspec.json.decode(
            _find_store().read_bytes(), type=dict[str, RememberedFile | str]
        )
        return {
            sha256: RememberedFile(entry) if isinstance(entry, str) else entry
            for sha256, entry in entries.items()
        }
    return {}


def _allow_file(
    file: Path, named: Mapping[CodeKey, ImportedCode], *, other_version: bool
) -> tuple[str, list[CodeKey]]:
    """Lets a file run as the code that has its hash, or else its name; returns its hash, and
    that code.
    """
    source = read_code("", "--law", file.resolve())
    now = source.sha256
    stem = (source.file.parent if file.stem == "__init__" else file).stem
    alike = [key for key in named if re.split(r"[.:]", key.code)[-2] == stem]
    meant = [key for key in named if key.sha256 == now] or alike
    if not meant:
        names = ", ".join(sorted({key.code for key in named})) or "none from outside"
        raise UsageError(f"--law {file}: is no law that the log names: these are {names}")
    for key in meant:
        if key.sha256 != now and not other_version:
            versions = f"its sha256 is {now[:16]}, and was {key.sha256[:16]}"
            problem = f"is not the file that ran as {key.code}: {versions}"
            raise UsageError(f"--law {file}: {problem}; --other-version takes it all the same")
        check_class(source, key.code, "--law", named[key].method)
        allowed_code[key] = CodeConsent(source.file, now)
    return now, meant


def _find_store() -> Path:
    return Path(
        os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config", "trilat-net", "laws.json"
    )


class LoggedUserLaw(NamedTuple):
    """A user law that a log names, and its sites.

    Attributes:
        code: the place of its class.
        sites: the sites that it controls.
        settings: the arguments of its class, as text.
        allowed: whether its file may run with these settings.
        file: that file, else what Python finds by the name of its module; None: nothing.
        changed: how the file differs from the one that ran, or "".
        other_settings: how its settings differ from those that are allowed, or "".
    """

    code: str
    sites: tuple[str, ...]
    settings: str
    allowed: bool
    file: Path | None
    changed: str
    other_settings: str = ""

    def __str__(self) -> str:
        named = f"{self.code} of {', '.join(self.sites)}"
        settings = f" with {self.settings}" if self.settings else ""
        state = f"was changed, {self.changed}" if self.changed else "is the one that ran"
        if self.allowed:
            return f"{named}{settings}; its file {state}"
        hint = (
            f"{self.file}{' --other-version' * bool(self.changed)} (it {state})"
            if self.file
            else "FILE"
        )
        problem = f"{named} is code from outside, which may not run{settings}"
        problem = f"{problem} ({self.other_settings})" if self.other_settings else problem
        return f"{problem}; if you trust it: --law {hint}"


def find_user_laws(scenario: "Scenario") -> list[LoggedUserLaw]:
    """Returns the user laws of a scenario without running any code of theirs."""
    sites: dict[CodeKey, tuple[str, ...]] = {}
    settings: dict[CodeKey, str] = {}
    for name, spec in scenario.sites.items():
        if isinstance(law := spec.control, ImportedLaw):
            key = CodeKey.of(law)
            sites[key] = (*sites.get(key, ()), name)
            settings[key] = ", ".join(
                f"{argument} = {describe_setting(value)}"
                for argument, value in law.settings.items()
            )
    laws = []
    for key, owners in sites.items():
        consent = find_consent(key)
        now = ""
        file = None
        with suppress(ScenarioError):
            source = read_code(key.code, "", consent and consent.file)
            check_class(source, key.code, "")
            now = source.sha256
            file = source.file
        allowed = consent is not None and consent.sha256 == now
        changed = (
            ""
            if now in ("", key.sha256)
            else f"its sha256 is {now[:16]}, and was {key.sha256[:16]}"
        )
        other = "" if allowed else describe_new_settings(key)
        laws.append(
            LoggedUserLaw(
                code=key.code,
                sites=owners,
                settings=settings[key],
                allowed=allowed,
                file=file,
                changed=changed,
                other_settings=other,
            )
        )
    return laws
