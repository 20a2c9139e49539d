"""What a control law says of itself at a site of a scenario: what its stability rests on, its
small motions.

Invariant: a law states both once, as methods of its type. A condition, which `trilat scenario
check` and `trilat linear` print, says if it is only sufficient, and who proved it. Small
motions are blocks of a matrix, of a law that has states, or sends more than its peers' samples
have; what it has in common with a law of known gravity (`linear_gains`) is no part of them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.dominance import find_balancing_weights
from ..core.vectors import Array

PASSIVE_OUTSIDE = "operators and environments are passive (*sufficient*)"
"""What every law that keeps account of energy asks for."""
COMMON_MOTION_SHARE = 0.21723362821
"""-min sin x / x: the share of K T that the common motion of all sites asks for, at its worst
mass.
"""


class LawSituation(NamedTuple):
    """What a law's condition may be made of.

    Attributes:
        site: the index of the site.
        names: of the sites.
        laws: the control of each site.
        alpha: dominance matrix, shape (N, N).
        delay_s: delay of the link from j to i, row i, column j, at least one tick, s; NaN if it
            varies.
        tau_limit_nm: largest torques of the site's joints, N m.
        rate_hz: tick rate of the site, Hz.
        gravity_nm: largest torque by which the site's planar arm is held, N m per joint; () of
            a chain.
        hold_s: for how long a torque is held, s: a tick of the scheme `digital`, NaN if sites
            have several rates; else 0, as in continuous time.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    delay_s: Array
    tau_limit_nm: tuple[float, ...]
    rate_hz: int
    gravity_nm: tuple[float, ...] = ()
    hold_s: float = 0.0

    @property
    def longest_s(self) -> float:
        """The longest delay of links with a dominance factor, s; NaN if one of them varies."""
        return float(np.max(self.delay_s[self.alpha > 0.0], initial=0.0))

    def restrict(self, sites: Sequence[int]) -> "LawSituation":
        """Returns the situation of the same site among some of the sites alone."""
        part = np.ix_(sites, sites)
        return self._replace(
            site=list(sites).index(self.site),
            names=tuple(self.names[n] for n in sites),
            laws=tuple(self.laws[n] for n in sites),
            alpha=self.alpha[part],
            delay_s=self.delay_s[part],
        )


class StabilityCondition(NamedTuple):
    """A law's condition at a site.

    Attributes:
        holds: None if it cannot be said.
        text: the condition with its numbers, what it rests on, and if it is sufficient or
            sharp.
    """

    holds: bool | None
    text: str


def find_least_reversible(alpha: Array) -> float | None:
    """Returns the least eigenvalue of reversible shares, which bounds d by K T; None: they are
    not.
    """
    return (
        None
        if find_balancing_weights(alpha) is None
        else float(np.linalg.eigvals(alpha).real.min())
    )


def judge_position_exchange(
    situation: LawSituation, stiffness: str, damping: str
) -> StabilityCondition:
    """Returns the condition of P+d, whatever the arms weigh; the keys of a law's K and d are
    named.

    Nuno, Basanez, Ortega and Spong, IJRR 28, 2009, for two sites; of more than two the shares
    must be reversible, K and d one for all and the delays one T: docs/errata.md, 13. Torques
    that are held for h act h / 2 later: d is K h / 2 less and T is h / 2 more, for arms whose
    least inertia is above d h / 2 (docs/laws.md).
    """
    T = situation.longest_s
    laws = situation.laws
    h = situation.hold_s
    K, d = (
        np.array([getattr(law, key, [np.nan]) for law in laws]) for key in (stiffness, damping)
    )
    if np.isnan(T) or np.isnan(K).any():
        return StabilityCondition(
            None, "known for constant delays, and with this law at all sites"
        )
    if np.isnan(h):
        return StabilityCondition(None, "known of held torques for sites of one tick rate")
    scope = (
        f"sufficient for arms above d h / 2 = {0.5 * float(d.max()) * h:.3g} kg m^2"
        if h
        else ""
    )
    if h and any(np.any(getattr(law, "Kd", 0.0)) for law in laws):
        scope = "sufficient for heavy arms"
    scope = scope or "sufficient whatever the masses"
    own = d - 0.5 * K * h
    if len(laws) == 2:
        both = float(situation.delay_s.sum()) + h
        pulls = situation.alpha[0, 1] * situation.alpha[1, 0] * K[0] * K[1]
        excess = float((4.0 * own[0] * own[1] - both**2 * pulls).min())
        text = f"4 d1 d2 >= (T1 + T2)^2 K1 K2, T1 + T2 = {1e3 * both:.4g} ms"
        if h:
            text = f"4 (d1 - K1 h / 2) (d2 - K2 h / 2) >= (T1 + T2 + h)^2 K1 K2, the last {1e3 * both:.4g} ms"
        holds = excess >= -1e-9 * float(d.max()) ** 2 and bool((own >= 0.0).all())
        return StabilityCondition(holds, f"{text} ({scope})")
    if (
        np.ptp(K, axis=0).any()
        or np.ptp(d, axis=0).any()
        or np.ptp(situation.delay_s[situation.alpha > 0.0])
    ):
        return StabilityCondition(
            None, "known of more than two sites for one K, one d and one delay"
        )
    least = find_least_reversible(situation.alpha)
    if least is None:
        return StabilityCondition(
            False, "shares that are not reversible: some heavy arms are unstable at any d"
        )
    share = max(
        -least, _find_common_motion_share(2.0 * T / h + 1.0) if h else COMMON_MOTION_SHARE
    )
    bound = 0.5 * h * K[0] + share * K[0] * (T + 0.5 * h)
    text = f"d > {'K h / 2 + ' if h else ''}{share:.4g} K {'(T + h / 2)' if h else 'T'} = {bound.max():.4g}"
    return StabilityCondition(bool((d[0] > bound).all()), f"{text} ({scope})")


def _find_common_motion_share(count: float) -> float:
    """Returns -min sin(n x) / (n sin x), the common motion's share over n = 2 T / h + 1 halves
    of a tick.
    """
    x = np.linspace(np.pi, 2.0 * np.pi, 1001)[1:-1] / count
    return float(-(np.sin(count * x) / (count * np.sin(x))).min())


Place = str | tuple[str, int]
"""A row or column of a form. Rows: "tau"; the rate of a state, by its name; ("to", j): what
peer j is sent.
Columns: "q", "qd", "q_des", "qd_des", a state, ("from", j): what came from peer j, and "tau_h"
ON the arm.
"""


class LinearSituation(NamedTuple):
    """What the small motions of a law may depend on.

    Attributes:
        site: the index of the site.
        names: of the sites.
        laws: the control of each site.
        alpha: dominance matrix in force, shape (N, N).
        inertia: M(q) of the site's arm, shape (n, n), kg m^2.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    inertia: Array

    @property
    def peers(self) -> list[int]:
        """Indices of the other sites."""
        return [j for j in range(len(self.names)) if j != self.site]


class LinearForm:
    """The small motions of a law at a site with n joints; every row and column stands for n
    numbers.

    Args:
        joints: n.
        states: names of its states.
        sends_acceleration: what it sends is the acceleration of its arm, and not what its rows
            say.

    Attributes:
        blocks: by row and column, shape (n, n).
    """

    def __init__(
        self, joints: int, states: Sequence[str] = (), *, sends_acceleration: bool = False
    ) -> None:
        self.joints = joints
        self.states = tuple(states)
        self.sends_acceleration = sends_acceleration
        self.blocks: dict[tuple[Place, Place], Array] = {}

    def add(self, row: Place, column: Place, gain: Any) -> None:
        """Adds a gain per joint, one of all, or a matrix, to a block."""
        block = np.asarray(gain, dtype=np.float64)
        if block.ndim < 2:
            block = np.diag(np.broadcast_to(block, self.joints))
        self.blocks[row, column] = self.blocks.get((row, column), 0.0) + block

    def list_receivers(self) -> list[int]:
        """Returns the peers to which it sends."""
        return sorted({int(row[1]) for row, _ in self.blocks if isinstance(row, tuple)})
