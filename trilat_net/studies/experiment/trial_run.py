"""One trial with synthetic participants in virtual time: its log, and what is measured of it.

Invariant: a trial is run twice by the same numbers: compiled, to find when it ends, and into its log, which
then lasts just that long. The log is executed again before its numbers count.
"""

import hashlib
import math
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from ...analysis.aligned import AlignedRecords, align_records
from ...analysis.torque_sources import split_torque
from ...core.ticks import NS_PER_S, tick_ns
from ...core.vectors import Array
from ...errors import LogError
from ...execution.fused import FusedRun
from ...execution.verify import verify
from ...execution.virtual import write_virtual_log
from ...log.log_file import LogFile
from ...log.log_reader import Log, open_log
from ...scenario import Scenario, parse_scenario
from ...scenario.operators.kernel_operators import find_live_hand
from ...scenario.operators.program_hand import HandPlayer, HandSite
from .movement_measures import mean_force_n, movement_time_s, path_length_m, peak_force_n, sparc
from .protocol import PlannedTrial, Protocol
from .synthetic_participant import SyntheticParticipant
from .tasks import Outcome, TrialGoal

EVERY = 5
"""Of the slave's records one in so many is measured."""
HAND_HZ, HAND_DELAY_S, REST_S = 50, 0.02, 0.1
"""How often a synthetic participant acts; time from what it decides to what its arm does; after the end."""


class Slave(NamedTuple):
    """The arm that a task is about."""

    site: str
    arm: Any


class TrialEntry(msgspec.Struct, frozen=True):
    """A trial that is done, in the journal.

    Attributes:
        cell: its number.
        seed: its seed.
        sha256: digest of its log.
        succeeded: whether its task was done.
        measures: by name, units in the names.
    """

    cell: int
    seed: int
    sha256: str
    succeeded: bool
    measures: dict[str, float]


def find_slave(scenario: Scenario) -> Slave:
    """Returns the first site whose role is slave, else the last one."""
    slaves = [name for name in scenario.names if scenario.sites[name].role == "slave"]
    site = (slaves or scenario.names)[0 if slaves else -1]
    return Slave(site, scenario.arms[site])


class SyntheticTrial:
    """A trial of synthetic participants.

    Attributes:
        outcome: how it ended, once it has run.
    """

    def __init__(self, protocol: Protocol, scenario: Scenario, planned: PlannedTrial, digest: str) -> None:
        self._protocol, self._planned, task = protocol, planned, protocol.task
        self.slave = find_slave(scenario)
        spec = scenario.sites[self.slave.site]
        self._start_m = np.array(self.slave.arm.end_effector(spec.q0_rad), dtype=np.float64)
        about = f"trial {planned.number} of {protocol.name}: {', '.join(planned.group)}, condition "
        about += (
            f"{planned.condition}, block {planned.block}, trial {planned.trial}; protocol sha256 {digest}"
        )
        drawn_s = np.random.default_rng(planned.seed).uniform(*protocol.foreperiod_s)
        self._appears_s = round(float(drawn_s), 3)
        self._longest_s = self._appears_s + task.longest_s + 1.0 / HAND_HZ
        lasts = replace(scenario, duration_s=self._longest_s + REST_S, seed=planned.seed, about=about)
        self._scenario, self.outcome = lasts, Outcome(False, self._longest_s)

    def _goal(self) -> TrialGoal:
        planned = self._planned
        goal = self._protocol.task.begin(self._start_m, planned.target, planned.seed)
        goal.appears_s = self._appears_s
        return goal

    def _make_players(self, scenario: Scenario) -> dict[str, HandPlayer]:
        found = {}
        for user, name in zip(self._protocol.users, self._planned.group, strict=True):
            hand = find_live_hand(scenario.sites[user].hands, is_open=True)
            assert hand is not None  # see `plan_experiment`
            at = HandSite(scenario, user, hand, HAND_HZ, HAND_DELAY_S)
            own = int.from_bytes(hashlib.sha256(f"{self._protocol.seed}/{name}".encode()).digest()[:4], "big")
            model, before = self._protocol.model.draw(own), self._planned.before
            act = SyntheticParticipant(
                at.describe(), model, self._goal(), self.slave, before, self._planned.seed
            )
            found[user] = HandPlayer(at, act)
        return found

    def find_end(self) -> Outcome:
        """Runs the trial, compiled, until it ends."""
        scenario, goal = self._scenario, self._goal()
        run = FusedRun(scenario, keep=1, hands=self._make_players(scenario))
        run.plan([scenario.ticks(name) for name in scenario.names])
        place, joints = scenario.names.index(self.slave.site), self.slave.arm.counts.joints
        for step in range(1, math.ceil(self._longest_s * HAND_HZ) + 1):
            run.step_to(tick_ns(step, HAND_HZ) - 1)
            q = run.arrays(place).site[0]["q"][:joints]
            at_m = np.array(self.slave.arm.end_effector(q), dtype=np.float64)
            ended = goal.judge(step / HAND_HZ, at_m)
            if run.diverged_s is not None:
                ended = Outcome(False, step / HAND_HZ)
            if ended is not None:
                self.outcome = ended
                break
        return self.outcome

    def write(self, path: Path) -> str:
        """Runs the trial into its log; returns the digest of the file, SHA-256."""
        lasts = replace(self._scenario, duration_s=self.outcome.ended_s + REST_S)
        hands = {name: player.track for name, player in self._make_players(lasts).items()}
        with LogFile(path, force=True) as stream:
            write_virtual_log(lasts, stream, hands=hands)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    def measure(self, log: Log) -> dict[str, float]:
        """Returns the measures of a trial, units in the names."""
        found, ended_s = self._measure_motion(log), self.outcome.ended_s
        aligned = align_records(log)
        for place, user in enumerate(self._protocol.users, 1):
            force = _hand_force_n(aligned[user], log.scenario, ended_s)
            which = f"_user{place}" if len(self._protocol.users) > 1 else ""
            found |= {
                f"force_mean{which}_n": mean_force_n(force),
                f"force_peak{which}_n": peak_force_n(force),
            }
        own = log[self._protocol.users[0]]
        used, rate_hz = own.used[self.slave.site], log.scenario.sites[self.slave.site].rate_hz
        age_ms = (own.t_ns - used * NS_PER_S // rate_hz)[used >= 0] / 1e6
        return {**found, "delay_ms": float(age_ms.mean()) if len(age_ms) else 0.0}

    def _measure_motion(self, log: Log) -> dict[str, float]:
        """Returns what the slave did from when the target appears until the trial ends."""
        goal, part, ended_s = self._goal(), log[self.slave.site], self.outcome.ended_s
        rows = np.flatnonzero((part.t_s >= goal.appears_s) & (part.t_s <= ended_s))[::EVERY]
        t_s, rate_hz = part.t_s[rows], part.rate_hz / EVERY
        places = np.array([self.slave.arm.end_effector(q) for q in part.q[rows]], dtype=np.float64)
        wanted = np.array([goal.place(t) for t in t_s])
        apart_m = np.linalg.norm(places - wanted, axis=1)
        speed = np.linalg.norm(np.gradient(places, 1.0 / rate_hz, axis=0), axis=1)
        smooth = sparc(speed, rate_hz)
        ends = {"start": goal.start_m, "target": wanted[-1], "end": places[-1]}
        return {
            "completion_s": ended_s - goal.appears_s,
            "movement_s": movement_time_s(speed, rate_hz) or 0.0,
            "reaction_s": float(np.argmax(speed > 0.05 * speed.max())) / rate_hz,
            "error_end_mm": 1e3 * float(apart_m[-1]),
            "error_rms_mm": 1e3 * float(np.sqrt(np.mean(apart_m**2))),
            "path_m": path_length_m(places),
            **({} if smooth is None else {"sparc": smooth}),
            **{
                f"{name}_{axis}_m": float(x)
                for name, at in ends.items()
                for axis, x in zip("xyz", at, strict=False)
            },
        }


def _hand_force_n(own: AlignedRecords, scenario: Scenario, until_s: float) -> Array:
    """Returns the force of a participant's hand ON its arm, shape (K, 2) or (K, 3), N."""
    split = split_torque(own, scenario)
    inverse = np.linalg.pinv(split.end_effector.J.transpose(0, 2, 1))
    force: Array = np.einsum("kij,kj->ki", inverse, split.operator)
    return force[own.t_s <= until_s]


def run_trial(task: tuple[Protocol, str, PlannedTrial, str, Path]) -> TrialEntry:
    """Runs a trial, by the text of its scenario; keeps its log, and executes that again.

    Raises:
        LogError: the log is not that of its run.
    """
    protocol, text, planned, digest, folder = task
    trial = SyntheticTrial(protocol, parse_scenario(text), planned, digest)
    outcome = trial.find_end()
    path = folder / planned.file
    sha256 = trial.write(path)
    log = open_log(path)
    if not verify(log).passed:
        raise LogError(f"{path}: its records are not those of the run")
    return TrialEntry(planned.number, planned.seed, sha256, outcome.succeeded, trial.measure(log))
