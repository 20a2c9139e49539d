"""Replies to other programs on behalf of the original sites while a log is played.

When a log is played, the messages of its session are published again, but the sites no longer
exist. This module announces the sites on the network, replies to identity queries and pings,
and resends messages that recorders missed, using the messages stored in `PlayedHistory`. To
other programs, the playback therefore looks like a running session.

Invariant:
    - Recorders, viewers and pings receive everything that they would receive from a running
      session that they join late.
    - Identities are sent for all sites. Other messages of a site are sent only if the log
      contains them.
    - Recorders can request played messages again. If the log is in memory, all messages of the
      present round are available. If the log is read while it is played, the messages of the
      last minute are available, which bounds the memory.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Collection
from functools import partial
from typing import NamedTuple

import numpy as np

from trilat_net.net import topics

from ...log import Ints
from ...net import (
    BACKFILL_BYTES,
    BACKFILL_MESSAGES,
    Bus,
    Clock,
    Event,
    SessionMembers,
    SiteStandIn,
)
from .batch import MessageBatch
from .session_reader import NUMBERS_OF_A_START, PayloadHeader, SessionHeader


class _ChannelMessages(NamedTuple):
    """Replayed messages of one channel (topic) that are stored for recorders.

    Attributes:
        numbers: Numbers of the messages in ascending order, shape (K,).
        indices: Indices of the messages in the batch, shape (K,).
        batch: The batch.
    """

    numbers: Ints
    indices: Ints
    batch: MessageBatch

    def list_from(self, number: int) -> list[tuple[int, int]]:
        """Lists the stored messages starting at a given number, for a reply to a recorder.

        Args:
            number: Smallest message number to include.

        Returns:
            Pairs of the number of a message within its channel and its index in the batch, in
            ascending order. The list has at most one entry more than a reply may contain, which
            lets the caller detect a full reply.
        """
        start = int(np.searchsorted(self.numbers, number))
        selected = slice(start, start + BACKFILL_MESSAGES + 1)
        numbers = self.numbers[selected].tolist()
        indices = self.indices[selected].tolist()
        return list(zip(numbers, indices, strict=True))


class PlayedHistory:
    """Stores played messages, so that recorders that missed some can request them again.

    In a real session, recorders request lost messages in the same way.

    Args:
        kept_ns: How long a message is stored after it is played, in ns of log time. If `None`,
            all messages are stored.

    Attributes:
        next_numbers: For each channel, the number after that of the last played message.
    """

    def __init__(self, kept_ns: int | None = None) -> None:
        self.next_numbers: dict[int, int] = {}
        self._kept_ns = kept_ns
        self._messages: dict[int, deque[_ChannelMessages]] = {}

    def add(self, batch: MessageBatch) -> None:
        """Stores messages before they are played, so that recorders can request them again.

        Removes messages older than `kept_ns`.

        Args:
            batch: The messages, in playback order.
        """
        for channel in np.unique(batch.channels).tolist():
            indices = np.flatnonzero(batch.channels == channel)
            numbers = batch.numbers[indices]
            stored_batches = self._messages.setdefault(channel, deque())
            stored_batches.append(_ChannelMessages(numbers, indices, batch))

            if self._kept_ns is not None:
                oldest_ns = batch.end_ns - self._kept_ns
                while stored_batches[0].batch.end_ns < oldest_ns:
                    stored_batches.popleft()

    def clear(self) -> None:
        """Removes all stored messages, before a log is played again from its beginning.

        The next number of each channel (`next_numbers`) is kept, so that message numbers
        continue.
        """
        self._messages.clear()

    def find_messages(self, channel: int, first: int, last: int) -> tuple[int, list[bytes]]:
        """Finds consecutive played messages for one reply to a recorder that missed them.

        A reply has no gaps. It contains at most `BACKFILL_MESSAGES` messages and, unless a
        single message is larger, at most `BACKFILL_BYTES` bytes.

        Args:
            channel: Channel index.
            first: Number of the first requested message. If it is no longer stored, the reply
                begins with the next message that is.
            last: Number of the last requested message.

        Returns:
            The number of the first message in the reply, and the payloads.
        """
        next_to_play = self.next_numbers.get(channel, 0)
        last_available = min(last, next_to_play - 1)
        payloads: list[bytes] = []
        size = 0
        reply_first = first
        next_number = first
        for stored_batch in self._list_parts(channel, first):
            for number, index in stored_batch.list_from(next_number):
                # The reply begins with the first message that is stored.
                if not payloads:
                    reply_first = max(first, min(number, next_to_play))
                    next_number = reply_first
                if number < next_number:
                    continue  # a repeated number

                payload = stored_batch.batch.payload(index)
                size += len(payload)
                is_beyond = number > last_available
                has_gap = number > next_number
                is_full = len(payloads) == BACKFILL_MESSAGES
                is_large = bool(payloads) and size > BACKFILL_BYTES
                if is_beyond or has_gap or is_full or is_large:
                    return reply_first, payloads
                payloads.append(payload)
                next_number = number + 1

        if not payloads and first < next_to_play:
            # No requested message is kept. The empty reply states that they are not available.
            reply_first = next_to_play
        return reply_first, payloads

    def _list_parts(self, channel: int, first: int) -> list[_ChannelMessages]:
        """Returns the kept messages of a channel, without the parts that end before `first`."""
        parts = list(self._messages.get(channel, ()))
        index = bisect_left(parts, first, key=lambda part: int(part.numbers[-1]))
        return parts[index:]


_MAX_RECORDER_EVENTS = 256
"""Largest number of waiting events of recorders."""


class SiteStandIns:
    """Replies on behalf of the sites of a recorded session while its log is played.

    This makes the playback look like a running session, whose sites announce themselves, reply
    to queries, and resend messages that a recorder missed.

    Args:
        bus: Network connection of the player.
        clock: Clock of the player.
        session: Name of the session in which the log is played.
        header: Description of the recorded session.
        history: The messages that were played.

    Attributes:
        recorders: Identifiers of the recorders that are present, as strings. A recorder gets a
            new random identifier at each start.
        refilled: Number of messages that were sent again to recorders.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        header: SessionHeader,
        history: PlayedHistory,
    ) -> None:
        self.recorders: set[str] = set()
        self.refilled = 0
        self._clock = clock
        self._header = header
        self._history = history
        self._presence = bus.presence(topics.presence_key(session, topics.RECORDER))
        self._recorder_members = SessionMembers(bus, clock, session, topics.RECORDER)
        self._read_recorder_events = self._recorder_members.subscribe(
            Event, capacity=_MAX_RECORDER_EVENTS
        )
        # Sites whose messages are stored completely, by the boot of the recorder.
        self._stored: dict[str, set[str]] = {}
        # Boots of the recorders that have sent their identity.
        self._listening: set[str] = set()
        # Index and boot of the start of each site that is played, see `_find_start`.
        self._boots: dict[str, tuple[int, int]] = {}

        self._sites: dict[str, SiteStandIn] = {}
        for site, boot in header.boots.items():
            self._sites[site] = SiteStandIn(
                bus=bus,
                clock=clock,
                session=session,
                site=site,
                boot=boot,
                fingerprint=header.fingerprint,
                scenario_text=header.scenario_text,
            )

    def start_session(self, epoch_mono_ns: int) -> None:
        """Announces the session as running, so that recorders and viewers join it.

        In the announced identities of the sites, the start time is that of the playback.

        Args:
            epoch_mono_ns: Start time of the session (tick 0) on the monotonic clock, in ns.
        """
        unix_ns = self._clock.unix_ns()
        epoch_unix_ns = unix_ns + epoch_mono_ns - self._clock.monotonic_ns()
        for stand_in in self._sites.values():
            stand_in.start_session(epoch_mono_ns, epoch_unix_ns, self._header.boots)

    def serve_queries(self) -> bool:
        """Replies to pending requests of other programs on behalf of the original sites.

        To keep the call short, at most one request for missing messages is answered, but all
        identity queries are. The method also updates which recorders are present, and which
        messages they have stored.

        Returns:
            True if a recorder's request was processed, in which case more may be pending.
        """
        for site, stand_in in self._sites.items():
            stand_in.answer_identity_queries(partial(self._count_ticks, site))
        self._receive_recorders()
        for site, stand_in in self._sites.items():
            find_messages = partial(self._find_messages, site)
            sent = stand_in.answer_backfill_query(partial(self._find_boot, site), find_messages)
            if sent is not None:
                self.refilled += sent
                return True
        return False

    def _receive_recorders(self) -> None:
        """Updates which recorders are present, and which sites they have stored completely."""
        for token, is_alive in topics.read_presence(self._presence):
            if is_alive:
                self.recorders.add(token.boot)
            else:
                self.recorders.discard(token.boot)
        for event in self._read_recorder_events():
            if event.kind == "stored":
                stored_sites = self._stored.setdefault(str(event.boot), set())
                stored_sites.add(event.about)

    def _count_ticks(self, site: str) -> int:
        """Returns the number of the newest played record of a site plus 1."""
        channel = self._find_channel(site, topics.STATE)
        return self._history.next_numbers.get(channel, 0)

    def are_recorders_listening(self) -> bool:
        """Returns True if all recorders on the network are ready to receive played messages.

        A recorder is ready once it has replied.
        """
        self._listening |= {str(info.boot) for info in self._recorder_members.poll()}
        return not self.recorders - self._listening

    def have_stored(self, recorders: Collection[str]) -> bool:
        """Returns True if the recorders have reported that they stored every site's messages.

        The player may then end, because no recorder will request a message again.

        Args:
            recorders: Identifiers of the recorders, in the form of the attribute `recorders`.
        """
        all_sites = self._sites.keys()
        for recorder in recorders:
            stored_sites = self._stored.get(recorder, set())
            if not stored_sites >= all_sites:
                return False
        return True

    def _find_channel(self, site: str, channel: str) -> int:
        """Returns the number of an arm's channel (topic), such as its records, in the replay.

        It is -1 if the log has no such channel.
        """
        topic = "/" + topics.key(self._header.session, site, channel)
        played_topics = self._header.topics
        return played_topics.index(topic) if topic in played_topics else -1

    def _find_start(self, site: str) -> tuple[int, int]:
        """Finds out which start of a site is being played at present.

        A site may have been started several times while the session was recorded. Each start
        numbers its events from 0, and states in them its boot, the random number that
        identifies the start. The history of the played messages adds `NUMBERS_OF_A_START` to
        the number of an event for each earlier start. Hence the number of the newest played
        event, divided by `NUMBERS_OF_A_START` and rounded down, is the index of its start.

        The boot of the first start is known in advance. The boot of a later start is read from
        the newest event when it is first needed, and is then stored in `_boots`.

        Args:
            site: Name of the site.

        Returns:
            The index of the start, which is 0 for the first one, and its boot. If the newest
            event is no longer stored or cannot be decoded, the values that were found before
            are returned.
        """
        channel = self._find_channel(site, topics.EVENT)
        # It is -1 if no event of the site was played yet.
        newest_event = self._history.next_numbers.get(channel, 0) - 1
        start_index = max(newest_event, 0) // NUMBERS_OF_A_START
        first_start = (0, self._sites[site].boot)
        if start_index == 0:
            return first_start

        stored_index, _ = self._boots.get(site, first_start)
        is_boot_known = stored_index == start_index
        if not is_boot_known:
            # At most one event is requested, so that the list has at most one entry.
            _, payloads = self._history.find_messages(channel, newest_event, newest_event)
            for payload in payloads:
                header = PayloadHeader.decode(payload)
                if header.boot >= 0:  # an event of a damaged log may be unreadable
                    self._boots[site] = (start_index, header.boot)
        return self._boots.get(site, first_start)

    def _find_boot(self, site: str) -> int:
        """Returns the boot of the start that is being played: the random number of this start.

        Recorders accept only replies of that start.
        """
        _, boot = self._find_start(site)
        return boot

    def _find_messages(
        self, site: str, channel_name: str, first: int, last: int
    ) -> tuple[int, list[bytes], int]:
        """Finds the replayed messages that a recorder requests again after missing them.

        The history and the recorder number events differently. A site numbers its events from 0
        after each start, and so does the recorder. In the history, the numbers increase over
        all starts: `NUMBERS_OF_A_START` is added for each earlier start.

        Args:
            site: Name of the site.
            channel_name: Name of the site's channel.
            first: Number of the first requested message.
            last: Number of the last requested message.

        Returns:
            The number of the first message in the reply, the encoded messages, and the number
            of messages that the site has published on this channel so far. The numbers are
            those of the recorder.
        """
        channel = self._find_channel(site, channel_name)
        # Number in the history minus number of the recorder.
        offset = 0
        if channel_name == topics.EVENT:
            start_index, _ = self._find_start(site)
            offset = start_index * NUMBERS_OF_A_START
        published = self._history.next_numbers.get(channel, 0) - offset
        first_in_history, payloads = self._history.find_messages(
            channel, first + offset, last + offset
        )
        # Messages of earlier starts would have negative numbers.
        return max(first_in_history - offset, 0), payloads, max(published, 0)
