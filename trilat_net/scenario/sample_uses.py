"""Which samples of a peer a site uses, and which its user is shown, at its ticks, drawn as a
run draws them.

Invariant: the draws are those of the link's key, so that what is said before a run holds in the
run. What a user is shown is a function of scenario, seed and ticks: a log has it without a word
of it.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np

from ..core.channel import LOST, schedule_deliveries
from ..core.delay import LINK_MODEL_DTYPE, LinkModel
from ..core.link import link_dtype
from ..core.philox import link_key
from ..core.site_setup import LinkSetup
from ..core.ticks import NS_PER_S
from ..core.vectors import IntArray, Row
from .delay_models import LinkBase
from .scenario_types import Scenario

_BLOCK = 8192


class LinkSchedule:
    """When the samples of a link are due, one after the other: by a row of the core's link.

    Ordered changes hold from a time at which no sample had been decided, so all can stand there
    at once.

    Attributes:
        models: the link's, in the order of their first stamps.
        row: its state in the core.
    """

    def __init__(self, setup: LinkSetup, ordered: Sequence[LinkModel] = ()) -> None:
        points: list[tuple[int, int]] = []
        placed = []
        for model, trace in zip(setup.models, setup.traces, strict=True):
            if trace is not None:
                model = model._replace(trace_first=len(points), trace_count=len(trace))
                points += [(int(t_us), int(delay_us)) for t_us, delay_us in trace]
            placed.append(model)
        self.models = np.array(
            sorted([*placed, *ordered], key=lambda one: one.from_ns), LINK_MODEL_DTYPE
        )
        self._points = np.array([*points, *setup.outages], dtype=np.int64).reshape(-1, 2)
        row: Row = np.zeros(1, link_dtype(0))[0]
        row.rate_hz = setup.rate_hz
        row.key = setup.key
        row.models = len(self.models)
        row.used = -1
        row.foreseen = -1
        row.outage_first = len(points)
        row.outage_count = len(setup.outages)
        self.row = row
        self._block = np.empty(_BLOCK, dtype=np.int64)

    def draw(self, end: int) -> IntArray:
        """Returns when the samples are due that follow those of the last call, up to one, ns;
        or LOST.
        """
        first = int(self.row.foreseen) + 1
        due_ns = np.empty(max(0, end - first), dtype=np.int64)
        for start in range(first, end, _BLOCK):
            stop = min(start + _BLOCK, end)
            schedule_deliveries(
                sample=stop - 1,
                link=self.row,
                models=self.models,
                dues=self._block,
                points=self._points,
            )
            due_ns[start - first : stop - first] = self._block[np.arange(start, stop) % _BLOCK]
        return due_ns

    def draw_releases(self, end: int, own_hz: int) -> tuple[IntArray, IntArray]:
        """Returns those of the same samples that are not lost, and the receiver's ticks that
        release them.
        """
        sample = np.arange(int(self.row.foreseen) + 1, end)
        due_ns = self.draw(end)
        stamp_ns = sample * NS_PER_S // int(self.row.rate_hz)
        ticks = first_ticks(np.maximum(due_ns, stamp_ns + 1), own_hz)
        return sample[due_ns != LOST], ticks[due_ns != LOST]


def first_ticks(due_ns: IntArray, rate_hz: int) -> IntArray:
    """Returns the first ticks at or after times, ns; `core.ticks.first_tick_at` for arrays."""
    return -(-due_ns * rate_hz // NS_PER_S)


@lru_cache(maxsize=256)
def draw_used_samples(
    link: LinkBase, key: int, own_hz: int, peer_hz: int, duration_s: float
) -> IntArray:
    """Returns the sample in use at every tick of a site with nothing but this link, -1 before
    the first.
    """
    setup = LinkSetup(
        peer="peer",
        alpha=1.0,
        rate_hz=peer_hz,
        q0=(),
        key=key,
        models=(link.to_core_model(),),
        traces=(link.points,),
    )
    released = LinkSchedule(setup).draw_releases(round(duration_s * peer_hz), own_hz)
    used = _find_newest(*released, max(2, round(duration_s * own_hz)))
    used.flags.writeable = False
    return used


def _find_newest(sample: IntArray, release: IntArray, ticks: int) -> IntArray:
    newest = np.full(ticks, -1, dtype=np.int64)
    np.maximum.at(newest, release[release < ticks], sample[release < ticks])
    return np.maximum.accumulate(newest)


def count_silences(used: IntArray, own_hz: int, silence_ns: int) -> int:
    """Returns how often none came into use for longer than `silence_ns`, after the first."""
    came = np.flatnonzero(np.diff(used, prepend=-1) > 0)
    gaps_ns = np.diff(came, append=len(used)) * NS_PER_S // own_hz
    return int(np.count_nonzero(gaps_ns - NS_PER_S // own_hz > silence_ns)) if len(came) else 0


class PictureDelay:
    """Which tick of each peer a site's user is shown: `[sites.NAME.view]`, a link beside the
    haptic one.

    A peer's sample is shown from the site's first tick at or after its arrival over that link
    (L2), drawn by a key of its own (L4), until a newer one is. Without a view the samples in
    use are shown.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._own_hz = scenario.sites[site].rate_hz
        view = scenario.sites[site].view
        self._links: dict[str, tuple[int, LinkSchedule]] = {}
        for peer in scenario.peers(site) if view is not None else ():
            assert view is not None
            key = link_key(scenario.seed, f"view {peer}->{site}")
            rate_hz = scenario.sites[peer].rate_hz
            outages = tuple((round(a * 1e9), round(b * 1e9)) for a, b in view.outages_s)
            setup = LinkSetup(
                peer=peer,
                alpha=1.0,
                rate_hz=rate_hz,
                q0=(),
                key=key,
                models=(view.to_core_model(),),
                traces=(view.points,),
                outages=outages,
            )
            self._links[peer] = rate_hz, LinkSchedule(setup)
        self._waiting = {peer: np.empty((2, 0), dtype=np.int64) for peer in self._links}
        self._shown = dict.fromkeys(self._links, -1)

    def advance_to(self, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns the peers' ticks that are shown at a tick of the site, -1 before the first.

        Args:
            tick: never before that of the last call.
            used: the samples in use then.
        """
        for peer, waiting in self._draw(tick):
            sample, release = np.concatenate((self._waiting[peer], waiting), axis=1)
            self._waiting[peer] = np.stack((sample, release))[:, release > tick]
            self._shown[peer] = max([self._shown[peer], *sample[release <= tick][-1:].tolist()])
        return {**used, **self._shown}

    def list_shown_samples(self, ticks: int) -> dict[str, IntArray]:
        """Returns the same for the first ticks of a run, shape (K,) each; {} without a view."""
        return {peer: _find_newest(*drawn, ticks) for peer, drawn in self._draw(ticks - 1)}

    def _draw(self, tick: int) -> Iterator[tuple[str, tuple[IntArray, IntArray]]]:
        for peer, (rate_hz, schedule) in self._links.items():  # none is shown at its own stamp
            yield peer, schedule.draw_releases(-(-tick * rate_hz // self._own_hz), self._own_hz)
