"""Finds the largest gains with which identical arms can follow one another over a delay.

The longer the delay, the smaller the gains must be for the arms to remain stable. Given an arm
model and a delay, `tune_arm` computes for each joint a stiffness K and damping gains: d for the
velocity and, in some control laws, Kd for the rate of the position error. A single parameter k,
in 1/s^2, determines all of them:

    K = k m,    d + Kd = 2 zeta sqrt(k) m,

where zeta is the damping ratio and m is the largest inertia of the joint about its own axis
over a set of poses.

Two limits bound the gains, and the result keeps a margin to both:

- Stability under the delay: the edge is the smallest k at which small motions of the sampled
  control loop grow in one of the poses. The tuned stiffness is the stiffness at the edge
  divided by the margin. The edge is checked with simulated runs.
- Damping at the tick rate: a damping torque stays constant for a whole tick, so excessive
  damping reverses the velocity in every tick. This happens first in the direction in which the
  arm has the least inertia. If this limit requires it, a smaller m is used.

For the stability edge of a single joint at a wall, see J. J. Gil, A. Avello, A. Rubio and J.
Florez, "Stability analysis of a 1 DOF haptic interface using the Routh-Hurwitz criterion", IEEE
Trans. Control Systems Technology 12 (2004); for the edge with delays, T. Hulin, C. Preusche and
G. Hirzinger, "Stability boundary for haptic rendering: influence of physical damping", IROS
2006.

Invariant:
    - A result depends only on the arguments.
    - Friction, joint stops and torque limits are ignored: friction only stabilises the loop,
      and the limits do not affect small motions.
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

from trilat_net.analysis import EnvelopeTrend, RestingLoop
from trilat_net.core import Array
from trilat_net.errors import LogError, UsageError
from trilat_net.execution import FusedRun
from trilat_net.log import open_log
from trilat_net.presentation import MARKS, Block, MarkedText, TextTable, describe_moving_states
from trilat_net.results import Result, finite_or_none
from trilat_net.scenario import BUILT_IN, Scenario, load_scenario
from trilat_net.work import Progress

TUNED_LAWS = tuple(
    name
    for name, law in BUILT_IN.items()
    if {"K", "d"} <= law.tune.keys() and not getattr(law, "sends", ())
)
"""Control laws that have a stiffness and a damping and send only the motion of their arm."""
SHARES = (0.95, 1.1)
"""Values of k, as fractions of k at the edge, at which runs check the edge."""
_PUSH = 1e-6
"""Largest initial displacement of the joints of the first arm, in rad or m."""
_SMALL = 1.0
"""Speed above which a motion is no longer considered small, in rad/s."""
_SITES = {2: ("m", "s"), 3: ("m1", "m2", "s")}
"""Site names for each number of sites."""
_SLACK = 0.05
"""Fraction of a joint's range, at either end, that the drawn poses avoid."""
_HALF_TURN = math.pi
"""Half of the range of a revolute joint without limits, in rad."""
_HALF_SLIDE_M = 0.5
"""Half of the range of a prismatic joint without limits, in m."""
_SETTLES = 4.0
"""Initial duration of a run, in time constants of its slowest motion."""
_SHORTEST_S = 2.0
"""Smallest initial duration of a run, in s."""
_LONGEST_S = 400.0
"""Largest initial duration of a run, in s."""
_EXTENSIONS = 3
"""Number of durations to try for a run, each twice as long as the previous one."""
_IS_STABLE = {EnvelopeTrend.GROWS: False, EnvelopeTrend.DECAYS: True}
"""Stability of a run for each trend of its speed. All other trends leave it undecided."""
_NO_GAIN = 1e-6
"""Negligible gain used in the loop until its gains are set."""
_CURVE_POINTS = 9
"""Number of delays for which the edge is computed for a figure."""
_EDGE_TOLERANCE = 1e-4
"""Tolerance of ln k at the edge."""
_FITTING_STEP = 0.9
"""Smallest factor by which m is multiplied in one step."""
_DELAY = re.compile(r"(\d+\.?\d*|\.\d+) ?(us|ms|s|)")
"""A number with an optional unit, such as "40ms"."""
_UNIT_MS = {"us": 1e-3, "ms": 1.0, "": 1.0, "s": 1e3}
"""Delay units in ms. A number without a unit is in ms."""


@dataclass(frozen=True, repr=False)
class ArmGains(Result):
    """The largest stable gains for an arm, reduced by a safety margin.

    The gains are computed for two or three identical arms that follow one another over delayed
    links. One parameter k, in 1/s^2, determines all gains: the stiffness of a joint is K = k m,
    where m is the inertia of the joint. The edge of stability is the k above which small
    motions grow. `tune_arm` creates this object. Its JSON keys are the attribute names.

    Attributes:
        arm: File name of the arm's URDF.
        law: Name of the control law.
        sites: Number of arms.
        rate_hz: Tick rate of the control loop, in Hz.
        delay: Description of the link delay.
        age_ms: Constant sample age that represents the delay, in ms.
        margin: Ratio of the stiffness at the edge to the tuned stiffness.
        damping: Damping ratio of the gains.
        joints: For each joint, the inertia m, the gains with their unit, and the position error
            at which the joint reaches its effort limit.
        edge: Values of k at the edge, in 1/s^2, for three models: the sampled loop with the
            actual delays, the sampled loop with a constant delay, and the loop in continuous
            time. A value is `None` if there is no edge. Further entries are the smallest k at
            which the damping makes a motion oscillate from tick to tick; the frequency, motion
            and pose at the edge; and whether the delay or the tick rate limits K.
        runs: Simulated runs that check the gains. `share` is the k of the run as a fraction of
            the k at the edge, or `None` for the run with the tuned gains. Each run has two
            growth rates. The first is measured from the largest speed, and is `None` if the
            motions were not small. The second is predicted from the characteristic roots of the
            linearised loop.
        agree: True if all runs behave as the roots predict and the motions decay with the tuned
            gains.
        line: The gains as a line to paste above the tables of a scenario.
        curve: Pairs of a delay, in s, and k at the edge in the same pose. Empty unless
            requested.
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
        """Returns the inertia and the gains of each joint, as the rows of the CSV file."""
        return self.joints

    def blocks(self) -> Iterator[Block]:
        """Yields the sections of the report that `trilat tune` prints.

        The report describes the control loop, lists the gains of each joint, states the
        stability limit, and shows the simulated runs that check this limit. It ends with the
        gains as a line that can be pasted into a scenario.
        """
        yield (
            f"{self.arm}: {self.sites} equal arms, {self.law}, {self.rate_hz} Hz, "
            f"{self.delay}, damping ratio {self.damping:g}, margin {self.margin:g}"
        )

        first_joint = self.joints[0]
        header = [key.replace("_", " ") for key in first_joint]
        rows = []
        for joint in self.joints:
            row = [_format_cell(value) for value in joint.values()]
            rows.append(row)
        yield TextTable(header, rows, align="lr")

        yield from self._describe_edge()
        for run in self.runs:
            outcome = "ok" if run["agrees"] else "fail"
            mark = MARKS[outcome]
            yield MarkedText(mark, _describe_run(run))

        yield "to paste above the first table of a scenario:"
        yield self.line

    def _describe_edge(self) -> Iterator[str]:
        """Yields the lines of the report on the limits of k, in 1/s^2.

        The stiffness of a joint is K = k m, where m is its inertia. The limits (see the
        attribute `edge`) are the smallest values of k at which

        - small motions grow, which is the edge of stability: in the loop as it is, with a
          constant delay, and in continuous time ("none" if they never grow there);
        - the damping, which grows with sqrt(k), reverses a velocity in every tick.

        The lines also state which joints move at the edge and at which frequency, the pose with
        the lowest edge, and which of the two limits bounds the stiffness.
        """
        edge = self.edge
        motion = describe_moving_states(edge["moves"])
        yield (
            f"edge: K = {edge['k_per_s2']:.4g} /s^2 times inertia "
            f"({motion}; {edge['omega_rad_s']:.4g} rad/s)"
        )

        continuous_text = "none"
        continuous_per_s2 = edge["continuous_per_s2"]
        if continuous_per_s2 is not None:
            continuous_text = f"{continuous_per_s2:.4g}"
        yield (
            f"  {edge['constant_per_s2']:.4g} with a constant delay of {self.age_ms:.4g} ms; "
            f"{continuous_text} in continuous time; the {edge['bound']} bounds K"
        )
        yield f"  damping swings from tick to tick from {edge['limit_per_s2']:.4g} on"

        pose_text = ", ".join(f"{q:.3g}" for q in edge["pose"])
        yield f"  least in the pose {pose_text}"


def _format_cell(value: Any) -> str:
    """Formats a table cell, rounding a number to four digits.

    A string is returned unchanged, and an empty value becomes "-".
    """
    if isinstance(value, float):
        return f"{value:.4g}"
    return value or "-"


def _describe_run(run: Mapping[str, Any]) -> str:
    """Returns a sentence about a simulation that checks the stability limit or the gains.

    Example: "run of 20 s at 0.97 of the edge: decays -0.12 /s; by its roots -0.118 /s".

    Args:
        run: The run, as in `ArmGains.runs`.
    """
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
    """Parses the delay for which gains are computed.

    Args:
        delay: A number with an optional unit, a table of delays, or a log. From a log, the link
            with the longest median delay is used.

    Returns:
        The table [link] of a scenario with this delay, and a description for the user.

    Raises:
        UsageError: The text is not a delay, or the delays of the log cannot be used.
    """
    text = str(delay).strip()
    match = _DELAY.fullmatch(text)
    if match:
        unit_ms = _UNIT_MS[match[2]]
        delay_ms = float(match[1]) * unit_ms
        return {"delay_ms": delay_ms}, f"{delay_ms:g} ms each way"

    path = Path(text.removeprefix("measured:"))
    if path.suffix not in (".csv", ".mcap"):
        raise UsageError(
            "--delay must be a time such as 40ms, a log such as measured:run.mcap, or a table "
            f"of t_s,delay_ms such as run.csv, not {text!r}"
        )
    link = {"model": "trace", "file": str(path), "at_end": "loop"}
    if path.suffix == ".csv":
        return link, f"the delays of {path.name}"

    medians_ms = {}
    log = open_log(path)
    try:
        link_delays = log.link_delays
    except LogError as error:
        raise UsageError(f"--delay {text}: {str(error).removeprefix(f'{path}: ')}") from None
    for name in log.scenario.links:
        delays = link_delays[name]
        if not delays:
            raise UsageError(f"--delay {text}: no sample arrived over {name}")
        medians_ms[name] = float(np.median([delay_ms for _, delay_ms in delays]))
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
    """Builds a scenario of identical arms that follow one another without friction.

    The scenario has negligible gains, which the search replaces, and limits so wide that they
    do not affect small motions.

    Args:
        arm: Path of a URDF, or the name of a shipped file.
        link: Table [link], which contains the delay.
        law: Name of the control law.
        overrides: Overrides of the scenario.
        sites: Number of arms.
        tip: Name of the end link.
        rate_hz: Tick rate, in Hz.

    Raises:
        UsageError: The law, the number of sites or an override is not valid.
    """
    if law not in TUNED_LAWS:
        known = ", ".join(TUNED_LAWS)
        raise UsageError(
            f"--law must be one of {known}, which have a stiffness K and a damping d that "
            f"acts on motion only, not {law}"
        )
    if sites not in _SITES:
        raise UsageError(f"--sites must be 2 or 3, not {sites}")

    names = _SITES[sites]
    tuned_gains = BUILT_IN[law].tune
    gains = {gain: _NO_GAIN for gain in ("K", "d", "Kd") if gain in tuned_gains}
    peer_count = sites - 1
    dominance_factor = 1.0 / peer_count
    roles = {}
    dominance = {}
    for name in names:
        role = "slave" if name == "s" else "master"
        roles[name] = {"role": role}
        peers = [peer for peer in names if peer != name]
        dominance[name] = dict.fromkeys(peers, dominance_factor)
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
    control = scenario.controls[0]
    if getattr(control, "gravity", 1.0) != 1.0:
        raise UsageError(
            "--set control.gravity: gravity must be exact here, because only then is every "
            "pose an equilibrium"
        )

    # Friction and damping of the joints are the attributes of the URDF's <dynamics>.
    without_friction = {}
    for name, text in scenario.urdf.items():
        without_friction[name] = re.sub(r"<dynamics\b[^>/]*", "<dynamics", text)
    return msgspec.structs.replace(scenario, urdf=without_friction)


def _draw_poses(scenario: Scenario, count: int, seed: int) -> Array:
    """Draws random poses within the joint limits.

    A joint with no limits, or with wide limits, stays within half a turn or half a metre of the
    position closest to 0.

    Args:
        scenario: Scenario with the arm.
        count: Number of poses.
        seed: Random seed.

    Returns:
        Joint angles or positions, shape (count, n), in rad or m.
    """
    ranges = []
    first_site = scenario.sites[scenario.names[0]]
    model = first_site.arm.read_chain(scenario.urdf)
    for joint in model.joints:
        half_range = _HALF_SLIDE_M if joint.kind == "prismatic" else _HALF_TURN
        at_least_lower = max(joint.lower, 0.0)
        middle = min(at_least_lower, joint.upper)
        lower = max(joint.lower, middle - half_range)
        upper = min(joint.upper, middle + half_range)
        ranges.append((lower, upper))

    low, high = np.transpose(ranges)
    bit_generator = np.random.Philox(seed)
    random = np.random.Generator(bit_generator)
    shape = (count, len(low))
    fractions = random.uniform(_SLACK, 1.0 - _SLACK, shape)

    width = high - low
    return np.asarray(low + width * fractions)


class _GainSearch:
    """Search for the edge of stability of identical arms whose gains depend on one parameter.

    The stiffness of each joint is K = k m, where m is its inertia and k the parameter, in
    1/s^2. The edge is the smallest k at which small motions of the linearised loop grow.

    Args:
        scenario: Scenario of the loop, see `_build_loop`.
        poses: Poses in which the loop is analysed, shape (count, n).
        margin: Factor by which the stiffness is kept below the edge.
        damping: Damping ratio of the gains.
        quantile: With varying sample ages, the quantile that is used as the constant age.

    Attributes:
        loop: The linearised loop of the arms.
        constant_loop: The same loop with the constant sample age `age_s`. Equal to `loop` if
            the ages do not vary.
        rate_hz: Tick rate, in Hz.
        age_s: Constant sample age, in s.
        inertia: Inertia m of each joint, shape (n,).
    """

    def __init__(
        self,
        scenario: Scenario,
        poses: Array,
        margin: float,
        damping: float,
        quantile: float,
    ) -> None:
        self._scenario = scenario
        self._poses = poses
        self._margin = margin
        # Damping ratio at the edge, where the damping is the same and K is larger by the
        # margin.
        self._damping = damping / math.sqrt(margin)

        self.loop = RestingLoop.of_scenario(scenario)
        self.constant_loop = self.loop
        self.rate_hz = self.loop.rate_hz
        if self.loop.varies:
            self.constant_loop = self.loop.fix_age(self.loop.find_age_quantile_s(quantile))
        self.age_s = self.constant_loop.largest_age_s
        # The heaviest mass is stable up to k = (2 zeta / T)^2, where T is the age. At this k
        # the damping must keep its margin to the sampled-data limit.
        omega_rad_s = 2.0 * self._damping / self.age_s
        self._least_k = omega_rad_s**2

        first_site = scenario.names[0]
        model = scenario.arms[first_site]
        largest_factor = 1.0 if scenario.scheme == "second_order" else 2.0
        # A motion swings from tick to tick if its damping per inertia exceeds this value.
        self._largest_damping_per_s = largest_factor * self.rate_hz

        self._M = [model.inertia(q) for q in poses]
        diagonals = [np.diag(M) for M in self._M]
        self.inertia: Array = np.max(diagonals, axis=0)
        self._fit_inertia()

    def _fit_inertia(self) -> None:
        """Reduces the inertias m of the joints until the damping suits the tick rate.

        The gains are proportional to the inertia m of a joint about its own axis: the damping
        is 2 zeta sqrt(k) m, in N m s/rad. A motion of several joints together can have a
        smaller inertia than m. Relative to this inertia, the damping is larger by a ratio r,
        the largest eigenvalue of m M^-1, where M is the inertia matrix:

            damping per inertia = 2 zeta sqrt(k) r, in 1/s

        Above the sampled-data limit (one or two times the tick rate), the motion would
        oscillate from tick to tick. This method reduces m until the damping keeps its margin to
        this limit at the smallest k that the search considers.

        Only joints that take part in the lightest motion (the one with the ratio r) need to be
        changed. The m of the joint with the largest participation is multiplied by a factor
        below 1, and that of any other joint by this factor to the power of its relative
        participation. Afterwards another motion may be the lightest, so this is repeated in
        small steps.
        """
        damping_per_inertia_per_s = 2.0 * self._damping * math.sqrt(self._least_k)
        damping_with_margin_per_s = damping_per_inertia_per_s * self._margin
        allowed_ratio = self._largest_damping_per_s / damping_with_margin_per_s
        ratio, participation = self._find_lightest()
        largest_ratio = allowed_ratio * (1.0 + _EDGE_TOLERANCE)
        while ratio > largest_ratio:
            relative_participation = participation / participation.max()
            factor = max(allowed_ratio / ratio, _FITTING_STEP)
            self.inertia = self.inertia * factor**relative_participation
            ratio, participation = self._find_lightest()

    def _find_lightest(self) -> tuple[float, Array]:
        """Finds the motion with the smallest inertia relative to the inertias m of its joints.

        Returns:
            The largest eigenvalue of m M^-1 over the poses, where M is the inertia matrix; and
            the participation of each joint in that motion, shape (n,), which adds up to 1.
        """
        # m M^-1 has the eigenvalues of the symmetric matrix m^(1/2) M^-1 m^(1/2).
        root = np.sqrt(self.inertia)
        decompositions = []
        for M in self._M:
            scaled = root * np.linalg.inv(M) * root[:, np.newaxis]
            decompositions.append(np.linalg.eigh(scaled))
        values, vectors = max(decompositions, key=lambda pair: float(pair[0][-1]))
        largest_ratio = float(values[-1])
        lightest_motion = vectors[:, -1]
        return largest_ratio, lightest_motion**2

    def build_law(self, k: float, stiffness_divisor: float = 1.0) -> Any:
        """Creates the control law with the gains that correspond to a value of k.

        For a joint with inertia m, the stiffness K, the velocity damping d and the error-rate
        damping Kd satisfy

            K = k m,    d + Kd = 2 zeta sqrt(k) m,

        where zeta is the damping ratio. The ratio of d to Kd is that of the law's default
        gains. All gains are rounded to four digits.

        Args:
            k: The gain parameter, in 1/s^2.
            stiffness_divisor: Divisor of K. The damping is not divided.
        """
        law: Any = self._scenario.controls[0]
        default_damping = {}
        for name in ("d", "Kd"):
            if name in law.kind.tune:
                defaults = getattr(law.kind, name)
                default_damping[name] = defaults[0]
        default_sum = sum(default_damping.values())
        damping_sum = 2.0 * self._damping * math.sqrt(k) * self.inertia
        damping_scale = damping_sum / default_sum

        stiffness = k / stiffness_divisor * self.inertia
        gains = {"K": stiffness}
        for name, default in default_damping.items():
            gains[name] = default * damping_scale
        rounded_gains = {}
        for name, values in gains.items():
            texts = [f"{value:.4g}" for value in values]
            rounded_gains[name] = tuple(map(float, texts))
        return msgspec.structs.replace(law, **rounded_gains)

    def find_least_edge(
        self,
        loop: RestingLoop,
        poses: Iterable[Array],
        start: float,
        *,
        sampled: bool = True,
    ) -> tuple[float, Array]:
        """Finds the smallest gain parameter k, over all poses, at which small motions grow.

        In each pose, k is raised from `start` until motions grow, and the edge below that k is
        then located with Brent's method. The search skips a pose if its motions still decay
        just below the smallest edge found so far.

        If the delays vary, motions may grow, decay and grow again as k increases, so the search
        then begins with small steps.

        Args:
            loop: The linearised loop of the arms.
            poses: The poses.
            start: Initial k of the search, in 1/s^2.
            sampled: True to analyse the sampled loop, False to analyse it in continuous time.

        Returns:
            The smallest k, in 1/s^2, and the pose in which it occurs. k is infinite if motions
            decay in every pose.

        Raises:
            UsageError: Motions grow even with tiny gains in one of the poses.
        """
        least_edge = math.inf
        worst_pose = self._poses[0]
        log_steps = np.arange(24) * math.log(2.0)
        if loop.varies:
            small_steps = np.arange(15) * math.log(1.1)
            large_steps = math.log(4.0) + log_steps
            log_steps = np.append(small_steps, large_steps)

        for pose in poses:

            def growth(log_k: float, pose: Array = pose) -> float:
                """Returns the growth rate of small motions about a pose, in 1/s.

                The gains correspond to k = exp(log_k). The rate is negative if the motions
                decay.
                """
                law = self.build_law(math.exp(log_k))
                return loop.find_root(law, pose, sampled=sampled).s.real

            candidates: Iterable[float] = math.log(start) + log_steps
            if least_edge != math.inf:
                # Only a pose whose edge is lower than the least edge so far matters.
                candidates = [math.log(least_edge) - 10.0 * _EDGE_TOLERANCE]
            # bracket the edge: first find a k with growing motions, then a smaller k without
            high = next((log_k for log_k in candidates if growth(log_k) > 0.0), None)
            if high is None:
                continue
            lower_candidates = high - log_steps[1:]
            low = next((log_k for log_k in lower_candidates if growth(log_k) <= 0.0), None)
            if low is None:
                raise UsageError(f"--arm: no gains are stable in the pose {pose.tolist()}")
            log_edge = brentq(growth, low, high, xtol=_EDGE_TOLERANCE)
            least_edge = math.exp(log_edge)
            worst_pose = pose
        return least_edge, worst_pose

    def find_edge(self) -> dict[str, Any]:
        """Finds the largest gains with which small motions of the arms still decay.

        The stiffness of each joint is K = k m, where m is its inertia, and the edge is the
        smallest k, in 1/s^2, at which small motions grow. The pose with the smallest edge is
        first found with a constant delay. The edges with the varying delay and in continuous
        time are then computed for that pose only.

        Returns:
            The edge values described for `ArmGains.edge`. The additional entry `used_per_s2` is
            the k of the tuned gains before the stiffness is divided by the margin.
        """
        constant, pose = self.find_least_edge(self.constant_loop, self._poses, self._least_k)

        varies = self.loop.varies
        if varies:
            delay_s = self.age_s
        else:
            link = next(iter(self._scenario.links.values()))
            delay_s = 1e-3 * link.moments().mean_ms
        continuous = math.inf
        if delay_s > 0.0:  # without a delay the loop is passive in continuous time
            fixed = self.loop.fix_age(delay_s)
            continuous, _ = self.find_least_edge(
                loop=fixed,
                poses=[pose],
                start=self._least_k,
                sampled=False,
            )
        k = constant
        if varies:
            k, _ = self.find_least_edge(self.loop, [pose], 0.5 * constant)

        lightest, _ = self._find_lightest()
        damping_factor = 2.0 * self._damping * lightest
        limit = (self._largest_damping_per_s / damping_factor) ** 2
        law = self.build_law(k)
        root = self.loop.find_root(law, pose)
        limit_with_margin = limit / self._margin**2
        lower_edge = min(k, constant)
        # m was fitted to the limit at the least k, up to rounding.
        tick_rate_bounds = limit_with_margin < 1.001 * max(self._least_k, lower_edge)
        return {
            "k_per_s2": k,
            "constant_per_s2": constant,
            "continuous_per_s2": finite_or_none(continuous),
            "limit_per_s2": limit,
            "used_per_s2": min(lower_edge, limit_with_margin),
            "omega_rad_s": root.s.imag,
            "moves": list(root.states),
            "pose": pose.tolist(),
            "bound": "tick rate" if tick_rate_bounds else "delay",
        }

    def trace_edge(self, pose: Array) -> list[tuple[float, float]]:
        """Computes the stability edge as a function of the delay, for a figure.

        The edge is the smallest gain parameter k, in 1/s^2, at which small motions of the
        sampled loop grow. Each delay is a multiple of the tick. The delays are spaced
        geometrically from one tick to four times the delay of the loop, or to eight ticks if
        that is longer.

        Args:
            pose: Pose of all arms, shape (n,), in rad or m, for n joints.

        Returns:
            Pairs of a delay, in s, and the edge at this delay, in 1/s^2.
        """
        longest_ticks = max(4.0 * self.age_s * self.rate_hz, 8.0)
        geometric_ticks = np.geomspace(1.0, longest_ticks, _CURVE_POINTS)
        delays_ticks = np.round(geometric_ticks)
        delays_s = np.unique(delays_ticks) / self.rate_hz
        curve = []
        for delay_s in delays_s:
            loop = self.loop.fix_age(delay_s)
            # Up to k = (2 zeta / delay)^2, even the heaviest mass is stable, see `__init__`. So
            # the search starts there.
            stable_k = (2.0 * self._damping / delay_s) ** 2
            edge_k, _ = self.find_least_edge(loop, [pose], stable_k)
            curve.append((float(delay_s), edge_k))
        return curve

    def confirm(
        self, law: Any, share: float | None, pose: Array, push: Array
    ) -> dict[str, Any]:
        """Simulates arms with given gains to check whether small motions grow as predicted.

        The first arm starts slightly displaced from the pose of the others. The run lasts a few
        time constants of the slowest motion. If the growth rate is still unclear, the duration
        is doubled, up to a limit.

        Args:
            law: Control law with its gains.
            share: Gain parameter k of the law as a fraction of k at the stability edge, or
                `None` for the tuned gains. The value is only copied into the result.
            pose: Pose of all arms, shape (n,), in rad or m, for n joints.
            push: Displacement of the first arm, shape (n,), in rad or m.

        Returns:
            An entry of `ArmGains.runs`, with the simulated and the predicted growth rate.
        """
        root = self.loop.find_root(law, pose)
        predicted_per_s = root.s.real
        sites = {}
        for n, (name, spec) in enumerate(self._scenario.sites.items()):
            is_first = n == 0
            start = pose + push * is_first  # only the first arm is displaced
            q0_rad = tuple(start.tolist())
            sites[name] = msgspec.structs.replace(spec, control=law, q0_rad=q0_rad)
        scenario = msgspec.structs.replace(self._scenario, sites=sites)
        run = FusedRun(scenario)

        slowest_per_s = max(abs(predicted_per_s), _SETTLES / _LONGEST_S)
        first_s = max(_SHORTEST_S, _SETTLES / slowest_per_s)
        durations_s = first_s * 2.0 ** np.arange(_EXTENSIONS)
        for end_s in durations_s.tolist():
            run.advance_to(end_s)
            fit = self.loop.measure_growth(run)
            diverged = run.diverged_s is not None
            if diverged or fit.trend in _IS_STABLE:
                break

        stable = False if diverged else _IS_STABLE.get(fit.trend)
        rate_per_s = None if diverged else finite_or_none(fit.rate_per_s)
        predicts_decay = predicted_per_s < 0.0
        return {
            "share": share,
            "predicted_per_s": predicted_per_s,
            "rate_per_s": rate_per_s,
            "ran_s": run.ran_s,
            "stable": stable,
            "agrees": stable is predicts_decay,
        }


def _write_control_line(law: str, gains: Mapping[str, Sequence[float]]) -> str:
    """Returns the scenario line that selects a law with these gains.

    Args:
        law: Name of the law.
        gains: Values of each gain, one per joint.
    """
    assignments = []
    for name, values in gains.items():
        text = msgspec.json.encode(values).decode()
        assignments.append(f"{name} = {text}")
    return f'control = {{ law = "{law}", {", ".join(assignments)} }}'


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
    progress: Progress | None = None,
) -> ArmGains:
    """Finds the largest gains with which identical arms follow one another stably over a delay.

    The command `trilat tune` does the same.

    >>> tuned = tn.tune_arm("arm6.urdf", "40ms", poses=2)
    >>> tuned.agree, len(tuned.joints)
    (True, 6)

    Args:
        arm: Path of a URDF, or the name of one that ships with the program.
        delay: Delay of each link: a string such as "40ms", a number of ms, a table with the
            columns t_s,delay_ms, or a log, as in "measured:run.mcap".
        law: Name of the control law: p_d, pd_d or saturated_pd.
        set: Overrides for the loop, such as `{"arm.armature_kg_m2": 0.1}`.
        tip: Name of the end link. May be empty if only one link has no child.
        sites: Number of arms: 2, or 3 that follow their two peers equally.
        rate_hz: Tick rate, in Hz.
        margin: Safety factor by which K is kept below the edge, and the damping below its
            sampled-data limit.
        damping: Damping ratio of an arm with inertia m whose peer is at rest.
        quantile: With varying delays, the quantile that is used as the constant delay.
        poses: Number of random poses within the joint limits.
        seed: Random seed of the poses.
        curve: True to compute the edge as a function of the delay too, for a figure.
        progress: Called with the number of completed steps and the total number of steps. The
            steps are the search for the edge and each simulated run.

    Raises:
        ScenarioError: The URDF, its tip or an override is not valid.
        UsageError: Another argument is not valid.
    """
    ranges = {
        "margin": (margin, 1.0, 100.0),
        "damping": (damping, 0.01, 10.0),
        "poses": (poses, 1, 1000),
        "quantile": (quantile, 0.0, 1.0),
    }
    for name, (value, low, high) in ranges.items():
        if not low <= value <= high:
            raise UsageError(f"{name} must be from {low:g} to {high:g}, not {value:g}")

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

    bits = np.random.Philox(seed)
    random = np.random.Generator(bits)
    relative_push = random.uniform(0.5, 1.0, len(pose))
    push = _PUSH * relative_push
    laws: list[tuple[float | None, Any]] = [(None, tuned_law)]
    for share in SHARES:
        law_near_edge = search.build_law(share * edge["k_per_s2"])
        laws.append((share, law_near_edge))
    runs = list[dict[str, Any]]()
    steps = 1 + len(laws)
    for run_share, run_law in laws:
        if progress is not None:
            progress(1 + len(runs), steps)
        run = search.confirm(run_law, run_share, pose, push)
        runs.append(run)

    gains = {}
    for name in ("K", "Kd", "d"):
        if name in tuned_law.kind.tune:
            gains[name] = list(getattr(tuned_law, name))
    tuned_run = runs[0]
    tuned_is_stable = tuned_run["stable"] is True
    agree = tuned_is_stable and all(run["agrees"] for run in runs)
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
        line=_write_control_line(law, gains),
        curve=search.trace_edge(pose) if curve else [],
    )


def _tabulate_joints(
    scenario: Scenario, inertia: Array, gains: Mapping[str, list[float]]
) -> list[dict[str, Any]]:
    """Returns the inertia and the gains of each joint of an arm, with units.

    Each row also contains the position error at which the spring reaches the torque limit of
    the joint, or `None` if the joint has no limit. See `ArmGains.joints`.

    Args:
        scenario: Scenario with the arm.
        inertia: Inertia m of each joint, shape (n,).
        gains: Mapping from gain name to values, one per joint.
    """
    first_site = scenario.names[0]
    arm_model = scenario.arms[first_site]
    limit_errors = np.divide(arm_model.efforts, gains["K"]).tolist()
    effort_units = arm_model.joint_units("N m")
    angle_units = arm_model.joint_units("rad")
    units = zip(effort_units, angle_units, strict=True)
    columns = {
        "joint": arm_model.joint_names,
        "inertia": inertia.tolist(),
        **gains,
        "unit": ["/".join(pair) for pair in units],
        "error_at_effort_limit": [finite_or_none(error) for error in limit_errors],
    }
    rows = zip(*columns.values(), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in rows]
