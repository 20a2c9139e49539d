"""Loops of laws with states, waves and accelerations: against closed equations of one mass, and
their roots.

The unit arm is two uncoupled masses: 1 along (1, 1/2) and 1/6 across.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.transmission import (
    PAIR,
    TABLE,
    VARIANTS,
    approximate_printed,
    build_balance,
    find_transmission,
)
from tests.unit_arm import CLAMP, make_four_channel_pair, make_spring_hand, make_unit_scenario
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.linear_analysis import LinearAnalysis
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.analysis.theory.port_response import evaluate_transfer
from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario

ALONG = np.array([1.0, 0.5])
b = 10.0
K = 100.0
T = 0.2
HELD = {**CLAMP, "stiffness_nm_rad": 50.0, "damping_nm_s_rad": 10.0}


def loop_of(scenario: Scenario) -> LinearLoop:
    return LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, (0.0, 0.0))
    )


def find_impedance(loop: LinearLoop, s: complex, site: int = 0) -> complex:
    """Returns torque over velocity at a site, along the line of the mass of 1."""
    ports = slice(2 * site, 2 * site + 2)
    Y = evaluate_transfer(loop, np.array([s]))[0, ports, ports]
    return complex(1.0 / (Y @ ALONG)[0])


def count_inside(f: Callable[[complex], complex], low: complex, high: complex) -> int:
    """Returns the number of zeros of an entire function in a rectangle, by the turns of its argument."""
    corners = [low, complex(high.real, low.imag), high, complex(low.real, high.imag), low]
    path = np.concatenate([np.linspace(a, z, 4001)[:-1] for a, z in pairwise(corners)])
    values = np.array([f(s) for s in path])
    steps = np.angle(np.roll(values, -1) / values)
    assert np.abs(steps).max() < 2.0
    return round(float(steps.sum()) / (2.0 * np.pi))


def wave_equation(s: complex, mass: float, wall: float) -> complex:
    """Is zero at the roots of a master with a hand of 50 + 10 s, a line, and a slave with K and
    B = b. u_m and v_s are the outputs of the line at the slave and at the master, times c.
    """
    e = np.exp(-s * T)
    # unknowns: x_m, x_s, y = q_sd, and c u, c v of what is sent: by the master, by the slave
    force_m = [b * s, 0.0, 0.0, 0.0, -e]  # F = b qd - c v
    rows = [
        [mass * s * s + 10.0 * s + 50.0 + force_m[0], 0.0, 0.0, 0.0, force_m[4]],
        [0.0, mass * s * s + wall + K + b * s, -(K + b * s), 0.0, 0.0],
        [0.0, -(K + b * s), 2.0 * b * s + K, -e, 0.0],  # (b + B) qd_sd = c u - K (y - x) + B qd
        [-2.0 * b * s, 0.0, 0.0, 1.0, e],  # c u = c^2 qd - c v
        [0.0, -2.0 * (K + b * s), 2.0 * (K + b * s), -e, 1.0],  # c v = c u - (c^2 / b) F
    ]
    return complex(np.linalg.det(np.array(rows)))


def wave_pair(wall: float = 0.0, held: bool = True) -> Scenario:
    slave = {"law": "wave", "b": b, "K": K, "B": b}
    env = [{**CLAMP, "stiffness_nm_rad": wall}] if wall else []
    sites = {"m": {"hands": [HELD] if held else []}, "s": {"hands": env, "control": slave}}
    return make_unit_scenario(
        sites, {"law": "wave", "b": b}, link={"model": "constant", "delay_ms": 1e3 * T}
    )


@pytest.mark.parametrize("wall", [pytest.param(0.0, marks=pytest.mark.long), 1000.0])
def test_wave_line_roots_follow_their_delays(wall: float) -> None:
    """All of them below 30 rad/s as far left as requested, counted by the turns of the argument."""
    spectrum = Spectrum.of_loop(loop_of(wave_pair(wall)), 24)
    for mass in (1.0, 1.0 / 6.0):
        ours = []
        for root in spectrum.roots:
            step = wave_equation(root.s, mass, wall) / (
                (
                    wave_equation(root.s + 1e-6, mass, wall)
                    - wave_equation(root.s - 1e-6, mass, wall)
                )
                / 2e-6
            )
            if abs(step) < 1e-7 * (1.0 + abs(root.s)):
                ours.append(root.s)
        low = complex(max(-4.0, spectrum.roots[-1].s.real + 1e-3), -1e-2)
        high = complex(1.0, 30.0)
        inside = [s for s in ours if s.real > low.real and s.imag < 30.0 and abs(s) > 1e-6]
        equation = partial(wave_equation, mass=mass, wall=wall)
        zeros = count_inside(equation, -1e-3 - 1e-3j, 1e-3 + 1e-3j)
        assert len(inside) + zeros == count_inside(equation, low, high)
        assert inside


def test_wave_lines_feel_like_mass_and_spring() -> None:
    """LAWS of lines: of a free slave both masses and b T; clamped rigidly at .1 Hz 51.88 N m s/rad."""
    free = loop_of(wave_pair(held=False))
    slow, fast = (2j * np.pi * hz for hz in (0.01, 0.1))
    assert abs(find_impedance(free, slow) / slow) == pytest.approx(4.0004, abs=5e-5)
    assert abs(find_impedance(free, fast)) == pytest.approx(2.538, abs=5e-4)
    assert abs(find_impedance(free.clamp_site("s"), fast)) == pytest.approx(51.88, abs=5e-3)


@pytest.mark.parametrize(("variant", "delay_s"), [key for key in TABLE if key[1] > 0.0])
def test_four_channels_transmit_as_published(variant: str, delay_s: float) -> None:
    """With accelerations and local force feedback, the impedance agrees to the last digit."""
    scenario = make_four_channel_pair(variant, delay_s)
    sites = {**scenario.sites, "m": msgspec.structs.replace(scenario.sites["m"], hands=())}
    loop = loop_of(msgspec.structs.replace(scenario, sites=sites))
    ratios = [
        abs(find_impedance(loop, 2j * np.pi * hz)) / abs(500.0 / (2j * np.pi * hz) + 5.0)
        for hz in (0.1, 0.5, 1.0, 2.0, 5.0)
    ]
    assert ratios == [approximate_printed(value) for value in TABLE[variant, delay_s]]
    exact = [
        find_transmission(hz, PAIR, 0, delay_s=delay_s, **VARIANTS[variant])
        for hz in (0.1, 5.0)
    ]
    assert [ratios[0], ratios[-1]] == pytest.approx(exact, rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("acceleration", [0.0, 0.5])
def test_delayed_four_channel_roots_solve_equations(acceleration: float) -> None:
    law = {"force_own": (0.2, -0.5), "acceleration": acceleration}
    scenario = make_four_channel_pair("without qdd", 0.02, **law)
    loads = [(50.0, 10.0), (500.0, 5.0)]

    def f(s: complex) -> complex:
        return complex(
            np.linalg.det(build_balance(s, PAIR, delay_s=0.02, loads=loads, **law)[0])
        )

    roots = [root.s for root in Spectrum.of_loop(loop_of(scenario), 12).roots]
    on_line = [
        s
        for s in roots
        if abs(f(s) / ((f(s + 1e-6) - f(s - 1e-6)) / 2e-6)) < 1e-7 * (1.0 + abs(s))
    ]
    assert len(on_line) >= 3
    edge = max(s.real for s in on_line)
    low = complex(edge - 1.0, -0.01)
    high = complex(edge + 50.0, 400.0)
    assert sum(s.real > edge - 1.0 and s.imag < 400.0 for s in on_line) == count_inside(
        f, low, high
    )


@pytest.mark.parametrize(
    ("a", "user", "values"), [(0.25, 0, (0.195, 0.277)), (0.25, 1, (0.373, 0.513))]
)
def test_six_channels_with_accelerations_share_as_published(
    a: float, user: int, values: tuple[float, float]
) -> None:
    names = ("u1", "u2", "s")
    alpha = DominanceMatrix.complementary(a).alpha
    shares = {
        site: {other: float(alpha[i, j]) for j, other in enumerate(names) if other != site}
        for i, site in enumerate(names)
    }
    sites: dict[str, Any] = {
        "u1": {},
        "u2": {},
        "s": {"hands": [make_spring_hand(0.0, 500.0, 5.0)]},
    }
    law = {"law": "six_channel", "K": 100.0, "B": 20.0, "acceleration": 1.0}
    loop = loop_of(make_unit_scenario(sites, law, dominance=shares)).set_common_delay(0.0)
    ratios = [
        abs(find_impedance(loop, 2j * np.pi * hz, user)) / abs(500.0 / (2j * np.pi * hz) + 5.0)
        for hz in (0.1, 1.0)
    ]
    assert ratios == [approximate_printed(value) for value in values]


def is_root(f: Callable[[complex], complex], s: complex) -> bool:
    return abs(f(s) / ((f(s + 1e-6) - f(s - 1e-6)) / 2e-6)) < 1e-6 * (1.0 + abs(s))


def test_true_models_predict_roots_without_delay() -> None:
    """s^2 + d s + 2 K, and of the slave s^2 + d s + K, along the mass that the model has."""
    law = {"law": "smith", "K": 100.0, "d": 5.0, "inertia": 1.0}
    sites = {"m": {"control": {**law, "predicts": True}}, "s": {}}
    roots = [
        root.s for root in Spectrum.of_loop(loop_of(make_unit_scenario(sites, law)), 16).roots
    ]
    for stiffness in (100.0, 200.0):
        wanted = np.roots([1.0, 5.0, stiffness]).astype(complex)[0]
        assert min(abs(root - complex(wanted.real, abs(wanted.imag))) for root in roots) < 1e-6


def test_shared_authority_has_its_springs_roots() -> None:
    a = 0.75
    d = 5.0
    K_a = 10.0
    names = ("u1", "u2", "s")
    alpha = DominanceMatrix.complementary(a).alpha
    shares = {
        site: {other: float(alpha[i, j]) for j, other in enumerate(names) if other != site}
        for i, site in enumerate(names)
    }
    law = {"law": "authority", "K": K_a, "d": d}
    sites = {"u1": {}, "u2": {}, "s": {"control": {**law, "leads": False}}}
    roots = [
        root.s
        for root in Spectrum.of_loop(
            loop_of(make_unit_scenario(sites, law, dominance=shares)), 12
        ).roots
    ]

    def users(s: complex) -> complex:
        free_dynamics = s * s + d * s
        pulls = K_a * alpha[0, 1], K_a * alpha[1, 0]
        return complex(
            (free_dynamics + pulls[0]) * (free_dynamics + pulls[1])
            - pulls[0] * pulls[1] * np.exp(-2.0 * s * T)
        )

    assert sum(is_root(users, s) for s in roots) >= 3
    assert any(is_root(lambda s: s * s + d * s + K_a, s) for s in roots)


@pytest.mark.long
def test_impedances_have_the_roots_of_their_masses() -> None:
    """Free, with known dynamics, no force returns: M s^2 + B s + K at every site."""
    law = {"law": "impedance", "M": 2.0, "B": 10.0, "K": 50.0}
    sites = {"m": {}, "s": {"control": {**law, "follows": True}}}
    roots = [
        root.s for root in Spectrum.of_loop(loop_of(make_unit_scenario(sites, law)), 4).roots
    ]
    wanted = np.roots([2.0, 10.0, 50.0])[0]
    assert roots
    for root in roots:  # of higher order: slave and master are alike
        assert root == pytest.approx(complex(wanted.real, abs(wanted.imag)), rel=1e-5)


def test_synchronised_outputs_have_consensus_roots() -> None:
    """Without gravity and with the true parameters, s = -Lambda, and m s = -K (1 -+ exp(-s T))."""
    law = {"law": "sync", "Lambda": 1.0, "K": 3.0}
    loop = loop_of(make_unit_scenario({"m": {}, "s": {}}, law))
    roots = [root.s for root in Spectrum.of_loop(loop, 10).roots]
    assert min(abs(root + 1.0) for root in roots) < 1e-5

    def consensus(s: complex) -> complex:
        late = np.exp(-s * T)
        pairs = [
            (m * s + 3.0 * (1.0 + late)) * (m * s + 3.0 * (1.0 - late))
            for m in (1.0, 1.0 / 6.0)
        ]
        return complex(pairs[0] * pairs[1])

    others = [root for root in roots if abs(root + 1.0) > 1e-5]
    assert len(others) > 5
    assert all(is_root(consensus, root) for root in others)


def test_energy_switching_laws_explain_missing_roots() -> None:
    for law, why in (("tanks", "tank"), ("tdpa", "second order")):
        with pytest.raises(ScenarioError, match=why):
            loop_of(make_unit_scenario({"m": {}, "s": {}}, {"law": law}))


def test_the_analysis_of_waves_is_whole() -> None:
    analysis = LinearAnalysis.compute(wave_pair(1000.0), pose=(0.0, 0.0))
    assert analysis.verdict == "stable"
    assert analysis.sampled is None
    assert any("continuous time only" in note for note in analysis.notes)
    assert analysis.margin.description.startswith("stable for every common delay")


def test_lines_hold_arms_at_rest_against_hands() -> None:
    """A line between passive ends has no root to the right: its torque balances that of the operator."""
    follows = {"sites.s.control.K": 100.0, "sites.s.control.B": 10.0, "duration_s": 6.0}
    scenario = load_scenario(
        "two_sites", {"control.law": "wave", "scheme": "digital", **follows}
    )
    loop = LinearLoop.of_conditions(
        OperatingConditions.derive(scenario), find_equilibrium(scenario, (0.4, 1.2))
    )
    assert Spectrum.of_loop(loop, 4).roots[0].s.real < -0.1


def test_saturating_pulls_are_linearised_below_saturation() -> None:
    """The loop is that of P+d with the same K and d, and the analysis says so."""
    loops = []
    for law in ({"law": "saturated_pd", "P": 5.0}, {"law": "p_d"}):
        scenario = make_unit_scenario(
            {"m": {"hands": [HELD]}, "s": {}}, {**law, "K": 10.0, "d": 3.0}
        )
        analysis = LinearAnalysis.compute(scenario, pose=(0.0, 0.0))
        loops.append([root.s for root in analysis.decisive.roots])
        assert any("small errors" in note for note in analysis.notes) == (
            law["law"] == "saturated_pd"
        )
    assert loops[0] == loops[1]
