"""Import users' classes from outside of the program: laws, hands and plants.

A user's law is named `law = "package.module:Law"`.

Invariant:
    - A scenario holds the hash of the file that defines a class, so that a log shows if the
      code that is executed again is the code that ran.
    - Naming a class runs no code, not even that of the package that contains it.
    - `import_class` is the only way to run code from outside. It imports a class only if
      `allowed_code` permits it, and if its file still has the permitted hash and defines a
      class of that name.
    - A permission covers the arguments of the class as well: harmless code with other arguments
      may open another file.
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
"""The hash of the file of each module of a law that was imported, when it was imported."""


Watch = Callable[[int, Callable[[], Any]], Any]
"""A function that calls a user's code at a tick and returns its result."""


def call_directly(_k: int, function: Callable[[], Any]) -> Any:
    """Calls a user's code without a time limit, as in virtual time, where nobody waits."""
    return function()


class NamedCode(Protocol):
    """A class from outside as a scenario names it: a law, a hand or a plant."""

    @property
    def code(self) -> str:
        """The module and the class, as in "package.module:Law"."""

    @property
    def source_sha256(self) -> str:
        """The hash of the file of that module."""

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments of the class, by name."""


ANY_SETTINGS = "*"
"""Stands for any settings. Only the workers of a study may be given such a permission."""


class CodeKey(NamedTuple):
    """The code that a permission covers.

    Attributes:
        code: the module and the class, as in "package.module:Law".
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
    """A file that may run.

    Attributes:
        file: the path of the file; None: the file that Python finds for the module.
        sha256: the SHA-256 of the file.
    """

    file: Path | None
    sha256: str


CodeConsents = dict[CodeKey, CodeConsent]
allowed_code: CodeConsents = {}
"""The code that may run in this process. Worker processes get a copy."""
remembered_settings: dict[tuple[str, str], list[str]] = {}
"""The remembered settings, as in a `CodeKey`, by the hash of a file and the name of a class."""


def find_consent(key: CodeKey) -> CodeConsent | None:
    """Returns the permission for code with its settings; None if it may not run."""
    return allowed_code.get(key) or allowed_code.get(key._replace(settings=ANY_SETTINGS))


@contextmanager
def allowing_any_settings(allowed: CodeConsents) -> Iterator[None]:
    """Allows code with any settings inside the block, because a study chooses settings itself.

    Args:
        allowed: the permissions that are widened.
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
    """Returns how the settings of withheld code differ from the nearest allowed settings.

    The result is "" if the code may not run with any settings.
    """
    allowed_settings = {
        allowed.settings
        for allowed in allowed_code
        if (allowed.code, allowed.sha256) == (key.code, key.sha256)
        and allowed.settings != ANY_SETTINGS
    }
    class_name = key.code.partition(":")[2]
    allowed_settings |= set(remembered_settings.get((key.sha256, class_name), ()))
    settings = json.loads(key.settings)
    differences = [
        _list_differences(json.loads(text), settings) for text in sorted(allowed_settings)
    ]
    nearest = min(differences, key=len, default=[])
    if not nearest:
        return ""
    return f"it was allowed with other settings, and here {', '.join(nearest)}"


def _list_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Returns a text on each setting whose description changed."""
    old = {key: describe_setting(value) for key, value in before.items()}
    new = {key: describe_setting(value) for key, value in now.items()}
    default = "its default"
    return [
        f"{key} = {new.get(key, default)} (was {old.get(key, default)})"
        for key in sorted({*old, *new})
        if old.get(key) != new.get(key)
    ]


LONGEST_SETTING = 300
"""Largest length of a setting that is shown completely; paths of files are shorter."""


def describe_setting(value: Any) -> str:
    """Returns the value of a setting as a text without control characters.

    A long value is shortened in the middle, because paths of files differ at their ends.
    """
    text = json.dumps(value, default=str)
    if len(text) <= LONGEST_SETTING:
        return text
    half = LONGEST_SETTING // 2
    return f"{text[:half]} ... {text[-half:]} ({len(text)} characters)"


_executed: dict["CodeSource", Any] = {}
"""The modules of the files that were executed."""


class ImportedLaw(LawSettings, frozen=True, tag_field="law", tag="own"):
    """A user's law.

    Attributes:
        code: the module and the class, as in "package.module:Law".
        source_sha256: the hash of the file of that module.
        settings: the arguments of the class, by name.
        sends: the vectors that the law sends to its peers, as its class declares them.
    """

    method: ClassVar[str] = "torque"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)
    sends: SentVectorSpecs = field(default_factory=dict)

    def build_factory(self, sites: int, scheme: str) -> UserLawFactory:
        """Returns the factory of the law for a site.

        Args:
            sites: the number of sites of the experiment.
            scheme: the scheme of the experiment.
        """

        def make(context: LawContext) -> UserLaw:
            path = f"sites.{context.site}.control"
            kind = import_class(CodeKey.of(self), f"{path}.law")
            # The class is checked before any of its code is called.
            check_law_class(
                kind=kind, code=self.code, context=context, sites=sites, scheme=scheme
            )
            declared = convert_sends(getattr(kind, "sends", {}), self.code, path)
            # The order of the vectors counts, too.
            if list(declared.items()) != list(self.sends.items()):
                raise ScenarioError(
                    f"{self.code} sends other vectors than the scenario names: write sends out "
                    f"in the body of that class, and set law = {self.code!r} again to read "
                    "them",
                    path=f"{path}.sends",
                )
            law: UserLaw = make_instance(kind, self.code, context, self.settings)
            return law

        return make


class CodeSource(NamedTuple):
    """The file of a class from outside.

    Attributes:
        file: its path.
        content: its content.
        sha256: the SHA-256 of the content.
    """

    file: Path
    content: bytes
    sha256: str


def read_code(code: str, path: str, file: Path | None = None) -> CodeSource:
    """Returns the file of a class, without running any code of it.

    Args:
        code: the module and the class, as in "package.module:Law".
        path: the path of the key in errors.
        file: the file; None: the file that Python finds for the module.

    Raises:
        ScenarioError: there is no such file, or it cannot be read.
    """
    source_file = file or _find_file(code, path)
    try:
        with open_regular(source_file) as stream:
            content = stream.read()
    except OSError as error:
        raise ScenarioError(
            f"{source_file} cannot be read: {error.strerror}", path=path
        ) from None
    return CodeSource(source_file, content, hashlib.sha256(content).hexdigest())


def _find_file(code: str, path: str) -> Path:
    """Returns the file that Python finds for the module of a class."""
    module = code.partition(":")[0]
    with _searching(None):
        spec = _find_spec(module)
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ScenarioError(
            f"there is no module {module}, where {code} is; install it, or run the command in "
            "its folder (PYTHONPATH counts, too)",
            path=path,
        )
    return Path(spec.origin)


def _find_spec(module: str) -> ModuleSpec | None:
    """Returns the spec of a module as an import finds it, without importing its packages.

    Only Python's path finder and the finders of editable installations are used. Other finders
    may run code: that of `distutils` imports the nearest setuptools.
    """
    finders = [
        finder
        for finder in sys.meta_path
        if finder is PathFinder or finder.__module__.startswith("__editable__")
    ]
    spec = None
    search_folders = None
    parts = module.split(".")
    for depth in range(1, len(parts) + 1):
        name = ".".join(parts[:depth])
        try:
            specs = (finder.find_spec(name, search_folders) for finder in finders)
            spec = next((candidate for candidate in specs if candidate is not None), None)
        except (ImportError, ValueError, AttributeError, LookupError):
            return None
        if spec is None:
            return None
        search_folders = spec.submodule_search_locations
        if search_folders is None and name != module:
            return None
    return spec


def import_class(key: CodeKey, path: str, method: str = "torque") -> Any:
    """Returns the class of a key, from the file that may run for it.

    Args:
        key: the class, with the hash of its file and its settings.
        path: the path of the key in errors.
        method: the method that the class must have.

    Raises:
        CodeWithheld: no file may run for the class.
        ScenarioError: the file differs from the one that was allowed, or does not define such a
            class, and no code of it has run; or it cannot be imported.
    """
    code = key.code
    module, _, name = code.partition(":")
    consent = find_consent(key)
    if consent is None:
        difference = describe_new_settings(key)
        reason = f" ({difference})" if difference else ""
        raise CodeWithheld(
            f"{code} is code from outside, which may not run{reason}: --law FILE lets its file "
            "(in Python tn.open_log(..., law=FILE))",
            path=path,
        )
    source = read_code(code, path, consent.file)
    if source.sha256 != consent.sha256:
        raise ScenarioError(
            f"the file of {code} is not the one that the scenario names by its hash; restore "
            f"that file, or write {code!r} in the scenario again to use the present one",
            path=path,
        )
    check_class(source, code, path, method)
    search_folder = consent.file and _find_import_folder(module, source.file)
    with _searching(search_folder):
        try:
            imported = (
                _execute(module, source) if consent.file else _import(module, source.sha256)
            )
        # The user's code may raise anything.
        except (Exception, SystemExit) as error:
            problem = f"{module} cannot be imported: {type(error).__name__}: {error}"
            raise ScenarioError(problem, path=path) from None
    return getattr(imported, name)


def _find_import_folder(module: str, file: Path) -> Path:
    """Returns the folder from which a module and its neighbours are imported.

    It is the folder of the file, or for a module of a package that of the outermost package.
    """
    depth = module.count(".") + (file.stem == "__init__")
    return file.parents[min(depth, len(file.parents) - 1)]


PAGES = {
    "torque": ("law", "own-controller.md"),
    "act": ("hand", "policies.md"),
    "step": ("plant", "policies.md"),
}
"""The name of a class that has such a method, and the page that describes it."""


def check_class(source: CodeSource, code: str, path: str, method: str = "torque") -> None:
    """Refuses a file that does not define a class with a method.

    The check reads the syntax of the file and runs no code of it.

    Raises:
        ScenarioError: the file is not Python, has no such class, or the class has neither the
            method nor a base class that may have it.
    """
    kind, page = PAGES[method]
    name = code.partition(":")[2]
    classes = parse_classes(source.content, source.file, path)
    if name not in classes:
        hint = suggest_nearest(name, list(classes)) or f"; see {find_page(page)}"
        raise ScenarioError(f"{source.file} defines no class {name}{hint}", path=path)
    node = classes[name]
    identifiers = {getattr(part, "name", getattr(part, "id", "")) for part in ast.walk(node)}
    may_inherit_method = node.bases or node.keywords or node.decorator_list
    if not may_inherit_method and method not in identifiers:
        raise ScenarioError(
            f"{code} is no {kind}: it has no {method}; see {find_page(page)}", path=path
        )


def _import(module: str, sha256: str) -> Any:
    """Returns a module as Python imports it; a file that was edited meanwhile is reloaded."""
    imported = importlib.import_module(module)
    if _imported.setdefault(module, sha256) != sha256:
        imported = importlib.reload(imported)
        _imported[module] = sha256
    return imported


def _execute(module: str, source: CodeSource) -> Any:
    """Returns a module of the content that was checked.

    Python's own import could take a compiled file that lies beside the source.
    """
    if source in _executed:
        return _executed[source]
    file = str(source.file)
    previous_module = sys.modules.get(module)
    spec = spec_from_file_location(module, file, loader=SourceFileLoader(module, file))
    executed = module_from_spec(cast(ModuleSpec, spec))
    sys.modules[module] = executed
    try:
        exec(compile(source.content, file, "exec"), executed.__dict__)
    finally:
        # A log may give its module any name: it must not replace another module for good.
        sys.modules.pop(module, None)
        if previous_module is not None:
            sys.modules[module] = previous_module
    _executed[source] = executed
    return executed


def name_law_class(kind: type) -> str:
    """Returns the name of a class in a scenario, as in "mylaws:Spring".

    Raises:
        ScenarioError: the class is not in a file, or not at the top level of its module.
    """
    module = kind.__module__
    name = kind.__qualname__
    if module == "__main__":
        module = Path(getattr(sys.modules[module], "__file__", None) or "").stem
    if not module or not name.isidentifier():
        raise ScenarioError(
            f"{name} is not a class in a file, so that no log can name it: write it into a "
            "file, in a notebook with %%writefile mylaws.py, and import it from there; see "
            f"{find_page('own-controller.md')}"
        )
    return f"{module}:{name}"


def name_law_classes(value: Any) -> Any:
    """Returns a value of a scenario in plain types.

    A class becomes its name by `name_law_class`, and a number or an array of NumPy a number or
    a list.
    """
    if isinstance(value, type):
        return name_law_class(value)
    if isinstance(value, Mapping):
        return {str(key): name_law_classes(entry) for key, entry in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


@contextmanager
def _searching(folder: Path | None) -> Iterator[None]:
    """Makes Python find modules in a folder before all others, inside the block.

    Args:
        folder: the folder; None: the working directory, unless Python searches it already.
    """
    search_path = str(folder or Path.cwd())
    if folder is None and search_path in sys.path:
        yield
        return
    sys.path.insert(0, search_path)
    # A file may have been written a moment ago.
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(search_path)
