"""Samples of its peers that a site uses, and samples that its user sees.

Delays and losses are drawn as a run draws them, so that a forecast before a run holds in the
run.

Invariant:
    - The draws are those of the link's key.
    - The samples that a user sees are a function of scenario, seed and ticks. A log
      therefore need not record them.
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
"""Samples that are scheduled at once."""


class LinkSchedule:
    """The due times of the samples of a link, computed with a row of the core's link.

    The row has all models and outages from the start. A model applies from its first stamp on.

    Args:
        setup: the link.
        changed_models: models that changes of the run bring into force later.

    Attributes:
        models: the models of the link, in the order of their first stamps.
        row: the state of the link in the core.
    """

    def __init__(self, setup: LinkSetup, changed_models: Sequence[LinkModel] = ()) -> None:
        points: list[tuple[int, int]] = []
        models: list[LinkModel] = []
        for model, trace in zip(setup.models, setup.traces, strict=True):
            if trace is not None:
                model = model._replace(trace_first=len(points), trace_count=len(trace))
                for t_us, delay_us in trace:
                    points.append((int(t_us), int(delay_us)))
            models.append(model)
        models += changed_models
        # The sort is stable: of two models with one first stamp, the changed model applies.
        models.sort(key=lambda model: model.from_ns)
        self.models = np.array(models, LINK_MODEL_DTYPE)
        self._points = np.array([*points, *setup.outages], dtype=np.int64).reshape(-1, 2)
        row: Row = np.zeros(1, link_dtype(0))[0]
        row.rate_hz = setup.rate_hz
        row.key = setup.key
        row.models = len(self.models)
        row.used = -1
        row.scheduled = -1
        row.outage_first = len(points)
        row.outage_count = len(setup.outages)
        self.row = row
        self._block = np.empty(_BLOCK, dtype=np.int64)

    def draw(self, end: int) -> IntArray:
        """Returns the due times of the samples before `end`, in ns; LOST for a lost sample.

        The first of these samples is the sample after the last sample of the previous call.
        """
        first = int(self.row.scheduled) + 1
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
            positions = np.arange(start, stop) % _BLOCK
            due_ns[start - first : stop - first] = self._block[positions]
        return due_ns

    def draw_releases(self, end: int, receiver_hz: int) -> tuple[IntArray, IntArray]:
        """Returns the next samples that are not lost, and the ticks of their release.

        Args:
            end: the sample after the last one to draw.
            receiver_hz: the tick rate of the receiving site, Hz.

        Returns:
            Numbers of samples, and the receiver's first tick at or after each due time.
        """
        samples = np.arange(int(self.row.scheduled) + 1, end)
        due_ns = self.draw(end)
        stamp_ns = samples * NS_PER_S // int(self.row.rate_hz)
        # A sample is never released at its own stamp.
        ticks = first_ticks(np.maximum(due_ns, stamp_ns + 1), receiver_hz)
        is_delivered = due_ns != LOST
        return samples[is_delivered], ticks[is_delivered]


def first_ticks(due_ns: IntArray, rate_hz: int) -> IntArray:
    """Returns the first ticks at or after times in ns, as `core.ticks.first_tick_at` does."""
    return -(-due_ns * rate_hz // NS_PER_S)


@lru_cache(maxsize=256)
def draw_used_samples(
    link: LinkBase, key: int, receiver_hz: int, sender_hz: int, duration_s: float
) -> IntArray:
    """Returns the sample in use at every tick of a site that has only this link.

    Args:
        link: the link.
        key: the key of its random draws.
        receiver_hz: the tick rate of the site, Hz.
        sender_hz: the tick rate of the peer, Hz.
        duration_s: the duration of the run, s.

    Returns:
        Numbers of samples, shape (ticks,); -1 before the first sample is in use.
    """
    setup = LinkSetup(
        peer="peer",
        alpha=1.0,
        rate_hz=sender_hz,
        q0=(),
        key=key,
        models=(link.to_core_model(),),
        traces=(link.points,),
    )
    sent = round(duration_s * sender_hz)
    samples, releases = LinkSchedule(setup).draw_releases(sent, receiver_hz)
    ticks = max(2, round(duration_s * receiver_hz))
    used = _list_newest(samples, releases, ticks)
    used.flags.writeable = False
    return used


def _list_newest(samples: IntArray, releases: IntArray, ticks: int) -> IntArray:
    """Returns the newest sample released at or before each tick, -1 before the first."""
    newest = np.full(ticks, -1, dtype=np.int64)
    is_within = releases < ticks
    np.maximum.at(newest, releases[is_within], samples[is_within])
    return np.maximum.accumulate(newest)


def count_silences(used: IntArray, receiver_hz: int, silence_ns: int) -> int:
    """Returns how often no new sample came into use for longer than `silence_ns`.

    The time before the first sample does not count.

    Args:
        used: the sample in use at every tick, -1 before the first.
        receiver_hz: the tick rate of the site, Hz.
        silence_ns: the longest time that is not a silence, ns.
    """
    new_sample_ticks = np.flatnonzero(np.diff(used, prepend=-1) > 0)
    if not len(new_sample_ticks):
        return 0
    gap_ticks = np.diff(new_sample_ticks, append=len(used))
    gaps_ns = gap_ticks * NS_PER_S // receiver_hz
    period_ns = NS_PER_S // receiver_hz
    return int(np.count_nonzero(gaps_ns - period_ns > silence_ns))


class PictureDelay:
    """The delay of the picture in which a site's user sees its peers: `[sites.NAME.view]`.

    The picture has a link of its own beside the haptic link, with random draws of its own (L4).
    The user sees a peer's sample from the site's first tick at or after the arrival of the
    sample over that link (L2), until a newer sample is shown. Without a view, the user sees the
    samples in use.

    Args:
        scenario: the scenario.
        site: name of the site.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._receiver_hz = scenario.sites[site].rate_hz
        self._links: dict[str, tuple[int, LinkSchedule]] = {}
        view = scenario.sites[site].view
        peers = scenario.peers(site) if view is not None else ()
        for peer in peers:
            assert view is not None
            rate_hz = scenario.sites[peer].rate_hz
            outages = []
            for start_s, end_s in view.outages_s:
                outages.append((round(start_s * 1e9), round(end_s * 1e9)))
            setup = LinkSetup(
                peer=peer,
                alpha=1.0,
                rate_hz=rate_hz,
                q0=(),
                key=link_key(scenario.seed, f"view {peer}->{site}"),
                models=(view.to_core_model(),),
                traces=(view.points,),
                outages=tuple(outages),
            )
            self._links[peer] = (rate_hz, LinkSchedule(setup))
        # Samples and their release ticks after the tick of the last call, shape (2, samples).
        self._waiting = {peer: np.empty((2, 0), dtype=np.int64) for peer in self._links}
        self._shown = dict.fromkeys(self._links, -1)

    def advance_to(self, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns the sample of each peer that is shown at a tick of the site.

        Args:
            tick: the tick; never before that of the last call.
            used: the sample in use of each peer at that tick.

        Returns:
            Ticks of the peers; -1 before the first.
        """
        for peer, releases in self._draw_until(tick):
            samples, ticks = np.concatenate((self._waiting[peer], releases), axis=1)
            is_released = ticks <= tick
            self._waiting[peer] = np.stack((samples, ticks))[:, ~is_released]
            released = samples[is_released]
            if len(released):
                self._shown[peer] = max(self._shown[peer], int(released[-1]))
        return {**used, **self._shown}

    def list_shown_samples(self, ticks: int) -> dict[str, IntArray]:
        """Returns the samples that are shown at the first ticks of a run.

        Returns:
            For each peer an array of shape (ticks,), -1 before the first; {} without a view.
        """
        return {
            peer: _list_newest(samples, releases, ticks)
            for peer, (samples, releases) in self._draw_until(ticks - 1)
        }

    def _draw_until(self, tick: int) -> Iterator[tuple[str, tuple[IntArray, IntArray]]]:
        """Yields each peer with the samples that it sent before `tick`, and their releases."""
        for peer, (rate_hz, schedule) in self._links.items():
            # A sample that is stamped at the tick itself is not shown yet.
            end = -(-tick * rate_hz // self._receiver_hz)
            yield peer, schedule.draw_releases(end, self._receiver_hz)
