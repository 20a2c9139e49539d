"""Renders bars in a report that show which user leads the slave arm over time.

A slave can follow several masters, each weighted by a dominance factor. The master with the
largest factor leads. The factors may change during a run, for example when a trainer takes over
from a trainee. The bars are shown below the moving arms of the report.

Invariant:
    - The factors are those that the slave used, taken from the scenario and the records.
    - For a slave whose factors never change, a sentence replaces the bar.
    - The bar has the same time axis as the slider that moves the arms.
"""

from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ..analysis import DominanceHistory, Timeline
from ..core import Array
from ..errors import join_words
from ..log import Log
from ..scenario import Scenario
from .html_templates import render_macro
from .page_data import PageData

_MAX_BARS = 4
"""Maximum number of slaves with a bar or a sentence."""
_MAX_PHASES = 6
"""Maximum number of time spans described in the text beside a bar."""
_INSTANTS = 600
"""Number of equally spaced instants at which the factors are computed."""
_STEP_S = 1e-6
"""Time before a sudden change at which the old factors still apply, in s."""
_SAME_SHARE = 1e-9
"""Maximum difference between two factors that are considered equal."""


class SlaveLead(NamedTuple):
    """The dominance factors with which a slave arm follows its peers over time.

    Attributes:
        slave: Name of the slave.
        peers: Names of the P peers that the slave follows at some time during the run.
        t_s: Times of the K points between which the factors change linearly, in s.
        shares: Dominance factor of each peer at these times, from 0 to 1, shape (K, P).
    """

    slave: str
    peers: list[str]
    t_s: Array
    shares: Array

    @property
    def is_constant(self) -> bool:
        """True if none of the slave's dominance factors change during the run.

        In that case a sentence describes the factors completely, and a bar over time would add
        nothing.
        """
        return len(self.t_s) < 2 or bool(np.ptp(self.shares, axis=0).max() <= _SAME_SHARE)

    @classmethod
    def list_of_log(cls, log: Log) -> list["SlaveLead"]:
        """Returns the dominance factors over time of each slave in a log.

        The bars, the sentences and the slider of the page use these data.

        Args:
            log: Log of the run.

        Returns:
            One entry per slave that has records and follows another arm, at most `_MAX_BARS`
            entries.
        """
        leads = []
        for site, site_settings in log.scenario.sites.items():
            if site_settings.role == "slave" and len(log[site]):
                lead = cls._trace(log, site)
                if lead.peers:
                    leads.append(lead)
        return leads[:_MAX_BARS]

    @classmethod
    def _trace(cls, log: Log, slave: str) -> "SlaveLead":
        """Computes the dominance factors with which a slave follows its peers.

        The points are those at which the slope of any factor changes, so that straight lines
        between them represent the factors at all times.
        """
        end_s = Timeline(log).end_s

        # Candidates: equal steps, and the start and the end of each ramp. A point just before
        # the start shows a jump as a vertical line.
        times_s = [np.linspace(0.0, end_s, _INSTANTS)]
        for start_s, end_of_ramp_s in DominanceHistory.list_ramp_spans_s(log, slave):
            times_s.append(np.array([start_s - _STEP_S, start_s, end_of_ramp_s]))
        t_s = np.unique(np.clip(np.concatenate(times_s), 0.0, end_s))

        factors = DominanceHistory.of_log(log, slave, t_s).alpha
        followed = np.flatnonzero(factors.max(axis=0) > 0.0)
        peers = [log.scenario.peers(slave)[index] for index in followed]
        factors_of_followed = factors[:, followed]
        corners = _find_corners(t_s, factors_of_followed)
        return cls(slave, peers, t_s[corners], factors_of_followed[corners])

    @property
    def bar(self) -> PageData.LeadBar:
        """Data from which a script of the page shows who leads the slave at a selected time."""
        return PageData.LeadBar(
            site=self.slave,
            peers=self.peers,
            t=self.t_s.tolist(),
            shares=self.shares.T.tolist(),
        )

    def describe_constant(self, scenario: Scenario) -> str:
        """Returns a sentence on who leads the slave if its dominance factors are constant.

        For example: "m1 leads the slave with 80 % and m2 with 20 %, during the whole run."

        Args:
            scenario: Scenario of the run.
        """
        slave = _name_slave(scenario, self.slave)
        first, *others = self.peers
        if not others:
            return f"{first} alone leads {slave}, during the whole run."
        phrases = [f"{first} leads {slave} with {_format_percent(self.shares[0, 0])}"]
        for peer, factor in zip(others, self.shares[0, 1:], strict=True):
            phrases.append(f"{peer} with {_format_percent(factor)}")
        return f"{join_words(phrases)}, during the whole run."

    def describe_phases(self) -> str:
        """Returns a text that says who leads the slave, and when.

        An example is "0 to 10 s: m1 90 %, m2 10 %; from 12 s: m1 10 %, m2 90 %". Ramps are
        omitted, because the time spans on either side show the factors before and after the
        ramp. Only the first `_MAX_PHASES` spans are listed, followed by the number of remaining
        ones.
        """
        phase_texts = []
        first_point = 0
        for index in range(1, len(self.t_s) + 1):
            is_last = index == len(self.t_s)
            if not is_last:
                change = np.abs(self.shares[index] - self.shares[first_point]).max()
                if change <= _SAME_SHARE:
                    continue  # the phase of constant shares continues

            is_longer_than_a_point = index - 1 > first_point  # otherwise within a ramp
            if is_longer_than_a_point:
                from_s = self.t_s[first_point]
                to_s = self.t_s[index - 1]
                span = f"from {from_s:.4g} s" if is_last else f"{from_s:.4g} to {to_s:.4g} s"
                phase_texts.append(f"{span}: {self._list_shares(first_point)}")
            first_point = index

        if not phase_texts:
            end = len(self.t_s) - 1
            phase_texts = [
                f"at first {self._list_shares(0)}",
                f"at the end {self._list_shares(end)}",
            ]

        if len(phase_texts) > _MAX_PHASES:
            unlisted_count = len(phase_texts) - _MAX_PHASES
            phase_texts = [*phase_texts[:_MAX_PHASES], f"and {unlisted_count} more"]
        return "; ".join(phase_texts)

    def render_bar(self, log: Log) -> Markup:
        """Returns a bar showing how much the slave follows each peer over time, as SVG.

        The areas of the peers are stacked and together fill the bar. The height of an area is
        the dominance factor of its peer.

        Args:
            log: Log of the run.
        """
        end_s = Timeline(log).end_s
        tops = 1.0 - np.cumsum(self.shares, axis=1)
        bottoms = tops + self.shares
        peers = []
        for column, peer in enumerate(self.peers):
            # The outline of an area runs along its upper edge and back along its lower edge.
            upper = _list_points(self.t_s, tops[:, column])
            lower = _list_points(self.t_s[::-1], bottoms[::-1, column])
            points = " ".join([*upper, *lower])
            peers.append({"name": peer, "index": log.sites.index(peer), "points": points})
        return render_macro(
            "charts.html",
            "lead_bar",
            slave=_name_slave(log.scenario, self.slave),
            peers=peers,
            phases=self.describe_phases(),
            end_s=f"{end_s:.6g}",
        )

    def _list_shares(self, index: int) -> str:
        """Returns the percentages of all peers at a point, such as "m1 90 %, m2 10 %"."""
        shares = zip(self.peers, self.shares[index], strict=True)
        return ", ".join(f"{peer} {_format_percent(share)}" for peer, share in shares)


def _find_corners(t_s: Array, shares: Array) -> list[int]:
    """Returns the indices of the points needed to draw factors over time as a line.

    Points on a straight line between other points are omitted. The first and the last point are
    kept.
    """
    slopes = np.diff(shares, axis=0) / np.diff(t_s)[:, np.newaxis]
    turns = np.abs(np.diff(slopes, axis=0)).max(axis=1, initial=0.0)
    corners = np.flatnonzero(turns > _SAME_SHARE) + 1
    return [0, *corners.tolist(), len(t_s) - 1]


def _list_points(t_s: Array, heights: Array) -> list[str]:
    """Formats points for an SVG shape, with time in s increasing to the right."""
    points = zip(t_s.tolist(), heights.tolist(), strict=True)
    return [f"{time_s:.6g},{height:.4f}" for time_s, height in points]


def _name_slave(scenario: Scenario, slave: str) -> str:
    """Returns "the slave", including its name if there are several slaves."""
    roles = [spec.role for spec in scenario.sites.values()]
    return "the slave" if roles.count("slave") == 1 else f"the slave {slave}"


def _format_percent(share: float) -> str:
    """Formats a dominance factor as a percentage with three digits."""
    return f"{100.0 * share:.3g} %"
