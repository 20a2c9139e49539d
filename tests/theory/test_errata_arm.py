"""The corrections of docs/theory/errata-arm.md, 1-4: the arm, derived from its energies, and its parameters."""

from typing import Any

import numpy as np
import pytest
import sympy as sp

from tests.theory.symbols import (
    QD,
    THETA,
    G,
    Q,
    columns,
    dot,
    forces,
    gravity,
    inertia,
    make_symbols,
    normalise,
)
from trilat_net.core.arms.two_link_arm import ArmLinks, regressor


def derive_by_lagrange() -> tuple[sp.Matrix, dict[str, Any]]:
    """Returns Euler and Lagrange's equations of two rigid links, with nothing of the paper in them."""
    t = sp.Symbol("t")
    m1, m2, l1, c1, c2, i1, i2 = sp.symbols("m1 m2 l1 lc1 lc2 I1 I2", positive=True)
    f = [sp.Function("a")(t), sp.Function("b")(t)]
    both = f[0] + f[1]
    first = c1 * sp.Matrix([sp.cos(f[0]), sp.sin(f[0])])
    second = l1 * sp.Matrix([sp.cos(f[0]), sp.sin(f[0])]) + c2 * sp.Matrix(
        [sp.cos(both), sp.sin(both)]
    )
    speeds = [first.diff(t), second.diff(t)]
    kinetic = sum(m * dot(v, v) for m, v in zip((m1, m2), speeds, strict=True)) / 2
    kinetic += (i1 * f[0].diff(t) ** 2 + i2 * both.diff(t) ** 2) / 2
    potential = G * (m1 * first[1] + m2 * second[1])
    lagrangian = kinetic - potential
    torque = [lagrangian.diff(x.diff(t)).diff(t) - lagrangian.diff(x) for x in f]
    a = make_symbols("a")
    plain = [(f[n].diff(t, 2), a[n]) for n in (0, 1)] + [(f[n].diff(t), QD[n]) for n in (0, 1)]
    plain += [(f[n], Q[n]) for n in (0, 1)]
    names = {"m1": m1, "m2": m2, "l1": l1, "lc1": c1, "lc2": c2, "I1": i1, "I2": i2}
    return sp.Matrix([sp.expand(x.subs(plain)) for x in torque]), names


def theta_24(n: dict[str, Any], last: Any) -> list[Any]:
    """Returns Eq. (24) with its last entry given."""
    outer = n["m2"] * n["lc2"] ** 2 + n["I2"]
    first = n["m1"] * n["lc1"] ** 2 + n["m2"] * n["l1"] ** 2 + n["I1"] + outer
    gravity4 = n["m1"] * n["lc1"] + n["m2"] * n["l1"]
    return [first, n["m2"] * n["l1"] * n["lc2"], outer, gravity4, last]


def test_theta_5_is_m2_lc2_unlike_eq_24() -> None:
    """Errata 1, Eq. (24)."""
    torque, n = derive_by_lagrange()
    ours = forces(QD, make_symbols("a"))

    def off(last: Any) -> sp.Matrix:
        return (torque - ours.subs(dict(zip(THETA, theta_24(n, last), strict=True)))).applyfunc(
            normalise
        )

    assert off(n["m2"] * n["lc2"]) == sp.zeros(2, 1)
    l2 = sp.Symbol("l2", positive=True)
    printed = off(n["m2"] * l2)
    assert printed != sp.zeros(2, 1)
    assert printed.subs(l2, n["lc2"]).applyfunc(normalise) == sp.zeros(2, 1)


def test_the_regressor_of_eq_12_needs_two_velocities() -> None:
    """Errata 2, Eq.

    (12): with one velocity the regressor is right where v = qd and nowhere else.
    """
    v = make_symbols("v")
    a = make_symbols("a")
    assert sp.expand(columns(v, a) * THETA - forces(v, a)) == sp.zeros(2, 1)
    # Section IV's, at v
    printed = columns(QD, a).subs(dict(zip(QD, v, strict=True)), simultaneous=True)
    off = (printed * THETA - forces(v, a)).applyfunc(sp.expand)
    assert off != sp.zeros(2, 1)
    assert off.subs(dict(zip(v, QD, strict=True))).applyfunc(sp.expand) == sp.zeros(2, 1)


def test_programs_regressor_equals_the_energies() -> None:
    """Errata 2: Y theta of `core.arm`, with its own theta, against Euler and Lagrange."""
    torque, n = derive_by_lagrange()
    links = ArmLinks(0.7, 1.3, 0.4, 0.11, 0.9, 0.8, 0.35, 0.07)
    values = {"m1": 1.3, "m2": 0.8, "l1": 0.7, "lc1": 0.4, "lc2": 0.35, "I1": 0.11, "I2": 0.07}
    a = make_symbols("a")
    exact = sp.lambdify(
        [Q, QD, a], torque.subs({n[k]: x for k, x in values.items()} | {G: 9.81}), "numpy"
    )
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, qd, qdd = rng.normal(size=(3, 2))
        Y = np.array(regressor(9.81, q, qd, qd, qdd))
        assert Y @ links.theta() == pytest.approx(exact(q, qd, qdd).ravel(), abs=1e-12)


def test_known_lengths_reduce_five_parameters_to_four() -> None:
    """Errata 3, Eq. (24): theta_2 = l1 theta_5."""
    _, n = derive_by_lagrange()
    theta = theta_24(n, n["m2"] * n["lc2"])
    assert sp.simplify(theta[1] - n["l1"] * theta[4]) == 0
    rng = np.random.default_rng(2)
    Y = np.array([regressor(9.81, *rng.normal(size=(4, 2))) for _ in range(40)])
    stacked = Y.reshape(-1, 5)
    four = np.delete(np.eye(5), 1, axis=1)
    four[1, 3] = 0.7  # theta_2 from theta_5, l1 = 0.7 m
    assert np.linalg.matrix_rank(stacked) == 5
    assert np.linalg.matrix_rank(stacked @ four) == 4
    theta = ArmLinks(0.7, 1.3, 0.4, 0.11, 0.9, 0.8, 0.35, 0.07).theta()
    assert four @ np.delete(theta, 1) == pytest.approx(theta)


def test_zero_estimates_contradict_zero_initial_acceleration() -> None:
    """Errata 4: level and at rest, tau = G_hat, so that qdd(0) = M^-1 (G_hat - G) = (-g, g)."""
    level = dict.fromkeys([*Q, *QD], 0)
    point_masses = dict(zip(THETA, (3, 1, 1, 2, 1), strict=True))
    M = inertia().subs(level).subs(point_masses)
    force = gravity().subs(level).subs(point_masses)
    assert list(M.inv() * -force) == [-G, G]
