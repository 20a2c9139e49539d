"""Hands with known impedance: springs of the kernel, and bodies with mass that also move on their own."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trilat_people.hand_impedance import HandImpedance, identify_hand

import trilat_net as tn
from trilat_net.analysis.theory.port_passivity import HandMatrices
from trilat_net.core.step.vectors import Array
from trilat_net.errors import UsageError

FIRST_JOINT_HZ = (0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 6.5)
SECOND_JOINT_HZ = (0.75, 1.25, 1.75, 2.25, 3.25, 4.75, 6.75)
"""Frequencies of the sines on the joints, which a segment of 8 s distinguishes."""
ARMS = {f"sites.{site}.q0_rad": [0.6, 1.2] for site in ("m1", "m2", "s")}

SPRING = {"kind": "tip_spring", "stiffness_n_m": [220.0, 150.0], "damping_n_s_m": [12.0, 9.0]}


def moved_from(site: str, amplitude_nm: float, duration_s: float = 28.0) -> dict[str, Any]:
    """Returns the settings of a run in which sines at a site move all arms."""
    first = {
        "kind": "multisine",
        "amplitude_nm": [amplitude_nm, 0.0],
        "frequencies_hz": list(FIRST_JOINT_HZ),
    }
    second = {
        "kind": "multisine",
        "amplitude_nm": [0.0, amplitude_nm],
        "frequencies_hz": list(SECOND_JOINT_HZ),
    }
    stiff = {"control.Kp": 60.0, "control.Kd": 12.0, "control.Gamma": 0.0, "rate_hz": 250}
    weightless = {"arm.g_m_s2": 0.0, "duration_s": duration_s, **ARMS}
    return {**stiff, **weightless, f"sites.{site}.hands": [first, second]}


def draw_gain(random: np.random.Generator, low: float, high: float) -> Array:
    """Returns a symmetric matrix with drawn axes and eigenvalues."""
    turn = random.uniform(0.0, np.pi)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    gain: Array = axes @ np.diag(random.uniform(low, high, 2)) @ axes.T
    return gain


def identify_drawn_hand(seed: int, duration_s: float) -> tuple[HandMatrices, HandImpedance]:
    """Returns a drawn hand at m1 and what a run identifies, over a link that jitters and loses."""
    random = np.random.default_rng(seed)
    true = HandMatrices(
        draw_gain(random, 0.5, 2.0),
        draw_gain(random, 5.0, 25.0),
        draw_gain(random, 80.0, 400.0),
    )
    plant = {
        "class": "tests.own_code:HeldArm",
        **{k: v.ravel().tolist() for k, v in true._asdict().items()},
    }
    link = {"model": "gamma", "delay_ms": 60.0, "deviation_ms": 10.0, "loss": 0.1}
    changes = {
        **moved_from("s", 15.0, duration_s),
        "sites.m1.plant": plant,
        "link": link,
        "seed": seed,
    }
    return true, identify_hand(tn.simulate("free", changes), "m1")


def find_covered(true: HandMatrices, hand_impedance: HandImpedance) -> Array:
    """Returns for each number of a hand whether its interval contains the true number."""
    rows = [
        np.abs(getattr(hand_impedance, k) - gain) <= hand_impedance.halves[k]
        for k, gain in true._asdict().items()
    ]
    return np.array(rows)


@pytest.fixture(scope="module")
def spring() -> HandImpedance:
    """A spring of the kernel that the sines of its own site move."""
    changes = moved_from("m1", 2.0)
    changes["sites.m1.hands"] = [SPRING, *changes["sites.m1.hands"]]
    return identify_hand(tn.simulate("free", changes))


def test_spring_and_damper_of_the_kernel_are_found(spring: HandImpedance) -> None:
    assert np.allclose(spring.K, np.diag([220.0, 150.0]), atol=0.1)
    assert np.allclose(spring.B, np.diag([12.0, 9.0]), atol=0.01)
    assert np.allclose(spring.M, 0.0, atol=0.005)
    assert (spring.segments, spring.segment_s) == (5, 8.0)


def test_only_segments_with_active_sines_count(spring: HandImpedance) -> None:
    """A run that continues for 12 s after its sines, with the same spring at the same arm."""
    changes = moved_from("m1", 2.0, 40.0)
    changes["sites.m1.hands"] = [
        SPRING,
        *({**hand, "end_s": 28.0} for hand in changes["sites.m1.hands"]),
    ]
    identified_hand = identify_hand(tn.simulate("free", changes))
    assert identified_hand.segments == spring.segments
    assert np.allclose(identified_hand.K, spring.K, atol=1e-6)


def test_an_identified_hand_works_in_a_scenario(spring: HandImpedance) -> None:
    hand = spring.to_hand()
    scenario = tn.load_scenario("free", {"sites.m1.hands": [hand]})
    assert scenario.sites["m1"].hands[0].stiffness_n_m == tuple(hand["stiffness_n_m"])
    assert np.allclose(hand["stiffness_n_m"], [220.0, 150.0], rtol=0.01)


def test_json_of_a_hand_is_read_again(spring: HandImpedance, tmp_path: Path) -> None:
    file = tmp_path / "m1.json"
    file.write_text(json.dumps(spring.to_dict()), encoding="utf-8")
    again = HandMatrices.read(file)
    assert np.array_equal(again.B, spring.B)
    assert np.array_equal(again.M, spring.M)
    assert spring.summary().count(" +- ") == 12


def test_mass_behind_own_motion_is_identified_over_networks() -> None:
    true, identified = identify_drawn_hand(3, 40.0)
    assert find_covered(true, identified).mean() >= 0.75
    assert np.allclose(identified.M, true.M, atol=0.2)
    assert {len(half) for half in dataclasses.asdict(identified)["halves"].values()} == {2}


@pytest.mark.long
def test_intervals_hold_nine_tenths_of_twenty_hands() -> None:
    covered = []
    for seed in range(1, 21):
        true, identified = identify_drawn_hand(seed, 52.0)
        covered.append(find_covered(true, identified))
    assert np.mean(covered) >= 0.9


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, "no operator of kind 'multisine'"),
        (moved_from("s", 5.0, 6.0), "m1: the log has 0 whole segments of 8 s .* at least 28 s"),
    ],
)
def test_a_run_without_excitation_is_refused(changes: dict[str, Any], problem: str) -> None:
    log = tn.simulate("free", {"duration_s": 1.0, "rate_hz": 250, **changes})
    with pytest.raises(UsageError, match=problem):
        identify_hand(log, "m1")


def test_motion_along_a_line_is_refused() -> None:
    hand = {"kind": "multisine", "amplitude_nm": [0.0, 2.0], "frequencies_hz": [1.0]}
    log = tn.simulate("free", {**moved_from("m1", 2.0, 9.0), "sites.m1.hands": [hand]})
    with pytest.raises(UsageError, match="too few frequencies"):
        identify_hand(log, "m1")


@pytest.mark.parametrize(
    "text", ["", "{}", '{"mass_kg": [[1]], "damping_n_s_m": [[1]], "stiffness_n_m": [[1]]}']
)
def test_a_file_of_no_hand_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "m1.json"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=r"m1\.json: does not contain the output"):
        HandMatrices.read(file)
