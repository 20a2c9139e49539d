"""The energy balance closes, to the order of the integrator, and only with every term as
derived.

The balance of arms of n joints closes with friction, stops, walls in space and limits. The
balance of sites that follow with their end effectors closes, and needs every term.
"""

import dataclasses
from dataclasses import replace
from itertools import accumulate, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net
from tests.analysis.builders import (
    JITTER,
    LYAPUNOV,
    find_relative_residual,
    make_rough_log,
    make_run,
)
from tests.core.guarded_runs import adaptive_text, make_stopped_log
from tests.execution.builders import make_shipped_trajectories
from tests.scenario.builders import planar_task_text, six_joint_text
from tests.theory.delay_equations import DelayEquations, inertia, make_equations
from tests.theory.energy import compute_balance as balance_by_hand
from tests.theory.energy import left_null_vector
from trilat_net.analysis.certificate.energy_balance import (
    EnergyBalance,
    SiteEnergy,
    find_dominance_matrices,
)
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.certificate.verdict_facts import StabilityFinding
from trilat_net.analysis.dominance_history import DominancePlan
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.core import DominanceRamp
from trilat_net.presentation.verdict_text import explain_no_functional
from trilat_net.scenario import load_scenario, parse_scenario

CAUGHT = 1e-3
"""A residual, as a share of the largest energy, that no log of these has by itself."""


def of_largest_v(b: EnergyBalance) -> float:
    return float(np.abs(b.residual).max() / b.V.max())


def measure_order(name: str, fine_hz: int = 1000, **overrides: object) -> float:
    rates = fine_hz // 2, fine_hz
    coarse, fine = (
        of_largest_v(make_run(name, {**overrides, "rate_hz": hz}).balance) for hz in rates
    )
    return float(np.log2(coarse / fine))


@pytest.mark.parametrize(
    "name", ["paper", pytest.param("free", marks=pytest.mark.long), "asymmetric"]
)
def test_balance_closes_to_2e_5_with_second_order(name: str) -> None:
    assert of_largest_v(make_run(name, {"duration_s": 2.0, "rate_hz": 1000}).balance) <= 2e-5
    assert measure_order(name, duration_s=2.0) == pytest.approx(2.0, abs=0.1)


def test_balance_closes_until_both_hands_let_go() -> None:
    """At a tenth of the rate the permitted error is a hundred times larger."""
    assert of_largest_v(make_run("paper", {"duration_s": 11.5, "rate_hz": 100}).balance) <= 2e-3


def test_digital_closes_to_some_percent_with_first_order() -> None:
    b = make_run("paper", {"duration_s": 3.0, "scheme": "digital", "rate_hz": 500}).balance
    assert of_largest_v(b) == pytest.approx(3.2e-2, rel=0.2)
    assert measure_order("paper", 500, duration_s=3.0, scheme="digital") == pytest.approx(
        1.0, abs=0.1
    )
    assert np.abs(b.unexplained).max() <= 4e-5 * b.scale


def test_jitter_closes_to_1e_4_with_booked_jumps() -> None:
    b = make_run("free", JITTER).balance
    links = np.sum([x for name, x in b.work.items() if "->" in name], axis=0)
    assert of_largest_v(b) <= 1e-4
    assert np.abs(b.residual + links).max() / b.V.max() >= 3e-3
    assert np.abs(b.unexplained).max() <= 5e-6 * b.scale


def test_jitter_is_of_order_one_at_least() -> None:
    """The order is measured over several seeds, because the jumps of a run depend on its draws."""
    seeds = [{**JITTER, "duration_s": 1.5, "seed": seed} for seed in (1, 2)]
    orders = [measure_order("free", 500, **overrides) for overrides in seeds]
    assert 1.0 <= np.mean(orders) <= 2.0


def test_sampling_error_across_jumps_is_second_order() -> None:
    """Arms that brake: e and its derivative jump at once, while the held torque is the torque
    before the jump.
    """
    cut = {"link.loss": 1.0, "on_stale.action": "brake", "duration_s": 1.0}
    rest = [
        float(np.abs(make_run("free", {**cut, "rate_hz": hz}).balance.unexplained).max())
        for hz in (200, 400)
    ]
    assert np.log2(rest[0] / rest[1]) == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize(
    ("key", "limit", "term"),
    [("tau_rate_limit_nm_s", 100.0, "torque limit"), ("qd_des_limit_rad_s", 0.5, "rule")],
)
def test_limits_of_torque_rate_and_reference_are_booked(
    key: str, limit: float, term: str
) -> None:
    b = make_run("paper", {"duration_s": 2.0, "rate_hz": 1000, f"limits.{key}": limit}).balance
    assert np.abs(b.work[term]).max() > 0.01 * b.V.max()
    assert np.abs(b.unexplained).max() <= 5e-6 * b.scale


def test_a_stop_and_restart_is_booked() -> None:
    """The torque of a stopped site is not that of the law, and the site's estimates stand still."""
    b = EnergyBalance.of_energies(SiteEnergy.by_site(make_stopped_log(adaptive_text(), 3000)))
    assert np.abs(b.work["torque limit"]).max() > 0.01 * b.V.max()
    assert np.abs(b.work["estimates"]).max() > 1e-3 * b.V.max()
    assert np.abs(b.unexplained).max() <= 5e-4 * b.scale


def test_sampled_walls_energy_closes_to_1e_4() -> None:
    b = make_run("wall").balance
    assert b.work["walls"].max() > 1e-3
    assert of_largest_v(b) <= 1e-4


def test_all_effects_together_close_to_1e_4() -> None:
    b = make_run("rich").balance
    assert of_largest_v(b) <= 1e-4
    assert all(
        np.abs(x).max() > 1e-4 * b.scale for name, x in b.work.items() if name not in _SILENT
    )


_SILENT = ("m2->m1", "m1->m2", "m2->s")
"""The links of `rich` that give one constant delay."""

TERMS = [
    *[("rich", "parts", name) for name in ("kinetic", "parameter", "position", "delay")],
    *[("rich", "dissipation", name) for name in ("damping", "disagreement")],
    *[
        ("rich", "work", name)
        for name in ("hands", "walls", "shares", "rule", "torque limit", "estimates")
    ],
    *[("rich", "work", name) for name in ("s->m1", "s->m2")],
    ("free", "work", "m1->m2"),
]


@pytest.mark.parametrize("factor", [-1.0, 0.0, 2.0])
@pytest.mark.parametrize(("name", "group", "term"), TERMS, ids=lambda value: str(value))
def test_a_wrong_sign_or_factor_is_detected(
    name: str, group: str, term: str, factor: float
) -> None:
    b = make_run(name, JITTER if name == "free" else None).balance
    terms = {**getattr(b, group), term: factor * getattr(b, group)[term]}
    assert (
        find_relative_residual(replace(b, **{group: terms}))
        > CAUGHT
        > 5 * find_relative_residual(b)
    )


def test_beta_of_ones_is_detected_and_named() -> None:
    """The paper sets beta = (1, 1, 1) after Eq.

    (20), which is the right null vector of Upsilon, not the left one.
    """
    ones = EnergyBalance.of_energies(
        make_run("asymmetric", {"duration_s": 2.0, "rate_hz": 1000}).energies,
        paper_weights=True,
    )
    assert find_relative_residual(ones) > 10 * CAUGHT
    assert np.abs(ones.residual + ones.transfer).max() <= 2e-5 * ones.V.max()


def test_v_rises_with_the_papers_weights_only() -> None:
    books = make_run("free", LYAPUNOV).energies
    ones = EnergyBalance.of_energies(books, paper_weights=True)
    right = EnergyBalance.of_energies(books)
    assert ones.V[0] == pytest.approx(32.8, abs=0.1)
    rise, kept = (float((b.V - np.minimum.accumulate(b.V)).max()) for b in (ones, right))
    assert rise == pytest.approx(12.3, abs=0.5)
    assert kept <= np.abs(right.residual).max()


@pytest.mark.parametrize("name", [pytest.param("paper", marks=pytest.mark.long), "asymmetric"])
def test_balance_equals_an_independent_book(name: str) -> None:
    """`tests/theory/energy.py` allows one constant delay per link and nothing else; for such
    runs both must agree.
    """
    overrides = {"duration_s": 2.5, "rate_hz": 500}
    run_of_program = make_shipped_trajectories(name, overrides)
    theirs = balance_by_hand(run_of_program, left_null_vector(run_of_program.scenario) * 3)
    ours = make_run(name, overrides).balance
    close = {"abs": 1e-12 * float(theirs.V.max())}
    assert pytest.approx(theirs.V, **close) == ours.V
    assert sum(ours.dissipation.values()) == pytest.approx(theirs.taken, **close)
    assert sum(ours.work.values()) == pytest.approx(theirs.given, **close)


def test_v_converges_to_the_exact_functional() -> None:
    """V, dissipation and work of the continuous equations: DOP853 and Gauss-Legendre, no code
    of the program.
    """
    scenario = load_scenario("paper", {"duration_s": 2.0})
    exact = make_equations(scenario).solve(2.0)
    ours = make_run("paper", {"duration_s": 2.0, "rate_hz": 1000}).balance
    for t in (0.5, 1.2, 1.9):
        k = round(t * 1000)
        assert float(ours.V[k]) == pytest.approx(_exact_v(exact, t), abs=3e-4)
        taken, work = _exact_integrals(exact, t)
        assert sum(float(x[k]) for x in ours.dissipation.values()) == pytest.approx(
            taken, abs=3e-4
        )
        assert float(ours.work["hands"][k]) == pytest.approx(work, abs=3e-4)
        assert _exact_v(exact, t) - _exact_v(exact, 0.0) + taken - work == pytest.approx(
            0.0, abs=1e-7
        )


def _gauss(f, a: float, b: float, edges: list[float]) -> float:
    """Returns the integral of a function of time, with no panel across an edge."""
    x, w = np.polynomial.legendre.leggauss(12)
    cuts = sorted({a, b, *(float(e) for e in edges if a < e < b)})
    total = 0.0
    for low, high in pairwise(cuts):
        total += 0.5 * (high - low) * float(w @ f(0.5 * (high + low) + 0.5 * (high - low) * x))
    return total


PANELS = np.arange(0.0, 4.0, 0.05).tolist()


def _delayed(exact: DelayEquations, times: np.ndarray) -> np.ndarray:
    return np.stack([exact.past(t - exact.delay_s) for t in times], axis=1)


def _exact_v(exact: DelayEquations, t: float) -> float:
    at = np.array([t])
    now = exact.past(t) if t else exact.past(-1.0)
    q = now[:, :2]
    qd = now[:, 2:4]
    estimate = now[:, 4:]
    e = q - exact.alpha @ _delayed(exact, at)[:, 0, :2]
    r = qd + exact.Lambda * e
    v = np.einsum("ki,kij,kj->", r, inertia(exact.theta, q), r)
    v += ((estimate - exact.theta) ** 2 / exact.Gamma).sum() + (
        exact.Lambda * exact.Kd * e**2
    ).sum()

    def moving(times: np.ndarray) -> np.ndarray:
        speeds = np.stack([exact.past(s)[:, 2:4] for s in times], axis=1)
        return np.einsum("ij,jt->t", exact.alpha, (exact.Kd * speeds**2).sum(-1))

    return 0.5 * (v + _gauss(moving, t - exact.delay_s, t, PANELS))


def _exact_integrals(exact: DelayEquations, t: float) -> tuple[float, float]:
    def powers(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        now = np.stack([exact.past(s) for s in times], axis=1)
        then = _delayed(exact, times)
        qd = now[..., 2:4]
        e = now[..., :2] - np.einsum("ij,jtn->itn", exact.alpha, then[..., :2])
        r = qd + exact.Lambda * e
        disagreement = (exact.Kd * (qd[:, np.newaxis] - then[np.newaxis, ..., 2:4]) ** 2).sum(
            -1
        )
        lost = (exact.Kp * r**2).sum((0, 2)) + 0.5 * np.einsum(
            "ij,ijt->t", exact.alpha, disagreement
        )
        pushed = np.stack([exact.hands(s) for s in times], axis=1)
        return lost, (r * pushed).sum((0, 2))

    return tuple(_gauss(lambda s, n=n: powers(s)[n], 0.0, t, PANELS) for n in (0, 1))  # type: ignore[return-value]


def test_a_closed_group_balances_alone() -> None:
    """m1 and m2 follow each other alone; s follows both and has no part in their balance."""
    pair = {
        "dominance.m1.m2": 1.0,
        "dominance.m1.s": 0.0,
        "dominance.m2.m1": 1.0,
        "dominance.m2.s": 0.0,
    }
    energies = make_run("free", {**pair, "duration_s": 1.5, "rate_hz": 500}).energies
    group = EnergyBalance.of_energies({site: energies[site] for site in ("m1", "m2")})
    assert group.beta == pytest.approx(np.ones((len(group.t_s), 2)))
    assert find_relative_residual(group) <= 1e-4
    assert group.transfer == pytest.approx(np.zeros(len(group.t_s)), abs=1e-9 * group.scale)


BAR = 5e-5
"""Largest unexplained energy as a share of the largest V."""


def find_unexplained_share(balance: EnergyBalance) -> float:
    return float(np.abs(balance.unexplained).max() / balance.V.max())


def check_six_joints(duration_s: float) -> LogMetrics:
    """Checks the certificate of a run of six joints, and its metrics."""
    log = trilat_net.simulate(parse_scenario(six_joint_text(duration_s, 200.0)))
    certificate = Certificate.of_log(log)
    metrics = LogMetrics.of_log(log)
    assert certificate.verdict.finding is StabilityFinding.COVERED, certificate.verdict.text
    assert certificate.balance is not None
    assert find_unexplained_share(certificate.balance) <= BAR
    assert np.abs(certificate.balance.residual).max() <= BAR * certificate.balance.V.max()
    for site, energy in certificate.energies.items():
        figures_of_site = metrics.sites[site]
        learnt = (
            figures_of_site["theta_energy_last_j"].value
            - figures_of_site["theta_energy_first_j"].value
        )
        assert learnt == pytest.approx(
            np.ptp(energy.parts.parameter[[0, -1]]) * np.sign(learnt), rel=1e-6
        )
        assert figures_of_site["unaccounted_j"].value <= 1e-6
    return metrics


def test_six_joints_close_with_the_base_parameters() -> None:
    metrics = check_six_joints(2.0)
    estimates = metrics.estimates["s"].base
    assert estimates is not None
    assert len(estimates.parameter) == 36
    assert metrics.sites["s"]["unphysical_links"].value == estimates.consistent_last.count(
        False
    )


@pytest.mark.long
def test_energy_of_seven_joints_closes() -> None:
    text = (
        six_joint_text(10.0, 200.0)
        .replace("arm6", "arm7")
        .replace("[0.2, 0.2, 0.2, 0.05, 0.05, 0.05]", "0.2")
    )
    text = text.replace("[10, 10, 10, 2, 2, 2]", "8").replace("[2, 2, 2, 0.5, 0.5, 0.5]", "1.5")
    for pose in ("0.5, 0.2]", "0.1, 0.0]", "0.3, 0.1]"):
        text = text.replace(pose, f"{pose[:-1]}, 0.4]")
    log = trilat_net.simulate(parse_scenario(text))
    balance = EnergyBalance.of_energies(SiteEnergy.by_site(log))
    assert find_unexplained_share(balance) <= BAR


@pytest.mark.long
def test_energy_of_ten_seconds_of_six_joints_closes() -> None:
    check_six_joints(10.0)


def test_premises_name_joints_at_limits_and_at_stops() -> None:
    certificate = Certificate.of_log(make_rough_log())
    premises = {premise.name: premise for premise in certificate.premises}
    assert (
        premises["torque"].holds is premises["stops"].holds is premises["hands"].holds is False
    )
    assert "s (shoulder_lift)" in premises["torque"].text
    assert "m2 (elbow)" in premises["stops"].text
    assert certificate.verdict.finding in (
        StabilityFinding.DID_NOT_RISE,
        StabilityFinding.ROSE,
    ), certificate.verdict.text


def test_every_term_of_a_rough_arm_is_needed() -> None:
    """Without its friction, its stops or its wall the energy of a site does not add up."""
    energies = SiteEnergy.by_site(make_rough_log())
    whole = EnergyBalance.of_energies(energies)
    assert np.abs(whole.unexplained).max() <= 2e-4 * whole.V.max()
    assert {"stops", "hands", "walls"} == set(whole.external)
    for site, name in (("s", "friction"), ("m2", "friction"), ("m2", "stops"), ("s", "walls")):
        energy = energies[site]
        kinds = {
            kind: {key: course for key, course in getattr(energy, kind).items() if key != name}
            for kind in ("dissipation", "work")
        }
        lame = dataclasses.replace(energy, **kinds)
        assert np.abs(lame.unexplained).max() > 50 * np.abs(energy.unexplained).max(), name


def test_friction_and_stops_stand_in_arm_energies() -> None:
    metrics = LogMetrics.of_log(make_rough_log())
    for site in metrics.sites.values():
        assert site["friction_j"].value > 1.0
        assert site["unaccounted_j"].value <= 0.02
    assert metrics.sites["m2"]["walls_j"].value < 0.0  # its stop
    assert not metrics.sites["m1"]["walls_j"].applies
    assert metrics.walls["s/1"]["force_peak_n"].value > 10.0


"""Largest residual as a share of the largest V."""


def certify_planar_task(
    rate_hz: int = 1000, elbow_rad: float = 1.7, **overrides: object
) -> Certificate:
    text = planar_task_text(rate_hz=rate_hz, elbow_rad=elbow_rad)
    return Certificate.of_log(trilat_net.simulate(parse_scenario(text, overrides=overrides)))


def find_largest_share(certificate: Certificate, name: str = "residual") -> float:
    assert certificate.balance is not None, certificate.verdict.text
    return float(np.abs(getattr(certificate.balance, name)).max() / certificate.balance.V.max())


def test_the_balance_closes_with_order_two() -> None:
    certificates = {rate_hz: certify_planar_task(rate_hz) for rate_hz in (500, 1000)}
    assert all(
        certificate.verdict.finding is StabilityFinding.COVERED
        for certificate in certificates.values()
    )
    assert find_largest_share(certificates[1000]) <= BAR
    assert find_largest_share(certificates[500]) / find_largest_share(
        certificates[1000]
    ) == pytest.approx(4.0, rel=0.1)


def test_the_balance_closes_under_jitter_and_limits() -> None:
    jitter = certify_planar_task(
        **{"link.model": "uniform", "link.delay_ms": 60, "link.half_width_ms": 30}
    )
    box = certify_planar_task(
        **{"control.law": "adaptive_box", "control.theta_low": -0.3, "control.theta_high": 1.2}
    )
    limit = certify_planar_task(**{"limits.tau_limit_nm": 25.0})
    for balanced in (jitter, box, limit):
        assert find_largest_share(balanced) <= BAR
    assert box.verdict.finding is StabilityFinding.COVERED
    assert {premise.name for premise in limit.premises if not premise.holds} == {"torque"}
    assert limit.verdict.rise is not None
    assert list(limit.verdict.rise.causes) == ["the torque limit"]


def test_damping_near_a_singular_pose_fails_a_premise() -> None:
    certificate = certify_planar_task(elbow_rad=0.15, **{"task.singular_value": 0.3})
    premise = next(listed for listed in certificate.premises if listed.name == "singular poses")
    assert premise.holds is False
    assert "s from 0 s on" in premise.text
    assert certificate.balance is not None
    assert (
        abs(certificate.balance.work["singular poses"][-1]) > 0.02 * certificate.balance.V.max()
    )
    assert find_largest_share(certificate, "unexplained") <= 2e-4


@pytest.mark.long
def test_the_axis_of_one_arm_dissipates() -> None:
    """The arm of seven joints starts beside the plane of its masters, and the masters cannot
    leave that plane.
    """
    q0 = [0.3, -0.3, 0.0, -1.6, 0.0, 1.4, 0.0]
    log = trilat_net.simulate(
        load_scenario("unlike_arms", {"duration_s": 1.0, "sites.s.q0_rad": q0})
    )
    certificate = Certificate.of_log(log)
    assert certificate.verdict.finding is StabilityFinding.COVERED, certificate.verdict.text
    assert find_largest_share(certificate) <= BAR
    assert certificate.balance is not None
    taken = certificate.balance.dissipation["open axes"]
    assert taken[-1] > 1e-3
    assert np.diff(taken).min() >= -1e-15
    for site, energy in SiteEnergy.by_site(log).items():
        terms = {
            name: course for name, course in energy.dissipation.items() if name != "open axes"
        }
        lame = dataclasses.replace(energy, dissipation=terms)
        if site == "s":
            assert np.abs(lame.residual).max() > 10 * np.abs(energy.residual).max()


def test_following_an_axis_free_at_peers_fails() -> None:
    certificate = certify_planar_task(**{"sites.m.task.axes": ["x"]})
    premise = next(listed for listed in certificate.premises if listed.name == "axes")
    assert premise.holds is False
    assert "s follows m" in premise.text


def test_orientations_have_no_v_for_a_reason() -> None:
    text = (
        planar_task_text(duration_s=0.1)
        .replace("position", "pose")
        .replace("[8.0, 5.0, 1.0]", "5.0")
    )
    assert "orientations" in explain_no_functional(parse_scenario(text))


def test_false_records_break_the_balance() -> None:
    """Every site's torque is checked against the law in task space."""
    log = trilat_net.simulate(parse_scenario(planar_task_text(duration_s=1.0)))
    energies = SiteEnergy.by_site(log)
    motion = energies["s"].motion
    assert (
        np.abs(motion.records.tau - motion.law_torque(np.arange(len(motion.r)))).max() <= 1e-9
    )
    wrong = dataclasses.replace(
        motion, constants=motion.constants._replace(Kd=1.01 * motion.constants.Kd)
    )
    assert np.abs(wrong.records.tau - wrong.law_torque(np.arange(len(motion.r)))).max() > 1e-3
    assert EnergyBalance.of_energies(energies).V.max() > 1.0


waits = st.lists(st.integers(1, 12), max_size=4)
"""Ticks between successive steps of the shares of a site."""


@given(waits, waits)
def test_every_step_of_shares_adds_a_matrix(of_a: list[int], of_b: list[int]) -> None:
    """The matrices of a run are the first one, and one for every step of the shares of a site."""
    rate_hz = 100
    t_s = np.arange(60) / rate_hz
    energies: dict[str, Any] = {}
    shares = {}
    for site, listed in (("a", of_a), ("b", of_b)):
        ramps = []
        for n, tick in enumerate(accumulate(listed)):
            start_ns = tick * 10**9 // rate_hz
            share = (n + 1) / 10
            ramps.append(DominanceRamp(start_ns, start_ns, (share, 1.0 - share)))
        plan = DominancePlan(np.array([0.0, 1.0]), ramps, 1 / rate_hz)
        history = plan.evaluate(t_s)
        records = SimpleNamespace(t_s=t_s, rate_hz=rate_hz, known=np.ones(60, dtype=bool))
        peers = dict.fromkeys(("b", "c") if site == "a" else ("a", "c"))
        motion = SimpleNamespace(records=records, dominance=history, peers=peers)
        energies[site] = SimpleNamespace(motion=motion)
        shares[site] = history.alpha[:, 0].tolist()
    matrices = find_dominance_matrices(energies)
    assert len(matrices) == 1 + len(of_a) + len(of_b)
    in_force = set(zip(shares["a"], shares["b"], strict=True))
    assert {(float(m[0, 1]), float(m[1, 0])) for m in matrices} == in_force
