"""Delay traces: from a CSV file, an earlier log or what `irtt` and `ping` measured, to a
scenario's text.

Invariant: a scenario that ran does not need the file again. Times count from the trace's first
point, of a measurement from the first sending; times and delays are whole microseconds. A
sample without an answer is lost, and so is one that took longer than a link may. Half a round
trip stands for one way, unless one way was measured and is asked for. Data of others is read
where it is, never shipped.

    t_s,delay_ms
    0.000,41.2
    0.001,lost
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
"""Most points of one trace: 200 s of a log at 1 kHz."""

_LOST = "lost"
LONGEST_MS = MAX_DELAY_US / 1e3
TracePoint = tuple[float, float]
"""A time, s, and a delay, ms; a delay of infinity is a sample lost."""

_LOG_READER = "trilat_net.log.log_reader", "read_link_delays"
"""Reads the delays of a log; it is above this package."""


def _read_csv(path: Path) -> list[TracePoint]:
    rows: list[TracePoint] = []
    first = True
    with open_regular(path) as stream:
        text = decode_text(stream.read())
    for number, cells in enumerate(csv.reader(io.StringIO(text, newline="")), start=1):
        if not any(cells) or cells[0].lstrip().startswith("#"):
            continue
        is_head = first and len(cells) == 2 and not any(map(_is_number, cells))
        first = False
        if is_head:
            continue
        try:
            time_text, delay_text = (cell.strip() for cell in cells)
            rows.append(
                (float(time_text), math.inf if delay_text == _LOST else float(delay_text))
            )
        except ValueError:
            raise ValueError(f"line {number}: a line is t_s,delay_ms or t_s,{_LOST}") from None
    return rows


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_trace(path: Path, link: str) -> str:
    """Returns the text of the trace in a file: a table `t_s,delay_ms`, or a log's link such as
    "m1->s".

    Raises:
        ScenarioError: the file cannot be read, or holds no trace.
    """
    try:
        if path.suffix != ".mcap":
            return format_trace(_read_csv(path))
        module, name = _LOG_READER
        return format_trace(getattr(import_module(module), name)(path, link))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, csv.Error) as error:  # UnicodeDecodeError is a ValueError
        raise ScenarioError(f"{path}: {error}") from None


def format_trace(rows: Sequence[TracePoint]) -> str:
    """Returns the text of a trace from its rows.

    Raises:
        ValueError: there are none or too many, or a number is out of range or out of order.
    """
    if not rows:
        raise ValueError("has no points")
    if len(rows) > MAX_TRACE_POINTS:
        raise ValueError(
            f"has {count_nouns(len(rows), 'point')}, at most {MAX_TRACE_POINTS} are taken: cut or thin it out"
        )
    before_us = -1
    points = []
    for number, (t_s, delay_ms) in enumerate(rows, start=1):
        where = f"point {number}: "
        if not math.isfinite(t_s) or t_s < 0.0:
            raise ValueError(f"{where}its time must be finite and not negative, is {t_s:g} s")
        if math.isnan(delay_ms) or delay_ms < 0.0 or LONGEST_MS < delay_ms < math.inf:
            bounds = f"from 0 to {LONGEST_MS:g} ms or {_LOST!r}"
            raise ValueError(f"{where}its delay must be {bounds}, is {delay_ms:g}")
        t_us = round((t_s - rows[0][0]) * 1e6)
        if t_us <= before_us:
            raise ValueError(
                f"{where}its time, {t_s:g} s, must be later than that of the point before it"
            )
        before_us = t_us
        points.append(f"{t_us} {_LOST if math.isinf(delay_ms) else round(delay_ms * 1e3)}")
    return ", ".join(points)


@lru_cache(maxsize=64)
def parse_trace(text: str) -> Points:
    """Returns the points of a trace, shape (n, 2), see `core.vectors.Points`.

    Raises:
        ValueError: the text is not one of `format_trace`.
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
    if not 0 < len(points) <= MAX_TRACE_POINTS or t_us[0] != 0 or np.any(np.diff(t_us) <= 0):
        raise ValueError(f"must be 1 to {MAX_TRACE_POINTS} points in order, the first at 0")
    if np.any(delay_us < LOST) or np.any(delay_us > MAX_DELAY_US):
        raise ValueError(f"its delays must be from 0 to {MAX_DELAY_US} us, or {_LOST!r}")
    points.flags.writeable = False
    return points


WAYS = ("half", "send", "receive", "whole")
"""Half of a round trip, one way of `irtt` there or back, or what stands there as it is."""
_MOST_BYTES = 2**30
_COLUMN = re.compile(r"(?P<name>.+?)(?:[_ ](?P<suffix>s|ms|us|ns)|\((?P<unit>s|ms|us|ns)\))?$")
_UNIT_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NO_ANSWER = ("lost", "-1", "", "nan", "inf")
"""Delays of samples that were lost, in a table."""
_TIMES = ("t", "time", "timestamp", "pub_time")
_DELAYS = ("delay", "rtt", "latency")


@dataclass(frozen=True, repr=False)
class MeasuredTrace(Result):
    """A trace from a measurement.

    Attributes:
        points: times of sending from the first on, s, and delays, ms; infinite of a sample
            lost.
        too_long: samples that count as lost because they took longer than a link may.
        doubled: samples left out because another one has their time.
        cut: samples left out at the end because a trace has a most of points.
        begin_known: False if the file does not tell what was sent before the first point.
        end_known: False if the file does not tell what was sent after the last point.
    """

    points: tuple[TracePoint, ...]
    too_long: int
    doubled: int
    cut: int
    begin_known: bool = True
    end_known: bool = True

    @property
    def delay_ms(self) -> Array:
        """The delays of what was not lost, in order."""
        return np.array([ms for _, ms in self.points if math.isfinite(ms)])

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat trace import --json`."""
        delay_ms = self.delay_ms
        lost = np.array([math.isinf(ms) for _, ms in self.points])
        bursts = int(np.sum(np.diff(lost.astype(np.int8), prepend=0) == 1))
        found: dict[str, Any] = {
            "samples": len(self.points),
            "span_s": self.points[-1][0],
            "lost_percent": 100.0 * float(lost.mean()),
            "lost_in_a_row": float(lost.sum() / bursts) if bursts else 0.0,
            "too_long": self.too_long,
            "doubled": self.doubled,
            "cut": self.cut,
            "begin_known": self.begin_known,
            "end_known": self.end_known,
        }
        if not len(delay_ms):
            return found
        low, median, high, most = np.percentile(delay_ms, (0.0, 50.0, 99.0, 100.0)).tolist()
        off = delay_ms - delay_ms.mean()
        return {
            **found,
            "min_ms": low,
            "p50_ms": median,
            "mean_ms": float(delay_ms.mean()),
            "p99_ms": high,
            "max_ms": most,
            "deviation_ms": float(delay_ms.std()),
            "correlation": float(off[1:] @ off[:-1] / (off @ off)) if off.any() else 0.0,
        }

    def blocks(self) -> list[str]:
        """Returns the lines of its text."""
        facts = self.to_dict()
        lost = f"{facts['lost_percent']:.2f} % lost, {facts['lost_in_a_row']:.1f} in a row"
        lines = [
            f"{count_nouns(facts['samples'], 'sample')} in {facts['span_s']:.1f} s, {lost}"
        ]
        if "min_ms" in facts:
            shown = ("min", "p50", "mean", "p99", "max", "deviation")
            lines.append(
                "delay, ms: " + ", ".join(f"{name} {facts[f'{name}_ms']:.2f}" for name in shown)
            )
            lines.append(f"correlation from one sample to the next: {facts['correlation']:.3f}")
        said = {
            "too_long": f"took longer than {LONGEST_MS / 1e3:g} s and count as lost",
            "doubled": "have the time of another one and are left out",
            "cut": f"are left out at the end: a trace has at most {MAX_TRACE_POINTS} points",
        }
        lines += [f"{facts[key]} {words}" for key, words in said.items() if facts[key]]
        unknown = {
            "begin_known": "the file does not tell what was sent before its first sample",
            "end_known": "the file does not tell how the measurement ended: later losses are missing",
        }
        return lines + [sentence for key, sentence in unknown.items() if not facts[key]]

    def write_rows(self) -> str:
        """Returns the table that a link of model "trace" reads: t_s,delay_ms."""
        rows = (
            f"{t_s:.6f},{'lost' if math.isinf(ms) else f'{ms:.3f}'}" for t_s, ms in self.points
        )
        return "\n".join(["t_s,delay_ms", *rows]) + "\n"


def import_trace(
    path: str | Path, form: str, *, way: str = "", column: str = "", every_s: float = 1.0
) -> MeasuredTrace:
    """Returns the trace of a file of `irtt client -o`, of `ping` or `fping`, or of a table with
    a head.

    >>> with open("table.csv", "w") as table:
    ...     print("t_s,rtt_ms", "0.0,20", "0.1,40", sep=chr(10), file=table)
    >>> tn.import_trace("table.csv", "csv").delay_ms.tolist()
    [10.0, 20.0]

    Args:
        path: the file; it may be gzipped, and text may be UTF-16.
        form: "irtt", "ping" or "csv".
        way: one of `WAYS`; "send" and "receive" are those of irtt, whose clocks must agree
            then. "": half of what is a round trip, as irtt, ping and a column "rtt" have it.
        column: the column of delays in a table; "": the first one named like one.
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
            raw = stream.read(_MOST_BYTES)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        text = decode_text(
            gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw, any_code_page=True
        )
    except (ValueError, EOFError, OSError) as error:
        raise ScenarioError(f"{path}: {error}") from None
    try:
        return _arrange(_READERS[form](text, way, column, every_s))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ScenarioError(f"{path}: is not of the form {form}: {error}") from None


class _Measured(NamedTuple):
    """Samples of a file, and whether the file tells how the measurement began and ended."""

    sent: list[TracePoint]
    begin_known: bool = True
    end_known: bool = True


def _arrange(measured: _Measured) -> MeasuredTrace:
    if not measured.sent:
        raise ValueError("it has no samples")
    sent = sorted(measured.sent, key=lambda one: one[0])
    begin_s = sent[0][0]
    points = []
    too_long = 0
    doubled = 0
    last_us = -1
    for at_s, ms in sent:
        t_us = round((at_s - begin_s) * 1e6)
        if t_us <= last_us:
            doubled += 1
            continue
        if not ms >= 0.0:
            raise ValueError(
                f"a delay of {ms:g} ms: the clocks do not agree, half of the round trip is known"
            )
        last_us = t_us
        too_long += LONGEST_MS < ms < math.inf
        points.append((t_us * 1e-6, ms if ms <= LONGEST_MS else math.inf))
    found = MeasuredTrace(
        tuple(points[:MAX_TRACE_POINTS]),
        too_long,
        doubled,
        max(0, len(points) - MAX_TRACE_POINTS),
        measured.begin_known,
        measured.end_known,
    )
    format_trace(found.points)
    return found


def _read_irtt(text: str, way: str, *_: object) -> _Measured:
    """Reads `irtt client -o`: nanoseconds, and a status of loss in words; its `stats` count the
    packets.
    """
    key, share = {"half": ("rtt", 0.5), "whole": ("rtt", 1.0)}.get(way or "half", (way, 1.0))
    sent: list[TracePoint] = []
    measured = json.loads(text)
    for trip in measured["round_trips"]:
        times = trip["timestamps"]["client"]["send"]
        answered = trip["lost"] == "false"
        ms = share * trip["delay"][key] * 1e-6 if answered else math.inf
        sent.append((times.get("monotonic", times.get("wall")) * 1e-9, ms))
    packets = measured.get("stats", {}).get("packets_sent", len(sent))
    return _Measured(sent, end_known=packets <= len(sent))


def _read_ping(text: str, way: str, _: str, every_s: float) -> _Measured:
    """Reads what `ping` printed, see `ping_output`."""
    share = 1.0 if way == "whole" else 0.5
    probes = read_ping(text, every_s)
    sent = [(t_s, share * ms) for t_s, ms in zip(probes.sent_s, probes.rtt_ms, strict=True)]
    return _Measured(sent, probes.begin_known, probes.end_known)


def _read_table(text: str, way: str, column: str, _: float) -> _Measured:
    """Reads a table whose head names columns with units, as "pub_time(ms) delay(ms)" or
    t_s,delay_ms.
    """
    numbered = enumerate(text.splitlines(), start=1)
    (_, head), *lines = [
        (n, line) for n, line in numbered if line.strip() and not line.startswith("#")
    ]
    mark = next((mark for mark in (";", "\t", ",") if mark in head), None)
    cells = _split_cells(head, mark)
    time, time_s = _find_column(cells, _TIMES, "")
    delay, delay_s = _find_column(cells, _DELAYS, column)
    half = way == "half" or (not way and "rtt" in cells[delay].lower())
    unit_ms = delay_s * (500.0 if half else 1e3)
    sent: list[TracePoint] = []
    for number, line in lines:
        # else a decimal comma
        row = _split_cells(line if mark == "," else line.replace(",", "."), mark)
        try:
            ms = math.inf if row[delay].lower() in _NO_ANSWER else unit_ms * float(row[delay])
            sent.append((float(row[time]) * time_s, ms))
        except (IndexError, ValueError):
            raise ValueError(f"line {number} is not as its head says") from None
    return _Measured(sent)


def _split_cells(line: str, mark: str | None) -> list[str]:
    return [cell.strip() for cell in line.split(mark)]


def _find_column(cells: list[str], names: tuple[str, ...], wanted: str) -> tuple[int, float]:
    for place, cell in enumerate(cells):
        found = _COLUMN.match(cell)
        if found is not None and (cell == wanted if wanted else found["name"].lower() in names):
            unit = found["suffix"] or found["unit"]
            if unit is None:
                raise ValueError(f"its column {cell!r} names no unit, as {cell}_ms would")
            return place, _UNIT_S[unit]
    raise ValueError(f"its head has no {wanted or f'column like {names[0]}_ms'}")


_READERS: dict[str, Callable[[str, str, str, float], _Measured]] = {
    "irtt": _read_irtt,
    "ping": _read_ping,
    "csv": _read_table,
}
