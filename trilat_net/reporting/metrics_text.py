"""The metrics of a run as text: tables by group, statics, impedances, and reasons of missing numbers.

Invariant: a dash stands for a missing number; if there could be one, its reason is given below.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby

from ..analysis.metrics.log_metrics import LogMetrics
from ..analysis.metrics.measures import Metric, Quantity, quantities
from .result_text import Block, MarkedText, TextTable
from .terminal_output import sanitize

_NO_NUMBER = "–"
_MAX_LINES = 16
"""Most frequencies of one response that are listed; the JSON has all."""


def compose_metrics(found: LogMetrics) -> Iterator[Block]:
    """Yields a table per group and kind of place, statics, impedances, and reasons of missing numbers."""
    reasons: dict[str, list[str]] = {}
    for (group, _), members in groupby(quantities(), key=lambda one: (one.group, one.of)):
        yield from _compose_group(group, list(members), found, reasons)
    yield from _compose_statics(found)
    yield from _compose_impedance(found)
    for why, where in reasons.items():
        yield _explain(sanitize(", ".join(where)), why)


def _explain(what: str, why: str) -> MarkedText:
    return MarkedText(f"[bold]{_NO_NUMBER}[/bold]", f"{what}: {sanitize(why)}")


def _compose_group(
    group: str, members: Sequence[Quantity], found: LogMetrics, reasons: dict[str, list[str]]
) -> Iterator[Block]:
    """Yields a row per quantity and a column per place that apply; collects reasons of missing numbers."""
    rows = {quantity: found.places(quantity) for quantity in members}
    could = {q: places for q, places in rows.items() if any(one.applies for one in places.values())}
    names = [
        name for name in next(iter(rows.values())) if any(places[name].applies for places in could.values())
    ]
    if not names:
        return
    cells = [[q.name, q.unit, *(_cell(places[name]) for name in names)] for q, places in could.items()]
    yield from _table([group, "", *names], cells, words=2)
    for quantity, places in could.items():
        for name in names:
            if places[name].value is None and places[name].applies:
                where = f"{quantity.name} of {name}" if name else quantity.name
                reasons.setdefault(places[name].why, []).append(where)


def _compose_statics(found: LogMetrics) -> Iterator[Block]:
    if found.sharing_ratios:
        joint, nm = ("axis", found.unit("N m", 1)) if found.axes else ("joint", "N m")
        heads = ("at rest", joint, "ON the arm of", nm, "felt at", nm, "expected", "off")
        rows = []
        for pair in found.sharing_ratios:
            pushed = f"{pair.pushed}{' (wall)' if pair.by_wall else ''}"
            off = _NO_NUMBER if pair.off is None else f"{100.0 * pair.off:.2g} %"
            when, which = f"{pair.from_s:.1f} - {pair.to_s:.1f} s", found.label(pair.joint)
            row = [when, which, pushed, _number(pair.pushed_nm)]
            rows.append([*row, pair.holds, _number(pair.felt_nm), _cell(pair.expected_nm), off])
        yield from _table(heads, rows, words=1)
        for why in dict.fromkeys(pair.expected_nm.why for pair in found.sharing_ratios):
            if why:
                yield _explain("nothing is expected", why)
    if found.stiffness:
        rows = []
        for one in found.stiffness:
            stiffness = _NO_NUMBER if one.stiffness_nm_rad is None else _number(one.stiffness_nm_rad)
            row = [f"{one.from_s:.1f} to {one.to_s:.1f} s", found.label(one.joint), one.site]
            rows.append([*row, _number(one.torque_nm), _number(one.angle_rad), stiffness])
        nm, rad, ratio = (found.unit(unit, 1) for unit in ("N m", "rad", "N m/rad"))
        joint = "axis" if found.axes else "joint"
        yield from _table(
            ("stiffness felt", joint, "by", f"{nm} more", f"{rad} further", ratio), rows, words=1
        )


def _compose_impedance(found: LogMetrics) -> Iterator[Block]:
    if not found.responses:
        return
    rows = []
    for one in found.responses:
        where = f"{'along' if found.axes else 'joint'} {found.label(one.joint)}"
        what = f"{one.kind}{f' of {one.of}' if one.of else ''} at {one.at}, {where}"
        step = -(-len(one.spectrum) // _MAX_LINES) or 1
        for n, ratio in enumerate(one.spectrum[::step] if len(one.spectrum) > 1 else [one.ratio]):
            head = ["" if n else what, found.unit(one.unit, one.joint)]
            if ratio.gain is None:
                rows.append([*head, "", "", "", "", ratio.why])
                continue
            numbers = (ratio.frequency_hz, ratio.gain, ratio.phase_rad, ratio.coherence)
            error = _NO_NUMBER if ratio.error is None else f"{100.0 * ratio.error:.1g} %"
            rows.append([*head, *(_number(value or 0.0) for value in numbers), f"+- {error}"])
    yield from _table(["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""], rows, words=2)


def _cell(one: Metric) -> str:
    return _NO_NUMBER if one.value is None else _number(one.value)


def _number(value: float) -> str:
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int) -> Iterator[Block]:
    """Yields a table and an empty line; its first columns hold words, the others numbers."""
    align = "l" * words + "r" * (len(heads) - words - 1) + ("r" if heads[-1] else "l")
    yield TextTable(heads, list(rows), align)
    yield ""
