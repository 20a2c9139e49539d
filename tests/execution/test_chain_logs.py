"""Logs of arms of six joints: every record, executed again and in virtual time, has the same bits."""

import io
import math
from functools import cache

import pytest

from tests.chains import six_joints
from tests.log_editing import Record, edited, opened
from trilat_net.core.chain import LINK_PARAMETERS
from trilat_net.errors import LogError
from trilat_net.execution.verify import verify
from trilat_net.execution.virtual import write_virtual_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import Log
from trilat_net.scenario.scenario_reader import parse_scenario

N, TICKS = 6, 80


@cache
def made() -> bytes:
    """A run of which 20 ms are the delay of every link."""
    stream = io.BytesIO()
    write_virtual_log(parse_scenario(six_joints(TICKS / 1000)), stream)
    return stream.getvalue()


def changed(field: str, numbers: int) -> Log:
    """The log whose slave has that many numbers in a vector of one record."""

    def change(record: Record) -> Record:
        if (record["site"], record["tick"]) == ("s", 40):
            record[field] = (record[field] * 2)[:numbers]
        return record

    return opened(edited(made(), record=change))


def test_every_record_of_six_joints_is_executed_again_and_virtual_time_is_the_same() -> None:
    log = opened(made())
    verdict, twins = verify(log), compare_with_virtual(log)
    assert verdict.passed, str(verdict.first)
    assert verdict.identical == verdict.records == 3 * TICKS
    assert twins.fed.identical == twins.plain.identical == 3 * TICKS
    assert log["s"].used["m1"][-1] > TICKS // 2
    assert log["s"].q.shape == log["s"].q_des.shape == log["s"].tau_x.shape == (TICKS, N)
    assert log["s"].theta_hat.shape == (TICKS, LINK_PARAMETERS * N)
    assert (log["s"].q[-1] != log["s"].q[0]).all()


def test_a_gap_of_six_joints_is_resumed_from_two_records() -> None:
    log = opened(edited(made(), record=lambda r: None if r["site"] == "m2" and 30 <= r["tick"] < 33 else r))
    verdict = verify(log)
    assert verdict.agreed, str(verdict.first)
    assert verdict.gaps == [("m2", 30, 32)]


@pytest.mark.parametrize(("field", "numbers"), [("q", 5), ("q", 7), ("tau", 2), ("theta_hat", 5)])
def test_a_record_with_another_number_of_joints_is_refused(field: str, numbers: int) -> None:
    log = changed(field, numbers)
    with pytest.raises(LogError, match=f"a record of s cannot be read: .*{field} has {numbers} numbers, not"):
        verify(log)
    with pytest.raises(LogError, match="a record of s cannot be read"):
        getattr(log["s"], field)


def test_one_bit_of_the_last_joint_is_found() -> None:
    def change(record: Record) -> Record:
        if (record["site"], record["tick"]) == ("m1", 50):
            record["qd"][N - 1] = math.nextafter(record["qd"][N - 1], math.inf)
        return record

    first = verify(opened(edited(made(), record=change))).first
    assert first is not None
    assert (first.site, first.tick, first.field) == ("m1", 50, f"qd[{N - 1}]")
