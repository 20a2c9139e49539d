"""What the command is as a process: pipes, Ctrl-C, what it imports."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.net.waiting import until
from trilat_net.files import STUDY_LIBRARIES

from .running import PLAIN, started, trilat


@pytest.mark.parametrize("command", [["scenario", "show", "paper"], ["sim", "--help"]])
def test_a_reader_that_had_enough_is_no_error(command: list[str], tmp_path: Path) -> None:
    process = started(*command, cwd=tmp_path)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert err == ""


def test_ctrl_c_while_computing_is_130_without_a_traceback(tmp_path: Path) -> None:
    process = started("sim", "paper", "--duration", "2000", "-o", "long.mcap", cwd=tmp_path)
    path = tmp_path / "long.mcap.active"
    until(lambda: path.exists() and path.stat().st_size > 100_000, timeout_s=60)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err


BLOCKED = """
import sys
for name in {blocked!r}:
    sys.modules[name] = None
import trilat_net, trilat_net.api, trilat_net.reporting.conclude, trilat_net.reporting.page, trilat_net.cli
from typer.testing import CliRunner
for arguments in {commands!r}:
    result = CliRunner().invoke(trilat_net.cli.app, arguments)
    assert result.exit_code == 0, (arguments, result.output, result.exception)
assert trilat_net.simulate("two_sites", set={{"duration_s": 0.1}})["m"].q.shape == (100, 2)
imported = {{name.partition(".")[0] for name, module in sys.modules.items() if module}}
assert not imported & {{"zenoh", "sites", "recorder"}}, imported
"""


def test_virtual_time_and_files_need_neither_posix_nor_zenoh(tmp_path: Path) -> None:
    program = BLOCKED.format(
        blocked=["fcntl", "resource", "pwd", "grp", "zenoh", "termios"],
        commands=[
            ["scenario", "check", "paper"],
            ["scenario", "new", "mine.toml"],
            ["sim", "two_sites", "--duration", "0.2", "-o", "run.mcap"],
            ["verify", "run.mcap", "--virtual"],
            ["figure", "run.mcap", "positions", "--format", "png"],
        ],
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=PLAIN, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr


ALONE = """
import sys
from importlib import import_module
from pkgutil import walk_packages
for name in {blocked!r}:
    sys.modules[name] = None
from trilat_net.cli import main
for top in {rooms!r}:
    for found in walk_packages(import_module(top).__path__, top + "."):
        import_module(found.name)
for arguments in {commands!r}:
    sys.argv = ["trilat", *arguments]
    try:
        main()
    except SystemExit as end:
        print("ended with", end.code or 0, *arguments)
"""
ROOMS = ("analysis", "cli", "core", "execution", "laws", "log", "net", "scenario")
NEED_STUDIES = (
    ("certify", "run.mcap"),
    ("report", "run.mcap"),
    ("figure", "run.mcap"),
    ("demo", "two_sites"),
    ("record", "--session", "x", "--conclude"),
    ("test", "two_sites", "--jobs", "1"),
    ("linear", "two_sites"),
)


def test_a_robot_needs_no_library_of_studies(tmp_path: Path) -> None:
    """All that it runs is imported without them; what needs one is refused before anything is done."""
    alone = [
        ("--help",),
        ("keys", "new", "keys", "m", "s"),
        ("sim", "two_sites", "--duration", "0.2", "-o", "run.mcap"),
        ("verify", "run.mcap"),
        ("metrics", "run.mcap"),
        ("log", "check", "run.mcap"),
    ]
    program = ALONE.format(
        blocked=[*STUDY_LIBRARIES, "pandas", "polars"],
        rooms=["sites", "recorder", "live", *(f"trilat_net.{room}" for room in ROOMS)],
        commands=[*alone, *NEED_STUDIES],
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=PLAIN, capture_output=True, text=True
    )
    ended = [line for line in done.stdout.splitlines() if line.startswith("ended with")]
    assert ended == [
        *(f"ended with 0 {' '.join(words)}" for words in alone),
        *(f"ended with 2 {' '.join(words)}" for words in NEED_STUDIES),
    ], done.stderr
    refused = done.stderr.splitlines()
    assert len(refused) == len(NEED_STUDIES), done.stderr
    assert all(
        line.endswith("which trilat-net-core does without: pip install trilat-net") for line in refused
    )
    assert {path.name for path in tmp_path.iterdir()} == {"keys", "run.mcap"}


def test_help_imports_nothing_heavy(tmp_path: Path) -> None:
    program = (
        "import sys, trilat_net.cli\n"
        "heavy = {'numba', 'numpy', 'zenoh', 'mcap', 'matplotlib', 'msgspec'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_text_with_square_brackets_is_printed_as_it_is(tmp_path: Path) -> None:
    done = trilat("sim", "[bold]x[/bold].toml", cwd=tmp_path)
    done.refuses("[bold]x[/bold].toml")
    done = trilat("sim", "two_sites", "--duration", "0.1", "-o", "[/red].mcap", cwd=tmp_path)
    assert done.code == 2, done  # "[" + "/red].mcap": a folder that is not there
    done = trilat("sim", "two_sites", "--duration", "0.1", "-o", "[red].mcap", cwd=tmp_path)
    assert "[red].mcap" in done.succeeds()
