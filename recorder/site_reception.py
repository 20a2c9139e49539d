"""Reception state of one site at the recorder: messages received, and messages still missing.

Invariant: a message counts only when it is decoded, of this site, of this boot, and has a number that the
scenario allows; each such message may imply that others exist.
"""

from typing import NamedTuple

from trilat_net.errors import WireError
from trilat_net.log.accounting import Account
from trilat_net.log.log_layout import SITE_CHANNELS
from trilat_net.net import topics
from trilat_net.net.loop_stats import ticks_per_stats
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.requests import Backfill
from trilat_net.net.wire import decode
from trilat_net.scenario import Scenario

CHANNEL_NOUNS = {topics.STATE: "records", topics.LINK: "statistics", topics.EVENT: "events"}
"""What people call the messages of a channel."""
_ANY = 1 << 40


class SiteMessage(NamedTuple):
    """What a payload of a site says.

    Attributes:
        number: its number in its channel; -1 where it has none.
        sequence: what the file calls it by.
        t_ns: when it was sent, ns since the epoch on the sender's clock; below 0 where it was before.
        content: the message itself.
    """

    number: int
    sequence: int
    t_ns: int
    content: State | LinkStats | Event


class SiteReception:
    """One start of one site.

    Args:
        scenario: the session's.
        name: which of its sites.
        boot: the start of it that is a member; None where it never was.

    Attributes:
        name: its name.
        accounts: what it has sent and what it owes, by channel.
        made: how many ticks it made, once it has said its end; else None.
        heard_ns: when it was heard last, on the recorder's clock; None before.
    """

    def __init__(self, scenario: Scenario, name: str, boot: int | None) -> None:
        self.name = name
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self.made: int | None = None
        self.heard_ns: int | None = None
        self._boot = boot
        self._rate_hz = scenario.sites[name].rate_hz
        self._every = ticks_per_stats(self._rate_hz)
        self._ticks = scenario.ticks(name)
        self._most = {topics.STATE: self._ticks, topics.LINK: self._linked(self._ticks), topics.EVENT: _ANY}

    @property
    def period_ns(self) -> int:
        """Time between two of its records."""
        return 1_000_000_000 // self._rate_hz

    def read(self, channel: str, payload: bytes) -> SiteMessage:
        """Returns what a payload says.

        Raises:
            WireError: it is no message of this site's channel, and why.
        """
        if channel == topics.STATE:
            state = decode(payload, State)
            message = SiteMessage(state.tick, state.tick, state.sent_ns, state)
            sender, boot = state.site, state.boot
        elif channel == topics.LINK:
            stats = decode(payload, LinkStats)
            message = SiteMessage(stats.tick // self._every, stats.tick, stats.t_ns, stats)
            sender, boot = stats.site, stats.boot
        else:
            event = decode(payload, Event)
            message = SiteMessage(event.n, event.n, event.t_ns, event)
            sender, boot = event.member, event.boot
            if event.kind == "end" and not 0 <= event.ticks <= self._ticks:
                raise WireError("out of range", f"{self.name} says it made {event.ticks} ticks")
        if sender != self.name or boot != self._boot:
            raise WireError("stranger", f"{sender}, start {boot}, on a key of {self.name}")
        if message.number >= self._most[channel]:
            raise WireError("out of range", f"{self.name}/{channel} number {message.number}")
        return message

    def take(self, channel: str, message: SiteMessage, came_ns: int) -> bool:
        """Books a message that came by itself; False where it is there already."""
        self.heard_ns = came_ns
        new = message.number < 0 or self.accounts[channel].take(message.number, came_ns)
        self._learn(message.content)
        return new

    def refill(self, channel: str, message: SiteMessage) -> bool:
        """Books a message from the site's memory; False where it is there already."""
        new = self.accounts[channel].refill(message.number)
        self._learn(message.content)
        return new

    def trust(self, past: Backfill) -> None:
        """Refuses an answer that this start of the site cannot have given.

        Raises:
            WireError: and why.
        """
        if past.member != self.name or past.boot != self._boot:
            raise WireError("stranger", f"{past.member}, start {past.boot}, answers for {self.name}")

    def expect(self, channel: str, made: int) -> None:
        """Books how many messages of a channel there are at least; no more than the scenario allows."""
        self.accounts[channel].expect(min(made, self._most[channel]))

    def _learn(self, content: State | LinkStats | Event) -> None:
        """Books what must exist because this does."""
        if isinstance(content, LinkStats):
            self.expect(topics.STATE, content.tick + 1)
        elif isinstance(content, Event) and content.kind == "end":
            self.made = content.ticks
            self.expect(topics.STATE, content.ticks)
            self.expect(topics.LINK, self._linked(content.ticks))

    def _linked(self, ticks: int) -> int:
        """Returns how many statistics go with so many ticks."""
        return -(-ticks // self._every)

    @property
    def full(self) -> bool:
        """True once it has ended and nothing is missing that could still be had."""
        return self.made is not None and not any(account.wanted() for account in self.accounts.values())

    def give_up(self) -> None:
        """Books all that is missing now as lost for good."""
        for account in self.accounts.values():
            account.give_up(account.last + 1)

    def shortage(self) -> str:
        """Says what is missing, "" where nothing is."""
        return ", ".join(
            f"{account.missing} of {account.expected} {CHANNEL_NOUNS[channel]} "
            f"({' '.join(account.gap_texts(5))})"
            for channel, account in self.accounts.items()
            if account.missing
        )
