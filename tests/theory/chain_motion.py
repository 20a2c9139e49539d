"""Three arms of six joints, pushed, over 200 ms: the scenario and its exact motion, stored."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from tests.core.chain_references import Array
from tests.scenario.builders import make_six_joint_scenario
from trilat_net.scenario import Scenario

PATH = Path(__file__).with_name("chain_motion.json")
TIMES_S = np.arange(1, 21) / 10.0


def pushed_chains(**changes: Any) -> Scenario:
    """Returns the scenario from rest in three poses; the first arm is pushed at every joint."""
    push = {
        "kind": "pulse",
        "start_s": 0.5,
        "end_s": 1.5,
        "peak_nm": [10.0, 10.0, 8.0, 2.0, 2.0, 1.0],
    }
    return make_six_joint_scenario(**{"sites.m1.hands": [push], **changes})


def exact_motion() -> Array:
    """Returns q at `TIMES_S`, shape (3, 20, 6), rad."""
    stored: Array = np.array(json.loads(PATH.read_text())["q"])
    return stored
