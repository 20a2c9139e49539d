"""Creates the arrays that hold the state of a running arm, and enlarges them during a run.

The arrays contain the state of an arm and its control law (`SiteRow`), and of each network link
over which the arm receives samples (`LinkRow`). Each link has a ring buffer (calendar) that
holds samples until their simulated delay has passed. The buffer is enlarged when the delay
grows during a run.

Structured arrays are cheap to pass to compiled code, and their fields can be named after the
symbols in the equations.

Invariant:
    - The compiled code of a control period reads and writes nothing but these arrays and
      `TickBuffers`.
    - Two arms with equal setups have equal arrays.
    - The links of an arm use at most `MAX_LINKS_BYTES` of memory, unless the delays in the
      setup require more.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arms.chain import build_chain
from ..arms.exogenous import TorqueSourceRows, TorqueTable, torque_source_rows
from ..links.channel import LOST
from ..links.delay import LINK_MODEL_DTYPE, MAX_DELAY_US, LinkModel, max_delay_us
from ..links.dominance import RAMP_COLUMNS, fold_ramps
from ..links.link import (
    AHEAD_LIMIT_NS,
    ChannelArrays,
    calendar_pages,
    link_dtype,
    sample_dtype,
    span_ticks,
)
from .row_fields import FIELDS, field_shape, row_dtype
from .site_setup import Gains, Layout, LinkSetup, SiteSetup
from .ticks import MAX_ARRIVALS, NS_PER_S, CoreChange, DominanceRamp, LifeOrder, Mode
from .vectors import Array, IntArray, Points, Row, RowArray

_OTHER_GAINS = ("law", "theta_hat0", "absolute")
_GAINS = tuple(name for name in Gains._fields if name not in _OTHER_GAINS)
"""Constant gains, named like the fields of the site. theta_hat0 is stored as `theta_hat`."""


@cache
def site_dtype(layout: Layout) -> np.dtype[np.void]:
    """Returns the NumPy structured data type that holds the complete state of a site.

    `SiteRow` lists its fields, which are the settings, gains, motion and results. One array
    element holds everything that the compiled control loop reads and writes about the arm.

    Args:
        layout: Lengths of the site's vectors.
    """
    return row_dtype("site", layout.axes(), chain=layout.chain)


@cache
def arrival_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the NumPy structured data type of a message that has just arrived.

    `ArrivalRow` lists its fields: the sending arm, the control period, and the motion.

    Args:
        shared: Number of coordinates that sites share, which is the length of the sample's
            vectors.
    """
    return row_dtype("arrival", {"shared": shared})


class SiteArrays(NamedTuple):
    """All arrays that the compiled control loop of a site reads and writes.

    For a simulation of several arms, the arrays of all sites are stacked along an additional
    leading axis.

    Attributes:
        site: State and constants, shape (1,), see `site_dtype`.
        links: One row per peer, shape (P,), see `link_dtype`.
        models: Delay and loss models of the links, shape (P, M), LINK_MODEL_DTYPE.
        dues: Due times of the newest samples on the links, shape (P, D), ns; see `LinkArrays`.
        calendars: Calendars of the links, shape (P, pages), see `sample_dtype`.
        points: Traces and outages, shape (n, 2); stacked sites share one table.
        ramps: Changes of the dominance factors, shape (R, RAMP_COLUMNS + P).
        actors: Operators and environments, shape (A,), see `torque_source_dtype`.
        table: Recorded torques of the operators and environments, shape (rows, 1 + n); stacked
            sites share one table.
        chain: The joints of a chain, shape (n,), see `chain_dtype`. None for the planar
            two-link arm.
        channel: Values that the peers' laws send to a user's law, one row per peer. None if the
            kernel computes the law.
    """

    site: RowArray
    links: RowArray
    models: RowArray
    dues: IntArray
    calendars: RowArray
    points: Points
    ramps: Array
    actors: TorqueSourceRows
    table: TorqueTable
    chain: RowArray | None
    channel: ChannelArrays | None

    @classmethod
    def build(
        cls,
        setup: SiteSetup,
        spare: tuple[int, int] = (0, 0),
        pages: int = 0,
        layout: Layout | None = None,
        *,
        plugged: bool = False,
    ) -> "SiteArrays":
        """Creates all arrays of a site, in their state before the first control period.

        Args:
            setup: Setup of the site.
            spare: Numbers of free rows for changes during the run: in each link's table of
                models, and in the table of dominance ramps.
            pages: Number of samples that can wait on each link, which is also the number of
                delivery times stored per link. 0 to derive both from the setup.
            layout: Lengths of the vectors in the arrays, if they must be larger than this site
                needs.
            plugged: True to include the arrays for a user's control law, even if this site has
                none.
        """
        links = setup.links
        layout = layout or setup.layout
        peers = len(links)
        spare_models, spare_ramps = spare
        kept_dues = pages or _count_kept_dues(setup)
        pages = pages or cls.count_pages(setup)
        calendars = np.zeros((peers, pages), sample_dtype(layout.shared))
        calendars["tick"] = -1  # no sample waits
        rows, models, points = _build_links(links, spare_models, layout.shared)
        # A planar arm moves in two dimensions.
        axes = 3 if layout.chain else 2
        actors, table = torque_source_rows(setup.actors, layout.joints, axes)
        ramp_count = 1 + len(setup.ramps) + spare_ramps
        ramps = np.zeros((ramp_count, RAMP_COLUMNS + peers))
        ramps[0, RAMP_COLUMNS:] = [link.alpha for link in links]
        chain = None
        if setup.chain is not None:
            chain = build_chain(setup.chain.joints, layout.joints)
        has_channel = plugged or setup.law_factory is not None
        arrays = SiteArrays(
            site=_build_site(setup, layout),
            links=rows,
            models=models,
            dues=np.full((peers, kept_dues), LOST, dtype=np.int64),
            calendars=calendars,
            points=points,
            ramps=ramps,
            actors=actors,
            table=table,
            chain=chain,
            channel=_build_channel(setup, pages) if has_channel else None,
        )
        for ramp in setup.ramps:
            _add_ramp(arrays, ramp)
        return arrays

    @classmethod
    def stack(
        cls,
        setups: Sequence[SiteSetup],
        changes: Sequence[CoreChange] = (),
        late_ns: int = 0,
    ) -> "SiteArrays":
        """Creates the arrays for a simulation of several sites, stacked along a leading axis.

        Arrays that are shorter than those of another site are padded with rows that are never
        read. The ring buffers for delayed samples are large enough for all delays.

        Args:
            setups: Setups of the sites.
            changes: Changes during the run. The tables of link models and dominance factors get
                enough free rows for all of them.
            late_ns: Longest time by which a sample may arrive after its delivery time, ns.
        """
        longest_us = 0
        for setup in setups:
            for link in setup.links:
                longest_us = max(longest_us, max_delay_us(link.models, link.traces))
        for change in changes:
            if change.model is not None:
                # A change cannot set a recorded delay trace.
                longest_us = max(longest_us, max_delay_us([change.model], [None]))
        spare = len(changes)
        fastest_hz = max(setup.rate_hz for setup in setups)
        margin_ns = late_ns + _SLACK * NS_PER_S // fastest_hz
        pages = calendar_pages(fastest_hz, longest_us, margin_ns)
        layouts = [setup.layout for setup in setups]
        lengths_by_field = zip(*layouts, strict=True)
        largest = Layout(*map(max, lengths_by_field))
        plugged = any(setup.law_factory is not None for setup in setups)
        sites = [
            SiteArrays.build(setup, (spare, spare), pages, largest, plugged=plugged)
            for setup in setups
        ]
        _share_tables(sites)
        actors = _stack_padded([site.actors for site in sites])
        for row, site in zip(actors, sites, strict=True):
            row["sampled"][len(site.actors) :] = _NEVER_SAMPLED
        chains = [site.chain for site in sites if site.chain is not None]
        channels = [site.channel for site in sites if site.channel is not None]
        return SiteArrays(
            site=_stack_padded([site.site for site in sites]),
            links=_stack_padded([site.links for site in sites]),
            models=_stack_padded([site.models for site in sites]),
            dues=_stack_padded([site.dues for site in sites]),
            calendars=_stack_padded([site.calendars for site in sites]),
            points=np.concatenate([site.points for site in sites]),
            ramps=_stack_padded([site.ramps for site in sites]),
            actors=actors,
            table=np.concatenate([site.table for site in sites]),
            chain=_stack_padded(chains) if largest.chain else None,
            channel=_stack_channels(setups, channels) if channels else None,
        )

    def select(self, i: int, layout: Layout) -> "SiteArrays":
        """Returns the arrays of one arm in a simulation of several arms, without copying.

        Vectors may be longer than this arm needs, because they have the same length for all
        arms.

        Args:
            i: Index of the site.
            layout: Lengths of the vectors of the site.
        """
        channel = self.channel
        if channel is not None:
            waiting = channel.waiting[i]
            received = channel.received[i]
            columns = channel.columns[i]
            channel = ChannelArrays(waiting, received, columns)
        chain = self.chain
        if chain is not None:
            chain = chain[i, : layout.joints]
        return self._replace(
            site=self.site[i],
            links=self.links[i],
            models=self.models[i],
            dues=self.dues[i],
            calendars=self.calendars[i],
            ramps=self.ramps[i],
            actors=self.actors[i],
            chain=chain,
            channel=channel,
        )

    def widen_calendars(self, k: int, pages: int) -> "SiteArrays":
        """Enlarges the calendars, the ring buffers that hold delayed messages.

        All waiting messages are kept.

        Args:
            k: Next tick of the site.
            pages: New number of entries per buffer, a power of two.

        Returns:
            New arrays with the larger buffers.
        """
        old_count = self.calendars.shape[1]
        ticks = np.arange(k, k + old_count)
        # A tick's page is its lowest bits, as the number of pages is a power of two.
        old_pages = ticks & (old_count - 1)
        new_pages = ticks & (pages - 1)
        calendars = np.zeros((len(self.links), pages), self.calendars.dtype)
        calendars["tick"] = -1
        calendars[:, new_pages] = self.calendars[:, old_pages]
        channel = self.channel
        if channel is not None:
            waiting = np.zeros((*calendars.shape, channel.waiting.shape[2]))
            waiting[:, new_pages] = channel.waiting[:, old_pages]
            channel = channel._replace(waiting=waiting)
        return self._replace(calendars=calendars, channel=channel)

    def apply_change(self, change: CoreChange, t_ns: int) -> None:
        """Applies an external change to a running site.

        There are four kinds of change:

        - A notification that the site missed ticks. The number of missed ticks is stored until
          the next tick.
        - An order, for example to stop the arm. It is carried out at the next tick. If several
          orders arrive before then, the one with the highest number takes precedence; see
          `LifeOrder`.
        - A new delay and loss model for a link. It is added to the link's table of models, and
          applies from its start time.
        - A ramp of the dominance factors. It is added to the table of ramps, after old ramps
          have been removed.

        Args:
            change: The change.
            t_ns: Current time in ns since the start of the session. The site will not compute
                any further control period that starts before this time.

        Raises:
            ValueError: A table has no free row for the change.
        """
        s: Row = self.site[0]
        if change.order is LifeOrder.OVERRUN:
            s.skipped = change.skipped
        elif change.order is not None:
            s.order = max(s.order, change.order)
        if change.model is not None:
            link: Row = self.links[change.peer]
            largest_count = self.models.shape[1]
            if link.models >= largest_count:
                raise ValueError(f"a run can have at most {MAX_CHANGES} changes to a link")
            _add_model(self, change.peer, change.model)
        if change.ramp is not None:
            # Remove the ramps that are over, to make room for the new ramp.
            s.ramps = fold_ramps(t_ns, int(s.ramps), self.ramps)
            if s.ramps >= len(self.ramps):
                raise ValueError(
                    f"at most {MAX_RAMPS} changes to the shares of a site can be pending "
                    "at once"
                )
            _add_ramp(self, change.ramp)

    @staticmethod
    def count_pages(setup: SiteSetup) -> int:
        """Computes how many messages must be able to wait on each network link of an arm.

        A message waits until its simulated delay has passed. The number depends on the longest
        delay, and on how far the sender's clock may be ahead (`_NEAR_NS`).

        Args:
            setup: Setup of the site.

        Returns:
            The number of entries in the ring buffer of each link, a power of two.
        """
        delays_us = [max_delay_us(link.models, link.traces) for link in setup.links]
        longest_us = max(delays_us)
        return calendar_pages(setup.rate_hz, longest_us, _NEAR_NS)

    @staticmethod
    def count_link_bytes(setup: SiteSetup, pages: int | None = None) -> int:
        """Returns the memory used by the network links of an arm, in bytes.

        Most of it is used by the ring buffers in which delayed messages wait. `CalendarSizer`
        uses the result to limit their length.

        Args:
            setup: Setup of the arm.
            pages: Number of samples that can wait in the ring buffer of each link. Defaults to
                the number required by the delays.
        """
        if pages is None:
            pages = SiteArrays.count_pages(setup)
        number_bytes = 8
        law_numbers = 0  # count of values that a user's law receives with each sample
        if setup.law_factory is not None:
            law_numbers = sum(vector.length for vector in setup.received_vectors)
        page_bytes = sample_dtype(setup.layout.shared).itemsize + number_bytes * law_numbers
        dues_bytes = number_bytes * _count_kept_dues(setup)
        link_bytes = pages * page_bytes + dues_bytes
        return len(setup.links) * link_bytes


class TickBuffers(NamedTuple):
    """Input and output arrays for one control period: received messages and results.

    They are created once and reused in every period, because allocation takes time. A sample
    contains m coordinates.

    Attributes:
        arrivals: Samples that arrived since the previous period, shape (MAX_ARRIVALS,), see
            `arrival_dtype`.
        forces: External torques or forces on the senders' arms, N m or N, shape (MAX_ARRIVALS,
            m).
        sent: Further values sent by the senders' control laws, shape (MAX_ARRIVALS, C) for at
            most C values per sample.
        record: Output array for the floating-point values of the record, see `Layout.columns`.
    """

    arrivals: RowArray
    forces: Array
    sent: Array
    record: Array

    @classmethod
    def build(cls, setup: SiteSetup) -> "TickBuffers":
        """Creates the arrays for the received messages and the results of a control period.

        A site creates them once and reuses them in every period.

        Args:
            setup: Setup of the site, which determines the vector lengths.
        """
        layout = setup.layout
        largest_received = 0
        if setup.law_factory is not None:
            largest_received = max(link.channel.received_size for link in setup.links)
        return cls(
            arrivals=np.zeros(MAX_ARRIVALS, arrival_dtype(layout.shared)),
            forces=np.zeros((MAX_ARRIVALS, layout.shared)),
            sent=np.zeros((MAX_ARRIVALS, largest_received)),
            record=np.zeros(layout.floats),
        )


def _count_kept_dues(setup: SiteSetup) -> int:
    """Returns the number of messages whose delivery times a link stores.

    A delivery time (due time) is stored for as long as its message may still arrive, late or as
    a duplicate. This time is bounded by the longest possible delay and by how far the sender's
    clock may be ahead of the receiver's.

    Args:
        setup: Setup of the site. The number depends on the fastest loop at either end.
    """
    peer_rates_hz = [link.rate_hz for link in setup.links]
    fastest_hz = max(setup.rate_hz, *peer_rates_hz)
    span_ns = MAX_DELAY_US * 1000 + AHEAD_LIMIT_NS
    return span_ticks(span_ns, fastest_hz) + _SLACK


class CalendarSizer:
    """Enlarges the ring buffers of delayed samples when a sample arrives that does not fit.

    Samples wait in a buffer until their simulated delay has passed. A buffer is too short if
    delays have increased, or if the peer's clock is far ahead. The links never use more memory
    than `MAX_LINKS_BYTES`, unless the delays in the setup require more. A sample that still
    does not fit is rejected later.

    Attributes:
        newest: For each peer, the number of the newest sample that is known to fit. All older
            samples of the peer fit too.
        most_pages: Largest number of entries per buffer.
    """

    def __init__(self, setup: SiteSetup) -> None:
        self._rate_hz = setup.rate_hz
        self._peer_hz = [link.rate_hz for link in setup.links]
        self._delay_us = [max_delay_us(link.models, link.traces) for link in setup.links]
        self.newest = [-1] * len(setup.links)
        self.most_pages = SiteArrays.count_pages(setup)
        limit = calendar_pages(setup.rate_hz)
        while self.most_pages < limit:
            if SiteArrays.count_link_bytes(setup, 2 * self.most_pages) > MAX_LINKS_BYTES:
                break
            self.most_pages *= 2

    def clear(self) -> None:
        """Discards the information on which messages fit into the ring buffers of the links.

        The next message from each sender will be checked again.
        """
        self.newest = [-1] * len(self.newest)

    def add_model(self, peer: int, model: LinkModel) -> None:
        """Takes a new delay model of a link into account, to reserve space for longer delays.

        Args:
            peer: Index of the sender at the other end of the link.
            model: New delay model of the link.
        """
        longest_us = max_delay_us([model], [None])
        self._delay_us[peer] = max(self._delay_us[peer], longest_us)
        self.newest[peer] = -1

    def list_rooms(self) -> list[tuple[int, int]]:
        """Returns how long received samples may wait in their ring buffers, for each sender.

        The compiled loop of `recorded_ticks` uses the result to check whether a sample fits
        into its buffer.

        Returns:
            For each sender, its entry in `newest`, and the largest number of ticks for which a
            sample waits.
        """
        longest_waits = []
        for delay_us in self._delay_us:
            delay_ticks = span_ticks(delay_us * 1000, self._rate_hz)
            longest_waits.append(delay_ticks + _SLACK)
        return list(zip(self.newest, longest_waits, strict=True))

    def make_room(self, arrays: SiteArrays, k: int, peer: int, tick: int) -> SiteArrays:
        """Ensures that a sample fits into the ring buffer of its link.

        The sample waits in the buffer until its simulated delay has passed. The buffer has one
        entry (page) for the current tick and one for each later tick of the receiver. The
        sample fits if there is a page for the latest tick in which it may come into use. This
        tick is at most `ahead` + `longest_wait` ticks away: the sample was sent `ahead` ticks
        after the current tick (negative for an earlier sample), and then waits for at most
        `longest_wait` ticks.

        If the peer's clock is too far ahead, the buffer is not enlarged, and the sample is
        rejected later. Otherwise, `newest` is set to the newest sample of the peer that fits
        into the buffer at its current size. The method need not be called for samples up to
        `newest`.

        Args:
            arrays: Arrays of the receiving site.
            k: Current tick of the site.
            peer: Index of the peer.
            tick: Tick in which the peer sent the sample.

        Returns:
            The same arrays if the sample fits, if it will be rejected, or if the buffers have
            already reached their largest size. Otherwise, arrays with larger buffers.
        """
        rate_hz = self._rate_hz
        peer_hz = self._peer_hz[peer]
        longest_wait = span_ticks(self._delay_us[peer] * 1000, rate_hz) + _SLACK
        sent_at_tick = tick * rate_hz // peer_hz  # in ticks of this site
        ahead = sent_at_tick - k
        if ahead > span_ticks(AHEAD_LIMIT_NS, rate_hz):
            return arrays  # the sample will be rejected

        needed = ahead + longest_wait
        pages = arrays.calendars.shape[1]
        if needed > pages and pages < self.most_pages:
            # The number of pages is a power of two, so that a modulo is a bit mask.
            next_power_of_two = 1 << needed.bit_length()
            pages = min(next_power_of_two, self.most_pages)
            # Samples of missed ticks still wait in the pages of those ticks.
            first_waiting_tick = k - int(arrays.site["skipped"][0])
            arrays = arrays.widen_calendars(first_waiting_tick, pages)
        newest_fitting_tick = k + pages - longest_wait
        self.newest[peer] = newest_fitting_tick * peer_hz // rate_hz
        return arrays


def _add_ramp(arrays: SiteArrays, ramp: DominanceRamp) -> None:
    """Adds a planned change of the dominance factors of an arm.

    The changes are stored in a table sorted by start time.

    Args:
        arrays: Arrays of the site, whose table must have a free row.
        ramp: The change, a ramp in time.
    """
    site: Row = arrays.site[0]
    count = int(site.ramps)
    ramps = arrays.ramps
    # Row 0 holds the factors before the first change, and stays first.
    starts_ns = ramps[1:count, 0]
    index = 1 + int(np.searchsorted(starts_ns, ramp.start_ns, side="right"))
    later_ramps = ramps[index:count].copy()
    ramps[index + 1 : count + 1] = later_ramps
    ramps[index] = (ramp.start_ns, ramp.end_ns, *ramp.alpha)
    site.ramps = count + 1


def _add_model(arrays: SiteArrays, peer: int, model: LinkModel) -> None:
    """Adds a planned change of a network link's delay and loss.

    The changes are stored in a table sorted by start time.

    Args:
        arrays: Arrays of the site, whose table must have a free row.
        peer: Index of the site at the other end of the link.
        model: Delay and loss model, including its start time.
    """
    link: Row = arrays.links[peer]
    models = arrays.models[peer]
    count = int(link.models)
    # Row 0 is the model before the first change, and stays first.
    starts_ns = models["from_ns"][1:count]
    index = 1 + int(np.searchsorted(starts_ns, model.from_ns, side="right"))
    later_models = models[index:count].copy()
    models[index + 1 : count + 1] = later_models
    models[index] = model
    link.models = count + 1
    # The model in force moves down one row. Samples already scheduled keep their times.
    if link.model >= index:
        link.model += 1


MAX_CHANGES = 4096
"""Largest number of changes of one link in addition to those in the scenario."""
MAX_RAMPS = 256
"""Largest number of pending changes of the dominance factors that are not in the scenario.

A run may have any number of changes in total, because changes that have started are removed,
see `fold_ramps`.
"""


_NEAR_NS = NS_PER_S // 4
"""How far senders may be ahead of a slightly late receiver without a larger buffer, ns."""
MAX_LINKS_BYTES = 64 << 20
"""Largest memory of a site's links, unless their delays require more, bytes."""
_SLACK = 4
"""Reserve in ticks, because a sample is scheduled up to two ticks before it is stored."""
_NEVER_SAMPLED = 2
"""Marks an actor that only pads a stack, and is evaluated neither per stage nor per tick."""


def _share_tables(sites: Sequence[SiteArrays]) -> None:
    """Shifts table row indices to prepare for joining the tables of all sites into one.

    Each site has a table with the points of delay traces and outages, and one with the recorded
    torques of operators. `SiteArrays.stack` joins them for a simulation of all sites, placing
    the rows of the second site after those of the first.

    Args:
        sites: Arrays of the sites, in the order of the joined tables. Their indices are
            changed.
    """
    first_point = 0
    first_torque = 0
    for site in sites:
        site.models["trace_first"] += first_point
        site.links["outage_first"] += first_point
        site.actors["table_first"] += first_torque
        first_point += len(site.points)
        first_torque += len(site.table)


def _stack_channels(
    setups: Sequence[SiteSetup], channels: Sequence[ChannelArrays]
) -> ChannelArrays:
    """Stacks the arrays for the values that control laws send, for several sites.

    The law of a peer sends A values to all sites, and E values to each of them individually. A
    single site receives only the A + E values intended for it. In a simulation of all sites, it
    reads the record of the peer, which contains the values for all of its receivers:

        a single site:  A to all | E to this site
        record:         A to all | E to receiver 0 | E to receiver 1 | ...

    The column of a value sent to each site individually therefore increases by E for each
    receiver that precedes this site.

    Args:
        setups: Setups of the sites.
        channels: Arrays of each site. For each peer, `columns` contains the index of each value
            that the law of the site reads, or -1. It is changed in place.

    Returns:
        The arrays with a leading axis for the site, padded to equal length.
    """
    for setup, channel in zip(setups, channels, strict=True):
        for link, columns in zip(setup.links, channel.columns, strict=True):
            to_all = link.channel.count_numbers(per_peer=False)
            to_each = link.channel.count_numbers(per_peer=True)
            are_to_this_site = columns >= to_all
            columns[are_to_this_site] += link.index_at_peer * to_each

    waiting = _stack_padded([channel.waiting for channel in channels])
    received = _stack_padded([channel.received for channel in channels])
    columns = _stack_padded([channel.columns for channel in channels])
    for channel, padded in zip(channels, columns, strict=True):
        # Zeros would mean column 0, so pad with -1, which stands for a value that is not sent.
        count = channel.columns.shape[1]
        padded[:, count:] = -1
    return ChannelArrays(waiting, received, columns)


def _stack_padded(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Stacks arrays of different lengths along a new leading axis, padded with zeros.

    Example: arrays of shapes (3,) and (5,) become one array of shape (2, 5).
    """
    shapes = [array.shape for array in arrays]
    largest_shape = [max(lengths) for lengths in zip(*shapes, strict=True)]
    dtype = arrays[0].dtype
    if any(array.dtype is not dtype for array in arrays):
        dtype = np.result_type(*arrays)  # slow for structured arrays
    stacked = np.zeros((len(arrays), *largest_shape), dtype)
    for padded, array in zip(stacked, arrays, strict=True):
        corner = tuple(slice(length) for length in array.shape)
        padded[corner] = array
    return stacked


def _build_site(setup: SiteSetup, layout: Layout) -> RowArray:
    """Creates the state of a site before its first control period.

    Args:
        setup: Setup of the site.
        layout: Lengths of the vectors in the result. They may be longer than the site needs, in
            which case the extra entries stay zero.
    """
    site = np.zeros(1, site_dtype(layout))
    s: Row = site[0]
    gains = setup.gains
    rule = setup.on_stale
    site_layout = setup.layout
    s.rate_hz = setup.rate_hz
    s.digital = setup.digital
    s.law = gains.law
    s.mode = Mode.RUN
    s.joints = site_layout.joints
    s.shared = site_layout.shared
    s.parameters = site_layout.parameters
    s.task = site_layout.task
    s.sent = site_layout.sent
    s.external = int(setup.external)
    s.ramps = 1
    s.theta_known = setup.theta_known
    s.on_stale = rule.action
    s.stale_ns = rule.age_ns
    s.return_ns = rule.return_ns
    s.align_speed = rule.align_speed
    s.align_limit = rule.align_limit
    s.degrades = rule.degrades
    s.bit = setup.bit
    if setup.chain is None:
        s.g = setup.g_m_s2
        s.lengths = setup.lengths_m
    else:
        s.gravity = setup.chain.gravity_m_s2
        s.tip = setup.chain.tip_m
        s.tip_back = np.transpose(setup.chain.tip_rotation)
    if setup.chain is not None and setup.chain.task is not None:
        task = setup.chain.task
        s.scale = task.scale
        s.posture_rate = task.posture_rate
        s.singular_value = task.singular_value
        s.axes[: site_layout.shared] = task.axes
        s.posture[: site_layout.joints] = task.posture or setup.q0
    # Creating a view of each field would take longer than copying the values.
    floats = site.view(np.float64)
    places = _find_places(layout, site_layout)
    for name, numbers in _list_vectors(setup).items():
        floats[places[name]] = numbers
    return site


@cache
def _find_places(layout: Layout, site_layout: Layout) -> dict[str, slice]:
    """Returns the position of each vector among the values of a site's row, keyed by name.

    Args:
        layout: Layout of the row.
        site_layout: Layout of the site, whose vectors may be shorter.
    """
    places = {}
    fields: Any = site_dtype(layout).fields
    lengths = site_layout.axes()
    for name, field in FIELDS["site"].items():
        dtype, offset, *_ = fields.get(name, (None, 0))
        shape = field_shape(field, lengths) if dtype is not None else ()
        if len(shape) == 1 and dtype.base == np.float64:
            first = offset // 8
            places[name] = slice(first, first + shape[0])
    return places


def _list_vectors(setup: SiteSetup) -> dict[str, Any]:
    """Returns gains, limits and the initial motion, keyed by field name.

    The estimate of the arm's parameters starts with the known parameters if the control law
    assumes that they are known. Otherwise, it starts with the estimate in the setup.
    """
    gains = setup.gains
    vectors: dict[str, Any] = {name: getattr(gains, name) for name in _GAINS}
    vectors |= setup.limits._asdict()
    vectors |= setup.rest.vectors()
    vectors["tau_limit"] = setup.tau_limit_nm
    vectors["qd_limit"] = setup.qd_limit_rad_s
    vectors["theta"] = setup.theta
    vectors["q"] = setup.q0
    vectors["qd"] = setup.qd0
    vectors["q_before"] = setup.q0
    if gains.is_user and setup.theta_known:
        vectors["known"] = setup.theta
    has_known_gravity = gains.is_known
    vectors["theta_hat"] = gains.known if has_known_gravity else gains.theta_hat0
    return vectors


def _build_channel(setup: SiteSetup, pages: int) -> ChannelArrays:
    """Creates the arrays for the values sent by the control laws of other arms.

    Some control laws send values in addition to the motion of the arm, for example energies.
    For all other laws, the arrays are empty.

    Args:
        setup: Setup of the site that receives the values.
        pages: Number of samples that can wait on each link until their delay has passed.
    """
    vectors = setup.received_vectors
    peers = len(setup.links)
    numbers = sum(vector.length for vector in vectors)
    columns = [link.channel.find_columns(vectors) for link in setup.links]
    shape = (peers, numbers)
    return ChannelArrays(
        waiting=np.zeros((peers, pages, numbers)),
        received=np.zeros(shape),
        columns=np.array(columns, dtype=np.int64).reshape(shape),
    )


def _build_links(
    links: Sequence[LinkSetup], spare: int, shared: int
) -> tuple[RowArray, RowArray, Points]:
    """Creates the arrays that describe all network links of an arm, before its first period.

    Args:
        links: Setups of the links.
        spare: Number of free rows per link for later changes of its delay model.
        shared: Number of coordinates in a sample.

    Returns:
        The state of each link, shape (P,), the delay and loss models, shape (P, M), and the
        points of all delay traces followed by those of all outages. Models and links refer to
        the points by the index of their first row.
    """
    most_models = max(len(link.models) for link in links)
    model_rows = most_models + spare
    rows = np.zeros(len(links), link_dtype(shared))
    all_models = np.zeros((len(links), model_rows), LINK_MODEL_DTYPE)
    trace_points: list[Any] = []
    outages: list[Any] = []
    for link in links:
        for trace in link.traces:
            if trace is not None:
                trace_points.extend(trace)
        outages.extend(link.outages)
    all_points = np.array(trace_points + outages, dtype=np.int64)
    points = all_points.reshape(-1, 2)

    trace_first = 0
    outage_first = len(trace_points)
    row: Row
    for row, models, link in zip(rows, all_models, links, strict=True):
        row.alpha = link.alpha
        row.rate_hz = link.rate_hz
        row.key = link.key
        row.bit = link.bit
        row.followed = link.followed
        row.dispensable = link.dispensable
        row.used = -1
        row.scheduled = -1
        row.q[: len(link.q0)] = link.q0
        row.outage_first = outage_first
        row.outage_count = len(link.outages)
        outage_first += len(link.outages)
        row.models = len(link.models)
        models_and_traces = zip(link.models, link.traces, strict=True)
        for n, (model, trace) in enumerate(models_and_traces):
            trace_count = 0 if trace is None else len(trace)
            models[n] = model._replace(trace_first=trace_first, trace_count=trace_count)
            trace_first += trace_count
    return rows, all_models, points
