"""Records one session: writes its messages, finds missing ones, and publishes statistics.

A site may be restarted while the session is running. Each start is identified by its boot (a
random number). The numbering of the records continues across starts.

Invariant:
    - A message of the session is written once, byte for byte. Any other message is counted as
      dropped, with the reason.
    - The recorder publishes the event "stored" about a site once it has every message from the
      site that can still be obtained. A site that has ended waits for this event, but only for
      a limited time.
    - Statistics are published and recorded once per second, with a bounded size. All times are
      measured with the monotonic clock. If the wall clock is set, this is visible only in the
      statistics.
"""

from collections import Counter
from collections.abc import Callable

from trilat_net.errors import WireError, count_nouns
from trilat_net.log import LAST, Account, LogParts, LogWriter, SessionScenario
from trilat_net.net import (
    Bus,
    Clock,
    Epoch,
    Event,
    EventPublisher,
    RecorderStats,
    decode,
    encode,
    split_states,
    topics,
)

from .backfill import GapRepair
from .site_reception import AWAY_NS, InboundQueue, SiteMessage, SiteReception

SETTLE_NS = 1_000_000_000
"""Time to wait for messages in transit after a site has ended and disappeared, in ns."""
RECONNECT_NS = 10_000_000_000
"""Time to wait for a disconnected site that has ended but still has missing records, in ns."""
_HEARD_NS = 500_000_000
"""Time since its last message within which a site counts as running, in ns."""
_UNDER_WAY_NS = 100_000_000
"""Time for which messages from a site that has disappeared may have been in transit, in ns."""
STARTS_KEPT = 4096
"""Maximum number of starts of sites that are remembered before they are recorded."""
LAST_NS = 6_000_000_000
"""Maximum time that a site stays after its last tick: 5 s plus a margin, in ns."""


class Recording:
    """Writes the log (MCAP file) of a session, and counts received and missing messages.

    `Recorder` creates this object when the session begins, and calls `write` periodically.

    Args:
        writer: Writes the log.
        scenario: Scenario of the session.
        session: Name of the session.
        epoch: Common start time of the session, and the boots of its members. A boot is a
            random number that identifies one start of a process.
        bus: Network connection of the recorder.
        publisher: Publishes the recorder's own events. It also puts them into the queue of
            received messages, so that they are recorded.

    Attributes:
        session: Name of the session.
        epoch: Common start time of the session, and the boots of its members.
        publisher: Publishes the recorder's own events.
        accounts: Mapping from the key of each channel to the counts of received and missing
            messages.
        dropped: Mapping from reason to the number of messages that were not written.
    """

    def __init__(
        self,
        writer: LogWriter | LogParts,
        scenario: SessionScenario,
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
        # A boot is the random number that identifies one start of a site's process.
        # Boot of the start that is being recorded, by site.
        self._recorded_boots = dict(epoch.boots)
        # Boot of a start that may be recorded next, by site. `_admit_starts` decides.
        self._next_boots = dict[str, int]()
        # Boots of the starts that other sites have admitted to the session.
        self._admitted_boots: set[int] = set()
        # Site and boot (as text) of starts that disappeared from the network while they were
        # not the recorded start of their site.
        self._vanished_starts: set[tuple[str, str]] = set()
        # Time at which every site should have left, on the monotonic clock.
        self._end_ns = epoch.mono_ns + round(scenario.duration_s * 1e9) + LAST_NS
        self._repairs = {
            name: GapRepair(
                bus=bus,
                session=session,
                scenario=scenario,
                site=name,
                boot=epoch.boots.get(name),
                dropped=self.dropped,
                now_ns=epoch.mono_ns,
            )
            for name in scenario.names
        }
        # Site and channel of each key.
        self._channels = {
            topics.key(session, name, channel): (repair.reception, channel)
            for name, repair in self._repairs.items()
            for channel in repair.reception.accounts
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
        self._stored_sites: set[str] = set()
        # Sites whose recorded start has disappeared, as the network reports.
        self._gone_sites: set[str] = set()
        # Time at which this was first noticed, on the monotonic clock in ns, by site.
        self._noticed_gone_ns: dict[str, int] = {}
        # Number of messages for which the queue had no room, at the end.
        self._overflowed = 0

    def join_late(self, now_ns: int) -> None:
        """Announces that the recorder has joined a running session, and requests old messages.

        The recorder publishes the event "late" with the time at which it joins, and an event
        "lost" for each site that is not present. The sites keep their messages in buffers for
        some time. The newest messages of each site are requested (a probe), and their numbers
        show which earlier messages are missing. `write` then requests those too.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
        """
        since_epoch_ns = now_ns - self.epoch.mono_ns
        present_sites = [name for name in self._repairs if name not in self._gone_sites]
        self.publisher.publish(
            "late",
            f"the recorder joins at t = {since_epoch_ns / 1e9:.3f} s; "
            f"it requests earlier messages from {', '.join(present_sites)}",
            t_ns=since_epoch_ns,
        )
        for name in self._gone_sites:
            self.publisher.publish("lost", f"{name} is gone", about=name, t_ns=since_epoch_ns)
        for repair in self._repairs.values():
            repair.probe()

    def assume_gone(self) -> None:
        """Treats every site as gone until the network reports that it is present.

        A recorder that joins a running session cannot know which sites have already left. If it
        expected messages from such a site, it would wait forever.
        """
        self._gone_sites = set(self._repairs)

    def write(self, queue: InboundQueue, now_ns: int) -> None:
        """Writes the messages that have arrived to the log, and requests missing messages.

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
        for name, repair in self._repairs.items():
            site = repair.reception
            if site.is_complete and name not in self._stored_sites:
                self._stored_sites.add(name)
                self._publish_stored(site, now_ns)

    @property
    def is_repairing(self) -> bool:
        """True while messages are missing that may still be obtained from their sender.

        This is the case if a site that has the messages is still present, or if its reply to a
        request is pending. The log is not closed in the meantime.
        """
        return any(repair.is_active for repair in self._repairs.values())

    @property
    def repaired_ns(self) -> int:
        """Arrival time of the latest recovered message, on the monotonic clock, in ns.

        If this was too long ago, a recorder that is ending stops waiting for missing messages.
        """
        return max(repair.progress_ns for repair in self._repairs.values())

    def _repair_gaps(self, name: str, repair: GapRepair, now_ns: int) -> None:
        """Writes messages that a site resent on request, and requests further missing ones.

        Three time scales are used: the monotonic clock, the time since the epoch (the start of
        the session), and Unix time, which the log contains as the time of arrival.

        Args:
            name: Name of the site.
            repair: Requests the missing messages of the site.
            now_ns: Present time on the monotonic clock, in ns.
        """
        since_epoch_ns = now_ns - self.epoch.mono_ns
        # The reception uses this time to judge whether a message is from the future.
        repair.reception.since_ns = since_epoch_ns
        gone_since_ns = self._update_gone_since_ns(name, now_ns)
        # If a message arrived after the site was reported as gone, the site can still reply.
        is_present = gone_since_ns is None or gone_since_ns > self._noticed_gone_ns[name]
        for channel, message, payload in repair.poll(now_ns, alive=is_present):
            key = topics.key(self.session, name, channel)
            sent_ns = max(message.t_ns, 0)  # a log contains no times before the epoch
            log_time_ns = self.epoch.unix_ns + since_epoch_ns
            self._writer.add(
                key, payload, sent_ns, log_time_ns, message.sequence, message.content
            )
            # An event may state that the site has admitted the next start of another site.
            self._note_admission(message.content)

    def _publish_stored(self, site: SiteReception, now_ns: int) -> None:
        """Announces that the log has all messages of one site that can still be obtained.

        The site waits for this event before it ends, because it keeps messages that the
        recorder may request again. The text of the event says which messages remain missing.

        Args:
            site: Reception of the site, which has ended.
            now_ns: Present time on the monotonic clock, in ns.
        """
        text = f"every record of {site.name} is stored"
        missing_text = site.describe_missing()
        if missing_text:
            text = (
                f"all that can be had of {site.name} is stored; "
                f"missing for good: {missing_text}"
            )
        t_ns = now_ns - self.epoch.mono_ns
        self.publisher.publish(
            "stored", text, t_ns=t_ns, about=site.name, ticks=site.final_ticks
        )

    def _drain(self, queue: InboundQueue, until_ns: int | None) -> None:
        """Writes the messages in the queue, and counts those that cannot be written as dropped.

        The writing thread calls this method regularly. A message that cannot be written, for
        example because it is invalid, must not end the recording.

        Args:
            queue: Queue of the received messages.
            until_ns: Messages that arrived later stay in the queue. If None, all messages are
                written.
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
        """Begins to record the next start of each site that was restarted.

        A second start may also be a mistake that makes two processes act as the same site. The
        next start is therefore recorded only if the previous one has disappeared or ended, or
        if another site of the session has admitted the new start. Until then, it remains in
        `_next_boots`.
        """
        for name, boot in list(self._next_boots.items()):
            previous = self._repairs[name].reception
            has_left = name in self._gone_sites or name not in self._recorded_boots
            has_ended = previous.final_ticks is not None
            is_admitted = boot in self._admitted_boots
            if not (has_left or has_ended or is_admitted):
                continue

            # The reception of the new start continues the counts of the previous one.
            del self._next_boots[name]
            self._recorded_boots[name] = boot
            repair = self._repairs[name].follow_start(boot)
            repair.probe()
            site = repair.reception
            self._repairs[name] = repair
            for channel in site.accounts:
                key = topics.key(self.session, name, channel)
                self._channels[key] = (site, channel)
                self.accounts[key] = site.accounts[channel]

            # The notes about the presence of the previous start no longer apply. The new start
            # may have disappeared already, before it was recorded.
            self._stored_sites.discard(name)
            self._noticed_gone_ns.pop(name, None)
            has_new_start_vanished = (name, str(boot)) in self._vanished_starts
            if has_new_start_vanished:
                self._gone_sites.add(name)
            else:
                self._gone_sites.discard(name)

    def _note_start(self, name: str, payload: bytes) -> None:
        """Registers that a site was restarted, if a message is the event that announces it.

        From then on, messages of the new start are expected. A message that announces another
        member, or belongs to a scenario in which sites may not return, has no effect.

        Args:
            name: Name of the site under whose key the message arrived.
            payload: The message.

        Raises:
            WireError: The message is not an event.
        """
        boot = self._repairs[name].reception.find_new_boot(payload, ("coming", "join"))
        if boot is not None:
            self._next_boots[name] = boot
            self._admit_starts()

    def _note_admission(self, event: object) -> None:
        """Evaluates an event in which one site reports that another site was restarted.

        There are two such events, and both state the boot (the random number that identifies
        the new start):

        - "admit": The reporting site has admitted the new start to the session. If this start
          is not recorded yet, it will be recorded from now on.
        - `LAST`: The number of ticks whose samples the reporting site had received before the
          new start. It is evaluated once the new start is being recorded, because it shows how
          many messages of the previous start are missing.

        Args:
            event: Any decoded message of a site. All messages other than these events are
                ignored.
        """
        if not isinstance(event, Event) or event.about not in self._repairs:
            return

        restarted_site = event.about
        boot = event.boots.get(restarted_site)
        is_recorded = boot == self._recorded_boots.get(restarted_site)
        if event.kind == LAST and is_recorded:
            self._repairs[restarted_site].reception.count_previous_start(event.ticks)
        is_new_admission = event.kind == "admit" and boot is not None and not is_recorded
        if not is_new_admission:
            return

        assert boot is not None
        # The limit bounds the memory if a faulty site admits invented starts.
        has_room = len(self._admitted_boots) < STARTS_KEPT
        if self._scenario.sites_may_return and has_room:
            self._admitted_boots.add(boot)
            self._next_boots[restarted_site] = boot
            self._admit_starts()

    def _read(self, key: str, payload: bytes) -> tuple[SiteReception, SiteMessage]:
        """Decodes a message from a site.

        If the site has been restarted and this is its first message, the new start is recorded
        from now on.

        Args:
            key: Key under which the message arrived.
            payload: The message.

        Returns:
            The site that sent the message, and the message.

        Raises:
            WireError: The message is invalid.
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
        """Writes an event or statistics from a site, unless they have already been written.

        The log contains two times for a message: the sending time, in ns since the epoch (the
        start of the session), and the arrival time, as Unix time.

        Args:
            key: Key under which the message arrived. It names the site and the channel.
            payload: The message.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: The message is invalid.
        """
        arrived_since_epoch_ns = mono_ns - self.epoch.mono_ns
        if key not in self._channels:
            raise WireError("stranger", f"a message arrived under the unknown key {key}")

        recorded_site, channel = self._channels[key]
        # The reception uses this time to judge whether the message is from the future.
        recorded_site.since_ns = arrived_since_epoch_ns
        # If the message is the first one of the site's next start, `site` is a new object.
        site, message = self._read(key, payload)
        if channel == topics.EVENT:
            self._note_admission(message.content)
        is_new = site.accept(channel, message, mono_ns)
        if not is_new:
            return

        sent_ns = message.t_ns
        if sent_ns < 0 and channel == topics.EVENT:
            # An event from before the epoch is stored with the time of its arrival.
            sent_ns = arrived_since_epoch_ns
        log_time_ns = self.epoch.unix_ns + arrived_since_epoch_ns
        self._writer.add(key, payload, sent_ns, log_time_ns, message.sequence, message.content)

    def _write_block(self, key: str, block: bytes, mono_ns: int) -> None:
        """Writes the records of a block, which contains the results of several ticks of a site.

        The rest of the block is skipped after the first payload that is not a valid record,
        because its sender is faulty.

        Args:
            key: Key under which the block arrived.
            block: The encoded records.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: A payload is not a valid record.
        """
        site, _ = self._channels[key]
        since_epoch_ns = mono_ns - self.epoch.mono_ns
        site.since_ns = since_epoch_ns
        log_time_ns = self.epoch.unix_ns + since_epoch_ns
        add = self._writer.add  # read once, because this loop runs for every record
        for payload, record in site.accept_records(split_states(block), mono_ns):
            add(key, payload, record.sent_ns, log_time_ns, record.tick, record)

    def _write_recorder_message(self, key: str, payload: bytes, mono_ns: int) -> None:
        """Writes an event or statistics of this recorder, after checking that they are its own.

        The recorder puts its own messages into the queue of received messages. Other processes,
        for example a second recorder, can publish under the same keys. Their messages are
        rejected: a message must state the boot (the random number that identifies this start of
        the recorder).

        Args:
            key: Key of the message: the key of recorders' events or of their statistics.
            payload: The message.
            mono_ns: Time of the arrival on the monotonic clock, in ns.

        Raises:
            WireError: The message is from another recorder, or is invalid.
        """
        account = self._recorder_accounts[key]
        since_epoch_ns = mono_ns - self.epoch.mono_ns
        event: Event | None = None
        if key.endswith(topics.STATS):
            boot = decode(payload, RecorderStats).boot
            # Statistics contain no number. Each of them gets the next number of the account, so
            # that none counts as a duplicate.
            number = account.expected
        else:
            event = decode(payload, Event)
            if event.member != topics.RECORDER:
                raise WireError("stranger", f"{event.member} published under {key}")
            boot = event.boot
            number = event.n
        if boot != self.publisher.info.boot:
            raise WireError("another recorder", f"another process published under {key}")

        is_new = number >= 0 and account.receive(number, mono_ns)
        if is_new:
            # The sending time equals the arrival time, because sender and receiver are the same
            # process.
            sent_ns = since_epoch_ns
            log_time_ns = self.epoch.unix_ns + since_epoch_ns
            self._writer.add(key, payload, sent_ns, log_time_ns, number, event)

    def note_presence(self, key: str, alive: bool) -> None:
        """Registers that a site has appeared on the network or disappeared from it.

        The network announces each start of a site with a token, which disappears with the
        process.

        A token may belong to a start other than the one being recorded, either an earlier or a
        later start. A token of another start does not affect the recorded one. Its
        disappearance is noted anyway, because that start may be recorded later, and the network
        will not report the disappearance again (`_admit_starts`). The number of these notes is
        limited.

        Args:
            key: Key of the token, which contains the name of the site and the boot (the random
                number that identifies the start).
            alive: True if the token appeared, False if it disappeared.
        """
        token = topics.parse_key(key)
        if token is None or token.member not in self._repairs:
            return

        recorded_boot = str(self._recorded_boots.get(token.member))  # keys contain text
        is_recorded_start = recorded_boot == token.boot
        if not is_recorded_start:
            if not alive and len(self._vanished_starts) < STARTS_KEPT:
                self._vanished_starts.add((token.member, token.boot))
        elif alive:
            self._gone_sites.discard(token.member)
        else:
            self._gone_sites.add(token.member)

    def _update_gone_since_ns(self, site: str, now_ns: int) -> int | None:
        """Registers when a site was first found gone, and returns when the wait for it begins.

        The caller uses the result to decide how much longer to wait for the site.

        After a reconnection, the network may report the return of a site first, and its earlier
        disappearance afterwards. The report that the site is gone is then wrong, which only the
        messages from the site reveal: a message that arrives more than `_UNDER_WAY_NS` after
        the report cannot have been in transit. In this case, the wait restarts with each
        message, so the site is never given up as long as messages arrive.

        Args:
            site: Name of the site.
            now_ns: Present time on the monotonic clock, in ns.

        Returns:
            The time from which to wait, on the monotonic clock, in ns: the time at which the
            site was found gone or, in the case above, the arrival of its last message. None if
            the network reports the site as present.
        """
        if site not in self._gone_sites:
            self._noticed_gone_ns.pop(site, None)
            return None
        noticed_ns = self._noticed_gone_ns.setdefault(site, now_ns)
        last_message_ns = self._repairs[site].reception.last_received_ns
        if last_message_ns is None or last_message_ns < noticed_ns + _UNDER_WAY_NS:
            return noticed_ns
        return last_message_ns

    def is_over(self, now_ns: int) -> bool:
        """Returns True if the recording can end, because no site can send any more messages.

        For every site, either all messages must be stored, or the site must be gone for good.
        The recorder then completes the log file and ends.

        Args:
            now_ns: Present time on the monotonic clock, in ns.
        """
        # Every site is examined, because `_has_left` notes the time at which a site
        # disappeared.
        have_left = [self._has_left(name, now_ns) for name in self._repairs]
        return all(have_left)

    def _has_left(self, site: str, now_ns: int) -> bool:
        """Returns True if the recorder no longer has to wait for messages from a site.

        This is the case if all messages of the site are stored, or if the site has been absent
        from the network for so long that it is considered gone for good.

        Args:
            site: Name of the site.
            now_ns: Present time on the monotonic clock, in ns.
        """
        if site in self._stored_sites:
            return True

        absent_since_ns = self._update_gone_since_ns(site, now_ns)
        if absent_since_ns is None:  # the site is present
            return False

        reception = self._repairs[site].reception
        has_ended = reception.final_ticks is not None
        if not has_ended:
            # The connection may have been cut, so the site may return. There is no reason to
            # wait beyond `_end_ns`, because every site should have left by then.
            until_session_end_ns = self._end_ns - absent_since_ns
            wait_ns = max(SETTLE_NS, min(AWAY_NS, until_session_end_ns))
        elif not reception.is_complete:
            # After its end, a site waits until the recorder has its messages. If its connection
            # is only interrupted, it can still send the missing ones.
            wait_ns = RECONNECT_NS
        else:
            # Nothing is known to be missing, but messages may still be in transit.
            wait_ns = SETTLE_NS
        return now_ns - absent_since_ns > wait_ns

    def is_up_to_date(self, ending_ns: int, now_ns: int) -> bool:
        """Determines whether the recorder has every message that the sites have sent so far.

        The recorder calls this method repeatedly after it was told to end while the session is
        still running. There are three cases for each site:

        - The site has left, and no more messages are expected from it (`_has_left`).
        - The site is running and sending messages, whose numbers show which messages are
          missing. `SETTLE_NS` after the recorder was told to end, all messages that were in
          transit when it was told have either arrived or left gaps.
        - Otherwise, the site has ended or is silent, but has not left. It may have sent
          messages unknown to the recorder, or the last check of its messages may still be
          pending. The recorder then waits until the site is running again or has left.

        Args:
            ending_ns: Time at which the recorder was told to end, on the monotonic clock, in
                ns.
            now_ns: Present time on the monotonic clock, in ns.

        Returns:
            True if every site has left, or is running with no missing messages.
        """
        may_be_in_transit = now_ns - ending_ns <= SETTLE_NS
        for name, repair in self._repairs.items():
            if self._has_left(name, now_ns):
                continue
            site = repair.reception
            silence_ns = now_ns - (site.last_received_ns or 0)
            is_running = site.final_ticks is None and silence_ns < _HEARD_NS
            if not is_running:
                return False
            if site.lacks_messages or may_be_in_transit:
                return False
        return True

    def flush(self) -> None:
        """Passes all messages buffered in this process to the operating system.

        They are then in the file even if this process crashes. Otherwise, a crash would lose
        the messages since the last call.
        """
        self._writer.flush()

    def finish(self, queue: InboundQueue, *, rest: bool = True) -> None:
        """Closes the log: writes the message counts and marks the file as complete.

        A log without this mark was cut off, for example by a power failure.

        Args:
            queue: Queue of the received messages.
            rest: True to first write the messages that are still in the queue.
        """
        if rest:
            self._drain(queue, None)
        self._overflowed = sum(queue.overflowed.values())
        self._writer.finish(self.render_accounts(queue))

    def render_accounts(self, queue: InboundQueue) -> dict[str, str]:
        """Formats the numbers of received and missing messages for storage in the log.

        The numbers show a reader of the log whether the log is complete.

        Args:
            queue: Queue of the received messages, which counts those that it could not hold.

        Returns:
            One line per topic, and the number of dropped messages for each reason.
        """
        # Counts of the events of earlier starts of a site, by key.
        event_accounts = {}
        for name, repair in self._repairs.items():
            event_key = topics.key(self.session, name, topics.EVENT)
            event_accounts[event_key] = repair.reception.event_accounts
        texts = {}
        for key, account in self.accounts.items():
            earlier_accounts = event_accounts.get(key, ())
            counts = account.describe(*earlier_accounts)
            texts[f"/{key}"] = f"{counts}, overflowed {queue.overflowed[key]}"

        for reason, count in self.dropped.items():
            texts[f"dropped: {reason}"] = str(count)
        return texts

    def render_summary(self) -> list[str]:
        """Returns lines that tell the user at the end whether the log is complete.

        There is one line per site with the numbers of its records, and one line for each reason
        why messages were not written.
        """
        lines = [self._summarize_site(repair.reception) for repair in self._repairs.values()]
        if self._overflowed:
            messages_text = count_nouns(self._overflowed, "message")
            lines.append(f"recorder: {messages_text} dropped because the queue was full")
        for reason, count in self.dropped.items():
            lines.append(f"recorder: {count_nouns(count, 'message')} dropped: {reason}")
        return lines

    def _summarize_site(self, site: SiteReception) -> str:
        """Summarises the records of a site in one line for the user, when recording ends.

        Example: "recorder: s: 12000 of 12000 records, 0 missing, 3 duplicate, largest gap 2".

        Args:
            site: Reception of the site.
        """
        account = site.accounts[topics.STATE]
        total_text = f" of {count_nouns(account.expected, 'record')}"
        if site.final_ticks is None:
            total_text = " records, its end is unknown"

        line = (
            f"recorder: {site.name}: {account.received}{total_text}, "
            f"{account.missing} missing, {account.duplicate} duplicate, "
            f"largest gap {account.largest_gap}"
        )

        if account.refilled:
            line += f", {account.refilled} from its memory"
        if site.skipped_ticks:
            line += f", {site.skipped_ticks} skipped"
        absent_ticks = account.unpublished - site.skipped_ticks
        if absent_ticks:
            line += f", {absent_ticks} not executed while it was away"
        return line

    def describe_problem(self) -> str | None:
        """Describes the first problem of the recording, for the recorder's final error.

        The recorder ends with an error if the log is incomplete, so that nobody uses an
        incomplete log unknowingly.

        Returns:
            A sentence about a site that disappeared or whose messages are missing, or None if
            there is no problem.
        """
        for name, repair in self._repairs.items():
            site = repair.reception
            if site.final_ticks is None:
                records_text = count_nouns(site.accounts[topics.STATE].received, "record")
                return f"{name} disappeared after {records_text}"
            missing_text = site.describe_missing()
            if missing_text:
                return f"missing of {name}: {missing_text}"
        return None


REPORT_EVERY_NS = 1_000_000_000
"""Interval between statistics, in ns."""
_MAX_GAPS_REPORTED = 20
"""Maximum number of gaps per channel that the statistics list."""
_ALL_GAPS = 600
"""Maximum number of gaps that the statistics list for all channels together."""


class RecorderReport:
    """Publishes statistics of a recording once per second, such as its size and losses.

    During the session, they show whether the log is complete and how large it is.

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
        """Registers the time the operating system took to accept the written messages, in ns.

        A slow disk first shows up in these times. The next statistics contain the longest one.

        Args:
            duration_ns: The time, in ns.
        """
        self._flush_max_ns = max(self._flush_max_ns, duration_ns)

    def poll(self) -> None:
        """Publishes the statistics of the recording if due, which is once per second."""
        now_ns = self._clock.monotonic_ns()
        if now_ns < self._due_ns:
            return
        # After a long delay, the missed statistics are not published later.
        is_on_time = now_ns - self._due_ns < REPORT_EVERY_NS
        counted_from_ns = self._due_ns if is_on_time else now_ns
        self._due_ns = counted_from_ns + REPORT_EVERY_NS
        self.publish()

    def publish(self) -> None:
        """Publishes the statistics of the recording now, and also writes them to the log.

        The statistics reveal losses, both during the session and to later readers of the log.
        The longest duration of a flush is reset for the next statistics.
        """
        payload = encode(self._make_stats())
        self._flush_max_ns = 0
        self._queue.receive(self._key, payload)
        self._publish(payload)

    def _make_stats(self) -> RecorderStats:
        """Returns the current statistics of the recording, to be shown during the session.

        For each channel, they contain the numbers of expected, received and missing messages,
        and the ranges of the missing ones.
        """
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
        # The size of the statistics is bounded, however many channels there are.
        gaps_per_channel = _ALL_GAPS // len(recording.accounts)
        gap_limit = max(1, min(_MAX_GAPS_REPORTED, gaps_per_channel))
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
