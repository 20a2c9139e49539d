"""The log of a rerun is sound, can be executed again, and names its source."""

import hashlib
import io
from pathlib import Path

import pytest

from tests.execution.builders import make_log_without
from tests.log.builders import make_log, make_log_bytes, write_log
from trilat_net.errors import UsageError
from trilat_net.execution.log_checks import LogCheckReport
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.execution.what_if import rerun
from trilat_net.log.log_reader import open_log
from trilat_net.net.messages import VERSION

from .deliveries import SITES, TICKS

GOLDEN = Path(__file__).parents[1] / "golden" / "v2.mcap"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_log(tmp_path, make_log_bytes("free"), "field.mcap")


def test_rerun_logs_name_source_and_differences(file: Path) -> None:
    after = rerun(file, ["s"], {"control.Kd": 5}).after
    session = after.session
    assert after.driver == "rerun"
    assert session["rerun_mode"] == "open loop"
    assert session["rerun_of"] == "field.mcap"
    assert session["rerun_of_sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert session["rerun_of_driver"] == "virtual"
    assert session["rerun_executed"] == "s"
    assert session["rerun_changes"] == "control.Kd of s: 3 -> 5"
    assert after.scenario.sites["s"].control.Kd == (5.0, 5.0)
    assert after.scenario.sites["m1"].control.Kd == (3.0, 3.0)
    assert after.scenario_sha256 == session["scenario_sha256"]


@pytest.mark.parametrize(
    "changes", [{}, {"control.Kd": 5, "link.delay_ms": 12.0}], ids=["same", "changed"]
)
def test_recorded_sites_stay_byte_for_byte(changes: dict[str, float]) -> None:
    log = make_log("free")
    after = rerun(log, ["s"], changes).after
    # it is in memory
    assert (after.session["rerun_of"], after.session["rerun_of_sha256"]) == (
        "",
        "",
    )
    for name in ("m1", "m2"):
        assert list(after[name].payloads) == list(log[name].payloads)
        assert after.link_stats(name) == log.link_stats(name)
        assert [e for e in after.events if e.member == name] == [
            e for e in log.events if e.member == name
        ]
    assert after.complete
    assert [e.ticks for e in after.events if e.kind == "end"] == [TICKS] * 3


@pytest.mark.parametrize("replace", [["s"], ["m1", "s"], list(SITES)], ids=" ".join)
def test_only_executed_sites_are_verified(replace: list[str]) -> None:
    after = rerun(make_log("free"), replace, {"control.Kd": 5}).after
    verdict = verify_log(after)
    assert after.executed_sites == tuple(sorted(replace))
    assert verdict.agreed, str(verdict.first)
    assert verdict.identical == verdict.records == TICKS * len(replace)
    lines = LogCheckReport.of_log(after, virtual=True).findings
    others = [name for name in SITES if name not in replace]
    assert [line.check for line in lines if not line.passed] == ["records"] * bool(others), (
        lines
    )
    assert all(name in lines[2].text for name in others)
    assert ("did not react" in lines[-1].text) == bool(others)


def test_a_closed_loop_is_virtual_time_again() -> None:
    twins = compare_with_virtual(
        rerun(make_log("free"), [], {"arm.m1_kg": 1.5}, closed_loop=True).after
    )
    for twin in (twins.fed, twins.plain):
        assert (twin.identical, twin.first) == (3 * TICKS, None)


def test_copied_records_are_not_judged() -> None:
    log = make_log_without({"s": [40, 41, 70], "m1": [40, 41, 42]})
    verdict = verify_log(rerun(log, ["s"]).after)
    assert verdict.agreed, str(verdict.first)
    assert [gap[1:] for gap in verdict.gaps] == [(40, 41), (70, 70)]


def test_older_logs_become_this_version() -> None:
    again = rerun(GOLDEN, ["m2"])
    for name in again.before.sites:
        for ours, theirs in zip(
            again.after[name].states, again.before[name].states, strict=True
        ):
            assert (ours.v, theirs.v) == (VERSION, 2)
            assert (ours.rx, ours.cmd) == (theirs.rx, theirs.cmd)
            # its sines were another library's
            for mine, old in (
                (ours.q, theirs.q),
                (ours.tau, theirs.tau),
            ):
                assert mine == (pytest.approx(old, abs=1e-9) if name == "m2" else old)
    assert verify_log(again.after).agreed
    assert {event.n for event in again.after.events if event.member == "s"} == set(range(4))


def test_reruns_can_be_rerun_within_limits(file: Path, tmp_path: Path) -> None:
    log_path = tmp_path / "again.mcap"
    rerun(file, ["s"], {"control.Kd": 5}).save(log_path)
    again = rerun(log_path, ["s"])
    assert again.identical
    other = rerun(log_path, ["m1"])  # met the s that was, and meets the one that is in the file
    assert not other.identical
    assert not other.broken
    assert any("is itself a rerun" in note and "m1" in note for note in other.notes)
    back = rerun(log_path, ["s"], {"control.Kd": 3})
    assert list(back.after["s"].q[-1]) == list(open_log(file)["s"].q[-1])


def test_an_existing_file_is_kept(file: Path) -> None:
    before = file.read_bytes()
    again = rerun(file, ["s"])
    with pytest.raises(UsageError, match="exists"):
        again.save(file)
    assert file.read_bytes() == before


def test_two_reruns_are_the_same_file(file: Path) -> None:
    written = []
    for _ in range(2):
        stream = io.BytesIO()
        rerun(file, ["s"], {"control.Kd": 5}).write(stream)
        written.append(stream.getvalue())
    assert written[0] == written[1]
