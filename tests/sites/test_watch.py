"""What a person sees of a session comes from its sites; what strangers say is nobody's."""

import io

import msgspec
import pytest
from rich.console import Console

from sites.display import LINE_EVERY, Display
from sites.watch import Watch
from trilat_net.core.site import Site
from trilat_net.core.tick import Tick
from trilat_net.net import topics
from trilat_net.net.bus import LocalNetwork
from trilat_net.net.stats import LoopStats
from trilat_net.net.wire import Event, encode
from trilat_net.scenario import load

SCENARIO = load("paper")
SITE = Site(SCENARIO.setup("m1"))
STATISTICS = LoopStats(SITE, 1, [1000, 1000]).take(SITE.step(Tick(0)))


@pytest.mark.parametrize("terminal", [False, True])
def test_whatever_strangers_say_is_shown_or_passed_over(terminal: bool) -> None:
    network = LocalNetwork()
    watch = Watch(network.join(), "t", SCENARIO.names)
    stranger = network.join()

    def say(member: str, channel: str, payload: bytes) -> None:
        stranger.publisher(topics.key("t", member, channel))(payload)

    for junk in (b"", b"\xc1", bytes(70_000)):
        say("m1", topics.LINK, junk)
        say("m1", topics.EVENT, junk)
    say("m1", topics.LINK, encode(STATISTICS))
    say("nobody", topics.LINK, encode(msgspec.structs.replace(STATISTICS, site="nobody")))
    say("m1", topics.EVENT, encode(Event(member="m1", boot=1, kind="lost", text="[/red] s is gone [x]")))
    out = io.StringIO()
    with Display(SCENARIO, Console(file=out, force_terminal=terminal, width=120)) as display:
        watch.poll()
        assert list(watch.latest) == ["m1"]
        for _ in range(LINE_EVERY):
            display.update(watch.latest)
        for sentence in watch.take_news():
            display.say(sentence)
    assert watch.take_news() == []
    assert "[/red] s is gone [x]" in out.getvalue()
    assert "m1" in out.getvalue()
    assert "nobody" not in out.getvalue()
