"""Laws from outside, for tests: the paper's law in Python, and some that fail."""

import math
from collections.abc import Sequence

import numpy as np

from trilat_net.core.arms.two_link_arm import regressor
from trilat_net.core.plug.user_law import LawContext, LawInput
from trilat_net.core.step import control


class Adaptive:
    """Eq. (13) and (15) with the trapezoid rule, by the same leaves as the built-in law."""

    def __init__(
        self, facts: LawContext, Lambda: float = 1.0, Kp: float = 1.0, Kd: float = 3.0
    ) -> None:
        self._facts = facts
        self._Lambda, self._Kp, self._Kd = (np.full(2, gain) for gain in (Lambda, Kp, Kd))
        self._Yr = np.zeros(5)
        self.theta_hat = np.zeros(5)

    def torque(self, now: LawInput) -> Sequence[float]:
        q, qd, q_des, qd_des = map(np.array, (now.q, now.qd, now.q_des, now.qd_des))
        e, ed, r = control.control_errors(q, qd, q_des, qd_des, self._Lambda)
        v = -self._Lambda * e
        a = -self._Lambda * ed
        Y = regressor(self._facts.g_m_s2, q, qd, v, a)
        Yr = np.array(control.regressor_transpose_times(Y, r))
        if now.k:
            self.theta_hat = self.theta_hat - 0.5 / self._facts.rate_hz * (self._Yr + Yr)
        self._Yr = Yr
        return control.adaptive_torque(
            Y, self.theta_hat, self._Kp, self._Kd, r, ed, self._facts.tau_limit_nm
        )

    def memory(self) -> Sequence[float]:
        return [*self._Yr, *self.theta_hat]

    def recall(self, memory: Sequence[float]) -> None:
        self._Yr = np.array(memory[:5])
        self.theta_hat = np.array(memory[5:])


class Failing(Adaptive):
    """A law that fails at a tick."""

    def __init__(self, facts: LawContext, how: str = "nan", at: int = 3) -> None:
        super().__init__(facts)
        self._how = how
        self._at = at

    def torque(self, now: LawInput) -> Sequence[float]:
        wrong = self._how if now.k == self._at else ""
        if wrong == "raises":
            raise ValueError("out of\nits depth")
        if wrong == "leaves":
            raise SystemExit(0)
        self._much = wrong == "remembers"
        tau = list(super().torque(now))
        return {"nan": [tau[0], math.nan], "short": tau[:1], "none": None}.get(wrong, tau)  # type: ignore[return-value]

    def memory(self) -> Sequence[float]:
        return [0.0] * 1025 if self._much else super().memory()


class Forgetful(Adaptive):
    """A law that does not declare all of its memory."""

    def memory(self) -> Sequence[float]:
        return [*self._Yr]

    def recall(self, memory: Sequence[float]) -> None:
        self._Yr = np.array(memory)
        self.theta_hat = np.zeros(5)


class Pair(Adaptive):
    sites = 2


class Few(Adaptive):
    sites = (2, 3)


class Odd(Adaptive):
    sites = "many"


class Knowing(Adaptive):
    needs_theta = True


class NoLaw:
    """A class that lacks the methods of a law."""
