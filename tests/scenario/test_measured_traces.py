"""Traces measured by irtt, ping and others: their numbers, in each tool's own form."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.scenario.round_trips import RTT_NS, SENT_NS, write_irtt_file
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_models.kernel_delays import TraceDelay
from trilat_net.scenario.delay_traces import import_trace

IRTT_MEAN_NS = 16616803
"""The mean that irtt states for its five round trips (README of clarkzjw/LENS)."""
IRTT_DEVIATION_NS = 488290
"""The standard deviation that irtt states for the same round trips."""
PING = """PING sat (2605:59c8:1000:962f::1) 56 data bytes
[1700182800.410606] 64 bytes from 2605:59c8:1000:962f::1: icmp_seq=1 ttl=63 time=60.6 ms
[1700182800.421290] 64 bytes from 2605:59c8:1000:962f::1: icmp_seq=2 ttl=63 time=56.9 ms
[1700182800.442474] 64 bytes from 2605:59c8:1000:962f::1: icmp_seq=3 ttl=63 time=62.0 ms
[1700182800.443000] 64 bytes from 2605:59c8:1000:962f::1: icmp_seq=3 ttl=63 time=62.5 ms (DUP!)
[1700182800.475936] 64 bytes from 2605:59c8:1000:962f::1: icmp_seq=5 ttl=63 time=65.1 ms
"""
CICV5G = """pub_time(ms) sub_time(ms) delay(ms) utmX(m) rsrp(db)
1722584108452 1722584108474 22 329247.4 -73
1722584108506 1722584108539 33 329247.4 -73
1722584108561 1722584119061 10500 329247.4 -73
"""


@pytest.mark.parametrize("zipped", [False, True])
def test_irtt_round_trips_give_halves(tmp_path: Path, zipped: bool) -> None:
    trace = import_trace(write_irtt_file(tmp_path, zipped=zipped), "irtt")
    facts = trace.to_dict()
    assert facts["mean_ms"] == pytest.approx(0.5e-6 * IRTT_MEAN_NS, rel=1e-7)
    sample = facts["deviation_ms"] * math.sqrt(5 / 4)
    assert sample == pytest.approx(0.5e-6 * IRTT_DEVIATION_NS, rel=1e-5)
    assert [t_s for t_s, _ in trace.points] == pytest.approx(
        [(t - SENT_NS[0]) * 1e-9 for t in SENT_NS], abs=1e-6
    )
    assert import_trace(
        write_irtt_file(tmp_path), "irtt", way="whole"
    ).delay_ms == pytest.approx(np.array(RTT_NS) * 1e-6)


def test_irtt_losses_and_clock_differences_are_kept(tmp_path: Path) -> None:
    trace = import_trace(write_irtt_file(tmp_path, 1, 2), "irtt")
    assert [math.isinf(ms) for _, ms in trace.points] == [False, True, True, False, False]
    assert (trace.to_dict()["lost_percent"], trace.to_dict()["lost_in_a_row"]) == (40.0, 2.0)
    with pytest.raises(ScenarioError, match="clocks do not agree"):
        import_trace(write_irtt_file(tmp_path), "irtt", way="receive")
    assert import_trace(write_irtt_file(tmp_path), "irtt", way="send").too_long == 5


def test_pings_keep_gaps_and_times(tmp_path: Path) -> None:
    path = tmp_path / "ping.txt"
    path.write_text(PING)
    trace = import_trace(path, "ping")
    assert [ms for _, ms in trace.points] == [30.3, 28.45, 31.0, math.inf, 32.55]
    assert trace.points[1][0] == pytest.approx(
        0.421290 - 0.0569 - (0.410606 - 0.0606), abs=1e-6
    )
    path.write_text(PING.replace("[17001828", "x [17001828"))
    assert [t for t, _ in import_trace(path, "ping", every_s=0.2).points] == pytest.approx(
        [0.0, 0.2, 0.4, 0.6, 0.8]
    )


def test_pings_that_restart_counting_continue(tmp_path: Path) -> None:
    path = tmp_path / "ping.txt"
    lines = [
        f"64 bytes from 192.0.2.1: icmp_seq={n} ttl=63 time=2.0 ms"
        for n in (65534, 65535, 0, 2)
    ]
    path.write_text("\n".join(lines))
    assert [ms for _, ms in import_trace(path, "ping").points] == [1.0, 1.0, 1.0, math.inf, 1.0]


def test_cicv5g_tables_make_a_link(tmp_path: Path) -> None:
    path = tmp_path / "drive.txt"
    path.write_text(CICV5G)
    trace_of_link = import_trace(path, "csv", way="half")
    assert trace_of_link.points == ((0.0, 11.0), (0.054, 16.5), (0.109, 5250.0))
    whole = import_trace(path, "csv")
    assert whole.points == ((0.0, 22.0), (0.054, 33.0), (0.109, math.inf))
    assert whole.too_long == 1
    assert "1 took longer than 10 s and count as lost" in whole.summary()
    trace = tmp_path / "drive.csv"
    trace.write_text(whole.write_rows())
    link = load_scenario("free", {"link": {"model": "trace", "file": str(trace)}}).links[
        "m1->s"
    ]
    assert isinstance(link, TraceDelay)
    assert link.points.tolist() == [[0, 22000], [54000, 33000], [109000, -1]]


def test_columns_state_units_and_round_trips(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("timestamp_s,rtt_ms,uplink_ms\n0,20,12\n1,40,-1\n")
    assert [ms for _, ms in import_trace(path, "csv").points] == [10.0, 20.0]
    assert [ms for _, ms in import_trace(path, "csv", column="uplink_ms").points] == [
        12.0,
        math.inf,
    ]


def test_unknown_forms_and_ways_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="irtt, ping, csv"):
        import_trace(tmp_path, "xml")
    with pytest.raises(UsageError, match="half or whole"):
        import_trace(tmp_path, "ping", way="send")
    with pytest.raises(ScenarioError, match="cannot be read"):
        import_trace(tmp_path / "nowhere", "csv")
