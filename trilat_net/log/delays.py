"""The measured one-way delays of a log's links, for scenarios that replay them (`model = "trace"`).

Law: what a log does not know is left out. A sample counts as lost where the receiver has a record of every
tick at which it could have come, up to the longest delay that the link shows.
"""

import math
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from ..core.delay import LIMIT_US
from ..core.grid import NS_PER_S
from ..errors import LogError
from ..net.messages import State
from .reader import Log, open_log

Row = tuple[float, float]
"""A sample's stamp, s since the epoch, and its delay, ms; a delay of infinity is a sample lost."""


def measured_rows(path: Path, link: str) -> list[Row]:
    """Returns how long the samples of a link were under way, by their own stamps.

    These are the delays of the network that carried them, as the receiver's records have them in `rx`; what
    the session's scenario injected besides is not in them. A negative one is a matter of clocks and counts
    as none; of a sample that came twice the shorter one counts.

    Args:
        path: the log.
        link: which link, as in "m1->s".

    Raises:
        OSError: the file cannot be opened.
        ValueError: it is no log, or has no such link, or nothing came over it.
    """
    status = path.stat()  # raises what open would, in the same words
    links = _links(path, status.st_mtime_ns, status.st_size)
    if link not in links:
        near = get_close_matches(link, list(links), n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        raise ValueError(f"has no link {link!r}{hint} Its links are {', '.join(links)}")
    if not links[link]:
        raise ValueError(f"nothing came over {link} in it")
    return links[link]


@lru_cache(maxsize=1)
def _links(path: Path, modified_ns: int, size: int) -> dict[str, list[Row]]:  # noqa: ARG001 - of this very file
    """Returns the rows of every link of a log; a scenario asks for one after the other."""
    try:
        log = open_log(path)
        return {
            f"{peer}->{site}": list(_rows(log, site, index, peer))
            for site in log.sites
            for index, peer in enumerate(log.scenario.peers(site))
        }
    except LogError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None


def _rows(log: Log, site: str, index: int, peer: str) -> Iterator[Row]:
    states = log[site].states
    came = _delays_us(states, index)
    longest_ns = 1000 * max(came.values(), default=0)
    gaps = _gaps_ns(states)
    rate_hz = log.scenario.sites[peer].rate_hz
    for tick in range(max(came, default=-1) + 1):
        stamp_ns = tick * NS_PER_S // rate_hz
        if tick not in came and any(
            stamp_ns <= end and stamp_ns + longest_ns >= start for start, end in gaps
        ):
            continue
        # the microsecond in which the stamp lies, as the core counts it
        yield stamp_ns // 1000 / 1e6, came[tick] / 1e3 if tick in came else math.inf


def _delays_us(states: Sequence[State], index: int) -> dict[int, int]:
    """Returns the delay of every sample that came from a peer, us, from 0 to `LIMIT_US`."""
    came: dict[int, int] = {}
    for state in states:
        for peer, tick, delay_us in state.rx:
            if peer == index and tick >= 0:
                came[tick] = min(came.get(tick, LIMIT_US), max(delay_us, 0))
    return came


def _gaps_ns(states: Sequence[State]) -> list[tuple[int, float]]:
    """Returns when samples may have come unseen, ns: where records are missing, and behind the last one."""
    pairs = pairwise(states)
    gaps: list[tuple[int, float]] = [(a.t_ns, b.t_ns) for a, b in pairs if b.tick != a.tick + 1]
    if states and states[0].tick > 0:
        gaps.append((0, states[0].t_ns))
    return [*gaps, (states[-1].t_ns if states else 0, math.inf)]
