"""A stability map: the plane of a sweep's results with the lines of theory, and the commands that make both.

Invariant: the runs come from the results and the lines from the plan alone; neither depends on the other.
"""

import shlex
from collections.abc import Sequence
from typing import Any, NamedTuple

from ...scenario import Scenario
from ...scenario.fields import is_number
from ...theory import compute_growth_rates
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from .map_plane import MapPanel, MapPlane, build_plane
from .sweep_cell import SweepSource
from .sweep_plan import MAX_EXTENSION, MAX_SCENARIO_S, SweepPlan
from .sweep_results import SweepResults
from .theory_lines import TheoryLine, trace_closed_form, trace_linear_analysis

LAW_AXIS = "law"


class StabilityMap(NamedTuple):
    """A map with what is drawn on it.

    Attributes:
        plane: what became of its places.
        lines: per panel the lines of theory.
        remarks: what is to be known of the lines.
        commands: what makes the results and the map, in order.
        title: of the page.
    """

    plane: MapPlane
    lines: tuple[tuple[TheoryLine, ...], ...]
    remarks: tuple[str, ...]
    commands: tuple[str, ...]
    title: str


class PanelScenarios(NamedTuple):
    """The scenarios of a panel: of its cells, and of what lies between them. Picklable.

    Attributes:
        written: the experiment.
        fixed: overrides of the panel.
        x: the key to the right.
        y: the key upwards.
    """

    written: SweepSource
    fixed: tuple[str, ...]
    x: str
    y: str

    def scenario(self, right: float, up: float) -> Scenario:
        """Returns the scenario of a place."""
        return self.written.scenario(*self.fixed, format_override(self.x, right), format_override(self.y, up))


def build_stability_map(
    results: SweepResults,
    commands: tuple[str, ...],
    jobs: int | None = None,
    progress: Progress = ignore_progress,
    *,
    linearly: bool = True,
    on: Workers = None,
) -> StabilityMap:
    """Returns the map of results.

    Raises:
        UsageError: there is nothing to draw, or too many panels.
    """
    plan = results.plan
    keys = [*([LAW_AXIS] if len(plan.laws) > 1 else []), *(one.key for one in plan.axes)]
    drawn = build_plane(results.rows, keys, plan.base)
    title = plan.base.title or plan.base.name
    if not drawn.y.key or len(drawn.y.values) < 2:
        return StabilityMap(drawn, ((),) * len(drawn.panels), (), commands, title)
    at = [panel_scenarios(plan, panel, drawn.x.key, drawn.y.key) for panel in drawn.panels]
    lines = [[trace_closed_form(one.scenario, drawn.x, drawn.y)] for one in at]
    remarks: dict[str, None] = {}
    if linearly:
        for some, columns in zip(lines, _columns(drawn, at, jobs, on, progress), strict=True):
            line, why = trace_linear_analysis(columns)
            some.append(line)
            remarks |= dict.fromkeys(why)
    kept = tuple(tuple(line for line in some if line is not None) for some in lines)
    return StabilityMap(drawn, kept, tuple(remarks), commands, title)


GrowthColumn = tuple[list[float], list[str]]


def _columns(
    drawn: MapPlane, at: Sequence[PanelScenarios], jobs: int | None, on: Workers, progress: Progress
) -> list[list[GrowthColumn]]:
    """Returns per panel the real parts of the rightmost roots, column by column."""
    tasks = [(one, x, drawn.y.values) for one in at for x in drawn.x.values]
    with open_worker_pool(jobs, on, most=len(tasks)) as pool:
        found = pool.map(_column, tasks, progress)
    wide = len(drawn.x.values)
    return [[found[n] for n in range(first, first + wide)] for first in range(0, len(tasks), wide)]


def _column(task: tuple[PanelScenarios, float, tuple[float, ...]]) -> GrowthColumn:
    at, x, values = task
    return compute_growth_rates([at.scenario(x, y) for y in values])


def panel_scenarios(plan: SweepPlan, panel: MapPanel, x: str, y: str) -> PanelScenarios:
    """Returns what makes the scenario of any place of a panel."""
    settings = dict(panel.settings)
    law = settings.pop(LAW_AXIS, plan.laws[0] if plan.laws else None)
    fixed = () if law is None else plan.law_overrides[plan.laws.index(law)]
    others = tuple(format_override(key, value) for key, value in settings.items())
    return PanelScenarios(plan.written, (*fixed, *others), x, y)


def build_sweep_command(plan: SweepPlan, *more: str) -> str:
    """Returns the command that makes a sweep."""
    words = ["trilat", "sweep", plan.written.source]
    words += [word for text in plan.written.overrides for word in ("--set", text)]
    words += [word for one in plan.axes for word in ("--over", one.asked)]
    own, count = plan.base.seed, len(plan.seeds)
    if plan.seeds == tuple(range(own, own + count)):
        words += ["--seeds", str(count)] if count > 1 else []
    else:
        words += ["--seeds", ",".join(map(str, plan.seeds)) + ("," if count == 1 else "")]
    words += ["--law", ",".join(plan.laws)] if plan.laws else []
    if plan.longest_s != min(MAX_SCENARIO_S, MAX_EXTENSION * plan.base.duration_s):
        words += ["--longest", format_override_value(plan.longest_s)]
    return shlex.join([*words, *more])


def format_override(key: str, value: Any) -> str:
    """Returns an override that sets a value: a whole number as one, a word as it is."""
    return f"{key}={format_override_value(value) if is_number(value) else value}"


def format_override_value(value: float) -> str:
    """Returns a number as an override's text, which reads as just that number; whole ones without a point."""
    return repr(value).removesuffix(".0")
