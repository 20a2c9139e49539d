"""The energies of a site's ports, and what became of them in the arm.

Law: the work of a torque is its integral over the way, int tau' dq. One that is held over a period does
tau_k' (q_k+1 - q_k), exactly; of one that follows the present the trapezoid rule is taken over the way, which
is exact for springs. What was given to an arm is in its kinetic and potential energy.

The running energy of a port is what a passivity observer sees: Hannaford and Ryu, "Time-domain passivity
control of haptic interfaces", IEEE Trans. Robotics and Automation 18 (2002).
"""

import numpy as np

from ..certificate.dynamics import inertia_times
from ..certificate.track import Track
from ..core.arm import Array
from ..core.setup import Scheme
from ..scenario import Scenario, SiteSpec
from .pushing import Pushed
from .rows import steps
from .said import Facts, Said, said, unsaid

SITE = (
    "controller_j",
    "hands_j",
    "hands_most_j",
    "walls_j",
    "walls_most_j",
    "mechanical_j",
    "unaccounted_j",
)


def held_work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that is held, of every period, shape (K - 1,), J.

    Args:
        torque: from each row to the next, shape (K - 1, 2) or more rows, N m.
        q: joint angles, shape (K, 2), rad.
    """
    way = np.diff(q, axis=0)
    work: Array = np.einsum("kj,kj->k", torque[: len(way)], way)
    return work


def work(torque: Array, q: Array) -> Array:
    """Returns the work of a torque that follows the present, of every period, shape (K - 1,), J.

    Args:
        torque: shape (K, 2), N m.
        q: joint angles, shape (K, 2), rad.
    """
    return held_work(0.5 * (torque[:-1] + torque[1:]), q)


def applied(track: Track, scenario: Scenario) -> Array:
    """Returns the torque that the controller held over every period, shape (K - 1, 2), N m.

    tau_k of `digital`; of `second_order` the extrapolated 1.5 tau_k - 0.5 tau_(k-1) within the limit. An arm
    outside of the program was told tau; what its drives made of it in between is not known: the trapezoid.
    """
    spec, tau = scenario.sites[track.site], track.tau
    if spec.plant == "external":
        mean: Array = 0.5 * (tau[:-1] + tau[1:])
        return mean
    u = tau[:-1].copy()
    if Scheme[scenario.scheme.upper()] is Scheme.SECOND_ORDER:
        limit = spec.limits.tau_limit_nm
        u[1:] = np.clip(1.5 * tau[1:-1] - 0.5 * tau[:-2], -limit, limit)
    return u


def stored(spec: SiteSpec, track: Track) -> Array:
    """Returns the arm's kinetic and potential energy, shape (K,), J; of height zero where it is level.

    1/2 qd'M qd + g (theta_4 sin q_1 + theta_5 sin(q_1 + q_2)).
    """
    theta, q = spec.arm.theta, track.q
    kinetic = 0.5 * np.einsum("kj,kj->k", track.qd, inertia_times(theta, q, track.qd))
    height = theta[3] * np.sin(q[:, 0]) + theta[4] * np.sin(q[:, 0] + q[:, 1])
    energy: Array = kinetic + spec.arm.g_m_s2 * height
    return energy


def theta_known(spec: SiteSpec) -> bool:
    """True where the scenario knows the arm's parameters."""
    return bool(getattr(spec.arm, "known", True))


def of_site(scenario: Scenario, track: Track, by: Pushed) -> Facts:
    """Returns the energies of a site's ports, over the periods whose both ends are recorded.

    Args:
        scenario: the experiment.
        track: the site's records.
        by: who pushed it.
    """
    spec, there = scenario.sites[track.site], steps(track)
    if not there.any():
        return unsaid(SITE, "no two records in a row")

    def summed(amounts: Array) -> Array:
        return np.cumsum(np.where(there, amounts, 0.0))

    controller = summed(held_work(applied(track, scenario), track.q))
    hands = summed(work(by.parts.hands, track.q) + held_work(by.parts.hands_held, track.q))
    walls = summed(work(by.parts.walls, track.q) + held_work(by.parts.walls_held, track.q))
    found = {
        "controller_j": said(controller[-1]),
        "hands_j": said(hands[-1]),
        "hands_most_j": said(max(0.0, float(hands.max()))),
        "walls_j": said(walls[-1]) if spec.environment else NO_WALLS,
        "walls_most_j": said(max(0.0, float(walls.max()))) if spec.environment else NO_WALLS,
    }
    if not theta_known(spec):
        return {**found, **unsaid(("mechanical_j", "unaccounted_j"), "theta of the arm is not known")}
    change = summed(np.diff(stored(spec, track)))
    rest = change - controller - hands - walls
    return {
        **found,
        "mechanical_j": said(change[-1]),
        "unaccounted_j": said(float(np.abs(rest).max())),
    }


NO_WALLS = Said(None, "the scenario has no environment here", applies=False)
