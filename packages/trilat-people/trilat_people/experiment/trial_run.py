"""Runs and judges one trial of an experiment, and computes its measures from the log.

In a trial, the participants move the slave arm over the network to perform a task such as
reaching a target. `ExperimentTrial` is a trial with people, recorded in a live session.
`SyntheticTrial` is a trial with synthetic participants (models of people), run in virtual time.

Invariant:
    - The result of a trial is computed from its log. The run is repeated from the log, and the
      task is judged by the state of the slave in every control period.
    - A trial with synthetic participants is simulated twice. The first simulation is fast,
      writes no log, and determines when the trial ends. The second repeats the same motion,
      writes the log, and stops shortly after that time.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from trilat_net.analysis import AlignedRecords, TorqueSplit, build_arm_rows
from trilat_net.core import Array
from trilat_net.errors import LogError
from trilat_net.execution import FusedRun, SimulatedLog, verify_log
from trilat_net.files import digest_file
from trilat_net.log import Ints, Log, SiteLog, open_log
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Change, HandPlayer, HandSite, Scenario, parse_embedded

from .movement_measures import energy_j, measure_pair, movement_time_s, path_length_m, sparc
from .protocol import ExperimentProtocol, PlannedTrial
from .synthetic_participant import ParticipantModel, SyntheticParticipant
from .tasks import Outcome, TrialGoal

RECORD_STEP = 5
"""Measures use every n-th record of the slave, where n is this number."""
HAND_HZ = 50
"""Rate at which a synthetic participant acts, in Hz."""
HAND_DELAY_S = 0.02
"""Time from a synthetic participant's decision until it affects the arm, in s."""
REST_S = 0.1
"""Time for which the log continues after the end of the trial, in s."""


class TrialEntry(msgspec.Struct, frozen=True):
    """Result of one finished trial, as stored in the journal of the experiment.

    Attributes:
        cell: Number of the trial, which is the key of the entry.
        seed: Random seed of the trial.
        sha256: Digest of the trial's log.
        succeeded: True if the task was completed.
        measures: Mapping from the name of each measure, which includes the unit, to its value.
        people: True if people took part, False for synthetic participants.
    """

    cell: int
    seed: int
    sha256: str
    succeeded: bool
    measures: dict[str, float]
    people: bool = False


class TrialJudge:
    """Decides from the records of the slave arm whether a trial has ended.

    Records must be passed one at a time, as they arrive.

    Args:
        trial: The trial, with its scenario, slave arm and goal.

    Attributes:
        goal: Goal of the trial.
        outcome: Outcome of the trial, or `None` while it continues.
    """

    def __init__(self, trial: "ExperimentTrial") -> None:
        self.goal = trial.make_goal()
        self._trial = trial
        self.outcome: Outcome | None = None

    def accept(self, t_s: float, q: Sequence[float], tau_x: Sequence[float]) -> Outcome | None:
        """Processes the next record of the slave.

        Args:
            t_s: Time since the start of the session, in s.
            q: Joint positions, in rad or m.
            tau_x: Negative of the torques that hands and environments exert ON the arm, in N m
                or N.

        Returns:
            The outcome once the trial has ended; `None` until then.
        """
        if self.outcome is None:
            # The force is computed only for tasks that need it, because it takes long.
            force_n = 0.0
            if self.goal.force_n:
                force_n = self._trial.find_force_n(q, tau_x)

            position = self._trial.arm.end_effector(q)
            position_m = np.array(position)
            self.outcome = self.goal.judge(t_s, position_m, force_n)
        return self.outcome


class _MotionSamples(NamedTuple):
    """Motion of the slave's end effector during a trial, used to compute measures.

    Contains K samples at a constant rate.

    Attributes:
        indices: Indices of the records, shape (K,).
        t_s: Times of the records, in s, shape (K,).
        positions_m: Positions, in m, shape (K, 2) or (K, 3).
        velocities_m_s: Velocities, in m/s, same shape as the positions.
        rate_hz: Sample rate, in Hz.
    """

    indices: Ints
    t_s: Array
    positions_m: Array
    velocities_m_s: Array
    rate_hz: float


class ExperimentTrial:
    """One trial of an experiment: its scenario, its goal and its result.

    Args:
        protocol: Protocol of the experiment, with the task and the users.
        scenario: Scenario of the condition: the arms, their control and the network.
        planned: Entry of this trial in the plan, with its participants, condition and seed.
        digest: Digest of the plan, which is stored in the log.

    Attributes:
        people: True if people take part, False for synthetic participants.
        protocol: The argument of the same name.
        planned: The argument of the same name.
        slave: Name of the slave in the scenario.
        arm: Model of the slave arm.
        scenario: Scenario of this trial. Its duration is the longest that the trial may take.
        appears_s: Time at which the target appears, in s.
        longest_s: Latest possible end of the trial, in s.
    """

    people = True

    def __init__(
        self,
        protocol: ExperimentProtocol,
        scenario: Scenario,
        planned: PlannedTrial,
        digest: str,
    ) -> None:
        self.protocol = protocol
        self.planned = planned
        self.slave = scenario.slave
        self.arm = scenario.arms[scenario.slave]
        start_q = scenario.sites[self.slave].q0_rad
        start = self.arm.end_effector(start_q)
        self._start_m = np.array(start, dtype=np.float64)

        # The target appears after a random time (foreperiod), so that users cannot anticipate
        # it.
        shortest_s, longest_s = protocol.foreperiod_s
        random = np.random.default_rng(planned.seed)
        foreperiod_s = random.uniform(shortest_s, longest_s)
        self.appears_s = round(float(foreperiod_s), 3)

        scenario = self._set_authority(scenario)
        # Synthetic participants act, and their trial is judged, once per 1 / HAND_HZ. The end
        # of a trial may be detected that late.
        latest_end_s = self.appears_s + protocol.task.longest_s
        self.longest_s = latest_end_s + 1.0 / HAND_HZ

        # The log of the trial states which trial it contains.
        kind = "" if self.people else "synthetic "
        participants = ", ".join(planned.group)
        about = (
            f"trial {planned.number} of {protocol.name}: {kind}{participants}, "
            f"condition {planned.condition}, block {planned.block}, trial {planned.trial}; "
            f"protocol sha256 {digest}"
        )

        limited_sites = protocol.limit_forces(scenario, planned.group)
        self.scenario = replace(
            scenario,
            duration_s=self.longest_s + REST_S,
            seed=planned.seed,
            about=about,
            sites={**scenario.sites, **limited_sites},
        )
        self._rows = build_arm_rows(self.scenario, self.slave)

    def _set_authority(self, scenario: Scenario) -> Scenario:
        """Sets the users' dominance factors over the slave arm for this trial.

        The protocol determines how two users share the sum of their dominance factors. In a
        handover, their shares are exchanged during the trial.
        """
        goal = self.make_goal()
        if goal.lead is None:
            return scenario

        slave_factors = scenario.dominance[self.slave]
        first, second = self.protocol.users
        sum_of_shares = slave_factors[first] + slave_factors[second]

        def divide_shares(lead: float) -> dict[str, float]:
            """Returns the dominance factors of the slave for this trial.

            The factors of the two users add up to the same sum as in the scenario. If this sum
            is 1, lead = 0.7 gives the factors 0.7 and 0.3.

            Args:
                lead: First user's share of the authority over the slave, between 0 and 1. The
                    second user gets the rest.
            """
            first_share = sum_of_shares * lead
            second_share = sum_of_shares - first_share
            return {
                **slave_factors,
                first: first_share,
                second: second_share,
            }

        dominance = {
            **scenario.dominance,
            self.slave: divide_shares(goal.lead),
        }
        timeline = scenario.timeline
        if goal.handover is not None:
            after_s, ramp_s = goal.handover
            handover = Change(
                self.appears_s + after_s,
                dominance=self.slave,
                to=divide_shares(1.0 - goal.lead),
                ramp_s=ramp_s,
            )
            timeline = (*timeline, handover)
        return replace(scenario, dominance=dominance, timeline=timeline)

    def find_force_n(self, q: Sequence[float], tau_x: Sequence[float]) -> float:
        """Computes the magnitude of the external force on the slave's end effector, in N.

        Args:
            q: Joint positions, in rad or m.
            tau_x: Negative of the torques that hands and environments exert ON the arm, in N m
                or N.
        """
        forces_n = self._find_forces_n(np.array([q]), np.array([tau_x]))
        return float(forces_n[0])

    def _find_forces_n(self, q: Array, tau_x: Array) -> Array:
        """Computes the magnitude of the external force on the slave's end effector, in N.

        An example is the force of contact with a wall.

        Args:
            q: Joint positions in K records, in rad or m, shape (K, n).
            tau_x: Negative of the external torques that act ON the joints, in N m or N, same
                shape as `q`.

        Returns:
            The magnitudes, shape (K,).
        """
        at_rest = 0.0 * q
        forces = self._rows.place_end_effector(q, at_rest).find_force(tau_x)
        magnitude_n: Array = np.linalg.norm(forces, axis=1)
        return magnitude_n

    def make_goal(self) -> TrialGoal:
        """Creates the goal of the trial: its target, and the rule for ending the trial.

        A goal stores when the end effector entered the target, so each `TrialJudge` needs a
        goal of its own.
        """
        planned = self.planned
        task = self.protocol.task
        goal = task.make_goal(self._start_m, planned.target, planned.seed)
        goal.appears_s = self.appears_s
        # The task of a handover fixes the authority; otherwise the plan does.
        if goal.lead is None:
            goal.lead = planned.lead
        return goal

    def settle(self, path: Path) -> TrialEntry:
        """Verifies the log of the trial and computes the result from it.

        The run is computed again from the inputs in the log, and the result is valid only if
        this gives the same records.

        Args:
            path: Path of the log.

        Raises:
            LogError: The records cannot be reproduced, or end before the trial does.
        """
        log = open_log(path)
        if not verify_log(log).passed:
            raise LogError(f"{path}: the records differ from those of a repeated run")

        outcome = self._judge_log(log)
        if outcome is None:
            raise LogError(f"{path}: the log ends before the trial does")

        return TrialEntry(
            cell=self.planned.number,
            seed=self.planned.seed,
            sha256=digest_file(path),
            succeeded=outcome.succeeded,
            measures=self._measure(log, outcome),
            people=self.people,
        )

    def _judge_log(self, log: Log) -> Outcome | None:
        """Determines from the recorded log when the trial succeeded or failed.

        The trial is judged record by record, in the same way as while it runs. If an arm
        exceeded its limits, the trial failed at that time.

        Returns:
            The outcome, or `None` if the log ends before the trial does.
        """
        judge = TrialJudge(self)
        records = log[self.slave]
        times_s = records.t_s.tolist()
        positions = records.q.tolist()
        torques = records.tau_x.tolist()
        for t_s, q, tau_x in zip(times_s, positions, torques, strict=True):
            outcome = judge.accept(t_s, q, tau_x)
            if outcome is not None:
                return outcome

        if log.diverged_s is not None:
            return Outcome(False, log.diverged_s)
        return None

    def _measure(self, log: Log, outcome: Outcome) -> dict[str, float]:
        """Computes the measures of a trial, whose names include the unit.

        Covers the motion of the slave, the forces and work of each user, and the mean age of
        the first user's samples at the slave.
        """
        measures = self._measure_motion(log, outcome.ended_s)
        aligned = AlignedRecords.by_site(log)
        users = self.protocol.users

        # Force and work of each user.
        forces: list[Array] = []
        for number, user in enumerate(users, 1):
            records = aligned[user]
            split = TorqueSplit.of_records(records, log.scenario)
            end_effector = split.end_effector
            is_in_trial = records.t_s <= outcome.ended_s
            # The force of the hand ON its arm, shape (K, 2) or (K, 3).
            hand_force = end_effector.find_force(split.operator)
            force = hand_force[is_in_trial]
            forces.append(force)

            magnitude_n = np.linalg.norm(force, axis=1)
            velocity = end_effector.speed[is_in_trial]

            suffix = ""
            if len(users) > 1:
                suffix = f"_user{number}"
            measures[f"force_mean{suffix}_n"] = float(magnitude_n.mean())
            measures[f"force_peak{suffix}_n"] = float(magnitude_n.max())
            measures[f"work{suffix}_j"] = energy_j(force, velocity, records.rate_hz)
        if len(forces) > 1:
            measures |= self._measure_pair(aligned, forces, outcome.ended_s)

        age_ms = log.sample_ages_ns(self.slave, users[0]) / 1e6
        mean_age_ms = 0.0
        if len(age_ms):
            mean_age_ms = float(age_ms.mean())
        measures["delay_ms"] = mean_age_ms
        return measures

    def _sample_motion(
        self, records: SiteLog | AlignedRecords, start_s: float, end_s: float
    ) -> _MotionSamples:
        """Returns the motion of the slave's end effector between two times.

        Uses only every `RECORD_STEP`-th record. Velocities are computed from differences
        between positions.

        Args:
            records: Records of the slave.
            start_s: First time, in s.
            end_s: Last time, in s.
        """
        has_started = records.t_s >= start_s
        is_between = has_started & (records.t_s <= end_s)
        indices = np.flatnonzero(is_between)[::RECORD_STEP]

        # The velocities are computed from differences below.
        q = records.q[indices]
        end_effector = self._rows.place_end_effector(q, 0.0 * q)
        positions_m = end_effector.position
        rate_hz = records.rate_hz / RECORD_STEP
        velocities_m_s = np.gradient(positions_m, 1.0 / rate_hz, axis=0)
        return _MotionSamples(
            indices=indices,
            t_s=records.t_s[indices],
            positions_m=positions_m,
            velocities_m_s=velocities_m_s,
            rate_hz=rate_hz,
        )

    def _measure_pair(
        self, aligned: Mapping[str, AlignedRecords], forces: Sequence[Array], ended_s: float
    ) -> dict[str, float]:
        """Computes cooperation measures of two users, such as the force that cancels out.

        The forces are treated as if each user pushed the slave's end effector.

        Args:
            aligned: Records of each site.
            forces: Forces of each user in the user's records, in N.
            ended_s: End of the trial, in s.
        """
        motion = self._sample_motion(aligned[self.slave], 0.0, ended_s)
        interpolated_forces: list[Array] = []
        for user, force in zip(self.protocol.users, forces, strict=True):
            # The times of the user's records differ from those of the slave's records.
            force_t_s = aligned[user].t_s[: len(force)]
            components: list[Array] = []
            for component in force.T:
                interpolated_component = np.interp(motion.t_s, force_t_s, component)
                components.append(interpolated_component)
            interpolated_forces.append(np.column_stack(components))

        first, second = interpolated_forces
        pair = measure_pair(first, second, motion.velocities_m_s, motion.rate_hz)
        measures = pair._asdict()
        return {name: value for name, value in measures.items() if value is not None}

    def _measure_motion(self, log: Log, ended_s: float) -> dict[str, float]:
        """Computes the measures of the slave's motion after the target has appeared.

        Examples are "completion_s", "path_m" and "error_end_mm". The task adds its own
        measures.

        Args:
            log: Log of the trial.
            ended_s: End of the trial, in s.

        Returns:
            Mapping from the name of each measure, which ends in the unit, to its value.
        """
        goal = self.make_goal()
        records = log[self.slave]

        motion = self._sample_motion(records, goal.appears_s, ended_s)

        # The movement begins when 5 % of the largest speed is exceeded.
        speed = np.linalg.norm(motion.velocities_m_s, axis=1)
        onset_speed = 0.05 * speed.max()
        is_moving = speed > onset_speed

        # The target may move, so the error is computed at each time.
        targets = [goal.find_target_m(t_s) for t_s in motion.t_s]
        targets_m = np.array(targets)
        error_vectors_m = motion.positions_m - targets_m
        errors_m = np.linalg.norm(error_vectors_m, axis=1)
        rms_error_m = float(np.sqrt(np.mean(errors_m**2)))
        first_moving = float(np.argmax(is_moving))

        force_n = 0.0 * motion.t_s
        if goal.force_n:
            q = records.q[motion.indices]
            tau_x = records.tau_x[motion.indices]
            force_n = self._find_forces_n(q, tau_x)

        measures = {
            "completion_s": ended_s - goal.appears_s,
            "movement_s": movement_time_s(speed, motion.rate_hz) or 0.0,
            "reaction_s": first_moving / motion.rate_hz,
            "error_end_mm": 1e3 * float(errors_m[-1]),
            "error_rms_mm": 1e3 * rms_error_m,
            "path_m": path_length_m(motion.positions_m),
        }
        smoothness = sparc(speed, motion.rate_hz)
        if smoothness is not None:
            measures["sparc"] = smoothness

        after_s = motion.t_s - goal.appears_s
        measures |= goal.compute_measures(after_s, motion.positions_m, force_n)

        points = {
            "start": goal.start_m,
            "target": targets_m[-1],
            "end": motion.positions_m[-1],
        }
        for name, point in points.items():
            # The end effector of a planar arm has no z.
            for axis, coordinate_m in zip("xyz", point, strict=False):
                measures[f"{name}_{axis}_m"] = float(coordinate_m)
        return measures


class SyntheticTrial(ExperimentTrial):
    """A trial in which synthetic participants (models of people) move the master arms.

    Runs in virtual time, without a network, and faster than real time. Used to test a protocol
    and its analysis before people take part.
    """

    people = False

    def _make_players(self, scenario: Scenario) -> dict[str, HandPlayer]:
        """Creates a model of a participant for each site whose arm is held.

        Each call creates new models, since a model keeps state during a trial.

        Args:
            scenario: Scenario of the trial.
        """
        players: dict[str, HandPlayer] = {}
        sites_and_names = zip(self.protocol.users, self.planned.group, strict=True)
        for user_index, (site, name) in enumerate(sites_and_names):
            operator = scenario.sites[site].find_live_hand(is_open=True)
            # `ExperimentPlan.of_protocol` has checked that the scenario has the hands of all
            # users.
            assert operator is not None
            hand_site = HandSite(
                scenario=scenario,
                name=site,
                spec=operator,
                rate_hz=HAND_HZ,
                delay_s=HAND_DELAY_S,
            )

            participant = SyntheticParticipant(
                facts=hand_site.describe(),
                model=self._draw_model(name),
                goal=self.make_goal(),
                slave=(self.slave, self.arm, self.find_force_n),
                before=self.planned.before,
                seed=self.planned.seed,
                user=user_index,
            )
            players[site] = HandPlayer(hand_site, participant)
        return players

    def _draw_model(self, participant: str) -> ParticipantModel:
        """Draws the model of a participant: reaction time, speed, noise, and so on.

        The parameters depend on the seed of the protocol and the pseudonym, so a participant
        has the same parameters in all trials.

        Args:
            participant: Pseudonym of the participant.
        """
        text = f"{self.protocol.seed}/{participant}"
        digest = hashlib.sha256(text.encode()).digest()
        participant_seed = int.from_bytes(digest[:4], "big")
        return self.protocol.model.draw(participant_seed)

    def find_end_s(self) -> float:
        """Runs a fast simulation with no log to determine when the trial ends, in s.

        The run that writes the log then stops shortly after that time.

        Returns:
            End of the trial, in s since the start of the session.
        """
        scenario = self.scenario
        judge = TrialJudge(self)
        slave = self.slave
        ticks_per_period = scenario.sites[slave].rate_hz // HAND_HZ

        # Simulated operators (players) move the arms in place of people.
        players = self._make_players(scenario)
        run = FusedRun(scenario, keep=ticks_per_period + 1, hands=players)
        tick_counts = [scenario.ticks(name) for name in scenario.names]
        run.plan(tick_counts)

        slave_index = scenario.names.index(slave)
        columns = scenario.layout(slave).columns()
        q_columns = columns["q"]
        torque_columns = columns["tau_x"]
        # The run is judged after each period of the hands.

        period_count = math.ceil(self.longest_s * HAND_HZ)
        for period in range(period_count):
            period_end_ns = (period + 1) * NS_PER_S // HAND_HZ
            run.step_to(period_end_ns)
            records = run.pop_records()
            t_ns, rows = records[slave_index]

            times_s = (t_ns / NS_PER_S).tolist()
            positions = rows[:, q_columns].tolist()
            torques = rows[:, torque_columns].tolist()
            for t_s, q, tau_x in zip(times_s, positions, torques, strict=True):
                judge.accept(t_s, q, tau_x)

            if judge.outcome is not None:
                return judge.outcome.ended_s
            if run.diverged_s is not None:
                return run.diverged_s
        return self.longest_s

    def write(self, path: Path) -> TrialEntry:
        """Simulates the trial, writes its log and returns its result.

        A first run with no log determines when the trial ends, so that the run with the log can
        stop shortly afterwards.

        Args:
            path: Path of the log.
        """
        duration_s = self.find_end_s() + REST_S
        scenario = replace(self.scenario, duration_s=duration_s)
        players = self._make_players(scenario)
        hands = {site: player.track for site, player in players.items()}

        SimulatedLog.record_scenario(
            scenario,
            path,
            force=True,
            views_hz=0.0,
            hands=hands,
        )
        return self.settle(path)

    @staticmethod
    def run_task(task: tuple[ExperimentProtocol, str, PlannedTrial, str, Path]) -> TrialEntry:
        """Runs a trial with synthetic participants in a worker process, and keeps its log.

        Takes a single argument, which is sent to the worker.

        Args:
            task: The protocol of the experiment, the source of the scenario, the planned trial,
                the digest of the plan, and the folder for the log.

        Returns:
            The result of the trial.

        Raises:
            LogError: The written log does not reproduce the run.
        """
        protocol, text, planned, digest, folder = task
        scenario = parse_embedded(text)
        trial = SyntheticTrial(protocol, scenario, planned, digest)
        return trial.write(folder / planned.file)
