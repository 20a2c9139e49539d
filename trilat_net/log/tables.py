"""The parts of a log as tables, by name.

Law: what cannot be found is answered with what can.
"""

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..core.grid import NS_PER_S
from ..net.messages import Event
from .meaning import meanings
from .site_tables import arrivals_table, link_table, state_table, times
from .table import Column, Table, whole

if TYPE_CHECKING:
    from .reader import Log

EVENTS = "events"
KINDS = ("state", "link", "arrivals")
"""What there is of a site."""


def table(log: "Log", name: str, kind: str = "") -> Table:
    """Returns a part of a log as a table.

    Args:
        log: the log.
        name: a site, or "events".
        kind: of a site, one of `KINDS`; "" is "state".

    Raises:
        KeyError: there is no such part.
        LogError: what is in it cannot be read.
    """
    if name == EVENTS and name not in log.sites:
        return events_table(log)
    part = log[name]
    match kind:
        case "" | "state":
            return state_table(log, part)
        case "link":
            return link_table(log, name)
        case "arrivals":
            return arrivals_table(log, part)
    raise KeyError(f"no table {kind!r} of {name}; there are {', '.join(KINDS)}")


def all_tables(log: "Log") -> Iterator[Table]:
    """Yields every table of a log, one at a time: of each site, and the events."""
    for site in log.sites:
        for kind in KINDS:
            yield table(log, site, kind)
    yield events_table(log)


def events_table(log: "Log") -> Table:
    """Returns what happened, a row each, in the order in which it came to the recorder.

    Raises:
        LogError: an event holds a number that is out of range.
    """
    events, log_ns, publish_ns = log.timed_events()
    t_ns = whole((event.t_ns for event in events), log.source, "t_ns")
    t_s = np.where(t_ns >= 0, t_ns / NS_PER_S, np.nan)
    columns = list(times(None, t_s, log_ns, publish_ns))
    for field, (unit, text, kind) in meanings(Event).items():
        if field in ("v", "t_ns"):
            continue
        values = [getattr(event, field) for event in events]
        if kind == "integer":
            bits = np.uint64 if field == "boot" else np.int64
            columns.append(Column(field, whole(values, log.source, field, bits), unit, text, field))
        else:  # what is told per member as JSON
            texts = [v if isinstance(v, str) else json.dumps(v, sort_keys=True) if v else "" for v in values]
            columns.append(Column(field, np.array(texts, dtype=np.object_), unit, text, field))
    return Table(EVENTS, "", "something that happened once", tuple(columns))
