"""Laws that are imported from a user's module.

Invariant: a user's law is named `law = "package.module:Law"`. The scenario holds the hash of
the file that defines it, so a log shows if the law executed again is the one that ran. Naming a
law runs nothing, not even the package that contains it. `import_class` is the one door to code
from outside: it opens for `allowed_code`, if the file is still that one and defines a law of
that name. A permission covers the arguments of the class as well: harmless code with other
arguments may open another file.
"""

import ast
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, cast

from msgspec import Meta, field

from ..core.user_law import LawContext, UserLaw, UserLawFactory
from ..errors import CodeWithheld, ScenarioError
from ..fields import suggest_nearest
from ..files import find_page, open_regular
from ..laws.interface import LawSettings, check_law_class, make_instance
from ..laws.sent_vectors import SentVectorSpecs, convert_sends, parse_classes

CLASS_PATTERN = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"

_imported: dict[str, str] = {}
"""Per imported module of a law the hash of its file at that time."""


Watch = Callable[[int, Callable[[], Any]], Any]
"""Calls code of a user's own at a tick, and returns what it gives."""


def call_directly(_k: int, call: Callable[[], Any]) -> Any:
    """Calls it, as in virtual time, where nobody waits."""
    return call()


class NamedCode(Protocol):
    """A class from outside as a scenario names it: a law, a hand or a plant."""

    @property
    def code(self) -> str:
        """The place of the class, as in "package.module:Law"."""

    @property
    def source_sha256(self) -> str:
        """The hash of the file of that module."""

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments of the class, by name."""


ANY_SETTINGS = "*"
"""In place of settings: whatever they are. Only the workers of a study may be given such a
permission.
"""


class CodeKey(NamedTuple):
    """What a permission covers.

    Attributes:
        code: the place of the class, as in "package.module:Law".
        sha256: the hash of its file, as the scenario names it.
        settings: the arguments of the class, as JSON with sorted keys; or `ANY_SETTINGS`.
    """

    code: str
    sha256: str
    settings: str

    @classmethod
    def of(cls, named: NamedCode) -> "CodeKey":
        """Returns the key of a law, hand or plant of a scenario."""
        return cls(
            named.code,
            named.source_sha256,
            json.dumps(named.settings, sort_keys=True, default=str),
        )


class CodeConsent(NamedTuple):
    """A file that may run: where it is, None for where Python finds its module; and its
    SHA-256.
    """

    file: Path | None
    sha256: str


CodeConsents = dict[CodeKey, CodeConsent]
allowed_code: CodeConsents = {}
"""The code that may run in this process; workers are given it."""
remembered_settings: dict[tuple[str, str], list[str]] = {}
"""The remembered settings, as in a `CodeKey`, by the hash of a file and the name of a class."""


def find_consent(key: CodeKey) -> CodeConsent | None:
    """Returns the permission for code with its settings; None if it may not run."""
    return allowed_code.get(key) or allowed_code.get(key._replace(settings=ANY_SETTINGS))


@contextmanager
def allowing_any_settings(allowed: CodeConsents) -> Iterator[None]:
    """Lets the code of a study run with any settings inside the block: a study chooses them by
    itself.
    """
    widened = {key._replace(settings=ANY_SETTINGS): consent for key, consent in allowed.items()}
    added = {key: consent for key, consent in widened.items() if key not in allowed_code}
    allowed_code.update(added)
    try:
        yield
    finally:
        for key in added:
            allowed_code.pop(key, None)


def describe_new_settings(key: CodeKey) -> str:
    """Returns how the settings of withheld code differ from the nearest that may run; "" if
    none may.
    """
    alike = {
        one.settings
        for one in allowed_code
        if one[:2] == key[:2] and one.settings != ANY_SETTINGS
    }
    alike |= set(remembered_settings.get((key.sha256, key.code.partition(":")[2]), ()))
    differences = [
        _list_differences(json.loads(text), json.loads(key.settings)) for text in sorted(alike)
    ]
    nearest = min(differences, key=len, default=[])
    return (
        f"it was allowed with other settings, and here {', '.join(nearest)}" if nearest else ""
    )


def _list_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    texts = [
        {key: describe_setting(value) for key, value in side.items()} for side in (before, now)
    ]
    old, new = texts
    changed = (key for key in sorted({*old, *new}) if old.get(key) != new.get(key))
    return [
        f"{key} = {new.get(key, 'its default')} (was {old.get(key, 'its default')})"
        for key in changed
    ]


LONGEST_SETTING = 300
"""Characters of a setting that are shown; paths of files are shorter."""


def describe_setting(value: Any) -> str:
    """Returns the value of a setting as a text without control characters.

    Of a long value the beginning and the end are shown: the end of a path is what tells files
    apart.
    """
    text = json.dumps(value, default=str)
    if len(text) <= LONGEST_SETTING:
        return text
    half = LONGEST_SETTING // 2
    return f"{text[:half]} ... {text[-half:]} ({len(text)} characters)"


_executed: dict["CodeSource", Any] = {}
"""Modules of the files that were executed."""


class ImportedLaw(LawSettings, frozen=True, tag_field="law", tag="own"):
    """A user's law.

    Attributes:
        code: its place, as in "package.module:Law".
        source_sha256: hash of the file of that module.
        settings: the arguments of its class, by name.
        sends: what it sends to its peers, as its class declares it.
    """

    method: ClassVar[str] = "torque"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)
    sends: SentVectorSpecs = field(default_factory=dict)

    def build_factory(self, sites: int, scheme: str) -> UserLawFactory:
        """Returns the factory of the law, for a site of an experiment of so many sites."""

        def make(context: LawContext) -> UserLaw:
            path = f"sites.{context.site}.control"
            kind = import_class(CodeKey.of(self), f"{path}.law")
            # before anything of it is called
            check_law_class(
                kind=kind, code=self.code, context=context, sites=sites, scheme=scheme
            )
            declared = convert_sends(getattr(kind, "sends", {}), self.code, path)
            if [*declared.items()] != [*self.sends.items()]:
                raise ScenarioError(
                    f"{self.code} sends other vectors than the scenario names: write sends out in the body "
                    f"of that class, and law = {self.code!r} to take what is there",
                    path=f"sites.{context.site}.control.sends",
                )
            law: UserLaw = make_instance(kind, self.code, context, self.settings)
            return law

        return make


class CodeSource(NamedTuple):
    """The file of a law, as it is: where, its content, and the SHA-256 of that."""

    file: Path
    content: bytes
    sha256: str


def read_code(code: str, path: str, file: Path | None = None) -> CodeSource:
    """Returns a law's file, or that which Python finds, of which nothing runs; errors call the
    key `path`.

    Raises:
        ScenarioError: there is no such file, or it cannot be read.
    """
    place = file or _find_file(code, path)
    try:
        with open_regular(place) as stream:
            content = stream.read()
    except OSError as error:
        raise ScenarioError(f"{place} cannot be read: {error.strerror}", path=path) from None
    return CodeSource(place, content, hashlib.sha256(content).hexdigest())


def _find_file(code: str, path: str) -> Path:
    module = code.partition(":")[0]
    with _searching(None):
        spec = _find_spec(module)
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ScenarioError(
            f"there is no module {module}, where {code} is; install it, or be in the folder that it lies in "
            "(PYTHONPATH counts too)",
            path=path,
        )
    return Path(spec.origin)


def _find_spec(module: str) -> ModuleSpec | None:
    """Finds a module as an import would, without running the packages that it is in.

    Finders of other packages are not asked: that of `distutils` imports the nearest setuptools.
    """
    spec = None
    folders = None
    finders = [
        one
        for one in sys.meta_path
        if one is PathFinder or one.__module__.startswith("__editable__")
    ]
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        try:
            found = (finder.find_spec(name, folders) for finder in finders)
            spec = next((one for one in found if one is not None), None)
        except (ImportError, ValueError, AttributeError, LookupError):
            return None
        folders = None if spec is None else spec.submodule_search_locations
        if spec is None or (folders is None and name != module):
            return None
    return spec


def import_class(key: CodeKey, path: str, method: str = "torque") -> Any:
    """Returns the class that a scenario names by a hash, from the file that may run for it.

    Raises:
        CodeWithheld: none may.
        ScenarioError: it is not as it was when it was let, or defines no such class: nothing
            has run; or it cannot be imported.
    """
    code = key.code
    module, _, name = code.partition(":")
    if (consent := find_consent(key)) is None:
        problem = f"{code} is code from outside, which may not run"
        problem = (
            f"{problem} ({difference})"
            if (difference := describe_new_settings(key))
            else problem
        )
        remedy = "--law FILE lets its file (in Python tn.open_log(..., law=FILE))"
        raise CodeWithheld(f"{problem}: {remedy}", path=path)
    source = read_code(code, path, consent.file)
    if source.sha256 != consent.sha256:
        problem = f"the file of {code} is not the one that the scenario names by its hash; put that one"
        raise ScenarioError(
            f"{problem} there, or write {code!r} anew to take the one that is", path=path
        )
    check_class(source, code, path, method)
    folders = source.file.parents  # its own, or that of its package
    depth = min(module.count(".") + (source.file.stem == "__init__"), len(folders) - 1)
    with _searching(consent.file and folders[depth]):
        try:
            found = _execute(module, source) if consent.file else _import(module, source.sha256)
        except (Exception, SystemExit) as error:  # the user's code
            problem = f"{module} cannot be imported: {type(error).__name__}: {error}"
            raise ScenarioError(problem, path=path) from None
    return getattr(found, name)


PAGES = {
    "torque": ("law", "own-controller.md"),
    "act": ("hand", "policies.md"),
    "step": ("plant", "policies.md"),
}
"""What a class is called that has such a method, and the page that describes it."""


def check_class(source: CodeSource, code: str, path: str, method: str = "torque") -> None:
    """Refuses a file that does not define a class with a method, by its syntax alone: nothing
    of it runs.

    Raises:
        ScenarioError: it is no Python, or has no such class, or that neither the method nor a
            base.
    """
    kind, page = PAGES[method]
    name = code.partition(":")[2]
    classes = parse_classes(source.content, source.file, path)
    if name not in classes:
        hint = suggest_nearest(name, list(classes)) or f"; see {find_page(page)}"
        raise ScenarioError(f"{source.file} defines no class {name}{hint}", path=path)
    node = classes[name]
    named = {getattr(one, "name", getattr(one, "id", "")) for one in ast.walk(node)}
    if not (node.bases or node.keywords or node.decorator_list or method in named):
        raise ScenarioError(
            f"{code} is no {kind}: it has no {method}; see {find_page(page)}", path=path
        )


def _import(module: str, sha256: str) -> Any:
    found = importlib.import_module(module)
    if _imported.setdefault(module, sha256) != sha256:  # edited while this program runs
        found = importlib.reload(found)
        _imported[module] = sha256
    return found


def _execute(module: str, source: CodeSource) -> Any:
    """Returns a module of the content that was checked, and of nothing that is cached beside
    the file.
    """
    if source in _executed:
        return _executed[source]
    file = str(source.file)
    before = sys.modules.get(module)
    spec = spec_from_file_location(module, file, loader=SourceFileLoader(module, file))
    made = sys.modules[module] = module_from_spec(cast(ModuleSpec, spec))
    try:
        exec(compile(source.content, file, "exec"), made.__dict__)
    finally:
        # whatever a log calls it, it takes no other module's place
        sys.modules.pop(module, None)
        if before is not None:
            sys.modules[module] = before
    _executed[source] = made
    return made


def name_law_class(kind: type) -> str:
    """Returns what a scenario calls a class, as in "mylaws:Spring".

    Raises:
        ScenarioError: it stands in no file, or within something else there.
    """
    module = kind.__module__
    name = kind.__qualname__
    if module == "__main__":
        module = Path(getattr(sys.modules[module], "__file__", None) or "").stem
    if not module or not name.isidentifier():
        raise ScenarioError(
            f"{name} is no class of a file, which a log could name: write it into one, in a notebook with "
            f"%%writefile mylaws.py, and import it from there; see {find_page('own-controller.md')}"
        )
    return f"{module}:{name}"


def name_law_classes(value: Any) -> Any:
    """Returns a value of a scenario as plain ones: classes by `name_law_class`, NumPy's as
    numbers.
    """
    if isinstance(value, type):
        return name_law_class(value)
    if isinstance(value, Mapping):
        return {str(key): name_law_classes(one) for key, one in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


@contextmanager
def _searching(folder: Path | None) -> Iterator[None]:
    """Lets modules be found in a folder before all others; None: the working directory, unless
    it is one.
    """
    first = str(folder or Path.cwd())
    if folder is None and first in sys.path:
        yield
        return
    sys.path.insert(0, first)
    importlib.invalidate_caches()  # a file may be a moment old
    try:
        yield
    finally:
        sys.path.remove(first)
