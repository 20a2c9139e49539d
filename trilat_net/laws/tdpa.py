"""Time-domain passivity control (TDPA) of coupled arms: delays cannot create energy.

A coupling connects two arms, a leader and a follower. Each end of a coupling keeps an account
of the energy that enters and leaves it. If an end would extract more energy than the other end
has reported as input, its controller reduces the torque or the velocity.

A spring K and a damper B pull a follower towards a moving goal with the torque F:

    F = K (goal - q) + B (v - qd)
    rate of goal = v = sum_j alpha_j v_j

q and qd are the position and velocity of the follower, v_j the velocity of leader j, and
alpha_j its dominance factor. Leader j feels -alpha_j F. Two arms that follow each other have
two couplings. While an arm waits or is being aligned with its leaders, the goal is shifted,
which costs no energy.

Names: E is the cumulative energy that an end has put in or extracted, and W the energy that an
end may still use. "led" denotes the leader's end and "followed" the follower's end. The work in
a control period is the torque times the motion of the joint (`energy` = "step"), or the torque
times velocity times period ("velocity", as published by Ryu and others).

Invariant:
    - In each coupling and for each joint, each end accumulates the energy that it puts in.
    - The other end never extracts more energy than it knows to have been put in.
"""

import math
from typing import Any, ClassVar, Literal

import numpy as np

from ..core import LawContext, LawEnergies, LawInput, LawRecords, compiled
from ..fields import NotNegative, NotNegativeJoints, Positive
from .conditions import PASSIVE_OUTSIDE, LawSituation, StabilityCondition
from .interface import DAMPING, STIFFNESS, EnergyLaw

SWEEPS = 3
"""Number of iterations for the mutually dependent limited torques of joints and couplings."""
AHEAD = 2.0
"""Number of ticks of a leader's motion for which energy is reserved in advance.

A joint needs one tick to reverse and two ticks to come to rest.
"""
SPENT_S = 0.1
"""Time for which the remaining energy lasts at the rate of drift compensation, s."""
_SLACK_NM = 1e-9
"""Torque below which a follower's controller does not intervene, N m."""


@compiled
def _book_leader_work(
    now: LawInput,
    j: int,
    i: int,
    torque: float,
    step: float,
) -> float:
    """Adds the work of the leader in one control period to the energy account of a coupling.

    If the work is positive, the leader puts energy into the coupling, and the sum E_led that is
    sent to the follower grows. If it is negative, the leader extracts energy.

    Args:
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that follows.
        i: Index of the joint.
        torque: Torque of the coupling, N m.
        step: Motion of the joint, rad.

    Returns:
        The (negative) work if the leader extracts energy, J. Otherwise 0.
    """
    work = torque * step
    input_J = max(work, 0.0)
    now.sent[j].E_led[i] += input_J
    taken: float = min(work, 0.0)
    return taken


@compiled
def _observe_leader(law: Any, now: LawInput, j: int, i: int) -> None:
    """Updates the energy that the leader may still extract from a coupling.

    The leader may extract only energy that the follower has put into the coupling:

        W_led = reserve + E_followed + (sum of the work of the leader where it is negative)

    W_led (the result) is the energy that the leader may still extract, J. E_followed is the
    total energy put in by the follower, as reported in its messages; only its increase since
    the previous tick is added here. If work is computed from the motion of the arm (`energy` =
    "step"), this function also adds the work of the previous control period, because the motion
    is known only now. Otherwise `Tdpa.torque` adds the work of each period in that period.

    Args:
        law: The law. `law.E_known`, the last report of the follower, is updated. `law.F_led` is
            the torque that the leader felt in the previous control period, N m.
        now: Inputs and outputs of the law in this tick. W_led is stored in the message to the
            follower, which still contains the value of the previous tick.
        j: Index of the peer that follows.
        i: Index of the joint.
    """
    index = j * now.joints + i  # position in lists with one entry per coupling and joint
    sent = now.sent[j]
    received = now.received[j]
    available_energy = sent.W_led[i] if now.k > 0 else law.reserve_J
    reported_energy = received.E_followed[i]
    available_energy += reported_energy - law.E_known[index]
    law.E_known[index] = reported_energy
    if law.by_step:
        last_step = now.q[i] - now.q_before[i]
        available_energy += _book_leader_work(
            now=now,
            j=j,
            i=i,
            torque=law.F_led[index],
            step=last_step,
        )
    sent.W_led[i] = available_energy


@compiled
def _invert_inertia(law: Any, now: LawInput) -> None:
    """Computes the inverse of the arm's inertia matrix M, used to predict the motion.

    The result is written into `law.inverse`, row by row. Gauss-Jordan elimination is done in
    place: column p of the inverse replaces column p of M. If the arm's parameters are unknown,
    M is zero, and so is the result.
    """
    n = now.joints
    inverse = law.inverse
    for i in range(n):
        for j in range(n):
            inverse[i * n + j] = now.inertia[i][j]
    for p in range(n):
        pivot_row = p * n
        pivot = inverse[pivot_row + p]
        if pivot == 0.0:
            return
        inverse[pivot_row + p] = 1.0
        for j in range(n):
            inverse[pivot_row + j] /= pivot
        for i in range(n):
            if i == p:
                continue
            row = i * n
            factor = inverse[row + p]
            inverse[row + p] = 0.0
            for j in range(n):
                inverse[row + j] -= factor * inverse[pivot_row + j]


@compiled
def _limit_leader_torque(law: Any, now: LawInput, j: int, i: int) -> None:
    """Limits the torque that the leader of a coupling feels to what the known energy covers.

    The coupling connects this arm (the leader) to follower j. The torque of the follower is
    reduced such that the known energy covers its work during the next `AHEAD` ticks. The
    prediction assumes that the joint continues its motion, and includes the effect of the
    torques that change in this tick, including the torque of the coupling itself. An energy
    deficit is repaid by damping.

    If m is the magnitude of the torque, the predicted cost is

        m (free_step + step_per_torque m)

    where free_step is the motion of the joint against the torque if the torque did not act.

    Args:
        law: The law; its coupling torque F_now is written.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that follows.
        i: Index of the joint.
    """
    n = now.joints
    h = now.h_s
    index = j * n + i
    qd = now.qd[i]
    requested = now.received[j].F[i]
    known_J = now.sent[j].W_led[i]
    available_J = max(known_J - law.floor, 0.0)
    sign = 1.0 if requested > 0.0 else -1.0
    magnitude = abs(requested)

    # Predict the motion of the joint.
    step = qd * h
    step_per_torque = 0.0
    half = 0.5 * h * h
    if law.by_step:
        half *= AHEAD * AHEAD
        row = i * n
        step_per_torque = half * law.inverse[row + i] / law.beta
        step_change = law.predicted_step[i] - step
        step = AHEAD * step + AHEAD**2 * step_change
        for m in range(n):
            inverse_inertia = law.inverse[row + m]
            step += half * inverse_inertia * law.torque_change[m]

    # The motion against the torque, as it would be without this coupling's torque.
    current = law.F_now[index]
    current_step = step_per_torque * sign * current
    disturbance_step = half * law.acceleration_rad_s2
    opposed_step = sign * step
    free_step = disturbance_step - opposed_step - current_step
    torque_step = step_per_torque * magnitude
    cost_J = magnitude * (free_step + torque_step)
    if cost_J > available_J:
        # The magnitude whose cost is the available energy.
        if step_per_torque > 0.0:
            discriminant = free_step * free_step + 4.0 * step_per_torque * available_J
            numerator = math.sqrt(discriminant) - free_step
            root = max(numerator, 0.0)
            magnitude = root / (2.0 * step_per_torque)
        else:
            magnitude = available_J / free_step
    torque = requested if not law.controlled else sign * magnitude

    # Repay a deficit by damping.
    deficit_J = law.floor - known_J
    if law.controlled and step_per_torque > 0.0 and deficit_J > 0.0:
        # Damping dissipates its coefficient times qd times the step.
        squared_step = qd * law.predicted_step[i]
        if squared_step > 0.0:
            couplings = n * len(now.peers)
            repaying_damping = 0.1 * deficit_J / squared_step
            largest_damping = 0.25 * h * AHEAD**2 / (couplings * step_per_torque)
            damping = min(repaying_damping, largest_damping)
            torque += qd * damping

    coupling_change = torque - current
    law.torque_change[i] -= coupling_change / law.beta
    law.F_now[index] = torque


@compiled
def _find_known_energy(law: Any, now: LawInput, j: int, i: int) -> float:
    """Returns the energy that may still be used to move the follower in one coupling, J.

    The known energy is

        E_led + reserve / 2 - E_moved + E_yielded

    E_led is the energy that the leader is known to have put in, E_moved the energy used to move
    the follower, and E_yielded the energy saved when the controller reduced the velocity. The
    other half of the initial reserve is kept for periods that cost more than predicted.

    Args:
        law: The law, with its energy accounts.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that is followed.
        i: Index of the joint.
    """
    index = j * now.joints + i
    moved_J = law.E_moved[index]
    yielded_J = law.E_yielded[index]
    received_J = now.received[j].E_led[i]
    half_reserve_J = 0.5 * law.reserve_J
    known_J: float = received_J + half_reserve_J - moved_J + yielded_J
    return known_J


@compiled
def _limit_follower_velocity(
    law: Any,
    now: LawInput,
    j: int,
    i: int,
    force: float,
    price: float,
) -> float:
    """Reduces the velocity of a followed peer if the known energy does not cover its work.

    This arm follows a peer through a spring and a damper whose goal moves at the velocity of
    the peer. If the goal moves at the velocity v during a period h, the force F of the spring
    and damper does the work F v h. This work must not exceed the known energy, which the peer
    is known to have put in and which has not been spent (`_find_known_energy`). Otherwise, the
    velocity is reduced until the work equals the known energy:

        F v_reduced h = known energy,    v_reduced = v + (known energy - F v h) / (F h)

    The velocity is stored as `law.v_led`, with which the goal is moved later.

    Args:
        law: The law. `law.v_led` is written. If `law.controlled` is False, for comparisons, no
            velocity is reduced.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that is followed.
        i: Index of the joint.
        force: F, this peer's part of the torque of the spring and damper, N m.
        price: Energy expected to be needed in this period in addition to F v h, J. It is
            reserved first if work is computed from the motion of the arm (`law.by_step`).

    Returns:
        The remaining known energy, J. Negative if the unreduced velocity of the peer costs more
        than the known energy.
    """
    index = j * now.joints + i  # position in lists with one entry per coupling and joint
    h = now.h_s
    peer_velocity = now.peers[j].qd[i]
    known_J = _find_known_energy(law, now, j, i)
    if law.by_step:
        known_J = max(known_J - price, 0.0)
    law.v_led[index] = peer_velocity
    # Negative work costs nothing: it puts energy into the coupling.
    cost_J = max(force * peer_velocity * h, 0.0)
    remaining_J: float = known_J - cost_J
    has_force = abs(force) > _SLACK_NM
    if law.controlled and remaining_J < 0.0 and has_force:
        law.v_led[index] += remaining_J / (force * h)
    return remaining_J


@compiled
def _compute_drift_velocity(
    law: Any,
    now: LawInput,
    i: int,
    error: float,
    available_J: float,
) -> float:
    """Returns the velocity that moves the goal back to the peers, within the available energy.

    The goal, towards which a spring and a damper pull the arm, moves at the velocities of the
    followed peers. Because these may have been reduced, the goal drifts away from the peers'
    position. The correction applies to all peers together, so the work of the total torque
    counts. If work is computed from motion (`law.by_step`), the reactions of the damper and the
    spring are included, also those to the velocities of the peers. The power of a correction at
    speed v is linear v + square v^2.

    Args:
        law: The law, with its energy accounts.
        now: Inputs and outputs of the law in this tick.
        i: Index of the joint.
        error: Difference between the peers' position and the goal, rad.
        available_J: Total energy remaining in all couplings, J.

    Returns:
        The velocity, rad/s.
    """
    h = now.h_s
    largest_velocity = law.drift_rad_s
    bounded_above = min(largest_velocity, error / h)
    velocity = max(-largest_velocity, bounded_above)
    sign = 1.0 if velocity > 0.0 else -1.0
    # The coefficients of the power, and the power that the energy allows, W.
    linear = law.force[i] * sign
    square = 0.0
    magnitude = abs(velocity)
    power = available_J / h
    if law.by_step:
        B = law.B[i]
        K = law.K[i]
        power = available_J / max(SPENT_S, h)
        square = B + 0.5 * K * h
        for j in range(len(now.peers)):
            peer = now.peers[j]
            speed = abs(peer.qd[i])
            linear += B * peer.alpha * speed
    # The largest magnitude with linear v + square v^2 <= power.
    if square > 0.0:
        discriminant = linear * linear + 4.0 * square * power
        root = math.sqrt(discriminant)
        magnitude = (root - linear) / (2.0 * square)
    elif linear > 0.0:
        magnitude = power / linear
    affordable = min(magnitude, velocity)
    return float(max(-magnitude, affordable))


@compiled
def _find_affordable_velocity(
    law: Any,
    now: LawInput,
    j: int,
    i: int,
    force: float,
) -> float:
    """Returns the largest velocity of a followed peer that the known energy covers, rad/s.

    The velocity of the peer moves the goal towards which a spring pulls this arm, and the
    torque of the spring does work. Because of delays, this work could exceed the energy that
    the peer has put in, and energy would be created. The velocity is therefore reduced if its
    work would exceed the energy that the peer is known to have put in and that has not been
    spent (`_find_known_energy`).

    Args:
        law: The law. `law.v_led` is the velocity of the peer, which may already have been
            reduced, in rad/s. If `law.controlled` is False, for comparisons, it is returned
            unchanged.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that is followed.
        i: Index of the joint.
        force: Torque of the spring and damper at the joint, N m. The dominance factor `alpha`
            determines the part that belongs to the peer.
    """
    index = j * now.joints + i  # position in lists with one entry per coupling and joint
    # Work in this period for each rad/s of the velocity, J s/rad. It has the sign of the force.
    work_per_velocity = now.peers[j].alpha * force * now.h_s
    known_J = max(_find_known_energy(law, now, j, i), 0.0)
    velocity = float(law.v_led[index])
    if law.controlled and work_per_velocity * velocity > known_J:
        # The work is positive, so the quotient has the sign of the velocity and is smaller.
        return known_J / work_per_velocity
    return velocity


@compiled
def _book_follower(
    law: Any,
    now: LawInput,
    j: int,
    i: int,
    force: float,
    drift: float,
) -> None:
    """Enters the energy of one control period into the accounts of the coupling to peer j.

    The accounts are those of the follower's end (this arm). The velocity of the leader (the
    peer) moves the goal of a spring and damper, which pull the arm with the force F. Cumulative
    energies since the start, J:

        E_led        energy that the leader has put into the coupling, as it reports it
        E_moved      energy taken out of the coupling by moving the goal
        E_followed   energy that this end has put in, which the leader may take out
        E_yielded    energy saved by moving the goal more slowly than the leader, minus the
                     energy that drift compensation took
        W_followed   energy that this end may still take out:

                     W_followed = E_led + reserve - E_moved + E_yielded

    In a period h, a goal with the velocity v extracts F v h, or puts in -F v h if this is
    negative. The law has two forms for v:

    - If work is computed from motion (`law.by_step`), v is the velocity in use, `law.v_led`,
      which the controller may have reduced. No energy is saved in this form.
    - In the published law, v is the velocity of the leader. The difference from the velocity in
      use saves F (v - v_led) h.

    Args:
        law: The law; its accounts of the coupling are updated.
        now: Inputs and outputs of the law in this tick.
        j: Index of the peer that is followed.
        i: Index of the joint.
        force: F, the peer's part of the torque of the spring and damper, N m.
        drift: Energy that drift compensation (moving the goal back towards the peers) takes
            from this coupling, J. Negative if it returns energy, which stays at this end.
    """
    index = j * now.joints + i  # position in lists with one entry per coupling and joint
    h = now.h_s
    sent = now.sent[j]
    used_velocity = law.v_led[index]
    velocity = used_velocity if law.by_step else now.peers[j].qd[i]
    energy = force * velocity * h
    if energy >= 0.0:
        law.E_moved[index] += energy
    else:
        sent.E_followed[i] -= energy
    saved_J = force * (velocity - used_velocity) * h
    law.E_yielded[index] += saved_J - drift
    put_in_J = now.received[j].E_led[i] + law.reserve_J
    moved_J = law.E_moved[index]
    sent.W_followed[i] = put_in_J - moved_J + law.E_yielded[index]


@compiled
def _charge_unpaid_energy(law: Any, now: LawInput, i: int, spring: float) -> None:
    """Charges the couplings for energy that the follower used beyond the prediction.

    Before a control period, each coupling pays for the predicted work. The actual work is known
    only afterwards:

        unpaid = force (step of the arm) + (growth of the spring's energy) - paid

    where `force` is the torque of the spring and damper during the period and `paid` the
    predicted work. If the result is positive, the arm and its spring received more energy than
    was paid for, and the difference is charged to the couplings in proportion to the dominance
    factors alpha. If the result is negative, earlier charges are refunded, up to their total
    amount.

    Accounts of each coupling, J: `E_moved` is the energy extracted so far, and `lent` the part
    of it that was charged by this function and not refunded. `E_yielded` is the energy saved by
    slower motion. `E_settled` is the net energy extracted, E_moved - E_yielded, based on the
    actual work; it is recorded to verify the run.

    Nothing is charged in the published form of the law, which computes work from velocity
    (`law.by_step` is False), or in the first tick.

    Args:
        law: The law; its energy accounts are updated. `law.alignment_step` is the shift of the
            goal while the arm is being aligned with its leaders, rad. This shift costs no
            energy, so the arm's step is measured relative to it.
        now: Inputs and outputs of the law in this tick.
        i: Index of the joint.
        spring: Current energy of the joint's spring, J.
    """
    q_before = now.q_before[i]
    arm_step = now.q[i] - q_before - law.alignment_step[i]
    arm_work = law.force[i] * arm_step
    spring_before = law.spring[i]
    unpaid = arm_work + spring - spring_before - law.paid[i]
    for j in range(len(now.peers)):
        index = j * now.joints + i  # position in lists with one entry per coupling and joint
        if law.by_step and now.k > 0:
            peer_part = now.peers[j].alpha * unpaid
            largest_repayment = law.lent[index]
            charged = max(peer_part, -largest_repayment)
            law.E_moved[index] += charged
            law.lent[index] += charged
        moved_J = law.E_moved[index]
        law.E_settled[index] = moved_J - law.E_yielded[index]
    law.spring[i] = spring


@compiled
def _settle_follower(
    law: Any,
    now: LawInput,
    i: int,
    stretch: float,
    drift_velocity: float,
    available_J: float,
) -> None:
    """Computes the torque of a following joint within the available energy.

    The torque depends on the velocity of the spring's goal, the velocity on the energy, and the
    energy on the torque. Torque and velocity are therefore computed with a fixed number of
    iterations (`SWEEPS`), unless work is computed from velocity. Finally, the work is
    subtracted from the energy account of each coupling.

    Args:
        law: The law; its energy accounts, goal and torque are updated.
        now: Inputs and outputs of the law in this tick.
        i: Index of the joint.
        stretch: Elongation of the spring between the arm and its goal, rad.
        drift_velocity: Velocity of the goal that reduces its distance from the peers, rad/s.
        available_J: Total energy remaining in all couplings, J.
    """
    n = now.joints
    h = now.h_s
    peers = len(now.peers)
    force = law.force[i]
    velocity = 0.0
    for sweep in range(1 + SWEEPS * law.by_step):
        if sweep > 0:
            spring_torque = law.K[i] * stretch
            damper_torque = law.B[i] * (velocity - now.qd[i])
            force = spring_torque + damper_torque
            bounded_above = min(law.high[i], force)
            force = max(law.low[i], bounded_above)
            if force * drift_velocity * h > available_J:
                drift_velocity = available_J / (force * h)
        velocity = drift_velocity
        for j in range(peers):
            index = j * n + i
            if sweep > 0:
                law.v_led[index] = _find_affordable_velocity(
                    law=law,
                    now=now,
                    j=j,
                    i=i,
                    force=force,
                )
            alpha = now.peers[j].alpha
            velocity += alpha * law.v_led[index]

    for j in range(peers):
        # Each coupling pays for drift compensation in proportion to its remaining energy.
        share = 0.0
        if available_J > 0.0:
            share = law.left_J[j * n + i] / available_J
        drift = share * force * drift_velocity * h
        peer_force = now.peers[j].alpha * force
        _book_follower(
            law=law,
            now=now,
            j=j,
            i=i,
            force=peer_force,
            drift=drift,
        )

    law.goal[i] += h * velocity
    law.force[i] = force
    goal_work = force * velocity * h
    alignment_work = force * law.alignment_step[i]
    law.paid[i] = goal_work + alignment_work


@compiled
def _follow_peers(law: Any, now: LawInput, i: int) -> None:
    """Computes the torque with which a joint follows its peers, and the motion of its goal.

    A spring and a damper pull the joint towards a goal that moves at the velocities of the
    peers. The steps are:

    1. Compute the torque of the spring and damper.
    2. Charge energy that was used in the previous control period beyond the prediction.
    3. Reduce the velocities of the peers until the known energy covers their work.
    4. If energy remains, move the goal back towards the true position of the peers.
    5. Compute the final torque, and move the goal.

    Args:
        law: The law; its energy accounts, goal and torque are updated.
        now: Inputs and outputs of the law in this tick.
        i: Index of the joint.
    """
    n = now.joints
    h = now.h_s
    K = law.K[i]
    B = law.B[i]
    peers = len(now.peers)
    target = 0.0
    velocity = 0.0
    for j in range(peers):
        peer = now.peers[j]
        target += peer.alpha * peer.q[i]
        velocity += peer.alpha * peer.qd[i]
    if now.k == 0:
        law.goal[i] = target

    # The reference differs from the peers while the site waits, aligns or holds.
    offset = now.q_des[i] - target
    # The motion of the offset in half a period.
    law.alignment_step[i] = 0.0
    if offset != 0.0:
        offset_rate = now.qd_des[i] - velocity
        law.alignment_step[i] = 0.5 * h * offset_rate

    low = law.low[i]
    high = law.high[i]
    stretch = law.goal[i] + offset - now.q[i]
    spring_torque = K * stretch
    damper_torque = B * (velocity - now.qd[i])
    bounded_above = min(high, spring_torque + damper_torque)
    force = max(low, bounded_above)
    # Beyond the torque limit the energy of the spring grows linearly with its elongation.
    spring_J = 0.0
    if K > 0.0:
        spring_bounded_above = min(high, spring_torque)
        limited_torque = max(low, spring_bounded_above)
        mean_stretch = stretch - 0.5 * limited_torque / K
        spring_J = limited_torque * mean_stretch
    _charge_unpaid_energy(law, now, i, spring_J)
    law.force[i] = force

    # The expected elongation of the spring in this period.
    elongation = velocity * h - law.predicted_step[i]
    mean_torque = 0.5 * K * elongation - damper_torque
    price = max(mean_torque * elongation, 0.0)
    available_J = 0.0
    least_J = 0.0
    for j in range(peers):
        alpha = now.peers[j].alpha
        peer_force = alpha * force
        peer_price = alpha * price
        now.sent[j].F[i] = peer_force
        remaining_J = _limit_follower_velocity(
            law=law,
            now=now,
            j=j,
            i=i,
            force=peer_force,
            price=peer_price,
        )
        left_J = max(remaining_J, 0.0) * (alpha > 0.0)
        law.left_J[j * n + i] = left_J
        available_J += left_J
        least_J = min(least_J, remaining_J)

    drift_velocity = 0.0
    has_drift_control = law.drift_rad_s > 0.0
    costs_are_covered = least_J >= 0.0
    if has_drift_control and available_J > 0.0 and costs_are_covered:
        error = target - law.goal[i] - h * velocity
        drift_velocity = _compute_drift_velocity(
            law=law,
            now=now,
            i=i,
            error=error,
            available_J=available_J,
        )
    _settle_follower(
        law=law,
        now=now,
        i=i,
        stretch=stretch,
        drift_velocity=drift_velocity,
        available_J=available_J,
    )


@compiled
class Tdpa(EnergyLaw):
    """Couples arms such that no end of a coupling extracts more energy than was put in.

    The method is time-domain passivity control. A spring K and a damper B pull each arm towards
    the integral of the velocities of the arms that it follows, weighted by the dominance
    factors. These arms feel the torque of K and B. An arm with K = 0 and B = 0 only leads.

    Source: Ryu, Artigas and Preusche (2010); for several arms Panzirsch and others (2012).

    Attributes:
        K: Stiffness of the spring with which the site follows, per joint, N m/rad. 0 if the
            site follows no other site.
        B: Damping with which the site follows, per joint, N m s/rad.
        acceleration_rad_s2: Largest change of a joint's acceleration per tick, due to torques
            other than those of the law, that the leaders' controllers allow for. Larger changes
            are covered by half of the reserve.
        drift_rad_s: Largest velocity used to realign positions that have drifted apart. If 0,
            drift is not corrected.
        reserve_J: Initial energy of an end, per joint and peer, J.
        energy: How work is computed. "step": torque times the change of q, which is the energy
            that the arm receives. "velocity": torque times velocity times period, as published.
        beta: Divisor of the site's torque, dimensionless, which scales the forces that the
            users feel relative to each other.
    """

    K: NotNegativeJoints = (100.0,)
    B: NotNegativeJoints = (10.0,)
    acceleration_rad_s2: NotNegative = 0.0
    drift_rad_s: NotNegative = 0.5
    reserve_J: NotNegative = 1e-3
    energy: Literal["step", "velocity"] = "step"
    beta: Positive = 1.0

    sends: ClassVar[Any] = {
        "F": {"unit": "N m", "length": "joints", "per_peer": True},
        "E_led": {"unit": "J", "length": "joints", "per_peer": True},
        "E_followed": {"unit": "J", "length": "joints", "per_peer": True},
        # The energies observed at this end. Peers do not need them, but the log shows them.
        "W_led": {"unit": "J", "length": "joints", "per_peer": True},
        "W_followed": {"unit": "J", "length": "joints", "per_peer": True},
    }
    remembers: ClassVar = (
        "goal",
        "F_led",
        "E_known",
        "E_moved",
        "E_yielded",
        "lent",
        "carried",
        "spring",
        "force",
        "paid",
        "E_settled",
    )
    needs_model: ClassVar = True
    tune: ClassVar = {"K": STIFFNESS, "B": DAMPING}
    known_facts: ClassVar = "gravity, and inertia to predict two ticks"
    controlled = True
    """False disables the controllers, for comparison: energies are only observed."""

    def begin(self, facts: LawContext) -> None:
        """Prepares the law before a run by creating its energy accounts and work space.

        This arm has two couplings with each peer: one as the leader of the peer, and one as its
        follower. As a follower, the arm is pulled towards a moving goal by a spring and a
        damper. Each end of a coupling keeps an account of the energy that it may extract. Lists
        with one entry per coupling and joint are flat: joint i of peer j has the index j n + i,
        where n is the number of joints.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        n = facts.joints
        couplings = n * len(facts.peers)

        # Constants.
        self.by_step = self.energy == "step"  # work is torque times motion, see `energy`
        self.controlled = bool(self.controlled)  # as a bool of this instance
        # Energy that the leader's controller does not plan to spend, J. It covers periods that
        # cost more than predicted.
        self.floor = 0.5 * self.reserve_J if self.by_step else 0.0
        limits = np.zeros(n) + facts.tau_limit_nm
        self.tau_limit = limits.tolist()  # largest torque per joint, N m

        # Per joint.
        self.goal = [0.0] * n  # goal of the spring, rad
        self.predicted_step = [0.0] * n  # motion expected in the coming period, rad
        self.low = [0.0] * n  # bounds of the coupling's torque that keep tau in its limits, N m
        self.high = [0.0] * n
        self.torque_change = [0.0] * n  # change of the arm's torque in this period, N m
        self.alignment_step = [0.0] * n  # shift of the goal in half a period, rad

        # Per coupling and joint.
        self.F_led = [0.0] * couplings  # torque felt as a leader in the last period, N m
        self.F_now = [0.0] * couplings  # the same torque while it is being computed, N m
        self.v_led = [0.0] * couplings  # velocity of the leader as the goal uses it, rad/s
        self.E_known = [0.0] * couplings  # energy that the follower has reported last, J
        self.E_moved = [0.0] * couplings  # energy taken out by following, J
        self.E_yielded = [0.0] * couplings  # energy saved by following more slowly, J
        self.lent = [0.0] * couplings  # part of E_moved that was charged afterwards, J
        self.E_settled = [0.0] * couplings  # E_moved - E_yielded with the true work, J
        self.left_J = [0.0] * couplings  # energy that remains in this period, J

        # Per joint.
        self.carried = [0.0] * n  # gravity torque within the last torque, N m
        self.spring = [0.0] * n  # energy in the spring, J
        self.force = [0.0] * n  # torque of spring and damper, N m
        self.paid = [0.0] * n  # predicted work that the couplings have paid, J
        self.inverse = [0.0] * (n * n)  # inverse of the inertia matrix, row by row

    def torque(self, now: LawInput) -> None:
        """Computes the torque of one tick, and sends torques and energies to the peers.

        The arm acts first as a follower and then as a leader. The torque that it feels as a
        leader is reduced if a joint would otherwise exceed its torque limit.

        Args:
            now: Inputs and outputs of the law in this tick.
        """
        n = now.joints
        peers = len(now.peers)
        _invert_inertia(self, now)
        for i in range(n):
            limit = self.tau_limit[i]
            self.torque_change[i] = self.carried[i] - now.tau_before[i]
            carried = self.gravity * now.gravity[i]
            self.carried[i] = carried
            self.low[i] = self.beta * (-limit - carried)
            self.high[i] = self.beta * (limit - carried)
            predicted_step = now.qd[i] * now.h_s
            if now.k > 0:
                last_step = now.q[i] - now.q_before[i]
                predicted_step += predicted_step - last_step
            self.predicted_step[i] = predicted_step
            _follow_peers(self, now, i)
            self.torque_change[i] += self.force[i] / self.beta

            for j in range(peers):
                index = j * n + i
                _observe_leader(self, now, j, i)
                last_force = self.F_led[index]
                self.F_now[index] = last_force
                self.torque_change[i] -= last_force / self.beta

        for _ in range(SWEEPS):
            for i in range(n):
                for j in range(peers):
                    _limit_leader_torque(self, now, j, i)

        for i in range(n):
            felt = 0.0
            force = self.force[i]
            for j in range(peers):
                felt += self.F_now[j * n + i]
            # Factor of the felt torque that keeps the joint's torque within its limits.
            least_felt = force - self.high[i]
            most_felt = force - self.low[i]
            applied = max(least_felt, min(most_felt, felt))
            reduction = 1.0 if applied == felt else applied / felt
            step = now.qd[i] * now.h_s
            for j in range(peers):
                index = j * n + i
                torque = reduction * self.F_now[index]
                self.F_led[index] = torque
                if not self.by_step:
                    taken = _book_leader_work(
                        now=now,
                        j=j,
                        i=i,
                        torque=torque,
                        step=step,
                    )
                    now.sent[j].W_led[i] += taken
            coupling_force = force - applied
            now.tau[i] = self.carried[i] + coupling_force / self.beta

    def energies(self, seen: LawRecords) -> LawEnergies:
        """Computes the energies that show whether the law was passive in a run.

        For each peer, the result contains the energy that this arm put into the two couplings
        with this peer, the energy that it extracted, and the energy that, by its own account,
        it may still extract. The result also contains the energy of the springs and the energy
        that the arm supplied to its controller.

        The energies of the follower lag by one tick, because the work of a control period is
        known only at its end.

        Args:
            seen: Records of the arm in the run, one per tick.
        """
        gave = []
        took = []
        observed = []
        n = seen.q.shape[1]
        for j, peer in enumerate(seen.peers):
            received = peer.received
            sent = peer.sent
            followed = sent["E_followed"]
            followed_before = np.vstack([np.zeros(n), followed[:-1]])
            input_energies = np.hstack([sent["E_led"], followed_before])
            gave.append(input_energies)
            first = j * n
            columns = slice(first, first + n)
            settled = seen.memory["E_settled"][:, columns]
            taken_by_follower = settled - self.reserve_J
            taken_by_leader = received["E_followed"] - sent["W_led"]
            output_energies = np.hstack([taken_by_follower, taken_by_leader])
            took.append(output_energies)
            known_energies = np.hstack([sent["W_led"], sent["W_followed"]])
            observed.append(known_energies)
        coupling_torque = seen.tau - seen.memory["carried"]
        work = seen.sum_work(coupling_torque)
        return LawEnergies(
            gave=gave,
            took=took,
            port=-self.beta * work,
            store=seen.memory["spring"],
            observed=observed,
            weight=self.beta,
            gravity=self.gravity,
        )

    def explain_no_linear_form(self) -> str:
        """Explains to the user why `trilat linear` cannot linearise this law."""
        return "its controllers act by energies, which are of second order in the motion"

    def explain_idle_shares(self, situation: LawSituation) -> str:  # noqa: ARG002
        """Explains to the user that the dominance factors of an arm have no effect.

        This is the case if the stiffness K and the damping B are both zero, because the arm
        then does not follow the others.

        Returns:
            A sentence for the user. Empty if K or B is not zero.
        """
        follows = any(self.K) or any(self.B)
        return "" if follows else "with K = 0 and B = 0, an arm does not follow others"

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns the assumptions under which the law keeps the session passive.

        Passive means that the law never supplies more energy than it received. The law has this
        property for all gains, delays, lost messages and dominance factors, so the condition is
        always satisfied. The assumptions depend on how the law computes work:

        - With `energy` = "step", work is torque times motion, which is exact. However, the work
          of each control period is charged in advance, based on the predicted motion. If
          another torque changes the acceleration, the prediction is wrong. Changes of up to
          `acceleration_rad_s2` are allowed for, and half of `reserve_J` must cover the energy
          of larger changes.
        - With `energy` = "velocity", as in the original publication, work is torque times
          velocity times the control period h. This neglects the acceleration qdd within a
          period, and therefore work of up to tau qdd h^2 / 2, where tau is the torque.

        Returns:
            A condition that holds, with the assumptions as text.
        """
        passive_coupling = (
            "motion stays bounded (decay is not proved): couplings are passive for any delays, "
            f"jitter, loss and shares, where {PASSIVE_OUTSIDE}"
        )
        if self.energy == "velocity":
            leak = "except for up to tau qdd h^2 / 2 per tick that the energy account misses"
            return StabilityCondition(True, f"{passive_coupling}, {leak}")

        planned_change = ""
        if self.acceleration_rad_s2:
            planned_change = f" beyond {self.acceleration_rad_s2:g} rad/s^2"
        reserve = (
            ", if half of reserve_J covers changes of acceleration by other torques in a "
            f"tick{planned_change}"
        )
        return StabilityCondition(True, passive_coupling + reserve)
