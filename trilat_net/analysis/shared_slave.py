"""Finds the users who control a slave arm together, and the arms moved by a program.

Each user moves the arm of a master, and the slave follows the masters according to its
dominance factors. In some experiments a program moves the arm of one user.

Invariant:
    - A program is a hand of kind "own", or a policy whose takeover of an arm is reported by the
      events of the log.
"""

from typing import NamedTuple

import numpy as np

from ..core import TAKEN, Array
from ..errors import UsageError
from ..log import Ints, Log
from ..scenario import POLICY


class UserShares(NamedTuple):
    """How much of a slave's motion each of its users determines, at K times.

    The slave follows the master of each user with a dominance factor. For example, with shares
    of 0.7 and 0.3 the first user leads. In some experiments a program moves the arm of one
    user. If another user leads, this counts as an intervention by a person.

    Attributes:
        shares: The slave's dominance factors for its U users, shape (K, U).
        leader: Index of the user with the largest factor, shape (K,). If the program's user
            shares the largest factor with another user, this is the index of the program's
            user.
        program: Index of the user whose arm the program moves.
    """

    shares: Array
    leader: Ints
    program: int


class SharedSlave:
    """The slave arm that several users of a run control together, and the users' masters.

    Args:
        log: Log of the run.

    Attributes:
        name: Name of the first slave. Empty if there is none.
        users: Names of all masters, each of which represents its user.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        roles = {site: spec.role for site, spec in log.scenario.sites.items()}
        slaves = [site for site, role in roles.items() if role == "slave"]
        self.name = slaves[0] if slaves else ""
        self.users = [site for site, role in roles.items() if role == "master"]

    @property
    def program(self) -> str:
        """The user whose arm was moved by a program. Empty if no program moved an arm.

        This is the last user who has a hand of kind "own" in the scenario, or otherwise the
        last user whose arm was moved by a policy, through the LeRobot plugin or in an
        environment.
        """
        log = self._log
        held_by_policy = [user for user in self.users if _is_held_by_policy(log, user)]
        moved_by_program = [
            user for user in self.users if log.scenario.sites[user].has_program_hand
        ]
        # the last candidate wins, and without any the name is empty
        candidates = ["", *held_by_policy, *moved_by_program]
        return candidates[-1]

    def find_shares(self, alpha: Array, program: str = "") -> UserShares:
        """Returns the dominance factors with which the slave follows each user over time.

        Args:
            alpha: Dominance factors of the slave for its P peers, at K times, shape (K, P).
            program: Name of the user whose arm a program moves. Empty for the last user.

        Returns:
            The factors, and the user with the largest factor at each time.

        Raises:
            UsageError: There is no user with this name.
        """
        users = self.users
        program = program or users[-1]
        if program not in users:
            possible_users = " or ".join(users)
            raise UsageError(
                f"the program can hold the arm of {possible_users}, not of {program!r}"
            )

        peers = self._log.scenario.peers(self.name)
        columns = [peers.index(user) for user in users]
        shares = alpha[:, columns]

        program_index = users.index(program)
        program_share = shares[:, program_index]
        program_leads = program_share >= shares.max(axis=1)
        largest = shares.argmax(axis=1)
        leader = np.where(program_leads, program_index, largest)
        return UserShares(shares, leader, program_index)


def list_program_sites(log: Log) -> list[str]:
    """Lists the sites whose arms were moved by a program in a run, in scenario order.

    The program is a hand of kind "own" in the scenario, or a policy that moved the arm through
    the LeRobot plugin or in an environment. Unlike a script, the program reacts to the motion
    of the arms.

    Args:
        log: Log of the run.
    """
    return [
        site
        for site in log.scenario.sites
        if log.scenario.sites[site].has_program_hand or _is_held_by_policy(log, site)
    ]


def _is_held_by_policy(log: Log, site: str) -> bool:
    """Returns True if the events of a log say that a policy took hold of the arm of a site."""
    text_start = f"{site}: {POLICY} {TAKEN} "
    for event in log.events:
        if event.kind == "hand" and event.text.startswith(text_start):
            return True
    return False
