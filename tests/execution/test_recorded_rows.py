"""Logs that are verified by the compiled loop give the result of single ticks."""

import random
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.execution.builders import make_external_arm_bytes, make_log_without
from tests.log.builders import Record, edit_log_bytes, make_log, make_log_bytes, open_bytes
from trilat_net.core.step import recorded_ticks
from trilat_net.core.step.site_step import Site
from trilat_net.execution import recorded_rows, verification
from trilat_net.log.log_reader import Log
from trilat_net.scenario import list_shipped

FIELDS = "q qd q_des qd_des tau tau_x theta_hat used rx rx_crc mode mem cmd boot t_ns tick site"
SITES = ("m1", "m2", "s")
PAPER = make_log_bytes("paper", {"duration_s": 0.4, "link.delay_ms": 20.0})


def verify_singly(log: Log, **options: Any) -> verification.VerifyResult:
    """Verifies a log by `Site.step` alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification.SampleTable, "of_log", lambda _: None)
        return verification.verify_log(log, **options)


def assert_same_result(data: bytes, **options: Any) -> verification.VerifyResult:
    result = verification.verify_log(open_bytes(data), **options)
    assert result == verify_singly(open_bytes(data), **options)
    return result


def without_single_ticks(log: Log) -> verification.VerifyResult:
    """Verifies a log by the compiled loop alone."""

    def step(*_: Any) -> None:
        raise AssertionError("a tick was executed by itself")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Site, "step", step)
        return verification.verify_log(log)


@pytest.mark.parametrize("name", ["paper", "six_joints", "jitter", "contact", "unlike_arms"])
def test_untouched_records_need_no_single_tick(name: str) -> None:
    log = make_log(name, {"duration_s": 0.3})
    result = without_single_ticks(log)
    assert result.passed
    assert result.identical == sum(len(log[site]) for site in log.sites)


@pytest.mark.parametrize("name", list_shipped())
def test_both_ways_agree_on_shipped_scenarios(name: str) -> None:
    data = make_log_bytes(name, {"duration_s": 0.3})
    assert assert_same_result(data).passed
    assert_same_result(data, resume_every=50)


def test_both_ways_agree_on_arms_outside() -> None:
    assert assert_same_result(make_external_arm_bytes()).identical > 0


def spoil_record(record: Record, draws: random.Random) -> None:
    """Changes a field of a record."""
    name = draws.choice(FIELDS.split())
    value = record[name]
    match name:
        case "used":
            peer = draws.choice(sorted(value))
            value[peer] = draws.choice((value[peer] + 1, 0, -1, 10**6))
        case "rx" if value:
            value[draws.randrange(len(value))][draws.randrange(3)] += draws.choice((1, -1, 500))
        case "rx":
            value.append([draws.randrange(3), draws.randrange(400), 0])
        case "mode":
            record[name] = draws.choice(("hold", "diverged", "return"))
        case "mem":
            record[name] = [0.5] * draws.choice((1, 3))
        case "cmd":
            record[name] = draws.choice((["{}"], ["no"], ['{"link": "m2->m1"}']))
        case "site":
            record[name] = "m2"
        case "tick":
            record[name] = max(0, value - draws.choice((1, 2, 50)))
        case "rx_crc" | "boot" | "t_ns":
            record[name] = value + draws.choice((1, 2))
        case _:
            index = draws.randrange(len(value))
            value[index] = draws.choice((np.nextafter(value[index], 9.0), -0.0, 1e300))


@settings(max_examples=60)
@given(st.integers(0, 2**32))
def test_both_ways_agree_on_spoiled_records(seed: int) -> None:
    draws = random.Random(seed)
    spoiled = {(draws.choice(SITES), draws.randrange(400)) for _ in range(3)}
    dropped = {
        (draws.choice(SITES), draws.randrange(400)) for _ in range(draws.choice((0, 0, 1, 4)))
    }
    is_lasting = draws.random() < 0.2

    def change(record: Record) -> Record | None:
        place = (record["site"], record["tick"])
        if place in dropped:
            return None
        if place in spoiled or (is_lasting and record["tick"] > 200 and place[0] == "m1"):
            spoil_record(record, draws)
        return record

    assert_same_result(
        edit_log_bytes(PAPER, record=change), resume_every=draws.choice((0, 0, 30))
    )


def test_both_ways_agree_behind_gaps() -> None:
    log = make_log_without({"m1": range(100, 110), "s": [200, 202]}, PAPER)
    again = make_log_without({"m1": range(100, 110), "s": [200, 202]}, PAPER)
    result = verification.verify_log(log)
    assert result == verify_singly(again)
    assert result.unjudged > 0


def test_short_and_long_blocks_end_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = verification.verify_log(open_bytes(PAPER))
    monkeypatch.setattr(recorded_rows, "BLOCK_ROWS", 37)
    assert verification.verify_log(open_bytes(PAPER)) == expected


def test_calendars_that_are_too_short_are_replaced() -> None:
    changes = [{"at_s": 0.1, "link": "m2->m1", "to": {"delay_ms": 900.0}}]
    log = make_log(
        "paper", {"duration_s": 1.5, "link.delay_ms": 5.0, "timeline": changes, "expect": {}}
    )
    result = verification.verify_log(log)
    assert result.passed
    assert result == verify_singly(log)


@given(st.lists(st.integers(0, 2**64 - 1), max_size=9))
def test_the_checksum_is_that_of_zlib(numbers: list[int]) -> None:
    signed = np.array(numbers, np.uint64).view(np.int64).tolist()
    crc = 0xFFFFFFFF
    for word in signed:
        crc = recorded_ticks._update_checksum(crc, word)
    data = b"".join(word.to_bytes(8, "little") for word in numbers)
    assert crc ^ 0xFFFFFFFF == zlib.crc32(data)
