"""An operator, an environment and a delay model are one file each: every reader of scenarios
finds an added file.
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.builders import compute_due_ns, make_channel
from tests.dropped_files import put_beside, run_in_folder
from trilat_net.core.arms.exogenous import torque_on_arm, torque_source_rows
from trilat_net.scenario.delay_models import DELAY_MODELS
from trilat_net.scenario.delay_models.low_orbit import LowOrbit
from trilat_net.scenario.operators import ENVIRONMENTS, OPERATORS, OwnActor
from trilat_net.scenario.operators.hunt_crossley import HuntCrossley

OPERATOR = """
import numpy as np

from trilat_net import fields
from trilat_net.core.arms.elementary import sincos
from trilat_net.scenario.operators import OwnActor


class Tremor(OwnActor, frozen=True, kw_only=True, tag="tremor"):
    \"\"\"A hand that holds the joints where they start, and trembles.\"\"\"

    value_texts = {"turn_rad_s": "a frequency, rad/s"}
    stiffness_nm_rad: fields.NotNegativeJoints
    turn_rad_s: fields.Positive

    def act(self, now):
        s, _ = sincos(self.turn_rad_s * now.t_s)
        for i in range(now.coordinates):
            now.effort[i] = self.stiffness_nm_rad[i] * (0.01 * s - now.at[i])

    def effort(self, t_s, at, speed):
        target = 0.01 * np.sin(self.turn_rad_s * np.asarray(t_s))[..., None]
        return np.array(self.stiffness_nm_rad) * (target - at)
"""
DELAY = """
from trilat_net.core import draw_pair
from trilat_net.scenario.delay_models import Milliseconds, OwnDelay


class TwoPaths(OwnDelay, frozen=True, kw_only=True, tag="two_paths"):
    short_ms: Milliseconds
    long_ms: Milliseconds

    def draw(self, now):
        u, _ = draw_pair(now, now.sample, 0)
        now.drawn_us = 1e3 * (self.short_ms if u < 0.5 else self.long_ms)

    def _moments(self):
        return 0.5 * (self.short_ms + self.long_ms), 0.5 * abs(self.long_ms - self.short_ms)

    def _reach_ms(self):
        return max(self.short_ms, self.long_ms)
"""
LOOK = """
import json, os
import numpy as np
import trilat_net as tn
from trilat_net.errors import ScenarioError

assert tn.__file__.startswith(os.getcwd())
hand = {"kind": "tremor", "stiffness_nm_rad": 30.0, "turn_rad_s": 40.0}
first = next(iter(tn.simulate(SCENARIO, duration_s=0.01).sites))
changes = {
    f"sites.{first}.hands": [hand],
    "link": {"model": "two_paths", "short_ms": 5.0, "long_ms": 12.0},
    "duration_s": 0.4,
}
log = tn.simulate(SCENARIO, changes)
verdict, again = tn.verify(log), tn.verify(log, virtual=True)
try:
    tn.simulate(SCENARIO, {f"sites.{first}.hands": [{**hand, "turn_rad_s": -1.0}]})
except ScenarioError as error:
    refused = str(error)
print(json.dumps({
    "identical": [one.identical == one.records for one in (verdict, again)],
    "check": tn.describe_scenario(log.scenario),
    "moved": float(np.abs(log[first].tau_x).max()),
    "roots": len(tn.linear(SCENARIO, changes).continuous.roots) > 0,
    "refused": refused,
}))
"""


@pytest.mark.parametrize(
    "scenario", ["two_sites", pytest.param("six_joints", marks=pytest.mark.long)]
)
def test_an_added_file_acts_in_every_driver(tmp_path: Path, scenario: str) -> None:
    put_beside(tmp_path, "scenario/operators", "tremor.py", OPERATOR)
    put_beside(tmp_path, "scenario/delay_models", "two_paths.py", DELAY)
    output = run_in_folder(LOOK.replace("SCENARIO", json.dumps(scenario)), tmp_path)
    assert output["identical"] == [True, True]
    assert any("two_paths 8.5 +- 3.5 ms" in line for line in output["check"])
    assert output["moved"] > 0.0
    assert output["roots"]
    assert "hands[0].turn_rad_s: must be a frequency, rad/s, but is -1.0" in output["refused"]


numbers = st.floats(-2.0, 2.0)
pairs = st.tuples(numbers, numbers)
bodies = st.builds(
    HuntCrossley,
    point_m=pairs,
    normal=pairs.filter(lambda pair: math.hypot(*pair) > 1e-3),
    stiffness_n_m15=st.floats(0.0, 1e5),
    damping_s_m=st.floats(0.0, 10.0),
)


def force_of_kernel(body: HuntCrossley, q: tuple, qd: tuple) -> np.ndarray:
    rows, table = torque_source_rows((body.actor,))
    return np.array(torque_on_arm(1.0, q, qd, (1.0, 1.0), rows, table, 0)[:2])


def compute_tip(q: tuple, qd: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a = q[0]
    b = q[0] + q[1]
    J = np.array(
        [[-math.sin(a) - math.sin(b), -math.sin(b)], [math.cos(a) + math.cos(b), math.cos(b)]]
    )
    return np.array([math.cos(a) + math.cos(b), math.sin(a) + math.sin(b)]), J @ qd, J


@given(body=bodies, q=pairs, qd=pairs)
def test_compiled_and_row_functions_of_a_body_agree(
    body: HuntCrossley, q: tuple, qd: tuple
) -> None:
    """F = K d^(3/2) (1 + lambda d'), Hunt and Crossley (1975)."""
    at, speed, J = compute_tip(q, qd)
    effort = body.effort(np.array([1.0]), at[None], speed[None])[0]
    size = body.stiffness_n_m15 * (1.0 + body.damping_s_m)
    assert force_of_kernel(body, q, qd) == pytest.approx(
        J.T @ effort, rel=1e-9, abs=1e-9 * (1.0 + size)
    )


@given(body=bodies, depth_mm=st.floats(1e-3, 50.0), speed_m_s=st.floats(0.0, 1.0))
def test_a_compliant_body_always_dissipates(
    body: HuntCrossley, depth_mm: float, speed_m_s: float
) -> None:
    """At equal depth and speed, the force on the way out is never larger than that on the way in."""
    normal = np.array(body.normal) / np.hypot(*body.normal)
    at = np.array(body.point_m) - 1e-3 * depth_mm * normal
    still = body.effort(np.array([0.0]), at[None], np.zeros((1, 2)))[0] @ normal
    speeds = speed_m_s * np.array([-1.0, 1.0])[:, None] * normal
    into, out = body.effort(np.zeros(2), np.array([at, at]), speeds) @ normal
    rounding = 1e-15 * into  # of the normal, whose length is 1 to rounding
    assert into + rounding >= still >= out - rounding
    assert out >= 0.0
    assert still == pytest.approx(body.stiffness_n_m15 * (1e-3 * depth_mm) ** 1.5, rel=1e-6)


def test_low_orbit_paths_last_their_slot() -> None:
    model = LowOrbit(floor_ms=20.0, path_ms=50.0, jitter_ms=0.0, slot_s=0.1)
    fates = compute_due_ns(
        make_channel(
            [model.to_core_model()._replace(trace_count=len(model.points))], points=model.points
        ),
        1000,
    )
    delays = fates - np.arange(1000) * 1_000_000
    slots = delays.reshape(10, 100)
    assert (slots == slots[:, :1]).all()
    assert len(np.unique(slots[:, 0])) == 10
    assert (delays >= 20_000_000).all()


def test_every_kind_of_file_is_found() -> None:
    kinds = [
        kind
        for kind in (*OPERATORS.values(), *ENVIRONMENTS.values())
        if issubclass(kind, OwnActor)
    ]
    assert HuntCrossley in kinds
    assert DELAY_MODELS["low_orbit"] is LowOrbit
