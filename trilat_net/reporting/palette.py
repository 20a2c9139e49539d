"""Colours of sites, the same in every figure and on every page.

The first three are the "high contrast" set of Paul Tol's notes on colour: safe for the colour blind and apart
in lightness, also in grey print. The third is the slave's, however many masters there are.
"""

from collections.abc import Sequence

from ..scenario import Scenario

SITE_COLOURS = ("#004488", "#bb5566", "#ddaa33", "#000000", "#66a3d2", "#7a7a7a")
DARK_SITE_COLOURS = ("#79b0f2", "#f08a9b", "#e9bd4c", "#f2f2f2", "#9bd3f5", "#a3a3a3")
"""The same sites on a dark page."""
_SLAVE = 2


def order_palette(scenario: Scenario) -> list[int]:
    """Returns the palette's places in the order of a scenario's sites; sites beyond them begin anew."""
    free = list(range(len(SITE_COLOURS)))
    order = []
    roles = [site.role for site in scenario.sites.values()]
    for n, role in enumerate(roles[: len(free)]):
        kept = [place for place in free if place != _SLAVE or "slave" not in roles[n:]]
        order.append(_SLAVE if role == "slave" and _SLAVE in free else kept[0])
        free.remove(order[-1])
    return [*order, *free]


def list_site_colours(scenario: Scenario, colours: Sequence[str] = SITE_COLOURS) -> list[str]:
    """Returns the colours of a palette in the order of a scenario's sites."""
    return [colours[place] for place in order_palette(scenario)]
