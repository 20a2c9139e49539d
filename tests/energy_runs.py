"""Runs in the compiled loop with the numbers of every tick by name, what laws send included."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.unit_arm import CLAMP, H50, unit_scenario
from tests.virtual_runs import sampled
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


def pair(control: dict[str, Any], *, clamped: bool, duration_s: float, **more: Any) -> Scenario:
    """A master with the hand H50 that leads only, and a slave with K and B, of laws that have them."""
    follows, leads = ({}, {}) if control["law"].lower().endswith("tanks") else (FOLLOWER, LEADER)
    slave = {"hands": [CLAMP] if clamped else [], "control": {**control, **follows}}
    sites = {"m": {"hands": [H50], "control": {**control, **leads}}, "s": slave}
    return unit_scenario(sites, control, **{"duration_s": duration_s, "link": CONSTANT, **more})


def ticked(scenario: Scenario, every: int = 1) -> dict[str, Any]:
    """Returns per site arrays with a row for every so many ticks, up to the last.

    They are q, qd, tau, ..., and what it sends: `to_all.H` of shape (rows, length), `sent[j].u` to peer j.
    """
    rate_hz = next(iter(scenario.sites.values())).rate_hz
    ticks = np.arange(every, round(scenario.duration_s * rate_hz) + 1, every)
    rows = sampled(scenario, ticks / rate_hz)
    return {
        name: _name_columns(scenario, name, site) for name, site in zip(scenario.names, rows, strict=True)
    }


def _name_columns(scenario: Scenario, name: str, rows: Any) -> Any:
    columns = scenario.layout(name).columns()
    ch = rows[:, columns.pop("ch")]
    run = SimpleNamespace(**{key: rows[:, one] for key, one in columns.items()}, to_all=SimpleNamespace())
    run.sent = [SimpleNamespace() for _ in scenario.peers(name)]
    vectors = scenario.channel(name).vectors
    places = [(run.to_all, one) for one in vectors if not one.per_peer]
    places += [(to, one) for to in run.sent for one in vectors if one.per_peer]
    first = 0
    for to, one in places:
        setattr(to, one.name, ch[:, first : first + one.length])
        first += one.length
    return run


def least_energy(run: dict[str, Any]) -> float:
    """The least energy, J, that any end of a line or coupling, or any tank, has observed."""
    found = [run[site].to_all.H for site in run if hasattr(run[site].to_all, "H")]
    found += [
        getattr(to, name)
        for site in run.values()
        for to in site.sent
        for name in ("W", "W_led", "W_followed")
        if hasattr(to, name)
    ]
    return min(float(one.min()) for one in found)
