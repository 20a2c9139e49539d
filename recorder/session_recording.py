"""Records one session: writes its messages, finds missing ones, and publishes statistics.

A session consists of sites, processes that run one arm each. Each start of a site has a boot, a
random number that identifies it. A site may be started again while the session runs. Its new
start then continues the numbers of the records, the messages with the results of each period of
the control loop.

Invariant:
    - A message of the session is written once, byte for byte. Any other message is counted as
      dropped, with the reason.
    - The recorder publishes the event "stored" about a site when it has every message of the
      site that it can get. A site that has ended waits for this event, but only for a limited
      time.
    - Statistics are published and recorded once a second, with a bounded size. All times are
      measured by the monotonic clock. If the wall clock is set, only the statistics show it.
"""

from collections import Counter
from collections.abc import Callable

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
"""Time to wait for messages in transit after a site has ended and disappeared, in ns."""
RECONNECT_NS = 10_000_000_000
"""Time to wait for a site that has ended but still has missing records, if its connection is
interrupted, in ns.
"""
HEARD_NS = 500_000_000
"""A site counts as running if one of its messages arrived within this time, in ns."""
UNDER_WAY_NS = 100_000_000
"""Time for which messages of a site that has disappeared may have been in transit, in ns."""
AWAY_NS = 15_000_000_000
"""Time to wait for a site that disappeared without an "end" event, in ns.

Its link may have been

cut, and may work again.
"""
STARTS_KEPT = 4096
"""Largest number of starts of sites that are remembered before they are recorded."""
LAST_NS = 6_000_000_000
"""Longest time that a site stays after its last tick: 5 s and a margin, in ns."""


class Recording:
    """One log while it is recorded: writes messages, and counts received and missing ones.

    `Recorder` creates this object when the session begins, and calls `write` periodically.

    Args:
        writer: Writes the log.
        scenario: Scenario of the session.
        session: Name of the session.
        epoch: Common start time of the session, and the boots of its members. A boot is a
            random number that identifies one start of a process.
        bus: Network connection of the recorder.
        publisher: Publishes the recorder's own events. It also puts them into the queue of the
            received messages, so that they are recorded.

    Attributes:
        session: Name of the session.
        epoch: Common start time of the session, and the boots of its members.
        publisher: Publishes the recorder's own events.
        accounts: For each channel, the counts of received and missing messages, by key.
        dropped: Number of messages that were not written, by the reason.
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
        self.session = session
        self.epoch = epoch
        self.publisher = publisher
        self.dropped: Counter[str] = Counter()
        self._writer = writer
        self._scenario = scenario
        self._bus = bus
        # Boot of the start that is being recorded, by site.
        self._boots = dict(epoch.boots)
        # Boot of a start that may be recorded next, by site.
        self._candidates = dict[str, int]()
        # Boots of the starts that other sites have admitted to the session.
        self._admitted: set[int] = set()
        # Site and boot of starts that have disappeared before they were recorded.
        self._vanished: set[tuple[str, str]] = set()
        # Time at which every site should have left, on the monotonic clock.
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
        # Site and channel of each key.
        self._channels = {
            topics.key(session, name, channel): (site, channel)
            for name, site in self._sites.items()
            for channel in site.accounts
        }
        # Keys under which sites publish blocks of records.
        self._block_keys = {
            key for key, (_, channel) in self._channels.items() if channel == topics.STATE
        }
        self._recorder_accounts = {
            topics.key(session, topics.RECORDER, channel): Account()
            for channel in (topics.EVENT, topics.STATS)
        }
        self.accounts = {
            key: site.accounts[channel] for key, (site, channel) in self._channels.items()
        }
        self.accounts.update(self._recorder_accounts)
        # Sites about which "stored" was published.
        self._stored: set[str] = set()
        # Sites that have disappeared from the network.
        self._gone: set[str] = set()
        # Time at which these sites disappeared, on the monotonic clock.
        self._gone_ns: dict[str, int] = {}
        # Number of messages for which the queue had no room, at the end.
        self._overflowed = 0

    def join_late(self, now_ns: int) -> None:
        """Announces that the recorder has joined a session that is running.

        It also requests the earlier messages, which the sites keep in their buffers for some
        time.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
        """
        t_ns = now_ns - self.epoch.mono_ns
        sites = ", ".join(name for name in self._sites if name not in self._gone)
        self.publisher.publish(
            "late",
            f"the recorder joins at t = {t_ns / 1e9:.3f} s; "
            f"it requests the earlier messages from {sites}",
            t_ns=t_ns,
        )
        for name in self._gone:
            self.publisher.publish("lost", f"{name} is gone", about=name, t_ns=t_ns)
        for repair in self._repairs.values():
            repair.probe()

    def assume_gone(self) -> None:
        """Regards every site as gone until the network reports that it is present."""
        self._gone = set(self._sites)

    def write(self, queue: InboundQueue, now_ns: int) -> None:
        """Writes the messages that have arrived into the log, and requests missing messages.

        A site that has ended waits until the recorder has all its messages. As soon as this is
        the case, the recorder publishes the event "stored" for the site.

        Args:
            queue: Queue of the received messages.
            now_ns: Present time on the monotonic clock, in ns. Messages that arrived later stay
                in the queue.
        """
        self._drain(queue, now_ns)
        self._admit_starts()
        for name, repair in list(self._repairs.items()):
            self._repair_gaps(name, repair, now_ns)
        for name, site in self._sites.items():
            if site.is_complete and name not in self._stored:
                self._stored.add(name)
                self._publish_stored(site, now_ns)

    def _repair_gaps(self, name: str, repair: GapRepair, now_ns: int) -> None:
        """Writes requested messages of a site that have arrived, and requests more.

        Args:
            name: Name of the site.
            repair: Requests the missing messages of the site.
            now_ns: Present time on the monotonic clock, in ns.
        """
        t_ns = now_ns - self.epoch.mono_ns
        self._sites[name].since_ns = t_ns
        gone_since_ns = self._find_gone_since_ns(name, now_ns)
        # If a message arrived after the site was reported as gone, the site can still reply.
        is_present = gone_since_ns is None or gone_since_ns > self._gone_ns[name]
        for channel, message, payload in repair.poll(now_ns, alive=is_present):
            key = topics.key(self.session, name, channel)
            sent_ns = max(message.t_ns, 0)  # a log contains no times before the epoch
            log_time_ns = self.epoch.unix_ns + t_ns
            self._writer.add(
                key, payload, sent_ns, log_time_ns, message.sequence, message.content
            )
            self._note_admission(message.content)

    def _publish_stored(self, site: SiteReception, now_ns: int) -> None:
        """Publishes that all messages of a site that can be obtained are stored."""
        text = f"every record of {site.name} is stored"
        missing = site.describe_missing()
        if missing:
            text = f"all that can be had of {site.name} is stored; missing for good: {missing}"
        t_ns = now_ns - self.epoch.mono_ns
        self.publisher.publish(
            "stored", text, t_ns=t_ns, about=site.name, ticks=site.final_ticks
        )

    def _drain(self, queue: InboundQueue, until_ns: int | None) -> None:
        """Writes the messages of the queue, and counts those that cannot be written as dropped.

        Args:
            queue: Queue of the received messages.
            until_ns: Messages that arrived later stay in the queue. None writes all messages.
        """
        for message in queue.drain(until_ns):
            try:
                if message.key in self._block_keys:
                    self._write_block(*message)
                elif message.key in self._recorder_accounts:
                    self._write_recorder_message(*message)
                else:
                    self._write_site_message(*message)
            except WireError as error:
                self.dropped[error.reason] += 1

    def _admit_starts(self) -> None:
        """Begins to record the next start of each site that was started again.

        A second start may also be a mistake. Therefore it is recorded only if the previous
        start has disappeared or ended, or if another site has admitted the new start.
        """
        for name, boot in list(self._candidates.items()):
            previous = self._sites[name]
            has_left = name in self._gone or name not in self._boots
            has_ended = previous.final_ticks is not None
            is_admitted = boot in self._admitted
            if not (has_left or has_ended or is_admitted):
                continue

            del self._candidates[name]
            self._boots[name] = boot
            site = SiteReception(self._scenario, name, boot, previous)
            repair = GapRepair(self._bus, self.session, site, self.dropped)
            repair.probe()
            self._sites[name] = site
            self._repairs[name] = repair
            for channel in site.accounts:
                key = topics.key(self.session, name, channel)
                self._channels[key] = (site, channel)
                self.accounts[key] = site.accounts[channel]

            self._stored.discard(name)
            self._gone_ns.pop(name, None)
            if (name, str(boot)) in self._vanished:
                self._gone.add(name)
            else:
                self._gone.discard(name)

    def _note_start(self, name: str, payload: bytes) -> None:
        """Notes the next start of a site, if a message is its event of joining.

        Args:
            name: Name of the site under whose key the message arrived.
            payload: The message.

        Raises:
            WireError: The message is not an event.
        """
        event = decode(payload, Event)
        if event.kind not in ("coming", "join") or event.member != name:
            return
        if event.boots.get(name) == event.boot and self._scenario.sites_may_return:
            self._candidates[name] = event.boot
            self._admit_starts()

    def _note_admission(self, event: object) -> None:
        """Evaluates an event by which a site reports about the start of another site.

        The event "admit" states that the site has admitted the start. The event `LAST` states
        how many ticks the site received before the start. Other messages are ignored.
        """
        if not isinstance(event, Event) or event.about not in self._sites:
            return
        boot = event.boots.get(event.about)
        is_recorded = boot == self._boots.get(event.about)
        if event.kind == LAST and is_recorded:
            self._sites[event.about].count_previous_start(event.ticks)
        if event.kind != "admit" or boot is None or is_recorded:
            return
        if self._scenario.sites_may_return and len(self._admitted) < STARTS_KEPT:
            self._admitted.add(boot)
            self._candidates[event.about] = boot
            self._admit_starts()

    def _read(self, key: str, payload: bytes) -> tuple[SiteReception, SiteMessage]:
        """Decodes a message of a site.

        If the message is the first one of the site's next start, that start is recorded from
        now on.

        Args:
            key: Key under which the message arrived.
            payload: The message.

        Returns:
            The site that sent the message, and the message.

        Raises:
            WireError: The message is not valid.
        """
        site, channel = self._channels[key]
        try:
            return site, site.read(channel, payload)
        except WireError:
            if channel != topics.EVENT:
                raise
            self._note_start(site.name, payload)
            site, channel = self._channels[key]
            return site, site.read(channel, payload)

    def _write_site_message(self, key: str, payload: bytes, mono_ns: int) -> None:
        """Writes an event or statistics of a site, unless they were written before.

        Args:
            key: Key under which the message arrived.
            payload: The message.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: The message is not valid.
        """
        since_ns = mono_ns - self.epoch.mono_ns
        if key not in self._channels:
            raise WireError("stranger", f"a message arrived under the unknown key {key}")
        self._channels[key][0].since_ns = since_ns
        site, message = self._read(key, payload)
        channel = self._channels[key][1]
        if channel == topics.EVENT:
            self._note_admission(message.content)
        if not site.accept(channel, message, mono_ns):
            return

        sent_ns = message.t_ns
        if sent_ns < 0 and channel == topics.EVENT:
            # An event from before the epoch is stored with the time of its arrival.
            sent_ns = since_ns
        log_time_ns = self.epoch.unix_ns + since_ns
        self._writer.add(key, payload, sent_ns, log_time_ns, message.sequence, message.content)

    def _write_block(self, key: str, block: bytes, mono_ns: int) -> None:
        """Writes the records of a block up to the first payload that is not a valid record.

        Args:
            key: Key under which the block arrived.
            block: The encoded records.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: A payload is not a valid record.
        """
        site = self._channels[key][0]
        since_ns = mono_ns - self.epoch.mono_ns
        site.since_ns = since_ns
        log_time_ns = self.epoch.unix_ns + since_ns
        add = self._writer.add
        for payload, record in site.accept_records(split_states(block), mono_ns):
            add(key, payload, record.sent_ns, log_time_ns, record.tick, record)

    def _write_recorder_message(self, key: str, payload: bytes, mono_ns: int) -> None:
        """Writes an event or statistics of this recorder.

        Args:
            key: Key of the message.
            payload: The message.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: The message is from another recorder, or is not valid.
        """
        account = self._recorder_accounts[key]
        since_ns = mono_ns - self.epoch.mono_ns
        content: Event | None = None
        if key.endswith(topics.STATS):
            boot = decode(payload, RecorderStats).boot
            number = account.expected  # statistics contain no number
        else:
            content = decode(payload, Event)
            if content.member != topics.RECORDER:
                raise WireError("stranger", f"{content.member} published under {key}")
            boot = content.boot
            number = content.n
        if boot != self.publisher.info.boot:
            raise WireError("another recorder", f"another process published under {key}")
        if number >= 0 and account.receive(number, mono_ns):
            log_time_ns = self.epoch.unix_ns + since_ns
            self._writer.add(key, payload, since_ns, log_time_ns, number, content)

    def note_presence(self, key: str, alive: bool) -> None:
        """Notes that a site appeared on the network, or disappeared from it.

        The network announces each start of a site by a token, which disappears with the
        process.

        Args:
            key: Key of the token, which contains the name of the site and the number of its
                start.
            alive: True if the token appeared, False if it disappeared.
        """
        parts = topics.parse_key(key)
        if parts is None or parts.member not in self._sites:
            return
        if str(self._boots.get(parts.member)) != parts.boot:
            if not alive and len(self._vanished) < STARTS_KEPT:
                self._vanished.add((parts.member, parts.boot))
        elif alive:
            self._gone.discard(parts.member)
        else:
            self._gone.add(parts.member)

    def _find_gone_since_ns(self, site: str, now_ns: int) -> int | None:
        """Returns the time since when a site is gone. None if it is present.

        When a connection is established again, the network may report that a site disappeared
        after it has reported the return. Therefore, if a message arrives so late that it cannot
        have been in transit (`UNDER_WAY_NS`), the site is present nevertheless. It then counts
        as gone since the arrival of that message.

        Args:
            site: Name of the site.
            now_ns: Present time on the monotonic clock, in ns.

        Returns:
            The time on the monotonic clock, in ns.
        """
        if site not in self._gone:
            self._gone_ns.pop(site, None)
            return None
        gone_ns = self._gone_ns.setdefault(site, now_ns)
        last_ns = self._sites[site].last_received_ns
        if last_ns is None or last_ns < gone_ns + UNDER_WAY_NS:
            return gone_ns
        return last_ns

    def is_over(self, now_ns: int) -> bool:
        """Finds out whether the recording can end, because no site can send any more messages.

        Args:
            now_ns: Present time on the monotonic clock, in ns.

        Returns:
            True if for every site, either all messages are stored or the site is gone for good.
        """
        # Every site is examined, because `_has_left` notes the time at which a site
        # disappeared.
        left = [self._has_left(name, now_ns) for name in self._sites]
        return all(left)

    def _has_left(self, site: str, now_ns: int) -> bool:
        """Returns True if all messages of a site are stored, or if the site is gone for good.

        How long the recorder waits for a site that is gone depends on whether its end and all
        its messages are known.
        """
        if site in self._stored:
            return True
        since_ns = self._find_gone_since_ns(site, now_ns)
        if since_ns is None:
            return False

        wait_ns = SETTLE_NS
        if self._sites[site].final_ticks is None:
            wait_ns = max(SETTLE_NS, min(AWAY_NS, self._end_ns - since_ns))
        elif not self._sites[site].is_complete:
            wait_ns = RECONNECT_NS
        return now_ns - since_ns > wait_ns

    def is_up_to_date(self, ending_ns: int, now_ns: int) -> bool:
        """Returns True if the recorder has every message that the sites have sent so far.

        The recorder calls this method after it was told to end during a running session. It
        waits for `SETTLE_NS`, because messages may still be in transit. After this time, every
        site that still runs must have no missing message.

        Args:
            ending_ns: Time at which the recorder was told to end, on the monotonic clock, in
                ns.
            now_ns: Present time on the monotonic clock, in ns.
        """
        for name, site in self._sites.items():
            if self._has_left(name, now_ns):
                continue
            silence_ns = now_ns - (site.last_received_ns or 0)
            is_running = site.final_ticks is None and silence_ns < HEARD_NS
            if not is_running or site.lacks_messages or now_ns - ending_ns <= SETTLE_NS:
                return False
        return True

    def flush(self) -> None:
        """Passes all written messages to the operating system."""
        self._writer.flush()

    def finish(self, queue: InboundQueue, *, rest: bool = True) -> None:
        """Finishes the log with the counts of messages and the end mark.

        Args:
            queue: Queue of the received messages.
            rest: True to write the messages that still wait in the queue before.
        """
        if rest:
            self._drain(queue, None)
        self._overflowed = sum(queue.overflowed.values())
        self._writer.finish(self.render_accounts(queue))

    def render_accounts(self, queue: InboundQueue) -> dict[str, str]:
        """Formats the numbers of received and missing messages, as they are stored in the log.

        Args:
            queue: Queue of the received messages, which counts those for which it had no room.

        Returns:
            A line for each topic, and the number of dropped messages for each reason.
        """
        event_accounts = {
            topics.key(self.session, name, topics.EVENT): site.event_accounts
            for name, site in self._sites.items()
        }
        texts = {}
        for key, account in self.accounts.items():
            counts = account.describe(*event_accounts.get(key, ()))
            texts[f"/{key}"] = f"{counts}, overflowed {queue.overflowed[key]}"
        for reason, count in self.dropped.items():
            texts[f"dropped: {reason}"] = str(count)
        return texts

    def render_summary(self) -> list[str]:
        """Summarises the recording for the user.

        Returns:
            A line for each site with the numbers of its records, and a line for each reason why
            messages were not written.
        """
        lines = [self._summarize_site(site) for site in self._sites.values()]
        if self._overflowed:
            messages = count_nouns(self._overflowed, "message")
            lines.append(f"recorder: {messages} turned away because the queue was full")
        for reason, count in self.dropped.items():
            lines.append(f"recorder: {count_nouns(count, 'message')} dropped: {reason}")
        return lines

    def _summarize_site(self, site: SiteReception) -> str:
        """Returns a line for the user about the records of a site."""
        account = site.accounts[topics.STATE]
        total = f" of {count_nouns(account.expected, 'record')}"
        if site.final_ticks is None:
            total = " records, its end is unknown"
        line = (
            f"recorder: {site.name}: {account.received}{total}, {account.missing} missing, "
            f"{account.duplicate} duplicate, largest gap {account.largest_gap}"
        )
        if account.refilled:
            line += f", {account.refilled} from its memory"
        if account.unpublished:
            line += f", {account.unpublished} not made while it was away"
        return line

    def describe_problem(self) -> str | None:
        """Describes the first problem of the recording, for the error message at its end.

        Returns:
            The site that disappeared or lacks messages, as a text. None if there is no problem.
        """
        for name, site in self._sites.items():
            if site.final_ticks is None:
                records = count_nouns(site.accounts[topics.STATE].received, "record")
                return f"{name} disappeared after {records}"
            missing = site.describe_missing()
            if missing:
                return f"missing of {name}: {missing}"
        return None


REPORT_EVERY_NS = 1_000_000_000
"""Period of the statistics, in ns."""
MAX_GAPS_REPORTED = 20
"""Largest number of gaps of a channel that the statistics list."""
_ALL_GAPS = 600
"""Largest number of gaps of all channels together that the statistics list."""


class RecorderReport:
    """Publishes statistics of a recording once a second, such as its size and its gaps.

    Args:
        bus: Network connection of the recorder.
        clock: Clock of the recorder.
        recording: The recording.
        queue: Queue of the received messages. The statistics are added to it, so that they are
            recorded.
        size: Function that returns the size of the log in bytes.
    """

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

    def note_flush(self, duration_ns: int) -> None:
        """Notes how long it took to pass the written messages to the operating system.

        The next statistics state the longest of these times.

        Args:
            duration_ns: The time, in ns.
        """
        self._flush_max_ns = max(self._flush_max_ns, duration_ns)

    def poll(self) -> None:
        """Publishes the statistics of the recording if they are due, once a second.

        The statistics state, for example, the size of the log and the numbers of missing
        messages.
        """
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._due_ns:
            # After a long delay, the missed statistics are not published later.
            is_on_time = now_ns - self._due_ns < REPORT_EVERY_NS
            self._due_ns = (self._due_ns if is_on_time else now_ns) + REPORT_EVERY_NS
            self.publish()

    def publish(self) -> None:
        """Publishes the statistics of the recording now, and also writes them into the log."""
        payload = encode(self._make_stats())
        self._flush_max_ns = 0
        self._queue.receive(self._key, payload)
        self._publish(payload)

    def _make_stats(self) -> RecorderStats:
        """Returns the present statistics, with the counts and gaps of every channel."""
        recording = self._recording
        now_ns = self._clock.monotonic_ns()
        stats = RecorderStats(
            boot=recording.publisher.info.boot,
            t_ns=now_ns - recording.epoch.mono_ns,
            expected={},
            received={},
            missing={},
            dropped=dict(recording.dropped),
            queued=len(self._queue),
            written_bytes=self._size(),
            flush_max_us=self._flush_max_ns // 1000,
            mono_ns=now_ns,
            unix_ns=self._clock.unix_ns(),
        )
        gap_limit = max(1, min(MAX_GAPS_REPORTED, _ALL_GAPS // len(recording.accounts)))
        for key, account in recording.accounts.items():
            # A key is "trilat/SESSION/MEMBER/CHANNEL". The statistics use "MEMBER/CHANNEL".
            name = "/".join(key.split("/")[2:])
            stats.expected[name] = account.expected
            stats.received[name] = account.received
            stats.missing[name] = account.missing
            stats.duplicate[name] = account.duplicate
            stats.reordered[name] = account.reordered
            stats.refilled[name] = account.refilled
            if account.missing:
                stats.gaps[name] = account.format_gaps(gap_limit)
            stats.overflowed[name] = self._queue.overflowed[key]
            stats.silence_us[name] = account.silence_ns // 1000
        return stats
