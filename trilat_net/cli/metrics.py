"""`trilat metrics`: the metrics of a run, by group, with statics and rendered impedance."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from rich.markup import escape

from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..analysis.metrics.log_metrics import LogMetrics
    from ..analysis.metrics.metric_catalogue import Metric, Quantity


_NO_NUMBER = "–"
_MAX_LINES = 16
"""Most frequencies of one response that are printed; --json has all."""


def metrics_command(file: options.LogArgument, as_json: options.JsonOption = False) -> None:
    """Measures a run: tracking, effort, energies, force sharing, impedance, walls, learning, network.

    Sites, links and walls are columns. A dash stands for a missing number; if there could be one, the reason
    is given below. docs/metrics.md has every formula.
    """
    from ..analysis.metrics.log_metrics import compute_log_metrics, metrics_to_json

    log = terminal.open_with_progress(file)
    found = compute_log_metrics(log)
    if as_json:
        terminal.print_json(metrics_to_json(log, found))
    else:
        _show(found)


def _show(found: "LogMetrics") -> None:
    """Prints a table per group and kind of place, statics, impedances, and reasons of missing numbers."""
    from ..analysis.metrics.metric_catalogue import QUANTITIES

    reasons: dict[str, list[str]] = {}
    for (group, _), quantities in groupby(QUANTITIES, key=lambda one: (one.group, one.of)):
        _print_group(group, list(quantities), found, reasons)
    _print_statics(found)
    _print_impedance(found)
    for why, where in reasons.items():
        _explain(terminal.sanitize(", ".join(where)), why)


def _explain(what: str, why: str) -> None:
    text = escape(f"{what}: {terminal.sanitize(why)}")
    terminal.out.print(f"[bold]{_NO_NUMBER}[/bold] {text}")


def _print_group(
    group: str, quantities: "Sequence[Quantity]", found: "LogMetrics", reasons: dict[str, list[str]]
) -> None:
    """Prints a row per quantity and a column per place that apply; collects reasons of missing numbers."""
    rows = {quantity: found.places(quantity) for quantity in quantities}
    could = {q: places for q, places in rows.items() if any(one.applies for one in places.values())}
    names = [
        name for name in next(iter(rows.values())) if any(places[name].applies for places in could.values())
    ]
    if not names:
        return
    cells = [[q.name, q.unit, *(_cell(places[name]) for name in names)] for q, places in could.items()]
    _print([group, "", *names], cells, words=2)
    for quantity, places in could.items():
        for name in names:
            if places[name].value is None and places[name].applies:
                where = f"{quantity.name} of {name}" if name else quantity.name
                reasons.setdefault(places[name].why, []).append(where)


def _print_statics(found: "LogMetrics") -> None:
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
        _print(heads, rows, words=1)
        for why in dict.fromkeys(pair.expected_nm.why for pair in found.sharing_ratios):
            if why:
                _explain("nothing is expected", why)
    if found.stiffness:
        rows = []
        for one in found.stiffness:
            stiffness = _NO_NUMBER if one.stiffness_nm_rad is None else _number(one.stiffness_nm_rad)
            row = [f"{one.from_s:.1f} to {one.to_s:.1f} s", found.label(one.joint), one.site]
            rows.append([*row, _number(one.torque_nm), _number(one.angle_rad), stiffness])
        nm, rad, ratio = (found.unit(unit, 1) for unit in ("N m", "rad", "N m/rad"))
        joint = "axis" if found.axes else "joint"
        _print(("stiffness felt", joint, "by", f"{nm} more", f"{rad} further", ratio), rows, words=1)


def _print_impedance(found: "LogMetrics") -> None:
    """Prints the impedance that operators feel over frequency, decided or not."""
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
    _print(["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""], rows, words=2)


def _cell(one: "Metric") -> str:
    return _NO_NUMBER if one.value is None else _number(one.value)


def _number(value: float) -> str:
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _print(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int) -> None:
    """Prints a table; its first columns hold words, the others numbers."""
    align = "l" * words + "r" * (len(heads) - words - 1) + ("r" if heads[-1] else "l")
    terminal.print_table(TextTable(heads, list(rows), align))
    terminal.out.print()
