"""Execution from a log: what is untouched is identical, what was touched is named (L3, L5)."""

import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.execution.builders import OTHER_PLATFORM, make_log_without
from tests.execution.deliveries import (
    SITES,
    TICKS,
    Sample,
    draw_gaps,
    first_in_first_out,
    make_delivered_bytes,
    never,
    under_way,
)
from tests.log.builders import Record, drop_records, edit_log_bytes, make_log_bytes, open_bytes
from trilat_net.core.step.site_setup import Layout
from trilat_net.execution.verification import RecordDifference, verify_log
from trilat_net.scenario import list_shipped

VECTORS = Layout().lengths()

ticks = st.one_of(st.sampled_from([0, 1, 2, TICKS - 2, TICKS - 1]), st.integers(0, TICKS - 1))


def flip_bit(value: float, bit: int) -> float:
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    return float(struct.unpack("<d", struct.pack("<Q", bits ^ (1 << bit)))[0])


def change_tick(
    site: str, tick: int, change: Callable[[Record], Any]
) -> Callable[[Record], Record]:
    """Changes one record in place."""

    def record(r: Record) -> Record:
        if r["site"] == site and r["tick"] == tick:
            change(r)
        return r

    return record


def find_first_difference(name: str = "paper", **changes: Any) -> RecordDifference:
    """The first difference of the log of a scenario that was changed as `edited` says."""
    first = verify_log(open_bytes(edit_log_bytes(make_log_bytes(name), **changes))).first
    assert first is not None
    return first


@pytest.mark.parametrize("name", list_shipped())
@pytest.mark.parametrize("scheme", ["second_order", "digital"])
def test_every_record_of_an_untouched_log_is_identical(name: str, scheme: str) -> None:
    log = open_bytes(make_log_bytes(name, {"duration_s": 0.5, "scheme": scheme}))
    verdict = verify_log(log)
    assert verdict.whole_run
    assert verdict.passed
    assert verdict.identical == verdict.records == 500 * len(log.sites)
    assert (verdict.unjudged, verdict.differing, verdict.gaps) == (0, 0, [])


def test_different_rates_are_identical() -> None:
    rates = {"sites.m1.rate_hz": 1000, "sites.m2.rate_hz": 700, "sites.s.rate_hz": 333}
    log = open_bytes(make_log_bytes("paper", {**rates, "duration_s": 0.5}))
    assert verify_log(log).identical == 500 + 350 + 166


def test_diverged_runs_are_identical_to_their_end() -> None:
    data = make_log_bytes("free", {"duration_s": 1.0, "limits.qd_limit_rad_s": 0.3})
    log = open_bytes(data)
    assert log["m1"].states[-1].tick < 999
    assert "diverged" in {log[name].states[-1].mode for name in log.sites}
    verdict = verify_log(log)
    assert verdict.identical == verdict.records


@settings(max_examples=40)
@given(
    site=st.sampled_from(SITES),
    field=st.sampled_from(sorted(VECTORS)),
    tick=ticks,
    entry=st.integers(0, 4),
    bit=st.one_of(st.just(0), st.just(63), st.integers(0, 51)),
)
def test_one_changed_vector_bit_is_named(
    site: str, field: str, tick: int, entry: int, bit: int
) -> None:
    index = entry % VECTORS[field]

    def change(r: Record) -> None:
        r[field][index] = flip_bit(r[field][index], bit)

    first = find_first_difference(record=change_tick(site, tick, change))
    assert first[:3] == (site, tick, f"{field}[{index}]")
    assert first.logged.hex() != first.computed.hex()


@settings(max_examples=15)
@given(site=st.sampled_from(SITES), tick=ticks, peer=st.integers(0, 1), bit=st.integers(0, 12))
def test_a_changed_bit_of_used_is_named(site: str, tick: int, peer: int, bit: int) -> None:
    name = [other for other in SITES if other != site][peer]

    def change(r: Record) -> None:
        r["used"][name] ^= 1 << bit

    assert find_first_difference(record=change_tick(site, tick, change))[:3] == (
        site,
        tick,
        f"used[{name}]",
    )


@settings(max_examples=20)
@given(
    site=st.sampled_from(SITES),
    tick=ticks.filter(bool),
    arrival=st.integers(0, 1),
    bit=st.integers(0, 12),
)
def test_one_changed_arrival_tick_is_named(
    site: str, tick: int, arrival: int, bit: int
) -> None:
    def change(r: Record) -> None:
        r["rx"][arrival][1] ^= 1 << bit

    first = find_first_difference(record=change_tick(site, tick, change))
    assert first[:2] == (site, tick)
    assert first.field.startswith("rx")


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["rx"].pop(),
        lambda r: r["rx"].append([0, 3, 0]),
        lambda r: r["rx"].reverse(),
        lambda r: r["rx"][0].__setitem__(0, 1),
        lambda r: r["rx"][0].__setitem__(0, 7),
        lambda r: r.update(rx_crc=r["rx_crc"] ^ 1),
    ],
    ids=["one less", "one more", "another order", "another peer", "no peer", "their CRC"],
)
@pytest.mark.parametrize("tick", [1, 50, TICKS - 1])
def test_other_arrivals_are_found_and_named(change: Callable[[Record], Any], tick: int) -> None:
    first = find_first_difference(record=change_tick("m2", tick, change))
    assert first[:2] == ("m2", tick)
    assert first.field.startswith("rx")


FIELDS = {"mode": "diverged", "cmd": ["stop"], "mem": [1.0], "t_ns": 50_000_001, "boot": 1}


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("tick", [0, 1, 50, TICKS - 1])
def test_any_changed_field_is_named(field: str, tick: int) -> None:
    """Also a field that nothing is computed from; the first boot of a site is that of its start."""
    record = change_tick("m2", tick, lambda r: r.update({field: FIELDS[field]}))
    named_tick = 1 if (field, tick) == ("boot", 0) else tick
    assert find_first_difference(record=record)[:3] == ("m2", named_tick, field)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Kd = [3.0, 3.0]", "Kd = [3.0, 3.0000000000000004]"),
        ("Kp = [1.0, 1.0]", "Kp = [1.0000000000000002, 1.0]"),
        ("Lambda = [1.0, 1.0]", "Lambda = [1.0, 1.0000000000000002]"),
        (
            "Gamma = [1.0, 1.0, 1.0, 1.0, 1.0]",
            "Gamma = [1.0, 1.0, 1.0, 1.0, 1.0000000000000002]",
        ),
        ("g_m_s2 = 9.81", "g_m_s2 = 9.810000000000002"),
        ("delay_ms = 20.0", "delay_ms = 20.001"),
        ('scheme = "second_order"', 'scheme = "digital"'),
    ],
)
def test_another_scenario_number_is_found(old: str, new: str) -> None:
    def scenario(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    assert find_first_difference("free", scenario=scenario).tick <= 25


def list_ranges(lost: set[int]) -> list[tuple[int, int]]:
    starts = sorted(t for t in lost if t - 1 not in lost)
    ends = sorted(t for t in lost if t + 1 not in lost)
    return list(zip(starts, ends, strict=True))


@pytest.mark.parametrize("site", SITES)
@pytest.mark.parametrize(
    "lost",
    [
        {0},
        {0, 1, 2},
        {1},
        {40},
        set(range(40, 45)),
        {40, 42},
        {10, 50, 51, 90},
        set(range(5, 80)),
        {TICKS - 1},
        set(range(TICKS - 10, TICKS)),
    ],
)
def test_execution_resumes_behind_a_reported_gap(site: str, lost: set[int]) -> None:
    verdict = verify_log(make_log_without({site: lost}))
    assert verdict.agreed, str(verdict.first)
    assert verdict.gaps == [(site, first, last) for first, last in list_ranges(lost)]
    assert verdict.records == 3 * TICKS - len(lost)
    assert verdict.identical + verdict.unjudged == verdict.records
    # two records to resume from at the site itself, and at each peer no more than what was lost
    assert verdict.unjudged <= sum(
        3 + 2 * (last - first + 4) for first, last in list_ranges(lost)
    )


@settings(max_examples=25)
@given(
    site=st.sampled_from(SITES),
    holes=st.lists(
        st.tuples(st.integers(0, TICKS - 2), st.integers(1, 12)), min_size=1, max_size=4
    ),
    whole_run=st.booleans(),
)
def test_gaps_are_never_a_false_alarm(
    site: str, holes: list[tuple[int, int]], whole_run: bool
) -> None:
    lost = {t for start, length in holes for t in range(start, start + length) if t < TICKS - 1}
    verdict = verify_log(
        make_log_without({site: lost}, session={} if whole_run else OTHER_PLATFORM)
    )
    assert verdict.agreed, str(verdict.first)
    assert [gap[1:] for gap in verdict.gaps] == list_ranges(lost)
    assert verdict.identical + verdict.unjudged == verdict.records


@settings(max_examples=12)
@given(delays=under_way, never=never)
def test_scattered_samples_are_no_difference(
    delays: dict[Sample, int], never: frozenset[Sample]
) -> None:
    verdict = verify_log(open_bytes(make_delivered_bytes(delays, never)))
    assert verdict.identical == verdict.records == 3 * TICKS


@settings(max_examples=20)
@given(delays=under_way, never=never, lost=draw_gaps(30, least=0), whole_run=st.booleans())
def test_gaps_with_lost_samples_are_no_difference(
    delays: dict[Sample, int],
    never: frozenset[Sample],
    lost: dict[str, set[int]],
    whole_run: bool,
) -> None:
    """On links that keep their order, as those of a session do."""
    data = make_delivered_bytes(first_in_first_out(delays), never)
    verdict = verify_log(make_log_without(lost, data, {} if whole_run else OTHER_PLATFORM))
    assert verdict.agreed, str(verdict.first)
    assert {gap[0] for gap in verdict.gaps} == set(lost)


def test_gaps_among_reordered_samples_are_no_difference() -> None:
    """Sample 45 comes at 53, after newer ones; record 50 is missing, and the first to be listed is 45."""
    delays = {("m2", peer, tick): way for peer in (0, 1) for tick, way in ((45, 8), (52, 5))}
    data = make_delivered_bytes(delays)
    verdict = verify_log(open_bytes(edit_log_bytes(data, record=drop_records("m2", {50}))))
    assert verdict.agreed, str(verdict.first)


def test_a_change_behind_a_gap_is_still_found() -> None:
    def record(r: Record) -> Record | None:
        if r["site"] == "m2" and r["tick"] == 90:
            r["tau"][0] = flip_bit(r["tau"][0], 0)
        return drop_records("m2", {40, 41})(r)

    assert find_first_difference(record=record)[:3] == ("m2", 90, "tau[0]")


def test_a_record_that_stands_twice_is_found() -> None:
    def record(r: Record) -> Record:
        return {**r, "tick": 50} if r["site"] == "m2" and r["tick"] == 51 else r

    assert find_first_difference(record=record)


@pytest.mark.parametrize("name", list_shipped())
def test_other_platforms_execute_from_two_records(name: str) -> None:
    data = make_log_bytes(name, {"duration_s": 0.5})
    verdict = verify_log(open_bytes(edit_log_bytes(data, session=OTHER_PLATFORM)))
    assert not verdict.whole_run
    assert verdict.agreed, str(verdict.first)
    assert verdict.identical == verdict.records


@pytest.mark.parametrize("field", sorted(VECTORS))
@pytest.mark.parametrize("tick", [0, 1, 60, TICKS - 1])
def test_other_platforms_find_changes_beyond_tolerance(field: str, tick: int) -> None:
    def change(r: Record) -> None:
        r[field][1] += 1e-6 * (1 + abs(r[field][1]))

    first = find_first_difference(
        "free", record=change_tick("m2", tick, change), session=OTHER_PLATFORM
    )
    assert first[:3] == ("m2", tick, f"{field}[1]")


def test_on_another_platform_rounding_is_no_difference() -> None:
    def record(r: Record) -> Record:
        r["tau"] = [v * (1 + 1e-13) for v in r["tau"]]
        return r

    assert verify_log(
        open_bytes(
            edit_log_bytes(make_log_bytes("free"), record=record, session=OTHER_PLATFORM)
        )
    ).passed


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_torn_logs_verify_while_whole(share: float) -> None:
    data = edit_log_bytes(make_log_bytes("paper"), chunk_bytes=2048)
    log = open_bytes(data[: int(share * len(data))])
    assert not log.complete
    verdict = verify_log(log)
    assert verdict.agreed, str(verdict.first)
    assert 0 < verdict.identical + verdict.unjudged == verdict.records < 3 * TICKS
    assert verdict.unjudged <= 3
