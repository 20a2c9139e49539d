"""The command that measures a run: metrics."""

import json
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from .opening import opened
from .options import JsonOption, LogArgument, out
from .show import shown

if TYPE_CHECKING:
    from ..metrics.catalogue import Quantity
    from ..metrics.measurement import Measurement
    from ..metrics.said import Said

app = typer.Typer()

_WIDE = 160
"""Columns that a pipe has at least."""
_NO_NUMBER = "–"


@app.command(epilog="Example: trilat metrics run.mcap")
def metrics(file: LogArgument, as_json: JsonOption = False) -> None:
    """Measures a run: tracking, effort, energies, force sharing, what hands feel, walls, learning, network.

    Sites, links and walls are columns. A dash is a number that there is none of; where there could be one,
    the reason stands below. Every formula is in docs/metrics.md.
    """
    from ..metrics.facts import facts
    from ..metrics.measurement import measure

    log = opened(file)
    found = measure(log)
    if as_json:
        typer.echo(json.dumps(facts(log, found), indent=2, ensure_ascii=False, allow_nan=False))
    else:
        _show(found)


def _show(found: "Measurement") -> None:
    """Prints a table per group and kind of place, then statics, what is felt, and what is missing."""
    from ..metrics.catalogue import QUANTITIES

    reasons: dict[str, list[str]] = {}
    for (group, _), quantities in groupby(QUANTITIES, key=lambda one: (one.group, one.of)):
        _print_group(group, list(quantities), found, reasons)
    _print_statics(found)
    _print_felt(found)
    for why, where in reasons.items():
        out.print(f"[bold]{_NO_NUMBER}[/bold] {escape(shown(', '.join(where)))}: {escape(shown(why))}")


def _print_group(
    group: str, quantities: "Sequence[Quantity]", found: "Measurement", reasons: dict[str, list[str]]
) -> None:
    """Prints a row per quantity and a column per place, of what could be; notes why numbers are missing."""
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


def _print_statics(found: "Measurement") -> None:
    """Prints who felt what in the windows at rest, and the stiffness between them."""
    if found.shared:
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
                for pair in found.shared
            ),
            words=1,
        )
        for why in dict.fromkeys(pair.expected_nm.why for pair in found.shared):
            if why:
                out.print(f"[bold]{_NO_NUMBER}[/bold] nothing is expected: {escape(shown(why))}")
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


def _print_felt(found: "Measurement") -> None:
    """Prints what hands feel over frequency, decided or not."""
    if not found.felt:
        return
    rows = []
    for one in found.felt:
        told = one.ratio
        what = f"{one.kind}{f' of {one.of}' if one.of else ''} at {one.at}, joint {one.joint}"
        if told.gain is None:
            rows.append([what, one.unit, "", "", "", "", told.why])
            continue
        numbers = (told.frequency_hz, told.gain, told.phase_rad, told.coherence)
        rows.append(
            [what, one.unit, *(_number(value or 0.0) for value in numbers), f"+- {_percent(told.error)}"]
        )
    _print(["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""], rows, words=2)


def _percent(share: float | None) -> str:
    return _NO_NUMBER if share is None else f"{100.0 * share:.1g} %"


def _cell(one: "Said") -> str:
    return _NO_NUMBER if one.value is None else _number(one.value)


def _number(value: float) -> str:
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _print(heads: Sequence[str], rows: Iterable[Sequence[str]], words: int) -> None:
    """Prints a table; its first columns hold words, the others numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for n, head in enumerate(heads):
        last = n == len(heads) - 1 and head == ""
        table.add_column(escape(shown(head)), justify="left" if n < words or last else "right")
    for row in rows:
        table.add_row(*(escape(shown(cell)) for cell in row))
    console = out if out.is_terminal else Console(file=out.file, width=max(out.width, _WIDE), highlight=False)
    console.print(table)
    console.print()
