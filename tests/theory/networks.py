"""Hand-made loops whose answers are known in closed form: masses, dampers, springs, and links with delays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilat_net.analysis.theory.linear_loop import DelayedTerm, LinearLoop

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Wire(NamedTuple):
    """A torque on `at` towards the earlier position of `of`, by K and B after a delay; and a
    share of the torque on `of`.
    """

    at: int
    of: int
    K: float
    B: float = 0.0
    delay_s: float = 0.0
    k_f: float = 0.0


class Network(NamedTuple):
    m: tuple[float, ...]
    d: tuple[float, ...]
    k: tuple[float, ...]
    wires: tuple[Wire, ...] = ()

    @property
    def loop(self) -> LinearLoop:
        count = len(self.m)
        names = tuple(f"{site}.{x}1" for site in "abcd"[:count] for x in ("q", "qd"))
        A = np.zeros((2 * count, 2 * count))
        B = np.zeros((2 * count, count))
        C = np.zeros((count, 2 * count))
        late: dict[float, DelayedTerm] = {}
        for i in range(count):
            q = 2 * i
            qd = 2 * i + 1
            A[q, qd] = C[i, qd] = 1.0
            A[qd, q] = -self.k[i] / self.m[i]
            A[qd, qd] = -self.d[i] / self.m[i]
            B[qd, i] = 1.0 / self.m[i]
        for wire in self.wires:
            at = 2 * wire.at + 1
            of = 2 * wire.of
            m = self.m[wire.at]
            A[at, at - 1 : at + 1] -= np.array([wire.K, wire.B]) / m
            delayed_term = late.setdefault(
                wire.delay_s, DelayedTerm(wire.delay_s, np.zeros_like(A), np.zeros_like(B))
            )
            delayed_term.A[at, of : of + 2] += np.array([wire.K, wire.B]) / m
            delayed_term.B[at, wire.of] += wire.k_f / m
        if 0.0 in late:
            now = late.pop(0.0)
            A = A + now.A
            B = B + now.B
        ports = [tuple(f"{site}.{x}1" for site in "abcd"[:count]) for x in ("tau", "qd")]
        return LinearLoop(
            names, ports[0], ports[1], A, B, C, tuple(late[T] for T in sorted(late))
        )

    def impedance(self, w_rad_s: Sequence[float] | Array) -> Complex:
        """Returns Z with Z qd = (1 + reflection) u, from the equations of motion as written on paper."""
        s = 1j * np.asarray(w_rad_s)
        Z = np.zeros((len(s), len(self.m), len(self.m)), np.complex128)
        reflected = np.zeros_like(Z) + np.eye(len(self.m))
        for i, (m, d, k) in enumerate(zip(self.m, self.d, self.k, strict=True)):
            Z[:, i, i] = m * s + d + k / s
        for wire in self.wires:
            late = np.exp(-s * wire.delay_s)
            link = wire.B + wire.K / s
            Z[:, wire.at, wire.at] += link
            Z[:, wire.at, wire.of] -= link * late
            reflected[:, wire.at, wire.of] += wire.k_f * late
        return np.asarray(np.linalg.solve(reflected, Z), dtype=np.complex128)


def hold_by_spring(loop: LinearLoop, site: str, K: float, B: float = 0.0) -> LinearLoop:
    """Returns the loop with a spring, N m/rad, and a damper, N m s/rad, to a fixed point at
    each joint of a site.
    """
    ports = loop.find_site_ports(site)
    back = np.zeros((len(loop.inputs), len(loop.names)))
    back[ports] = B * loop.C[ports]
    back[
        ports, [loop.names.index(loop.inputs[port].replace(".tau", ".q")) for port in ports]
    ] += K
    delayed = tuple(term._replace(A=term.A - term.B @ back) for term in loop.delayed)
    return loop._replace(A=loop.A - loop.B @ back, delayed=delayed)


def make_pair(
    K: tuple[float, float] = (10.0, 10.0),
    d: tuple[float, float] = (1.0, 1.0),
    T: tuple[float, float] = (0.2, 0.2),
    B: float = 0.0,
) -> Network:
    """Returns two sites that follow each other: P+d with B = 0."""
    wires = (Wire(0, 1, K[0], B, T[0]), Wire(1, 0, K[1], B, T[1]))
    return Network((1.0, 1.5), d, (0.0, 0.0), wires)
