"""An export is complete or absent, and replaces only the requested files."""

import ast
import errno
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests import house
from tests.install_extras import list_extras, parse_extras
from tests.other_systems import replace_os
from trilat_net import files
from trilat_net.app.api import choose_report_folder
from trilat_net.app.demo_session import create_file
from trilat_net.errors import LogRefused, UsageError
from trilat_net.files import (
    Extra,
    make_folder,
    make_results_folder,
    open_regular,
    refuse_existing,
    stage_output,
    write_whole,
)
from trilat_net.log.log_file import LogFile, sync_folder
from trilat_net.package_names import EXTRAS, STUDY_LIBRARIES, describe_missing_library
from trilat_net.presentation.export import EXPORT_MANIFEST
from trilat_net.work.run_journal import RunJournal


def read_folder(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else ""
        for path in sorted(folder.rglob("*"))
    }


def write_output(path: Path, text: str, *, folder: bool, force: bool = False) -> None:
    with stage_output(
        path, force=force, manifest=EXPORT_MANIFEST if folder else None
    ) as staged:
        (staged / EXPORT_MANIFEST if folder else staged).write_text(text)


@pytest.mark.parametrize("folder", [False, True])
def test_only_the_finished_output_remains(folder: bool, tmp_path: Path) -> None:
    write_output(tmp_path / "out", "1", folder=folder)
    expected_files = {"out": "", f"out/{EXPORT_MANIFEST}": "1"} if folder else {"out": "1"}
    assert read_folder(tmp_path) == expected_files
    with pytest.raises(
        UsageError, match="exists; choose another name, or replace it with force=True"
    ):
        write_output(tmp_path / "out", "2", folder=folder)
    assert read_folder(tmp_path) == expected_files
    write_output(tmp_path / "out", "3", folder=folder, force=True)
    assert read_folder(tmp_path) == {
        name: text and "3" for name, text in expected_files.items()
    }


def break_off(path: Path, error: BaseException, *, folder: bool) -> None:
    with stage_output(path, force=True, manifest=EXPORT_MANIFEST if folder else None) as staged:
        (staged / "half" if folder else staged).write_text("half")
        raise error


@pytest.mark.parametrize("folder", [False, True])
@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no")])
def test_failures_keep_the_former_files(
    folder: bool, before: bool, error: BaseException, tmp_path: Path
) -> None:
    if before:
        write_output(tmp_path / "out", "1", folder=folder)
    former_files = read_folder(tmp_path)
    with pytest.raises(type(error)):
        break_off(tmp_path / "out", error, folder=folder)
    assert read_folder(tmp_path) == former_files


def test_full_disks_have_an_exit_code(tmp_path: Path) -> None:
    with pytest.raises(LogRefused, match="No space left") as raised:
        break_off(
            tmp_path / "out", OSError(errno.ENOSPC, "No space left on device"), folder=False
        )
    assert raised.value.exit_code == 5
    assert read_folder(tmp_path) == {}


def test_foreign_folders_are_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years")
    with pytest.raises(UsageError, match="is not an exported folder"):
        write_output(tmp_path / "mine", "1", folder=True, force=True)
    with pytest.raises(UsageError, match="is not a file;"):
        write_output(tmp_path / "mine", "1", folder=False, force=True)
    (tmp_path / "notes").write_text("notes")
    with pytest.raises(UsageError, match="is not an exported folder"):
        refuse_existing(tmp_path / "notes", force=True, manifest=EXPORT_MANIFEST)
    assert read_folder(tmp_path)["mine/thesis.tex"] == "years"


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_output(tmp_path / "out", "1", folder=True)
    assert read_folder(tmp_path)[f"out/{EXPORT_MANIFEST}"] == "1"


def test_unwritable_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"out cannot be written: No such file"):
        write_output(tmp_path / "none" / "out", "1", folder=False)


def test_files_are_written_whole_or_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "report.json"
    write_whole(path, "1")
    with pytest.raises(UsageError, match="exists"):
        write_whole(path, "2", force=False)

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(LogRefused, match="No space left on device; make room") as raised:
        write_whole(path, "3", remedy="make room")
    assert raised.value.exit_code == 5
    assert read_folder(tmp_path) == {"report.json": "1"}


def test_open_files_stay_as_on_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows replaces no file that a program has open."""
    write_whole(tmp_path / "report.json", "1")

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(UsageError, match=r"report.json cannot be written: Permission denied"):
        write_whole(tmp_path / "report.json", "2")
    with pytest.raises(UsageError, match=r"report.json cannot be written: Permission denied"):
        write_output(tmp_path / "report.json", "3", folder=False, force=True)
    assert read_folder(tmp_path) == {"report.json": "1"}


def test_unsynced_folders_are_left_as_on_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows opens no folder."""

    def refuse(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(files, "os", replace_os(open=refuse))
    sync_folder(tmp_path)


@pytest.mark.push
def test_every_written_text_states_its_line_ends() -> None:
    """A stream of text translates line ends on Windows; `write_whole` and bytes do not."""
    calls = []
    for path in house.files():
        for call in (node for node in ast.walk(house.tree(path)) if isinstance(node, ast.Call)):
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            modes = [
                argument.value for argument in call.args if isinstance(argument, ast.Constant)
            ]
            writes = name == "write_text" or (
                name == "open" and {"w", "a", "x", "r+", "w+"} & {*modes}
            )
            if writes and "newline" not in {keyword.arg for keyword in call.keywords}:
                calls.append((path.name, call.lineno))
    assert not calls


@pytest.mark.parametrize("exists", [False, True])
@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_whole(path, b"1"),
        lambda path: create_file(path),
        lambda path: RunJournal[Any](path, "study", object, "make room"),
        lambda path: make_folder(path, may_be_link=False),
        lambda path: write_output(path, "1", folder=False, force=True),
        lambda path: write_output(path, "1", folder=True, force=True),
        lambda path: LogFile(path, force=True),
    ],
    ids=["whole", "create", "extend", "subfolder", "staged", "staged folder", "log"],
)
def test_no_output_is_written_through_a_link(
    write: Callable[[Path], object], exists: bool, tmp_path: Path
) -> None:
    if exists:
        (tmp_path / "real").write_text("years")
    (tmp_path / "linked").symlink_to(tmp_path / "real")
    with pytest.raises(
        UsageError, match="linked is a symbolic link, and no output is written through a link"
    ):
        write(tmp_path / "linked")
    assert (tmp_path / "linked").is_symlink()
    assert (
        read_folder(tmp_path) == {"linked": "years", "real": "years"}
        if exists
        else {"linked": ""}
    )


@pytest.mark.parametrize("name", ["out.unfinished", "out.mcap.active"])
def test_links_in_place_of_unfinished_files_are_removed(name: str, tmp_path: Path) -> None:
    (tmp_path / "real").write_text("years")
    (tmp_path / name).symlink_to(tmp_path / "real")
    write_whole(tmp_path / "out", "1")
    file = LogFile(tmp_path / "out.mcap", force=True)
    file.write(b"1")
    file.flush()
    file.end()
    assert (tmp_path / "real").read_text() == "years"


def test_hard_links_elsewhere_are_not_written_to(tmp_path: Path) -> None:
    for name in ("real", "out.mcap.active"):
        (tmp_path / name).write_text("years") if name == "real" else os.link(
            tmp_path / "real", tmp_path / name
        )
    file = LogFile(tmp_path / "out.mcap", force=True)
    file.write(b"1")
    file.flush()
    file.end()
    create_file(tmp_path / "out.mcap.active").close()
    assert (tmp_path / "real").read_text() == "years"


def test_system_devices_and_links_are_written_to() -> None:
    write_whole(Path("/dev/null"), b"1")
    write_whole(Path("/dev/stdout"), b"")
    assert not Path("/dev/null").is_file()


def test_endless_inputs_are_no_files(tmp_path: Path) -> None:
    """A pipe without a writer would wait for ever, and a device would be read for ever."""
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="a pipe or a device"):
            open_regular(path)
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path)
    (tmp_path / "file").write_text("text")
    with open_regular(tmp_path / "file", encoding="utf-8") as stream:
        assert stream.read() == "text"


def test_concurrent_outputs_get_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        folders = list(
            pool.map(lambda _: make_results_folder(None, "x", force=False), range(24))
        )
    assert len(set(folders)) == 24


def make_clone(folder: Path) -> None:
    """Makes a folder look like a clone in which the program runs from its sources."""
    for name in ("Makefile", "pyproject.toml"):
        (folder / name).write_text("")


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder from which the program seems to run."""
    monkeypatch.setattr(files, "__file__", str(tmp_path / "trilat_net" / "files.py"))
    return tmp_path


def test_an_installed_program_names_pip(program: Path) -> None:
    assert program.is_dir()
    assert Extra("view").install_command == "pip install 'trilat-net[view]'"


def test_a_clone_names_its_makefile(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_clone(program)
    monkeypatch.setattr(sys, "prefix", str(program / ".venv"))
    assert Extra("view").install_command == f"make -C {program} extras EXTRAS=view"
    monkeypatch.chdir(program)
    assert Extra("view").install_command == "make extras EXTRAS=view"


def test_a_clone_in_another_environment_names_pip(
    program: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_clone(program)
    monkeypatch.setattr(sys, "prefix", "/opt/lab")
    monkeypatch.setattr(sys, "executable", "/opt/lab/bin/python")
    hint = Extra("view").install_command
    assert hint == f"/opt/lab/bin/python -m pip install -e '{program}[view]'"


def test_every_named_extra_can_be_installed() -> None:
    named = {
        keyword
        for file in house.files()
        for keyword in re.findall(r'\bExtra\("(\w+)"', file.read_text(encoding="utf-8"))
    }
    without_packages = {"mat"}  # SciPy comes with the program
    assert {"view", "frames", "cluster", "stats"} <= named
    assert named <= list_extras().keys() | without_packages


@pytest.mark.parametrize("text", ["view", "view,frames", "view frames", " view , frames "])
def test_extras_stand_between_commas_or_spaces(text: str) -> None:
    assert parse_extras(text) == ["view", "frames"][: 1 + ("frames" in text)]


def test_unknown_extra_is_refused_with_all_names() -> None:
    with pytest.raises(SystemExit, match="there is no extra views") as error:
        parse_extras("views")
    for name in list_extras():
        assert f"  {name} " in str(error.value)


def test_no_extra_lists_all_names(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse_extras("")
    assert end.value.code == 0
    printed = capsys.readouterr().out
    for name in list_extras():
        assert f"  {name} " in printed


def test_the_locks_hold_every_extra() -> None:
    locked = (Path(__file__).parents[1] / "requirements" / "dev.lock").read_text(
        encoding="utf-8"
    )
    for needs in list_extras().values():
        for need in needs:
            assert f"\n{re.split('[><=]', need)[0]}==" in f"\n{locked}"


def test_optional_libraries_have_an_installing_extra() -> None:
    """The table agrees with pyproject.toml, whose names of packages may differ."""
    packages = {"rerun": "rerun-sdk", "mujoco": "mujoco-core"}
    text = (Path(files.__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    declared = {
        re.split("[><=]", package)[0]: name for name in extras for package in extras[name]
    }
    named = {packages.get(library, library): extra for library, extra in EXTRAS.items()}
    assert named == declared


@pytest.mark.parametrize("library", [*EXTRAS, *STUDY_LIBRARIES, "somewhere"])
def test_the_remedy_for_a_missing_library_installs_it(library: str) -> None:
    error = ModuleNotFoundError(f"No module named {library}.deeper", name=f"{library}.deeper")
    text = describe_missing_library("make_env", error)
    assert text.startswith(f"make_env needs {library}, ")
    remedy = f"pip install {library}"
    if library in EXTRAS:
        remedy = Extra(EXTRAS[library]).install_command
    elif library in STUDY_LIBRARIES:
        remedy = "pip install trilat-net"
    assert text.endswith(remedy)


HIDE = """
import sys
import tomllib
class Hiding:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == sys.argv[1]:
            raise ModuleNotFoundError("No module named " + name, name=name)
sys.meta_path.insert(0, Hiding())
import trilat_net as tn
for name in tn.__all__:
    text = getattr(getattr(tn, name), "__doc__", None) or ""
    if text.startswith("Is not available"):
        print(name, text)
"""


@pytest.mark.parametrize(
    ("library", "functions"),
    [
        ("gymnasium", {"make_env"}),
        ("scipy", {"compare", "figure", "identify_hand", "tune_arm"}),
        *(
            pytest.param(library, set(), marks=pytest.mark.long)
            for library in ("pandas", "polars", "pyarrow", "rerun", "distributed", "mujoco")
        ),
    ],
)
def test_without_a_library_only_dependents_are_missing(
    library: str, functions: set[str]
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", HIDE, library], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert {line.split()[0] for line in lines} == functions, done
    remedy = "pip install trilat-net"
    if library in EXTRAS:
        remedy = Extra(EXTRAS[library]).install_command
    assert all(f" {library}" in line and line.endswith(remedy) for line in lines)


def test_missing_libraries_of_libraries_are_distinguished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "optional_thing.py").write_text("import that_is_nowhere\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(
        UsageError, match="viewers need optional_thing, which needs that_is_nowhere: "
    ):
        Extra("view", "viewers").import_module("optional_thing")
    with pytest.raises(UsageError, match="viewers need not_there_at_all: "):
        Extra("view", "viewers").import_module("not_there_at_all")


@pytest.mark.parametrize("name", ["run.mcap", "run", "a.b.mcap", "run.mcap.active", ".run"])
def test_report_folders_are_never_the_log(name: str, tmp_path: Path) -> None:
    folder = choose_report_folder(tmp_path / name)
    assert folder != tmp_path / name
    assert folder.parent == tmp_path
    assert folder.name.startswith(name.removesuffix(".active").removesuffix(".mcap"))
