"""Missing records and changed records keep a log from passing."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import msgpack
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.execution.builders import make_log_without
from tests.execution.deliveries import SITES, TICKS, make_delivered_bytes
from tests.log.builders import (
    drop_records,
    edit_log_bytes,
    make_log,
    make_log_bytes,
    open_bytes,
    write_log,
)
from tests.log.surgery import Pieces, Stored, repack_message, take_apart
from trilat_net.app.cli import options
from trilat_net.errors import LogError, ScenarioError
from trilat_net.execution.log_checks import LogCheckReport
from trilat_net.execution.verification import verify_log
from trilat_net.execution.what_if import rerun
from trilat_net.log.accounting import MIN_COVERAGE, Coverage
from trilat_net.log.log_reader import open_log
from trilat_net.log.running_digest import DigestState
from trilat_net.net.messages import Event

LATE = {("m1", 0, 20): 35, ("m2", 1, 30): 38, ("s", 0, 25): 39}
"""Samples that come late in another run of the same experiment: its motion differs from then on."""


@cache
def make_run_bytes(*, other: bool = False) -> bytes:
    return make_delivered_bytes(LATE if other else {})


def make_pieces(*, chained: bool, other: bool = False) -> Pieces:
    taken = take_apart(make_run_bytes(other=other))
    return taken if chained else taken.without_chain()


def is_refused(data: bytes, *, chained: bool) -> bool:
    """True if a log does not pass as whole and identical; a log with a chain, by the chain alone."""
    try:
        log = open_bytes(data)
        if chained:
            return not log.judge_integrity().passed
        return not LogCheckReport.of_log(log, virtual=False).passed
    except (LogError, ScenarioError):
        return True


def test_rewriting_without_changes_keeps_the_file() -> None:
    assert take_apart(make_run_bytes()).bytes() == make_run_bytes()
    log = open_bytes(make_run_bytes())
    assert log.judge_integrity().state is DigestState.INTACT
    assert LogCheckReport.of_log(log, virtual=True).passed
    old = open_bytes(make_pieces(chained=False).bytes())
    assert old.judge_integrity().state is DigestState.ABSENT
    assert LogCheckReport.of_log(old, virtual=True).passed


sites = st.one_of(st.sampled_from([(site,) for site in SITES]), st.just(SITES))
stretches = st.tuples(st.integers(1, TICKS - 2), st.integers(1, 30)).map(
    lambda x: range(x[0], min(sum(x), TICKS - 1))
)


def list_places(taken: Pieces, of: tuple[str, ...], ticks: range) -> list[int]:
    """Returns the places in a file of the records of some sites and ticks."""
    topics = taken.topics()
    wanted = {f"/trilat/free/{site}/state" for site in of}
    return [
        n
        for n, m in enumerate(taken.messages)
        if topics[m.channel] in wanted and m.sequence in ticks
    ]


def remove_records(draw: Callable, taken: Pieces) -> None:
    gone = set(list_places(taken, draw(sites), draw(stretches)))
    taken.messages = [m for n, m in enumerate(taken.messages) if n not in gone]


def splice_run(draw: Callable, taken: Pieces) -> None:
    """Returns a log that continues with another run from some tick on, over a gap or none."""
    k = draw(st.integers(TICKS // 2, TICKS - 5))
    gap = draw(st.integers(0, 3))
    other = take_apart(make_run_bytes(other=True)).messages
    topics = taken.topics()

    def is_record(m: Stored) -> bool:
        return topics[m.channel].endswith("/state")

    kept = [m for m in taken.messages if not is_record(m) or m.sequence < k]
    taken.messages = kept + [m for m in other if is_record(m) and m.sequence >= k + gap]


def replay_records(draw: Callable, taken: Pieces) -> None:
    """Returns a log with a repeated stretch: unchanged, or with the following tick numbers, in
    place of the original.
    """
    of = draw(sites)
    ticks = draw(stretches)
    again = [taken.messages[n] for n in list_places(taken, of, ticks)]
    if draw(st.booleans()):
        taken.messages += again
        return
    assume(ticks.stop + len(ticks) < TICKS)
    later = set(list_places(taken, of, range(ticks.stop, ticks.stop + len(ticks))))
    taken.messages = [m for n, m in enumerate(taken.messages) if n not in later]
    for message in again:
        tick = message.sequence + len(ticks)
        taken.messages.append(
            repack_message(message, tick=tick, t_ns=tick * 1_000_000, sent_ns=tick * 1_000_000)
        )


def renumber_records(draw: Callable, taken: Pieces) -> None:
    by = draw(st.integers(-40, 40).filter(bool))
    for n in list_places(taken, draw(sites), draw(stretches)):
        tick = taken.messages[n].sequence + by
        taken.messages[n] = repack_message(taken.messages[n], tick=tick)


def change_metadata(draw: Callable, taken: Pieces) -> None:
    """Changes, adds or removes an entry of any metadata, including a channel's; or removes all metadata."""
    entry = draw(
        st.sampled_from(
            [
                entry_of_file
                for entry_of_file in taken.about
                if hasattr(entry_of_file, "metadata")
            ]
        )
    )
    key = draw(st.sampled_from([*entry.metadata, "new"]))
    match draw(st.sampled_from(["change", "drop", "rename"])):
        case "drop" if key != "new":
            del entry.metadata[key]
        case "rename" if hasattr(entry, "name") and entry.name != "trilat.session":
            entry.name += "x"
        case _:
            entry.metadata[key] = entry.metadata.get(key, "") + draw(
                st.sampled_from(["0", " ", "s"])
            )


def change_description(draw: Callable, taken: Pieces) -> None:
    """Changes a byte of the scenario or of a schema."""
    entry = draw(
        st.sampled_from(
            [entry_of_file for entry_of_file in taken.about if hasattr(entry_of_file, "data")]
        )
    )
    index = draw(st.integers(0, len(entry.data) - 1))
    entry.data = entry.data[:index] + bytes([entry.data[index] ^ 1]) + entry.data[index + 1 :]


def change_one_message(draw: Callable, taken: Pieces) -> None:
    """Changes a time, or the telemetry of a record, which no execution computes; or removes any message."""
    n = draw(st.integers(0, len(taken.messages) - 1))
    message = taken.messages[n]
    match draw(st.sampled_from(["log_ns", "publish_ns", "telemetry", "out"])):
        case "telemetry" if "late_us" in msgpack.unpackb(message.payload):
            taken.messages[n] = repack_message(message, late_us=77)
        case "out":
            del taken.messages[n]
        case "publish_ns":
            taken.messages[n] = message._replace(publish_ns=message.publish_ns + 1)
        case _:
            taken.messages[n] = message._replace(log_ns=message.log_ns + 1)


OF_RECORDS = [remove_records, splice_run, replay_records, renumber_records]
ANY = [*OF_RECORDS, change_metadata, change_description, change_one_message]


def refuses_all(changes: list[Callable], *, chained: bool, examples: int) -> None:
    @settings(max_examples=examples)
    @given(st.data(), st.sampled_from(changes))
    def check(data: st.DataObject, change: Callable) -> None:
        taken = make_pieces(chained=chained)
        change(data.draw, taken)
        assert is_refused(taken.bytes(), chained=chained), change.__name__

    check()


@pytest.mark.push
def test_chained_logs_reveal_any_change() -> None:
    refuses_all(ANY, chained=True, examples=150)


def test_unchained_records_reveal_any_change() -> None:
    refuses_all(OF_RECORDS, chained=False, examples=40)


@pytest.mark.long
@pytest.mark.parametrize(("chained", "changes"), [(True, ANY), (False, OF_RECORDS)])
def test_of_500_changed_logs_none_passes(chained: bool, changes: list[Callable]) -> None:
    refuses_all(changes, chained=chained, examples=500)


def test_two_runs_over_a_gap_are_refused() -> None:
    """The same experiment and the same starts of its sites: another run follows the gap."""
    taken = make_pieces(chained=False)
    other = take_apart(make_run_bytes(other=True)).messages
    topics = taken.topics()
    taken.messages = [
        m for m in taken.messages if "state" not in topics[m.channel] or m.sequence < 60
    ]
    taken.messages += [m for m in other if "state" in topics[m.channel] and m.sequence >= 62]
    integrity = open_bytes(taken.bytes()).judge_integrity()
    assert integrity.state is DigestState.CHANGED
    assert "were removed or added" in integrity.text


def test_sparse_logs_fail_with_the_judged_share() -> None:
    log = make_log_without({"m1": range(2, 100)})
    verdict = verify_log(log)
    assert verdict.agreed
    assert not verdict.passed
    assert verdict.coverage.judged["m1"] < 25
    assert verdict.coverage.share < 0.2
    text = LogCheckReport.of_log(log, virtual=False).findings[0].text
    assert "m1" in text
    assert "less than 99.9 %" in text


def test_torn_logs_pass_no_more_than_asked() -> None:
    data = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=2048)
    log = open_bytes(data[: len(data) // 2])
    assert not verify_log(log).passed
    share = verify_log(log).coverage.share
    assert 0.1 < share < 0.9
    assert verify_log(log, min_coverage=share).passed
    assert not verify_log(log, min_coverage=share + 1e-6).passed
    whole = make_log_bytes("paper")
    unfinished = open_bytes(whole[: whole.index(b"trilat.chain")])
    assert unfinished.judge_integrity().state is DigestState.OPEN


def test_foreign_records_are_found_without_execution() -> None:
    """The two records behind a gap are not executed, but their start is compared."""

    def record(r: dict) -> dict | None:
        changed = {**r, "boot": 1} if (r["site"], r["tick"]) == ("s", 45) else r
        return drop_records("s", {43, 44})(changed)

    first = verify_log(open_bytes(edit_log_bytes(make_log_bytes("paper"), record=record))).first
    assert first is not None
    assert first[:3] == ("s", 45, "boot")


def test_a_claimed_rerun_is_executed_whole() -> None:
    def zeroed(r: dict) -> dict:
        return r if r["site"] == "s" else {**r, "tau": [0.0, 0.0]}

    claims = {"rerun_executed": "s", "rerun_mode": "open loop"}
    data = edit_log_bytes(make_log_bytes("paper"), record=zeroed, session=claims)
    assert not verify_log(open_bytes(data)).agreed
    worse = verify_log(open_bytes(edit_log_bytes(data, session={**claims, "driver": "rerun"})))
    assert worse.agreed  # its m1 and m2 met samples that are not in it
    assert worse.coverage.share == 0.0
    assert not worse.passed


def test_open_loop_reruns_are_judged_beside_logs(tmp_path: Path) -> None:
    write_log(tmp_path, make_log_bytes("free"))
    log_path = tmp_path / "again.mcap"
    rerun(tmp_path / "run.mcap", ["s"], {"control.Kd": 5}).save(log_path)
    verdict = verify_log(open_log(log_path))
    assert verdict.passed
    assert verdict.identical == 3 * TICKS
    forged = edit_log_bytes(
        log_path.read_bytes(),
        record=lambda r: {**r, "tau": [0.0, 0.0]} if r["site"] == "m1" else r,
    )
    log_path.write_bytes(forged)
    assert verify_log(open_log(log_path)).first[:3] == ("m1", 0, "record")
    # no more the file that the rerun names
    write_log(tmp_path, make_log_bytes("free") + b"x")
    alone = LogCheckReport.of_log(open_log(log_path), virtual=True)
    assert not alone.passed
    assert "not in the same folder" in "".join(line.text for line in alone.findings)


def test_lost_samples_excuse_virtual_time_afterwards() -> None:
    lost = frozenset({("m2", 1, tick) for tick in range(40, 60)})
    log = open_bytes(make_delivered_bytes({}, lost))
    report = LogCheckReport.of_log(log, virtual=True)
    assert report.passed, report.findings
    assert (
        "20 lost on the way, the first: sample 40 of s was due at tick 60 of m2 and never came"
        in (report.findings[-1].check)
    )
    assert "the first that differs" in report.findings[-1].text

    def record(r: dict) -> dict:
        return {**r, "tau": [r["tau"][0], r["tau"][1] + 1e-12]} if r["tick"] == 30 else r

    changed = LogCheckReport.of_log(
        open_bytes(edit_log_bytes(make_delivered_bytes({}, lost), record=record)), virtual=True
    )
    assert not changed.findings[-1].passed


def test_gaps_pass_with_possible_arrivals() -> None:
    lines = LogCheckReport.of_log(make_log_without({"m2": [50, 51]}), virtual=True).findings
    fed = next(line for line in lines if "fed" in line.check)
    assert fed.passed, fed


def test_coverage_is_the_least_of_all_sites() -> None:
    coverage = Coverage({"a": 1000, "b": 995}, {"a": 1000, "b": 1000, "c": 0})
    assert coverage.share == 0.995
    assert str(coverage) == "b 995 of 1000 ticks (99.5 %)"
    assert Coverage({}, {}).share == 0.0
    assert Coverage({"a": 0}, {"a": 0}).share == 0.0
    assert "99.999 %" in str(Coverage({"a": 10**7 - 1}, {"a": 10**7}))
    assert options.MIN_COVERAGE == MIN_COVERAGE


def test_lost_sites_end_where_last_seen() -> None:
    whole = make_log("paper")
    assert {whole.expected_ticks(site) for site in SITES} == {TICKS}
    data = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=2048)
    torn = open_bytes(data[: len(data) // 2])
    assert {torn.expected_ticks(site) for site in SITES} == {TICKS}  # nobody tells more
    last = int(torn["s"].tick[-1])
    torn.events.append(Event(member="m1", boot=1, t_ns=1, n=9, kind="lost", text="", about="s"))
    assert [torn.expected_ticks(site) for site in SITES] == [TICKS, TICKS, last + 1]
    torn.events.append(
        Event(member="m1", boot=1, t_ns=2, n=10, kind="back", text="", about="s")
    )
    assert torn.expected_ticks("s") == TICKS
