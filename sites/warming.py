"""What runs before a session does, so that nothing in it is slow because it is the first of its kind.

Law: it leaves no trace: what is stepped and measured here is thrown away.
"""

from trilat_net.core.site import Site
from trilat_net.core.tick import Arrival, Tick
from trilat_net.net.messages import Sample
from trilat_net.net.offset import Limit, OffsetEstimator
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import Scenario

_TICKS = 200


def warm_up(scenario: Scenario, name: str) -> None:
    """Steps a throw-away site, so that everything that a tick runs through is compiled and in memory."""
    setup = scenario.setup(name)
    site, clock = Site(setup), OffsetEstimator()
    for k in range(_TICKS):
        arrivals = [
            Arrival(j, k - 1, link.q0, (0.0,) * len(link.q0)) for j, link in enumerate(setup.links) if k > 0
        ]
        output = site.step(Tick(k, arrivals))
        echo = [(arrival.peer, arrival.tick, k) for arrival in arrivals]
        decode(encode_state(name, 0, site.peers, output, arrivals, 0, 0, k, echo), Sample)
        clock.add(Limit(k, 1), Limit(k, -1))
        clock.estimate(k)
