"""Analyses the control loop of arms at rest in one common pose, with arbitrary gains.

The search for the gains of an arm (`trilat tune --arm`) needs the rate at which small motions
about a pose grow with these gains. `RestingLoop` computes the rate for any pose, any gains, and
either the delays of the scenario or a constant delay. For comparison, it also determines the
rate at which the motion of a simulated run grows.

Invariant:
    - The gains and the start poses of the scenario have no effect.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...core import BUCKETS_PER_S, Array
from ...execution import FusedRun
from ...scenario import Scenario
from ..twins.envelope_trend import EnvelopeFit
from .characteristic_roots import CharacteristicRoot
from .floquet import SamplesInUse
from .linear_edge import find_rightmost_root
from .operating_point import Equilibrium, OperatingConditions

_STILL_SHARE = 1e-7
"""Share of the largest speed of a run below which a speed counts as rounding error."""
_NO_ROOT_PER_S = -1e3
"""Real part of the root of a loop without roots, such as one with negligible gains, in 1/s."""


@dataclass(frozen=True)
class RestingLoop:
    """The linearised control loop of arms at rest in one common pose.

    `find_root` predicts how fast small motions grow, and `measure_growth` measures how fast
    they grow in a simulated run.

    Attributes:
        conditions: Tick rates of the arms, and the delays between them.
    """

    conditions: OperatingConditions

    @classmethod
    def of_scenario(cls, scenario: Scenario) -> "RestingLoop":
        """Returns the loop of the arms of a scenario, with the delays of its links.

        Args:
            scenario: The scenario.
        """
        return cls(OperatingConditions.derive(scenario))

    @property
    def rate_hz(self) -> int:
        """Tick rate of the first site, in Hz."""
        return self.conditions.sites[0].rate_hz

    @property
    def varies(self) -> bool:
        """True if the ages of the samples that the sites use vary during a run."""
        return self.conditions.varying

    @property
    def largest_age_s(self) -> float:
        """Largest age of the samples in use on any link, in s.

        The age of a sample is the time between sending and use. For a link whose ages vary,
        their mean is used.
        """
        return float(self.conditions.age_s.max())

    def find_age_quantile_s(self, quantile: float) -> float:
        """Returns the age that a given fraction of all samples in use does not exceed, in s.

        Args:
            quantile: The fraction, from 0 to 1.
        """
        used = SamplesInUse.predict(self.conditions).used.values()
        ages_by_link = [np.arange(len(samples)) - samples for samples in used]
        ages = np.concatenate(ages_by_link)
        age_ticks = float(np.quantile(ages, quantile, method="higher"))
        return age_ticks / self.rate_hz

    def fix_age(self, age_s: float) -> "RestingLoop":
        """Returns the loop with one constant age for all samples, in place of varying ages.

        Args:
            age_s: The age, in s.
        """
        has_delay = self.conditions.age_s > 0.0
        ages_s: Array = np.where(has_delay, age_s, 0.0)
        return RestingLoop(self.conditions._replace(age_s=ages_s, varying=False))

    def find_root(self, law: Any, pose: Array, *, sampled: bool = True) -> CharacteristicRoot:
        """Returns the characteristic root of the loop with the largest real part.

        The real part is the rate, in 1/s, at which small motions grow. A negative value means
        that they decay.

        Args:
            law: Control law of all arms, with its gains.
            pose: Pose of all arms, shape (n,), in rad or m, for n joints.
            sampled: True to analyse the sampled loop, False to analyse it in continuous time.

        Returns:
            The root. If the loop has no roots, a root with a large negative real part.
        """
        sites = []
        for site in self.conditions.sites:
            gains = law.linear_gains(site.theta)
            sites.append(site._replace(gains=gains))
        poses = np.tile(pose, (len(sites), 1))
        theta = np.array([site.theta for site in sites])
        rest = Equilibrium(poses, theta, "a pose", 0.0)
        conditions = self.conditions._replace(sites=tuple(sites))
        root = find_rightmost_root(conditions, rest, sampled=sampled)
        return root or CharacteristicRoot(complex(_NO_ROOT_PER_S), 1, ())

    @staticmethod
    def measure_growth(run: FusedRun) -> EnvelopeFit:
        """Determines whether the motion of a simulated run grows, decays or persists.

        The motion is measured by the largest speed of all joints in each interval of 50 ms.

        Args:
            run: The run in the fused loop.

        Returns:
            The trend of the largest speed, with its rate in 1/s.
        """
        speed = np.max([site[:, 1] for site in run.maxima], axis=0)
        t_s = np.arange(len(speed)) / BUCKETS_PER_S
        floor = _STILL_SHARE * speed.max()
        (fit,) = EnvelopeFit.fit_columns(t_s, speed[:, np.newaxis], floor, falls_first=True)
        return fit
