"""The arrays of a running site: their layout, and how a setup fills them.

Invariant: the kernel reads and writes nothing else; two sites of one setup have the same arrays. A site's
state is one row of a structured array: one argument that costs a quarter of a microsecond to pass, and
fields with the paper's names.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .delay import LINK_MODEL_DTYPE, LinkModel, max_delay_us
from .dominance import RAMP_COLUMNS
from .exogenous import TorqueSourceRows, TorqueTable, torque_source_rows
from .link import LINK_DTYPE, SAMPLE_DTYPE, calendar_pages
from .site_setup import Gains, Law, LinkSetup, SiteSetup
from .ticks import DominanceRamp, Mode, first_tick_at
from .two_link_arm import JOINTS, PARAMETERS
from .vectors import Array, IntArray, Points, Row, RowArray

_VECTOR, _ESTIMATE = (JOINTS,), (PARAMETERS,)
_GAINS = {name: len(value) for name, value in Gains._field_defaults.items() if name != "theta_hat0"}
"""Constant gains, and how many numbers each has; the first estimate becomes `theta_hat`."""
_SETTINGS = ("rate_hz", "scheme", "law", "external", "ramps", "on_stale", "stale_ns", "return_ns")
_STATE = ("q", "qd", "tau", "tau_before", "q_held")
_COMPUTED = ("q_des", "qd_des", "q_followed", "felt", "on_arm", "held", "e", "ed", "r")
SITE_DTYPE = np.dtype(
    (
        np.record,
        [
            *((name, "i8") for name in _SETTINGS),
            *((name, "f8") for name in ("g", "tau_limit", "qd_limit")),
            ("lengths", "f8", (2,)),
            ("theta", "f8", _ESTIMATE),
            *((name, "f8", (count,)) for name, count in _GAINS.items()),
            ("mode", "i8"),
            *((name, "f8", _VECTOR) for name in _STATE),
            *((name, "f8", _ESTIMATE) for name in ("theta_hat", "Yr", "Yr_before")),
            ("return_from_ns", "i8"),
            *((name, "f8", _VECTOR) for name in _COMPUTED),
            ("Y", "f8", (JOINTS, PARAMETERS)),
            ("wall_n", "f8"),
        ],
    )
)
"""A site's settings and gains, its state (from `mode` on), and the intermediate results of a tick."""
ARRIVAL_DTYPE = np.dtype(
    (np.record, [("peer", "i8"), ("tick", "i8"), ("q", "f8", _VECTOR), ("qd", "f8", _VECTOR)])
)

ROW_FLOATS = 6 * JOINTS + PARAMETERS
"""The floats of a record, one after the other: q, qd, q_des, qd_des, tau, tau_x, theta_hat."""
RECORD_Q_DES, RECORD_TAU, RECORD_TAU_X = 2 * JOINTS, 4 * JOINTS, 5 * JOINTS
"""Where three of them begin."""


class SiteArrays(NamedTuple):
    """The arrays of one site, or of several that are stacked: then each has one axis more, in front.

    Attributes:
        site: state and constants, shape (1,), SITE_DTYPE.
        links: one row per peer, shape (P,), LINK_DTYPE.
        models: what the links' channels do, shape (P, M), LINK_MODEL_DTYPE.
        samples: where samples wait, shape (P, pages), SAMPLE_DTYPE.
        calendars: the links' calendars, shape (P, pages).
        points: traces and outages, shape (n, 2); of stacked sites one for all.
        ramps: how dominance factors change, shape (R, RAMP_COLUMNS + P).
        actors: operators and environments, shape (A,), TORQUE_SOURCE_DTYPE.
        table: their recorded torques, shape (n, 3); of stacked sites one for all.
    """

    site: RowArray
    links: RowArray
    models: RowArray
    samples: RowArray
    calendars: IntArray
    points: Points
    ramps: Array
    actors: TorqueSourceRows
    table: TorqueTable


class TickBuffers(NamedTuple):
    """Input and output of one tick.

    Attributes:
        arrivals: what came in, shape (MAX_ARRIVALS,), ARRIVAL_DTYPE.
        forces: the peers' exogenous torques that came with it, shape (MAX_ARRIVALS, JOINTS), N m.
        record: the record's floats, shape (ROW_FLOATS,); written.
    """

    arrivals: RowArray
    forces: Array
    record: Array


def build_site_arrays(setup: SiteSetup, spare: int = 0, pages: int = 0) -> SiteArrays:
    """Returns the arrays of a site at its first tick.

    Args:
        setup: all that the site is built from.
        spare: room for so many more changes of a link, and of the dominance factors.
        pages: pages of a link; 0: as many as any delay may ever need.
    """
    links = setup.links
    peers = len(links)
    pages = pages or max(calendar_pages(max(link.rate_hz, setup.rate_hz)) for link in links)
    samples = np.zeros((peers, pages), SAMPLE_DTYPE)
    samples["tick"] = -1
    rows, models, points = _build_links(links, spare)
    actors, table = torque_source_rows(setup.actors)
    ramps = np.zeros((1 + len(setup.ramps) + spare, RAMP_COLUMNS + peers))
    ramps[0, RAMP_COLUMNS:] = [link.alpha for link in links]
    calendars = np.full((peers, pages), -1, dtype=np.int64)
    arrays = SiteArrays(_build_site(setup), rows, models, samples, calendars, points, ramps, actors, table)
    for ramp in setup.ramps:
        add_ramp(arrays, ramp)
    return arrays


def add_ramp(arrays: SiteArrays, ramp: DominanceRamp) -> None:
    """Adds a change of the dominance factors to those that are planned, in the order of their starts."""
    site: Row = arrays.site[0]
    count, ramps = int(site.ramps), arrays.ramps
    place = 1 + int(np.searchsorted(ramps[1:count, 0], ramp.start_ns, side="right"))
    ramps[place + 1 : count + 1] = ramps[place:count].copy()
    ramps[place] = (ramp.start_ns, ramp.end_ns, *ramp.alpha)
    site.ramps = count + 1


def add_model(arrays: SiteArrays, peer: int, model: LinkModel) -> None:
    """Adds a change of a link to those that are planned, in the order of their first stamps."""
    link: Row = arrays.links[peer]
    models, count = arrays.models[peer], int(link.models)
    place = 1 + int(np.searchsorted(models["from_ns"][1:count], model.from_ns, side="right"))
    models[place + 1 : count + 1] = models[place:count].copy()
    models[place] = model
    link.models = count + 1
    if link.model >= place:  # samples from ahead that are scheduled already stay as they are
        link.model += 1


_SLACK = 4
"""Ticks by which a sample may be scheduled before it is filed, and some."""
_NEVER_SAMPLED = 2
"""Neither evaluated in every stage (0) nor once a tick (1)."""


def stack_site_arrays(setups: Sequence[SiteSetup]) -> SiteArrays:
    """Returns the arrays of all sites of a run stacked, with links no longer than their delays need.

    An array that is shorter than another site's is filled up with rows that are never read.
    """
    longest = max(max_delay_us(link.models, link.traces) for setup in setups for link in setup.links)
    fastest_hz = max(setup.rate_hz for setup in setups)
    pages = 1 << (first_tick_at(longest * 1000, fastest_hz) + _SLACK).bit_length()
    sites = [build_site_arrays(setup, pages=pages) for setup in setups]
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
    joined: dict[str, Any] = {name: np.concatenate(columns.pop(name)) for name in ("points", "table")}
    stacked: dict[str, Any] = {name: _stack_padded(column) for name, column in columns.items()}
    for row, site in zip(stacked["actors"], sites, strict=True):
        row["sampled"][len(site.actors) :] = _NEVER_SAMPLED
    return SiteArrays(**stacked, **joined)


def _stack_padded(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Returns arrays stacked, each filled up with zeros to the longest along every axis."""
    shape = np.max([array.shape for array in arrays], axis=0)
    return np.stack(
        [
            np.pad(array, [(0, most - length) for most, length in zip(shape, array.shape, strict=True)])
            for array in arrays
        ]
    )


def _build_site(setup: SiteSetup) -> RowArray:
    site = np.zeros(1, SITE_DTYPE)
    s: Row = site[0]
    gains, rule = setup.gains, setup.on_stale
    s.rate_hz, s.scheme, s.law, s.mode = setup.rate_hz, setup.scheme, gains.law, Mode.RUN
    s.g, s.tau_limit, s.qd_limit = setup.g_m_s2, setup.tau_limit_nm, setup.qd_limit_rad_s
    s.external, s.ramps = int(setup.external), 1
    s.on_stale, s.stale_ns, s.return_ns = rule.action, rule.age_ns, rule.return_ns
    s.lengths, s.theta = setup.lengths_m, setup.theta
    for name in _GAINS:
        s[name] = getattr(gains, name)
    s.q, s.qd = setup.q0, setup.qd0
    s.theta_hat = gains.known if gains.law is Law.KNOWN else gains.theta_hat0
    return site


def _build_links(links: Sequence[LinkSetup], spare: int) -> tuple[RowArray, RowArray, Points]:
    """Returns the links' rows, their models, and the points of their traces and outages."""
    rows = np.zeros(len(links), LINK_DTYPE)
    all_models = np.zeros((len(links), max(len(link.models) for link in links) + spare), LINK_MODEL_DTYPE)
    traces = [trace for link in links for trace in link.traces if trace is not None]
    outages = [outage for link in links for outage in link.outages]
    points = np.array([pair for trace in traces for pair in trace] + outages, dtype=np.int64).reshape(-1, 2)
    trace_first, outage_first = 0, sum(map(len, traces))
    row: Row
    for row, models, link in zip(rows, all_models, links, strict=True):
        row.alpha, row.rate_hz, row.key = link.alpha, link.rate_hz, link.key
        row.used, row.foreseen, row.q = -1, -1, link.q0
        row.outage_first, row.outage_count = outage_first, len(link.outages)
        outage_first += len(link.outages)
        row.models = len(link.models)
        for n, (model, trace) in enumerate(zip(link.models, link.traces, strict=True)):
            count = 0 if trace is None else len(trace)
            models[n] = model._replace(trace_first=trace_first, trace_count=count)
            trace_first += count
    return rows, all_models, points
