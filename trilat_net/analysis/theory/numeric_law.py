"""Linearises a control law that is known only from its code, using central differences.

A user may write a control law as a Python function. Its derivatives are needed for the linear
analysis, but its equations are unknown. For one tick, the code is treated as a function:

    (tau_k, m_k) = f(q, qd, m_{k-1}, q_des, qd_des, felt, peers, torque)

The results at tick k are the torque tau_k that the law commands and its memory m_k, the values
that it stores for the next tick. The arguments are:

- the joint angles q and velocities qd, and the desired angles q_des and velocities qd_des,
- `felt`, the weighted sum of the received torques on the other arms,
- `peers`, the states of these arms one by one,
- `torque`, the external torque on the law's own arm.

Each argument is changed by a small step in both directions, and the differences between the
results give the derivatives. In continuous time, the memory changes at the rate m' = (m_k -
m_{k-1}) / h, where h is the tick period.

Invariant:
    - The law receives the same inputs as in a run. Its torque is not limited.
    - If the law uses the torque or the angles of the previous tick, they belong to the memory.
    - The sampled analysis adds h m' to the memory m_{k-1}, which gives m_k.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core import (
    Array,
    LawContext,
    SiteArrays,
    SiteSetup,
    UserLaw,
    chain_stages,
    plug_law,
    tick_ns,
    two_link_stages,
)
from ...errors import ScenarioError
from ..arm_rows import Numbers

_TICK = 1_000_000
"""Number of the tick that is evaluated. This tick is so late that no start-up action of a law
is active.
"""
_STEP = 1e-5
"""Half the step of a central difference, relative to the argument's size or to 1.

Errors of the derivatives are about 1e-10.
"""
_STILL = 1e-14
"""Largest change in one tick at which the memory counts as constant."""


class NumericLaw:
    """A user's control law as a function that the linear analysis can differentiate.

    The memory of the law consists of the values that it stores from one tick to the next. The
    law object is built only once. Calling a `NumericLaw` returns this law object, so a
    `NumericLaw` can replace the function that normally builds the law of a `SiteSetup`.

    Args:
        setup: Setup of the site.
        code: Name by which the scenario refers to the law.
        shares: Dominance factors of the site.

    Attributes:
        names: Names of the values in the memory, such as "error[1]".
        memory: The memory at the start of a run.

    Raises:
        ScenarioError: The law sends vectors that it defines itself, or follows with the end
            effector.
    """

    def __init__(self, setup: SiteSetup, code: str, shares: Sequence[float]) -> None:
        path = f"sites.{setup.name}.control.law"
        if setup.layout.sent:
            raise ScenarioError(
                f"{code} sends vectors that the law defines; an imported law of this kind "
                "cannot be linearised",
                path=path,
            )
        if setup.layout.task:
            raise ScenarioError(
                f"{code} follows in task space, but an imported law can be linearised "
                "in joint space only",
                path=path,
            )

        assert setup.law_factory is not None
        self._law = setup.law_factory(setup.law_context())
        self._layout = setup.layout
        self._arrays = SiteArrays.build(setup)
        self._rate_hz = setup.rate_hz
        self._arrays.site["tau_limit"] = np.inf
        self._arrays.links["alpha"] = shares

        self._plugged_law = plug_law(self._law, setup, self._arrays, np.zeros(0))

        remembered = np.array(self._plugged_law.memory)
        self._remembered_count = len(remembered)
        self._uses_previous_tick = False
        self.memory = remembered
        self.names = self._plugged_law.memory_names
        self._extend_memory_by_previous_tick(setup)

    def _extend_memory_by_previous_tick(self, setup: SiteSetup) -> None:
        """Adds the previous torque and angles to the memory if the law's output uses them."""
        joints = self._layout.joints
        q0 = np.array(setup.q0)
        zeros = np.zeros(joints)

        peers = []
        for link in setup.links:
            sample = np.concatenate([link.q0, zeros, zeros])
            peers.append(sample)
        parts = [q0, zeros, self.memory, q0, zeros, zeros, *peers, zeros]
        arguments = np.concatenate(parts)

        previous = np.concatenate([zeros, q0])
        shifted = previous + 1e-3
        output = self._evaluate_tick(arguments, previous)
        output_of_shifted = self._evaluate_tick(arguments, shifted)
        self._uses_previous_tick = not np.array_equal(output, output_of_shifted)
        if not self._uses_previous_tick:
            return

        self.memory = np.concatenate([self.memory, previous])
        numbers = range(1, joints + 1)
        for name in ("tau_before", "q_before"):
            self.names += tuple(f"{name}[{number}]" for number in numbers)

    @property
    def _memory_slice(self) -> slice:
        """Position of the memory in the arguments."""
        start = 2 * self._layout.joints
        return slice(start, start + len(self.memory))

    def __call__(self, _context: LawContext) -> UserLaw:
        """Returns the law, so that this object can stand in for a function that builds it."""
        return self._law

    def complete_memory(self, memory: Array | None) -> Array:
        """Completes the memory of a control law if only its first values are known.

        The memory contains all values that the law stores from tick to tick. Unknown values are
        taken from the memory at the start of a run.

        Args:
            memory: Known values: the complete memory, or at least the values that the law
                itself stores. Longer arrays are truncated. `None` if nothing is known.

        Returns:
            The complete memory.
        """
        full_memory: Array = self.memory.copy()
        if memory is None:
            return full_memory
        known = self._remembered_count
        if len(memory) >= len(full_memory):
            known = len(full_memory)
        full_memory[:known] = memory[:known]
        return full_memory

    def iterate_memory(self, x: Array, ticks: int) -> Array:
        """Executes a user's control law with constant inputs until its memory is steady.

        The memory consists of the values that the law stores from one tick to the next, such as
        an integral. The iteration ends early once these values no longer change.

        Args:
            x: Arguments in the order of `ArgumentLayout`, shape (arguments,).
            ticks: Maximum number of ticks.
        """
        memory = self._memory_slice
        x = x.copy()
        for _ in range(ticks):
            _, rate = self._evaluate_rates(x)
            step = rate / self._rate_hz
            x[memory] += step
            largest_step = np.abs(step).max(initial=0.0)
            if not largest_step > _STILL:
                break
        return x[memory]

    def evaluate(self, x: Numbers) -> tuple[Numbers, Numbers]:
        """Computes the torque of a control law, or its derivatives by central differences.

        The derivatives are requested in the same form as for functions that accept a complex
        step: the real parts of x are the arguments, and the imaginary part of each column is a
        small change of the arguments.

        Args:
            x: Arguments of the law, real with shape (arguments,), or complex with shape
                (arguments, columns).

        Returns:
            The torque of the n joints, shape (n, ...), in N m. For a complex x, the imaginary
            part of each column is the small change of the torque.
            The rate of change of the law's memory, shape (memory, ...), in 1/s, in the same
            form.
        """
        if not np.iscomplexobj(x):
            return self._evaluate_rates(x)

        arguments: Array = x.real[:, 0]
        torque, rate = self._evaluate_rates(arguments)
        columns = []
        for n, value in enumerate(arguments):
            size = max(1.0, abs(float(value)))
            half_step = _STEP * size
            upper = arguments.copy()
            lower = arguments.copy()
            upper[n] = value + half_step
            lower[n] = value - half_step
            upper_rates = np.concatenate(self._evaluate_rates(upper))
            lower_rates = np.concatenate(self._evaluate_rates(lower))
            # the difference of the rounded arguments, not 2 half_step
            step = upper[n] - lower[n]
            difference = upper_rates - lower_rates
            columns.append(difference / step)

        values = np.concatenate([torque, rate])
        derivatives = np.stack(columns, axis=1)
        imaginary_part = derivatives @ x.imag
        outputs = values[:, np.newaxis] + 1j * imaginary_part
        return outputs[: len(torque)], outputs[len(torque) :]

    def _evaluate_rates(self, x: Array) -> tuple[Array, Array]:
        """Returns the law's torque and the rate of change of its memory, for real arguments."""
        joints = self._layout.joints
        q = x[:joints]
        memory = x[self._memory_slice]
        if self._uses_previous_tick:
            previous = memory[self._remembered_count :]
        else:
            no_torque = np.zeros(joints)
            previous = np.concatenate([no_torque, q])

        output = self._evaluate_tick(x, previous)
        torque = output[:joints]
        next_memory = output[joints:]
        if self._uses_previous_tick:
            next_memory = np.concatenate([next_memory, torque, q])

        change = next_memory - memory
        return torque, change * self._rate_hz

    def _evaluate_tick(self, x: Array, previous: Array) -> Array:
        """Evaluates a user's control law for one tick, a period of the control loop.

        The result is differentiated numerically, because the code of the law is arbitrary.

        Returns:
            The torque, and the values that the law stores for its next tick.

        Args:
            x: Arguments, shape (arguments,).
            previous: Torque and angles of the previous tick, shape (2 n,).
        """
        arrays = self._arrays
        n = self._layout.joints
        row: Any = arrays.site[0]

        references_start = self._memory_slice.stop
        peers_start = references_start + 3 * n
        row.q[:] = x[:n]
        row.qd[:] = x[n : 2 * n]
        references = x[references_start:peers_start]
        q_des, qd_des, felt = np.split(references, 3)
        row.q_des[:] = q_des
        row.qd_des[:] = qd_des
        row.felt[:] = felt
        tau_before, q_before = np.split(previous, 2)
        row.tau_before[:] = tau_before
        row.q_before[:] = q_before
        row.on_arm[:] = x[len(x) - n :]

        arrays.links["used"] = _TICK - 1
        sample_length = 3 * n
        for j, link in enumerate(arrays.links):
            first = peers_start + sample_length * j
            sample = x[first : first + sample_length]
            q, qd, tau_x = np.split(sample, 3)
            link["q"][:] = q
            link["qd"][:] = qd
            link["tau_x"][:] = tau_x

        if arrays.chain is None:
            # also computes the regressor, for gravity
            two_link_stages.update_errors(row)
        else:
            chain_stages.place_chain(row, arrays.chain)

        memory_start = self._memory_slice.start
        remembered_end = memory_start + self._remembered_count
        remembered = x[memory_start:remembered_end]
        self._plugged_law.restore(remembered.tolist())
        time_ns = tick_ns(_TICK, self._rate_hz)
        memory = self._plugged_law.compute(_TICK, time_ns)
        return np.concatenate([row.tau, memory])
