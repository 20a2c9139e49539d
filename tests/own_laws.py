"""Users' own laws that repeat built-in ones, and a few that go beyond them."""

import trilat_net
from trilat_net.core.plug.user_law import LawContext, LawInput


class PD:
    """`p_d`, by the reference."""

    remembers: tuple[str, ...] = ()
    tune = {"K": (5.0, 50.0, "N m/rad"), "d": (1.0, 20.0, "N m s/rad")}  # noqa: RUF012

    def __init__(
        self, _facts: LawContext, K: float = 10.0, d: float = 3.0, gravity: float = 1.0
    ) -> None:
        self.K = K
        self.d = d
        self.gravity = gravity

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            pull = self.K * (now.q_des[i] - now.q[i])
            now.tau[i] = self.gravity * now.gravity[i] + pull - self.d * now.qd[i]


@trilat_net.compiled
class CompiledPD(PD):
    """The same, compiled."""


class PeerPD(PD):
    """`p_d`, by the sample of each peer."""

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - self.d * now.qd[i]
            for peer in now.peers:
                now.tau[i] += peer.alpha * self.K * (peer.q[i] - now.q[i])


class Backward(PD):
    """P+d with the velocity from the angle of the last tick."""

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            speed = (now.q[i] - now.q_before[i]) / now.h_s
            now.tau[i] = now.gravity[i] + self.K * (now.q_des[i] - now.q[i]) - self.d * speed


class Remembering(Backward):
    """The same law, which keeps that angle itself."""

    remembers = ("last",)

    def __init__(self, facts: LawContext, K: float = 10.0, d: float = 3.0) -> None:
        super().__init__(facts, K, d)
        self.last = [0.0] * facts.joints

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            last = self.last[i] if now.k else now.q[i]
            self.last[i] = now.q[i]
            speed = (now.q[i] - last) / now.h_s
            now.tau[i] = now.gravity[i] + self.K * (now.q_des[i] - now.q[i]) - self.d * speed


class Forces:
    """`four_channel`: positions, forces of the peers as a sum or separately, and the own force."""

    remembers = ()

    def __init__(
        self,
        _facts: LawContext,
        K: float = 100.0,
        B: float = 20.0,
        own: float = 0.5,
        alone: bool = False,
    ) -> None:
        self.K = K
        self.B = B
        self.own = own
        self.alone = alone

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            felt = now.felt[i]
            if self.alone:
                felt = -sum(peer.alpha * peer.tau_x[i] for peer in now.peers)
            now.tau[i] = (
                now.gravity[i]
                + self.K * (now.q_des[i] - now.q[i])
                + felt
                - self.own * now.tau_x[i]
            )
            now.tau[i] += self.B * (now.qd_des[i] - now.qd[i])


@trilat_net.compiled
class JointPD(PD):
    """`p_d` with gains of each joint."""

    def __init__(
        self,
        facts: LawContext,
        K: list[float],
        d: list[float],
    ) -> None:
        self.K = list(K)
        self.d = list(d)
        assert len(self.K) == len(self.d) == facts.joints

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            pull = self.K[i] * (now.q_des[i] - now.q[i])
            now.tau[i] = now.gravity[i] + pull - self.d[i] * now.qd[i]
