"""`tdpa` written again from docs/data/tdpa-steps.txt, and from nothing else.

Arms, hands and the law are this file's own. The network is an input: the sample in use at each
tick is read from the run of the program, which draws delays and losses.
"""

from dataclasses import dataclass, field
from math import cos, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
import pytest

import trilat_net
from tests.unit_arm import make_unit_scenario

Pair = list[float]
H = 1e-3
GRAVITY = 9.81
LINKS = {
    "l1_m": 0.9,
    "m1_kg": 1.2,
    "lc1_m": 0.4,
    "I1_kg_m2": 0.08,
    "l2_m": 0.7,
    "m2_kg": 0.8,
    "lc2_m": 0.3,
    "I2_kg_m2": 0.05,
}
LAW = {"K": 60.0, "B": 6.0, "drift_rad_s": 0.5, "reserve_J": 1e-3, "beta": 1.0}
LIMIT_NM = 60.0
START = [-0.6, 0.9]


def clip(x: float, low: float, high: float) -> float:
    return max(low, min(high, x))


class Arm:
    """A planar arm of two links from the horizontal, by the Euler-Lagrange equations."""

    def __init__(self, **links: float) -> None:
        l1, m1, lc1, I1, _, m2, lc2, I2 = links.values()
        self.inner = m1 * lc1**2 + I1 + m2 * l1**2
        self.outer = m2 * lc2**2 + I2
        self.mixed = m2 * l1 * lc2
        self.weights = ((m1 * lc1 + m2 * l1) * GRAVITY, m2 * lc2 * GRAVITY)

    def inertia(self, q: Pair) -> tuple[float, float, float]:
        """M11, M12 and M22."""
        mixed = self.mixed * cos(q[1])
        return self.inner + self.outer + 2.0 * mixed, self.outer + mixed, self.outer

    def gravity(self, q: Pair) -> Pair:
        outer = self.weights[1] * cos(q[0] + q[1])
        return [self.weights[0] * cos(q[0]) + outer, outer]

    def inverse(self, q: Pair) -> list[Pair]:
        m11, m12, m22 = self.inertia(q)
        det = m11 * m22 - m12 * m12
        return [[m22 / det, -m12 / det], [-m12 / det, m11 / det]]

    def acceleration(self, q: Pair, qd: Pair, torque: Pair) -> Pair:
        h = self.mixed * sin(q[1])
        g1, g2 = self.gravity(q)
        rest1 = torque[0] + h * qd[1] * (2.0 * qd[0] + qd[1]) - g1
        rest2 = torque[1] - h * qd[0] ** 2 - g2
        (a, b), (c, d) = self.inverse(q)
        return [a * rest1 + b * rest2, c * rest1 + d * rest2]


class Hand(NamedTuple):
    """A spring and damper per joint to a pose that moves by minimum jerk from 0.2 s to 1.2 s."""

    to: tuple[float, float]
    stiffness: float
    damping: float

    def torque(self, t: float, q: Pair, qd: Pair) -> Pair:
        s = clip(t - 0.2, 0.0, 1.0)
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        rate = 30.0 * s**2 * (1.0 - s) ** 2
        torque = []
        for i in (0, 1):
            distance = self.to[i] - START[i]
            target = START[i] + distance * way
            pull = self.stiffness * (target - q[i])
            torque.append(pull + self.damping * (distance * rate - qd[i]))
        return torque

    def table(self) -> dict[str, Any]:
        return {
            "kind": "spring",
            "to_rad": list(self.to),
            "move_start_s": 0.2,
            "move_end_s": 1.2,
            "stiffness_nm_rad": self.stiffness,
            "damping_nm_s_rad": self.damping,
        }


def advance_arm(arm: Arm, hand: Hand | None, t: float, q: Pair, qd: Pair, tau: Pair) -> Any:
    """Advances by one period under a held torque, classical Runge-Kutta; the hand acts in every stage."""

    def slope(t: float, q: Pair, qd: Pair) -> tuple[Pair, Pair]:
        pull = hand.torque(t, q, qd) if hand else [0.0, 0.0]
        return qd, arm.acceleration(q, qd, [tau[0] + pull[0], tau[1] + pull[1]])

    def moved(step: float, v: Pair, a: Pair) -> tuple[Pair, Pair]:
        return [x + step * y for x, y in zip(q, v, strict=True)], [
            x + step * y for x, y in zip(qd, a, strict=True)
        ]

    v1, a1 = slope(t, q, qd)
    v2, a2 = slope(t + H / 2.0, *moved(H / 2.0, v1, a1))
    v3, a3 = slope(t + H / 2.0, *moved(H / 2.0, v2, a2))
    v4, a4 = slope(t + H, *moved(H, v3, a3))
    v = [(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(v1, v2, v3, v4, strict=True)]
    a = [(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in zip(a1, a2, a3, a4, strict=True)]
    return moved(H, v, a)


@dataclass
class Message:
    """The message of a site to one peer: its motion and the five numbers of each joint."""

    q: Pair
    qd: Pair = field(default_factory=lambda: [0.0, 0.0])
    F: Pair = field(default_factory=lambda: [0.0, 0.0])
    E_led: Pair = field(default_factory=lambda: [0.0, 0.0])
    E_fol: Pair = field(default_factory=lambda: [0.0, 0.0])


class Site:
    """The law of one site. Names are those of the page."""

    def __init__(self, arm: Arm, alpha: list[float], law: dict[str, float]) -> None:
        self.arm = arm
        self.alpha = alpha
        self.law = law
        r = law["reserve_J"]
        peers = range(len(alpha))
        self.goal = [0.0, 0.0]
        self.F, self.S, self.P, self.G, self.tau = ([0.0, 0.0] for _ in range(5))
        self.U, self.L, self.E_fol, self.Fl, self.R, self.E_led = (
            [[0.0, 0.0] for _ in peers] for _ in range(6)
        )
        self.W = [[r, r] for _ in peers]
        self.W_fol = [[r, r] for _ in peers]

    def tick(self, k: int, q: Pair, qd: Pair, q_before: Pair, got: list[Message]) -> Pair:
        alpha = self.alpha
        law = self.law
        K = law["K"]
        B = law["B"]
        r = law["reserve_J"]
        beta = law["beta"]
        peers = range(len(alpha))
        G = self.arm.gravity(q)
        Q = self.arm.inverse(q)
        self.sent_F = [[0.0, 0.0] for _ in peers]
        p, F_now, low, high, u = ([0.0, 0.0] for _ in range(5))
        for i in (0, 1):
            # 1. prediction
            low[i] = beta * (-LIMIT_NM - G[i])
            high[i] = beta * (LIMIT_NM - G[i])
            p[i] = qd[i] * H if k == 0 else 2.0 * qd[i] * H - (q[i] - q_before[i])
            # 2. torque of the follower; q_des is the target
            target = sum(alpha[j] * got[j].q[i] for j in peers)
            v = sum(alpha[j] * got[j].qd[i] for j in peers)
            if k == 0:
                self.goal[i] = target
            x = self.goal[i] - q[i]
            c = B * (v - qd[i])
            F = clip(K * x + c, low[i], high[i])
            y = clip(K * x, low[i], high[i])
            S = y * (x - y / (2.0 * K)) if K > 0.0 else 0.0
            # 3. the past tick is settled
            if k > 0:
                D = self.F[i] * (q[i] - q_before[i]) + S - self.S[i] - self.P[i]
                for j in peers:
                    D_j = max(alpha[j] * D, -self.L[j][i])
                    self.U[j][i] += D_j
                    self.L[j][i] += D_j
            # 4. velocities that are paid for
            e = v * H - p[i]
            price = max((K * e / 2.0 - c) * e, 0.0)
            paid_v = []
            rest = []
            left = []
            for j in peers:
                F_j = alpha[j] * F
                self.sent_F[j][i] = F_j
                bank = got[j].E_led[i] + r / 2.0 - self.U[j][i]
                known = max(bank - alpha[j] * price, 0.0)
                rest.append(known - max(F_j * got[j].qd[i] * H, 0.0))
                v_j = got[j].qd[i]
                if rest[j] < 0.0 and abs(F_j) > 1e-9:
                    v_j += rest[j] / (F_j * H)
                paid_v.append(v_j)
                left.append(max(rest[j], 0.0) if alpha[j] > 0.0 else 0.0)
            A = sum(left)
            # 5. drift compensation
            w = 0.0
            if law["drift_rad_s"] > 0.0 and A > 0.0 and min(rest) >= 0.0:
                most = law["drift_rad_s"]
                w = clip((target - self.goal[i] - H * v) / H, -most, most)
                b = F * (1.0 if w > 0.0 else -1.0)
                b += sum(B * alpha[j] * abs(got[j].qd[i]) for j in peers)
                g = B + K * H / 2.0
                power = A / max(0.1, H)
                if g > 0.0:
                    m = (sqrt(b * b + 4.0 * g * power) - b) / (2.0 * g)
                else:
                    m = power / b if b > 0.0 else abs(w)
                w = clip(w, -m, m)
            # 6. torque and velocities together
            V = w + sum(alpha[j] * paid_v[j] for j in peers)
            for _ in range(3):
                F = clip(K * x + B * (V - qd[i]), low[i], high[i])
                if F * w * H > A:
                    w = A / (F * H)
                for j in peers:
                    N = max(got[j].E_led[i] + r / 2.0 - self.U[j][i], 0.0)
                    if alpha[j] * F * H * paid_v[j] > N:
                        paid_v[j] = N / (alpha[j] * F * H)
                V = w + sum(alpha[j] * paid_v[j] for j in peers)
            # 7. accounts of the follower
            for j in peers:
                E = alpha[j] * F * paid_v[j] * H
                if E >= 0.0:
                    self.U[j][i] += E
                else:
                    self.E_fol[j][i] -= E
                if A > 0.0:
                    self.U[j][i] += left[j] / A * F * w * H
                self.W_fol[j][i] = got[j].E_led[i] + r - self.U[j][i]
            self.goal[i] += H * V
            self.F[i] = F
            self.S[i] = S
            self.P[i] = F * V * H
            F_now[i] = F
            # 8. accounts of the leader
            for j in peers:
                E = self.Fl[j][i] * (q[i] - q_before[i])
                self.W[j][i] += got[j].E_fol[i] - self.R[j][i] + min(E, 0.0)
                self.R[j][i] = got[j].E_fol[i]
                self.E_led[j][i] += max(E, 0.0)
        # 9. torque that the leader feels
        T = [list(torques) for torques in self.Fl]
        for i in (0, 1):
            u[i] = self.G[i] - self.tau[i] + (F_now[i] - sum(T[j][i] for j in peers)) / beta
        for _ in range(3):
            for i in (0, 1):
                f = 2.0 * H * H * Q[i][i] / beta
                for j in peers:
                    step = 2.0 * qd[i] * H + 4.0 * (p[i] - qd[i] * H)
                    step += 2.0 * H * H * (Q[i][0] * u[0] + Q[i][1] * u[1])
                    m = abs(got[j].F[i])
                    s = 1.0 if got[j].F[i] > 0.0 else -1.0
                    avail = max(self.W[j][i] - r / 2.0, 0.0)
                    free = -s * step - f * s * T[j][i]
                    if m * (free + f * m) > avail:
                        m = max(sqrt(free * free + 4.0 * f * avail) - free, 0.0) / (2.0 * f)
                    t = s * m
                    if self.W[j][i] < r / 2.0 and qd[i] * p[i] > 0.0:
                        repaying = 0.1 * (r / 2.0 - self.W[j][i]) / (qd[i] * p[i])
                        t += qd[i] * min(repaying, H / (2.0 * len(alpha) * f))
                    u[i] -= (t - T[j][i]) / beta
                    T[j][i] = t
        # 10. torque of the site
        tau = [0.0, 0.0]
        for i in (0, 1):
            felt = sum(T[j][i] for j in peers)
            X = clip(felt, F_now[i] - high[i], F_now[i] - low[i])
            for j in peers:
                self.Fl[j][i] = T[j][i] if felt == X else T[j][i] * X / felt
            tau[i] = G[i] + (F_now[i] - X) / beta
        self.G = G
        self.tau = tau
        return tau


HANDS = {"m1": Hand((0.1, 0.5), 40.0, 6.0), "m2": Hand((-0.9, 1.2), 60.0, 4.0), "s": None}
SHARES = {
    "m1": {"m2": 0.3, "s": 0.7},
    "m2": {"m1": 0.55, "s": 0.45},
    "s": {"m1": 0.8, "m2": 0.2},
}
EVEN = {
    "m1": {"m2": 0.5, "s": 0.5},
    "m2": {"m1": 0.5, "s": 0.5},
    "s": {"m1": 0.5, "m2": 0.5},
}
PAIR = {"m1": {"s": 1.0}, "s": {"m1": 1.0}}
RUNS: dict[str, tuple[Any, ...]] = {
    "two sites, 40 ms": (
        PAIR,
        {"model": "constant", "delay_ms": 40.0},
        {"K": 30.0, "B": 3.0},
        650,
    ),
    "two sites, 150 ms, 30 % lost": (
        PAIR,
        {"model": "constant", "delay_ms": 150.0, "loss": 0.3},
        {},
        1600,
    ),
    "three sites, jitter": (
        SHARES,
        {"model": "uniform", "delay_ms": 80.0, "half_width_ms": 60.0},
        {},
        1000,
    ),
    "three sites, even shares, half lost": (
        EVEN,
        {"model": "constant", "delay_ms": 60.0, "loss": 0.5},
        {"beta": 2.0},
        580,
    ),
    "three sites, 200 ms, jitter and loss": (
        SHARES,
        {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 50.0, "loss": 0.2},
        {"K": 90.0, "B": 4.0},
        2500,
    ),
}
"""Shares, link, gains, and the tick from which torques chatter: there the last bits of a number decide."""


FIRST = next(iter(RUNS))


def simulate_page(log: Any, alpha: Any, gains: dict[str, float], ticks: int) -> Any:
    """Returns per site q, tau and the energies W_led and W_followed of every tick, by the page."""
    names = list(alpha)
    law = {**LAW, **gains}
    peers = {name: [peer for peer in names if peer != name] for name in names}
    sites = {
        name: Site(Arm(**LINKS), [alpha[name][peer] for peer in peers[name]], law)
        for name in names
    }
    q = {name: list(START) for name in names}
    qd = {name: [0.0, 0.0] for name in names}
    before = {name: list(START) for name in names}
    sent: dict[tuple[str, str], list[Message]] = {
        (name, peer): [] for name in names for peer in peers[name]
    }
    result: dict[str, dict[str, list[Any]]] = {
        name: {"q": [], "tau": [], "W": []} for name in names
    }
    for k in range(ticks):
        tau = {}
        posted = []
        for name, site in sites.items():
            got = []
            for peer in peers[name]:
                used = int(log[name].used[peer][k])
                got.append(sent[peer, name][used] if used >= 0 else Message(list(START)))
            tau[name] = site.tick(k, q[name], qd[name], before[name], got)
            result[name]["q"].append(q[name])
            result[name]["tau"].append(tau[name])
            observed = [*site.W, *site.W_fol]
            result[name]["W"].append([x for energies in observed for x in energies])
            for j, peer in enumerate(peers[name]):
                motion = (list(q[name]), list(qd[name]), list(site.sent_F[j]))
                message = Message(*motion, list(site.E_led[j]), list(site.E_fol[j]))
                posted.append(((name, peer), message))
        for route, message in posted:
            sent[route].append(message)
        for name, site in sites.items():
            before[name] = q[name]
            q[name], qd[name] = advance_arm(
                site.arm, HANDS[name], k * H, q[name], qd[name], tau[name]
            )
    return {
        name: {key: np.array(rows) for key, rows in columns.items()}
        for name, columns in result.items()
    }


@pytest.mark.parametrize(
    "name",
    [FIRST, *(pytest.param(name, marks=pytest.mark.long) for name in RUNS if name != FIRST)],
)
def test_the_page_alone_gives_the_run(name: str) -> None:
    """Positions and energies agree to 1e-9, and torques to 1e-9 of their limit, until chatter begins."""
    alpha, link, gains, chatter = RUNS[name]
    sites = {
        site: {"q0_rad": START, "hands": [HANDS[site].table()] if HANDS[site] else []}
        for site in alpha
    }
    scenario = make_unit_scenario(
        sites,
        {"law": "tdpa", **LAW, **gains},
        arm={**LINKS, "g_m_s2": GRAVITY},
        limits={"tau_limit_nm": LIMIT_NM, "qd_limit_rad_s": 1e3},
        dominance=alpha,
        link=link,
        duration_s=chatter * H,
    )
    log = trilat_net.simulate(scenario)
    page = simulate_page(log, alpha, gains, chatter)
    least_J = np.inf
    for site in alpha:
        part = log[site]
        assert len(part) == chatter
        assert np.abs(part.q - page[site]["q"]).max() < 1e-9
        assert np.abs(part.tau - page[site]["tau"]).max() < 1e-9 * LIMIT_NM
        peers = [peer for peer in alpha if peer != site]
        energies = [part.sent[f"W_led[{peer}]"] for peer in peers]
        energies += [part.sent[f"W_followed[{peer}]"] for peer in peers]
        observed = np.hstack(energies)
        assert np.abs(observed - page[site]["W"]).max() < 1e-9
        least_J = min(least_J, observed.min())
    # The arms move, and the controllers act: an account is down to the half that is kept.
    assert np.ptp(log["m1"].q, axis=0).min() > 0.05
    assert least_J < 0.55 * LAW["reserve_J"]
