"""What runs before a session does, so that nothing in it is slow because it is the first of its kind.

Law: it leaves no trace: what is stepped and measured here is thrown away. A law from outside that fails here
is told before a session begins.
"""

from collections.abc import Callable

from trilat_net.core.setup import SiteSetup
from trilat_net.core.site import Site
from trilat_net.core.tick import Arrival, Measured, Output, Tick
from trilat_net.errors import LawFailed
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.messages import Sample
from trilat_net.net.offset import Limit, OffsetEstimator
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import Scenario
from trilat_net.scenario.own_law import Own

from .overtime import Overtime

_TICKS = 200


def warm_up(scenario: Scenario, name: str, time: Clock | None = None) -> None:
    """Steps a throw-away site, so that everything that a tick runs through is compiled and in memory.

    Args:
        scenario: the experiment.
        name: which of its sites.
        time: the time; by default the machine's.

    Raises:
        LawFailed: a law from outside does so already with every arm at rest where it starts.
    """
    setup, law = scenario.setup(name), scenario.sites[name].control
    site = Site(setup)
    try:
        if isinstance(law, Own):
            with Overtime(site, law.code, time or SystemClock()) as overtime:
                _warm(setup, site, overtime.step)
        else:
            _warm(setup, site, site.step)
    except LawFailed as failed:
        problem = f"{failed.problem}; this was the rehearsal, with every arm at rest where it starts"
        raise LawFailed(problem, site=name, law=failed.law, tick=failed.tick) from None


def _warm(setup: SiteSetup, site: Site, step: Callable[[Tick], Output]) -> None:
    clock = OffsetEstimator()
    measured = Measured(setup.q0, setup.qd0) if setup.external else None
    for k in range(_TICKS):
        arrivals = [
            Arrival(j, k - 1, link.q0, (0.0,) * len(link.q0)) for j, link in enumerate(setup.links) if k > 0
        ]
        output = step(Tick(k, arrivals, (), measured))
        echo = [(arrival.peer, arrival.tick, k) for arrival in arrivals]
        decode(encode_state(setup.name, 0, site.peers, output, arrivals, 0, 0, k, echo), Sample)
        clock.add(Limit(k, 1), Limit(k, -1))
        clock.estimate(k)
