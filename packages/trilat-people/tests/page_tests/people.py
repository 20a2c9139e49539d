"""People without browsers: they do at once what a stage asks, and their sessions run in virtual time."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.trial_run import SyntheticTrial
from trilat_people.live_page.experiment_sessions import ExperimentSessions
from trilat_people.live_page.experiment_stage import Stage, TrialWatch
from trilat_people.live_page.page_orders import DoStep

from tests.net.manual_clock import ManualClock
from trilat_net.app.demo_session import SessionResult

NO_SESSION: Any = SimpleNamespace(running=False, sites={})
Fault = Callable[[TrialWatch, Path], SessionResult | None]


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the program runs after it."""


class People(ManualClock):
    """Those who take part, a page each; whenever the program waits, they do what they are asked.

    Attributes:
        stage: what asks them.
        steps: what they have done, in order, a site and a key each.
        wall_ns: how far the machine's wall clock was set, ns.
    """

    def __init__(self, experiment: Experiment, answer: float = 40.0) -> None:
        super().__init__(1, 10**18)
        self.stage = Stage(experiment.plan, self)
        self.experiment, self._answer = experiment, answer
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
            shown = self.stage.describe("user", site, n, None)
            items = shown.get("form", {}).get("items", {})
            message = DoStep(key=shown.get("key", ""), answers=[self._answer] * len(items))
            if not shown.get("done") and self.stage.accept(site, n, message):
                self.steps.append((site, message.key))

    def run(self, fault: Fault = lambda _, __: None) -> bool:
        """Goes on with the experiment; a fault may end a session instead."""

        def run_session(
            watch: TrialWatch, folder: Path, begins: Callable[[], bool]
        ) -> SessionResult:
            while not begins():
                if self.ends:
                    return SessionResult(folder / "run.mcap")
                self.sleep_until(self.monotonic_ns() + 10**9)
            failed = fault(watch, folder)
            if failed is None:
                trial, plan = watch.trial, self.experiment.plan
                scenario = plan.find_scenario(trial.planned, self.experiment.list_choices())
                SyntheticTrial(plan.protocol, scenario, trial.planned, plan.digest).write(
                    folder / "run.mcap"
                )
            return failed or SessionResult(folder / "run.mcap")

        made = ExperimentSessions(
            self.experiment, self.stage, self, run_session, lambda: self.ends, self.said.append
        )
        return made.run()
