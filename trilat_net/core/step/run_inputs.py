"""Stores the external inputs of a simulated run: arrivals, changes and operators' actions.

A run that repeats a log is fed the recorded inputs. The only inputs of a new run are the
actions of programs that move an arm.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from .fused_run import ReplayedInputs
from .site_setup import SiteSetup
from .ticks import CoreChange
from .vectors import Array

_TARGET_COLUMN = 3
"""First column of the target in an action, after grip, number and source."""


class RunInputs(NamedTuple):
    """All external inputs of a recorded run, from which the run can be repeated.

    Attributes:
        feed: Actions of live operators, and the ticks in which samples from other sites
            arrived.
        changes: Changes to links or sites during the run, in chronological order. Each entry
            contains the tick before which the site applies the change, the index of the site,
            and the change.
        late_ns: Longest time from the time stamp of a sample to its arrival, in ns, which
            determines how long samples must be stored.
    """

    feed: ReplayedInputs
    changes: Sequence[tuple[int, int, CoreChange]] = ()
    late_ns: int = 0

    @classmethod
    def prompt(cls, sites: int) -> "RunInputs":
        """Returns the inputs of a run without external influences.

        In such a run, every sample arrives in the first tick after it was sent, no setting is
        changed, and no live operator moves an arm. Link delays from the setup still apply,
        because they are simulated by the receivers.

        Args:
            sites: Number of sites.
        """
        most_peers = max(sites - 1, 1)
        # To the compiled loop, arrays for 0 ticks mean that nothing was recorded, see
        # `ReplayedInputs`.
        feed = ReplayedInputs(
            first=np.zeros((sites, most_peers, 0), np.int64),
            samples=np.zeros(0, np.int64),
            hands=np.zeros((sites, 0, 1)),
            hand_indices=np.full(sites, -1),  # -1: the site has no live operator
        )
        return cls(feed)

    def with_hands(
        self, setups: Sequence[SiteSetup], sites: Collection[int], ticks: int
    ) -> "RunInputs":
        """Returns these inputs with memory allocated for the actions of live operators.

        Args:
            setups: Setups of all sites.
            sites: Indices of the sites with a live operator.
            ticks: Number of ticks to allocate memory for.
        """
        if not sites:
            return self
        hand_indices = np.full(len(setups), -1)  # -1: the site has no live operator
        for i in sites:
            hand_indices[i] = setups[i].live_actor
        most_coordinates = max(_count_coordinates(setups[i].layout.hand) for i in sites)
        # Columns: grip, target, and target one second later, see `write_actions`.
        actions = np.zeros((len(setups), ticks, 1 + 2 * most_coordinates))
        feed = self.feed._replace(hands=actions, hand_indices=hand_indices)
        return self._replace(feed=feed)

    def with_ticks(self, ticks: int) -> "RunInputs":
        """Returns these inputs with more memory for the actions of live operators.

        Args:
            ticks: Number of ticks to allocate memory for, not less than before.
        """
        sites, old_ticks, columns = self.feed.hands.shape
        actions = np.zeros((sites, ticks, columns))
        actions[:, :old_ticks] = self.feed.hands
        return self._replace(feed=self.feed._replace(hands=actions))

    def write_actions(self, i: int, first_tick: int, actions: Array) -> None:
        """Stores the actions of an operator in the form that the compiled loop reads.

        A live operator prescribes m target coordinates. The columns of the two forms are:

        - Action of the operator (`HandInForce`): grip firmness; number of the operator's
          message; source of the message; target (m columns); velocity of the target (m
          columns).
        - Action in the feed (`ReplayedInputs.hands`): grip firmness; target (M columns); target
          extrapolated by one second, i.e. the sum of target and velocity (M columns). M is the
          largest m of all sites. If m is smaller than M, the remaining columns stay zero.

        Args:
            i: Index of the site.
            first_tick: Tick of the first action.
            actions: Actions of the operator, one row per tick, shape (ticks, 3 + 2 m).
        """
        coordinates = _count_coordinates(actions.shape[1])
        most_coordinates = (self.feed.hands.shape[2] - 1) // 2
        grip = actions[:, 0]
        target = actions[:, _TARGET_COLUMN : _TARGET_COLUMN + coordinates]
        velocity = actions[:, _TARGET_COLUMN + coordinates :]

        rows = self.feed.hands[i, first_tick : first_tick + len(actions)]
        rows[:, 0] = grip
        rows[:, 1 : 1 + coordinates] = target
        second_part = 1 + most_coordinates
        rows[:, second_part : second_part + coordinates] = target + velocity


def _count_coordinates(numbers: int) -> int:
    """Returns the number of coordinates that a person or program commands to move an arm.

    Args:
        numbers: Length of an action: grip, number and source, followed by the target and the
            velocity of each coordinate, see `HandInForce`.
    """
    return (numbers - _TARGET_COLUMN) // 2
