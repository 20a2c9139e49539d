"""Rules for every built-in law that is plugged in: bits, replay, the scenario that names the law."""

from typing import Any

import numpy as np
import pytest

from tests.control_laws.law_settings import LAWS
from tests.core.guarded_runs import RATE_NM_S, find_largest_step, make_ordered_log
from tests.execution.builders import make_trajectories, sample_records
from trilat_net.core.plug.compiled_law import is_compiled
from trilat_net.execution.verification import verify_log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.describe import describe_scenario
from trilat_net.scenario.laws import LAWS as ALL_LAWS

LONG = [
    name if name == "saturated_pd" else pytest.param(name, marks=pytest.mark.long)
    for name in LAWS
]


def make_law_overrides(law: str) -> dict[str, Any]:
    return {"duration_s": 0.12, "link.delay_ms": 20.0, "control.law": law, **LAWS[law][1]}


def make_law_scenario(law: str) -> Scenario:
    return load_scenario(LAWS[law][0], make_law_overrides(law))


@pytest.mark.parametrize("law", LAWS)
def test_checking_scenarios_states_the_laws_condition(law: str) -> None:
    lines = describe_scenario(make_law_scenario(law))
    assert (
        len([line for line in lines if line.startswith("condition of ") and law in line]) >= 1
    )


@pytest.mark.parametrize("law", LONG)
def test_every_driver_runs_the_same_bits(law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = make_law_scenario(law)
    ticks = make_trajectories(chosen)
    fused = sample_records(chosen, (0.12,))[:, 0]
    names = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
    columns = chosen.layout(chosen.names[0]).columns()
    for site, row in zip(ticks.sites.values(), fused, strict=True):
        assert all((getattr(site, name)[-1] == row[columns[name]]).all() for name in names)
    kind = chosen.sites[chosen.names[0]].control.kind
    if is_compiled(kind):  # others are in the kernel
        monkeypatch.setattr(kind, "is_compiled", False)
        plain = make_trajectories(chosen)
        for name in names:
            assert (plain.stack(name) == ticks.stack(name)).all()


DIGITAL = ("wave", "tdpa", "tanks")
FOR_TWO = ("p_f", *DIGITAL)
RULE: dict[str, Any] = {"action": "glide", "align_limit_rad": 4.0, "align_speed_rad_s": 2.0}


def make_apart_scenario(law: str, **more: Any) -> Scenario:
    """Sets arms 3 rad apart, which align at 2 rad/s."""
    name, settings = LAWS.get(law, ("two_sites" if law in FOR_TWO else "paper", {}))
    first, *others = load_scenario(name).names
    keys = {
        "control.law": law,
        "link.delay_ms": 20.0,
        f"sites.{first}.q0_rad": [3.2, 1.2],
        **{f"sites.{other}.q0_rad": [0.2, 1.5] for other in others},
        **{f"on_stale.{key}": value for key, value in RULE.items()},
        **({"scheme": "digital"} if law in DIGITAL else {}),
    }
    return load_scenario(name, {**settings, **keys, **more})


@pytest.mark.long
@pytest.mark.parametrize("law", [law for law in ALL_LAWS if law != "own"])
def test_torque_rates_stay_limited_in_every_event(law: str) -> None:
    """Arms begin 3 rad apart, links are cut, a site is stopped, the first one in fault; from tick 0 on."""
    more: dict[str, Any] = {
        "duration_s": 9.0,
        "link.outages_s": [[4.0, 4.5]],
        "limits.tau_rate_limit_nm_s": RATE_NM_S,
        # laws that take 20 ms badly would be in fault at the speed limit of the shipped arms
        "limits.qd_limit_rad_s": 100.0,
        **(
            {"arm.g_m_s2": 0.0} if law == "adaptive_kinematics" else {}
        ),  # elbows bent, and none hangs
    }
    far_scenario = make_apart_scenario(law, **more)
    orders = {
        "s": {
            2800: "stop",
            3200: "enable",
            3230: "stop",
            3300: "enable",
            7000: "stop",
            7040: "enable",
        },
        far_scenario.names[0]: {
            5500: "arm_lost",
            5530: "stop",
            6000: "reset",
            6050: "arm_lost",
            6400: "reset",
        },
    }
    log = make_ordered_log(far_scenario, orders)
    modes = {str(mode) for site in log.sites for mode in log[site].mode}
    assert {"waiting", "return", "run", "hold", "stopped", "fault"} <= modes
    for site in log.sites:
        assert find_largest_step(log, site) <= RATE_NM_S * 1e-3 * (1.0 + 1e-9), site
        assert np.isfinite(log[site].tau).all()
    assert verify_log(log).differing == 0


CALM = [
    law for law in ALL_LAWS if law not in ("own", "six_channel", "adaptive_kinematics", "sync")
]
"""Those that are stable with these arms and shares, from so far apart."""


@pytest.mark.parametrize(
    "law", [x if x in DIGITAL else pytest.param(x, marks=pytest.mark.long) for x in CALM]
)
def test_arms_far_apart_approach_slowly(law: str) -> None:
    """3 rad apart, at 2 rad/s and the law's own speed, at the start and after a stop; no spring
    is wound up.
    """
    far_scenario = make_apart_scenario(law, duration_s=6.0)
    unheld = load_scenario(
        far_scenario, {f"sites.{site}.hands": [] for site in far_scenario.names}
    )
    log = make_ordered_log(unheld, {"s": {1200: "stop", 4000: "enable"}})
    for site in log.sites:
        assert np.abs(log[site].qd).max() < 2.5 * RULE["align_speed_rad_s"], site
