"""Networks of N sites under P+d, and their unstable roots, counted without the program's own linear loop."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.scenario_reader import parse_scenario

Array = NDArray[np.float64]
H_S = 1e-3


def position_network(
    alpha: Any,
    K: float | Sequence[float] = 10.0,
    d: float | Sequence[float] = 1.0,
    delay_ms: float = 200.0,
    masses: Sequence[float] | None = None,
    **changes: Any,
) -> Scenario:
    """Returns uniform rods of the given masses, kg (1 m long, two to an arm), all from one
    pose, under P+d.
    """
    count = len(alpha)
    names = [f"s{n}" for n in range(count)]
    lines = [
        'name = "network"',
        "rate_hz = 1000",
        "duration_s = 1.0",
        'scheme = "second_order"',
    ]
    lines += ["[link]", f"delay_ms = {float(delay_ms)!r}", "[control]", 'law = "p_d"']
    for n, name in enumerate(names):
        mass = 1.0 if masses is None else float(masses[n])
        gains = [float(np.broadcast_to(gain, count)[n]) for gain in (K, d)]
        lines += [
            f"[sites.{name}]",
            f'role = "{"master" if n else "slave"}"',
            "q0_rad = [-0.1, 0.4]",
        ]
        lines += [f"control = {{ K = {gains[0]!r}, d = {gains[1]!r} }}", f"[sites.{name}.arm]"]
        for link in "12":
            lines += [f"l{link}_m = 1.0", f"m{link}_kg = {mass!r}", f"lc{link}_m = 0.5"]
            lines += [f"I{link}_kg_m2 = {mass / 12.0!r}"]
    lines += ["[dominance]"]
    for n, name in enumerate(names):
        shares = ", ".join(
            f"{names[j]} = {float(alpha[n][j])!r}" for j in range(count) if alpha[n][j]
        )
        lines += [f"{name} = {{ {shares} }}"]
    scenario = parse_scenario("\n".join(lines))
    return load_scenario(scenario, changes) if changes else scenario


def compute_rod_inertia(mass_kg: float, q2_rad: float) -> Array:
    """Returns M of two uniform rods of 1 m, kg m^2."""
    c = np.cos(q2_rad)
    return mass_kg * np.array([[5 / 3 + c, 1 / 3 + c / 2], [1 / 3 + c / 2, 1 / 3]])


def count_growing(
    alpha: Any,
    inertias: Sequence[Array],
    K: Any,
    d: Any,
    ticks: Any,
    growth_per_s: float = 1e-6,
) -> int:
    """Counts roots z of the sampled loop outside of abs(z) = exp(growth h): by the turns of its determinant.

    A tick of `second_order`: M (2 / h^2) (z - 1)^2 z q = -(1.5 z - 0.5) (2 d (z - 1) / h + (z + 1) K (I -
    alpha z^-n)) q, from q' = q + h qd + h^2 u / 2, qd' = qd + h u, M u = 1.5 tau - 0.5 tau of the last tick.
    """
    joints = len(inertias[0])
    count = len(alpha)
    mass = block_diag(*inertias)
    size = joints * count
    stiffness, damping = (np.repeat(np.broadcast_to(gain, count), joints) for gain in (K, d))
    shares = np.kron(np.asarray(alpha), np.eye(joints))
    late = np.kron(np.broadcast_to(ticks, (count, count)), np.ones((joints, joints)))

    def angle(phi: Array) -> Array:
        s = growth_per_s * H_S + 1j * phi
        z = np.exp(s)[:, None, None]
        less = np.expm1(s)[:, None, None]
        seen = np.eye(size) - shares * np.exp(-s[:, None, None] * late)
        control = 2.0 / H_S * less * np.diag(damping) + (z + 1.0) * stiffness[:, None] * seen
        sign, _ = np.linalg.slogdet(
            2.0 / H_S**2 * less**2 * z * mass + (1.5 * z - 0.5) * control
        )
        return np.asarray(np.angle(sign))

    phi = np.concatenate([np.geomspace(1e-12, 1e-6, 60)[:-1], np.geomspace(1e-6, np.pi, 1500)])
    phi = np.union1d(phi, np.linspace(0.0, min(np.pi, 60.0 / np.max(ticks)), 400))
    turned = angle(phi)
    for _ in range(40):
        steps = (np.diff(turned) + np.pi) % (2.0 * np.pi) - np.pi
        wide = np.flatnonzero(np.abs(steps) > 0.7)
        if not len(wide):
            break
        between = 0.5 * (phi[wide] + phi[wide + 1])
        phi = np.insert(phi, wide + 1, between)
        turned = np.insert(turned, wide + 1, angle(between))
    growing = 3 * size - steps.sum() / np.pi
    assert abs(growing - round(growing)) < 1e-6
    return round(growing)
