"""A monitor shows the messages of a session's sites, and ignores those of strangers."""

import io

import msgspec
import numpy as np
import pytest

import trilat_net
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.app.monitor import LINES_NS, SessionDisplay, SessionMonitor
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.net import topics
from trilat_net.net.messages import Event
from trilat_net.net.session_members import SessionMembers
from trilat_net.net.timing import LoopStats
from trilat_net.net.wire import encode
from trilat_net.presentation.terminal_output import TextConsole
from trilat_net.scenario import load_scenario

SCENARIO = load_scenario("paper")
SITE = Site(SCENARIO.setup("m1"))
STATISTICS = LoopStats(SITE, 1).pop_stats(SITE.step(TickInput(0)))


@pytest.mark.parametrize("terminal", [False, True])
def test_strangers_messages_are_shown_or_ignored(terminal: bool) -> None:
    moved = trilat_net.simulate(SCENARIO, duration_s=0.01)["m1"]
    network = LocalNetwork()
    clock = ManualClock()
    mine = network.join()
    out = io.StringIO()
    display = SessionDisplay(TextConsole(file=out, force_terminal=terminal, width=200), clock)
    watch = SessionMonitor(SessionMembers(mine, clock, "t"), SCENARIO, display)
    stranger = network.join()

    def say(member: str, channel: str, payload: bytes) -> None:
        stranger.publisher(topics.key("t", member, channel))(payload)

    for junk in (b"", b"\xc1", bytes(70_000)):
        say("m1", topics.LINK, junk)
        say("m1", topics.EVENT, junk)
        say("m1", topics.STATE, junk)
    say("m1", topics.LINK, encode(msgspec.structs.replace(STATISTICS, mode="[/red]\x1b[7mX")))
    record = msgspec.structs.replace(moved.states[-1], mode="[/red]\x1b[7mX")
    say("m1", topics.STATE, b"".join([*moved.payloads[:-1], msgspec.msgpack.encode(record)]))
    say("nobody", topics.LINK, encode(msgspec.structs.replace(STATISTICS, site="nobody")))
    say(
        "m1",
        topics.EVENT,
        encode(Event(member="m1", boot=1, kind="lost", text="[/red] s is gone [x]")),
    )
    with display:
        watch.poll()
        assert list(watch.latest) == ["m1"]
        sleep_for_ns(clock, LINES_NS)
        watch.poll()
    assert out.getvalue().count("s is gone") == 1
    assert "[/red] s is gone [x]" in out.getvalue()
    assert "m1" in out.getvalue()
    assert "|e|" in out.getvalue()
    assert f"{np.linalg.norm(moved.e[-1]):.4f} rad" in out.getvalue()
    assert f"{np.abs(moved.tau[-1]).max():.2f} N m" in out.getvalue()
    assert "[/red]<U+001B>[7mX" in out.getvalue()
    assert "nobody" not in out.getvalue()
