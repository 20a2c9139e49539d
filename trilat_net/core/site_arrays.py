"""The arrays of a running site: their layout, and how a setup fills them.

Invariant: the kernel reads and writes nothing else; two sites of one setup have the same arrays. A site's
state is one row of a structured array: one argument that costs a quarter of a microsecond to pass, and
fields with the paper's names.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .delay import LINK_MODEL_DTYPE, max_delay_us
from .dominance import RAMP_COLUMNS
from .exogenous import TorqueSourceRows, TorqueTable, torque_source_rows
from .link import LINK_DTYPE, SAMPLE_DTYPE, calendar_pages
from .site_setup import Law, LinkSetup, SiteSetup
from .ticks import DominanceRamp, Mode, first_tick_at
from .two_link_arm import JOINTS, PARAMETERS
from .vectors import Array, IntArray, Points, Row, RowArray


class SiteArrays(NamedTuple):
    """The tables of one site, or of several that are stacked: then each has one axis more, in front.

    Attributes:
        site: state and constants, shape (1,), dtype SITE.
        links: one row per peer, shape (P,), dtype LINK.
        models: what the links' channels do, shape (P, M), dtype MODEL.
        samples: where samples wait, shape (P, pages), dtype SAMPLE.
        calendars: the links' calendars, shape (P, pages).
        points: traces and outages, shape (n, 2).
        ramps: how shares change, shape (R, 2 + P), see `shares`.
        actors: operators and environments, shape (A,), dtype ACTOR.
        table: their recorded torques, shape (n, 3).
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


def build_site_arrays(setup: SiteSetup, spare: int = 0, pages: int = 0) -> SiteArrays:
    """Returns the tables of a site at its first tick.

    Args:
        setup: all that the site is built from.
        spare: how many changes of a link, and of the shares, it must have room for besides.
        pages: pages of a link; 0: as many as any delay may ever need.
    """
    links = setup.links
    peers = len(links)
    pages = pages or max(calendar_pages(max(link.rate_hz, setup.rate_hz)) for link in links)
    samples = np.zeros((peers, pages), SAMPLE_DTYPE)
    samples["tick"] = -1
    rows, models, points = _links_of(links, spare)
    actors, table = torque_source_rows(setup.actors)
    ramps = np.zeros((1 + len(setup.ramps) + spare, RAMP_COLUMNS + peers))
    ramps[0, RAMP_COLUMNS:] = [link.alpha for link in links]
    calendars = np.full((peers, pages), -1, dtype=np.int64)
    tables = SiteArrays(_site_of(setup), rows, models, samples, calendars, points, ramps, actors, table)
    for ramp in setup.ramps:
        add_ramp(tables, ramp)
    return tables


def add_ramp(tables: SiteArrays, ramp: DominanceRamp) -> None:
    """Puts a change of the shares among those that are planned."""
    site: Row = tables.site[0]
    count, ramps = int(site.ramps), tables.ramps
    place = 1 + int(np.searchsorted(ramps[1:count, 0], ramp.start_ns, side="right"))
    ramps[place + 1 : count + 1] = ramps[place:count].copy()
    ramps[place] = (ramp.start_ns, ramp.end_ns, *ramp.alpha)
    site.ramps = count + 1


def stack_site_arrays(setups: Sequence[SiteSetup]) -> SiteArrays:
    """Returns the tables of all sites of a run in one, with links no longer than their delays need.

    What one site has less of than another is filled with rows that nobody reads.
    """
    longest = max(max_delay_us(link.models, link.traces) for setup in setups for link in setup.links)
    fastest_hz = max(setup.rate_hz for setup in setups)
    pages = 1 << (first_tick_at(longest * 1000, fastest_hz) + _SLACK).bit_length()
    each = [build_site_arrays(setup, pages=pages) for setup in setups]
    first_point = first_torque = 0
    for tables in each:  # one table of points, and one of torques, for all
        tables.models["trace_first"] += first_point
        tables.links["outage_first"] += first_point
        tables.actors["table_first"] += first_torque
        first_point += len(tables.points)
        first_torque += len(tables.table)
    actors = _padded([tables.actors for tables in each])
    for row, tables in zip(actors, each, strict=True):
        row["sampled"][len(tables.actors) :] = _NOBODY
    return SiteArrays(
        np.stack([tables.site for tables in each]),
        np.stack([tables.links for tables in each]),
        _padded([tables.models for tables in each]),
        np.stack([tables.samples for tables in each]),
        np.stack([tables.calendars for tables in each]),
        np.concatenate([tables.points for tables in each]),
        _padded([tables.ramps for tables in each]),
        actors,
        np.concatenate([tables.table for tables in each]),
    )


_SLACK = 4
"""Ticks by which a sample may be foreseen before it is filed, and some."""
_NOBODY = 2
"""Neither asked in every stage (0) nor once a tick (1)."""


def _padded(tables: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Returns tables stacked, each filled up with zeros along its last axis but that of a row."""
    axis = 0 if tables[0].ndim == 1 or tables[0].dtype.names is None else 1
    length = max(table.shape[axis] for table in tables)
    filled = []
    for table in tables:
        shape = [*table.shape]
        shape[axis] = length
        whole = np.zeros(shape, table.dtype)
        whole[(slice(None),) * axis + (slice(table.shape[axis]),)] = table
        filled.append(whole)
    return np.stack(filled)


def _site_of(setup: SiteSetup) -> RowArray:
    site = np.zeros(1, SITE_DTYPE)
    s: Row = site[0]
    s.rate_hz, s.scheme, s.law, s.mode = (
        setup.rate_hz,
        int(setup.scheme),
        int(setup.gains.law),
        int(Mode.RUN),
    )
    s.g, s.tau_limit, s.qd_limit = setup.g_m_s2, setup.tau_limit_nm, setup.qd_limit_rad_s
    s.external, s.ramps = int(setup.external), 1
    rule = setup.on_stale
    s.on_stale, s.stale_ns, s.return_ns = int(rule.action), rule.age_ns, rule.return_ns
    s.lengths = setup.lengths_m
    s.theta = setup.theta
    gains = setup.gains
    for name in gains._fields[1:]:
        if name != "theta_hat0":
            s[name] = getattr(gains, name)
    s.q, s.qd = setup.q0, setup.qd0
    s.theta_hat = gains.known if gains.law is Law.KNOWN else gains.theta_hat0
    return site


def _links_of(links: Sequence[LinkSetup], spare: int) -> tuple[RowArray, RowArray, Points]:
    """Returns the links' rows, their models, and their traces and outages."""
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


_VECTOR = (JOINTS,)
SITE_DTYPE = np.dtype(
    (
        np.record,
        [
            ("rate_hz", "i8"),
            ("scheme", "i8"),
            ("law", "i8"),
            ("external", "i8"),
            ("ramps", "i8"),
            ("on_stale", "i8"),
            ("stale_ns", "i8"),
            ("return_ns", "i8"),
            ("g", "f8"),
            ("tau_limit", "f8"),
            ("qd_limit", "f8"),
            ("theta", "f8", (PARAMETERS,)),
            ("Lambda", "f8", _VECTOR),
            ("Kp", "f8", _VECTOR),
            ("Kd", "f8", _VECTOR),
            ("Gamma", "f8", (PARAMETERS,)),
            ("low", "f8", (PARAMETERS,)),
            ("high", "f8", (PARAMETERS,)),
            ("known", "f8", (PARAMETERS,)),
            ("K", "f8", _VECTOR),
            ("d", "f8", _VECTOR),
            ("k_f", "f8", _VECTOR),
            ("lengths", "f8", (2,)),
            # the state
            ("mode", "i8"),
            ("q", "f8", _VECTOR),
            ("qd", "f8", _VECTOR),
            ("theta_hat", "f8", (PARAMETERS,)),
            ("tau", "f8", _VECTOR),
            ("tau_before", "f8", _VECTOR),
            ("Yr", "f8", (PARAMETERS,)),
            ("Yr_before", "f8", (PARAMETERS,)),
            ("q_held", "f8", _VECTOR),
            ("return_from_ns", "i8"),
            # what a tick computes on its way
            ("q_des", "f8", _VECTOR),
            ("qd_des", "f8", _VECTOR),
            ("q_followed", "f8", _VECTOR),
            ("felt", "f8", _VECTOR),
            ("on_arm", "f8", _VECTOR),
            ("held", "f8", _VECTOR),
            ("e", "f8", _VECTOR),
            ("ed", "f8", _VECTOR),
            ("r", "f8", _VECTOR),
            ("Y", "f8", (JOINTS, PARAMETERS)),
        ],
    )
)
ARRIVAL_DTYPE = np.dtype(
    (np.record, [("peer", "i8"), ("tick", "i8"), ("q", "f8", _VECTOR), ("qd", "f8", _VECTOR)])
)

# Where each vector of a record lies in the row of floats that a tick emits.
EMITTED = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
ROW_FLOATS = 6 * JOINTS + PARAMETERS
