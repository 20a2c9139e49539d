"""What a site knows of its peers' clocks when the session begins."""

from trilat_net.net.pinging import Pinger
from trilat_net.net.session import Epoch
from trilat_net.net.timing import Peer
from trilat_net.scenario import Scenario


def peers_of(scenario: Scenario, name: str, epoch: Epoch, pinger: Pinger) -> list[Peer]:
    """Returns what is known of the peers of a site, in scenario order."""
    return [
        Peer(
            peer,
            epoch.epochs[peer],
            scenario.peers(peer).index(name),
            pinger.estimate(epoch.boots[peer]),
            pinger.estimator(epoch.boots[peer]),
        )
        for peer in scenario.peers(name)
    ]
