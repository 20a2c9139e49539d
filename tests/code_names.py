"""The names that the project's files define, and those that its prose refers to in backticks."""

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from . import house

DATA = {
    ".css",
    ".html",
    ".ipynb",
    ".j2",
    ".js",
    ".json",
    ".msg",
    ".toml",
    ".txt",
    ".urdf",
    ".yaml",
    ".yml",
}
"""Endings of other files whose words all count as defined."""

_QUOTED = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_NAME = re.compile(r"\.{0,2}[A-Za-z_]\w*(?:\.\w+)*(?:\.\.\.)?(?:\(\))?")


class Reference(NamedTuple):
    """A name in backticks, with the file and the line where its docstring or page begins."""

    file: str
    line: int
    name: str


@cache
def list_files() -> tuple[Path, ...]:
    """Returns every file of the project that is under version control, or is about to be."""
    command = ["git", "ls-files", "-co", "--exclude-standard"]
    listed = subprocess.run(command, cwd=house.ROOT, capture_output=True, text=True, check=True)
    paths = (house.ROOT / name for name in listed.stdout.splitlines())
    return tuple(path for path in paths if path.is_file())


def iterate_docstrings(tree: ast.Module) -> Iterator[ast.Constant]:
    """Yields the docstrings of a module, of its classes and functions, and those below assignments."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for statement in body if isinstance(body, list) else ():
            value = getattr(statement, "value", None)
            is_text = isinstance(value, ast.Constant) and isinstance(value.value, str)
            if is_text and isinstance(statement, ast.Expr):
                yield value


def _iterate_words_of_code(path: Path) -> Iterator[str]:
    docstrings = {
        (value.lineno, value.col_offset) for value in iterate_docstrings(house.tree(path))
    }
    text = path.read_text(encoding="utf-8")
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            yield token.string
        elif token.type == tokenize.STRING and token.start not in docstrings:
            yield from re.findall(r"\w+", token.string)


def _has_words(path: Path) -> bool:
    return path.suffix in {".py", *DATA} or path.name in {"Makefile", "json-keys.csv"}


@cache
def collect_words() -> frozenset[str]:
    """Returns every name and every word of a string in the sources, the data and the names of files.

    Every word of a test counts. The test of these names does not: it holds names that nothing defines.
    """
    program = set(house.files())
    all_words = set()
    for path in list_files():
        all_words |= {*path.relative_to(house.ROOT).parts, path.stem}
        if path in program:
            all_words |= set(_iterate_words_of_code(path))
        elif path.name != "test_code_names.py" and _has_words(path):
            all_words |= set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    return frozenset(all_words)


@cache
def _find_modules() -> dict[str, frozenset[str]]:
    """Returns the words of the code of each module of the program, by the module's name."""
    return {path.stem: frozenset(_iterate_words_of_code(path)) for path in house.files()}


def iterate_references() -> Iterator[Reference]:
    """Yields the names in backticks in the docstrings of the program and on the pages of the documentation.

    Blocks and formulas of pages do not count.
    """
    for path in house.files():
        for value in iterate_docstrings(house.tree(path)):
            yield from _find_names(path, value.lineno, str(value.value))
    for path in (*sorted((house.ROOT / "docs").rglob("*.md")), house.ROOT / "README.md"):
        text = path.read_text(encoding="utf-8")
        prose = re.sub(r"```.*?```|\$`[^`]+`\$", "", text, flags=re.DOTALL)
        yield from _find_names(path, 1, prose)


def _find_names(path: Path, line: int, text: str) -> Iterator[Reference]:
    for quoted in _QUOTED.finditer(text):
        if _NAME.fullmatch(quoted[1]):
            file = str(path.relative_to(house.ROOT))
            yield Reference(file, line + text[: quoted.start()].count("\n"), quoted[1])


def is_defined(name: str) -> bool:
    """True if a file has this name, or if each part of a dotted name is defined.

    A name that begins with a package of the program is resolved in its module. `test_of_` with an ellipsis stands
    for the names that begin so, and a test may be named without `test_`.
    """
    known_words = collect_words()
    name = name.removesuffix("()").lstrip(".")
    if name.endswith("..."):
        return any(word.startswith(name.removesuffix("...")) for word in known_words)
    package, *rest = name.split(".")
    if len(rest) > 1 and (house.ROOT / "trilat_net" / package).is_dir():
        module, *rest = [
            part for part in rest if not (house.ROOT / "trilat_net" / package / part).is_dir()
        ]
        return set(rest) <= _find_modules().get(module, set())
    return name in known_words or all(
        part in known_words or f"test_{part}" in known_words for part in (package, *rest)
    )
