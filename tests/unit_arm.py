"""The unit arm: a mass of exactly 1 kg m^2 in one direction, without gravity and Coriolis torques.

M = [[5/6, 1/3], [1/3, 1/3]], so along (1, 1/2) it answers a torque along (1, 1/2) as 1 kg m^2 would. A law
with one gain for both joints keeps that line: x is q1, and q2 = q1 / 2.
"""

from collections.abc import Mapping
from typing import Any

from tests.execution.builders import Array, sample_records
from tests.transmission import VARIANTS
from trilat_net.own_code.code_consent import allow_own_code
from trilat_net.scenario import Scenario, parse_scenario

ARM = {
    "l1_m": 1.0,
    "m1_kg": 1.0,
    "lc1_m": 1e-12,
    "I1_kg_m2": 0.25,
    "l2_m": 1.0,
    "m2_kg": 0.25,
    "lc2_m": 1e-12,
    "I2_kg_m2": 0.3333333333333333,
    "g_m_s2": 0.0,
}
CLAMP = {
    "kind": "spring",
    "stiffness_nm_rad": 1000.0,
    "damping_nm_s_rad": 0.0,
    "to_rad": [0.0, 0.0],
}
"""A spring that clamps the slave, which is free without the spring."""


def make_spring_hand(
    to: float, stiffness: float = 50.0, damping: float = 10.0, start_s: float = 1.0
) -> dict[str, Any]:
    """Returns a spring hand that goes to x = `to` in two seconds."""
    gains = {"stiffness_nm_rad": stiffness, "damping_nm_s_rad": damping}
    return {
        "kind": "spring",
        "to_rad": [to, 0.5 * to],
        "move_start_s": start_s,
        "move_end_s": start_s + 2.0,
        **gains,
    }


H50 = make_spring_hand(0.3)
"""The hand of most tests."""
WALL = make_spring_hand(0.0, 500.0, 5.0)
DRIVE = {
    "kind": "multisine",
    "amplitude_nm": [2.0, 1.0],
    "frequencies_hz": [1.0],
    "end_s": 1000.0,
}


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f'"{key}" = {_toml(item)}' for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def unit_text(
    sites: Mapping[str, Mapping[str, Any]], control: Mapping[str, Any], **more: Any
) -> str:
    """Returns sites with unit arms, the last one a slave; two follow each other, more share as
    `dominance` says.

    `more` are keys of the scenario; links have 200 ms unless `link` says otherwise.
    """
    names = [*sites]
    roles = {name: "slave" if name == names[-1] else "master" for name in names}
    pair = dict(zip(names, ({name: 1.0} for name in reversed(names)), strict=True))
    table = {
        "name": "unit",
        "rate_hz": 1000,
        "scheme": "digital",
        "arm": ARM,
        "limits": {"tau_limit_nm": 1e6, "qd_limit_rad_s": 1e3},
        "link": {"model": "constant", "delay_ms": 200.0},
        "sites": {
            name: {"role": roles[name], "q0_rad": [0.0, 0.0], **site}
            for name, site in sites.items()
        },
        "control": control,
        "dominance": pair,
        **more,
    }
    return "\n".join(f"{key} = {_toml(value)}" for key, value in table.items())


def make_unit_scenario(
    sites: Mapping[str, Mapping[str, Any]], control: Mapping[str, Any], **more: Any
) -> Scenario:
    """Returns the scenario of `unit_text`."""
    return allow_own_code(parse_scenario(unit_text(sites, control, **more), "unit"))


def read_last_rows(scenario: Scenario, *times_s: float) -> list[dict[str, Array]]:
    """Returns, per time, the records before it, of a compiled run: by field shape (N, 2)."""
    rows = sample_records(scenario, times_s)
    columns = next(iter(scenario.names))
    fields = scenario.layout(columns).columns()
    return [{name: rows[:, k, fields[name]] for name in fields} for k in range(len(times_s))]


def make_four_channel_pair(
    variant: str, delay_s: float, duration_s: float = 9.0, **more: Any
) -> Scenario:
    """Returns a driven master and a slave at a wall, `delay_s` apart, under a variant of the
    four-channel law.
    """

    def make_control(at: int) -> dict[str, Any]:
        law = {"law": "four_channel", "K": 100.0, "B": 20.0, **VARIANTS[variant], **more}
        return {
            key: value[at] if isinstance(value, tuple) else value for key, value in law.items()
        }

    sites = {
        "m": {"hands": [DRIVE, make_spring_hand(0.0)], "control": make_control(0)},
        "s": {"hands": [WALL], "control": make_control(1)},
    }
    link = {"model": "constant", "delay_ms": 1e3 * delay_s}
    return make_unit_scenario(sites, {}, link=link, duration_s=duration_s)
