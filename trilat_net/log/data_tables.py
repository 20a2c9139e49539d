"""Converts a log to tables that can be exported to CSV, Parquet and data frames.

There are four kinds of tables: the states of an arm (one row per tick), the states that it
received from other arms, the statistics of its network links, and the events of the run. For
example, the column `q1_rad` of the first kind is the angle of joint 1 in rad.

Invariant:
    - Every value is taken from the log, or follows exactly from values in the log (an age is a
      difference of two time stamps). The only exceptions are orientations, which are given as
      unit quaternions that do not jump (see `orientations`).
    - The name of a column ends in its unit. A missing value is null, never a number.
    - Units, names and meanings come from the message types and from the declarations of control
      laws, so nothing is described in two places.
    - A number out of range, or a state from an arm that the receiver does not follow, raises a
      `LogError` that names the file.
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

from ..core import LINK_PARAMETERS, POSE, POSITION
from ..errors import LogError
from ..files import Extra
from ..net import Event, LinkStats, State, json_schema
from ..records import NS_PER_S
from ..scenario import TASK_AXES, ArmModel, Scenario
from .orientations import QUATERNION_AXES, RotationVectors, align_signs
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
"""Maps each unit to the last part of a column's name."""
EVENTS_TABLE = "events"
"""Name of the table with the events."""
_FRAMES = Extra("frames", "data frames")
SITE_TABLE_KINDS = ("state", "link", "arrivals")
"""Kinds of tables available for each site."""
_NONE_BELOW_0 = {"age_us", "delay_us", "delay_max_us", "rtt_us"}
"""Fields of the statistics in which -1 represents a missing value."""
_JOINT_VECTORS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x")
"""Vectors of a record with one entry per joint, if the sites share joint positions."""
_TASK_VECTORS = {
    **dict.fromkeys(("q_des", "x"), ("m", "rad")),
    **dict.fromkeys(("qd_des", "xd"), ("m/s", "rad/s")),
    "wrench": ("N", "N m"),
}
"""Vectors of a record with one entry per coordinate of the end effector, if the sites share its
position or pose. The first unit is that of the three position coordinates, the second that of
the others.
"""


_POSES = ("q_des", "x")
"""Vectors in `_TASK_VECTORS` that contain an orientation. The others contain an angular
velocity or a torque.
"""
_STEADY_QUATERNION = "a unit quaternion w, x, y, z, with signs that avoid jumps"
"""Text that is part of the meaning of orientation columns."""


class Column(NamedTuple):
    """One column of a table exported from a log, with K rows.

    Attributes:
        name: Name of the column, which ends in its unit, such as "t_s".
        values: The values, shape (K,): numbers, or strings as objects.
        unit: Unit of the values. Empty for strings and counts.
        meaning: Description of the values for readers of the table.
        source: Message field that the values are taken from.
        known: True for the rows that have a value, shape (K,). None if all rows have one.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    meaning: str = ""
    source: str = ""
    known: NDArray[np.bool_] | None = None

    @property
    def stem(self) -> str:
        """Name of the column without its unit, such as "q1" for "q1_rad"."""
        suffix = UNIT_SUFFIXES.get(self.unit, "")
        return self.name.removesuffix(f"_{suffix}") if suffix else self.name

    @property
    def is_text(self) -> bool:
        """True if the column holds strings, False if it holds numbers."""
        return self.values.dtype == np.object_

    def numbers(self) -> NDArray[Any]:
        """Returns a numeric column as an array of shape (K,), with NaN for missing values.

        Used for export to formats that cannot represent missing values, such as NumPy files.
        """
        if self.known is None or self.known.all():
            return self.values
        return np.where(self.known, self.values, np.nan)

    def texts(self) -> NDArray[Any]:
        """Returns a string column as an array of NumPy strings, shape (K,).

        Array formats such as .npz store strings in this form.
        """
        return np.array(self.values.tolist(), dtype=np.str_)

    def rows(self, first: int, last: int) -> list[Any]:
        """Returns a slice of the column as plain Python values, as needed for CSV.

        Args:
            first: Index of the first row.
            last: Index after the last row.

        Returns:
            The values, with None for rows without a value.
        """
        values: list[Any] = self.values[first:last].tolist()
        if self.known is None:
            return values
        for index, is_known in enumerate(self.known[first:last].tolist()):
            if not is_known:
                values[index] = None
        return values


@dataclass(frozen=True)
class Table:
    """A table exported from a log, such as the joint angles of an arm over time.

    All columns have the same length.

    Attributes:
        name: Name of the site whose messages the table contains, or "events".
        kind: Kind of a site's table, one of `SITE_TABLE_KINDS`. Empty for other tables.
        about: Explains to readers of the table what one row contains.
        columns: The columns.
    """

    name: str
    kind: str
    about: str
    columns: tuple[Column, ...] = dataclasses.field(repr=False)

    def __len__(self) -> int:
        return len(self.columns[0].values) if self.columns else 0

    def __getitem__(self, name: str) -> Column:
        """Returns the column with a given name, as in `table["q1_rad"]`.

        Raises:
            KeyError: The table has no column of that name.
        """
        columns = {column.name: column for column in self.columns}
        if name not in columns:
            raise KeyError(f"there is no column {name!r}; the columns are {', '.join(columns)}")
        return columns[name]

    @property
    def label(self) -> str:
        """Name of the table for file names, such as "m1_link" for the links of site "m1".

        The label of a table that covers all sites, such as "events", does not name a site.
        """
        return f"{self.name}_{self.kind}" if self.kind else self.name

    def to_data_frame(self) -> "polars.DataFrame":
        """Converts the table to a polars data frame with the same columns.

        Missing values become null.

        Raises:
            UsageError: polars is not installed.
        """
        pl = _FRAMES.import_module("polars")
        all_series = []
        for column in self.columns:
            if column.is_text:
                series = pl.Series(column.name, column.values.tolist(), pl.String)
            else:
                series = pl.Series(column.name, column.values, None)
            if column.known is not None:
                null = pl.Series([None], dtype=series.dtype)
                series = series.zip_with(pl.Series(column.known), null)
            all_series.append(series)
        return cast("polars.DataFrame", pl.DataFrame(all_series))

    def to_pandas(self) -> "pandas.DataFrame":
        """Converts the table to a pandas data frame with the same columns.

        Missing values become None in string columns and NaN in numeric columns.

        Raises:
            UsageError: pandas is not installed.
        """
        values: dict[str, Any] = {}
        for column in self.columns:
            if column.is_text:
                values[column.name] = column.rows(0, len(column.values))
            else:
                values[column.name] = column.numbers()
        return _FRAMES.import_module("pandas").DataFrame(values)

    @classmethod
    def of_states(cls, site: SiteLog, scenario: Scenario) -> "Table":
        """Creates a table of an arm's angles, torques and other values, one row per tick.

        Args:
            site: Records of the site.
            scenario: Scenario of the session, which names the joints and parameters.

        Returns:
            The table, in tick order.
        """
        docs = read_field_docs(State)
        arm = scenario.arms[site.name]
        # The person or program that moves the arm, if there is one.
        live_operator = scenario.sites[site.name].find_live_hand()

        columns = list(
            _make_time_columns(site.tick, site.t_s, site.log_time_ns, site.publish_time_ns)
        )
        columns.append(
            Column(
                name="mode", values=site.mode, unit="", meaning=docs["mode"].text, source="mode"
            )
        )
        columns += _make_vector_columns(site, arm)
        columns += _make_sent_columns(site)
        if live_operator is not None:
            columns += _make_hand_columns(site, arm, live_operator.mode)
        columns += _make_bodies_columns(site, scenario.bodies_m(site.name))
        for peer in site.peers:
            columns += _make_sample_columns(site, peer, scenario.sites[peer].rate_hz)

        # The timing of the control loop.
        for field in ("late_us", "busy_us", "sent_ns"):
            unit, text, _ = docs[field]
            columns.append(
                Column(
                    name=field,
                    values=site.numbers(field),
                    unit=unit,
                    meaning=text,
                    source=field,
                )
            )
        return cls(site.name, "state", f"a tick of {site.name}", tuple(columns))

    @classmethod
    def of_arrivals(cls, site: SiteLog, source: str, *, live: bool) -> "Table":
        """Creates a table of the samples that a site received, with their delays.

        The table has one row per sample, in order of arrival.

        Args:
            site: Records of the receiving site, which list the arrivals.
            source: Name of the file for error messages.
            live: True if the session was live, in which case the delays were measured. In
                virtual time the delays are the ages of the samples.

        Raises:
            LogError: A record lists an arrival from a peer that the site does not have.
        """
        counts, entries = site.arrivals
        index = entries[:, 0]
        if ((index < 0) | (index >= len(site.peers))).any():
            raise LogError(
                f"{source}: a record of {site.name} lists a sample from a site that is not a "
                f"peer of {site.name}"
            )
        # Index of the record that contains each arrival.
        row = np.repeat(np.arange(len(site)), counts)
        names = np.array(site.peers, dtype=np.object_)[index]
        delay = "the age of its stamp; in virtual time every sample arrives at the next tick"
        if live:
            delay = "its one-way delay, computed with the clock offset in use"
        columns = (
            *_make_time_columns(
                site.tick[row], site.t_s[row], site.log_time_ns[row], site.publish_time_ns[row]
            ),
            Column(
                name="peer",
                values=names,
                unit="",
                meaning="peer that sent the sample",
                source="rx[][0]",
            ),
            Column(
                name="sample_tick",
                values=entries[:, 1].copy(),
                unit="tick",
                meaning="tick of the sample, at the peer's rate",
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
        return cls(
            site.name,
            "arrivals",
            f"a sample that {site.name} received, with the tick that took it in",
            columns,
        )

    @classmethod
    def of_link_stats(
        cls, site: SiteLog, timed: TimedMessages[LinkStats], source: str
    ) -> "Table":
        """Creates a table of a site's network link statistics, with one row per message.

        A field with one value per peer becomes one column per peer.

        Args:
            site: Records of the site.
            timed: The statistics messages, with their arrival and sending times.
            source: Name of the file for error messages.

        Returns:
            The table, in tick order.

        Raises:
            LogError: A number is out of range.
        """
        stats = timed.messages
        tick = _to_int_array((s.tick for s in stats), source, "tick")
        t_s = _to_int_array((s.t_ns for s in stats), source, "t_ns") / NS_PER_S
        columns = list(_make_time_columns(tick, t_s, timed.log_ns, timed.publish_ns))
        for field, (unit, text, kind) in read_field_docs(LinkStats).items():
            if field in ("v", "site", "boot", "tick", "t_ns"):
                continue  # the same in every row, or already a column
            fields = [getattr(s, field) for s in stats]
            if kind == "object":
                keys: Iterable[str] = site.peers
                if field == "dropped":  # counts by reason instead of by peer
                    keys = _list_reasons(fields)
                columns += [_make_entry_column(source, field, key, fields) for key in keys]
                continue

            values: NDArray[Any]
            if kind == "integer":
                values = _to_int_array(fields, source, field)
            else:
                values = np.array(fields, dtype=np.object_)
            columns.append(
                Column(name=field, values=values, unit=unit, meaning=text, source=field)
            )
        about = f"statistics of {site.name}'s loop and links, ten times a second"
        return cls(site.name, "link", about, tuple(columns))

    @classmethod
    def of_events(cls, timed: TimedMessages[Event], source: str) -> "Table":
        """Creates a table of the events of a session, with one row per event.

        An event is a message that reports an occurrence, such as a site joining the session.
        Rows are in the order in which the events arrived at the recorder.

        Args:
            timed: The events, with their sending and arrival times.
            source: Name of the file for error messages.

        Raises:
            LogError: An integer of an event does not fit in 64 bits.
        """
        events = timed.messages
        t_ns = _to_int_array((event.t_ns for event in events), source, "t_ns")
        # Events before the start of the session have the time -1.
        t_s = np.where(t_ns >= 0, t_ns / NS_PER_S, np.nan)
        columns = list(_make_time_columns(None, t_s, timed.log_ns, timed.publish_ns))
        for field, (unit, text, kind) in read_field_docs(Event).items():
            if field in ("v", "t_ns"):
                continue
            entries = [getattr(event, field) for event in events]
            values: NDArray[Any]
            if kind == "integer":
                # The boot, which identifies a start of a process, is a random 64-bit number.
                data_type = np.uint64 if field == "boot" else np.int64
                values = _to_int_array(entries, source, field, data_type)
            else:
                texts = [_to_text(entry) for entry in entries]
                values = np.array(texts, dtype=np.object_)
            columns.append(
                Column(name=field, values=values, unit=unit, meaning=text, source=field)
            )
        return cls(EVENTS_TABLE, "", "an event of the session", tuple(columns))


# An entry of the section "Attributes:" in a docstring: name of the field and its meaning.
_FIELD = re.compile(r"^ {4}(\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)
# Units of fields for which the schema states no unit.
_UNITS_BY_NAME = {"t_ns": "ns", "sent_ns": "ns", "tick": "tick"}
_UNITS_BY_ENDING = {"ns": "ns", "us": "us", "ppb": "ns/s"}
_COMPLETE_TEXTS = {
    "qd_des": "derivative of the reference, Eq. (6)",
    "delay_max_us": (
        "per peer, largest one-way delay since the last statistics; -1 if none arrived"
    ),
    "offset_us": "per peer, its clock minus this site's clock, as currently used",
    "late": "per peer, samples that arrived after they were due",
    "duplicate": "per peer, samples that arrived twice",
    "refused": "per peer, samples whose stamp was out of range",
    "lost": "per peer, samples lost by the link's model",
}
"""Meanings of fields whose description in the docstring cannot be understood on its own."""


class _FieldDoc(NamedTuple):
    """Unit, meaning and type of one field of a message, for the header of an exported table.

    Attributes:
        unit: Unit of the field. Empty if it has no unit.
        text: Meaning of the field.
        kind: Type of the field in JSON Schema, such as "number".
    """

    unit: str
    text: str
    kind: str


@cache
def read_field_docs(kind: type[msgspec.Struct]) -> dict[str, _FieldDoc]:
    """Collects the documentation of the fields of a message type.

    The meanings come from the docstring of the type, and the units from its JSON Schema.

    Args:
        kind: Type of the messages, such as `State`.

    Returns:
        Maps the name of each field to its documentation, in order of definition.
    """
    docstring = inspect.getdoc(kind) or ""
    texts = dict(_FIELD.findall(docstring))
    for name in texts.keys() & _COMPLETE_TEXTS.keys():
        texts[name] = _COMPLETE_TEXTS[name]

    properties: dict[str, dict[str, Any]] = json_schema(kind)["properties"]
    docs = {}
    for name, entry in properties.items():
        ending = name.rpartition("_")[2]  # "us" of "late_us"
        unit_by_ending = _UNITS_BY_ENDING.get(ending, "")
        default_unit = _UNITS_BY_NAME.get(name, unit_by_ending)
        text = texts.get(name, entry.get("description", ""))
        one_line = " ".join(text.split()).rstrip(".")
        docs[name] = _FieldDoc(
            unit=entry.get("x-unit", default_unit), text=one_line, kind=entry["type"]
        )
    return docs


def _to_int_array(
    values: Iterable[int], source: str, field: str, kind: Any = np.int64
) -> NDArray[Any]:
    """Converts integers of a log to an array, rejecting those that do not fit.

    Args:
        values: The integers.
        source: Name of the log for the error message.
        field: Name of the field that contains the integers, for the error message.
        kind: Data type of the array.

    Returns:
        The array, shape (K,) for K integers.

    Raises:
        LogError: An integer does not fit into the data type.
    """
    try:
        return np.fromiter(values, kind)
    except OverflowError:
        raise LogError(f"{source}: {field} has a number that is out of range") from None


def _make_time_columns(
    tick: Ints | None, t_s: NDArray[Any], log_ns: Ints, publish_ns: Ints
) -> Iterator[Column]:
    """Yields the first columns of a table: nominal time, tick, arrival and sending times.

    Args:
        tick: Ticks, shape (K,). None if the table has no tick column.
        t_s: Nominal times since the start of the session, shape (K,), in s. NaN if unknown.
        log_ns: Arrival times at the recorder in Unix time, shape (K,), in ns.
        publish_ns: Sending times in Unix time, shape (K,), in ns.
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
            name="tick", values=tick, unit="tick", meaning="tick number", source="tick"
        )
    yield Column(
        name="log_time_ns",
        values=log_ns,
        unit="ns",
        meaning="time of arrival at the recorder, Unix time",
        source="log_time",
    )
    yield Column(
        name="publish_time_ns",
        values=publish_ns,
        unit="ns",
        meaning="time of sending, Unix time",
        source="publish_time",
    )


def _make_vector_columns(site: SiteLog, arm: ArmModel) -> Iterator[Column]:
    """Yields the columns of the vectors in an arm's records, such as joint angles and torques.

    Each vector has one entry per joint, per coordinate of the end effector, or per parameter of
    the dynamics. If the arms share the pose of the end effector instead of joint angles, the
    reference and its velocity are vectors of the end effector.

    Args:
        site: Records of the arm.
        arm: Model of the arm.
    """
    end_effector_vectors = _TASK_VECTORS if arm.shares_pose else {}
    for field in _JOINT_VECTORS:
        if field not in end_effector_vectors:
            yield from _make_joint_columns(site, arm, field)
    for field, units in end_effector_vectors.items():
        yield from _make_task_columns(site, arm, field, units)
    yield from _make_parameter_columns(site, arm)


def _make_joint_columns(site: SiteLog, arm: ArmModel, field: str) -> Iterator[Column]:
    """Yields the columns of a vector that has one entry per joint."""
    doc = read_field_docs(State)[field]
    units = arm.joint_units(doc.unit)
    for n, (unit, joint) in enumerate(zip(units, arm.joint_names, strict=True)):
        text = f"{doc.text}, joint {n + 1}"
        if arm.chain is not None:
            text += f", {joint}"
        yield _make_number_column(
            site=site, field=field, n=n, stem=f"{field}{n + 1}", unit=unit, text=text
        )


def _make_task_columns(
    site: SiteLog, arm: ArmModel, field: str, units: tuple[str, str]
) -> Iterator[Column]:
    """Yields the columns of a vector with one entry per coordinate of the end effector.

    An example is the position x, y and z.

    Args:
        site: Records of the site.
        arm: Model of the site's arm.
        field: Name of the vector.
        units: Units of the position coordinates and of the other coordinates.
    """
    text = read_field_docs(State)[field].text
    has_orientation = field in _POSES and arm.counts.shared == POSE
    count = POSITION if has_orientation else arm.counts.shared
    position_unit, other_unit = units
    for n, axis in enumerate(TASK_AXES[:count]):
        yield _make_number_column(
            site=site,
            field=field,
            n=n,
            stem=f"{field}_{axis}",
            unit=position_unit if n < POSITION else other_unit,
            text=f"{text}, along {axis}",
        )
    if has_orientation:
        yield from _make_orientation_columns(site, field, text)


def _make_parameter_columns(site: SiteLog, arm: ArmModel) -> Iterator[Column]:
    """Yields the columns of the estimated parameters of the arm's dynamics.

    The parameters of the two-link arm of the paper are numbered, as in theta_hat3. A chain of
    joints has the same parameters for each link, such as theta_hat2_m, the mass of the second
    link.
    """
    doc = read_field_docs(State)["theta_hat"]
    for n, (parameter, unit) in enumerate(arm.parameters):
        is_two_link_arm = arm.chain is None
        if is_two_link_arm:
            stem = f"theta_hat{n + 1}"
            text = f"{doc.text}, parameter {n + 1}"
        else:
            link_name, _, symbol = parameter.rpartition(".")
            link_number = 1 + n // LINK_PARAMETERS
            stem = f"theta_hat{link_number}_{symbol}"
            text = f"estimate of {symbol} of link {link_name}, about the frame of its joint"
        yield _make_number_column(
            site=site, field="theta_hat", n=n, stem=stem, unit=unit, text=text
        )


def _make_orientation_columns(site: SiteLog, field: str, text: str) -> Iterator[Column]:
    """Yields the four columns of an orientation, given as a unit quaternion.

    Args:
        site: Records of the site.
        field: Name of the vector that contains the poses.
        text: Meaning of the vector.
    """
    orientations = RotationVectors(getattr(site, field)[:, POSITION:])
    quaternions = orientations.as_quaternions()
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
    """Returns a table column with one entry of a vector, for example joint 1 of "q".

    Args:
        site: Records of the site.
        field: Name of the vector.
        n: Index of the entry in the vector.
        stem: Name of the column without its unit.
        unit: Unit of the entry.
        text: Meaning of the entry.
        known: True for the rows that have a value, shape (K,). None if all rows have one.
    """
    suffix = UNIT_SUFFIXES.get(unit, "")
    # A stem such as "base_m" ends in the unit already.
    if suffix and stem != suffix and not stem.endswith(f"_{suffix}"):
        stem = f"{stem}_{suffix}"
    values = np.ascontiguousarray(getattr(site, field)[:, n])
    return Column(
        name=stem, values=values, unit=unit, meaning=text, source=f"{field}[{n}]", known=known
    )


def _make_sent_columns(site: SiteLog) -> Iterator[Column]:
    """Yields the columns of the vectors that a site's control law sends to other sites.

    Their names begin with "ch_". For example, "ch_force_m1_nm" is a torque that is sent to m1.
    """
    for n, entry in enumerate(site.channel.entries(site.peers)):
        (name, unit, length, _) = entry.vector
        # The text names the receiver and the element, if there are several receivers or
        # elements.
        stem = f"ch_{name}"
        if entry.peer:
            stem += f"_{entry.peer}"
        text = f"{name} that the law sends to {entry.peer or 'all'}"
        if length > 1:
            stem += f"_{entry.position + 1}"
            text += f", number {entry.position + 1}"
        suffix = UNIT_SUFFIXES.get(unit) or _to_word(unit).strip("_")
        values = np.ascontiguousarray(site.ch[:, n])
        yield Column(
            name=f"{stem}_{suffix}" if suffix else stem,
            values=values,
            unit=unit,
            meaning=text,
            source=f"ch.{entry}",
        )


def _make_hand_columns(site: SiteLog, arm: ArmModel, mode: str) -> Iterator[Column]:
    """Yields the columns about the operator, a person or program that moves the arm.

    Args:
        site: Records of the site.
        arm: Model of the site's arm.
        mode: How the operator moves the arm: to a target for the tip ("tip") or for the joints
            ("joint"), or by a force ("force").
    """
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
        "number": "number of the newest message from the operator who holds the arm",
        "source": "number that identifies the operator who holds the arm",
    }
    for n, (name, text) in enumerate(meanings.items(), 1):
        yield Column(
            name=f"hand_{name}",
            # Floating-point numbers represent integers exactly up to 2^53.
            values=np.clip(site.hand[:, n], -1, 2**53).astype(np.int64),
            unit="",
            meaning=text,
            source=f"hand[{n}]",
            known=held,
        )

    # The next numbers are the target and its rate of change, or only the force.
    axes = arm.joint_names if mode == "joint" else TASK_AXES[:POSITION]
    units = {"tip": ("m", "m/s"), "joint": ("rad", "rad/s"), "force": ("N", "")}[mode]
    size = (site.layout.hand - 3) // 2
    quantities = ["force"] if mode == "force" else ["target", "target_rate"]
    for row, quantity in enumerate(quantities):
        for n in range(size):
            yield _make_number_column(
                site=site,
                field="hand",
                n=3 + row * size + n,
                stem=f"hand_{quantity}_{axes[n]}",
                unit=units[row],
                text=f"{quantity.replace('_', ' ')} of the hand, {axes[n]}",
                known=held,
            )


def _make_bodies_columns(site: SiteLog, bodies: Iterable[str]) -> Iterator[Column]:
    """Yields the columns of the poses of the bodies in the site's simulated environment.

    For each body, a record contains a pose of seven numbers: the position (x, y, z) in m, and
    the orientation as a unit quaternion (w, x, y, z). A quaternion and its negative represent
    the same orientation. Signs are chosen such that the curves of the four components do not
    jump.

    Args:
        site: Records of the site.
        bodies: Names of the bodies, in record order.

    Yields:
        Seven columns per body, such as "cup_x_m" and "cup_qw", with one row per record.
    """
    pose_length = POSITION + len(QUATERNION_AXES)
    for body_index, body in enumerate(bodies):
        position_start = pose_length * body_index
        for index, axis in enumerate("xyz", position_start):
            text = f"{axis} position of {body}, a body of its plant"
            yield _make_number_column(
                site=site, field="bodies", n=index, stem=f"{body}_{axis}", unit="m", text=text
            )

        quaternion_start = position_start + POSITION
        quaternion_end = quaternion_start + len(QUATERNION_AXES)
        quaternions = align_signs(site.bodies[:, quaternion_start:quaternion_end])
        components = zip(QUATERNION_AXES, quaternions.T, strict=True)
        for index, (name, values) in enumerate(components, quaternion_start):
            component = name[1]  # "w" of "qw"
            text = (
                f"orientation of {body}, a body of its plant, {component} of "
                f"{_STEADY_QUATERNION}"
            )
            yield Column(
                name=f"{body}_{name}",
                values=np.ascontiguousarray(values),
                unit="",
                meaning=text,
                source=f"bodies[{index}]",
            )


def _make_sample_columns(site: SiteLog, peer: str, rate_hz: int) -> Iterator[Column]:
    """Yields the columns for the sample of a peer that the control law used, and its age.

    The age is the total delay that the control law sees.

    Args:
        site: Records of the receiving site.
        peer: Name of the peer.
        rate_hz: Tick rate of the peer, in Hz.
    """
    used_ticks = site.used[peer]
    known: NDArray[np.bool_] = used_ticks >= 0  # -1 before the first sample
    source = f"used.{peer}"
    yield Column(
        name=f"used_{peer}_tick",
        values=used_ticks,
        unit="tick",
        meaning=f"tick of the sample from {peer} in use",
        source=source,
        known=known,
    )
    yield Column(
        name=f"age_{peer}_ms",
        values=site.age_ns(peer, rate_hz) / 1e6,
        unit="ms",
        meaning=f"time since the stamp of the sample from {peer} in use",
        source=f"t_ns, {source}",
        known=known,
    )


def _list_reasons(dropped: Iterable[Mapping[str, int]]) -> list[str]:
    """Returns the reasons why messages were dropped, each of which becomes a column.

    The reasons are in the order in which they first occur. Reasons that result in the same
    column name are listed once.

    Args:
        dropped: For each statistics message, maps reasons to the number of dropped messages.
    """
    reason_by_column: dict[str, str] = {}
    for counts in dropped:
        for reason in sorted(counts):
            reason_by_column[_to_word(reason)] = reason
    return list(reason_by_column.values())


def _to_word(text: str) -> str:
    """Converts a string to part of a column name: lowercase letters, digits and underscores."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower())[:31]


def _make_entry_column(
    source: str, field: str, name: str, values: Sequence[Mapping[str, int]]
) -> Column:
    """Creates the column for one entry of a statistics field whose values are mappings.

    For example, the field `delay_us` maps each peer to a delay. Its entry for the peer m2
    becomes the column delay_m2_us. A field without a unit is a count: the entry m2 of
    `accepted` becomes accepted_m2_count.

    Args:
        source: Name of the file for error messages.
        field: Name of the field of the statistics.
        name: Key of the entry: a peer, or a reason why messages were dropped.
        values: The mappings, one per row.

    Returns:
        The column. A value is unknown if the mapping has no such entry, or if the entry is -1
        in a field where -1 represents a missing value.
    """
    unit, meaning_of_field, _ = read_field_docs(LinkStats)[field]
    stem = field
    ending = "count"
    if unit:
        stem, _, ending = field.rpartition("_")  # the ending is the unit, such as "us"
    # `dropped` has no entry for a reason if no message was dropped for that reason.
    absent = 0 if field == "dropped" else None
    numbers = [value.get(name, absent) for value in values]
    lowest_known = 0 if field in _NONE_BELOW_0 else -math.inf
    known = np.array(
        [number is not None and number >= lowest_known for number in numbers], dtype=np.bool_
    )
    # The documentation of a field describes all peers. The column belongs to one peer.
    meaning = meaning_of_field.removeprefix("per peer, ")
    return Column(
        name=f"{stem}_{_to_word(name)}_{ending}",
        values=_to_int_array((number or 0 for number in numbers), source, field),
        unit=unit,
        meaning=f"{name}: {meaning}",
        source=f"{field}.{name}",
        known=None if known.all() else known,
    )


def _to_text(value: str | Mapping[str, Any]) -> str:
    """Converts a field of an event to the string in a table cell.

    A dictionary becomes JSON, but an empty dictionary becomes the empty string.
    """
    if isinstance(value, str):
        return value
    return json.dumps(value, sort_keys=True) if value else ""
