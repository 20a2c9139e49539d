"""Calls a user's control law in plain Python, once per tick.

A control law is a class with a method `torque`, which computes the torque of an arm from a
`LawInput`: the motion of the arm and of the other arms. A law may keep state between ticks (its
memory), for example the integral of an error.

Invariant:
    - A law is a function of its input and its memory: equal inputs and equal memory give equal
      torques.
    - Each record contains the memory, so a run can be resumed from the middle of its log.
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
    """Facts about an arm and its peers, which a control law receives when it is created.

    >>> class Damper:
    ...     def __init__(self, facts: tn.LawContext, d: float = 2.0) -> None:
    ...         self.d = [d] * facts.joints

    Attributes:
        site: Name of the site.
        rate_hz: Tick rate of the site, Hz.
        g_m_s2: Gravitational acceleration, m/s^2.
        lengths_m: Lengths of the two links, m.
        theta: The arm's true parameters, shape (5,), for laws that require them; () if they are
            unknown, as for a real arm that has not been identified.
        tau_limit_nm: Largest joint torque, N m; a single value, or one value per joint.
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

    The method works elementwise. Its arguments are the vector and the other operand.

    Args:
        operate: The operation on two numbers, for example `operator.add`.
    """

    def compute(vector: "LawVector", other: Any) -> Any:
        """Applies an operation, such as addition, to two vectors, or to a vector and a number.

        Args:
            vector: The first vector.
            other: A vector of the same length, or a single number.

        Returns:
            The resulting vector, or NotImplemented if `other` is of another type.
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
    """A list of numbers with elementwise arithmetic, for writing control laws as formulas.

    For example, `-5.0 * (now.q - now.q_des) - 2.0 * now.qd`. The other operand is a number or a
    list of the same length.
    """

    __add__ = __radd__ = __iadd__ = _make_operator(operator.add)
    __sub__ = _make_operator(operator.sub)
    __rsub__ = _make_operator(lambda right, left: left - right)
    __mul__ = __rmul__ = __imul__ = _make_operator(operator.mul)
    __truediv__ = _make_operator(operator.truediv)

    def __neg__(self) -> "LawVector":
        return LawVector(map(operator.neg, self))


class PeerView(NamedTuple):
    """Data about a peer that a control law can read in one tick.

    The data come from the newest sample whose network delay has passed. Before the first
    sample, they describe the start pose of the peer, at rest.

    Attributes:
        alpha: Current dominance factor of the peer, the weight that this site gives to it.
        tick: Tick of the peer at which the sample in use was sent; -1 before the first sample.
        age_s: Age of the sample in use, s; before the first sample, the time since the start of
            the session.
        new: 1 if the sample came into use in this tick, else 0.
        q: Joint angles or coordinates of the sample, rad or m.
        qd: Derivative of q, rad/s or m/s.
        tau_x: External torque of the peer's arm, N m or N; the torque ON that arm is its
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
    """Input of a control law in one tick, and fields for its results.

    Vectors have one entry per joint, or one per shared coordinate.

    >>> def torque(self, now: tn.LawInput) -> list[float]:
    ...     return [-d * speed for d, speed in zip(self.d, now.qd)]

    In plain Python, each vector is a `LawVector`, which supports arithmetic. A compiled law
    must access the entries of a vector one by one.

    Attributes:
        k: Number of the tick.
        t_s: Nominal time since the start of the session, s.
        h_s: The control period, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        q_des: Reference of Eq. (6), rad.
        qd_des: Derivative of q_des, rad/s.
        felt: External torque ON the peers' arms as received, weighted by dominance, N m: the
            sum of -alpha tau_x over the peers.
        joints: Number of joints.
        coordinates: Length of the vectors q, qd and tau_x of a peer.
        tau: Torque of each joint, N m, written by the law and limited afterwards.
        peers: The peers in scenario order.
        received: For each peer, the vectors that its law sent with the sample in use, accessed
            by name. Zeros before the first sample, and for a vector that the peer's law does
            not send.
        sent: For each peer, the vectors sent to this peer alone, written by the law. A vector
            that is not written keeps its values.
        to_all: Vectors sent to all peers, also written by the law.
        tau_x: External torque of this arm in this tick, N m, with the sign of Eq. (8); the
            torque ON the arm is its negative.
        tau_before: Torque of the previous tick after limiting, N m; zeros at tick 0.
        q_before: Joint angles of the previous tick, rad; the start pose at tick 0.
        gravity: Torque that holds the arm against gravity, N m; zeros if the arm's parameters
            are unknown.
        theta_hat: Parameter estimate that is stored in the record. Unchanged unless the law
            writes it.
        inertia: M(q), one row per joint, for a law with `needs_model`; otherwise zeros.
        bias: C qd + G, N m, for a law with `needs_model`; otherwise zeros. For a chain,
            friction is added and the torque of the joint stops subtracted.
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
    """Interface of a control law written by a user in Python.

    The class is instantiated with a `LawContext`, which describes the arm, and with the entries
    of the scenario's table `[control]` as keyword arguments. The method `torque` is called in
    every tick.

    A law may also define:

    - A memory. Any state that `torque` keeps between ticks must be declared, because otherwise
      a run could not be repeated. Either the class lists the attribute names in `remembers`, or
      a method `memory()` returns the state vector and a method `recall(memory)` restores it.
    - An attribute `theta_hat` with one value per dynamic parameter, which is stored in the
      records.
    - An attribute `holds = True`, if the law depends on the other arms only through the
      reference. The torque of the law is then also used while the arm is at rest.
    """

    def torque(self, now: LawInput) -> Sequence[float] | None:
        """Computes the motor torque of each joint in one tick.

        The returned torque is then limited to the motors' range.

        Args:
            now: State of the arm and of the other arms. The law may also write results into it,
                for example vectors for other arms.

        Returns:
            The torques, N m, or None if the law has written them into `now.tau`.
        """


UserLawFactory = Callable[[LawContext], UserLaw]


class SiteLaw:
    """Calls a user's control law at one site, and handles the law's memory and errors.

    Args:
        law: An instance of the law's class.
        site: Name of the site, for error messages.
    """

    def __init__(self, law: UserLaw, site: str) -> None:
        self._law: Any = law
        self._site = site

    @property
    def name(self) -> str:
        """Name by which a scenario selects the law, for example "mylaws:Spring"."""
        kind = type(self._law)
        return f"{kind.__module__}:{kind.__qualname__}"

    @property
    def remembered(self) -> tuple[str, ...]:
        """Names of the attributes that the law keeps from one tick to the next.

        The law's class lists them in `remembers`, for example `remembers = ("x",)`. Their
        values are stored in the log, so that a run can be repeated. Empty for a law without
        memory.
        """
        return tuple(getattr(self._law, "remembers", ()))

    @property
    def memory(self) -> list[float]:
        """State vector that the law keeps from one tick to the next.

        It is the result of the law's method `memory` if there is one, otherwise the values of
        the attributes listed in `remembers`.
        """
        if callable(getattr(self._law, "memory", None)):
            return [float(value) for value in self._law.memory()]
        numbers: list[float] = []
        for name in self.remembered:
            numbers += _flatten(getattr(self._law, name))
        return numbers

    @property
    def memory_names(self) -> tuple[str, ...]:
        """Name of each entry of `memory`, for example "error[1]" or "memory[1]"."""
        if callable(getattr(self._law, "memory", None)):
            return tuple(f"memory[{n + 1}]" for n in range(len(self._law.memory())))
        names = []
        for attribute in self.remembered:
            value = getattr(self._law, attribute)
            numbers = range(1, np.size(value) + 1)
            names += [f"{attribute}[{number}]" for number in numbers]
        return tuple(names)

    def restore(self, memory: Sequence[float]) -> None:
        """Restores the state of the law after a recorded tick.

        A recorded run can then be continued or checked from that tick. If the law has a method
        `recall`, the state vector is passed to this method. Otherwise its entries are assigned
        to the attributes listed in `remembers`.

        Args:
            memory: State vector from the record of the tick.

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
        """Calls the law for one tick, and checks its results.

        If the law raises an exception or returns an unusable result, the error message names
        the class, the arm and the tick.

        Args:
            now: Input of the law in this tick.
            collect_sent: Function that returns the values that the law sends to other arms.

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
        """Raises LawFailed if a result is not finite or the memory is too large.

        A torque of NaN would make the simulation useless, and a large memory would fill the
        log.

        Args:
            tick: Number of the tick, for the error message.
            results: Results of the law.

        Raises:
            LawFailed: A check fails. The error describes the first problem.
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
        """Converts an exception raised by the law to an error that names the class and the arm.

        The message includes the line of the user's file.

        Args:
            tick: Number of the tick. None if the law failed outside a tick.
            error: The exception.
        """
        problem = describe_exception(error)
        if "LawVector" in problem:
            problem += "; for more than + - * / make it an array, as in numpy.asarray(now.q)"
        return self._make_error(tick, problem)

    def _make_error(self, tick: int | None, problem: str) -> LawFailed:
        """Returns the error for a problem with the law, which names the arm and the class.

        Args:
            tick: Number of the tick. None outside a tick.
            problem: The problem, as a sentence for the user.
        """
        return LawFailed(problem, site=self._site, code=self.name, tick=tick)


class LawResults(NamedTuple):
    """Checked results of a user's control law in one tick.

    They are the torque of each joint, the parameter estimate of the arm, the memory that the
    law keeps for the next tick, and the values sent to other arms.
    """

    torque: list[float]
    theta_hat: list[float]
    memory: list[float]
    sent: list[float]


def _flatten(value: Any) -> Iterator[float]:
    """Yields the numbers in an attribute of a control law as floats, for storage in the log.

    A single number yields itself. Nested lists are flattened: [[1, 2], [3]] yields 1, 2 and 3.
    """
    if isinstance(value, Real):
        yield float(value)
        return
    for entry in value:
        yield from _flatten(entry)


def _fill(value: Any, numbers: Iterator[float]) -> Any:
    """Restores an attribute of a law from its numbers. Inverse of `_flatten`.

    For example, the value [[1, 2], [3]] and the numbers 4, 5, 6 result in [[4, 5], [6]]. Types
    are preserved: an integer remains an integer if its new value is integral.

    Args:
        value: Current value: a number, an array, or nested lists of numbers.
        numbers: The new numbers, of which as many are consumed as `value` contains.
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
