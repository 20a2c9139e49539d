"""The benchmark of a network: its measurements over known networks, and its conclusions."""

import json

import pytest

import trilat_net as tn
from tests.cli.running import trilat
from tests.json_outline import is_documented
from tests.net.local_bus import LocalNetwork
from trilat_net.app.network_benchmark import (
    SESSION,
    NearEnd,
    NetworkBenchmark,
    NetworkNeeds,
    answer_benchmarks,
    ping_benchmark,
)
from trilat_net.net import topics
from trilat_net.results import Result

from .far_end import answering_far_end
from .relay import Relay

MS = 1_000_000


class SlowFarEnd:
    """Returns every sample but some, after a fixed time."""

    def __init__(
        self, relay: Relay, network: LocalNetwork, trip_ns: int, lost_every: int = 0
    ) -> None:
        relayed = LocalNetwork()
        self.came = 0
        answer_benchmarks(relayed.join(), "far")
        forward = relayed.join()
        to_near = network.join().publisher(topics.key(SESSION, "far", topics.SAMPLE))
        forward.tap(
            "**",
            lambda _, payload: relay.happens(relay.now_ns + trip_ns, lambda: to_near(payload)),
        )
        ask = forward.publisher(topics.key(SESSION, "near", topics.SAMPLE))

        def take(_: str, payload: bytes) -> None:
            self.came += 1
            if not (lost_every and self.came % lost_every == 0):
                ask(payload)

        network.join().tap(topics.key(SESSION, "near", topics.SAMPLE), take)


@pytest.mark.parametrize("trip_ms", [0.4, 35.0])
def test_round_trips_are_those_of_the_network(trip_ms: float) -> None:
    relay = Relay()
    network = LocalNetwork()
    far = SlowFarEnd(relay, network, round(trip_ms * MS), lost_every=10)
    network.join().publisher(topics.key(SESSION, "other", topics.SAMPLE))(b"junk")

    def run(clock):
        near = NearEnd(network.join(), clock, "near")
        met = near.wait_for_far_end()
        begun_ns = clock.monotonic_ns()
        trips_s = near.measure(500, 1000, 0.2)
        return met, trips_s, clock.monotonic_ns() - begun_ns

    relay.add("near", run)
    met, trips_s, took_ns = relay.run()["near"]
    assert met
    assert far.came == 200 + far.came % 200
    lost = [trip for trip in trips_s if trip != trip]
    assert (len(trips_s), len(lost)) == (200, 20)
    assert trips_s[trips_s == trips_s] == pytest.approx(trip_ms / 1e3, rel=1e-12)
    assert took_ns <= 700 * MS + 35 * MS


def test_an_absent_far_end_is_reported() -> None:
    relay = Relay()
    network = LocalNetwork()
    relay.add("near", lambda clock: NearEnd(network.join(), clock, "near").wait_for_far_end())
    assert relay.run()["near"] is False


def make_row(needs, p99_ms: float, lost: int = 0) -> dict:
    times = {"p50": 500 * p99_ms, "p99": 1e3 * p99_ms, "max": 2e3 * p99_ms}
    facts = {"transport": "tcp", "bytes": needs.sample_bytes, "rate_hz": 1000.0, "sent": 1000}
    return {**facts, "lost": lost, "one_way_us": times}


@pytest.mark.long
def test_delay_margins_judge_a_network() -> None:
    """P+d at 200 ms tolerates up to 229.9 ms, docs/sessions/network-check.md, and its links hide shorter delays."""
    needs = NetworkNeeds.of_scenario(tn.load_scenario("p_d_margin"))
    margin = tn.linear("p_d_margin", ports=False).to_dict()["margin"]["stable"]
    assert needs.stable_ms == [
        [1e3 * window["from_s"], 1e3 * window["to_s"]] for window in margin
    ]
    edge_ms = needs.stable_ms[0][1]
    assert edge_ms == pytest.approx(229.9, abs=0.05)
    hidden = needs.judge(make_row(needs, 150.0))
    assert hidden["hidden"]
    assert (hidden["good"], hidden["age_ms"]) == (True, 200.0)
    assert hidden["spare_ms"] == pytest.approx(edge_ms - 200.0)
    near = needs.judge(make_row(needs, 228.4))
    assert (near["good"], near["hidden"], near["age_ms"]) == (True, False, 229.0)
    assert not needs.judge(make_row(needs, 230.0))["good"]
    assert not needs.judge(make_row(needs, 150.0, lost=2))["good"]
    assert not needs.judge({**make_row(needs, 1.0, lost=1000), "one_way_us": None})["good"]


def test_measured_links_add_their_play_out() -> None:
    needs = NetworkNeeds.of_scenario(
        tn.load_scenario("p_d_margin", {"link.model": "measured", "link.playout_ms": 40})
    )
    assert (needs.playout_ms, needs.held_ms, needs.in_use_ms) == (40.0, 40.0, None)
    assert needs.judge(make_row(needs, 12.3))["age_ms"] == 40.0
    assert needs.judge(make_row(needs, 41.3))["age_ms"] == 42.0
    assert needs.judge(make_row(needs, 41.3))["playout_ms"] == 83


def check_result(result: Result, transports: list[str]) -> None:
    facts = result.to_dict()
    assert [transport["transport"] for transport in facts["transports"]] == transports
    assert len(facts["rows"]) == 6 * len(transports)
    assert all(0 <= row["lost"] <= row["sent"] for row in facts["rows"])
    # a machine that stands still for half a second loses all of a row
    for row in facts["rows"]:
        assert (row["one_way_us"] is None) == (row["lost"] == row["sent"])
        assert (
            row["one_way_us"] is None
            or 0 < row["one_way_us"]["p50"] <= row["one_way_us"]["max"]
        )
    assert is_documented("ping --benchmark", facts)
    assert facts["connect"] or result.summary().startswith(
        "this machine alone, without a network"
    )
    assert len(result.to_frame()) == len(facts["rows"])


@pytest.mark.parametrize(
    ("connect", "line"),
    [
        ((), "this machine alone, without a network: name another machine with --connect"),
        (("tcp/192.0.2.1:7447",), "the network from this machine to tcp/192.0.2.1:7447"),
    ],
)
def test_the_first_line_names_the_measurement(connect: tuple[str, ...], line: str) -> None:
    needs = NetworkNeeds.of_scenario(tn.load_scenario("free"))
    network_benchmark = NetworkBenchmark("free", 1.0, needs, [], [], connect)
    assert network_benchmark.summary().startswith(line)
    assert network_benchmark.to_dict()["connect"] == list(connect)


@pytest.mark.long
def test_loopback_is_measured() -> None:
    with answering_far_end() as endpoint:
        check_result(ping_benchmark("p_d_margin", duration_s=1.0, connect=[endpoint]), ["tcp"])


@pytest.mark.long
def test_the_command_measures_all_transports_and_draws(tmp_path) -> None:
    arguments = [
        "--benchmark",
        "p_d_margin",
        "--seconds",
        "3",
        "--figure",
        "network.png",
        "--json",
    ]
    facts = json.loads(trilat("ping", *arguments, cwd=tmp_path).out)
    assert [transport["transport"] for transport in facts["transports"]] == [
        "tcp",
        "tls",
        "quic",
    ]
    assert (tmp_path / "network.png").stat().st_size > 10_000
    assert is_documented("ping --benchmark", facts)
