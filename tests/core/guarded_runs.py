"""Two arms under the rule `glide`: their limits, orders at ticks, and the reasons in a log."""

import functools
from typing import Any

import numpy as np

from tests.log.builders import open_bytes, simulate_bytes
from trilat_net.core.step.ticks import CoreChange, LifeReason, tick_ns
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import RESTING_MODES
from trilat_net.own_code.code_consent import allow_own_code
from trilat_net.scenario import Scenario, parse_scenario

TEXT = """
name = "glide"
duration_s = {duration_s}
rate_hz = {rate_hz}
[arm]
[control]
law = "pd_d"
K = 60.0
Kd = 4.0
d = 12.0
[on_stale]
action = "glide"
align_speed_rad_s = {speed}
align_limit_rad = {limit}
[link]
delay_ms = 100
outages_s = {outages_s}
[sites.m]
q0_rad = [0.8, 0.3]
[[sites.m.hands]]
kind = "spring"
to_rad = [-0.4, 0.9]
move_start_s = 0.5
move_end_s = 4.0
stiffness_nm_rad = 80.0
damping_nm_s_rad = 8.0
[sites.s]
role = "slave"
q0_rad = [0.1, 0.4]
[dominance]
m = {{ s = 1.0 }}
s = {{ m = 1.0 }}
"""
RATE_NM_S = 500.0
LIMITS = {
    "tau_rate_limit_nm_s": RATE_NM_S,
    "qd_des_limit_rad_s": 6.0,
    "q_min_rad": -4.0,
    "q_max_rad": 4.0,
}
KEYS = {"duration_s": 6.0, "rate_hz": 1000, "outages_s": "[]", "speed": 1.0, "limit": 4.0}


def adaptive_text() -> str:
    """Returns the scenario of the rule, with the paper's law."""
    text = TEXT.replace(
        "K = 60.0\nKd = 4.0\nd = 12.0", "Lambda = 2.0\nKp = 4.0\nKd = 5.0\nGamma = 3.0"
    )
    return text.replace('law = "pd_d"', 'law = "adaptive"')


def make_guarded_scenario(
    limits: dict[str, Any] = LIMITS, text: str = TEXT, where: str = "", **keys: object
) -> Scenario:
    """Returns the scenario of the rule, with limits of all sites or of one."""
    overrides = {f"{where}limits.{key}": value for key, value in limits.items()}
    return allow_own_code(parse_scenario(text.format(**{**KEYS, **keys}), "", overrides))


def make_ordered_log(
    scenario: Scenario, orders: dict[str, dict[int, str]], ticks: int = 0
) -> Log:
    """Returns a virtual run in which sites are given orders at ticks."""

    def change(site: str, tick: int, order: str) -> CoreChange:
        t_ns = tick_ns(tick, scenario.sites[site].rate_hz)
        order_change = scenario.make_site_order(site, order, t_ns, ticks)
        return scenario.to_core_change(order_change)

    commands = {
        site: {tick: [change(site, tick, order)] for tick, order in of_site.items()}
        for site, of_site in orders.items()
    }
    return open_bytes(simulate_bytes(scenario, commands=commands))


def list_reasons(log: Log, site: str) -> list[tuple[str, LifeReason]]:
    """Returns the modes of a site in order, each with its reason."""
    modes: list[tuple[str, LifeReason]] = []
    for state in log[site].states:
        reason = LifeReason.of_record(state.to_tick_record(log[site].peers))
        if not modes or modes[-1] != (state.mode, reason):
            modes.append((state.mode, reason))
    return modes


@functools.cache
def make_stopped_log(text: str = TEXT, enabled: int = 3500) -> Log:
    """Returns the log of a slave that is stopped at 2 s, while it moves, and enabled at a tick."""
    return make_ordered_log(
        make_guarded_scenario(text=text), {"s": {2000: "stop", enabled: "enable"}}
    )


def find_largest_step(log: Log, site: str, first: int = 0) -> float:
    """Returns the largest change of a joint's torque between ticks; the torque before tick 0 is
    zero.

    The braking torque of an arm that comes to rest, B |qd| against its motion, is subtracted.
    """
    part = log[site]
    steps = np.diff(np.vstack([np.zeros_like(part.tau[:1]), part.tau]), axis=0)
    resting = np.isin(part.mode, RESTING_MODES)[:, None]
    brake = np.abs(part.qd) * resting * np.array(log.scenario.setup(site).rest.damping)
    against = np.where(steps * part.qd < 0.0, brake, 0.0)
    return float((np.abs(steps) - against)[first:].max())
