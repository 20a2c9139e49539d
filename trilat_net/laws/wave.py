"""Wave variables: every pair of sites is joined by a line of some impedance, in which waves
travel.

Invariant: an end takes no more energy out of a line than the other end is known to have put in,
whatever becomes of samples (but for the reception `hold`), and puts in no more than it has, H:
what it took, less the work that its torque did on the arm, tau times the step in q.

Of one line and joint, with c = sqrt(2 b) and v the wave that an end plays:

    without a spring of its own (K = 0)    F = b qd - c v, pushed by -F, sends c step / h - v a
    tick later with K and B                           qd_sd = (c v - K (q_sd - q) + B qd) / (b +
    B), q_sd follows,
                                           F = K (q_sd - q) + B (qd_sd - qd), pushed by F, sends
                                           v - (c / b) F

As it sends what its arm did in the period that is over, its waves add up to the steps of its
arm, and to b h qd^2 / 4 more than their work, which H lends until the arm slows down.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, permutations
from typing import Any, ClassVar, Literal, cast

import numpy as np
from msgspec.structs import replace

from ..core.compiled_law import compiled
from ..core.dominance import find_balancing_weights
from ..core.law_energy import LawEnergies, LawRecords, sum_work
from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Array
from ..fields import KeyProblem, NotNegative, NotNegativeJoints, Positive, PositiveJoints
from .conditions import (
    PASSIVE_OUTSIDE,
    LawSituation,
    LinearForm,
    LinearSituation,
    StabilityCondition,
)
from .interface import DAMPING, STIFFNESS, EnergyLaw, TuningSite

RECEPTIONS = ("replay", "zero", "scaled", "hold")
"""How waves are played, by number. `hold` repeats the last wave; it is not passive, and for
comparison.
"""
_REPLAY = 0
_SCALED = 2
_HOLD = 3
CONCEALED_S = 0.005
"""A wave that is held falls to what the known energy pays for this long, s."""
STAMP_FILTER_TICKS = 20.0
"""Time constant of the rate at which stamps advance, ticks."""


@compiled
def replay_wave(law: Any, at: int, fresh: float, energy: float, h: float) -> float:
    """Returns a wave that makes up for those which never came, as far as their energy allows.

    Their integral is owed. It is played at its mean or slower; per unit of it at most its part
    of the energy is spent.
    """
    owed = abs(law.owed_U[at])
    if owed == 0.0:
        return fresh
    sign = 1.0 if law.owed_U[at] > 0.0 else -1.0
    mean = owed / max(law.owed_s[at], CONCEALED_S, h)
    spare = max(energy - 0.5 * law.reserve, 0.0)  # the rest is for waves that are concealed
    extra: float = max(0.0, min(2.0 * (spare / owed - sign * fresh), mean))
    law.owed_U[at] -= sign * extra * h
    law.owed_s[at] = max(law.owed_s[at] - extra / mean * h, 0.0)
    return fresh + sign * extra


@compiled
def conceal_wave(law: Any, at: int, energy: float, h: float) -> float:
    """Returns the wave of a tick without a new one: the last one again, as far as the known
    energy allows.

    It is an advance on what the next sample tells: its integral counts against what is owed.
    """
    most = math.sqrt(2.0 * max(energy, 0.0) / max(CONCEALED_S, h))
    held = max(-most, min(most, law.wave[at]))
    played: float = held
    if law.owed_U[at] * held > 0.0:
        played = replay_wave(
            law=law, at=at, fresh=held, energy=energy - 0.5 * held * held * h, h=h
        )
    law.owed_U[at] -= held * h
    law.held_s[at] += h
    return played


@compiled
def take_wave(law: Any, now: LawInput, j: int, i: int, missed: float) -> float:
    """Returns the wave of line j that an end plays at a tick, and books its energy.

    `missed` counts the samples between the one in use and the one before it; -1: no new one
    came.
    """
    received = now.received[j]
    sent = now.sent[j]
    at = j * now.joints + i
    h = now.h_s
    if now.k == 0 and law.playing == _REPLAY:
        sent.W[i] = law.reserve
    fresh = own = played = 0.0
    if missed < 0.0 and law.playing == _REPLAY:
        played = conceal_wave(law, at, sent.W[i], h)
    elif missed >= 0.0:
        fresh = law.wave[at] = received.u[i]
        own = 0.5 * fresh * fresh * h
        if missed > 0.0:
            energy = max(received.E[i] - law.E_seen[at] - own, 0.0)
            law.owed_U[at] += received.U[i] - law.U_seen[at] - fresh * h
            law.owed_s[at] += max(missed * h - law.held_s[at], 0.0) if energy > 0.0 else 0.0
            sent.W[i] += energy
        law.held_s[at] = 0.0
        law.U_seen[at] = received.U[i]
        law.E_seen[at] = received.E[i]
        played = fresh
    if law.playing == _REPLAY and missed >= 0.0:
        played = replay_wave(law=law, at=at, fresh=fresh, energy=sent.W[i], h=h)
    elif law.playing == _SCALED:
        most = math.sqrt(2.0 * max(sent.W[i] + own, 0.0) / h)
        played = max(-most, min(most, math.sqrt(law.rate[j]) * law.wave[at]))
    elif law.playing == _HOLD:
        played = law.wave[at]
    sent.W[i] += own - 0.5 * played * played * h
    now.to_all.H[i] += 0.5 * played * played * h
    return played


@compiled
def follow_wave(law: Any, now: LawInput, j: int, i: int, v: float) -> float:
    """Moves what an end with a spring follows by a wave v, and answers it; returns the torque
    ON the arm.
    """
    at = j * now.joints + i
    h = now.h_s
    b = law.impedance[at]
    stretch = law.q_sd[at] - now.q[i]
    c = math.sqrt(2.0 * b)
    qd_sd = (c * v - law.K[i] * stretch + law.B[i] * now.qd[i]) / (b + law.B[i])
    force: float = law.K[i] * stretch + law.B[i] * (qd_sd - now.qd[i])
    law.ahead[i] += (law.K[i] * stretch * (qd_sd - now.qd[i])) * h  # what the spring will get
    law.q_sd[at] += h * qd_sd
    now.sent[j].u[i] = v - c / b * force
    return force


@compiled
def close_wave_period(law: Any, now: LawInput, i: int) -> None:
    """Books in H what the arm got in the period before; what the springs of an end got is part
    of H.
    """
    H = now.to_all.H
    spring = 0.0
    for j in range(len(now.peers)):
        at = j * now.joints + i
        if now.k == 0:
            law.q_sd[at] = now.peers[j].q[i]
        if law.impedance[at] > 0.0:
            stretch = law.q_sd[at] - now.q[i]
            spring += 0.5 * law.K[i] * stretch * stretch
    if now.k == 0:
        H[i] = law.reserve + spring
    H[i] -= law.beta * (now.tau_before[i] - law.carried[i]) * (now.q[i] - now.q_before[i])
    law.spring[i] = spring
    most = law.reserve + spring
    if law.K[i] > 0.0 and H[i] > most:  # what is left its damper has taken
        law.damped[i] += H[i] - most
        H[i] = most


@compiled
def send_waves(law: Any, now: LawInput, i: int, ahead: float) -> None:
    """Shrinks the waves of a joint to what H pays for beside what lies ahead, and books them."""
    h = now.h_s
    asked = 0.0
    for j in range(len(now.peers)):
        asked += 0.5 * now.sent[j].u[i] * now.sent[j].u[i] * h
    most = now.to_all.H[i] - law.spring[i] - ahead - 0.5 * law.reserve
    share = 1.0
    if asked > max(most, 0.0):  # of nothing asked nothing is cut
        share = math.sqrt(max(most, 0.0) / asked)
    for j in range(len(now.peers)):
        sent = now.sent[j]
        sent.u[i] *= share
        sent.U[i] += sent.u[i] * h
        sent.E[i] += 0.5 * sent.u[i] * sent.u[i] * h
        now.to_all.H[i] -= 0.5 * sent.u[i] * sent.u[i] * h


def find_line(lines: Mapping[str, Any], site: str, peer: str) -> Any:
    """Returns the impedance that a table such as {"m1-s": 18.0} has for a line, one or per
    joint, or None.
    """
    return lines.get(f"{site}-{peer}", lines.get(f"{peer}-{site}"))


@compiled
class Wave(EnergyLaw):
    """Wave variables: a line of impedance b between every two sites, whose waves carry its
    energy.

    At an end without a spring of its own F = b qd - c v and u = c qd - v, c = sqrt(2 b), v
    being the wave that comes and u the one that goes; an end with K and B follows by them, and
    with B = b reflects nothing. Sites share as b_ij / sum b_ik. After Anderson and Spong
    (1989), Niemeyer and Slotine (1991).

    Attributes:
        b: impedance per joint, N m s/rad.
        K: spring of an end that moves its arm by one, per joint, N m/rad; 0: none.
        B: damper of such an end, per joint, N m s/rad; b matches it to the line.
        lines: impedances of single lines, for all joints, as in { "m1-s" = 18.0 }, N m s/rad;
            0: no line; b of those not named. "shares": those by which sites share as their
            dominance factors at the start say, b on the average, where these are reversible;
            else b.
        beta: the site's torque is divided by it, dimensionless: who feels whom.
        reception: how waves are played if samples are late or lost. "replay": the last one is
            held, and what was missed is made up for, as far as known energy allows; "zero": it
            is dropped, and positions drift; "scaled": the last wave goes on, times sqrt(1 -
            T'), for delays that vary continuously.
        reserve_J: energy per joint with which an end begins, and again for what it plays of
            each line; waves are cut where it has less than half of it.
    """

    b: PositiveJoints = (10.0,)
    K: NotNegativeJoints = (0.0,)
    B: NotNegativeJoints = (10.0,)
    lines: dict[str, NotNegative] | Literal["shares"] = "shares"
    beta: Positive = 1.0
    reception: Literal["replay", "zero", "scaled"] = "replay"
    reserve_J: NotNegative = 1e-2

    fixed_shares: ClassVar = True
    sends: ClassVar[Any] = {
        "u": {"unit": "sqrt(W)", "length": "joints", "per_peer": True},
        "U": {"unit": "sqrt(W) s", "length": "joints", "per_peer": True},
        "E": {"unit": "J", "length": "joints", "per_peer": True},
        "W": {
            "unit": "J",
            "length": "joints",
            "per_peer": True,
        },  # known and not played: for logs
        "H": {"unit": "J", "length": "joints"},  # what this end has, for logs too
    }
    remembers: ClassVar = (
        *("q_sd", "wave", "U_seen", "E_seen", "owed_U", "owed_s", "held_s", "stamp", "rate"),
        *("played", "carried", "damped"),
    )
    tune: ClassVar = {"b": DAMPING, "K": STIFFNESS}

    def begin(self, facts: LawContext) -> None:
        """Makes the lines of this end."""
        n = facts.joints
        peers = len(facts.peers)
        self.impedance: list[float] = []
        for peer in facts.peers:
            line = find_line({} if self.lines == "shares" else self.lines, facts.site, peer)
            self.impedance += self.b if line is None else (np.zeros(n) + line).tolist()
        self.playing = RECEPTIONS.index(self.reception)
        self.q_sd = [0.0] * (n * peers)
        self.wave = [0.0] * (n * peers)
        self.U_seen = [0.0] * (n * peers)
        self.E_seen = [0.0] * (n * peers)
        self.owed_U, self.owed_s, self.held_s = ([0.0] * (n * peers) for _ in range(3))
        self.stamp = [-1.0] * peers
        self.rate = [1.0] * peers
        self.reserve = float(self.reserve_J)
        self.tau_limit = (np.zeros(n) + facts.tau_limit_nm).tolist()
        self.played = [0.0] * (n * peers)
        self.carried = [0.0] * n
        self.ahead = [0.0] * n
        self.spring = [0.0] * n
        self.damped = [0.0] * n

    def torque(self, now: LawInput) -> None:
        """Writes the torque, and sends the waves."""
        n = now.joints
        for i in range(n):
            close_wave_period(self, now, i)
            if self.K[i] == 0.0:
                for j in range(len(now.peers)):
                    c = math.sqrt(2.0 * self.impedance[j * n + i])
                    at = j * n + i
                    now.sent[j].u[i] = (
                        c * (now.q[i] - now.q_before[i]) / now.h_s - self.played[at]
                    )
                send_waves(self, now, i, 0.0)
            self.carried[i] = self.gravity * now.gravity[i]
            now.tau[i] = self.carried[i]
            self.ahead[i] = 0.0
        for j in range(len(now.peers)):
            peer = now.peers[j]
            missed = -1.0
            if peer.new:
                missed = peer.tick - self.stamp[j] - 1.0
                self.stamp[j] = peer.tick
            if self.stamp[j] >= 0.0:
                self.rate[j] += (missed + 1.0 - self.rate[j]) / STAMP_FILTER_TICKS
            for i in range(n):
                b = self.impedance[j * n + i]
                at = j * n + i
                if b == 0.0:
                    continue
                self.played[at] = take_wave(law=self, now=now, j=j, i=i, missed=missed)
                if self.K[i] == 0.0:
                    force = math.sqrt(2.0 * b) * self.played[at] - b * now.qd[i]
                else:
                    force = follow_wave(law=self, now=now, j=j, i=i, v=self.played[at])
                now.tau[i] += force / self.beta
        for i in range(n):
            if self.K[i] > 0.0:
                applied = (
                    max(-self.tau_limit[i], min(self.tau_limit[i], now.tau[i]))
                    - self.carried[i]
                )
                send_waves(
                    self, now, i, self.beta * applied * now.qd[i] * now.h_s + self.ahead[i]
                )

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Returns the energy of the waves, what the end stores, and what its dampers took."""
        gave = [peer.sent["E"] for peer in seen.peers]
        observed = [peer.sent["W"] for peer in seen.peers]
        took = [peer.received["E"] - peer.sent["W"] for peer in seen.peers]
        port = -self.beta * sum_work(seen.tau - seen.memory["carried"], seen.q)
        taken = seen.memory["damped"].sum(axis=1)
        return LawEnergies(
            gave=gave,
            took=took,
            port=port,
            store=seen.to_all["H"],
            taken=taken,
            observed=observed,
            weight=self.beta,
            gravity=self.gravity,
        )

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:
        """Returns a line that joins no two sites, or rates that differ: a wave lasts for a
        tick.
        """
        for line in () if self.lines == "shares" else self.lines:
            if sorted(line.split("-", 1)) not in [
                sorted(two) for two in permutations(rates_hz, 2)
            ]:
                names = ", ".join(rates_hz)
                return KeyProblem(
                    f"control.lines.{line}",
                    f"joins no two sites: name them as in m1-s, of {names}",
                )
        if len({*rates_hz.values()}) > 1:
            return KeyProblem(
                "rate_hz", "wave is for sites of one tick rate, as a wave lasts for a tick"
            )
        return None

    def resolve_shares(self, names: Sequence[str], alpha: Array) -> Any:
        """Returns the law with its lines as numbers: b_ij = D_i alpha_ij, D_i alpha_ij = D_j
        alpha_ji.
        """
        if self.lines != "shares":
            return self
        lines: dict[str, Any] = {}
        pairs = list(combinations(range(len(names)), 2))
        D = find_balancing_weights(alpha)
        if D is not None and np.array_equal(alpha > 0.0, alpha.T > 0.0):
            mean = sum(float(D[i] * alpha[i, j]) for i, j in pairs) / len(pairs)
            for i, j in pairs:
                part = float(f"{D[i] * alpha[i, j] / mean:.12g}")
                lines[f"{names[i]}-{names[j]}"] = tuple(part * b for b in self.b)
        return replace(cast(Any, self), lines=lines)

    def explain_idle_shares(self, at: LawSituation) -> str:
        """Returns what lines do in place of the shares, if these are not theirs."""
        here = at.names[at.site]
        lines = np.array(
            [self.find_impedances(here, peer)[0] * (peer != here) for peer in at.names]
        )
        if np.allclose(lines, at.alpha[at.site] * lines.sum(), atol=1e-6 * lines.sum()):
            return ""
        own = self.lines or find_balancing_weights(at.alpha) is not None
        return f"lines share as b_ij / sum b_ik{'' if own else ', as the shares of sites are not reversible'}"

    def find_impedances(self, site: str, peer: str) -> tuple[float, ...]:
        """Returns the impedance of a line at each joint, N m s/rad; as `resolve_shares` left it."""
        line = find_line({} if self.lines == "shares" else self.lines, site, peer)
        return self.b if line is None else tuple(np.broadcast_to(line, len(self.b)).tolist())

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its gravity."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns lines as the delays that they are, in continuous time, if no wave is late or
        lost.
        """
        if any(self.K) and not all(self.K):
            return None
        here = at.names[at.site]
        form = LinearForm(
            len(at.inertia), [f"q_sd_{at.names[j]}" for j in at.peers] if any(self.K) else []
        )
        K = np.array(self.K)
        B = np.array(self.B)
        for j in at.peers:
            b = np.array(self.find_impedances(here, at.names[j]))
            if not b.all():
                continue
            c = np.sqrt(2.0 * b)
            to = ("to", j)
            came = ("from", j)
            led = f"q_sd_{at.names[j]}"
            if not any(self.K):
                form.add("tau", "qd", -b / self.beta)
                form.add("tau", came, c / self.beta)
                form.add(to, "qd", c)
                form.add(to, came, -1.0)
                continue
            rate = {came: c / (b + B), led: -K / (b + B), "q": K / (b + B), "qd": B / (b + B)}
            for column, own in ((came, 0.0), (led, K), ("q", -K), ("qd", -B)):
                force = own + B * rate[column]
                form.add(led, column, rate[column])
                form.add("tau", column, force / self.beta)
                form.add(to, column, -c / b * force)
            form.add(to, came, 1.0)
        return form

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that the lines are passive, and how sites share."""
        here = situation.names[situation.site]
        peers = [name for name in situation.names if name != here]
        weights = [self.find_impedances(here, peer)[0] for peer in peers]
        shares = ", ".join(
            f"{peer} {line / (sum(weights) or 1.0):.4g}"
            for peer, line in zip(peers, weights, strict=True)
        )
        text = (
            f"lines are passive whatever delays, jitter and loss are, where {PASSIVE_OUTSIDE}"
        )
        return StabilityCondition(
            True, f"{text}; the shares of {here} are b_ij / sum b_ik, {shares}"
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """All ends are matched to their lines, masters too, so that no wave is reflected for
        ever.
        """
        return {**gains, "B": gains["b"], "gravity": at.gravity}
