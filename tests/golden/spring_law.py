"""A spring and a damper towards the peers, and an integrator that takes on gravity (docs/own-controller.md).

`own-law.mcap` was made with this file: not a byte of it may change.
"""

from trilat_net.core.user_law import LawContext, LawInput


class Spring:
    """tau = -K e - d qd - I (integral of e), e = q - q_des."""

    def __init__(self, facts: LawContext, K: float = 60.0, d: float = 25.0, I: float = 40.0) -> None:
        self.h_s = 1.0 / facts.rate_hz
        self.K, self.d, self.I = K, d, I
        self.sum = [0.0, 0.0]

    def torque(self, now: LawInput) -> list[float]:
        error = [q - goal for q, goal in zip(now.q, now.q_des)]
        self.sum = [s + self.h_s * e for s, e in zip(self.sum, error)]
        return [-self.K * e - self.d * w - self.I * s for e, w, s in zip(error, now.qd, self.sum)]

    def memory(self) -> list[float]:
        return self.sum

    def recall(self, memory: list[float]) -> None:
        self.sum = list(memory)
