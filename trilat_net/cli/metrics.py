"""`trilat metrics`: the metrics of a run, by group, with statics and rendered impedance."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import typer
from rich.markup import escape

from ..reporting.terminal_output import open_with_progress, out, print_json, print_table, sanitize
from ..reporting.text_table import TextTable
from .options import JsonOption, LogArgument

if TYPE_CHECKING:
    from ..analysis.metrics.log_metrics import LogMetrics
    from ..analysis.metrics.metric_catalogue import Metric, Quantity


app = typer.Typer()

_NO_NUMBER = "–"


@app.command("metrics", epilog="Example: trilat metrics run.mcap")
def metrics_command(file: LogArgument, as_json: JsonOption = False) -> None:
    """Measures a run: tracking, effort, energies, force sharing, impedance, walls, learning, network.

    Sites, links and walls are columns. A dash stands for a missing number; if there could be one, the reason
    is given below. docs/metrics.md has every formula.
    """
    from ..analysis.metrics.log_metrics import compute_log_metrics, metrics_to_json

    log = open_with_progress(file)
    found = compute_log_metrics(log)
    if as_json:
        print_json(metrics_to_json(log, found))
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
        out.print(f"[bold]{_NO_NUMBER}[/bold] {escape(sanitize(', '.join(where)))}: {escape(sanitize(why))}")


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
    _print(
        [group, "", *names],
        (
            [quantity.name, quantity.unit, *(_cell(places[name]) for name in names)]
            for quantity, places in could.items()
        ),
        words=2,
    )
    for quantity, places in could.items():
        for name in names:
            if places[name].value is None and places[name].applies:
                where = f"{quantity.name} of {name}" if name else quantity.name
                reasons.setdefault(places[name].why, []).append(where)


def _print_statics(found: "LogMetrics") -> None:
    """Prints the reflected torques of the windows at rest, and the stiffness between them."""
    if found.sharing_ratios:
        _print(
            ["at rest", "joint", "ON the arm of", "N m", "felt at", "N m", "expected", "off"],
            (
                [
                    f"{pair.from_s:.1f} - {pair.to_s:.1f} s",
                    str(pair.joint),
                    f"{pair.pushed}{' (wall)' if pair.by_wall else ''}",
                    _number(pair.pushed_nm),
                    pair.holds,
                    _number(pair.felt_nm),
                    _cell(pair.expected_nm),
                    _NO_NUMBER if pair.off is None else f"{100.0 * pair.off:.2g} %",
                ]
                for pair in found.sharing_ratios
            ),
            words=1,
        )
        for why in dict.fromkeys(pair.expected_nm.why for pair in found.sharing_ratios):
            if why:
                out.print(f"[bold]{_NO_NUMBER}[/bold] nothing is expected: {escape(sanitize(why))}")
    if found.stiffness:
        _print(
            ["stiffness felt", "joint", "by", "N m more", "rad further", "N m/rad"],
            (
                [
                    f"{one.from_s:.1f} to {one.to_s:.1f} s",
                    str(one.joint),
                    one.site,
                    _number(one.torque_nm),
                    _number(one.angle_rad),
                    _NO_NUMBER if one.stiffness_nm_rad is None else _number(one.stiffness_nm_rad),
                ]
                for one in found.stiffness
            ),
            words=1,
        )


def _print_impedance(found: "LogMetrics") -> None:
    """Prints the impedance that operators feel over frequency, decided or not."""
    if not found.responses:
        return
    rows = []
    for one in found.responses:
        ratio = one.ratio
        what = f"{one.kind}{f' of {one.of}' if one.of else ''} at {one.at}, joint {one.joint}"
        if ratio.gain is None:
            rows.append([what, one.unit, "", "", "", "", ratio.why])
            continue
        numbers = (ratio.frequency_hz, ratio.gain, ratio.phase_rad, ratio.coherence)
        rows.append(
            [what, one.unit, *(_number(value or 0.0) for value in numbers), f"+- {_percent(ratio.error)}"]
        )
    _print(["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""], rows, words=2)


def _percent(share: float | None) -> str:
    return _NO_NUMBER if share is None else f"{100.0 * share:.1g} %"


def _cell(one: "Metric") -> str:
    return _NO_NUMBER if one.value is None else _number(one.value)


def _number(value: float) -> str:
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _print(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int) -> None:
    """Prints a table; its first columns hold words, the others numbers."""
    align = "l" * words + "r" * (len(heads) - words - 1) + ("r" if heads[-1] else "l")
    print_table(TextTable(heads, list(rows), align))
    out.print()
