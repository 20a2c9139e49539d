"""A scenario of three arms of six joints, as an author writes it."""

from typing import Any

from tests.chains import six_joints
from trilat_net.scenario import Scenario, parse_scenario

SIX = six_joints(20.0, delay_ms=200.0)


def six(**changes: Any) -> Scenario:
    return parse_scenario(SIX, overrides=changes)
