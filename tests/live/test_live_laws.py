"""The laws that are plugged in, live: numbers of independent simulations, and every record executed again."""

from typing import Any

import numpy as np
import pytest

from sites.site_parts import warm_up
from tests.control_laws.law_settings import LAWS
from tests.energy_runs import FOLLOWER
from tests.live.processes import assert_executed_again, open_whole_log
from tests.unit_arm import H50, make_spring_hand, unit_text
from trilat_net.analysis.certificate.observed_energy import ObservedEnergy, ObservedFinding
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import load_scenario

from .processes import Session, Stage

pytestmark = pytest.mark.long
PAIR = ("m", "s")
PUBLISHED = {
    "energy": "velocity",
    "reserve_J": 0.0,
    "drift_rad_s": 0.0,
    "acceleration_rad_s2": 0.0,
}
STORED = {"wave": FOLLOWER, "tdpa": FOLLOWER, "tanks": {}}
"""Laws that keep account of energy, and what the slave has besides."""


def run_live(stage: Stage, scenario: str, sites: tuple[str, ...], *options: str) -> Log:
    for name in sites:  # compiled before the session waits for it
        warm_up(load_scenario(scenario, options[1::2]), name)
    session = Session(stage, scenario, sites, *options)
    session.all()
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    return open_log(session.log)


def run_unit_arms(
    stage: Stage, control: dict[str, Any], slave: dict[str, Any], **more: Any
) -> Log:
    sites = {"m": {"hands": [H50]}, "s": {"control": {**control, **slave}}}
    file = stage.folder / "unit.toml"
    file.write_text(
        unit_text(**{"sites": sites, "control": control, "duration_s": 12.0, **more})
    )
    return run_live(stage, str(file), PAIR)


def test_waves_through_200_ms(stage: Stage) -> None:
    log = run_unit_arms(stage, {"law": "wave"}, FOLLOWER)
    m = log["m"]
    s = log["s"]
    assert [m.q[-1, 0], s.q[-1, 0]] == pytest.approx([0.3, 0.3], abs=2e-3)
    assert np.abs(m.q - s.q)[:, 0].max() == pytest.approx(0.0476, rel=0.01)
    assert -m.tau[:, 0].min() == pytest.approx(1.763, rel=0.01)
    assert ObservedEnergy.of_log(log).finding is ObservedFinding.PASSIVE


def test_passivity_control_through_50_ms(stage: Stage) -> None:
    link = {"model": "constant", "delay_ms": 50.0}
    leads = {"law": "tdpa", **PUBLISHED, "K": 0.0, "B": 0.0}
    log = run_unit_arms(stage, leads, FOLLOWER, link=link)
    assert log["m"].q[-1, 0] == pytest.approx(0.3, abs=5e-5)
    assert log["s"].q[-1, 0] == pytest.approx(0.2864, abs=5e-5)
    least = min(
        min(values.min() for name, values in site.sent.items() if name.startswith("W_"))
        for site in (log["m"], log["s"])
    )
    assert least >= -1e-15


def test_four_channels_transmit_through_20_ms(stage: Stage) -> None:
    drive = {
        "kind": "multisine",
        "amplitude_nm": [2.0, 1.0],
        "frequencies_hz": [1.0],
        "end_s": 1000.0,
    }
    sites = {
        "m": {"hands": [drive, make_spring_hand(0.0)]},
        "s": {"hands": [make_spring_hand(0.0, 500.0, 5.0)]},
    }
    law = {"law": "four_channel", "K": 100.0, "B": 20.0}
    link = {"model": "constant", "delay_ms": 20.0}
    m = run_unit_arms(stage, law, {}, sites=sites, duration_s=9.0, link=link)["m"]
    turn = np.exp(-2j * np.pi * m.t_s[-1000:])
    felt = abs((m.tau_x[-1000:, 0] @ turn) / (m.qd[-1000:, 0] @ turn))
    assert felt / abs(500.0 / (2j * np.pi) + 5.0) == pytest.approx(0.650, rel=0.01)


@pytest.mark.parametrize("law", [*LAWS, *STORED])
def test_live_laws_are_executed_again_exactly(law: str, stage: Stage) -> None:
    scenario, changes = LAWS.get(law, ("two_sites", {"scheme": "digital"}))
    changes = {**changes, "duration_s": 2.0, "link.delay_ms": 20.0, "control.law": law}
    changes |= {f"sites.s.control.{key}": value for key, value in STORED.get(law, {}).items()}
    options = [
        word
        for key, value in changes.items()
        for word in ("--set", f"{key}={_format_value(value)}")
    ]
    sites = tuple(load_scenario(scenario).names)
    log = run_live(stage, scenario, sites, *options)
    assert sum(len(log[name]) for name in sites) == 2000 * len(sites)


def _format_value(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
