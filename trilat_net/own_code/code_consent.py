"""Decides which user-written code may run, and remembers permissions.

A scenario may name user-written classes: control laws, programs that move an arm, and plants
(simulations of an arm). Code that users name in their own scenario may run. A log, or another
member of a session, may have an unknown author, and code that it names may run only if a person
names the file of the code. On request, the program remembers the permission in the
configuration folder.

Invariant:
    - The file that a person names must have the hash stated in the log, unless the person
      explicitly allows another version.
    - A permission applies to one class in one file, with the arguments of one log. A log with
      other arguments needs its own permission, and the error message says which arguments
      differ.
"""

import json
import os
import re
from collections.abc import Container, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from ..errors import ScenarioError, UsageError
from ..files import make_folder, write_whole
from .imported_code import (
    CodeConsent,
    CodeKey,
    ImportedLaw,
    NamedCode,
    ScenarioWithCode,
    allowed_code,
    describe_setting,
    read_code,
    remembered_settings,
)

AnyScenario = TypeVar("AnyScenario", bound=ScenarioWithCode)
LawFiles = str | Path | Sequence[str | Path]
"""Path of a file with user-written code, or several such paths."""


def list_named_code(scenario: ScenarioWithCode) -> list[NamedCode]:
    """Returns the entries of a scenario that name a user's class.

    These are control laws, operators (programs that move an arm) and plants (programs that
    compute the motion of an arm).

    Args:
        scenario: The scenario.
    """
    named: list[NamedCode] = []
    for site in scenario.sites.values():
        for candidate in (site.control, *site.hands, site.plant):
            kind: object = type(candidate)
            if _names_code(kind):
                named.append(candidate)
    return named


@cache
def _names_code(kind: object) -> bool:
    """Returns True if scenario entries of the given class name a user's class.

    The result is cached per class, because `isinstance` with a protocol is slow: without the
    cache, it took one twelfth of the time needed to reset a training environment.

    Args:
        kind: Class of an entry of a scenario.
    """
    return all(hasattr(kind, name) for name in ("method", "code", "source_sha256", "settings"))


def allow_own_code(
    scenario: AnyScenario,
    codes: Container[Any] | None = None,
    changed_from: ScenarioWithCode | None = None,
) -> AnyScenario:
    """Grants permission to run the user-written classes that a user of this process has named.

    Code that nobody has named or permitted is rejected, because a scenario from elsewhere may
    name harmful code.

    Args:
        scenario: Scenario that names the code.
        codes: Classes that the user named, for example "package.module:Law". If None, the user
            wrote the complete scenario, so all its code may run.
        changed_from: Scenario that the user modified to get this scenario. Code that was
            permitted in that scenario is also permitted in the new one, with its new arguments.
            None if the scenario was not modified in this way.

    Returns:
        The same scenario.
    """
    earlier_consents: dict[tuple[str, str], CodeConsent] = {}
    if changed_from is not None:
        for key in map(CodeKey.of, list_named_code(changed_from)):
            consent = key.find_consent()
            if consent is not None:
                earlier_consents[key.code, key.sha256] = consent

    for key in map(CodeKey.of, list_named_code(scenario)):
        earlier_consent = earlier_consents.get((key.code, key.sha256))
        if codes is None or key.code in codes:
            allowed_code[key] = CodeConsent(None, key.sha256)
        elif earlier_consent is not None:
            allowed_code[key] = earlier_consent
    return scenario


def import_named_class(code: str, path: str) -> Any:
    """Imports a control law that a user of this process has named and thereby permitted.

    Args:
        code: Module and class, as in "mylaws:Spring".
        path: Name of the option or key that contains the class, for error messages.

    Raises:
        ScenarioError: The class does not exist, or its file raises an error.
    """
    sha256 = read_code(code, path).sha256
    key = CodeKey(code, sha256, "{}")
    allowed_code[key] = CodeConsent(None, sha256)
    return key.import_class(path)


class _RememberedFile(msgspec.Struct):
    """File with user-written code that a person has permitted to run, as stored on disk.

    Attributes:
        file: Path of the file.
        classes: Maps the name of each class in the file to the sets of arguments with which it
            may run.
    """

    file: str
    classes: dict[str, list[dict[str, Any]]] = {}


def allow_logged_code(
    scenario: ScenarioWithCode,
    law: LawFiles = (),
    *,
    other_version: bool = False,
    remember: bool = False,
) -> None:
    """Grants permission to run user-written code named in a log, if a person has allowed it.

    A log may have an unknown author, so its code does not run without permission. A person
    either permits the code now, by naming its file, or has stored a permission earlier. See
    `open_log`.

    Args:
        scenario: Scenario of the log, which names the code.
        law: Python files that the person permits to run. By default, no file is permitted.
        other_version: True to allow a file to differ from the one that ran.
        remember: True to store the permission for later logs.

    Raises:
        UsageError: A file does not belong to code that the log names, or is not the version
            that ran. Also raised if `other_version` or `remember` is set but no file is named.
        ScenarioError: A file cannot be read, or does not define the class that the log names.
            No code has run.
    """
    files = [Path(law)] if isinstance(law, str | Path) else list(map(Path, law))
    if (other_version or remember) and not files:
        raise UsageError("--other-version and --remember need a file: give --law FILE, too")
    logged = {CodeKey.of(imported): imported for imported in list_named_code(scenario)}

    # If the log names no user's code, the store is not read.
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
            entry = remembered.setdefault(sha256, _RememberedFile(""))
            entry.file = str(file.resolve())
            for key in keys:
                settings = entry.classes.setdefault(_class_of(key), [])
                if logged[key].settings not in settings:
                    settings.append(logged[key].settings)
            _write_store(remembered)


def _load_remembered_settings(remembered: Mapping[str, _RememberedFile]) -> None:
    """Loads the arguments to which stored permissions apply.

    A message about rejected code can then say which arguments differ.

    Args:
        remembered: Maps the hash of each file to the stored permissions.
    """
    remembered_settings.clear()
    for sha256, entry in remembered.items():
        for name, settings in entry.classes.items():
            remembered_settings[sha256, name] = [
                json.dumps(arguments, sort_keys=True, default=str) for arguments in settings
            ]


def _class_of(key: CodeKey) -> str:
    """Returns the name of a user's class without its module: "Law" for "package.module:Law"."""
    return key.code.partition(":")[2]


def _find_store() -> Path:
    """Returns the path of the file that stores the user's permissions to run code."""
    folder = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(folder, "trilat-net", "laws.json")


def _read_store() -> dict[str, _RememberedFile]:
    """Returns the permissions to run code that this user has stored.

    If nothing was stored, or the file cannot be read, there are no permissions. Earlier
    versions of the program stored only the path of a file. Such an entry permits nothing.

    Returns:
        Maps the hash of each file to its permissions.
    """
    # A RuntimeError is raised if the user has no home folder.
    with suppress(OSError, ValueError, RuntimeError):
        entries = msgspec.json.decode(
            _find_store().read_bytes(), type=dict[str, _RememberedFile | str]
        )
        return {
            sha256: _RememberedFile(entry) if isinstance(entry, str) else entry
            for sha256, entry in entries.items()
        }
    return {}


def _write_store(remembered: Mapping[str, _RememberedFile]) -> None:
    """Replaces the permissions in the user's file with the given ones."""
    make_folder(_find_store().parent)
    # The file may be a link: people link their settings to a folder under version control.
    store = _find_store().resolve()
    write_whole(store, msgspec.json.format(msgspec.json.encode(remembered), indent=1))


def _allow_file(
    file: Path, logged: Mapping[CodeKey, NamedCode], *, other_version: bool
) -> tuple[str, list[CodeKey]]:
    """Permits a file named by the user to run as code that a log names.

    The file belongs to the code that has the hash of the file. If there is no such code, it
    belongs to the code whose module has the name of the file, and is another version of that
    code.

    Args:
        file: Path of the file.
        logged: Maps the key of the code that the log names to its entry in the scenario.
        other_version: True if the file may be another version.

    Returns:
        The hash of the file, and the keys of the code that was permitted.

    Raises:
        UsageError: The file is not code that the log names, or is another version.
        ScenarioError: The file cannot be read, or does not define the class.
    """
    source = read_code("", "--law", file.resolve())
    sha256 = source.sha256
    is_package = file.stem == "__init__"
    module_name = source.file.parent.stem if is_package else file.stem
    keys = [key for key in logged if key.sha256 == sha256]
    if not keys:
        # The last part of "package.module:Law" before the class is the name of the file.
        keys = [key for key in logged if re.split(r"[.:]", key.code)[-2] == module_name]
    if not keys:
        names = ", ".join(sorted({key.code for key in logged})) or "no external code"
        raise UsageError(
            f"--law {file} does not contain code that the log names; the log names {names}"
        )
    for key in keys:
        if key.sha256 != sha256 and not other_version:
            versions = _compare_hashes(key, sha256)
            problem = f"is not the file that ran as {key.code}: {versions}"
            raise UsageError(f"--law {file} {problem}; --other-version accepts it")
        source.check_class(key.code, "--law", logged[key].method)
        allowed_code[key] = CodeConsent(source.file, sha256)
    return sha256, keys


def _compare_hashes(key: CodeKey, sha256: str) -> str:
    """Returns the first digits of a file's hash and of the hash in a log, for a message.

    Different digits show the user that the file is not the version that the log names.
    """
    return f"its sha256 is {sha256[:16]}, but was {key.sha256[:16]}"


class LoggedUserLaw(NamedTuple):
    """User-written control law that a log names, with its permission to run.

    Attributes:
        code: Class of the law, for example "package.module:Law".
        sites: Names of the sites that the law controls.
        settings: Arguments of the class, as readable text.
        allowed: True if the file may run with these arguments.
        file: The file that a person permitted, or else the file that Python's import system
            finds for the module. None if there is no such file.
        changed: Phrase that compares the hashes, if the file differs from the file that ran.
            Otherwise empty.
        other_settings: Phrase that states the differences, if the code was permitted with other
            arguments. Otherwise empty.
    """

    code: str
    sites: tuple[str, ...]
    settings: str
    allowed: bool
    file: Path | None
    changed: str
    other_settings: str = ""

    @classmethod
    def inspect(cls, law: ImportedLaw, sites: tuple[str, ...]) -> "LoggedUserLaw":
        """Finds the file of a user's control law, and determines whether the law may run.

        None of its code is run.

        Args:
            law: The law in the scenario.
            sites: Names of the sites that it controls.
        """
        key = CodeKey.of(law)
        consent = key.find_consent()
        sha256 = ""
        file = None
        with suppress(ScenarioError):
            source = read_code(key.code, "", consent and consent.file)
            source.check_class(key.code, "")
            sha256 = source.sha256
            file = source.file

        is_allowed = consent is not None and consent.sha256 == sha256
        # The hash is empty if there is no file.
        is_changed = sha256 not in ("", key.sha256)
        settings = ", ".join(
            f"{argument} = {describe_setting(value)}"
            for argument, value in law.settings.items()
        )
        return cls(
            code=key.code,
            sites=sites,
            settings=settings,
            allowed=is_allowed,
            file=file,
            changed=_compare_hashes(key, sha256) if is_changed else "",
            other_settings="" if is_allowed else key.describe_new_settings(),
        )

    def __str__(self) -> str:
        """Returns a sentence about the control law, with the option that permits it to run."""
        law = f"{self.code} of {', '.join(self.sites)}"
        settings = f" with {self.settings}" if self.settings else ""
        file_state = "is the one that ran"
        if self.changed:
            file_state = f"was changed, {self.changed}"
        if self.allowed:
            return f"{law}{settings}; its file {file_state}"

        option = "FILE"
        if self.file:
            version = " --other-version" if self.changed else ""
            option = f"{self.file}{version} (it {file_state})"
        difference = f" ({self.other_settings})" if self.other_settings else ""
        problem = f"{law} is external code, which may not run{settings}{difference}"
        return f"{problem}; if you trust it: --law {option}"
