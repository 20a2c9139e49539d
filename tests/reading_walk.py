"""How far a reader walks from `certify` to the judgement, counted in the source: stays and returns.

    python -m tests.reading_walk

He begins in `certify` and, as that decides the exit code, in `Certificate.accepts`. He follows the calls of a
body in the order in which they stand, depth first, into the room `analysis`, and reads
everything once.

- He goes by what measures: a function or property whose annotated result is numbers alone (arrays, floats,
  whole numbers, what a scenario or a log states, or records and mappings of these with names), for its
  docstring says what it is, and in which unit. What it calls he follows all the same.
- He STAYS in every other function, method or property: one that gives a truth value, a word, a sentence, or
  what holds such.
- He RETURNS from a stay if the body that brought him there decides on the answer: the call, or a name that
  was given the answer, stands in a condition (if, while, assert, and, or, filter of a comprehension). From a
  table of functions (a tuple at the top of a module) he returns once, however many are in it: the first one
  that applies decides, or all are taken.

Methods and properties are those of the classes that an expression is of, or holds, by the annotations of
arguments, fields and results. What is of no such class is not followed.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from . import house

ROOMS = ("analysis",)
NUMBERS = {
    "Array",
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
CERTIFICATE = house.ROOT / "trilat_net/analysis/certificate/stability_certificate.py"


class Place(NamedTuple):
    """A function or class, `Class.method`, of a module."""

    module: Path
    name: str


class Walk(NamedTuple):
    """Where a reader stays, in order, and from which of these he returns to decide."""

    stays: list[Place]
    returns: list[Place]


@cache
def _module_names(path: Path) -> dict[str, Place | Path | ast.expr]:
    """What the names at the top of a module stand for: definitions, modules, values."""
    found: dict[str, Place | Path | ast.expr] = {}
    for node in house.tree(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = Place(path, node.name)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = node.value
        elif isinstance(node, ast.ImportFrom) and node.level:
            base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            for alias in node.names:
                inside = (base / alias.name).with_suffix(".py")
                module = base.with_suffix(".py")
                if module.is_file() or inside.is_file():
                    found[alias.asname or alias.name] = (
                        Place(module, alias.name) if module.is_file() else inside
                    )
    return found


@cache
def _definition(place: Place) -> ast.FunctionDef | ast.ClassDef | None:
    head, _, method = place.name.partition(".")
    body = house.tree(place.module).body
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
            yield below.value


def _resolve(path: Path, name: str) -> list[Place]:
    """What a name of a module stands for, through aliases and tables."""
    found = _module_names(path).get(name)
    if isinstance(found, ast.expr):
        return [
            place
            for inner in _names_in(found)
            if inner != name
            for place in _resolve(path, inner)
        ]
    if not isinstance(found, Place):
        return []
    return (
        [found]
        if _definition(found) or found.module == path
        else _resolve(found.module, found.name)
    )


def _fields(node: ast.ClassDef) -> list[ast.AnnAssign]:
    return [below for below in node.body if isinstance(below, ast.AnnAssign)]


@cache
def _is_numbers(path: Path, name: str) -> bool:
    """True of a type of numbers: one of `NUMBERS`, or a class all of whose fields are of such."""
    places = [] if name in NUMBERS else _resolve(path, name)
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
    return name in NUMBERS or bool(places)


@cache
def _measures(place: Place) -> bool:
    """True of what gives numbers alone; names are the keys of a mapping, or the fields of a record."""
    node = _definition(place)
    if not isinstance(node, ast.FunctionDef) or node.returns is None:
        return True
    names = list(_names_in(node.returns))
    keyed = names[:1] in (["dict"], ["Mapping"])
    texts = "str" in names and not keyed
    return not texts and all(_is_numbers(place.module, name) for name in names)


def _conditions(node: ast.AST) -> Iterator[ast.AST]:
    for below in ast.walk(node):
        if isinstance(below, ast.If | ast.IfExp | ast.While | ast.Assert):
            yield below.test
        elif isinstance(below, ast.comprehension):
            yield from below.ifs
        elif isinstance(below, ast.BoolOp):
            yield from below.values


def _decided(function: ast.FunctionDef) -> set[ast.AST]:
    """The expressions of a body that it decides on."""
    tested = {inner for test in _conditions(function) for inner in ast.walk(test)}
    names = {node.id for node in tested if isinstance(node, ast.Name)}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.NamedExpr):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if names & {name for target in targets for name in _names_in(target)}:
                tested |= set(ast.walk(node.value))
    return tested


class _Body:
    """A body, and of which classes its names and expressions are, or what they hold."""

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
        """The classes that an expression is of, or holds."""
        module = self.place.module
        if isinstance(node, ast.Name) and node.id in self.names:
            return self.names[node.id]
        if isinstance(node, ast.Name):
            return {
                one
                for one in _resolve(module, node.id)
                if isinstance(_definition(one), ast.ClassDef)
            }
        if isinstance(node, ast.Attribute):
            owners = self.classes(node.value)
            found = [_member(owner, node.attr) for owner in owners]
            known = [(one.module, part) for one, part in found if part is not None]
            return (
                {c for path, part in known for c in _classes_in(path, part)}
                if known
                else owners
            )
        if isinstance(node, ast.Call):
            results = [(one.module, _definition(one).returns) for one in self.called(node.func)]  # type: ignore[union-attr]
            classes = {c for path, part in results if part for c in _classes_in(path, part)}
            return (
                classes
                or self.classes(node.func)
                or {c for one in node.args for c in self.classes(one)}
            )
        below = ast.iter_child_nodes(node)
        return (
            {c for one in below for c in self.classes(one)}
            if isinstance(node, ast.expr)
            else set()
        )

    def called(self, node: ast.AST) -> list[Place]:
        """The functions, methods and properties of the rooms that an expression leads to."""
        found: list[Place] = []
        if (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Load)
            and node.id not in self.names
        ):
            found = _resolve(self.place.module, node.id)
        elif isinstance(node, ast.Attribute):
            above = _module_names(self.place.module).get(getattr(node.value, "id", ""))
            owners = sorted(self.classes(node.value))
            found = [_member(owner, node.attr)[0] for owner in owners]
            found = [Place(above, node.attr)] if isinstance(above, Path) else found
        return [
            one
            for one in found
            if isinstance(_definition(one), ast.FunctionDef) and _in_rooms(one)
        ]


def _in_rooms(place: Place) -> bool:
    return place.module.relative_to(house.ROOT).parts[1] in ROOMS


@cache
def _member(owner: Place, name: str) -> tuple[Place, ast.expr | None]:
    """A method or field of a class or of those that it derives from, and what it gives."""
    node, place = _definition(owner), owner._replace(name=f"{owner.name}.{name}")
    method = _definition(place)
    if isinstance(method, ast.FunctionDef):
        return place, method.returns
    for field in _fields(node) if isinstance(node, ast.ClassDef) else ():
        if isinstance(field.target, ast.Name) and field.target.id == name:
            return place, field.annotation
    for base in node.bases if isinstance(node, ast.ClassDef) else ():
        for one in _classes_in(owner.module, base) - {owner}:
            found = _member(one, name)
            if found[1] is not None:
                return found
    return place, None


def _classes_in(path: Path, part: ast.expr) -> set[Place]:
    """The classes that an annotation names."""
    found = {one for name in _names_in(part) for one in _resolve(path, name)}
    return {one for one in found if isinstance(_definition(one), ast.ClassDef)}


def _in_order(node: ast.AST) -> Iterator[ast.AST]:
    for below in ast.iter_child_nodes(node):
        yield from _in_order(below)
    yield node


def walk(*starts: Place) -> Walk:
    """Returns the walk from some functions."""
    seen, stays, returns = set(starts), list(starts), []

    def read(place: Place) -> None:
        body = _Body(place)
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
    """Returns the walk from a log to what decides the exit code of `trilat certify`."""
    return walk(Place(CERTIFICATE, "certify"), Place(CERTIFICATE, "Certificate.accepts"))


if __name__ == "__main__":
    found = walk_to_judgement()
    for one in found.stays:
        print(f"{'<- ' if one in found.returns else '   '}{one.module.stem}: {one.name}")
    print(f"{len(found.stays)} stays, {len(found.returns)} returns")
