"""Laws that look at peers and send to all and to each, plain and compiled; some are unsuitable
for Numba.
"""

from typing import Any, ClassVar

from trilat_net import compiled
from trilat_net.core.plug.user_law import LawContext, LawInput


class Line:
    """Springs to each peer, an energy sent to all, an integral and a count; the law uses every input."""

    sends: ClassVar[Any] = {
        "E": {"unit": "J", "length": 1},
        "u": {"unit": "N m", "length": "joints", "per_peer": True},
    }
    remembers = ("integral", "count")
    needs_model = True

    def __init__(self, facts: LawContext, K: float = 20.0, fail_at: int = -1) -> None:
        self.K = K
        self.fail_at = fail_at
        self.integral = [[0.0] * facts.joints for _ in facts.peers]
        self.count = 0
        self.signs = tuple(1 if i % 2 else -1 for i in range(facts.joints))
        self.note = facts.site

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            total = (
                now.gravity[i]
                + 0.01 * now.bias[i]
                + 0.05 * now.tau_x[i]
                - 0.1 * now.tau_before[i]
            )
            for j in range(len(now.peers)):
                peer = now.peers[j]
                difference = now.q[i] - peer.q[i]
                self.integral[j][i] += now.h_s * difference
                pull = peer.alpha * (self.K * difference + half(self.integral[j][i]))
                if peer.new:
                    pull += 1e-3 * peer.tick + 0.1 * peer.age_s + 0.01 * peer.tau_x[i]
                now.sent[j].u[i] = pull
                total -= (
                    pull
                    + 0.1 * now.received[j].u[i]
                    - self.signs[i] * 0.01 * now.received[j].E[0]
                )
            now.to_all.E[0] += total * (now.q[i] - now.q_before[i])
            now.tau[i] = total - 5.0 * now.inertia[i][i] * now.qd[i]
            now.theta_hat[i] = self.integral[0][i]
        self.count += 1
        if self.count == self.fail_at:
            now.tau[0] /= self.count - self.fail_at


@compiled
def half(x: float) -> float:
    return 0.5 * x


@compiled
class CompiledLine(Line):
    sends: ClassVar[Any] = {
        "E": {"unit": "J", "length": 1},
        "u": {"unit": "N m", "length": "joints", "per_peer": True},
    }


def plain(x: float) -> float:
    return x


@compiled
class Refused:
    """Code that Numba refuses, by name."""

    remembers = ()

    def __init__(self, _facts: LawContext) -> None:
        self.name = "x"
        self.work = [0.0, 0.0]
        self.limits = {"low": 0.0}

    def double(self, x: float) -> float:
        return 2.0 * x


@compiled
class CallsPlain(Refused):
    def torque(self, now: LawInput) -> None:
        now.tau[0] = plain(now.q[0])


@compiled
class CallsMethod(Refused):
    def torque(self, now: LawInput) -> None:
        now.tau[0] = self.double(now.q[0])


@compiled
class ReadsText(Refused):
    def torque(self, now: LawInput) -> None:
        now.tau[0] = len(self.name)


@compiled
class ReadsNothing(Refused):
    def torque(self, now: LawInput) -> None:
        now.tau[0] = self.gain  # type: ignore[attr-defined]


@compiled
class MakesList(Refused):
    def torque(self, now: LawInput) -> None:
        self.work = [now.q[0]] * 2


@compiled
class Returns(Refused):
    def torque(self, now: LawInput) -> Any:
        return now.q[0], now.q[1]


@compiled
class RemembersText(Refused):
    remembers = ("name",)

    def torque(self, now: LawInput) -> None:
        now.tau[0] = 0.0


@compiled
class Forgets(Refused):
    """A law that writes no torque at tick 3."""

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            if now.k < 3:
                now.tau[i] = 0.0


@compiled
class BeyondEnd(Refused):
    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = self.work[now.k]


class Arithmetic:
    """P+d without memory, of whole vectors."""

    def __init__(self, _facts: LawContext) -> None:
        self.K = 20.0
        self.d = 5.0

    def torque(self, now: LawInput) -> Any:
        pulls = [peer.alpha * (now.q - peer.q) for peer in now.peers]
        return now.gravity - self.K * sum(pulls, 0.0 * now.q) - self.d * now.qd


@compiled
class ByNumbers(Arithmetic):
    """The same law, number by number."""

    def torque(self, now: LawInput) -> Any:
        for i in range(now.joints):
            pull = 0.0 * now.q[i]
            for j in range(len(now.peers)):
                pull += now.peers[j].alpha * (now.q[i] - now.peers[j].q[i])
            now.tau[i] = now.gravity[i] - self.K * pull - self.d * now.qd[i]


class Sums(Arithmetic):
    """A law with undeclared memory."""

    def torque(self, now: LawInput) -> Any:
        self.sums = now.q
        return -now.q


class SumsEach(Arithmetic):
    def torque(self, now: LawInput) -> Any:
        self.sums[0] += now.q[0]
        return -now.q


class Squares(Arithmetic):
    def torque(self, now: LawInput) -> Any:
        return -(now.qd**2)


class Mismatched(Arithmetic):
    def torque(self, now: LawInput) -> Any:
        return now.q - [0.0, 0.0, 0.0]
