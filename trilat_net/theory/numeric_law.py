"""A law of one's own as a function of numbers, and its derivatives by central differences.

    (tau_k, m_k) = f(q, qd, m_{k-1}, q_des, qd_des, felt, peers, torque ON the arm)

Invariant: it is asked as its site asks it, through the rows from which it gets its input,
without the clamp. Its memory m is its own, and the torque and the angles of the tick before if
it uses these. In continuous time m' = (m_k - m_{k-1}) / h, which the sampled loop puts back to
the memory that it was.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..analysis.arm_rows import Numbers
from ..core import chain_stages, two_link_stages
from ..core.compiled_law import plug_law
from ..core.site_arrays import build_site_arrays
from ..core.site_setup import SiteSetup
from ..core.ticks import tick_ns
from ..core.user_law import LawContext, UserLaw, list_remembered, read_memory
from ..core.vectors import Array
from ..errors import ScenarioError

_TICK = 1_000_000
"""The tick at which a law is asked: late, so that nothing begins."""
_STEP = 1e-5
"""Half the difference of an argument, relative to its size, at least 1: errors are about 1e-10.
"""
_STILL = 1e-14
"""A step by which memory is at rest."""


class NumericLaw:
    """An imported law of a site, made; called, it returns it, as a factory does.

    Args:
        setup: of its site.
        code: what the scenario calls it.
        shares: the dominance factors of the peers in force.

    Attributes:
        names: of the numbers of its memory, as "error[1]".
        memory: the same at the beginning.

    Raises:
        ScenarioError: it sends vectors of its own, or follows with an end effector.
    """

    def __init__(self, setup: SiteSetup, code: str, shares: Sequence[float]) -> None:
        path = f"sites.{setup.name}.control.law"
        if setup.layout.sent:
            raise ScenarioError(
                f"{code} sends vectors of its own, which are not linearised", path=path
            )
        if setup.layout.task:
            raise ScenarioError(f"{code} is linearised between joint angles alone", path=path)
        assert setup.own is not None
        self._law = setup.own(setup.law_context())
        self._layout = setup.layout
        self._arrays = build_site_arrays(setup)
        self._rate_hz = setup.rate_hz
        self._arrays.site["tau_limit"] = np.inf
        self._arrays.links["alpha"] = shares
        self._asked = plug_law(self._law, setup, self._arrays, np.zeros(0))
        own = np.array(read_memory(self._law))
        self._own = len(own)
        self._keeps_past = False
        self.memory = own
        self.names = _name_memory(self._law, self._own)
        start = np.array(setup.q0)
        rest = np.zeros(self._layout.joints)
        peers = [np.r_[link.q0, rest, rest] for link in setup.links]
        arguments = np.concatenate([start, rest, self.memory, start, rest, rest, *peers, rest])
        past = np.r_[np.zeros(self._layout.joints), setup.q0]
        self._keeps_past = not np.array_equal(
            self._ask(arguments, past), self._ask(arguments, past + 1e-3)
        )
        if self._keeps_past:
            self.memory = np.r_[own, past]
            for name in ("tau_before", "q_before"):
                self.names += tuple(
                    f"{name}[{joint + 1}]" for joint in range(self._layout.joints)
                )

    @property
    def _memory_at(self) -> slice:
        return slice(2 * self._layout.joints, 2 * self._layout.joints + len(self.memory))

    def __call__(self, _context: LawContext) -> UserLaw:
        """Returns the law."""
        return self._law

    def complete(self, memory: Array | None) -> Array:
        """Returns all of the memory: that at the beginning, with as much of it as is given."""
        whole: Array = self.memory.copy()
        if memory is not None:
            known = len(whole) if len(memory) >= len(whole) else self._own
            whole[:known] = memory[:known]
        return whole

    def settle(self, x: Array, ticks: int) -> Array:
        """Returns its memory after so many ticks of the same arguments, or once it stays as it
        is.
        """
        memory = self._memory_at
        x = x.copy()
        for _ in range(ticks):
            step = self._evaluate(x)[1] / self._rate_hz
            x[memory] += step
            if not np.abs(step).max(initial=0.0) > _STILL:
                break
        return x[memory]

    def evaluate(self, x: Numbers) -> tuple[Numbers, Numbers]:
        """Returns the torque and the rate of the memory; of complex columns with their
        derivatives.
        """
        if not np.iscomplexobj(x):
            return self._evaluate(x)
        at: Array = x.real[:, 0]
        torque, rate = self._evaluate(at)
        columns = []
        for n, value in enumerate(at):
            half = _STEP * max(1.0, abs(float(value)))
            up = at.copy()
            down = at.copy()
            up[n] = value + half
            down[n] = value - half
            ends = [np.concatenate(self._evaluate(one)) for one in (up, down)]
            columns.append((ends[0] - ends[1]) / (up[n] - down[n]))
        whole = np.concatenate([torque, rate])[:, np.newaxis] + 1j * (
            np.stack(columns, axis=1) @ x.imag
        )
        return whole[: len(torque)], whole[len(torque) :]

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        n = self._layout.joints
        memory = self._memory_at
        past = x[memory][self._own :] if self._keeps_past else np.r_[np.zeros(n), x[:n]]
        after = self._ask(x, past)
        torque = after[:n]
        kept = after[n:]
        now = np.r_[kept, torque, x[:n]] if self._keeps_past else kept
        return torque, (now - x[memory]) * self._rate_hz

    def _ask(self, x: Array, past: Array) -> Array:
        """Returns the torque and the law's own memory after a tick; `past`: torque and angles
        before it.
        """
        a = self._arrays
        n = self._layout.joints
        s: Any = a.site[0]
        start = self._memory_at.stop
        s.q[:] = x[:n]
        s.qd[:] = x[n : 2 * n]
        s.q_des[:], s.qd_des[:], s.felt[:] = np.split(x[start : start + 3 * n], 3)
        s.tau_before[:], s.q_before[:] = np.split(past, 2)
        s.on_arm[:] = x[len(x) - n :]
        a.links["used"] = _TICK - 1
        for j, link in enumerate(a.links):
            first = start + 3 * n * (1 + j)
            link["q"][:], link["qd"][:], link["tau_x"][:] = np.split(
                x[first : first + 3 * n], 3
            )
        if a.chain is None:
            two_link_stages.update_errors(s)  # with the regressor, which gravity is taken from
        else:
            chain_stages.place_chain(s, a.chain)
        self._asked.recall(x[2 * n : 2 * n + self._own].tolist())
        memory = self._asked.compute(_TICK, tick_ns(_TICK, self._rate_hz))
        return np.concatenate([s.tau, memory])


def _name_memory(law: Any, count: int) -> tuple[str, ...]:
    if callable(getattr(law, "memory", None)):
        return tuple(f"memory[{n + 1}]" for n in range(count))
    sizes = {name: np.size(getattr(law, name)) for name in list_remembered(law)}
    return tuple(f"{name}[{n + 1}]" for name, size in sizes.items() for n in range(size))
