"""Provides the data of a recorded run from which all metrics are computed.

Many metrics need the same data, for example the torques of operators on an arm, which take time
to compute. `RunView` computes shared data when a metric first needs them and caches them for
the other metrics. `SiteRun` contains the data of one arm: its records and the torques on it.
`RunView` adds the dominance factors, the network links and the virtual walls.

Invariant:
    - Each quantity is computed from the log only once, by `RunView.compute_once` or a cached
      property.
"""

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from ..core import POSE, POSITION
from ..log import Log, RotationVectors
from ..scenario import Scenario
from .aligned import AlignedRecords
from .arm_rows import build_arm_rows
from .dominance_history import DominanceHistory
from .following import JointFollowing, build_following
from .link_summary import LinkSummary
from .torque_sources import TorqueSplit, VirtualWall

T = TypeVar("T")


class SiteRun(NamedTuple):
    """Motion of one arm in a recorded run, the torques on it, and how it follows other arms.

    Attributes:
        records: Records of the site, with one row per tick.
        torque: External torque on the site's arm, divided into operator and environment.
        dominance: Dominance factors of the site over time.
    """

    records: AlignedRecords
    torque: TorqueSplit
    dominance: DominanceHistory


class RunView:
    """A recorded run, with cached quantities that several metrics share.

    Every metric receives this object and reads arms, network links and walls from it.

    Args:
        log: The log of the run.

    Attributes:
        log: The log of the run.
        scenario: The scenario of the run.
    """

    def __init__(self, log: Log) -> None:
        self.log = log
        self.scenario = log.scenario
        self._results: dict[Callable[[RunView], Any], Any] = {}

    def compute_once(self, compute: Callable[["RunView"], T]) -> T:
        """Applies a function to this run, and caches the result.

        Later calls with the same function return the cached result, which lets several metrics
        share intermediate results.

        Args:
            compute: The function.
        """
        if compute not in self._results:
            self._results[compute] = compute(self)
        return cast(T, self._results[compute])

    @cached_property
    def sites(self) -> dict[str, SiteRun]:
        """Motion and torques of every arm with records, keyed by site name.

        For arms without records, metrics contain a reason in place of a value.
        """
        runs = {}
        for site, records in AlignedRecords.by_site(self.log).items():
            runs[site] = SiteRun(
                records=records,
                torque=TorqueSplit.with_script(records, self.scenario),
                dominance=DominanceHistory.of_log(self.log, site, records.t_s),
            )
        return runs

    @cached_property
    def shared(self) -> dict[str, SiteRun]:
        """Motion and torques of each site in the coordinates that sites exchange, by site name.

        Sites exchange either joint angles or poses of their end effectors. In the latter case
        the result contains poses in place of angles, and forces in place of torques. Sites
        without records are missing.
        """
        shared = {}
        for site, run in self.sites.items():
            shared[site] = _view_shared(self.scenario, run)
        return shared

    @cached_property
    def absent(self) -> list[str]:
        """Names of the arms without any record, as can occur in the log of a failed session."""
        return [site for site in self.log.sites if site not in self.sites]

    @cached_property
    def links(self) -> dict[str, LinkSummary]:
        """Summaries of network links (delays, losses, clocks), keyed by link name.

        The name "m1->s" denotes the link from arm m1 to arm s. The summaries are computed when
        first used.
        """
        return {link.name: link for link in LinkSummary.list_of_log(self.log)}

    @cached_property
    def walls(self) -> dict[str, tuple[str, VirtualWall]]:
        """All virtual walls, keyed by name, each with the arm that can touch it.

        The name "s/1" denotes the first wall of arm s. The walls of an arm are numbered from 1.
        """
        walls = {}
        for site in self.log.sites:
            for number, wall in enumerate(VirtualWall.list_of_site(self.scenario, site), 1):
                walls[f"{site}/{number}"] = (site, wall)
        return walls

    def list_subjects(self, kind: str) -> Iterable[str]:
        """Lists the names of all arms, network links or walls for which a metric is computed.

        Args:
            kind: "site", "link", "wall", or "run". For "run", the list contains a single empty
                name.
        """
        if kind == "run":
            return [""]
        subjects: dict[str, Iterable[str]] = {
            "site": self.log.sites,
            "link": self.links,
            "wall": self.walls,
        }
        return subjects[kind]


def _view_shared(scenario: Scenario, site_run: SiteRun) -> SiteRun:
    """Returns a site's motion and torques in the coordinates that sites exchange.

    For sites that exchange poses of their end effectors, joint torques become forces. The plan
    of an operator is converted with the Jacobian of the first pose, so that a constant plan
    stays constant.
    """
    records = site_run.records
    torque = site_run.torque
    arm = build_arm_rows(scenario, records.site)
    axes = np.array(records.axes)
    following = build_following(arm, records.q, records.qd, axes)
    if isinstance(following, JointFollowing):
        return site_run

    plan = torque.script
    if plan is not None:
        force_by_torque = following.inverse[0] @ following.J[0]
        plan = plan @ force_by_torque.T

    forces = torque._replace(
        operator_now=following.project_torque(torque.operator_now),
        operator_held=following.project_torque(torque.operator_held),
        environment_now=following.project_torque(torque.environment_now),
        environment_held=following.project_torque(torque.environment_held),
        script=plan,
    )

    x = records.x
    if x.shape[1] == POSE:
        # metrics compare poses of different times, so rotation vectors must not change branch
        position = x[:, :POSITION]
        rotation_vectors = RotationVectors(x[:, POSITION:]).without_jumps()
        x = np.hstack([position, rotation_vectors])

    shared_records = records._replace(
        q=axes * x,
        qd=axes * records.xd,
        tau_x=axes * records.wrench,
    )
    return SiteRun(shared_records, forces, site_run.dominance)
