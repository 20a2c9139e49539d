"""The program's own sources: files, rooms, definitions, and which room imports which."""

import ast
import re
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOPS = {
    **dict.fromkeys(("trilat_net", "sites", "recorder"), ROOT),
    "trilat_people": ROOT / "packages" / "trilat-people",
    "trilat_studies": ROOT / "packages" / "trilat-studies",
    "trilat_ros2": ROOT / "packages" / "trilat-ros2",
}
"""The packages of the program, each with the folder in which it lies."""
BELOW_ALL = {
    *("errors", "process", "signals", "workers", "files", "results", "fields", "records"),
    *("recorded_change", "hooks", "entry_points", "package_names", "toml_text"),
}


INTERFACES = (
    "trilat_net.log.ros2",
    "trilat_net.net.ros2",
    *("trilat_net.core", "trilat_net.laws", "trilat_net.own_code", "trilat_net.scenario"),
    *("trilat_net.net", "trilat_net.log", "trilat_net.execution", "trilat_net.analysis"),
    *("trilat_net.presentation", "trilat_net.work", "trilat_net.app", "sites", "recorder"),
)
"""The packages whose `__init__.py` lists in `__all__` what other packages may import.

A package within another one stands before it.
"""
_APP_ROOTS = ("trilat_net", "trilat_net.__main__", "trilat_net.extension")
"""Modules beside the packages that belong to the app."""


def files() -> list[Path]:
    """Returns every source file, tests aside."""
    folders = [parent / top for top, parent in TOPS.items()]
    return sorted(
        path for folder in (*folders, ROOT / "containers") for path in folder.rglob("*.py")
    )


def _dotted_parts(path: Path) -> tuple[str, ...]:
    """Returns the name of a file's module, in parts; the name of a file of no package is its path."""
    parents = [parent for top, parent in TOPS.items() if path.is_relative_to(parent / top)]
    return path.relative_to(*(parents or [ROOT])).with_suffix("").parts


@cache
def tree(path: Path) -> ast.Module:
    """Returns the syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


INNER_ROOMS = {("app", "api"), ("app", "cli"), ("analysis", "theory")}
"""Folders and files of rooms that have rules of their own."""


def room(path: Path) -> str:
    """Returns the room of a file: its top-level folder, or one of those of `trilat_net`."""
    top, *below = _dotted_parts(path)
    if top != "trilat_net":
        return top
    return below[1] if tuple(below[:2]) in INNER_ROOMS else below[0]


def find_package(module: str) -> str | None:
    """Returns the package with an interface to which a module belongs. None if there is none."""
    return next((name for name in INTERFACES if f"{module}.".startswith(f"{name}.")), None)


def find_border(module: str) -> str:
    """Returns the package whose modules a module may import without their interface."""
    if module in _APP_ROOTS:
        return "trilat_net.app"
    return find_package(module) or module.partition(".")[0]


def package_folder(package: str) -> Path:
    """Returns the folder of a package."""
    return TOPS[package.partition(".")[0]].joinpath(*package.split("."))


def list_interface(package: str) -> list[str]:
    """Returns the names in `__all__` of a package."""
    for node in tree(package_folder(package) / "__init__.py").body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            names: list[str] = ast.literal_eval(node.value)
            return names
    return []


def list_registered_hooks() -> Iterator[str]:
    """Yields the names of the functions that packages register in `hooks`."""
    for path in files():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "register_hooks":
                yield from ast.literal_eval(node.args[1])


@cache
def interface_homes(package: str) -> dict[str, str]:
    """Returns the module of each name of an interface, relative to the package.

    The module of a name that is itself a module is that module.
    """
    path = package_folder(package) / "__init__.py"
    homes = {}
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and node.level == 1:
            for alias in node.names:
                inside = ".".join(filter(None, (node.module, alias.name)))
                is_module = find_file((*package.split("."), *inside.split("."))) is not None
                homes[alias.name] = inside if is_module else node.module or ""
    return homes


def assigned_names(path: Path) -> set[str]:
    """Returns the names that the statements at the top of a file define."""
    names = {name for name in definitions(path) if "." not in name}
    for node in tree(path).body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {
                inner.id
                for target in targets
                for inner in ast.walk(target)
                if isinstance(inner, ast.Name)
            }
    return names


def find_file(module: tuple[str, ...]) -> Path | None:
    """Returns the file of a module of the program. None if the module is not of the program."""
    return _module(TOPS[module[0]].joinpath(*module)) if module and module[0] in TOPS else None


def imported_names(path: Path) -> Iterator[tuple[str, ...]]:
    """Yields what a file imports, wherever in it the import stands, as the parts of a dotted name.

    A name that the file imports from an interface is that of the module which defines it.
    """
    for parts in written_imports(path):
        package = ".".join(parts[:-1])
        home = interface_homes(package).get(parts[-1]) if package in INTERFACES else None
        if home is None:
            yield parts
        elif home.rpartition(".")[2] == parts[-1]:
            yield (*parts[:-1], *home.split("."))
        else:
            yield (*parts[:-1], *home.split("."), parts[-1])


def written_imports(path: Path) -> Iterator[tuple[str, ...]]:
    """Yields what a file imports, as `imported_names` does, with the modules that the file names."""
    package = _dotted_parts(path)[:-1]
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            parts = (*base, *(node.module or "").split(".")) if node.module else base
            yield from ((*parts, alias.name) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (tuple(alias.name.split(".")) for alias in node.names)


def _imported(path: Path) -> Iterator[Path]:
    """Yields the files of this program that a file imports."""
    for name in imported_names(path):
        found = find_file(name) or find_file(name[:-1])
        if found is not None:
            yield found


def _module(at: Path) -> Path | None:
    if at.with_suffix(".py").is_file():
        return at.with_suffix(".py")
    return at / "__init__.py" if (at / "__init__.py").is_file() else None


def room_imports() -> set[tuple[str, str]]:
    """Returns which room imports which, without rooms below all others, and interfaces."""
    paths = [path for path in files() if dotted(path) not in INTERFACES]
    pairs = {(room(path), room(other)) for path in paths for other in _imported(path)}
    return {
        (a, b)
        for a, b in pairs
        if a != b and not {a, b} & (BELOW_ALL | {"__init__", "__main__"})
    }


def definitions(path: Path) -> set[str]:
    """Returns the classes and functions of a file, those of classes as `Class.method`."""
    names = set()
    for node in tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {
                f"{node.name}.{below.name}"
                for below in node.body
                if isinstance(below, ast.FunctionDef)
            }
    return names


@cache
def layers() -> dict[str, int]:
    """Returns the height of each layer that pyproject.toml lists, by its dotted name; the lowest has 0."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    rows = project["tool"]["importlinter"]["contracts"][0]["layers"]
    return {
        name: height
        for height, row in enumerate(reversed(rows))
        for name in re.findall(r"[\w.]+", row)
    }


def dotted(path: Path) -> str:
    return ".".join(_dotted_parts(path)).removesuffix(".__init__")


@cache
def heights() -> dict[str, int]:
    """Returns the height of the layer of each module, by its dotted name; some belong to no layer."""
    levels = {}
    for path in files():
        parts = dotted(path).split(".")
        names = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
        layer = next((name for name in names if name in layers()), None)
        if layer is not None:
            levels[".".join(parts)] = layers()[layer]
    return levels


@cache
def class_heights() -> dict[str, int]:
    """Returns the height of the lowest layer that defines a class, by the name of the class."""
    levels: dict[str, int] = {}
    for path in files():
        height = heights().get(dotted(path))
        for node in tree(path).body:
            if isinstance(node, ast.ClassDef) and height is not None:
                levels[node.name] = min(height, levels.get(node.name, height))
    return levels


def strings(path: Path) -> Iterator[str]:
    """Yields the strings of a file, also those in f-strings, but neither its docstrings nor `__all__`."""
    statements = {id(node.value) for node in ast.walk(tree(path)) if isinstance(node, ast.Expr)}
    for node in tree(path).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            statements |= {id(inner) for inner in ast.walk(node.value)}
    for node in ast.walk(tree(path)):
        match node:
            case ast.Constant(value=str(text)) if id(node) not in statements:
                yield text


def names_from_above(path: Path) -> set[str]:
    """Returns the strings of a file that name a module or a class of a layer above its own.

    A module is named by its dotted name, or by the end of one, as in f"{__package__}.analysis.judge".
    """
    height = heights().get(dotted(path))
    if height is None:
        return set()
    names = set()
    for text in strings(path):
        for name in re.findall(r"\w*(?:\.\w+)+", text):
            modules = (name, f"trilat_net.{name.strip('.')}")
            if any(heights().get(module, 0) > height for module in modules):
                names.add(text)
        if class_heights().get(text, 0) > height:
            names.add(text)
    return names


def unused_methods() -> set[str]:
    """Returns the methods that nothing refers to, as "Class.method".

    An override whose method of the base class was renamed shows here: nobody calls its old name. Methods that
    a library calls, and those that only the documentation names, count as referred to if their name stands in
    the documentation.
    """
    references = set(
        re.findall(
            r"\w+", "".join(path.read_text("utf-8") for path in (ROOT / "docs").rglob("*.md"))
        )
    )
    methods = set()
    folders = (
        "trilat_net",
        "sites",
        "recorder",
        "packages",
        "containers",
        "tests",
        "benchmarks",
        "examples",
        "docs",
    )
    for path in sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(tree(path)):
            match node:
                case ast.Attribute(attr=name) | ast.Name(id=name) | ast.alias(name=name):
                    references.add(name)
                case ast.keyword(arg=str(name)):
                    references.add(name)
                case ast.Constant(value=str(name)):
                    references.add(name)
                case ast.ClassDef() if "tests" not in path.relative_to(ROOT).parts:
                    methods |= {
                        (node.name, method.name)
                        for method in node.body
                        if isinstance(method, ast.FunctionDef)
                    }
    return {
        f"{owner}.{name}"
        for owner, name in methods
        if name not in references and not name.startswith("__")
    }


def list_test_names() -> Iterator[tuple[Path, str]]:
    """Yields the name of every test of the program and its packages, with the file of the test."""
    for folder in (ROOT / "tests", *sorted(ROOT.glob("packages/*/tests"))):
        for path in sorted(folder.rglob("test_*.py")):
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                    yield path.relative_to(ROOT), node.name
