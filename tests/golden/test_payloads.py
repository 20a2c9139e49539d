"""The payload bytes of every channel stay as they were before the house was put in order.

`payloads.json` was written then: the channels of `trilat sim` for every shipped scenario, and of two live
sessions (`live-*.mcap`) executed again in closed loop.
"""

import json
import subprocess
from pathlib import Path

import pytest

from trilat_net.core.step.fingerprint import compute_fingerprint

from .digests import COMMAND, channel_digests

HERE = Path(__file__).parent
BEFORE = json.loads((HERE / "payloads.json").read_text())

pytestmark = pytest.mark.skipif(
    compute_fingerprint() != BEFORE["fingerprint"],
    reason="another arithmetic: L5 compares whole runs on an equal one",
)


SHORTER_THEN = {"4g": "30", "p_d_margin": "60"}
"""How long these ran then, s."""

CHAINS = ("six_joints", "seven_joints", "wall_in_space")
"""Scenarios whose speed limits come from the files of their arms."""

PUSHED = ("paper", "live-paper.mcap")
"""What a push looks at: the paper's hands, simulated and live."""


def limits_then(scenario: str) -> list[str]:
    """The speed limit of planar arms was 100 rad/s then, whatever their motors bear."""
    if scenario in CHAINS:
        return []
    sites = ("sites.m1.", "sites.m2.") if scenario == "unlike_arms" else ("",)
    return [word for site in sites for word in ("--set", f"{site}limits.qd_limit_rad_s=100.0")]


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(name, marks=() if name in PUSHED else pytest.mark.long)
        for name in BEFORE["sim"]
    ],
)
@pytest.mark.push
def test_the_payloads_of_a_simulated_scenario_are_the_same_bytes(
    scenario: str, tmp_path: Path
) -> None:
    path = tmp_path / "sim.mcap"
    then = ["--duration", SHORTER_THEN[scenario]] if scenario in SHORTER_THEN else []
    command = [*COMMAND, "sim", scenario, "-o", str(path), *then, *limits_then(scenario)]
    subprocess.run(command, check=True, capture_output=True)
    assert channel_digests(path) == BEFORE["sim"][scenario]


@pytest.mark.parametrize(
    "log",
    [
        pytest.param(name, marks=() if name in PUSHED else pytest.mark.long)
        for name in BEFORE["live"]
    ],
)
def test_payloads_of_live_session_executed_again_are_same_bytes(
    log: str, tmp_path: Path
) -> None:
    path = tmp_path / "rerun.mcap"
    command = [*COMMAND, "rerun", str(HERE / log), "--closed-loop", "-o", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    assert channel_digests(path) == BEFORE["live"][log]
