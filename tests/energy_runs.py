"""Compiled runs with the numbers of every tick by name, including the messages of laws."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.execution.builders import sample_records
from tests.unit_arm import CLAMP, H50, make_spring_hand, make_unit_scenario
from trilat_net.scenario import Scenario

CONSTANT = {"model": "constant", "delay_ms": 200.0}
JITTER = {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 200.0, "loss": 0.1}
MOBILE = {"preset": "4g"}
FOLLOWER = {"K": 100.0, "B": 10.0}
LEADER = {"K": 0.0, "B": 0.0}
LAWS: dict[str, dict[str, Any]] = {
    "wave": {"law": "wave"},
    "tdpa": {"law": "tdpa"},
    "tanks": {"law": "tanks"},
}


def make_energy_pair(
    control: dict[str, Any], *, clamped: bool, duration_s: float, **more: Any
) -> Scenario:
    """Returns a master that leads only, with the hand H50, and a slave with K and B if the law has them."""
    follows, leads = (
        ({}, {}) if control["law"].lower().endswith("tanks") else (FOLLOWER, LEADER)
    )
    slave = {"hands": [CLAMP] if clamped else [], "control": {**control, **follows}}
    sites = {"m": {"hands": [H50], "control": {**control, **leads}}, "s": slave}
    return make_unit_scenario(
        sites, control, **{"duration_s": duration_s, "link": CONSTANT, **more}
    )


def sample_contact_run(
    delay_ms: float, duration_s: float = 20.0, loss: float = 0.0, **more: Any
) -> Any:
    """Returns every tick of a master that leads only, and of a slave held by 700 N m/rad and 3 N m s/rad."""
    law = {"law": "tdpa", **more}
    clamp = {**CLAMP, "stiffness_nm_rad": 700.0, "damping_nm_s_rad": 3.0}
    sites = {
        "m": {
            "hands": [make_spring_hand(0.3, 40.0, 6.0)],
            "control": {**law, "K": 0.0, "B": 0.0},
        },
        "s": {"hands": [clamp], "control": {**law, "K": 80.0, "B": 8.0}},
    }
    link = {**CONSTANT, "delay_ms": delay_ms, "loss": loss}
    return sample_every_tick(make_unit_scenario(sites, law, duration_s=duration_s, link=link))


def sample_every_tick(scenario: Scenario, every: int = 1) -> dict[str, Any]:
    """Returns per site arrays with a row for every so many ticks, up to the last.

    They are q, qd, tau, ..., and what it sends: `to_all.H` of shape (rows, length), `sent[j].u` to peer j.
    """
    rate_hz = next(iter(scenario.sites.values())).rate_hz
    ticks = np.arange(every, round(scenario.duration_s * rate_hz) + 1, every)
    rows = sample_records(scenario, ticks / rate_hz)
    return {
        name: _name_columns(scenario, name, site)
        for name, site in zip(scenario.names, rows, strict=True)
    }


def _name_columns(scenario: Scenario, name: str, rows: Any) -> Any:
    columns = scenario.layout(name).columns()
    ch = rows[:, columns.pop("ch")]
    run = SimpleNamespace(
        **{key: rows[:, column] for key, column in columns.items()}, to_all=SimpleNamespace()
    )
    run.sent = [SimpleNamespace() for _ in scenario.peers(name)]
    vectors = scenario.channel(name).vectors
    places = [(run.to_all, vector) for vector in vectors if not vector.per_peer]
    places += [(to, vector) for to in run.sent for vector in vectors if vector.per_peer]
    first = 0
    for to, vector in places:
        setattr(to, vector.name, ch[:, first : first + vector.length])
        first += vector.length
    return run


def find_least_energy(run: dict[str, Any]) -> float:
    """Returns the least energy that any end of a line or coupling, or any tank, has observed, in J."""
    energies = [run[site].to_all.H for site in run if hasattr(run[site].to_all, "H")]
    energies += [
        getattr(to, name)
        for site in run.values()
        for to in site.sent
        for name in ("W", "W_led", "W_followed")
        if hasattr(to, name)
    ]
    return min(float(energy.min()) for energy in energies)


def draw_energy_run(law: str, seed: int) -> Scenario:
    """Two or three sites, half of the runs with planar arms, over a bad network; shares change thrice.

    Half of the samples are lost, or delays are those of 4g, or jitter is as long as the delay. In most runs
    the slave is in contact, or is pushed.
    """
    rng = np.random.default_rng(seed)
    names = ["m1", "m2", "s"] if rng.random() < 0.65 else ["m1", "s"]
    K = round(float(np.exp(rng.uniform(np.log(20.0), np.log(300.0)))), 1)
    B = round(K * float(rng.uniform(0.03, 0.15)), 2)
    T = round(float(rng.uniform(20.0, 250.0)), 1)
    b = round(float(rng.uniform(2.0, 20.0)), 2)
    keys: dict[str, dict[str, Any]] = {
        "tdpa": {"K": K, "B": B},
        "wave": {"b": b, "K": K * float(rng.random() < 0.6), "B": b},
        "tanks": {"K": K, "Kd": B},
    }
    links: list[dict[str, Any]] = [
        MOBILE,
        {"model": "uniform", "delay_ms": T, "half_width_ms": T, "loss": 0.1},
        {"model": "constant", "delay_ms": T, "loss": 0.5},
        {"model": "uniform", "delay_ms": T, "half_width_ms": round(0.5 * T, 1), "loss": 0.5},
    ]
    clamp = {
        **CLAMP,
        "stiffness_nm_rad": float(rng.uniform(200.0, 1500.0)),
        "damping_nm_s_rad": 3.0,
    }
    push = {"kind": "pulse", "start_s": 3.0, "end_s": 3.3, "peak_nm": [8.0, 4.0]}
    sites: dict[str, Any] = {"s": {"hands": [[clamp], [clamp], [push], []][rng.integers(4)]}}
    for name, to in zip(names[:-1], (0.3, -0.3), strict=False):
        k = round(float(rng.uniform(20.0, 100.0)), 1)
        sites = {
            name: {"hands": [make_spring_hand(to * float(rng.uniform(0.5, 1.5)), k, 0.15 * k)]},
            **sites,
        }
    sites = {name: sites[name] for name in names}
    more: dict[str, Any] = (
        {} if rng.random() < 0.5 else {"arm": {}, "limits": {"tau_limit_nm": 200.0}}
    )
    if len(names) == 3:
        times = [(at_s, name) for at_s in (2.5, 4.5, 6.5) for name in names]
        changes = [
            {"at_s": at_s, "dominance": name, "to": _draw_shares(rng, name)}
            for at_s, name in times
        ]
        more["timeline"] = [
            {**change, "ramp_s": float(rng.choice([0.0, 0.05, 1.0]))} for change in changes
        ]
        more["dominance"] = {name: _draw_shares(rng, name) for name in names}
    control = {"law": law, **keys[law]}
    link = links[rng.integers(4)]
    return make_unit_scenario(sites, control, duration_s=8.0, link=link, seed=seed, **more)


def _draw_shares(rng: np.random.Generator, name: str) -> dict[str, float]:
    first, second = (peer for peer in ("m1", "m2", "s") if peer != name)
    share = round(float(rng.uniform(0.05, 0.95)), 3)
    return {first: share, second: round(1.0 - share, 3)}
