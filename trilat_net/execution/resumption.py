"""Restores the state of an arm in the middle of a log, to execute the rest of the run.

A log has one record per tick, which contains the state of the arm and lists the samples that
arrived from other arms. If records are missing, the ticks of this gap cannot be executed again.
After the gap, execution resumes from a restored state.

Invariant (L3):
    - The state of the arm and its controller can be restored from two consecutive records,
      together with the samples that the arm has received but not used yet.
    - If records are missing, it is unknown which samples arrived in those ticks. A sample that
      was sent, but appears in none of the receiver's records, is assumed to have arrived in
      such a tick.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from ..core import MAX_ARRIVALS, MAX_DELAY_US, CoreChange, LinkSetup, Site
from ..log import SiteLog
from ..net import RESTING_MODES, State
from ..records import NS_PER_S, Arrival, TickRecord

_LOOK_BACK = 100
"""Number of records before a gap that are searched for the newest sample received."""

Change = TypeVar("Change")

ArrivalEntry = Sequence[int]
"""Arrival in the format of a record's `rx`: peer index, tick of the sample, latency in us."""


ReceivedMotion = State | Arrival
"""Sample from a peer: a record in the log, or a newly computed arrival."""


def make_arrival(
    peer: int, tick: int, sample: ReceivedMotion | TickRecord, latency_us: int = 0
) -> Arrival:
    """Returns the message that delivers a sample from another site to a receiver.

    The message contains all values that the sender's control law sends to any receiver. Use
    `select_peer_channels` to select the values for one receiver.

    Args:
        peer: Index of the sender among the sites from which the receiver gets samples.
        tick: Tick in which the sender published the sample.
        sample: Record of that tick, or an earlier arrival of the same sample.
        latency_us: Time from the stamp of the sample to its arrival, in us.
    """
    q = sample.q
    qd = sample.qd
    tau_x = sample.tau_x
    if not isinstance(sample, Arrival) and sample.x:
        # In task space, the sites share the motion of the end effector.
        q = sample.x
        qd = sample.xd
        tau_x = sample.wrench
    return Arrival(
        peer=peer,
        tick=tick,
        q=q,
        qd=qd,
        latency_us=latency_us,
        tau_x=tau_x,
        ch=sample.ch,
    )


def select_peer_channels(
    arrivals: Sequence[Arrival], links: Sequence[LinkSetup]
) -> list[Arrival]:
    """Returns copies of arrived samples that contain only the values for one receiver.

    A control law may send different values to different receivers. The values for other
    receivers are removed.

    Args:
        arrivals: Arrived samples with the values for all receivers.
        links: Links of the receiver, in the order of its peers.
    """
    selected = []
    for arrival in arrivals:
        if not arrival.ch:
            selected.append(arrival)
            continue
        link = links[arrival.peer]
        numbers = link.channel.select_for_peer(arrival.ch, link.index_at_peer)
        selected.append(arrival._replace(ch=numbers))
    return selected


def find_recorded_hand(site_log: SiteLog, site: Site, k: int) -> list[float]:
    """Returns how an operator moved a site's arm in one tick, according to the log.

    The site that is run again may have a different tick rate than in the log, so the newest
    record up to the time of the tick is used.

    Args:
        site_log: Records of the site in the log.
        site: The site that is run again.
        k: Number of the tick of this site.

    Returns:
        The operator's grip, target and velocity, in the order of `HandInForce`. Empty if the
        site had no live operator.
    """
    if not site_log.layout.hand:
        return []
    t_ns = k * NS_PER_S // site.rate_hz
    earlier_records = int(np.searchsorted(site_log.t_ns, t_ns, side="right"))
    if not earlier_records:
        return []
    action: list[float] = site_log.hand[earlier_records - 1].tolist()
    return action


class RecordedInputs(Generic[Change]):
    """All inputs of one site according to a log: received samples and changes to settings.

    With these inputs, the site can be run again.

    Args:
        site_log: Records of the site.
        samples: Records or arrivals of all sites, keyed by site and tick.
        ends: Last tick of each site.
        changes: Changes that took effect at the site, keyed by tick.
        links: Links over which the site receives, in the order of its peers.
        states: Records of the site, possibly decoded only on access. None to use those of
            `site_log`.

    Attributes:
        samples: Samples of each peer, keyed by the tick in which the peer published them.
        ends: Last tick of each peer.
        assumed: For each peer, the ticks of samples that are assumed to have arrived in a gap
            in the log.
        lacking: For each peer, the ticks of samples that arrived, but whose content is missing
            from the log.
    """

    def __init__(
        self,
        site_log: SiteLog,
        samples: Mapping[str, Mapping[int, ReceivedMotion]],
        ends: Mapping[str, int],
        changes: Mapping[int, Sequence[Change]],
        links: Sequence[LinkSetup],
        states: Sequence[State] | None = None,
    ) -> None:
        """Collects what a site received in a recorded run: samples and changes to settings."""
        self._site_log = site_log
        self._states = site_log.states if states is None else states
        self._links = links
        self.samples = [samples[peer] for peer in site_log.peers]
        self.ends = [ends[peer] for peer in site_log.peers]
        self._changes = sorted(changes.items(), reverse=True)
        self.assumed: list[set[int]] = [set() for _ in site_log.peers]
        self.lacking: list[set[int]] = [set() for _ in site_log.peers]

    @property
    def next_change_tick(self) -> int | None:
        """Tick at which the next change to a setting takes effect.

        None if the recorded run has no further changes.
        """
        return self._changes[-1][0] if self._changes else None

    def pop_changes(self, tick: int) -> list[tuple[int, Change]]:
        """Removes and returns the changes to settings that take effect no later than a tick.

        Args:
            tick: Last tick whose changes are returned.

        Returns:
            Pairs of (tick, change), in ascending order of tick. Empty if there are no further
            changes.
        """
        popped: list[tuple[int, Change]] = []
        while self._changes and self._changes[-1][0] <= tick:
            change_tick, changes = self._changes.pop()
            popped += [(change_tick, change) for change in changes]
        return popped

    def find_arrivals(
        self, entries: Sequence[ArrivalEntry]
    ) -> tuple[list[Arrival], list[ArrivalEntry]]:
        """Looks up the content of the samples that arrived in a tick.

        The record of a tick only lists which samples arrived. Their content is in the records
        of the senders.

        Args:
            entries: Arrived samples, in the format of the field `rx` of a record.

        Returns:
            The arrivals with the content of their samples, and the entries whose content is
            missing from the log.
        """
        arrivals: list[Arrival] = []
        unknown_entries: list[ArrivalEntry] = []
        for entry in entries:
            peer, tick, latency_us = entry
            is_known_peer = 0 <= peer < len(self.samples)
            sample = self.samples[peer].get(tick) if is_known_peer else None
            if sample is None:
                unknown_entries.append(entry)
            else:
                arrivals.append(make_arrival(peer, tick, sample, latency_us))
        return select_peer_channels(arrivals, self._links), unknown_entries

    def add_lacking(self, entries: Sequence[ArrivalEntry]) -> None:
        """Stores which samples arrived although their content is missing from the log.

        The content is unknown if the sender's record is missing. A tick that uses such a sample
        cannot be computed with certainty.

        Args:
            entries: The samples: index of the sender, number of the tick in which it sent the
                sample, and latency.
        """
        for peer, tick, _ in entries:
            self.lacking[peer].add(tick)

    def can_resume(self, row: int, *, detached: bool = False) -> bool:
        """Returns True if the log contains enough to restore a site's state before a record.

        There are two conditions:

        - The records of the two preceding ticks must exist. The later one contains the state of
          the arm and of the control law; the earlier one contains a control torque that is part
          of the state of the control loop.
        - The log must contain the samples from other sites that the site used in the last tick,
          because it may use them again. A site that rests at a position of its own ignores
          samples, and is exempt from this condition.

        Args:
            row: Index of the record, among the records of the site.
            detached: True if the site, while at rest, holds a position of its own instead of
                following other sites.
        """
        states = self._states
        if row < 2:
            return False
        tick = states[row].tick
        ticks_before = [states[row - 2].tick, states[row - 1].tick]
        if ticks_before != [tick - 2, tick - 1]:
            return False

        last_record = states[row - 1]
        if detached and last_record.mode in RESTING_MODES:
            return True
        used_ticks = last_record.to_tick_record(self._site_log.peers).used
        for used_tick, samples in zip(used_ticks, self.samples, strict=True):
            has_sample = used_tick >= 0
            if has_sample and used_tick not in samples:
                return False
        return True

    def resume(self, site: Site, row: int, changes: Sequence[CoreChange] = ()) -> None:
        """Restores the state that a site had at a given point in a log, after missing records.

        The state before a tick is restored from the records of the two preceding ticks. Call
        `can_resume` first to check that these records and all other required data exist.

        Args:
            site: The site that is run again; its state is replaced.
            row: Index of the record of the next tick, among the records of the site.
            changes: Changes to settings since the last executed tick of the site.
        """
        states = self._states
        peers = self._site_log.peers
        for change in changes:
            site.apply_change(change, states[row].t_ns)

        # For each link the site stores the sample (state of a peer) that it uses, and newer
        # samples that have arrived, but wait until the delay of the link has passed.
        before_last = states[row - 2].to_tick_record(peers)
        last = states[row - 1].to_tick_record(peers)
        samples_in_use: list[Arrival | None] = []
        waiting_samples: list[Arrival] = []
        for peer, used_tick in enumerate(last.used):
            samples_in_use.append(self._find_in_use(peer, used_tick, len(last.q_des)))
            # A sample that is older than the sample in use is never used again.
            self.lacking[peer] = {tick for tick in self.lacking[peer] if tick >= used_tick}

            rate_hz = site.peer_rate_hz(peer)
            certain, self.assumed[peer] = self._find_waiting(row, peer, used_tick, rate_hz)
            waiting_ticks = sorted(certain | self.assumed[peer])
            # The latency, last in an entry, is only recorded. It does not affect the site.
            entries = [(peer, tick, 0) for tick in waiting_ticks]
            arrivals, missing = self.find_arrivals(entries)
            self.add_lacking(missing)
            waiting_samples += arrivals

        # A site accepts at most `MAX_ARRIVALS` samples at once: keep the last ones.
        site.restore_links(states[row].tick, samples_in_use, waiting_samples[-MAX_ARRIVALS:])
        site.restore_state(before_last, last)

    def _find_in_use(self, peer: int, used_tick: int, coordinates: int) -> Arrival | None:
        """Returns the sample from a peer that the site used in its last tick before a gap.

        If the log does not contain the sample, it is replaced by a sample of zeros and listed
        in `lacking`. This happens only for a site that holds a position of its own and
        therefore does not use the sample, see `can_resume`.

        Args:
            peer: Index of the peer.
            used_tick: Tick in which the peer sent the sample. -1 before the first sample.
            coordinates: Number of coordinates of the sample.

        Returns:
            The sample, or None before the first sample.
        """
        sample = self.samples[peer].get(used_tick)
        if sample is None:
            if used_tick < 0:
                return None
            zeros = (0.0,) * coordinates
            sample = Arrival(peer=peer, tick=used_tick, q=zeros, qd=zeros)
            self.lacking[peer].add(used_tick)
        arrival = make_arrival(peer, used_tick, sample)
        [arrival_for_site] = select_peer_channels([arrival], self._links)
        return arrival_for_site

    def is_uncertain(self, state: State, output: TickRecord) -> bool:
        """Returns True if a deviation from a record may be due to data missing from the log.

        In each tick, a site uses the newest sample from each of its peers. The tick is
        uncertain if the arrival of such a sample was assumed, because no record lists it, or if
        the content of the sample is missing from the log.

        Args:
            state: Record of the tick in the log.
            output: Result of re-executing the tick.
        """
        for peer, peer_name in enumerate(self._site_log.peers):
            # Ticks of the used samples. -1 before the first sample.
            used_in_log = state.used.get(peer_name, -1)
            used_in_execution = output.used[peer]
            assumed_ticks = self.assumed[peer]
            if used_in_log in assumed_ticks or used_in_execution in assumed_ticks:
                return True
            # The execution itself cannot use a sample whose content is missing.
            if used_in_log in self.lacking[peer]:
                return True
        return False

    def _find_waiting(
        self, row: int, peer: int, used_tick: int, rate_hz: int
    ) -> tuple[set[int], set[int]]:
        """Finds received samples that were still delayed by a link at the time of a record.

        A sample waits at the receiver until the delay of the link has passed. If records are
        missing from the log, it is uncertain which samples had arrived.

        Args:
            row: Index of the record, among the records of the receiver.
            peer: Index of the peer.
            used_tick: Tick of the peer's sample that the receiver uses. Older samples are never
                used again.
            rate_hz: Tick rate of the peer, in Hz.

        Returns:
            Ticks of the samples that certainly arrived, because an earlier record lists them,
            and ticks of samples that probably arrived. The latter are in no record, and are
            older than the given record or than the first sample listed in a later record.
        """
        states = self._states
        t_ns = states[row].t_ns
        listing = self._listings[peer]
        position = bisect_left(listing.rows, row)
        next_listed = self.ends[peer] + 1
        if position < len(listing.rows):
            next_listed = listing.first_ticks[position]

        # The last sample before t_ns: the first tick at or after t_ns, less one.
        last_sent = -(-t_ns * rate_hz // NS_PER_S) - 1
        newest_probable = max(last_sent, next_listed - 1)
        newest_listed = self._find_newest_listed(row, peer)

        # A sample does not wait longer than the longest permitted delay.
        oldest_tick = (t_ns - MAX_DELAY_US * 1000) * rate_hz // NS_PER_S
        first_tick = max(used_tick + 1, oldest_tick)
        newest_tick = min(max(newest_probable, newest_listed), self.ends[peer])
        certain_ticks: set[int] = set()
        probable_ticks: set[int] = set()
        for tick in range(first_tick, newest_tick + 1):
            first_row = listing.first_rows.get(tick)
            if first_row is None:
                if tick <= newest_probable:
                    probable_ticks.add(tick)
            elif first_row < row:
                certain_ticks.add(tick)
        return certain_ticks, probable_ticks

    def _find_newest_listed(self, row: int, peer: int) -> int:
        """Returns the tick of the newest sample from a peer in the latest records of a site.

        -1 if these records list no sample from the peer.
        """
        newest = -1
        for state in self._states[max(0, row - _LOOK_BACK) : row]:
            for sender, tick, _ in state.rx:
                if sender == peer:
                    newest = max(newest, tick)
        return newest

    @cached_property
    def _listings(self) -> "list[_PeerListing]":
        """Index of the records that list samples from each peer.

        The record of a tick lists the samples that arrived in this tick. The index makes it
        fast to find the first record that lists a given sample, and the sample listed by the
        next record after a gap.
        """
        listings = [_PeerListing(first_rows={}, rows=[], first_ticks=[]) for _ in self.samples]
        for row, state in enumerate(self._states):
            for peer, sample_tick, _ in state.rx:
                # A damaged record may list any peer.
                is_known_peer = 0 <= peer < len(listings)
                if not is_known_peer:
                    continue
                listing = listings[peer]
                listing.first_rows.setdefault(sample_tick, row)
                is_first_in_record = not listing.rows or listing.rows[-1] != row
                if is_first_in_record:
                    listing.rows.append(row)
                    listing.first_ticks.append(sample_tick)
        return listings


class _PeerListing(NamedTuple):
    """Index of the records of a site that list samples received from one peer.

    Attributes:
        first_rows: Mapping from the tick of each sample to the row of the first record that
            lists it.
        rows: Rows of all records that list a sample from the peer, in ascending order.
        first_ticks: For each of these rows, the tick of the first sample that the record lists.
    """

    first_rows: dict[int, int]
    rows: list[int]
    first_ticks: list[int]
