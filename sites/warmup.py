"""Warm-up of a site before its session: compile and load every code path of a tick.

Invariant: it leaves no trace; the steps and measurements made here are discarded. A user's control law that
fails here is reported before the session begins.
"""

from collections.abc import Callable

from trilat_net.core.site_setup import SiteSetup
from trilat_net.core.site_step import Site
from trilat_net.core.ticks import Arrival, PlantState, TickInput, TickRecord
from trilat_net.errors import LawFailed
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.messages import PeerSample
from trilat_net.net.offset import OffsetEstimator, OffsetLimit
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import Scenario
from trilat_net.scenario.laws import ImportedLaw

from .law_watchdog import LawWatchdog

_TICKS = 200


def warm_up(scenario: Scenario, name: str, clock: Clock | None = None) -> None:
    """Steps a throw-away site, so that all code of a tick is compiled and in memory.

    Raises:
        LawFailed: a user law fails already with every arm at rest where it starts.
    """
    setup, law = scenario.setup(name), scenario.sites[name].control
    site = Site(setup)
    try:
        if isinstance(law, ImportedLaw):
            with LawWatchdog(site, law.code, clock or SystemClock()) as watchdog:
                _warm(setup, site, watchdog.step)
        else:
            _warm(setup, site, site.step)
    except LawFailed as failed:
        problem = f"{failed.problem}; this was the rehearsal, with every arm at rest where it starts"
        raise LawFailed(problem, site=name, law=failed.law, tick=failed.tick) from None


def _warm(setup: SiteSetup, site: Site, step: Callable[[TickInput], TickRecord]) -> None:
    estimator = OffsetEstimator()
    measured = PlantState(setup.q0, setup.qd0) if setup.external else None
    for k in range(_TICKS):
        arrivals = [
            Arrival(j, k - 1, link.q0, (0.0,) * len(link.q0)) for j, link in enumerate(setup.links) if k > 0
        ]
        output = step(TickInput(k, arrivals, (), measured))
        echo = [(arrival.peer, arrival.tick, k) for arrival in arrivals]
        decode(encode_state(setup.name, 0, site.peers, output, arrivals, 0, 0, k, echo), PeerSample)
        estimator.add(OffsetLimit(k, 1), OffsetLimit(k, -1))
        estimator.estimate(k)
