"""Laws and arms from outside, executed from the log (L3)."""

import io
from pathlib import Path
from typing import Any

import pytest

from tests.execution.builders import (
    OTHER_PLATFORM,
    list_results,
    make_external_arm_bytes,
    make_log_without,
)
from tests.execution.deliveries import SITES, TICKS
from tests.log.builders import Record, edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.errors import LawFailed, ScenarioError, UsageError, join_arguments
from trilat_net.execution import virtual
from trilat_net.execution.log_checks import LogCheckReport
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import load_scenario
from trilat_net.scenario.run_changes import LinkTables, resolve_change

LAW = "tests.laws:Adaptive"
SHORT: dict[str, Any] = {"duration_s": 0.12, "link.delay_ms": 20.0}


def make_own_law_bytes(law: str = LAW, **more: Any) -> bytes:
    return make_log_bytes("paper", {**SHORT, "control.law": law, **more})


@pytest.mark.parametrize("name", ["paper", "asymmetric"])
def test_own_paper_law_gives_equal_bits(name: str) -> None:
    """Gains of the shipped scenarios are those of `tests.laws`."""
    ours = open_bytes(make_log_bytes(name, SHORT))
    theirs = open_bytes(make_log_bytes(name, {**SHORT, "control.law": LAW}))
    for site in ours.sites:
        for a, b in zip(ours[site].states, theirs[site].states, strict=True):
            # but for what a law from outside remembers
            assert list_results(a)[:-1] == list_results(b)[:-1]


@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
def test_incomplete_memory_is_found(session: dict[str, str] | None) -> None:
    """If no memory has to be restored the law passes; behind a gap, or tick by tick, it does not."""
    data = make_own_law_bytes("tests.laws:Forgetful")
    assert verify_log(open_bytes(data)).passed
    verdict = verify_log(make_log_without({"s": range(50, 61)}, data, session))
    assert verdict.first is not None
    assert verdict.first.field.startswith(("theta_hat", "tau"))


@pytest.mark.parametrize("law", [LAW, "adaptive"])
def test_restarted_sites_are_the_same(law: str) -> None:
    """Also after changes that were ordered while the run lasted, over a link whose delay varies."""
    link = {"model": "uniform", "delay_ms": 20.0, "half_width_ms": 10.0}
    scenario = load_scenario("paper", {"duration_s": 0.3, "control.law": law, "link": link})
    orders = [
        {"link": "m1->s", "to": {"model": "constant", "delay_ms": 30.0}},
        {"dominance": "s", "to": {"m1": 0.9, "m2": 0.1}, "ramp_s": 0.1},
    ]
    changes = [
        scenario.to_core_change(
            resolve_change(scenario, LinkTables(scenario.links, ()), order, 10**8)
        )
        for order in orders
    ]
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream, commands={"s": {50: changes}})
    verdict = verify_log(open_bytes(stream.getvalue()), resume_every=7)
    assert verdict.identical == verdict.records == 900


def test_hidden_memory_shows_at_a_restart() -> None:
    log = open_bytes(make_own_law_bytes("tests.laws:Forgetful"))
    assert verify_log(log).passed
    assert verify_log(log, resume_every=1000).passed
    verification = verify_log(log, resume_every=40)
    assert verification.first is not None
    assert verification.first.tick == 40


def test_reports_explain_hidden_memory() -> None:
    log = open_bytes(make_own_law_bytes("tests.laws:Forgetful"))
    (law,) = log.scenario.inspect_user_laws()[:1]

    def find_text(**settings: int) -> str:
        findings = LogCheckReport.of_log(log, virtual=False, **settings).findings
        return next(finding.text for finding in findings if finding.check == "executed again")

    verify_command = [
        "trilat",
        "verify",
        *log.sources,
        "--law",
        str(law.file),
        "--resume-every",
        "100",
    ]
    command = join_arguments(verify_command)
    assert find_text().endswith(f"to find it: {command}")
    assert "--resume-every" not in find_text(resume_every=1000)
    built_in = LogCheckReport.of_log(open_bytes(make_log_bytes("paper")), virtual=False)
    assert not [finding for finding in built_in.findings if "--resume-every" in finding.text]


def test_changed_memory_shows_at_its_tick() -> None:
    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("m2", 70):
            r["mem"][4] += 1e-3
        return r

    verdict = verify_log(open_bytes(edit_log_bytes(make_own_law_bytes(), record=record)))
    assert verdict.differing == 1
    assert (verdict.first.site, verdict.first.tick, verdict.first.field) == ("m2", 70, "mem")


@pytest.fixture
def file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Path:
    """Writes a law into the current folder, as a module of this test alone."""
    monkeypatch.chdir(tmp_path)
    name = "".join(letter for letter in request.node.name if letter.isalnum())
    file = tmp_path / f"law_{name}.py"
    file.write_text("from tests.laws import Adaptive\nclass Law(Adaptive):\n    pass\n")
    return file


def make_log_stream(file: Path) -> io.BytesIO:
    stream = io.BytesIO()
    virtual.write_virtual_log(
        load_scenario("two_sites", {"duration_s": 0.05, "control.law": f"{file.stem}:Law"}),
        stream,
    )
    stream.seek(0)
    return stream


def test_changed_files_are_judged_on_request(file: Path) -> None:
    stream = make_log_stream(file)
    log = open_log(stream)
    (law,) = log.scenario.inspect_user_laws()
    assert (law.sites, law.allowed, law.changed) == (("m", "s"), True, "")
    assert "is the one that ran" in str(law)
    file.write_text(file.read_text() + "# a word\n")
    (law,) = log.scenario.inspect_user_laws()
    assert not law.allowed
    assert f"--law {file} --other-version (it was changed" in str(law)
    verdict = verify_log(log)
    assert (verdict.withheld, verdict.records, verdict.agreed, verdict.passed) == (
        ["m", "s"],
        0,
        True,
        False,
    )
    with pytest.raises(UsageError, match="is not the file that ran"):
        reopen_log(stream, law=file)
    assert verify_log(reopen_log(stream, law=file, other_version=True)).passed
    file.write_text(file.read_text().replace("pass", "def memory(self): return [1.0]"))
    assert verify_log(reopen_log(stream, law=file, other_version=True)).first.field == "mem"


def reopen_log(stream: io.BytesIO, **how: Any) -> Log:
    stream.seek(0)
    return open_log(stream, **how)


def test_a_missing_file_names_the_remedy(file: Path) -> None:
    log = open_log(make_log_stream(file))
    file.unlink()
    (law,) = log.scenario.inspect_user_laws()
    assert str(law).endswith("external code, which may not run; if you trust it: --law FILE")
    assert verify_log(log).withheld == ["m", "s"]


def test_a_law_failing_only_now_is_a_difference(file: Path) -> None:
    stream = make_log_stream(file)
    wrong = "1 / 0 if now.k == 7 and self._facts.site == 's'"
    failing = f"def torque(self, now): return {wrong} else super().torque(now)"
    file.write_text(file.read_text().replace("pass", failing))
    log = open_log(stream, law=file, other_version=True)
    verdict = verify_log(log)
    assert (verdict.first.site, verdict.first.tick) == ("s", 7)
    assert "ZeroDivisionError" in str(verdict.first)
    assert (verdict.identical, verdict.differing, verdict.unjudged) == (50 + 7, 1, 42)
    assert compare_with_virtual(log).fed.first.tick == 7


FAILURES = {
    "nan": "torque[1] must be a finite number, but is nan",
    "raises": "ValueError: out of",
    "short": "torque has 1 number, not 2",
    "none": "TypeError",
    "remembers": "memory has 1025 numbers, but at most 1024 are allowed",
    "leaves": "SystemExit: 0",
}


@pytest.mark.parametrize("how", FAILURES)
@pytest.mark.parametrize("at", [0, 30])
def test_failing_laws_leave_a_finished_log(how: str, at: int) -> None:
    law = {"law": "tests.laws:Failing", "how": how, "at": at}
    stream = io.BytesIO()
    with pytest.raises(LawFailed) as caught:
        virtual.write_virtual_log(
            load_scenario("paper", {**SHORT, "sites.s.control": law}), stream
        )
    text = str(caught.value)
    assert text.startswith(
        f"the law tests.laws:Failing of s failed at tick {at}: {FAILURES[how]}"
    )
    assert "\n" not in text
    stream.seek(0)
    log = open_log(stream)
    assert log.complete
    assert [len(log[name]) for name in SITES] == [at + 1, at + 1, at]
    assert [event.text for event in log.events if event.kind == "failed"] == [text]
    assert {event.member: event.ticks for event in log.events if event.kind == "end"}["s"] == at
    verdict = verify_log(log)
    assert verdict.agreed
    assert verdict.identical == 3 * at + 2
    assert compare_with_virtual(log).fed.first is None


@pytest.mark.parametrize("session", [None, OTHER_PLATFORM])
def test_external_records_are_inputs(session: dict[str, str] | None) -> None:
    log = open_bytes(edit_log_bytes(make_external_arm_bytes(), session=session))
    assert log["s"].q[50].tolist() == [0.5, -0.3]
    verdict = verify_log(log)
    assert verdict.agreed
    assert verdict.identical == 2 * TICKS
    twins = compare_with_virtual(log)
    assert twins.fed.identical == 2 * TICKS
    assert twins.plain.records == 0


def test_external_arms_are_executed_behind_gaps() -> None:
    """As much can be judged as of a simulated arm."""
    verdict = verify_log(make_log_without({"s": range(40, 45)}, make_external_arm_bytes()))
    assert verdict.agreed
    ours = verify_log(
        make_log_without({"s": range(40, 45)}, make_log_bytes("two_sites", SHORT))
    )
    assert (verdict.identical, verdict.unjudged) == (ours.identical, ours.unjudged)


def test_another_measurement_gives_another_torque() -> None:
    def record(r: Record) -> Record:
        if (r["site"], r["tick"]) == ("s", 70):
            r["q"][1] += 1e-6
        return r

    verdict = verify_log(open_bytes(edit_log_bytes(make_external_arm_bytes(), record=record)))
    assert (verdict.first.site, verdict.first.tick) == ("s", 70)
    assert verdict.first.field.startswith("tau")


def test_virtual_time_has_no_external_arm() -> None:
    scenario = load_scenario("two_sites", {"sites.s.plant": "external"})
    with pytest.raises(ScenarioError, match="can only run live"):
        virtual.write_virtual_log(scenario, io.BytesIO())
    with pytest.raises(ScenarioError, match="can only run live"):
        next(virtual.execute_virtual(scenario))
