"""Permissions for code from outside: which laws, hands and plants of users may run.

The code of a user's own scenario may run. The code that a log or a member of a session names
may run only if a person names its file.

Invariant:
    - The named file must have the hash that the log names, unless another version is asked for.
    - A permission, remembered or not, covers one class of that file with the settings of that
      log. A log with other settings needs a permission of its own, and the refusal says which
      settings differ.
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
"""The file of a law, or the files of several laws."""


ImportedCode = ImportedLaw | ProgramHand | OwnPlant
"""The parts of a scenario that may be classes from outside."""


def list_imported_code(scenarios: "Iterable[Scenario]") -> list[ImportedCode]:
    """Returns the users' own laws, hands and plants in some scenarios."""
    imported = []
    for scenario in scenarios:
        for site in scenario.sites.values():
            candidates = (site.control, *site.hands, site.plant)
            imported += [part for part in candidates if isinstance(part, ImportedCode)]
    return imported


def allow_own_code(
    scenario: "Scenario",
    codes: Container[Any] | None = None,
    changed_from: "Scenario | None" = None,
) -> "Scenario":
    """Allows the code of a scenario to run, and returns the scenario.

    Args:
        scenario: the scenario.
        codes: the classes that a person named, as in "package.module:Law"; None: a person wrote
            the whole scenario, and all its code may run.
        changed_from: the scenario that a person changed into this one. Code that may run there
            may also run here, with the settings that the person gave it.
    """
    earlier_consents: dict[tuple[str, str], CodeConsent] = {}
    if changed_from is not None:
        for key in map(CodeKey.of, list_imported_code([changed_from])):
            consent = find_consent(key)
            if consent is not None:
                earlier_consents[key.code, key.sha256] = consent
    for key in map(CodeKey.of, list_imported_code([scenario])):
        earlier_consent = earlier_consents.get((key.code, key.sha256))
        if codes is None or key.code in codes:
            allowed_code[key] = CodeConsent(None, key.sha256)
        elif earlier_consent is not None:
            allowed_code[key] = earlier_consent
    return scenario


class RememberedFile(msgspec.Struct):
    """A file whose code a person allowed for good.

    Attributes:
        file: the path of the file.
        classes: the settings with which each class may run, by the name of the class.
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
    """Allows the code of a log that is in named or remembered files to run, see `open_log`.

    Args:
        scenario: the scenario of the log.
        law: the files that a person names.
        other_version: whether a file may differ from the one that ran.
        remember: whether the permission is remembered for later logs.

    Raises:
        UsageError: a file does not define code that the log names, or is another version of it;
            or an option needs a file and none is named.
        ScenarioError: a file cannot be read, or does not define such a law. No code has run.
    """
    files = [Path(law)] if isinstance(law, str | Path) else list(map(Path, law))
    if (other_version or remember) and not files:
        raise UsageError("--other-version and --remember need a file: give --law FILE, too")
    logged = {CodeKey.of(imported): imported for imported in list_imported_code([scenario])}
    remembered = _read_store() if logged else {}
    _load_remembered_settings(remembered)
    for key in logged:
        texts = remembered_settings.get((key.sha256, _class_of(key)), [])
        if key.sha256 in remembered and key.settings in texts:
            file = Path(remembered[key.sha256].file)
            allowed_code.setdefault(key, CodeConsent(file, key.sha256))
    for file in files:
        sha256, keys = _allow_file(file, logged, other_version=other_version)
        if remember:
            entry = remembered.setdefault(sha256, RememberedFile(""))
            entry.file = str(file.resolve())
            for key in keys:
                settings = entry.classes.setdefault(_class_of(key), [])
                if logged[key].settings not in settings:
                    settings.append(logged[key].settings)
            _write_store(remembered)


def _load_remembered_settings(remembered: Mapping[str, RememberedFile]) -> None:
    """Replaces the settings that a refusal compares by those of the remembered files."""
    remembered_settings.clear()
    for sha256, entry in remembered.items():
        for name, settings in entry.classes.items():
            remembered_settings[sha256, name] = [
                json.dumps(values, sort_keys=True, default=str) for values in settings
            ]


def _class_of(key: CodeKey) -> str:
    return key.code.partition(":")[2]


def _find_store() -> Path:
    """Returns the path of the file that holds remembered permissions."""
    folder = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(folder, "trilat-net", "laws.json")


def _read_store() -> dict[str, RememberedFile]:
    """Returns the remembered files by their hash.

    An entry without settings, which earlier versions wrote, allows nothing.
    """
    # A RuntimeError is raised if the user has no home folder.
    with suppress(OSError, ValueError, RuntimeError):
        entries = msgspec.json.decode(
            _find_store().read_bytes(), type=dict[str, RememberedFile | str]
        )
        return {
            sha256: RememberedFile(entry) if isinstance(entry, str) else entry
            for sha256, entry in entries.items()
        }
    return {}


def _write_store(remembered: Mapping[str, RememberedFile]) -> None:
    make_folder(_find_store().parent)
    # The file may be a link: people link their settings to a folder under version control.
    store = _find_store().resolve()
    write_whole(store, msgspec.json.format(msgspec.json.encode(remembered), indent=1))


def _allow_file(
    file: Path, logged: Mapping[CodeKey, ImportedCode], *, other_version: bool
) -> tuple[str, list[CodeKey]]:
    """Allows a file to run as the logged code that has its hash, or else its name.

    Returns:
        The hash of the file, and the keys of the code that was allowed.
    """
    source = read_code("", "--law", file.resolve())
    sha256 = source.sha256
    # A package is named by its folder.
    module = (source.file.parent if file.stem == "__init__" else file).stem
    keys = [key for key in logged if key.sha256 == sha256]
    if not keys:
        keys = [key for key in logged if re.split(r"[.:]", key.code)[-2] == module]
    if not keys:
        names = ", ".join(sorted({key.code for key in logged})) or "none from outside"
        raise UsageError(f"--law {file}: is no law that the log names: these are {names}")
    for key in keys:
        if key.sha256 != sha256 and not other_version:
            versions = _compare_hashes(key, sha256)
            problem = f"is not the file that ran as {key.code}: {versions}"
            raise UsageError(f"--law {file}: {problem}; --other-version accepts it")
        check_class(source, key.code, "--law", logged[key].method)
        allowed_code[key] = CodeConsent(source.file, sha256)
    return sha256, keys


def _compare_hashes(key: CodeKey, sha256: str) -> str:
    return f"its sha256 is {sha256[:16]}, and was {key.sha256[:16]}"


class LoggedUserLaw(NamedTuple):
    """A user law that a log names, and its sites.

    Attributes:
        code: the class of the law, as in "package.module:Law".
        sites: the sites that it controls.
        settings: the arguments of its class, as text.
        allowed: whether its file may run with these settings.
        file: that file, else the file that Python finds by the name of its module; None: there
            is no such file.
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
        law = f"{self.code} of {', '.join(self.sites)}"
        settings = f" with {self.settings}" if self.settings else ""
        state = f"was changed, {self.changed}" if self.changed else "is the one that ran"
        if self.allowed:
            return f"{law}{settings}; its file {state}"
        option = "FILE"
        if self.file:
            version = " --other-version" if self.changed else ""
            option = f"{self.file}{version} (it {state})"
        difference = f" ({self.other_settings})" if self.other_settings else ""
        problem = f"{law} is code from outside, which may not run{settings}{difference}"
        return f"{problem}; if you trust it: --law {option}"


def find_user_laws(scenario: "Scenario") -> list[LoggedUserLaw]:
    """Returns the user laws of a scenario without running any code of them."""
    sites: dict[CodeKey, tuple[str, ...]] = {}
    laws: dict[CodeKey, ImportedLaw] = {}
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            key = CodeKey.of(spec.control)
            sites[key] = (*sites.get(key, ()), name)
            laws[key] = spec.control
    return [_inspect_user_law(key, law, sites[key]) for key, law in laws.items()]


def _inspect_user_law(key: CodeKey, law: ImportedLaw, sites: tuple[str, ...]) -> LoggedUserLaw:
    """Returns the state of a user law: its file, and whether it may run."""
    consent = find_consent(key)
    sha256 = ""
    file = None
    with suppress(ScenarioError):
        source = read_code(key.code, "", consent and consent.file)
        check_class(source, key.code, "")
        sha256 = source.sha256
        file = source.file
    is_allowed = consent is not None and consent.sha256 == sha256
    is_changed = sha256 not in ("", key.sha256)
    settings = ", ".join(
        f"{argument} = {describe_setting(value)}" for argument, value in law.settings.items()
    )
    return LoggedUserLaw(
        code=key.code,
        sites=sites,
        settings=settings,
        allowed=is_allowed,
        file=file,
        changed=_compare_hashes(key, sha256) if is_changed else "",
        other_settings="" if is_allowed else describe_new_settings(key),
    )
