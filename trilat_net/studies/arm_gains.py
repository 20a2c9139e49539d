"""The largest gains that an arm bears over a delay: the edge along a ray of gains, and runs
that confirm it.

    K = k m,    d + Kd = 2 zeta sqrt(k) m,    m: the largest M_ii of a joint in some poses, or
    less

Alike arms follow one another over links of that delay. The edge is the least k, over the poses,
at which small motions of the sampled loop grow. The gains have its damping, and its stiffness
over the margin. They keep the same margin to the sampled-data limit, where a damping that is
held for a tick makes the lightest motion swing from tick to tick; m is less of joints that
share one too light. For one joint at a wall such edges are known: Gil, Avello, Rubio and
Florez, "Stability analysis of a 1 DOF haptic interface using the Routh-Hurwitz criterion", IEEE
Trans. Control Systems Technology 12 (2004); over delays Hulin, Preusche and Hirzinger,
"Stability boundary for haptic rendering: influence of physical damping", IROS 2006.

Invariant: a result is a function of its arguments. Friction, stops and torque limits are left
out: friction only helps, and limits are no matter of small motions.
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
"""Those with a stiffness and a damping that send nothing but their motion."""
SHARES = (0.95, 1.1)
"""Of the edge, at which runs show that it is one."""
_PUSH = 1e-6
_SMALL = 1.0
_STILL = 1e-7
"""By how much the first arm starts aside, rad or m; from which speed on motions are not small,
rad/s; and what share of the largest speed is rounding.
"""
_SITES = {2: ("m", "s"), 3: ("m1", "m2", "s")}
_SLACK = 0.05
_HALF_TURN = math.pi
_HALF_SLIDE_M = 0.5
"""Share of a joint's range that poses leave at its ends, and half of the range of one without
limits.
"""
_SETTLES = 4.0
_SHORTEST_S = 2.0
_LONGEST_S = 400.0
_EXTENSIONS = 3
"""By how many time constants of its slowest motion a run lasts at first, within which bounds,
s; and how often it may go on for as long again.
"""
_TELLS = {EnvelopeTrend.GROWS: False, EnvelopeTrend.DECAYS: True}
_NO_GAIN = 1e-6
_CURVE_POINTS = 9
_EDGE_TOLERANCE = 1e-4
_FITTING_STEP = 0.9
_GONE_PER_S = -1e3
_DELAY = re.compile(r"(\d+\.?\d*|\.\d+) ?(us|ms|s|)")
_UNIT_MS = {"us": 1e-3, "ms": 1.0, "": 1.0, "s": 1e3}


@dataclass(frozen=True, repr=False)
class ArmGains(Result):
    """The largest gains that an arm bears, with a margin; as the keys of `trilat tune --json`.

    Attributes:
        age_ms: the constant age of samples that stands for the delay.
        joints: of each m, the gains with their unit, and the error at which the effort limit is
            reached.
        edge: k, 1/s^2, of the sampled loop over the delays in use, over a constant one, in
            continuous time (None: never), and where damping swings from tick to tick;
            frequency, motion, pose, what bounds K.
        runs: at the gains (share None) and at shares of the edge's k: how fast the largest
            speed grows (None: until motions were not small), and the roots.
        agree: whether all runs do as the roots predict, and the one at the gains decays.
        line: the gains, to paste above the tables of a scenario.
        curve: delays, s, and k of the edge in the same pose, if asked for.
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
        edge = self.edge
        about = f"damping ratio {self.damping:g}, margin {self.margin:g}"
        yield f"{self.arm}: {self.sites} such arms, {self.law}, {self.rate_hz} Hz, {self.delay}, {about}"
        rows = [list(row.values()) for row in self.joints]
        cells = [
            [f"{one:.4g}" if isinstance(one, float) else one or "-" for one in row]
            for row in rows
        ]
        yield TextTable([head.replace("_", " ") for head in self.joints[0]], cells, align="lr")
        moves = f"{CharacteristicRoot(0j, 1, tuple(edge['moves'])).description}; {edge['omega_rad_s']:.4g} rad/s"
        yield f"edge: K = {edge['k_per_s2']:.4g} /s^2 times inertia ({moves})"
        smooth = (
            "none" if edge["continuous_per_s2"] is None else f"{edge['continuous_per_s2']:.4g}"
        )
        constant = (
            f"{edge['constant_per_s2']:.4g} with a constant delay of {self.age_ms:.4g} ms"
        )
        yield f"  {constant}; {smooth} in continuous time; the {edge['bound']} bounds K"
        yield f"  damping swings from tick to tick from {edge['limit_per_s2']:.4g} on"
        yield f"  least in the pose {', '.join(f'{q:.3g}' for q in edge['pose'])}"
        for run in self.runs:
            where = "these gains" if run["share"] is None else f"{run['share']:g} of the edge"
            found = {None: "does not tell", True: "decays", False: "grows"}[run["stable"]]
            found += f" {run['rate_per_s']:+.3g} /s" if run["rate_per_s"] else ""
            found += f"; by its roots {run['predicted_per_s']:+.3g} /s"
            mark = MARKS["ok" if run["agrees"] else "fail"]
            yield MarkedText(mark, f"run of {run['ran_s']:.4g} s at {where}: {found}")
        yield "to paste above the first table of a scenario:"
        yield self.line


def _read_delay(delay: str | float) -> tuple[dict[str, Any], str]:
    """Returns the [link] of a delay, and its words; of a log the link with the longest delays."""
    text = str(delay).strip()
    if found := _DELAY.fullmatch(text):
        delay_ms = float(found[1]) * _UNIT_MS[found[2]]
        return {"delay_ms": delay_ms}, f"{delay_ms:g} ms each way"
    path = Path(text.removeprefix("measured:"))
    if path.suffix not in (".csv", ".mcap"):
        raise UsageError(
            f"--delay reads 40ms, measured:run.mcap or a table t_s,delay_ms such as run.csv, not {text!r}"
        )
    link = {"model": "trace", "file": str(path), "at_end": "loop"}
    if path.suffix == ".csv":
        return link, f"the delays of {path.name}"
    try:
        delays_ms = {
            name: read_link_delays(path, name) for name in open_log(path).scenario.links
        }
    except ValueError as error:
        raise UsageError(f"--delay {text}: {error}") from None
    longest = max(
        delays_ms, key=lambda name: float(np.median([ms for _, ms in delays_ms[name]]))
    )
    return {**link, "of": longest}, f"the delays of {longest} in {path.name}"


def _set_up_loop(
    arm: str | Path, link: Mapping[str, Any], law: str, more: Any, **at: Any
) -> Scenario:
    """Returns alike arms that follow one another, without friction and with hardly any gains."""
    if law not in TUNED_LAWS:
        known = ", ".join(TUNED_LAWS)
        raise UsageError(
            f"--law {law}: has no stiffness K beside a damping d of motion alone; {known} have"
        )
    if (sites := at.pop("sites")) not in _SITES:
        raise UsageError(f"--sites is 2 or 3, not {sites}")
    names = _SITES[sites]
    tip = at.pop("tip")
    tables = {
        "name": "tune",
        "duration_s": _SHORTEST_S,
        **at,
        "arm": {"urdf": str(arm), "tip": tip, "stops": False},
        "control": {
            "law": law,
            **{one: _NO_GAIN for one in ("K", "d", "Kd") if one in BUILT_IN[law].tune},
        },
        "limits": {"tau_limit_nm": 1e9, "qd_limit_rad_s": _SMALL},
        "link": dict(link),
        "sites": {one: {"role": "slave" if one == "s" else "master"} for one in names},
        "dominance": {one: {p: 1.0 / (sites - 1) for p in names if p != one} for one in names},
    }
    loaded = load_scenario(tables, more)
    if getattr(loaded.controls[0], "gravity", 1.0) != 1.0:
        raise UsageError(
            "--set control.gravity: only with exact gravity is every pose one of rest"
        )
    smooth = {
        name: re.sub(r"<dynamics\b[^>/]*", "<dynamics", text)
        for name, text in loaded.urdf.items()
    }
    return msgspec.structs.replace(loaded, urdf=smooth)


def _draw_poses(scenario: Scenario, count: int, seed: int) -> Array:
    """Returns poses within the joints' limits, shape (count, n)."""
    ranges = []
    for joint in read_arm(scenario.sites[scenario.names[0]].arm, scenario.urdf).joints:
        half = _HALF_SLIDE_M if joint.kind == "prismatic" else _HALF_TURN
        middle = min(max(joint.lower, 0.0), joint.upper)
        ranges.append((max(joint.lower, middle - half), min(joint.upper, middle + half)))
    low, high = np.transpose(ranges)
    shares = np.random.Generator(np.random.Philox(seed)).uniform(
        _SLACK, 1.0 - _SLACK, (count, len(low))
    )
    return np.asarray(low + (high - low) * shares)


class _GainSearch:
    """The loop of alike arms in some poses, for the gains of a ray.

    Attributes:
        conditions: of the loop; `held` with the constant age `age_s` of samples, where theirs
            varies.
        inertia: m, shape (n,).
    """

    def __init__(
        self, scenario: Scenario, poses: Array, margin: float, damping: float, quantile: float
    ) -> None:
        self._scenario = scenario
        self._poses = poses
        self._margin = margin
        # at the edge, where K is larger by the margin
        self._damping = damping = damping / math.sqrt(margin)
        self.conditions = self.held = derive_operating_conditions(scenario)
        self.rate_hz = self.held.sites[0].rate_hz
        if self.conditions.varying:
            used = find_samples_in_use(self.conditions).used.values()
            ages = np.concatenate([np.arange(len(one)) - one for one in used])
            self.held = self.delay_by(
                float(np.quantile(ages, quantile, method="higher")) / self.rate_hz
            )
        self.age_s = float(self.held.age_s.max())
        # the heaviest mass is stable up to k = (2 zeta / T)^2, where the damping shall have its margin
        self._least = (2.0 * damping / self.age_s) ** 2
        model = scenario.arms[scenario.names[0]]
        most = 1.0 if scenario.scheme == "second_order" else 2.0
        self._swings_per_s = most * self.rate_hz
        self._M = [model.inertia(q) for q in poses]
        self.inertia: Array = np.max([np.diag(M) for M in self._M], axis=0)
        wanted = self._swings_per_s / (2.0 * damping * math.sqrt(self._least) * margin)
        while (found := self._find_lightest())[0] > wanted * (1.0 + _EDGE_TOLERANCE):
            shares = found[1] / found[1].max()
            self.inertia = self.inertia * max(wanted / found[0], _FITTING_STEP) ** shares

    def _find_lightest(self) -> tuple[float, Array]:
        """Returns the largest eigenvalue of m M^-1 in a pose, and the joints' shares in that
        motion.
        """
        root = np.sqrt(self.inertia)
        pairs = [np.linalg.eigh(root * np.linalg.inv(M) * root[:, np.newaxis]) for M in self._M]
        values, vectors = max(pairs, key=lambda pair: float(pair[0][-1]))
        return float(values[-1]), vectors[:, -1] ** 2

    def delay_by(self, age_s: float) -> OperatingConditions:
        """Returns the conditions with one constant age of samples."""
        same: Array = np.where(self.conditions.age_s > 0.0, age_s, 0.0)
        return self.conditions._replace(age_s=same, varying=False)

    def at(self, k: float, softer: float = 1.0) -> Any:
        """Returns the law at k, 1/s^2; with its stiffness divided by `softer`. Gains have four
        digits.

        What damps has the shares of the law's defaults.
        """
        law: Any = self._scenario.controls[0]
        usual = {
            name: getattr(law.kind, name)[0] for name in ("d", "Kd") if name in law.kind.tune
        }
        D = 2.0 * self._damping * math.sqrt(k) * self.inertia / sum(usual.values())
        gains = {
            "K": k / softer * self.inertia,
            **{name: one * D for name, one in usual.items()},
        }
        rounded = {name: tuple(float(f"{x:.4g}") for x in own) for name, own in gains.items()}
        return msgspec.structs.replace(law, **rounded)

    def find_root(
        self, law: Any, pose: Array, loop: OperatingConditions, *, sampled: bool = True
    ) -> CharacteristicRoot:
        """Returns the rightmost root of a loop with a law at rest in a pose."""
        sites = tuple(site._replace(gains=law.linear_gains(site.theta)) for site in loop.sites)
        theta = np.array([site.theta for site in sites])
        rest = Equilibrium(np.tile(pose, (len(sites), 1)), theta, "a pose", 0.0)
        found = find_rightmost_root(loop._replace(sites=sites), rest, sampled=sampled)
        return found or CharacteristicRoot(complex(_GONE_PER_S), 1, ())

    def find_least(
        self,
        loop: OperatingConditions,
        poses: Iterable[Array],
        start: float,
        *,
        sampled: bool = True,
    ) -> tuple[float, Array]:
        """Returns the least k at which small motions grow in a pose, and that pose; inf if in
        none.

        Under delays that vary they may grow, and not, and grow again: then the first steps are
        small.
        """
        edge = math.inf
        worst = self._poses[0]
        small = np.arange(15) * math.log(1.1)
        steps = np.arange(24) * math.log(2.0)
        steps = np.append(small, math.log(4.0) + steps) if loop.varying else steps
        for pose in poses:

            def growth(log_k: float, pose: Array = pose) -> float:
                return self.find_root(
                    self.at(math.exp(log_k)), pose, loop, sampled=sampled
                ).s.real

            tried = (
                math.log(start) + steps
                if edge == math.inf
                else [math.log(edge) - 10.0 * _EDGE_TOLERANCE]
            )
            high = next((one for one in tried if growth(one) > 0.0), None)
            if high is not None:
                low = next((one for one in high - steps[1:] if growth(one) <= 0.0), None)
                if low is None:
                    raise UsageError(f"--arm: no gains are stable in the pose {pose.tolist()}")
                edge = math.exp(brentq(growth, low, high, xtol=_EDGE_TOLERANCE))
                worst = pose
        return edge, worst

    def find_edge(self) -> dict[str, Any]:
        constant, pose = self.find_least(self.held, self._poses, self._least)
        k = constant
        continuous = math.inf
        link = next(iter(self._scenario.links.values()))
        varies = self.conditions.varying
        delay_s = self.age_s if varies else 1e-3 * link.moments().mean_ms
        if delay_s > 0.0:  # without a delay such a loop is passive
            continuous, _ = self.find_least(
                self.delay_by(delay_s), [pose], self._least, sampled=False
            )
        if varies:
            k, _ = self.find_least(self.conditions, [pose], 0.5 * constant)
        limit = (self._swings_per_s / (2.0 * self._damping * self._find_lightest()[0])) ** 2
        root = self.find_root(self.at(k), pose, self.conditions)
        damped = limit / self._margin**2
        by_rate = damped < 1.001 * max(self._least, min(k, constant))
        return {
            "k_per_s2": k,
            "constant_per_s2": constant,
            "continuous_per_s2": finite_or_none(continuous),
            "limit_per_s2": limit,
            "used_per_s2": min(k, constant, damped),
            "omega_rad_s": root.s.imag,
            "moves": list(root.states),
            "pose": pose.tolist(),
            "bound": "tick rate" if by_rate else "delay",
        }

    def trace_edge(self, pose: Array) -> list[tuple[float, float]]:
        """Returns delays about the age, s, each with k of the sampled loop at the edge in a
        pose.
        """
        most = max(4.0 * self.age_s * self.rate_hz, 8.0)
        ages_s = np.unique(np.round(np.geomspace(1.0, most, _CURVE_POINTS))) / self.rate_hz
        found = [
            self.find_least(self.delay_by(T), [pose], (2.0 * self._damping / T) ** 2)
            for T in ages_s
        ]
        return [(float(T), k) for T, (k, _) in zip(ages_s, found, strict=True)]

    def confirm(
        self, law: Any, share: float | None, pose: Array, push: Array
    ) -> dict[str, Any]:
        """Runs from a pose, the first arm pushed aside, until it is told whether small motions
        decay.
        """
        predicted_per_s = self.find_root(law, pose, self.conditions).s.real
        sites = {
            name: msgspec.structs.replace(
                spec, control=law, q0_rad=tuple((pose + push * (n == 0)).tolist())
            )
            for n, (name, spec) in enumerate(self._scenario.sites.items())
        }
        run = FusedRun(msgspec.structs.replace(self._scenario, sites=sites))
        first_s = max(_SHORTEST_S, _SETTLES / max(abs(predicted_per_s), _SETTLES / _LONGEST_S))
        for end_s in (first_s * 2.0 ** np.arange(_EXTENSIONS)).tolist():
            run.advance_to(end_s)
            speed = np.max([site[:, 1] for site in run.maxima], axis=0)
            t_s = np.arange(len(speed)) / BUCKETS_PER_S
            fit = fit_envelopes(
                t_s, speed[:, np.newaxis], _STILL * speed.max(), falls_first=True
            )[0]
            left = run.diverged_s is not None
            if left or fit.trend in _TELLS:
                break
        stable = False if left else _TELLS.get(fit.trend)
        return {
            "share": share,
            "predicted_per_s": predicted_per_s,
            "rate_per_s": None if left else finite_or_none(fit.rate_per_s),
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
    """Returns the largest gains with which alike arms follow one another stably; as `trilat
    tune`.

    >>> found = tn.tune_arm("arm6.urdf", "40ms", poses=2)
    >>> found.agree, len(found.joints)
    (True, 6)

    Args:
        arm: path of a URDF, or the name of a shipped one.
        delay: of each link: "40ms", a number of ms, a table t_s,delay_ms, or a log, as
            "measured:run.mcap".
        law: p_d, pd_d or saturated_pd.
        set: overrides of the loop, as in `{"arm.armature_kg_m2": 0.1}`.
        tip: the end link; "": the only one that nothing hangs on.
        sites: 2, or 3 with equal shares.
        rate_hz: tick rate, Hz.
        margin: by how much K is below the edge, and the damping below its sampled-data limit.
        damping: the damping ratio of inertia m against a peer that stands.
        quantile: of delays that vary, the one that the edge of a constant delay is for.
        poses: how many poses within the joints' limits are tried.
        seed: seed of the poses.
        curve: whether to find the edge over the delay too, for a figure.
        progress: called with the steps done, and in all: the edge, and each run.

    Raises:
        ScenarioError: the file, its tip or an override is not valid.
        UsageError: another argument is not valid.
    """
    ranges = {
        "margin": (margin, 1.0, 100.0),
        "damping": (damping, 0.01, 10.0),
        "poses": (poses, 1, 1000),
    }
    for name, (value, low, high) in {**ranges, "quantile": (quantile, 0.0, 1.0)}.items():
        if not low <= value <= high:
            raise UsageError(f"{name} is from {low:g} to {high:g}, not {value:g}")
    link, words = _read_delay(delay)
    scenario = _set_up_loop(arm, link, law, set, sites=sites, tip=tip, rate_hz=rate_hz)
    search = _GainSearch(
        scenario=scenario,
        poses=_draw_poses(scenario, poses, seed),
        margin=margin,
        damping=damping,
        quantile=quantile,
    )
    edge = search.find_edge()
    pose = np.array(edge["pose"])
    found = search.at(edge["used_per_s2"], margin)
    push = _PUSH * np.random.Generator(np.random.Philox(seed)).uniform(0.5, 1.0, len(pose))
    tried = [(None, found), *((share, search.at(share * edge["k_per_s2"])) for share in SHARES)]
    runs = list[dict[str, Any]]()
    for share, one in tried:
        progress(1 + len(runs), 1 + len(tried))
        runs.append(search.confirm(one, share, pose, push))
    gains = {
        name: list(getattr(found, name)) for name in ("K", "Kd", "d") if name in found.kind.tune
    }
    cells = ", ".join(
        f"{name} = {msgspec.json.encode(own).decode()}" for name, own in gains.items()
    )
    model = scenario.arms[scenario.names[0]]
    units = map("/".join, zip(model.joint_units("N m"), model.joint_units("rad"), strict=True))
    errors = map(finite_or_none, np.divide(model.efforts, gains["K"]).tolist())
    heads = ("joint", "inertia", *gains, "unit", "error_at_effort_limit")
    columns = (model.joint_names, search.inertia.tolist(), *gains.values(), units, errors)
    joints = [dict(zip(heads, row, strict=True)) for row in zip(*columns, strict=True)]
    asked = (
        Path(arm).name,
        law,
        sites,
        search.rate_hz,
        words,
        1e3 * search.age_s,
        margin,
        damping,
    )
    agree = runs[0]["stable"] is True and all(run["agrees"] for run in runs)
    line = f'control = {{ law = "{law}", {cells} }}'
    over = search.trace_edge(pose) if curve else []
    return ArmGains(*asked, joints, edge, runs, agree, line, over)
