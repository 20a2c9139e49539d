"""Watches a session from outside: what its sites say of themselves, ten times a second."""

from collections.abc import Sequence

from trilat_net.errors import WireError
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.messages import Event, LinkStats
from trilat_net.net.wire import decode


class Watch:
    """The latest statistics and the events of a session.

    Args:
        bus: a connection to every site.
        session: the session's name.
        sites: its sites; what others say is nobody's.

    Attributes:
        latest: per site its latest statistics.
        news: sentences that a person should read, not yet taken.
    """

    def __init__(self, bus: Bus, session: str, sites: Sequence[str]) -> None:
        self.latest: dict[str, LinkStats] = {}
        self.news: list[str] = []
        self._sites = sites
        self._links = bus.inbox(topics.key(session, "*", topics.LINK), 256)
        self._events = bus.inbox(topics.key(session, "*", topics.EVENT), 256)

    def poll(self) -> None:
        """Takes what has come."""
        while (message := self._links.poll()) is not None:
            try:
                stats = decode(message[1], LinkStats)
            except WireError:
                continue  # the sites and the recorder count strangers
            if stats.site in self._sites:
                self.latest[stats.site] = stats
        while (message := self._events.poll()) is not None:
            try:
                event = decode(message[1], Event)
            except WireError:
                continue
            if event.kind in ("lost", "diverged", "failed", "refused", "clock fault"):
                self.news.append(event.text)

    def take_news(self) -> Sequence[str]:
        """Returns the sentences that came since the last call."""
        news, self.news = self.news, []
        return news
