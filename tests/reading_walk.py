"""Two walks of a reader through the source, counted: stays, returns and climbs.

    python -m tests.reading_walk

One walk leads from `certify` to the judgement. The reader begins in `certify` and, because it
decides the exit code, in `Certificate.accepts`, and follows the calls into the folder `analysis`.
The other walk leads from the tables of a scenario file to a complete scenario. The reader
begins in `resolve_scenario`, and follows the calls into the modules that check and complete
tables (`TABLE_MODULES`). Modules that read other files, word errors or check single values
are passed by.

The reader follows the calls of a body in their order, depth first, and reads each function once.

- The reader passes by functions and properties that measure: their annotated results are
  numbers alone (arrays, floats, whole numbers, statements of a scenario or a log, or records
  and mappings of these with names), and their docstrings state meaning and unit. The calls of
  such a function are followed.
- The reader STAYS in every other function, method or property: its result is a truth value, a
  word, a sentence, or contains one.
- The reader RETURNS from a stay if the calling body decides on its result: the call, or a name
  that holds its result, stands in a condition (if, while, assert, and, or, filter of a
  comprehension). A table of functions (a tuple at the top of a module) counts as one return,
  however many functions it holds: the first that applies decides, or all are taken.
- The reader CLIMBS to a stay that stands in its file above a stay that was read before.

Methods and properties are those of the classes of an expression or of its elements, by the
annotations of arguments, fields and results. Expressions of unknown class are not followed.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from . import house

ROOMS = ("analysis",)
NUMBERS = {
    "Array",
    "RowArray",
    "Bools",
    "Ints",
    "Numbers",
    "NDArray",
    "float",
    "int",
    "None",
    "str",
    "np",
    "bool_",
    "int64",
}
NUMBERS |= {"tuple", "list", "dict", "Sequence", "Mapping", "Iterator", "slice", "Rows"}
CERTIFICATE = house.ROOT / "trilat_net/analysis/certificate"
SCENARIO = house.ROOT / "trilat_net/scenario"
TABLE_MODULES = [
    SCENARIO / f"{name}.py"
    for name in ("resolve", "written_tables", "site_tables", "link_tables")
]
"""Modules that the tables of a scenario file pass on their way to a complete scenario."""


class Place(NamedTuple):
    """A function or class, `Class.method`, of a module."""

    module: Path
    name: str


class Walk(NamedTuple):
    """The functions at which a reader stays, in order, and those from which the reader returns
    to decide.
    """

    stays: list[Place]
    returns: list[Place]

    @property
    def climbs(self) -> list[Place]:
        """Functions that stand in their file above a function that was read before."""
        climbs = []
        deepest_lines: dict[Path, int] = {}
        for place in self.stays:
            definition = _definition(place)
            assert definition is not None, place
            deepest_line = deepest_lines.get(place.module, 0)
            if definition.lineno < deepest_line:
                climbs.append(place)
            deepest_lines[place.module] = max(definition.lineno, deepest_line)
        return climbs

    def print(self) -> None:
        """Prints the functions in the order of the walk, and how many there are."""
        for place in self.stays:
            mark = "<- " if place in self.returns else "   "
            print(f"{mark}{place.module.stem}: {place.name}")
        print(
            f"{len(self.stays)} stays, {len(self.returns)} returns, {len(self.climbs)} climbs"
        )


@cache
def _module_names(path: Path) -> dict[str, Place | Path | ast.expr]:
    """Returns the meanings of the names at the top of a module: definitions, modules, values."""
    names: dict[str, Place | Path | ast.expr] = {}
    for node in house.tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names[node.name] = Place(path, node.name)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            names[node.targets[0].id] = node.value
        elif isinstance(node, ast.ImportFrom) and node.level:
            base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            package = ".".join(base.relative_to(house.ROOT).parts)
            homes = house.interface_homes(package) if package in house.INTERFACES else {}
            for alias in node.names:
                if alias.name in homes:
                    home = house.find_file((*package.split("."), *homes[alias.name].split(".")))
                    if home is not None:
                        is_module = home.stem == alias.name
                        place = home if is_module else Place(home, alias.name)
                        names[alias.asname or alias.name] = place
                    continue
                inside = (base / alias.name).with_suffix(".py")
                module = base.with_suffix(".py")
                if module.is_file() or inside.is_file():
                    names[alias.asname or alias.name] = (
                        Place(module, alias.name) if module.is_file() else inside
                    )
    return names


@cache
def _definition(definition: Place) -> ast.FunctionDef | ast.ClassDef | None:
    head, _, method = definition.name.partition(".")
    body = house.tree(definition.module).body
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == head:
            inside = [
                n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == method
            ]
            return node if not method else next(iter(inside), None)
    return None


def _names_in(node: ast.AST) -> Iterator[str]:
    for below in ast.walk(node):
        if isinstance(below, ast.Name):
            yield below.id
        elif isinstance(below, ast.Constant) and isinstance(below.value, str):
            # an annotation in quotes, as a class method of a result has
            yield from re.findall(r"\w+", below.value)


def _resolve(path: Path, name: str) -> list[Place]:
    """Returns the definitions behind a name of a module, through aliases and tables."""
    binding = _module_names(path).get(name)
    if isinstance(binding, ast.expr):
        return [
            place
            for inner in _names_in(binding)
            if inner != name
            for place in _resolve(path, inner)
        ]
    if not isinstance(binding, Place):
        return []
    return (
        [binding]
        if _definition(binding) or binding.module == path
        else _resolve(binding.module, binding.name)
    )


def _fields(node: ast.ClassDef) -> list[ast.AnnAssign]:
    return [below for below in node.body if isinstance(below, ast.AnnAssign)]


@cache
def _is_numbers(path: Path, name: str) -> bool:
    """True for a type of numbers: one of `NUMBERS`, or a class all of whose fields have such
    types.
    """
    if name in NUMBERS:
        return True
    alias = _module_names(path).get(name)
    if isinstance(alias, ast.expr):
        # a type that has a name of its own, such as the key of a mapping
        return all(_is_numbers(path, inner) for inner in _names_in(alias) if inner != name)
    places = _resolve(path, name)
    for place in places:
        node = _definition(place)
        if not _in_rooms(place):
            continue
        if not isinstance(node, ast.ClassDef) or not _fields(node):
            return False
        for field in _fields(node):
            if not all(
                _is_numbers(place.module, inner) for inner in _names_in(field.annotation)
            ):
                return False
    return bool(places)


@cache
def _measures(definition: Place) -> bool:
    """True for a function that returns numbers alone; names may be keys of a mapping, or fields
    of a record.
    """
    node = _definition(definition)
    if not isinstance(node, ast.FunctionDef) or node.returns is None:
        return True
    names = list(_names_in(node.returns))
    keyed = names[:1] in (["dict"], ["Mapping"])
    texts = "str" in names and not keyed
    return not texts and all(_is_numbers(definition.module, name) for name in names)


def _conditions(node: ast.AST) -> Iterator[ast.AST]:
    for below in ast.walk(node):
        if isinstance(below, ast.If | ast.IfExp | ast.While | ast.Assert):
            yield below.test
        elif isinstance(below, ast.comprehension):
            yield from below.ifs
        elif isinstance(below, ast.BoolOp):
            yield from below.values


def _decided(function: ast.FunctionDef) -> set[ast.AST]:
    """Yields the expressions of a body on which the body decides."""
    tested = {inner for test in _conditions(function) for inner in ast.walk(test)}
    names = {node.id for node in tested if isinstance(node, ast.Name)}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.NamedExpr):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if names & {name for target in targets for name in _names_in(target)}:
                tested |= set(ast.walk(node.value))
    return tested


class _Body:
    """A body, and the classes of its names and expressions, or of their elements."""

    def __init__(self, place: Place) -> None:
        function = _definition(place)
        assert isinstance(function, ast.FunctionDef), place
        self.place, self.function, self.names = place, function, dict[str, set[Place]]()
        given = function.args
        for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs):
            if argument.annotation is not None:
                self.names[argument.arg] = _classes_in(place.module, argument.annotation)
        if "." in place.name and given.args:
            self.names[given.args[0].arg] = {place._replace(name=place.name.partition(".")[0])}
        for _ in range(2):  # names may be given below where they stand
            for node in ast.walk(function):
                self._give(node)

    def _give(self, node: ast.AST) -> None:
        pairs = (
            [(node.target, node.iter)] if isinstance(node, ast.For | ast.comprehension) else []
        )
        pairs += (
            [(target, node.value) for target in node.targets]
            if isinstance(node, ast.Assign)
            else []
        )
        pairs += [(node.target, node.value)] if isinstance(node, ast.NamedExpr) else []
        for target, value in pairs:
            for name in ast.walk(target):
                if isinstance(name, ast.Name):
                    self.names.setdefault(name.id, set()).update(self.classes(value))

    def classes(self, node: ast.AST) -> set[Place]:
        """Returns the classes of an expression, or of its elements."""
        module = self.place.module
        if isinstance(node, ast.Name) and node.id in self.names:
            return self.names[node.id]
        if isinstance(node, ast.Name):
            return {
                place
                for place in _resolve(module, node.id)
                if isinstance(_definition(place), ast.ClassDef)
            }
        if isinstance(node, ast.Attribute):
            owners = self.classes(node.value)
            members = [_member(owner, node.attr) for owner in owners]
            known = [(one.module, part) for one, part in members if part is not None]
            return (
                {c for path, part in known for c in _classes_in(path, part)}
                if known
                else owners
            )
        if isinstance(node, ast.Call):
            results = [
                (place.module, _definition(place).returns) for place in self.called(node.func)
            ]  # type: ignore[union-attr]
            classes = {c for path, part in results if part for c in _classes_in(path, part)}
            return (
                classes
                or self.classes(node.func)
                or {c for inner in node.args for c in self.classes(inner)}
            )
        below = ast.iter_child_nodes(node)
        return (
            {c for inner in below for c in self.classes(inner)}
            if isinstance(node, ast.expr)
            else set()
        )

    def called(self, node: ast.AST) -> list[Place]:
        """The functions, methods and properties of the rooms that an expression leads to."""
        places: list[Place] = []
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Load)
            and node.id not in self.names
        ):
            places = _resolve(self.place.module, node.id)
        elif isinstance(node, ast.Attribute):
            above = _module_names(self.place.module).get(getattr(node.value, "id", ""))
            owners = sorted(self.classes(node.value))
            places = [_member(owner, node.attr)[0] for owner in owners]
            places = [Place(above, node.attr)] if isinstance(above, Path) else places
        return [
            place
            for place in places
            if isinstance(_definition(place), ast.FunctionDef) and _in_rooms(place)
        ]


def _in_rooms(definition: Place) -> bool:
    part = definition.module.relative_to(house.ROOT).parts[1]
    return part in ROOMS or definition.module in TABLE_MODULES


@cache
def _member(owner: Place, name: str) -> tuple[Place, ast.expr | None]:
    """Returns a method or field of a class or of its bases, and the type of its value."""
    node, member_place = _definition(owner), owner._replace(name=f"{owner.name}.{name}")
    method = _definition(member_place)
    if isinstance(method, ast.FunctionDef):
        return member_place, method.returns
    for field in _fields(node) if isinstance(node, ast.ClassDef) else ():
        if isinstance(field.target, ast.Name) and field.target.id == name:
            return member_place, field.annotation
    for base in node.bases if isinstance(node, ast.ClassDef) else ():
        for base_class in _classes_in(owner.module, base) - {owner}:
            found = _member(base_class, name)
            if found[1] is not None:
                return found
    return member_place, None


def _classes_in(path: Path, part: ast.expr) -> set[Place]:
    """The classes that an annotation names."""
    definitions = {
        definition for name in _names_in(part) for definition in _resolve(path, name)
    }
    return {place for place in definitions if isinstance(_definition(place), ast.ClassDef)}


def _in_order(node: ast.AST) -> Iterator[ast.AST]:
    for below in ast.iter_child_nodes(node):
        yield from _in_order(below)
    yield node


def walk(*starts: Place) -> Walk:
    """Returns the walk from some functions."""
    seen, stays, returns = set(starts), list(starts), []

    def read(definition: Place) -> None:
        body = _Body(definition)
        decided = _decided(body.function)
        for node in (
            inner for statement in body.function.body for inner in _in_order(statement)
        ):
            new = [one for one in body.called(node) if one not in seen]
            seen.update(new)
            judging = [one for one in new if not _measures(one)]
            stays.extend(judging)
            table = len(new) > 1 and isinstance(node, ast.Name)
            returns.extend(judging[:1] if table else judging if node in decided else [])
            for one in new:
                read(one)

    for start in starts:
        read(start)
    return Walk(stays, returns)


def walk_to_judgement() -> Walk:
    """Returns the walk from a log to the exit code of `trilat certify`."""
    return walk(
        Place(CERTIFICATE / "stability_certificate.py", "Certificate.of_log"),
        Place(CERTIFICATE / "stability_certificate.py", "Certificate.accepts"),
    )


def walk_to_scenario() -> Walk:
    """Returns the walk from the tables of a scenario file to the complete scenario."""
    return walk(Place(SCENARIO / "resolve.py", "resolve_scenario"))


if __name__ == "__main__":
    walk_to_judgement().print()
    walk_to_scenario().print()
