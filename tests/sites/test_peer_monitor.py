"""Presence of members: starts of other sessions do not count, but a recorder may come at any time."""

from collections.abc import Sequence

import pytest

from sites.peer_monitor import PeerMonitor
from tests.net.local_bus import LocalBus, LocalNetwork
from tests.net.parties import answer_info
from trilat_net.net import topics
from trilat_net.net.membership import EventPublisher
from trilat_net.net.messages import Event
from trilat_net.net.wire import encode, read_messages

BOOTS = {"m1": 1, "m2": 2, "s": 3, topics.RECORDER: 9}


class Desk:
    """The site m1, its peers, and its reports about them."""

    def __init__(self) -> None:
        self.network = LocalNetwork()
        self._heard = self.network.join().inbox(topics.key("t", "m1", topics.EVENT))
        bus = self.network.join()
        self._publisher = EventPublisher(bus, "t", answer_info("m1", 1))
        self.company = PeerMonitor(bus, "t", "m1", ("m2", "s"))
        self.company.boots = BOOTS

    def comes(self, member: str, boot: int) -> LocalBus:
        bus = self.network.join()
        bus.announce(topics.presence_token("t", member, boot))
        return bus

    def says(self, member: str, boot: int, kind: str, about: str = "", ticks: int = 0) -> None:
        event = Event(
            member=member,
            boot=boot,
            kind=kind,
            text=f"{member} {kind}",
            about=about,
            ticks=ticks,
        )
        self.network.join().publisher(topics.key("t", member, topics.EVENT))(encode(event))

    def list_news(self) -> Sequence[tuple[str, str]]:
        self.company.watch(self._publisher, 0)
        return [(event.kind, event.about) for event in read_messages(self._heard, Event)]


@pytest.mark.parametrize(
    ("boot", "event", "news", "ended_by"),
    [
        (2, "", [("lost", "m2")], ""),
        (2, "end", [], ""),
        (2, "diverged", [("lost", "m2")], "m2 diverged"),
        (22, "diverged", [], ""),  # another start is nobody
    ],
)
def test_departed_peers_are_lost_without_an_end(
    boot: int, event: str, news: list[tuple[str, str]], ended_by: str
) -> None:
    desk = Desk()
    bus = desk.comes("m2", boot)
    assert desk.list_news() == []
    if event:
        desk.says("m2", boot, event)
    bus.close()
    assert (desk.list_news(), desk.company.ended_by) == (news, ended_by)


def test_later_recorders_are_reported_and_counted() -> None:
    desk = Desk()
    first = desk.comes(topics.RECORDER, 9)
    assert desk.list_news() == []
    assert desk.company.recorders == {"9"}
    first.close()
    assert desk.list_news() == [("lost", topics.RECORDER)]
    assert desk.company.recorders == set()
    desk.comes(topics.RECORDER, 10)
    assert desk.list_news() == [("back", topics.RECORDER)]
    assert desk.company.recorders == {"10"}


def test_recorders_report_themselves_complete() -> None:
    desk = Desk()
    desk.says(topics.RECORDER, 9, "stored", about="m1", ticks=4)
    desk.says(topics.RECORDER, 9, "stored", about="m2", ticks=5)
    assert not desk.company.read_stored(5)
    desk.says(topics.RECORDER, 10, "stored", about="m1", ticks=5)
    assert desk.company.read_stored(5)
    assert desk.company.stored == {"10"}
    desk.says(topics.RECORDER, 10, "stored", about="m1", ticks=5)
    assert not desk.company.read_stored(5)
