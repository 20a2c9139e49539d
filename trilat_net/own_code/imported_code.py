"""Imports user-written classes, once a person has permitted them.

A scenario names a class by its module and its name, for example `law = "package.module:Law"`.
Importing a module runs its code, and a scenario may have an unknown author, so a person must
permit the code first. A permission applies to one class in one file, which is identified by its
SHA-256 hash.

Invariant:
    - A scenario contains the hash of the file that defines a class. If a run is repeated from
      its log, the hash shows whether the code is still the code that ran.
    - Looking up a class by its name runs no code, not even that of the enclosing packages.
    - `CodeKey.import_class` is the only way to run user-written code. It imports a class only
      if `allowed_code` contains a permission, and if the file still has the permitted hash and
      defines a class of that name.
    - A permission includes the arguments of the class, because code that is harmless with some
      arguments may do harm with others, for example if an argument is the name of a file to
      overwrite.
"""

import ast
import hashlib
import importlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, cast

from msgspec import Meta, field

from ..core import LawContext, UserLaw, UserLawFactory
from ..errors import CodeWithheld, ScenarioError, describe_exception, suggest_nearest
from ..files import find_page, open_regular
from ..laws import LawSettings, SentVectorSpecs, convert_sends
from .class_arguments import list_default_arguments, make_own_instance
from .sent_channel import parse_classes

CLASS_PATTERN = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"

_imported: dict[str, str] = {}
"""Maps each module that Python's import system has loaded to the hash that its file had then.
"""


Watch = Callable[[int, Callable[[], Any]], Any]
"""Function that calls user-written code and returns its result, for example with a time limit.

Its arguments are the tick and the call, a function without arguments.
"""


def call_directly(_k: int, function: Callable[[], Any]) -> Any:
    """Calls user-written code without a time limit.

    In a live session, user-written code must not delay the control loop, so calls to it are
    monitored by a `Watch`. In virtual time, where no other process waits for the result, this
    function takes its place.

    Args:
        _k: Tick in which the call is made. Not used.
        function: Function without arguments that makes the call.

    Returns:
        The result of the function.
    """
    return function()


class NamedCode(Protocol):
    """Protocol for an entry of a scenario that names a user-written class.

    The class is a control law, an operator (a program that moves an arm) or a plant (a program
    that computes the motion of an arm).

    Attributes:
        method: Method that the class must have.
    """

    method: ClassVar[str]

    @property
    def code(self) -> str:
        """Module and name of the user's class, for example "package.module:Law"."""

    @property
    def source_sha256(self) -> str:
        """SHA-256 hash of the module's file, which shows whether the file has changed."""

    @property
    def settings(self) -> dict[str, Any]:
        """Maps the names of the constructor arguments of the user's class to their values."""


class _SiteWithCode(Protocol):
    """Protocol for the part of a scenario that describes one arm and its user-written classes.

    These are its control law, the programs that move the arm, and the model of the arm. The
    permission checks search here for user-written classes, without importing the scenario's
    types.
    """

    @property
    def control(self) -> Any:
        """Control law of the arm, possibly a user-written class."""

    @property
    def hands(self) -> Sequence[Any]:
        """People and programs that move the arm. A program may be a user-written class."""

    @property
    def plant(self) -> Any:
        """The plant that computes or measures the arm's motion, possibly a user's class."""


class ScenarioWithCode(Protocol):
    """Protocol for a scenario that may name user-written classes.

    Lists only the attributes that the permission checks need.
    """

    @property
    def sites(self) -> Mapping[str, _SiteWithCode]:
        """Maps the name of each site to its description."""


ANY_SETTINGS = "*"
"""Replaces the arguments of a class in a permission that applies to all arguments.

Only the worker processes of a study receive such a permission, because a study varies the
arguments itself.
"""


class CodeKey(NamedTuple):
    """Identifies user-written code by its class, the hash of its file and its arguments.

    A person's permission to run the code is stored under this key. If the file or an argument
    changes, the permission no longer applies.

    Attributes:
        code: Module and class, for example "package.module:Law".
        sha256: SHA-256 hash of the file, as stated in the scenario.
        settings: Arguments of the class as a JSON string with sorted keys, or `ANY_SETTINGS`.
    """

    code: str
    sha256: str
    settings: str

    @classmethod
    def of(cls, named: NamedCode) -> "CodeKey":
        """Returns the key under which the permission to run a user's class is stored.

        The key consists of the class, the hash of its file and its arguments.

        Args:
            named: Entry of a scenario that names the class: a control law, an operator or a
                plant.
        """
        return cls(
            named.code,
            named.source_sha256,
            json.dumps(named.settings, sort_keys=True, default=str),
        )

    def find_consent(self) -> "CodeConsent | None":
        """Returns the permission that lets a user's class run with its arguments.

        Returns:
            The permission, or None if nobody has permitted the class, its current file or its
            arguments.
        """
        return allowed_code.get(self) or allowed_code.get(self._replace(settings=ANY_SETTINGS))

    def describe_new_settings(self) -> str:
        """Explains why a user's class that was permitted before is rejected with new arguments.

        A permission applies only to certain arguments of a class. The explanation states how
        the arguments of the rejected code differ from permitted ones. If several sets of
        arguments were permitted, the one with the fewest differences is used.

        Returns:
            Part of a sentence. Empty if the code was not permitted with other arguments.
        """
        allowed_settings = {
            allowed.settings
            for allowed in allowed_code
            if (allowed.code, allowed.sha256) == (self.code, self.sha256)
            and allowed.settings != ANY_SETTINGS
        }
        # Permissions that a person has stored permanently count as well.
        class_name = self.code.partition(":")[2]
        allowed_settings |= set(remembered_settings.get((self.sha256, class_name), ()))

        settings = json.loads(self.settings)
        differences = [
            _list_differences(json.loads(text), settings) for text in sorted(allowed_settings)
        ]
        smallest_difference = min(differences, key=len, default=[])
        if not smallest_difference:
            return ""
        return f"it was allowed with other settings, but here {', '.join(smallest_difference)}"

    def import_class(self, path: str, method: str = "torque") -> Any:
        """Imports a user's class from its permitted file.

        Before any code of the file runs, this method checks that the file is the one that the
        user permitted.

        Args:
            path: Path of the key in the scenario, for error messages.
            method: Method that the class must have.

        Raises:
            CodeWithheld: There is no permission.
            ScenarioError: The file differs from the permitted one, or does not define the class
                or its method, in which case none of its code has run. Also raised if the code
                raises an error while it is imported.
        """
        code = self.code
        module, _, name = code.partition(":")
        consent = self.find_consent()
        if consent is None:
            difference = self.describe_new_settings()
            reason = f" ({difference})" if difference else ""
            raise CodeWithheld(
                f"{code} is external code, which may not run{reason}: allow its file with "
                "--law FILE (in Python: tn.open_log(..., law=FILE))",
                path=path,
            )

        source = read_code(code, path, consent.file)
        if source.sha256 != consent.sha256:
            raise ScenarioError(
                f"the file of {code} has changed: its hash is not the permitted one; restore "
                f"the file, or write {code!r} in the scenario again to use the present file",
                path=path,
            )
        source.check_class(code, path, method)

        search_folder = None
        if consent.file is not None:
            search_folder = _find_import_folder(module, source.file)
        with _searching(search_folder):
            try:
                if consent.file is not None:
                    imported = _execute(module, source)
                else:
                    imported = _import(module, source.sha256)
            # The user's code may raise any exception.
            except (Exception, SystemExit) as error:
                problem = f"{module} cannot be imported: {describe_exception(error)}"
                raise ScenarioError(problem, path=path) from None
        return getattr(imported, name)


class CodeConsent(NamedTuple):
    """Permission by a person to run the code of one Python file that a scenario names.

    Attributes:
        file: Path of the file. If None, the file that Python's import system finds for the
            module.
        sha256: SHA-256 hash that the file must have for the permission to apply.
    """

    file: Path | None
    sha256: str


CodeConsents = dict[CodeKey, CodeConsent]
allowed_code: CodeConsents = {}
"""Permissions for this process. Worker processes receive a copy."""
remembered_settings: dict[tuple[str, str], list[str]] = {}
"""Arguments that were permitted in earlier sessions, as the JSON strings of `CodeKey.settings`.

The keys are the hash of the file and the name of the class. The strings only serve to explain
what differs if code is rejected. They permit nothing.
"""


@contextmanager
def allowing_any_settings(allowed: CodeConsents) -> Iterator[None]:
    """Permits code to run with any arguments, inside the `with` block.

    Normally, a permission applies only to certain arguments of a class. A parameter study
    varies the arguments itself, so it needs a wider permission.

    Args:
        allowed: Permissions for the code under study.
    """
    widened_permissions = {
        key._replace(settings=ANY_SETTINGS): consent for key, consent in allowed.items()
    }
    added_permissions = {
        key: consent for key, consent in widened_permissions.items() if key not in allowed_code
    }
    allowed_code.update(added_permissions)
    try:
        yield
    finally:
        for key in added_permissions:
            allowed_code.pop(key, None)


def _list_differences(
    old_settings: Mapping[str, Any], new_settings: Mapping[str, Any]
) -> list[str]:
    """Returns one string per argument whose value differs, such as "gain = 5 (was 3)".

    An argument that is missing from one of the two sets has its default value there.
    """
    old_texts = {key: describe_setting(value) for key, value in old_settings.items()}
    new_texts = {key: describe_setting(value) for key, value in new_settings.items()}
    differences = []
    for key in sorted({*old_texts, *new_texts}):
        old_text = old_texts.get(key, "its default")
        new_text = new_texts.get(key, "its default")
        if old_texts.get(key) != new_texts.get(key):
            differences.append(f"{key} = {new_text} (was {old_text})")
    return differences


LONGEST_SETTING = 300
"""Maximum length up to which an argument is shown completely. Paths are usually shorter."""


def describe_setting(value: Any) -> str:
    """Returns the value of an argument as a string for messages.

    The string is JSON, which contains no control characters. A long string is shortened in the
    middle, because file paths differ at their ends.

    Args:
        value: Value of the argument, of any type that JSON supports.
    """
    text = json.dumps(value, default=str)
    if len(text) <= LONGEST_SETTING:
        return text
    half = LONGEST_SETTING // 2
    return f"{text[:half]} ... {text[-half:]} ({len(text)} characters)"


_executed: dict["_CodeSource", Any] = {}
"""Maps each file that a person named, with its content, to the module executed from it."""


class ImportedLaw(LawSettings, frozen=True, tag_field="law", tag="own"):
    """Control law of a scenario that is implemented by a user-written Python class.

    The scenario names the class and the hash of its file. The class is not imported when the
    scenario is read, so a scenario from an unknown author can be read without running its code.

    Attributes:
        code: Module and class, for example "package.module:Law".
        source_sha256: SHA-256 hash of the module's file.
        settings: Maps the names of the class's arguments to their values.
        sends: Vectors that the law sends to its peers, as declared by the class.
    """

    method: ClassVar[str] = "torque"

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)
    sends: SentVectorSpecs = field(default_factory=dict)

    def read_default_settings(self) -> dict[str, Any]:
        """Returns the default values of the arguments that the scenario may omit.

        They are read from the file of the law, which is not run. A default that is not a
        literal is returned as its Python source text.

        Returns:
            Maps the name of each argument to its default. Empty if the file is missing, has
            changed since the scenario was made, or does not define the arguments.
        """
        try:
            source = read_code(self.code, "control.law")
        except ScenarioError:
            return {}
        if source.sha256 != self.source_sha256:
            return {}
        return list_default_arguments(source.content, self.code.partition(":")[2])

    def build_factory(self, sites: int, scheme: str) -> UserLawFactory:
        """Returns a function that creates the control law for a site.

        The user's class is imported only when the returned function is called.

        Args:
            sites: Number of sites in the scenario.
            scheme: Integration scheme of the scenario.
        """

        def make(context: LawContext) -> UserLaw:
            path = f"sites.{context.site}.control"
            kind = CodeKey.of(self).import_class(f"{path}.law")
            # The class is checked before any of its code is called.
            self.check_class(
                kind=kind, code=self.code, context=context, sites=sites, scheme=scheme
            )
            declared = convert_sends(getattr(kind, "sends", {}), self.code, path)
            # The order is compared too, because it is the order of the vectors in a message.
            if list(declared.items()) != list(self.sends.items()):
                raise ScenarioError(
                    f"{self.code} sends different vectors from those in the scenario: define "
                    "`sends` explicitly in the body of the class, and set law = "
                    f"{self.code!r} again so that the scenario is updated",
                    path=f"{path}.sends",
                )
            law: UserLaw = make_own_instance(kind, self.code, context, self.settings, path)
            return law

        return make


class _CodeSource(NamedTuple):
    """Python file that defines a user's class, as read from disk.

    The content is stored, so that exactly the checked text is run.

    Attributes:
        file: Path of the file.
        content: Content of the file.
        sha256: SHA-256 hash of the content.
    """

    file: Path
    content: bytes
    sha256: str

    def check_class(self, code: str, path: str, method: str = "torque") -> None:
        """Raises ScenarioError unless the file defines a given class with a given method.

        The file is parsed but not run, because the code may not have been permitted yet.

        Args:
            code: Module and class, for example "package.module:Law".
            path: Path of the key in the scenario, for error messages.
            method: Method that the class must have.

        Raises:
            ScenarioError: The file is not valid Python, has no such class, or the class has
                neither the method nor a base class or decorator that may add it.
        """
        kind, page = PAGES[method]
        name = code.partition(":")[2]
        classes = parse_classes(self.content, self.file, path)
        if name not in classes:
            hint = suggest_nearest(name, list(classes)) or f"; see {find_page(page)}"
            raise ScenarioError(f"{self.file} defines no class {name}{hint}", path=path)
        class_node = classes[name]
        used_names = {
            getattr(syntax_node, "name", getattr(syntax_node, "id", ""))
            for syntax_node in ast.walk(class_node)
        }
        may_inherit_method = (
            class_node.bases or class_node.keywords or class_node.decorator_list
        )
        if not may_inherit_method and method not in used_names:
            raise ScenarioError(
                f"{code} is not a {kind}: the class has no {method}; see {find_page(page)}",
                path=path,
            )


def read_code(code: str, path: str, file: Path | None = None) -> _CodeSource:
    """Reads the file that defines a class, without running any of its code.

    The hash of the file determines whether a permission applies to it.

    Args:
        code: Module and class, for example "package.module:Law".
        path: Path of the key in the scenario, for error messages.
        file: Path of the file. If None, the file that Python's import system finds for the
            module.

    Raises:
        ScenarioError: There is no such file, or it cannot be read.
    """
    source_file = file or _find_file(code, path)
    try:
        with open_regular(source_file) as stream:
            content = stream.read()
    except OSError as error:
        raise ScenarioError(
            f"{source_file} cannot be read: {error.strerror}", path=path
        ) from None
    return _CodeSource(source_file, content, hashlib.sha256(content).hexdigest())


def _find_file(code: str, path: str) -> Path:
    """Returns the file from which Python would import the module of a user's class.

    Raises:
        ScenarioError: There is no such module, or it is not a file.
    """
    module, _, name = code.partition(":")
    with _searching(None):
        spec = _find_spec(module)
    if spec is None and module.endswith(".py"):
        raise ScenarioError(
            f"is {code!r}, but must name the module, not its file: "
            f"{module.removesuffix('.py')}:{name}",
            path=path,
        )
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ScenarioError(
            f"the module {module}, which {code} names, was not found; install the module, or "
            "run the command in its folder (folders on PYTHONPATH are searched too)",
            path=path,
        )
    return Path(spec.origin)


def _find_spec(module: str) -> ModuleSpec | None:
    """Finds a module in the same way as an import does, but without importing its packages.

    Only Python's path finder and the finders of editable installations are used. Other finders
    may run code: that of `distutils` imports the nearest setuptools.

    Args:
        module: Name of the module, with dots.

    Returns:
        The spec of the module, which contains its file, or None if it is not found.
    """
    finders = [
        finder
        for finder in sys.meta_path
        if finder is PathFinder or finder.__module__.startswith("__editable__")
    ]

    # The enclosing packages of the module are looked up first, starting with the outermost.
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
        is_package = search_folders is not None
        if not is_package and name != module:
            return None
    return spec


def _find_import_folder(module: str, file: Path) -> Path:
    """Returns the folder that must be on Python's search path to import a module from a file.

    For a plain module, this is the folder of the file. For a module in packages, it is the
    folder that contains the outermost package.
    """
    depth = module.count(".") + (file.stem == "__init__")
    return file.parents[min(depth, len(file.parents) - 1)]


PAGES = {
    "torque": ("law", "own-controller.md"),
    "act": ("hand", "policies.md"),
    "step": ("plant", "own-plant.md"),
}
"""Maps each required method to the name of the kind of class that has it, and its documentation
page.
"""


def _import(module: str, sha256: str) -> Any:
    """Imports a module in Python's usual way, reloading it if its file has changed.

    In a notebook, for example, a user may edit a control law and simulate it again.

    Args:
        module: Name of the module.
        sha256: Current hash of its file.
    """
    imported = importlib.import_module(module)
    if _imported.setdefault(module, sha256) != sha256:
        imported = importlib.reload(imported)
        _imported[module] = sha256
    return imported


def _execute(module: str, source: _CodeSource) -> Any:
    """Executes the content of a file as a module, and returns the module.

    Exactly the content that was checked is executed. Python's own import might read the file
    again, or load a compiled version of it from `__pycache__`.

    Args:
        module: Name for the module.
        source: The file and its content.
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
        # A log may give its module any name, so the module must not permanently replace another
        # one.
        sys.modules.pop(module, None)
        if previous_module is not None:
            sys.modules[module] = previous_module
    _executed[source] = executed
    return executed


def _name_law_class(kind: type) -> str:
    """Returns the name by which a scenario refers to a user's class.

    For example, the class Spring in the file mylaws.py has the name "mylaws:Spring".

    Args:
        kind: The class.

    Raises:
        ScenarioError: The class is not defined in a file, or not at the top level of its
            module.
    """
    module = kind.__module__
    name = kind.__qualname__
    if module == "__main__":
        # Python calls the running script `__main__`; a scenario names its module by the file.
        module = Path(getattr(sys.modules[module], "__file__", None) or "").stem
    if not module or not name.isidentifier():
        raise ScenarioError(
            f"{name} is not defined in a file, so a log cannot refer to it: write the "
            "class to a file (in a notebook, with %%writefile mylaws.py) and import it from "
            f"there; see {find_page('own-controller.md')}"
        )
    return f"{module}:{name}"


def name_law_classes(value: Any) -> Any:
    """Converts a value passed by a Python program to types that TOML supports.

    A user's class becomes its name (see `_name_law_class`), and a NumPy number or array becomes
    a number or a list. Tables are converted entry by entry. Other values are returned
    unchanged.

    Args:
        value: Value for a scenario.
    """
    if isinstance(value, type):
        return _name_law_class(value)
    if isinstance(value, Mapping):
        return {str(key): name_law_classes(entry) for key, entry in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value


@contextmanager
def _searching(folder: Path | None) -> Iterator[None]:
    """Makes Python search one folder for modules before all others, inside the `with` block.

    This lets a user's class import other files from the folder of its own file.

    Args:
        folder: The folder. If None, the working directory, unless Python already searches it.
    """
    search_path = str(folder or Path.cwd())
    if folder is None and search_path in sys.path:
        yield
        return
    sys.path.insert(0, search_path)
    # A file may have been written a moment ago, after Python read the contents of the folder.
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(search_path)
