"""Splits the external torque on an arm into the torques of the operator and the environment.

A log contains only the sum of the torques with which operators and environments, such as
virtual walls, push an arm. Metrics need them separately, for example to compute the work of the
operator. The scenario contains a model of each. This module evaluates the models for all
records at once and splits the sum. All torques are those that act on the arm.

Invariant:
    - Torques are computed from the definitions in the scenario, independently of the
      simulation. The tests compare the two.
    - The recorded torque minus the environment's torque is attributed to the operator, even if
      the scenario does not explain it.
    - The scenario may plan what an operator does. This plan is used only if the operator's
      recorded torque agrees with it.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..core import LIVE_KINDS, OWN_KINDS, SCRIPTED_KINDS, Array, TorqueKind, TorqueSource
from ..log import Log
from ..scenario import Scenario
from .aligned import AlignedRecords, Bools
from .arm_rows import EndEffectorRows, build_arm_rows
from .row_reductions import sum_rows

SCRIPT_TORQUE_TOLERANCE = 1e-8
"""Largest relative difference at which a torque agrees with the scenario."""


class VirtualWall:
    """A plane that pushes the end effector of an arm back with a spring and a damper.

    Args:
        source: Description of the wall.

    Attributes:
        source: Description of the wall.
        normal: Unit vector along which the wall pushes, shape (2,) or (3,).
        may_generate_energy: True if the wall has a stiffness or a damping, and its force is
            computed once per tick and held. A force that follows the motion of the arm
            continuously generates no energy.
    """

    def __init__(self, source: TorqueSource) -> None:
        self.source = source
        self.normal: Array = np.array(source.b)
        self.may_generate_energy = source.sampled and (any(source.K) or any(source.B))

    @classmethod
    def list_of_site(cls, scenario: Scenario, site: str) -> list["VirtualWall"]:
        """Lists the walls that the end effector of a site may touch, in scenario order.

        Args:
            scenario: The scenario.
            site: Name of the site.
        """
        actors = [source.actor for source in scenario.sites[site].environment]
        return [cls(actor) for actor in actors if actor.kind is TorqueKind.WALL]

    def find_depth(self, end_effector: EndEffectorRows) -> Array:
        """Returns how deep the end effector is inside the wall, in m.

        The force of the wall grows with the depth. Outside the wall there is no force.

        Args:
            end_effector: Motion of the end effector over K poses.

        Returns:
            Depth, shape (K,), which is negative outside the wall.
        """
        surface_point = np.array(self.source.a)
        depth: Array = (surface_point - end_effector.position) @ self.normal
        return depth

    def find_force(self, t_s: Array, end_effector: EndEffectorRows) -> Array:
        """Returns the force of the wall along its normal, which pushes and never pulls.

        Inside the wall, the force is max(K depth - B outward speed, 0), with the stiffness K
        and the damping B of the wall. It is 0 outside, before the wall's start and after its
        end.

        Args:
            t_s: Times, shape (K,), in s.
            end_effector: Motion of the end effector.

        Returns:
            Force, shape (K,), in N.
        """
        depth = self.find_depth(end_effector)
        outward_speed = end_effector.speed @ self.normal
        spring = self.source.K[0] * depth
        damper = self.source.B[0] * outward_speed
        push = np.maximum(spring - damper, 0.0)
        is_inside = _is_active(self.source, t_s) & (depth > 0.0)
        return np.where(is_inside, push, 0.0)


class SourceRows:
    """A source of torque on an arm, evaluated at many times at once.

    The source may be an operator or an environment: a scripted torque, a spring, a damper, a
    wall, a person who acts live, or a model written by a user.

    Args:
        source: Description of the source.
    """

    def __init__(self, source: TorqueSource) -> None:
        self.source = source

    def find_target_motion(self, t_s: Array) -> tuple[Array, Array]:
        """Computes where the target of an operator's spring is, and how fast it moves.

        The operator is modelled as a spring between the arm and a target. The target moves from
        a to b along a minimum-jerk trajectory.

        Args:
            t_s: Times, shape (K,), in s.

        Returns:
            Position of the target, shape (K, n), in the coordinates of the spring.
            Velocity of the target, shape (K, n).
        """
        span_s = self.source.move_end_s - self.source.move_start_s
        progress = (t_s > self.source.move_start_s).astype(np.float64)
        progress_rate = 0.0
        if span_s > 0.0:
            since_start_s = t_s - self.source.move_start_s
            progress = np.clip(since_start_s / span_s, 0.0, 1.0)
            progress_rate = 1.0 / span_s
        start = np.array(self.source.a)
        distance = np.array(self.source.b) - start
        progress_column = progress[:, np.newaxis]
        # minimum jerk with progress x: 10 x^3 - 15 x^4 + 6 x^5, and its derivative
        # 30 x^2 (1 - x)^2
        path_fraction = progress_column**3 * (
            10.0 + progress_column * (6.0 * progress_column - 15.0)
        )
        path_slope = 30.0 * progress_column**2 * (1.0 - progress_column) ** 2
        position = start + path_fraction * distance
        velocity = path_slope * progress_rate * distance
        return position, velocity

    def _compute_spring_effort(
        self,
        t_s: Array,
        position: Array,
        speed: Array,
    ) -> Array:
        """Computes the torque, or the force, of a spring that pulls an arm to its target.

        It is K (target - position) + B (target velocity - speed), with the stiffness K and the
        damping B of the spring.

        Args:
            t_s: Times, shape (K,), in s.
            position: Joint angles in rad, or position of the end effector in m, shape (K, n).
            speed: Their time derivatives, shape (K, n).

        Returns:
            Torque in N m if the spring acts on joints, or force in N, shape (K, n).
        """
        target, target_velocity = self.find_target_motion(t_s)
        spring = np.array(self.source.K) * (target - position)
        damper = np.array(self.source.B) * (target_velocity - speed)
        effort: Array = spring + damper
        return effort

    def compute_torque(
        self,
        t_s: Array,
        q: Array,
        qd: Array,
        end_effector: EndEffectorRows,
    ) -> Array:
        """Returns the torque of a source that depends on the arm's motion.

        The source may be a spring, a damper, a wall, or a model written by a user.

        Args:
            t_s: Times, shape (K,), in s.
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            end_effector: Motion of the end effector.

        Returns:
            Torque on the arm, shape (K, n), in N m.

        Raises:
            ValueError: The torque of the source is scripted, and does not depend on the motion.
        """
        kind = self.source.kind
        position = end_effector.position
        speed = end_effector.speed
        J = end_effector.J

        if kind is TorqueKind.WALL:
            wall = VirtualWall(self.source)
            force = wall.find_force(t_s, end_effector)[:, np.newaxis] * wall.normal
            torque = _map_to_joints(J, force)
        elif kind is TorqueKind.VISCOUS:
            torque = -np.array(self.source.B) * qd
        elif kind is TorqueKind.HAND:
            torque = self._compute_spring_effort(t_s, q, qd)
        elif kind is TorqueKind.TASK_HAND:
            force = self._compute_spring_effort(t_s, position, speed)
            torque = _map_to_joints(J, force)
        elif kind is TorqueKind.OWN_JOINTS:
            torque = self.source.model.effort(t_s, q, qd)
        elif kind is TorqueKind.OWN_TIP:
            force = self.source.model.effort(t_s, position, speed)
            torque = _map_to_joints(J, force)
        else:
            raise ValueError(f"{kind.name} is not a function of the state")

        is_active = _is_active(self.source, t_s)
        return np.where(is_active[:, np.newaxis], torque, 0.0)

    def compute_live_torque(
        self,
        hand: Array,
        q: Array,
        qd: Array,
        end_effector: EndEffectorRows,
    ) -> Array:
        """Computes the torque of an operator who acts live, through a web page or a device.

        The operator's recorded action is either a force, or a target to which a spring and a
        damper pull the arm. The pull is clipped to the limit of the operator, and multiplied by
        the firmness of the grip.

        Args:
            hand: Recorded action of the operator (see `HandInForce`), shape (K, h): the
                firmness of the grip from 0 to 1, the numbers of the message and of its sender,
                the target and the target's velocity.
            q: Joint angles, shape (K, n), in rad.
            qd: Joint velocities, shape (K, n), in rad/s.
            end_effector: Motion of the end effector.

        Returns:
            Torque on the arm, shape (K, n), in N m.
        """
        # after three values come target and target velocity, with as many coordinates each
        coordinates = (hand.shape[1] - 3) // 2
        grip = hand[:, 0]
        target = hand[:, 3 : 3 + coordinates]
        target_rate = hand[:, 3 + coordinates :]
        acts_on_joints = self.source.kind is TorqueKind.LIVE_JOINT
        position = q if acts_on_joints else end_effector.position
        speed = qd if acts_on_joints else end_effector.speed

        if self.source.kind is TorqueKind.LIVE_FORCE:
            pull = target
        else:
            spring = np.array(self.source.K) * (target - position)
            damper = np.array(self.source.B) * (target_rate - speed)
            pull = spring + damper

        # a larger pull is scaled down to the operator's limit
        pull_size = np.linalg.norm(pull, axis=1)
        reduction = self.source.limit / np.maximum(pull_size, self.source.limit)
        is_limited = pull_size > self.source.limit
        factor = grip * np.where(is_limited, reduction, 1.0)
        effort: Array = factor[:, np.newaxis] * pull
        if acts_on_joints:
            return effort
        return _map_to_joints(end_effector.J, effort)

    def compute_script(self, t_s: Array, J: Array) -> Array:
        """Returns an operator's plan as a torque that does not depend on the arm's motion.

        Metrics use the plan to find out when the operator acts, because the plan changes
        whenever the operator's action changes, and only then. How the plan is defined depends
        on the kind of operator:

        - Scripted torque (pulse, recorded, chirp, multisine): the torque itself.
        - Spring: K times the position of its target plus B times the target's velocity. If the
          spring acts at the end effector, the Jacobian J of one pose maps this force to the
          joints.
        - Model written by a user: the torque of the model on an arm that is at rest at the
          origin.

        Args:
            t_s: Times, shape (K,), in s.
            J: Jacobian of one pose, shape (2, 2) or (3, n).

        Returns:
            The plan, shape (K, n), in N m.
        """
        if self.source.kind in SCRIPTED_KINDS:
            planned_torque = self._evaluate_scripted_torque(t_s)
        elif self.source.kind in OWN_KINDS:
            acts_at_tip = self.source.kind is TorqueKind.OWN_TIP
            coordinates, joints = J.shape
            origin = np.zeros((len(t_s), coordinates if acts_at_tip else joints))
            effort = self.source.model.effort(t_s, origin, origin)
            planned_torque = effort @ J if acts_at_tip else effort
        else:
            origin = np.zeros((len(t_s), len(self.source.a)))
            effort = self._compute_spring_effort(t_s, origin, origin)
            planned_torque = effort @ J if self.source.kind is TorqueKind.TASK_HAND else effort

        is_active = _is_active(self.source, t_s)
        return np.where(is_active[:, np.newaxis], planned_torque, 0.0)

    def _evaluate_scripted_torque(self, t_s: Array) -> Array:
        """Returns a planned torque signal over time, regardless of its start and end times.

        Args:
            t_s: Times, shape (K,), in s.

        Returns:
            Torque, shape (K, n), in N m.
        """
        since_start_s = t_s - self.source.start_s
        if self.source.kind is TorqueKind.RECORDED:
            assert self.source.table is not None
            table_s = self.source.table[:, 0]
            columns = []
            for joint_torque in self.source.table[:, 1:].T:
                column = np.interp(t_s, table_s, joint_torque, left=0.0, right=0.0)
                columns.append(column)
            return np.stack(columns, axis=1)

        if self.source.kind is TorqueKind.PULSE:
            span_s = self.source.end_s - self.source.start_s
            phase = np.clip(since_start_s / span_s, 0.0, 1.0)
            waveform = np.sin(np.pi * phase) ** 2
        elif self.source.kind is TorqueKind.CHIRP:
            span_s = self.source.move_end_s - self.source.move_start_s
            first_hz, last_hz = self.source.b
            # the frequency rises linearly, and starts again at the end of the sweep
            sweep_s = np.mod(since_start_s, span_s)
            turns = first_hz * sweep_s + (last_hz - first_hz) * sweep_s**2 / (2.0 * span_s)
            waveform = np.sin(2.0 * np.pi * turns)
        else:
            assert self.source.table is not None
            frequencies_hz = self.source.table[:, 0]
            phases = self.source.table[:, 1]
            turns = np.outer(since_start_s, frequencies_hz) + phases
            waveform = np.sin(2.0 * np.pi * turns).sum(axis=1)

        torque: Array = waveform[:, np.newaxis] * np.array(self.source.a)
        return torque


class TorqueSplit(NamedTuple):
    """The external torque on an arm, divided between operator and environment, in N m.

    Each attribute has shape (K, n) unless stated otherwise. Torques that follow the motion
    continuously and torques that are computed once per tick are kept separate, because they do
    different work within a tick. The torque of the arm's mechanical stops is not included.

    Attributes:
        end_effector: Motion of the end effector.
        operator_now: Operator's torque that follows the motion continuously.
        operator_held: Operator's torque that is computed once per tick and held.
        environment_now: Environment's torque that follows the motion continuously.
        environment_held: Environment's torque that is computed once per tick and held.
        script: The part of the operator's action that the scenario plans (see
            `SourceRows.compute_script`), or None if it was not requested or the operator's
            torque does not agree with the scenario.
    """

    end_effector: EndEffectorRows
    operator_now: Array
    operator_held: Array
    environment_now: Array
    environment_held: Array
    script: Array | None = None

    @property
    def operator(self) -> Array:
        """Total torque of the operator on the arm, shape (K, n), in N m.

        The sum of the continuous torque and the torque held over each tick.
        """
        return self.operator_now + self.operator_held

    @property
    def environment(self) -> Array:
        """Total torque of the environment, such as walls, on the arm, shape (K, n), in N m.

        The sum of the continuous torque and the torque held over each tick.
        """
        return self.environment_now + self.environment_held

    @classmethod
    def of_records(cls, records: AlignedRecords, scenario: Scenario) -> "TorqueSplit":
        """Splits the recorded external torque on an arm between operator and environment.

        The environment's torque is computed from the scenario, and the rest is attributed to
        the operator. Use `with_script` to also find what the scenario plans for the operator.

        Args:
            records: Records of the site.
            scenario: The scenario.

        Returns:
            The torques at every record. The attribute `script` is `None`.
        """
        spec = scenario.sites[records.site]
        t_s = records.nominal_s
        arm = build_arm_rows(scenario, records.site)
        end_effector = arm.place_end_effector(records.q, records.qd)

        def add_torques(actors: Iterable[TorqueSource], *, sampled: bool) -> Array:
            """Returns the sum of the torques that models of operators or environments compute.

            Args:
                actors: The operators or environments.
                sampled: True to add only torques that are computed once per tick and then held.
                    False to add only torques that follow the motion continuously.

            Returns:
                The sum in each of K records for each of n joints, shape (K, n).
            """
            total = np.zeros_like(records.q)
            for actor in actors:
                if actor.sampled is not sampled:
                    continue
                rows = SourceRows(actor)
                if actor.kind in LIVE_KINDS:
                    torque = rows.compute_live_torque(
                        hand=records.hand,
                        q=records.q,
                        qd=records.qd,
                        end_effector=end_effector,
                    )
                else:
                    torque = rows.compute_torque(
                        t_s=t_s,
                        q=records.q,
                        qd=records.qd,
                        end_effector=end_effector,
                    )
                total = total + torque
            return total

        environment = [source.actor for source in spec.environment]
        operators = [source.actor for source in spec.hands]
        environment_now = add_torques(environment, sampled=False)
        environment_held = add_torques(environment, sampled=True)
        operator_held = add_torques(operators, sampled=True)
        operator_now = -records.tau_x - environment_now - environment_held - operator_held
        return TorqueSplit(
            end_effector=end_effector,
            operator_now=operator_now,
            operator_held=operator_held,
            environment_now=environment_now,
            environment_held=environment_held,
        )

    @classmethod
    def with_script(cls, records: AlignedRecords, scenario: Scenario) -> "TorqueSplit":
        """Splits the external torque on an arm, and adds the plan of the operator.

        The torque is split between operator and environment. The result also contains the
        torque that the scenario plans for the operator, if the recorded torque agrees with it.
        If the scenario has no operator, rounding errors are removed from the operator's torque.

        Args:
            records: Records of the site.
            scenario: The scenario.

        Returns:
            The torques at every record.
        """
        split = cls.of_records(records, scenario)
        t_s = records.nominal_s
        spec = scenario.sites[records.site]
        expected = np.zeros_like(records.q)
        plan = np.zeros_like(records.q)
        for operator in spec.hands:
            source = operator.actor
            rows = SourceRows(source)
            if source.kind in LIVE_KINDS:
                # a live operator plans its torque on an arm that rests in the first pose
                first_q = np.broadcast_to(records.q[0], records.q.shape)
                at_rest = 0.0 * first_q
                arm = build_arm_rows(scenario, records.site)
                live_torque = rows.compute_live_torque(
                    hand=records.hand,
                    q=first_q,
                    qd=at_rest,
                    end_effector=arm.place_end_effector(first_q, at_rest),
                )
                plan = plan + live_torque
                continue

            planned_torque = rows.compute_script(t_s, split.end_effector.J[0])
            plan = plan + planned_torque
            if source.kind in SCRIPTED_KINDS:
                expected = expected + planned_torque
            elif not source.sampled:
                torque = rows.compute_torque(
                    t_s=t_s,
                    q=records.q,
                    qd=records.qd,
                    end_effector=split.end_effector,
                )
                expected = expected + torque

        torque_scale = 1.0 + np.abs(records.tau_x)
        difference = np.abs(split.operator_now - expected)
        matches = difference <= SCRIPT_TORQUE_TOLERANCE * torque_scale
        if matches[records.known].all():
            split = split._replace(script=plan)
        if not spec.hands:
            without_rounding = np.where(matches, 0.0, split.operator_now)
            split = split._replace(operator_now=without_rounding)
        return split


class WallEnergy(NamedTuple):
    """Energy that a sampled wall generates in contact, and the damping needed to dissipate it.

    The force F_k of a sampled wall is computed once per tick and held for the tick period h. It
    does the work F_k (x_{k+1} - x_k), where x is the depth. Together with the energy K x^2 / 2
    of its spring, the wall generates K (x_{k+1} - x_k)^2 / 2 in every tick of a contact, minus
    the energy that its damping B dissipates. A damper b of the arm itself dissipates all of
    this energy if b > K h / 2 + B: Colgate and Schenkel, "Passivity of a class of sampled-data
    systems", J. Robotic Systems 14 (1997).

    The condition is sufficient if B acts on the speed at the tick, and if the motion within a
    tick is straight (docs/reference/certificate-premises.md). `trilat linear` shows whether the
    loop is stable in contact.

    Attributes:
        site: Site of the wall.
        generated_j: Largest energy that the wall supplied to the joint motion in excess of the
            energy that its spring had stored, in J.
        required_damping_n_s_m: K h / 2 + B, in N s/m.
        arm_damping_n_s_m: Smallest damping b of the arm itself along the normal during contact,
            in N s/m.
    """

    site: str
    generated_j: float
    required_damping_n_s_m: float
    arm_damping_n_s_m: float

    @staticmethod
    def count_generating_walls(scenario: Scenario) -> int:
        """Returns the number of walls in a scenario that may generate energy.

        Args:
            scenario: The scenario.
        """
        walls = [
            wall for site in scenario.names for wall in VirtualWall.list_of_site(scenario, site)
        ]
        return sum(wall.may_generate_energy for wall in walls)

    @classmethod
    def list_of_log(cls, log: Log) -> list["WallEnergy"]:
        """Computes the energy that each virtual wall of a run generated by itself.

        A real wall generates no energy. The force of a virtual wall, however, is computed once
        per tick and held until the next tick, so the wall may return more energy than it
        received. Walls that follow the motion continuously are left out.

        Args:
            log: The log of the run.

        Returns:
            The energies in scenario order, for the walls that were touched.
        """
        energies = []
        for site, records in AlignedRecords.by_site(log).items():
            arm = build_arm_rows(log.scenario, site)
            end_effector = arm.place_end_effector(records.q, records.qd)
            sources = [source.actor for source in log.scenario.sites[site].environment]
            for wall in VirtualWall.list_of_site(log.scenario, site):
                if not wall.may_generate_energy:
                    continue
                force = wall.find_force(records.nominal_s, end_effector)
                is_touched = force > 0.0
                if not is_touched.any():
                    continue

                generated_j = _find_generated_energy(wall, records, end_effector, force)
                # K h / 2 + B, see `WallEnergy`
                spring_share = 0.5 * wall.source.K[0] * records.h_s
                contact_J = end_effector.J[is_touched]
                contact_s = records.nominal_s[is_touched]
                energy = cls(
                    site=site,
                    generated_j=generated_j,
                    required_damping_n_s_m=spring_share + wall.source.B[0],
                    arm_damping_n_s_m=_find_arm_damping(sources, wall, contact_J, contact_s),
                )
                energies.append(energy)
        return energies


def _find_generated_energy(
    wall: VirtualWall,
    records: AlignedRecords,
    end_effector: EndEffectorRows,
    force: Array,
) -> float:
    """Returns the energy that a wall generated: the largest rise of its work and stored energy.

    A passive wall never returns more energy than it received. Therefore the sum of its work and
    of its spring's energy never rises. The result is in J.

    Args:
        wall: The wall.
        records: Records of its site.
        end_effector: Motion of the end effector.
        force: Force of the wall along its normal, shape (K,), in N.
    """
    force_vector = force[:, np.newaxis] * wall.normal
    torque = _map_to_joints(end_effector.J, force_vector)
    motion = np.diff(records.q, axis=0)
    work = sum_rows(torque[:-1] * motion)
    depth = np.where(force > 0.0, wall.find_depth(end_effector), 0.0)
    stored = 0.5 * wall.source.K[0] * depth**2
    generated = work + np.diff(stored)

    known_part = np.where(records.known_periods, generated, 0.0)
    supplied_until = np.concatenate([[0.0], np.cumsum(known_part)])
    least_so_far = np.minimum.accumulate(supplied_until)
    return float((supplied_until - least_so_far).max())


def _find_arm_damping(
    sources: Sequence[TorqueSource],
    wall: VirtualWall,
    J: Array,
    t_s: Array,
) -> float:
    """Returns the least damping of an arm along a wall's normal during contact, in N s/m.

    The damping is 1 / (n'J D^-1 J'n), with the normal n, the Jacobian J and the damping D of
    the joints. Only dampers that act continuously are included.

    Args:
        sources: Torque sources of the environment of the wall's site.
        wall: The wall.
        J: Jacobian of the rows in contact, shape (K, m, n).
        t_s: Times of the rows in contact, shape (K,), in s.
    """
    damping_gains = []
    for source in sources:
        is_damper = source.kind is TorqueKind.VISCOUS and not source.sampled
        acts_in_all_rows = source.start_s <= t_s[0] and source.end_s > t_s[-1]
        if is_damper and acts_in_all_rows:
            damping_gains.append(source.B)
    joint_damping = np.zeros(J.shape[2])
    for B in damping_gains:
        joint_damping = joint_damping + np.array(B)

    lever_arms = np.einsum("kij,i->kj", J, wall.normal)
    squared_arms = lever_arms**2
    with np.errstate(divide="ignore", invalid="ignore"):
        # mobility n'J D^-1 J'n, in which joints that do not move along the normal do not count
        terms = np.where(squared_arms > 0.0, squared_arms / joint_damping, 0.0)
        damping = 1.0 / terms.sum(axis=1)
        return float(damping.min())


def _is_active(source: TorqueSource, t_s: Array) -> Bools:
    """Returns True for the times between start and end of a source, shape (K,)."""
    has_started = t_s >= source.start_s
    has_not_ended = t_s < source.end_s
    active: Bools = has_started & has_not_ended
    return active


def _map_to_joints(J: Array, force: Array) -> Array:
    """Returns the joint torque J'f of a force f at the end effector, shape (K, n), in N m."""
    torque: Array = np.einsum("kij,ki->kj", J, force)
    return torque
