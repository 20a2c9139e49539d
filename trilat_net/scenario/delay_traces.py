"""Delay traces of links: from a CSV file, a log, or the output of `irtt` or `ping`.

    t_s,delay_ms
    0.000,41.2
    0.001,lost

A resolved scenario holds a trace as a text, see `format_trace`.

Invariant:
    - A scenario that ran does not need the file again.
    - Times count from the first point of the trace; in a measurement from the first sending.
      Times and delays are whole microseconds.
    - A sample without an answer is lost. So is a sample that took longer than a link may take.
    - Half a round trip stands for one way, unless one way was measured and is asked for.
    - Data of others is read where it is, never shipped.
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
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.channel import LOST
from ..core.delay import MAX_DELAY_US
from ..core.vectors import Array, Points
from ..errors import ScenarioError, UsageError, count_nouns
from ..files import decode_text, open_regular
from ..results import Result
from .ping_output import read_ping

MAX_TRACE_POINTS = 200_000
"""Largest number of points of a trace: 200 s of a log at 1 kHz."""

_LOST = "lost"
LONGEST_MS = MAX_DELAY_US / 1e3
TracePoint = tuple[float, float]
"""A time, s, and a delay, ms; the delay of a lost sample is infinite."""

_LOG_READER = "trilat_net.log.log_reader", "read_link_delays"
"""Module and function that read the delays of a log.

They are imported when they are needed, because their package is above this one.
"""


def _read_csv(path: Path) -> list[TracePoint]:
    """Returns the points of a file with lines t_s,delay_ms, with or without a head."""
    points: list[TracePoint] = []
    is_first_line = True
    with open_regular(path) as stream:
        text = decode_text(stream.read())
    for number, cells in enumerate(csv.reader(io.StringIO(text, newline="")), start=1):
        if not any(cells) or cells[0].lstrip().startswith("#"):
            continue
        is_head = is_first_line and len(cells) == 2 and not any(map(_is_number, cells))
        is_first_line = False
        if is_head:
            continue
        try:
            time_text, delay_text = (cell.strip() for cell in cells)
            delay_ms = math.inf if delay_text == _LOST else float(delay_text)
            points.append((float(time_text), delay_ms))
        except ValueError:
            raise ValueError(f"line {number}: a line is t_s,delay_ms or t_s,{_LOST}") from None
    return points


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_trace(path: Path, link: str) -> str:
    """Returns the text of the trace in a file.

    Args:
        path: a table `t_s,delay_ms`, or a log.
        link: the link of the log, as in "m1->s".

    Raises:
        ScenarioError: the file cannot be read, or does not hold a trace.
    """
    try:
        if path.suffix != ".mcap":
            return format_trace(_read_csv(path))
        module, name = _LOG_READER
        return format_trace(getattr(import_module(module), name)(path, link))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    # UnicodeDecodeError is a ValueError.
    except (ValueError, csv.Error) as error:
        raise ScenarioError(f"{path}: {error}") from None


def format_trace(points: Sequence[TracePoint]) -> str:
    """Returns the text of a trace: "t_us delay_us, ...", with "lost" for a lost sample.

    Raises:
        ValueError: there are no points or too many, or a number is out of range or of order.
    """
    if not points:
        raise ValueError("has no points")
    if len(points) > MAX_TRACE_POINTS:
        raise ValueError(
            f"has {count_nouns(len(points), 'point')}, at most {MAX_TRACE_POINTS} are allowed: "
            "cut or thin it out"
        )
    previous_us = -1
    texts = []
    for number, (t_s, delay_ms) in enumerate(points, start=1):
        if not math.isfinite(t_s) or t_s < 0.0:
            raise ValueError(
                f"point {number}: its time must be finite and not negative, is {t_s:g} s"
            )
        if math.isnan(delay_ms) or delay_ms < 0.0 or LONGEST_MS < delay_ms < math.inf:
            raise ValueError(
                f"point {number}: its delay must be from 0 to {LONGEST_MS:g} ms or {_LOST!r}, "
                f"is {delay_ms:g}"
            )
        t_us = round((t_s - points[0][0]) * 1e6)
        if t_us <= previous_us:
            raise ValueError(
                f"point {number}: its time, {t_s:g} s, must be later than that of the point "
                "before it"
            )
        previous_us = t_us
        delay_text = _LOST if math.isinf(delay_ms) else str(round(delay_ms * 1e3))
        texts.append(f"{t_us} {delay_text}")
    return ", ".join(texts)


@lru_cache(maxsize=64)
def parse_trace(text: str) -> Points:
    """Returns the points of a trace, shape (n, 2), see `core.vectors.Points`.

    Args:
        text: the text of `format_trace`.

    Raises:
        ValueError: the text is not of that form.
    """
    pairs = []
    for part in text.split(", "):
        t_text, _, delay_text = part.partition(" ")
        try:
            pairs.append((int(t_text), LOST if delay_text == _LOST else int(delay_text)))
        except ValueError:
            raise ValueError(f"reads {part[:40]!r} where a point is 't_us delay_us'") from None
    points: Points = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    t_us, delay_us = points.T
    has_valid_length = 0 < len(points) <= MAX_TRACE_POINTS
    if not has_valid_length or t_us[0] != 0 or np.any(np.diff(t_us) <= 0):
        raise ValueError(f"must be 1 to {MAX_TRACE_POINTS} points in order, the first at 0")
    if np.any(delay_us < LOST) or np.any(delay_us > MAX_DELAY_US):
        raise ValueError(f"its delays must be from 0 to {MAX_DELAY_US} us, or {_LOST!r}")
    points.flags.writeable = False
    return points


WAYS = ("half", "send", "receive", "whole")
"""How a delay follows from a measurement: half of a round trip; the way there or back, which
`irtt` measures; or the number as it is.
"""
_MAX_BYTES = 2**30
_COLUMN = re.compile(r"(?P<name>.+?)(?:[_ ](?P<suffix>s|ms|us|ns)|\((?P<unit>s|ms|us|ns)\))?$")
_GZIP_MAGIC = b"\x1f\x8b"
_UNIT_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO_ANSWER_TEXTS = ("lost", "-1", "", "nan", "inf")
"""Delays of lost samples in a table."""
_TIME_NAMES = ("t", "time", "timestamp", "pub_time")
_DELAY_NAMES = ("delay", "rtt", "latency")


@dataclass(frozen=True, repr=False)
class MeasuredTrace(Result):
    """A trace from a measurement.

    Attributes:
        points: times of sending since the first one, s, and delays, ms; infinite for a lost
            sample.
        too_long: number of samples that count as lost because they took longer than a link may.
        doubled: number of samples that are left out because another sample has the same time.
        cut: number of samples that are left out at the end because a trace has at most
            `MAX_TRACE_POINTS`.
        begin_known: False if samples may have been sent before the first point.
        end_known: False if samples may have been sent after the last point.
    """

    points: tuple[TracePoint, ...]
    too_long: int
    doubled: int
    cut: int
    begin_known: bool = True
    end_known: bool = True

    @property
    def delay_ms(self) -> Array:
        """The delays of the samples that were not lost, in order."""
        return np.array([ms for _, ms in self.points if math.isfinite(ms)])

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat trace import --json`."""
        delay_ms = self.delay_ms
        is_lost = np.array([math.isinf(ms) for _, ms in self.points])
        bursts = int(np.sum(np.diff(is_lost.astype(np.int8), prepend=0) == 1))
        facts: dict[str, Any] = {
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
        if not len(delay_ms):
            return facts
        least, median, p99, most = np.percentile(delay_ms, (0.0, 50.0, 99.0, 100.0)).tolist()
        deviations = delay_ms - delay_ms.mean()
        correlation = 0.0
        if deviations.any():
            lagged_product = deviations[1:] @ deviations[:-1]
            correlation = float(lagged_product / (deviations @ deviations))
        return {
            **facts,
            "min_ms": least,
            "p50_ms": median,
            "mean_ms": float(delay_ms.mean()),
            "p99_ms": p99,
            "max_ms": most,
            "deviation_ms": float(delay_ms.std()),
            "correlation": correlation,
        }

    def blocks(self) -> list[str]:
        """Returns the lines of the text for people."""
        facts = self.to_dict()
        samples = count_nouns(facts["samples"], "sample")
        lost = f"{facts['lost_percent']:.2f} % lost, {facts['lost_in_a_row']:.1f} in a row"
        lines = [f"{samples} in {facts['span_s']:.1f} s, {lost}"]
        if "min_ms" in facts:
            figures = ", ".join(
                f"{name} {facts[f'{name}_ms']:.2f}"
                for name in ("min", "p50", "mean", "p99", "max", "deviation")
            )
            lines.append(f"delay, ms: {figures}")
            lines.append(f"correlation from one sample to the next: {facts['correlation']:.3f}")
        counted_texts = {
            "too_long": f"took longer than {LONGEST_MS / 1e3:g} s and count as lost",
            "doubled": "have the time of another one and are left out",
            "cut": f"are left out at the end: a trace has at most {MAX_TRACE_POINTS} points",
        }
        lines += [f"{facts[key]} {text}" for key, text in counted_texts.items() if facts[key]]
        unknown_texts = {
            "begin_known": "the file does not tell what was sent before its first sample",
            "end_known": "the file does not tell how the measurement ended: "
            "later losses are missing",
        }
        lines += [text for key, text in unknown_texts.items() if not facts[key]]
        return lines

    def write_rows(self) -> str:
        """Returns the table that a link of the model "trace" reads: t_s,delay_ms."""
        rows = ["t_s,delay_ms"]
        for t_s, ms in self.points:
            delay_text = _LOST if math.isinf(ms) else f"{ms:.3f}"
            rows.append(f"{t_s:.6f},{delay_text}")
        return "\n".join(rows) + "\n"


def import_trace(
    path: str | Path, form: str, *, way: str = "", column: str = "", every_s: float = 1.0
) -> MeasuredTrace:
    """Returns the trace of a file of `irtt client -o`, `ping` or `fping`, or of a table.

    >>> with open("table.csv", "w") as table:
    ...     print("t_s,rtt_ms", "0.0,20", "0.1,40", sep=chr(10), file=table)
    >>> tn.import_trace("table.csv", "csv").delay_ms.tolist()
    [10.0, 20.0]

    Args:
        path: the file; it may be gzipped, and its text may be UTF-16.
        form: "irtt", "ping" or "csv"; a table "csv" has a head with the names of its columns.
        way: one of `WAYS`. "send" and "receive" are for irtt, and its clocks must then agree.
            "": half of a round trip, which irtt, ping and a column "rtt" state; other delays as
            they are.
        column: the column of delays in a table; "": the first column named like a delay.
        every_s: the interval of a `ping` that prints no times, as without -D or on Windows, s.

    Raises:
        UsageError: there is no such form, or it has no such way.
        ScenarioError: the file cannot be read, or is not of that form.
    """
    if form not in _READERS:
        raise UsageError(f"a trace is imported from {', '.join(_READERS)}, not from {form!r}")
    ways = WAYS if form == "irtt" else ("half", "whole")
    if way and way not in ways:
        raise UsageError(f"the way of {form} is {', '.join(ways)}, not {way!r}")
    try:
        with open_regular(Path(path)) as stream:
            raw = stream.read(_MAX_BYTES)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        if raw.startswith(_GZIP_MAGIC):
            raw = gzip.decompress(raw)
        text = decode_text(raw, any_code_page=True)
    except (ValueError, EOFError, OSError) as error:
        raise ScenarioError(f"{path}: {error}") from None
    try:
        measurement = _READERS[form](text, way, column, every_s)
        return _build_trace(measurement)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ScenarioError(f"{path}: is not of the form {form}: {error}") from None


class _Measurement(NamedTuple):
    """The samples in a file.

    Attributes:
        samples: times of sending, s, and delays, ms.
        begin_known: False if samples may have been sent before the first one.
        end_known: False if samples may have been sent after the last one.
    """

    samples: list[TracePoint]
    begin_known: bool = True
    end_known: bool = True


def _build_trace(measurement: _Measurement) -> MeasuredTrace:
    """Returns the trace of a measurement: in order, with times from the first sending on."""
    if not measurement.samples:
        raise ValueError("it has no samples")
    samples = sorted(measurement.samples, key=lambda sample: sample[0])
    begin_s = samples[0][0]
    points = []
    too_long = 0
    doubled = 0
    last_us = -1
    for sent_s, delay_ms in samples:
        t_us = round((sent_s - begin_s) * 1e6)
        if t_us <= last_us:
            doubled += 1
            continue
        if not delay_ms >= 0.0:
            raise ValueError(
                f"a delay of {delay_ms:g} ms: the clocks do not agree, half of the round trip "
                "is known"
            )
        last_us = t_us
        too_long += LONGEST_MS < delay_ms < math.inf
        points.append((t_us * 1e-6, delay_ms if delay_ms <= LONGEST_MS else math.inf))
    trace = MeasuredTrace(
        points=tuple(points[:MAX_TRACE_POINTS]),
        too_long=too_long,
        doubled=doubled,
        cut=max(0, len(points) - MAX_TRACE_POINTS),
        begin_known=measurement.begin_known,
        end_known=measurement.end_known,
    )
    format_trace(trace.points)
    return trace


def _read_irtt(text: str, way: str, *_: object) -> _Measurement:
    """Returns the samples in the JSON of `irtt client -o`.

    Its times are nanoseconds, a lost sample has a status in words, and `stats` counts the
    packets that were sent.
    """
    key = "rtt" if way in ("", "half", "whole") else way
    share = 0.5 if way in ("", "half") else 1.0
    samples: list[TracePoint] = []
    document = json.loads(text)
    for trip in document["round_trips"]:
        times = trip["timestamps"]["client"]["send"]
        sent_s = times.get("monotonic", times.get("wall")) * 1e-9
        delay_ms = math.inf
        if trip["lost"] == "false":
            delay_ms = share * trip["delay"][key] * 1e-6
        samples.append((sent_s, delay_ms))
    packets = document.get("stats", {}).get("packets_sent", len(samples))
    return _Measurement(samples, end_known=packets <= len(samples))


def _read_ping(text: str, way: str, _: str, every_s: float) -> _Measurement:
    """Returns the samples in the output of `ping`, see `ping_output`."""
    share = 1.0 if way == "whole" else 0.5
    probes = read_ping(text, every_s)
    samples = [
        (sent_s, share * rtt_ms)
        for sent_s, rtt_ms in zip(probes.sent_s, probes.rtt_ms, strict=True)
    ]
    return _Measurement(samples, probes.begin_known, probes.end_known)


def _read_table(text: str, way: str, column: str, _: float) -> _Measurement:
    """Returns the samples of a table whose head names columns with units.

    Examples of heads are "pub_time(ms) delay(ms)" and "t_s,delay_ms".
    """
    numbered_lines = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.startswith("#")
    ]
    (_, head), *lines = numbered_lines
    separator = next((mark for mark in (";", "\t", ",") if mark in head), None)
    names = _split_cells(head, separator)
    time_index, time_unit_s = _find_column(names, _TIME_NAMES, "")
    delay_index, delay_unit_s = _find_column(names, _DELAY_NAMES, column)
    is_round_trip = not way and "rtt" in names[delay_index].lower()
    is_half = way == "half" or is_round_trip
    unit_ms = delay_unit_s * (500.0 if is_half else 1e3)
    samples: list[TracePoint] = []
    for number, line in lines:
        # If commas do not separate the cells, a comma is a decimal comma.
        cells = _split_cells(line if separator == "," else line.replace(",", "."), separator)
        try:
            delay_text = cells[delay_index]
            delay_ms = math.inf
            if delay_text.lower() not in _NO_ANSWER_TEXTS:
                delay_ms = unit_ms * float(delay_text)
            samples.append((float(cells[time_index]) * time_unit_s, delay_ms))
        except (IndexError, ValueError):
            raise ValueError(f"line {number} is not as its head says") from None
    return _Measurement(samples)


def _split_cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(separator)]


def _find_column(cells: list[str], names: tuple[str, ...], wanted: str) -> tuple[int, float]:
    """Returns the index of a column and its unit, s.

    Args:
        cells: the head of the table.
        names: names of the quantity.
        wanted: the column; "": the first column that has one of the names.

    Raises:
        ValueError: there is no such column, or it has no unit.
    """
    for index, cell in enumerate(cells):
        match = _COLUMN.match(cell)
        if match is None:
            continue
        is_wanted = cell == wanted if wanted else match["name"].lower() in names
        if is_wanted:
            unit = match["suffix"] or match["unit"]
            if unit is None:
                raise ValueError(f"its column {cell!r} names no unit, as {cell}_ms would")
            return index, _UNIT_S[unit]
    raise ValueError(f"its head has no {wanted or f'column like {names[0]}_ms'}")


_READERS: dict[str, Callable[[str, str, str, float], _Measurement]] = {
    "irtt": _read_irtt,
    "ping": _read_ping,
    "csv": _read_table,
}
"""The function that reads each form of files."""
