"""The interfaces of the packages: what each one gives to the others, as `__all__` of its `__init__.py` lists it.

    python -m tests.part_interfaces            writes the tables below `__all__`: in which module each name is
    python -m tests.part_interfaces --count    prints how many names of each part the others use

A part is an amount of code that one person can own (`line_figures.PARTS`), such as several packages. A name of a
part belongs to its interface if a file of another part imports the name. The fewer such names, the more a part may
change freely.
"""

import ast
import re
import sys
import textwrap
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from . import house, line_figures

_LINE = 96
_WIDTH = 74
"""The most columns of a line, and of the names in a line of their own."""


class CrossingImport(NamedTuple):
    """An import of a name of one package in a file of another.

    Attributes:
        file: The file that imports the name.
        package: The package that has the name.
        module: The module that the import names: the package itself, if the import is allowed.
        name: The name.
    """

    file: Path
    package: str
    module: str
    name: str


def list_crossing_imports() -> list[CrossingImport]:
    """Returns all imports of the program across the borders of packages that have an interface."""
    imports = []
    for path in house.files():
        side = house.find_border(house.dotted(path))
        for *module, name in house.written_imports(path):
            base = ".".join(module)
            below = ".".join((*module, name))
            package = house.find_package(base) or house.find_package(below)
            if package not in (None, below) and house.find_border(package) != side:
                imports.append(CrossingImport(path, package, base, name))
    return imports


def list_unused_names() -> dict[str, set[str]]:
    """Returns, for each package, the names of its interface that no other package imports."""
    used = defaultdict(set)
    for crossing in list_crossing_imports():
        used[crossing.package].add(crossing.name)
    return {
        package: unused
        for package in house.INTERFACES
        if (unused := {*house.list_interface(package)} - used[package])
    }


def count_names() -> Counter[str]:
    """Returns how many names of each part other parts import."""
    names = defaultdict(set)
    paths = [p for p in line_figures.list_sources() if house.dotted(p) not in house.INTERFACES]
    for path in paths:
        user = line_figures.find_part(path)
        for *module, name in house.imported_names(path):
            file = house.find_file((*module, name)) or house.find_file(tuple(module))
            if file is None:
                continue
            part = line_figures.find_part(file)
            if part != user:
                names[part].add((".".join(module), name))
    return Counter({part: len(members) for part, members in names.items()})


def find_homes(package: str) -> dict[str, str]:
    """Returns the module of each name of an interface, relative to the package.

    Raises:
        SystemExit: No module of the package defines the name, or several do.
    """
    folder = house.package_folder(package)
    known = house.interface_homes(package)
    homes = {}
    for name in house.list_interface(package):
        modules = {
            ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
            for path in folder.rglob("*.py")
            if path.parent != folder or path.name != "__init__.py"
            if house.find_package(house.dotted(path)) == package
            if path.stem == name or name in house.assigned_names(path)
        }
        if known.get(name) in modules:
            modules = {known[name]}
        if len(modules) != 1:
            sys.exit(f"{package}.{name} is defined in {sorted(modules) or 'no module'}")
        homes[name] = modules.pop()
    return homes


def write_tables(package: str, homes: Mapping[str, str]) -> None:
    """Writes the block below `__all__`: imports for type checkers, and the table of `import_on_use`."""
    path = house.package_folder(package) / "__init__.py"
    modules = defaultdict(list)
    for name in sorted(homes):
        modules[homes[name]].append(name)
    block = ["if TYPE_CHECKING:"]
    for module in sorted(modules):
        parent, _, stem = module.rpartition(".")
        if stem in modules[module]:
            block.append(f"    from .{parent} import {stem}")
        if names := ", ".join(name for name in modules[module] if name != stem):
            block.append(f"    from .{module} import ({names})")
    block += ["else:", "    __getattr__ = import_on_use(", "        __name__,", "        {"]
    for module in sorted(modules):
        names = " ".join(modules[module])
        if len(f'            "{module}": "{names}",') > _LINE:
            pieces = textwrap.wrap(names, _WIDTH)
            last = pieces.pop()
            value = "(" + "\n".join([*(f'"{piece} "' for piece in pieces), f'"{last}"']) + ")"
        else:
            value = f'"{names}"'
        block.append(f'            "{module}": {value},')
    block += ["        },", "    )"]

    text = path.read_text(encoding="utf-8")
    body = ast.parse(text).body
    lines = text.split("\n")
    start = next(n for n in body if ast.unparse(n).startswith("__all__ ="))
    old = next((n for n in body if isinstance(n, ast.If)), None)
    first = old.lineno - 1 if old else start.end_lineno
    last = old.end_lineno if old else start.end_lineno
    lines[first:last] = block if old else ["", *block]
    head = body[0].end_lineno
    wanted = [
        "from typing import TYPE_CHECKING",
        f"from {_hooks_of(package)} import import_on_use",
    ]
    missing = [line for line in wanted if not re.search(rf"^{re.escape(line)}", text, re.M)]
    if missing:
        lines[head:head] = ["", *missing]
    path.write_text("\n".join(lines).rstrip("\n") + "\n", encoding="utf-8")


def _hooks_of(package: str) -> str:
    depth = package.count(".")
    return "." * (depth + 1) + "hooks" if depth else "trilat_net.hooks"


def main() -> None:
    """Writes the tables, or prints the counts."""
    if "--count" in sys.argv[1:]:
        for part, count in count_names().most_common():
            print(f"{part:<12}{count:>6}")
        return
    for package in house.INTERFACES:
        write_tables(package, find_homes(package))


if __name__ == "__main__":
    main()
