"""Samples go to peers at every tick, records to recorders in blocks, with equal contents."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.net.waiting import sleep_for_ns
from tests.scenario.builders import six_joint_text
from tests.sites.sessions import execute_packed, pack_log
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.net import topics
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.messages import PeerSample, State
from trilat_net.net.requests import ChangeRequest
from trilat_net.net.wire import decode, encode, split_states
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.scenario_reader import parse_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

A_SECOND = 1_000_000_000


def take_payloads(inbox: Inbox) -> list[bytes]:
    return [message[1] for message in iter(inbox.poll, None)]


def listen_to_sites(
    session: Session, sites: Sequence[str]
) -> tuple[dict[str, list[bytes]], dict[str, list[bytes]]]:
    """Returns the messages of every site until the session is over: samples and blocks."""
    samples: dict[str, list[bytes]] = {}
    blocks: dict[str, list[bytes]] = {}

    def listen(bus: Bus, clock: RelayClock) -> None:
        keys = [(name, channel) for name in sites for channel in (topics.SAMPLE, topics.STATE)]
        rings = {key: bus.inbox(topics.key(SESSION, *key)) for key in keys}
        sleep_for_ns(clock, 8 * A_SECOND)
        for (name, channel), ring in rings.items():
            (samples if channel == topics.SAMPLE else blocks)[name] = take_payloads(ring)

    session.stranger(listen)
    return samples, blocks


@pytest.mark.parametrize(
    "scenario",
    [
        load_scenario("two_sites", {"duration_s": 0.25, "sites.m.rate_hz": 333}),
        load_scenario("two_sites", {"duration_s": 0.1, "rate_hz": 4000}),
        parse_scenario(six_joint_text(0.25)),
    ],
    ids=["two joints", "four ticks a millisecond", "six joints"],
)
def test_samples_are_records_and_blocks_hold_10_ms(scenario: Scenario, tmp_path: Path) -> None:
    session = Session.whole(scenario, tmp_path)
    samples, blocks = listen_to_sites(session, scenario.names)
    log = session.run()
    assert verify_log(log).passed
    assert pack_log(log) == execute_packed(scenario)
    for name in scenario.names:
        small = [
            decode(payload, PeerSample, layout=scenario.layout(name))
            for payload in samples[name]
        ]
        split = [[*split_states(block)] for block in blocks[name]]
        assert [payload for block in split for payload in block] == log[name].payloads
        assert [sample.tick for sample in small] == list(range(scenario.ticks(name)))
        for sample, state in zip(small, log[name].states, strict=True):
            assert all(
                getattr(sample, f) == getattr(state, f) for f in PeerSample.__struct_fields__
            )
        stamps = [[decode(payload, State).t_ns for payload in block] for block in split]
        assert max(last[-1] - last[0] for last in stamps) < 10_000_000
        assert len(blocks[name]) < 0.4 * len(small)


def test_a_lost_block_is_filled_with_its_records(tmp_path: Path) -> None:
    scenario = load_scenario("two_sites", {"duration_s": 0.3})
    session = Session.whole(scenario, tmp_path)
    lost: list[bytes] = []
    join = session.network.join

    def join_lossy() -> Bus:
        bus = join()
        publisher = bus.publisher

        def dropping(key: str, *, patient: bool = False):  # type: ignore[no-untyped-def]
            publish = publisher(key, patient=patient)
            if key != topics.key(SESSION, "s", topics.STATE):
                return publish

            def send(payload: bytes) -> None:
                if 3 <= len(lost) < 5 or len(lost) < 2:
                    lost.append(payload)
                else:
                    lost.append(b"")
                    publish(payload)

            return send

        bus.publisher = dropping  # type: ignore[method-assign]
        return bus

    session.network.join = join_lossy  # type: ignore[method-assign]
    log = session.run()
    assert any(lost)
    assert len(log["s"]) == scenario.ticks("s")
    assert verify_log(log).passed
    refilled = log.recorder_stats()[-1].refilled["s/state"]
    assert refilled == sum(len([*split_states(block)]) for block in lost if block)


def ticks_that_hear(log: Log, name: str) -> list[int]:
    return [state.tick for state in log[name].states if state.rx]


@pytest.mark.parametrize(("delay_ms", "together"), [(99, 1), (100, 5)])
def test_samples_of_long_delays_come_together(
    delay_ms: int, together: int, tmp_path: Path
) -> None:
    scenario = load_scenario("two_sites", {"duration_s": 0.5, "link.delay_ms": delay_ms})
    log = Session.whole(scenario, tmp_path).run()
    assert pack_log(log) == execute_packed(scenario)
    for name in scenario.names:
        counts = [len(state.rx) for state in log[name].states if state.rx]
        assert counts[1:-1].count(together) > 0.8 * len(counts)
        assert max(counts) == together


def test_samples_of_another_clock_are_not_held(tmp_path: Path) -> None:
    scenario = load_scenario("two_sites", {"duration_s": 0.3})
    session = Session.whole(scenario, tmp_path, skews={"s": (1_000_000, 0)})
    log = session.run()
    assert all(
        len(ticks_that_hear(log, name)) > 0.9 * scenario.ticks(name) for name in scenario.names
    )


@pytest.mark.parametrize("at_ns", [3_000_000, 41_000_000, 99_000_000])
def test_a_delay_made_short_finds_no_sample_held(at_ns: int, tmp_path: Path) -> None:
    scenario = load_scenario("two_sites", {"duration_s": 1.0})
    session = Session.whole(scenario, tmp_path)

    def shorten(bus: Bus, clock: RelayClock) -> None:
        running = bus.inbox(topics.key(SESSION, "s", topics.SAMPLE))
        while running.poll() is None:
            sleep_for_ns(clock, 1_000_000)
        sleep_for_ns(clock, 200_000_000 + at_ns)
        order = ChangeRequest(link="m->s", to={"delay_ms": 1.0})
        answers = bus.query(topics.key(SESSION, "s", topics.SET), encode(order))
        while answers.poll() is None:
            sleep_for_ns(clock, 1_000_000)

    session.stranger(shorten)
    log = session.run()
    (taken,) = (state for state in log["s"].states if state.cmd)
    assert log.link_stats("s")[-1].late == {"m": 0}
    assert log["s"].states[-1].used["m"] == scenario.ticks("m") - 2
    assert ticks_that_hear(log, "s")[-50:] == list(
        range(scenario.ticks("s") - 50, scenario.ticks("s"))
    )
    assert taken.tick < 320 + at_ns // 1_000_000
