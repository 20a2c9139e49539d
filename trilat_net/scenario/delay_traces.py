"""Reads delay traces: tables of the send time and the delay of each message.

A link with the delay model "trace" replays the delays of a trace. A trace is read from a CSV
file such as

    t_s,delay_ms
    0.000,41.2
    0.001,lost

or from the log of a run. `import_trace` creates a trace from the output of network measurement
programs such as `irtt` or `ping`. A resolved scenario contains the trace as a string (see
`format_trace`).

Invariant:
    - A resolved scenario no longer needs the file.
    - Times are relative to the first point of the trace or, for a measurement, to the first
      message sent. Times and delays are integers in microseconds.
    - A message with no reply is lost. A message also counts as lost if its delay exceeds the
      longest permitted delay of a link.
    - The one-way delay is half the round-trip time, unless one-way delays were measured and the
      caller asks for them.
    - The package contains no published measurements by third parties. Users supply the files.
"""

import csv
import gzip
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core import LOST, MAX_DELAY_US, Array, Points
from ..errors import ScenarioError, UsageError, count_nouns
from ..files import open_regular
from ..hooks import find_hook
from ..results import Result
from .ping_output import read_ping

MAX_TRACE_POINTS = 200_000
"""Maximum number of points of a trace, equivalent to 200 s of a log at 1 kHz."""

_LOST = "lost"
LONGEST_MS = MAX_DELAY_US / 1e3
"""Longest delay that a link may have, in ms."""
TracePoint = tuple[float, float]
"""Send time of a message in s, and its delay in ms (infinite for a lost message)."""


_OTHER_KINDS = {
    b"\x89MCAP": "an MCAP file",
    b"\xd0\xcf\x11\xe0": "a spreadsheet or document of an old Office program (.xls, .doc)",
    b"\x1f\x8b": "a gzip file",
    b"%PDF": "a PDF document",
    b"SQLite": "an SQLite database",
}
"""Kinds of files that are not text, identified by their leading bytes."""


_ZIPPED_KINDS = {
    b"xl/workbook": "a spreadsheet (.xlsx)",
    b"opendocument.spreadsheet": "a spreadsheet (.ods)",
    b"Index/Tables": "a spreadsheet (.numbers)",
    b"word/document": "a text document (.docx)",
}
"""Kinds of documents in ZIP archives, identified by an uncompressed string in the archive."""


def _decode_text(raw: bytes, *, any_code_page: bool = False) -> str:
    """Decodes the bytes of a text file, and raises ValueError if the file is not text.

    The encoding is UTF-8, or UTF-16 as written by Windows PowerShell. It is detected from the
    first bytes of the file, such as a byte order mark.

    Args:
        raw: Content of the file.
        any_code_page: True to decode any other encoding as Latin-1, since Windows programs
            print in the code page of the user's country. Non-ASCII letters may then be wrong.

    Returns:
        The text, without a byte order mark.

    Raises:
        ValueError: The content is not text. The message names the kind of file, for example a
            spreadsheet.
    """
    is_zip_archive = raw[:4] == b"PK\x03\x04"
    if is_zip_archive:
        kinds = [kind for mark, kind in _ZIPPED_KINDS.items() if mark in raw]
        raise ValueError(_describe_kind(kinds[0] if kinds else "a ZIP archive"))
    for mark, kind in _OTHER_KINDS.items():
        if raw.startswith(mark):
            raise ValueError(_describe_kind(kind))

    has_utf16_mark = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
    if has_utf16_mark:
        return raw.decode("utf-16")
    # UTF-16 without a byte order mark: each pair of bytes of ASCII text has one zero.
    if raw[:2].count(0) == 1:
        return raw.decode("utf-16-be" if raw[0] == 0 else "utf-16-le")
    if 0 in raw:
        raise ValueError("is not text: the file contains null bytes")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        if not any_code_page:
            raise
        return raw.decode("latin-1")


def _describe_kind(kind: str) -> str:
    """Explains to the user that a file is not text, and how to obtain a text file from it.

    Args:
        kind: Kind of file, including the article, as in "a PDF document".
    """
    advice = "save the sheet as CSV" if "spreadsheet" in kind else "a text file is needed"
    return f"is {kind}, not text: {advice}"


def _read_csv(path: Path) -> list[TracePoint]:
    """Reads a delay trace from a CSV file with the columns `t_s,delay_ms`.

    The header is optional. Empty lines and lines that start with "#" are ignored.

    Raises:
        ValueError: A line does not contain a time and a delay.
    """
    with open_regular(path) as stream:
        text = _decode_text(stream.read())
    points: list[TracePoint] = []
    is_first_line = True
    for number, cells in enumerate(csv.reader(io.StringIO(text, newline="")), start=1):
        if not any(cells) or cells[0].lstrip().startswith("#"):
            continue
        is_header = is_first_line and len(cells) == 2 and not any(map(_is_number, cells))
        is_first_line = False
        if is_header:
            continue
        try:
            time_text, delay_text = (cell.strip() for cell in cells)
            delay_ms = math.inf if delay_text == _LOST else float(delay_text)
            points.append((float(time_text), delay_ms))
        except ValueError:
            raise ValueError(
                f"line {number}: must have the form t_s,delay_ms or t_s,{_LOST}"
            ) from None
    return points


def _is_number(cell: str) -> bool:
    """Returns True if a cell of a table contains a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_trace(path: Path, link: str) -> str:
    """Reads a delay trace from a CSV file or from the log of a run.

    Args:
        path: CSV file with the columns `t_s,delay_ms`, or a log.
        link: Name of the link whose delays are read from a log, for example "m1->s".

    Returns:
        The trace as a string in the format of `format_trace`.

    Raises:
        ScenarioError: The file cannot be read or contains no trace.
    """
    try:
        if path.suffix != ".mcap":
            return format_trace(_read_csv(path))
        read_link_delays = find_hook("read the delays of a link")
        return format_trace(read_link_delays(path, link))
    except OSError as error:
        raise ScenarioError(f"{path} cannot be read: {error.strerror}") from None
    # UnicodeDecodeError is a ValueError.
    except (ValueError, csv.Error) as error:
        raise ScenarioError(f"{path}: {error}") from None


def format_trace(points: Sequence[TracePoint]) -> str:
    """Formats a delay trace as a string, to be stored in a scenario.

    The format is "t_us delay_us, t_us delay_us, ...", in microseconds, with "lost" in place of
    the delay of a lost message. Times are relative to the first point.

    Args:
        points: Send time in s and delay in ms of each message. The delay of a lost message is
            infinite.

    Raises:
        ValueError: There are no points or too many, a number is out of range, or the times are
            not increasing.
    """
    if not points:
        raise ValueError("has no points")
    if len(points) > MAX_TRACE_POINTS:
        raise ValueError(
            f"has {count_nouns(len(points), 'point')}, but at most {MAX_TRACE_POINTS} are "
            "allowed: shorten the trace or keep fewer points"
        )
    first_s = points[0][0]
    previous_us = -1
    texts = []
    for number, (t_s, delay_ms) in enumerate(points, start=1):
        if not math.isfinite(t_s) or t_s < 0.0:
            raise ValueError(
                f"point {number}: the time must be finite and not negative, but is {t_s:g} s"
            )
        # an infinite delay means that the message was lost
        is_too_long = LONGEST_MS < delay_ms < math.inf
        if math.isnan(delay_ms) or delay_ms < 0.0 or is_too_long:
            raise ValueError(
                f"point {number}: the delay must be from 0 to {LONGEST_MS:g} ms or {_LOST!r}, "
                f"but is {delay_ms:g}"
            )
        t_us = round((t_s - first_s) * 1e6)
        if t_us <= previous_us:
            raise ValueError(
                f"point {number}: the time, {t_s:g} s, must be later than that of the previous "
                "point"
            )
        previous_us = t_us
        delay_text = _LOST if math.isinf(delay_ms) else str(round(delay_ms * 1e3))
        texts.append(f"{t_us} {delay_text}")
    return ", ".join(texts)


@lru_cache(maxsize=64)
def parse_trace(text: str) -> Points:
    """Parses the string form of a delay trace into an array.

    The result is cached, since the trace of a link is needed many times.

    Args:
        text: A string returned by `format_trace`.

    Returns:
        Read-only array of times and delays in microseconds, shape (n, 2). The delay of a lost
        message is `LOST` (see `core.vectors.Points`).

    Raises:
        ValueError: The string is malformed, or a number is out of range.
    """
    pairs = []
    for part in text.split(", "):
        time_text, _, delay_text = part.partition(" ")
        try:
            delay_us = LOST if delay_text == _LOST else int(delay_text)
            pairs.append((int(time_text), delay_us))
        except ValueError:
            raise ValueError(
                f"contains {part[:40]!r}, where a point must have the form 't_us delay_us'"
            ) from None

    points: Points = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    times_us, delays_us = points.T
    has_valid_length = 0 < len(points) <= MAX_TRACE_POINTS
    if not has_valid_length or times_us[0] != 0 or np.any(np.diff(times_us) <= 0):
        raise ValueError(
            f"must be 1 to {MAX_TRACE_POINTS} points in the order of their times, and the time "
            "of the first point must be 0"
        )
    if np.any(delays_us < LOST) or np.any(delays_us > MAX_DELAY_US):
        raise ValueError(f"the delays must be from 0 to {MAX_DELAY_US} us, or {_LOST!r}")
    points.flags.writeable = False
    return points


WAYS = ("half", "send", "receive", "whole")
"""How the one-way delay of a link is computed from a measurement.

"half": half of the round trip. "send", "receive": the one-way delay, which only `irtt`
measures. "whole": the measured value itself.
"""
_MAX_BYTES = 2**30
"""Maximum number of bytes read from a file."""
_COLUMN = re.compile(r"(?P<name>.+?)(?:[_ ](?P<suffix>s|ms|us|ns)|\((?P<unit>s|ms|us|ns)\))?$")
"""Matches a column heading with its unit, for example "rtt_ms" or "delay(ms)"."""
_GZIP_MAGIC = b"\x1f\x8b"
"""First two bytes of a gzip file."""
_UNIT_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO_ANSWER_TEXTS = ("lost", "-1", "", "nan", "inf")
"""Strings used in tables in place of the delay of a lost message."""
_TIME_NAMES = ("t", "time", "timestamp", "pub_time")
_DELAY_NAMES = ("delay", "rtt", "latency")


@dataclass(frozen=True, repr=False)
class MeasuredTrace(Result):
    """Delays of a real network, imported from the output of a measurement program.

    Returned by `import_trace`. A simulated network link can replay these delays.

    Attributes:
        points: Send time in s (relative to the first message) and delay in ms of each message.
            The delay of a lost message is infinite.
        too_long: Number of messages counted as lost because their delay exceeds the longest
            permitted delay of a link.
        doubled: Number of messages dropped because another message has the same send time.
        cut: Number of messages cut off at the end, since a trace has at most `MAX_TRACE_POINTS`
            points.
        begin_known: False if messages before the first point may be missing from the file.
        end_known: False if messages after the last point may be missing from the file.
    """

    points: tuple[TracePoint, ...]
    too_long: int
    doubled: int
    cut: int
    begin_known: bool = True
    end_known: bool = True

    @property
    def delay_ms(self) -> Array:
        """Delays of all messages that were not lost, in ms, in the order of sending."""
        return np.array([ms for _, ms in self.points if math.isfinite(ms)])

    def to_dict(self) -> dict[str, Any]:
        """Returns summary statistics of the trace as JSON-compatible values.

        The keys are those of `trilat trace import --json`. The statistics of the delays are
        omitted if all messages were lost. The correlation is the lag-one autocorrelation of the
        delays, or 0 if all delays are equal.
        """
        is_lost = np.array([math.isinf(ms) for _, ms in self.points])
        # a burst begins where a lost message follows a message that arrived
        bursts = int(np.sum(np.diff(is_lost.astype(np.int8), prepend=0) == 1))
        statistics: dict[str, Any] = {
            "samples": len(self.points),
            "span_s": self.points[-1][0],
            "lost_percent": 100.0 * float(is_lost.mean()),
            "lost_in_a_row": float(is_lost.sum() / bursts) if bursts else 0.0,
            "too_long": self.too_long,
            "doubled": self.doubled,
            "cut": self.cut,
            "begin_known": self.begin_known,
            "end_known": self.end_known,
        }
        delay_ms = self.delay_ms
        if not len(delay_ms):
            return statistics

        smallest_ms, median_ms, p99_ms, largest_ms = np.percentile(
            delay_ms, (0.0, 50.0, 99.0, 100.0)
        ).tolist()
        deviations = delay_ms - delay_ms.mean()
        correlation = 0.0
        if deviations.any():
            lagged_product = deviations[1:] @ deviations[:-1]
            correlation = float(lagged_product / (deviations @ deviations))
        return {
            **statistics,
            "min_ms": smallest_ms,
            "p50_ms": median_ms,
            "mean_ms": float(delay_ms.mean()),
            "p99_ms": p99_ms,
            "max_ms": largest_ms,
            "deviation_ms": float(delay_ms.std()),
            "correlation": correlation,
        }

    def blocks(self) -> list[str]:
        """Returns a text report of the trace, as printed by `trilat trace import`.

        The lines state the number of messages, the losses, the delays, and how many messages
        were dropped.
        """
        statistics = self.to_dict()
        samples = count_nouns(statistics["samples"], "sample")
        lost_percent = f"{statistics['lost_percent']:.2f} % lost"
        burst_length = f"{statistics['lost_in_a_row']:.1f} in a row"
        lines = [f"{samples} in {statistics['span_s']:.1f} s, {lost_percent}, {burst_length}"]

        if "min_ms" in statistics:
            figures = ", ".join(
                f"{name} {statistics[f'{name}_ms']:.2f}"
                for name in ("min", "p50", "mean", "p99", "max", "deviation")
            )
            lines.append(f"delay, ms: {figures}")
            correlation = statistics["correlation"]
            lines.append(f"correlation from one sample to the next: {correlation:.3f}")

        count_texts = {
            "too_long": f"took longer than {LONGEST_MS / 1e3:g} s and count as lost",
            "doubled": "have the time of another one and are left out",
            "cut": f"are left out at the end: a trace has at most {MAX_TRACE_POINTS} points",
        }
        for key, text in count_texts.items():
            if statistics[key]:
                lines.append(f"{statistics[key]} {text}")

        unknown_texts = {
            "begin_known": "the file does not tell what was sent before its first sample",
            "end_known": "the file does not tell how the measurement ended: "
            "later losses are missing",
        }
        for key, text in unknown_texts.items():
            if not statistics[key]:
                lines.append(text)
        return lines

    def write_rows(self) -> str:
        """Formats the trace as CSV with the columns `t_s,delay_ms`.

        Saved to a file, the CSV can be used in a link with the delay model "trace". No file is
        written here.
        """
        rows = ["t_s,delay_ms"]
        for t_s, ms in self.points:
            delay_text = _LOST if math.isinf(ms) else f"{ms:.3f}"
            rows.append(f"{t_s:.6f},{delay_text}")
        return "\n".join(rows) + "\n"


def import_trace(
    path: str | Path, form: str, *, way: str = "", column: str = "", every_s: float = 1.0
) -> MeasuredTrace:
    """Imports measured delays from the output of `irtt`, `ping` or `fping`, or from a CSV file.

    >>> with open("table.csv", "w") as table:
    ...     print("t_s,rtt_ms", "0.0,20", "0.1,40", sep=chr(10), file=table)
    >>> tn.import_trace("table.csv", "csv").delay_ms.tolist()
    [10.0, 20.0]

    Args:
        path: Path of the file, which may be gzip-compressed or encoded in UTF-16.
        form: Format of the file: "irtt" (output of `irtt client -o`), "ping" (also for `fping`)
            or "csv". A CSV file must have a header with the names and units of its columns.
        way: How the one-way delay is computed, one of `WAYS`. "send" and "receive" are
            available only for irtt and require synchronised clocks. By default, round-trip
            times (from irtt, ping or a column named "rtt") are halved, and other delays are
            used unchanged.
        column: Name of the delay column of a CSV file. By default, the first column whose name
            denotes a delay.
        every_s: Interval between probes, in s, if the output of `ping` contains no timestamps.
            Timestamps require the option -D and are never printed on Windows.

    Raises:
        UsageError: The format is unknown, or does not support `way`.
        ScenarioError: The file cannot be read or is not in this format.
    """
    if form not in _READERS:
        raise UsageError(
            f"a trace can be imported from {', '.join(_READERS)}, not from {form!r}"
        )
    ways = WAYS if form == "irtt" else ("half", "whole")
    if way and way not in ways:
        raise UsageError(f"--way must be {' or '.join(ways)} for {form}, not {way!r}")
    try:
        with open_regular(Path(path)) as stream:
            raw = stream.read(_MAX_BYTES)
    except OSError as error:
        raise ScenarioError(f"{path} cannot be read: {error.strerror or error}") from None

    try:
        if raw.startswith(_GZIP_MAGIC):
            raw = gzip.decompress(raw)
        text = _decode_text(raw, any_code_page=True)
    except (ValueError, EOFError, OSError) as error:
        raise ScenarioError(f"{path}: {error}") from None

    try:
        measurement = _READERS[form](text, way, column, every_s)
        return _build_trace(measurement)
    # A JSON text in another format lacks keys, or has values of other types.
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ScenarioError(f"{path} is not in the format {form}: {error}") from None


class _Measurement(NamedTuple):
    """Messages whose round trips or delays were recorded by a measurement program.

    Attributes:
        samples: Send time in s and delay in ms of each message.
        begin_known: False if messages before the first one may be missing from the file.
        end_known: False if messages after the last one may be missing from the file.
    """

    samples: list[TracePoint]
    begin_known: bool = True
    end_known: bool = True


def _build_trace(measurement: _Measurement) -> MeasuredTrace:
    """Converts a network measurement to a delay trace that a simulated link can replay.

    Messages are sorted by send time, relative to the first one. If several messages have the
    same time in microseconds, only the first is kept.

    Raises:
        ValueError: There are no messages, or a delay is negative.
    """
    if not measurement.samples:
        raise ValueError("the file has no samples")
    samples = sorted(measurement.samples, key=lambda sample: sample[0])
    first_s, _ = samples[0]
    points = []
    too_long = 0
    doubled = 0
    previous_us = -1
    for sent_s, delay_ms in samples:
        t_us = round((sent_s - first_s) * 1e6)
        if t_us <= previous_us:
            doubled += 1
            continue
        previous_us = t_us

        # NaN is refused as well
        if not delay_ms >= 0.0:
            raise ValueError(
                f"a delay of {delay_ms:g} ms is impossible: if the two clocks do not agree, "
                "use half of the round trip"
            )
        # A message whose delay exceeds the longest delay of a link counts as lost.
        is_too_long = LONGEST_MS < delay_ms < math.inf
        too_long += int(is_too_long)
        points.append((t_us * 1e-6, math.inf if is_too_long else delay_ms))

    trace = MeasuredTrace(
        points=tuple(points[:MAX_TRACE_POINTS]),
        too_long=too_long,
        doubled=doubled,
        cut=max(0, len(points) - MAX_TRACE_POINTS),
        begin_known=measurement.begin_known,
        end_known=measurement.end_known,
    )
    # The text itself is not needed here. The call raises an error for a trace that a scenario
    # would refuse.
    format_trace(trace.points)
    return trace


def _read_irtt(text: str, way: str, *_: object) -> _Measurement:
    """Parses the JSON output of `irtt client -o`.

    Times are in nanoseconds. The entry `lost` of a message is a string, and only "false" means
    that the reply arrived. The entry `stats` contains the number of packets sent; if this
    exceeds the number of messages, the last messages are missing.

    Args:
        text: The JSON output.
        way: How the delay is computed: one of `WAYS`, or empty.
    """
    delay_key = "rtt" if way in ("", "half", "whole") else way
    factor = 0.5 if way in ("", "half") else 1.0
    samples: list[TracePoint] = []
    document = json.loads(text)
    for trip in document["round_trips"]:
        times = trip["timestamps"]["client"]["send"]
        sent_s = times.get("monotonic", times.get("wall")) * 1e-9
        delay_ms = math.inf
        if trip["lost"] == "false":
            delay_ms = factor * trip["delay"][delay_key] * 1e-6
        samples.append((sent_s, delay_ms))
    sent_packets = document.get("stats", {}).get("packets_sent", len(samples))
    return _Measurement(samples, end_known=sent_packets <= len(samples))


def _read_ping(text: str, way: str, _: str, every_s: float) -> _Measurement:
    """Parses round trips from the output of `ping` or `fping`.

    See `ping_output` for the formats.

    Args:
        text: The output.
        way: "whole" to use the round trip as the delay; otherwise, half of it is used.
        every_s: Interval between messages, in s, if the output contains no timestamps.
    """
    factor = 1.0 if way == "whole" else 0.5
    probes = read_ping(text, every_s)
    samples = [
        (sent_s, factor * rtt_ms)
        for sent_s, rtt_ms in zip(probes.sent_s, probes.rtt_ms, strict=True)
    ]
    return _Measurement(samples, probes.begin_known, probes.end_known)


def _read_table(text: str, way: str, column: str, _: float) -> _Measurement:
    """Parses a table whose header contains column names with units.

    Examples of headers are "pub_time(ms) delay(ms)" and "t_s,delay_ms". Columns are separated
    by semicolons, tabs, commas or spaces.

    Args:
        text: The table.
        way: "half" if the column contains round trips, or "whole" if it contains delays. If
            empty, determined from the name of the column.
        column: Name of the delay column. If empty, the first column whose name denotes a delay.

    Raises:
        ValueError: A column is missing, or a line does not contain numbers.
    """
    numbered_lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.startswith("#")
    ]
    (_, header), *lines = numbered_lines
    separator = next((mark for mark in (";", "\t", ",") if mark in header), None)
    names = _split_cells(header, separator)
    time_index, time_unit_s = _find_column(names, _TIME_NAMES, "")
    delay_index, delay_unit_s = _find_column(names, _DELAY_NAMES, column)

    is_round_trip = not way and "rtt" in names[delay_index].lower()
    is_half = way == "half" or is_round_trip
    # factor from a number in the table to a delay in ms
    unit_ms = delay_unit_s * (500.0 if is_half else 1e3)

    samples: list[TracePoint] = []
    for number, line in lines:
        # If commas do not separate the cells, a comma is a decimal comma.
        decimal_line = line if separator == "," else line.replace(",", ".")
        cells = _split_cells(decimal_line, separator)
        try:
            delay_text = cells[delay_index]
            delay_ms = math.inf
            if delay_text.lower() not in _NO_ANSWER_TEXTS:
                delay_ms = unit_ms * float(delay_text)
            samples.append((float(cells[time_index]) * time_unit_s, delay_ms))
        except (IndexError, ValueError):
            raise ValueError(
                f"line {number} has no time or delay in the columns that the header names"
            ) from None
    return _Measurement(samples)


def _split_cells(line: str, separator: str | None) -> list[str]:
    """Splits a line of a table into cells, at whitespace if there is no separator."""
    return [cell.strip() for cell in line.split(separator)]


def _find_column(cells: list[str], names: tuple[str, ...], wanted: str) -> tuple[int, float]:
    """Finds the column of a table that contains a quantity.

    Args:
        cells: Cells of the header.
        names: Permitted names of the quantity.
        wanted: Header of the column to use. If empty, the first column with a permitted name is
            used.

    Returns:
        Index of the column, and its unit in s.

    Raises:
        ValueError: There is no such column, or it has no unit.
    """
    for index, cell in enumerate(cells):
        match = _COLUMN.match(cell)
        if match is None:
            continue
        is_wanted = cell == wanted if wanted else match["name"].lower() in names
        if is_wanted:
            unit = match["suffix"] or match["unit"]
            if unit is None:
                raise ValueError(f"the column {cell!r} must name a unit, as in {cell}_ms")
            return index, _UNIT_S[unit]
    column = f"column {wanted!r}" if wanted else f"column such as {names[0]}_ms"
    raise ValueError(f"the header has no {column}")


_READERS: dict[str, Callable[[str, str, str, float], _Measurement]] = {
    "irtt": _read_irtt,
    "ping": _read_ping,
    "csv": _read_table,
}
"""Mapping from format to the function that reads it.

The arguments are the text, the way, the column and the interval in s (see `import_trace`).
"""
