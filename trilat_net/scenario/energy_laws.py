"""Built-in control laws that keep account of energy: their gains and their conditions.

Invariant: as for the laws of `laws.py`. Each is for sites that all have it: what one end sends, the other
end books.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations, permutations
from typing import Any, Literal

import numpy as np
from msgspec.structs import replace

from ..core.dominance import find_balancing_weights
from ..core.laws.tanks import Tanks
from ..core.laws.tdpa import Tdpa
from ..core.laws.wave import Wave, find_line
from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from .fields import KeyProblem, NotNegative, NotNegativeJoints, Positive, PositiveJoints
from .imported_law import PluggedLaw
from .law_conditions import LawSituation, StabilityCondition
from .linear_form import LinearForm, LinearSituation

_PASSIVE = "operators and environments are passive (*sufficient*)"


class EnergyLaw(PluggedLaw, frozen=True):
    """A law of which all sites of a scenario are an end.

    Attributes:
        gravity: share of gravity that it knows, 1: exactly.
    """

    gravity: NotNegative = 1.0

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:  # noqa: ARG002
        """Returns what a site's law has against sites of such rates, or None."""
        return None


class WaveVariables(EnergyLaw, frozen=True, tag_field="law", tag="wave"):
    """Wave variables: a line of impedance b between every two sites, whose waves carry its energy.

    At an end without a spring of its own F = b qd - c v and u = c qd - v, c = sqrt(2 b), v being the wave
    that comes and u the one that goes; an end with K and B follows by them, and with B = b reflects nothing.
    Sites share as b_ij / sum b_ik. After Anderson and Spong (1989), Niemeyer and Slotine (1991).

    Attributes:
        b: impedance per joint, N m s/rad.
        K: spring of an end that moves its arm by one, per joint, N m/rad; 0: none.
        B: damper of such an end, per joint, N m s/rad; b matches it to the line.
        lines: impedances of single lines, for all joints, as in { "m1-s" = 18.0 }, N m s/rad; 0: no line; b
            of those not named. "shares": those by which sites share as their dominance factors at the start
            say, b on the average, where these are reversible; else b.
        beta: the site's torque is divided by it, dimensionless: who feels whom.
        reception: how waves are played if samples are late or lost. "replay": the last one is held, and what
            was missed is made up for, as far as known energy allows; "zero": it is dropped, and positions
            drift; "scaled": the last wave goes on, times sqrt(1 - T'), for delays that vary continuously.
        reserve_J: energy per joint with which an end begins, and again for what it plays of each line; waves
            are cut where it has less than half of it.
    """

    core_class = Wave
    fixed_shares = True

    b: PositiveJoints = (10.0,)
    K: NotNegativeJoints = (0.0,)
    B: NotNegativeJoints = (10.0,)
    lines: dict[str, NotNegative] | Literal["shares"] = "shares"
    beta: Positive = 1.0
    reception: Literal["replay", "zero", "scaled"] = "replay"
    reserve_J: NotNegative = 1e-2

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:
        """Returns a line that joins no two sites, or rates that differ: a wave lasts for a tick."""
        for line in () if self.lines == "shares" else self.lines:
            if sorted(line.split("-", 1)) not in [sorted(two) for two in permutations(rates_hz, 2)]:
                names = ", ".join(rates_hz)
                return KeyProblem(
                    f"control.lines.{line}", f"joins no two sites: name them as in m1-s, of {names}"
                )
        if len({*rates_hz.values()}) > 1:
            return KeyProblem("rate_hz", "wave is for sites of one tick rate, as a wave lasts for a tick")
        return None

    def at_shares(self, names: Sequence[str], alpha: Array) -> "WaveVariables":
        """Returns the law with its lines as numbers: b_ij = D_i alpha_ij, D_i alpha_ij = D_j alpha_ji."""
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
        return replace(self, lines=lines)

    def explain_idle_shares(self, at: LawSituation) -> str:
        """Returns what lines do in place of the shares, if these are not theirs."""
        here = at.names[at.site]
        lines = np.array([self.find_impedances(here, peer)[0] * (peer != here) for peer in at.names])
        if np.allclose(lines, at.alpha[at.site] * lines.sum(), atol=1e-6 * lines.sum()):
            return ""
        own = self.lines or find_balancing_weights(at.alpha) is not None
        return f"lines share as b_ij / sum b_ik{'' if own else ', as the shares of sites are not reversible'}"

    def find_impedances(self, site: str, peer: str) -> tuple[float, ...]:
        """Returns the impedance of a line at each joint, N m s/rad; as `at_shares` left it."""
        line = find_line({} if self.lines == "shares" else self.lines, site, peer)
        return self.b if line is None else tuple(np.broadcast_to(line, len(self.b)).tolist())

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns its gravity."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist())

    def linear_form(self, at: LinearSituation) -> LinearForm | None:
        """Returns lines as the delays that they are, in continuous time, if no wave is late or lost."""
        if any(self.K) and not all(self.K):
            return None
        here = at.names[at.site]
        form = LinearForm(len(at.inertia), [f"q_sd_{at.names[j]}" for j in at.peers] if any(self.K) else [])
        K, B = np.array(self.K), np.array(self.B)
        for j in at.peers:
            b = np.array(self.find_impedances(here, at.names[j]))
            if not b.all():
                continue
            c, to, came, led = np.sqrt(2.0 * b), ("to", j), ("from", j), f"q_sd_{at.names[j]}"
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
            f"{peer} {line / (sum(weights) or 1.0):.4g}" for peer, line in zip(peers, weights, strict=True)
        )
        text = (
            f"lines are passive whatever delays, jitter and loss are, where {_PASSIVE}; the shares of {here}"
        )
        return StabilityCondition(True, f"{text} are b_ij / sum b_ik, {shares}")


class EnergyTanks(EnergyLaw, frozen=True, tag_field="law", tag="tanks"):
    """Two layers: springs to the reference, over a tank per site that pays for what they do.

    Any shares, any delays: the tanks are passive. Franken, Stramigioli, Misra, Secchi and Macchelli, IEEE
    Transactions on Robotics 27 (4), 2011.

    Attributes:
        K: stiffness of the transparency layer per joint, N m/rad.
        Kd: its damping of the error's velocity per joint, N m s/rad.
        d: its damping of the arm's velocity per joint, N m s/rad.
        level_J: level to which a tank is kept, J.
        fill_nm_s_rad_J: damping of the arm per energy that is missing from it, N m s/rad/J.
        packet_1_s: rate at which a tank is emptied towards the peers, 1/s.
        by_shares: true: peers get parts by this site's dominance factors; false: equal ones.
        acceleration_rad_s2: most by which a joint accelerates, as far as tanks cover it: in the period to
            come it moves by qd h and half of this times h^2 more.
    """

    core_class = Tanks

    def explain_no_linear_form(self) -> str:
        """Returns why it cannot be linearised."""
        return "it is the layer where a tank is full enough, and none where it is empty: energy switches it"

    K: PositiveJoints = (100.0,)
    Kd: NotNegativeJoints = (2.0,)
    d: NotNegativeJoints = (0.0,)
    level_J: Positive = 0.1
    fill_nm_s_rad_J: NotNegative = 50.0
    packet_1_s: NotNegative = 10.0
    by_shares: bool = False
    acceleration_rad_s2: NotNegative = 100.0

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that tanks are passive, if no more than all of a tank is sent in a tick."""
        most = f"joints accelerate by {self.acceleration_rad_s2:g} rad/s^2 at most"
        text = f"tanks are passive for any shares, delays and loss, where {_PASSIVE}, and {most}"
        share = self.packet_1_s / situation.rate_hz
        if share > 1.0:
            return StabilityCondition(
                False, f"a tank sends {share:.3g} of its energy a tick, more than it has"
            )
        return StabilityCondition(True, text)


class PassivityControl(EnergyLaw, frozen=True, tag_field="law", tag="tdpa"):
    """Time-domain passivity control with delay: each end watches the energy of its coupling, and damps.

    Every site follows by K and B towards the integral of its peers' velocities, mixed by dominance, and the
    peers feel that torque; K = 0 and B = 0 make a site lead only. After Ryu, Artigas and Preusche (2010); of
    several sites after Panzirsch and others (2012).

    Attributes:
        K: spring by which the site follows, per joint, N m/rad; 0: it follows nobody.
        B: damper by which it follows, per joint, N m s/rad.
        acceleration_rad_s2: by which torques that are not the law's change a joint's acceleration from tick
            to tick, as far as leaders' controllers cover it beforehand; half of the reserve covers it too.
        drift_rad_s: largest velocity by which positions are made to agree again; 0: they drift.
        reserve_J: energy per joint and peer with which an end begins.
        energy: "step": what the arm gets, torque times the step in q; "velocity": torque times velocity times
            period, as it is published.
        beta: the site's torque is divided by it, dimensionless: who feels whom.
    """

    core_class = Tdpa

    def explain_no_linear_form(self) -> str:
        """Returns why it cannot be linearised."""
        return "its controllers act by the energy observed, which is of second order in the motion"

    K: NotNegativeJoints = (100.0,)
    B: NotNegativeJoints = (10.0,)
    acceleration_rad_s2: NotNegative = 0.0
    drift_rad_s: NotNegative = 0.5
    reserve_J: NotNegative = 1e-3
    energy: Literal["step", "velocity"] = "step"
    beta: Positive = 1.0

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns that a site without K and B follows nobody."""
        return "" if any(self.K) or any(self.B) else "K = 0 and B = 0 follow nobody"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns that the couplings are passive, as far as motion can be foretold."""
        text = f"couplings are passive for any delays, jitter, loss and shares, where {_PASSIVE}, "
        if self.energy == "velocity":
            return StabilityCondition(True, f"{text}in books that leak tau qdd h^2 / 2 a tick")
        beyond = f" beyond {self.acceleration_rad_s2:g} rad/s^2" if self.acceleration_rad_s2 else ""
        paid = (
            f"while half of reserve_J pays for what other torques change accelerations by in a tick{beyond}"
        )
        return StabilityCondition(True, f"{text}{paid}")
