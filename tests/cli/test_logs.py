"""`sim`, `verify` and `report` on equal files, changed files and torn files."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from tests.log.builders import edit_log_bytes
from trilat_net.log.log_reader import open_log

from .running import trilat


def test_runs_of_one_seed_are_the_same_file(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        trilat("sim", "two_sites", "--duration", "1", "-o", name, cwd=tmp_path).succeeds()
    trilat(
        "sim", "two_sites", "--duration", "1", "-o", "c.mcap", "--seed", "2", cwd=tmp_path
    ).succeeds()
    a, b, c = ((tmp_path / name).read_bytes() for name in ("a.mcap", "b.mcap", "c.mcap"))
    assert a == b != c
    log = open_log(tmp_path / "a.mcap")
    assert (log.complete, log.driver, len(log["m"])) == (True, "virtual", 1000)


def test_existing_logs_are_kept_unless_forced(tmp_path: Path) -> None:
    path = tmp_path / "two_sites.mcap"  # the name that it has by default
    path.write_bytes(b"precious")
    trilat("sim", "two_sites", "--duration", "0.1", cwd=tmp_path).refuses(
        "two_sites.mcap", "--force"
    )
    assert path.read_bytes() == b"precious"
    trilat("sim", "two_sites", "--duration", "0.1", "--force", cwd=tmp_path).succeeds()
    assert open_log(path).complete


def test_a_diverging_run_exits_1(tmp_path: Path) -> None:
    done = trilat(
        "sim", "paper", "--set", "limits.qd_limit_rad_s=0.5", "-o", "d.mcap", cwd=tmp_path
    )
    done.refuses("diverged", "qd_limit_rad_s", code=1)
    log = open_log(tmp_path / "d.mcap")
    assert log.complete
    assert "diverged" in {event.kind for event in log.events}
    assert any(log[name].states[-1].mode == "diverged" for name in log.sites)
    trilat("verify", "d.mcap", cwd=tmp_path).succeeds()


def test_verify_compares_with_virtual_time_too(log_file: Path) -> None:
    text = trilat("verify", log_file, "--virtual", cwd=log_file.parent).succeeds()
    assert text.count("1500/1500 records identical") == 3
    assert "0 late samples" in text


def test_verify_names_the_first_different_record(log_file: Path, short_log: bytes) -> None:
    def record(r: dict[str, Any]) -> dict[str, Any]:
        if (r["site"], r["tick"]) == ("m2", 300):
            # the last bit of the first torque
            r["tau"][0] = math.nextafter(r["tau"][0], math.inf)
        return r

    log_file.write_bytes(edit_log_bytes(short_log, record=record))
    done = trilat("verify", log_file, cwd=log_file.parent)
    assert done.code == 1, done
    assert "1499/1500 records identical" in done.err
    for fact in ("m2", "300", "tau"):
        assert fact in done.err
    assert "Traceback" not in done.err


def test_verify_notices_another_gain(log_file: Path, short_log: bytes) -> None:
    def gain(text: str) -> str:
        assert "Kd = [3.0, 3.0]" in text
        return text.replace("Kd = [3.0, 3.0]", "Kd = [3.5, 3.0]", 1)

    log_file.write_bytes(edit_log_bytes(short_log, scenario=gain))
    done = trilat("verify", log_file, cwd=log_file.parent)
    assert done.code == 1, done
    assert "tau" in done.err
    assert "scenario" in done.err


def test_torn_logs_are_verified_as_far_as_whole(tmp_path: Path) -> None:
    path = tmp_path / "torn.mcap"
    trilat("sim", "paper", "--duration", "2", "-o", path, cwd=tmp_path).succeeds()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    records = sum(len(open_log(path)[name]) for name in ("m1", "m2", "s"))
    assert 0 < records < 6000
    done = trilat("verify", path, cwd=tmp_path)
    assert done.code == 1, done
    assert f"records: {records}/6000 in the file" in done.err
    assert "the file was not finished" in done.err
    assert "less than 99.9 %" in done.err
    assert f"{records}/{records} records identical" in done.out
    assert done.err.startswith("note: "), done
    assert f"trilat log recover {path}" in done.err
    assert trilat("verify", path, "--min-coverage", "0.3", cwd=tmp_path).code == 0
    trilat("verify", path, "--min-coverage", "2", cwd=tmp_path).refuses(
        "--min-coverage", "from 0 to 1"
    )


def test_log_torn_before_its_first_record_fails(log_file: Path, short_log: bytes) -> None:
    log_file.write_bytes(short_log[: len(short_log) * 2 // 3])  # inside its only chunk
    done = trilat("verify", log_file, cwd=log_file.parent)
    done_text = done.out + done.err
    assert done.code == 1, done
    assert "not finished" in done_text
    assert "no records to execute" in done.err


JITTER = (
    "--set",
    "link.model=uniform",
    "--set",
    "link.delay_ms=50",
    "--set",
    "link.half_width_ms=40",
)


@pytest.mark.long
def test_reports_lie_beside_logs_and_keep_files(tmp_path: Path) -> None:
    sim = ("sim", "two_sites", "--duration", "1", "--set", "rate_hz=200", "-o", "run.mcap")
    trilat(*sim, *JITTER, cwd=tmp_path).succeeds()
    before = (tmp_path / "run.mcap").read_bytes()
    text = trilat("report", "run.mcap", cwd=tmp_path).succeeds()
    assert text.startswith("open undecided (record longer)")
    assert text.splitlines()[-1] == "open first: run/report.html"
    assert "400/400 records identical" in text
    assert "late p50" not in text
    assert text.count("virtual time: no clock was read") == 1
    assert "stability theorem of the paper (V: its energy function): " in text
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html")
    assert 'src="http' not in page  # it works offline
    assert json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "report.html",
        "summary.json",
    }
    assert "  run/summary.json" in text.splitlines()
    output = trilat("report", "run.mcap", "-o", "drawn", "--png", cwd=tmp_path).succeeds()
    pictures = {f"  drawn/{path.name}" for path in (tmp_path / "drawn").glob("*.png")}
    assert "  drawn/certificate.png" in pictures
    assert pictures <= set(output.splitlines())
    links = [line for line in text.splitlines() if line.startswith("link ")]
    assert [
        line.partition(": stated uniform 10 to 90 ms; effective ")[0] for line in links
    ] == [
        "link s->m",
        "link m->s",
    ]
    verified = trilat("verify", "run.mcap", cwd=tmp_path).succeeds().splitlines()
    assert [line for line in verified if line.startswith("link ")] == links
    trilat("report", "run.mcap", cwd=tmp_path).refuses("is not empty", "--force")
    assert (tmp_path / "run.mcap").read_bytes() == before


@pytest.mark.long
def test_a_report_in_the_folder_keeps_its_log(log_file: Path) -> None:
    before = log_file.read_bytes()
    done = trilat("report", log_file, "-o", log_file.parent, "--force", cwd=log_file.parent)
    assert done.code == 0, done
    assert log_file.read_bytes() == before
    assert (log_file.parent / "report.html").exists()


def test_a_wrong_name_is_left_alone(tmp_path: Path) -> None:
    done = trilat(
        "sim", "two_sites", "--duration", "0.1", "-o", "/dev/full", "--force", cwd=tmp_path
    )
    done.refuses("/dev/full: already exists and is not a file")
