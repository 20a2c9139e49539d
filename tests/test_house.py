"""How the house is built: names, rooms (docs/develop/packages.md), and the tour through it."""

import csv
import re
from collections import Counter, defaultdict
from importlib import import_module

import grimp
import pytest
from scipy.sparse import lil_matrix
from scipy.sparse.csgraph import connected_components

from trilat_net.hooks import find_hook

from . import house, line_figures, part_interfaces, reading_walk
from .import_contracts import see_through_interfaces

ARM_STAGES = ("trilat_net/core/arms/chain_stages.py", "trilat_net/core/arms/two_link_stages.py")
PLUG_INS = {
    "main",
    *set.intersection(*(house.definitions(house.ROOT / path) for path in ARM_STAGES)),
}
"""Names that an interface asks of several modules: the entry point of a program, the stages of an arm."""
IMPORTED_BY_USERS = {
    "compiled_law",
    "gym_environment",
    "movement_measures",
    "own_hand",
    "statistics",
    "trials",
    "user_law",
}
"""Modules that have a second, former place, from which files of users import."""
IMPORTS = house.ROOT / "docs" / "data" / "package-imports.csv"
LINE_LIMITS = {  # part: tokens per line, parallel assignments, unpacked tuples and filler names per 1000 lines
    "kernel": (8.4, 0.1, 0, 1.0),
    "session": (8.4, 0.1, 0, 1.0),
    "analysis": (8.5, 0.1, 0, 1.0),
    "app": (8.2, 0.1, 0, 1.0),
    "studies": (8.4, 0.1, 0, 2.0),
    "people": (8.5, 0.1, 0, 1.0),
    "ros2": (8.4, 0.1, 0, 1.0),
    "lerobot": (8.0, 0.1, 0, 1.0),
}
"""A number here only falls, until each part has 8.5, 2, 0 and 4; `python -m tests.line_figures` prints them."""
MOST_WORDS = 8
"""The most words in the name of a test, without `test`."""
LONG_TEST_NAMES = 5
"""Names of tests with more words, all of them in tests/golden; this number only falls."""
INTERFACE_LIMITS = {  # part: how many of its names other parts import
    "kernel": 185,
    "session": 155,
    "analysis": 51,
    "app": 45,
    "studies": 9,
    "people": 9,
    "ros2": 18,
}
"""A number here only falls; `python -m tests.part_interfaces --count` prints them."""
TOUR = (house.ROOT / "docs" / "develop" / "tour.md").read_text(encoding="utf-8")


CALLED_BY_LIBRARIES = {
    "FencedExamples.on_object",
    "LaneVector.can_convert_from",
    "LaneVector.unify",
    "_CompilingNotice.on_end",
    "_CompilingNotice.on_start",
    "_CompressedFiles._load_data",
    "_LeafCache.load_overload",
    "_LeafLocator.get_disambiguator",
    "_LeafLocator.get_source_stamp",
    "_PackageCommand.short_help",
    "_RowAttributes.generic_resolve",
    "_RowsAttributes.resolve_shape",
}


def test_every_method_is_referred_to() -> None:
    assert house.unused_methods() == CALLED_BY_LIBRARIES


def test_a_class_or_public_function_has_one_module() -> None:
    homes = defaultdict(set)
    for path in house.files():
        # it has commands' names
        for name in house.definitions(path) if house.room(path) != "api" else ():
            if "." not in name and not name.startswith("_") and name not in PLUG_INS:
                homes[name].add(str(path.relative_to(house.ROOT)))
    assert not {name: places for name, places in homes.items() if len(places) > 1}


def test_a_module_name_is_used_once() -> None:
    homes = defaultdict(set)
    for path in house.files():
        # a command's module bears its name
        if path.stem != "__init__" and house.room(path) != "cli":
            homes[path.stem].add(str(path.relative_to(house.ROOT)))
    twice = {name for name, places in homes.items() if len(places) > 1}
    assert twice == IMPORTED_BY_USERS


@pytest.mark.push
def test_readers_walk_straight_from_certify_to_judgement() -> None:
    """`python -m tests.reading_walk` prints the walk, and says how it is counted."""
    walk = reading_walk.walk_to_judgement()
    # The analysis returns names and numbers, and the walk meets no sentence.
    assert len(walk.stays) <= 70
    assert len(walk.returns) <= 25
    assert len(walk.climbs) <= 5


@pytest.mark.push
def test_readers_walk_straight_from_file_to_scenario() -> None:
    """`python -m tests.reading_walk` prints the walk, and says how it is counted."""
    walk = reading_walk.walk_to_scenario()
    assert len(walk.stays) <= 15
    assert len(walk.returns) <= 5
    assert len(walk.climbs) <= 2


@pytest.mark.push
def test_lines_are_no_denser_than_their_limits() -> None:
    figures = line_figures.measure_parts()
    assert set(figures) == set(LINE_LIMITS)
    for part, (tokens, parallel, unpacked, filler) in LINE_LIMITS.items():
        measured = figures[part]
        assert measured.tokens_per_line <= tokens, part
        assert measured.per_thousand_lines("parallel") <= parallel, part
        assert measured.unpacked <= unpacked, part
        assert measured.per_thousand_lines("filler") <= filler, part


@pytest.mark.push
def test_no_test_imports_another() -> None:
    files = [
        path
        for top in ("tests", "packages", "benchmarks")
        for path in (house.ROOT / top).rglob("*.py")
    ]
    test_names = {
        path: re.findall(r"\btest_(?!.*\) -> None:)", path.read_text(encoding="utf-8"))
        for path in files
    }
    imported_names = [
        (path.name, *name)
        for path in files
        if test_names[path]
        for name in house.imported_names(path)
    ]
    assert not [
        name for name in imported_names if any(part.startswith("test_") for part in name[1:])
    ]


@pytest.mark.push
def test_names_of_tests_have_eight_words_at_most() -> None:
    """A file states each law once, so that no two of its tests share a name."""
    names = list(house.list_test_names())
    assert len(names) > 3000
    assert [name for name, uses in Counter(names).items() if uses > 1] == []
    too_long = [f"{path}::{name}" for path, name in names if name.count("_") > MOST_WORDS]
    assert len(too_long) <= LONG_TEST_NAMES, "\n".join(too_long)


@pytest.mark.push
def test_every_import_between_rooms_has_its_reason() -> None:
    """The table that docs/develop/packages.md links to has exactly the existing pairs."""
    with IMPORTS.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all(row["what for"] for row in rows)
    stated = {(row["package"], row["imports"]) for row in rows}
    assert stated == house.room_imports()
    assert len(stated) <= 113  # two of them are what packages of others may use


@pytest.mark.push
def test_other_packages_import_names_of_the_interface_alone() -> None:
    """Everything else inside a package may change freely (docs/develop/packages.md)."""
    imports = part_interfaces.list_crossing_imports()
    assert len(imports) > 1000
    assert [
        (str(crossing.file), crossing.module, crossing.name)
        for crossing in imports
        if crossing.module != crossing.package
        or crossing.name not in house.list_interface(crossing.package)
    ] == []


@pytest.mark.push
def test_other_packages_use_every_name_of_an_interface() -> None:
    """A name that no other package imports any more leaves `__all__`."""
    assert part_interfaces.list_unused_names() == {}


@pytest.mark.push
@pytest.mark.parametrize("package", house.INTERFACES)
def test_interfaces_resolve_the_names_that_they_list(package: str) -> None:
    """`python -m tests.part_interfaces` writes the tables below `__all__`."""
    interface = import_module(package)
    homes = house.interface_homes(package)
    assert sorted(homes) == sorted(house.list_interface(package))
    assert homes == part_interfaces.find_homes(package)
    for name, home in homes.items():
        module = import_module(f"{package}.{home}")
        value = module if home.endswith(f".{name}") or home == name else vars(module)[name]
        assert getattr(interface, name) is value
    with pytest.raises(AttributeError, match="has no attribute 'no_such_name'"):
        _ = interface.no_such_name


@pytest.mark.push
def test_parts_use_no_more_names_of_each_other() -> None:
    counts = part_interfaces.count_names()
    assert set(counts) <= set(INTERFACE_LIMITS)
    assert {
        part: counts[part] for part in counts if counts[part] > INTERFACE_LIMITS[part]
    } == {}


@pytest.mark.push
def test_no_string_names_a_layer_above() -> None:
    """Import contracts do not see such a name; code uses `hooks` instead."""
    names_by_file = {str(path): house.names_from_above(path) for path in house.files()}
    assert {path: names for path, names in names_by_file.items() if names} == {}


def test_every_hook_that_is_looked_up_is_registered() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in house.files())
    wanted = set(re.findall(r'find_hook\("([^"]+)"\)', sources))
    assert len(wanted) >= 5
    assert wanted == set(house.list_registered_hooks())
    assert all(callable(find_hook(hook)) for hook in wanted)


@pytest.mark.push
def test_no_modules_import_each_other_in_circles() -> None:
    graph = grimp.build_graph(*house.TOPS, cache_dir=None, exclude_type_checking_imports=True)
    see_through_interfaces(graph)
    modules = sorted(graph.modules)
    indices = {module: n for n, module in enumerate(modules)}
    imports = lil_matrix((len(modules), len(modules)), dtype=bool)
    for module in modules:
        for other in graph.find_modules_directly_imported_by(module):
            imports[indices[module], indices[other]] = True
    _, circles = connected_components(imports, directed=True, connection="strong")
    members = defaultdict(list)
    for module, circle in zip(modules, circles, strict=True):
        members[circle].append(module)
    assert [names for names in members.values() if len(names) > 1] == []


@pytest.mark.push
def test_contracts_see_the_modules_behind_interfaces() -> None:
    graph = grimp.build_graph(*house.TOPS, cache_dir=None)
    see_through_interfaces(graph)
    assert graph.direct_import_exists(
        importer="sites.site_process", imported="trilat_net.net.zenoh_bus"
    )
    assert graph.find_modules_directly_imported_by("trilat_net.net") == {"trilat_net.hooks"}
    assert not graph.chain_exists(
        importer="recorder", imported="trilat_net.core", as_packages=True
    )


def test_the_tour_names_existing_files() -> None:
    stops = re.findall(r"`([\w/]+\.py)`(?:: ((?:`[\w.]+`(?:, )?)+))?", TOUR)
    assert len(stops) > 25
    for file, names in stops:
        path = house.ROOT / file
        assert path.is_file(), file
        missing = set(re.findall(r"`([\w.]+)`", names)) - house.definitions(path)
        assert not missing, (file, missing)


def test_the_tour_is_short() -> None:
    assert TOUR.count("\n") <= 120


def test_the_readme_is_short() -> None:
    """The first 40 lines must hold what a newcomer needs: a picture, the purpose, the paper and two commands."""
    text = (house.ROOT / "README.md").read_text(encoding="utf-8")
    first_screen = "\n".join(text.splitlines()[:40])
    assert text.count("\n") <= 90
    assert len(text.split()) <= 1100
    assert len(re.findall(r"(?<!`)`[^`\n]+`", text)) <= 20
    assert first_screen.partition("![")[0].split() == ["#", "trilat-net"]
    assert {"docs/reference/references.md", "make demo", "make play"} <= set(
        re.findall(r"docs/reference/references\.md|make demo|make play", first_screen)
    )


def test_examples_import_the_interface_alone() -> None:
    """Readers of an example learn from it what their own program may use."""
    inside = re.compile(
        r"^\s*(?:from|import) (?:trilat_net\.(?!extension )|trilat_people|trilat_studies|trilat_ros2|sites|recorder)",
        re.MULTILINE,
    )
    assert not [
        path.name
        for path in (house.ROOT / "examples").rglob("*.py")
        if inside.search(path.read_text(encoding="utf-8"))
    ]
