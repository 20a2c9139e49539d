"""Finds circumstances of a run that a reader of its stability verdict should know about.

For example, a run may be stable although a motor was at its torque limit for 2 s. Such a
circumstance does not change the verdict, but shows that the arms or the computers were at their
limits. The circumstances are:

- a motor was at its torque limit and did not apply the full torque of the control law;
- an operator or a wall pushed with a large fraction of the torque limit;
- ticks began at least one full period late;
- samples in use were clearly younger or older than the delay that the scenario states for their
  link;
- a user's program moved an arm, or failed while moving an arm.

Invariant:
    - Each named arm comes with a number that shows the circumstance.
    - The package `presentation` generates one remark for each circumstance that occurred.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..hooks import find_hook
from ..log import Log
from .shared_slave import list_program_sites
from .site_signals import external_torques
from .timeline import Timeline

LARGE_PUSH_SHARE = 0.5
"""Smallest torque of operators and walls that gives a remark, as a share of the torque limit.
"""


_LARGE_AGE_SHARE = 0.05
"""Smallest relative difference between mean age and stated delay that gives a remark."""


class _LargePush(NamedTuple):
    """Largest torque of operators and walls at one site, with the torque limit.

    Attributes:
        site: Name of the site.
        joint: Number of the joint, counted from 1.
        torque_nm: The torque.
        limit_nm: Torque limit of the joint.
    """

    site: str
    joint: int
    torque_nm: float
    limit_nm: float


class _OddAge(NamedTuple):
    """Mean age of the samples in use on a link, if it differs from the stated mean delay.

    Under jitter the newest sample that has arrived is used. The samples in use are therefore
    younger than the mean delay. Lost samples, and samples that wait for older ones, increase
    the age.

    Attributes:
        link: Name of the link, such as "m->s".
        age_ms: Mean age of the samples in use.
        stated_ms: Stated mean delay.
    """

    link: str
    age_ms: float
    stated_ms: float


class RunCircumstances(NamedTuple):
    """Circumstances of a run that may explain why it was judged stable or not.

    `RunCircumstances.of_log` finds these circumstances. An object that is created without
    arguments describes a run without any of them.

    Attributes:
        at_limit_s: How long the motors of each site were at their torque limit, in s, keyed by
            site.
        large_pushes: Largest torque of operators and walls at each site where it was a large
            fraction of the torque limit.
        late_ticks: Number of ticks that began at least one tick period late, keyed by site.
        odd_age: Mean age of the samples in use on the link on which this age deviates most from
            the stated delay, or `None` if the ages agree with the delays on every link.
        program_sites: Sites whose arms were moved by a user's program. The verdict ignores how
            the program reacts to the arms.
        failures: Sentences from the log about programs that failed.
    """

    at_limit_s: Mapping[str, float] = MappingProxyType({})
    large_pushes: tuple[_LargePush, ...] = ()
    late_ticks: Mapping[str, int] = MappingProxyType({})
    odd_age: _OddAge | None = None
    program_sites: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences for the user, one per circumstance that occurred, without a full stop.

        An example is "m1 and m2 were at their torque limit for 0.56 s and 0.43 s". The package
        `presentation` generates them.
        """
        return tuple(find_hook("list the sentences of a finding")(self))

    @classmethod
    def of_log(cls, log: Log) -> "RunCircumstances":
        """Finds the circumstances of a recorded run.

        Args:
            log: Log of the run.
        """
        return RunCircumstances(
            at_limit_s=_measure_time_at_limit(log),
            large_pushes=_find_large_pushes(log),
            late_ticks=_count_late_ticks(log),
            odd_age=_find_odd_age(log),
            program_sites=tuple(list_program_sites(log)),
            failures=tuple(log.failed_hands),
        )


def _measure_time_at_limit(log: Log) -> dict[str, float]:
    """Returns how long the motors of each site were at their torque limit, in s.

    At its limit a motor does not apply the torque that the control law demands. Sites whose
    motors were never at their limit are left out.
    """
    durations_s: dict[str, float] = {}
    for site in log.sites:
        site_log = log[site]
        limit_nm = log.scenario.sites[site].limits.tau_limit_nm
        at_limit = np.any(np.abs(site_log.tau) >= limit_nm, axis=1)
        if at_limit.any():
            durations_s[site] = np.count_nonzero(at_limit) / site_log.rate_hz
    return durations_s


def _find_large_pushes(log: Log) -> tuple[_LargePush, ...]:
    """Finds the sites where operators or walls pushed with a large part of the torque limit.

    Motors near their limit may no longer be able to apply the torque of the control law.
    """
    pushes = []
    for site in log.sites:
        limit_nm = log.scenario.sites[site].limits.tau_limit_nm
        torques_nm = np.abs(external_torques(log[site]))
        peaks_nm = torques_nm.max(axis=0, initial=0.0)
        limits_nm = np.broadcast_to(limit_nm, peaks_nm.shape)
        joint = int(np.argmax(peaks_nm / limits_nm))
        if peaks_nm[joint] > LARGE_PUSH_SHARE * limits_nm[joint]:
            push = _LargePush(site, joint + 1, float(peaks_nm[joint]), float(limits_nm[joint]))
            pushes.append(push)
    return tuple(pushes)


def _count_late_ticks(log: Log) -> dict[str, int]:
    """Counts the control periods (ticks) of each site that began a period or more too late.

    Late periods occur on a busy machine. Sites without late periods are left out.
    """
    counts = {}
    for site in log.sites:
        site_log = log[site]
        late = int(np.count_nonzero(site_log.late_us >= 1e6 / site_log.rate_hz))
        if late:
            counts[site] = late
    return counts


def _find_odd_age(log: Log) -> _OddAge | None:
    """Finds the age of the samples in use, if it differs from the mean of a random delay.

    Links that change during the run are left out.

    Returns:
        The age on the link with the largest difference. `None` if the ages agree with the
        delays on every link.
    """
    changed = {change.link for change in log.scenario.timeline}
    changed |= {change.link for change in Timeline(log).effective_commands}
    ages = []
    for name, link in log.scenario.links.items():
        stated_ms, deviation_ms = link.moments()
        is_jittered = link.random and deviation_ms > 0.0 and stated_ms > 0.0
        if name in changed or link.measured or not is_jittered:
            continue

        peer, site = name.split("->")
        ages_ns = log.sample_ages_ns(peer, site)
        if len(ages_ns):
            ages.append(_OddAge(name, 1e-6 * float(ages_ns.mean()), stated_ms))

    def measure_difference(age: _OddAge) -> float:
        return abs(age.age_ms / age.stated_ms - 1.0)

    oddest = max(ages, key=measure_difference, default=None)
    if oddest is None or measure_difference(oddest) <= _LARGE_AGE_SHARE:
        return None
    return oddest
