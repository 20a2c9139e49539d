from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import trilat_net
from tests.scenario.builders import make_six_joint_scenario
from tests.unit_arm import make_unit_scenario
from trilat_net.app.cli.options import list_laws
from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.scenario.describe import ScenarioDifference, describe_scenario
from trilat_net.scenario.named_files import SHIPPED_FOLDER
from trilat_net.scenario.rest_bounds import find_rest_bounds
from trilat_net.scenario.value_text import describe_value

EXAMPLES = Path(__file__).parents[2] / "examples"


def compare_texts(*scenarios: tuple[str, list[str]]) -> dict[str, tuple[str, ...]]:
    return {
        str(difference): difference.values
        for difference in ScenarioDifference.list_between(
            [load_scenario(name, sets) for name, sets in scenarios]
        )
    }


def test_renamed_experiments_do_not_differ() -> None:
    assert compare_texts(("free", []), ("free", ["name=other", "expect.stable=false"])) == {}


def test_a_gain_of_all_sites_is_one_line() -> None:
    assert compare_texts(("free", []), ("free", ["control.Kd=5"])) == {
        "control.Kd of m1, m2, s": ("3", "5")
    }
    differences = compare_texts(("free", []), ("free", ["sites.s.control.Kd=[5, 6]"]))
    assert differences == {"control.Kd of s": ("3", "[5, 6]")}


def test_another_law_is_shown_whole() -> None:
    differences = compare_texts(("free", []), ("free", ["control.law=p_d"]))
    assert differences == {
        "control of m1, m2, s": (
            "adaptive (Lambda 1, Kp 1, Kd 3, Gamma 1, theta_hat0 0)",
            "p_d (K 10, d 3, gravity 1)",
        )
    }


def test_links_are_described_in_words() -> None:
    differences = compare_texts(
        ("free", []), ("free", ["link.delay_ms=50"]), ("free", ["links.m1->s.delay_ms=9"])
    )
    assert differences == {
        "link m1->s": ("200 ms", "50 ms", "9 ms"),
        "link m2->m1, s->m1, m1->m2, s->m2, m2->s": ("200 ms", "50 ms", "200 ms"),
    }


def test_other_scenarios_other_sites_other_hands() -> None:
    differences = compare_texts(("contact", []), ("free", []))
    assert differences["sites"] == ("m, s", "m1, m2, s")
    assert "wall" in differences["environment of s"][0]
    assert differences["environment of s"][1] == "none"
    assert differences["duration_s"] == ("15", "30")


def test_chains_are_described_by_joint() -> None:
    unlimited = (
        (SHIPPED_FOLDER / "arm6.urdf")
        .read_text()
        .replace('effort="28" velocity', "velocity", 1)
    )
    text = "\n".join(describe_scenario(make_six_joint_scenario(urdf={"arm6.urdf": unlimited})))
    first = "  shoulder_pan moves shoulder, 3.7 kg; -6.283 to 6.283 rad; 150 N m; 3.142 rad/s; drive 0.2 kg m^2"
    assert (
        f"arm of m1, m2, s: arm6.urdf, 6 joints from base to flange, 17.05 kg move\n{first}\n"
        in text
    )
    assert (
        "  note: joint 'wrist_1' states no limit of effort, or 0: it has no such limit" in text
    )
    assert (
        "  wrist_1 moves wrist_1_link, 1.219 kg; -6.283 to 6.283 rad; 3.142 rad/s; drive"
        in text
    )
    assert "arm of" not in "\n".join(describe_scenario(load_scenario("free")))


def test_limits_of_real_arms_come_first() -> None:
    (line,) = [
        line for line in describe_scenario(EXAMPLES / "external_arm.toml")[:2] if "real" in line
    ]
    assert line == (
        "s is a real arm: at most 60 N m, 6 rad/s, -2.5 to 2.5 rad; it starts at 0 rad: are "
        "these your robot's?"
    )
    many = describe_scenario(EXAMPLES / "two_operators_six_joints.toml")[1]
    assert many.startswith(
        "s is a real arm: at most 15, 15, 15, 2.8, 2.8, 2.8 N m, 0.3 rad/s, "
    )
    assert not [line for line in describe_scenario("free") if "real arm" in line]


def test_checks_predict_holds_of_a_site() -> None:
    keys = {"on_stale.action": "glide", "link.model": "normal", "duration_s": 6.0, "seed": 3}
    link = {"link.delay_ms": 60.0, "link.deviation_ms": 25.0, "link.loss": 0.6}
    scenario = load_scenario("two_sites", {**keys, **link})
    (line,) = (line for line in describe_scenario(scenario) if line.startswith("s will hold"))
    log = trilat_net.simulate(scenario)
    modes = log["s"].mode
    entered = int(np.count_nonzero((modes[1:] == "hold") & (modes[:-1] != "hold")))
    assert entered > 3
    assert f"will hold {10 * entered:.3g} times a minute" in line


def test_sites_that_never_hold_get_no_remark() -> None:
    glide = load_scenario("two_sites", {"on_stale.action": "glide", "duration_s": 2.0})
    assert not [line for line in describe_scenario(glide) if "times a minute" in line]
    assert describe_scenario("two_sites") == describe_scenario(load_scenario("two_sites"))


def test_check_states_the_time_to_rest() -> None:
    """The time stands for every site under `glide`, and the reached speed for an arm too fast for its motors."""
    scenario = load_scenario("free", {"on_stale.action": "glide"})
    bounds = find_rest_bounds(scenario, "s")
    lines = [line for line in describe_scenario(scenario) if line.startswith("arms of")]
    stated = (
        f"come to rest within {bounds.rest_s:.3g} s of a stop at limits.qd_limit_rad_s = 7.5"
    )
    assert lines == [f"arms of m1, m2, s {stated}"]
    assert not [line for line in describe_scenario("free") if "come to rest" in line]
    fast = load_scenario("free", {"on_stale.action": "glide", "limits.qd_limit_rad_s": 40.0})
    (line,) = (line for line in describe_scenario(fast) if "motors bear" in line)
    assert "beyond 7.54 rad/s" in line
    weak = load_scenario("free", {"on_stale.action": "glide", "limits.tau_limit_nm": 20.0})
    assert any("they sink" in line for line in describe_scenario(weak))


@pytest.mark.parametrize("name", ["free", "paper_rods", "play", "six_joints", "unlike_arms"])
def test_motors_bear_the_speeds_of_shipped_scenarios(name: str) -> None:
    """Eq.

    (7) of docs/theory/coming-to-rest.md: the limits of torque hold gravity and Coriolis
    torques.
    """
    scenario = load_scenario(name, {"on_stale.action": "glide"})
    for site in scenario.names:
        bounds = find_rest_bounds(scenario, site)
        assert bounds.bearable_share >= 1.0
        assert bounds.rest_s < 4.5


REVERSIBLE = {
    "m1": {"m2": 0.25, "s": 0.75},
    "m2": {"m1": 0.25, "s": 0.75},
    "s": {"m1": 0.5, "m2": 0.5},
}
ONE_WAY = {**REVERSIBLE, "s": {"m1": 0.9, "m2": 0.1}}
RAMP = [{"at_s": 1.0, "dominance": "s", "to": {"m1": 0.1, "m2": 0.9}, "ramp_s": 0.5}]


@pytest.mark.parametrize(
    ("law", "more", "expected"),
    [
        ({"law": "p_d"}, {}, []),
        ({"law": "tdpa"}, {}, []),
        (
            {"law": "tdpa", "K": 0.0, "B": 0.0},
            {},
            ["m1, m2, s: with K = 0 and B = 0, an arm does not follow others"],
        ),
        ({"law": "wave"}, {}, []),
        ({"law": "wave", "lines": {}}, {}, ["m1, m2: lines share as b_ij / sum b_ik"]),
        ({"law": "wave", "lines": {"m1-m2": 5.0, "m1-s": 15.0, "m2-s": 15.0}}, {}, []),
        (
            {"law": "wave"},
            {"dominance": ONE_WAY},
            [
                "m1, m2, s: lines share as b_ij / sum b_ik, because the shares of the sites are not reversible"
            ],
        ),
        (
            {"law": "wave"},
            {"timeline": RAMP},
            ["s: the impedances of the lines stay as at the start, whatever the timeline says"],
        ),
    ],
)
def test_a_check_names_shares_without_effect(
    law: dict[str, object], more: dict[str, object], expected: list[str]
) -> None:
    scenario = make_unit_scenario(
        {"m1": {}, "m2": {}, "s": {}}, law, **{"dominance": REVERSIBLE, **more}
    )
    lines = [
        line
        for line in describe_scenario(scenario)
        if line.startswith("dominance without effect")
    ]
    assert lines == [f"dominance without effect at {line}" for line in expected]


def test_lines_share_by_site_and_average_b() -> None:
    law = {"law": "wave", "b": [6.0, 3.0]}
    scenario = make_unit_scenario({"m1": {}, "m2": {}, "s": {}}, law, dominance=REVERSIBLE)
    total = np.zeros(2)
    for name, control in zip(scenario.names, scenario.controls, strict=True):
        lines = np.array([control.find_impedances(name, peer) for peer in scenario.peers(name)])
        shares = [scenario.dominance[name][peer] for peer in scenario.peers(name)]
        assert lines / lines.sum(axis=0) == pytest.approx(
            np.array([shares, shares]).T, rel=1e-9
        )
        total += lines.sum(axis=0)
    assert total / 6.0 == pytest.approx([6.0, 3.0])


@pytest.mark.parametrize("gain", [1.5, 1.9999, 2.0, 6.0])
@pytest.mark.parametrize("law", ["p_d", "pd_d"])
def test_checks_evaluate_conditions_of_spring_laws(law: str, gain: float) -> None:
    """Two sites with K = 10 N m/rad and 200 ms need d of at least 2 N m s/rad."""
    scenario = load_scenario("p_d_margin_two", {"control.law": law, "control.d": gain})
    (line,) = [line for line in describe_scenario(scenario) if line.startswith("condition")]
    word = "holds" if gain >= 2.0 else "does not hold"
    assert line.startswith(f"condition of {law} at m, s {word}: 4 d1 d2")


@pytest.mark.parametrize("law", ["pd_d", "lee_spong"])
@pytest.mark.parametrize(("factor", "is_known"), [(1.0, True), (2.0, False)])
def test_conditions_need_one_ratio_of_error_damping(
    law: str, factor: float, is_known: bool
) -> None:
    changes = {
        "control.law": law,
        "control.Kd": 3.0,
        "sites.m.control.K": 10.0 * factor,
        "sites.s.control.K": 10.0,
    }
    lines = describe_scenario(load_scenario("p_d_margin_two", changes))
    conditions = [line for line in lines if line.startswith("condition")]
    assert conditions
    assert all(("one ratio" not in line) == is_known for line in conditions)


@pytest.mark.parametrize("law", ["p_d", "pd_d", "lee_spong", "saturated_pd", "authority"])
@pytest.mark.parametrize("gravity", [0.8, 1.0])
def test_conditions_need_exact_gravity(law: str, gravity: float) -> None:
    changes = {"control.law": law, "control.gravity": gravity}
    lines = describe_scenario(load_scenario("p_d_margin_two", changes))
    assert any(line.startswith("condition of") for line in lines) == (gravity == 1.0)


def test_long_values_end_with_whole_entries() -> None:
    """A hand with many settings shows the first ones, and eight digits of a hash."""
    hand = {"kind": "own", "class": "my_policy:Reach", "source_sha256": "0123456789abcdef" * 4}
    assert describe_value([hand]) == "[own class my_policy:Reach source_sha256 01234567]"
    settings = {f"setting_{n}": 1.5 for n in range(9)}
    entries = describe_value([{**hand, **settings}]).strip("[]").split()
    assert entries[-1] == "..."
    assert entries[-2] == "1.5"
    assert len(entries) < 12
    numbers = describe_value([n + 0.125 for n in range(40)]).strip("[]").split(", ")
    assert numbers[:-1] == [f"{n + 0.125:g}" for n in range(len(numbers) - 1)]
    assert numbers[-1] == "..."


@pytest.mark.parametrize("scenario", ["p_d_margin_two", "paper", "two_sites"])
@pytest.mark.parametrize("law", list_laws())
def test_every_law_is_described_or_refused(law: str, scenario: str) -> None:
    """A law that does not fit a scenario is refused in a sentence, and never by a failure."""
    with suppress(ScenarioError):
        assert describe_scenario(load_scenario(scenario, {"control.law": law}))
