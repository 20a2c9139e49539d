"""A log as data tables: a row per record, arrival, statistics message or event.

Invariant: every number is the record's own, or follows from it exactly (an age is a difference of
stamps). A column's name ends in its unit; a missing value is null, never a number in its place. Units
come from the schema, meanings from the docstrings of the message types: there is no second list.
"""

import dataclasses
import inspect
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.ticks import NS_PER_S
from ..core.two_link_arm import JOINTS, PARAMETERS
from ..errors import LogError
from ..files import import_extra
from ..net.messages import STATE_VECTORS, Event, LinkStats, State, json_schema
from .record_columns import Ints

if TYPE_CHECKING:
    import polars

    from .log_reader import Log
    from .site_log import SiteLog


UNIT_SUFFIXES = {
    "rad": "rad",
    "rad/s": "rad_s",
    "N m": "nm",
    "kg m^2": "kg_m2",
    "kg m": "kg_m",
    "s": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "ns/s": "ppb",
    "tick": "tick",
    "byte": "bytes",
}
"""How a unit stands at the end of a name."""


def add_unit_suffix(stem: str, unit: str) -> str:
    """Returns a column's name: what it is, and its unit unless that is named already."""
    suffix = UNIT_SUFFIXES.get(unit, "")
    return stem if not suffix or stem == suffix or stem.endswith(f"_{suffix}") else f"{stem}_{suffix}"


def to_int_array(values: Iterable[int], source: str, field: str, kind: Any = np.int64) -> NDArray[Any]:
    """Returns whole numbers as an array.

    Args:
        values: the numbers.
        source: what errors call the file.
        field: what they are.
        kind: how an array holds them.

    Raises:
        LogError: 64 bits do not hold one.
    """
    try:
        return np.fromiter(values, kind)
    except OverflowError:
        raise LogError(f"{source}: {field} has a number that is out of range") from None


class Column(NamedTuple):
    """One column.

    Attributes:
        name: its name, with the unit at its end.
        values: its values, shape (K,): numbers, or texts as objects.
        unit: their unit; "" for texts and counts.
        meaning: what they are.
        source: the field of the message that they are from.
        known: which rows have a value, shape (K,); None where all have.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    meaning: str = ""
    source: str = ""
    known: NDArray[np.bool_] | None = None

    @property
    def is_text(self) -> bool:
        """True where the values are texts."""
        return self.values.dtype == np.object_

    def numbers(self) -> NDArray[Any]:
        """Returns the values of a column of numbers, with NaN where there is none."""
        if self.known is None or self.known.all():
            return self.values
        return np.where(self.known, self.values, np.nan)

    def rows(self, first: int, last: int) -> list[Any]:
        """Returns the values of some rows as Python's own numbers and texts, None where there is none."""
        values: list[Any] = self.values[first:last].tolist()
        if self.known is None:
            return values
        known = self.known[first:last].tolist()
        return [value if there else None for value, there in zip(values, known, strict=True)]


@dataclass(frozen=True)
class Table:
    """Columns of one length.

    Attributes:
        name: the site, or what else it is of.
        kind: of a site, what of it: "state", "link" or "arrivals"; else "".
        about: what a row is.
        columns: the columns.
    """

    name: str
    kind: str
    about: str
    columns: tuple[Column, ...] = dataclasses.field(repr=False)

    def __len__(self) -> int:
        return len(self.columns[0].values) if self.columns else 0

    def __getitem__(self, name: str) -> Column:
        """Returns a column by its name.

        Raises:
            KeyError: there is none of that name.
        """
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(f"no column {name!r}; there are {', '.join(column.name for column in self.columns)}")

    @property
    def label(self) -> str:
        """Its name as that of a file: "m1_link", "events"."""
        return f"{self.name}_{self.kind}" if self.kind else self.name


_FIELD = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
_NAMED = {"t_ns": "ns", "sent_ns": "ns", "tick": "tick"}
"""Units of fields whose name says them, or that count ticks."""
_ALONE = {
    "qd_des": "derivative of the reference, Eq. (6)",
    "delay_max_us": "per peer, largest one-way delay since the last statistics; -1 where nothing came",
    "late": "per peer, samples that came after they were due",
    "duplicate": "per peer, samples that came twice",
    "refused": "per peer, samples whose stamp was out of range",
    "lost": "per peer, samples that the link's model lost",
}
"""Where the documentation leans on the line before: the same without that line."""


class FieldDoc(NamedTuple):
    """What a field is.

    Attributes:
        unit: its unit, "" where it has none.
        text: a sentence's worth.
        kind: its type, as JSON Schema has it.
    """

    unit: str
    text: str
    kind: str


@cache
def read_field_docs(kind: type[msgspec.Struct]) -> dict[str, FieldDoc]:
    """Returns what every field of a message type is, in the order of its definition."""
    texts = dict(_FIELD.findall(inspect.getdoc(kind) or ""))
    texts |= {name: _ALONE[name] for name in texts.keys() & _ALONE.keys()}
    properties: dict[str, dict[str, Any]] = json_schema(kind)["properties"]
    return {
        name: FieldDoc(
            entry.get("x-unit", _NAMED.get(name, _ending(name))),
            " ".join(texts.get(name, entry.get("description", "")).split()).rstrip("."),
            entry["type"],
        )
        for name, entry in properties.items()
    }


def _ending(name: str) -> str:
    """Returns the unit that a field's name ends in."""
    ending = name.rpartition("_")[2]
    return {"ns": "ns", "us": "us", "ppb": "ns/s"}.get(ending, "")


THETA_UNITS = ("kg m^2", "kg m^2", "kg m^2", "kg m", "kg m")
"""Units of the five parameters of Eq. (24)."""
_NONE_BELOW_0 = {"age_us", "delay_us", "delay_max_us", "rtt_us"}
"""Statistics in which -1 says that there is none."""


def build_time_columns(
    tick: Ints | None, t_s: NDArray[Any], log_ns: Ints, publish_ns: Ints
) -> Iterator[Column]:
    """Yields the columns that tell when something was: nominally, when it came, when it was sent."""
    yield Column("t_s", t_s, "s", "nominal time since the session's epoch", "t_ns", known=_known(t_s))
    if tick is not None:
        yield Column("tick", tick, "tick", "number of the tick", "tick")
    yield Column("log_time_ns", log_ns, "ns", "when it came to the recorder, Unix time", "log_time")
    yield Column("publish_time_ns", publish_ns, "ns", "when it was sent, Unix time", "publish_time")


def _known(t_s: NDArray[Any]) -> NDArray[np.bool_] | None:
    there: NDArray[np.bool_] = ~np.isnan(t_s)
    return None if there.all() else there


def build_state_table(log: "Log", part: "SiteLog") -> Table:
    """Returns a site's records, a row each, in order of their ticks."""
    said = read_field_docs(State)
    columns = list(build_time_columns(part.tick, part.t_s, part.log_time_ns, part.publish_time_ns))
    columns.append(Column("mode", part.mode, "", said["mode"].text, "mode"))
    for field, count in STATE_VECTORS.items():
        values = getattr(part, field)
        units = THETA_UNITS if count == PARAMETERS else (said[field].unit,) * count
        thing = "joint" if count == JOINTS else "parameter"
        columns += [
            Column(
                add_unit_suffix(f"{field}{n + 1}", unit),
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


def build_arrivals_table(log: "Log", part: "SiteLog") -> Table:
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
        *build_time_columns(
            part.tick[record], part.t_s[record], part.log_time_ns[record], part.publish_time_ns[record]
        ),
        Column("peer", names, "", "whose sample came", "rx[][0]"),
        Column("sample_tick", entries[:, 1].copy(), "tick", "its tick, at the peer's rate", "rx[][1]"),
        Column("delay_us", entries[:, 2].copy(), "us", _delay_text(log), "rx[][2]"),
    )
    return Table(part.name, "arrivals", f"a sample that {part.name} took in, by the tick that did", columns)


def _delay_text(log: "Log") -> str:
    if log.driver == "live":
        return "its one-way delay, by the offset of the clocks in force"
    return "the age of its stamp; in virtual time every sample arrives at the next tick"


def build_link_table(log: "Log", site: str) -> Table:
    """Returns the statistics of a site's loop and links, a row each, in order of their ticks.

    Raises:
        LogError: one cannot be read.
    """
    stats, log_ns, publish_ns = log.timed_link_stats(site)
    tick = to_int_array((s.tick for s in stats), log.source, "tick")
    t_s = to_int_array((s.t_ns for s in stats), log.source, "t_ns") / NS_PER_S
    columns = list(build_time_columns(tick, t_s, log_ns, publish_ns))
    for field, (unit, text, kind) in read_field_docs(LinkStats).items():
        if field in ("v", "site", "boot", "tick", "t_ns"):
            continue
        values = [getattr(s, field) for s in stats]
        if kind == "object":
            names = log.scenario.peers(site) if field != "dropped" else _reasons(values)
            columns += [_entry(log, field, name, values) for name in names]
        elif kind == "integer":
            columns.append(Column(field, to_int_array(values, log.source, field), unit, text, field))
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
    unit, text, _ = read_field_docs(LinkStats)[field]
    stem, _, ending = field.rpartition("_") if unit else (field, "", "count")
    absent = 0 if field == "dropped" else None  # what was never dropped for a reason is not named
    said = [value.get(name, absent) for value in values]
    known = np.array([n is not None and (n >= 0 or field not in _NONE_BELOW_0) for n in said], dtype=np.bool_)
    return Column(
        f"{stem}_{_word(name)}_{ending}",
        to_int_array((n or 0 for n in said), log.source, field),
        unit,
        f"{name}: {text.removeprefix('per peer, ')}",
        f"{field}.{name}",
        None if known.all() else known,
    )


EVENTS_TABLE = "events"
SITE_TABLE_KINDS = ("state", "link", "arrivals")
"""What there is of a site."""


def build_table(log: "Log", name: str, kind: str = "") -> Table:
    """Returns a part of a log as a table.

    Args:
        log: the log.
        name: a site, or "events".
        kind: of a site, one of `KINDS`; "" is "state".

    Raises:
        KeyError: there is no such part.
        LogError: what is in it cannot be read.
    """
    if name == EVENTS_TABLE and name not in log.sites:
        return build_events_table(log)
    part = log[name]
    match kind:
        case "" | "state":
            return build_state_table(log, part)
        case "link":
            return build_link_table(log, name)
        case "arrivals":
            return build_arrivals_table(log, part)
    raise KeyError(f"no table {kind!r} of {name}; there are {', '.join(SITE_TABLE_KINDS)}")


def iterate_tables(log: "Log") -> Iterator[Table]:
    """Yields every table of a log, one at a time: of each site, and the events."""
    for site in log.sites:
        for kind in SITE_TABLE_KINDS:
            yield build_table(log, site, kind)
    yield build_events_table(log)


def build_events_table(log: "Log") -> Table:
    """Returns what happened, a row each, in the order in which it came to the recorder.

    Raises:
        LogError: an event holds a number that is out of range.
    """
    events, log_ns, publish_ns = log.timed_events()
    t_ns = to_int_array((event.t_ns for event in events), log.source, "t_ns")
    t_s = np.where(t_ns >= 0, t_ns / NS_PER_S, np.nan)
    columns = list(build_time_columns(None, t_s, log_ns, publish_ns))
    for field, (unit, text, kind) in read_field_docs(Event).items():
        if field in ("v", "t_ns"):
            continue
        values = [getattr(event, field) for event in events]
        if kind == "integer":
            bits = np.uint64 if field == "boot" else np.int64
            columns.append(Column(field, to_int_array(values, log.source, field, bits), unit, text, field))
        else:  # what is told per member as JSON
            texts = [v if isinstance(v, str) else json.dumps(v, sort_keys=True) if v else "" for v in values]
            columns.append(Column(field, np.array(texts, dtype=np.object_), unit, text, field))
    return Table(EVENTS_TABLE, "", "something that happened once", tuple(columns))


def to_data_frame(table: Table) -> "polars.DataFrame":
    """Returns a table as a polars data frame.

    Raises:
        UsageError: polars is not installed.
    """
    pl = import_extra("polars", "frames", "data frames")

    return cast("polars.DataFrame", pl.DataFrame([_series(pl, column) for column in table.columns]))


def _series(pl: Any, column: Column) -> Any:
    if column.is_text:
        made = pl.Series(column.name, column.values.tolist(), dtype=pl.String)
    else:
        made = pl.Series(column.name, column.values)
    if column.known is None:
        return made
    return made.zip_with(pl.Series(column.known), pl.Series([None], dtype=made.dtype))
