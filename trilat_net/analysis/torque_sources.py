"""Torque on an arm by its sources, operator and environment models, over all rows of a log at
once.

Invariant: written from the definitions of the scenario, independently of the core; the tests
compare the two. Torques act ON the arm. A torque that the scenario does not explain is the
operator's: the record's torque less the environment's. An operator has a script only if its
torque matches the scenario.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ..core.exogenous import LIVE_KINDS, OWN_KINDS, SCRIPTED_KINDS, TorqueKind, TorqueSource
from ..core.vectors import Array
from ..log.log_reader import Log
from ..scenario import Scenario, SiteSpec
from ..scenario.operators import ActorBase
from .aligned import AlignedRecords, align_records
from .arm_rows import EndEffectorRows, build_arm_rows

SCRIPT_TORQUE_TOLERANCE = 1e-8
"""Relative difference up to which a torque is the scenario's."""


def list_walls(spec: SiteSpec) -> list[TorqueSource]:
    """Returns the walls of a site, in scenario order."""
    return [one.actor for one in spec.environment if one.actor.kind is TorqueKind.WALL]


def wall_depth(wall: TorqueSource, end_effector: EndEffectorRows) -> Array:
    """Returns the depth of an end effector in a wall, shape (K,), m; negative outside of it."""
    found: Array = (np.array(wall.a) - end_effector.position) @ np.array(wall.b)
    return found


def wall_force(wall: TorqueSource, t_s: Array, end_effector: EndEffectorRows) -> Array:
    """Returns the force of a wall along its normal, shape (K,), N: it pushes, and never pulls.

    max(K depth - B outward speed, 0) inside of it, 0 outside, and before its start and after
    its end.
    """
    depth = wall_depth(wall, end_effector)
    push = np.maximum(
        wall.K[0] * depth - wall.B[0] * (end_effector.speed @ np.array(wall.b)), 0.0
    )
    there = (t_s >= wall.start_s) & (t_s < wall.end_s) & (depth > 0.0)
    return np.where(there, push, 0.0)


def compute_target_motion(source: TorqueSource, t_s: Array) -> tuple[Array, Array]:
    """Returns the target of a spring, which moves from a to b with minimum jerk, and its
    velocity, (K, n).
    """
    span_s = source.move_end_s - source.move_start_s
    x = (t_s > source.move_start_s).astype(np.float64)
    per_s = 0.0
    if span_s > 0.0:
        x = np.clip((t_s - source.move_start_s) / span_s, 0.0, 1.0)
        per_s = 1.0 / span_s
    a = np.array(source.a)
    way = np.array(source.b) - np.array(source.a)
    x = x[:, None]
    return a + x**3 * (10.0 + x * (6.0 * x - 15.0)) * way, 30.0 * x**2 * (
        1.0 - x
    ) ** 2 * per_s * way


def compute_spring_effort(source: TorqueSource, t_s: Array, at: Array, speed: Array) -> Array:
    """Returns K (target - at) + B (its velocity - speed), per joint or axis, shape (K, n)."""
    target, velocity = compute_target_motion(source, t_s)
    found: Array = np.array(source.K) * (target - at) + np.array(source.B) * (velocity - speed)
    return found


def compute_source_torque(
    source: TorqueSource, t_s: Array, q: Array, qd: Array, end_effector: EndEffectorRows
) -> Array:
    """Returns the torque of a spring, a damper, a wall or an own kind ON the arm, shape (K, n),
    N m.

    Raises:
        ValueError: it is another source: a scripted torque is no function of the state.
    """
    if source.kind is TorqueKind.WALL:
        force = wall_force(source, t_s, end_effector)[:, None] * np.array(source.b)
        pushed = np.einsum("kij,ki->kj", end_effector.J, force)
    elif source.kind is TorqueKind.VISCOUS:
        pushed = -np.array(source.B) * qd
    elif source.kind is TorqueKind.HAND:
        pushed = compute_spring_effort(source, t_s, q, qd)
    elif source.kind is TorqueKind.TASK_HAND:
        effort = compute_spring_effort(source, t_s, end_effector.position, end_effector.speed)
        pushed = np.einsum("kij,ki->kj", end_effector.J, effort)
    elif source.kind is TorqueKind.OWN_JOINTS:
        pushed = source.model.effort(t_s, q, qd)
    elif source.kind is TorqueKind.OWN_TIP:
        effort = source.model.effort(t_s, end_effector.position, end_effector.speed)
        pushed = np.einsum("kij,ki->kj", end_effector.J, effort)
    else:
        raise ValueError(f"{source.kind.name} is no function of the state")
    there = (t_s >= source.start_s) & (t_s < source.end_s)
    return np.where(there[:, None], pushed, 0.0)


def compute_live_torque(
    source: TorqueSource, hand: Array, q: Array, qd: Array, end_effector: EndEffectorRows
) -> Array:
    """Returns the torque of a live hand ON the arm, shape (K, n), N m, by the `hand` of its
    records.
    """
    size = (hand.shape[1] - 3) // 2
    target = hand[:, 3 : 3 + size]
    rate = hand[:, 3 + size :]
    at_joints = source.kind is TorqueKind.LIVE_JOINT
    at, speed = (q, qd) if at_joints else (end_effector.position, end_effector.speed)
    pull = target
    if source.kind is not TorqueKind.LIVE_FORCE:
        pull = np.array(source.K) * (target - at) + np.array(source.B) * (rate - speed)
    norm = np.linalg.norm(pull, axis=1)
    share = hand[:, 0] * np.where(
        norm > source.limit, source.limit / np.maximum(norm, source.limit), 1.0
    )
    effort: Array = share[:, None] * pull
    return effort if at_joints else np.einsum("kij,ki->kj", end_effector.J, effort)


class TorqueSplit(NamedTuple):
    """The torque ON an arm over its rows, shape (K, n) each, N m; its stops are part of the
    arm.

    Attributes:
        end_effector: its position, speed and Jacobian. operator_now, operator_held: of the
        operator: a function of the present, and computed once a tick. environment_now,
        environment_held: the same of the environment.
        script: the operator's intention, see `compute_operator_script`; None if not asked for,
            or if its torque does not match the scenario.
    """

    end_effector: EndEffectorRows
    operator_now: Array
    operator_held: Array
    environment_now: Array
    environment_held: Array
    script: Array | None = None

    @property
    def operator(self) -> Array:
        """Of the operator in all, shape (K, n), N m."""
        return self.operator_now + self.operator_held

    @property
    def environment(self) -> Array:
        """Of the environment in all, shape (K, n), N m."""
        return self.environment_now + self.environment_held


def split_torque(records: AlignedRecords, scenario: Scenario) -> TorqueSplit:
    """Returns the torque on a site's arm by its sources, held and not; without the script."""
    spec = scenario.sites[records.site]
    t_s = records.nominal_s
    end_effector = build_arm_rows(scenario, records.site).place_end_effector(
        records.q, records.qd
    )

    def add(sources: Iterable[ActorBase], *, sampled: bool) -> Array:
        total = np.zeros_like(records.q)
        for source in (one.actor for one in sources if one.actor.sampled is sampled):
            if source.kind in LIVE_KINDS:
                torque = compute_live_torque(
                    source=source,
                    hand=records.hand,
                    q=records.q,
                    qd=records.qd,
                    end_effector=end_effector,
                )
            else:
                torque = compute_source_torque(
                    source=source,
                    t_s=t_s,
                    q=records.q,
                    qd=records.qd,
                    end_effector=end_effector,
                )
            total = total + torque
        return total

    now = add(spec.environment, sampled=False)
    held = add(spec.environment, sampled=True)
    operator_held = add(spec.hands, sampled=True)
    operator_now = -records.tau_x - now - held - operator_held
    return TorqueSplit(
        end_effector=end_effector,
        operator_now=operator_now,
        operator_held=operator_held,
        environment_now=now,
        environment_held=held,
    )


def compute_operator_script(source: TorqueSource, t_s: Array, J: Array) -> Array:
    """Returns the intention of an operator, which does not depend on the arm's motion, shape
    (K, n), N m.

    A scripted torque itself (pulse, recorded, chirp, multisine); of a spring K times the
    displacement of its target and B times the target's speed, of one of the end effector by the
    Jacobian J of one pose, shape (2, 2) or (3, n); of an own kind what it does to an arm at
    zero, at rest. It moves if and only if the operator does.
    """
    if source.kind is TorqueKind.PULSE:
        x = np.clip((t_s - source.start_s) / (source.end_s - source.start_s), 0.0, 1.0)
        intent = np.sin(np.pi * x)[:, None] ** 2 * np.array(source.a)
    elif source.kind is TorqueKind.RECORDED and source.table is not None:
        at_s = source.table[:, 0]
        rows = source.table[:, 1:]
        columns = [np.interp(t_s, at_s, column, left=0.0, right=0.0) for column in rows.T]
        intent = np.stack(columns, axis=1)
    elif source.kind is TorqueKind.CHIRP:
        span_s = source.move_end_s - source.move_start_s
        (first_hz, last_hz) = source.b
        x = np.mod(t_s - source.start_s, span_s)
        turns = first_hz * x + (last_hz - first_hz) * x**2 / (2.0 * span_s)
        intent = np.sin(2.0 * np.pi * turns)[:, None] * np.array(source.a)
    elif source.kind is TorqueKind.MULTISINE and source.table is not None:
        turns = np.outer(t_s - source.start_s, source.table[:, 0]) + source.table[:, 1]
        intent = np.sin(2.0 * np.pi * turns).sum(axis=1)[:, None] * np.array(source.a)
    elif source.kind in OWN_KINDS:
        at_tip = source.kind is TorqueKind.OWN_TIP
        origin = np.zeros((len(t_s), J.shape[0 if at_tip else 1]))
        pull = source.model.effort(t_s, origin, origin)
        intent = pull @ J if at_tip else pull
    else:
        origin = np.zeros((len(t_s), len(source.a)))
        pull = compute_spring_effort(source, t_s, origin, origin)
        intent = pull @ J if source.kind is TorqueKind.TASK_HAND else pull
    acting = (t_s >= source.start_s) & (t_s < source.end_s)
    return np.where(acting[:, None], intent, 0.0)


def attribute_torque(records: AlignedRecords, scenario: Scenario) -> TorqueSplit:
    """Returns the torque on a site's arm by its sources, with the operator's script.

    Without an operator in the scenario, the operator's torque is exactly zero where only
    rounding is left.
    """
    split = split_torque(records, scenario)
    t_s = records.nominal_s
    spec = scenario.sites[records.site]
    expected = np.zeros_like(records.q)
    scripts = np.zeros_like(records.q)
    for source in (one.actor for one in spec.hands):
        if source.kind in LIVE_KINDS:
            at_start = np.broadcast_to(records.q[0], records.q.shape)
            still = build_arm_rows(scenario, records.site).place_end_effector(
                at_start, 0.0 * at_start
            )
            scripts = scripts + compute_live_torque(
                source=source,
                hand=records.hand,
                q=at_start,
                qd=0.0 * at_start,
                end_effector=still,
            )
            continue
        script = compute_operator_script(source, t_s, split.end_effector.J[0])
        scripts = scripts + script
        if source.kind in SCRIPTED_KINDS:
            expected = expected + script
        elif not source.sampled:
            torque = compute_source_torque(
                source=source,
                t_s=t_s,
                q=records.q,
                qd=records.qd,
                end_effector=split.end_effector,
            )
            expected = expected + torque
    tolerance = SCRIPT_TORQUE_TOLERANCE * (1.0 + np.abs(records.tau_x))
    matches = np.abs(split.operator_now - expected) <= tolerance
    if matches[records.known].all():
        split = split._replace(script=scripts)
    if not spec.hands:
        split = split._replace(operator_now=np.where(matches, 0.0, split.operator_now))
    return split


class WallEnergy(NamedTuple):
    """The energy that a touched wall gave which is held over a tick h, and the damping that
    would take it.

    It does the work F_k (x_{k+1} - x_k); with its spring's energy K x^2 / 2 booked it gives K
    (x_{k+1} - x_k)^2 / 2 in every tick of a contact, less what its damping B takes. A damper b
    of the arm itself takes all of it if b > K h / 2 + B: Colgate and Schenkel, "Passivity of a
    class of sampled-data systems", J. Robotic Systems 14 (1997). That is sufficient, for a B on
    the speed at the tick while that is straight within one (docs/certificate.md); whether the
    loop is stable in contact is told by the map from tick to tick, `trilat linear`.

    Attributes:
        site: whose wall.
        generated_j: the most that it gave in qd beyond what its spring had stored, J.
        required_damping_n_s_m: K h / 2 + B, N s/m.
        arm_damping_n_s_m: the arm's own damping b along the normal, the least in contact, N s/m.
    """

    site: str
    generated_j: float
    required_damping_n_s_m: float
    arm_damping_n_s_m: float


def list_sampled_walls(spec: SiteSpec) -> list[TorqueSource]:
    """Returns the walls of a site that are held over a tick, and that push back."""
    return [wall for wall in list_walls(spec) if wall.sampled and any(wall.K)]


def find_wall_energies(log: Log) -> list[WallEnergy]:
    """Returns the sampled walls that were touched, in scenario order."""
    found = []
    for site, records in align_records(log).items():
        spec = log.scenario.sites[site]
        end_effector = build_arm_rows(log.scenario, site).place_end_effector(
            records.q, records.qd
        )
        for wall in list_sampled_walls(spec):
            force = wall_force(wall, records.nominal_s, end_effector)
            touched = force > 0.0
            if touched.any():
                needed = 0.5 * wall.K[0] * records.h_s + wall.B[0]
                gave = _find_given_energy(wall, records, end_effector, force)
                own = _find_own_damping(
                    spec, wall, end_effector.J[touched], records.nominal_s[touched]
                )
                found.append(WallEnergy(site, gave, needed, own))
    return found


def _find_given_energy(
    wall: TorqueSource, records: AlignedRecords, end_effector: EndEffectorRows, force: Array
) -> float:
    """Returns the largest rise of the wall's work on the arm with its spring's energy added, J."""
    torque = np.einsum("kij,ki->kj", end_effector.J, force[:, None] * np.array(wall.b))
    work = (torque[:-1] * np.diff(records.q, axis=0)).sum(axis=1)
    spring = 0.5 * wall.K[0] * np.where(force > 0.0, wall_depth(wall, end_effector), 0.0) ** 2
    change = np.where(records.known_periods, work + np.diff(spring), 0.0)
    given = np.concatenate([[0.0], np.cumsum(change)])
    return float((given - np.minimum.accumulate(given)).max())


def _find_own_damping(spec: SiteSpec, wall: TorqueSource, J: Array, t_s: Array) -> float:
    """Returns the least of 1 / (n'J D^-1 J'n), D the damping of joints that acts continuously,
    N s/m.

    J and t_s are of the rows in contact; what does not act at all of them is no damping.
    """
    actors = [one.actor for one in spec.environment]
    lasting = [one for one in actors if one.start_s <= t_s[0] and one.end_s > t_s[-1]]
    viscous = [one.B for one in lasting if one.kind is TorqueKind.VISCOUS and not one.sampled]
    D = np.sum(viscous, axis=0) if viscous else np.zeros(J.shape[2])
    arms = np.einsum("kij,i->kj", J, np.array(wall.b)) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        compliance = np.where(arms > 0.0, arms / D, 0.0).sum(axis=1)
        return float((1.0 / compliance).min())
