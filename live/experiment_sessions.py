"""An experiment with people: a session for each trial, one page for all of them, and what is
written down.

Invariant: what counts is a function of the log, which is in its place before the journal has
the trial: a process that dies at any moment loses no trial whose session it had ended, and
counts no other. Every try has a folder of its own, which stays if the trial does not count,
with a note that says why.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from sites.demo_session import SessionResult, compile_core, run_demo
from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import LogError, LogRefused, RunFailed
from trilat_net.files import describe_write_error, make_subfolder
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.process import Interrupt
from trilat_net.studies.experiment.experiment_run import LOGS, Experiment, Note
from trilat_net.studies.experiment.protocol import PlannedTrial, Step
from trilat_net.studies.experiment.trial_run import ExperimentTrial

from .experiment_stage import Stage, TrialWatch
from .page_server import PageOptions, PageServer

TRIES = "tries"
POLL_NS = 20_000_000
GOODBYE_NS = NS_PER_S
"""From when all is done to the end of the server, in which every page hears of it."""

SOON_NS = 60 * NS_PER_S
"""A session that fails sooner than this, before it has begun, would fail again."""

SessionRunner = Callable[[TrialWatch, Path, Callable[[], bool]], SessionResult]
"""Runs the session of a trial in a folder: from when the function given returns true until its
watch is over, or people end the experiment.
"""


@dataclass
class ExperimentSessions:
    """What is left of an experiment, made with people step by step.

    Attributes:
        experiment: in its folder.
        stage: what its pages are asked.
        clock: of the stage.
        run_session: runs the session of a trial.
        ends: returns true once the experiment is to end for now.
        say: tells people at the terminal.
    """

    experiment: Experiment
    stage: Stage
    clock: Clock
    run_session: SessionRunner
    ends: Callable[[], bool]
    say: Callable[[str], None]

    def run(self) -> bool:
        """Goes on to the end; false if it was ended before.

        Raises:
            LogRefused: a disk refused something; all that was done is kept.
            UsageError: its trials are of synthetic participants.
        """
        trials = self.experiment.open_trials(people=True)
        notes = self.experiment.open_notes()
        with trials as self._trials, notes as self._notes:
            done = {entry.cell for entry in self._trials.done.values()}
            for step in self.experiment.plan.list_steps():
                is_trial = step.kind == "trial"
                if is_trial and step.planned.number in done:
                    continue
                if not (self._make_trial(step) if is_trial else self._ask(step)):
                    return False
            self.stage.close()
        return True

    def _ask(self, step: Step, rest_s: float = 0.0) -> bool:
        """Waits until every user has done a step; notes consents and answers as they come."""
        users = dict(zip(self.stage.users, step.planned.group, strict=True))
        cells = {site: f"{step.key} {who}" for site, who in users.items()}
        asked = self.stage.ask(
            step,
            rest_s,
            [site for site, cell in cells.items() if (cell, 0) in self._notes.done],
        )
        noted = len(self._notes.done)
        while not asked.replies.keys() >= users.keys():
            if self.ends():
                return False
            self.clock.sleep_until(self.clock.monotonic_ns() + POLL_NS)
            for site, (answers, _) in (
                list(asked.replies.items()) if step.kind != "trial" else ()
            ):
                told = step.form.name if step.form else ""
                self._note(
                    cells[site], step.kind, users[site], step.planned.number, told, answers
                )
        if len(self._notes.done) > noted:
            self.experiment.write_tables()
        return True

    def _note(self, cell: str, kind: str, who: str, number: int, *told: Any) -> None:
        self._notes.add(
            Note(cell, kind, who, number, round(self.clock.unix_ns() / NS_PER_S, 3), *told)
        )

    def _make_trial(self, step: Step) -> bool:
        """Makes a trial until one counts; false if the experiment was ended before."""
        plan = self.experiment.plan
        planned = step.planned
        scenario = plan.find_scenario(planned, self.experiment.list_choices())
        trial = ExperimentTrial(plan.protocol, scenario, planned, plan.digest)
        path = make_subfolder(self.experiment.folder / LOGS) / planned.file
        # a program was killed before it was counted
        if path.exists() and not self._count(trial, path):
            return True
        for left in self._list_tries(planned)[-1:]:
            if any(left.glob("*.mcap*")):
                self._note_aborted(planned, "the program was ended")
            else:  # its session had not begun
                shutil.rmtree(left, ignore_errors=True)
        rest_s = plan.rest_before_s(planned)
        while not self._try(step, trial, path, rest_s):
            if self.ends():
                return False
            rest_s = 0.0
        return True

    def _list_tries(self, planned: PlannedTrial) -> list[Path]:
        return sorted((self.experiment.folder / TRIES).glob(f"{planned.number:05d}-*"))

    def _note_aborted(self, planned: PlannedTrial, why: str) -> None:
        """Notes why the newest try does not count, unless that is noted."""
        cell = f"aborted {self._list_tries(planned)[-1].name}"
        self._note(cell, "aborted", "-".join(planned.group), planned.number, why)
        self.experiment.write_tables()

    def _try(self, step: Step, trial: ExperimentTrial, path: Path, rest_s: float) -> bool:
        """Runs the session of a trial, once all users are ready; false if it does not count."""
        number = len(self._list_tries(step.planned)) + 1
        begun_ns = self.clock.monotonic_ns()
        tries = make_subfolder(self.experiment.folder / TRIES)
        folder = make_subfolder(tries / f"{step.planned.number:05d}-{number:02d}")
        watch = TrialWatch(trial, self.clock)
        asked = self.stage.ask(step, rest_s)
        ready: list[str] = []

        def begins() -> bool:
            if not ready and asked.replies.keys() >= set(self.stage.users):
                ready.extend(self.stage.users)
                self.stage.begin(watch)
            return bool(ready)

        try:
            result = self.run_session(watch, folder, begins)
        except OSError as error:
            raise describe_write_error(folder, error) from None
        self.stage.check()
        if result.problems and result.exit_code == LogRefused.exit_code:
            raise LogRefused("; ".join(result.problems))
        # nobody has begun anything: people have ended it, or the sites have waited for long
        if not ready:
            shutil.rmtree(folder, ignore_errors=True)
            if result.problems and self.clock.monotonic_ns() - begun_ns < SOON_NS:
                raise RunFailed("; ".join(result.problems))
            return False
        why = _find_reason(watch, result)
        if not why:
            result.log.replace(path)
            why = self._count(trial, path)
        if why:
            self._note_aborted(step.planned, why)
            self.stage.tell(None, why)
            self.say(f"trial {step.planned.number} is to be made again: {why}")
        return not why

    def _count(self, trial: ExperimentTrial, path: Path) -> str:
        """Counts a trial by its log, which is in its place; returns why it does not count, ""
        if it does.
        """
        tries = self._list_tries(trial.planned)[-1:]
        try:
            entry = trial.settle(path)
        except LogError as error:
            path.replace((*tries, self.experiment.folder)[0] / path.name)
            return str(error)
        self._trials.add(entry)
        for folder in tries:
            shutil.rmtree(folder, ignore_errors=True)
        self.stage.tell(entry)
        self.experiment.write_tables()
        planned = trial.planned
        took_s = entry.measures["completion_s"]
        how = f"{'succeeded' if entry.succeeded else 'failed'} after {took_s:.2f} s"
        whose = f"trial {planned.number} of {len(self.experiment.plan.trials)}, {', '.join(planned.group)}"
        self.say(f"{whose}, {planned.condition}: {how}")
        return ""


def _find_reason(watch: TrialWatch, result: SessionResult) -> str:
    """Returns why the session of a trial is none that counts; an arm that diverged is a trial
    that failed.
    """
    if result.interrupted:
        return "the experiment was interrupted"
    if watch.aborted or not result.log.exists():
        return watch.aborted or "; ".join(result.problems) or "there is no log"
    return "" if watch.diverged else "; ".join(result.problems)


def run_with_people(
    experiment: Experiment, options: PageOptions, say: Callable[[str], None]
) -> int:
    """Goes on with an experiment, with people on its page; returns the exit code.

    Raises:
        LogRefused: a disk refused something; all that was done is kept.
        UsageError: its trials are of synthetic participants.
    """
    clock = SystemClock()
    plan = experiment.plan
    stage = Stage(plan, clock)
    name = plan.protocol.name
    with Interrupt() as interrupt, closing(ZenohBus()) as idle:
        for scenario in plan.scenarios.values():
            compile_core(scenario, say, interrupt)
        with PageServer(idle, clock, name, options, ends=True, say=say, stage=stage) as page:

            def run_session(
                watch: TrialWatch, folder: Path, begins: Callable[[], bool]
            ) -> SessionResult:
                attend = partial(_attend, page, idle, watch)
                result = run_demo(
                    scenario=watch.trial.scenario,
                    folder=folder,
                    console=Console(quiet=True),
                    attend=attend,
                    begins=begins,
                )
                interrupt.number = interrupt.number or result.interrupted
                return result

            def ends() -> bool:
                return interrupt.is_requested() or page.end_requested.is_set()

            if ExperimentSessions(
                experiment=experiment,
                stage=stage,
                clock=clock,
                run_session=run_session,
                ends=ends,
                say=say,
            ).run():
                clock.sleep_until(clock.monotonic_ns() + GOODBYE_NS)
    return interrupt.exit_code if interrupt.is_requested() else 0


@contextmanager
def _attend(
    page: PageServer,
    idle: Bus,
    watch: TrialWatch,
    session: str,
    endpoints: Sequence[str],
    _say: Callable[[str], None],
) -> Iterator[Callable[[], bool]]:
    """The `SessionAttendant` of a trial: the page shows its session, and then none."""
    with closing(ZenohBus([], endpoints)) as bus:
        page.show(bus, session)
        try:
            yield lambda: watch.over or page.end_requested.is_set()
        finally:
            page.show(idle, watch.trial.protocol.name)
