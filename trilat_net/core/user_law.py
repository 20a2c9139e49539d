"""A user's control law, in plain Python.

Invariant: it is part of the site's step, a function of its input and its memory; the memory is in the
record of every tick, so a log resumes in the middle of a run.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from ..errors import LawFailed
from .vectors import Vector

MAX_LAW_MEMORY = 1024
"""Most numbers of a law's memory, which is in the record of every tick."""


class LawContext(NamedTuple):
    """The knowledge of a law before it begins.

    Attributes:
        site: the site's name.
        rate_hz: its tick rate, Hz.
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        theta: the arm's true parameters, shape (5,), for a law that claims to know them; () if they are
            unknown, as of a real arm that was not identified.
        tau_limit_nm: largest torque of a joint, N m; one number, or one per joint.
    """

    site: str
    rate_hz: int
    g_m_s2: float
    lengths_m: tuple[float, float]
    theta: tuple[float, ...]
    tau_limit_nm: Vector


class LawInput(NamedTuple):
    """The input of a law at a tick; every vector has one number per joint.

    Attributes:
        k: the tick.
        t_s: nominal time since the epoch, s.
        h_s: the period, s.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference of Eq. (6), rad.
        qd_des: its derivative, rad/s.
        felt: the torque on the peers' arms as received, weighted by dominance, N m.
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
    """A control law; its class is called with `LawContext` and the keys of its `[control]` table, by name.

    It may have an attribute `theta_hat`, five numbers, which is recorded.
    """

    def torque(self, now: LawInput) -> Sequence[float]:
        """Returns the torque of each joint, N m; more than the limit is cut off."""

    def memory(self) -> Sequence[float]:
        """Returns all that `torque` needs of the ticks so far, as numbers."""

    def recall(self, memory: Sequence[float]) -> None:
        """Restores the state in which `memory` returned these numbers."""


UserLawFactory = Callable[[LawContext], UserLaw]


def call_law(
    law: UserLaw, site: str, now: LawInput, joints: int, parameters: int
) -> tuple[list[float], list[float], list[float]]:
    """Returns torque, estimate and memory of a law at a tick, of an arm with so many joints and parameters.

    Raises:
        LawFailed: it raised, or its results are not finite numbers of the right count.
    """
    try:
        torque = [float(value) for value in law.torque(now)]
        estimate = [float(value) for value in getattr(law, "theta_hat", (0.0,) * parameters)]
        memory = [float(value) for value in law.memory()]
    except LawFailed:  # its watchdog has stopped it
        raise
    except (Exception, SystemExit) as error:
        raise _law_error(law, site, now.k, _one_line(error)) from error
    for name, values, length in (("torque", torque, joints), ("theta_hat", estimate, parameters)):
        if len(values) != length:
            raise _law_error(law, site, now.k, f"{name} has {len(values)} numbers, not {length}")
    if len(memory) > MAX_LAW_MEMORY:
        problem = f"memory has {len(memory)} numbers, at most {MAX_LAW_MEMORY} are kept"
        raise _law_error(law, site, now.k, problem)
    for name, values in (("torque", torque), ("theta_hat", estimate), ("memory", memory)):
        if not all(map(math.isfinite, values)):
            first = next(n for n, value in enumerate(values) if not math.isfinite(value))
            raise _law_error(law, site, now.k, f"{name}[{first}] is {values[first]}, no finite number")
    return torque, estimate, memory


def restore_law(law: UserLaw, site: str, memory: Sequence[float]) -> None:
    """Restores a law from the memory in a record.

    Raises:
        LawFailed: it raised.
    """
    try:
        law.recall(memory)
    except (Exception, SystemExit) as error:
        raise _law_error(law, site, None, _one_line(error)) from error


def law_name(law: UserLaw) -> str:
    """Returns the name of a law as in a scenario."""
    return f"{type(law).__module__}:{type(law).__qualname__}"


def _law_error(law: UserLaw, site: str, tick: int | None, problem: str) -> LawFailed:
    return LawFailed(problem, site=site, law=law_name(law), tick=tick)


def _one_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
