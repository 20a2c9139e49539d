"""A map: the plane of a sweep's results, with the lines that theory draws on it.

Law: the runs come from the results and the lines from the plan alone; neither knows of the other.
"""

import shlex
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..scenario import Scenario
from ..scenario.tables import is_number
from ..workers import cores
from .cell import Written
from .crew import crew
from .line import Line, closed_form, linear
from .plan import LONGEST, MOST_S, Plan
from .plane import Panel, Plane, plane
from .root import growths
from .table import Results

LAW = "law"


class Chart(NamedTuple):
    """A map with what is drawn on it.

    Attributes:
        plane: what became of its places.
        lines: per panel the lines of theory.
        remarks: what is to be known of the lines.
        commands: what makes the results and the map, in order.
        title: of the page.
    """

    plane: Plane
    lines: tuple[tuple[Line, ...], ...]
    remarks: tuple[str, ...]
    commands: tuple[str, ...]
    title: str


class Places(NamedTuple):
    """The scenarios of a panel: of its cells, and of what lies between them. Picklable.

    Attributes:
        written: the experiment.
        fixed: overrides of the panel.
        x: the key to the right.
        y: the key upwards.
    """

    written: Written
    fixed: tuple[str, ...]
    x: str
    y: str

    def scenario(self, right: float, up: float) -> Scenario:
        """Returns the scenario of a place."""
        return self.written.scenario(*self.fixed, override(self.x, right), override(self.y, up))


def chart(
    results: Results,
    commands: tuple[str, ...],
    jobs: int | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    *,
    linearly: bool = True,
) -> Chart:
    """Returns the map of results.

    Args:
        results: a sweep that was run.
        commands: what makes them.
        jobs: in how many processes the linear analysis works; None for one per core.
        progress: told how many columns of it are done, and how many there are.
        linearly: whether its line is wanted.

    Raises:
        UsageError: there is nothing to draw, or too many panels.
    """
    asked = results.plan
    keys = [*([LAW] if len(asked.laws) > 1 else []), *(one.key for one in asked.axes)]
    drawn = plane(results.rows, keys, asked.base)
    title = asked.base.title or asked.base.name
    if not drawn.y.key or len(drawn.y.values) < 2:
        return Chart(drawn, ((),) * len(drawn.panels), (), commands, title)
    at = [places(asked, panel, drawn.x.key, drawn.y.key) for panel in drawn.panels]
    lines = [[closed_form(one.scenario, drawn.x, drawn.y)] for one in at]
    remarks: dict[str, None] = {}
    if linearly:
        for some, columns in zip(lines, _columns(drawn, at, jobs, progress), strict=True):
            line, why = linear(columns)
            some.append(line)
            remarks |= dict.fromkeys(why)
    kept = tuple(tuple(line for line in some if line is not None) for some in lines)
    return Chart(drawn, kept, tuple(remarks), commands, title)


Column = tuple[list[float], list[str]]


def _columns(
    drawn: Plane, at: Sequence[Places], jobs: int | None, progress: Callable[[int, int], None]
) -> list[list[Column]]:
    """Returns per panel the real parts of the rightmost roots, column by column."""
    tasks = [(one, x, drawn.y.values) for one in at for x in drawn.x.values]
    found: dict[int, Column] = {}
    with crew(min(jobs or cores(), len(tasks))) as hands:
        for n, column in hands.each(_column, tasks):
            found[n] = column
            progress(len(found), len(tasks))
    wide = len(drawn.x.values)
    return [[found[n] for n in range(first, first + wide)] for first in range(0, len(tasks), wide)]


def _column(task: tuple[Places, float, tuple[float, ...]]) -> Column:
    at, x, values = task
    return growths([at.scenario(x, y) for y in values])


def places(asked: Plan, panel: Panel, x: str, y: str) -> Places:
    """Returns what makes the scenario of any place of a panel.

    Args:
        asked: the sweep.
        panel: one of its planes.
        x: the key to the right.
        y: the key upwards.
    """
    settings = dict(panel.settings)
    law = settings.pop(LAW, asked.laws[0] if asked.laws else None)
    fixed = () if law is None else asked.law_overrides[asked.laws.index(law)]
    others = tuple(override(key, value) for key, value in settings.items())
    return Places(asked.written, (*fixed, *others), x, y)


def sweep_command(asked: Plan, *more: str) -> str:
    """Returns the command that makes a sweep.

    Args:
        asked: the sweep.
        *more: further words.
    """
    words = ["trilat", "sweep", asked.written.source]
    words += [word for text in asked.written.overrides for word in ("--set", text)]
    words += [word for one in asked.axes for word in ("--over", one.asked)]
    own, count = asked.base.seed, len(asked.seeds)
    if asked.seeds == tuple(range(own, own + count)):
        words += ["--seeds", str(count)] if count > 1 else []
    else:
        words += ["--seeds", ",".join(map(str, asked.seeds)) + ("," if count == 1 else "")]
    words += ["--law", ",".join(asked.laws)] if asked.laws else []
    if asked.longest_s != min(MOST_S, LONGEST * asked.base.duration_s):
        words += ["--longest", number(asked.longest_s)]
    return shlex.join([*words, *more])


def override(key: str, value: Any) -> str:
    """Returns an override that sets a value: a whole number as one, a word as it is."""
    return f"{key}={number(value) if is_number(value) else value}"


def number(value: float) -> str:
    """Returns a number as an override's text, which reads as just that number; whole ones without a point."""
    return repr(value).removesuffix(".0")
