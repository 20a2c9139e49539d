"""Exogenous torque: what operators do to the arm.

Law: a function of time and of the arm's state, so that each stage of the integrator can ask for it.

Scenarios speak of the torque ON the arm; the paper's tau_x, which Eq. (8) subtracts, is its negative.
"""

import math

import numpy as np
from numpy.typing import NDArray

from .jit import leaf

Array = NDArray[np.float64]

# Columns of the pulse table: first second, last second, then the peak torque of each joint in N m.
START, END, PEAK = 0, 1, 2


@leaf
def torque_on_arm(t_s: float, pulses: Array, torque: Array) -> None:
    """Writes the operator's torque ON the arm at time t, shape (n,), N m; -tau_x of Eq. (8).

    Each pulse is peak * sin^2(pi (t - start) / (end - start)) between start and end: smooth at both ends,
    as in Fig. 3 of the paper, whose numbers are not printed.

    Args:
        t_s: time since the epoch, s.
        pulses: one row per pulse, shape (P, 2 + n): start s, end s, peak of each joint N m.
        torque: where the result goes, shape (n,).
    """
    torque[:] = 0.0
    for p in range(pulses.shape[0]):
        start, end = pulses[p, START], pulses[p, END]
        if start < t_s < end:
            height = math.sin(math.pi * (t_s - start) / (end - start)) ** 2
            for joint in range(torque.shape[0]):
                torque[joint] += pulses[p, PEAK + joint] * height
