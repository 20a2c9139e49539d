"""One trial: its scenario, how it is judged record by record, what its log says; and synthetic
participants.

Invariant: what counts is a function of the log, whoever took part. It is executed again, and
judged by every record of the slave in it. A synthetic trial is run twice by the same numbers:
compiled, to find when it ends, and into its log, which then lasts just that long.
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

EVERY = 5
"""Of the slave's records one in so many is measured."""
HAND_HZ = 50
HAND_DELAY_S = 0.02
REST_S = 0.1
"""How often a synthetic participant acts; time from what it decides to what its arm does; after
the end.
"""


class TrialEntry(msgspec.Struct, frozen=True):
    """A trial that is done, in the journal.

    Attributes:
        cell: its number.
        seed: its seed.
        sha256: digest of its log.
        succeeded: whether its task was done.
        measures: by name, units in the names.
        people: whether people made it, and no models of them.
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
        goal: what is asked.
        outcome: how it ended; None: it goes on.
    """

    def __init__(self, trial: "ExperimentTrial") -> None:
        self.goal = trial.make_goal()
        self._trial = trial
        self.outcome: Outcome | None = None

    def take(self, t_s: float, q: Sequence[float], tau_x: Sequence[float]) -> Outcome | None:
        """Takes in angles and exogenous torques of a record; returns the outcome, once there is
        one.
        """
        if self.outcome is None:
            force_n = self._trial.find_force_n(q, tau_x) if self.goal.force_n else 0.0
            self.outcome = self.goal.judge(
                t_s, np.array(self._trial.arm.end_effector(q)), force_n
            )
        return self.outcome


class ExperimentTrial:
    """A trial of the plan, of people.

    Attributes:
        people: whether they are people, and no models of them.
        planned: its place in the plan.
        slave, arm: the site whose arm it is about, and that arm.
        scenario: its own, which lasts as long as the trial may.
        appears_s, longest_s: when its target appears, and when it has ended at the latest, s.
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
        whose = "" if self.people else "synthetic "
        about = f"trial {planned.number} of {protocol.name}: {whose}{', '.join(planned.group)}, condition "
        about += f"{planned.condition}, block {planned.block}, trial {planned.trial}; protocol sha256 {digest}"
        drawn_s = np.random.default_rng(planned.seed).uniform(*protocol.foreperiod_s)
        self.appears_s = round(float(drawn_s), 3)
        scenario = self._share_out(scenario)
        self.longest_s = self.appears_s + protocol.task.longest_s + 1.0 / HAND_HZ
        lasts_s = self.longest_s + REST_S
        sites = limit_forces(scenario, protocol, planned.group)
        self.scenario = replace(
            scenario,
            duration_s=lasts_s,
            seed=planned.seed,
            about=about,
            sites={**scenario.sites, **sites},
        )
        self._rows = build_arm_rows(self.scenario, self.slave)

    def _share_out(self, scenario: Scenario) -> Scenario:
        """Returns a scenario in which users have the authority over the slave that the trial
        gives them.
        """
        row = scenario.dominance[self.slave]
        (first, *rest) = self.protocol.users
        goal = self.make_goal()
        if goal.lead is None:
            return scenario
        both = row[first] + row[rest[0]]
        before, after = (
            {**row, first: both * lead, rest[0]: both - both * lead}
            for lead in (goal.lead, 1.0 - goal.lead)
        )
        dominance = {**scenario.dominance, self.slave: before}
        timeline = scenario.timeline
        if goal.handover is not None:
            at_s = self.appears_s + goal.handover[0]
            ramp_s = goal.handover[1]
            timeline = (*timeline, Change(at_s, dominance=self.slave, to=after, ramp_s=ramp_s))
        return replace(scenario, dominance=dominance, timeline=timeline)

    def find_force_n(self, q: Sequence[float], tau_x: Sequence[float]) -> float:
        """Returns the magnitude of what presses on the slave's end effector, N."""
        return float(self._find_forces_n(np.array([q]), np.array([tau_x]))[0])

    def _find_forces_n(self, q: Array, tau_x: Array) -> Array:
        """Returns the same of K records, shape (K,)."""
        force_n: Array = np.linalg.norm(self._place(q).find_force(tau_x), axis=1)
        return force_n

    def _place(self, q: Array) -> EndEffectorRows:
        return self._rows.place_end_effector(q, 0.0 * q)

    def make_goal(self) -> TrialGoal:
        """Returns what is asked."""
        planned = self.planned
        goal = self.protocol.task.begin(self._start_m, planned.target, planned.seed)
        goal.appears_s = self.appears_s
        goal.lead = planned.lead if goal.lead is None else goal.lead
        return goal

    def settle(self, path: Path) -> TrialEntry:
        """Executes its log again and returns what that says of the trial.

        Raises:
            LogError: its records are not those of a run, or they end before the trial does.
        """
        log = open_log(path)
        if not verify(log).passed:
            raise LogError(f"{path}: its records are not those of the run")
        if (outcome := self._judge(log)) is None:
            raise LogError(f"{path}: ends before its trial does")
        of_log = digest_file(path), outcome.succeeded, self._measure(log, outcome)
        return TrialEntry(self.planned.number, self.planned.seed, *of_log, self.people)

    def _judge(self, log: Log) -> Outcome | None:
        judge = TrialJudge(self)
        part = log[self.slave]
        for moment in zip(part.t_s.tolist(), part.q.tolist(), part.tau_x.tolist(), strict=True):
            if (outcome := judge.take(*moment)) is not None:
                return outcome
        return None if log.diverged_s is None else Outcome(False, log.diverged_s)

    def _measure(self, log: Log, outcome: Outcome) -> dict[str, float]:
        """Returns the measures of a trial, units in the names."""
        found = self._measure_motion(log, outcome.ended_s)
        aligned = align_records(log)
        forces = list[Array]()
        for place, user in enumerate(self.protocol.users, 1):
            own = aligned[user]
            which = f"_user{place}" if len(self.protocol.users) > 1 else ""
            split = split_torque(own, log.scenario)
            until = own.t_s <= outcome.ended_s
            # of the hand ON its arm
            forces.append(split.end_effector.find_force(split.operator)[until])
            force_n = np.linalg.norm(forces[-1], axis=1)
            found |= {
                f"force_mean{which}_n": float(force_n.mean()),
                f"force_peak{which}_n": float(force_n.max()),
                f"work{which}_j": energy_j(
                    forces[-1], split.end_effector.speed[until], own.rate_hz
                ),
            }
        if len(forces) > 1:
            found |= self._measure_pair(aligned, forces, outcome.ended_s)
        age_ms = sample_ages_ns(log, self.slave, self.protocol.users[0]) / 1e6
        return {**found, "delay_ms": float(age_ms.mean()) if len(age_ms) else 0.0}

    def _follow(
        self, part: SiteLog | AlignedRecords, from_s: float, until_s: float
    ) -> tuple[Ints, Array, Array, float]:
        """Returns which records of the slave are measured, its places and velocities, and their
        rate, Hz.
        """
        rows = np.flatnonzero((part.t_s >= from_s) & (part.t_s <= until_s))[::EVERY]
        places = self._place(part.q[rows]).position
        rate_hz = part.rate_hz / EVERY
        return rows, places, np.gradient(places, 1.0 / rate_hz, axis=0), rate_hz

    def _measure_pair(
        self, aligned: Mapping[str, AlignedRecords], forces: Sequence[Array], ended_s: float
    ) -> dict[str, float]:
        """Returns what two users do to the slave, as if each pushed at its end effector."""
        slave = aligned[self.slave]
        rows, _, moves, rate_hz = self._follow(slave, 0.0, ended_s)
        t_s = slave.t_s[rows]
        one, other = (
            np.column_stack(
                [np.interp(t_s, aligned[user].t_s[: len(force)], axis) for axis in force.T]
            )
            for user, force in zip(self.protocol.users, forces, strict=True)
        )
        found = measure_pair(one, other, moves, rate_hz)
        return {name: value for name, value in found._asdict().items() if value is not None}

    def _measure_motion(self, log: Log, ended_s: float) -> dict[str, float]:
        """Returns what the slave did from when the target appears until the trial ends."""
        goal = self.make_goal()
        part = log[self.slave]
        rows, places, moves, rate_hz = self._follow(part, goal.appears_s, ended_s)
        t_s = part.t_s[rows]
        speed = np.linalg.norm(moves, axis=1)
        wanted = np.array([goal.place(t) for t in t_s])
        apart_m = np.linalg.norm(places - wanted, axis=1)
        smooth = sparc(speed, rate_hz)
        force_n = (
            self._find_forces_n(part.q[rows], part.tau_x[rows]) if goal.force_n else 0.0 * t_s
        )
        ends = {"start": goal.start_m, "target": wanted[-1], "end": places[-1]}
        return {
            "completion_s": ended_s - goal.appears_s,
            "movement_s": movement_time_s(speed, rate_hz) or 0.0,
            "reaction_s": float(np.argmax(speed > 0.05 * speed.max())) / rate_hz,
            "error_end_mm": 1e3 * float(apart_m[-1]),
            "error_rms_mm": 1e3 * float(np.sqrt(np.mean(apart_m**2))),
            "path_m": path_length_m(places),
            **({} if smooth is None else {"sparc": smooth}),
            **goal.measure(t_s - goal.appears_s, places, force_n),
            **{
                f"{name}_{axis}_m": float(x)
                for name, at in ends.items()
                for axis, x in zip("xyz", at, strict=False)
            },
        }


class SyntheticTrial(ExperimentTrial):
    """A trial of synthetic participants."""

    people = False

    def _make_players(self, scenario: Scenario) -> dict[str, HandPlayer]:
        found = dict[str, HandPlayer]()
        for user, name in zip(self.protocol.users, self.planned.group, strict=True):
            hand = scenario.sites[user].find_live_hand(is_open=True)
            assert hand is not None  # see `plan_experiment`
            at = HandSite(
                scenario=scenario, name=user, spec=hand, rate_hz=HAND_HZ, delay_s=HAND_DELAY_S
            )
            own = int.from_bytes(
                hashlib.sha256(f"{self.protocol.seed}/{name}".encode()).digest()[:4], "big"
            )
            model = self.protocol.model.draw(own)
            slave = (self.slave, self.arm, self.find_force_n)
            mine = (self.make_goal(), slave, self.planned.before, self.planned.seed, len(found))
            act = SyntheticParticipant(at.describe(), model, *mine)
            found[user] = HandPlayer(at, act)
        return found

    def find_end_s(self) -> float:
        """Runs the trial, compiled, until it ends; returns when that is, s."""
        scenario = self.scenario
        judge = TrialJudge(self)
        site = self.slave
        kept = scenario.sites[site].rate_hz // HAND_HZ + 1
        run = FusedRun(scenario, keep=kept, hands=self._make_players(scenario))
        run.plan([scenario.ticks(name) for name in scenario.names])
        place = scenario.names.index(site)
        columns = scenario.layout(site).columns()
        for piece in range(math.ceil(self.longest_s * HAND_HZ)):
            run.step_to((piece + 1) * NS_PER_S // HAND_HZ)
            t_ns, rows = run.pop_records()[place]
            moments = (rows[:, columns[name]].tolist() for name in ("q", "tau_x"))
            for moment in zip((t_ns / NS_PER_S).tolist(), *moments, strict=True):
                judge.take(*moment)
            if judge.outcome is not None:
                return judge.outcome.ended_s
            if run.diverged_s is not None:
                return run.diverged_s
        return self.longest_s

    def write(self, path: Path) -> TrialEntry:
        """Runs the trial into its log, and returns what that says."""
        lasts = replace(self.scenario, duration_s=self.find_end_s() + REST_S)
        hands = {name: player.track for name, player in self._make_players(lasts).items()}
        record_virtual(lasts, path, force=True, views_hz=0.0, hands=hands)
        return self.settle(path)


def run_trial(task: tuple[Protocol, str, PlannedTrial, str, Path]) -> TrialEntry:
    """Runs a trial, by the text of its scenario, and keeps its log.

    Raises:
        LogError: the log is not that of its run.
    """
    protocol, text, planned, digest, folder = task
    return SyntheticTrial(protocol, parse_scenario(text), planned, digest).write(
        folder / planned.file
    )
