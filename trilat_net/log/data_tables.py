"""A log as data tables: a row per record, arrival, statistics message or event.

Invariant:
- Every number is the record's own, or follows from it exactly (an age is a difference of
  stamps), except that an orientation is a unit quaternion whose sign continues from row to row:
  the record's rotation vector jumps where it passes half a turn (see `orientations`). The
  column's meaning says so.
- A column's name ends in its unit; a missing value is null, never a number in its place.
- Units come from the schema, meanings from the docstrings of the message types, and of what a
  law sends from its declaration: there is no second list.
- A number out of range, or an arrival of a peer that a site does not have, is a `LogError` that
  names the file (`source`).
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
"""Units as the endings of names."""
EVENTS_TABLE = "events"
SITE_TABLE_KINDS = ("state", "link", "arrivals")
"""Tables of a site."""
_NONE_BELOW_0 = {"age_us", "delay_us", "delay_max_us", "rtt_us"}
"""Statistics in which -1 stands for none."""
_JOINT_VECTORS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x")
"""Vectors of a record with a number per joint, in joint space."""
_TASK_VECTORS = {
    **dict.fromkeys(("q_des", "x"), ("m", "rad")),
    **dict.fromkeys(("qd_des", "xd"), ("m/s", "rad/s")),
    "wrench": ("N", "N m"),
}
"""Those with a number per coordinate of the task: units of places and of orientations."""


_POSES = ("q_des", "x")
"""Those of them that have an orientation; the others have angular velocities and torques."""
_STEADY_QUATERNION = "a unit quaternion w, x, y, z, each nearest to the one before"


class Column(NamedTuple):
    """One column.

    Attributes:
        name: its name, with the unit at its end.
        values: its values, shape (K,): numbers, or texts as objects.
        unit, meaning: their unit ("" for texts and counts), and what they are.
        source: the field of the message that they are from.
        known: True for rows that have a value, shape (K,); None if all have.
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
        """Returns the values of a column of numbers, with NaN for those that are missing."""
        if self.known is None or self.known.all():
            return self.values
        return np.where(self.known, self.values, np.nan)

    def rows(self, first: int, last: int) -> list[Any]:
        """Returns the values of some rows as Python's own numbers and texts, None for missing
        ones.
        """
        values: list[Any] = self.values[first:last].tolist()
        if self.known is None:
            return values
        known = self.known[first:last].tolist()
        return [value if there else None for value, there in zip(values, known, strict=True)]


@dataclass(frozen=True)
class Table:
    """Columns of one length.

    Attributes:
        name: the site, or "events".
        kind: of a site, one of `SITE_TABLE_KINDS`; else "".
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
        columns = {column.name: column for column in self.columns}
        if name not in columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(columns)}")
        return columns[name]

    @property
    def label(self) -> str:
        """Its name as that of a file: "m1_link", "events"."""
        return f"{self.name}_{self.kind}" if self.kind else self.name


_FIELD = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
_UNITS_BY_NAME = {"t_ns": "ns", "sent_ns": "ns", "tick": "tick"}
_UNITS_BY_ENDING = {"ns": "ns", "us": "us", "ppb": "ns/s"}
_COMPLETE_TEXTS = {
    "qd_des": "derivative of the reference, Eq. (6)",
    "delay_max_us": "per peer, largest one-way delay since the last statistics; -1 where nothing came",
    "late": "per peer, samples that came after they were due",
    "duplicate": "per peer, samples that came twice",
    "refused": "per peer, samples whose stamp was out of range",
    "lost": "per peer, samples that the link's model lost",
}
"""Meanings of fields whose docstring continues the line before."""


class FieldDoc(NamedTuple):
    """Documentation of a field: its unit ("" for none), its meaning, and its type in JSON
    Schema.
    """

    unit: str
    text: str
    kind: str


@cache
def read_field_docs(kind: type[msgspec.Struct]) -> dict[str, FieldDoc]:
    """Returns the documentation of every field of a message type, in the order of its
    definition.
    """
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
    """Returns whole numbers as an array of type `kind`."""
    try:
        return np.fromiter(values, kind)
    except OverflowError:
        raise LogError(f"{source}: {field} has a number that is out of range") from None


def _make_time_columns(
    tick: Ints | None, t_s: NDArray[Any], log_ns: Ints, publish_ns: Ints
) -> Iterator[Column]:
    known: NDArray[np.bool_] = ~np.isnan(t_s)
    about = "nominal time since the session's epoch"
    yield Column(
        name="t_s",
        values=t_s,
        unit="s",
        meaning=about,
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
    """Yields the orientation of a pose as a quaternion; its source is the record's rotation
    vector.
    """
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
    suffix = UNIT_SUFFIXES.get(unit, "")
    # else it is named already
    if suffix and stem != suffix and not stem.endswith(f"_{suffix}"):
        stem = f"{stem}_{suffix}"
    values = np.ascontiguousarray(getattr(site, field)[:, n])
    return Column(
        name=stem, values=values, unit=unit, meaning=text, source=f"{field}[{n}]", known=known
    )


def _make_sent_columns(site: SiteLog) -> Iterator[Column]:
    for n, entry in enumerate(site.channel.entries(site.peers)):
        (name, unit, length, _) = entry.vector
        peer = entry.peer
        stem = f"ch_{name}" + f"_{peer}" * bool(peer) + f"_{entry.place + 1}" * (length > 1)
        suffix = UNIT_SUFFIXES.get(unit) or _to_word(unit).strip("_")
        text = (
            f"{name} that the law sends to {peer or 'all'}"
            + f", number {entry.place + 1}" * (length > 1)
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
    """Yields what somebody who holds the arm does, a column per number."""
    held: NDArray[np.bool_] = site.hand[:, 2] > 0.0
    yield _make_number_column(
        site=site,
        field="hand",
        n=0,
        stem="hand_grip",
        unit="",
        text="how firmly the arm is held, 0 to 1",
    )
    whose = {
        "number": "number of the newest message of who holds the arm",
        "source": "who holds the arm",
    }
    for n, (name, text) in enumerate(whose.items(), 1):
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
    what = "force" if mode == "force" else "target"
    for n in range(2 * size if what == "target" else size):
        stem, unit = (what, units[0]) if n < size else (f"{what}_rate", units[1])
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
    """Returns the records of a site, a row each, in order of their ticks."""
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
    """Returns the samples that came to a site, a row each, in the order in which it accepted
    them.
    """
    counts, entries = site.arrivals
    index = entries[:, 0]
    if ((index < 0) | (index >= len(site.peers))).any():
        raise LogError(
            f"{source}: a record of {site.name} lists an arrival of a peer that it does not have"
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
    """Returns the statistics of a site's loop and links, a row each, in order of their ticks."""
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
            if field == "dropped":  # by reason, one per column name
                names = {
                    _to_word(reason): reason for value in values for reason in sorted(value)
                }.values()
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


def _to_word(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower())[:31]


def _make_entry_column(
    source: str, field: str, name: str, values: Sequence[Mapping[str, int]]
) -> Column:
    unit, text, _ = read_field_docs(LinkStats)[field]
    stem, _, ending = field.rpartition("_") if unit else (field, "", "count")
    # a reason for which no message was dropped is not named
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
    """Returns the events, a row each, in the order in which they came to the recorder."""
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
        else:  # a map per member as JSON
            texts = [
                v if isinstance(v, str) else json.dumps(v, sort_keys=True) if v else ""
                for v in values
            ]
            columns.append(
                Column(
                    name=field,
                    values=np.array(texts, dtype=np.object_),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
    return Table(EVENTS_TABLE, "", "something that happened once", tuple(columns))


def to_pandas_frame(table: Table) -> "pandas.DataFrame":
    """Returns a table as a pandas data frame; what is missing is None among texts, NaN among
    numbers.

    Raises:
        UsageError: pandas is not installed.
    """
    columns = {
        c.name: c.rows(0, len(c.values)) if c.is_text else c.numbers() for c in table.columns
    }
    return import_extra("pandas", "frames", "data frames").DataFrame(columns)


def to_data_frame(table: Table) -> "polars.DataFrame":
    """Returns a table as a polars data frame.

    Raises:
        UsageError: polars is not installed.
    """
    pl = import_extra("polars", "frames", "data frames")
    series = []
    for column in table.columns:
        text = column.is_text
        one = pl.Series(
            column.name,
            column.values.tolist() if text else column.values,
            pl.String if text else None,
        )
        if column.known is not None:
            one = one.zip_with(pl.Series(column.known), pl.Series([None], dtype=one.dtype))
        series.append(one)
    return cast("polars.DataFrame", pl.DataFrame(series))
