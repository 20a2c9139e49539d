"""What the recorder writes, and what it knows is missing.

Law: a message is written byte for byte as it came, if it is a message of this session; whatever is not is
counted by reason. The recorder says `stored` to a site when it has every record that the site made.
"""

from collections import Counter
from typing import BinaryIO

from trilat_net.errors import WireError
from trilat_net.log.accounting import Account
from trilat_net.log.writer import LogWriter
from trilat_net.net import topics
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.session import Epoch
from trilat_net.net.stats import ticks_between
from trilat_net.net.voice import Voice
from trilat_net.net.wire import decode, encode
from trilat_net.scenario import Scenario

from .tap import Arrived, Tap

SETTLE_NS = 1_000_000_000
"""How long to wait for what may still be under way of a site that has ended and is gone."""
AWAY_NS = 15_000_000_000
"""How long to wait for a site that is gone without a word: a link that is cut may heal."""
LAST_NS = 6_000_000_000
"""How long after the last tick that is due there may still be a site: it stays for 5 s at most."""


class Recording:
    """One file and its accounts.

    Args:
        stream: the file, opened for writing.
        scenario: the scenario of the session.
        session: the session's name.
        epoch: its tick 0, and who its members are.
        voice: the recorder's own events.
    """

    def __init__(
        self, stream: BinaryIO, scenario: Scenario, session: str, epoch: Epoch, voice: Voice
    ) -> None:
        self._writer = LogWriter(stream, scenario, session, "live", epoch.unix_ns)
        self._scenario, self._session, self._epoch, self._voice = scenario, session, epoch, voice
        self._ends: dict[str, int] = {}
        self._stored: set[str] = set()
        self._gone: set[str] = set()
        self._gone_since_ns: dict[str, int] = {}
        self._accounts = {key: Account() for key in self._writer.keys}
        self._overflowed = 0
        self.dropped: Counter[str] = Counter()

    def write(self, tap: Tap, now_ns: int) -> None:
        """Writes what has come in, and answers sites whose records are complete."""
        for arrived in tap.drain():
            try:
                self._take(arrived)
            except WireError as error:
                self.dropped[error.reason] += 1
        for site, ticks in self._ends.items():
            if site not in self._stored and self._account(site).received >= ticks:
                self._stored.add(site)
                self._say("stored", f"every record of {site} is stored", now_ns, about=site, ticks=ticks)

    def _take(self, arrived: Arrived) -> None:
        where = topics.address(arrived.key)
        if where is None or where.member not in self._scenario.sites:
            raise WireError("stranger", arrived.key)
        boot = self._epoch.boots.get(where.member)
        log_time_ns = self._epoch.unix_ns + arrived.mono_ns - self._epoch.mono_ns
        if where.channel == topics.STATE:
            state = decode(arrived.payload, State)
            _belongs(state.site == where.member and state.boot == boot, arrived.key)
            if self._accounts[arrived.key].take(state.tick):
                self._writer.add(arrived.key, arrived.payload, state.sent_ns, log_time_ns, state.tick, state)
        elif where.channel == topics.LINK:
            stats = decode(arrived.payload, LinkStats)
            _belongs(stats.site == where.member and stats.boot == boot, arrived.key)
            every = ticks_between(self._scenario.sites[where.member].rate_hz)
            if self._accounts[arrived.key].take(stats.tick // every):
                self._writer.add(arrived.key, arrived.payload, stats.t_ns, log_time_ns, stats.tick, stats)
        else:
            event = decode(arrived.payload, Event)
            _belongs(event.member == where.member and event.boot == boot, arrived.key)
            t_ns = event.t_ns if event.t_ns >= 0 else log_time_ns - self._epoch.unix_ns
            if event.n < 0 or self._accounts[arrived.key].take(event.n):
                self._writer.add(arrived.key, arrived.payload, t_ns, log_time_ns, event.n, event)
            if event.kind == "end":
                self._ends[where.member] = event.ticks

    def _say(self, kind: str, text: str, now_ns: int, **facts: object) -> None:
        """Publishes an event of the recorder's own, and writes it."""
        t_ns = now_ns - self._epoch.mono_ns
        event = self._voice.say(kind, text, t_ns=t_ns, **facts)
        key = topics.key(self._session, topics.RECORDER, topics.EVENT)
        self._accounts[key].take(event.n)
        self._writer.add(key, encode(event), t_ns, self._epoch.unix_ns + t_ns, event.n, event)

    def _account(self, site: str) -> Account:
        return self._accounts[topics.key(self._session, site, topics.STATE)]

    def presence(self, key: str, alive: bool) -> None:
        """Takes note of a member's token that appeared or disappeared."""
        where = topics.address(key)
        if where is None or str(self._epoch.boots.get(where.member)) != where.boot:
            return
        (self._gone.discard if alive else self._gone.add)(where.member)

    def over(self, now_ns: int) -> bool:
        """True once every site has ended with all its records here, or is gone for good."""
        left = [self._left(site, now_ns) for site in self._scenario.names]
        return all(left)

    def _left(self, site: str, now_ns: int) -> bool:
        """True once nothing more of a site will come."""
        if site in self._stored:
            return True
        if site not in self._gone:
            self._gone_since_ns.pop(site, None)
            return False
        since_ns = self._gone_since_ns.setdefault(site, now_ns)
        patience_ns = SETTLE_NS
        if site not in self._ends:
            end_ns = self._epoch.mono_ns + round(self._scenario.duration_s * 1e9) + LAST_NS
            patience_ns = max(SETTLE_NS, min(AWAY_NS, end_ns - since_ns))
        return now_ns - since_ns > patience_ns

    def flush(self) -> None:
        """Hands everything so far to the operating system."""
        self._writer.flush()

    def finish(self, tap: Tap) -> None:
        """Writes the rest, the accounts and the end mark."""
        for arrived in tap.drain():
            try:
                self._take(arrived)
            except WireError as error:
                self.dropped[error.reason] += 1
        self._overflowed = sum(tap.overflowed.values())
        counts = {f"dropped: {reason}": str(count) for reason, count in self.dropped.items() if count}
        for site, ticks in self._ends.items():
            self._account(site).expect(ticks)
        texts = {
            f"/{key}": f"{account.as_text()}, overflowed {tap.overflowed[key]}"
            for key, account in self._accounts.items()
        }
        self._writer.finish({**texts, **counts})

    def summary(self) -> list[str]:
        """Returns what was recorded, a line per site, for people."""
        lines = []
        for site in self._scenario.names:
            account = self._account(site)
            made = self._ends.get(site)
            of = f" of {made} records" if made is not None else " records of a number that it never said"
            lines.append(
                f"recorder: {site}: {account.received}{of}, {account.missing} missing, "
                f"{account.duplicate} duplicate, largest gap {account.largest_gap}"
            )
        if self._overflowed:
            lines.append(f"recorder: {self._overflowed} messages lost because the queue was full")
        for reason, count in self.dropped.items():
            if count:
                lines.append(f"recorder: {count} messages dropped: {reason}")
        return lines

    def problem(self) -> str | None:
        """Says what is missing, or None where everything is there."""
        for site in self._scenario.names:
            account = self._account(site)
            if site not in self._ends:
                return f"{site} disappeared after {account.received} records"
            if account.missing:
                return f"{account.missing} of {self._ends[site]} records of {site} are missing"
        return None


def _belongs(right: bool, key: str) -> None:
    """Refuses a message whose sender is not the member that its key names."""
    if not right:
        raise WireError("stranger", key)
