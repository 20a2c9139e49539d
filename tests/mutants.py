"""Single-token changes of the rooms in which an error costs most, each judged by the tests of a
push.

    python -m tests.mutants --seed 1 --count 40

Changes are drawn by the seed, equally many from each room. Each change is made in a copy of the
tree. The tests of a push run there, those nearest to the changed file first, until one fails. A
changed core takes minutes to compile, so that its own tests run first without compilation. A
change that survives all tests reveals a law that no test states, or has no effect.

Changes without effect on any run are not drawn: annotations and decorators, text for people
(strings, and the arguments of `raise`), names that a module exports, and the bases of a class.
"""

import argparse
import ast
import io
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tokenize
from bisect import bisect_left
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from subprocess import CompletedProcess
from typing import NamedTuple

from . import house
from .golden.digests import channel_digests

LINKS = ("arrivals", "channel", "delay", "link", "lost_peers", "philox")
ROOMS = {
    "core": [
        path for path in house.files() if house.room(path) == "core" and path.stem not in LINKS
    ],
    "links": [
        path for path in house.files() if house.room(path) == "core" and path.stem in LINKS
    ],
    "log": [path for path in house.files() if house.room(path) == "log"],
    "certificate": sorted((house.ROOT / "trilat_net/analysis/certificate").glob("*.py")),
}
CORE = (*ROOMS["core"], *ROOMS["links"])
OTHERS = {
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "//": "*",
    "%": "*",
    "**": "*",
    "@": "*",
    "|": "&",
    "&": "|",
    "^": "|",
    "<<": ">>",
    ">>": "<<",
    "+=": "-=",
    "-=": "+=",
    "*=": "/=",
    "/=": "*=",
    "//=": "*=",
    "|=": "&=",
    "&=": "|=",
    "^=": "|=",
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "and": "or",
    "or": "and",
    "not": "",
    "True": "False",
    "False": "True",
}
"""What a token of these becomes; a number becomes one more or, with a point, twice what it is."""
SLOWEST_S = 600
"""A test that takes longer hangs: it has found the change."""
INTERPRETED = {"NUMBA_DISABLE_JIT": "1"}
QUICK_S = 5
"""A test of the core that takes longer without compiling waits until the changed core is compiled."""


class Mutant(NamedTuple):
    """A change of one token.

    Attributes:
        path: the file.
        line, column: where the token is, from 1 and from 0.
        was, now: the token, and what stands there instead.
    """

    path: Path
    line: int
    column: int
    was: str
    now: str

    def apply(self) -> str:
        """Returns the text of the file with the change in it."""
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        line = lines[self.line - 1].encode()  # columns of a syntax tree count bytes
        end = self.column + len(self.was.encode())
        assert line[self.column : end] == self.was.encode()
        lines[self.line - 1] = (line[: self.column] + self.now.encode() + line[end:]).decode()
        return "".join(lines)

    def __str__(self) -> str:
        return f"{self.path.relative_to(house.ROOT)}:{self.line}: `{self.was}` -> `{self.now}`"


class _Places(ast.NodeVisitor):
    """Collects the changes of a file that a run can tell."""

    def __init__(self, path: Path) -> None:
        self.path, self.found = path, list[Mutant]()
        self._parameters: list[str] = []
        text = path.read_text(encoding="utf-8")
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        lines = text.splitlines()
        self._tokens = [
            (
                (token.start[0], len(lines[token.start[0] - 1][: token.start[1]].encode())),
                token.string,
            )
            for token in tokens
            if token.string.strip() and token.type != tokenize.COMMENT
        ]
        self._words = dict(self._tokens)
        self.visit(house.tree(path))

    def _add(self, at: tuple[int, int], was: str, now: str) -> None:
        self.found.append(Mutant(self.path, *at, was, now))

    def _between(self, before: ast.expr, after: ast.expr) -> None:
        """The operator between two operands."""
        assert before.end_lineno is not None
        assert before.end_col_offset is not None
        first, last = (
            (before.end_lineno, before.end_col_offset),
            (after.lineno, after.col_offset),
        )
        low, high = (
            bisect_left(self._tokens, (token_index, "")) for token_index in (first, last)
        )
        tokens = [token for token in self._tokens[low:high] if token[1] not in ("(", ")")]
        if len(tokens) == 1 and tokens[0][1] in OTHERS:  # `is not` and `not in` are two
            self._add(*tokens[0], OTHERS[tokens[0][1]])

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self._between(node.left, node.right)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        self._between(node.target, node.value)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for before, after in zip(
            [node.left, *node.comparators], node.comparators, strict=False
        ):
            self._between(before, after)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for before, after in zip(node.values, node.values[1:], strict=False):
            self._between(before, after)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.Not):
            self._add((node.lineno, node.col_offset), "not", "")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        at = (node.lineno, node.col_offset)
        was = self._words.get(at, "")
        if isinstance(node.value, bool):
            self._add(at, was, OTHERS[was])
        elif isinstance(node.value, int | float):
            more = node.value + 1 if isinstance(node.value, int) else 2.0 * node.value or 1.0
            self._add(at, was, repr(more))

    def visit_Name(self, node: ast.Name) -> None:
        """An argument becomes the next one of its function."""
        if (
            node.id in self._parameters
            and len(self._parameters) > 1
            and isinstance(node.ctx, ast.Load)
        ):
            after = self._parameters[
                (self._parameters.index(node.id) + 1) % len(self._parameters)
            ]
            self._add((node.lineno, node.col_offset), node.id, after)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer, given = self._parameters, node.args
        names = [
            argument.arg for argument in (*given.posonlyargs, *given.args, *given.kwonlyargs)
        ]
        for default in (*given.defaults, *filter(None, given.kw_defaults)):
            self.visit(default)
        self._parameters = [name for name in names if name not in ("self", "cls")]
        for statement in node.body:
            self.visit(statement)
        self._parameters = outer

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for statement in node.body:
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Raise(self, node: ast.Raise) -> None:
        """Not looked into, nor is a string with numbers in it."""

    visit_JoinedStr = visit_Raise  # type: ignore[assignment]


@cache
def find_mutants(room: str) -> list[Mutant]:
    """Returns all changes that may be drawn of a room."""
    return [mutant for path in ROOMS[room] for mutant in _Places(path).found]


def draw_mutants(seed: int, count: int) -> list[Mutant]:
    """Draws so many changes, a room after the other."""
    rng = random.Random(seed)
    shares = [count // len(ROOMS) + (n < count % len(ROOMS)) for n in range(len(ROOMS))]
    return [
        mutant
        for room, share in zip(ROOMS, shares, strict=True)
        for mutant in rng.sample(find_mutants(room), share)
    ]


def order_tests(path: Path) -> Iterator[list[str]]:
    """Yields files of tests: those that import a file of the program, golden runs, its room, all others."""
    module = path.relative_to(house.ROOT).with_suffix("").parts
    tests = sorted((house.ROOT / "tests").rglob("test_*.py"))
    near = [
        one
        for one in tests
        if any(name[: len(module)] == module for name in house.imported_names(one))
    ]
    near.sort(key=lambda one: one.stem != f"test_{path.stem}")
    room = [one for one in tests if house.room(path) in one.parts and one not in near]
    golden = [one for one in tests if "golden" in one.parts and one not in near]
    for some in (
        near,
        golden,
        room,
        [one for one in tests if one not in (*near, *golden, *room)],
    ):
        if some:
            yield [str(one.relative_to(house.ROOT)) for one in some]


def ask_pytest(
    tree: Path, options: list[str], workers: int, **environment: str
) -> CompletedProcess[str]:
    """Runs tests of a push in a tree; what runs in another folder is of this tree too."""
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "-p", "no:cacheprovider"]
    command += ["-m", "not live and not long"]
    command += ["-n", str(workers), "--dist", "worksteal"] if workers > 1 else []
    env = {**os.environ, "PYTHONPATH": str(tree), "CI": "1", **environment}
    return subprocess.run(
        [*command, *options], cwd=tree, env=env, capture_output=True, text=True, check=False
    )


@cache
def find_paper() -> dict[str, str]:
    """Returns the digests of the tree as it is."""
    with tempfile.TemporaryDirectory() as tree_copy:
        copy_tree(Path(tree_copy) / "tree")
        return digest_paper(Path(tree_copy) / "tree")


@cache
def find_quick_tests(workers: int) -> list[str]:
    """Returns the tests of the core that pass, and soon, where nothing is compiled."""
    with tempfile.TemporaryDirectory() as tree_copy:
        copy_tree(Path(tree_copy))
        options = [f"--timeout={QUICK_S}", "--timeout-method=signal", "-rp", "tests/core"]
        output = ask_pytest(Path(tree_copy), options, workers, **INTERPRETED).stdout
    return re.findall(r"^PASSED (.+)$", output, re.MULTILINE)


def digest_paper(tree: Path) -> dict[str, str]:
    """Returns digests of the first second of `paper` where nothing is compiled; none if it does not run.

    If they differ from those of the tree as it is, so do those of the whole run, see `tests.golden`.
    """
    path = tree.parent / "paper.mcap"
    arguments = [
        "-m",
        "trilat_net",
        "sim",
        "paper",
        "--duration",
        "1",
        "-o",
        str(path),
        "--force",
    ]
    environment = {**os.environ, "PYTHONPATH": str(tree), **INTERPRETED}
    ended = subprocess.run(
        [sys.executable, *arguments],
        cwd=tree,
        env=environment,
        capture_output=True,
        check=False,
    )
    return channel_digests(path) if ended.returncode == 0 else {}


def run_interpreted(tree: Path, path: Path, workers: int) -> str:
    """Runs the quick tests of the core, of which nothing is compiled, as `run_tests` does."""
    if digest_paper(tree) != find_paper():
        return "tests/golden/test_payloads.py[paper]"
    listed = tree.parent / "quick.txt"
    near = next(order_tests(path))
    names = sorted(
        find_quick_tests(workers), key=lambda name: name.partition("::")[0] not in near
    )
    listed.write_text("\n".join(names), encoding="utf-8")
    ended = ask_pytest(
        tree, ["-x", "-rfE", "--timeout=60", f"@{listed}"], workers, **INTERPRETED
    )
    return name_failure(ended)


def run_tests(tree: Path, files: list[str], workers: int) -> str:
    """Runs tests of a push in a tree until one fails; returns its name, or "" if none does."""
    options = ["-x", "-rfE", f"--timeout={SLOWEST_S}", "--timeout-method=thread", *files]
    changed = any(
        (tree / path.relative_to(house.ROOT)).read_bytes() != path.read_bytes() for path in CORE
    )
    # nothing compiled is kept
    cache = {"XDG_CACHE_HOME": str(tree.parent / "cache")} if changed else {}
    return name_failure(ask_pytest(tree, options, workers, **cache))


def name_failure(ended: CompletedProcess[str]) -> str:
    """Returns the name of a test that failed, or "" if none did."""
    if ended.returncode in (0, 5):  # 5: all of them are long tests
        return ""
    named = re.search(r"^(?:FAILED|ERROR) (\S+)", ended.stdout, re.MULTILINE)
    hangs = re.search(r"Timeout", ended.stdout + ended.stderr)
    return (
        named[1]
        if named
        else f"{'a test hangs' if hangs else 'the tests do not run'} ({ended.returncode})"
    )


def copy_tree(to: Path) -> None:
    """Copies what is under version control; times stay, as compiled code goes by them."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=house.ROOT, capture_output=True, check=True
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        (to / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(house.ROOT / name, to / name)


def judge_mutant(mutant: Mutant, workers: int) -> str:
    """Returns the name of a test that fails with a change, or "" if it survives."""
    with tempfile.TemporaryDirectory() as tree_copy:
        tree = Path(tree_copy) / "tree"
        copy_tree(tree)
        (tree / mutant.path.relative_to(house.ROOT)).write_text(
            mutant.apply(), encoding="utf-8"
        )
        if mutant.path in CORE and (found := run_interpreted(tree, mutant.path, workers)):
            return found
        return next(
            filter(None, (run_tests(tree, some, workers) for some in order_tests(mutant.path))),
            "",
        )


def main() -> int:
    """Prints a table, a row as it is found; the exit code is 1 if more than a twentieth survives."""
    parser = argparse.ArgumentParser(
        description="Judges the tests of a push by single-token changes."
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=40, help="of changes, over four rooms")
    parser.add_argument("--only", default="", help="a pattern of the files that are changed")
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processes that test"
    )
    arguments = parser.parse_args()
    print("| change | found by | s |\n|---|---|---|", flush=True)
    drawn = [
        candidate
        for candidate in draw_mutants(arguments.seed, arguments.count)
        if re.search(arguments.only, str(candidate))
    ]
    survivors = 0
    for mutant in drawn:
        begun_s = time.monotonic()
        failure = judge_mutant(mutant, arguments.workers)
        survivors += not failure
        print(
            f"| {mutant} | {failure or 'SURVIVES'} | {time.monotonic() - begun_s:.0f} |",
            flush=True,
        )
    print(f"\n{len(drawn) - survivors} of {len(drawn)} are found")
    return int(survivors > len(drawn) / 20)


if __name__ == "__main__":
    sys.exit(main())
