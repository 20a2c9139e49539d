"""Computes the dominance factors of an arm during a running session.

A dominance factor is the weight with which an arm follows another arm. Displays of a running
session compute the factors from the scenario and from the events that the sites publish.

Invariant:
    - The factors equal those that a certificate computes from the log of the session.
"""

from contextlib import suppress

from trilat_net.errors import ScenarioError

from ..scenario import Scenario


class ShareHistory:
    """Tracks how the dominance factors of an arm change over the course of a session.

    A dominance factor is the weight with which the arm follows another arm. The scenario sets
    the initial factors and planned changes, and users may request more changes during the
    session. Each change is a linear ramp from the current factors to new ones.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._later_ramps = scenario.scripted_ramps(site)
        self._ramp = scenario.ramp(site, scenario.dominance[site], -1, 0.0)
        self._shares_before = self._ramp.alpha

    def add_change(self, change: str) -> None:
        """Adds a change of dominance factors that a site has reported as an event.

        Changes of other settings, and strings that do not describe a change, are ignored.

        Args:
            change: Description of the change, from the field `command` of the event.
        """
        with suppress(ScenarioError):  # raised if the text is not a change
            ramp = self._scenario.parse_core_change(self._site, change).ramp
            # A ramp that starts before the present ramp was added earlier, from another event.
            if ramp is not None and ramp.start_ns >= self._ramp.start_ns:
                self._later_ramps.append(ramp)

    def advance_to(self, t_ns: int) -> tuple[float, ...]:
        """Computes the dominance factors (0 to 1) of an arm at a given time of the session.

        Args:
            t_ns: Time in ns after the start of the session. It must not be earlier than in the
                previous call.

        Returns:
            One factor per peer, in the order of the site's peers.
        """
        started_ramps = sorted(ramp for ramp in self._later_ramps if ramp.start_ns <= t_ns)
        # A ramp starts from the factors that the previous ramp had reached by then.
        for ramp in started_ramps:
            self._shares_before = self._interpolate(ramp.start_ns)
            self._ramp = ramp

        # The other ramps have not begun yet.
        self._later_ramps = [ramp for ramp in self._later_ramps if ramp.start_ns > t_ns]
        return self._interpolate(t_ns)

    def _interpolate(self, t_ns: int) -> tuple[float, ...]:
        """Returns the dominance factors at a time during or after the present ramp."""
        ramp = self._ramp
        if t_ns >= ramp.end_ns:
            return ramp.alpha
        progress = (t_ns - ramp.start_ns) / (ramp.end_ns - ramp.start_ns)
        pairs = zip(self._shares_before, ramp.alpha, strict=True)
        return tuple(before + progress * (after - before) for before, after in pairs)
