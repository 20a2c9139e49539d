"""All quantities of a log.

Law: every quantity of the catalogue is there for every place that it is of, as a number or with the reason
why there is none.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..analysis.link_use import link_uses
from ..certificate.shares import Shares, shares
from ..certificate.track import Track
from ..log.reader import Log
from . import contact, delays, effort, energy, learning, network, sharing, tracking
from .catalogue import Quantity
from .pushing import Pushed, pushed
from .reflection import Felt, felt
from .rest import Rest, rests
from .rows import tracks
from .said import Facts, Said, unsaid
from .stiffness import Stiffness, stiffnesses


class Measurement(NamedTuple):
    """A log in numbers.

    Attributes:
        run: of the whole, by key.
        sites: per site.
        links: per link "j->i".
        walls: per wall "s/1": a site, and which of its walls.
        learnt: per site with records, its estimates one by one.
        rest: how many windows at rest there are, in which statics can be read off; or why there is none.
        levers: their loaded joints, with the torques of all loaded sites.
        shared: who felt what of them, where two sites are loaded.
        stiffness: what hands felt from one of them to the next.
        felt: impedances and reflections over frequency.
    """

    run: Facts
    sites: dict[str, Facts]
    links: dict[str, Facts]
    walls: dict[str, Facts]
    learnt: dict[str, learning.Learnt]
    rest: Said
    levers: list[sharing.Lever]
    shared: list[sharing.Shared]
    stiffness: list[Stiffness]
    felt: list[Felt]

    def places(self, quantity: Quantity) -> dict[str, Said]:
        """Returns a quantity of every place that has it; of the run by the name ""."""
        if quantity.of == "run":
            return {"": self.run[quantity.key]}
        found: dict[str, Facts] = getattr(self, f"{quantity.of}s")
        return {name: facts[quantity.key] for name, facts in found.items()}

    def whole(self, quantity: Quantity) -> Said:
        """Returns a quantity of the run: the largest of its places, or their sum.

        A place that can have none does not count; where one has none that could, there is none of the run.
        """
        places = {name: one for name, one in self.places(quantity).items() if one.applies}
        lacking = {name: one for name, one in places.items() if one.value is None}
        if lacking:
            whys = [f"{name}: {one.why}" if name else one.why for name, one in lacking.items()]
            return Said(None, "; ".join(whys))
        values = [one.value for one in places.values() if one.value is not None]
        if not values:
            nowhere = dict.fromkeys(one.why for one in self.places(quantity).values())
            return Said(None, "; ".join(nowhere) or f"there is no {quantity.of}", applies=False)
        return Said(sum(values) if quantity.whole == "sum" else max(values))


def measure(log: Log) -> Measurement:
    """Returns all quantities of a log; of torn, short and empty ones too.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # what is not finite is no number
        return _measure(log, tracks(log))


def _measure(log: Log, found: dict[str, Track]) -> Measurement:
    specs = log.scenario.sites
    by = {site: pushed(track, specs[site]) for site, track in found.items()}
    owned = {site: shares(log, track) for site, track in found.items()}
    absent = [site for site in log.sites if site not in found]
    windows: list[Rest] = [] if absent else rests(found, by, owned)
    levers = sharing.levers(log.scenario, windows)
    pairs = sharing.shared(log.scenario, windows, levers)
    return Measurement(
        {**tracking.of_run(log, found), **sharing.of_run(absent, windows, pairs)},
        {site: _site(log, site, found.get(site), by.get(site)) for site in log.sites},
        _links(log, found, owned),
        _walls(log, found, by),
        {site: learning.learnt(specs[site], track) for site, track in found.items()},
        sharing.resting(absent, windows),
        levers,
        pairs,
        stiffnesses(windows),
        felt(found, by),
    )


def _site(log: Log, site: str, track: Track | None, by: Pushed | None) -> Facts:
    ports = unsaid(energy.SITE, f"no records of {site}")
    if track is not None and by is not None:
        ports = energy.of_site(log.scenario, track, by)
    return {
        **tracking.of_site(log, site),
        **effort.of_site(log, site),
        **ports,
        **learning.of_site(log.scenario.sites[site], track),
        **network.of_loop(log, site),
    }


def _links(log: Log, found: Mapping[str, Track], owned: Mapping[str, Shares]) -> dict[str, Facts]:
    return {
        use.name: {
            **tracking.of_link(log, found, use.peer, use.site),
            **delays.of_link(log, found, owned, use.peer, use.site),
            **network.of_link(use),
        }
        for use in link_uses(log)
    }


def _walls(log: Log, found: Mapping[str, Track], by: Mapping[str, Pushed]) -> dict[str, Facts]:
    facts = {}
    for site in log.sites:
        for n, wall in enumerate(contact.walls(log.scenario.sites[site]), 1):
            tip = by[site].parts.tip if site in by else None
            facts[f"{site}/{n}"] = contact.of_wall(wall, found.get(site), tip)
    return facts
