"""The largest gains for an arm over a delay: an edge along a ray, confirmed by runs.

    K = k m,    d + Kd = 2 zeta sqrt(k) m

with m of each joint the largest M_ii of its inertia in some poses, or less. Two or three such
arms follow one another over links of that delay. The edge is the least k over the poses at
which small motions of the sampled loop grow. The gains have the damping of the edge, and its
stiffness divided by the margin.

The gains keep the same margin to the sampled-data limit, where a damping that is held for a
tick makes the lightest motion swing from tick to tick. If a light motion is shared by several
joints, their m is reduced. For one joint at a wall such edges are known: Gil, Avello, Rubio and
Florez, "Stability analysis of a 1 DOF haptic interface using the Routh-Hurwitz criterion", IEEE
Trans. Control Systems Technology 12 (2004); over delays Hulin, Preusche and Hirzinger,
"Stability boundary for haptic rendering: influence of physical damping", IROS 2006.

Invariant:
    - A result is a function of its arguments.
    - Friction, stops and torque limits are left out: friction only helps, and limits do not
      concern small motions.
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import brentq

from ..analysis.envelope_trend import EnvelopeTrend, fit_envelopes
from ..core.ticks import BUCKETS_PER_S
from ..core.vectors import Array
from ..errors import UsageError
from ..execution.fused import FusedRun
from ..log.log_reader import open_log, read_link_delays
from ..reporting.result_text import MARKS, Block, MarkedText, TextTable
from ..results import Result, finite_or_none
from ..scenario import Scenario, load_scenario
from ..scenario.arms import read_arm
from ..scenario.laws import BUILT_IN
from ..theory.characteristic_roots import CharacteristicRoot
from ..theory.floquet import find_samples_in_use
from ..theory.linear_edge import find_rightmost_root
from ..theory.operating_point import (
    Equilibrium,
    OperatingConditions,
    derive_operating_conditions,
)
from .executor import Progress, ignore_progress

TUNED_LAWS = tuple(
    name
    for name, law in BUILT_IN.items()
    if {"K", "d"} <= law.tune.keys() and not getattr(law, "sends", ())
)
"""Laws with a stiffness and a damping that send nothing but their motion."""
SHARES = (0.95, 1.1)
"""Shares of the edge's k at which runs confirm the edge."""
_PUSH = 1e-6
"""Largest initial displacement of the first arm's joints, rad or m."""
_SMALL = 1.0
"""Speed from which on motions are not small, rad/s."""
_STILL = 1e-7
"""Share of the largest speed that counts as rounding."""
_SITES = {2: ("m", "s"), 3: ("m1", "m2", "s")}
_SLACK = 0.05
"""Share of a joint's range at each end that poses avoid."""
_HALF_TURN = math.pi
_HALF_SLIDE_M = 0.5
"""Half of the range of a prismatic joint without limits, m."""
_SETTLES = 4.0
"""Time constants of its slowest motion that a run lasts at first."""
_SHORTEST_S = 2.0
_LONGEST_S = 400.0
"""Bounds of that first duration, s."""
_EXTENSIONS = 3
"""Number of durations of a run, each twice the one before."""
_IS_STABLE = {EnvelopeTrend.GROWS: False, EnvelopeTrend.DECAYS: True}
_NO_GAIN = 1e-6
_CURVE_POINTS = 9
_EDGE_TOLERANCE = 1e-4
"""Tolerance of the edge's ln k."""
_FITTING_STEP = 0.9
"""Least factor by which m is reduced in one step."""
_NO_ROOT_PER_S = -1e3
"""Real part that stands for a loop without roots, 1/s."""
_DELAY = re.compile(r"(\d+\.?\d*|\.\d+) ?(us|ms|s|)")
_UNIT_MS = {"us": 1e-3, "ms": 1.0, "": 1.0, "s": 1e3}


@dataclass(frozen=True, repr=False)
class ArmGains(Result):
    """The largest gains for an arm, with a margin; with the keys of `trilat tune --json`.

    Attributes:
        arm, law, sites, rate_hz, delay, margin, damping: the arguments.
        age_ms: the constant age of samples that stands for the delay, ms.
        joints: for each joint m, the gains with their unit, and the error at which the effort
            limit is reached.
        edge: k of the sampled loop over the delays in use, over a constant delay, in continuous
            time (None: never), and the k from which damping swings from tick to tick, 1/s^2;
            frequency, motion, pose, and the limit that bounds K.
        runs: runs at the gains (share None) and at shares of the edge's k, with the growth rate
            of the largest speed (None: motions were not small) and that of the roots.
        agree: True if all runs behave as the roots predict, and the run at the gains decays.
        line: the gains as a line to paste above the tables of a scenario.
        curve: pairs of a delay, s, and k of the edge in the same pose, if requested.
    """

    arm: str
    law: str
    sites: int
    rate_hz: int
    delay: str
    age_ms: float
    margin: float
    damping: float
    joints: list[dict[str, Any]]
    edge: dict[str, Any]
    runs: list[dict[str, Any]]
    agree: bool
    line: str
    curve: list[tuple[float, float]]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per joint."""
        return self.joints

    def blocks(self) -> Iterator[Block]:
        """Yields the loop, a row per joint, the edge, the runs, and the line to paste."""
        yield (
            f"{self.arm}: {self.sites} equal arms, {self.law}, {self.rate_hz} Hz, "
            f"{self.delay}, damping ratio {self.damping:g}, margin {self.margin:g}"
        )
        header = [key.replace("_", " ") for key in self.joints[0]]
        rows = [[_format_cell(value) for value in joint.values()] for joint in self.joints]
        yield TextTable(header, rows, align="lr")
        yield from self._describe_edge()
        for run in self.runs:
            mark = MARKS["ok" if run["agrees"] else "fail"]
            yield MarkedText(mark, _describe_run(run))
        yield "to paste above the first table of a scenario:"
        yield self.line

    def _describe_edge(self) -> Iterator[str]:
        """Yields lines on the edge and the sampled-data limit."""
        edge = self.edge
        motion = CharacteristicRoot(0j, 1, tuple(edge["moves"])).description
        yield (
            f"edge: K = {edge['k_per_s2']:.4g} /s^2 times inertia "
            f"({motion}; {edge['omega_rad_s']:.4g} rad/s)"
        )
        continuous = "none"
        if edge["continuous_per_s2"] is not None:
            continuous = f"{edge['continuous_per_s2']:.4g}"
        yield (
            f"  {edge['constant_per_s2']:.4g} with a constant delay of {self.age_ms:.4g} ms; "
            f"{continuous} in continuous time; the {edge['bound']} bounds K"
        )
        yield f"  damping swings from tick to tick from {edge['limit_per_s2']:.4g} on"
        yield f"  least in the pose {', '.join(f'{q:.3g}' for q in edge['pose'])}"


def _format_cell(value: Any) -> str:
    """Returns a table's cell: a number with four digits, a text, or "-"."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return value or "-"


def _describe_run(run: Mapping[str, Any]) -> str:
    """Returns a sentence on a run that confirms the edge or the gains."""
    share = run["share"]
    gains = "these gains" if share is None else f"{share:g} of the edge"
    behaviours = {None: "is undecided", True: "decays", False: "grows"}
    result = behaviours[run["stable"]]
    rate_per_s = run["rate_per_s"]
    if rate_per_s:
        result += f" {rate_per_s:+.3g} /s"
    predicted = f"by its roots {run['predicted_per_s']:+.3g} /s"
    return f"run of {run['ran_s']:.4g} s at {gains}: {result}; {predicted}"


def _read_delay(delay: str | float) -> tuple[dict[str, Any], str]:
    """Returns the table [link] of a delay, and its description.

    For a log it is the link with the longest median delay.

    Raises:
        UsageError: the text is no delay, or the log's delays cannot be used.
    """
    text = str(delay).strip()
    match = _DELAY.fullmatch(text)
    if match:
        delay_ms = float(match[1]) * _UNIT_MS[match[2]]
        return {"delay_ms": delay_ms}, f"{delay_ms:g} ms each way"
    path = Path(text.removeprefix("measured:"))
    if path.suffix not in (".csv", ".mcap"):
        raise UsageError(
            "--delay reads 40ms, measured:run.mcap or a table t_s,delay_ms such as run.csv, "
            f"not {text!r}"
        )
    link = {"model": "trace", "file": str(path), "at_end": "loop"}
    if path.suffix == ".csv":
        return link, f"the delays of {path.name}"
    medians_ms = {}
    try:
        for name in open_log(path).scenario.links:
            delays_ms = [delay_ms for _, delay_ms in read_link_delays(path, name)]
            medians_ms[name] = float(np.median(delays_ms))
    except ValueError as error:
        raise UsageError(f"--delay {text}: {error}") from None
    longest = max(medians_ms, key=lambda name: medians_ms[name])
    return {**link, "of": longest}, f"the delays of {longest} in {path.name}"


def _build_loop(
    arm: str | Path,
    link: Mapping[str, Any],
    law: str,
    overrides: Any,
    *,
    sites: int,
    tip: str,
    rate_hz: int,
) -> Scenario:
    """Returns a scenario of equal arms that follow one another, without friction.

    Its gains are negligible, and its limits do not act on small motions.

    Args:
        arm: path of a URDF, or the name of a shipped file.
        link: the table [link].
        law: the control law.
        overrides: overrides of the scenario.
        sites: number of arms.
        tip: the end link.
        rate_hz: tick rate, Hz.

    Raises:
        UsageError: the law, the number of sites or an override is not valid.
    """
    if law not in TUNED_LAWS:
        known = ", ".join(TUNED_LAWS)
        raise UsageError(
            f"--law {law}: has no stiffness K with a damping d of motion only; {known} have"
        )
    if sites not in _SITES:
        raise UsageError(f"--sites is 2 or 3, not {sites}")
    names = _SITES[sites]
    gains = {gain: _NO_GAIN for gain in ("K", "d", "Kd") if gain in BUILT_IN[law].tune}
    share = 1.0 / (sites - 1)
    roles = {}
    dominance = {}
    for name in names:
        roles[name] = {"role": "slave" if name == "s" else "master"}
        dominance[name] = {peer: share for peer in names if peer != name}
    tables = {
        "name": "tune",
        "duration_s": _SHORTEST_S,
        "rate_hz": rate_hz,
        "arm": {"urdf": str(arm), "tip": tip, "stops": False},
        "control": {"law": law, **gains},
        "limits": {"tau_limit_nm": 1e9, "qd_limit_rad_s": _SMALL},
        "link": dict(link),
        "sites": roles,
        "dominance": dominance,
    }
    scenario = load_scenario(tables, overrides)
    if getattr(scenario.controls[0], "gravity", 1.0) != 1.0:
        raise UsageError(
            "--set control.gravity: only with exact gravity is every pose an equilibrium"
        )
    without_friction = {}
    for name, text in scenario.urdf.items():
        without_friction[name] = re.sub(r"<dynamics\b[^>/]*", "<dynamics", text)
    return msgspec.structs.replace(scenario, urdf=without_friction)


def _draw_poses(scenario: Scenario, count: int, seed: int) -> Array:
    """Returns random poses within the joints' limits, shape (count, n)."""
    ranges = []
    first_site = scenario.sites[scenario.names[0]]
    model = read_arm(first_site.arm, scenario.urdf)
    for joint in model.joints:
        half = _HALF_SLIDE_M if joint.kind == "prismatic" else _HALF_TURN
        middle = min(max(joint.lower, 0.0), joint.upper)
        lower = max(joint.lower, middle - half)
        upper = min(joint.upper, middle + half)
        ranges.append((lower, upper))
    low, high = np.transpose(ranges)
    random = np.random.Generator(np.random.Philox(seed))
    shares = random.uniform(_SLACK, 1.0 - _SLACK, (count, len(low)))
    return np.asarray(low + (high - low) * shares)


class _GainSearch:
    """The loop of equal arms in some poses, for the gains of a ray.

    Args:
        scenario: the loop.
        poses: the poses, shape (count, n).
        margin: factor by which K is below the edge.
        damping: damping ratio of the gains.
        quantile: quantile of varying ages that stands for a constant age.

    Attributes:
        conditions: conditions of the loop.
        constant_conditions: the same with the constant age `age_s` of samples, if ages vary.
        inertia: m, shape (n,).
    """

    def __init__(
        self, scenario: Scenario, poses: Array, margin: float, damping: float, quantile: float
    ) -> None:
        self._scenario = scenario
        self._poses = poses
        self._margin = margin
        # the damping ratio at the edge, where K is larger by the margin
        self._damping = damping / math.sqrt(margin)
        self.conditions = derive_operating_conditions(scenario)
        self.constant_conditions = self.conditions
        self.rate_hz = self.conditions.sites[0].rate_hz
        if self.conditions.varying:
            used = find_samples_in_use(self.conditions).used.values()
            ages_by_link = [np.arange(len(samples)) - samples for samples in used]
            ages = np.concatenate(ages_by_link)
            age_ticks = float(np.quantile(ages, quantile, method="higher"))
            self.constant_conditions = self.fix_age(age_ticks / self.rate_hz)
        self.age_s = float(self.constant_conditions.age_s.max())
        # the heaviest mass is stable up to this k, (2 zeta / T)^2; there the damping shall have
        # its margin to the sampled-data limit
        self._least = (2.0 * self._damping / self.age_s) ** 2
        model = scenario.arms[scenario.names[0]]
        largest_factor = 1.0 if scenario.scheme == "second_order" else 2.0
        self._swings_per_s = largest_factor * self.rate_hz
        self._M = [model.inertia(q) for q in poses]
        self.inertia: Array = np.max([np.diag(M) for M in self._M], axis=0)
        self._fit_inertia()

    def _fit_inertia(self) -> None:
        """Reduces m of the joints of the lightest motion until its damping has the margin."""
        divisor = 2.0 * self._damping * math.sqrt(self._least) * self._margin
        allowed = self._swings_per_s / divisor
        ratio, participation = self._find_lightest()
        while ratio > allowed * (1.0 + _EDGE_TOLERANCE):
            shares = participation / participation.max()
            self.inertia = self.inertia * max(allowed / ratio, _FITTING_STEP) ** shares
            ratio, participation = self._find_lightest()

    def _find_lightest(self) -> tuple[float, Array]:
        """Returns the largest eigenvalue of m M^-1 over the poses, and the joints' shares."""
        # m M^-1 has the eigenvalues of the symmetric m^(1/2) M^-1 m^(1/2)
        root = np.sqrt(self.inertia)
        decompositions = []
        for M in self._M:
            scaled = root * np.linalg.inv(M) * root[:, np.newaxis]
            decompositions.append(np.linalg.eigh(scaled))
        values, vectors = max(decompositions, key=lambda pair: float(pair[0][-1]))
        return float(values[-1]), vectors[:, -1] ** 2

    def fix_age(self, age_s: float) -> OperatingConditions:
        """Returns the conditions with one constant age of samples, s."""
        ages_s: Array = np.where(self.conditions.age_s > 0.0, age_s, 0.0)
        return self.conditions._replace(age_s=ages_s, varying=False)

    def build_law(self, k: float, softer: float = 1.0) -> Any:
        """Returns the law with the gains at k, rounded to four digits.

        Damping gains have the same ratio as the law's defaults.

        Args:
            k: position on the ray of gains, 1/s^2.
            softer: divisor of the stiffness.
        """
        law: Any = self._scenario.controls[0]
        defaults = {}
        for name in ("d", "Kd"):
            if name in law.kind.tune:
                defaults[name] = getattr(law.kind, name)[0]
        default_sum = sum(defaults.values())
        # the damping per unit of the default gains
        damping = 2.0 * self._damping * math.sqrt(k) * self.inertia / default_sum
        gains = {"K": k / softer * self.inertia}
        for name, default in defaults.items():
            gains[name] = default * damping
        rounded = {}
        for name, values in gains.items():
            rounded[name] = tuple(float(f"{value:.4g}") for value in values)
        return msgspec.structs.replace(law, **rounded)

    def find_root(
        self, law: Any, pose: Array, loop: OperatingConditions, *, sampled: bool = True
    ) -> CharacteristicRoot:
        """Returns the rightmost root of a loop with a law at rest in a pose."""
        sites = tuple(site._replace(gains=law.linear_gains(site.theta)) for site in loop.sites)
        poses = np.tile(pose, (len(sites), 1))
        theta = np.array([site.theta for site in sites])
        rest = Equilibrium(poses, theta, "a pose", 0.0)
        root = find_rightmost_root(loop._replace(sites=sites), rest, sampled=sampled)
        if root is None:
            return CharacteristicRoot(complex(_NO_ROOT_PER_S), 1, ())
        return root

    def find_least_edge(
        self,
        loop: OperatingConditions,
        poses: Iterable[Array],
        start: float,
        *,
        sampled: bool = True,
    ) -> tuple[float, Array]:
        """Returns the least k at which small motions grow in a pose, and that pose.

        k is inf if motions grow in no pose. Under varying delays motions may grow, decay and
        grow again with rising k; therefore the first steps of the search are small.

        Args:
            loop: conditions of the loop.
            poses: the poses.
            start: first k of the search.
            sampled: analyse the sampled loop.
        """
        edge = math.inf
        worst_pose = self._poses[0]
        steps = np.arange(24) * math.log(2.0)
        if loop.varying:
            small_steps = np.arange(15) * math.log(1.1)
            steps = np.append(small_steps, math.log(4.0) + steps)
        for pose in poses:

            def growth(log_k: float, pose: Array = pose) -> float:
                law = self.build_law(math.exp(log_k))
                return self.find_root(law, pose, loop, sampled=sampled).s.real

            candidates: Iterable[float] = math.log(start) + steps
            if edge != math.inf:
                # only a pose with a lower edge matters
                candidates = [math.log(edge) - 10.0 * _EDGE_TOLERANCE]
            high = next((log_k for log_k in candidates if growth(log_k) > 0.0), None)
            if high is None:
                continue
            low = next((log_k for log_k in high - steps[1:] if growth(log_k) <= 0.0), None)
            if low is None:
                raise UsageError(f"--arm: no gains are stable in the pose {pose.tolist()}")
            edge = math.exp(brentq(growth, low, high, xtol=_EDGE_TOLERANCE))
            worst_pose = pose
        return edge, worst_pose

    def find_edge(self) -> dict[str, Any]:
        """Returns the edge and the sampled-data limit, see `ArmGains.edge`."""
        constant, pose = self.find_least_edge(
            self.constant_conditions, self._poses, self._least
        )
        varies = self.conditions.varying
        if varies:
            delay_s = self.age_s
        else:
            link = next(iter(self._scenario.links.values()))
            delay_s = 1e-3 * link.moments().mean_ms
        continuous = math.inf
        if delay_s > 0.0:  # without a delay the continuous loop is passive
            fixed = self.fix_age(delay_s)
            continuous, _ = self.find_least_edge(fixed, [pose], self._least, sampled=False)
        k = constant
        if varies:
            k, _ = self.find_least_edge(self.conditions, [pose], 0.5 * constant)
        lightest, _ = self._find_lightest()
        limit = (self._swings_per_s / (2.0 * self._damping * lightest)) ** 2
        root = self.find_root(self.build_law(k), pose, self.conditions)
        limit_with_margin = limit / self._margin**2
        tick_rate_bounds = limit_with_margin < 1.001 * max(self._least, min(k, constant))
        return {
            "k_per_s2": k,
            "constant_per_s2": constant,
            "continuous_per_s2": finite_or_none(continuous),
            "limit_per_s2": limit,
            "used_per_s2": min(k, constant, limit_with_margin),
            "omega_rad_s": root.s.imag,
            "moves": list(root.states),
            "pose": pose.tolist(),
            "bound": "tick rate" if tick_rate_bounds else "delay",
        }

    def trace_edge(self, pose: Array) -> list[tuple[float, float]]:
        """Returns pairs of a delay, s, and the k of the sampled loop's edge in a pose."""
        most = max(4.0 * self.age_s * self.rate_hz, 8.0)
        ages_ticks = np.round(np.geomspace(1.0, most, _CURVE_POINTS))
        ages_s = np.unique(ages_ticks) / self.rate_hz
        curve = []
        for age_s in ages_s:
            start = (2.0 * self._damping / age_s) ** 2
            k, _ = self.find_least_edge(self.fix_age(age_s), [pose], start)
            curve.append((float(age_s), k))
        return curve

    def confirm(
        self, law: Any, share: float | None, pose: Array, push: Array
    ) -> dict[str, Any]:
        """Runs from a pose with the first arm displaced, until motions decay or grow.

        Args:
            law: the law with its gains.
            share: share of the edge's k, for the result; None: the tuned gains.
            pose: the pose.
            push: displacement of the first arm, shape (n,), rad or m.

        Returns:
            The run as in `ArmGains.runs`.
        """
        predicted_per_s = self.find_root(law, pose, self.conditions).s.real
        sites = {}
        for n, (name, spec) in enumerate(self._scenario.sites.items()):
            start = pose + push * (n == 0)
            q0_rad = tuple(start.tolist())
            sites[name] = msgspec.structs.replace(spec, control=law, q0_rad=q0_rad)
        run = FusedRun(msgspec.structs.replace(self._scenario, sites=sites))
        slowest_per_s = max(abs(predicted_per_s), _SETTLES / _LONGEST_S)
        first_s = max(_SHORTEST_S, _SETTLES / slowest_per_s)
        durations_s = first_s * 2.0 ** np.arange(_EXTENSIONS)
        for end_s in durations_s.tolist():
            run.advance_to(end_s)
            speed = np.max([site[:, 1] for site in run.maxima], axis=0)
            t_s = np.arange(len(speed)) / BUCKETS_PER_S
            floor = _STILL * speed.max()
            fit = fit_envelopes(t_s, speed[:, np.newaxis], floor, falls_first=True)[0]
            diverged = run.diverged_s is not None
            if diverged or fit.trend in _IS_STABLE:
                break
        stable = False if diverged else _IS_STABLE.get(fit.trend)
        return {
            "share": share,
            "predicted_per_s": predicted_per_s,
            "rate_per_s": None if diverged else finite_or_none(fit.rate_per_s),
            "ran_s": run.ran_s,
            "stable": stable,
            "agrees": stable is (predicted_per_s < 0.0),
        }


def tune_arm(
    arm: str | Path,
    delay: str | float,
    law: str = "p_d",
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    tip: str = "",
    sites: int = 2,
    rate_hz: int = 1000,
    margin: float = 2.0,
    damping: float = 0.7,
    quantile: float = 1.0,
    poses: int = 16,
    seed: int = 1,
    curve: bool = False,
    progress: Progress = ignore_progress,
) -> ArmGains:
    """Returns the largest gains with which equal arms follow one another stably.

    The command is `trilat tune`.

    >>> found = tn.tune_arm("arm6.urdf", "40ms", poses=2)
    >>> found.agree, len(found.joints)
    (True, 6)

    Args:
        arm: path of a URDF, or the name of a shipped file.
        delay: delay of each link: "40ms", a number of ms, a table t_s,delay_ms, or a log, as
            "measured:run.mcap".
        law: p_d, pd_d or saturated_pd.
        set: overrides of the loop, as in `{"arm.armature_kg_m2": 0.1}`.
        tip: the end link; "": the only link without a child.
        sites: 2, or 3 with equal shares.
        rate_hz: tick rate, Hz.
        margin: factor by which K is below the edge, and the damping below its sampled-data
            limit.
        damping: damping ratio of inertia m against a peer that stands still.
        quantile: quantile of varying delays for which the edge of a constant delay is computed.
        poses: number of poses within the joints' limits.
        seed: seed of the poses.
        curve: compute the edge over the delay too, for a figure.
        progress: called with the number of finished steps and of all steps: the edge and each
            run.

    Raises:
        ScenarioError: the file, its tip or an override is not valid.
        UsageError: another argument is not valid.
    """
    ranges = {
        "margin": (margin, 1.0, 100.0),
        "damping": (damping, 0.01, 10.0),
        "poses": (poses, 1, 1000),
        "quantile": (quantile, 0.0, 1.0),
    }
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise UsageError(f"{name} is from {low:g} to {high:g}, not {value:g}")
    link, delay_text = _read_delay(delay)
    scenario = _build_loop(arm, link, law, set, sites=sites, tip=tip, rate_hz=rate_hz)
    search = _GainSearch(
        scenario=scenario,
        poses=_draw_poses(scenario, poses, seed),
        margin=margin,
        damping=damping,
        quantile=quantile,
    )
    edge = search.find_edge()
    pose = np.array(edge["pose"])
    tuned_law = search.build_law(edge["used_per_s2"], margin)
    random = np.random.Generator(np.random.Philox(seed))
    push = _PUSH * random.uniform(0.5, 1.0, len(pose))
    laws: list[tuple[float | None, Any]] = [(None, tuned_law)]
    laws += [(share, search.build_law(share * edge["k_per_s2"])) for share in SHARES]
    runs = list[dict[str, Any]]()
    for run_share, run_law in laws:
        progress(1 + len(runs), 1 + len(laws))
        runs.append(search.confirm(run_law, run_share, pose, push))
    gains = {}
    assignments = []
    for name in ("K", "Kd", "d"):
        if name in tuned_law.kind.tune:
            values = list(getattr(tuned_law, name))
            gains[name] = values
            assignments.append(f"{name} = {msgspec.json.encode(values).decode()}")
    agree = runs[0]["stable"] is True and all(run["agrees"] for run in runs)
    return ArmGains(
        arm=Path(arm).name,
        law=law,
        sites=sites,
        rate_hz=search.rate_hz,
        delay=delay_text,
        age_ms=1e3 * search.age_s,
        margin=margin,
        damping=damping,
        joints=_tabulate_joints(scenario, search.inertia, gains),
        edge=edge,
        runs=runs,
        agree=agree,
        line=f'control = {{ law = "{law}", {", ".join(assignments)} }}',
        curve=search.trace_edge(pose) if curve else [],
    )


def _tabulate_joints(
    scenario: Scenario, inertia: Array, gains: Mapping[str, list[float]]
) -> list[dict[str, Any]]:
    """Returns a row per joint: m, the gains, their unit, and the error at the effort limit."""
    model = scenario.arms[scenario.names[0]]
    errors = np.divide(model.efforts, gains["K"]).tolist()
    units = zip(model.joint_units("N m"), model.joint_units("rad"), strict=True)
    columns = {
        "joint": model.joint_names,
        "inertia": inertia.tolist(),
        **gains,
        "unit": ["/".join(pair) for pair in units],
        "error_at_effort_limit": [finite_or_none(error) for error in errors],
    }
    rows = zip(*columns.values(), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]
