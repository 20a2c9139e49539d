"""Where a run in virtual time ends: at rest, still moving, or diverged.

Law: the simulation is asked for this alone; all equations of the linear loop are its own.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..core.grid import BUCKETS_PER_S
from ..scenario import Scenario
from ..sim.fused import FusedRun
from .conditions import staying

STILL_RAD_S = 1e-5
"""Nothing that moved faster within the last second is at rest."""
LONGEST = 8.0
"""A run that is not at rest goes on for up to so many times its duration."""
MOST_TICKS = 4_000_000
"""Ticks of all sites together; a run goes on no further than that."""
_KEPT = 100
"""States of the last stretch that a mean is made of."""


class Ending(NamedTuple):
    """The end of a run.

    Attributes:
        t_s: when it ended, s.
        speed_rad_s: the largest joint speed of its last second, rad/s.
        diverged: whether a site left its limits.
        q: joint angles at the end, shape (N, 2), rad.
        theta_hat: estimates at the end, shape (N, 5).
        mean_q: joint angles on average over the last quarter, shape (N, 2), rad.
        mean_theta_hat: estimates on average over the last quarter, shape (N, 5).
    """

    t_s: float
    speed_rad_s: float
    diverged: bool
    q: Array
    theta_hat: Array
    mean_q: Array
    mean_theta_hat: Array

    @property
    def at_rest(self) -> bool:
        """True where nothing moves any more."""
        return not self.diverged and self.speed_rad_s < STILL_RAD_S


def ending_of(scenario: Scenario) -> Ending:
    """Runs a scenario until it rests, and for at most `LONGEST` times its duration.

    Args:
        scenario: the experiment.

    Raises:
        ScenarioError: virtual time cannot run it.
    """
    ticks = sum(map(scenario.ticks, scenario.names))
    most_s = scenario.duration_s * max(1.0, min(LONGEST, MOST_TICKS / ticks))
    run = FusedRun(staying(scenario, most_s))
    look_s = scenario.duration_s
    while True:
        q, theta_hat = _last_quarter(run, look_s)
        speed_rad_s = max(float(site[-BUCKETS_PER_S:, 1].max()) for site in run.maxima)
        if run.diverged_s is not None or speed_rad_s < STILL_RAD_S or 2.0 * look_s > most_s:
            break
        look_s *= 2.0
    diverged = run.diverged_s is not None
    return Ending(run.ran_s, speed_rad_s, diverged, run.q, run.theta_hat, q, theta_hat)


def _last_quarter(run: FusedRun, until_s: float) -> tuple[Array, Array]:
    """Goes on with a run; returns the mean of its angles and estimates over the last quarter of its time."""
    q, theta_hat = [], []
    for t_s in np.linspace(0.75 * until_s, until_s, _KEPT):
        run.advance(float(t_s))
        q.append(run.q)
        theta_hat.append(run.theta_hat)
    return np.mean(q, axis=0), np.mean(theta_hat, axis=0)
