"""A sweep that was run, in lines for people.

Law: every run is counted under one verdict, and each line that names a command names one that works.
"""

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from .outcome import Verdict
from .place import Place, places
from .plan import Plan
from .running import Speed, spoken
from .table import Results

_SHOWN = 8
"""So many doubtful places are told; all stand in the file."""


def opening(asked: Plan) -> list[str]:
    """Returns what will be run, before it is."""
    sizes = " x ".join(str(len(one.texts)) for one in asked.axes) or "1"
    lines = [f"{asked.base.name}: {asked.cells} cells ({sizes}{_laws(asked)}), {_seeds(asked)}"]
    lines += [f"  over {one.asked}: {_values(one.texts)}" for one in asked.axes]
    first_s, longest_s = asked.base.duration_s, asked.longest_s
    extended = f", one that is not plain by then up to {longest_s:g} s" if longest_s > first_s else ""
    return [*lines, f"  {first_s:g} s each{extended}"]


def _laws(asked: Plan) -> str:
    return f" x laws {', '.join(asked.laws)}" if asked.laws else ""


def _seeds(asked: Plan) -> str:
    if len(asked.seeds) == 1:
        return f"seed {asked.seeds[0]}"
    return f"{len(asked.seeds)} seeds each where anything is random"


def _values(texts: Sequence[str]) -> str:
    shown = [texts[0], texts[1], "...", texts[-1]] if len(texts) > 4 else list(texts)
    return ", ".join(shown)


def summary(results: Results) -> Iterator[str]:
    """Yields what came of it: verdicts, extensions, seeds."""
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    words = ", ".join(f"{counts[verdict.value]} {verdict.value}" for verdict in Verdict)
    yield f"{len(rows)} runs of {results.plan.cells} cells: {words}"
    extended = [row for row in rows if row["extended"]]
    if extended:
        longest_s = max(row["ran_s"] for row in extended)
        first_s = results.plan.base.duration_s
        yield (
            f"{len(extended)} were not plain after {first_s:g} s and went on, the longest to {longest_s:g} s"
        )
    if len(results.plan.seeds) > 1:
        yield from _of_seeds(results)


def _of_seeds(results: Results) -> Iterator[str]:
    fixed = sum(not row["random"] for row in results.rows)
    if fixed:
        yield f"in {_cells(fixed)} nothing is random: one seed was run there, which stands for all"
    doubtful = [place for place in places(results) if place.doubtful]
    if not doubtful:
        return
    yield f"stable with some seeds and not with others, {_cells(len(doubtful))}:"
    for place in doubtful[:_SHOWN]:
        yield f"  {_place(results.plan, place)}"
    if len(doubtful) > _SHOWN:
        yield f"  and {len(doubtful) - _SHOWN} more, all in places.parquet"


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _place(asked: Plan, place: Place) -> str:
    where = [f"{one.key} {value}" for one, value in zip(asked.axes, place.values, strict=True)]
    law = [place.law] if asked.laws else []
    low, high = (100.0 * end for end in place.interval)
    return (
        f"cell {place.cell} ({', '.join([*law, *where])}): {place.stable} of {place.decided} stable, "
        f"95 % interval {low:.0f} to {high:.0f} %"
    )


def speed_line(speed: Speed) -> str:
    """Returns how fast it went."""
    on = "1 process" if speed.jobs == 1 else f"{speed.jobs} processes"
    return (
        f"{speed.runs} runs, {speed.simulated_s:.4g} s simulated, in {spoken(speed.wall_s)} by {on}: "
        f"{speed.times_real_time:.0f} times real time per process"
    )


def next_commands(folder: Path) -> list[str]:
    """Returns what can be done with the results."""
    where = shlex.quote(str(folder))
    return [
        f"trilat sweep {where} --cell 0      # the command that makes a log of a cell",
        f"trilat sweep {where} --map         # its map, with the lines of theory",
    ]
