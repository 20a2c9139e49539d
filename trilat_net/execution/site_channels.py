"""The channels of one site in a log that an execution writes: records, link statistics, events.

Invariant: messages of older schema versions are written in the present one; a message of the present version
keeps its bytes.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import msgspec

from ..core.ticks import Arrival, Mode, TickRecord, describe_divergence, describe_mode
from ..log.accounting import Account
from ..log.log_layout import MAX_TIME_NS, SITE_CHANNELS
from ..log.log_writer import LogWriter
from ..net import topics
from ..net.messages import SENT_TIME_SINCE, VERSION, Event, LinkStats, State
from ..net.topics import number_message, skipped_numbers
from ..net.wire import encode, encode_state
from ..scenario import Scenario
from ..scenario.run_changes import count_skipped_ticks
from .resumption import read_output


class SiteEntry(NamedTuple):
    """One message of the file; entries are written in order of `t_ns`, ns since the epoch."""

    site: str
    t_ns: int
    sent_ns: int
    channel: str
    sequence: int
    payload: bytes
    message: Any


class SiteChannels:
    """Turns the ticks and messages of one site into entries, writes them, and keeps their accounts."""

    def __init__(self, scenario: Scenario, session: str, site: str, boot: int) -> None:
        self.peers, rate_hz = scenario.peers(site), scenario.sites[site].rate_hz
        self._glides = scenario.sites[site].on_stale.action == "glide"
        self._site, self._boot, self._rate_hz = site, boot, rate_hz
        self.keys = {channel: topics.key(session, site, channel) for channel in SITE_CHANNELS}
        self.accounts = {channel: Account() for channel in SITE_CHANNELS}
        self._mode = Mode.RUN
        self._events = 0
        self._t_ns = 0
        self.ticks = 0

    def follow(
        self, output: TickRecord, stats: LinkStats | None, law_failure: Exception | None = None
    ) -> Sequence[SiteEntry]:
        """Returns the entries after the record of an executed tick: statistics if any, change of mode."""
        self.ticks, self._t_ns = output.tick + 1, output.t_ns
        self._excuse_skipped(output.tick, output.cmd)
        entries = [] if stats is None else [self.stats(stats)]
        if output.mode is not self._mode:
            self._mode = output.mode
            diverged = output.mode is Mode.DIVERGED
            text = (
                describe_divergence(self._site, output)
                if diverged
                else describe_mode(self._site, output, glides=self._glides, law_failure=law_failure)
            )
            entries.append(self.new_event("diverged" if diverged else "mode", text, output.t_ns))
        return entries

    def _excuse_skipped(self, tick: int, cmd: Sequence[str]) -> None:
        if skipped := count_skipped_ticks(cmd):
            for channel in (topics.STATE, topics.LINK):
                self.accounts[channel].begin_anew(*skipped_numbers(channel, tick, skipped, self._rate_hz))

    def end(self, t_ns: int | None = None) -> SiteEntry:
        """Returns the entry of the event that ends the site's run, by default at its last tick."""
        when_ns = self._t_ns if t_ns is None else t_ns
        return self.new_event("end", f"{self._site} made {self.ticks} ticks", when_ns)

    def new_event(self, kind: str, text: str, t_ns: int) -> SiteEntry:
        """Returns the entry of a new event of the site."""
        n = self._events
        self._events += 1
        event = Event(
            member=self._site, boot=self._boot, n=n, kind=kind, text=text, t_ns=t_ns, ticks=self.ticks
        )
        return self.event(event, n)

    def record(self, state: State, payload: bytes) -> SiteEntry:
        """Returns the entry of a record of the source log."""
        self._excuse_skipped(state.tick, state.cmd)
        sent_ns = state.sent_ns if state.v >= SENT_TIME_SINCE else state.t_ns
        if state.v != VERSION:
            arrivals = [Arrival(peer, tick, (), (), us) for peer, tick, us in state.rx]
            output = read_output(state, self.peers)
            late_us, busy_us = state.late_us, state.busy_us
            payload = encode_state(
                state.site, state.boot, self.peers, output, arrivals, late_us, busy_us, sent_ns, state.echo
            )
        return SiteEntry(self._site, state.t_ns, sent_ns, topics.STATE, state.tick, payload, state)

    def stats(self, stats: LinkStats) -> SiteEntry:
        """Returns the entry of link statistics."""
        payload = encode(stats if stats.v == VERSION else msgspec.structs.replace(stats, v=VERSION))
        return SiteEntry(self._site, stats.t_ns, stats.t_ns, topics.LINK, stats.tick, payload, stats)

    def event(self, event: Event, n: int) -> SiteEntry:
        """Returns the entry of an event; `n` is its number if it has none of its own."""
        numbered = event if event.n >= 0 else msgspec.structs.replace(event, n=n)
        payload = encode(msgspec.structs.replace(numbered, v=VERSION))
        t_ns = max(event.t_ns, 0)
        return SiteEntry(self._site, t_ns, t_ns, topics.EVENT, numbered.n, payload, numbered)

    def write(self, entry: SiteEntry, writer: LogWriter, epoch_unix_ns: int = 0) -> None:
        """Writes an entry into a log."""
        self.accounts[entry.channel].take(number_message(entry.channel, entry.sequence, self._rate_hz))
        log_ns = min(max(0, epoch_unix_ns + entry.t_ns), MAX_TIME_NS)
        key = self.keys[entry.channel]
        writer.add(key, entry.payload, entry.sent_ns, log_ns, entry.sequence, entry.message)


def describe_accounts(sites: Iterable[SiteChannels]) -> dict[str, str]:
    """Returns the accounts of all channels, by topic."""
    return {
        f"/{site.keys[channel]}": f"{account.as_text()}, overflowed 0"
        for site in sites
        for channel, account in site.accounts.items()
    }
