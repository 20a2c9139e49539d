"""How a log ended: its arms stand, hang or sank, it diverged or was cut: what small errors do not tell.

Law: an arm hangs whose links both point down at the end and did not at the start; arms fell whose mean is
further than 0.2 rad from where a weightless consensus would stand, in a log in which nobody can have pushed
them there.
"""

import math
from collections.abc import Iterable

import numpy as np

from ..core.arm import Array
from ..errors import ScenarioError
from ..log.reader import Log
from .goal import consensus, refuse_unfit, twin
from .outcome import END_S, STRAYED_RAD

_SHORT_S = 0.5
_LOOKS = 2000
DOWN_RAD = 0.3
"""A link within this of straight down hangs."""


def standing(log: Log) -> list[str]:
    """Returns what to say of how a log ended, a sentence each; nothing where its arms stand at its end.

    Raises:
        LogError: a record cannot be read.
    """
    diverged = [s for s in log.sites if len(log[s]) and log[s].record(-1).mode == "diverged"]
    if diverged:
        return [f"{', '.join(diverged)} diverged: its figures end there"]
    ends = {site: _end_rad(log, site) for site in log.sites if len(log[site])}
    return [*_cut(log, ends), *_away(log, ends)]


def _cut(log: Log, sites: Iterable[str]) -> list[str]:
    """Says so where a log is shorter than its experiment."""
    last_s = min((float(log[site].t_s[-1]) for site in sites), default=0.0)
    wanted_s = log.scenario.duration_s
    if last_s > wanted_s - _SHORT_S:
        return []
    return [f"ends at {last_s:.4g} s of {wanted_s:g} s: its figures are of a shorter run"]


def _away(log: Log, ends: dict[str, Array]) -> list[str]:
    """Says so where arms hang, or are where nobody can have pushed them."""
    hanging = [site for site, q in ends.items() if _down(q) and not _down(log[site].q[0])]
    if hanging:
        return [
            f"{', '.join(hanging)} {'hangs' if len(hanging) == 1 else 'hang'} at the end: small errors and "
            "torques of arms that hang say nothing of a law"
        ]
    return _fallen(log, ends)


def _fallen(log: Log, ends: dict[str, Array]) -> list[str]:
    """Says so where the mean pose left the consensus, and no hand or wall can be the cause."""
    scenario = log.scenario
    try:
        refuse_unfit(scenario)
    except ScenarioError:  # there is no one pose to speak of
        return []
    if twin(scenario) is not None or len(ends) < len(scenario.names):
        return []
    t_s = np.linspace(0.0, min(float(log[site].t_s[-1]) for site in ends), _LOOKS)
    away = np.mean(list(ends.values()), axis=0) - consensus(scenario, t_s)[-1]
    joint = int(np.abs(away).argmax())
    if abs(away[joint]) <= STRAYED_RAD:
        return []
    return [
        f"the arms end {abs(away[joint]):.2g} rad (joint {joint + 1}) from where a weightless consensus "
        "would stand: they sank, or drifted"
    ]


def _end_rad(log: Log, site: str) -> Array:
    """Returns a site's mean angles of the last second, shape (n,), rad."""
    part = log[site]
    mean: Array = part.q[part.t_s > part.t_s[-1] - END_S].mean(axis=0)
    return mean


def _down(q: Array) -> bool:
    """True where both links point straight down."""
    return all(abs(math.remainder(angle + math.pi / 2.0, math.tau)) < DOWN_RAD for angle in np.cumsum(q))
