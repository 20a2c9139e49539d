"""The paper's arm in symbols, linear in theta: Section IV, with C and Y in two velocities."""

from typing import Any

import sympy as sp

G = sp.Symbol("g", positive=True)
THETA = sp.Matrix(sp.symbols("theta1:6", positive=True))
Q = sp.Matrix(sp.symbols("q1:3", real=True))
QD = sp.Matrix(sp.symbols("qd1:3", real=True))


def diagonal(name: str) -> sp.Matrix:
    """Returns a diagonal gain."""
    return sp.diag(*sp.symbols(f"{name}1:3", positive=True))


def make_symbols(name: str) -> sp.Matrix:
    return sp.Matrix(sp.symbols(f"{name}1:3", real=True))


def norm(x: sp.Matrix, K: sp.Matrix) -> Any:
    return (x.T * K * x)[0]


def dot(a: sp.Matrix, b: sp.Matrix) -> Any:
    return (a.T * b)[0]


def normalise(expression: Any) -> Any:
    """Returns the normal form of a polynomial in sines and cosines of q1 and q2."""
    angles = {sp.sin(x): sp.Symbol(f"sin_{x}") for x in Q}
    written = sp.expand(sp.expand_trig(expression)).subs(angles)
    for x, sine in zip(Q, angles.values(), strict=True):
        written = (
            sp.rem(written, sine**2 + sp.cos(x) ** 2 - 1, sine)
            if written.has(sine)
            else written
        )
    return sp.expand(written)


def zero(expression: Any) -> bool:
    return bool(normalise(expression) == 0)


def inertia() -> sp.Matrix:
    """Returns M of Section IV in theta."""
    m12 = THETA[2] + THETA[1] * sp.cos(Q[1])
    return sp.Matrix([[THETA[0] + 2 * THETA[1] * sp.cos(Q[1]), m12], [m12, THETA[2]]])


def coriolis(qd: sp.Matrix) -> sp.Matrix:
    """Returns C of Section IV in theta."""
    h = -THETA[1] * sp.sin(Q[1])
    return sp.Matrix([[h * qd[1], h * (qd[0] + qd[1])], [-h * qd[0], 0]])


def gravity() -> sp.Matrix:
    outer = THETA[4] * G * sp.cos(Q[0] + Q[1])
    return sp.Matrix([THETA[3] * G * sp.cos(Q[0]) + outer, outer])


def forces(v: sp.Matrix, a: sp.Matrix) -> sp.Matrix:
    """Returns M a + C(q, qd) v + G, which Y theta of Eq. (12) has to equal."""
    return inertia() * a + coriolis(QD) * v + gravity()


def columns(v: sp.Matrix, a: sp.Matrix) -> sp.Matrix:
    """Returns Y(q, qd, v, a), found as the derivative of these forces by theta."""
    return forces(v, a).jacobian(THETA)
