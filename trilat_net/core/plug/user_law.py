"""Calls a user's control law in plain Python, once per period of the control loop.

A control law is a class with a method `torque`, which computes the torque of an arm from a
`LawInput`: the motion of the arm and of the other arms. From period to period a law may keep
numbers, its memory, for example an integral of the error.

Invariant:
    - A law is a function of its input and its memory: equal inputs and an equal memory give
      equal torques.
    - The record of each period contains the memory. A run can therefore be resumed from the
      middle of its log.
"""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...errors import LawFailed, count_nouns, describe_exception
from ...records import MAX_LAW_MEMORY as MAX_LAW_MEMORY
from ..step.vectors import Vector


class LawContext(NamedTuple):
    """Facts about the arm and the other arms that a control law receives when it is created.

    >>> class Damper:
    ...     def __init__(self, facts: tn.LawContext, d: float = 2.0) -> None:
    ...         self.d = [d] * facts.joints

    Attributes:
        site: Name of the site, the process that runs one arm.
        rate_hz: Tick rate of the site, Hz.
        g_m_s2: Gravitational acceleration, m/s^2.
        lengths_m: Lengths of the two links, m.
        theta: The arm's true parameters, shape (5,), for a law that knows them; () if they are
            unknown, as for a real arm that was not identified.
        tau_limit_nm: Largest torque of a joint, N m; one number, or one per joint.
        joints: Number of joints of the arm.
        coordinates: Number of values in q, qd and tau_x of a peer: one per joint, or one per
            coordinate of the end effector.
        peers: Names of the peers, in scenario order.
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


def _make_operator(operate: Callable[[Any, Any], Any]) -> Any:
    """Creates an arithmetic method of `LawVector`, such as `__add__`, from an operation.

    The method works number by number. Its arguments are the vector and the other operand.

    Args:
        operate: The operation on two numbers, for example `operator.add`.
    """

    def compute(vector: "LawVector", other: Any) -> Any:
        """Applies an operation, such as addition, to two vectors or to a vector and a number.

        Args:
            vector: The first vector.
            other: A vector with as many numbers, or a single number.

        Returns:
            The resulting vector. NotImplemented if `other` is of another type.
        """
        if isinstance(other, Real):
            return LawVector([operate(number, other) for number in vector])
        if not isinstance(other, list | tuple):
            # Python then asks `other`: a NumPy array computes the result itself, as an array.
            return NotImplemented
        if len(other) != len(vector):
            count = count_nouns(len(vector), "number")
            raise ValueError(
                f"cannot combine a vector of {count} with a vector of {len(other)}"
            )
        return LawVector(map(operate, vector, other))

    return compute


class LawVector(list[Any]):
    """List of numbers with arithmetic, so that users can write control laws as formulas.

    Operations act number by number, as in `-5.0 * (now.q - now.q_des) - 2.0 * now.qd`. The
    other operand is a number, or a list with as many numbers.
    """

    __add__ = __radd__ = __iadd__ = _make_operator(operator.add)
    __sub__ = _make_operator(operator.sub)
    __rsub__ = _make_operator(lambda right, left: left - right)
    __mul__ = __rmul__ = __imul__ = _make_operator(operator.mul)
    __truediv__ = _make_operator(operator.truediv)

    def __neg__(self) -> "LawVector":
        return LawVector(map(operator.neg, self))


class PeerView(NamedTuple):
    """Information that a control law has about another arm (a peer) in a control period.

    It is the newest state (sample) from the other arm whose network delay has passed. Before
    the first sample, it is the start pose of the other arm, at rest.

    Attributes:
        alpha: Dominance factor of the peer now, the weight with which this site follows it.
        tick: Stamp of the sample in use, a tick of the peer; -1 before the first sample.
        age_s: Age of that sample, s; before the first sample, the time since the start of the
            session.
        new: 1 if the sample came into use at this tick, else 0.
        q: Joint angles or coordinates of the sample, rad or m.
        qd: Derivative of q, rad/s or m/s.
        tau_x: Minus the torque of hand and environment ON the peer's arm, N m or N.
    """

    alpha: float
    tick: int
    age_s: float
    new: int
    q: LawVector
    qd: LawVector
    tau_x: LawVector


class LawInput(NamedTuple):
    """Input of a control law in one control period (tick), and fields for its results.

    A vector has one number per joint, or one per coordinate that the arms share.

    >>> def torque(self, now: tn.LawInput) -> list[float]:
    ...     return [-d * speed for d, speed in zip(self.d, now.qd)]

    In plain Python, each vector is a `LawVector`, which supports arithmetic. A compiled law
    uses the numbers of a vector one by one.

    Attributes:
        k: Number of the tick (control period).
        t_s: Nominal time since the start of the session, s.
        h_s: The period, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        q_des: Reference of Eq. (6), rad.
        qd_des: Derivative of q_des, rad/s.
        felt: Torque of hands and environments ON the peers' arms as received, weighted by
            dominance, N m: the sum of -alpha tau_x of the peers.
        joints: Number of joints.
        coordinates: Number of values in each vector of a peer.
        tau: Torque of each joint, N m, written by the law and then limited.
        peers: The peers in scenario order.
        received: Per peer, the vectors by name that its law sent with the sample in use. Zeros
            before the first sample, and for a vector that the peer's law does not send.
        sent: Per peer, the vectors that go to this peer alone, written by the law. A vector
            that is not written keeps its values.
        to_all: Vectors that go to all peers, also written by the law.
        tau_x: Minus the torque of hand and environment ON this arm in this tick, N m, the sign
            of Eq. (8).
        tau_before: Torque of the previous tick, within its limits, N m; zeros at tick 0.
        q_before: Joint angles of the previous tick, rad; the start pose at tick 0.
        gravity: Torque that holds the arm, N m; zeros if its parameters are unknown.
        theta_hat: Estimate in the record, written by the law; otherwise it does not change.
        inertia: M(q), one row per joint, for a law with `needs_model`; otherwise zeros.
        bias: C qd + G, N m, for a law with `needs_model`; otherwise zeros. For a chain, it
            includes the friction, minus the torque of the joint stops.
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
    """Interface of a control law that a user writes in Python.

    The class of the law is called with a `LawContext`, which describes the arm, and with the
    entries of the table `[control]` of the scenario as keyword arguments. The method `torque`
    is called in each period of the control loop.

    A law may have these attributes and methods:

    - If `torque` needs numbers from earlier periods, the law must declare them, so that a run
      can be repeated. Either the class lists the names of these attributes in `remembers`, or a
      method `memory()` returns the numbers and a method `recall(memory)` restores them.
    - An attribute `theta_hat` with a number per dynamic parameter is stored in the records.
    - `holds = True` states that the law knows the other arms only through the reference, the
      position that its arm follows. Its torque is then also used while the arm is at rest.
    """

    def torque(self, now: LawInput) -> Sequence[float] | None:
        """Computes the motor torque of each joint in a period of the control loop.

        The program limits the torque to the range of the motors afterwards.

        Args:
            now: State of the arm and of the other arms. The law may also write results into it,
                for example numbers for other arms.

        Returns:
            The torques, N m. None if the law has written them into `now.tau`.
        """


UserLawFactory = Callable[[LawContext], UserLaw]


class SiteLaw:
    """A user's control law at one site: its calls, its memory, and its errors.

    A site is the process that runs one arm.

    Args:
        law: An instance of the law's class.
        site: Name of the site, for errors.
    """

    def __init__(self, law: UserLaw, site: str) -> None:
        self._law: Any = law
        self._site = site

    @property
    def name(self) -> str:
        """Name by which a scenario selects the law, as in "mylaws:Spring"."""
        kind = type(self._law)
        return f"{kind.__module__}:{kind.__qualname__}"

    @property
    def remembered(self) -> tuple[str, ...]:
        """Names of the attributes that the law keeps from one control period to the next.

        The law's class lists them in `remembers`, for example `remembers = ("x",)`. The log
        contains their values, so that a run can be repeated. Empty for a law without memory.
        """
        return tuple(getattr(self._law, "remembers", ()))

    @property
    def memory(self) -> list[float]:
        """Numbers that the law keeps from one control period to the next.

        They come from the law's method `memory` if it has one, otherwise from the attributes
        that its class lists in `remembers`.
        """
        if callable(getattr(self._law, "memory", None)):
            return [float(value) for value in self._law.memory()]
        numbers: list[float] = []
        for name in self.remembered:
            numbers += _flatten(getattr(self._law, name))
        return numbers

    @property
    def memory_names(self) -> tuple[str, ...]:
        """A name for each number of `memory`, as "error[1]" or "memory[1]"."""
        if callable(getattr(self._law, "memory", None)):
            return tuple(f"memory[{n + 1}]" for n in range(len(self._law.memory())))
        names = []
        for attribute in self.remembered:
            value = getattr(self._law, attribute)
            numbers = range(1, np.size(value) + 1)
            names += [f"{attribute}[{number}]" for number in numbers]
        return tuple(names)

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the state that the law had after a recorded control period.

        A recorded run can then be continued or checked from that period. If the law has a
        method `recall`, the numbers are passed to this method. Otherwise they are written into
        the attributes that the class of the law lists in `remembers`.

        Args:
            memory: Numbers that the law remembered, from the record of the period.

        Raises:
            LawFailed: The law raised an exception.
        """
        try:
            if callable(getattr(self._law, "recall", None)):
                self._law.recall(memory)
                return
            numbers = iter(memory)
            for name in self.remembered:
                setattr(self._law, name, _fill(getattr(self._law, name), numbers))
        except (Exception, SystemExit) as error:
            raise self.describe_failure(None, error) from error

    def call(
        self, now: LawInput, collect_sent: Callable[[LawInput], list[float]]
    ) -> "LawResults":
        """Calls the law for one control period, and checks its results.

        If the law raises an exception or returns an unusable result, the error names the class,
        the arm and the period.

        Args:
            now: Input of the law in this control period.
            collect_sent: Function that returns the numbers that the law sends to other arms.

        Raises:
            LawFailed: The law raised an exception, or its results are not finite or have the
                wrong length.
        """
        try:
            returned = self._law.torque(now)
            # `now.tau` is NaN before the call.
            if returned is None and all(map(math.isnan, now.tau)):
                raise TypeError("torque returned None and did not write now.tau")
            torque_numbers = now.tau if returned is None else returned
            estimate_numbers = getattr(self._law, "theta_hat", now.theta_hat)
            torque = [float(value) for value in torque_numbers]
            estimate = [float(value) for value in estimate_numbers]
            results = LawResults(torque, estimate, self.memory, collect_sent(now))
        except LawFailed:  # the watchdog has stopped the law
            raise
        except (Exception, SystemExit) as error:
            raise self.describe_failure(now.k, error) from error

        required_lengths = (
            ("torque", torque, now.joints),
            ("theta_hat", estimate, len(now.theta_hat)),
        )
        for name, values, length in required_lengths:
            if len(values) != length:
                problem = f"{name} has {count_nouns(len(values), 'number')}, not {length}"
                raise self._make_error(now.k, problem)
        self.check_results(now.k, results)
        return results

    def check_results(self, tick: int, results: "LawResults") -> None:
        """Checks that the results of the law are finite, and its memory not too large.

        A torque that is NaN would make the simulation useless, and a large memory would fill
        the log.

        Args:
            tick: Number of the tick (control period), for the error.
            results: Results of the law.

        Raises:
            LawFailed: A check fails. The error states the first problem.
        """
        count = len(results.memory)
        if count > MAX_LAW_MEMORY:
            numbers = count_nouns(count, "number")
            problem = f"memory has {numbers}, but at most {MAX_LAW_MEMORY} are allowed"
            raise self._make_error(tick, problem)
        for name, values in zip(results._fields, results, strict=True):
            if all(map(math.isfinite, values)):
                continue
            for n, value in enumerate(values):
                if not math.isfinite(value):
                    problem = f"{name}[{n}] must be a finite number, but is {value}"
                    raise self._make_error(tick, problem)

    def describe_failure(self, tick: int | None, error: BaseException) -> LawFailed:
        """Converts an exception in the law to an error with the class and the arm.

        The message contains the line of the user's file.

        Args:
            tick: Number of the tick (control period). None if the law failed outside a tick.
            error: The exception.
        """
        problem = describe_exception(error)
        if "LawVector" in problem:
            problem += "; for more than + - * / make it an array, as in numpy.asarray(now.q)"
        return self._make_error(tick, problem)

    def _make_error(self, tick: int | None, problem: str) -> LawFailed:
        """Returns the error for a problem with the law, which names the arm and the class.

        Args:
            tick: Number of the tick (control period). None outside a tick.
            problem: The problem, a sentence for the user.
        """
        return LawFailed(problem, site=self._site, code=self.name, tick=tick)


class LawResults(NamedTuple):
    """Checked results of a user's control law in one control period.

    They are the torque of each joint, the estimate of the arm's parameters, the numbers that
    the law keeps for the next period, and the numbers that it sends to other arms.
    """

    torque: list[float]
    theta_hat: list[float]
    memory: list[float]
    sent: list[float]


def _flatten(value: Any) -> Iterator[float]:
    """Yields the numbers of an attribute of a control law as floats, to store them in the log.

    A single number gives itself. Nested lists give their numbers in order: [[1, 2], [3]] gives
    1, 2 and 3.
    """
    if isinstance(value, Real):
        yield float(value)
        return
    for entry in value:
        yield from _flatten(entry)


def _fill(value: Any, numbers: Iterator[float]) -> Any:
    """Restores an attribute of a law from a list of numbers; the inverse of `_flatten`.

    Example: the value [[1, 2], [3]] and the numbers 4, 5, 6 give [[4, 5], [6]]. Types are kept:
    an integer stays an integer as long as its new number is integral.

    Args:
        value: Present value: a number, an array, or nested lists of numbers.
        numbers: The new numbers. As many of them are consumed as `value` contains.
    """
    if isinstance(value, bool):
        return bool(next(numbers))
    if isinstance(value, Real):
        number = next(numbers)
        stays_integer = isinstance(value, int) and number.is_integer()
        return int(number) if stays_integer else number
    if isinstance(value, np.ndarray):
        entries = [next(numbers) for _ in range(value.size)]
        return np.array(entries, value.dtype).reshape(value.shape)
    return type(value)(_fill(entry, numbers) for entry in value)
