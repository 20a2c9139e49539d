"""The measured delays of a log come back as a trace: what the records say, and nothing that they do not."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.log.builders import edit_log_bytes
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import first_tick_at, tick_ns
from trilat_net.execution import virtual
from trilat_net.execution.virtual_network import RecordedNetwork
from trilat_net.log.log_reader import read_link_delays
from trilat_net.scenario import load_scenario
from trilat_net.scenario.delay_traces import parse_trace

TICKS = 400
OVERRIDES: dict[str, Any] = {
    "duration_s": TICKS / 1000,
    "sites.m2.rate_hz": 333,
    "link.delay_ms": 50.0,
}
LOST = {7, 8, 9, 100}


def delay_us(peer: str, site: str, tick: int) -> int:
    """A known delay of each sample, 1 to 30 ms; some clocks are off, so that some are below zero."""
    drawn = np.random.default_rng([ord(c) for c in f"{peer}->{site}"] + [tick]).integers(
        1_000, 30_000
    )
    return -500 if (peer, tick) == ("m1", 40) else int(drawn)


def make_delayed_bytes() -> bytes:
    """A session in which every sample of every link but the lost ones came after its known delay."""
    scenario = load_scenario("paper", OVERRIDES)
    peers = {name: scenario.peers(name) for name in scenario.names}
    schedule: dict[str, dict[int, list[list[int]]]] = {name: {} for name in scenario.names}
    for site in scenario.names:
        rate_hz = scenario.sites[site].rate_hz
        for index, peer in enumerate(peers[site]):
            for tick in range(scenario.ticks(peer)):
                us = delay_us(peer, site, tick)
                at = first_tick_at(
                    tick_ns(tick, scenario.sites[peer].rate_hz) + max(us, 1) * 1000, rate_hz
                )
                if tick not in LOST:
                    schedule[site].setdefault(at, []).append([index, tick, us])
                if tick == 60:  # and once more, later
                    schedule[site].setdefault(at + 9, []).append([index, tick, us + 9000])
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream, RecordedNetwork(schedule, peers))
    return stream.getvalue()


@pytest.fixture(scope="module")
def data() -> bytes:
    return make_delayed_bytes()


@pytest.fixture
def path(data: bytes, tmp_path: Path) -> Path:
    file = tmp_path / "run.mcap"
    file.write_bytes(data)
    return file


@pytest.mark.parametrize(
    ("peer", "site"), [("m1", "s"), ("s", "m1"), ("m2", "s"), ("m1", "m2")]
)
def test_samples_have_their_recorded_delay(path: Path, peer: str, site: str) -> None:
    """By its own stamp; lost ones as infinity, negative ones as none, the shorter of two."""
    rate_hz = 333 if peer == "m2" else 1000
    rows = dict(read_link_delays(path, f"{peer}->{site}"))
    # some that were sent later were under way at the end
    known = (TICKS - 41) * rate_hz // 1000
    for tick in range(known):
        delay_ms = rows.pop((tick * 10**9 // rate_hz // 1000) / 1e6)
        expected = math.inf if tick in LOST else max(delay_us(peer, site, tick), 0) / 1e3
        assert delay_ms == expected
    assert not any(map(math.isinf, rows.values()))


@pytest.mark.parametrize("rate_hz", [1000, 333])
def test_replayed_logs_give_measured_delays(path: Path, rate_hz: int) -> None:
    """In [link] each link reads its own; to the microsecond, at any rate."""
    link = {"model": "trace", "file": str(path)}
    scenario = load_scenario("paper", {**OVERRIDES, "link": link})
    peer = "m2" if rate_hz == 333 else "m1"
    setup = scenario.setup("s")
    index = scenario.peers("s").index(peer)
    site = Site(setup)
    for tick in range(100):
        release = site.release_tick(index, tick)
        if tick in LOST:
            assert release is None
        else:
            due_ns = tick_ns(tick, rate_hz) + max(delay_us(peer, "s", tick), 0) * 1000
            assert release == first_tick_at(max(due_ns, tick_ns(tick, rate_hz) + 1), 1000)


def test_links_choose_their_delays_by_name(path: Path) -> None:
    shared = {"model": "trace", "file": str(path), "at_end": "loop"}
    links = load_scenario(
        "paper", {**OVERRIDES, "link": shared, "links.m1->s": {"of": "s->m1"}}
    ).links
    texts = {name: link.trace for name, link in links.items()}
    assert len(set(texts.values())) == 5
    assert texts["m1->s"] == texts["s->m1"]
    assert parse_trace(texts["m1->s"])[0, 1] == delay_us("s", "m1", 0)


def test_executed_scenarios_do_not_need_the_log(path: Path) -> None:
    scenario = load_scenario(
        "paper", {**OVERRIDES, "link": {"model": "trace", "file": str(path)}}
    )
    path.unlink()
    assert load_scenario(scenario, {"seed": 1}) == scenario
    assert "run.mcap" not in scenario.text


def test_delays_within_missing_records_are_left_out(data: bytes, path: Path) -> None:
    """A gap in the receiver's records hides arrivals: those samples are unknown, not lost."""
    path.write_bytes(
        edit_log_bytes(
            data, record=lambda r: None if r["site"] == "s" and 200 <= r["tick"] < 220 else r
        )
    )
    rows = read_link_delays(path, "m1->s")
    ticks = {round(t_s * 1000): delay_ms for t_s, delay_ms in rows}
    assert {tick for tick, delay_ms in ticks.items() if math.isinf(delay_ms)} == LOST
    came_in = {
        t: first_tick_at(t * 10**6 + delay_us("m1", "s", t) * 1000, 1000) for t in range(350)
    }
    hidden = {t for t in came_in if t not in ticks}
    assert hidden == {t for t, tick in came_in.items() if 200 <= tick < 220}


@pytest.mark.parametrize(
    ("link", "words"),
    [("m1->ss", "did you mean 'm1->s'"), ("x", "The links are m2->m1"), ("m1->m1", "no link")],
)
def test_missing_links_name_the_nearest(path: Path, link: str, words: str) -> None:
    with pytest.raises(ValueError, match="no link") as error:
        read_link_delays(path, link)
    assert words in str(error.value)


def test_links_without_arrivals_have_no_delays(data: bytes, path: Path) -> None:
    def silent(record: dict[str, Any]) -> dict[str, Any]:
        return {**record, "rx": [entry for entry in record["rx"] if entry[0] != 0]}

    path.write_bytes(edit_log_bytes(data, record=silent))
    with pytest.raises(ValueError, match="no sample arrived over m1->s"):
        read_link_delays(path, "m1->s")


def test_losses_at_both_ends_of_a_log_count(data: bytes, path: Path) -> None:
    """What its sender recorded and nobody received is lost; what it never sent is not."""
    quiet = {*range(30), *range(300, TICKS)}

    def cut(record: dict[str, Any]) -> dict[str, Any] | None:
        if record["site"] == "m1" and record["tick"] < 10:
            return None  # it came later
        if record["site"] == "s":
            record["rx"] = [
                entry for entry in record["rx"] if entry[0] != 0 or entry[1] not in quiet
            ]
        return record

    path.write_bytes(edit_log_bytes(data, record=cut))
    delay_ms = {round(t_s * 1000): ms for t_s, ms in read_link_delays(path, "m1->s")}
    known = TICKS - 41
    assert min(delay_ms) == 10
    assert {t for t, ms in delay_ms.items() if math.isinf(ms) and t < known} == {
        t for t in quiet | LOST if 10 <= t < known
    }
