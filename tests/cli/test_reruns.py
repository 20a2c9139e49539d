"""`trilat rerun`: output, files, refusals and exit codes."""

import json
from pathlib import Path

import trilat_net
from tests.log.builders import edit_log_bytes
from trilat_net.log.log_reader import open_log

from .running import trilat


def test_an_unchanged_rerun_equals_the_log(log_file: Path) -> None:
    text = trilat("rerun", log_file, "--replace", "s", cwd=log_file.parent).succeeds()
    assert "open loop: s executed afresh; m1, m2 as recorded" in text
    assert "nothing is changed" in text
    (row,) = [line.split() for line in text.splitlines() if line.startswith("s ")]
    assert row[:3] == ["s", "500", "500"]
    assert "note" not in text


def test_changes_are_summarised_in_lines_that_fit(log_file: Path) -> None:
    done = trilat(
        "rerun", log_file, "--replace", "s", "--set", "control.Kd=5", cwd=log_file.parent
    )
    text = done.succeeds()
    for words in (
        "control.Kd of s: 3 -> 5",
        "rms e rad",
        "max tau N m",
        "s: q is up to",
        "s: the first difference is at tick 1 (0.001 s): tau[0] was",
        "note: m1 and m2 are as recorded: nothing is changed there, and they do not react",
    ):
        assert words in text
    assert max(map(len, text.splitlines())) <= 100


def test_closed_loops_have_a_row_per_site(log_file: Path) -> None:
    options = ("--closed-loop", "--set", "link.delay_ms=300")
    text = trilat("rerun", log_file, *options, cwd=log_file.parent).succeeds()
    assert "closed loop: m1, m2, s executed afresh\n" in text
    assert "every link: 200 ms -> 300 ms" in text
    assert (
        sum(
            line.split()[0] in ("m1", "m2", "s")
            for line in text.splitlines()
            if line[:1] in "ms"
        )
        == 3
    )
    assert "link m1->s: samples in use were 200 ms old" in text


def test_reruns_show_what_a_delay_costs(log_file: Path) -> None:
    """The column `undelayed` has the metric of the log and that of the written rerun."""
    options = ("--closed-loop", "--set", "link.delay_ms=300", "-o", "again.mcap")
    text = trilat("rerun", log_file, *options, cwd=log_file.parent).succeeds()
    header, row = [line for line in text.splitlines() if line.startswith(("site ", "s   "))]
    assert "undelayed: largest distance in rad from where the peers are" in text
    # "rms e rad", "max e rad" and "max tau N m" are names of more than one word
    column = header.replace(" e rad", "").replace(" tau N m", "").split().index("undelayed")
    for log, cell in zip(
        (log_file, log_file.parent / "again.mcap"), row.split()[column:], strict=False
    ):
        undelayed_rad = trilat_net.metrics(log).sites["s"]["undelayed_max_rad"].value
        assert cell == f"{undelayed_rad:#.3g}"


def test_every_command_reads_the_resulting_log(log_file: Path) -> None:
    cwd = log_file.parent
    options = ("--replace", "s", "--set", "control.Kd=5", "-o", "again.mcap")
    assert "again.mcap" in trilat("rerun", log_file, *options, cwd=cwd).succeeds()
    assert open_log(cwd / "again.mcap").driver == "rerun"
    text = trilat("verify", "again.mcap", "--virtual", cwd=cwd).succeeds()
    assert "1500/1500 records identical" in text
    assert "m1 and m2 stand as recorded" in text
    trilat("rerun", log_file, *options, cwd=cwd).refuses("again.mcap", "--force")
    trilat("rerun", log_file, *options, "--force", cwd=cwd).succeeds()
    trilat("log", "check", "again.mcap", cwd=cwd).succeeds()


def test_json_has_all_results(log_file: Path) -> None:
    options = ("--replace", "s", "--set", "control.Kd=5", "--json", "-o", "again.mcap")
    facts = json.loads(trilat("rerun", log_file, *options, cwd=log_file.parent).succeeds())
    assert facts["replaced"] == ["s"]
    assert facts["file"] == "again.mcap"
    assert facts["sites"]["s"]["executed"] == 500
    assert facts["sites"]["s"]["error_max_rad"]["before"] > 0.0


def test_diverging_sites_are_a_result_and_failure(log_file: Path) -> None:
    options = ("--replace", "s", "--set", "limits.qd_limit_rad_s=0.5", "--set", "control.Kd=0")
    done = trilat("rerun", log_file, *options, cwd=log_file.parent)
    assert done.code == 1, done
    assert "s: diverged at 0." in done.out


def test_a_log_differing_from_its_records_fails(log_file: Path, short_log: bytes) -> None:
    def record(r: dict[str, object]) -> dict[str, object]:
        if (r["site"], r["tick"]) == ("s", 300):
            r["tau"] = [1.0, 2.0]
        return r

    log_file.write_bytes(edit_log_bytes(short_log, record=record))
    done = trilat("rerun", log_file, "--replace", "s", cwd=log_file.parent)
    assert done.code == 1, done
    assert "tick 300" in done.out
