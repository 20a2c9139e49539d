"""Export of a log for other tools: a ROS 2 bag, a folder of CSV or Parquet files, or a NumPy or MATLAB file.

A bag has standard messages at full rate, in an MCAP file of profile `ros2`.

Invariant: a number read back is the same, bit for bit. An export describes itself: unit, meaning and source
of every column, and its session. What can be refused is refused before anything is read or written. A bag has
every record once, with its numbers and times; nothing is decimated. A header's stamp is the nominal time of
its tick, the publish time the time of sending, the log time the time of arrival.
"""

import csv
import heapq
import io
import json
from collections.abc import Callable, Iterable, Iterator
from enum import StrEnum
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.ticks import NS_PER_S
from ..errors import UsageError
from ..files import import_extra, refuse_existing, stage_output
from ..log.data_tables import Column, Table, to_data_frame
from ..log.log_layout import SCENARIO, collect_provenance
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..log.mcap_writer import McapWriter
from ..log.ros2 import cdr
from ..log.ros2.cdr import pack_string
from ..log.ros2.ros2_messages import (
    FRAMES,
    ROBOT,
    ROBOT_CHANNELS,
    SESSION_CHANNELS,
    Ros2Channel,
    Ros2SiteChannels,
    pack_event,
    stack_signals,
)

EXPORT_MANIFEST = "about.json"
"""File of an exported folder; it distinguishes such a folder from any other."""
_ROWS = 4096
"""Rows that are converted to text together."""
_EXACT = 2**53
"""Largest integer up to which all are exact as floats, the numbers of MATLAB."""
_KEYWORDS = {
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global",
    "if", "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
}  # fmt: skip
"""Reserved words of MATLAB."""

SOURCE_METADATA = "trilat.source"
"""Metadata of the file: its session."""
_QOS = """\
- history: 1
  depth: 10
  reliability: 1
  durability: 2
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
"""Reliable, volatile, the last ten: the default of publishers in ROS 2."""
_TF = "/tf"
"""The frames of all sites, where tools look for them."""
_EVERY = 1000
"""Records between two reports of progress."""

_Written = Callable[[int], None]
"""Called with the number of records just written."""


class ExportFormat(StrEnum):
    """A format of exports."""

    ROS2 = "ros2"
    PARQUET = "parquet"
    CSV = "csv"
    NPZ = "npz"
    MAT = "mat"


_EXTRAS = {
    ExportFormat.PARQUET: ("polars", "frames", "Parquet files"),
    ExportFormat.MAT: ("scipy.io", "mat", "MAT files"),
}


class Exporter:
    """An export to a file, or to a folder of CSV or Parquet files, which is refused before a log is read.

    Raises:
        UsageError: the place is taken and `force` is false, or a package is missing.
    """

    def __init__(self, form: ExportFormat, path: Path, *, force: bool = False) -> None:
        self._form, self._path, self._force = form, path, force
        self._manifest = EXPORT_MANIFEST if form in (ExportFormat.CSV, ExportFormat.PARQUET) else None
        refuse_existing(path, force=force, manifest=self._manifest)
        if form in _EXTRAS:
            import_extra(*_EXTRAS[form])

    def export(self, log: Log, progress: Progress = lambda _done, _total: None) -> None:
        """Exports a log; `progress` is called with the number of records that are written, and of all.

        Raises:
            LogError: a record cannot be read.
            LogRefused: the disk is full.
            UsageError: the place cannot be written to.
        """
        total = sum(len(log[site]) for site in log.sites)
        done = 0

        def written(records: int) -> None:
            nonlocal done
            done += records
            progress(done, total)

        with stage_output(self._path, force=self._force, manifest=self._manifest) as path:
            _WRITERS[self._form](log, path, written)


def default_export_path(form: ExportFormat, first: Path) -> Path:
    """Returns the default path of an export: next to the log, or its first part, and named after it."""
    name = first.name.removesuffix(".active").removesuffix(".mcap")
    ending = {ExportFormat.NPZ: ".npz", ExportFormat.MAT: ".mat", ExportFormat.ROS2: "-ros2.mcap"}
    return first.with_name(name + ending.get(form, f"-{form}"))


def _store_tables(
    log: Log, written: _Written, place: Callable[[Table], str], store: Callable[[Table, str], Any]
) -> str:
    """Stores every table at its place, and returns the description of the export as JSON."""
    tables = {}
    for table in log.tables():
        where = place(table)
        store(table, where)
        columns = {c.name: {"unit": c.unit, "meaning": c.meaning, "source": c.source} for c in table.columns}
        tables[where] = {"row": table.about, "rows": len(table), "columns": columns}
        written(len(table) if table.kind == "state" else 0)
    facts = {
        "exported_by": f"trilat-net {collect_provenance()['version_trilat-net']}",
        "session": log.session,
        "complete": log.complete,
        "records_missing": {site: log.missing(site) for site in log.sites},
        "no_value": "an empty field in CSV, null in Parquet, NaN in NPZ and MAT",
        "tables": tables,
    }
    return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


def _write_csv(log: Log, folder: Path, written: _Written) -> None:
    """Writes CSV files: a line of names, then a row per line, numbers as Python shows them."""

    def store(table: Table, name: str) -> None:
        with (folder / name).open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(column.name for column in table.columns)
            for first in range(0, len(table), _ROWS):
                columns = (column.rows(first, first + _ROWS) for column in table.columns)
                writer.writerows(zip(*columns, strict=True))

    _describe_folder(log, folder, _store_tables(log, written, lambda table: f"{table.label}.csv", store))


def _write_parquet(log: Log, folder: Path, written: _Written) -> None:
    def store(table: Table, name: str) -> None:
        made = io.BytesIO()  # a full disk is reported here, not by polars
        to_data_frame(table).write_parquet(made, compression="zstd")
        (folder / name).write_bytes(made.getbuffer())

    _describe_folder(log, folder, _store_tables(log, written, lambda table: f"{table.label}.parquet", store))


def _describe_folder(log: Log, folder: Path, about: str) -> None:
    (folder / EXPORT_MANIFEST).write_text(about, encoding="utf-8")
    (folder / SCENARIO).write_bytes(log.scenario_text.encode())


def _place(table: Table, name: str, separator: str) -> str:
    return name if table.kind in ("", "state") else f"{name}{separator}{table.kind}"


def _write_npz(log: Log, path: Path, written: _Written) -> None:
    """Writes arrays "m1/q1_rad", "m1/link/age_s_us", "events/text", and two texts."""
    arrays: dict[str, NDArray[Any]] = {}

    def store(table: Table, place: str) -> None:
        for column in table.columns:
            arrays[f"{place}/{column.name}"] = _texts(column) if column.is_text else column.numbers()

    about = _store_tables(log, written, lambda table: _place(table, table.name, "/"), store)
    arrays |= {"about_json": np.array(about), "scenario_toml": np.array(log.scenario_text)}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type] # its stubs take every name for allow_pickle's


def _write_mat(log: Log, path: Path, written: _Written) -> None:
    """Writes a struct per site (`m1.q1_rad`, `m1.link.age_s_us`), `events`, and two texts."""
    variables: dict[str, Any] = {}

    def store(table: Table, place: str) -> None:
        struct: dict[str, Any] = {column.name: _matlab(column, table) for column in table.columns}
        struct["units"] = {column.name: column.unit for column in table.columns}
        name, _, kind = place.partition(".")
        (variables[name] if kind else variables)[kind or name] = struct

    def place_of(table: Table) -> str:
        return _place(table, f"{table.name}_site" if table.name in _KEYWORDS else table.name, ".")

    about = _store_tables(log, written, place_of, store)
    variables |= {"about_json": about, "scenario_toml": log.scenario_text}
    savemat = import_extra(*_EXTRAS[ExportFormat.MAT]).savemat
    try:
        with path.open("wb") as stream:
            savemat(stream, variables, long_field_names=True, oned_as="column")
    except (ValueError, OverflowError) as error:
        text = f"too large for a MAT file ({error}); export it --to npz, or --to parquet"
        raise UsageError(f"{log.source}: {text}") from None


def _texts(column: Column) -> NDArray[Any]:
    return np.array(column.values.tolist(), dtype=np.str_)


def _matlab(column: Column, table: Table) -> Any:
    """Returns a column for MATLAB: doubles if they are exact, rows of characters or cells."""
    if column.is_text:
        return _texts(column) if table.kind else column.values.reshape(-1, 1)
    values = column.numbers()
    is_stamp = column.unit == "ns" and not column.name.startswith("drift")
    exact = values.dtype == np.int64 and bool((np.abs(values) <= _EXACT).all())
    if is_stamp or values.dtype.kind not in "iu" or not exact:
        return values
    return values.astype(np.float64)


class _TimedMessages(NamedTuple):
    """Messages of one publish time, by topic."""

    log_ns: int
    publish_ns: int
    messages: list[tuple[str, bytes]]


def export_ros2(log: Log, path: Path, progress: Callable[[int], None] = lambda _: None) -> None:
    """Writes a log as a bag that `ros2 bag` and its like play and read.

    Per site, under its name: `joint_states`, `reference`, `error`, `tau_x`, `theta_hat`, `mode`, in task
    space `end_effector` and `wrench`; its statistics `link_age`, `link_delay`, `link_offset`, `timing`; of
    the session `/events` and `/log`. Units and names stand in the channels' metadata and in the labels of
    dimensions. A chain has its `robot_description` and its links' frames in `/tf`.

    An earlier file is replaced; `progress` is called with the number of records written since its last call.

    Raises:
        LogError: a message of the log cannot be read.
        OSError: the disk refuses.
    """
    with path.open("wb") as stream:
        file = McapWriter(stream, f"trilat-net {collect_provenance()['version_trilat-net']}", profile="ros2")
        file.add_metadata(SOURCE_METADATA, {"source": log.source, **log.session})
        file.add_attachment(0, 0, SCENARIO, "application/toml", log.scenario_text.encode())
        sites = [_SiteMessages(log, name, progress) for name in log.sites]
        known = {f"/{name}": channel for name, channel in SESSION_CHANNELS.items()}
        for site in sites:
            known |= site.channels
        bag = _BagChannels(file, known)
        parts = [part for site in sites for part in (site.records(), site.statistics())]
        for log_ns, publish_ns, messages in heapq.merge(*parts, _events(log), key=itemgetter(0)):
            for topic, data in messages:
                file.add_message(bag.channel(topic), log_ns, data, publish_ns)
        file.finish()


class _BagChannels:
    """The channels of a bag, of all that are known by topic; each is registered with its first message."""

    def __init__(self, file: McapWriter, known: dict[str, Ros2Channel]) -> None:
        self._file, self._known = file, known
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def channel(self, topic: str) -> int:
        """Returns the number of a channel."""
        if topic not in self._channels:
            kind, about = self._known[topic]
            if kind not in self._schemas:
                text = cdr.ROS2_SCHEMAS[kind]
                self._schemas[kind] = self._file.register_schema(kind, cdr.SCHEMA_ENCODING, text)
            self._channels[topic] = self._file.register_channel(
                topic, cdr.ENCODING, self._schemas[kind], {"offered_qos_profiles": _QOS, **about}
            )
        return self._channels[topic]


class _SiteMessages:
    """The messages of one site, on topics under its name."""

    def __init__(self, log: Log, name: str, progress: Callable[[int], None]) -> None:
        self._log, self._name, self._progress = log, name, progress
        self._epoch_unix_ns = int(log.session.get("epoch_unix_ns", "0"))
        self._shapes = shapes = Ros2SiteChannels(log.scenario, name)
        self._states = cdr.JointStatePacker(shapes.joints)
        self._reference = cdr.JointStatePacker(shapes.joints, effort=False)
        self.channels = {
            f"/{name}/joint_states": shapes.joint_states(shapes.joints),
            f"/{name}/reference": shapes.joint_states(shapes.joints, effort=False),
            **{f"/{name}/{part}": array.channel for part, array in shapes.arrays.items()},
        }
        if shapes.robot is not None:
            self.channels |= {f"/{name}/{ROBOT}": ROBOT_CHANNELS[ROBOT], _TF: ROBOT_CHANNELS[FRAMES]}

    def _named(self, messages: Iterable[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        return [(part if part == _TF else f"/{self._name}/{part}", data) for part, data in messages]

    def records(self) -> Iterator[_TimedMessages]:
        """Yields its records in the order of arrival."""
        part = self._log[self._name]
        log_ns, publish_ns = part.log_time_ns.tolist(), part.publish_time_ns.tolist()
        for count, at in enumerate(np.argsort(part.log_time_ns, kind="stable").tolist(), 1):
            state = part.states[at]
            stamp_ns = max(0, self._epoch_unix_ns + state.tick * NS_PER_S // part.rate_hz)
            row = [column[0] for column in stack_signals([state])]
            messages = [
                ("joint_states", self._states.pack(stamp_ns, state.q, state.qd, state.tau)),
                *self._shapes.end_effector(state),
                ("error", self._shapes.arrays["error"].pack(*row[self._shapes.error_row])),
                *self._shapes.slow(row[self._shapes.slow_row]),
            ]
            if not self._shapes.task:
                messages.insert(1, ("reference", self._reference.pack(stamp_ns, state.q_des, state.qd_des)))
            if (robot := self._shapes.robot) is not None:
                if count == 1:
                    messages.append((ROBOT, pack_string(robot.description)))
                messages.append((_TF, robot.pack(stamp_ns, state.q)))
            yield _TimedMessages(log_ns[at], publish_ns[at], self._named(messages))
            if not count % _EVERY or count == len(part):
                self._progress((count - 1) % _EVERY + 1)

    def statistics(self) -> Iterator[_TimedMessages]:
        """Yields its statistics in the order of arrival."""
        timed = self._log.timed_link_stats(self._name)
        rows = zip(timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True)
        for log_ns, publish_ns, stats in sorted(rows, key=itemgetter(0)):
            yield _TimedMessages(log_ns, publish_ns, self._named(self._shapes.statistics(stats)))


def _events(log: Log) -> Iterator[_TimedMessages]:
    timed = log.timed_events()
    rows = zip(timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True)
    for log_ns, publish_ns, event in rows:
        messages = [(f"/{topic}", data) for topic, data in pack_event(event, publish_ns)]
        yield _TimedMessages(log_ns, publish_ns, messages)


_WRITERS: dict[ExportFormat, Callable[[Log, Path, _Written], None]] = {
    ExportFormat.ROS2: export_ros2,
    ExportFormat.PARQUET: _write_parquet,
    ExportFormat.CSV: _write_csv,
    ExportFormat.NPZ: _write_npz,
    ExportFormat.MAT: _write_mat,
}
