"""The command as a process: pipes, Ctrl-C, imports."""

import errno
import io
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pandas
import pytest

from tests.cli.running import start_command
from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import until
from tests.other_systems import prepare_process, replace_os
from trilat_net import __main__
from trilat_net.app import cli
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.package_names import STUDY_LIBRARIES
from trilat_net.scenario.scenario_reader import read_template

from .running import PLAIN, trilat


@pytest.mark.parametrize("command", [["scenario", "show", "paper"], ["sim", "--help"]])
def test_a_closed_pipe_is_no_error(command: list[str], tmp_path: Path) -> None:
    process = start_command(*command, cwd=tmp_path)
    assert process.stdout is not None
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert err == ""


def test_ctrl_c_while_computing_exits_130_quietly(tmp_path: Path) -> None:
    process = start_command(
        "sim", "paper", "--duration", "2000", "-o", "long.mcap", cwd=tmp_path
    )
    path = tmp_path / "long.mcap.active"
    until(lambda: path.exists() and path.stat().st_size > 100_000, timeout_s=60)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err


CALLED = """
import sys, threading
from trilat_net import __main__
from trilat_net.app import cli
from trilat_net.net.zenoh_bus import ZenohBus
called = threading.Event()
def take(key, payload):
    called.set()
    threading.Event().wait(0.001)
def run():
    bus.tap("key", take)
    assert called.wait(30.0)
    sys.exit(3)
bus = ZenohBus([], [sys.argv[1]])
cli.main = run
__main__.main()
"""


def test_exit_codes_survive_late_calls_of_zenoh() -> None:
    """The session is left open; the process would mostly be aborted, and sometimes even after
    closing the session.
    """
    endpoints = find_free_endpoints(1)
    with closing(ZenohBus(endpoints)) as bus:
        put = bus.publisher("key")
        process = subprocess.Popen([sys.executable, "-c", CALLED, *endpoints])
        while process.poll() is None:
            put(b"")
    assert process.returncode == 3


GOES_ON = """
import sys, zenoh
from trilat_net import __main__
from trilat_net.app import cli
cli.main = lambda: None
__main__.main()
sys.exit(5)
"""


def test_calling_programs_end_with_their_own_code() -> None:
    assert subprocess.run([sys.executable, "-c", GOES_ON], check=False).returncode == 5


PROGRAM = """
import sys
import trilat_net, trilat_net.__main__
for words in {commands!r}:
    sys.argv = ["trilat", *words]
    try:
        trilat_net.__main__.main()
    except SystemExit as end:
        undecided = words[0] == "certify"  # two seconds are too short for a verdict
        assert (end.code or 0) == undecided, (words, end.code)
assert trilat_net.simulate("two_sites", set={{"duration_s": 0.1}})["m"].q.shape == (100, 2)
assert "<table" in trilat_net.certify(trilat_net.open_log("run.mcap"))._repr_html_()
imported = {{name.partition(".")[0] for name, module in sys.modules.items() if module}}
assert not imported & {{"zenoh", "sites", "recorder", "live"}}, imported
"""


def run_commands_elsewhere(folder: Path, *commands: str) -> str:
    """Runs commands with only those modules that every system has; returns their output as UTF-8."""
    program = PROGRAM.format(commands=[command.split() for command in commands])
    env = {**PLAIN, **prepare_process(folder / "start")}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=env, capture_output=True
    )
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode("utf-8")


def test_logs_and_studies_need_only_portable_modules(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        read_template().replace('title = "', 'title = "θ → 0: '), "utf-8"
    )
    printed = run_commands_elsewhere(
        tmp_path,
        "scenario show mine.toml",
        "sim free --duration 2 -o run.mcap",
        "verify run.mcap --virtual",
        "certify run.mcap",
        "metrics run.mcap --json",
        "report run.mcap -o report",
        "log check run.mcap",
        "log export run.mcap --to csv",
        "sweep two_sites --over link.delay_ms=0:100:100 --duration 0.5 --jobs 1 -o one",
        "sweep two_sites --over link.delay_ms=0:100:100 --duration 0.5 --jobs 2 -o two",
        "bench --study round-trips --task contact --law p_d --link rtt8 --jobs 1",
    )
    assert "θ → 0" in printed
    assert len(list((tmp_path / "start").glob("*.process"))) >= 2  # of a worker too
    sweeps = [pandas.read_csv(tmp_path / name / "results.csv") for name in ("one", "two")]
    assert sweeps[0].equals(sweeps[1])


PROBE = """
where = {"__name__": "trilat_net.probe", "__package__": "trilat_net"}
for line in ("import fcntl", "import termios", "from signal import SIGKILL", "import os; os.fork",
             "import os; os.sched_getaffinity", "import socket; socket.AF_UNIX", "import resource",
             "import select; select.epoll", "from pathlib import Path; Path('text').write_text('')"):
    exec("import sys, os; assert (sys.platform, os.name) == ('win32', 'nt')", where)
    try:
        exec(line, where)
    except (ImportError, AttributeError, EncodingWarning):
        continue
    sys.exit(line)
"""


def test_unportable_modules_are_hidden(tmp_path: Path) -> None:
    """Otherwise the process above would prove nothing."""
    env = prepare_process(tmp_path / "start")
    subprocess.run([sys.executable, "-c", PROBE], cwd=tmp_path, env=env, check=True)


class Terminal(io.TextIOWrapper):
    """A terminal with the letters of Western Europe."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("kind", "printed"),
    [(io.TextIOWrapper, "±1 → ≥ 2\n".encode()), (Terminal, b"\xb11 \\u2192 \\u2265 2\n")],
)
def test_printed_text_has_letters_on_every_system(
    kind: type[io.TextIOWrapper], printed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    into = io.BytesIO()
    monkeypatch.setattr(sys, "argv", ["trilat"])
    monkeypatch.setattr(sys, "stdout", kind(into, encoding="cp1252", newline="\n"))
    monkeypatch.setattr(cli, "main", lambda: print("±1 → ≥ 2", flush=True))
    __main__.main()
    assert into.getvalue() == printed


@pytest.mark.parametrize(("name", "code"), [((), 0), (("a?b.mcap",), 2)])
def test_closed_pipes_and_bad_names_on_windows(
    name: tuple[str, ...], code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both are EINVAL on Windows."""

    def fail() -> None:
        raise OSError(errno.EINVAL, "Invalid argument", *name)

    monkeypatch.setattr(cli, "os", replace_os(dup2=lambda *_, **__: None))
    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == code


ALONE = """
import sys
from importlib import import_module
from pkgutil import walk_packages
for name in {blocked!r}:
    sys.modules[name] = None
from trilat_net.app.cli import main
for top in {rooms!r}:
    for found in walk_packages(import_module(top).__path__, top + "."):
        if not found.name.startswith({judges!r}):
            import_module(found.name)
for arguments in {commands!r}:
    sys.argv = ["trilat", *arguments]
    try:
        main()
    except SystemExit as end:
        print("ended with", end.code or 0, *arguments)
"""
ROOMS = ("analysis", "app.cli", "core", "execution", "laws", "log", "net", "scenario")
JUDGES = ("trilat_net.analysis.judge", "trilat_net.analysis.theory")
"""Modules for which `certify` needs SciPy, as pyproject.toml permits for the theory alone."""
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
    """Everything that a robot runs is imported without these libraries; commands that need one
    are refused at once.
    """
    alone = [
        ("--help",),
        ("keys", "new", "keys", "m", "s"),
        ("sim", "two_sites", "--duration", "0.2", "-o", "run.mcap"),
        ("verify", "run.mcap"),
        ("metrics", "run.mcap"),
        ("log", "check", "run.mcap"),
    ]
    program = ALONE.format(
        blocked=[*STUDY_LIBRARIES, "pandas", "polars", "websockets"],
        rooms=["sites", "recorder", *(f"trilat_net.{room}" for room in ROOMS)],
        judges=JUDGES,
        commands=[*alone, *NEED_STUDIES],
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=PLAIN, capture_output=True, text=True
    )
    ended = [line for line in done.stdout.splitlines() if line.startswith("ended with")]
    assert ended == [
        *(f"ended with 0 {' '.join(command)}" for command in alone),
        *(f"ended with 2 {' '.join(command)}" for command in NEED_STUDIES),
    ], done.stderr
    refused = done.stderr.splitlines()
    assert len(refused) == len(NEED_STUDIES), done.stderr
    assert all(
        line.endswith("which trilat-net-core does not include: pip install trilat-net")
        for line in refused
    )
    assert {path.name for path in tmp_path.iterdir()} == {"keys", "run.mcap"}


def test_help_imports_no_heavy_library(tmp_path: Path) -> None:
    program = (
        "import sys, trilat_net.app.cli\n"
        "heavy = {'numba', 'numpy', 'zenoh', 'mcap', 'matplotlib', 'msgspec', 'jinja2'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_square_brackets_are_printed_literally(tmp_path: Path) -> None:
    done = trilat("sim", "two_sites", "--duration", "0.1", "-o", "[/red].mcap", cwd=tmp_path)
    assert done.code == 2, done  # "[" + "/red].mcap": a folder that is not there
    done = trilat("sim", "two_sites", "--duration", "0.1", "-o", "[red].mcap", cwd=tmp_path)
    assert "[red].mcap" in done.succeeds()
