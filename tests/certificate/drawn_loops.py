"""Experiments that are drawn from a seed, many of them near an edge of stability.

Seeds below `WIDE_FROM` draw loops of a few kinds at rest poses well apart. Larger seeds draw
every feature of a scenario: all laws, starts from 1e-10 to 1 rad apart, delays that swing,
drift or were recorded, several tick rates, chains, task space, walls, hands that hold or let
go.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

DRAWN_S = 40.0
"""The length of a drawn run."""
RODS = {"lc1_m": 0.5, "lc2_m": 0.5, "I1_kg_m2": 1 / 12, "I2_kg_m2": 1 / 12}
STIFFNESS = "sites.s.environment.0.stiffness_n_m"
SAMPLED = "sites.s.environment.0.sampled"


def _toml(value: Any) -> str:
    """Returns a value in TOML with nine digits, since further digits of a sine or an eigenvalue
    depend on the machine.
    """
    if isinstance(value, float):
        return json.dumps(float(f"{value:.9g}"))
    if isinstance(value, Mapping):
        return (
            "{ "
            + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items())
            + " }"
        )
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)


def make_experiment(name: str, **tables: Any) -> Scenario:
    """Returns the scenario of some tables."""
    keys = {
        "name": name,
        "rate_hz": 100,
        "duration_s": 30.0,
        "scheme": "second_order",
        **tables,
    }
    return parse_scenario("\n".join(f"{key} = {_toml(value)}" for key, value in keys.items()))


def make_swinging_hand(
    peaks: Iterable[tuple[float, float]], hertz: float = 1.0
) -> dict[str, Any]:
    """Returns a hand whose torque swings on joint 1 and 2, its size linear between (time s, N m)."""
    times, sizes = np.array(list(peaks)).T
    t_s = np.arange(times[0], times[-1] + 1e-9, 0.02)
    torque = np.interp(t_s, times, sizes) * np.sin(2 * np.pi * hertz * t_s)
    return {
        "kind": "recorded",
        "points": [[float(t), float(x), float(x)] for t, x in zip(t_s, torque, strict=True)],
    }


def p_d(d: Any, **more: Any) -> dict[str, Any]:
    """Returns P+d with 10 N m/rad."""
    return {"law": "p_d", "K": 10.0, "d": d, **more}


class Drawn(NamedTuple):
    """An experiment that was drawn: its kind, its scenario, the key that may be near an edge,
    and its features.
    """

    kind: str
    scenario: Scenario
    key: str = ""
    has: str = ""

    @property
    def wide(self) -> bool:
        """True if every feature was drawn."""
        return bool(self.has)


def _draw_sites(rng: np.random.Generator, names: str, spread_rad: float) -> dict[str, Any]:
    """Draws arms of several masses, about one pose."""
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


def _draw_shares(rng: np.random.Generator, names: str) -> dict[str, dict[str, float]]:
    """Draws shares of every site, of all of its peers or of one."""
    rows = {}
    for name in names:
        peers = [peer for peer in names if peer != name]
        if len(peers) > 1 and rng.random() < 0.2:
            peers = [str(rng.choice(peers))]
        cut = rng.dirichlet(np.ones(len(peers))).round(3)
        cut[-1] = 1.0 - cut[:-1].sum()
        rows[name] = dict(zip(peers, cut.tolist(), strict=True))
    return rows


def _draw_loop(rng: np.random.Generator, names: str, **more: Any) -> dict[str, Any]:
    """Draws a network of P+d or PD+d whose damping is about the edge of stability."""
    shares = _draw_shares(rng, names)
    T_ms = float(rng.uniform(80.0, 400.0))
    K = float(rng.uniform(8.0, 40.0))
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
        "sites": _draw_sites(rng, names, spread),
        "dominance": shares,
        **more,
    }


def _draw_network(rng: np.random.Generator) -> Drawn:
    loop_keys = _draw_loop(rng, "abce"[: rng.integers(2, 5)])
    return Drawn("network", make_experiment("network", **loop_keys), "control.d")


def _draw_noisy(rng: np.random.Generator) -> Drawn:
    loop_keys = _draw_loop(rng, "abc"[: rng.integers(2, 4)])
    loop_keys["link"] |= {
        "model": "uniform",
        "half_width_ms": min(3.0, loop_keys["link"]["delay_ms"]),
        "loss": 0.02,
    }
    return Drawn("noise", make_experiment("noise", **loop_keys), "control.d")


def _draw_groups(rng: np.random.Generator) -> Drawn:
    """Draws two closed groups, one of which hides the motion of the other."""
    keys = _draw_loop(rng, "abce")
    T = 0.001 * float(rng.uniform(50.0, 300.0))
    d = 10.0 * T * rng.uniform([1.2, 0.7], [2.5, 1.3])
    sites = _draw_sites(rng, "abce", 0.5)
    for n, name in enumerate("abce"):
        sites[name]["control"] = p_d(float(d[n // 2]))
        if n >= 2:
            sites[name]["q0_rad"] = [0.1 + 1e-3 * n, 0.2]
    pairs = {"a": {"b": 1.0}, "b": {"a": 1.0}, "c": {"e": 1.0}, "e": {"c": 1.0}}
    keys |= {"sites": sites, "dominance": pairs, "link": {"delay_ms": 1e3 * T}}
    return Drawn(
        "groups", make_experiment("groups", **{**keys, "control": p_d(1.0)}), "control.d"
    )


def _draw_adaptive(rng: np.random.Generator) -> Drawn:
    """Draws the paper's law at rates at which sampling may feed it."""
    names = "abc"[: rng.integers(2, 4)]
    late = rng.random() < 0.6
    loop_keys = _draw_loop(
        rng, names, link={"delay_ms": float(rng.uniform(20.0, 500.0)) if late else 0.0}
    )
    loop_keys["control"] = {
        "law": "adaptive",
        "Kp": float(rng.uniform(0.5, 3.0)),
        "Kd": float(rng.uniform(1.0, 5.0)),
    }
    return Drawn(
        "adaptive",
        make_experiment("adaptive", **{**loop_keys, "rate_hz": int(rng.choice([50, 100]))}),
    )


def _draw_delay(rng: np.random.Generator) -> Drawn:
    """Draws a delay that swings about twice as fast as the loop does."""
    T = float(rng.uniform(100.0, 250.0))
    link = {
        "model": "sine",
        "delay_ms": T,
        "amplitude_ms": T * float(rng.choice([0.1, 0.9])),
        "period_s": 1.0 / rng.uniform(1.0, 2.5),
    }
    loop_keys = _draw_loop(rng, "abc", link=link)
    if rng.random() < 0.5:
        loop_keys["control"] = {"law": "adaptive"}
    return Drawn("delay", make_experiment("delay", **loop_keys))


def _draw_wall(rng: np.random.Generator) -> Drawn:
    rate_hz = int(rng.choice([100, 200]))
    edge = 15.5e3 * rate_hz / 1000
    K = edge * (rng.uniform(0.8, 1.2) if rng.random() < 0.5 else rng.uniform(0.2, 2.5))
    # The stored truths are those of the speed limit that `windup` had when they were found.
    loop_keys = {
        SAMPLED: True,
        STIFFNESS: K,
        "rate_hz": rate_hz,
        "duration_s": DRAWN_S,
        "limits.qd_limit_rad_s": 100.0,
    }
    return Drawn("wall", load_scenario("windup", loop_keys), STIFFNESS)


def _draw_operator(rng: np.random.Generator) -> Drawn:
    """Draws a hand that swings to the end, or lets go long before the end."""
    loop_keys = _draw_loop(rng, "abc")
    loop_keys["control"] = p_d(float(rng.uniform(2.0, 6.0)))
    until_s = DRAWN_S - 0.02 if rng.random() < 0.5 else 0.3 * DRAWN_S
    hand = make_swinging_hand(
        [(0.0, 0.0), (until_s, float(rng.uniform(2.0, 10.0)))], float(rng.uniform(0.3, 1.5))
    )
    loop_keys["sites"]["a"]["hands"] = [hand]
    return Drawn("operator", make_experiment("operator", **loop_keys))


KINDS: tuple[tuple[float, Callable[[np.random.Generator], Drawn]], ...] = (
    (0.62, _draw_network),
    (0.08, _draw_noisy),
    (0.06, _draw_groups),
    (0.08, _draw_adaptive),
    (0.05, _draw_delay),
    (0.05, _draw_wall),
    (0.06, _draw_operator),
)


WIDE_FROM = 2000
"""The first seed that draws every feature of a scenario."""
_OF_TWO = ("p_f", "smith")
_LEARN = ("adaptive", "adaptive_box", "adaptive_robust", "sync", "adaptive_kinematics")
_TYPICAL: Mapping[str, Mapping[str, float]] = {
    "adaptive": {"Lambda": 1.0, "Kp": 2.0, "Kd": 3.0},
    "adaptive_box": {"Lambda": 1.0, "Kp": 2.0, "Kd": 3.0},
    "adaptive_robust": {"Lambda": 1.0, "Kp": 2.0, "Kd": 3.0},
    "p_d": {"K": 12.0, "d": 4.0},
    "pd_d": {"K": 12.0, "Kd": 2.0, "d": 4.0},
    "p_f": {"K": 12.0, "d": 4.0, "k_f": 0.2},
    "lee_spong": {"K": 10.0, "Kd": 3.0},
    "four_channel": {"K": 20.0, "B": 8.0},
    "six_channel": {"K": 20.0, "B": 8.0},
    "saturated_pd": {"K": 10.0, "P": 5.0, "d": 4.0},
    "authority": {"K": 10.0, "d": 4.0},
    "sync": {"Lambda": 1.0, "K": 3.0},
    "adaptive_kinematics": {"Lambda": 1.0, "Kp": 1.0, "Kd": 3.0},
    "impedance": {"M": 1.0, "B": 10.0, "K": 40.0},
    "smith": {"K": 10.0, "d": 4.0},
    "wave": {"b": 8.0, "K": 20.0, "B": 5.0},
    "tdpa": {"K": 40.0, "B": 5.0},
    "tanks": {"K": 40.0, "Kd": 4.0, "d": 1.0},
}
"""Gains about which those of every law are drawn."""


def _draw_about(rng: np.random.Generator, value: float, factor: float = 2.0) -> float:
    """Draws a number within a factor of another."""
    return float(f"{value * factor ** rng.uniform(-1.0, 1.0):.4g}")


def _draw_law(rng: np.random.Generator, law: str, names: str) -> list[dict[str, Any]]:
    """Draws a law with its gains, for every site."""
    gains: dict[str, Any] = {"law": law} | {
        key: _draw_about(rng, x) for key, x in _TYPICAL[law].items()
    }
    if law in _LEARN and rng.random() < 0.5:
        gains["theta_hat0"] = [3.0, 1.0, 1.0, 2.0, 1.0]
    if law == "tdpa":
        gains |= {
            "reserve_J": float(rng.choice([1e-3, 0.1, 10.0])),
            "energy": str(rng.choice(["step", "velocity"])),
        }
    if law == "tanks":
        gains |= {
            "level_J": float(rng.choice([0.01, 0.1, 5.0])),
            "by_shares": bool(rng.random() < 0.5),
        }
    if law == "wave" and rng.random() < 0.3:
        gains |= {"K": 0.0, "B": 0.0}
    settings: Callable[[int], dict[str, Any]] = {
        "authority": lambda n: {"leads": n < len(names) - 1},
        "impedance": lambda n: {"follows": n == len(names) - 1},
        "smith": lambda n: {"predicts": n == 0},
        "p_f": lambda n: (
            {"K": gains["K"], "k_f": 0.0} if n else {"K": 0.0, "k_f": gains["k_f"]}
        ),
    }.get(law, lambda _: {})
    return [gains | settings(n) for n in range(len(names))]


def _draw_link(rng: np.random.Generator) -> tuple[str, dict[str, Any]]:
    """Draws a link's name and its keys: constant, swinging, drifting, or recorded."""
    T_ms = round(float(rng.uniform(20.0, 250.0)), 1)
    kind = str(rng.choice(["constant", "sine", "ar1", "trace"]))
    if kind == "constant":
        return kind, {"delay_ms": T_ms}
    if kind == "sine":
        swing = round(T_ms * float(rng.uniform(0.1, 0.99)), 1)
        period_s = round(float(rng.uniform(0.4, 4.0)), 3)
        return kind, {
            "model": kind,
            "delay_ms": T_ms,
            "amplitude_ms": swing,
            "period_s": period_s,
        }
    if kind == "ar1":
        noise = {
            "deviation_ms": round(0.2 * T_ms, 1),
            "correlation": 0.999,
            "loss": float(rng.choice([0.0, 0.02])),
        }
        return kind, {"model": kind, "delay_ms": T_ms, **noise}
    walk = np.cumsum(rng.uniform(-0.2, 0.2, 40)).round(3)
    points = [
        f"{500_000 * n} {round(1e3 * T_ms * float(np.clip(1.0 + x, 0.3, 2.0)))}"
        for n, x in enumerate(walk)
    ]
    return kind, {"model": kind, "trace": ", ".join(points), "at_end": "loop"}


def _draw_touch(rng: np.random.Generator, sites: dict[str, Any]) -> str:
    """Draws a hand that holds, lets go or pushes, or an environment that resists, and returns its kind."""
    names = list(sites)
    to = [float(x) for x in rng.uniform(-0.8, 1.2, 2).round(3)]
    spring = {"kind": "spring", "to_rad": to, "stiffness_nm_rad": _draw_about(rng, 30.0, 3.0)}
    spring |= {
        "damping_nm_s_rad": _draw_about(rng, 6.0, 3.0),
        "move_start_s": 1.0,
        "move_end_s": 4.0,
    }
    kind = str(
        rng.choice(
            ["nobody", "hold", "lets go", "two hold", "push", "damper", "wall"], p=_TOUCHES
        )
    )
    if kind in ("hold", "two hold", "wall"):
        sites[names[0]]["hands"] = [spring]
    if kind == "two hold":
        sites[names[1]]["hands"] = [spring | {"to_rad": [to[0] + 0.3, to[1] - 0.2]}]
    if kind == "lets go":
        sites[names[0]]["hands"] = [spring | {"end_s": 9.0}]
    if kind == "push":
        sites[names[0]]["hands"] = [
            {"kind": "pulse", "start_s": 1.0, "end_s": 4.0, "peak_nm": [6.0, 3.0]}
        ]
    if kind in ("damper", "wall"):
        wall: dict[str, Any] = {
            "kind": "viscous",
            "damping_nm_s_rad": _draw_about(rng, 4.0, 3.0),
        }
        if kind == "wall":
            wall = {"kind": "wall", "point_m": [1.4, 0.0], "normal": [-1.0, 0.0]}
            wall |= {
                "stiffness_n_m": _draw_about(rng, 600.0, 4.0),
                "damping_n_s_m": _draw_about(rng, 10.0, 5.0),
            }
        sites[names[-1]]["environment"] = [wall | {"sampled": bool(rng.random() < 0.5)}]
    return kind


_TOUCHES = (0.4, 0.12, 0.12, 0.08, 0.1, 0.1, 0.08)


def _draw_wide(rng: np.random.Generator) -> Drawn:
    """Draws every feature of a scenario; contradictory draws are repeated."""
    while True:
        try:
            return _draw_anything(rng)
        except ScenarioError:
            continue


def _draw_anything(rng: np.random.Generator) -> Drawn:
    law = str(rng.choice(list(_TYPICAL)))
    names = "ab" if law in _OF_TWO or (law != "six_channel" and rng.random() < 0.4) else "abc"
    rate_hz = int(rng.choice([100, 200]))
    sites = _draw_sites(rng, names, 0.0)
    space = "joints"
    spread = float(f"{10.0 ** rng.uniform(-10.0, 0.0):.3g}")
    for name, control in zip(names, _draw_law(rng, law, names), strict=True):
        sites[name]["control"] = control
    if law not in ("wave",) and rng.random() < 0.25:
        for name in names:
            sites[name]["rate_hz"] = int(rng.choice([rate_hz // 2, rate_hz, 3 * rate_hz // 4]))
    link, keys = _draw_link(rng)
    touch = _draw_touch(rng, sites)
    loop_keys: dict[str, Any] = {"link": keys, "dominance": _draw_shares(rng, names)}
    starts = np.array(sites["a"]["q0_rad"]).round(3)
    if law in ("adaptive", "p_d", "pd_d") and rng.random() < 0.25:
        loop_keys["task"] = {"space": "position", "axes": ["x", "y"]}
        space = "position"
        starts = np.array([0.2, 1.4])
    elif touch == "nobody" and rng.random() < 0.15 and law != "adaptive_kinematics":
        loop_keys["arm"] = {"urdf": "arm6.urdf", "tip": "forearm", "armature_kg_m2": 0.3}
        starts = np.array([0.2, -1.0, 1.2])
        space = "chain"
        for name in names:
            del sites[name]["arm"]
            sites[name]["control"].pop("theta_hat0", None)
    loop_keys |= {
        "rate_hz": rate_hz,
        "duration_s": DRAWN_S,
        "scheme": str(rng.choice(["second_order", "digital"])),
    }
    if law in ("wave", "tdpa", "tanks"):
        loop_keys["scheme"] = "digital"
    for name in names:
        sites[name]["q0_rad"] = starts.tolist()
    alike = make_experiment("wide", sites=sites, **loop_keys)
    start_keys = {
        f"sites.{name}.q0_rad": [
            float(q + round(spread * x, 13)) for q, x in zip(starts, row, strict=True)
        ]
        for name, row in zip(
            names, rng.uniform(-1.0, 1.0, (len(names), len(starts))), strict=True
        )
    }
    return Drawn(law, load_scenario(alike, start_keys), has=f"{link}, {touch}, {space}")


def draw_experiment(seed: int) -> Drawn:
    """Returns the experiment of a seed."""
    rng = np.random.default_rng(seed)
    if seed >= WIDE_FROM:
        return _draw_wide(rng)
    shares, draws = zip(*KINDS, strict=True)
    return draws[rng.choice(len(draws), p=shares)](rng)
