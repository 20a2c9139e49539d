"""Processes of a session start like those of a shell, and none survives, whichever dies first."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from numba.core import event

from tests.cli.running import trilat
from tests.live.processes import is_running
from tests.net.waiting import until
from trilat_net.app import demo_session
from trilat_net.app.process_starter import ProcessStarter, SessionProcess
from trilat_net.core.step.jit import COMPILING, compiling_notice
from trilat_net.core.step.kernel import site_tick
from trilat_net.scenario import load_scenario
from trilat_net.scenario.scenario_reader import read_shipped
from trilat_net.scenario.skeletons import name_skeleton_class
from trilat_net.signals import Interrupt

WAITS = ("record", "--session", "nobody", "--connect", "tcp/127.0.0.1:9", "-o", "run.mcap")


def test_compilations_are_announced_before_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """This holds also if loading the scenario has compiled and announced a part of the code before."""
    said: list[str] = []
    compiled = {"dispatcher": SimpleNamespace(py_func=site_tick.py_func)}

    def compile_in_two_parts(_scenario: object, _site: str) -> None:
        for _ in range(2):
            event.start_event("numba:compile", compiled)
            event.end_event("numba:compile", compiled)

    monkeypatch.setattr(demo_session, "is_core_cached", lambda: False)
    monkeypatch.setattr(demo_session, "warm_up", compile_in_two_parts)
    monkeypatch.setattr(compiling_notice, "report", compiling_notice.report)
    monkeypatch.setattr(compiling_notice, "is_reported", True)
    with Interrupt() as interrupt:
        demo_session.compile_core(load_scenario("two_sites"), said.append, interrupt)
    assert said == [COMPILING]


def make_starter(folder: Path) -> ProcessStarter:
    (folder / "paper.toml").write_text(read_shipped("paper"))
    return ProcessStarter(folder / "paper.toml", folder)


@pytest.fixture(scope="module")
def starter(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ProcessStarter]:
    with closing(make_starter(tmp_path_factory.mktemp("processes"))) as starter:
        yield starter


def wait_for_end(starter: ProcessStarter, process: SessionProcess) -> SessionProcess:
    until(lambda: starter.poll() or process.code is not None)
    return process


def start_waiting(starter: ProcessStarter, name: str) -> SessionProcess:
    process = starter.start(name, WAITS)
    until(
        lambda: (
            starter.poll()
            or (process.output.exists() and "waiting for" in process.output.read_text())
        )
    )
    return process


def find_parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_processes_run_their_words(starter: ProcessStarter, tmp_path: Path) -> None:
    show_process = wait_for_end(starter, starter.start("show", ["scenario", "show", "paper"]))
    refused = wait_for_end(
        starter, starter.start("site", ["site", "m9", "--scenario", "paper"])
    )
    assert (show_process.code, show_process.problem()) == (0, None)
    assert (
        show_process.output.read_text() == trilat("scenario", "show", "paper", cwd=tmp_path).out
    )
    assert refused.code == 2
    assert "site ended with code 2: " in str(refused.problem())
    assert "m9" in str(refused.problem())


def test_processes_have_own_name_session_and_signals(starter: ProcessStarter) -> None:
    process = start_waiting(starter, "recorder")
    assert process.pid is not None
    assert (
        Path(f"/proc/{process.pid}/cmdline")
        .read_text()
        .startswith("trilat record --session nobody ")
    )
    assert os.getsid(process.pid) == process.pid
    process.end(signal.SIGINT)
    assert (wait_for_end(starter, process).code, process.problem()) == (130, None)
    process.end(signal.SIGKILL)  # it has ended: nobody gets that


def test_a_killed_process_is_named_with_its_signal(starter: ProcessStarter) -> None:
    process = start_waiting(starter, "m1")
    os.kill(int(process.pid or 0), signal.SIGKILL)
    assert wait_for_end(starter, process).problem() == "m1 was killed by SIGKILL"


def test_unstarted_processes_end_with_their_starter(tmp_path: Path) -> None:
    with closing(make_starter(tmp_path)) as starter:
        process = starter.start("m1", WAITS)
        process.end(signal.SIGINT)
        assert wait_for_end(starter, process).problem() is None


def test_interrupted_starters_are_no_problem(tmp_path: Path) -> None:
    """An interpreter that a signal meets while it imports its first modules ends with code 1."""
    with closing(make_starter(tmp_path)) as starter:
        process = SessionProcess(starter, "m1", tmp_path / "m1.txt")
        process.output.write_text("KeyboardInterrupt")
        process.code = 1
        assert process.problem() == "m1 ended with code 1: KeyboardInterrupt"
        process.code = None
        process.end(signal.SIGINT)
        process.code = 1
        assert process.problem() is None


def test_signals_before_the_handler_end_copies(tmp_path: Path) -> None:
    """The starter forks and signals at once: none of ten copies loses the signal."""
    with closing(make_starter(tmp_path)) as starter:
        start_waiting(starter, "recorder")  # the starter serves orders
        processes = []
        for n in range(10):
            processes.append(starter.start(f"m{n}", WAITS))
            processes[-1].end(signal.SIGINT)
        assert [wait_for_end(starter, process).problem() for process in processes] == [
            None
        ] * 10


def test_processes_of_a_killed_starter_end(tmp_path: Path) -> None:
    with closing(make_starter(tmp_path)) as starter:
        process = start_waiting(starter, "m1")
        os.kill(find_parent(int(process.pid or 0)), signal.SIGKILL)
        assert wait_for_end(starter, process).problem() == "m1 was killed by SIGKILL"
    until(lambda: not is_running(int(process.pid or 0)))


def test_processes_end_with_their_requester(tmp_path: Path) -> None:
    starter = make_starter(tmp_path)
    processes = [start_waiting(starter, name) for name in ("m1", "recorder")]
    starter.close()
    assert not any(is_running(int(process.pid or 0)) for process in processes)


def test_failing_starters_give_their_reason(tmp_path: Path) -> None:
    with closing(ProcessStarter(tmp_path / "absent.toml", tmp_path)) as starter:
        process = wait_for_end(starter, starter.start("m1", WAITS))
    assert "absent.toml" in str(process.problem())


def test_no_user_code_runs_in_the_starter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Copies would not have the threads or devices of such code."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    )
    trilat("new", "law", "mylaw.py", cwd=tmp_path)
    file = tmp_path / "mylaw.py"
    file.write_text(file.read_text() + "\nopen('imported', 'a').close()\n")
    law = f'law = "mylaw:{name_skeleton_class("mylaw", "law")}"'
    (tmp_path / "own.toml").write_text(read_shipped("paper").replace('law = "adaptive"', law))
    with closing(ProcessStarter(tmp_path / "own.toml", tmp_path)) as starter:
        assert (
            wait_for_end(starter, starter.start("show", ["scenario", "show", "paper"])).code
            == 0
        )
    assert not (tmp_path / "imported").exists()
