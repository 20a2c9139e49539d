"""The accounts of a log, made from the log itself: what is in it, and what must have been besides.

Law: nothing is decoded but the events: what a message is numbered by stands in its channel and its sequence.
A part of a log is judged from its first message on.
"""

from collections.abc import Iterator, Mapping

from ..errors import ScenarioError, WireError
from ..net import topics
from ..net.messages import READABLE, Event
from ..net.stats import ticks_between
from ..net.wire import decode
from ..scenario import embedded
from .accounting import SHOWN, Account
from .writer import PART, SCENARIO, SESSION

NUMBERED_EVENTS = 3
"""Events have numbers from this version of the schema on."""


class Books:
    """The accounts of one file.

    Args:
        metadata: the file's, by name, as far as it was read.
        attachments: the file's, by name.

    Raises:
        NotOurs: it is no log of ours.
    """

    def __init__(self, metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]) -> None:
        session = metadata.get(SESSION, {})
        try:
            scenario = embedded(attachments[SCENARIO].decode(), SCENARIO)
            self._session = session["session"]
            version = int(session["schema_version"])
        except (KeyError, ValueError, ScenarioError) as error:
            raise NotOurs(str(error)) from None
        self._sites = scenario.names
        self._every = {name: ticks_between(scenario.sites[name].rate_hz) for name in scenario.names}
        self._numbered = (topics.STATE, topics.LINK, topics.EVENT)[: 3 if version >= NUMBERED_EVENTS else 2]
        self._carried_on = metadata.get(PART, {}).get("index", "1") != "1"
        self._accounts: dict[str, Account] = {}
        self._bases: dict[str, int] = {}

    def open(self, topic: str) -> None:
        """Takes note of a channel that the file has."""
        where = topics.address(topic.removeprefix("/"))
        if where is not None and where.session == self._session and where.channel in self._numbered:
            self._accounts[topic] = Account()

    def take(self, topic: str, sequence: int, payload: bytes) -> None:
        """Books a message."""
        account = self._accounts.get(topic)
        if account is None:
            return
        member, channel = topic.split("/")[-2:]
        number = sequence // self._every.get(member, 1) if channel == topics.LINK else sequence
        base = self._bases.setdefault(topic, number if self._carried_on else 0)
        if number >= base:
            account.take(number - base)
        if channel == topics.LINK:
            self._expect(member, topics.STATE, sequence + 1)
        elif channel == topics.EVENT:
            self._learn(payload)

    def _learn(self, payload: bytes) -> None:
        """Books what an event says of the number of ticks."""
        try:
            event = decode(payload, Event, READABLE)
        except WireError:
            return
        if event.kind == "end" and event.member in self._every and 0 <= event.ticks < 1 << 32:
            self._expect(event.member, topics.STATE, event.ticks)
            self._expect(event.member, topics.LINK, -(-event.ticks // self._every[event.member]))

    def _expect(self, member: str, channel: str, made: int) -> None:
        topic = "/" + topics.key(self._session, member, channel)
        if topic in self._accounts:
            self._accounts[topic].expect(made - self._bases.get(topic, 0))

    def texts(self) -> dict[str, str]:
        """Returns the accounts by topic, as the file holds them."""
        return {
            topic: self._text(topic, account)
            for topic, account in self._accounts.items()
            if account.expected or topic.split("/")[-2] in self._every
        }

    def _text(self, topic: str, account: Account) -> str:
        base = self._bases.get(topic, 0)
        return account.as_text() if not base else f"from {base} on: {account.as_text()}"

    def records(self) -> dict[str, int]:
        """Returns per site how many of its records are in the file."""
        topics_of = {site: "/" + topics.key(self._session, site, topics.STATE) for site in self._sites}
        return {
            site: self._accounts[topic].received
            for site, topic in topics_of.items()
            if topic in self._accounts
        }

    def missing(self) -> Iterator[str]:
        """Yields per site which of its records are not in the file."""
        for site in self._sites:
            topic = "/" + topics.key(self._session, site, topics.STATE)
            account = self._accounts.get(topic)
            if account is not None and account.missing:
                base = self._bases.get(topic, 0)
                gaps = [f"{base + first}-{base + last}" for first, last in account.gaps[:SHOWN]]
                more = " ..." if len(account.gaps) > len(gaps) else ""
                yield f"{site}: {account.missing} of {account.expected} records: {' '.join(gaps)}{more}"


class NotOurs(Exception):  # noqa: N818 - what it says of a file
    """A file that is no log of ours; never leaves this package."""
