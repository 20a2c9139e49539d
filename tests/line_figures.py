"""How densely the source is written, in figures for each part of the program.

    python -m tests.line_figures            print a row for each part
    python -m tests.line_figures --where    and the files that add most to each figure

The figures are symptoms of code that is hard to read. Meeting one of them by a trick (a new filler word, a
pointless line break) defeats its purpose.

    tokens per line: names, operators, numbers and strings per line that holds one of them
    parallel: assignments of a tuple to a tuple, per 1000 lines; swaps and coordinates may stay
    unpacked: tuples that are built in order to be unpacked into a call
    filler: names that do not say which quantity or thing they hold, per 1000 lines
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from . import house

SOURCES = ("trilat_net", "sites", "recorder", "packages")
PARTS = {
    "ros2": r"ros2|robot_model",
    "lerobot": r"lerobot",
    "people": r"^packages/trilat-people/|studies/experiment",
    "studies": r"^trilat_net/studies/|^packages/trilat-studies/",
    "kernel": r"^trilat_net/(core|laws)/|^trilat_net/(fields|errors|files|process|signals|workers|results|hooks|records|recorded_change|toml_text)\.py",
    "analysis": r"^trilat_net/analysis/",
    "app": r"^trilat_net/(app|presentation|work)/|^trilat_net/(__init__|__main__|entry_points|extension|package_names)\.py",
    "session": r"^trilat_net/(scenario|own_code|net|log|execution)/|^sites/|^recorder/",
}
"""The files of each part by their paths; the first pattern that matches decides."""

# fmt: off
FILLER_NAMES = frozenset((
    "one", "found", "made", "told", "asked", "shown", "own", "here", "there", "came", "led", "apart",
    "every", "away", "take", "place", "given", "words",
))
# fmt: on
COUNTED_TOKENS = {tokenize.NAME, tokenize.OP, tokenize.NUMBER, tokenize.STRING}


@dataclass
class LineFigures:
    """The counts of one or more files."""

    lines: int = 0
    code_lines: int = 0
    tokens: int = 0
    parallel: int = 0
    unpacked: int = 0
    filler: int = 0

    def add(self, other: "LineFigures") -> None:
        """Adds the counts of other files."""
        for name, count in vars(other).items():
            setattr(self, name, getattr(self, name) + count)

    @property
    def tokens_per_line(self) -> float:
        """Tokens per line of code."""
        return self.tokens / max(1, self.code_lines)

    def per_thousand_lines(self, name: str) -> float:
        """Returns a count per 1000 lines."""
        return 1000.0 * float(getattr(self, name)) / max(1, self.lines)


def list_sources() -> list[Path]:
    """Returns the source files of the program, in order, without the tests of its packages."""
    paths = (path for top in SOURCES for path in (house.ROOT / top).rglob("*.py"))
    return sorted(path for path in paths if "tests" not in path.relative_to(house.ROOT).parts)


def find_part(path: Path) -> str:
    """Returns the part that a file belongs to."""
    name = path.relative_to(house.ROOT).as_posix()
    return next(part for part, pattern in PARTS.items() if re.search(pattern, name))


def measure_file(path: Path) -> LineFigures:
    """Counts the tokens, assignments, calls and names of a file."""
    text = path.read_text(encoding="utf-8")
    tree = house.tree(path)
    figures = LineFigures(lines=text.count("\n"))
    code_lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in COUNTED_TOKENS:
            figures.tokens += 1
        if token.type in COUNTED_TOKENS - {tokenize.STRING}:
            code_lines.add(token.start[0])
        if token.type == tokenize.NAME and token.string in FILLER_NAMES:
            figures.filler += 1
    figures.code_lines = len(code_lines)
    figures.parallel = sum(is_parallel(node) for node in ast.walk(tree))
    figures.unpacked = sum(
        count_unpacked(node) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)
    )
    return figures


def is_parallel(node: ast.AST) -> bool:
    """True if a statement assigns a tuple to a tuple."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def count_unpacked(function: ast.FunctionDef) -> int:
    """Counts the arguments of calls in a function that unpack a tuple which the function builds."""
    built = {
        target.id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        for target in node.targets
        if isinstance(target, ast.Name) and len(node.value.elts) > 1
    }
    return sum(
        isinstance(value, ast.Tuple) or (isinstance(value, ast.Name) and value.id in built)
        for value in _iterate_unpacked(function)
    )


def _iterate_unpacked(function: ast.FunctionDef) -> Iterator[ast.expr]:
    for call in ast.walk(function):
        if isinstance(call, ast.Call):
            yield from (item.value for item in call.args if isinstance(item, ast.Starred))


def measure_parts() -> dict[str, LineFigures]:
    """Returns the figures of each part."""
    parts = {part: LineFigures() for part in PARTS}
    for path in list_sources():
        parts[find_part(path)].add(measure_file(path))
    return parts


def print_worst(count: int = 20) -> None:
    """Prints the files that add most to each figure."""
    figures = {path: measure_file(path) for path in list_sources()}
    for name in ("parallel", "unpacked", "filler"):
        worst = sorted(figures, key=lambda path: -getattr(figures[path], name))[:count]
        print(f"\n{name}:")
        for path in worst:
            print(f"  {getattr(figures[path], name):4d} {path.relative_to(house.ROOT)}")


def main() -> None:
    """Prints a row for each part, and the worst files if they are asked for."""
    print(
        f"{'part':<12}{'lines':>9}{'tokens/line':>13}{'parallel/k':>12}{'unpacked':>10}{'filler/k':>10}"
    )
    for part, figures in measure_parts().items():
        print(
            f"{part:<12}{figures.lines:>9}{figures.tokens_per_line:>13.2f}"
            f"{figures.per_thousand_lines('parallel'):>12.1f}{figures.unpacked:>10}"
            f"{figures.per_thousand_lines('filler'):>10.1f}"
        )
    if "--where" in sys.argv[1:]:
        print_worst()


if __name__ == "__main__":
    main()
