"""What a site knows of its peers' clocks when the session begins, and how it says so."""

from collections.abc import Sequence

from trilat_net.net.offset import offset_text
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


def clock_texts(peers: Sequence[Peer], at_ns: int) -> list[str]:
    """Returns a sentence for every peer whose clock is another one, as of an instant of the own clock."""
    texts = []
    for peer in peers:
        if peer.estimator is not None:
            offset_ns = peer.estimate.offset_at(at_ns)
            bound_ns = peer.estimate.bound_at(at_ns, offset_ns)
            texts.append(f"clock of {peer.name}: another one, {offset_text(offset_ns, bound_ns)}")
    return texts
