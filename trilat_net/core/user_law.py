"""A user's control law, in plain Python.

Invariant: it is part of the site's step, a function of its input and its memory; the memory is
in the record of every tick, so a log resumes in the middle of a run.
"""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..errors import LawFailed, count_nouns
from .vectors import Vector

MAX_LAW_MEMORY = 1024
"""Most numbers of a law's memory, which is in the record of every tick."""


class LawContext(NamedTuple):
    """The knowledge of a law before it begins.

    >>> class Damper:
    ...     def __init__(self, facts: tn.LawContext, d: float = 2.0) -> None:
    ...         self.d = [d] * facts.joints

    Attributes:
        site: the site's name.
        rate_hz: its tick rate, Hz.
        g_m_s2: gravitational acceleration, m/s^2.
        lengths_m: of the two links.
        theta: the arm's true parameters, shape (5,), for a law that claims to know them; () if
            they are unknown, as of a real arm that was not identified.
        tau_limit_nm: largest torque of a joint, N m; one number, or one per joint.
        joints: how many joints the arm has.
        coordinates: how many numbers q, qd and tau_x of a peer have: one per joint, or one per
            coordinate of the end effector.
        peers: names of the peers, in scenario order.
    """

    site: str
    rate_hz: int
    g_m_s2: float
    lengths_m: tuple[float, float]
    theta: tuple[float, ...]
    tau_limit_nm: Vector
    joints: int = 2
    coordinates: int = 2
    peers: tuple[str, ...] = ()


def _by_number(operate: Callable[[Any, Any], Any]) -> Any:
    def compute(numbers: "LawVector", other: Any) -> Any:
        if isinstance(other, Real):
            return LawVector([operate(one, other) for one in numbers])
        if not isinstance(other, list | tuple):
            return NotImplemented  # an array's own arithmetic, and its array
        if len(other) != len(numbers):
            raise ValueError(
                f"arithmetic of {count_nouns(len(numbers), 'number')} with {len(other)}"
            )
        return LawVector(map(operate, numbers, other))

    return compute


class LawVector(list[Any]):
    """Numbers with arithmetic one by one: `-5.0 * (now.q - now.q_des) - 2.0 * now.qd`."""

    __add__ = __radd__ = __iadd__ = _by_number(operator.add)
    __sub__ = _by_number(operator.sub)
    __rsub__ = _by_number(lambda own, first: first - own)
    __mul__ = __rmul__ = __imul__ = _by_number(operator.mul)
    __truediv__ = _by_number(operator.truediv)

    def __neg__(self) -> "LawVector":
        return LawVector(map(operator.neg, self))


class PeerView(NamedTuple):
    """A peer as a law sees it at a tick: its sample in use, or its start pose at rest.

    Attributes:
        alpha: its dominance factor now.
        tick: the stamp of the sample in use, a tick of the peer; -1 before the first.
        age_s: the age of that sample, s; before the first, the time since the epoch.
        new: 1 if it came into use at this tick, else 0.
        q: of the sample, rad or m.
        qd: its derivative.
        tau_x: the exogenous torque of the peer, N m or N; the torque ON its arm is the
            negative.
    """

    alpha: float
    tick: int
    age_s: float
    new: int
    q: LawVector
    qd: LawVector
    tau_x: LawVector


class LawInput(NamedTuple):
    """The input of a law at a tick; a vector has one number per joint, or per coordinate that
    sites share.

    >>> def torque(self, now: tn.LawInput) -> list[float]:
    ...     return [-d * speed for d, speed in zip(self.d, now.qd)]

    In plain Python vectors are `LawVector`, with arithmetic; compiled, their numbers are taken
    one by one.

    Attributes:
        k: the tick.
        t_s: nominal time since the epoch, s.
        h_s: the period, s.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        q_des: reference of Eq. (6), rad.
        qd_des: its derivative, rad/s.
        felt: the torque on the peers' arms as received, weighted by dominance, N m.
        joints: how many there are.
        coordinates: how many numbers the vectors of a peer have.
        tau: the torque of each joint, N m, for the law to write; more than the limit is cut
            off.
        peers: the peers in scenario order.
        received: per peer the vectors that its law sent with the sample in use, by their names;
            zeros before the first, and of a peer whose law sends no such vector.
        sent: per peer the vectors that go to it alone, for the law to write; unwritten, they
            stay.
        to_all: the vectors that go to all peers, likewise.
        tau_x: exogenous torque of this tick, N m; the torque ON the arm is its negative.
        tau_before: torque of the tick before, within its limits, N m; zeros at tick 0.
        q_before: joint angles of the tick before, rad; the start pose at tick 0.
        gravity: the torque that holds the arm, N m; zeros where its parameters are unknown.
        theta_hat: the estimate in the record, for the law to write; unwritten, it stays as it
            was.
        inertia: M(q), a row per joint, for a law that `needs_model`; else zeros.
        bias: C qd + G (of a chain with friction, less the torque of its stops), N m, likewise.
    """

    k: int
    t_s: float
    h_s: float
    q: LawVector
    qd: LawVector
    q_des: LawVector
    qd_des: LawVector
    felt: LawVector
    joints: int = 2
    coordinates: int = 2
    tau: Any = ()
    peers: Sequence[PeerView] = ()
    received: Sequence[Any] = ()
    sent: Sequence[Any] = ()
    to_all: Any = None
    tau_x: LawVector = LawVector()
    tau_before: LawVector = LawVector()
    q_before: LawVector = LawVector()
    gravity: LawVector = LawVector()
    theta_hat: Any = ()
    inertia: LawVector = LawVector()
    bias: LawVector = LawVector()


class UserLaw(Protocol):
    """A control law; its class is called with `LawContext` and the keys of its `[control]`
    table, by name.

    All that `torque` needs of the ticks so far is its memory: the attributes that its class
    names in `remembers`, or what a method `memory()` returns as numbers, from which
    `recall(memory)` restores it. It may have an attribute `theta_hat`, a number per parameter,
    which is recorded. One whose torque is right while the reference is held, because it follows
    that and nothing else of its peers, has `holds = True`.
    """

    def torque(self, now: LawInput) -> Sequence[float] | None:
        """Returns the torque of each joint, N m, or writes `now.tau`; more than the limit is
        cut off.
        """


UserLawFactory = Callable[[LawContext], UserLaw]


def call_law(
    law: UserLaw, site: str, now: LawInput, collect_sent: Callable[[LawInput], list[float]]
) -> "LawResults":
    """Returns the results of a law at a tick; `collect_sent` returns what it sends.

    Raises:
        LawFailed: it raised, or its results are not finite numbers of the right count.
    """
    try:
        returned = law.torque(now)
        if returned is None and all(map(math.isnan, now.tau)):
            raise TypeError("torque returned None and did not write now.tau")
        torque = [float(value) for value in (now.tau if returned is None else returned)]
        estimate = [float(value) for value in getattr(law, "theta_hat", now.theta_hat)]
        results = LawResults(torque, estimate, read_memory(law), collect_sent(now))
    except LawFailed:  # its watchdog has stopped it
        raise
    except (Exception, SystemExit) as error:
        raise describe_failure(law, site, now.k, error) from error
    parameters = len(now.theta_hat)
    for name, values, length in (
        ("torque", torque, now.joints),
        ("theta_hat", estimate, parameters),
    ):
        if len(values) != length:
            raise _law_error(
                law,
                site,
                now.k,
                f"{name} has {count_nouns(len(values), 'number')}, not {length}",
            )
    check_results(law, site, now.k, results)
    return results


class LawResults(NamedTuple):
    """What a law gives at a tick: its torque, estimate and memory, and all that it sends."""

    torque: list[float]
    theta_hat: list[float]
    memory: list[float]
    sent: list[float]


def check_results(law: UserLaw, site: str, tick: int, results: LawResults) -> None:
    """Refuses numbers that are not finite, and a memory that is too large.

    Raises:
        LawFailed: with the first of them.
    """
    if (count := len(results.memory)) > MAX_LAW_MEMORY:
        problem = (
            f"memory has {count_nouns(count, 'number')}, at most {MAX_LAW_MEMORY} are kept"
        )
        raise _law_error(law, site, tick, problem)
    for name, values in zip(results._fields, results, strict=True):
        if not all(map(math.isfinite, values)):
            first = next(n for n, value in enumerate(values) if not math.isfinite(value))
            raise _law_error(
                law, site, tick, f"{name}[{first}] is {values[first]}, no finite number"
            )


def describe_failure(
    law: UserLaw, site: str, tick: int | None, error: BaseException
) -> LawFailed:
    """Returns the failure of a law that raised."""
    problem = _one_line(error)
    hint = "; for more than + - * / make it an array, as in numpy.asarray(now.q)"
    return _law_error(law, site, tick, problem + (hint if "LawVector" in problem else ""))


def _flatten(value: Any) -> Iterator[float]:
    if isinstance(value, Real):
        yield float(value)
        return
    for one in value:
        yield from _flatten(one)


def _fill(value: Any, numbers: Iterator[float]) -> Any:
    """Returns a value of the same form as another, of the next numbers."""
    if isinstance(value, bool):
        return bool(next(numbers))
    if isinstance(value, Real):
        number = next(numbers)
        return int(number) if isinstance(value, int) and number.is_integer() else number
    if isinstance(value, np.ndarray):
        return np.array([next(numbers) for _ in range(value.size)], value.dtype).reshape(
            value.shape
        )
    return type(value)(_fill(one, numbers) for one in value)


def list_remembered(law: Any) -> tuple[str, ...]:
    """Returns the names of the attributes that a law remembers; none of one without memory."""
    return tuple(getattr(law, "remembers", ()))


def read_memory(law: Any) -> list[float]:
    """Returns the memory of a law: of the attributes that it remembers, or what it says itself."""
    if callable(getattr(law, "memory", None)):
        return [float(value) for value in law.memory()]
    return [number for name in list_remembered(law) for number in _flatten(getattr(law, name))]


def write_memory(law: Any, memory: Sequence[float]) -> None:
    """Restores a law from its memory."""
    if callable(getattr(law, "recall", None)):
        law.recall(memory)
        return
    numbers = iter(memory)
    for name in list_remembered(law):
        setattr(law, name, _fill(getattr(law, name), numbers))


def restore_law(law: UserLaw, site: str, memory: Sequence[float]) -> None:
    """Restores a law from the memory in a record.

    Raises:
        LawFailed: it raised.
    """
    try:
        write_memory(law, memory)
    except (Exception, SystemExit) as error:
        raise describe_failure(law, site, None, error) from error


def law_name(law: UserLaw) -> str:
    """Returns the name of a law as in a scenario."""
    return f"{type(law).__module__}:{type(law).__qualname__}"


def _law_error(law: UserLaw, site: str, tick: int | None, problem: str) -> LawFailed:
    return LawFailed(problem, site=site, code=law_name(law), tick=tick)


def _one_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
