"""`trilat record --conclude`: the recorder judges its log, draws it, and says so with its exit code."""

import json
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

import recorder.record_process
from tests.cli.running import trilat
from tests.net.free_endpoints import find_free_endpoints
from trilat_net.execution.virtual import record_virtual
from trilat_net.log.log_writer import LogStorage
from trilat_net.scenario import load_scenario

from .processes import Session, Stage


@pytest.mark.long
def test_a_good_log_is_verified_and_reported(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "0.5", "--stay", "60")
    session.recorder("--conclude")
    for name in session.sites:
        session.site(name, "--needs-recorder")
    session.ends_well()
    printed = session.processes["recorder"].text()
    assert "ok   records: 1000/1000 in the file" in printed
    assert "1000/1000 records identical" in printed
    checks = json.loads((stage.folder / "summary.json").read_text(encoding="utf-8"))["checks"]
    assert all(check["passed"] for check in checks)
    assert (stage.folder / "report.html").exists()


@pytest.mark.long
def test_a_diverged_run_fails_despite_sound_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def recorded(storage: LogStorage, afterwards: Callable[[], None], **_others: object) -> int:
        assert not record_virtual(
            load_scenario("two_sites", {"limits.qd_limit_rad_s": 0.01}), storage.path
        )
        afterwards()
        return 0

    monkeypatch.setattr(recorder.record_process, "record_session", recorded)
    done = trilat("record", "--session", "x", "--conclude", cwd=tmp_path)
    failed = "".join(re.findall("^FAIL .*$", done.out, re.MULTILINE))
    assert re.match(r"FAIL not stable: diverged: \w+ joint \d", failed)
    assert (tmp_path / "runs" / "x-001" / "report.html").is_file()  # a folder of its own
    done.refuses("run.mcap", "diverged at t = ", code=1)


def test_a_port_in_use_leaves_no_folder(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        arguments = ("--conclude", "--listen", place, "--connect", *find_free_endpoints(1))
        done = trilat("record", "--session", "x", *arguments, cwd=tmp_path)
    done.refuses("the port is in use", code=done.code)
    assert done.code != 0
    assert not list((tmp_path / "runs").iterdir())


def test_the_report_of_another_log_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("another's", encoding="utf-8")
    done = trilat("record", "--session", "x", "--conclude", "-o", "x.mcap", cwd=tmp_path)
    done.refuses("report.html", "--force")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "another's"
