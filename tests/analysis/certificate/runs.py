"""Virtual runs with their energy books, each made once per test session."""

import json
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

import trilat_net
from trilat_net.analysis.certificate.certificate_result import Certificate
from trilat_net.analysis.certificate.energy_balance import (
    EnergyBalance,
    SiteEnergy,
    compute_energy_balance,
    compute_site_energies,
)
from trilat_net.analysis.certificate.stability_certificate import certify
from trilat_net.scenario import load_scenario, parse_scenario

ROWS = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.8, "s": 0.2}, "s": {"m1": 0.8, "m2": 0.2}}
LYAPUNOV = {
    **{f"dominance.{i}.{j}": share for i, row in ROWS.items() for j, share in row.items()},
    "sites.m1.control.Kd": 10.0,
    "sites.m2.control.Kd": 3.0,
    "sites.s.control.Kd": 0.3,
    "control.Kp": 0.1,
    "duration_s": 5.0,
    "rate_hz": 500,
}
"""Unequal shares and Kd, upon `free`."""

JITTER = {
    "link.model": "uniform",
    "link.delay_ms": 200.0,
    "link.half_width_ms": 50.0,
    "duration_s": 3.0,
}

EXPERT = {
    "dominance.m1.m2": 0.0,
    "dominance.m1.s": 1.0,
    "dominance.s.m1": 1.0,
    "dominance.s.m2": 0.0,
}
"""m1 and s follow each other, and m2 follows both."""

RICH = """
name = "rich"
rate_hz = 500
duration_s = 6.0
[control]
law = "adaptive_box"
theta_hat0 = [0.0, 0.0, 0.0, 1.9, 0.95]
theta_low = [-9.0, -9.0, -9.0, 1.8, 0.9]
theta_high = [9.0, 9.0, 9.0, 2.1, 1.05]
[link]
delay_ms = 100.0
[sites.m1]
role = "master"
q0_rad = [-0.6, 1.8]
[[sites.m1.hands]]
kind = "spring"
to_rad = [-0.2, 1.2]
move_start_s = 0.5
move_end_s = 2.0
stiffness_nm_rad = 60.0
damping_nm_s_rad = 5.0
sampled = true
[sites.m2]
role = "master"
q0_rad = [-0.9, 1.9]
hands = [{ kind = "pulse", start_s = 2.5, end_s = 4.0, peak_nm = [6.0, -3.0] }]
on_stale = { action = "hold", age_ms = 300.0, return_s = 0.5 }
[sites.s]
role = "slave"
q0_rad = [-0.4, 1.6]
limits = { tau_limit_nm = 18.0 }
environment = [
    { kind = "wall", point_m = [1.2, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 300.0 },
    { kind = "viscous", damping_nm_s_rad = 0.5, sampled = true },
]
[dominance]
m1 = { m2 = 0.4, s = 0.6 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.7, m2 = 0.3 }
[links."m1->s"]
model = "uniform"
delay_ms = 100.0
half_width_ms = 60.0
[links."s->m1"]
model = "uniform"
delay_ms = 60.0
half_width_ms = 40.0
loss = 0.3
[links."s->m2"]
delay_ms = 100.0
outages_s = [[1.0, 1.8]]
[[timeline]]
at_s = 1.0
dominance = "s"
to = { m1 = 0.2, m2 = 0.8 }
ramp_s = 1.5
[[timeline]]
at_s = 3.0
dominance = "m1"
to = { m2 = 0.9, s = 0.1 }
"""
"""Everything at once that can give energy to V."""

WALL = """
name = "wall"
rate_hz = 500
duration_s = 6.0
[control]
theta_hat0 = [3.0, 1.0, 1.0, 2.0, 1.0]
[link]
delay_ms = 200.0
[sites.m1]
q0_rad = [-0.6, 1.8]
[[sites.m1.hands]]
kind = "tip_spring"
to_m = [1.5, 0.37]
move_start_s = 1.0
move_end_s = 3.0
stiffness_n_m = 100.0
damping_n_s_m = 20.0
[sites.m2]
q0_rad = [-0.6, 1.8]
[sites.s]
role = "slave"
q0_rad = [-0.6, 1.8]
environment = [{ kind = "wall", point_m = [1.24, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 10000.0 }]
[dominance]
m1 = { m2 = 0.5, s = 0.5 }
m2 = { m1 = 0.5, s = 0.5 }
s = { m1 = 0.5, m2 = 0.5 }
"""

TEXTS = {"rich": RICH, "wall": WALL}


class _Run:
    """A run, and the results computed from the run, each computed once."""

    def __init__(self, name: str, overrides: Mapping[str, Any]) -> None:
        known = name in TEXTS
        scenario = (
            parse_scenario(TEXTS[name], name, overrides)
            if known
            else load_scenario(name, overrides)
        )
        self.log = trilat_net.simulate(scenario)

    @cached_property
    def energies(self) -> dict[str, SiteEnergy]:
        return compute_site_energies(self.log)

    @cached_property
    def balance(self) -> EnergyBalance:
        return compute_energy_balance(self.energies)

    @cached_property
    def certificate(self) -> Certificate:
        return certify(self.log)


_made: dict[str, _Run] = {}


def run(name: str, overrides: Mapping[str, Any] | None = None) -> _Run:
    """Returns a run of a shipped scenario or of a scenario above, made once per test session."""
    key = json.dumps([name, overrides or {}], sort_keys=True)
    if key not in _made:
        _made[key] = _Run(name, dict(overrides or {}))
    return _made[key]


def relative(balance: EnergyBalance) -> float:
    """Returns the largest residual of a balance as a share of the largest energy."""
    return float(np.abs(balance.residual).max()) / max(balance.scale, 1e-12)
