"""Loops that hide their growth, each as a scenario and as the numbers of `linear_truth`.

A kind is a way of hiding: several sinusoidal delays, looped traces of any length, a slow joint beside a fast
one, starts without any motion, changes during the run, laws that may not be executed, bursts of losses with
and without a held reference. All arms start within `SPREAD_RAD` of one pose, so that the linear loop about it tells
the truth. A third of the loops is drawn next to an edge of stability, by the truth itself.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from tests.certificate.drawn_loops import make_experiment
from trilat_net.scenario import Scenario, load_scenario

from .linear_truth import Loop, Way, gravity_gradient, measure_growth, planar_inertia

SPREAD_RAD = 1e-3
RATE_HZ = 100
SPAN_S = 600.0
"""Length of the simulation that shows the truth."""
RANDOM_SPAN_S = 4000.0
"""The same length for links that lose samples, whose rate is a mean over the draws."""
EDGE_SPAN_S = 400.0
"""Length of the simulations that look for an edge, which need not be exact."""
OWN_LAW = "tests.own_laws:JointPD"
LEAST_PER_S = 2e-3
"""The slowest growth or decay that is drawn."""
LEAST_RANDOM_PER_S = 5e-3
"""The same for links that lose samples, whose rate is an estimate."""
MOST_PER_S = 1.5
"""The fastest growth, with which runs still end next to the pose at which the loop was linearised."""
NEAR_PER_S = 0.01
"""A loop that grows or decays more slowly is near an edge."""
BRACKET = (0.5, 2.5)
"""The factors on the damping between which the edge is searched."""


class Hidden(NamedTuple):
    """A drawn loop.

    Attributes:
        kind: how it hides.
        loop: the numbers of its final loop.
        pose_rad: the pose about which its arms start.
        starts_rad: where they do, shape (sites, 2).
        arms: lengths, masses, centres and inertias of each.
        own_law: True if the law is one of a user's.
        earlier: links before a change, and its time in s; None without a change.
        idle: True if a change at that time changes nothing.
        duration_s: length of the run.
    """

    kind: str
    loop: Loop
    pose_rad: np.ndarray
    starts_rad: np.ndarray
    arms: list[dict[str, float]]
    own_law: bool = False
    earlier: tuple[float, Way] | None = None
    idle: bool = False
    duration_s: float = 30.0

    @property
    def loses(self) -> bool:
        """True if the links of the loop lose samples."""
        return any(way.loss for way in self.loop.ways.values())

    def measure(self) -> float:
        """Returns the rate of growth of the loop, 1/s."""
        return measure_growth(self.loop, RANDOM_SPAN_S if self.loses else SPAN_S)

    def scaled(self, factor: float) -> "Hidden":
        """Returns the loop with its damping times a factor."""
        return self._replace(loop=self.loop._replace(damping=factor * self.loop.damping))


def _round(value: Any, digits: int = 6) -> Any:
    return np.array([float(f"{x:.{digits}g}") for x in np.ravel(value)]).reshape(
        np.shape(value)
    )


def _draw_arms(
    rng: np.random.Generator, count: int, pose: np.ndarray
) -> tuple[list[dict[str, float]], np.ndarray, np.ndarray]:
    """Draws arms of unlike masses, and M and the gradient of gravity of each at the pose."""
    arms = []
    inertias = []
    gravity = []
    for _ in range(count):
        m1, m2 = _round(np.exp(rng.uniform(-0.7, 0.7, 2)), 3)
        arm = {"l1_m": 1.0, "l2_m": 1.0, "m1_kg": m1, "m2_kg": m2}
        arm |= {"lc1_m": 0.5, "lc2_m": 0.5, "I1_kg_m2": 0.1, "I2_kg_m2": 0.1}
        arms.append(arm)
        rods = ((1.0, 1.0), (m1, m2), (0.5, 0.5))
        inertias.append(planar_inertia(*rods, (0.1, 0.1), pose[1]))
        gravity.append(gravity_gradient(*rods, pose))
    return arms, np.array(inertias), np.array(gravity)


def _draw_shares(rng: np.random.Generator, count: int) -> np.ndarray:
    shares = np.zeros((count, count))
    for i in range(count):
        peers = [j for j in range(count) if j != i]
        cut = rng.dirichlet(np.ones(len(peers)) * 2.0).round(3)
        cut[-1] = 1.0 - cut[:-1].sum()
        shares[i, peers] = cut
    return shares


def _draw_loop(rng: np.random.Generator, way: Callable[[], Way]) -> Hidden:
    """Draws two or three arms under P+d, over links that `way` draws."""
    count = int(rng.integers(2, 4))
    pose = _round(rng.uniform(-0.8, 0.8, 2), 3)
    arms, inertias, gravity = _draw_arms(rng, count, pose)
    shares = _draw_shares(rng, count)
    pairs = [(i, j) for i in range(count) for j in range(count) if shares[i, j] > 0.0]
    stiffness = float(_round(rng.uniform(8.0, 30.0), 3))
    ways = {pair: way() for pair in pairs}
    mean_s = 1e-3 * np.mean([_mean_ms(link_way) for link_way in ways.values()])
    damping = 0.6 * stiffness * (mean_s + 1.0 / RATE_HZ)
    loop = Loop(
        inertias,
        gravity,
        np.full((count, 2), stiffness),
        np.full((count, 2), damping),
        shares,
        ways,
        RATE_HZ,
        bool(rng.random() < 0.5),
    )
    starts = pose + _round(SPREAD_RAD * rng.uniform(-1.0, 1.0, (count, 2)), 3)
    return Hidden("", loop, pose, starts, arms)


def _mean_ms(way: Way) -> float:
    if way.points:
        return float(np.mean([delay_ms for _, delay_ms in way.points]))
    return way.delay_ms + 1e3 * way.loss * way.burst / RATE_HZ


def _constant(rng: np.random.Generator) -> Way:
    return Way(float(rng.integers(8, 30)) * 10.0)


def _draw_sinusoids(rng: np.random.Generator) -> Hidden:
    """Draws delays in which every link has a period of its own, some almost the same as another's."""
    period_s = round(float(rng.uniform(0.8, 4.0)), 2)

    def way() -> Way:
        delay_ms = float(rng.integers(10, 25)) * 10.0
        swing_ms = round(delay_ms * float(rng.uniform(0.3, 0.97)), 1)
        near = rng.random() < 0.5
        beat_s = rng.uniform(0.01, 0.05) if near else rng.uniform(0.0, 2.0)
        own_s = round(period_s + float(beat_s), 2)
        return Way(delay_ms, swing_ms, own_s, round(float(rng.uniform(0.0, 6.2)), 2))

    return _draw_loop(rng, way)._replace(duration_s=float(rng.choice([20.0, 40.0])))


def _draw_traces(rng: np.random.Generator) -> Hidden:
    """Draws looped tables that last from a tenth of the run to three times as long."""
    length_s = float(rng.choice([3.0, 7.5, 20.0, 45.0, 90.0]))

    def way() -> Way:
        mean_ms = rng.uniform(80.0, 220.0)
        times = np.arange(0.0, length_s, 0.5)
        table_ms = mean_ms * np.clip(1.0 + rng.uniform(-0.8, 0.8, len(times)), 0.1, 2.0)
        if rng.random() < 0.5:  # a good half and a bad one
            table_ms = np.where(times < length_s / 2.0, 0.5, 1.5) * mean_ms
        points = zip(times, table_ms.round(3), strict=True)
        return Way(points=tuple((float(t_s), float(delay)) for t_s, delay in points))

    return _draw_loop(rng, way)._replace(duration_s=float(rng.choice([15.0, 28.0, 40.0])))


def _draw_slow_joint(rng: np.random.Generator) -> Hidden:
    """Draws a loop whose first joint moves much and decays fast, and whose second joint hardly moves."""
    hidden = _draw_loop(rng, lambda: _constant(rng))
    damping = hidden.loop.damping * np.array([float(rng.uniform(2.0, 4.0)), 1.0])
    starts = hidden.starts_rad + np.array([1.0, 0.0]) * _round(
        20.0 * SPREAD_RAD * rng.uniform(-1.0, 1.0, (len(damping), 1)), 3
    )
    return hidden._replace(
        loop=hidden.loop._replace(damping=damping),
        starts_rad=starts,
        own_law=bool(rng.random() < 0.5),
    )


def _draw_symmetric(rng: np.random.Generator) -> Hidden:
    """Draws a loop whose arms all start at rest at one pose, so that nothing moves by itself."""
    hidden = _draw_loop(rng, lambda: _constant(rng))
    starts = np.tile(hidden.pose_rad, (len(hidden.arms), 1))
    return hidden._replace(starts_rad=starts, own_law=bool(rng.random() < 0.3))


def _draw_command(rng: np.random.Generator) -> Hidden:
    """Draws a change during the run that changes nothing, or makes every delay longer or shorter."""
    hidden = _draw_loop(rng, lambda: _constant(rng))
    at_s = float(rng.choice([2.0, 6.0, 12.0, 24.0]))
    if rng.random() < 0.4:
        return hidden._replace(earlier=(at_s, Way()), idle=True)
    before = Way(float(rng.integers(4, 40)) * 10.0)
    return hidden._replace(earlier=(at_s, before))


def _draw_own_law(rng: np.random.Generator) -> Hidden:
    """Draws a user's own law, over a link that may swing."""
    hidden = _draw_sinusoids(rng) if rng.random() < 0.3 else _draw_symmetric(rng)
    return hidden._replace(own_law=True, duration_s=20.0)


def _draw_bursts(rng: np.random.Generator) -> Hidden:
    """Draws losses in bursts, during which the last sample is used, or the reference stays where it is."""
    loss = round(float(rng.uniform(0.05, 0.5)), 2)
    burst = float(rng.integers(2, 40))
    hidden = _draw_loop(rng, lambda: _constant(rng)._replace(loss=loss, burst=burst))
    hold_s = None
    if rng.random() < 0.6:
        longest_ms = max(way.delay_ms for way in hidden.loop.ways.values())
        hold_s = round(1e-3 * longest_ms + float(rng.choice([0.05, 0.1, 0.3])), 3)
    loop = hidden.loop._replace(hold_s=hold_s, return_s=float(rng.choice([0.2, 0.5])))
    return hidden._replace(loop=loop)


KINDS: Mapping[str, Callable[[np.random.Generator], Hidden]] = {
    "several sinusoids": _draw_sinusoids,
    "looped traces": _draw_traces,
    "slow joint": _draw_slow_joint,
    "symmetric start": _draw_symmetric,
    "change": _draw_command,
    "own law": _draw_own_law,
    "bursts": _draw_bursts,
}
"""The ways of hiding growth, by name; successive seeds use them in turn."""
PUSH = range(len(KINDS))
"""Seeds that every push judges."""


def draw_hidden(seed: int) -> tuple[Hidden, float]:
    """Returns the loop of a seed, and its rate of growth, 1/s.

    The damping is a factor of the damping at the edge of stability, which is found by
    bisection.
    """
    rng = np.random.default_rng(seed)
    kind = list(KINDS)[seed % len(KINDS)]
    hidden = KINDS[kind](rng)._replace(kind=kind)
    edge = _find_edge(hidden)
    least_per_s = LEAST_RANDOM_PER_S if hidden.loses else LEAST_PER_S
    while True:
        near = rng.random() < 0.35
        factor = rng.uniform(0.96, 1.03) if near else rng.uniform(0.5, 1.35)
        damping = _round(edge * factor * hidden.loop.damping, 5)
        drawn = hidden._replace(loop=hidden.loop._replace(damping=damping))
        rate_per_s = drawn.measure()
        if abs(rate_per_s) > least_per_s and rate_per_s < MOST_PER_S:
            return drawn, rate_per_s


def _find_edge(hidden: Hidden) -> float:
    """Returns the factor on the damping at which the loop neither grows nor decays, to a hundredth."""
    low, high = BRACKET
    if measure_growth(hidden.scaled(low).loop, EDGE_SPAN_S) < 0.0:
        return low
    while high / low > 1.01:
        middle = float(np.sqrt(low * high))
        if measure_growth(hidden.scaled(middle).loop, EDGE_SPAN_S) > 0.0:
            low = middle
        else:
            high = middle
    return high


def write_scenario(hidden: Hidden) -> Scenario:
    """Returns the scenario of a drawn loop."""
    loop = hidden.loop
    names = "abc"[: len(hidden.arms)]
    sites = {}
    laws = {}
    for n, name in enumerate(names):
        stiffness = float(loop.stiffness[n, 0])
        damping = loop.damping[n].tolist()
        law: dict[str, Any] = {"law": "p_d", "K": stiffness, "d": damping}
        if hidden.own_law:
            law = {"law": OWN_LAW, "K": [stiffness] * 2, "d": damping}
        laws[f"sites.{name}.control"] = law
        sites[name] = {
            "role": "slave" if n else "master",
            "q0_rad": hidden.starts_rad[n].tolist(),
            "arm": hidden.arms[n],
            "control": {"law": "p_d", "K": stiffness, "d": damping},
        }
    keys: dict[str, Any] = {
        "rate_hz": loop.rate_hz,
        "duration_s": hidden.duration_s,
        "scheme": "second_order" if loop.second_order else "digital",
        "sites": sites,
        "dominance": {
            name: {
                names[j]: float(loop.shares[n, j])
                for j in range(len(names))
                if loop.shares[n, j] > 0.0
            }
            for n, name in enumerate(names)
        },
        "links": {
            f"{names[j]}->{names[i]}": _write_way(
                hidden.earlier[1] if _begins_otherwise(hidden) else way
            )
            for (i, j), way in loop.ways.items()
        },
    }
    if hidden.earlier is not None:
        keys["timeline"] = [
            {
                "at_s": hidden.earlier[0],
                "link": f"{names[j]}->{names[i]}",
                "to": _write_way(way),
            }
            for (i, j), way in loop.ways.items()
        ]
    if loop.hold_s is not None:
        keys["on_stale"] = {
            "action": "hold",
            "age_ms": 1e3 * loop.hold_s,
            "return_s": loop.return_s,
        }
    scenario = make_experiment("hidden", **keys)
    return load_scenario(scenario, laws) if hidden.own_law else scenario


def _begins_otherwise(hidden: Hidden) -> bool:
    return hidden.earlier is not None and not hidden.idle


def _write_way(way: Way) -> dict[str, Any]:
    """Returns the keys of a link."""
    if way.points:
        table = ", ".join(
            f"{round(1e6 * t_s)} {round(1e3 * delay_ms)}" for t_s, delay_ms in way.points
        )
        return {"model": "trace", "trace": table, "at_end": "loop"}
    keys: dict[str, Any] = {"delay_ms": way.delay_ms}
    if way.amplitude_ms:
        keys |= {"model": "sine", "amplitude_ms": way.amplitude_ms}
        keys |= {"period_s": way.period_s, "phase_rad": way.phase_rad}
    if way.loss:
        keys |= {"loss": way.loss, "loss_burst": way.burst}
    return keys
