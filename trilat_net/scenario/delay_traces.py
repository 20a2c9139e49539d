"""Delay traces: from a CSV file or an earlier log to the text that a resolved scenario holds.

Invariant: a scenario that ran does not need the file again. Times count from the trace's first point;
times and delays are whole microseconds.

    t_s,delay_ms
    0.000,41.2
    0.001,lost
"""

import csv
import math
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from pathlib import Path

import numpy as np

from ..core.channel import LOST
from ..core.delay import MAX_DELAY_US
from ..core.vectors import Points
from ..errors import ScenarioError
from ..files import open_regular

MAX_TRACE_POINTS = 200_000
"""Most points of one trace: 200 s of a log at 1 kHz."""

_LOST = "lost"

TracePoint = tuple[float, float]
"""A time, s, and a delay, ms; a delay of infinity is a sample lost."""

_LOG_READER = "trilat_net.log.log_reader", "read_link_delays"
"""Reads the delays of a log; it is above this package."""


def _read_csv(path: Path) -> list[TracePoint]:
    rows: list[TracePoint] = []
    first = True
    with open_regular(path, newline="", encoding="utf-8-sig") as stream:
        for number, cells in enumerate(csv.reader(stream), start=1):
            if not any(cells) or cells[0].lstrip().startswith("#"):
                continue
            is_head = first and len(cells) == 2 and not any(map(_is_number, cells))
            first = False
            if is_head:
                continue
            try:
                time_text, delay_text = (cell.strip() for cell in cells)
                rows.append((float(time_text), math.inf if delay_text == _LOST else float(delay_text)))
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
    """Returns the text of the trace in a file: a table `t_s,delay_ms`, or a log's link such as "m1->s".

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
        raise ValueError(f"has {len(rows)} points, at most {MAX_TRACE_POINTS} are taken: cut or thin it out")
    before_us = -1
    points = []
    for number, (t_s, delay_ms) in enumerate(rows, start=1):
        where = f"point {number}: "
        if not math.isfinite(t_s) or t_s < 0.0:
            raise ValueError(f"{where}its time must be finite and not negative, is {t_s:g} s")
        if math.isnan(delay_ms) or delay_ms < 0.0 or MAX_DELAY_US / 1000 < delay_ms < math.inf:
            limit = MAX_DELAY_US / 1000
            raise ValueError(f"{where}its delay must be from 0 to {limit:g} ms or {_LOST!r}, is {delay_ms:g}")
        t_us = round((t_s - rows[0][0]) * 1e6)
        if t_us <= before_us:
            raise ValueError(f"{where}its time, {t_s:g} s, must be later than that of the point before it")
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
