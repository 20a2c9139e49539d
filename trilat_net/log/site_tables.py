"""What a site recorded, as tables: a row per record, per sample that came in, per statistics.

Law: every number is the record's own, or follows from it exactly: an age is a difference of stamps.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.arm import JOINTS, PARAMETERS
from ..core.grid import NS_PER_S
from ..errors import LogError
from ..net.messages import STATE_VECTORS, LinkStats, State
from .columns import Ints
from .meaning import meanings
from .table import Column, Table, named, whole

if TYPE_CHECKING:
    from .reader import Log
    from .site_log import SiteLog

THETA_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters of Eq. (24)."""
_NONE_BELOW_0 = {"age_us", "delay_us", "delay_max_us", "rtt_us"}
"""Statistics in which -1 says that there is none."""


def times(tick: Ints | None, t_s: NDArray[Any], log_ns: Ints, publish_ns: Ints) -> Iterator[Column]:
    """Yields the columns that tell when something was: nominally, when it came, when it was sent."""
    yield Column("t_s", t_s, "s", "nominal time since the session's epoch", "t_ns", known=_known(t_s))
    if tick is not None:
        yield Column("tick", tick, "tick", "number of the tick", "tick")
    yield Column("log_time_ns", log_ns, "ns", "when it came to the recorder, Unix time", "log_time")
    yield Column("publish_time_ns", publish_ns, "ns", "when it was sent, Unix time", "publish_time")


def _known(t_s: NDArray[Any]) -> NDArray[np.bool_] | None:
    there: NDArray[np.bool_] = ~np.isnan(t_s)
    return None if there.all() else there


def state_table(log: "Log", part: "SiteLog") -> Table:
    """Returns a site's records, a row each, in order of their ticks."""
    said = meanings(State)
    columns = list(times(part.tick, part.t_s, part.log_time_ns, part.publish_time_ns))
    columns.append(Column("mode", part.mode, "", said["mode"].text, "mode"))
    for field, count in STATE_VECTORS.items():
        values = getattr(part, field)
        units = THETA_UNITS if count == PARAMETERS else (said[field].unit,) * count
        thing = "joint" if count == JOINTS else "parameter"
        columns += [
            Column(
                named(f"{field}{n + 1}", unit),
                np.ascontiguousarray(values[:, n]),
                unit,
                f"{said[field].text}, {thing} {n + 1}",
                f"{field}[{n}]",
            )
            for n, unit in enumerate(units)
        ]
    for peer in part.peers:
        columns += _use(part, peer, log.scenario.sites[peer].rate_hz)
    for field in ("late_us", "busy_us", "sent_ns"):
        unit, text, _ = said[field]
        columns.append(Column(field, part.numbers(field), unit, text, field))
    return Table(part.name, "state", f"a tick of {part.name}", tuple(columns))


def _use(part: "SiteLog", peer: str, rate_hz: int) -> Iterator[Column]:
    """Yields which sample of a peer was in use, and how old it was."""
    used = part.used[peer]
    there: NDArray[np.bool_] = used >= 0
    age_ms = (part.t_ns - used * NS_PER_S // rate_hz) / 1e6
    source = f"used.{peer}"
    yield Column(f"used_{peer}_tick", used, "tick", f"tick of the sample of {peer} in use", source, there)
    text = f"now minus the stamp of the sample of {peer} in use"
    yield Column(f"age_{peer}_ms", age_ms, "ms", text, f"t_ns, {source}", there)


def arrivals_table(log: "Log", part: "SiteLog") -> Table:
    """Returns the samples that came to a site, a row each, in the order in which it accepted them.

    Raises:
        LogError: a record names a peer that the site does not have.
    """
    counts, entries = part.arrivals
    index = entries[:, 0]
    if ((index < 0) | (index >= len(part.peers))).any():
        raise LogError(
            f"{log.source}: a record of {part.name} lists an arrival of a peer that it does not have"
        )
    record = np.repeat(np.arange(len(part)), counts)
    names = np.array(part.peers, dtype=np.object_)[index]
    columns = (
        *times(part.tick[record], part.t_s[record], part.log_time_ns[record], part.publish_time_ns[record]),
        Column("peer", names, "", "whose sample came", "rx[][0]"),
        Column("sample_tick", entries[:, 1].copy(), "tick", "its tick, at the peer's rate", "rx[][1]"),
        Column("delay_us", entries[:, 2].copy(), "us", _delay_text(log), "rx[][2]"),
    )
    return Table(part.name, "arrivals", f"a sample that {part.name} took in, by the tick that did", columns)


def _delay_text(log: "Log") -> str:
    if log.driver == "live":
        return "its one-way delay, by the offset of the clocks in force"
    return "the age of its stamp; in virtual time every sample arrives at the next tick"


def link_table(log: "Log", site: str) -> Table:
    """Returns the statistics of a site's loop and links, a row each, in order of their ticks.

    Raises:
        LogError: one cannot be read.
    """
    stats, log_ns, publish_ns = log.timed_link_stats(site)
    tick = whole((s.tick for s in stats), log.source, "tick")
    t_s = whole((s.t_ns for s in stats), log.source, "t_ns") / NS_PER_S
    columns = list(times(tick, t_s, log_ns, publish_ns))
    for field, (unit, text, kind) in meanings(LinkStats).items():
        if field in ("v", "site", "boot", "tick", "t_ns"):
            continue
        values = [getattr(s, field) for s in stats]
        if kind == "object":
            names = log.scenario.peers(site) if field != "dropped" else _reasons(values)
            columns += [_entry(log, field, name, values) for name in names]
        elif kind == "integer":
            columns.append(Column(field, whole(values, log.source, field), unit, text, field))
        else:
            columns.append(Column(field, np.array(values, dtype=np.object_), unit, text, field))
    about = f"statistics of {site}'s loop and links, ten times a second"
    return Table(site, "link", about, tuple(columns))


def _reasons(values: Iterable[Mapping[str, int]]) -> list[str]:
    """Returns for which reasons messages were dropped: words, each once however it is spelt in a name."""
    return list({_word(reason): reason for value in values for reason in sorted(value)}.values())


def _word(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower())[:31]


def _entry(log: "Log", field: str, name: str, values: Sequence[Mapping[str, int]]) -> Column:
    """Returns what is told of one peer, or of one reason."""
    unit, text, _ = meanings(LinkStats)[field]
    stem, _, ending = field.rpartition("_") if unit else (field, "", "count")
    absent = 0 if field == "dropped" else None  # what was never dropped for a reason is not named
    said = [value.get(name, absent) for value in values]
    known = np.array([n is not None and (n >= 0 or field not in _NONE_BELOW_0) for n in said], dtype=np.bool_)
    return Column(
        f"{stem}_{_word(name)}_{ending}",
        whole((n or 0 for n in said), log.source, field),
        unit,
        f"{name}: {text.removeprefix('per peer, ')}",
        f"{field}.{name}",
        None if known.all() else known,
    )
