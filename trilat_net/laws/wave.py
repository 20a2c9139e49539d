"""Couples arms with wave variables: delays and lost messages cannot create energy.

A virtual line connects two sites. Instead of forces and velocities, the two ends of a line
exchange waves. A wave w carries the power w^2 / 2, so a delayed wave is stored energy.

For one line and one joint, let q and qd be the position and velocity of the arm, b the
impedance of the line (N m s/rad), c = sqrt(2 b), h the control period, and v the received wave
(or its substitute, if a message is late). The torque on the arm and the sent wave u are

    without a spring:    torque = c v - b qd
                         u = c step / h - v, sent one period later
    with spring K        rate of q_s = (c v - K (q_s - q) + B qd) / (b + B)
    and damper B:        torque = K (q_s - q) + B (rate of q_s - qd)
                         u = v - (c / b) torque

where q_s is the position of the spring's end at the line, and `step` the motion in one period.

Two accounts limit the energy:
- W, for each line: energy that has arrived in waves and has not yet acted on the arm.
- H, for each end: energy that the end may put into its lines, namely the energy extracted from
  the lines minus the work on the arm.

Without a spring, waves carry b h qd^2 / 4 more energy than the work of the arm, because they
describe the previous period. H lends this energy until the arm slows down.

Invariant:
    - An end never extracts more energy from a line than the other end has put in, no matter
      which messages are late or lost. The only exception is the reception mode "hold", which
      exists for comparisons.
    - An end never puts more energy into its lines than its account H contains.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations, permutations
from typing import Any, ClassVar, Literal, cast

import numpy as np
from msgspec.structs import replace

from ..core import (
    Array,
    DominanceMatrix,
    Gains,
    Law,
    LawContext,
    LawEnergies,
    LawInput,
    LawRecords,
    compiled,
)
from ..fields import KeyProblem, NotNegative, NotNegativeJoints, Positive, PositiveJoints
from .conditions import (
    PASSIVE_OUTSIDE,
    BlockKey,
    LawSituation,
    LinearForm,
    LinearSituation,
    StabilityCondition,
)
from .interface import DAMPING, STIFFNESS, EnergyLaw, TuningSite

RECEPTIONS = ("replay", "zero", "scaled", "hold")
"""Ways to choose the wave that acts on the arm. See `Wave`.

`hold` repeats the last wave. It is not passive, and exists only for comparison.
"""
_REPLAY = 0
_SCALED = 2
_HOLD = 3
CONCEALED_S = 0.005
"""Time for which the known energy must last while a wave is repeated, s."""
STAMP_FILTER_TICKS = 20.0
"""Time constant of the filter for the rate at which stamps advance, ticks."""


@compiled
def _replay_wave(
    law: Any,
    index: int,
    fresh: float,
    energy: float,
    h: float,
) -> float:
    """Returns the wave to play, which makes up for lost waves within the known energy.

    A wave acts on the arm (is played) like a force that also carries energy. If lost messages
    were ignored, the arm would end at a wrong position. Later messages contain the integral of
    all waves, from which the integral of the lost waves (the owed integral) is known. It is
    played in addition to the wave of this tick, at the mean rate of the lost waves or slower.
    The known energy is distributed evenly over the owed integral: each unit of the integral may
    use only its share of the energy.

    Args:
        law: The law; its owed integral and owed time are reduced by the part that is played.
        index: Index of the line and joint in the law's lists.
        fresh: The wave that is played in any case, sqrt(W).
        energy: The known energy that has not yet been played, J.
        h: The control period, s.

    Returns:
        The sum of `fresh` and the additional wave, sqrt(W).
    """
    owed_integral = law.owed_U[index]
    owed_s = law.owed_s[index]
    owed = abs(owed_integral)
    if owed == 0.0:
        return fresh

    sign = 1.0 if owed_integral > 0.0 else -1.0
    mean_wave = owed / max(owed_s, CONCEALED_S, h)
    # The other half of the reserve is for the ticks without a sample (`_conceal_wave`).
    free = energy - 0.5 * law.reserve
    available = max(free, 0.0)
    # In addition to the wave f, an extra wave e costs f + e / 2 per unit of the integral.
    energy_per_integral = available / owed
    aligned_wave = sign * fresh
    affordable = 2.0 * (energy_per_integral - aligned_wave)
    largest_extra = min(affordable, mean_wave)
    extra: float = max(0.0, largest_extra)

    repaid_integral = sign * extra * h
    repaid_s = extra / mean_wave * h
    remaining_s = owed_s - repaid_s
    law.owed_U[index] = owed_integral - repaid_integral
    law.owed_s[index] = max(remaining_s, 0.0)
    return fresh + sign * extra


@compiled
def _conceal_wave(law: Any, index: int, energy: float, h: float) -> float:
    """Returns the wave that acts on the arm in a tick in which no message has arrived.

    A wave w in sqrt(W) carries the power w^2 / 2. The previous wave is repeated, but limited
    such that the unused energy E that has arrived would last for the time T = `CONCEALED_S`,
    that is, w^2 T / 2 <= E.

    Two accounts of the law track the missing waves. `owed_U` is the time integral of the lost
    waves that the arm has yet to receive, sqrt(W) s. Because the repeated wave replaces a
    missing one, its integral w h is subtracted from `owed_U`. Otherwise, the arm would receive
    it again after a later message has reported the integral of the missing waves. `held_s` is
    the time for which waves have been repeated since the last message.

    If earlier lost waves of the same sign are still owed, a part of them is added to the
    repeated wave (`_replay_wave`).

    Args:
        law: The law, with its accounts.
        index: Index of the line and joint in the law's lists.
        energy: Unused energy E that has arrived, J.
        h: Control period, s.

    Returns:
        The wave, sqrt(W).
    """
    duration_s = max(CONCEALED_S, h)
    available = max(energy, 0.0)
    largest_wave = math.sqrt(2.0 * available / duration_s)
    last_wave = law.wave[index]
    bounded_above = min(largest_wave, last_wave)
    held = max(-largest_wave, bounded_above)
    played: float = held
    # The product is positive if the owed waves have the sign of the repeated wave.
    if law.owed_U[index] * held > 0.0:
        spent = 0.5 * held * held * h
        remaining = energy - spent
        played = _replay_wave(
            law=law,
            index=index,
            fresh=held,
            energy=remaining,
            h=h,
        )
    anticipated = held * h
    law.owed_U[index] -= anticipated
    law.held_s[index] += h
    return played


@compiled
def _receive_wave(
    law: Any,
    now: LawInput,
    j: int,
    i: int,
    missed: float,
) -> float:
    """Chooses the wave that acts on the arm in one tick, and accounts for its energy.

    The energy of a new sample is added to the account W of the line, which holds the energy
    that has arrived. The energy of the wave that acts (is played) is transferred from W to the
    account H, the energy that this arm may send. The setting `reception` determines which wave
    is played if a sample is late or lost.

    Args:
        law: The law, with its energy accounts.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer at the other end of the line.
        i: Index of the joint.
        missed: Number of samples between the sample in use and the previously used sample. -1
            if there is no new sample.

    Returns:
        The wave to play, sqrt(W).
    """
    received = now.received[j]
    sent = now.sent[j]
    index = j * now.joints + i
    h = now.h_s
    if now.k == 0 and law.playing == _REPLAY:
        sent.W[i] = law.reserve

    # Receive the wave of a new sample, and the energy of the samples that were missed.
    fresh = 0.0
    fresh_energy = 0.0
    played = 0.0
    has_sample = missed >= 0.0
    is_replay = law.playing == _REPLAY
    if not has_sample and is_replay:
        known_energy = sent.W[i]
        played = _conceal_wave(law, index, known_energy, h)
    elif has_sample:
        fresh = received.u[i]
        law.wave[index] = fresh
        fresh_energy = 0.5 * fresh * fresh * h
        if missed > 0.0:
            # The sums U and E contain the waves that did not arrive.
            energy_sum = received.E[i]
            wave_sum = received.U[i]
            missed_energy = energy_sum - law.E_seen[index] - fresh_energy
            missed_integral = wave_sum - law.U_seen[index] - fresh * h
            energy = max(missed_energy, 0.0)
            law.owed_U[index] += missed_integral
            if energy > 0.0:
                missed_s = missed * h
                unplayed_s = missed_s - law.held_s[index]
                law.owed_s[index] += max(unplayed_s, 0.0)
            sent.W[i] += energy
        law.held_s[index] = 0.0
        law.U_seen[index] = received.U[i]
        law.E_seen[index] = received.E[i]
        played = fresh

    # Choose the wave to play.
    if is_replay and has_sample:
        played = _replay_wave(
            law=law,
            index=index,
            fresh=fresh,
            energy=sent.W[i],
            h=h,
        )
    elif law.playing == _SCALED:
        energy = sent.W[i] + fresh_energy
        known_energy = max(energy, 0.0)
        largest_wave = math.sqrt(2.0 * known_energy / h)
        scale = math.sqrt(law.rate[j])
        scaled = scale * law.wave[index]
        bounded_above = min(largest_wave, scaled)
        played = max(-largest_wave, bounded_above)
    elif law.playing == _HOLD:
        played = law.wave[index]

    played_energy = 0.5 * played * played * h
    sent.W[i] += fresh_energy - played_energy
    now.to_all.H[i] += played_energy
    return played


@compiled
def _follow_wave(
    law: Any,
    now: LawInput,
    j: int,
    i: int,
    v: float,
) -> float:
    """Computes the torque with which a received wave moves the arm through a spring.

    The wave moves one end of a spring and damper, and the other end pulls the arm. Part of the
    wave is reflected; the reflected wave is stored in `now` and will be sent to the peer. See
    the module docstring for the equations.

    Args:
        law: The law; the position of the spring is updated.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that sent the wave.
        i: Index of the joint.
        v: The wave, sqrt(W).

    Returns:
        The torque on the arm, N m.
    """
    index = j * now.joints + i
    h = now.h_s
    b = law.impedance[index]
    K = law.K[i]
    B = law.B[i]
    qd = now.qd[i]
    stretch = law.q_sd[index] - now.q[i]
    spring_force = K * stretch
    c = math.sqrt(2.0 * b)
    wave_force = c * v
    arm_force = B * qd
    qd_sd = (wave_force - spring_force + arm_force) / (b + B)
    stretch_rate = qd_sd - qd
    force: float = spring_force + B * stretch_rate
    # The energy that the spring is expected to receive in this period.
    spring_power = spring_force * stretch_rate
    law.spring_gain_J[i] += spring_power * h
    law.q_sd[index] += h * qd_sd
    reflected = c / b * force
    now.sent[j].u[i] = v - reflected
    return force


@compiled
def _close_wave_period(law: Any, now: LawInput, i: int) -> None:
    """Updates the energy account of this end of the lines after a control period.

    H is the energy that this site may send to its peers in waves, plus the energy in its
    springs. The work of the torque on the arm in the previous control period is subtracted. If
    H then exceeds the energy of the springs plus the initial reserve, the excess has been
    dissipated by the dampers and is removed. In the first tick, the springs and H are
    initialised.

    Args:
        law: The law, with its accounts.
        now: Inputs and outputs of the law in this tick.
        i: Index of the joint.
    """
    H = now.to_all.H
    K = law.K[i]
    q = now.q[i]
    is_first = now.k == 0
    spring = 0.0
    for j in range(len(now.peers)):
        index = j * now.joints + i
        if is_first:
            peer = now.peers[j]
            law.q_sd[index] = peer.q[i]
        if law.impedance[index] > 0.0:
            stretch = law.q_sd[index] - q
            spring += 0.5 * K * stretch * stretch
    largest_H = law.reserve + spring
    if is_first:
        H[i] = largest_H

    coupling_torque = now.tau_before[i] - law.carried[i]
    step = q - now.q_before[i]
    work = law.beta * coupling_torque * step
    H[i] -= work
    law.spring[i] = spring
    excess = H[i] - largest_H
    if K > 0.0 and excess > 0.0:
        # The damper of the end has dissipated the excess.
        law.damped[i] += excess
        H[i] = largest_H


@compiled
def _send_waves(law: Any, now: LawInput, i: int, committed: float) -> None:
    """Scales down the waves of a joint if the site lacks the energy to send them.

    A wave u in sqrt(W) that lasts for a control period h carries the energy u^2 h / 2. The site
    keeps an account H of the energy that it may send, J. Part of H is not available: the energy
    stored in the springs, the energy needed in the next period (`committed`), and half of the
    initial reserve, which is kept because the predicted motion in the next period may cost more
    than expected.

    Each message to a peer contains the wave u and two cumulative sums, from which the peer can
    recover the contents of lost messages: U, the sum of u h in sqrt(W) s, and E, the sum of the
    energies in J.

    Args:
        law: The law, with its accounts.
        now: Inputs and outputs of the law in this tick. The waves are scaled, and the sums and
            H are updated.
        i: Index of the joint.
        committed: Energy needed for other purposes in the next period, J.
    """
    h = now.h_s
    H = now.to_all.H
    peers = len(now.peers)
    requested = 0.0
    for j in range(peers):
        wave = now.sent[j].u[i]
        requested += 0.5 * wave * wave * h
    spring_energy = law.spring[i]
    kept_reserve = 0.5 * law.reserve
    free = H[i] - spring_energy - committed - kept_reserve
    available = max(free, 0.0)
    scale = 1.0
    if requested > available:
        # The energy is proportional to the square of the waves.
        scale = math.sqrt(available / requested)

    for j in range(peers):
        sent = now.sent[j]
        wave = sent.u[i] * scale
        energy = 0.5 * wave * wave * h
        sent.u[i] = wave
        sent.U[i] += wave * h
        sent.E[i] += energy
        H[i] -= energy


def _find_line_impedance(lines: Mapping[str, Any], site: str, peer: str) -> Any:
    """Returns the impedance that a user has specified for the line between two sites.

    The order of the two names does not matter.

    Args:
        lines: Mapping from line name to impedance, for example {"m1-s": 18.0}, N m s/rad.
        site: Name of the site at one end of the line.
        peer: Name of the site at the other end.

    Returns:
        A scalar for all joints, or one value per joint. None if no impedance is specified.
    """
    name = f"{site}-{peer}"
    reversed_name = f"{peer}-{site}"
    return lines.get(name, lines.get(reversed_name))


@compiled
class Wave(EnergyLaw):
    """Couples arms with wave variables, which carry energy along virtual lines between arms.

    At an end without a spring, F = b qd - c v and u = c qd - v with c = sqrt(2 b), where v is
    the received wave and u the sent wave. An end with K and B follows the line through this
    spring and damper; if B = b, it reflects no waves. The effective weight that site i gives to
    site j is b_ij / sum_k b_ik, where b_ij is the impedance of the line between them.

    Source: Anderson and Spong (1989); Niemeyer and Slotine (1991).

    Attributes:
        b: Impedance per joint, N m s/rad.
        K: Stiffness of the spring through which an end moves its arm, per joint, N m/rad. 0 for
            an end without a spring.
        B: Damping in parallel with this spring, per joint, N m s/rad. B = b matches the end to
            the line.
        lines: Impedances of individual lines, for all joints, for example { "m1-s" = 18.0 }, N
            m s/rad. 0 removes a line, and lines that are not listed have the impedance b. With
            "shares", the impedances are computed from the initial dominance factors, with the
            mean b, if these factors are reversible; otherwise all impedances are b. Dominance
            factors alpha_ij are reversible if there are positive weights D_i with D_i alpha_ij
            = D_j alpha_ji.
        beta: Divisor of the site's torque, dimensionless, which scales the forces that the
            users feel relative to each other.
        reception: Wave that is used when samples are late or lost. "replay" repeats the last
            wave, and makes up for missed waves within the known energy. "zero" drops missed
            waves, which makes positions drift. "scaled", for continuously varying delays,
            continues the last wave times sqrt(1 - T'), where T' is the rate of change of the
            delay.
        reserve_J: Initial energy of an end, per joint, J. Each line has the same initial energy
            for its waves. An end with less than half of the reserve sends smaller waves.
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
        # W (known energy that has not acted yet) and H (energy of this end) are sent only for
        # logs.
        "W": {"unit": "J", "length": "joints", "per_peer": True},
        "H": {"unit": "J", "length": "joints"},
    }
    remembers: ClassVar = (
        "q_sd",
        "wave",
        "U_seen",
        "E_seen",
        "owed_U",
        "owed_s",
        "held_s",
        "stamp",
        "rate",
        "played",
        "carried",
        "damped",
    )
    tune: ClassVar = {"b": DAMPING, "K": STIFFNESS}

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run by creating the virtual lines to the peers.

        The lines carry no waves yet. Lists with one entry per line and joint are flat: joint i
        of peer j has the index j n + i, where n is the number of joints.

        Waves are in sqrt(W): a wave w carries the power w^2 / 2.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        n = facts.joints
        peers = len(facts.peers)
        ends = n * peers

        # Impedance of each line, N m s/rad. "shares" means that the author of the scenario
        # stated no line by name.
        lines = {} if self.lines == "shares" else self.lines
        self.impedance: list[float] = []
        for peer in facts.peers:
            line = _find_line_impedance(lines, facts.site, peer)
            if line is None:
                self.impedance += self.b
            else:
                impedances = np.zeros(n) + line
                self.impedance += impedances.tolist()
        # A number instead of the string, because `torque` is compiled.
        self.playing = RECEPTIONS.index(self.reception)

        # Per line and joint.
        self.q_sd = [0.0] * ends  # end of the spring that moves with the line, rad
        self.wave = [0.0] * ends  # wave of the newest message, sqrt(W)
        self.U_seen = [0.0] * ends  # integral of all waves, from that message, sqrt(W) s
        self.E_seen = [0.0] * ends  # energy of all waves, from that message, J
        self.owed_U = [0.0] * ends  # integral of lost waves not played yet, sqrt(W) s
        self.owed_s = [0.0] * ends  # duration of these lost waves, s
        self.held_s = [0.0] * ends  # time since the newest message, s

        # Per line.
        self.stamp = [-1.0] * peers  # tick in which the newest message was sent, -1 before it
        self.rate = [1.0] * peers  # filtered increase of the stamp per tick

        # Constants.
        self.reserve = float(self.reserve_J)  # initial energy, J
        limits = np.zeros(n) + facts.tau_limit_nm
        self.tau_limit = limits.tolist()  # largest torque per joint, N m

        self.played = [0.0] * ends  # wave played in the last tick, per line and joint, sqrt(W)

        # Per joint.
        self.carried = [0.0] * n  # gravity torque within the last torque, N m
        self.spring_gain_J = [0.0] * n  # energy that the springs will gain in this tick, J
        self.spring = [0.0] * n  # energy in the springs, J
        self.damped = [0.0] * n  # energy that the dampers have dissipated so far, J

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and sends waves to the other arms.

        The torque is the sum of the gravity compensation and the torques exerted by all
        arriving waves. The steps are:

        1. Update the energy account of each joint with the work of the previous control period.
        2. Send the waves of joints without a spring.
        3. Compute the torque that the arriving waves exert on the arm.
        4. Send the waves of joints with a spring, which depend on the result of step 3.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        n = now.joints
        h = now.h_s
        peers = len(now.peers)
        for i in range(n):
            _close_wave_period(self, now, i)
            if self.K[i] == 0.0:
                # An end without a spring sends the motion of the period that has just ended.
                step = now.q[i] - now.q_before[i]
                for j in range(peers):
                    index = j * n + i
                    b = self.impedance[index]
                    c = math.sqrt(2.0 * b)
                    motion_wave = c * step / h
                    now.sent[j].u[i] = motion_wave - self.played[index]
                _send_waves(self, now, i, 0.0)
            carried = self.gravity * now.gravity[i]
            self.carried[i] = carried
            now.tau[i] = carried
            self.spring_gain_J[i] = 0.0

        for j in range(peers):
            peer = now.peers[j]
            missed = -1.0
            if peer.new:
                missed = peer.tick - self.stamp[j] - 1.0
                self.stamp[j] = peer.tick
            if self.stamp[j] >= 0.0:
                advance = missed + 1.0
                rate = self.rate[j]
                self.rate[j] += (advance - rate) / STAMP_FILTER_TICKS
            for i in range(n):
                index = j * n + i
                b = self.impedance[index]
                if b == 0.0:
                    continue
                played = _receive_wave(
                    law=self,
                    now=now,
                    j=j,
                    i=i,
                    missed=missed,
                )
                self.played[index] = played
                if self.K[i] == 0.0:
                    c = math.sqrt(2.0 * b)
                    force = c * played - b * now.qd[i]
                else:
                    force = _follow_wave(
                        law=self,
                        now=now,
                        j=j,
                        i=i,
                        v=played,
                    )
                now.tau[i] += force / self.beta

        for i in range(n):
            if self.K[i] > 0.0:
                limit = self.tau_limit[i]
                bounded_above = min(limit, now.tau[i])
                limited = max(-limit, bounded_above)
                applied = limited - self.carried[i]
                work = self.beta * applied * now.qd[i] * h
                committed = work + self.spring_gain_J[i]
                _send_waves(self, now, i, committed)

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Computes the energies that show whether the law was passive in a run.

        All energies are in J. The records contain, for each tick:

        - "E": the total energy of the waves sent to or received from a peer so far;
        - "W": the part of the received energy whose waves have not yet acted on the arm, so
          that E - W is the energy used;
        - "H": the energy that this site may still send, including the energy of its springs;
        - "damped": the energy dissipated by the dampers, per joint;
        - "carried": the part of the torque that compensates for gravity, N m. It is subtracted
          from the torque, because its work is unrelated to the waves.

        The torque of the waves is divided by the gain beta before it acts on the arm. The work
        of this torque is therefore multiplied by beta before it is compared with the energy of
        the waves.

        Args:
            seen: Records of the site in the run.

        Returns:
            The energy sent to each peer (`gave`), the energy used from the peer's waves
            (`took`), the energy that the arm supplied to its controller (`port`), H (`store`),
            the dissipated energy (`taken`), and W (`observed`).
        """
        sent_energies = []
        used_energies = []
        unused_energies = []
        for peer in seen.peers:
            unused = peer.sent["W"]  # sent only so that it is recorded
            received = peer.received["E"]
            sent_energies.append(peer.sent["E"])
            used_energies.append(received - unused)
            unused_energies.append(unused)
        coupling_torque = seen.tau - seen.memory["carried"]
        # Work of the controller on the arm; the arm gave the opposite.
        work = seen.sum_work(coupling_torque)
        damped = seen.memory["damped"]
        return LawEnergies(
            gave=sent_energies,
            took=used_energies,
            port=-self.beta * work,
            store=seen.to_all["H"],
            taken=damped.sum(axis=1),
            observed=unused_energies,
            weight=self.beta,
            gravity=self.gravity,
        )

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:
        """Finds a setting that prevents the use of this law in a scenario.

        Each line named in the settings, for example "m1-s", must connect two sites of the
        scenario. All sites must have the same tick rate, because one wave is sent per tick.

        Args:
            rates_hz: Mapping from site name to tick rate, in Hz.

        Returns:
            The key of the setting and the problem. None if the law can be used.
        """
        pairs = [sorted(pair) for pair in permutations(rates_hz, 2)]
        lines = () if self.lines == "shares" else self.lines
        for line in lines:
            ends = line.split("-", 1)
            joins_two_sites = sorted(ends) in pairs
            if not joins_two_sites:
                names = ", ".join(rates_hz)
                return KeyProblem(
                    f"control.lines.{line}",
                    f"does not join two sites: name two of the sites {names}, as in m1-s",
                )
        if len({*rates_hz.values()}) > 1:
            return KeyProblem(
                "rate_hz",
                "must be the same at all sites with the law wave, because a wave lasts for one "
                "tick",
            )
        return None

    def resolve_shares(self, names: Sequence[str], alpha: Array) -> Any:
        """Computes the impedance of each line from the dominance factors of the scenario.

        Site i follows site j in proportion to the impedance of the line between them. To match
        the dominance factors alpha_ij, the impedances are set to

            b_ij = b D_i alpha_ij / m

        where b is the impedance from the settings, D_i are positive weights with D_i alpha_ij =
        D_j alpha_ji, and m is the mean of D_i alpha_ij over all pairs of sites. If no such
        weights exist, all lines get the impedance b. Impedances specified by the user are kept.

        Args:
            names: Names of the N sites.
            alpha: Dominance factors at the start, shape (N, N).

        Returns:
            The law with these impedances.
        """
        if self.lines != "shares":
            return self  # the user has stated the impedances

        lines: dict[str, Any] = {}
        sites = range(len(names))
        pairs = list(combinations(sites, 2))
        D = DominanceMatrix(alpha).find_balancing_weights()
        follows = alpha > 0.0
        is_symmetric = np.array_equal(follows, follows.T)
        if D is not None and is_symmetric:
            weights = [float(D[i] * alpha[i, j]) for i, j in pairs]
            mean = sum(weights) / len(pairs)
            for (i, j), weight in zip(pairs, weights, strict=True):
                # Twelve digits, so that rounding errors of the weights do not show.
                share = float(f"{weight / mean:.12g}")
                line = f"{names[i]}-{names[j]}"
                lines[line] = tuple(share * b for b in self.b)
        return replace(cast(Any, self), lines=lines)

    def explain_idle_shares(self, situation: LawSituation) -> str:
        """Explains to the user why the dominance factors of a site have no effect.

        With this law, the effective weights are determined by the impedances of the lines: if
        the line between sites i and j has the impedance b_ij, site i follows site j with the
        weight b_ij / sum_k b_ik. The dominance factors ("shares") have an effect only if the
        impedances were computed from them (see `resolve_shares`).

        This is possible only if the factors are reversible: since b_ij = D_i alpha_ij must be
        the same in both directions, there must be positive weights D_i with D_i alpha_ij = D_j
        alpha_ji for all sites i and j.

        Args:
            situation: The site, and the dominance factors alpha of the scenario.

        Returns:
            A sentence for the user. Empty if the effective weights equal the dominance factors.
        """
        site = situation.names[situation.site]
        impedances = np.zeros(len(situation.names))
        for index, peer in enumerate(situation.names):
            if peer != site:
                # The first joint represents all joints. Impedances that are computed from
                # dominance factors have the same ratios at every joint.
                joint_impedances = self.find_impedances(site, peer)
                impedances[index] = joint_impedances[0]
        total_impedance = impedances.sum()
        dominance_factors = situation.alpha[situation.site]
        expected_impedances = dominance_factors * total_impedance
        tolerance = 1e-6 * total_impedance
        if np.allclose(impedances, expected_impedances, atol=tolerance):
            return ""

        explanation = "lines share as b_ij / sum b_ik"
        # Without impedances from the user, the law computes them from the factors if these are
        # reversible. Only if they are not is this the cause of the difference.
        are_chosen_by_user = bool(self.lines)
        shares = DominanceMatrix(situation.alpha)
        if are_chosen_by_user or shares.find_balancing_weights() is not None:
            return explanation
        return f"{explanation}, because the shares of the sites are not reversible"

    def find_impedances(self, site: str, peer: str) -> tuple[float, ...]:
        """Returns the impedance of the line between two sites, for each joint, N m s/rad.

        Defaults to the common impedance `b` if the settings specify no impedance for the line.

        Args:
            site: Name of the site at one end of the line.
            peer: Name of the site at the other end.
        """
        lines = {} if self.lines == "shares" else self.lines
        line = _find_line_impedance(lines, site, peer)
        if line is None:
            return self.b
        joints = len(self.b)
        impedances = np.broadcast_to(line, joints)
        return tuple(impedances.tolist())

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the gains of the gravity compensation for the linear analysis.

        The result describes the law with known parameters (`Law.KNOWN`), reduced to the gravity
        torque, with no springs or dampers. All other torques of this law are caused by waves,
        which `linear_form` adds.

        Args:
            theta: The P dynamic parameters of the arm, such as masses, shape (P,).
        """
        # The gravity torque is linear in the parameters: scaled parameters scale the torque
        # by `gravity`, the ratio of the compensated gravity torque to the true one.
        compensated_parameters = theta * self.gravity
        return Gains(Law.KNOWN, known=compensated_parameters.tolist())

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:
        """Returns the torque and the sent waves as linear functions of motion and waves.

        The linear analysis uses these functions for small motions about a resting pose. A line
        is treated as a pure delay in continuous time, with no late or lost waves.

        Args:
            situation: The site, its arm and the other sites.

        Returns:
            The functions, as blocks of a matrix. None if some joints have a spring and others
            do not.
        """
        has_springs = any(self.K)
        if has_springs and not all(self.K):
            return None
        names = situation.names
        site = names[situation.site]
        joints = len(situation.inertia)
        states: list[str] = []
        if has_springs:
            states = [f"q_sd_{names[j]}" for j in situation.peers]
        form = LinearForm(joints, states)
        for j in situation.peers:
            peer = names[j]
            impedances = self.find_impedances(site, peer)
            b = np.array(impedances)
            if not b.all():
                continue
            if has_springs:
                self._add_spring_end(form, j, f"q_sd_{peer}", b)
            else:
                received = ("from", j)
                sent = ("to", j)
                c = np.sqrt(2.0 * b)
                form.add("tau", "qd", -b / self.beta)
                form.add("tau", received, c / self.beta)
                form.add(sent, "qd", c)
                form.add(sent, received, -1.0)
        return form

    def _add_spring_end(self, form: LinearForm, j: int, state: str, b: Array) -> None:
        """Adds the equations of a line that pulls the arm through a spring to the linear form.

        The received wave v moves one end of a spring K with a parallel damper B; q_sd is the
        position of this end. The other end is the arm, with the position q and the velocity qd.
        With the impedance b of the line and c = sqrt(2 b), the rate of q_sd, the force F of the
        spring and damper, the torque tau on the arm and the sent wave u are

            rate = (c v - K q_sd + K q + B qd) / (b + B)
            F    = K (q_sd - q) + B (rate - qd)
            tau  = F / beta
            u    = v - (c / b) F

        All four are linear in v, q_sd, q and qd. The call `form.add(row, column, gain)` adds
        gain times the column to the row. The row of a state is its rate; ("from", j) is the
        wave received from peer j, and ("to", j) the wave sent to it.

        Args:
            form: The law's linear form; modified.
            j: Index of the peer at the other end of the line.
            state: Name of the state q_sd.
            b: Impedance of the line at each joint, N m s/rad.
        """
        K = np.array(self.K)
        B = np.array(self.B)
        c = np.sqrt(2.0 * b)
        damping = b + B
        received = ("from", j)
        sent = ("to", j)
        # For each column: its gain in the rate of q_sd, and its gain in F without the term
        # B times the rate, which the loop adds.
        columns: tuple[tuple[BlockKey, Array, Any], ...] = (
            (received, c / damping, 0.0),
            (state, -K / damping, K),
            ("q", K / damping, -K),
            ("qd", B / damping, -B),
        )
        for column, rate, direct_force in columns:
            force = direct_force + B * rate
            form.add(state, column, rate)
            form.add("tau", column, force / self.beta)
            form.add(sent, column, -c / b * force)
        form.add(sent, received, 1.0)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Evaluates whether the law keeps the coupled arms passive.

        Passive means that they never supply more energy than they received. This is true for
        any delays and lost messages, provided that operators and environments are passive. The
        text also states the effective weight that each arm gives to the others, which is
        proportional to the impedance of the line between them.

        Args:
            situation: The site and the other sites.
        """
        site = situation.names[situation.site]
        peers = [name for name in situation.names if name != site]
        impedances = [self.find_impedances(site, peer)[0] for peer in peers]
        total = sum(impedances) or 1.0
        shares = []
        for peer, impedance in zip(peers, impedances, strict=True):
            share = impedance / total
            shares.append(f"{peer} {share:.4g}")
        text = (
            "motion stays bounded (decay is not proved): lines are passive for any delays, "
            f"jitter and loss, where {PASSIVE_OUTSIDE}; "
            f"the shares of {site} are b_ij / sum b_ik: {', '.join(shares)}"
        )
        return StabilityCondition(True, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The damping B is set to the impedance b of the lines. An arm with B = b absorbs arriving
        waves instead of reflecting them.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "B": gains["b"], "gravity": site.gravity}
