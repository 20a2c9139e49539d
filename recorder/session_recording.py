"""One log while it is recorded: messages written, accounts of missing ones, and the recorder's
statistics.

Invariant: a message of this session is written once, byte for byte; any other is counted by
reason. The recorder sends `stored` to a site when it has every message that it can get.
Statistics, once a second, go to the bus and the log; they are bounded, and a stepping wall
clock shows in them and nowhere else.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any

from trilat_net.errors import WireError, count_nouns
from trilat_net.log.accounting import LAST, Account
from trilat_net.log.log_writer import LogParts, LogWriter
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.membership import Epoch, EventPublisher
from trilat_net.net.messages import Event, RecorderStats
from trilat_net.net.wire import decode, encode, split_states
from trilat_net.scenario import Scenario

from .backfill import GapRepair
from .site_reception import InboundQueue, SiteMessage, SiteReception

SETTLE_NS = 1_000_000_000
"""Time for messages still under way of a site that has ended and is gone."""
RECONNECT_NS = 10_000_000_000
"""Time for a site that has ended and keeps records that are missing, if its connection broke.
"""
HEARD_NS = 500_000_000
"""A site that was heard within this time is there."""
UNDER_WAY_NS = 100_000_000
"""A message that arrives within this time of the end of its site's token was under way."""
AWAY_NS = 15_000_000_000
"""Time for a site that is gone without an end event: a cut link may heal."""
STARTS_KEPT = 4096
"""Starts that went before they were admitted."""
LAST_NS = 6_000_000_000
"""Longest stay of a site after its last due tick: 5 s, and a margin."""


class Recording:
    """One log and its accounts.

    Attributes:
        accounts: messages of every channel, by its key.
        publisher: the recorder's own events; it keeps them in the same queue as other messages.
    """

    def __init__(
        self,
        writer: LogWriter | LogParts,
        scenario: Scenario,
        session: str,
        epoch: Epoch,
        bus: Bus,
        publisher: EventPublisher,
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self._writer = writer
        self.session = session
        self.epoch = epoch
        self.publisher = publisher
        self._scenario = scenario
        self._bus = bus
        self._boots = dict(epoch.boots)
        self._candidates = dict[str, int]()
        self._confirmed: set[int] = set()
        self._vanished: set[tuple[str, str]] = set()
        self._end_ns = epoch.mono_ns + round(scenario.duration_s * 1e9) + LAST_NS
        self._sites = {
            name: SiteReception(scenario, name, epoch.boots.get(name))
            for name in scenario.names
        }
        self._repairs = {
            name: GapRepair(
                bus=bus,
                session=session,
                reception=site,
                dropped=self.dropped,
                now_ns=epoch.mono_ns,
            )
            for name, site in self._sites.items()
        }
        self._channels = {
            topics.key(session, name, channel): (site, channel)
            for name, site in self._sites.items()
            for channel in site.accounts
        }
        self._blocks = {
            key for key, (_, channel) in self._channels.items() if channel == topics.STATE
        }
        self._own = {
            topics.key(session, topics.RECORDER, channel): Account()
            for channel in (topics.EVENT, topics.STATS)
        }
        self.accounts = {
            key: site.accounts[channel] for key, (site, channel) in self._channels.items()
        } | self._own
        self._stored: set[str] = set()
        self._gone: set[str] = set()
        self._gone_ns: dict[str, int] = {}
        self._overflowed = 0

    def join_late(self, now_ns: int) -> None:
        """Reports that the recorder joins a running session, and requests everything from every
        site.
        """
        at_ns = now_ns - self.epoch.mono_ns
        sites = ", ".join(name for name in self._sites if name not in self._gone)
        self.publisher.publish(
            "late",
            f"the recorder joins at t = {at_ns / 1e9:.3f} s; what was before is asked of {sites}",
            t_ns=at_ns,
        )
        for name in self._gone:
            self.publisher.publish("lost", f"{name} is gone", about=name, t_ns=at_ns)
        for repair in self._repairs.values():
            repair.probe()

    def assume_gone(self) -> None:
        """Takes every site as gone until its token appears."""
        self._gone = set(self._sites)

    def write(self, queue: InboundQueue, now_ns: int) -> None:
        """Writes the queue, requests missing messages, and sends `stored` to sites that are
        complete.
        """
        self._drain(queue, now_ns)
        self._admit_starts()
        log_time_ns = self.epoch.unix_ns + now_ns - self.epoch.mono_ns
        for name, repair in list(self._repairs.items()):
            self._sites[name].since_ns = now_ns - self.epoch.mono_ns
            silent_ns = self._silent_since_ns(name, now_ns)
            alive = silent_ns is None or silent_ns > self._gone_ns[name]
            for channel, message, payload in repair.poll(now_ns, alive=alive):
                key = topics.key(self.session, name, channel)
                sent_ns = max(message.t_ns, 0)  # an event before the epoch has no time
                self._writer.add(
                    key, payload, sent_ns, log_time_ns, message.sequence, message.content
                )
                self._note_admission(message.content)
        for name, site in self._sites.items():
            if name in self._stored or not site.is_complete:
                continue
            self._stored.add(name)
            text = f"every record of {name} is stored"
            if shortage := site.describe_missing():
                text = f"all that can be had of {name} is stored; missing for good: {shortage}"
            t_ns = now_ns - self.epoch.mono_ns
            self.publisher.publish(
                "stored", text, t_ns=t_ns, about=name, ticks=site.final_ticks
            )

    def _drain(self, queue: InboundQueue, until_ns: int | None) -> None:
        for arrived in queue.drain(until_ns):
            try:
                if arrived.key in self._blocks:
                    self._take_block(*arrived)
                else:
                    take = self._take_own if arrived.key in self._own else self._take
                    take(*arrived)
            except WireError as error:
                self.dropped[error.reason] += 1

    def _admit_starts(self) -> None:
        """Goes over to starts of sites that others admit, or where the one before is gone or
        has ended.
        """
        for name, boot in list(self._candidates.items()):
            before = self._sites[name]
            left = name in self._gone or name not in self._boots
            if not (left or before.final_ticks is not None or boot in self._confirmed):
                continue
            del self._candidates[name]
            self._boots[name] = boot
            site = self._sites[name] = SiteReception(self._scenario, name, boot, before)
            repair = self._repairs[name] = GapRepair(
                self._bus, self.session, site, self.dropped
            )
            repair.probe()
            for channel in site.accounts:
                key = topics.key(self.session, name, channel)
                self._channels[key] = (site, channel)
                self.accounts[key] = site.accounts[channel]
            self._stored.discard(name)
            self._gone_ns.pop(name, None)
            (self._gone.add if (name, str(boot)) in self._vanished else self._gone.discard)(
                name
            )

    def _note_start(self, name: str, payload: bytes) -> None:
        event = decode(payload, Event)
        comes = event.kind in ("coming", "join") and event.boots.get(name) == event.boot
        if comes and event.member == name and self._scenario.sites_may_return:
            self._candidates[name] = event.boot
            self._admit_starts()

    def _note_admission(self, event: object) -> None:
        if not isinstance(event, Event) or event.about not in self._sites:
            return
        boot = event.boots.get(event.about)
        is_known = boot == self._boots.get(event.about)
        if event.kind == LAST and is_known:
            self._sites[event.about].count_previous_start(event.ticks)
        if event.kind != "admit" or boot is None or is_known:
            return
        if self._scenario.sites_may_return and len(self._confirmed) < STARTS_KEPT:
            self._confirmed.add(boot)
            self._candidates[event.about] = boot
            self._admit_starts()

    def _read(self, key: str, payload: bytes) -> tuple[SiteReception, SiteMessage]:
        site, channel = self._channels[key]
        try:
            return site, site.read(channel, payload)
        except WireError:
            if channel != topics.EVENT:
                raise
            self._note_start(site.name, payload)
            site, channel = self._channels[key]
            return site, site.read(channel, payload)

    def _take(self, key: str, payload: bytes, mono_ns: int) -> None:
        since_ns = mono_ns - self.epoch.mono_ns
        if key not in self._channels:
            raise WireError("stranger", key)
        self._channels[key][0].since_ns = since_ns
        site, message = self._read(key, payload)
        channel = self._channels[key][1]
        if channel == topics.EVENT:
            self._note_admission(message.content)
        if site.accept(channel, message, mono_ns):
            t_ns = message.t_ns if message.t_ns >= 0 or channel != topics.EVENT else since_ns
            log_time_ns = self.epoch.unix_ns + since_ns
            self._writer.add(key, payload, t_ns, log_time_ns, message.sequence, message.content)

    def _take_block(self, key: str, block: bytes, mono_ns: int) -> None:
        """Writes the records of a block; one that is none drops those after it."""
        site = self._channels[key][0]
        since_ns = mono_ns - self.epoch.mono_ns
        site.since_ns = since_ns
        log_time_ns = self.epoch.unix_ns + since_ns
        add = self._writer.add
        for payload, record in site.accept_records(split_states(block), mono_ns):
            add(key, payload, record.sent_ns, log_time_ns, record.tick, record)

    def _take_own(self, key: str, payload: bytes, mono_ns: int) -> None:
        account = self._own[key]
        since_ns = mono_ns - self.epoch.mono_ns
        if key.endswith(topics.STATS):
            stats = decode(payload, RecorderStats)
            boot = stats.boot
            number = account.expected
            content = None
        else:
            event = decode(payload, Event)
            if event.member != topics.RECORDER:
                raise WireError("stranger", key)
            boot = event.boot
            number = event.n
            content = event
        if boot != self.publisher.info.boot:
            raise WireError("another recorder", key)
        if number >= 0 and account.receive(number, mono_ns):
            self._writer.add(
                key, payload, since_ns, self.epoch.unix_ns + since_ns, number, content
            )

    def note_presence(self, key: str, alive: bool) -> None:
        """Notes a member's token that appeared or disappeared."""
        parts = topics.parse_key(key)
        if parts is None or parts.member not in self._sites:
            return
        if str(self._boots.get(parts.member)) == parts.boot:
            (self._gone.discard if alive else self._gone.add)(parts.member)
        elif not alive and len(self._vanished) < STARTS_KEPT:
            self._vanished.add((parts.member, parts.boot))

    def _silent_since_ns(self, site: str, now_ns: int) -> int | None:
        """Returns since when a site is gone; None while its token is present.

        A reconnection may report a token's end after its return: a message of the site that
        arrives later than those under way proves that it is still present.
        """
        if site not in self._gone:
            self._gone_ns.pop(site, None)
            return None
        gone_ns = self._gone_ns.setdefault(site, now_ns)
        heard_ns = self._sites[site].last_received_ns
        return gone_ns if heard_ns is None or heard_ns < gone_ns + UNDER_WAY_NS else heard_ns

    def is_over(self, now_ns: int) -> bool:
        """True once every site has all its messages stored, or is gone for good."""
        left = [self._has_left(name, now_ns) for name in self._sites]  # each notes the time
        return all(left)

    def _has_left(self, site: str, now_ns: int) -> bool:
        if site in self._stored:
            return True
        since_ns = self._silent_since_ns(site, now_ns)
        if since_ns is None:
            return False
        patience_ns = SETTLE_NS
        if self._sites[site].final_ticks is None:
            patience_ns = max(SETTLE_NS, min(AWAY_NS, self._end_ns - since_ns))
        elif not self._sites[site].is_complete:
            patience_ns = RECONNECT_NS
        return now_ns - since_ns > patience_ns

    def is_up_to_date(self, ending_ns: int, now_ns: int) -> bool:
        """True once nothing more can be had of any site, since the recorder was asked to end.

        A site that goes on is one that is heard `SETTLE_NS` after that, without an end, and
        lacks nothing.

        Args:
            ending_ns: when the recorder was asked to end, on its monotonic clock.
            now_ns: the time on that clock.
        """
        for name, site in self._sites.items():
            if self._has_left(name, now_ns):
                continue
            heard_ns = site.last_received_ns or 0
            is_running = (
                site.final_ticks is None
                and now_ns - heard_ns < HEARD_NS
                and not site.lacks_messages
            )
            if not (is_running and now_ns - ending_ns > SETTLE_NS):
                return False
        return True

    def flush(self) -> None:
        """Hands everything so far to the operating system."""
        self._writer.flush()

    def finish(self, queue: InboundQueue, *, rest: bool = True) -> None:
        """Writes the rest of the queue, if that is wanted, the accounts and the end mark."""
        if rest:
            self._drain(queue, None)
        self._overflowed = sum(queue.overflowed.values())
        self._writer.finish(self.render_accounts(queue))

    def render_accounts(self, queue: InboundQueue) -> dict[str, str]:
        """Returns the accounts as they stand in the file: per topic, and dropped messages by
        reason.
        """
        before = {
            topics.key(self.session, name, topics.EVENT): site.event_accounts
            for name, site in self._sites.items()
        }
        texts = {
            f"/{key}": f"{account.describe(*before.get(key, ()))}, overflowed {queue.overflowed[key]}"
            for key, account in self.accounts.items()
        }
        return {
            **texts,
            **{f"dropped: {reason}": str(count) for reason, count in self.dropped.items()},
        }

    def render_summary(self) -> list[str]:
        """Returns a line for every site, and for messages turned away or dropped."""
        lines = []
        for name, site in self._sites.items():
            account = site.accounts[topics.STATE]
            total = (
                " records, its end is unknown"
                if site.final_ticks is None
                else f" of {count_nouns(account.expected, 'record')}"
            )
            lines.append(
                f"recorder: {name}: {account.received}{total}, {account.missing} missing, "
                f"{account.duplicate} duplicate, largest gap {account.largest_gap}"
                + (f", {account.refilled} from its memory" if account.refilled else "")
                + (
                    f", {account.unpublished} not made while it was away"
                    if account.unpublished
                    else ""
                )
            )
        if self._overflowed:
            lines.append(
                f"recorder: {count_nouns(self._overflowed, 'message')} turned away because the queue was full"
            )
        return lines + [
            f"recorder: {count_nouns(count, 'message')} dropped: {reason}"
            for reason, count in self.dropped.items()
        ]

    def describe_problem(self) -> str | None:
        """Describes what is missing; None if nothing is."""
        for name, site in self._sites.items():
            if site.final_ticks is None:
                return f"{name} disappeared after {count_nouns(site.accounts[topics.STATE].received, 'record')}"
            if shortage := site.describe_missing():
                return f"missing of {name}: {shortage}"
        return None


REPORT_EVERY_NS = 1_000_000_000
MAX_GAPS_REPORTED = 20
"""Gaps named of a channel; fewer with many channels."""
_ALL_GAPS = 600


class RecorderReport:
    """The statistics of one recording; `size` returns the bytes of its log."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        recording: Recording,
        queue: InboundQueue,
        size: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._recording = recording
        self._queue = queue
        self._size = size
        self._key = topics.key(recording.session, topics.RECORDER, topics.STATS)
        self._publish = bus.publisher(self._key)
        self._flush_max_ns = 0
        self._due_ns = clock.monotonic_ns() + REPORT_EVERY_NS

    def flushed(self, took_ns: int) -> None:
        """Notes the duration of a flush, ns."""
        self._flush_max_ns = max(self._flush_max_ns, took_ns)

    def poll(self) -> None:
        """Publishes the statistics if they are due."""
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._due_ns:
            on_time = now_ns - self._due_ns < REPORT_EVERY_NS
            self._due_ns = (self._due_ns if on_time else now_ns) + REPORT_EVERY_NS
            self.publish()

    def publish(self) -> None:
        """Publishes the statistics, and puts them into the queue."""
        payload = encode(self._stats())
        self._flush_max_ns = 0
        self._queue.receive(self._key, payload)
        self._publish(payload)

    def _stats(self) -> RecorderStats:
        accounts = {  # by member and channel, as in "m1/state"
            "/".join(key.split("/")[2:]): account
            for key, account in self._recording.accounts.items()
        }
        most = max(1, min(MAX_GAPS_REPORTED, _ALL_GAPS // len(accounts)))
        now_ns = self._clock.monotonic_ns()
        counts: dict[str, Any] = {
            field: {name: getattr(account, field) for name, account in accounts.items()}
            for field in (
                "expected",
                "received",
                "missing",
                "duplicate",
                "reordered",
                "refilled",
            )
        }
        return RecorderStats(
            boot=self._recording.publisher.info.boot,
            t_ns=now_ns - self._recording.epoch.mono_ns,
            **counts,
            gaps={
                name: account.format_gaps(most)
                for name, account in accounts.items()
                if account.missing
            },
            overflowed={
                name: self._queue.overflowed[key]
                for name, key in zip(accounts, self._recording.accounts, strict=True)
            },
            silence_us={name: account.silence_ns // 1000 for name, account in accounts.items()},
            dropped=dict(self._recording.dropped),
            queued=len(self._queue),
            written_bytes=self._size(),
            flush_max_us=self._flush_max_ns // 1000,
            mono_ns=now_ns,
            unix_ns=self._clock.unix_ns(),
        )
