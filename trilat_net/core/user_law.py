"""A user's control law, in plain Python.

Invariant: it is part of the site's step, a function of its input and its memory; the memory is in the
record of every tick, so a log resumes in the middle of a run.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from ..errors import LawFailed
from .two_link_arm import JOINTS, PARAMETERS

MAX_LAW_MEMORY = 1024
"""Most numbers that a law remembers: they are in the record of every tick."""


class LawContext(NamedTuple):
    """What a law may know before it begins.

    Attributes:
        site: the site's name.
        rate_hz: its tick rate, Hz.
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        theta: the arm's true parameters, shape (5,); whether a law knows them is its author's claim. ()
            where nobody does, as of a real arm that was not identified.
        tau_limit_nm: largest torque of a joint, N m.
    """

    site: str
    rate_hz: int
    g_m_s2: float
    lengths_m: tuple[float, float]
    theta: tuple[float, ...]
    tau_limit_nm: float


class LawInput(NamedTuple):
    """What a law is told at a tick; every vector has one number per joint.

    Attributes:
        k: the tick.
        t_s: nominal time since the epoch, s.
        h_s: the period, s.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference of Eq. (6), rad.
        qd_des: its derivative, rad/s.
        felt: the torque on the peers' arms as it came, weighted by dominance, N m.
    """

    k: int
    t_s: float
    h_s: float
    q: list[float]
    qd: list[float]
    q_des: list[float]
    qd_des: list[float]
    felt: list[float]


class UserLaw(Protocol):
    """What a law must do; called with `Facts` and the keys of its `[control]` table, by name, to make one.

    It may have an attribute `theta_hat`, five numbers, which is recorded.
    """

    def torque(self, now: LawInput) -> Sequence[float]:
        """Returns the torque of each joint, N m; more than the limit is cut off."""

    def memory(self) -> Sequence[float]:
        """Returns all that `torque` will need of the ticks so far, as numbers."""

    def recall(self, memory: Sequence[float]) -> None:
        """Puts the law where `memory` said that it was."""


UserLawFactory = Callable[[LawContext], UserLaw]


def call_law(law: UserLaw, site: str, now: LawInput) -> tuple[list[float], list[float], list[float]]:
    """Returns torque, estimate and memory of a law at a tick.

    Raises:
        LawFailed: it raised, or returned what is none.
    """
    try:
        torque = [float(value) for value in law.torque(now)]
        estimate = [float(value) for value in getattr(law, "theta_hat", (0.0,) * PARAMETERS)]
        memory = [float(value) for value in law.memory()]
    except LawFailed:  # whoever watches it has stopped it
        raise
    except (Exception, SystemExit) as error:  # what somebody's code does is told in a sentence
        raise _failed(law, site, now.k, _told(error)) from error
    for name, values, length in (("torque", torque, JOINTS), ("theta_hat", estimate, PARAMETERS)):
        if len(values) != length:
            raise _failed(law, site, now.k, f"{name} has {len(values)} numbers, not {length}")
    if len(memory) > MAX_LAW_MEMORY:
        problem = f"memory has {len(memory)} numbers, at most {MAX_LAW_MEMORY} are kept"
        raise _failed(law, site, now.k, problem)
    for name, values in (("torque", torque), ("theta_hat", estimate), ("memory", memory)):
        if not all(map(math.isfinite, values)):
            first = next(n for n, value in enumerate(values) if not math.isfinite(value))
            raise _failed(law, site, now.k, f"{name}[{first}] is {values[first]}, no finite number")
    return torque, estimate, memory


def restore_law(law: UserLaw, site: str, memory: Sequence[float]) -> None:
    """Puts a law where a record says that it was.

    Raises:
        LawFailed: it raised.
    """
    try:
        law.recall(memory)
    except (Exception, SystemExit) as error:  # as above
        raise _failed(law, site, None, _told(error)) from error


def law_name(law: UserLaw) -> str:
    """Returns where a law is from, as a scenario names it."""
    return f"{type(law).__module__}:{type(law).__qualname__}"


def _failed(law: UserLaw, site: str, tick: int | None, problem: str) -> LawFailed:
    return LawFailed(problem, site=site, law=law_name(law), tick=tick)


def _told(error: BaseException) -> str:
    """Returns an error of somebody's code in one line."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
