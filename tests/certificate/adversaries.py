"""Experiments that try to fool the judgement of a run, each with its truth.

`ROWS` are made by hand: a run that once passed for stable, and beside it a stable one much like it that must
pass. `draw_experiment` makes any number of further ones from a seed, many at an edge of stability. Their
truth is what the linear loop's rightmost root says, and a run eight times as long; no judgement changes it,
so that of the first seeds is kept in `TRUTHS`, with the digest of each scenario.

    python -m tests.certificate.adversaries
    python -m tests.certificate.adversaries --find-truths

The first prints the table of docs/certificate.md, the second finds the truths anew.
"""

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import trilat_net
from trilat_net.analysis.certificate.energy_terms import explain_missing_functional
from trilat_net.analysis.certificate.evidence import Evidence
from trilat_net.analysis.certificate.stability_certificate import (
    Certificate,
    StabilityFinding,
    StabilityVerdict,
)
from trilat_net.analysis.run_end import RunEnd, RunTrace, Stability, classify_run_end
from trilat_net.analysis.twin_growth import measure_virtual_twins
from trilat_net.core.ticks import BUCKETS_PER_S
from trilat_net.core.two_link_arm import JOINTS
from trilat_net.core.vectors import Array
from trilat_net.errors import ScenarioError
from trilat_net.execution.fused import FusedRun
from trilat_net.log.accounting import Coverage
from trilat_net.log.digest_chain import ChainState, Integrity
from trilat_net.log.integrity import MIN_COVERAGE
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.studies.sweep.cell_result import classify_cell
from trilat_net.theory.end_pose import find_end_pose_roots
from trilat_net.theory.equilibrium import follow_equilibrium, prolong_scenario
from trilat_net.theory.linear_edge import find_contact_growth, find_rightmost_root
from trilat_net.theory.operating_point import Equilibrium, derive_operating_conditions, is_constant_link

LONGER = 8.0
"""The run that knows the truth is so many times as long."""
DRAWN_S = 40.0
"""The length of a drawn run."""
SEEN = 1e-6
"""A growing mode counts from this size on, rad/s, in the records."""
SLOW_PER_S = 0.01
"""A stable root this slow hardly dies within eight times the run: then the root decides."""
NEAR_AN_EDGE = (0.8, 1.2)
TRUTHS = Path(__file__).with_name("truths.csv")
"""Per seed: the digest of its scenario, and its truth."""
SEEDS = 2000
"""Seeds whose truth is stored."""
RODS = {"lc1_m": 0.5, "lc2_m": 0.5, "I1_kg_m2": 1 / 12, "I2_kg_m2": 1 / 12}
CIRCLE = {"m1": {"m2": 0.5, "s": 0.5}, "m2": {"m1": 0.5, "s": 0.5}, "s": {"m1": 0.5, "m2": 0.5}}
STIFFNESS = "sites.s.environment.0.stiffness_n_m"
SAMPLED = "sites.s.environment.0.sampled"


def _toml(value: Any) -> str:
    """A value in TOML; nine digits, since further ones of a sine or an eigenvalue depend on the machine."""
    if isinstance(value, float):
        return json.dumps(float(f"{value:.9g}"))
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {_toml(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)


def experiment(name: str, **tables: Any) -> Scenario:
    """The scenario of some tables."""
    given = {"name": name, "rate_hz": 100, "duration_s": 30.0, "scheme": "second_order", **tables}
    return parse_scenario("\n".join(f"{key} = {_toml(value)}" for key, value in given.items()))


def swinging(peaks: Iterable[tuple[float, float]], hertz: float = 1.0) -> dict[str, Any]:
    """A hand whose torque swings on joint 1 and 2, its size linear between (time s, N m)."""
    times, sizes = np.array(list(peaks)).T
    t_s = np.arange(times[0], times[-1] + 1e-9, 0.02)
    torque = np.interp(t_s, times, sizes) * np.sin(2 * np.pi * hertz * t_s)
    return {
        "kind": "recorded",
        "points": [[float(t), float(x), float(x)] for t, x in zip(t_s, torque, strict=True)],
    }


def two_pairs(laws: tuple[Any, Any], q1_rad: tuple[float, ...], across: float = 0.0, **more: Any) -> Scenario:
    """{a, b} and {c, e}, each pair under one of two laws; `across` is the share of the other pair."""
    sites = {
        name: {
            "role": "master" if name in "ac" else "slave",
            "q0_rad": [q1, q1],
            "control": laws[name in "ce"],
        }
        for name, q1 in zip("abce", q1_rad, strict=True)
    }
    own, other = dict(zip("abce", "baec", strict=True)), dict(zip("abce", "ceab", strict=True))
    dominance = {i: {j: 1.0 - across, **({other[i]: across} if across else {})} for i, j in own.items()}
    given = {"sites": sites, "dominance": dominance, "link": {"delay_ms": 200.0}}
    return experiment("pairs", **{**given, **more})


def p_d(d: Any, **more: Any) -> dict[str, Any]:
    """P+d with 10 N m/rad."""
    return {"law": "p_d", "K": 10.0, "d": d, **more}


class Row(NamedTuple):
    """One experiment made by hand.

    Attributes:
        mark: its number; mirrors end in "=".
        what: in words.
        make: its scenario.
        words: what may be said of it.
        reason: what its judgement names, in lower case; "" for anything.
    """

    mark: str
    what: str
    make: Callable[[], Scenario]
    words: tuple[str, ...]
    reason: str = ""


NEVER_STABLE = ("not stable", "open")
STABLE = ("stable",)


def _load(name: str, overrides: Mapping[str, Any] | None = None, /, **more: Any) -> Callable[[], Scenario]:
    changes = {**(overrides or {}), **{key.replace("__", "."): value for key, value in more.items()}}
    return lambda: load_scenario(name, changes)


PUSH = [{"kind": "recorded", "points": [[0.0, 3.0, 0.0], [1e3, 3.0, 0.0]]}]


def _pairs(first: Any, second: Any, across: float = 0.0) -> Callable[[], Scenario]:
    return lambda: two_pairs((first, second), APART if across else WIDE, across)


def _wall(kilonewtons: float, *, sampled: bool = True, **more: Any) -> Callable[[], Scenario]:
    return _load("windup", {SAMPLED: sampled, STIFFNESS: 1e3 * kilonewtons, "duration_s": 24.0, **more})


def _free(overrides: Mapping[str, Any] | None = None, /, **more: Any) -> Callable[[], Scenario]:
    return _load("free", {"rate_hz": 100, "duration_s": 40.0, **(overrides or {})}, **more)


def _margin(
    overrides: Mapping[str, Any] | None = None, /, d: float = 5.0, T_ms: float = 200.0, **more: Any
) -> Callable[[], Scenario]:
    given = {"control.d": d, "link.delay_ms": T_ms, "rate_hz": 100, "duration_s": 40.0, **(overrides or {})}
    return _load("p_d_margin", given, **more)


WIDER = [swinging([(0.0, 0.0), (39.98, 12.0)])]
EARLY = [swinging([(0.0, 0.0), (10.0, 6.0)])]
LASTING = [swinging([(0.0, 5.0), (40.0, 5.0)])]
WIDE = (0.9, -0.9, 1e-3, -1e-3)
APART = (0.35, 0.25, -0.15, -0.25)
LEARNT = ({"law": "adaptive", "theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0]},) * 2
CYCLE = {"rate_hz": 100, "scheme": "digital", "link.delay_ms": 0.0, "duration_s": 200.0}
PARAMETRIC = {
    "link.model": "sine",
    "link.delay_ms": 200.0,
    "link.amplitude_ms": 200.0,
    "link.period_s": 1 / 1.7,
    "duration_s": 60.0,
}

HANGS = {"control.Gamma": [1.0, 1.0, 1.0, 0.01, 0.01], "control.theta_hat0": [3.0, 1.0, 1.0, 1.6, 0.8]}
NUDGE = [{"kind": "pulse", "start_s": 20.0, "end_s": 39.9, "peak_nm": [8.0, 8.0]}]

LOSSY = {"link.loss": 1e-6}
CLOSE = {"sites.m1.q0_rad": [0.1, 0.2], "sites.m2.q0_rad": [0.102, 0.199], "sites.s.q0_rad": [0.099, 0.203]}
STIFF = {"control.K": 100.0, "control.d": 200.0, "rate_hz": 1000, "duration_s": 20.0}


def _slower_from(at_s: float, d: float) -> Callable[[], Scenario]:
    """P+d whose delay becomes longer, on links that lose a sample now and then."""
    to = {"delay_ms": 900.0, "loss": 1e-6}
    later = [{"at_s": at_s, "link": link, "to": to} for link in load_scenario("p_d_margin").links]
    return _margin(LOSSY | {"timeline": later}, d=d)


def _touched(across: float) -> Callable[[], Scenario]:
    """Two pairs of arms, of which a hand touches one, weakly."""
    hand = {"kind": "spring", "to_rad": [0.9, 0.9], "stiffness_nm_rad": 0.01}
    return lambda: load_scenario(two_pairs(LEARNT, APART, across), {"sites.a.hands": [hand]})


ROWS = (
    Row(
        "F1", "the wide group decays, the small one grows", _pairs(p_d(2.4), p_d(1.7)), NEVER_STABLE, "joint"
    ),
    Row("F1", "and of that only one joint", _pairs(p_d(4.0), p_d([1.2, 4.0])), NEVER_STABLE, "joint"),
    Row("F1=", "both groups decay", _pairs(p_d(4.0), p_d(4.0)), STABLE),
    Row("F2", "a sampled wall of 20 kN/m", _wall(20.0), NEVER_STABLE, "this rest: unstable"),
    Row("F2", "a sampled wall of 28 kN/m", _wall(28.0), NEVER_STABLE, "this rest: unstable"),
    Row("F2", "a sampled wall of 5 kN/m at 100 Hz", _wall(5.0, rate_hz=100), NEVER_STABLE),
    Row("F2=", "a sampled wall of 8 kN/m", _wall(8.0), STABLE),
    Row("F2=", "a wall of 28 kN/m that is not sampled", _wall(28.0, sampled=False), STABLE),
    Row("F4", "the delay swings at 1.7 Hz", _load("free", PARAMETRIC), NEVER_STABLE, "v rises"),
    Row("F4=", "by a tenth of that", _load("free", PARAMETRIC, link__amplitude_ms=20.0), STABLE),
    Row("F5", "P+d, 1.6 s, d 2.7", _margin(d=2.7, T_ms=1600.0, duration_s=60.0), NEVER_STABLE, "unstable"),
    Row("F5", "P+d, 0.8 s, d 2", _margin(d=2.0, T_ms=800.0, duration_s=60.0), NEVER_STABLE, "unstable"),
    Row("F5=", "P+d, 1.6 s, d 16", _margin(d=16.0, T_ms=1600.0, duration_s=120.0), STABLE),
    Row("F5", "at its edge, if a sample is lost", _margin(CLOSE | LOSSY, d=0.96), NEVER_STABLE),
    Row("F5=", "beyond its edge, the same", _margin(CLOSE | LOSSY, d=1.2), STABLE),
    Row(
        "F5",
        "1.56 s, d 2.6, if a sample is lost",
        _margin(LOSSY, d=2.6, T_ms=1560.0, duration_s=120.0),
        NEVER_STABLE,
        "of the mean ages",
    ),
    Row("F5=", "1.56 s, d 16, the same", _margin(LOSSY, d=16.0, T_ms=1560.0, duration_s=120.0), STABLE),
    Row("F6", "two pairs that hardly hear of each other", _pairs(*LEARNT, 1e-6), NEVER_STABLE, "apart"),
    Row("F6=", "two pairs that do", _pairs(*LEARNT, 0.3), STABLE),
    Row("F6", "a hand that cannot hold them apart", _touched(1e-6), NEVER_STABLE, "apart"),
    Row("F7", "20 ms of free motion", _free({"sites.m1.hands": WIDER}), NEVER_STABLE, "operator acts"),
    Row("F7", "100 ms of it, after a push", _free({"sites.m1.hands": NUDGE}), NEVER_STABLE, "operator acts"),
    Row("F7=", "30 s of it", _free({"sites.m1.hands": EARLY}), STABLE),
    Row("F8", "force reflection hammers", _load("contact", duration_s=60.0), ("not stable",), "bounded"),
    Row(
        "F8=", "a fifth of the force", _load("contact", {"sites.m.control.k_f": 0.2}, duration_s=60.0), STABLE
    ),
    Row("F8", "100 Hz, no delay: a limit cycle", _load("free", CYCLE), NEVER_STABLE, "v rises"),
    Row("F8=", "500 Hz, no delay", _load("free", CYCLE, rate_hz=500, duration_s=60.0), STABLE),
    Row("F8", "a push without end", _margin({"sites.m1.hands": PUSH}), NEVER_STABLE, "drift"),
    Row(
        "F9",
        "gravity known to 80 %",
        _margin({"control.gravity": 0.8}, duration_s=60.0),
        NEVER_STABLE,
        "hang",
    ),
    Row("F9", "gravity hardly learnt", _free(HANGS, duration_s=60.0), NEVER_STABLE),
    Row("F9", "a torque limit of 15 N m", _free(limits__tau_limit_nm=15.0), NEVER_STABLE, "v ends"),
    Row("F9=", "a torque limit of 100 N m", _free(limits__tau_limit_nm=100.0), STABLE),
    Row("F9=", "gravity known", _margin(duration_s=60.0), STABLE),
    Row("F9", "arms that sink slowly", _margin(STIFF | {"control.gravity": 0.99}), NEVER_STABLE),
    Row("F9=", "arms that do not", _margin(STIFF), STABLE),
    Row("W", "a hand swings ever wider", _margin({"sites.m1.hands": WIDER}), ("open",), "operator acts"),
    Row(
        "W", "a hand swings on at the slave", _margin({"sites.s.hands": LASTING}), ("open",), "operator acts"
    ),
    Row(
        "W", "a delay that is too long in the end", _slower_from(39.9, 2.0), NEVER_STABLE, "the loop changes"
    ),
    Row("W=", "a longer delay since long", _slower_from(15.0, 5.0), STABLE),
    Row("W=", "the hand lets go", _margin({"sites.m1.hands": EARLY}), STABLE),
)


def under_noise(scenario: Scenario) -> Scenario:
    """An experiment with its delays, on links as of a live run: jitter of 1.5 ms, 1 % of samples lost."""
    noise = {"model": "uniform", "half_width_ms": 1.5, "loss": 0.01}
    links = {f"links.{link}.{key}": value for link in scenario.links for key, value in noise.items()}
    delays = {f"links.{link}.delay_ms": spec.delay_ms for link, spec in scenario.links.items()}
    return load_scenario(scenario, links | delays)


class Drawn(NamedTuple):
    """An experiment that was drawn: its kind, its scenario, and the key that may be near an edge."""

    kind: str
    scenario: Scenario
    key: str = ""


def _sites(rng: np.random.Generator, names: str, spread_rad: float) -> dict[str, Any]:
    """Arms of several masses, about one pose."""
    pose = rng.uniform(-0.8, 0.8, 2)
    return {
        name: {
            "role": "slave" if n else "master",
            "q0_rad": (pose + spread_rad * rng.uniform(-1, 1, 2)).tolist(),
            "arm": {
                **({"l1_m": 1.0, "l2_m": 1.0, **RODS} if rng.random() < 0.5 else {}),
                "m1_kg": float(np.exp(rng.uniform(-0.7, 0.7))),
                "m2_kg": float(np.exp(rng.uniform(-0.7, 0.7))),
            },
        }
        for n, name in enumerate(names)
    }


def _shares(rng: np.random.Generator, names: str) -> dict[str, dict[str, float]]:
    """Shares of every site, of all of its peers or of one."""
    rows = {}
    for name in names:
        peers = [peer for peer in names if peer != name]
        if len(peers) > 1 and rng.random() < 0.2:
            peers = [str(rng.choice(peers))]
        cut = rng.dirichlet(np.ones(len(peers))).round(3)
        cut[-1] = 1.0 - cut[:-1].sum()
        rows[name] = dict(zip(peers, cut.tolist(), strict=True))
    return rows


def _loop(rng: np.random.Generator, names: str, **more: Any) -> dict[str, Any]:
    """A network of P+d or PD+d whose damping is about the edge of stability."""
    shares, T_ms, K = _shares(rng, names), float(rng.uniform(80.0, 400.0)), float(rng.uniform(8.0, 40.0))
    alpha = np.array([[shares[i].get(j, 0.0) for j in names] for i in names])
    worst = max(float(np.abs(np.linalg.eigvals(alpha).real.min())), 0.2173)
    bound = worst * K * (T_ms + 10.0) / 1e3
    factor = rng.uniform(0.8, 1.2) if rng.random() < 0.6 else rng.choice([0.5, 1.5, 3.0])
    control = {"law": "p_d", "K": K, "d": float(factor * bound)}
    if rng.random() < 0.2:
        control |= {"law": "pd_d", "Kd": float(rng.uniform(0.2, 2.0))}
    spread = float(rng.choice([0.5, 0.05, 1e-3]))
    return {
        "rate_hz": 100,
        "duration_s": DRAWN_S,
        "scheme": str(rng.choice(["second_order", "digital"])),
        "control": control,
        "link": {"delay_ms": T_ms},
        "sites": _sites(rng, names, spread),
        "dominance": shares,
        **more,
    }


def _draw_network(rng: np.random.Generator) -> Drawn:
    made = _loop(rng, "abce"[: rng.integers(2, 5)])
    return Drawn("network", experiment("network", **made), "control.d")


def _draw_noisy(rng: np.random.Generator) -> Drawn:
    made = _loop(rng, "abc"[: rng.integers(2, 4)])
    made["link"] |= {"model": "uniform", "half_width_ms": min(3.0, made["link"]["delay_ms"]), "loss": 0.02}
    return Drawn("noise", experiment("noise", **made), "control.d")


def _draw_groups(rng: np.random.Generator) -> Drawn:
    """Two closed groups: what one does hides the other."""
    made, T = _loop(rng, "abce"), 0.001 * float(rng.uniform(50.0, 300.0))
    d = 10.0 * T * rng.uniform([1.2, 0.7], [2.5, 1.3])
    sites = _sites(rng, "abce", 0.5)
    for n, name in enumerate("abce"):
        sites[name]["control"] = p_d(float(d[n // 2]))
        if n >= 2:
            sites[name]["q0_rad"] = [0.1 + 1e-3 * n, 0.2]
    pairs = {"a": {"b": 1.0}, "b": {"a": 1.0}, "c": {"e": 1.0}, "e": {"c": 1.0}}
    made |= {"sites": sites, "dominance": pairs, "link": {"delay_ms": 1e3 * T}}
    return Drawn("groups", experiment("groups", **{**made, "control": p_d(1.0)}), "control.d")


def _draw_adaptive(rng: np.random.Generator) -> Drawn:
    """The paper's law at rates at which sampling may feed it."""
    names = "abc"[: rng.integers(2, 4)]
    late = rng.random() < 0.6
    made = _loop(rng, names, link={"delay_ms": float(rng.uniform(20.0, 500.0)) if late else 0.0})
    made["control"] = {
        "law": "adaptive",
        "Kp": float(rng.uniform(0.5, 3.0)),
        "Kd": float(rng.uniform(1.0, 5.0)),
    }
    return Drawn("adaptive", experiment("adaptive", **{**made, "rate_hz": int(rng.choice([50, 100]))}))


def _draw_delay(rng: np.random.Generator) -> Drawn:
    """A delay that swings about twice as fast as the loop does."""
    T = float(rng.uniform(100.0, 250.0))
    link = {
        "model": "sine",
        "delay_ms": T,
        "amplitude_ms": T * float(rng.choice([0.1, 0.9])),
        "period_s": 1.0 / rng.uniform(1.0, 2.5),
    }
    made = _loop(rng, "abc", link=link)
    if rng.random() < 0.5:
        made["control"] = {"law": "adaptive"}
    return Drawn("delay", experiment("delay", **made))


def _draw_wall(rng: np.random.Generator) -> Drawn:
    rate_hz = int(rng.choice([100, 200]))
    edge = 15.5e3 * rate_hz / 1000
    K = edge * (rng.uniform(0.8, 1.2) if rng.random() < 0.5 else rng.uniform(0.2, 2.5))
    made = {SAMPLED: True, STIFFNESS: K, "rate_hz": rate_hz, "duration_s": DRAWN_S}
    return Drawn("wall", load_scenario("windup", made), STIFFNESS)


def _draw_operator(rng: np.random.Generator) -> Drawn:
    """A hand that swings to the end, or lets go long before it."""
    made = _loop(rng, "abc")
    made["control"] = p_d(float(rng.uniform(2.0, 6.0)))
    until_s = DRAWN_S - 0.02 if rng.random() < 0.5 else 0.3 * DRAWN_S
    hand = swinging([(0.0, 0.0), (until_s, float(rng.uniform(2.0, 10.0)))], float(rng.uniform(0.3, 1.5)))
    made["sites"]["a"]["hands"] = [hand]
    return Drawn("operator", experiment("operator", **made))


KINDS: tuple[tuple[float, Callable[[np.random.Generator], Drawn]], ...] = (
    (0.62, _draw_network),
    (0.08, _draw_noisy),
    (0.06, _draw_groups),
    (0.08, _draw_adaptive),
    (0.05, _draw_delay),
    (0.05, _draw_wall),
    (0.06, _draw_operator),
)


def draw_experiment(seed: int) -> Drawn:
    """The experiment of a seed."""
    rng = np.random.default_rng(seed)
    shares, draws = zip(*KINDS, strict=True)
    return draws[rng.choice(len(draws), p=shares)](rng)


class Truth(NamedTuple):
    """What is true of a run: whether it is unstable, its rightmost root, 1/s, and whether an edge is near."""

    unstable: bool
    root_per_s: float | None
    near: bool


def find_truth(drawn: Drawn) -> Truth:
    """The truth by the rightmost root and by a run eight times as long, in which operators let go.

    Of random links the roots are those of mean ages, and the longer run alone decides.
    """
    scenario, ends_s = drawn.scenario, drawn.scenario.duration_s
    run = FusedRun(prolong_scenario(scenario, LONGER * ends_s))
    states = []
    for t_s in np.linspace(0.75, 1.0, 100) * ends_s if has_sampled_wall(scenario) else ():
        run.advance(float(t_s))
        states.append((run.q, run.theta_hat))
    run.advance(ends_s)
    in_contact = find_contact_growth(scenario, *map(np.array, zip(*states, strict=True))) if states else -1.0
    run.advance(LONGER * ends_s)
    at = Equilibrium(run.q, run.theta_hat, "", 0.0)
    if run.diverged_s is not None:
        at = at._replace(q=np.array([spec.q0_rad for spec in scenario.sites.values()]))
    root = _rightmost(scenario, at)
    near = False
    if drawn.key and root is not None:
        beside = [_rightmost(_scaled(drawn, factor), at) for factor in NEAR_AN_EDGE]
        near = any(one is not None and (one > 0.0) != (root > 0.0) for one in beside)
    if run.diverged_s is not None:
        return Truth(True, root, near)
    early, late = _peak_speeds(run, 0.75 * ends_s, ends_s), _peak_speeds(run, (LONGER - 1.0) * ends_s)
    slow = root is not None and -SLOW_PER_S < root < 0.0
    lasts = bool((late > np.maximum((1.2 if slow else 0.5) * early, SEEN)).any())
    grows = root is not None and root > 0.0 and not scenario.links_random
    return Truth(lasts or grows or in_contact > 0.0, root, near)


def has_sampled_wall(scenario: Scenario) -> bool:
    """True if a wall is held over a tick."""
    return any(one.actor.sampled for spec in scenario.sites.values() for one in spec.environment)


def _peak_speeds(run: FusedRun, from_s: float, to_s: float = np.inf) -> Array:
    """The largest |qd| of every joint over a span, shape (N, 2), rad/s."""
    first, last = (round(t_s * BUCKETS_PER_S) for t_s in (from_s, min(to_s, run.ran_s)))
    return np.array([site[first:last, JOINTS : 2 * JOINTS].max(axis=0) for site in run.buckets])


def _rightmost(scenario: Scenario, at: Equilibrium) -> float | None:
    """The real part of the rightmost root at the rest next to a pose; None without a loop or a rest there."""
    if scenario.links_random:
        scenario = load_scenario(scenario, {"duration_s": 4.0})  # ages are counted sample by sample
    try:
        rest = follow_equilibrium(scenario, at)
        root = find_rightmost_root(derive_operating_conditions(scenario), rest, sampled=True)
    except (ScenarioError, np.linalg.LinAlgError):
        return None
    return None if root is None else root.s.real


def _scaled(drawn: Drawn, factor: float) -> Scenario:
    """The experiment with its key times a factor."""
    if drawn.key == STIFFNESS:
        value = drawn.scenario.sites["s"].environment[0].stiffness_n_m
        return load_scenario(drawn.scenario, {STIFFNESS: factor * value})
    sites = drawn.scenario.sites.items()
    damping = {f"sites.{name}.control.d": [factor * d for d in spec.control.d] for name, spec in sites}
    return load_scenario(drawn.scenario, damping)


def say_of(log: Log) -> str:
    """The word of `trilat certify`."""
    return str(trilat_net.certify(log).stability)


class RunInMemory:
    """A compiled run with what the roots at its end pose take from a log: its states every 50 ms."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.sites, self._run = scenario, scenario.names, FusedRun(scenario)
        self._run.advance(scenario.duration_s)

    def find_end(self) -> RunEnd:
        """The judgement of its end."""
        run = self._run
        return classify_run_end(self.scenario, RunTrace(run.buckets, run.tau_x, run.diverged_s))

    def changes(self, _site: str) -> tuple[()]:
        """Nobody gives it commands."""
        return ()

    def __getitem__(self, site: str) -> Any:
        n, rate_hz = self.sites.index(site), self.scenario.sites[site].rate_hz
        buckets, end = self._run.buckets[n], "run" if self._run.diverged_s is None else "diverged"
        return LastOfBuckets(
            rate_hz=rate_hz,
            mode=[end],
            t_s=np.arange(1, len(buckets) + 1) / BUCKETS_PER_S - 1.0 / rate_hz,
            q=buckets[:, 2 * JOINTS :],
            qd=buckets[:, JOINTS : 2 * JOINTS],
            theta_hat=np.tile(self._run.theta_hat[n], (len(buckets), 1)),
        )


class LastOfBuckets(SimpleNamespace):
    """A site's part of such a run: its last q of every bucket, and its largest |qd|."""

    def __len__(self) -> int:
        return len(self.t_s)


def say_of_run(scenario: Scenario) -> str:
    """The word of `trilat certify` on a scenario's run, and no log is made where none is needed.

    V, if the law has one, takes all records, and so do ages that vary.
    """
    varies = not all(map(is_constant_link, scenario.links.values()))
    if varies or not any(map(explain_missing_functional, scenario.sites.values())):
        return say_of(trilat_net.simulate(scenario))
    run = RunInMemory(scenario)
    no_v = StabilityVerdict(StabilityFinding.NOT_JUDGED, "")
    ticks = {site: scenario.ticks(site) for site in scenario.names}
    whole = Evidence(Coverage(ticks, ticks), None, MIN_COVERAGE, Integrity(ChainState.INTACT, ""))
    roots = find_end_pose_roots(run)  # type: ignore[arg-type]
    end = run.find_end()
    twins = measure_virtual_twins(scenario, end, scenario.duration_s)
    return str(Certificate([], no_v, end, whole, None, roots=roots, twins=twins).stability)


def say_of_sweep(scenario: Scenario) -> str:
    """The word of a cell of `trilat sweep`."""
    stable = classify_cell(scenario.text, LONGER * scenario.duration_s).verdict.stable
    return str({True: Stability.STABLE, False: Stability.NOT_STABLE, None: Stability.OPEN}[stable])


class Judged(NamedTuple):
    """A drawn experiment, its truth, and what `certify` and a sweep say of it."""

    drawn: Drawn
    truth: Truth
    certified: str
    swept: str


def judge_experiment(seed: int, *, stored: bool = True) -> Judged:
    """What is said of the experiment of a seed; its truth is read from `TRUTHS` if it is stored there."""
    drawn = draw_experiment(seed)
    truth = read_truth(seed, drawn) if stored else find_truth(drawn)
    return Judged(drawn, truth, say_of_run(drawn.scenario), say_of_sweep(drawn.scenario))


def read_truth(seed: int, drawn: Drawn) -> Truth:
    """The truth of a seed, as it was stored for this very scenario."""
    digest, unstable, root_per_s, near = _read_rows()[seed]
    anew = "python -m tests.certificate.adversaries --find-truths"
    assert digest == _digest(drawn), f"seed {seed} draws another scenario than its truth is of: run {anew}"
    return Truth(unstable == "1", float(root_per_s) if root_per_s else None, near == "1")


@cache
def _read_rows() -> list[list[str]]:
    return [row.split(",")[1:] for row in TRUTHS.read_text().splitlines()[1:]]


def _digest(drawn: Drawn) -> str:
    return drawn.scenario.sha256[:12]


def write_truth(seed: int) -> str:
    """The row of a seed, its truth found anew."""
    drawn = draw_experiment(seed)
    unstable, root, near = find_truth(drawn)
    root_per_s = "" if root is None else f"{root:.6g}"
    return f"{seed},{_digest(drawn)},{unstable:d},{root_per_s},{near:d}"


class Tally(NamedTuple):
    """Counts over some experiments."""

    runs: int
    unstable: int
    near: int
    false_ok: int
    false_alarm: int
    undecided: int


def tally(judged: Iterable[Judged], by: str = "certified") -> Tally:
    """Counts of what `by` says: wrongly stable, wrongly not, and neither."""
    rows = [(one.truth, getattr(one, by)) for one in judged]
    return Tally(
        len(rows),
        sum(truth.unstable for truth, _ in rows),
        sum(truth.near for truth, _ in rows),
        sum(truth.unstable and word == "stable" for truth, word in rows),
        sum(not truth.unstable and word == "not stable" for truth, word in rows),
        sum(word == "open" for _, word in rows),
    )


def main() -> None:
    """Prints the table of docs/certificate.md."""
    parser = argparse.ArgumentParser(description="What is said of random experiments whose truth is known.")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--find-truths", action="store_true", help="write truths.csv anew")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        if asked.find_truths:
            rows = pool.map(write_truth, range(asked.seeds), chunksize=8)
            TRUTHS.write_text("\n".join(["seed,digest,unstable,root_per_s,near", *rows, ""]))
            return
        judged = list(pool.map(judge_experiment, seeds, chunksize=8))
    print("| experiments | runs | unstable | near an edge | false ok | false alarms | open |")
    print("|---|---|---|---|---|---|---|")
    kinds = sorted({one.drawn.kind for one in judged})
    for by in ("certified", "swept"):
        for kind in (*kinds, ""):
            found = [one for one in judged if kind in ("", one.drawn.kind)]
            name = kind or f"all, {by}"
            if kind == "" or by == "certified":
                print("| " + " | ".join([name, *map(str, tally(found, by))]) + " |")
    for seed, one in zip(seeds, judged, strict=True):
        for by in ("certified", "swept"):
            if any(tally([one], by)[3:5]):
                print(f"seed {seed}: {one.drawn.kind}, {one.truth}, {by}: {getattr(one, by)}")


if __name__ == "__main__":
    main()
