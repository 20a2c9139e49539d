"""The four- and the six-channel law against their loops in the frequency domain, and runs in time."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.execution.builders import make_trajectories
from tests.log.builders import open_bytes, simulate_bytes
from tests.transmission import (
    PAIR,
    TABLE,
    VARIANTS,
    approximate_printed,
    find_transmission,
    rightmost_root,
)
from tests.unit_arm import (
    DRIVE,
    WALL,
    make_four_channel_pair,
    make_unit_scenario,
    read_last_rows,
)
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.theory.linear_analysis import LinearAnalysis
from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.errors import ScenarioError
from trilat_net.laws.six_channel import complementary_weights
from trilat_net.scenario import Scenario

SHARED = {  # factor: user 1 and user 2 at 0.1 and 1 Hz without and with qdd; rightmost root; beta_s / beta
    0.0: ((0.201, 0.278, 0.201, 0.278), (0.999, 0.921, 1.0, 1.0), -5.858, (np.inf, 1.0)),
    0.25: ((0.195, 0.257, 0.195, 0.277), (0.373, 0.448, 0.373, 0.513), -5.989, (1.857, 0.867)),
    0.5: ((0.232, 0.293, 0.232, 0.332), (0.232, 0.293, 0.232, 0.332), -6.044, (1.0, 1.0)),
    1.0: ((0.999, 0.921, 1.0, 1.0), (0.201, 0.278, 0.201, 0.278), -5.858, (1.0, np.inf)),
}
USERS = [(50.0, 10.0), (50.0, 10.0), (500.0, 5.0)]


DATA = Path(__file__).parents[2] / "docs" / "data"
ARCHITECTURES = {
    "ideal": ("ideal", "1"),
    "without qdd": ("ideal", "0"),
    "three": ("three channels", "1"),
    "no forces": ("position error", "0"),
}


def rows_of(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_tables_of_documentation_have_these_numbers() -> None:
    four = {
        (
            row["architecture"],
            row["acceleration"],
            row["delay_each_way_ms"],
            row["frequency_hz"],
        ): (float(row["felt_over_wall"]))
        for row in rows_of("four-channel.csv")
    }
    assert four == {
        (*ARCHITECTURES[variant], f"{1e3 * delay_s:g}", hz): value
        for (variant, delay_s), values in TABLE.items()
        for hz, value in zip(("0.1", "0.5", "1", "2", "5"), values, strict=True)
    }
    six: dict[float, list[float]] = {}
    for row in rows_of("six-channel.csv"):
        felt = [float(row[f"felt_over_wall_at_{hz}_hz"]) for hz in ("0.1", "1")]
        six.setdefault(float(row["a"]), []).extend(felt)
        assert row["rightmost_root_1_s"] in ("", str(SHARED[float(row["a"])][2]))
    assert six == {a: [*first, *other] for a, (first, other, *_) in SHARED.items()}


def three_sites(a: float, driven: int, duration_s: float = 9.0, **more: Any) -> Scenario:
    hands = [[DRIVE] if driven == n else [] for n in (0, 1)]
    names = ("u1", "u2", "s")
    alpha = DominanceMatrix.complementary(a).alpha.tolist()
    shares = {
        i: {j: x for j, x in zip(names, row, strict=True) if j != i}
        for i, row in zip(names, alpha, strict=True)
    }
    sites = {
        name: {"hands": acting} for name, acting in zip(names, (*hands, [WALL]), strict=True)
    }
    control = {"law": "six_channel", "K": 100.0, "B": 20.0, **more}
    link = {"model": "constant", "delay_ms": 0.0}
    return make_unit_scenario(
        sites, control, dominance=shares, link=link, duration_s=duration_s
    )


def measure_transmission(scenario: Scenario, site: str) -> float:
    """Returns the same as `transmitted` at 1 Hz, for a run in time: over its last period."""
    times_s = 8.0 + np.arange(1, 21) / 20.0
    site_index = scenario.names.index(site)
    rows = read_last_rows(scenario, *times_s)
    turn = np.exp(-2j * np.pi * times_s)
    torque, speed = (
        np.array([row[name][site_index, 0] for row in rows]) for name in ("tau_x", "qd")
    )
    return float(abs((torque @ turn) / (speed @ turn)) / abs(500.0 / (2j * np.pi) + 5.0))


@pytest.mark.parametrize(("variant", "delay_s"), TABLE)
def test_two_sites_transmit_as_published(variant: str, delay_s: float) -> None:
    ratios = [
        find_transmission(hz, PAIR, 0, delay_s=delay_s, **VARIANTS[variant])
        for hz in (0.1, 0.5, 1.0, 2.0, 5.0)
    ]
    assert ratios == [approximate_printed(value) for value in TABLE[variant, delay_s]]


@pytest.mark.parametrize("a", SHARED)
def test_the_dominance_factor_shares_felt_forces(a: float) -> None:
    alpha = DominanceMatrix.complementary(a).alpha
    *users, root, ratios = SHARED[a]
    for at, values in enumerate(users):
        felt_ratios = [
            find_transmission(hz, alpha, at, acceleration=qdd)
            for qdd in (0.0, 1.0)
            for hz in (0.1, 1.0)
        ]
        assert felt_ratios == [approximate_printed(value) for value in values]
    assert rightmost_root(alpha, USERS) == pytest.approx(root, abs=5e-4)
    beta = np.array(complementary_weights(a))
    assert beta @ (np.eye(3) - alpha) == pytest.approx(0.0, abs=1e-15)
    with np.errstate(divide="ignore"):
        assert (beta[2] / beta[:2]).tolist() == [
            pytest.approx(value, abs=5e-4) for value in ratios
        ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("a", "user", "felt"),
    [
        (0.5, 0, 0.2905),
        (0.5, 1, 0.2905),
        (1.0, 0, 0.8968),
        (1.0, 1, 0.2782),
        (0.0, 0, 0.2782),
        (0.0, 1, 0.8968),
    ],
)
def test_six_channel_runs_transmit_like_their_loop(a: float, user: int, felt: float) -> None:
    assert measure_transmission(three_sites(a, user), ("u1", "u2")[user]) == pytest.approx(
        felt, abs=6e-5
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("variant", "delay_s", "acceleration", "felt"),
    [
        ("ideal", 0.001, 0.9, 0.9542),
        ("ideal", 0.02, 0.5, 0.6607),
        ("without qdd", 0.001, 0.0, 0.8967),
        ("without qdd", 0.02, 0.0, 0.6455),
        ("three", 0.001, 0.9, 0.9754),
        ("no forces", 0.001, 0.0, 0.1992),
        ("no forces", 0.02, 0.0, 0.1912),
    ],
)
def test_four_channel_runs_transmit_like_their_loop(
    variant: str, delay_s: float, acceleration: float, felt: float
) -> None:
    """The law uses a part of the acceleration, as all of it is unstable; the model of a torque holds it over a tick."""
    ratio = measure_transmission(
        make_four_channel_pair(variant, delay_s, acceleration=acceleration), "m"
    )
    law = {**VARIANTS[variant], "acceleration": acceleration, "delay_s": delay_s}
    assert ratio == pytest.approx(find_transmission(1.0, PAIR, 0, held_s=1e-3, **law), rel=2e-4)
    assert ratio == pytest.approx(felt, abs=6e-5)
    assert ratio == pytest.approx(find_transmission(1.0, PAIR, 0, **law), rel=0.02)


@pytest.mark.long
def test_full_acceleration_one_tick_late_is_unstable() -> None:
    rows = read_last_rows(three_sites(0.5, 0, acceleration=1.0), 9.0)[0]
    assert np.abs(rows["qd"]).max() > 100.0
    assert (
        "does not hold: " in three_sites(0.5, 0, acceleration=1.0).describe_law_conditions()[0]
    )


def test_the_linear_loop_has_the_law_without_acceleration() -> None:
    loop = LinearAnalysis.compute(three_sites(0.25, 5), pose=(0.0, 0.0)).loop
    A = loop.set_common_delay(0.0).A
    alpha = DominanceMatrix.complementary(0.25).alpha
    assert np.linalg.eigvals(A).real.max() == pytest.approx(
        rightmost_root(alpha, [(0.0, 0.0), (0.0, 0.0), (500.0, 5.0)]), abs=1e-6
    )


def test_shares_without_a_single_factor_are_reported() -> None:
    assert (
        "a = 0.25, weights beta = (0.4375, 0.9375, 0.8125)"
        in three_sites(0.25, 0).describe_law_conditions()[0]
    )
    others = {
        "u1": {"u2": 0.5, "s": 0.5},
        "u2": {"u1": 0.2, "s": 0.8},
        "s": {"u1": 0.5, "u2": 0.5},
    }
    scenario = make_unit_scenario(
        {name: {} for name in others}, {"law": "six_channel"}, dominance=others
    )
    assert (
        "does not hold: the shares are not those of one factor"
        in scenario.describe_law_conditions()[0]
    )


def test_two_sites_cannot_share_by_one_factor() -> None:
    with pytest.raises(ScenarioError, match="is for 3 sites"):
        make_trajectories(
            make_unit_scenario({"m": {}, "s": {}}, {"law": "six_channel"}, duration_s=0.01)
        )


@pytest.mark.long
def test_metrics_measure_the_felt_impedance_of_the_loop() -> None:
    """`trilat metrics` of a log of 26 s: stretches of 4 s, driven at 1 Hz alone."""
    log = open_bytes(
        simulate_bytes(make_four_channel_pair("without qdd", 0.001, duration_s=26.0))
    )
    responses = LogMetrics.of_log(log).responses
    felt = next(
        response
        for response in responses
        if (response.kind, response.at, response.joint) == ("impedance", "m", 1)
    )
    expected = find_transmission(1.0, PAIR, 0, delay_s=0.001, held_s=0.001) * abs(
        500.0 / (2j * np.pi) + 5.0
    )
    assert felt.ratio.frequency_hz == 1.0
    assert felt.ratio.gain == pytest.approx(expected, rel=0.01)
