"""The table [expect]: its valid keys, its refusals, and its place in the scenario's text."""

from typing import Any

import pytest

from tests.scenario.builders import make_six_joint_scenario
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Expect, load_scenario, parse_scenario, read_template
from trilat_net.scenario.expect import ExpectWindow


def load_expect(**keys: Any) -> Expect:
    return load_scenario("free", {f"expect.{key}": value for key, value in keys.items()}).expect


def test_without_keys_nothing_is_expected() -> None:
    assert not Expect().has_expectations
    assert not Expect(synchronised_rad=0.5, end_pose_within_rad=0.5).has_expectations


@pytest.mark.parametrize(
    "keys",
    [
        {"stable": True},
        {"stable": False},
        {"synchronised_by_s": 0.0},
        {"late_samples_max": 0},
        {"no_gaps": True},
        {"windows": (ExpectWindow(from_s=0.0, to_s=1.0, error_peak_rad=(0.0, 1.0)),)},
    ],
    ids=str,
)
def test_other_keys_always_expect_something(keys: dict[str, Any]) -> None:
    assert Expect(**keys).has_expectations


def test_a_pair_of_limits_must_leave_room() -> None:
    assert Expect(mean_age_min_ms=5.0, mean_age_max_ms=5.0).find_problem({"m": 2}) is None
    assert Expect(mean_age_min_ms=5.1, mean_age_max_ms=5.0).find_problem({"m": 2}) is not None


def test_expectations_enter_the_canonical_text() -> None:
    scenario = load_scenario(
        "free", {"expect.end_pose_rad": {"s": [0.1, -0.2]}, "expect.stable": False}
    )
    assert parse_scenario(scenario.text).expect == scenario.expect
    assert scenario.sha256 != load_scenario("free").sha256


WINDOW = {"from_s": 1.0, "to_s": 2.0, "site": "s", "wall_mean_n": [7, 9]}


def test_a_window_is_part_of_the_scenarios_text() -> None:
    scenario = load_scenario("free", {"expect.windows": [WINDOW]})
    assert parse_scenario(scenario.text).expect == scenario.expect
    assert scenario.expect.windows[0].wall_mean_n == (7.0, 9.0)
    assert "[[expect.windows]]" in scenario.text


def test_template_names_every_key_with_valid_values() -> None:
    commented = read_template().partition("# [expect]")[2].splitlines()[1:]
    text = (
        read_template()
        + "\n[expect]\n"
        + "\n".join(line.removeprefix("# ") for line in commented)
    )
    expect = parse_scenario(text).expect
    named = [line.removeprefix("# ").split(" = ")[0] for line in commented if " = " in line]
    window = ["from_s", "to_s", "site", *ExpectWindow.list_quantities(2)]
    assert set(named[: -len(window)]) | {"windows"} == set(Expect.__struct_fields__)
    assert named[-len(window) :] == window
    assert [key for key, _ in expect.windows[0].limits] == window[3:]


def test_windows_have_quantities_of_all_joints() -> None:
    window = {
        "from_s": 1.0,
        "to_s": 2.0,
        "site": "s",
        "q6_rad": [0.0, 1.0],
        "push5_mean_nm": [0.0, 1.0],
    }
    limits = make_six_joint_scenario(**{"expect.windows": [window]}).expect.windows[0].limits
    assert dict(limits) == {"q6_rad": (0.0, 1.0), "push5_mean_nm": (0.0, 1.0)}
    with pytest.raises(
        ScenarioError, match=r"windows\[0\].q7_rad: there is no such joint: .* has 6"
    ):
        make_six_joint_scenario(**{"expect.windows": [window | {"q7_rad": [0.0, 1.0]}]})
    with pytest.raises(
        ScenarioError, match=r"windows\[0\].q6_rad: there is no such joint: .* has 2"
    ):
        load_expect(windows=[window])


def test_windows_may_name_joints() -> None:
    """A window with names equals one with numbers, so that no other code has to distinguish them."""

    def windows(**keys: Any) -> tuple[ExpectWindow, ...]:
        return make_six_joint_scenario(
            **{"expect.windows": [{"from_s": 0.0, "to_s": 1.0, "site": "m1", **keys}]}
        ).expect.windows

    named = windows(q_elbow_rad=[0.0, 1.0], push_wrist_1_mean_nm=[-1.0, 1.0])
    assert named == windows(q3_rad=[0.0, 1.0], push4_mean_nm=[-1.0, 1.0])
    for keys, reason in (
        ({"q_elbo_rad": [0, 1]}, r"expect\.windows\[0\]\.q_elbo_rad: unknown key"),
        ({"q_elbow_rad": [0, 1], "q3_rad": [0, 1]}, "repeats q3_rad"),
    ):
        with pytest.raises(ScenarioError, match=reason):
            windows(**keys)
