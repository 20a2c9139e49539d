"""Margins as a table, a page and plain values.

Law: an edge is told as the two values that it lies between, what theory has beside it, and what is not known
in words.
"""

from collections.abc import Sequence
from typing import Any

from .chart import number, sweep_command
from .grid import Grid
from .label import label
from .margin import Margin, Span
from .margins import Found, Range
from .plan import Plan


def table(asked: Plan, within: Range, found: Sequence[Found]) -> Grid:
    """Returns margins as a table, a row per edge, or per place that has none.

    Args:
        asked: the plan whose last axis is the range.
        within: the range.
        found: per place what was found.
    """
    axes = asked.axes[:-1]
    seeds = len({one.seed for one in found}) > 1
    closed = any(one.closed is not None for one in found)
    heads = [*(label(axis.key, asked.base) for axis in axes), *(["law"] if asked.laws else [])]
    heads += [*(["seed"] if seeds else []), f"edge of {label(within.key, asked.base)}", "stable is"]
    heads += ["linear", "difference", *(["closed form", "difference"] if closed else []), "runs"]
    rows = []
    for one in found:
        place = [_text(value) for value in one.cell.values] + ([one.cell.law] if asked.laws else [])
        place += [str(one.seed)] if seeds else []
        for span in one.margin.spans or (None,):
            cells = [*place, *_told(one.margin, span), *_beside(span, _near(one, span))]
            cells += _beside(span, one.closed) if closed else []
            rows.append((*cells, str(one.margin.runs)))
    return Grid(tuple(heads), rows)


def page(asked: Plan, within: Range, found: Sequence[Found]) -> str:
    """Returns margins as a page in Markdown.

    Args:
        asked: the plan whose last axis is the range.
        within: the range.
        found: per place what was found.
    """
    command = margin_command(asked, within)
    remarks = dict.fromkeys(one.remark for one in found if one.remark)
    parts = [f"# {asked.base.title or asked.base.name}: margin", f"```sh\n{command}\n```"]
    parts.append(table(asked, within, found).markdown())
    parts += [f"{remark[0].upper()}{remark[1:]}." for remark in remarks]
    islands = sum(len(one.margin.spans) > 1 for one in found)
    if islands:
        parts.append(
            f"Stability is not monotone in {islands} of {len(found)} places: they have several edges."
        )
    return "\n\n".join(parts) + "\n"


def facts(asked: Plan, within: Range, found: Sequence[Found]) -> dict[str, Any]:
    """Returns margins as plain values, for JSON.

    Args:
        asked: the plan whose last axis is the range.
        within: the range.
        found: per place what was found.
    """
    keys = [axis.key for axis in asked.axes[:-1]]
    return {
        "command": margin_command(asked, within),
        "scenario_sha256": asked.base.sha256,
        "key": within.key,
        "low": within.low,
        "high": within.high,
        "tolerance": within.tolerance,
        "places": [
            {
                **dict(zip(keys, one.cell.values, strict=True)),
                **({"law": one.cell.law} if asked.laws else {}),
                "seed": one.seed,
                "edges": [span._asdict() for span in one.margin.spans],
                "stable_everywhere": one.margin.stable,
                "undecided": one.margin.undecided,
                "runs": one.margin.runs,
                "linear": list(one.linear),
                "closed_form": one.closed,
                "remark": one.remark,
            }
            for one in found
        ],
    }


def margin_command(asked: Plan, within: Range) -> str:
    """Returns the command that searches margins."""
    reach = f"{within.key}={number(within.low)}:{number(within.high)}"
    words = ["--margin", reach, "--tolerance", number(within.tolerance)]
    return sweep_command(asked._replace(axes=asked.axes[:-1]), *words)


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _told(margin: Margin, span: Span | None) -> list[str]:
    """Returns where an edge lies and which side is stable, or why there is none."""
    if span is None:
        words = {True: "none: all stable", False: "none: nothing stable", None: "none: nothing decided"}
        return [words[margin.stable], "-"]
    digits = 5 if span.sharp else 4
    blur = "" if span.sharp else " (undecided between)"
    return [
        f"{span.low:.{digits}g} to {span.high:.{digits}g}{blur}",
        "below" if span.stable_below else "above",
    ]


def _near(one: Found, span: Span | None) -> float | None:
    """Returns the linear edge that is next to a measured one; the lowest where nothing was measured."""
    if not one.linear:
        return None
    return one.linear[0] if span is None else min(one.linear, key=lambda edge: abs(edge - span.middle))


def _beside(span: Span | None, value: float | None) -> list[str]:
    """Returns what theory says, and how far that is from the middle of the edge."""
    if value is None:
        return ["-", "-"]
    difference = "-" if span is None else f"{100.0 * (value / span.middle - 1.0):+.2f} %"
    return [f"{value:.5g}", difference]
