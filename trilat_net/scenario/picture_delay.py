"""Computes which states of the other arms the user of an arm sees, without running anything.

The picture in which a user sees the other arms has a delay and loss of its own. These are
random, but the random numbers follow from the seed of the scenario and can be drawn again. For
example, a report can show what a user saw even though the log does not contain it.

Invariant:
    - What a user sees depends only on the scenario, its seed and the number of the control
      period.
"""

from collections.abc import Mapping

import numpy as np

from ..core import IntArray, LinkSchedule, LinkSetup, link_key
from .scenario_types import Scenario


class PictureDelay:
    """Delay of the picture in which the user of a site sees the other arms.

    The picture is sent over its own network link, with its own random delays and losses. It
    changes in the first control period after a newer state of another arm arrives.

    The delay is configured in the table `[sites.NAME.view]` of a scenario. Without that table,
    the user sees the states that the controller uses.

    Args:
        scenario: The scenario.
        site: Name of the site whose user looks at the picture.
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
        # Samples that are not shown yet, and the ticks in which they will be shown.
        self._waiting = {peer: np.empty((2, 0), dtype=np.int64) for peer in self._links}
        self._shown = dict.fromkeys(self._links, -1)

    def advance_to(self, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns, for each peer, the index of the sample that the user sees in one tick.

        Args:
            tick: The tick, no earlier than that of the previous call.
            used: Mapping from peer name to the index of the sample that the controller uses in
                this tick.

        Returns:
            Mapping from peer name to sample index; -1 before the first sample.
        """
        for peer, (rate_hz, schedule) in self._links.items():
            end = self._find_end(tick, rate_hz)
            releases = schedule.draw_releases(end, self._receiver_hz)
            samples, ticks = np.concatenate((self._waiting[peer], releases), axis=1)
            is_released = ticks <= tick
            self._waiting[peer] = np.stack((samples, ticks))[:, ~is_released]
            released = samples[is_released]
            if len(released):
                self._shown[peer] = max(self._shown[peer], int(released[-1]))
        return {**used, **self._shown}

    def list_shown_samples(self, ticks: int) -> dict[str, IntArray]:
        """Returns the indices of the samples that the user sees in every control period.

        Args:
            ticks: Number of control periods of the user's site, from the start of the run.

        Returns:
            Mapping from peer name to the index of the shown sample in every period, shape
            (ticks,); -1 before the first sample. Empty if the scenario specifies no delay of
            the picture, in which case the user sees the samples that the controller uses.
        """
        return {
            peer: schedule.draw_used(
                self._find_end(ticks - 1, rate_hz), self._receiver_hz, ticks
            )
            for peer, (rate_hz, schedule) in self._links.items()
        }

    def _find_end(self, tick: int, rate_hz: int) -> int:
        """Returns the number of samples that a peer sent before a tick of the site.

        A sample sent at the time of the tick itself is not shown yet.

        Args:
            tick: Tick of the site.
            rate_hz: Tick rate of the peer, in Hz.
        """
        return -(-tick * rate_hz // self._receiver_hz)
