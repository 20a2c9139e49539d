"""The vector field against the compiled leaves, which compute the same equations by independent code."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.theory.loops import Array, draw_actors, draw_site
from trilat_net.analysis.theory.site_dynamics import (
    ArgumentLayout,
    SiteRates,
    describe_switching_points,
)
from trilat_net.core.arms.exogenous import (
    TorqueKind,
    TorqueSource,
    torque_on_arm,
    torque_source_rows,
)
from trilat_net.core.arms.two_link_arm import forward_dynamics, regressor
from trilat_net.core.step import control
from trilat_net.core.step.site_setup import SiteSetup

LATE_S = 100.0
AT = ArgumentLayout(2, 5)
seeds = st.integers(0, 2**32 - 1)
laws = st.sampled_from(["adaptive", "known"])


def by_leaves(site_setup: SiteSetup, x: Array) -> dict[str, Array]:
    """Returns the rates as a tick computes them: errors, regressor, torque, external torques,
    forward dynamics.
    """
    gains = site_setup.gains
    q = x[AT.q]
    qd = x[AT.qd]
    Lambda = np.broadcast_to(gains.Lambda, 2)
    e, ed, r = control.control_errors(q, qd, x[AT.q_des], x[AT.qd_des], Lambda)
    Y = regressor(site_setup.g_m_s2, q, qd, -Lambda * e, -Lambda * ed)
    wide = np.inf
    Kp, Kd, K, d, k_f = (
        np.zeros(2) + gain for gain in (gains.Kp, gains.Kd, gains.K, gains.d, gains.k_f)
    )
    known = np.zeros(5) + gains.known
    if gains.law.name == "ADAPTIVE":
        tau = control.adaptive_torque(Y, x[AT.estimate], Kp, Kd, r, ed, wide)
        estimate = -np.asarray(gains.Gamma) * control.regressor_transpose_times(Y, r)
    else:
        tau = control.damped_torque(
            known, site_setup.g_m_s2, K, d, Kd, k_f, q, qd, e, ed, x[AT.peer_torque], wide
        )
        estimate = np.zeros(5)
    rows, table = torque_source_rows(site_setup.actors)
    acted, held = (
        np.array(
            torque_on_arm(LATE_S, q, qd, np.array(site_setup.lengths_m), rows, table, sampled)[
                :2
            ]
        )
        for sampled in (0, 1)
    )
    total = np.array(tau) + acted + held + x[AT.external_torque]
    qdd = np.array(forward_dynamics(site_setup.theta, site_setup.g_m_s2, q, qd, total))
    return {
        "qdd": qdd,
        "estimate": estimate,
        "tau": np.array(tau),
        "external": acted + x[AT.external_torque],
        "held": held,
    }


@given(seed=seeds, law=laws)
def test_the_field_equals_a_tick(seed: int, law: str) -> None:
    rng = np.random.default_rng(seed)
    random_site = draw_site(rng, law, draw_actors(rng))
    x = rng.uniform(-2, 2, AT.arguments)
    site_rates = SiteRates.evaluate(random_site, x)
    wanted = by_leaves(random_site, x)
    for name, value in wanted.items():
        scale = 1.0 + max(
            np.abs(value).max(), np.abs(wanted["external"]).max(), np.abs(wanted["tau"]).max()
        )
        inverse = (
            np.abs(SiteRates.differentiate(random_site, x).qdd[:, AT.external_torque]).max()
            if name == "qdd"
            else 1.0
        )
        assert np.abs(getattr(site_rates, name) - value).max() <= 1e-12 * scale * max(
            1.0, inverse
        ), name


@given(seed=seeds, law=laws)
@settings(max_examples=50)
def test_the_jacobian_is_the_limit_of_differences(seed: int, law: str) -> None:
    """Away from the surfaces of walls, where no derivative exists."""
    rng = np.random.default_rng(seed)
    random_site = draw_site(
        rng, law, [actor for actor in draw_actors(rng) if actor.kind is not TorqueKind.WALL]
    )
    x = rng.uniform(-1, 1, AT.arguments)
    step = 1e-5
    derivatives = SiteRates.differentiate(random_site, x)
    for k in range(AT.arguments):
        ahead, behind = (
            SiteRates.evaluate(random_site, x + sign * step * np.eye(AT.arguments)[k])
            for sign in (1, -1)
        )
        for name in derivatives._fields:
            difference = (getattr(ahead, name) - getattr(behind, name)) / (2 * step)
            exact = getattr(derivatives, name)[:, k]
            assert np.abs(difference - exact).max() <= 1e-6 * (
                1.0 + np.abs(getattr(derivatives, name)).max()
            )


def test_walls_push_on_one_side_only() -> None:
    rng = np.random.default_rng(1)
    wall = TorqueSource(
        TorqueKind.WALL, a=(0.0, 0.0), b=(1.0, 0.0), K=(100.0, 0.0), B=(10.0, 0.0)
    )
    wall_site = draw_site(rng, "known", [wall])
    x = np.zeros(AT.arguments)
    assert not SiteRates.evaluate(
        wall_site, x
    ).external.any()  # the stretched arm is on the free side
    x[AT.q] = np.pi, 0.0
    assert SiteRates.evaluate(wall_site, x).external[0] == pytest.approx(
        0.0, abs=1e-12
    )  # no lever
    x[AT.q] = 2.5, 0.1
    assert np.abs(SiteRates.evaluate(wall_site, x).external).max() > 1.0
    outward = np.sign(
        SiteRates.evaluate(
            wall_site, x * np.where(np.arange(AT.arguments) == AT.qd.start, 0.0, 1.0)
        ).external[0]
    )
    x[AT.qd] = outward * 1e3, 0.0
    assert not SiteRates.evaluate(
        wall_site, x
    ).external.any()  # faster outward than the spring would push


def test_estimates_never_leave_their_box_and_return() -> None:
    rng = np.random.default_rng(2)
    adaptive_site = draw_site(rng, "adaptive")
    x = rng.uniform(-1, 1, AT.arguments)
    free = SiteRates.evaluate(adaptive_site, x).estimate
    ends = (
        np.where(free > 0, x[AT.estimate], np.inf),
        np.where(free > 0, -np.inf, x[AT.estimate]),
    )
    held = adaptive_site._replace(
        gains=adaptive_site.gains._replace(high=tuple(ends[0]), low=tuple(ends[1]))
    )
    assert not SiteRates.evaluate(held, x).estimate.any()
    assert not SiteRates.differentiate(held, x).estimate.any()
    back = adaptive_site._replace(
        gains=adaptive_site.gains._replace(
            low=tuple(np.where(free > 0, x[AT.estimate], -np.inf))
        )
    )
    assert (SiteRates.evaluate(back, x).estimate == free).all()


def test_states_exactly_on_edges_are_reported() -> None:
    rng = np.random.default_rng(3)
    wall = TorqueSource(TorqueKind.WALL, a=(0.0, 0.0), b=(1.0, 0.0), K=(100.0, 0.0))
    wall_site = draw_site(rng, "known", [wall])
    x = np.zeros(AT.arguments)
    assert not list(describe_switching_points(wall_site, x))
    on = wall_site._replace(actors=(wall._replace(a=(sum(wall_site.lengths_m), 0.0)),))
    assert list(describe_switching_points(on, x)) == [
        "x rests exactly on the surface of its wall 1: it counts as not touching"
    ]
    boxed = draw_site(rng, "adaptive")
    boxed = boxed._replace(gains=boxed.gains._replace(high=(9.0, 9.0, 9.0, 1.0, 9.0)))
    x[AT.estimate] = 0.0, 0.0, 0.0, 1.0, 0.0
    assert list(describe_switching_points(boxed, x)) == [
        "theta4 of x rests exactly on the edge of its box: it counts as free"
    ]
