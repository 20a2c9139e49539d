"""A visitor sees the members and their clock offsets; no member sees the visitor."""

import pytest

from tests.json_outline import is_documented
from tests.net.manual_clock import ManualClock
from tests.net.parties import SESSION, Member, Party, answer_info
from tests.net.waiting import sleep_for_ns
from trilat_net.app.ros2_ping import TopicDelays
from trilat_net.app.session_ping import GATHERING_NS
from trilat_net.errors import RunFailed
from trilat_net.net import topics
from trilat_net.net.clock import SkewedClock
from trilat_net.net.wire import encode

from .visits import S, Visit, link_stats, ping_publishers, ping_sites


def test_members_are_seen_without_waiting() -> None:
    party = Party(("m", "s"))
    party.start("m", "recorder")
    members = Visit(party).look().report().members
    assert [facts["member"] for facts in members] == ["m", "recorder"]
    assert all(facts["answers"] >= 10 for facts in members)
    assert all(
        (facts["same_clock"], facts["offset_ns"], facts["bound_us"]) == (True, 0, 0.0)
        for facts in members
    )
    assert party.members["m"].joining.membership.list_missing() == ["s"]
    party.start("s")
    party.agreed()


def test_another_clock_is_found() -> None:
    party = Party(("m", "s"))
    skewed_clock = SkewedClock(party.clock, 3 * S, 50_000)
    party.start("m")
    party.start("s", on_clock=skewed_clock)
    probe = Visit(party).look()
    (_, facts) = probe.report().members
    assert not facts["same_clock"]
    estimate = probe.pinger.estimate(probe.infos["s"].boot)
    bound_us = estimate.error_bound_ns(estimate.local_ns, estimate.offset_ns) / 1000
    assert (facts["offset_ns"], facts["bound_us"]) == (estimate.offset_ns, bound_us)
    now_ns = party.clock.monotonic_ns()
    truth = skewed_clock.monotonic_ns() - now_ns
    value = estimate.extrapolate_ns(now_ns)
    assert abs(truth - value) <= estimate.error_bound_ns(now_ns, value) + 2


def test_members_without_answer_lack_their_clock() -> None:
    party = Party(("m", "s"))
    party.start("m")
    questions = party.stranger.query_inbox(topics.key(SESSION, "s", topics.INFO))
    visit = Visit(party)
    for _ in range(20):
        visit.probe.poll()
        while (question := questions.poll()) is not None:
            question.reply(encode(answer_info("s", 9, clock="far away")))
        sleep_for_ns(party.clock, S // 10)
    facts = visit.look().report().members[-1]
    assert (facts["member"], facts["answers"]) == ("s", 0)
    assert not {"rtt_us", "jitter_us", "offset_ns", "bound_us"} & facts.keys()


def test_absent_sessions_end_after_the_given_time() -> None:
    party = Party(("m", "s"))
    probe = Visit(party).look(2 * S)
    assert probe.report().members == []
    assert 0 <= party.clock.monotonic_ns() - 10**9 - 2 * S <= S // 10


def test_running_sites_state_their_links() -> None:
    party = Party(("m", "s"))
    party.start("m")
    visit = Visit(party)
    stats = link_stats()
    for junk in (b"", b"\xc1", bytes(70_000)):
        party.say("m", junk, topics.LINK)
        party.say("m", junk, topics.INFO)
    party.say("m", encode(stats), topics.LINK)
    assert visit.look().links == {"m": stats}


def test_pings_wait_briefly_for_others() -> None:
    party = Party(("m", "s"))
    party.start("m")
    visit = Visit(party, count=5)
    member: Member | None = None
    while not visit.probe.is_over(S, visit.begun_ns):
        visit.probe.poll()
        for present in (party.members["m"], member):
            if present is not None:
                present.poll()
        sleep_for_ns(party.clock, 2_000_000)
        if member is None and party.clock.monotonic_ns() - visit.begun_ns > GATHERING_NS // 3:
            member = party.member("s")
    assert {facts["member"] for facts in visit.probe.report().members} == {"m", "s"}


def test_ping_json_is_as_documented() -> None:
    assert is_documented("ping", ping_sites().to_dict())


def test_ros_topic_delays_are_per_publisher() -> None:
    measurements = ping_publishers()
    first, second = measurements.publishers
    assert first["messages"] == 201
    assert (first["lost"], second["lost"]) == (0, 66)  # the last that it sent is no loss
    assert first["delay_us"] == {"min": 2000.0, "p50": 2000.0, "p99": 12000.0, "max": 12000.0}
    assert sum(first["histogram"]["counts"]) == 201
    assert first["rate_hz"] == pytest.approx(100.0, rel=0.01)
    text = measurements.summary()
    assert "std_msgs/msg/String" in text
    assert "the publisher's clock is ahead" in text  # of the second
    assert is_documented("ping --ros2", measurements.to_dict())


def test_silent_topics_are_reported() -> None:
    class Silent:
        def tap(self, topic: str, take: object) -> None:
            del topic, take

    with pytest.raises(RunFailed, match="no publisher sent a message on /chatter in 1 s"):
        TopicDelays.measure(Silent(), ManualClock(), "chatter", 1.0, lambda: False)  # type: ignore[arg-type]
