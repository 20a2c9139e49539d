"""Loops of unit masses under laws of positions and forces, in the frequency domain: one matrix, solved.

For each site i, with x_des, f_des the shares of the peers' x and torque, T late, and F_i the torque ON arm i:

    s^2 x_i = (K + B s)(x_des - x_i) + c_a s^2 x_des + c_p f_des + c_o F_i + F_i

Nothing here is of the package: it is what the runs in time are compared with.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

Complex = NDArray[np.complex128]

WALL = (500.0, 5.0)
"""K and B of the environment at the slave, the last site."""
PAIR = np.array([[0.0, 1.0], [1.0, 0.0]])
VARIANTS: dict[str, dict[str, Any]] = {
    "ideal": {"acceleration": 1.0},
    "without qdd": {},
    "three": {"force_peer": (1.0, 0.0), "force_own": (0.0, -1.0), "acceleration": 1.0},
    "no forces": {"force_peer": 0.0},
}
TABLE = {
    ("ideal", 0.0): (1.0, 1.0, 1.0, 1.0, 1.0),
    ("ideal", 0.001): (1.0, 0.992, 0.979, 0.970, 0.938),
    ("ideal", 0.02): (0.990, 0.840, 0.686, 0.580, 0.720),
    ("ideal", 0.2): (0.802, 0.234, 0.041, 3.14, 1.00),
    ("without qdd", 0.0): (0.999, 0.980, 0.921, 0.690, 0.976),
    ("without qdd", 0.001): (0.999, 0.973, 0.904, 0.667, 1.004),
    ("without qdd", 0.02): (0.990, 0.832, 0.650, 0.350, 1.75),
    ("without qdd", 0.2): (0.802, 0.234, 0.034, 3.62, 0.976),
    ("three", 0.0): (1.0, 1.0, 1.0, 1.0, 1.0),
    ("three", 0.001): (1.0, 0.999, 0.997, 0.987, 0.903),
    ("three", 0.02): (0.999, 0.984, 0.936, 0.766, 2.35),
    ("three", 0.2): (0.989, 0.764, 0.708, 1.55, 1.00),
    ("no forces", 0.0): (0.167, 0.177, 0.200, 0.244, 2.38),
    ("no forces", 0.001): (0.167, 0.177, 0.199, 0.245, 2.42),
    ("no forces", 0.02): (0.167, 0.175, 0.191, 0.313, 2.95),
    ("no forces", 0.2): (0.167, 0.193, 0.333, 0.491, 2.38),
}
"""Ratios of the transmitted to the true impedance at 0.1, 0.5, 1, 2 and 5 Hz, by variant and delay in s."""


def build_balance(
    s: complex,
    alpha: NDArray[np.float64],
    *,
    K: float = 100.0,
    B: float = 20.0,
    acceleration: float = 0.0,
    force_peer: Sequence[float] | float = 1.0,
    force_own: Sequence[float] | float = 0.0,
    delay_s: float = 0.0,
    held_s: float = 0.0,
    loads: Sequence[tuple[float, float]] = (),
) -> tuple[Complex, Complex]:
    """Returns A and b of A x = b F, F free torques: `loads` are K and B of what holds the arms, in order.

    `held_s`: for so long a torque of the law is held, which delays it by half of that.
    """
    n = len(alpha)
    identity = np.eye(n)
    late = alpha * np.exp(-s * delay_s)
    held = (1.0 - np.exp(-s * held_s)) / (s * held_s) if held_s else 1.0
    peer, own_gain = (np.diag(np.broadcast_to(gain, n)) for gain in (force_peer, force_own))
    impedance = np.diag([K_h + B_h * s for K_h, B_h in [*loads, *[(0.0, 0.0)] * n][:n]])
    # s^2 x = held tau + f and (1 - c_a late) tau = -(K + B s)(1 - late) x + felt f, f: the torque on the arm,
    # tau + f being what is sent as qdd
    slow = (identity - acceleration * late) / held
    felt = own_gain + (peer + acceleration * identity) @ late
    b = slow + felt
    return slow * s**2 + (K + B * s) * (identity - late) + b @ impedance, b


def find_transmission(
    frequency_hz: float, alpha: NDArray[np.float64], at: int, **law: object
) -> float:
    """Returns |torque / velocity| for a torque on arm `at`, over |Z_e| of the wall at the last arm."""
    s = 2j * np.pi * frequency_hz
    free = [(0.0, 0.0)] * (len(alpha) - 1)
    A, b = build_balance(s, alpha, loads=[*free, WALL], **law)  # type: ignore[arg-type]
    x = np.linalg.solve(A, b[:, at])
    return float(abs(1.0 / (s * x[at])) / abs(WALL[0] / s + WALL[1]))


def rightmost_root(
    alpha: NDArray[np.float64], loads: Sequence[tuple[float, float]], **law: object
) -> float:
    """Returns the largest real part of the roots without delay, from det A(s), a polynomial of
    degree 2 n.
    """
    degree = 2 * len(alpha)
    points = 10.0 * np.exp(2j * np.pi * np.arange(degree + 1) / (degree + 1))
    values = [np.linalg.det(build_balance(s, alpha, loads=loads, **law)[0]) for s in points]  # type: ignore[arg-type]
    scaled = np.fft.fft(values) / (degree + 1)  # coefficients of (s / 10)^k
    return float(10.0 * np.roots(scaled[::-1]).real.max())


def approximate_printed(value: float) -> Any:
    """Returns an approximation of a printed number of three digits, within half of the last digit."""
    return pytest.approx(value, rel=2e-3, abs=6e-4)
