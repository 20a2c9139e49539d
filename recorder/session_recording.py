"""One log while it is recorded: messages written, accounts of missing ones, and the recorder's statistics.

Invariant: a message of this session is written once, byte for byte; any other is counted by reason. The
recorder sends `stored` to a site when it has every message that it can get. Statistics, once a second, go to
the bus and the log; they are bounded, and a stepping wall clock shows in them and nowhere else.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol

from trilat_net.errors import WireError
from trilat_net.log.accounting import Account
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.membership import EventPublisher
from trilat_net.net.messages import Event, LinkStats, RecorderStats, State
from trilat_net.net.session import Epoch
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import Scenario

from .backfill import GapRepair
from .inbound_queue import InboundMessage, InboundQueue
from .site_reception import SiteMessage, SiteReception

SETTLE_NS = 1_000_000_000
"""How long to wait for what may still be under way of a site that has ended and is gone."""
UNDER_WAY_NS = 100_000_000
"""What comes within this time of a site whose token has disappeared was under way."""
AWAY_NS = 15_000_000_000
"""How long to wait for a site that is gone without a word: a link that is cut may heal."""
LAST_NS = 6_000_000_000
"""How long after the last tick that is due there may still be a site: it stays for 5 s at most."""


class MessageWriter(Protocol):
    """Where a recording goes: `log.writer.LogWriter`, and whatever stands in for it."""

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: State | LinkStats | Event | None = None,
    ) -> None:
        """Writes one message."""

    def flush(self) -> None:
        """Hands everything so far to the operating system."""

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Writes the accounts and the end mark."""


class Recording:
    """One log and its accounts.

    Args:
        writer: the log, begun.
        scenario: the scenario of the session.
        session: the session's name.
        epoch: its tick 0, and who its members are.
        bus: the connection, over which sites are asked for what is missing.
        publisher: the recorder's own events; it keeps them in the same tap as what comes from others.

    Attributes:
        dropped: messages that were none of the session's, by reason.
        accounts: of every channel, by its key.
    """

    def __init__(
        self,
        writer: MessageWriter,
        scenario: Scenario,
        session: str,
        epoch: Epoch,
        bus: Bus,
        publisher: EventPublisher,
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self._writer = writer
        self._session, self._epoch, self._publisher = session, epoch, publisher
        self._end_ns = epoch.mono_ns + round(scenario.duration_s * 1e9) + LAST_NS
        self._senders = {
            name: SiteReception(scenario, name, epoch.boots.get(name)) for name in scenario.names
        }
        self._fillings = {
            name: GapRepair(bus, session, sender, self.dropped, epoch.mono_ns)
            for name, sender in self._senders.items()
        }
        self._places = {
            topics.key(session, name, channel): (sender, channel)
            for name, sender in self._senders.items()
            for channel in sender.accounts
        }
        self._own = {
            topics.key(session, topics.RECORDER, channel): Account()
            for channel in (topics.EVENT, topics.STATS)
        }
        self.accounts = {
            key: sender.accounts[channel] for key, (sender, channel) in self._places.items()
        } | self._own
        self._stored: set[str] = set()
        self._gone: set[str] = set()
        self._missed_ns: dict[str, int] = {}
        self._overflowed = 0

    def late(self, now_ns: int) -> None:
        """Says that the recorder came into a session that was running, and asks every site for its past.

        Args:
            now_ns: the time.
        """
        at_ns = now_ns - self._epoch.mono_ns
        there = [name for name in self._senders if name not in self._gone]
        self._publisher.publish(
            "late",
            f"the recorder joins at t = {at_ns / 1e9:.3f} s; what was before is asked of {', '.join(there)}",
            t_ns=at_ns,
        )
        for name in self._gone:
            self._publisher.publish("lost", f"{name} is gone", about=name, t_ns=at_ns)
        for filling in self._fillings.values():
            filling.probe()

    def away(self) -> None:
        """Takes every site as gone until its token says otherwise."""
        self._gone = set(self._senders)

    def write(self, tap: InboundQueue, now_ns: int) -> None:
        """Writes what has come in, asks for what is missing, and answers sites of which all is here."""
        self._drain(tap, now_ns)
        log_time_ns = self._epoch.unix_ns + now_ns - self._epoch.mono_ns
        for name, filling in self._fillings.items():
            for filled in filling.poll(now_ns, alive=self._goes_on(name, now_ns)):
                key = topics.key(self._session, name, filled.channel)
                sent_ns = max(filled.message.t_ns, 0)  # what was said before the epoch bears no time
                self._add(key, filled.payload, filled.message, sent_ns, log_time_ns)
        for name, sender in self._senders.items():
            if name not in self._stored and sender.full:
                self._stored.add(name)
                self._say_stored(sender, now_ns)

    def _drain(self, tap: InboundQueue, until_ns: int | None) -> None:
        for arrived in tap.drain(until_ns):
            try:
                self._take(arrived)
            except WireError as error:
                self.dropped[error.reason] += 1

    def _take(self, arrived: InboundMessage) -> None:
        place = self._places.get(arrived.key)
        since_ns = arrived.mono_ns - self._epoch.mono_ns
        log_time_ns = self._epoch.unix_ns + since_ns
        if place is None:
            if self.accounts.get(arrived.key) is None:
                raise WireError("stranger", arrived.key)
            self._take_own(arrived, since_ns, log_time_ns)
            return
        sender, channel = place
        message = sender.read(channel, arrived.payload)
        if sender.take(channel, message, arrived.mono_ns):
            t_ns = message.t_ns if message.t_ns >= 0 or channel != topics.EVENT else since_ns
            self._add(arrived.key, arrived.payload, message, t_ns, log_time_ns)

    def _take_own(self, arrived: InboundMessage, since_ns: int, log_time_ns: int) -> None:
        """Takes what this recorder says itself."""
        account, own = self._own[arrived.key], self._publisher.info.boot
        if arrived.key.endswith(topics.STATS):
            stats = decode(arrived.payload, RecorderStats)
            boot, number, content = stats.boot, account.expected, None
        else:
            event = decode(arrived.payload, Event)
            if event.member != topics.RECORDER:
                raise WireError("stranger", arrived.key)
            boot, number, content = event.boot, event.n, event
        if boot != own:
            raise WireError("another recorder", arrived.key)
        if number >= 0 and account.take(number, arrived.mono_ns):
            self._writer.add(arrived.key, arrived.payload, since_ns, log_time_ns, number, content)

    def _add(self, key: str, payload: bytes, message: SiteMessage, t_ns: int, log_time_ns: int) -> None:
        self._writer.add(key, payload, t_ns, log_time_ns, message.sequence, message.content)

    def _say_stored(self, sender: SiteReception, now_ns: int) -> None:
        shortage = sender.shortage()
        text = f"every record of {sender.name} is stored"
        if shortage:
            text = f"all that can be had of {sender.name} is stored; missing for good: {shortage}"
        self._publisher.publish(
            "stored", text, t_ns=now_ns - self._epoch.mono_ns, about=sender.name, ticks=sender.made
        )

    def presence(self, key: str, alive: bool) -> None:
        """Takes note of a member's token that appeared or disappeared."""
        where = topics.parse_key(key)
        if where is None or str(self._epoch.boots.get(where.member)) != where.boot:
            return
        (self._gone.discard if alive else self._gone.add)(where.member)

    def _silent_since_ns(self, site: str, now_ns: int) -> int | None:
        """Returns since when a site is gone; None while its token is there.

        A connection that is made anew may tell that a token went and came in the wrong order: what comes of a
        site later than what was under way shows that it was there still.
        """
        if site not in self._gone:
            self._missed_ns.pop(site, None)
            return None
        missed_ns = self._missed_ns.setdefault(site, now_ns)
        heard_ns = self._senders[site].heard_ns
        return missed_ns if heard_ns is None or heard_ns < missed_ns + UNDER_WAY_NS else heard_ns

    def _goes_on(self, site: str, now_ns: int) -> bool:
        """True where a site's token is there, or something came of it after the token had disappeared."""
        since_ns = self._silent_since_ns(site, now_ns)
        return since_ns is None or since_ns > self._missed_ns[site]

    def over(self, now_ns: int) -> bool:
        """True once all that can be had of every site is here, or the site is gone for good."""
        left = [self._left(name, now_ns) for name in self._senders]
        return all(left)

    def _left(self, site: str, now_ns: int) -> bool:
        """True once nothing more of a site will come."""
        if site in self._stored:
            return True
        since_ns = self._silent_since_ns(site, now_ns)
        if since_ns is None:
            return False
        patience_ns = SETTLE_NS
        if self._senders[site].made is None:
            patience_ns = max(SETTLE_NS, min(AWAY_NS, self._end_ns - since_ns))
        return now_ns - since_ns > patience_ns

    def flush(self) -> None:
        """Hands everything so far to the operating system."""
        self._writer.flush()

    def finish(self, tap: InboundQueue) -> None:
        """Writes the rest, the accounts and the end mark."""
        self._drain(tap, None)
        self._overflowed = sum(tap.overflowed.values())
        self._writer.finish(self.account_texts(tap))

    def account_texts(self, tap: InboundQueue) -> dict[str, str]:
        """Returns the accounts as the file holds them: per topic, and what was dropped, by reason."""
        counts = {f"dropped: {reason}": str(count) for reason, count in self.dropped.items() if count}
        texts = {
            f"/{key}": f"{account.as_text()}, overflowed {tap.overflowed[key]}"
            for key, account in self.accounts.items()
        }
        return {**texts, **counts}

    def summary(self) -> list[str]:
        """Returns what was recorded, a line per site, for people."""
        lines = []
        for name, sender in self._senders.items():
            account = sender.accounts[topics.STATE]
            made = sender.made
            of = f" of {made} records" if made is not None else " records of a number that it never said"
            lines.append(
                f"recorder: {name}: {account.received}{of}, {account.missing} missing, "
                f"{account.duplicate} duplicate, largest gap {account.largest_gap}"
                + (f", {account.refilled} from its memory" if account.refilled else "")
            )
        if self._overflowed:
            lines.append(f"recorder: {self._overflowed} messages turned away because the queue was full")
        for reason, count in self.dropped.items():
            if count:
                lines.append(f"recorder: {count} messages dropped: {reason}")
        return lines

    def problem(self) -> str | None:
        """Says what is missing, or None where everything is there."""
        for name, sender in self._senders.items():
            if sender.made is None:
                return f"{name} disappeared after {sender.accounts[topics.STATE].received} records"
            if sender.shortage():
                return f"missing of {name}: {sender.shortage()}"
        return None


REPORT_EVERY_NS = 1_000_000_000
MAX_GAPS_REPORTED = 20
"""Gaps that are named of a channel; of many channels fewer."""
_ALL_GAPS = 600


class RecorderReport:
    """The statistics of one recording.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        boot: the recorder's.
        epoch: tick 0.
        recording: what it is about.
        tap: where messages wait; its own statistics go into it.
        size: says how many bytes the log has.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        boot: int,
        epoch: Epoch,
        recording: Recording,
        tap: InboundQueue,
        size: Callable[[], int],
    ) -> None:
        self._clock, self._boot, self._epoch = clock, boot, epoch
        self._recording, self._tap, self._size = recording, tap, size
        self._key = topics.key(session, topics.RECORDER, topics.STATS)
        self._publish = bus.publisher(self._key)
        self._flush_max_ns = 0
        self._due_ns = clock.monotonic_ns() + REPORT_EVERY_NS

    def flushed(self, took_ns: int) -> None:
        """Books how long the operating system took to take the log so far, ns."""
        self._flush_max_ns = max(self._flush_max_ns, took_ns)

    def poll(self) -> None:
        """Says how it stands, if it is time to."""
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._due_ns:
            on_time = now_ns - self._due_ns < REPORT_EVERY_NS
            self._due_ns = (self._due_ns if on_time else now_ns) + REPORT_EVERY_NS
            self.say()

    def say(self) -> None:
        """Says how it stands, and writes it."""
        payload = encode(self._stats())
        self._flush_max_ns = 0
        self._tap.take(self._key, payload)
        self._publish(payload)

    def _stats(self) -> RecorderStats:
        accounts = {_short(key): account for key, account in self._recording.accounts.items()}
        most = max(1, min(MAX_GAPS_REPORTED, _ALL_GAPS // len(accounts)))
        now_ns = self._clock.monotonic_ns()

        def counted(what: Callable[[Account], int]) -> dict[str, int]:
            return {name: what(account) for name, account in accounts.items()}

        return RecorderStats(
            boot=self._boot,
            t_ns=now_ns - self._epoch.mono_ns,
            expected=counted(lambda account: account.expected),
            received=counted(lambda account: account.received),
            missing=counted(lambda account: account.missing),
            gaps={name: account.gap_texts(most) for name, account in accounts.items() if account.missing},
            duplicate=counted(lambda account: account.duplicate),
            reordered=counted(lambda account: account.reordered),
            refilled=counted(lambda account: account.refilled),
            overflowed={_short(key): self._tap.overflowed[key] for key in self._recording.accounts},
            silence_us=counted(lambda account: account.silence_ns // 1000),
            dropped=dict(self._recording.dropped),
            queued=len(self._tap),
            written_bytes=self._size(),
            flush_max_us=self._flush_max_ns // 1000,
            mono_ns=now_ns,
            unix_ns=self._clock.unix_ns(),
        )


def _short(key: str) -> str:
    """Returns member and channel of a key, as in "m1/state"."""
    return "/".join(key.split("/")[2:])
