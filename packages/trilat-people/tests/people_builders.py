"""Experiments, their tables, and participants without browsers, for the tests of people.

The participants do at once what a stage asks, and their sessions run in virtual time.
"""

import csv
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.protocol import PlannedTrial
from trilat_people.experiment.trial_run import ExperimentTrial, SyntheticTrial
from trilat_people.live_page.experiment_sessions import ExperimentSessions
from trilat_people.live_page.experiment_stage import Stage, TrialWatch
from trilat_people.live_page.page_orders import DoStep

from tests.net.manual_clock import ManualClock
from trilat_net import run_experiment
from trilat_net.app.demo_session import SessionResult

PAIR = '["m1", "m2"]'
"""The users of an experiment with pairs."""


def replace_text(file: Path, old: str, new: str) -> Path:
    """Replaces a text that a file contains, and returns the file."""
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    return file


def run_protocol(file: Path) -> Experiment:
    """Runs the experiment of a protocol with synthetic participants, in the folder `out` beside it."""
    return run_experiment(file, file.parent / "out", jobs=1)


def read_table(folder: Path, name: str = "trials.csv") -> list[dict[str, str]]:
    """Returns the rows of a table in the folder of an experiment."""
    with (folder / name).open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def make_experiment_trial(experiment: Experiment, planned: PlannedTrial) -> ExperimentTrial:
    """Returns a planned trial of an experiment under its condition."""
    plan = experiment.plan
    scenario = plan.scenarios[planned.condition]
    return ExperimentTrial(plan.protocol, scenario, planned, plan.digest)


NO_SESSION: Any = SimpleNamespace(running=False, sites={})
Fault = Callable[[TrialWatch, Path], SessionResult | None]


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the program runs after it."""


class People(ManualClock):
    """Participants with a page each, who do what they are asked whenever the program waits.

    Attributes:
        stage: The stage that asks them.
        steps: The steps that they have done, in order, each as a site and a key.
        said: The texts that the program has printed.
        ends: True if the experimenter ends the experiment.
        wall_ns: The shift of the machine's wall clock, in ns.
    """

    def __init__(self, experiment: Experiment, answer: float = 40.0) -> None:
        super().__init__(1, 10**18)
        self.stage = Stage(experiment.plan, self)
        self.experiment = experiment
        self._answer = answer
        self.steps: list[tuple[str, str]] = []
        self.said: list[str] = []
        self.ends = False
        self.wall_ns = 0

    def unix_ns(self) -> int:
        return super().unix_ns() + self.wall_ns

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns)
        self.stage.poll(NO_SESSION, [(site, n) for n, site in enumerate(self.stage.users)])
        for n, site in enumerate(self.stage.users):
            stage_view = self.stage.describe("user", site, n, None)
            items = stage_view.get("form", {}).get("items", {})
            message = DoStep(key=stage_view.get("key", ""), answers=[self._answer] * len(items))
            if not stage_view.get("done") and self.stage.accept(site, n, message):
                self.steps.append((site, message.key))

    def run(self, fault: Fault = lambda _, __: None) -> bool:
        """Continues the experiment, in which a fault may end a session.

        Returns:
            True if all trials are done.
        """

        def run_session(
            watch: TrialWatch, folder: Path, begins: Callable[[], bool]
        ) -> SessionResult:
            while not begins():
                if self.ends:
                    return SessionResult(folder / "run.mcap")
                self.sleep_until(self.monotonic_ns() + 10**9)
            failure = fault(watch, folder)
            if failure is not None:
                return failure
            planned = watch.trial.planned
            plan = self.experiment.plan
            scenario = plan.find_scenario(planned, self.experiment.list_choices())
            trial = SyntheticTrial(plan.protocol, scenario, planned, plan.digest)
            trial.write(folder / "run.mcap")
            return SessionResult(folder / "run.mcap")

        sessions = ExperimentSessions(
            self.experiment, self.stage, self, run_session, lambda: self.ends, self.said.append
        )
        return sessions.run()
