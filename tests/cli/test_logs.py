"""`sim`, `verify` and `report` on equal files, changed files and torn files."""

import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

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
    (lasted,) = re.findall(
        r"d.mcap: (\S+) s of m1, m2, s, of (?:\S+) s that were planned", done.out
    )
    assert f"at {lasted} s" in done.err
    log = open_log(tmp_path / "d.mcap")
    assert 0.0 < float(lasted) < log.scenario.duration_s
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


class Reported(NamedTuple):
    """A simulation over jittered links, and its report.

    Attributes:
        folder: Folder of the log `run.mcap`.
        log_bytes: The log before its report was made.
        printed: What `trilat report` printed.
    """

    folder: Path
    log_bytes: bytes
    printed: str


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    folder = tmp_path_factory.mktemp("reported")
    sim = ("sim", "two_sites", "--duration", "1", "--set", "rate_hz=200", "-o", "run.mcap")
    trilat(*sim, *JITTER, cwd=folder).succeeds()
    log_bytes = (folder / "run.mcap").read_bytes()
    return Reported(folder, log_bytes, trilat("report", "run.mcap", cwd=folder).succeeds())


@pytest.mark.long
def test_reports_lie_beside_logs_and_keep_files(reported: Reported) -> None:
    folder = reported.folder
    assert {path.name for path in (folder / "run").iterdir()} == {
        "report.html",
        "summary.json",
    }
    lines = reported.printed.splitlines()
    assert "  run/summary.json" in lines
    assert lines[-1] == "open first: run/report.html"
    page = (folder / "run" / "report.html").read_text(encoding="utf-8")
    assert page.lstrip().lower().startswith("<!doctype html")
    assert 'src="http' not in page  # it works offline
    assert json.loads((folder / "run" / "summary.json").read_text(encoding="utf-8"))
    trilat("report", "run.mcap", cwd=folder).refuses("is not empty", "--force")
    assert (folder / "run.mcap").read_bytes() == reported.log_bytes


@pytest.mark.long
def test_reports_print_judgement_and_checks(reported: Reported) -> None:
    text = reported.printed
    assert text.startswith("open undecided (record longer)")
    assert "400/400 records identical" in text
    assert "stability theorem of the paper (V: its energy function): " in text
    assert text.count("virtual time: no clock was read") == 1
    assert "late p50" not in text


@pytest.mark.long
def test_report_and_verify_print_the_same_links(reported: Reported) -> None:
    verified = trilat("verify", "run.mcap", cwd=reported.folder).succeeds()
    links, links_of_verify = (
        [line for line in text.splitlines() if line.startswith("link ")]
        for text in (reported.printed, verified)
    )
    assert links == links_of_verify
    stated = [line.partition("; effective ")[0] for line in links]
    assert stated == [
        "link s->m: stated uniform 10 to 90 ms",
        "link m->s: stated uniform 10 to 90 ms",
    ]


@pytest.mark.long
def test_pictures_of_a_report_are_listed(reported: Reported, tmp_path: Path) -> None:
    log = reported.folder / "run.mcap"
    output = trilat("report", log, "-o", "drawn", "--png", cwd=tmp_path).succeeds()
    pictures = {f"  drawn/{path.name}" for path in (tmp_path / "drawn").glob("*.png")}
    assert "  drawn/certificate.png" in pictures
    assert pictures <= set(output.splitlines())


@pytest.mark.long
def test_a_report_in_the_folder_keeps_its_log(log_file: Path) -> None:
    before = log_file.read_bytes()
    done = trilat("report", log_file, "-o", log_file.parent, "--force", cwd=log_file.parent)
    assert done.code == 0, done
    assert log_file.read_bytes() == before
    assert (log_file.parent / "report.html").exists()
