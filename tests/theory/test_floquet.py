"""Roots over the period of tick rates and delays: against twins of runs, the companion matrix, and draws."""

import math
from collections.abc import Mapping
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.execution.builders import run_fused
from tests.theory.loops import Array
from tests.theory.tick_recursion import build_recursion
from trilat_net.analysis.theory import find_equilibrium, floquet
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.floquet import CoupledTicks, SampledLoop, SamplesInUse
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.scenario import Scenario, load_scenario

POSE = (0.1, 0.4)


class Loop(NamedTuple):
    """A loop at rest in one pose, its roots, and that scenario."""

    scenario: Scenario
    spectrum: Spectrum

    @property
    def growth_per_s(self) -> float:
        """Growth of the slowest motion, 1/s."""
        assert self.spectrum.rightmost is not None
        return self.spectrum.rightmost.s.real


def make_loop_at_rest(
    name: str, changes: Mapping[str, Any], wanted: int = 4, pose: tuple[float, ...] = POSE
) -> Loop:
    """Returns a scenario with all sites at rest at a pose, and its roots there."""
    scenario = load_scenario(name, changes)
    starts = {f"sites.{site}.q0_rad": list(pose) for site in scenario.names}
    scenario = load_scenario(
        scenario, starts | {f"sites.{site}.hands": [] for site in scenario.names}
    )
    spectrum = SampledLoop(OperatingConditions.derive(scenario)).compute_spectrum(
        find_equilibrium(scenario, pose), wanted
    )
    return Loop(scenario, spectrum)


def measure_growth(loop: Loop, push_rad: float, from_s: float, to_s: float) -> float:
    """Measures the growth of the difference of two runs, of which one starts beside the other,
    1/s.

    The speeds at whole periods follow a recurrence, for any motion within a period; the
    recurrence of least norm has its other roots inside. Kumaresan and Tufts, IEEE Trans.
    Acoustics, Speech, Signal Processing 30 (1982).
    """
    whole = load_scenario(loop.scenario, {"duration_s": to_s})
    pushes = np.random.default_rng(1).uniform(-push_rad, push_rad, (len(whole.names), 2, 2))
    beside = load_scenario(
        whole,
        {
            f"sites.{name}.{key}": (np.array(start) + push).tolist()
            for name, both in zip(whole.names, pushes, strict=True)
            for key, start, push in zip(
                ("q0_rad", "qd0_rad_s"), (POSE, (0.0, 0.0)), both, strict=True
            )
        },
    )
    step_s = (loop.spectrum.span_s or 0.05) * math.ceil(0.2 / (loop.spectrum.span_s or 0.05))
    k = np.arange(math.ceil(from_s / step_s), math.floor((to_s - 0.1) / step_s))
    seen = []
    for name, speeds_first, other in zip(
        whole.names, list_speeds(whole), list_speeds(beside), strict=True
    ):
        ticks = np.rint(k * step_s * whole.sites[name].rate_hz).astype(int)
        seen.append(
            (speeds_first - other)[ticks]
            * np.exp(-loop.growth_per_s * k * step_s)[:, np.newaxis]
        )
    rows = np.concatenate(seen, axis=1)  # of one size, to weigh alike
    before = np.concatenate(
        [
            np.stack([rows[n : n + len(rows) - ORDER, at] for n in range(ORDER)], axis=1)
            for at in range(rows.shape[1])
        ]
    )
    after = np.concatenate([rows[ORDER:, at] for at in range(rows.shape[1])])
    terms = np.linalg.lstsq(before, after, rcond=1e-3)[0]
    return loop.growth_per_s + math.log(np.abs(np.roots([1.0, *-terms[::-1]])).max()) / step_s


def list_speeds(scenario: Scenario) -> list[Array]:
    """Returns the joint speeds of every record of each site."""
    run = run_fused(scenario, keep=max(map(scenario.ticks, scenario.names)))
    assert run.diverged_s is None
    columns = scenario.layout(scenario.names[0]).columns()["qd"]
    return [rows[:, columns] for _, rows in run.pop_records()]


ORDER = 16
"""Of the recurrence: more than there are motions late in a run."""
LAWS = (
    {"law": "p_d", "K": 10.0},
    {"law": "pd_d", "K": 10.0, "Kd": 2.0},
    {"law": "adaptive"},
)


def draw_loop(seed: int) -> tuple[Loop, float, float, float] | None:
    """Draws a loop of one, two or three tick rates, with the push, begin and end of a
    measurement by twins.

    None if its slowest motion is lost in rounding, or leaves the small ones, before the next
    has died.
    """
    rng = np.random.default_rng(seed)
    control = dict(LAWS[seed % 3])
    if control["law"] != "adaptive":
        control["d"] = float(rng.uniform(0.2, 2.5))
    else:
        control |= {"Kp": float(rng.uniform(2.0, 12.0)), "Kd": float(rng.uniform(0.5, 3.0))}
    name = ("two_sites", "p_d_margin")[seed // 3 % 2]
    shipped = load_scenario(name)
    sites = shipped.names
    if control["law"] == "adaptive":
        control["theta_hat0"] = [float(parameter) for parameter in shipped.arms[sites[0]].theta]
    rates = rng.choice([40, 50, 60, 80, 100, 150, 200], len(sites)).tolist()
    mean_ms = float(rng.integers(0, 400))
    sine = {"model": "sine", "amplitude_ms": round(mean_ms * rng.uniform(0.3, 1.0), 1)}
    sine["period_s"] = float(rng.choice([0.4, 0.6, 1.0, 1.25, 1.5, 2.0]))
    link = {"delay_ms": mean_ms, "model": "constant"} | (sine if rng.random() < 0.6 else {})
    if rng.random() < 0.3:
        link |= (
            {"playout_ms": round(mean_ms * rng.uniform(0.5, 1.0), 1)}
            if rng.random() < 0.5
            else {"order": "in_order"}
        )
    changes = {
        "scheme": str(rng.choice(["second_order", "digital"])),
        "control": control,
        "link": link,
    }
    for n, site in enumerate(sites):
        changes[f"sites.{site}.rate_hz"] = int(rates[n if seed % 5 < 3 else 0])
    loop = make_loop_at_rest(name, changes, 6)
    reals = [root.s.real for root in loop.spectrum.roots]
    gap_per_s = reals[0] - next(
        (real for real in reals if real < reals[0] - 1e-3), reals[0] - 1.0
    )
    from_s = max(4.0, 2.0 / max(0.1, gap_per_s))
    to_s = from_s + max(
        20.0 * max(1.0, loop.spectrum.span_s or 0.0), min(120.0, 4.0 / gap_per_s)
    )
    size = reals[0] * to_s
    if not -20.0 < size < 15.0:
        return None
    return loop, 1e-6 * min(100.0, math.exp(-size)), from_s, to_s


def compare_with_twins(seed: int) -> bool:
    """Compares a drawn loop with its twins; False if the twins cannot decide."""
    drawn = draw_loop(seed)
    if drawn is None:
        return False
    loop, push, from_s, to_s = drawn
    measured = measure_growth(loop, push, from_s, to_s)
    assert measured == pytest.approx(loop.growth_per_s, rel=2e-3, abs=2e-4), seed
    return True


@pytest.mark.parametrize("seed", [20, 69, 90])
def test_twins_of_runs_grow_at_their_roots(seed: int) -> None:
    """An adaptive loop of two rates and a sine, three rates, and one rate at a constant delay."""
    assert compare_with_twins(seed)


@pytest.mark.long
def test_sixty_twins_grow_at_their_roots() -> None:
    """A third of the loops at several tick rates, and most with delays that follow a sine."""
    assert len([*islice(filter(compare_with_twins, range(400)), 60)]) == 60


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law["law"])
@pytest.mark.parametrize("delay_ms", [0.0, 30.0, 200.0])
def test_one_rate_gives_companion_matrix_eigenvalues(
    law: dict[str, Any], delay_ms: float
) -> None:
    damped = {} if law["law"] == "adaptive" else {"d": 1.3}
    loop = make_loop_at_rest(
        "two_sites", {"rate_hz": 100, "control": {**law, **damped}, "link.delay_ms": delay_ms}
    )
    recursion = build_recursion(
        OperatingConditions.derive(loop.scenario), find_equilibrium(loop.scenario, POSE)
    )
    roots = recursion.roots(100)
    still = np.abs(roots) < 1e-6
    assert loop.spectrum.zeros == recursion.constant + np.count_nonzero(still)
    moving = roots[~still & (roots.imag >= 0.0)]
    for root, other in zip(loop.spectrum.roots, moving, strict=False):
        assert abs(root.s - other) <= 1e-6 * (1.0 + abs(other))
    assert loop.spectrum.span_s is None


@pytest.mark.parametrize(
    ("rates_hz", "growth_per_s", "period_s"), [((30, 30), 0.595, None), ((40, 30), 0.180, 0.1)]
)
def test_digital_pairs_may_grow_despite_continuous_damping(
    rates_hz: tuple[int, int], growth_per_s: float, period_s: float | None
) -> None:
    """K 50, d 2 against a bound of 1.667 at one tick of 30 Hz; folded, joint 2 has 1 kg m^2."""
    rates = {"sites.m.rate_hz": rates_hz[0], "sites.s.rate_hz": rates_hz[1]}
    control = {"law": "p_d", "K": 50.0, "d": 2.0}
    changes = {**rates, "scheme": "digital", "control": control, "link.delay_ms": 0.0}
    roots = make_loop_at_rest("two_sites", changes, pose=(0.0, math.pi)).spectrum
    assert roots.rightmost is not None
    assert roots.rightmost.s.real == pytest.approx(growth_per_s, abs=5e-4)
    assert roots.rightmost.s.imag == pytest.approx(9.9, abs=0.2)
    assert (roots.verdict, roots.span_s) == ("unstable", period_s)


SINE_S = 1.4
SINE = {"model": "sine", "delay_ms": 200.0, "amplitude_ms": 195.0, "period_s": SINE_S}


def test_sinusoidal_delays_can_pump_stable_loops() -> None:
    """P+d, d 1.1, 200 +- 195 ms: the loop swings at half the frequency of the delay, which
    excites it parametrically.
    """
    changes = {"rate_hz": 200, "control.d": 1.1}
    straight = (0.1, 0.0)
    mean = {"model": "constant", "delay_ms": 202.5}
    assert (
        make_loop_at_rest("p_d_margin", {**changes, "link": mean}, pose=straight).growth_per_s
        < -0.01
    )
    pumped = make_loop_at_rest("p_d_margin", {**changes, "link": SINE}, pose=straight).spectrum
    assert pumped.rightmost is not None
    assert abs(pumped.rightmost.s - complex(0.0397, math.pi / SINE_S)) <= 1e-4
    assert pumped.span_s == SINE_S


@pytest.mark.parametrize("period_s", [1.4, 1.2517, 0.58317])
def test_the_period_is_that_of_the_draws(period_s: float) -> None:
    """For a period that is no multiple of the tick, all but a few of a hundred samples repeat."""
    changes = {
        "sites.m.rate_hz": 200,
        "sites.s.rate_hz": 150,
        "link": {**SINE, "period_s": period_s},
    }
    conditions = OperatingConditions.derive(load_scenario("two_sites", changes))
    uses = SamplesInUse.predict(conditions)
    assert uses.period_s is not None
    for (i, j), (link, key) in conditions.links.items():
        own_hz, peer_hz = (conditions.sites[n].rate_hz for n in (i, j))
        drawn = link.draw_used_samples(key, own_hz, peer_hz, 3.0 + 2.0 * uses.period_s)[
            3 * own_hz :
        ]
        later = drawn[round(uses.period_s * own_hz) :] - round(uses.period_s * peer_hz)
        assert np.mean(drawn[: len(later)] != later) <= (0.0 if period_s == SINE_S else 0.05)


def test_drawn_delays_grow_like_their_twins() -> None:
    """The growth is measured from one window of 3 s to another; the span of the roots begins earlier in the same draws."""
    link = {"model": "normal", "delay_ms": 200.0, "deviation_ms": 80.0, "loss": 0.3}
    changes = {"rate_hz": 100, "control.d": 1.0, "link": link, "duration_s": 30.0}
    loop = make_loop_at_rest("p_d_margin_two", changes, 1, (0.1, 0.0))
    assert loop.spectrum.span_s == 30.0
    assert loop.spectrum.deviation_per_s is not None
    assert 1e-3 < loop.spectrum.deviation_per_s < 0.02
    beside = load_scenario(loop.scenario, {"sites.s.q0_rad": [POSE[0] + 1e-7, 0.0]})
    distances = np.hstack(
        [a - b for a, b in zip(list_speeds(loop.scenario), list_speeds(beside), strict=True)]
    )
    first, last = (np.linalg.norm(distances[from_s * 100 :][:300]) for from_s in (2, 27))
    assert math.log(last / first) / 25.0 == pytest.approx(
        loop.growth_per_s, abs=3.0 * loop.spectrum.deviation_per_s
    )


def test_drifting_motions_differ_from_staying_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A free mass, and one that follows it: a shared place stays, and both may go on at one speed."""
    h = 0.01
    K = 4.0
    d = 3.0
    S = np.eye(4)
    S[0, 1] = S[2, 3] = h
    S[3, 2:] -= h * K, h * d
    effect = np.zeros((4, 4))
    effect[3, :2] = h * K, h * d
    hand_made = CoupledTicks(
        S, {(1, 0): effect}, ("m.q1", "m.qd1", "s.q1", "s.qd1"), np.array([0, 0, 1, 1]), 0
    )
    monkeypatch.setattr(floquet.CoupledTicks, "of_conditions", lambda *_, **__: hand_made)
    roots = make_loop_at_rest(
        "two_sites", {"rate_hz": 100, "control.law": "p_d", "link": SINE}
    ).spectrum
    assert (roots.zeros, roots.drifting, roots.verdict) == (2, 1, "at the edge")
    assert roots.rightmost is not None
    exact = np.log(np.roots([1.0, -(2.0 - h * d), 1.0 - h * d + h * h * K]).astype(complex)) / h
    assert roots.rightmost.s == pytest.approx(exact[np.argmax(exact.imag)], abs=1e-6)


def test_thousandfold_growth_per_tick_has_its_root() -> None:
    control = {"law": "p_d", "K": 1.0, "d": 1e5}
    loop = make_loop_at_rest(
        "two_sites",
        {"rate_hz": 1000, "scheme": "digital", "control": control, "link.delay_ms": 20.0},
        1,
    )
    recursion = build_recursion(
        OperatingConditions.derive(loop.scenario), find_equilibrium(loop.scenario, POSE)
    )
    assert loop.growth_per_s == pytest.approx(recursion.roots(1000)[0].real, rel=1e-9)
    assert loop.growth_per_s > 6e3
