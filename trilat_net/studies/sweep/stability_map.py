"""A stability map: the plane of a sweep's results with the lines of theory, and the commands
that make both.

The plane has two numeric axes with their labels, a panel per setting of the others, class
counts per grid point, and the measured edges. Lines are those of closed-form stability criteria
and of the dominant root of the linear loop, where either is marginal.

Invariant: the runs come from the results and the lines from the plan alone. Every run is in
exactly one grid point of one panel. A label takes its words from the scenario key and its unit
from the key's suffix; a gain has the unit that its control law states. An edge lies between two
decided grid points of a column, one stable and one not; undecided ones widen it, the majority
of the runs decides, and a draw decides nothing. A line is the zero set of a quantity that
theory gives, found between any two places of a column of which just one is stable. A criterion
applies only if all of its hypotheses hold, and its excess is positive where it is met. P+d
counts as it is computed, from tick to tick; of the roots' line only those with scheme `digital`
do.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...analysis.arm_rows import PlacedArm
from ...core.vectors import Array
from ...errors import ScenarioError, UsageError
from ...fields import is_number
from ...laws.adaptive import Adaptive
from ...laws.conditions import COMMON_MOTION_SHARE, find_least_reversible
from ...laws.p_d import PD
from ...scenario import Scenario, SiteSpec
from ...scenario.arms import ArmModel
from ...scenario.delay_models import LinkBase
from ...scenario.delay_models.kernel_delays import ConstantDelay, NoDelay
from ...theory.linear_edge import GrowthColumn, compute_growth_column
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from .fixed_gains import describe_fixed_gains
from .sweep_cell import CellClass
from .sweep_plan import SweepPlan, format_override, label_axis, label_setting
from .sweep_results import SweepResults

RunCounts = NDArray[np.int64]

CELL_CLASSES = tuple(CellClass)
"""The order of the last axis of `MapPanel.counts`."""
MAX_PANELS = 12


class PlaneAxis(NamedTuple):
    """One axis of a plane: a dotted key, the numbers that it takes, rising, in its unit, and a
    label.
    """

    key: str
    values: tuple[float, ...]
    label: str

    @property
    def even(self) -> bool:
        """True where its values are as far apart, each from the next."""
        steps = np.diff(self.values)
        return len(steps) < 2 or bool(np.ptp(steps) <= 1e-6 * np.abs(steps).max())

    @property
    def places(self) -> Array:
        """Where its values are drawn: at themselves where they are even, else one apart from
        the next.
        """
        return (
            np.array(self.values)
            if self.even
            else np.arange(len(self.values), dtype=np.float64)
        )


class MapPanel(NamedTuple):
    """One plane's worth of runs.

    Attributes:
        title: where it lies along the axes that are not drawn; "" where there are none.
        settings: the same as overrides, key by key; "law" among them where laws were swept.
        counts: runs per place and class, shape (y, x, 4), in the order of `CELL_CLASSES`.
        exponents_per_s: growth exponents, 1/s, means of the seeds, shape (y, x); NaN where
            there is none.
    """

    title: str
    settings: tuple[tuple[str, Any], ...]
    counts: RunCounts
    exponents_per_s: Array

    @property
    def runs(self) -> RunCounts:
        """Runs per place, shape (y, x)."""
        total: RunCounts = self.counts.sum(axis=2)
        return total

    @property
    def stable(self) -> RunCounts:
        """Stable runs per place, shape (y, x)."""
        stable: RunCounts = self.counts[
            :, :, [verdict.stable is True for verdict in CELL_CLASSES]
        ].sum(axis=2)
        return stable

    @property
    def decided(self) -> RunCounts:
        """Decided runs per place, shape (y, x)."""
        return self.runs - self.counts[:, :, CELL_CLASSES.index(CellClass.UNDECIDED)]

    @property
    def share(self) -> Array:
        """Share of stable runs among the decided ones, shape (y, x); NaN where none was
        decided.
        """
        stable = self.stable
        decided = self.decided
        share: Array = np.full(decided.shape, np.nan)
        np.divide(stable, decided, out=share, where=decided > 0)
        return share


class MapPlane(NamedTuple):
    """What a map shows of a scenario: a panel per place of the axes that are not drawn.

    Where only one axis was swept, y has an empty key and a single value.
    """

    scenario: str
    x: PlaneAxis
    y: PlaneAxis
    panels: tuple[MapPanel, ...]

    @property
    def judged_by_twins(self) -> bool:
        """True if there are growth exponents to be drawn."""
        return any(np.isfinite(panel.exponents_per_s).any() for panel in self.panels)

    @property
    def seeds(self) -> int:
        """The largest number of runs of a place."""
        return max(int(panel.runs.max()) for panel in self.panels)


def build_plane(
    rows: Sequence[Mapping[str, Any]], axes: Sequence[str], scenario: Scenario
) -> MapPlane:
    """Returns the plane of results: its first two axes of numbers, a panel per place of all
    others.

    Args:
        rows: one mapping per run: a value per axis, and "verdict" as its text.
        axes: the keys of the axes, in the order in which they were given; "law" where laws were
            swept.
        scenario: the experiment that was swept, for its words.

    Raises:
        UsageError: there is nothing to draw, or there are too many panels to see any.
    """
    if not rows:
        raise UsageError("no cell has run: there is nothing to draw")
    drawn = [key for key in axes if all(is_number(row[key]) for row in rows)][:2]
    if not drawn:
        raise UsageError(
            f"a map needs an axis of numbers, and {', '.join(axes)} has words only"
        )
    sides = [  # whole numbers stay whole
        PlaneAxis(key, tuple(sorted({row[key] for row in rows})), label_axis(key, scenario))
        for key in drawn
    ]
    if len(sides) == 1:
        sides.append(PlaneAxis("", (0.0,), ""))
    others = [key for key in axes if key not in drawn and len({row[key] for row in rows}) > 1]
    settings = list(dict.fromkeys(tuple((key, row[key]) for key in others) for row in rows))
    if len(settings) > MAX_PANELS:
        found = (
            f"at most {MAX_PANELS} panels, and {', '.join(others)} would make {len(settings)}"
        )
        raise UsageError(f"a map has {found}: sweep fewer values of what is not drawn")
    shape = len(sides[1].values), len(sides[0].values), len(CELL_CLASSES)
    panels = [
        MapPanel(
            _title(one, scenario), one, np.zeros(shape, dtype=np.int64), np.zeros(shape[:2])
        )
        for one in settings
    ]
    of = dict(zip(settings, panels, strict=True))
    place = [{value: n for n, value in enumerate(side.values)} for side in sides]
    verdicts = {verdict.value: n for n, verdict in enumerate(CELL_CLASSES)}
    for row in rows:
        j, i = (place[n][row[side.key]] if side.key else 0 for n, side in enumerate(sides))
        panel = of[tuple((key, row[key]) for key in others)]
        panel.counts[i, j, verdicts[row["verdict"]]] += 1
        exponent = row.get("exponent_per_s")
        panel.exponents_per_s[i, j] += np.nan if exponent is None else exponent
    for panel in panels:
        panel.exponents_per_s[...] /= np.maximum(panel.runs, 1)
        panel.exponents_per_s[panel.runs == 0] = np.nan
    return MapPlane(scenario.name, sides[0], sides[1], tuple(panels))


def _title(settings: Sequence[tuple[str, Any]], scenario: Scenario) -> str:
    words = []
    for key, value in settings:
        spaced = value.replace("_", " ") if isinstance(value, str) and key != "law" else value
        words.append(spaced if isinstance(spaced, str) else label_setting(key, value, scenario))
    return ", ".join(words)


class StableInterval(NamedTuple):
    """A change between stable and not, along one key.

    Attributes:
        low: the last value below it that was decided.
        high: the first one above it.
        stable_below: whether what lies below is the stable side.
        sharp: True if nothing between the two stayed undecided.
    """

    low: float
    high: float
    stable_below: bool
    sharp: bool = True

    @property
    def middle(self) -> float:
        """The value half way."""
        return 0.5 * (self.low + self.high)


def find_map_edges(plane: MapPlane, panel: MapPanel) -> list[tuple[float, StableInterval]]:
    """Returns the edges of a panel with the values of their columns, each column from below."""
    found = []
    y = plane.y.values
    for x, share in zip(plane.x.values, panel.share.T, strict=True):
        decided = np.flatnonzero(np.isfinite(share) & (share != 0.5))
        stable = share[decided] > 0.5
        for n in np.flatnonzero(stable[1:] != stable[:-1]):
            low, high = decided[n : n + 2].tolist()
            found.append((x, StableInterval(y[low], y[high], bool(stable[n]), high == low + 1)))
    return found


_GRAVITY = slice(3, 5)
"""The parameters of Eq. (24) that gravity's torque consists of."""
_ROUNDING = 1e-6


class StabilityCriterion(NamedTuple):
    """A condition, at one scenario.

    Attributes:
        symbol: its edge, as a legend has it; `text`: the same for plain text.
        source: where it is from, and what it is worth.
        excess: how much more there is than it asks for, in its own unit; positive: it is met.
    """

    symbol: str
    text: str
    source: str
    excess: float


def evaluate_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Returns the condition in closed form that covers a scenario, or None."""
    if scenario.timeline or any(
        spec.on_stale.action != "use" for spec in scenario.sites.values()
    ):
        return None
    if any(arm.shares_pose for arm in scenario.arms.values()):
        return None
    chains = any(arm.chain is not None for arm in scenario.arms.values())
    return _damped(scenario) or (None if chains else _sampled(scenario))


def _damped(scenario: Scenario) -> StabilityCriterion | None:
    """P+d: 4 d1 d2 > (T1 + T2)^2 K1 K2 for two sites, d > max(abs(lambda_min), 0.2172) K T for
    N equal ones.

    Of N sites the shares must be reversible. It is the condition for no root on the unit circle
    whatever the masses, down to d h: lighter arms no damping steadies at this tick rate
    (docs/errata.md, 13).
    """
    delays_s = _delays_s(scenario)
    rates_hz = {spec.rate_hz for spec in scenario.sites.values()}
    gains = [_scalar_gains(spec) for spec in scenario.sites.values()]
    K = [gain[0] for gain in gains if gain]
    d = [gain[1] for gain in gains if gain]
    if (
        delays_s is None
        or len(K) < len(gains)
        or len(rates_hz) > 1
        or scenario.scheme != "second_order"
    ):
        return None
    rate_hz = rates_hz.pop()
    if max(d) / rate_hz >= min(map(_least_inertia, scenario.arms.values())):
        return None
    ticks = [max(1, math.ceil(delay_s * rate_hz - _ROUNDING)) for delay_s in delays_s]
    source = "P+d: sufficient whatever the arms weigh, and necessary for the worst masses"
    if len(K) == 2:
        symbol = r"$4\,d_1 d_2 = (T_1 + T_2)^2 K_1 K_2$"
        excess = _excess_of_two(K, d, 0.5 * sum(ticks), rate_hz)
        return StabilityCriterion(symbol, "4 d1 d2 = (T1 + T2)² K1 K2", source, excess)
    least = find_least_reversible(scenario.alpha)
    if len({*K}) > 1 or len({*d}) > 1 or len({*ticks}) > 1 or least is None:
        return None
    excess = d[0] - K[0] * _find_asked_share(least, ticks[0]) * ticks[0] / rate_hz
    if -least < COMMON_MOTION_SHARE:
        return StabilityCriterion(r"$d = 0.2172\,K\,T$", "d = 0.2172 K T", source, excess)
    symbol = r"$d = |\lambda_{\min}(\alpha)|\,K\,T$"
    return StabilityCriterion(symbol, "d = abs(lambda_min(alpha)) K T", source, excess)


def _scalar_gains(spec: SiteSpec) -> tuple[float, float] | None:
    """Returns K and d of P+d with known gravity, if they are alike at all joints, which the arm
    couples.
    """
    law: Any = spec.control
    if law.kind is not PD or law.gravity != 1.0 or len({*law.K}) + len({*law.d}) > 2:
        return None
    return law.K[0], law.d[0]


def _tick_angles(ticks: float) -> tuple[Array, Array, Array]:
    """Returns angles phi = w h of z from almost 0 to almost pi, 2 tan(phi / 2), and the
    scheme's lag.

    The first turn of a delay of so many ticks has the more of them.
    """
    first = np.linspace(0.0, min(2.0 * np.pi / ticks, 3.0), 400)[1:]
    phi = np.concatenate([[1e-7 / ticks], first, np.linspace(0.0, np.pi, 400)[1:-1]])
    t = np.tan(0.5 * phi)
    return phi, 2.0 * t, 2.0 * t**3 / (1.0 + 3.0 * t**2)


def _find_asked_share(least: float, ticks: int) -> float:
    phi, w, lag = _tick_angles(ticks)
    asked = [
        (lag * (1.0 - a * np.cos(ticks * phi)) - a * np.sin(ticks * phi)) / (w * ticks)
        for a in (least, 1.0)
    ]
    return float(np.max(asked))


def _excess_of_two(K: list[float], d: list[float], ticks: float, rate_hz: float) -> float:
    """Returns the least of 2 sqrt(d1 d2) - (T1 + T2) sqrt(K1 K2) over all frequencies, T1 + T2
    = 2 ticks.
    """
    phi, w, lag = _tick_angles(ticks)
    first, second = (
        np.maximum(damping - K_i * lag / (w * rate_hz), 0.0)
        for K_i, damping in zip(K, d, strict=True)
    )
    across = np.abs(np.sin(ticks * phi) + lag * np.cos(ticks * phi)) / (w * rate_hz)
    return float(2.0 * np.min(np.sqrt(first * second) - math.sqrt(K[0] * K[1]) * across))


def _least_inertia(arm: ArmModel) -> float:
    """Returns what the least eigenvalue of M(q) exceeds in all poses, kg m^2.

    Of the planar arm it lies at cos q2 = 1 or -1; a chain has at least the inertia of its
    drives.
    """
    if arm.chain is not None:
        return min(joint.armature_kg_m2 for joint in arm.chain.joints)
    ends = PlacedArm(0.0, arm.lengths_m, np.array([[0.0, 0.0], [0.0, np.pi]]))
    return float(np.linalg.eigvalsh(ends.inertia_matrix(arm.theta).T).min())


def _sampled(scenario: Scenario) -> StabilityCriterion | None:
    """The adaptive law as `digital` computes it, without delay: it rests where Gamma g^2 h <
    Kp, about.
    """
    delays_s = _delays_s(scenario)
    if scenario.scheme != "digital" or delays_s is None:
        return None
    excess = []
    for spec in scenario.sites.values():
        law: Any = spec.control
        h_s = 1.0 / spec.rate_hz
        if law.kind is not Adaptive or max(delays_s) > h_s:
            return None
        excess.append(min(law.Kp) - max(law.Gamma[_GRAVITY]) * spec.arm.g_m_s2**2 * h_s)
    source = "a rule for arms of about 1 m and no delay: the estimate of gravity against the lag of a tick"
    return StabilityCriterion(r"$\Gamma g^2 h = K_p$", "Gamma g² h = Kp", source, min(excess))


def _delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the delays of all links that carry a share, s; None where one is not constant or
    loses.
    """
    delays_s = []
    for name in scenario.names:
        for peer in scenario.peers(name):
            if scenario.dominance[name].get(peer, 0.0) == 0.0:
                continue
            link: LinkBase = scenario.links[f"{peer}->{name}"]
            if (
                not isinstance(link, ConstantDelay | NoDelay)
                or link.random
                or link.loss
                or link.outages_s
            ):
                return None
            delays_s.append(max(link.moments().mean_ms, link.playout_ms) / 1e3)
    return delays_s


ScenarioAt = Callable[[float, float], Scenario]
"""The scenario of a panel at (x, y)."""

_PAIR = ((None, -1), (1, None))
"""All places but the last along an axis, and all but the first."""
_MOST_STEPS = 500
LINEAR_ANALYSIS = "linear analysis"
_ABOUT = "where the rightmost root of the loop, linearised, crosses the imaginary axis"


class MapLine(NamedTuple):
    """One line.

    Attributes:
        label: what the legend calls it; `text`: the same for plain text.
        about: where it is from.
        spare: what is zero on it and positive on its stable side, shape (y, x), and goes
            straight from one value of a column to the next; NaN where it is silent.
        rank: how it is drawn: 0 is the first look, and so on; -1 is that of what was measured.
    """

    label: str
    text: str
    about: str
    spare: Array
    rank: int

    @property
    def there(self) -> bool:
        """Whether it goes through the map: between four places that theory speaks of, some on
        either side.
        """
        corners = np.array([self.spare[a:b, c:d] for a, b in _PAIR for c, d in _PAIR])
        stable = (corners > 0.0).sum(axis=0)
        return bool(
            (np.isfinite(corners).all(axis=0) & (stable > 0) & (stable < len(corners))).any()
        )

    def crossings(self, column: int, y: PlaneAxis) -> list[float]:
        """Returns where it crosses a column, from below."""
        at = y.values
        spare = self.spare[:, column].tolist()
        return [
            at[n] + (at[n + 1] - at[n]) * spare[n] / (spare[n] - spare[n + 1])
            for n in _changes(spare)
        ]


ZERO_EXPONENT = "exponent = 0"
_TWINS = "where a small push of the run neither grows nor dies away, straight from cell to cell"


def trace_zero_exponent(panel: MapPanel) -> MapLine | None:
    """Returns the line on which the growth exponents of a panel are zero; None if it has none."""
    line = MapLine(
        label=ZERO_EXPONENT,
        text=ZERO_EXPONENT,
        about=_TWINS,
        spare=-panel.exponents_per_s,
        rank=-1,
    )
    return line if line.there else None


def trace_closed_form(at: ScenarioAt, x: PlaneAxis, y: PlaneAxis) -> MapLine | None:
    """Returns the line of the condition in closed form; None where there is none, or not within
    the map.
    """
    found = [[evaluate_criterion(at(right, up)) for up in y.values] for right in x.values]
    first = next((one for column in found for one in column if one is not None), None)
    if first is None:
        return None
    columns = []
    for right, column in zip(x.values, found, strict=True):
        excess = [np.nan if one is None else one.excess for one in column]
        edges: dict[int, float] = {}
        for n in _changes(excess):
            edge = find_criterion_edge(
                lambda up, right=right: evaluate_criterion(at(right, up)),  # type: ignore[misc]
                *y.values[n : n + 2],
            )
            edges |= {} if edge is None else {n: edge}
        columns.append(_straighten(y.values, excess, edges))
    line = MapLine(
        label=first.symbol,
        text=first.text,
        about=first.source,
        spare=np.array(columns).T,
        rank=0,
    )
    return line if line.there else None


def trace_linear_analysis(
    columns: Sequence[GrowthColumn], y: PlaneAxis
) -> tuple[MapLine | None, list[str]]:
    """Returns the line of the linear analysis from its columns, and what is to be known of it."""
    spare = [
        _straighten(
            y.values, [np.nan if np.isinf(s) else -s for s in one.growth_per_s], one.edges
        )
        for one in columns
    ]
    remarks = list(dict.fromkeys(remark for one in columns for remark in one.remarks))
    line = MapLine(
        label=LINEAR_ANALYSIS,
        text=LINEAR_ANALYSIS,
        about=_ABOUT,
        spare=np.array(spare).T,
        rank=1,
    )
    return line if line.there else None, remarks


def _changes(spare: Sequence[float]) -> list[int]:
    pairs = enumerate(pairwise(spare))
    return [n for n, (a, b) in pairs if np.isfinite([a, b]).all() and (a > 0.0) != (b > 0.0)]


def _straighten(
    values: Sequence[float], spare: Sequence[float], edges: Mapping[int, float]
) -> Array:
    """Returns what is zero at the edges of a column and goes straight between its values, shape
    (y,).

    Elsewhere it is `spare`, by which a line that rises steeply finds its way between two
    columns. An edge that is not given is where `spare` itself, if it went straight, would be
    zero.
    """
    straight: Array = np.where(np.isfinite(spare), spare, np.nan)
    straight[straight == 0.0] = -_ROUNDING
    for n in _changes(spare):
        low, high = values[n : n + 2]
        share = (
            (edges[n] - low) / (high - low)
            if n in edges
            else spare[n] / (spare[n] - spare[n + 1])
        )
        share = min(max(share, _ROUNDING), 1.0 - _ROUNDING)
        straight[n + 1] = straight[n] * (1.0 - 1.0 / share)
    return straight


def find_criterion_edge(
    criterion: Callable[[float], StabilityCriterion | None], low: float, high: float
) -> float | None:
    """Returns where between two values a criterion is just met; None if nowhere, or if it may
    not be asked.

    The criterion of a value may refuse it by ScenarioError, as between whole numbers.
    """
    from scipy.optimize import brentq  # takes half a second, which most commands can do without

    def excess(value: float) -> float:
        found = criterion(value)
        if found is None:
            raise ScenarioError("no criterion covers it")
        return found.excess

    try:
        if (excess(low) > 0.0) == (excess(high) > 0.0):
            return None
        return float(brentq(excess, low, high, xtol=1e-8 * (high - low), maxiter=_MOST_STEPS))
    except ScenarioError:
        return None


LAW_AXIS = "law"


class StabilityMap(NamedTuple):
    """A map.

    Attributes:
        plane: what it shows.
        lines: per panel the lines of theory.
        remarks: on these lines.
        commands: that make the map.
        title: of its page.
        fixed: the gains that were not swept, a text per law.
    """

    plane: MapPlane
    lines: tuple[tuple[MapLine, ...], ...]
    remarks: tuple[str, ...]
    commands: tuple[str, ...]
    title: str
    fixed: tuple[str, ...] = ()


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
    fixed = tuple(describe_fixed_gains(plan))
    if not drawn.y.key or len(drawn.y.values) < 2:
        return StabilityMap(
            plane=drawn,
            lines=((),) * len(drawn.panels),
            remarks=(),
            commands=commands,
            title=title,
            fixed=fixed,
        )
    at = [panel_scenarios(plan, panel, drawn.x.key, drawn.y.key) for panel in drawn.panels]
    lines = [
        [trace_zero_exponent(panel), trace_closed_form(one, drawn.x, drawn.y)]
        for panel, one in zip(drawn.panels, at, strict=True)
    ]
    remarks: dict[str, None] = {}
    if linearly:
        tasks = [(one, x, drawn.y) for one in at for x in drawn.x.values]
        with open_worker_pool(jobs, on, most=len(tasks)) as pool:
            columns = iter(pool.map(_column, tasks, progress))
        for some in lines:
            line, why = trace_linear_analysis([next(columns) for _ in drawn.x.values], drawn.y)
            some.append(line)
            remarks |= dict.fromkeys(why)
    kept = tuple(tuple(line for line in some if line is not None) for some in lines)
    return StabilityMap(
        plane=drawn,
        lines=kept,
        remarks=tuple(remarks),
        commands=commands,
        title=title,
        fixed=fixed,
    )


def _column(task: tuple[ScenarioAt, float, PlaneAxis]) -> GrowthColumn:
    at, x, y = task
    return compute_growth_column([at(x, up) for up in y.values], y.key, y.values)


def panel_scenarios(plan: SweepPlan, panel: MapPanel, x: str, y: str) -> ScenarioAt:
    """Returns what makes the scenario of any place of a panel along the keys x and y; it is
    picklable.
    """
    settings = dict(panel.settings)
    fixed = plan.laws.get(settings.pop(LAW_AXIS, next(iter(plan.laws), "")), ())
    others = tuple(format_override(key, value) for key, value in settings.items())
    return partial(load_place, plan, (*fixed, *others), x, y)


def load_place(
    plan: SweepPlan, fixed: Sequence[str], x: str, y: str, right: float, up: float
) -> Scenario:
    """Returns the scenario of a place, of a cell or between some, along the keys x and y."""
    return plan.scenario(*fixed, format_override(x, right), format_override(y, up))
