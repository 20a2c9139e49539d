"""The corrections of docs/theory/errata-proof.md, 5 and 8: the derivative of V by the chain rule, in symbols."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import sympy as sp

from tests.theory.symbols import (
    QD,
    THETA,
    Q,
    columns,
    coriolis,
    diagonal,
    dot,
    gravity,
    inertia,
    make_symbols,
    norm,
    zero,
)

# --- 5: the derivative of V_i ---------------------------------------------------------------------------


class Rates(NamedTuple):
    """Site 1 with peers 2 and 3: V_1' by the chain rule, and the terms of Eq. (16)-(19)."""

    chain: Any
    r: sp.Matrix
    e: sp.Matrix
    ed: sp.Matrix
    qd_j: list[sp.Matrix]
    seen: list[sp.Matrix]
    alpha: list[Any]
    growth: list[Any]
    hand: sp.Matrix
    Kp: sp.Matrix
    Kd: sp.Matrix
    Lambda: sp.Matrix

    @property
    def passed(self) -> Any:
        """Returns the sum over peers of alpha (|qd_j|^2 - |qd_j(t - T)|^2)."""
        terms = zip(self.alpha, self.qd_j, self.seen, strict=True)
        return sum(a * (norm(now, self.Kd) - norm(then, self.Kd)) for a, now, then in terms)

    @property
    def disagreement(self) -> Any:
        return sum(
            a * norm(QD - then, self.Kd) for a, then in zip(self.alpha, self.seen, strict=True)
        )


@cache
def make_rates() -> Rates:
    """Returns Eq.

    (8), (13), (15) put into the derivative of Eq. (16), for delays T(t) that may grow.
    """
    Lambda = diagonal("L")
    Kp = diagonal("P")
    Kd = diagonal("D")
    Gamma = sp.diag(*sp.symbols("gamma1:6"))
    share = sp.Symbol("alpha12", positive=True)
    growth = list(sp.symbols("Tdot2 Tdot3", real=True))
    alpha = [share, 1 - share]  # Eq. (7)
    e = make_symbols("e")
    qd_j = [make_symbols("u"), make_symbols("w")]
    seen = [make_symbols("us"), make_symbols("ws")]
    hand = make_symbols("h")
    estimate = sp.Matrix(sp.symbols("hat1:6", real=True))
    ed = QD - sum((a * x for a, x in zip(alpha, seen, strict=True)), sp.zeros(2, 1))  # Eq. (18)
    lags = zip(alpha, growth, seen, strict=True)
    e_dot = ed + sum((a * grows * x for a, grows, x in lags), sp.zeros(2, 1))
    r = QD + Lambda * e  # Eq. (10)
    Y = columns(-Lambda * e, -Lambda * ed)
    tau = Y * estimate - Kp * r - Kd * ed  # Eq. (13)
    M_qdd = tau + hand - coriolis(QD) * QD - gravity()  # Eq. (8), tau_h = -tau_x
    M_dot = sum((inertia().diff(Q[n]) * QD[n] for n in (0, 1)), sp.zeros(2, 2))
    chain = dot(r, M_qdd + inertia() * Lambda * e_dot) + norm(r, M_dot) / 2
    chain += dot(estimate - THETA, Gamma.inv() * (-Gamma * Y.T * r))  # Eq. (15)
    chain += dot(e, Lambda * Kd * e_dot)
    for a, grows, now, then in zip(alpha, growth, qd_j, seen, strict=True):
        chain += a * (norm(now, Kd) - (1 - grows) * norm(then, Kd)) / 2
    return Rates(chain, r, e, ed, qd_j, seen, alpha, growth, hand, Kp, Kd, Lambda)


@cache
def make_chain(constant: bool) -> Any:
    """Returns V_1' by the chain rule, with constant delays or not."""
    x = make_rates()
    still = dict.fromkeys(x.growth, 0) if constant else {}
    return sp.expand(sp.expand_trig(x.chain.subs(still)))


def test_eq_17_has_wrong_sign_and_factor() -> None:
    """Errata 5, Eq. (17), and 9: the hands' power is r'tau_h, not qd'tau_h."""
    x = make_rates()
    right = -norm(x.r, x.Kp) - dot(QD, x.Kd * x.ed) + x.passed / 2
    assert zero(make_chain(True) - right - dot(x.r, x.hand))
    free = make_chain(True).subs(dict.fromkeys(x.hand, 0))
    printed = -norm(x.r, x.Kp) + dot(QD, x.Kd * x.ed) + x.passed
    assert not zero(free - printed)
    # the sign alone
    assert not zero(free - (-norm(x.r, x.Kp) - dot(QD, x.Kd * x.ed) + x.passed))
    # the factor alone
    assert not zero(free - (-norm(x.r, x.Kp) + dot(QD, x.Kd * x.ed) + x.passed / 2))
    assert not zero(make_chain(True) - right - dot(QD, x.hand))


def test_eq_19_does_not_follow_from_eq_17() -> None:
    """Errata 5, Eq. (19): halves, and the other sign of the last two norms."""
    x = make_rates()
    stored = norm(QD, x.Kd) - sum(
        a * norm(u, x.Kd) for a, u in zip(x.alpha, x.qd_j, strict=True)
    )
    printed_17 = -norm(x.r, x.Kp) + dot(QD, x.Kd * x.ed) + x.passed
    printed_19 = -norm(x.r, x.Kp) - x.disagreement + stored
    assert not zero(printed_17 - printed_19)
    right_17 = -norm(x.r, x.Kp) - dot(QD, x.Kd * x.ed) + x.passed / 2
    right_19 = -norm(x.r, x.Kp) - x.disagreement / 2 - stored / 2
    assert zero(right_17 - right_19)
    assert not zero(right_17 - printed_19)


# --- 8: delays that vary --------------------------------------------------------------------------------


def test_varying_delay_adds_exactly_one_term() -> None:
    """Errata 8: sum_j alpha_ij T_ij' (1/2 |qd_jd|^2 + (Lambda Kd e + Lambda M r)'qd_jd)."""
    x = make_rates()
    push = x.Lambda * x.Kd * x.e + x.Lambda * inertia() * x.r
    terms = zip(x.alpha, x.growth, x.seen, strict=True)
    added = sum(
        a * grows * (norm(then, x.Kd) / 2 + dot(push, then)) for a, grows, then in terms
    )
    assert zero(make_chain(False) - make_chain(True) - added)


def one_joint(grows: float, Kp: float, Kd: float, Lambda: float, M: float) -> Any:
    """Returns V_i' without the terms that beta cancels, as a symmetric matrix in (r, Lambda e,
    qd_jd), one joint, one peer.

    From the chain rule above: -Kp r^2 - Kd/2 (qd - w)^2 + T' (Kd/2 w^2 + (Lambda Kd e + Lambda
    M r) w).
    """
    r, x, w = sp.symbols("r x w", real=True)
    rate = -Kp * r**2 - Kd / 2 * (r - x - w) ** 2
    rate += grows * (Kd / 2 * w**2 + Kd * x * w + Lambda * M * r * w)
    return np.array(sp.hessian(rate, (r, x, w)), dtype=float) / 2


@pytest.mark.parametrize("grows", [-1.0, -0.1, -1e-3, -1e-6])
def test_any_shrinking_delay_lets_v_rise(grows: float) -> None:
    """Errata 8: all arms in common motion, r = 0, Lambda e = -qd: V' = -T'/2 |qd|^2 > 0."""
    form = one_joint(grows, 1.0, 3.0, 1.0, 5.83)
    state = np.array([0.0, -1.0, 1.0])
    assert state @ form @ state == pytest.approx(-grows * 3.0 / 2)
    assert np.linalg.eigvalsh(form)[-1] > 0.0


@pytest.mark.parametrize(
    "gains", [(1.0, 3.0, 1.0, 5.83), (20.0, 5.0, 2.0, 0.17), (0.1, 10.0, 1.0, 1.0)]
)
def test_slowly_growing_delays_keep_v_falling(
    gains: tuple[float, float, float, float],
) -> None:
    """Errata 8: T' (Kd + Lambda M)^2 <= 2 Kp Kd (1 - T') is where V' <= 0 ends."""
    Kp, Kd, Lambda, M = gains
    limit = 2 * Kp * Kd / ((Kd + Lambda * M) ** 2 + 2 * Kp * Kd)
    assert np.linalg.eigvalsh(one_joint(0.99 * limit, *gains))[-1] < 0.0
    assert np.linalg.eigvalsh(one_joint(1.01 * limit, *gains))[-1] > 0.0
