"""A lossless line between sites, for tests of the energies that a law declares; one variant
makes energy.
"""

from typing import ClassVar

import numpy as np

from trilat_net.core.plug.law_energy import LawEnergies, LawRecords
from trilat_net.core.plug.user_law import LawContext, LawInput


class Line:
    """Wave variables between every two sites (Anderson and Spong 1989): F = b qd - c v, u = c
    qd - v.

    With `boost` the waves are larger than declared by that factor, so that the line makes
    energy.
    """

    sends: ClassVar = {"u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True}}
    remembers: ClassVar = ()
    schemes: ClassVar = ("digital",)

    def __init__(self, facts: LawContext, b: float = 10.0, boost: float = 1.0) -> None:  # noqa: ARG002
        self.b = b
        self.c = (2.0 * b) ** 0.5
        self.boost = boost

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i]
            for j in range(len(now.peers)):
                v = now.received[j].u[i]
                now.tau[i] -= self.b * now.qd[i] - self.c * v
                now.sent[j].u[i] = self.boost * (self.c * now.qd[i] - v)

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns half the square of each wave, because the ends of a line neither dissipate nor store energy."""

        def half_squares(waves: list[np.ndarray]) -> list[np.ndarray]:
            return [np.cumsum(0.5 * seen.h_s * (wave**2).sum(axis=1)) for wave in waves]

        gave = half_squares([peer.sent["u"] for peer in seen.peers])
        took = half_squares([peer.received["u"] for peer in seen.peers])
        force = sum(self.b * seen.qd - self.c * peer.received["u"] for peer in seen.peers)
        port = np.cumsum(seen.h_s * (force * seen.qd).sum(axis=1))
        return LawEnergies(gave, took, port, taken=np.zeros(len(seen.q)))


class Silent(Line):
    """The same line without declared energies."""

    sends: ClassVar = {"u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True}}
    energies = None
