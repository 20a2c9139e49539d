"""Commands and functions of other packages: the available names, and the messages for missing
or broken packages.
"""

import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

import trilat_net as tn
from tests.cli.running import trilat
from trilat_net import entry_points
from trilat_net.entry_points import COMMANDS, FUNCTIONS, HOOKS, VIEWS, find_entries
from trilat_net.errors import UsageError
from trilat_net.package_names import PACKAGE_COMMANDS, PACKAGE_FUNCTIONS, PACKAGE_HOOKS

ROOT = Path(__file__).parents[1]
Installs = Callable[..., None]


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Installs]:
    """Makes the entry points of this process those of a test; without any, no package is installed."""

    def install(group: str = "", **values: str) -> None:
        entries = [EntryPoint(name.replace("_", "-"), values[name], group) for name in values]

        def list_entries(group: str) -> list[EntryPoint]:
            return [entry for entry in entries if entry.group == group]

        monkeypatch.setattr(entry_points, "entry_points", list_entries)
        find_entries.cache_clear()

    yield install
    monkeypatch.undo()
    find_entries.cache_clear()


def read_entry_points(package: str) -> dict[str, dict[str, str]]:
    text = (ROOT / "packages" / package / "pyproject.toml").read_text(encoding="utf-8")
    entries: dict[str, dict[str, str]] = tomllib.loads(text)["project"]["entry-points"]
    return entries


@pytest.mark.parametrize("package", PACKAGE_COMMANDS)
def test_packages_register_their_documented_names(package: str) -> None:
    assert set(read_entry_points(package)[COMMANDS]) == set(PACKAGE_COMMANDS[package])
    functions = read_entry_points(package).get(FUNCTIONS, {})
    assert set(functions) == set(PACKAGE_FUNCTIONS.get(package, "").split())
    assert set(read_entry_points(package).get(HOOKS, {})) == set(
        PACKAGE_HOOKS.get(package, "").split()
    )
    for group, values in read_entry_points(package).items():
        assert {name: find_entries(group)[name].value for name in values} == values


@pytest.mark.parametrize("package", PACKAGE_COMMANDS)
def test_a_purpose_is_the_helps_beginning(package: str) -> None:
    for name, purpose in PACKAGE_COMMANDS[package].items():
        text = find_entries(COMMANDS)[name].load().__doc__.split("\n\n")[0]
        assert " ".join(text.split()) == purpose


def test_a_missing_package_is_named(installed: Installs, tmp_path: Path) -> None:
    installed()
    for package, commands in PACKAGE_COMMANDS.items():
        for name in commands:
            for more in (["--help"], ["--anything", "else"]):
                done = trilat(
                    *re.sub("^(experiment|identify)-", r"\1 ", name).split(),
                    *more,
                    cwd=tmp_path,
                )
                done.refuses(f"pip install {package}")
        listed = trilat("--help", cwd=tmp_path).succeeds()
        assert all(f" {name} " in listed for name in commands if "-" not in name)
    for package, names in PACKAGE_FUNCTIONS.items():
        for name in names.split():
            assert name in tn.__all__
            with pytest.raises(UsageError, match=f"pip install {package}"):
                getattr(tn, name)()


def test_other_packages_add_names_without_replacing_any(
    installed: Installs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = ModuleType("other_package")
    other.greeting = "hello"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "other_package", other)
    before = dir(tn)
    simulate = tn.simulate
    value = "other_package:greeting"
    installed(FUNCTIONS, greeting=value, simulate=value, sweep=value)
    assert tn.greeting == "hello"
    assert set(dir(tn)) - set(before) == {"greeting"}
    assert "greeting" not in tn.__all__
    assert tn.simulate is simulate
    with pytest.raises(UsageError, match="pip install trilat-studies"):
        tn.sweep()  # type: ignore[call-arg]
    installed(COMMANDS, sim=value, sweep=value, greet=value)
    assert "greet" in trilat("--help", cwd=tmp_path).succeeds()
    trilat("greet", cwd=tmp_path).refuses("trilat greet is not a command", "extension.command")
    assert "virtual time" in trilat("sim", "--help", cwd=tmp_path).succeeds()
    trilat("sweep", cwd=tmp_path).refuses("pip install trilat-studies")


def test_another_package_shows_a_log(
    installed: Installs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The viewer of that name gets the paths, by the command and by the function alike."""
    shown: list[list[Path]] = []
    other = ModuleType("other_package")
    other.show = lambda files: shown.append(list(files))  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "other_package", other)
    installed(VIEWS, curves="other_package:show", broken="no_such_package:show")
    log = ROOT / "tests" / "golden" / "live-paper.mcap"
    trilat("log", "view", log, "--in", "curves", cwd=tmp_path).succeeds()
    tn.view(log, viewer="curves")
    assert shown == [[log], [log]]
    trilat("log", "view", log, "--in", "broken", cwd=tmp_path).refuses("cannot be imported")
    unknown = trilat("log", "view", log, "--in", "other", cwd=tmp_path)
    unknown.refuses("no viewer 'other'", "broken, curves")
    both = trilat("log", "view", log, "--in", "curves", "--foxglove", cwd=tmp_path)
    both.refuses("--in cannot be combined")
    with pytest.raises(UsageError, match="viewer cannot be combined"):
        tn.view(log, viewer="curves", rviz=True)
    assert len(shown) == 2


def test_a_broken_package_stops_no_other_command(installed: Installs, tmp_path: Path) -> None:
    installed(COMMANDS, broken="no_such_package:command")
    assert "no_such_package" in trilat("--help", cwd=tmp_path).succeeds()
    trilat("scenario", "list", cwd=tmp_path).succeeds()
    trilat("broken", cwd=tmp_path).refuses("no_such_package", "cannot be imported")
    installed(FUNCTIONS, broken="no_such_package:function")
    with pytest.raises(UsageError, match="no_such_package"):
        tn.broken()


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = tn.no_such_name
