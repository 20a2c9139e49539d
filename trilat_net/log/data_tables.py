"""Convert a log to data tables, with a row per record, arrival, statistics message or event.

Invariant:
    - Every number is that of the record, or follows from the record exactly (an age is a
      difference of stamps). The only exception is an orientation, which is a unit quaternion
      whose sign continues from row to row, because the rotation vector of the record jumps
      where it passes half a turn (see `orientations`). The meaning of the column states that.
    - The name of a column ends in its unit. A missing value is null, never a number.
    - Units come from the schema, and meanings from the docstrings of the message types. Units
      and names of the numbers that a law sends come from the law's declaration. There is no
      second list of them.
    - A number out of range, or an arrival of a peer that a site does not have, is a `LogError`
      that names the file (`source`).
"""

import dataclasses
import inspect
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..core.chain import LINK_PARAMETERS
from ..core.task_space import POSE, POSITION
from ..core.ticks import NS_PER_S
from ..errors import LogError
from ..files import import_extra
from ..net.messages import Event, LinkStats, State, json_schema
from ..scenario import Scenario
from ..scenario.arms import TASK_AXES, ArmModel
from .orientations import QUATERNION_AXES, align_signs, compute_quaternions
from .record_columns import Ints
from .site_log import SiteLog, TimedMessages

if TYPE_CHECKING:
    import pandas
    import polars

UNIT_SUFFIXES = {
    **{unit: unit for unit in ("rad", "m", "s", "ms", "us", "ns", "kg", "tick")},
    "rad/s": "rad_s",
    "m/s": "m_s",
    "N m": "nm",
    "N": "n",
    "kg m^2": "kg_m2",
    "kg m": "kg_m",
    "ns/s": "ppb",
    "byte": "bytes",
}
"""Endings of column names, by unit."""
EVENTS_TABLE = "events"
"""Name of the table of events."""
SITE_TABLE_KINDS = ("state", "link", "arrivals")
"""Kinds of the tables of a site."""
_NONE_BELOW_0 = {"age_us", "delay_us", "delay_max_us", "rtt_us"}
"""Statistics in which -1 stands for a missing value."""
_JOINT_VECTORS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x")
"""Vectors of a record that have a number per joint, in joint space."""
_TASK_VECTORS = {
    **dict.fromkeys(("q_des", "x"), ("m", "rad")),
    **dict.fromkeys(("qd_des", "xd"), ("m/s", "rad/s")),
    "wrench": ("N", "N m"),
}
"""Vectors of a record that have a number per coordinate of the task, with the units of
positions and of orientations.
"""


_POSES = ("q_des", "x")
"""Vectors of `_TASK_VECTORS` with an orientation; the others have angular velocities or
torques.
"""
_STEADY_QUATERNION = "a unit quaternion w, x, y, z, each nearest to the one before"
"""Part of the meaning of orientation columns."""


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        name: name of the column, which ends in its unit.
        values: the values, shape (K,): numbers, or texts as objects.
        unit: unit of the values; "" for texts and counts.
        meaning: description of the values.
        source: field of the message from which the values come.
        known: True for the rows that have a value, shape (K,); None if all rows have a value.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    meaning: str = ""
    source: str = ""
    known: NDArray[np.bool_] | None = None

    @property
    def is_text(self) -> bool:
        """True if the values are texts."""
        return self.values.dtype == np.object_

    def numbers(self) -> NDArray[Any]:
        """Returns the values of a column of numbers, with NaN for missing values."""
        if self.known is None or self.known.all():
            return self.values
        return np.where(self.known, self.values, np.nan)

    def rows(self, first: int, last: int) -> list[Any]:
        """Returns the values of rows `first` to `last` - 1 as plain Python values.

        Missing values are None.
        """
        values: list[Any] = self.values[first:last].tolist()
        if self.known is None:
            return values
        known = self.known[first:last].tolist()
        return [
            value if is_known else None for value, is_known in zip(values, known, strict=True)
        ]


@dataclass(frozen=True)
class Table:
    """A table of columns with equal lengths.

    Attributes:
        name: name of the site, or "events".
        kind: kind of a site's table, one of `SITE_TABLE_KINDS`; else "".
        about: description of a row.
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
            KeyError: the table has no column of that name.
        """
        columns = {column.name: column for column in self.columns}
        if name not in columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(columns)}")
        return columns[name]

    @property
    def label(self) -> str:
        """Name of the table as the name of a file: "m1_link", "events"."""
        return f"{self.name}_{self.kind}" if self.kind else self.name


_FIELD = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
_UNITS_BY_NAME = {"t_ns": "ns", "sent_ns": "ns", "tick": "tick"}
_UNITS_BY_ENDING = {"ns": "ns", "us": "us", "ppb": "ns/s"}
_COMPLETE_TEXTS = {
    "qd_des": "derivative of the reference, Eq. (6)",
    "delay_max_us": (
        "per peer, largest one-way delay since the last statistics; -1 where nothing came"
    ),
    "late": "per peer, samples that came after they were due",
    "duplicate": "per peer, samples that came twice",
    "refused": "per peer, samples whose stamp was out of range",
    "lost": "per peer, samples that the link's model lost",
}
"""Meanings of fields whose text in the docstring refers to the field before."""


class FieldDoc(NamedTuple):
    """Documentation of a field of a message.

    Attributes:
        unit: unit of the field; "" without a unit.
        text: meaning of the field.
        kind: type of the field in JSON Schema.
    """

    unit: str
    text: str
    kind: str


@cache
def read_field_docs(kind: type[msgspec.Struct]) -> dict[str, FieldDoc]:
    """Returns the documentation of the fields of a message type, in order of definition."""
    texts = dict(_FIELD.findall(inspect.getdoc(kind) or ""))
    texts |= {name: _COMPLETE_TEXTS[name] for name in texts.keys() & _COMPLETE_TEXTS.keys()}
    properties: dict[str, dict[str, Any]] = json_schema(kind)["properties"]
    docs = {}
    for name, entry in properties.items():
        by_name = _UNITS_BY_NAME.get(name, _UNITS_BY_ENDING.get(name.rpartition("_")[2], ""))
        text = " ".join(texts.get(name, entry.get("description", "")).split()).rstrip(".")
        docs[name] = FieldDoc(entry.get("x-unit", by_name), text, entry["type"])
    return docs


def to_int_array(
    values: Iterable[int], source: str, field: str, kind: Any = np.int64
) -> NDArray[Any]:
    """Returns integers as an array.

    Args:
        values: the integers.
        source: name of the file, for the error.
        field: name of the field, for the error.
        kind: data type of the array.

    Raises:
        LogError: a number does not fit into the data type.
    """
    try:
        return np.fromiter(values, kind)
    except OverflowError:
        raise LogError(f"{source}: {field} has a number that is out of range") from None


def _make_time_columns(
    tick: Ints | None, t_s: NDArray[Any], log_ns: Ints, publish_ns: Ints
) -> Iterator[Column]:
    """Yields the columns of the nominal time, the tick, and the times of arrival and sending.

    Args:
        tick: ticks, shape (K,); None: no column of ticks.
        t_s: nominal times since the epoch, s, shape (K,); NaN: unknown.
        log_ns: times of arrival, Unix ns, shape (K,).
        publish_ns: times of sending, Unix ns, shape (K,).
    """
    known: NDArray[np.bool_] = ~np.isnan(t_s)
    yield Column(
        name="t_s",
        values=t_s,
        unit="s",
        meaning="nominal time since the session's epoch",
        source="t_ns",
        known=None if known.all() else known,
    )
    if tick is not None:
        yield Column(
            name="tick", values=tick, unit="tick", meaning="number of the tick", source="tick"
        )
    yield Column(
        name="log_time_ns",
        values=log_ns,
        unit="ns",
        meaning="when it came to the recorder, Unix time",
        source="log_time",
    )
    yield Column(
        name="publish_time_ns",
        values=publish_ns,
        unit="ns",
        meaning="when it was sent, Unix time",
        source="publish_time",
    )


def _make_vector_columns(site: SiteLog, arm: ArmModel) -> Iterator[Column]:
    docs = read_field_docs(State)
    task = _TASK_VECTORS if arm.shares_pose else {}
    for field in (*(name for name in _JOINT_VECTORS if name not in task), *task):
        if field in task:
            is_pose = field in _POSES and arm.counts.shared == POSE
            for n, axis in enumerate(TASK_AXES[: POSITION if is_pose else arm.counts.shared]):
                text = f"{docs[field].text}, along {axis}"
                yield _make_number_column(
                    site=site,
                    field=field,
                    n=n,
                    stem=f"{field}_{axis}",
                    unit=task[field][n >= POSITION],
                    text=text,
                )
            if is_pose:
                yield from _make_orientation_columns(site, field, docs[field].text)
            continue
        units = arm.joint_units(docs[field].unit)
        for n, (unit, joint) in enumerate(zip(units, arm.joint_names, strict=True)):
            text = f"{docs[field].text}, joint {n + 1}" + f", {joint}" * (arm.chain is not None)
            yield _make_number_column(
                site=site, field=field, n=n, stem=f"{field}{n + 1}", unit=unit, text=text
            )
    for n, (parameter, unit) in enumerate(arm.parameters):
        stem = f"theta_hat{n + 1}"
        text = f"{docs['theta_hat'].text}, parameter {n + 1}"
        if arm.chain is not None:
            link, _, symbol = parameter.rpartition(".")
            stem = f"theta_hat{1 + n // LINK_PARAMETERS}_{symbol}"
            text = f"estimate of {symbol} of link {link}, about the frame of its joint"
        yield _make_number_column(
            site=site, field="theta_hat", n=n, stem=stem, unit=unit, text=text
        )


def _make_orientation_columns(site: SiteLog, field: str, text: str) -> Iterator[Column]:
    """Yields the columns of the orientation of a pose, as a quaternion."""
    quaternions = compute_quaternions(getattr(site, field)[:, POSITION:])
    for name, values in zip(QUATERNION_AXES, quaternions.T, strict=True):
        meaning = f"{text}, {name[1]} of its orientation as {_STEADY_QUATERNION}"
        yield Column(
            name=f"{field}_{name}",
            values=np.ascontiguousarray(values),
            unit="",
            meaning=meaning,
            source=f"{field}[{POSITION}:{POSE}]",
        )


def _make_number_column(
    site: SiteLog,
    field: str,
    n: int,
    stem: str,
    unit: str,
    text: str,
    known: NDArray[np.bool_] | None = None,
) -> Column:
    """Returns the column of a number of a vector.

    Args:
        site: the records.
        field: name of the vector.
        n: index of the number in the vector.
        stem: name of the column without its unit.
        unit: unit of the number.
        text: meaning of the number.
        known: True for the rows that have a value, shape (K,); None if all rows have a value.
    """
    suffix = UNIT_SUFFIXES.get(unit, "")
    # a stem such as "base_m" already ends in the unit
    if suffix and stem != suffix and not stem.endswith(f"_{suffix}"):
        stem = f"{stem}_{suffix}"
    values = np.ascontiguousarray(getattr(site, field)[:, n])
    return Column(
        name=stem, values=values, unit=unit, meaning=text, source=f"{field}[{n}]", known=known
    )


def _make_sent_columns(site: SiteLog) -> Iterator[Column]:
    """Yields the columns of the numbers that the site's law sends."""
    for n, entry in enumerate(site.channel.entries(site.peers)):
        (name, unit, length, _) = entry.vector
        peer = entry.peer
        stem = f"ch_{name}" + f"_{peer}" * bool(peer) + f"_{entry.position + 1}" * (length > 1)
        suffix = UNIT_SUFFIXES.get(unit) or _to_word(unit).strip("_")
        text = (
            f"{name} that the law sends to {peer or 'all'}"
            + f", number {entry.position + 1}" * (length > 1)
        )
        values = np.ascontiguousarray(site.ch[:, n])
        yield Column(
            name=f"{stem}_{suffix}" if suffix else stem,
            values=values,
            unit=unit,
            meaning=text,
            source=f"ch.{entry}",
        )


def _make_hand_columns(site: SiteLog, arm: ArmModel, mode: str) -> Iterator[Column]:
    """Yields the columns of the action of a live hand."""
    held: NDArray[np.bool_] = site.hand[:, 2] > 0.0
    yield _make_number_column(
        site=site,
        field="hand",
        n=0,
        stem="hand_grip",
        unit="",
        text="how firmly the arm is held, 0 to 1",
    )
    meanings = {
        "number": "number of the newest message of who holds the arm",
        "source": "who holds the arm",
    }
    for n, (name, text) in enumerate(meanings.items(), 1):
        yield Column(
            name=f"hand_{name}",
            values=np.clip(site.hand[:, n], -1, 2**53).astype(np.int64),
            unit="",
            meaning=text,
            source=f"hand[{n}]",
            known=held,
        )
    names = arm.joint_names if mode == "joint" else TASK_AXES[:POSITION]
    units = {"tip": ("m", "m/s"), "joint": ("rad", "rad/s"), "force": ("N", "")}[mode]
    size = (site.layout.hand - 3) // 2
    quantity = "force" if mode == "force" else "target"
    for n in range(2 * size if quantity == "target" else size):
        stem, unit = (quantity, units[0]) if n < size else (f"{quantity}_rate", units[1])
        meaning = f"{stem.replace('_', ' ')} of the hand, {names[n % size]}"
        yield _make_number_column(
            site=site,
            field="hand",
            n=3 + n,
            stem=f"hand_{stem}_{names[n % size]}",
            unit=unit,
            text=meaning,
            known=held,
        )


def _make_bodies_columns(site: SiteLog, bodies: Iterable[str]) -> Iterator[Column]:
    """Yields the columns of the poses of the bodies of the site's plant."""
    for number, body in enumerate(bodies):
        first = (POSITION + len(QUATERNION_AXES)) * number
        for n, axis in enumerate("xyz", first):
            text = f"{axis} of the place of {body}, a body of its plant"
            yield _make_number_column(
                site=site, field="bodies", n=n, stem=f"{body}_{axis}", unit="m", text=text
            )
        first += POSITION
        quaternions = align_signs(site.bodies[:, first : first + len(QUATERNION_AXES)])
        for n, (name, values) in enumerate(
            zip(QUATERNION_AXES, quaternions.T, strict=True), first
        ):
            text = (
                f"orientation of {body}, a body of its plant, {name[1]} of {_STEADY_QUATERNION}"
            )
            yield Column(
                name=f"{body}_{name}",
                values=np.ascontiguousarray(values),
                unit="",
                meaning=text,
                source=f"bodies[{n}]",
            )


def build_state_table(site: SiteLog, scenario: Scenario) -> Table:
    """Returns the table of the records of a site, in order of their ticks."""
    docs = read_field_docs(State)
    arm = scenario.arms[site.name]
    live = scenario.sites[site.name].find_live_hand()
    columns = list(
        _make_time_columns(site.tick, site.t_s, site.log_time_ns, site.publish_time_ns)
    )
    columns.append(
        Column(name="mode", values=site.mode, unit="", meaning=docs["mode"].text, source="mode")
    )
    columns += _make_vector_columns(site, arm)
    columns += _make_sent_columns(site)
    columns += [] if live is None else _make_hand_columns(site, arm, live.mode)
    columns += _make_bodies_columns(site, scenario.bodies_m(site.name))
    for peer in site.peers:
        used = site.used[peer]
        rate_hz = scenario.sites[peer].rate_hz
        known: NDArray[np.bool_] = used >= 0
        age_ms = (site.t_ns - used * NS_PER_S // rate_hz) / 1e6
        source = f"used.{peer}"
        text = f"tick of the sample of {peer} in use"
        columns.append(
            Column(
                name=f"used_{peer}_tick",
                values=used,
                unit="tick",
                meaning=text,
                source=source,
                known=known,
            )
        )
        text = f"now minus the stamp of the sample of {peer} in use"
        columns.append(
            Column(
                name=f"age_{peer}_ms",
                values=age_ms,
                unit="ms",
                meaning=text,
                source=f"t_ns, {source}",
                known=known,
            )
        )
    for field in ("late_us", "busy_us", "sent_ns"):
        unit, text, _ = docs[field]
        columns.append(
            Column(
                name=field, values=site.numbers(field), unit=unit, meaning=text, source=field
            )
        )
    return Table(site.name, "state", f"a tick of {site.name}", tuple(columns))


def build_arrivals_table(site: SiteLog, source: str, *, live: bool) -> Table:
    """Returns the table of the samples that arrived at a site, in order of arrival.

    Args:
        site: the records.
        source: name of the file, for errors.
        live: whether the session was live, so that delays were measured.

    Raises:
        LogError: a record lists an arrival of a peer that the site does not have.
    """
    counts, entries = site.arrivals
    index = entries[:, 0]
    if ((index < 0) | (index >= len(site.peers))).any():
        raise LogError(
            f"{source}: a record of {site.name} lists an arrival of a peer "
            "that it does not have"
        )
    row = np.repeat(np.arange(len(site)), counts)
    names = np.array(site.peers, dtype=np.object_)[index]
    delay = "the age of its stamp; in virtual time every sample arrives at the next tick"
    if live:
        delay = "its one-way delay, by the offset of the clocks in force"
    columns = (
        *_make_time_columns(
            site.tick[row], site.t_s[row], site.log_time_ns[row], site.publish_time_ns[row]
        ),
        Column(
            name="peer", values=names, unit="", meaning="whose sample came", source="rx[][0]"
        ),
        Column(
            name="sample_tick",
            values=entries[:, 1].copy(),
            unit="tick",
            meaning="its tick, at the peer's rate",
            source="rx[][1]",
        ),
        Column(
            name="delay_us",
            values=entries[:, 2].copy(),
            unit="us",
            meaning=delay,
            source="rx[][2]",
        ),
    )
    return Table(
        site.name,
        "arrivals",
        f"a sample that {site.name} took in, by the tick that did",
        columns,
    )


def build_link_table(site: SiteLog, timed: TimedMessages[LinkStats], source: str) -> Table:
    """Returns the table of the statistics of a site, in order of their ticks."""
    stats = timed.messages
    tick = to_int_array((s.tick for s in stats), source, "tick")
    t_s = to_int_array((s.t_ns for s in stats), source, "t_ns") / NS_PER_S
    columns = list(_make_time_columns(tick, t_s, timed.log_ns, timed.publish_ns))
    for field, (unit, text, kind) in read_field_docs(LinkStats).items():
        if field in ("v", "site", "boot", "tick", "t_ns"):
            continue
        values = [getattr(s, field) for s in stats]
        if kind == "object":
            names: Iterable[str] = site.peers
            if field == "dropped":
                names = _list_reasons(values)
            columns += [_make_entry_column(source, field, name, values) for name in names]
        elif kind == "integer":
            columns.append(
                Column(
                    name=field,
                    values=to_int_array(values, source, field),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
        else:
            columns.append(
                Column(
                    name=field,
                    values=np.array(values, dtype=np.object_),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
    about = f"statistics of {site.name}'s loop and links, ten times a second"
    return Table(site.name, "link", about, tuple(columns))


def _list_reasons(dropped: Iterable[Mapping[str, int]]) -> list[str]:
    """Returns the reasons for which messages were dropped, one for each column name."""
    reasons: dict[str, str] = {}
    for counts in dropped:
        for reason in sorted(counts):
            reasons[_to_word(reason)] = reason
    return list(reasons.values())


def _to_word(text: str) -> str:
    """Returns a text as a part of a column name: small letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower())[:31]


def _make_entry_column(
    source: str, field: str, name: str, values: Sequence[Mapping[str, int]]
) -> Column:
    """Returns the column of one key of a field of the statistics that is a map.

    Args:
        source: name of the file, for errors.
        field: name of the field.
        name: the key: a peer, or a reason of `dropped`.
        values: the maps, a row each.
    """
    unit, text, _ = read_field_docs(LinkStats)[field]
    stem, _, ending = field.rpartition("_") if unit else (field, "", "count")
    # `dropped` has no entry for a reason for which no message was dropped
    absent = 0 if field == "dropped" else None
    numbers = [value.get(name, absent) for value in values]
    lowest = 0 if field in _NONE_BELOW_0 else -math.inf
    known = np.array([n is not None and n >= lowest for n in numbers], dtype=np.bool_)
    return Column(
        name=f"{stem}_{_to_word(name)}_{ending}",
        values=to_int_array((n or 0 for n in numbers), source, field),
        unit=unit,
        meaning=f"{name}: {text.removeprefix('per peer, ')}",
        source=f"{field}.{name}",
        known=None if known.all() else known,
    )


def build_events_table(timed: TimedMessages[Event], source: str) -> Table:
    """Returns the table of the events, in order of their arrival at the recorder."""
    events = timed.messages
    t_ns = to_int_array((event.t_ns for event in events), source, "t_ns")
    t_s = np.where(t_ns >= 0, t_ns / NS_PER_S, np.nan)
    columns = list(_make_time_columns(None, t_s, timed.log_ns, timed.publish_ns))
    for field, (unit, text, kind) in read_field_docs(Event).items():
        if field in ("v", "t_ns"):
            continue
        values = [getattr(event, field) for event in events]
        if kind == "integer":
            bits = np.uint64 if field == "boot" else np.int64
            columns.append(
                Column(
                    name=field,
                    values=to_int_array(values, source, field, bits),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
        else:
            columns.append(
                Column(
                    name=field,
                    values=np.array(list(map(_to_text, values)), dtype=np.object_),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
    return Table(EVENTS_TABLE, "", "something that happened once", tuple(columns))


def _to_text(value: str | Mapping[str, Any]) -> str:
    """Returns a field of an event as text; a map per member as JSON, "" if it is empty."""
    if isinstance(value, str):
        return value
    return json.dumps(value, sort_keys=True) if value else ""


def to_pandas_frame(table: Table) -> "pandas.DataFrame":
    """Returns a table as a pandas data frame.

    A missing value is None in a column of texts, and NaN in a column of numbers.

    Raises:
        UsageError: pandas is not installed.
    """
    values: dict[str, Any] = {}
    for column in table.columns:
        if column.is_text:
            values[column.name] = column.rows(0, len(column.values))
        else:
            values[column.name] = column.numbers()
    return import_extra("pandas", "frames", "data frames").DataFrame(values)


def to_data_frame(table: Table) -> "polars.DataFrame":
    """Returns a table as a polars data frame.

    Raises:
        UsageError: polars is not installed.
    """
    pl = import_extra("polars", "frames", "data frames")
    all_series = []
    for column in table.columns:
        if column.is_text:
            series = pl.Series(column.name, column.values.tolist(), pl.String)
        else:
            series = pl.Series(column.name, column.values, None)
        if column.known is not None:
            null = pl.Series([None], dtype=series.dtype)
            series = series.zip_with(pl.Series(column.known), null)
        all_series.append(series)
    return cast("polars.DataFrame", pl.DataFrame(all_series))
