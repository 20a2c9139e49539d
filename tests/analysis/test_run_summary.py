"""The counts of `info`: messages, gaps and the time between messages, without decoding."""

import errno
import io
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import trilat_net
from tests.analysis.builders import (
    make_busy_run,
    make_diverged_log,
    make_log_without_hands,
    make_short_log,
)
from tests.log.builders import (
    add_clock_readings,
    drop_records,
    edit_log_bytes,
    make_log,
    make_log_bytes,
    replace_fields,
    rewrite_log,
    write_log,
)
from trilat_net import files
from trilat_net.analysis.file_overview import info, summarise_run
from trilat_net.errors import LogError
from trilat_net.log.findings import CheckReport, Finding


def parse_strictly(facts):
    """Parses JSON as strict programs do; NaN and arrays are errors."""
    return json.loads(json.dumps(facts, allow_nan=False))


def test_numbers_agree_with_the_records():
    log = make_short_log("paper")
    facts = parse_strictly(summarise_run(log, make_log_without_hands("paper")))
    for name in log.sites:
        states = log[name].states
        site = facts["sites"][name]
        errors = [max(abs(q - d) for q, d in zip(s.q, s.q_des, strict=True)) for s in states]
        assert site["records"] == site["expected_ticks"] == 400
        assert site["missing"] == 0
        assert site["q_end_rad"] == states[-1].q
        assert site["max_error_rad"] == max(errors)
        # the last second of two, at 200 Hz
        assert site["max_error_end_rad"] == max(errors[200:])
        assert site["peak_tau_nm"] == max(abs(t) for s in states for t in s.tau)
        assert site["saturated_ticks"] == 0
        moved = [
            [abs(a - b) for a, b in zip(s.q, t.q, strict=True)]
            for s, t in zip(states, make_log_without_hands("paper")[name].states, strict=True)
        ]
        assert site["hands_moved_max_rad"] == [max(joint) for joint in zip(*moved, strict=True)]
    link = facts["links"]["m2->s"]
    age = dict.fromkeys(("mean", "p50", "p95", "p99", "min", "max"), 200.0)
    assert link["age_ms"] == {**age, "deviation": 0.0}
    assert link["late_samples"] == 0
    assert link["stated"] == [
        {"from_s": 0.0, "link": "200 ms", "mean_ms": 200.0, "deviation_ms": 0.0}
    ]
    assert facts["changes"] == []
    assert facts["diverged"] is False
    assert facts["settle_s"] is None  # two seconds are not enough


def test_a_run_settles_with_its_last_site():
    def settle(state):
        off = 0.02 * (state.tick == 250 and state.site == "m2")
        return msgspec.structs.replace(state, q=[q + off for q in state.q_des])

    facts = summarise_run(rewrite_log(make_short_log("paper"), change=settle))
    assert [site["settle_s"] for site in facts["sites"].values()] == [0.0, 250 / 200, 0.0]
    assert facts["settle_s"] == 250 / 200


def test_loop_times_are_summarised():
    facts = summarise_run(add_clock_readings(make_short_log("four")))
    site = facts["sites"]["c"]  # 200 Hz: 400 ticks, late by 0 to 399 us
    assert site["late_us"]["p50"] == 199.5
    assert site["late_us"]["p99_9"] == pytest.approx(np.percentile(np.arange(400), 99.9))
    assert site["late_us"]["max"] == 399.0
    assert site["busy_us"] == {"p50": 7.0, "p99": 7.0, "max": 7.0}
    assert site["overruns"] == 0


def test_overruns_begin_at_a_whole_period():
    def late(state):
        return msgspec.structs.replace(
            state, late_us={10: 4999, 20: 5000, 30: 9000}.get(state.tick, 1)
        )

    facts = summarise_run(rewrite_log(make_short_log("paper"), change=late))
    # 200 Hz: 5000 us
    assert [site["overruns"] for site in facts["sites"].values()] == [
        2,
        2,
        2,
    ]


def test_saturation_is_counted():
    log = make_short_log("paper")
    limit = log.scenario.sites["m1"].limits.tau_limit_nm

    def cut(state):
        return msgspec.structs.replace(state, tau=[0.0, -limit]) if state.tick < 5 else state

    assert summarise_run(rewrite_log(log, change=cut))["sites"]["m1"]["saturated_ticks"] == 5


def test_divergence_is_reported_without_missing_records():
    facts = parse_strictly(summarise_run(make_diverged_log()))
    assert facts["diverged"] is True
    assert facts["missing"] == 0
    assert (
        0.0
        < min(s["diverged_at_s"] for s in facts["sites"].values() if s["diverged_at_s"])
        < 2.0
    )


def test_a_held_site_has_not_diverged():
    def hold(state):
        return replace_fields(state, mode="hold" if state.tick > 350 else "run")

    facts = parse_strictly(summarise_run(rewrite_log(make_short_log("paper"), change=hold)))
    assert facts["diverged"] is False
    assert facts["sites"]["m1"]["modes"] == [{"mode": "hold", "from_s": 351 / 200, "to_s": 2.0}]


def test_changes_are_reported_with_their_author():
    facts = parse_strictly(summarise_run(make_busy_run().log))
    changes = [
        (c["at_s"], c["about"], c["to"], c["site"], c["taken_at_tick"])
        for c in facts["changes"]
    ]
    assert changes == [
        (1.0, "a->c", "90 ms, loss 10 %", "c", None),
        (3.0, "c->a", "uniform 0 to 60 ms", "a", 500),
        (4.0, "shares of c", "a 0.9, b 0.1 within 1 s", "c", None),
    ]
    assert [s["from_s"] for s in facts["links"]["c->a"]["stated"]] == [0.0, 3.0]


def test_a_measured_link_states_no_delay():
    log = trilat_net.simulate(
        "two_sites", {"duration_s": 0.5, "rate_hz": 200, "link.model": "measured"}
    )
    facts = parse_strictly(summarise_run(log))
    for link in facts["links"].values():
        assert (link["delay_ms"], link["drawn_ms"], link["stated"][0]["mean_ms"]) == (
            None,
            None,
            None,
        )
        assert link["age_ms"]["max"] == 5.0
    assert set(facts["scenario"]["delay_ms"].values()) == {None}


def test_missing_records_are_counted():
    log = rewrite_log(
        make_short_log("paper"), keep=lambda s: s.site != "m2" or not 100 <= s.tick < 150
    )
    facts = summarise_run(log)
    assert [site["missing"] for site in facts["sites"].values()] == [0, 50, 0]
    assert facts["missing"] == 50


@pytest.mark.parametrize("records", [0, 1, 2])
def test_short_logs_have_nulls_and_no_nan(records):
    log = rewrite_log(make_short_log("paper"), keep=lambda s: s.tick < records, finished=False)
    facts = parse_strictly(summarise_run(log, make_log_without_hands("paper")))
    assert facts["session"]["complete"] is False
    for site in facts["sites"].values():
        assert site["records"] == records
        assert site["missing"] == 400 - records
        assert (site["q_end_rad"] is None) == (records == 0)
        assert (site["busy_us"]["max"] is None) == (records < 2)
    assert facts["links"]["s->m1"]["age_ms"]["p50"] is None
    assert facts["links"]["s->m1"]["late_samples"] == (0 if records else None)


WHOLE = make_log_bytes("paper")
STATE = "/trilat/paper/m1/state"


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sets(st.integers(0, 119), max_size=100))
def test_gaps_count_missing_records(tmp_path: Path, lost: set[int]) -> None:
    """Records missing behind the last one do not count, because no number reveals them."""
    path = write_log(tmp_path, edit_log_bytes(WHOLE, record=drop_records("m1", lost)))
    facts = info(path).facts["channels"][STATE]
    last = max(set(range(120)) - lost)
    named = {n for first, end in facts["gaps"] for n in range(first, end + 1)}
    assert named == {n for n in lost if n < last}
    assert facts["missing"] == len(named)
    assert facts["messages"] == 120 - len(lost)


def test_parts_are_counted_together(tmp_path: Path) -> None:
    halves = [lambda r: r if r["tick"] < 50 else None, lambda r: r if r["tick"] >= 50 else None]
    paths = []
    for n, half in enumerate(halves):
        paths.append(tmp_path / f"{n}.mcap")
        paths[-1].write_bytes(edit_log_bytes(WHOLE, record=half))
    overview = info(*paths)
    facts = overview.facts["channels"][STATE]
    assert (facts["messages"], facts["missing"]) == (120, 0)
    assert [file["finished"] for file in overview.facts["files"]] == [True, True]
    assert overview.facts["sites"]["m1"]["missing"] == 0


def test_progress_covers_the_file_once(tmp_path: Path) -> None:
    fractions: list[float] = []
    info(
        write_log(tmp_path, WHOLE), progress=lambda done, total: fractions.append(done / total)
    )
    assert fractions == sorted(fractions)
    assert 0.0 < fractions[0] < 0.5 < fractions[-1] <= 1.0


def test_an_unreadable_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        info(tmp_path)


def test_ticks_are_those_of_the_last_start() -> None:
    log = make_log("two_sites", {"duration_s": 0.2})
    last = next(event for event in log.events if (event.kind, event.member) == ("end", "s"))
    log.events.insert(0, msgspec.structs.replace(last, ticks=30, t_ns=0))
    assert summarise_run(log)["sites"]["s"]["made_ticks"] == last.ticks == 200


class _FailingDisk(io.BytesIO):
    """A file on a disk that fails in its middle."""

    def read(self, size: int | None = -1) -> bytes:
        if self.tell() > len(self.getbuffer()) // 2:
            raise OSError(errno.EIO, "Input/output error")
        return super().read(size)


def test_a_disk_that_fails_midway_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(tmp_path, make_log_bytes("two_sites"))
    opened = []

    def open_failing(path: Path) -> _FailingDisk:
        opened.append(_FailingDisk(path.read_bytes()))
        return opened[-1]

    monkeypatch.setattr(files, "open_regular", open_failing)
    with pytest.raises(LogError, match=r"run\.mcap cannot be read: Input/output error"):
        info(path)
    assert [stream.closed for stream in opened] == [True]


def test_a_report_of_checks_prints_its_findings() -> None:
    finding = Finding("records")
    finding.add("run.mcap", None, "three are missing")
    report = CheckReport([finding.conclude("all are there")])
    assert report.summary() == "records: three are missing"
    assert repr(report) == "<CheckReport records: three are missing>"
