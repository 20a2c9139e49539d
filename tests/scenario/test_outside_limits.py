"""A real robot moves only under limits that somebody stated for the robot itself."""

import re
from pathlib import Path

import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.named_files import SHIPPED_FOLDER

EXAMPLES = Path(__file__).parents[2] / "examples"
PLANAR = EXAMPLES / "external_arm.toml"
CHAIN = EXAMPLES / "two_operators_six_joints.toml"
FILE_KEYS = {"tau_limit_nm": "effort", "qd_limit_rad_s": "velocity"}


def write_scenario(folder: Path, example: Path, key: str, limit: str = "") -> Scenario:
    """Returns an example whose real arm has another limit, or none if `limit` is empty.

    The scenario is read from its own complete text, which contains all defaults.
    """
    text = example.read_text(encoding="utf-8")
    start, limits = text.split("[sites.s.limits]")
    line = f"{key} = {limit}" if limit else ""
    limits, count = re.subn(rf"^{key} = .*$", line, limits, flags=re.MULTILINE)
    assert count == 1
    path = folder / "mine.toml"
    whole = f"{start}[sites.s.limits]{limits}"
    path.write_text(whole.replace("arm6.urdf", "mine.urdf"), encoding="utf-8")
    return parse_scenario(load_scenario(path).text)


@pytest.mark.parametrize("key", FILE_KEYS)
def test_unstated_limits_of_real_arms_are_refused(key: str, tmp_path: Path) -> None:
    """The error names the key and shows how to write it."""
    scenario = write_scenario(tmp_path, PLANAR, key)
    with pytest.raises(ScenarioError, match=f"is missing: .*, as in {key} = ") as caught:
        scenario.check_outside_arms()
    assert caught.value.path == f"sites.s.limits.{key}"


@pytest.mark.parametrize("limit", ["60.0", "[60.0, 200.0]", "[200.0, 200.0]"])
def test_every_stated_limit_is_accepted(limit: str, tmp_path: Path) -> None:
    """A list states a limit of each joint, even if all numbers equal the default."""
    write_scenario(tmp_path, PLANAR, "tau_limit_nm", limit).check_outside_arms()


@pytest.mark.parametrize("key", FILE_KEYS)
def test_urdf_files_state_limits_of_real_arms(key: str, tmp_path: Path) -> None:
    """A limit of every joint in the file is enough, but one joint without a limit is not."""
    urdf = (SHIPPED_FOLDER / "arm6.urdf").read_text(encoding="utf-8")
    file = tmp_path / "mine.urdf"
    file.write_text(urdf, encoding="utf-8")
    write_scenario(tmp_path, CHAIN, key).check_outside_arms()

    unstated = re.sub(rf'{FILE_KEYS[key]}="[^"]*"', f'{FILE_KEYS[key]}="0"', urdf, count=1)
    assert unstated != urdf
    file.write_text(unstated, encoding="utf-8")
    scenario = write_scenario(tmp_path, CHAIN, key)
    with pytest.raises(ScenarioError, match=f"<limit {FILE_KEYS[key]}=...> in its URDF"):
        scenario.check_outside_arms()


@pytest.mark.parametrize("action", ["use", "hold", "brake"])
def test_real_arms_keep_limits_and_change_rule(action: str) -> None:
    """A rule that a real arm cannot have is the wrong key, and not the limits of the arm."""
    text = PLANAR.read_text(encoding="utf-8")
    with pytest.raises(ScenarioError, match="an external arm needs 'glide'") as caught:
        parse_scenario(text.replace('action = "glide"', f'action = "{action}"'))
    assert caught.value.path == "sites.s.on_stale.action"
