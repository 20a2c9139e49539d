"""A control law is one file: the program finds a law that was put beside the others."""

from pathlib import Path

import pytest

from tests.dropped_files import run_in_folder
from trilat_net.scenario.laws import BUILT_IN

LAW = '''
from typing import ClassVar

from trilat_net import compiled
from trilat_net.fields import PositiveJoints
from trilat_net.laws.conditions import StabilityCondition
from trilat_net.laws.interface import STIFFNESS, ControlLaw


@compiled
class SoftSpring(ControlLaw):
    """tau = G - K e."""

    K: PositiveJoints = (7.0,)
    tune: ClassVar = {"K": STIFFNESS}

    def torque(self, now):
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.K[i] * (now.q[i] - now.q_des[i])

    def condition(self, situation):
        return StabilityCondition(None, f"K = {self.K[0]:g} at {situation.names[situation.site]}")
'''
LOOK = """
import json, sys
import trilat_net.laws
trilat_net.laws.__path__.append(sys.argv[1])
import trilat_net as tn
from trilat_net.core.step.control import limit_torque
from trilat_studies.bench.bench_plan import LAWS_OF_ANY, LAWS_OF_TWO
from trilat_studies.tuning.search_space import SEARCH_SPACES
changes = {"control.law": "soft_spring", "control.K": 9.0, "duration_s": 0.2}
log = tn.simulate("free", changes)
verdict = tn.verify(log)
tuned = tn.tune("free", laws=["soft_spring"], budget=2, jobs=1)
print(json.dumps({
    "control": log.scenario.sites["s"].control.K,
    "check": tn.describe_scenario(log.scenario),
    "identical": verdict.identical == verdict.records,
    "knobs": [knob.name for knob in SEARCH_SPACES["soft_spring"].knobs],
    "tuned": [found.space.law for found in tuned.found],
    "suite": "soft_spring" in LAWS_OF_ANY,
    "two": "soft_spring" in LAWS_OF_TWO,
}))
"""


def test_an_added_file_is_a_law_everywhere(tmp_path: Path) -> None:
    (tmp_path / "soft_spring.py").write_text(LAW)
    output = run_in_folder(LOOK, tmp_path)
    assert output["control"] == [9.0, 9.0]
    assert any(
        "condition of soft_spring" in line and "K = 9 at s" in line for line in output["check"]
    )
    assert output["identical"]
    assert (output["knobs"], output["tuned"]) == (["K"], ["soft_spring"])
    assert (output["suite"], output["two"]) == (True, False)


@pytest.mark.parametrize("name", list(BUILT_IN))
def test_file_class_and_name_are_one(name: str) -> None:
    law = BUILT_IN[name]
    assert law.__module__ == f"trilat_net.laws.{name}"
    assert law.__name__ == "".join(map(str.capitalize, name.split("_")))
    assert law.tune  # no law is left out of tuning
