"""A site's shares in its peers, while they change.

Law: the shares at a time are a function of that time and of the ramps alone; between two rows that sum to
1 every row does.
"""

from .arm import Array
from .delay import Row
from .jit import leaf
from .link import Rows

RAMP_COLUMNS = 2
"""A ramp is a row: start and end, ns, then the share of each peer at its end."""


@leaf
def _between(t_ns: float, start_ns: float, end_ns: float, before: float, after: float) -> float:
    """Returns the share at a time of one ramp."""
    if t_ns >= end_ns:
        return after
    return before + (after - before) * ((t_ns - start_ns) / (end_ns - start_ns))


@leaf
def follow_ramps(t_ns: int, count: int, ramps: Array, links: Rows) -> None:
    """Writes alpha and its derivative into every link.

    A ramp begins where the one before it is at that time, complete or not.

    Args:
        t_ns: the time, ns since the epoch.
        count: how many rows of `ramps` are filled; the first holds the shares at the epoch.
        ramps: in the order of their starts, shape (R, 2 + P), see `RAMP_COLUMNS`.
        links: one row per peer, dtype LINK.
    """
    for j in range(links.shape[0]):
        link: Row = links[j]
        column = RAMP_COLUMNS + j
        before, current = ramps[0, column], 0
        for n in range(1, count):
            if t_ns < ramps[n, 0]:
                break
            before = _between(
                ramps[n, 0], ramps[current, 0], ramps[current, 1], before, ramps[current, column]
            )
            current = n
        start_ns, end_ns, after = ramps[current, 0], ramps[current, 1], ramps[current, column]
        link.alpha = _between(t_ns, start_ns, end_ns, before, after)
        link.alpha_rate = (after - before) / ((end_ns - start_ns) * 1e-9) if t_ns < end_ns else 0.0
