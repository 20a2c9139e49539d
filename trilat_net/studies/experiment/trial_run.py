"""One trial: its scenario, its judgement record by record, and the results of its log.

Invariant:
    - The result of a trial is a function of its log, for people and for synthetic participants
      alike. The log is executed again, and judged by every record of the slave in it.
    - A trial of synthetic participants is run twice with the same numbers: compiled, to find
      its end, and then into its log, which lasts just that long.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from ...analysis.aligned import AlignedRecords, align_records
from ...analysis.arm_rows import EndEffectorRows, build_arm_rows
from ...analysis.link_summary import sample_ages_ns
from ...analysis.torque_sources import split_torque
from ...core.ticks import NS_PER_S
from ...core.vectors import Array
from ...errors import LogError
from ...execution.fused import FusedRun
from ...execution.verify import verify
from ...execution.virtual import record_virtual
from ...files import digest_file
from ...log.log_reader import Log, open_log
from ...log.record_columns import Ints
from ...log.site_log import SiteLog
from ...scenario import Scenario, parse_scenario
from ...scenario.operators.program_hand import HandPlayer, HandSite
from ...scenario.scenario_types import Change
from .movement_measures import energy_j, measure_pair, movement_time_s, path_length_m, sparc
from .protocol import PlannedTrial, Protocol, limit_forces
from .synthetic_participant import SyntheticParticipant
from .tasks import Outcome, TrialGoal

RECORD_STEP = 5
"""Every fifth record of the slave is measured."""
HAND_HZ = 50
"""Rate at which a synthetic participant acts, 1/s."""
HAND_DELAY_S = 0.02
"""Time from the decision of a synthetic participant to its effect on the arm, s."""
REST_S = 0.1
"""Time after the end of a trial that its log still has, s."""


class TrialEntry(msgspec.Struct, frozen=True):
    """A finished trial in the journal.

    Attributes:
        cell: the number of the trial.
        seed: its seed.
        sha256: the digest of its log.
        succeeded: whether the task was done.
        measures: the measures by name, with units in the names.
        people: False for synthetic participants.
    """

    cell: int
    seed: int
    sha256: str
    succeeded: bool
    measures: dict[str, float]
    people: bool = False


class TrialJudge:
    """Judges a trial by the records of its slave, one after the other.

    Attributes:
        goal: the goal of the trial.
        outcome: how the trial has ended; None while it goes on.
    """

    def __init__(self, trial: "ExperimentTrial") -> None:
        self.goal = trial.make_goal()
        self._trial = trial
        self.outcome: Outcome | None = None

    def accept(self, t_s: float, q: Sequence[float], tau_x: Sequence[float]) -> Outcome | None:
        """Judges a record of the slave; returns the outcome once the trial has ended.

        Args:
            t_s: time since the epoch, s.
            q: joint coordinates, rad or m.
            tau_x: exogenous torques, N m or N.
        """
        if self.outcome is None:
            force_n = self._trial.find_force_n(q, tau_x) if self.goal.force_n else 0.0
            position_m = np.array(self._trial.arm.end_effector(q))
            self.outcome = self.goal.judge(t_s, position_m, force_n)
        return self.outcome


class ExperimentTrial:
    """A trial of the plan with people.

    Args:
        protocol: the protocol of the experiment.
        scenario: the scenario of the trial's condition.
        planned: the trial in the plan.
        digest: the digest of the plan.

    Attributes:
        people: False for synthetic participants.
        slave, arm: the site whose arm is moved, and that arm.
        scenario: the scenario of this trial, which lasts as long as the trial may.
        appears_s, longest_s: when the target appears, and the latest end of the trial, s.
    """

    people = True

    def __init__(
        self, protocol: Protocol, scenario: Scenario, planned: PlannedTrial, digest: str
    ) -> None:
        self.protocol = protocol
        self.planned = planned
        self.slave = scenario.slave
        self.arm = scenario.arms[scenario.slave]
        spec = scenario.sites[self.slave]
        self._start_m = np.array(self.arm.end_effector(spec.q0_rad), dtype=np.float64)
        foreperiod_s = np.random.default_rng(planned.seed).uniform(*protocol.foreperiod_s)
        self.appears_s = round(float(foreperiod_s), 3)
        scenario = self._set_authority(scenario)
        self.longest_s = self.appears_s + protocol.task.longest_s + 1.0 / HAND_HZ
        kind = "" if self.people else "synthetic "
        about = (
            f"trial {planned.number} of {protocol.name}: {kind}{', '.join(planned.group)}, "
            f"condition {planned.condition}, block {planned.block}, trial {planned.trial}; "
            f"protocol sha256 {digest}"
        )
        limited_sites = limit_forces(scenario, protocol, planned.group)
        self.scenario = replace(
            scenario,
            duration_s=self.longest_s + REST_S,
            seed=planned.seed,
            about=about,
            sites={**scenario.sites, **limited_sites},
        )
        self._rows = build_arm_rows(self.scenario, self.slave)

    def _set_authority(self, scenario: Scenario) -> Scenario:
        """Returns the scenario with the trial's authority of the users over the slave.

        The two users share the sum of their dominance factors; a handover exchanges the parts.
        """
        goal = self.make_goal()
        if goal.lead is None:
            return scenario
        row = scenario.dominance[self.slave]
        first, second = self.protocol.users
        sum_of_shares = row[first] + row[second]

        def divide(lead: float) -> dict[str, float]:
            first_share = sum_of_shares * lead
            return {**row, first: first_share, second: sum_of_shares - first_share}

        dominance = {**scenario.dominance, self.slave: divide(goal.lead)}
        timeline = scenario.timeline
        if goal.handover is not None:
            after_s, ramp_s = goal.handover
            handover = Change(
                self.appears_s + after_s,
                dominance=self.slave,
                to=divide(1.0 - goal.lead),
                ramp_s=ramp_s,
            )
            timeline = (*timeline, handover)
        return replace(scenario, dominance=dominance, timeline=timeline)

    def find_force_n(self, q: Sequence[float], tau_x: Sequence[float]) -> float:
        """Returns the magnitude of the external force on the slave's end effector, N."""
        return float(self._find_forces_n(np.array([q]), np.array([tau_x]))[0])

    def _find_forces_n(self, q: Array, tau_x: Array) -> Array:
        """Returns the magnitude of that force for K records, shape (K,), N."""
        force_n: Array = np.linalg.norm(self._locate_end_effector(q).find_force(tau_x), axis=1)
        return force_n

    def _locate_end_effector(self, q: Array) -> EndEffectorRows:
        return self._rows.place_end_effector(q, 0.0 * q)

    def make_goal(self) -> TrialGoal:
        """Returns the goal of the trial."""
        planned = self.planned
        goal = self.protocol.task.make_goal(self._start_m, planned.target, planned.seed)
        goal.appears_s = self.appears_s
        goal.lead = planned.lead if goal.lead is None else goal.lead
        return goal

    def settle(self, path: Path) -> TrialEntry:
        """Executes the log of the trial again, and returns the trial's result.

        Raises:
            LogError: the records are not those of a run, or they end before the trial does.
        """
        log = open_log(path)
        if not verify(log).passed:
            raise LogError(f"{path}: its records are not those of the run")
        outcome = self._judge_log(log)
        if outcome is None:
            raise LogError(f"{path}: ends before its trial does")
        return TrialEntry(
            cell=self.planned.number,
            seed=self.planned.seed,
            sha256=digest_file(path),
            succeeded=outcome.succeeded,
            measures=self._measure(log, outcome),
            people=self.people,
        )

    def _judge_log(self, log: Log) -> Outcome | None:
        """Returns the outcome of the trial in a log; None if the log ends before the trial."""
        judge = TrialJudge(self)
        part = log[self.slave]
        columns = zip(part.t_s.tolist(), part.q.tolist(), part.tau_x.tolist(), strict=True)
        for t_s, q, tau_x in columns:
            outcome = judge.accept(t_s, q, tau_x)
            if outcome is not None:
                return outcome
        return None if log.diverged_s is None else Outcome(False, log.diverged_s)

    def _measure(self, log: Log, outcome: Outcome) -> dict[str, float]:
        """Returns the measures of a trial, with units in the names."""
        measures = self._measure_motion(log, outcome.ended_s)
        aligned = align_records(log)
        users = self.protocol.users
        forces = list[Array]()
        for number, user in enumerate(users, 1):
            records = aligned[user]
            suffix = f"_user{number}" if len(users) > 1 else ""
            split = split_torque(records, log.scenario)
            is_in_trial = records.t_s <= outcome.ended_s
            # The force of the hand ON its arm, shape (K, 2) or (K, 3).
            force = split.end_effector.find_force(split.operator)[is_in_trial]
            forces.append(force)
            magnitude_n = np.linalg.norm(force, axis=1)
            velocity = split.end_effector.speed[is_in_trial]
            measures[f"force_mean{suffix}_n"] = float(magnitude_n.mean())
            measures[f"force_peak{suffix}_n"] = float(magnitude_n.max())
            measures[f"work{suffix}_j"] = energy_j(force, velocity, records.rate_hz)
        if len(forces) > 1:
            measures |= self._measure_pair(aligned, forces, outcome.ended_s)
        age_ms = sample_ages_ns(log, self.slave, users[0]) / 1e6
        measures["delay_ms"] = float(age_ms.mean()) if len(age_ms) else 0.0
        return measures

    def _measure_path(
        self, part: SiteLog | AlignedRecords, from_s: float, until_s: float
    ) -> tuple[Ints, Array, Array, float]:
        """Returns the measured records of the slave between two times.

        Returns:
            The indices of the records; positions, m, and velocities, m/s, of the end effector,
            shape (K, 2) or (K, 3); and the rate of these samples, 1/s.
        """
        rows = np.flatnonzero((part.t_s >= from_s) & (part.t_s <= until_s))[::RECORD_STEP]
        positions = self._locate_end_effector(part.q[rows]).position
        rate_hz = part.rate_hz / RECORD_STEP
        return rows, positions, np.gradient(positions, 1.0 / rate_hz, axis=0), rate_hz

    def _measure_pair(
        self, aligned: Mapping[str, AlignedRecords], forces: Sequence[Array], ended_s: float
    ) -> dict[str, float]:
        """Returns the measures of two users, as if each pushed at the slave's end effector."""
        slave = aligned[self.slave]
        rows, _, velocities, rate_hz = self._measure_path(slave, 0.0, ended_s)
        t_s = slave.t_s[rows]

        def interpolate(user: str, force: Array) -> Array:
            force_t_s = aligned[user].t_s[: len(force)]
            return np.column_stack([np.interp(t_s, force_t_s, axis) for axis in force.T])

        first, second = map(interpolate, self.protocol.users, forces)
        measures = measure_pair(first, second, velocities, rate_hz)._asdict()
        return {name: value for name, value in measures.items() if value is not None}

    def _measure_motion(self, log: Log, ended_s: float) -> dict[str, float]:
        """Returns the measures of the slave's motion after the target has appeared."""
        goal = self.make_goal()
        part = log[self.slave]
        rows, positions, velocities, rate_hz = self._measure_path(part, goal.appears_s, ended_s)
        t_s = part.t_s[rows]
        speed = np.linalg.norm(velocities, axis=1)
        targets = np.array([goal.find_target_m(t) for t in t_s])
        errors_m = np.linalg.norm(positions - targets, axis=1)
        force_n = 0.0 * t_s
        if goal.force_n:
            force_n = self._find_forces_n(part.q[rows], part.tau_x[rows])
        measures = {
            "completion_s": ended_s - goal.appears_s,
            "movement_s": movement_time_s(speed, rate_hz) or 0.0,
            "reaction_s": float(np.argmax(speed > 0.05 * speed.max())) / rate_hz,
            "error_end_mm": 1e3 * float(errors_m[-1]),
            "error_rms_mm": 1e3 * float(np.sqrt(np.mean(errors_m**2))),
            "path_m": path_length_m(positions),
        }
        smoothness = sparc(speed, rate_hz)
        if smoothness is not None:
            measures["sparc"] = smoothness
        measures |= goal.measure(t_s - goal.appears_s, positions, force_n)
        points = {"start": goal.start_m, "target": targets[-1], "end": positions[-1]}
        for name, point in points.items():
            for axis, coordinate_m in zip("xyz", point, strict=False):
                measures[f"{name}_{axis}_m"] = float(coordinate_m)
        return measures


class SyntheticTrial(ExperimentTrial):
    """A trial of synthetic participants."""

    people = False

    def _make_players(self, scenario: Scenario) -> dict[str, HandPlayer]:
        """Returns the synthetic participants of the trial, by the sites that they hold."""
        players = dict[str, HandPlayer]()
        for user, name in zip(self.protocol.users, self.planned.group, strict=True):
            hand = scenario.sites[user].find_live_hand(is_open=True)
            assert hand is not None  # `plan_experiment` has checked it
            hand_site = HandSite(
                scenario=scenario, name=user, spec=hand, rate_hz=HAND_HZ, delay_s=HAND_DELAY_S
            )
            digest = hashlib.sha256(f"{self.protocol.seed}/{name}".encode()).digest()
            participant_seed = int.from_bytes(digest[:4], "big")
            participant = SyntheticParticipant(
                facts=hand_site.describe(),
                model=self.protocol.model.draw(participant_seed),
                goal=self.make_goal(),
                slave=(self.slave, self.arm, self.find_force_n),
                before=self.planned.before,
                seed=self.planned.seed,
                user=len(players),
            )
            players[user] = HandPlayer(hand_site, participant)
        return players

    def find_end_s(self) -> float:
        """Runs the trial, compiled, until it ends; returns its end, s since the epoch."""
        scenario = self.scenario
        judge = TrialJudge(self)
        slave = self.slave
        kept_ticks = scenario.sites[slave].rate_hz // HAND_HZ + 1
        run = FusedRun(scenario, keep=kept_ticks, hands=self._make_players(scenario))
        run.plan([scenario.ticks(name) for name in scenario.names])
        slave_index = scenario.names.index(slave)
        columns = scenario.layout(slave).columns()
        for piece in range(math.ceil(self.longest_s * HAND_HZ)):
            run.step_to((piece + 1) * NS_PER_S // HAND_HZ)
            t_ns, rows = run.pop_records()[slave_index]
            times_s = (t_ns / NS_PER_S).tolist()
            angles = rows[:, columns["q"]].tolist()
            torques = rows[:, columns["tau_x"]].tolist()
            for t_s, q, tau_x in zip(times_s, angles, torques, strict=True):
                judge.accept(t_s, q, tau_x)
            if judge.outcome is not None:
                return judge.outcome.ended_s
            if run.diverged_s is not None:
                return run.diverged_s
        return self.longest_s

    def write(self, path: Path) -> TrialEntry:
        """Runs the trial into its log, and returns its result."""
        scenario = replace(self.scenario, duration_s=self.find_end_s() + REST_S)
        hands = {name: player.track for name, player in self._make_players(scenario).items()}
        record_virtual(scenario, path, force=True, views_hz=0.0, hands=hands)
        return self.settle(path)


def run_trial(task: tuple[Protocol, str, PlannedTrial, str, Path]) -> TrialEntry:
    """Runs a trial of synthetic participants, and keeps its log.

    Args:
        task: the protocol, the text of the scenario, the planned trial, the digest of the
            plan, and the folder of the log.

    Raises:
        LogError: the log is not that of its run.
    """
    protocol, text, planned, digest, folder = task
    trial = SyntheticTrial(protocol, parse_scenario(text), planned, digest)
    return trial.write(folder / planned.file)
