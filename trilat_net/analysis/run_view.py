"""One view of a recorded run: its sites' records aligned, the torques by source, dominance,
links and walls.

Invariant: whatever is derived from a log is derived once, by `RunView.once`, whoever asks
first.
"""

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from ..core.exogenous import TorqueSource
from ..core.task_space import POSE, POSITION
from ..log.log_reader import Log
from ..log.orientations import compute_continuous_vectors
from ..scenario import Scenario
from .aligned import AlignedRecords, align_records
from .arm_rows import build_arm_rows
from .dominance_history import DominanceHistory, trace_dominance
from .following import JointFollowing, build_following
from .link_summary import LinkSummary, summarise_links
from .torque_sources import TorqueSplit, attribute_torque, list_walls

T = TypeVar("T")


class SiteRun(NamedTuple):
    """A site with records: these aligned, the torque ON its arm by source, and its dominance
    factors.
    """

    records: AlignedRecords
    torque: TorqueSplit
    dominance: DominanceHistory


class RunView:
    """A run as metrics see it.

    Attributes:
        log: its log.
        scenario: its scenario.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self.scenario = log.scenario
        self._made: dict[Callable[[RunView], Any], Any] = {}

    def compute_once(self, make: Callable[["RunView"], T]) -> T:
        """Returns what a function makes of this view, made when it is first asked for."""
        if make not in self._made:
            self._made[make] = make(self)
        return cast(T, self._made[make])

    @cached_property
    def sites(self) -> dict[str, SiteRun]:
        """The sites with records."""
        return {
            site: SiteRun(
                own,
                attribute_torque(own, self.scenario),
                trace_dominance(self.log, site, own.t_s),
            )
            for site, own in align_records(self.log).items()
        }

    @cached_property
    def shared(self) -> dict[str, SiteRun]:
        """The same as what sites share: in task space places for angles, and forces for
        torques.
        """
        return {site: _view_shared(self.scenario, run) for site, run in self.sites.items()}

    @cached_property
    def absent(self) -> list[str]:
        """The sites without records."""
        return [site for site in self.log.sites if site not in self.sites]

    @cached_property
    def links(self) -> dict[str, LinkSummary]:
        """The links "j->i"."""
        return {use.name: use for use in summarise_links(self.log)}

    @cached_property
    def walls(self) -> dict[str, tuple[str, TorqueSource]]:
        """The walls "s/1" (the first of s), each with its site."""
        return {
            f"{site}/{n}": (site, wall)
            for site in self.log.sites
            for n, wall in enumerate(list_walls(self.scenario.sites[site]), 1)
        }

    def places(self, of: str) -> Iterable[str]:
        """Returns the names of the places of a kind: "run" (one, by ""), "site", "link" or
        "wall".
        """
        return {"run": [""], "site": self.log.sites, "link": self.links, "wall": self.walls}[of]


def _view_shared(scenario: Scenario, run: SiteRun) -> SiteRun:
    """Returns a site's run as what sites share.

    What an operator was to do is turned into forces in the first pose, so that what stands
    still does.
    """
    records, torque, dominance = run
    arm = build_arm_rows(scenario, records.site)
    follows = build_following(arm, records.q, records.qd, np.array(records.axes))
    if isinstance(follows, JointFollowing):
        return run
    axes = np.array(records.axes)
    script = torque.script
    forces = torque._replace(
        operator_now=follows.project_torque(torque.operator_now),
        operator_held=follows.project_torque(torque.operator_held),
        environment_now=follows.project_torque(torque.environment_now),
        environment_held=follows.project_torque(torque.environment_held),
    )
    if script is not None:
        script = script @ (follows.inverse[0] @ follows.J[0]).T
    x = records.x
    if x.shape[1] == POSE:  # metrics compare poses of different times
        x = np.hstack([x[:, :POSITION], compute_continuous_vectors(x[:, POSITION:])])
    places = records._replace(q=axes * x, qd=axes * records.xd, tau_x=axes * records.wrench)
    return SiteRun(places, forces._replace(script=script), dominance)
