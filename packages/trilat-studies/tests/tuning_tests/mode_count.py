"""The number of growing modes of alike arms, counted by the argument principle from M(q), K and
d alone.

Two alike arms that follow one another split into a sum and a difference. Each is one arm that
receives its own position n ticks later, with a = 1 or -1: x[k + 1] = P x[k] + a Q S x[k - n].
The turns of det(1 - a z^-n S (z - P)^-1 Q) about zero along a circle just outside of abs(z) = 1
count the growing modes. Desoer and Wang, "On the generalized Nyquist stability criterion", IEEE
Trans. Automatic Control 25 (1980). Nothing is imported from `trilat_net`.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

Array = NDArray[np.float64]
_GROWTH = 1e-7
"""By how much of itself a motion that counts grows in a tick."""


def count_growing(M: Array, K: Array, d: Array, delay_ticks: int, h_s: float) -> int:
    """Returns the number of growing modes under P+d without gravity, with torque 1.5 tau_k -
    0.5 tau_{k-1}.
    """
    n = len(M)
    zero = np.zeros((n, n))
    identity = np.eye(n)

    # the motion of an arm over a tick in which the torque is held
    rates = np.block(
        [[zero, identity, zero], [zero, zero, np.linalg.inv(M)], [np.zeros((n, 3 * n))]]
    )
    transition = expm(rates * h_s)
    Phi = transition[: 2 * n, : 2 * n]
    Gamma = transition[: 2 * n, 2 * n :]

    # the arm with its own feedback, its input from the other arm, and its position
    F = np.hstack([-np.diag(K), -np.diag(d)])
    P = np.block([[Phi + 1.5 * Gamma @ F, -0.5 * Gamma], [F, zero]])
    Q = np.vstack([1.5 * Gamma @ np.diag(K), np.diag(K)])
    S = np.eye(n, 3 * n)
    signs = np.array([1.0, -1.0]).reshape(2, 1, 1)

    def compute_determinants(angle: Array) -> NDArray[np.complex128]:
        """Returns det(1 - a z^-n S (z - P)^-1 Q) for both signs a, at angles of z."""
        z = (1.0 + _GROWTH) * np.exp(1j * angle)[:, np.newaxis, np.newaxis]
        G = z**-delay_ticks * (S @ np.linalg.solve(z * np.eye(3 * n) - P, Q + 0.0 * z))
        return np.linalg.det(identity - signs * G[:, np.newaxis])

    # angles are added until no step turns a determinant far enough to miss a turn
    angle = np.geomspace(1e-3 * _GROWTH, np.pi, 500)
    determinants = compute_determinants(angle)
    while True:
        turns = np.angle(determinants[1:] / determinants[:-1])
        wide = np.flatnonzero(np.abs(turns).max(axis=1) > 0.8)
        if not len(wide):
            break
        between = np.sqrt(angle[wide] * angle[wide + 1])
        new_determinants = compute_determinants(between)
        determinants = np.insert(determinants, wide + 1, new_determinants, axis=0)
        angle = np.insert(angle, wide + 1, between)

    growing_alone = int((np.abs(np.linalg.eigvals(P)) > 1.0 + _GROWTH).sum())
    return 2 * growing_alone - round(float(turns.sum()) / np.pi)
