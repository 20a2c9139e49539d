"""Builds a stability map: the results of a sweep on a plane, with the limits of theory.

The plane has two numeric axes with their labels, a panel per setting of the other axes, class
counts per grid point, and the measured edges. The lines show where a closed-form stability
criterion, or the dominant root of the linear loop, is marginal.

Invariant:
    - The runs come from the results alone, the lines from the plan alone.
    - Every run is in exactly one grid point of one panel.
    - A label takes its words from the scenario key and its unit from the key's suffix; a gain
      has the unit that its control law states.
    - A measured edge lies between two decided grid points of a column, one stable and one not.
      The majority of the runs decides a grid point; a draw leaves it undecided. Undecided grid
      points widen an edge.
    - A line is the zero set of a quantity of theory. It is located between two neighbouring
      grid points of a column of which exactly one is stable.
    - A criterion applies only if all of its hypotheses hold; its excess is positive if it is
      met.
    - The criterion of P+d covers the law as computed from tick to tick. The line of the roots
      does so only under scheme `digital`.
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
PanelSettings = tuple[tuple[str, Any], ...]
"""The setting of the axes that are not drawn, as pairs of key and value."""

CELL_CLASSES = tuple(CellClass)
"""The order of the last axis of `MapPanel.counts`."""
MAX_PANELS = 12
"""Largest number of panels of a map."""


class PlaneAxis(NamedTuple):
    """One axis of a plane.

    Attributes:
        key: the scenario key of the axis.
        values: the values of the axis in the unit of the key, in rising order.
        label: the text at the axis.
    """

    key: str
    values: tuple[float, ...]
    label: str

    @property
    def even(self) -> bool:
        """True if the values are equally spaced."""
        steps = np.diff(self.values)
        if len(steps) < 2:
            return True
        tolerance = 1e-6 * np.abs(steps).max()
        return bool(np.ptp(steps) <= tolerance)

    @property
    def positions(self) -> Array:
        """Drawing positions of the values: the values if equally spaced, else indices."""
        if self.even:
            return np.array(self.values)
        return np.arange(len(self.values), dtype=np.float64)


class MapPanel(NamedTuple):
    """The runs with one setting of the axes that are not drawn.

    Attributes:
        title: the setting of the axes that are not drawn, in words; "" without such axes.
        settings: the same setting as pairs; with the key "law" if laws are swept.
        counts: number of runs per grid point and class, shape (y, x, 4), in the order of
            `CELL_CLASSES`.
        exponents_per_s: mean growth exponents over the seeds, in 1/s, shape (y, x); NaN without
            an exponent.
    """

    title: str
    settings: PanelSettings
    counts: RunCounts
    exponents_per_s: Array

    @property
    def runs(self) -> RunCounts:
        """Number of runs per grid point, shape (y, x)."""
        total: RunCounts = self.counts.sum(axis=2)
        return total

    @property
    def stable(self) -> RunCounts:
        """Number of stable runs per grid point, shape (y, x)."""
        is_stable = [verdict.stable is True for verdict in CELL_CLASSES]
        stable: RunCounts = self.counts[:, :, is_stable].sum(axis=2)
        return stable

    @property
    def decided(self) -> RunCounts:
        """Number of decided runs per grid point, shape (y, x)."""
        undecided = self.counts[:, :, CELL_CLASSES.index(CellClass.UNDECIDED)]
        return self.runs - undecided

    @property
    def share(self) -> Array:
        """Share of the decided runs that are stable, shape (y, x); NaN without decided runs."""
        stable = self.stable
        decided = self.decided
        share: Array = np.full(decided.shape, np.nan)
        np.divide(stable, decided, out=share, where=decided > 0)
        return share


class MapPlane(NamedTuple):
    """The results of a sweep, on panels with the same two axes.

    There is a panel per setting of the axes that are not drawn. If only one axis is drawn, y
    has an empty key and a single value.
    """

    scenario: str
    x: PlaneAxis
    y: PlaneAxis
    panels: tuple[MapPanel, ...]

    @property
    def judged_by_twins(self) -> bool:
        """True if a panel has growth exponents."""
        return any(np.isfinite(panel.exponents_per_s).any() for panel in self.panels)

    @property
    def seeds(self) -> int:
        """Largest number of runs at a grid point."""
        return max(int(panel.runs.max()) for panel in self.panels)


def build_plane(
    rows: Sequence[Mapping[str, Any]], axes: Sequence[str], scenario: Scenario
) -> MapPlane:
    """Returns the plane of the results over the first two numeric axes.

    Args:
        rows: one mapping per run, with a value per axis and the text of its "verdict".
        axes: the keys of the axes, in their given order; with "law" if laws are swept.
        scenario: the swept experiment, for the labels.

    Raises:
        UsageError: there is nothing to draw, or there would be more than `MAX_PANELS` panels.
    """
    if not rows:
        raise UsageError("no cell has run: there is nothing to draw")
    numeric = [key for key in axes if all(is_number(row[key]) for row in rows)]
    drawn = numeric[:2]
    if not drawn:
        raise UsageError(
            f"a map needs an axis of numbers, and {', '.join(axes)} has words only"
        )
    values = {key: {row[key] for row in rows} for key in axes}
    plane_axes = [
        PlaneAxis(key, tuple(sorted(values[key])), label_axis(key, scenario)) for key in drawn
    ]
    if len(plane_axes) == 1:
        plane_axes.append(PlaneAxis("", (0.0,), ""))
    x, y = plane_axes

    panel_keys = [key for key in axes if key not in drawn and len(values[key]) > 1]
    rows_of: dict[PanelSettings, list[Mapping[str, Any]]] = {}
    for row in rows:
        settings = tuple((key, row[key]) for key in panel_keys)
        rows_of.setdefault(settings, []).append(row)
    if len(rows_of) > MAX_PANELS:
        raise UsageError(
            f"a map has at most {MAX_PANELS} panels, and {', '.join(panel_keys)} would make "
            f"{len(rows_of)}: sweep fewer values of the axes that are not drawn"
        )
    panels = []
    for settings, panel_rows in rows_of.items():
        title = _format_panel_title(settings, scenario)
        counts, exponents_per_s = _collect_runs(panel_rows, x, y)
        panels.append(MapPanel(title, settings, counts, exponents_per_s))
    return MapPlane(scenario.name, x, y, tuple(panels))


def _collect_runs(
    rows: Sequence[Mapping[str, Any]], x: PlaneAxis, y: PlaneAxis
) -> tuple[RunCounts, Array]:
    """Returns the class counts and the mean exponents of a panel, see `MapPanel`.

    Args:
        rows: the runs of the panel.
        x: the horizontal axis.
        y: the vertical axis; with an empty key if only one axis is drawn.
    """
    shape = (len(y.values), len(x.values))
    counts: RunCounts = np.zeros((*shape, len(CELL_CLASSES)), dtype=np.int64)
    exponents_per_s: Array = np.zeros(shape)
    index_of_x = {value: index for index, value in enumerate(x.values)}
    index_of_y = {value: index for index, value in enumerate(y.values)}
    index_of_class = {verdict.value: index for index, verdict in enumerate(CELL_CLASSES)}
    for row in rows:
        i = index_of_y[row[y.key]] if y.key else 0
        j = index_of_x[row[x.key]]
        counts[i, j, index_of_class[row["verdict"]]] += 1
        exponent = row.get("exponent_per_s")
        exponents_per_s[i, j] += np.nan if exponent is None else exponent
    runs = counts.sum(axis=2)
    exponents_per_s /= np.maximum(runs, 1)
    exponents_per_s[runs == 0] = np.nan
    return counts, exponents_per_s


def _format_panel_title(settings: PanelSettings, scenario: Scenario) -> str:
    """Returns the settings of a panel in words, as in "p d, delay 200 ms"."""
    texts = []
    for key, value in settings:
        if not isinstance(value, str):
            texts.append(label_setting(key, value, scenario))
        elif key == "law":
            texts.append(value)
        else:
            texts.append(value.replace("_", " "))
    return ", ".join(texts)


class StableInterval(NamedTuple):
    """An edge of stability along one key.

    Attributes:
        low: the largest decided value below the edge.
        high: the smallest decided value above the edge.
        stable_below: True if the values below the edge are stable.
        sharp: True if no value between `low` and `high` is undecided.
    """

    low: float
    high: float
    stable_below: bool
    sharp: bool = True

    @property
    def middle(self) -> float:
        """The value halfway between `low` and `high`."""
        return 0.5 * (self.low + self.high)


def find_map_edges(plane: MapPlane, panel: MapPanel) -> list[tuple[float, StableInterval]]:
    """Returns the measured edges of a panel, each with the x value of its column.

    The edges of a column are in rising order.
    """
    edges = []
    y = plane.y.values
    for x, share in zip(plane.x.values, panel.share.T, strict=True):
        decided = np.flatnonzero(np.isfinite(share) & (share != 0.5))
        stable = share[decided] > 0.5
        for n in np.flatnonzero(stable[1:] != stable[:-1]):
            below, above = decided[n : n + 2].tolist()
            edge = StableInterval(
                low=y[below],
                high=y[above],
                stable_below=bool(stable[n]),
                sharp=above == below + 1,
            )
            edges.append((x, edge))
    return edges


_GRAVITY = slice(3, 5)
"""The parameters of Eq. (24) in the gravity torque."""
_ROUNDING = 1e-6
"""Tolerance of delays, in ticks, and of the position of an edge, as a share of an interval."""


class StabilityCriterion(NamedTuple):
    """A stability condition in closed form, evaluated at one scenario.

    Attributes:
        symbol: the equation of the condition's limit, for a legend.
        text: the same equation as plain text.
        source: the origin of the condition, and whether it is necessary or sufficient.
        excess: margin by which the condition is met, in the unit of the condition; positive if
            it is met.
    """

    symbol: str
    text: str
    source: str
    excess: float


def evaluate_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Returns the stability condition in closed form that covers a scenario, or None."""
    holds_stale = any(spec.on_stale.action != "use" for spec in scenario.sites.values())
    if scenario.timeline or holds_stale:
        return None
    if any(arm.shares_pose for arm in scenario.arms.values()):
        return None
    criterion = _evaluate_damping_criterion(scenario)
    if criterion is not None:
        return criterion
    if any(arm.chain is not None for arm in scenario.arms.values()):
        return None
    return _evaluate_sampling_criterion(scenario)


def _evaluate_damping_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Returns the condition on the damping of P+d, or None if it does not cover the scenario.

    For two sites: 4 d1 d2 > (T1 + T2)^2 K1 K2. For N equal sites with reversible shares:
    d > max(abs(lambda_min), 0.2172) K T.

    Under this condition the loop has no root on the unit circle for all masses down to d h. No
    damping stabilises lighter arms at this tick rate (docs/errata.md, 13).
    """
    if scenario.scheme != "second_order":
        return None
    delays_s = _delays_s(scenario)
    rates_hz = {spec.rate_hz for spec in scenario.sites.values()}
    if delays_s is None or len(rates_hz) > 1:
        return None
    rate_hz = rates_hz.pop()
    K = []
    d = []
    for spec in scenario.sites.values():
        gains = _scalar_gains(spec)
        if gains is None:
            return None
        K.append(gains[0])
        d.append(gains[1])
    if max(d) / rate_hz >= min(map(_least_inertia, scenario.arms.values())):
        return None
    ticks = []
    for delay_s in delays_s:
        delay_ticks = math.ceil(delay_s * rate_hz - _ROUNDING)
        ticks.append(max(1, delay_ticks))
    if len(K) == 2:
        return StabilityCriterion(
            symbol=r"$4\,d_1 d_2 = (T_1 + T_2)^2 K_1 K_2$",
            text="4 d1 d2 = (T1 + T2)² K1 K2",
            source=_DAMPING_SOURCE,
            excess=_excess_of_two(K, d, 0.5 * sum(ticks), rate_hz),
        )
    are_equal = len({*K}) == len({*d}) == len({*ticks}) == 1
    least = find_least_reversible(scenario.alpha)
    if not are_equal or least is None:
        return None
    share = _compute_required_share(least, ticks[0])
    required_d = K[0] * share * ticks[0] / rate_hz
    excess = d[0] - required_d
    if -least < COMMON_MOTION_SHARE:
        return StabilityCriterion(
            symbol=r"$d = 0.2172\,K\,T$",
            text="d = 0.2172 K T",
            source=_DAMPING_SOURCE,
            excess=excess,
        )
    return StabilityCriterion(
        symbol=r"$d = |\lambda_{\min}(\alpha)|\,K\,T$",
        text="d = abs(lambda_min(alpha)) K T",
        source=_DAMPING_SOURCE,
        excess=excess,
    )


_DAMPING_SOURCE = "P+d: sufficient whatever the arms weigh, and necessary for the worst masses"


def _scalar_gains(spec: SiteSpec) -> tuple[float, float] | None:
    """Returns K and d of P+d with full gravity compensation, or None.

    None unless all joints have the same gains: the arm couples its joints.
    """
    law: Any = spec.control
    if law.kind is not PD or law.gravity != 1.0:
        return None
    if len({*law.K}) > 1 or len({*law.d}) > 1:
        return None
    return law.K[0], law.d[0]


def _tick_angles(ticks: float) -> tuple[Array, Array, Array]:
    """Returns angles phi = w h of z on the unit circle, 2 tan(phi / 2), and the scheme's lag.

    The angles go from almost 0 to almost pi. They are denser over the first turn of a delay of
    `ticks`, up to phi = 2 pi / `ticks`.
    """
    full_turn = min(2.0 * np.pi / ticks, 3.0)
    first_turn = np.linspace(0.0, full_turn, 400)[1:]
    half_circle = np.linspace(0.0, np.pi, 400)[1:-1]
    phi = np.concatenate([[1e-7 / ticks], first_turn, half_circle])
    t = np.tan(0.5 * phi)
    lag = 2.0 * t**3 / (1.0 + 3.0 * t**2)
    return phi, 2.0 * t, lag


def _compute_required_share(least: float, ticks: int) -> float:
    """Returns the least stable d / (K T) of equal sites with reversible shares.

    Args:
        least: the least eigenvalue of the share matrix; its largest eigenvalue is 1.
        ticks: the delay T, in ticks.
    """
    phi, w, lag = _tick_angles(ticks)
    cosine = np.cos(ticks * phi)
    sine = np.sin(ticks * phi)
    shares = []
    for eigenvalue in (least, 1.0):
        damping = lag * (1.0 - eigenvalue * cosine) - eigenvalue * sine
        shares.append(damping / (w * ticks))
    return float(np.max(shares))


def _excess_of_two(K: list[float], d: list[float], ticks: float, rate_hz: float) -> float:
    """Returns the least of 2 sqrt(d1 d2) - (T1 + T2) sqrt(K1 K2) over all frequencies.

    The scheme's lag reduces each damping, and T1 + T2 is 2 `ticks`.
    """
    phi, w, lag = _tick_angles(ticks)
    w_rad_s = w * rate_hz
    damping_1 = np.maximum(d[0] - K[0] * lag / w_rad_s, 0.0)
    damping_2 = np.maximum(d[1] - K[1] * lag / w_rad_s, 0.0)
    delayed = np.sin(ticks * phi) + lag * np.cos(ticks * phi)
    delay_s = np.abs(delayed) / w_rad_s
    stiffness = math.sqrt(K[0] * K[1])
    excess = np.sqrt(damping_1 * damping_2) - stiffness * delay_s
    return float(2.0 * np.min(excess))


def _least_inertia(arm: ArmModel) -> float:
    """Returns a lower bound of the least eigenvalue of M(q) over all poses, in kg m^2.

    The planar arm has its least eigenvalue at cos q2 = 1 or -1. A chain has at least the
    inertia of its drives.
    """
    if arm.chain is not None:
        return min(joint.armature_kg_m2 for joint in arm.chain.joints)
    poses = np.array([[0.0, 0.0], [0.0, np.pi]])
    extreme_poses = PlacedArm(0.0, arm.lengths_m, poses)
    inertia_kg_m2 = extreme_poses.inertia_matrix(arm.theta).T
    return float(np.linalg.eigvalsh(inertia_kg_m2).min())


def _evaluate_sampling_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Returns the condition on the tick of the adaptive law, or None if it does not apply.

    Without delay and under scheme `digital`, the arms come to rest if Gamma g^2 h < Kp,
    approximately.
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
        required_kp = max(law.Gamma[_GRAVITY]) * spec.arm.g_m_s2**2 * h_s
        excess.append(min(law.Kp) - required_kp)
    return StabilityCriterion(
        symbol=r"$\Gamma g^2 h = K_p$",
        text="Gamma g² h = Kp",
        source=(
            "a rule for arms of about 1 m and no delay: "
            "the estimate of gravity against the lag of a tick"
        ),
        excess=min(excess),
    )


def _delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the delays of all links that carry a share, in s.

    None if a delay is not constant, or if a link loses messages.
    """
    delays_s = []
    for name in scenario.names:
        shares = scenario.dominance[name]
        for peer in scenario.peers(name):
            if shares.get(peer, 0.0) == 0.0:
                continue
            link: LinkBase = scenario.links[f"{peer}->{name}"]
            if not isinstance(link, ConstantDelay | NoDelay):
                return None
            if link.random or link.loss or link.outages_s:
                return None
            delay_ms = max(link.moments().mean_ms, link.playout_ms)
            delays_s.append(delay_ms / 1e3)
    return delays_s


PanelLoader = Callable[[float, float], Scenario]
"""Loads the scenario of a panel at values of x and y."""

_MAX_ROOT_STEPS = 500
LINEAR_ANALYSIS = "linear analysis"
_ABOUT = "where the rightmost root of the loop, linearised, crosses the imaginary axis"


class MapLine(NamedTuple):
    """One stability limit on a panel: the zero set of a quantity.

    Attributes:
        label: the name of the line, for a legend.
        text: the same name as plain text.
        about: the origin of the line.
        spare: quantity that is zero on the line and positive on its stable side, shape (y, x);
            linear between the grid points of a column, NaN where theory makes no statement.
        rank: index of the line style; -1 is the style of measured lines.
    """

    label: str
    text: str
    about: str
    spare: Array
    rank: int

    @property
    def crosses_map(self) -> bool:
        """True if the line passes between grid points.

        This is so if four neighbouring grid points all have a value, and only some of them are
        on the stable side of the line.
        """
        spare = self.spare
        lower = spare[:-1]
        upper = spare[1:]
        corners = np.array([lower[:, :-1], lower[:, 1:], upper[:, :-1], upper[:, 1:]])
        has_values = np.isfinite(corners).all(axis=0)
        stable = (corners > 0.0).sum(axis=0)
        crossed = has_values & (stable > 0) & (stable < len(corners))
        return bool(crossed.any())

    def crossings(self, column: int, y: PlaneAxis) -> list[float]:
        """Returns the values of y at which the line crosses a column, in rising order."""
        values = y.values
        spare = self.spare[:, column].tolist()
        crossings = list[float]()
        for n in _find_sign_changes(spare):
            step = values[n + 1] - values[n]
            change = spare[n] - spare[n + 1]
            crossings.append(values[n] + step * spare[n] / change)
        return crossings


ZERO_EXPONENT = "exponent = 0"
_TWINS = "where a small push of the run neither grows nor dies away, straight from cell to cell"


def trace_zero_exponent(panel: MapPanel) -> MapLine | None:
    """Returns the line of zero growth exponents of a panel; None if no line crosses the map."""
    line = MapLine(
        label=ZERO_EXPONENT,
        text=ZERO_EXPONENT,
        about=_TWINS,
        spare=-panel.exponents_per_s,
        rank=-1,
    )
    return line if line.crosses_map else None


def trace_closed_form(load: PanelLoader, x: PlaneAxis, y: PlaneAxis) -> MapLine | None:
    """Returns the line of the closed-form criterion; None if no line crosses the map.

    Args:
        load: loads the scenario at values of x and y.
        x: the horizontal axis.
        y: the vertical axis.
    """
    first: StabilityCriterion | None = None
    columns = []
    for x_value in x.values:

        def evaluate(y_value: float, x_value: float = x_value) -> StabilityCriterion | None:
            return evaluate_criterion(load(x_value, y_value))

        criteria = [evaluate(y_value) for y_value in y.values]
        applicable = [criterion for criterion in criteria if criterion is not None]
        if first is None and applicable:
            first = applicable[0]
        excess = [np.nan if criterion is None else criterion.excess for criterion in criteria]
        edges: dict[int, float] = {}
        for n in _find_sign_changes(excess):
            edge = find_criterion_edge(evaluate, y.values[n], y.values[n + 1])
            if edge is not None:
                edges[n] = edge
        columns.append(_straighten(y.values, excess, edges))
    if first is None:
        return None
    line = MapLine(
        label=first.symbol,
        text=first.text,
        about=first.source,
        spare=np.array(columns).T,
        rank=0,
    )
    return line if line.crosses_map else None


def trace_linear_analysis(
    columns: Sequence[GrowthColumn], y: PlaneAxis
) -> tuple[MapLine | None, list[str]]:
    """Returns the line of the linear analysis, and remarks on the analysis.

    The line is None if it does not cross the map.

    Args:
        columns: the analysis of each column of the map.
        y: the axis along the columns.
    """
    spare = []
    all_remarks = list[str]()
    for column in columns:
        # a rate of -infinity means that nothing moves: the grid point is on neither side
        decay_per_s = [np.nan if np.isinf(rate) else -rate for rate in column.growth_per_s]
        spare.append(_straighten(y.values, decay_per_s, column.edges))
        all_remarks.extend(column.remarks)
    remarks = list(dict.fromkeys(all_remarks))
    line = MapLine(
        label=LINEAR_ANALYSIS,
        text=LINEAR_ANALYSIS,
        about=_ABOUT,
        spare=np.array(spare).T,
        rank=1,
    )
    return line if line.crosses_map else None, remarks


def _find_sign_changes(values: Sequence[float]) -> list[int]:
    """Returns each index n at which finite values n and n + 1 differ in being positive."""
    indices = list[int]()
    for n, (value, following) in enumerate(pairwise(values)):
        finite = np.isfinite([value, following]).all()
        if finite and (value > 0.0) != (following > 0.0):
            indices.append(n)
    return indices


def _straighten(
    values: Sequence[float], spare: Sequence[float], edges: Mapping[int, float]
) -> Array:
    """Returns a column of `MapLine.spare`: linear interpolation of it is zero at the edges.

    Away from the edges the result is `spare`, which steers a steep line between two columns.

    Args:
        values: the values of the axis along the column, shape (y,).
        spare: the quantity at these values, shape (y,).
        edges: the edge in the interval from value n to value n + 1, by n; an edge that is
            missing is the zero of the linear interpolation of `spare`.
    """
    straight: Array = np.where(np.isfinite(spare), spare, np.nan)
    straight[straight == 0.0] = -_ROUNDING
    for n in _find_sign_changes(spare):
        if n in edges:
            low = values[n]
            high = values[n + 1]
            share = (edges[n] - low) / (high - low)
        else:
            share = spare[n] / (spare[n] - spare[n + 1])
        share = min(max(share, _ROUNDING), 1.0 - _ROUNDING)
        straight[n + 1] = straight[n] * (1.0 - 1.0 / share)
    return straight


def find_criterion_edge(
    criterion: Callable[[float], StabilityCriterion | None], low: float, high: float
) -> float | None:
    """Returns the value at which a criterion is marginal, found by Brent's method.

    None if the criterion does not change between `low` and `high`, or does not apply to a value
    between them.

    Args:
        criterion: evaluates the criterion at a value; may raise ScenarioError for a value that
            is not valid, as between whole numbers.
        low: the first value of the interval.
        high: the last value of the interval.
    """
    # imported late: SciPy costs half a second, and most commands do not need it
    from scipy.optimize import brentq

    def excess(value: float) -> float:
        evaluated = criterion(value)
        if evaluated is None:
            raise ScenarioError("no criterion covers it")
        return evaluated.excess

    tolerance = 1e-8 * (high - low)
    try:
        if (excess(low) > 0.0) == (excess(high) > 0.0):
            return None
        return float(brentq(excess, low, high, xtol=tolerance, maxiter=_MAX_ROOT_STEPS))
    except ScenarioError:
        return None


LAW_AXIS = "law"


class StabilityMap(NamedTuple):
    """A stability map: measured results with the lines of theory.

    Attributes:
        plane: the results.
        lines: the lines of each panel.
        remarks: remarks on the lines.
        commands: the commands that make the map.
        title: the title of the map's page.
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
    """Returns the stability map of a sweep's results.

    Args:
        results: the results of the sweep.
        commands: the commands that make the map.
        jobs: number of worker processes; None: as many as there are cores.
        progress: called while the linear analysis runs.
        linearly: True to add the line of the linear analysis.
        on: the workers to use; None: processes of this computer.

    Raises:
        UsageError: there is nothing to draw, or there are too many panels.
    """
    plan = results.plan
    keys = [axis.key for axis in plan.axes]
    if len(plan.laws) > 1:
        keys.insert(0, LAW_AXIS)
    plane = build_plane(results.rows, keys, plan.base)
    stability_map = StabilityMap(
        plane=plane,
        lines=((),) * len(plane.panels),
        remarks=(),
        commands=commands,
        title=plan.base.title or plan.base.name,
        fixed=tuple(describe_fixed_gains(plan)),
    )
    x = plane.x
    y = plane.y
    if not y.key or len(y.values) < 2:
        return stability_map
    loaders = [make_panel_loader(plan, panel, x.key, y.key) for panel in plane.panels]
    panel_lines = [
        [trace_zero_exponent(panel), trace_closed_form(load, x, y)]
        for panel, load in zip(plane.panels, loaders, strict=True)
    ]
    remarks = list[str]()
    if linearly:
        tasks = [(load, x_value, y) for load in loaders for x_value in x.values]
        with open_worker_pool(jobs, on, most=len(tasks)) as pool:
            columns = iter(pool.map(_analyse_column, tasks, progress))
        for lines in panel_lines:
            panel_columns = [next(columns) for _ in x.values]
            line, line_remarks = trace_linear_analysis(panel_columns, y)
            lines.append(line)
            remarks += line_remarks
    crossing = [tuple(line for line in lines if line is not None) for lines in panel_lines]
    distinct_remarks = tuple(dict.fromkeys(remarks))
    return stability_map._replace(lines=tuple(crossing), remarks=distinct_remarks)


def _analyse_column(task: tuple[PanelLoader, float, PlaneAxis]) -> GrowthColumn:
    """Returns the linear analysis of one column of a panel; any worker can do it."""
    load, x, y = task
    scenarios = [load(x, y_value) for y_value in y.values]
    return compute_growth_column(scenarios, y.key, y.values)


def make_panel_loader(plan: SweepPlan, panel: MapPanel, x: str, y: str) -> PanelLoader:
    """Returns the function that loads the scenario at any point of a panel; it is picklable.

    Args:
        plan: the sweep.
        panel: the panel.
        x: the key of the horizontal axis.
        y: the key of the vertical axis.
    """
    settings = dict(panel.settings)
    only_law = next(iter(plan.laws), "")
    law = settings.pop(LAW_AXIS, only_law)
    law_overrides = plan.laws.get(law, ())
    overrides = [*law_overrides]
    overrides += [format_override(key, value) for key, value in settings.items()]
    return partial(load_grid_scenario, plan, tuple(overrides), x, y)


def load_grid_scenario(
    plan: SweepPlan, fixed: Sequence[str], x: str, y: str, x_value: float, y_value: float
) -> Scenario:
    """Returns the scenario at a point of a panel, which may lie between its cells.

    Args:
        plan: the sweep.
        fixed: the overrides that are common to the panel.
        x: the key of the horizontal axis.
        y: the key of the vertical axis.
        x_value: the value of `x`.
        y_value: the value of `y`.
    """
    return plan.scenario(*fixed, format_override(x, x_value), format_override(y, y_value))
