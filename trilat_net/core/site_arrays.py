"""The arrays of a running site: their layout, and how a setup fills them.

Invariant: the kernel reads and writes nothing else; two sites of one setup have the same
arrays. A site's state is one row of a structured array: one argument that costs a quarter of a
microsecond to pass, and fields with the paper's names.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .chain import build_chain
from .channel import LOST
from .delay import LINK_MODEL_DTYPE, MAX_DELAY_US, LinkModel, max_delay_us
from .dominance import RAMP_COLUMNS, fold_ramps
from .exogenous import TorqueSourceRows, TorqueTable, torque_source_rows
from .link import (
    AHEAD_LIMIT_NS,
    ChannelArrays,
    calendar_pages,
    link_dtype,
    sample_dtype,
    span_ticks,
)
from .site_setup import Gains, Law, Layout, LinkSetup, SiteSetup
from .ticks import MAX_ARRIVALS, NS_PER_S, CoreChange, DominanceRamp, LifeOrder, Mode
from .two_link_arm import JOINTS, PARAMETERS
from .vectors import Array, IntArray, Points, Row, RowArray

_SETTINGS = (
    *(
        "rate_hz",
        "first",
        "scheme",
        "law",
        "external",
        "ramps",
        "on_stale",
        "stale_ns",
        "return_ns",
    ),
    *("theta_known", "needs_model", "remembered", "asked", "order", "skipped"),
    *("degrades", "regrouped", "bit", "holds"),
)
_COUNTS = ("joints", "shared", "parameters", "task", "sent")
_GAINS = tuple(name for name in Gains._fields if name not in ("law", "theta_hat0", "absolute"))
"""Constant gains; the first estimate becomes `theta_hat`."""
_PER_JOINT = (
    *(
        "tau_limit",
        "qd_limit",
        "Kp",
        "d",
        "q",
        "qd",
        "tau",
        "tau_before",
        "on_arm",
        "held",
        "sensed",
    ),
    *("r", "u", "tau_x", "q_before", "G", "bias", "rho", "width", "friction"),
    *("q_min", "q_max", "tau_rate", "tau_held", "q_rest", "qd_rest"),
    *("damping", "integral", "deceleration"),
)
_PER_COORDINATE = (
    *(
        "Lambda",
        "Kd",
        "K",
        "k_f",
        "q_held",
        "qd_held",
        "q_des",
        "qd_des",
        "q_followed",
        "qd_followed",
        "felt",
        "e",
        "ed",
        "qd_des_limit",
    ),
)
_PER_PARAMETER = ("theta", "known", "Gamma", "low", "high", "theta_hat", "Yr", "Yr_before")
_OF_TASK = ("x", "xd", "wrench", "axes", "b", "y")
_OF_CHAIN = (
    "posture",
    "v",
    "a",
    "zeros",
    "stage_q",
    "stage_qd",
    "stage_qdd",
    "stage_torque",
    "sum_qd",
    "sum_qdd",
)


@cache
def site_dtype(layout: Layout) -> np.dtype[np.void]:
    """Returns the layout of a site's row: its settings and gains, its state, the results within
    a tick.
    """
    fields: list[Any] = [
        (name, "i8") for name in (*_SETTINGS, *_COUNTS, "mode", "return_from_ns", "reason")
    ]
    fields += [
        *((name, "f8") for name in ("g", "wall_n", "align_speed", "align_limit")),
        ("lengths", "f8", (2,)),
    ]
    fields += [
        ("k", "i8"),
        ("t_s", "f8"),
        ("h_s", "f8"),
        ("M", "f8", (layout.joints, layout.joints)),
    ]
    for names, count in (
        (_PER_JOINT, layout.joints),
        (_PER_COORDINATE, layout.shared),
        (_PER_PARAMETER, layout.parameters),
        (_OF_TASK, layout.shared),
    ):
        fields += [(name, "f8", (count,)) for name in names]
    if layout.chain:
        fields += [(name, "f8", (layout.joints,)) for name in _OF_CHAIN]
        fields += [("gravity", "f8", (3,)), ("tip", "f8", (3,))]
        fields += [(name, "f8") for name in ("scale", "posture_rate", "singular_value")]
        fields += [(name, "f8", (layout.shared, layout.joints)) for name in ("J", "Jd")]
        fields += [("A", "f8", (layout.shared, layout.shared)), ("tip_back", "f8", (3, 3))]
    # the leaves of the planar arm are compiled for any
    fields.append(("Y", "f8", (JOINTS, PARAMETERS)))
    return np.dtype((np.record, fields))


@cache
def arrival_dtype(shared: int) -> np.dtype[np.void]:
    """Returns the layout of an arrival whose vectors have so many numbers."""
    return np.dtype(
        (
            np.record,
            [("peer", "i8"), ("tick", "i8"), ("q", "f8", (shared,)), ("qd", "f8", (shared,))],
        )
    )


class SiteArrays(NamedTuple):
    """The arrays of one site, or of several that are stacked: then each has one axis more, in
    front.

    Attributes:
        site: state and constants, shape (1,), see `site_dtype`.
        links: one row per peer, shape (P,), see `link_dtype`.
        models: what the links' channels do, shape (P, M), LINK_MODEL_DTYPE.
        dues: when the links' last samples are due, shape (P, D), ns; see `LinkArrays`.
        calendars: the links' calendars, shape (P, pages), see `sample_dtype`.
        points: traces and outages, shape (n, 2); of stacked sites one for all.
        ramps: how dominance factors change, shape (R, RAMP_COLUMNS + P).
        actors: operators and environments, shape (A,), see `torque_source_dtype`.
        table: their recorded torques, shape (rows, 1 + n); of stacked sites one for all.
        chain: the joints of a chain, shape (n,), see `chain_dtype`; None: the planar two-link
            arm.
        channel: what the peers' laws send, per peer, for a plugged law; None: the law is one of
            the kernel's.
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


class TickBuffers(NamedTuple):
    """Input and output of one tick.

    Attributes:
        arrivals: what came in, shape (MAX_ARRIVALS,), see `arrival_dtype`.
        forces: the peers' exogenous torques that came with it, shape (MAX_ARRIVALS, m), N m.
        sent: what the peers' laws sent with it, shape (MAX_ARRIVALS, C).
        record: the record's floats, see `Layout.columns`; written.
    """

    arrivals: RowArray
    forces: Array
    sent: Array
    record: Array


def build_tick_buffers(setup: SiteSetup) -> TickBuffers:
    """Returns the buffers of a site."""
    layout = setup.layout
    shape = (MAX_ARRIVALS, layout.shared)
    most = (
        0
        if setup.law_factory is None
        else max(link.channel.received_size for link in setup.links)
    )
    return TickBuffers(
        np.zeros(MAX_ARRIVALS, arrival_dtype(layout.shared)),
        np.zeros(shape),
        np.zeros((MAX_ARRIVALS, most)),
        np.zeros(layout.floats),
    )


def build_site_arrays(
    setup: SiteSetup,
    spare: tuple[int, int] = (0, 0),
    pages: int = 0,
    layout: Layout | None = None,
    *,
    plugged: bool = False,
) -> SiteArrays:
    """Returns the arrays of a site at its first tick.

    Args:
        setup: all that the site is built from.
        spare: room for so many more changes of a link, and for so many of the dominance
            factors.
        pages: pages of a link, and samples whose due times it keeps; 0: pages for its delays,
            and due times for as long as a sample may be late.
        layout: of the arrays, if they are to be larger than the site needs.
        plugged: with the arrays of a plugged law, also if the site's is none.
    """
    links = setup.links
    layout = layout or setup.layout
    peers = len(links)
    kept = pages or _kept_dues(setup)
    pages = pages or needed_pages(setup)
    calendars = np.zeros((peers, pages), sample_dtype(layout.shared))
    calendars["tick"] = -1
    rows, models, points = _build_links(links, spare[0], layout.shared)
    actors, table = torque_source_rows(setup.actors, layout.joints, 3 if layout.chain else 2)
    ramps = np.zeros((1 + len(setup.ramps) + spare[1], RAMP_COLUMNS + peers))
    ramps[0, RAMP_COLUMNS:] = [link.alpha for link in links]
    dues = np.full((peers, kept), LOST, dtype=np.int64)
    chain = None if setup.chain is None else build_chain(setup.chain.joints, layout.joints)
    site = _build_site(setup, layout)
    channel = _build_channel(setup, pages) if plugged or setup.law_factory is not None else None
    arrays = SiteArrays(
        site=site,
        links=rows,
        models=models,
        dues=dues,
        calendars=calendars,
        points=points,
        ramps=ramps,
        actors=actors,
        table=table,
        chain=chain,
        channel=channel,
    )
    for ramp in setup.ramps:
        add_ramp(arrays, ramp)
    return arrays


def needed_pages(setup: SiteSetup) -> int:
    """Returns the pages of a site's links: for its delays, by senders that are ahead of it a
    little.
    """
    longest = max(max_delay_us(link.models, link.traces) for link in setup.links)
    return calendar_pages(setup.rate_hz, longest, _NEAR_NS)


def links_bytes(setup: SiteSetup, pages: int) -> int:
    """Returns the memory of a site's links with so many pages each, bytes."""
    numbers = (
        sum(vector.length for vector in setup.received_vectors)
        if setup.law_factory is not None
        else 0
    )
    page = sample_dtype(setup.layout.shared).itemsize + 8 * numbers
    return len(setup.links) * (pages * page + 8 * _kept_dues(setup))


def _kept_dues(setup: SiteSetup) -> int:
    """Returns how many due times a link keeps: from the latest sample there may be to the one
    most ahead.
    """
    fastest_hz = max(setup.rate_hz, *(link.rate_hz for link in setup.links))
    return span_ticks(MAX_DELAY_US * 1000 + AHEAD_LIMIT_NS, fastest_hz) + _SLACK


def widen_calendars(arrays: SiteArrays, k: int, pages: int) -> SiteArrays:
    """Returns the arrays of a site before tick k with calendars of more pages, and in them all
    that waits.
    """
    ticks = np.arange(k, k + arrays.calendars.shape[1])
    old = ticks & (len(ticks) - 1)
    new = ticks & (pages - 1)
    calendars = np.zeros((len(arrays.links), pages), arrays.calendars.dtype)
    calendars["tick"] = -1
    calendars[:, new] = arrays.calendars[:, old]
    channel = arrays.channel
    if channel is not None:
        waiting = np.zeros((*calendars.shape, channel.waiting.shape[2]))
        waiting[:, new] = channel.waiting[:, old]
        channel = channel._replace(waiting=waiting)
    return arrays._replace(calendars=calendars, channel=channel)


class CalendarSizer:
    """The room of a site's links: for its delays, and more for senders further ahead and delays
    that grow.

    Never more than `MAX_LINKS_BYTES`: what does not fit is refused as it is filed, like a stamp
    out of range.

    Attributes:
        newest: per peer a sample that fits at any tick from the last one on, and all older ones
            with it.
    """

    def __init__(self, setup: SiteSetup) -> None:
        self._rate_hz = setup.rate_hz
        self._peer_hz = [link.rate_hz for link in setup.links]
        self._delay_us = [max_delay_us(link.models, link.traces) for link in setup.links]
        self.newest = [-1] * len(setup.links)
        self.most_pages = needed_pages(setup)
        most = calendar_pages(setup.rate_hz)
        while (
            self.most_pages < most
            and links_bytes(setup, 2 * self.most_pages) <= MAX_LINKS_BYTES
        ):
            self.most_pages *= 2

    def clear(self) -> None:
        """Forgets the last tick."""
        self.newest = [-1] * len(self.newest)

    def lengthen(self, peer: int, model: LinkModel) -> None:
        """Takes in a change of a link."""
        self._delay_us[peer] = max(self._delay_us[peer], max_delay_us([model], [None]))
        self.newest[peer] = -1

    def make(self, arrays: SiteArrays, k: int, peer: int, tick: int) -> SiteArrays:
        """Returns the arrays at tick k with room for a peer's sample, if one from as far ahead
        is taken.
        """
        wait = span_ticks(self._delay_us[peer] * 1000, self._rate_hz) + _SLACK
        ahead = tick * self._rate_hz // self._peer_hz[peer] - k
        if ahead > span_ticks(AHEAD_LIMIT_NS, self._rate_hz):
            return arrays
        pages = arrays.calendars.shape[1]
        if ahead + wait > pages < self.most_pages:
            pages = min(1 << (ahead + wait).bit_length(), self.most_pages)
            arrays = widen_calendars(arrays, k - int(arrays.site["skipped"][0]), pages)
        self.newest[peer] = (k + pages - wait) * self._peer_hz[peer] // self._rate_hz
        return arrays


def add_ramp(arrays: SiteArrays, ramp: DominanceRamp) -> None:
    """Adds a change of the dominance factors to those that are planned, in the order of their
    starts.
    """
    site: Row = arrays.site[0]
    count = int(site.ramps)
    ramps = arrays.ramps
    place = 1 + int(np.searchsorted(ramps[1:count, 0], ramp.start_ns, side="right"))
    ramps[place + 1 : count + 1] = ramps[place:count].copy()
    ramps[place] = (ramp.start_ns, ramp.end_ns, *ramp.alpha)
    site.ramps = count + 1


def add_model(arrays: SiteArrays, peer: int, model: LinkModel) -> None:
    """Adds a change of a link to those that are planned, in the order of their first stamps."""
    link: Row = arrays.links[peer]
    models = arrays.models[peer]
    count = int(link.models)
    place = 1 + int(np.searchsorted(models["from_ns"][1:count], model.from_ns, side="right"))
    models[place + 1 : count + 1] = models[place:count].copy()
    models[place] = model
    link.models = count + 1
    if link.model >= place:  # samples from ahead that are scheduled already stay as they are
        link.model += 1


MAX_CHANGES = 4096
"""Most changes of one link that a site takes besides its scenario's."""
MAX_RAMPS = 256
"""Most changes of the dominance factors that wait to begin, besides the scenario's; any number
in a run.
"""


def apply_change(arrays: SiteArrays, change: CoreChange, t_ns: int) -> None:
    """Takes a change in; one that is planned for later, by the scenario or an earlier order,
    still comes.

    Args:
        arrays: of the site.
        change: the change.
        t_ns: a time before which the site makes no more ticks, ns since the epoch.

    Raises:
        ValueError: the arrays have no more room for it.
    """
    s: Row = arrays.site[0]
    if change.order is LifeOrder.OVERRUN:
        s.skipped = change.skipped
    elif change.order is not None:
        s.order = max(s.order, change.order)
    if change.model is not None:
        if arrays.links[change.peer].models >= arrays.models.shape[1]:
            raise ValueError(f"a run takes at most {MAX_CHANGES} changes of a link")
        add_model(arrays, change.peer, change.model)
    if change.ramp is not None:
        s.ramps = fold_ramps(t_ns, int(s.ramps), arrays.ramps)
        if s.ramps >= len(arrays.ramps):
            raise ValueError(
                f"at most {MAX_RAMPS} changes of the shares of a site wait to begin"
            )
        add_ramp(arrays, change.ramp)


_NEAR_NS = NS_PER_S // 4
"""By how much senders are ahead of a receiver that is a little late: a calendar has pages for
that.
"""
MAX_LINKS_BYTES = 64 << 20
"""Most memory of a site's links, bytes."""
_SLACK = 4
"""Ticks by which a sample may be scheduled before it is filed, and some."""
_NEVER_SAMPLED = 2
"""Neither evaluated in every stage (0) nor once a tick (1)."""


def stack_site_arrays(
    setups: Sequence[SiteSetup], spare: int = 0, longest_us: int = 0, late_ns: int = 0
) -> SiteArrays:
    """Returns the arrays of all sites of a run stacked, with links no longer than their delays
    need.

    An array that is shorter than another site's is filled up with rows that are never read.

    Args:
        setups: of the sites.
        spare: room for so many more changes of each link and of each site's dominance factors.
        longest_us: the longest delay of such a change, us.
        late_ns: by how much samples may come late, ns.
    """
    longest = max(
        max_delay_us(link.models, link.traces) for setup in setups for link in setup.links
    )
    fastest_hz = max(setup.rate_hz for setup in setups)
    margin_ns = late_ns + _SLACK * NS_PER_S // fastest_hz
    pages = calendar_pages(fastest_hz, max(longest, longest_us), margin_ns)
    layouts = [setup.layout for setup in setups]
    largest = Layout(*map(max, zip(*layouts, strict=True)))
    plugged = any(setup.law_factory is not None for setup in setups)
    sites = [
        build_site_arrays(one, (spare,) * 2, pages, largest, plugged=plugged) for one in setups
    ]
    first_point = first_torque = 0
    for site in sites:  # one table of points, and one of torques, for all
        site.models["trace_first"] += first_point
        site.links["outage_first"] += first_point
        site.actors["table_first"] += first_torque
        first_point += len(site.points)
        first_torque += len(site.table)
    columns: dict[str, list[Any]] = {
        name: [getattr(site, name) for site in sites] for name in SiteArrays._fields
    }
    if not largest.chain:
        del columns["chain"]
    channels = [site.channel for site in sites if site.channel is not None]
    if not channels:
        del columns["channel"]
    joined: dict[str, Any] = {
        name: np.concatenate(columns.pop(name)) for name in ("points", "table")
    }
    if channels:
        joined["channel"] = _stack_channels(setups, columns.pop("channel"))
    stacked: dict[str, Any] = {name: _stack_padded(column) for name, column in columns.items()}
    for row, site in zip(stacked["actors"], sites, strict=True):
        row["sampled"][len(site.actors) :] = _NEVER_SAMPLED
    return SiteArrays(**{"chain": None, "channel": None, **stacked, **joined})


def select_site(stacked: SiteArrays, i: int, layout: Layout) -> SiteArrays:
    """Returns the arrays of one site of a stack; its rows may be longer than its layout."""
    channel = stacked.channel
    parts = {name: getattr(stacked, name)[i] for name in SiteArrays._fields[:5]}
    return stacked._replace(
        **parts,
        ramps=stacked.ramps[i],
        actors=stacked.actors[i],
        chain=None if stacked.chain is None else stacked.chain[i, : layout.joints],
        channel=None if channel is None else ChannelArrays(*(array[i] for array in channel)),
    )


def _stack_channels(
    setups: Sequence[SiteSetup], channels: Sequence[ChannelArrays]
) -> ChannelArrays:
    """Returns the channels of several sites stacked; places are those in the numbers of the
    peer's record.
    """
    for setup, channel in zip(setups, channels, strict=True):
        for link, places in zip(setup.links, channel.places, strict=True):
            common, own = (
                link.channel.count_numbers(per_peer=per_peer) for per_peer in (False, True)
            )
            places[places >= common] += link.index_at_peer * own
    waiting, received, places = map(_stack_padded, zip(*channels, strict=True))
    for channel, whole in zip(channels, places, strict=True):
        whole[:, channel.places.shape[1] :] = -1
    return ChannelArrays(waiting, received, places)


def _stack_padded(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Returns arrays stacked, each filled up with zeros to the longest along every axis."""
    shape = np.max([array.shape for array in arrays], axis=0)
    return np.stack(
        [
            np.pad(
                array,
                [(0, most - length) for most, length in zip(shape, array.shape, strict=True)],
            )
            for array in arrays
        ]
    )


def _build_site(setup: SiteSetup, layout: Layout) -> RowArray:
    site = np.zeros(1, site_dtype(layout))
    s: Row = site[0]
    gains = setup.gains
    rule = setup.on_stale
    own = setup.layout
    s.rate_hz = setup.rate_hz
    s.scheme = setup.scheme
    s.law = gains.law
    s.mode = Mode.RUN
    s.joints = own.joints
    s.shared = own.shared
    s.parameters = own.parameters
    s.task = own.task
    s.sent = own.sent
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
        s.axes[: own.shared] = task.axes
        s.posture[: own.joints] = task.posture or setup.q0
    vectors = {name: getattr(gains, name) for name in _GAINS}
    vectors |= {
        "tau_limit": setup.tau_limit_nm,
        "qd_limit": setup.qd_limit_rad_s,
        "theta": setup.theta,
    }
    vectors |= {**setup.limits._asdict(), **setup.rest.vectors()}
    vectors |= {"q": setup.q0, "qd": setup.qd0, "q_before": setup.q0}
    if gains.law is Law.USER and setup.theta_known:
        vectors["known"] = setup.theta
    vectors["theta_hat"] = gains.known if gains.law is Law.KNOWN else gains.theta_hat0
    lengths = {
        **dict.fromkeys(_PER_JOINT, own.joints),
        **dict.fromkeys(_PER_COORDINATE, own.shared),
        **dict.fromkeys(_PER_PARAMETER, own.parameters),
    }
    for name, value in vectors.items():
        s[name][: lengths[name]] = value
    return site


def _build_channel(setup: SiteSetup, pages: int) -> ChannelArrays:
    vectors = setup.received_vectors
    links = setup.links
    numbers = sum(vector.length for vector in vectors)
    places = np.array([link.channel.find_columns(vectors) for link in links], dtype=np.int64)
    shape = (len(links), numbers)
    return ChannelArrays(
        np.zeros((len(links), pages, numbers)), np.zeros(shape), places.reshape(shape)
    )


def _build_links(
    links: Sequence[LinkSetup], spare: int, shared: int
) -> tuple[RowArray, RowArray, Points]:
    """Returns the links' rows, their models, and the points of their traces and outages."""
    rows = np.zeros(len(links), link_dtype(shared))
    all_models = np.zeros(
        (len(links), max(len(link.models) for link in links) + spare), LINK_MODEL_DTYPE
    )
    traces = [trace for link in links for trace in link.traces if trace is not None]
    outages = [outage for link in links for outage in link.outages]
    points = np.array(
        [pair for trace in traces for pair in trace] + outages, dtype=np.int64
    ).reshape(-1, 2)
    trace_first = 0
    outage_first = sum(map(len, traces))
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
        for n, (model, trace) in enumerate(zip(link.models, link.traces, strict=True)):
            count = 0 if trace is None else len(trace)
            models[n] = model._replace(trace_first=trace_first, trace_count=count)
            trace_first += count
    return rows, all_models, points
