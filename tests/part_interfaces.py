"""The names that parts of the program use of each other, as docs/data/part-interfaces.csv lists them.

    python -m tests.part_interfaces            writes the table
    python -m tests.part_interfaces --count    prints how many names of each part the others use

A part is an amount of code that one person can own (`line_figures.PARTS`). A name of a part belongs to its
interface if a file of another part imports the name. The fewer such names, the more a part may change freely.
"""

import csv
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from . import house, line_figures

TABLE = house.ROOT / "docs" / "data" / "part-interfaces.csv"
_HEAD = ("part", "name", "module", "used by")


class InterfaceRow(NamedTuple):
    """A name that other parts use: its part, its module, and the parts that import it."""

    part: str
    name: str
    module: str
    used_by: str


def _find_file(module: tuple[str, ...]) -> Path | None:
    """Returns the file of a module of the program. None if the module is not of the program."""
    if not module or module[0] not in house.TOPS:
        return None
    base = house.TOPS[module[0]].joinpath(*module)
    files = (base.with_suffix(".py"), base / "__init__.py")
    return next((file for file in files if file.is_file()), None)


def _iterate_imports(path: Path) -> Iterator[tuple[Path, str, str]]:
    """Yields the file, the module and the name of each import of the program in a file."""
    for parts in house.imported_names(path):
        *module, name = parts
        file = _find_file(parts) or _find_file(tuple(module))
        if file is not None:
            yield file, ".".join(module), name


def list_interfaces() -> list[InterfaceRow]:
    """Returns the names of each part that other parts import, in the order of the table."""
    users = defaultdict(set)
    for path in line_figures.list_sources():
        user = line_figures.find_part(path)
        for file, module, name in _iterate_imports(path):
            part = line_figures.find_part(file)
            if part != user:
                users[part, module, name].add(user)
    return sorted(
        InterfaceRow(part, name, module, " ".join(sorted(parts)))
        for (part, module, name), parts in users.items()
    )


def read_table() -> list[InterfaceRow]:
    """Returns the names that docs/data/part-interfaces.csv lists, in its order."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return [InterfaceRow(*(row[key] for key in _HEAD)) for row in csv.DictReader(file)]


def write_table() -> None:
    """Writes the table."""
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_HEAD)
        writer.writerows(list_interfaces())


def count_names() -> Counter[str]:
    """Returns how many names of each part other parts import."""
    return Counter(row.part for row in list_interfaces())


def main() -> None:
    """Writes the table, or prints the counts."""
    if "--count" in sys.argv[1:]:
        for part, count in count_names().most_common():
            print(f"{part:<12}{count:>6}")
    else:
        write_table()


if __name__ == "__main__":
    main()
