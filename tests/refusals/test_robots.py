"""URDF texts that describe no arm: each message names the link or joint, and the remedy."""

import pytest

from tests.refusals.corpus import INPUTS, Case, parametrize_cases
from trilat_net.errors import ScenarioError
from trilat_net.scenario.urdf import read_urdf


class RobotCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A URDF: a text, or a robot of the folder `inputs` with a part replaced."""

    robot: str = ""
    text: str = ""
    replace: str = ""
    by: str = ""
    base: str = ""
    """Name of the link at the base. Empty for the root of the robot."""
    tip: str = ""

    def write_text(self) -> str:
        """Returns the text of the URDF."""
        if not self.robot:
            return self.text
        text = (INPUTS / f"{self.robot}.urdf").read_text(encoding="utf-8")
        assert self.replace in text, self.name
        return text.replace(self.replace, self.by, 1) if self.replace else text


@parametrize_cases("robots.toml", RobotCase)
def test_wrong_robots_are_refused(case: RobotCase) -> None:
    with pytest.raises(ScenarioError) as caught:
        read_urdf(case.write_text(), base=case.base, tip=case.tip)
    case.check_message(str(caught.value), caught.value.exit_code)
