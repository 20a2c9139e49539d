"""Conducts an experiment with people: one live session per trial, on the same browser pages.

The participants open their pages once. For each trial, this module starts a session, shows it
on the pages of the experimenter and the participants, verifies the recorded log, and writes the
result to the journal of the experiment. Between trials, it collects consents and
questionnaires.

Invariant:
    - A trial counts only if its log exists and is valid. The log is moved to its final path
      before the trial is added to the journal. If this process dies at any moment, no completed
      trial is lost and no incomplete trial is counted.
    - Every attempt at a trial has its own folder. If an attempt does not count, its folder is
      kept together with a note of the reason.
"""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rich.console import Console

from trilat_net.app import SessionResult, compile_core, run_demo
from trilat_net.errors import LogError, LogRefused, RunFailed
from trilat_net.files import describe_write_error, make_folder
from trilat_net.net import Bus, Clock, Connection, SystemClock
from trilat_net.records import NS_PER_S
from trilat_net.signals import Interrupt

from ..experiment.experiment_run import LOGS, Experiment, Note
from ..experiment.protocol import PlannedTrial, Step
from ..experiment.trial_run import ExperimentTrial
from .experiment_stage import Stage, TrialWatch
from .page_server import PageOptions, PageServer

ATTEMPTS = "tries"
"""Name of the folder of trial attempts, inside the folder of the experiment."""
POLL_NS = 20_000_000
"""Time between two checks for the replies of participants, in ns."""
FAREWELL_NS = NS_PER_S
"""Time between the last step and the shutdown of the server, in ns.

During this time, every page is notified that the experiment has ended.
"""
EARLY_FAILURE_NS = 60 * NS_PER_S
"""Time within which a session that fails before starting would fail again, in ns."""

SessionRunner = Callable[[TrialWatch, Path, Callable[[], bool]], SessionResult]
"""Function that runs the session of a trial until the trial is over or people end it.

Takes the watch of the trial, the folder of the attempt, and a function that returns True once
the session may start.
"""


@dataclass
class ExperimentSessions:
    """Runs the remaining steps of an experiment with people, one at a time.

    Steps are consents, questionnaires and trials. Each trial runs in its own session.

    Attributes:
        experiment: The experiment, with its plan and the journals of completed steps.
        stage: Controls the content of the pages between sessions and collects the participants'
            replies.
        clock: Clock of this process.
        run_session: Function that runs the session of a trial.
        ends: Function that returns True once the experiment must be interrupted.
        say: Function that prints a line for the user.
    """

    experiment: Experiment
    stage: Stage
    clock: Clock
    run_session: SessionRunner
    ends: Callable[[], bool]
    say: Callable[[str], None]

    def run(self) -> bool:
        """Runs the remaining steps and skips those already completed.

        An experiment can be interrupted and resumed on another day.

        Returns:
            True if all steps have been completed, False if the experiment was interrupted.

        Raises:
            LogRefused: A file could not be written to disk. All results so far are kept.
            UsageError: The experiment has synthetic participants.
        """
        trials = self.experiment.open_trials(people=True)
        notes = self.experiment.open_notes()
        with trials as self._trials, notes as self._notes:
            completed_trials = {entry.cell for entry in self._trials.done.values()}
            for step in self.experiment.plan.list_steps():
                if step.kind != "trial":
                    is_done = self._request_step(step)
                elif step.planned.number in completed_trials:
                    is_done = True
                else:
                    is_done = self._run_trial(step)

                if not is_done:
                    return False
            self.stage.show_end()
        return True

    def _request_step(self, step: Step, rest_s: float = 0.0) -> bool:
        """Waits until every user has completed a step, and records their consents and answers.

        A step is a consent, a questionnaire, or confirming readiness for a trial. The users
        complete it on their web pages, which are controlled by the stage. The consent or the
        answers of each user are stored as a note in the journal of the experiment, which
        survives a restart of this program.

        Args:
            step: The step.
            rest_s: Rest before the step, in s.

        Returns:
            True if every user has completed the step, False if the experiment was interrupted
            first.
        """
        pseudonyms = dict(zip(self.stage.users, step.planned.group, strict=True))  # by site
        note_keys = {site: f"{step.key} {who}" for site, who in pseudonyms.items()}
        # The journal identifies an entry by its key and a seed, which is 0 for all notes.
        sites_done_earlier = [
            site for site, key in note_keys.items() if (key, 0) in self._notes.done
        ]
        request = self.stage.request_step(step, rest_s, sites_done_earlier)
        note_count_before = len(self._notes.done)
        form_name = step.form.name if step.form else ""

        while not request.replies.keys() >= pseudonyms.keys():
            if self.ends():
                return False
            self.clock.sleep_until(self.clock.monotonic_ns() + POLL_NS)
            # A user who is ready for a trial leaves no note.
            if step.kind == "trial":
                continue
            # Every poll returns all replies. The journal ignores replies that it already
            # contains.
            for site, (answers, _) in list(request.replies.items()):
                self._add_note(
                    cell=note_keys[site],
                    kind=step.kind,
                    who=pseudonyms[site],
                    number=step.planned.number,
                    text=form_name,
                    answers=answers,
                )
        has_new_notes = len(self._notes.done) > note_count_before
        if has_new_notes:
            self.experiment.write_tables()
        return True

    def _add_note(
        self,
        *,
        cell: str,
        kind: str,
        who: str,
        number: int,
        text: str,
        answers: Mapping[str, float | None] = {},
    ) -> None:
        """Adds a note to the journal, unless the journal already has a note with the same key.

        Args:
            cell: Key of the note.
            kind: Kind of note, such as "consent" or "aborted".
            who: Pseudonym of the participant, or of all participants of the trial.
            number: Number of the trial.
            text: Name of the questionnaire, or a reason.
            answers: Answers to a questionnaire; `None` for a missing answer.
        """
        unix_s = round(self.clock.unix_ns() / NS_PER_S, 3)
        note = Note(
            cell=cell,
            kind=kind,
            who=who,
            number=number,
            unix_s=unix_s,
            text=text,
            answers=dict(answers),
        )
        self._notes.add(note)

    def _run_trial(self, step: Step) -> bool:
        """Runs attempts at a trial until one is valid.

        An attempt is one session of the trial, with its own folder. If this program was
        previously terminated during the trial, it may have left behind a finished log, which is
        now counted, or an unfinished attempt, which is recorded as aborted.

        Args:
            step: The step of the trial.

        Returns:
            True if an attempt counts, False if the experiment was interrupted first.
        """
        plan = self.experiment.plan
        planned = step.planned
        scenario = plan.find_scenario(planned, self.experiment.list_choices())
        trial = ExperimentTrial(plan.protocol, scenario, planned, plan.digest)
        log_path = make_folder(self.experiment.folder / LOGS, may_be_link=False) / planned.file
        # If the log already exists, the program was killed before it had counted the trial.
        if log_path.exists():
            reason_against = self._count_trial(trial, log_path)
            if not reason_against:
                return True

        earlier_attempts = self._list_attempts(planned)
        if earlier_attempts:
            last_attempt = earlier_attempts[-1]
            has_begun_log = any(last_attempt.glob("*.mcap*"))
            if has_begun_log:
                self._record_aborted(planned, "the program was ended")
            else:
                # The session of the attempt had not begun.
                shutil.rmtree(last_attempt, ignore_errors=True)

        rest_s = plan.rest_before_s(planned)
        while True:
            counts = self._run_attempt(step, trial, log_path, rest_s)
            if counts:
                return True
            if self.ends():
                return False
            rest_s = 0.0  # the users have rested before the first attempt

    def _list_attempts(self, planned: PlannedTrial) -> list[Path]:
        """Returns the folders of all attempts at a trial, oldest first.

        A trial is attempted again if its session was aborted or its log is not valid. Folder
        names begin with the number of the trial.
        """
        attempts = self.experiment.folder / ATTEMPTS
        return sorted(attempts.glob(f"{planned.number:05d}-*"))

    def _record_aborted(self, planned: PlannedTrial, reason: str) -> None:
        """Records in the journal why the newest attempt at a trial does not count.

        The trial is then repeated. Does nothing if a reason for this attempt has already been
        recorded.

        Args:
            planned: The trial.
            reason: Reason why the attempt does not count, for the experimenter.
        """
        last_attempt = self._list_attempts(planned)[-1]

        self._add_note(
            cell=f"aborted {last_attempt.name}",
            kind="aborted",
            who="-".join(planned.group),
            number=planned.number,
            text=reason,
        )
        self.experiment.write_tables()

    def _run_attempt(
        self, step: Step, trial: ExperimentTrial, path: Path, rest_s: float
    ) -> bool:
        """Runs the session of a trial once all users are ready.

        Args:
            step: The step of the trial.
            trial: The trial.
            path: Final path of the log.
            rest_s: Rest before the trial, in s.

        Returns:
            True if the trial counts.

        Raises:
            LogRefused: The log could not be written to disk.
            RunFailed: The session failed before it started, and would fail again.
        """
        number = len(self._list_attempts(step.planned)) + 1
        begun_ns = self.clock.monotonic_ns()
        attempts = make_folder(self.experiment.folder / ATTEMPTS, may_be_link=False)
        folder = make_folder(
            attempts / f"{step.planned.number:05d}-{number:02d}", may_be_link=False
        )
        watch = TrialWatch(trial, self.clock)
        request = self.stage.request_step(step, rest_s)
        has_begun = False

        def begins() -> bool:
            """Returns True once all participants have confirmed that they are ready.

            They confirm this on their pages. The session waits for the confirmations before its
            first control period, and the pages then show the trial.
            """
            nonlocal has_begun
            if not has_begun and request.replies.keys() >= set(self.stage.users):
                has_begun = True
                self.stage.show_trial(watch)
            return has_begun

        try:
            result = self.run_session(watch, folder, begins)
        except OSError as error:
            raise describe_write_error(folder, error) from None
        self.stage.show_checking()
        if result.problems and result.exit_code == LogRefused.exit_code:
            raise LogRefused("; ".join(result.problems))
        if not has_begun:
            # People have ended the experiment, or the sites have waited for too long.
            shutil.rmtree(folder, ignore_errors=True)
            elapsed_ns = self.clock.monotonic_ns() - begun_ns
            if result.problems and elapsed_ns < EARLY_FAILURE_NS:
                raise RunFailed("; ".join(result.problems))
            return False

        reason = _find_repeat_reason(watch, result)
        if not reason:
            result.log.replace(path)
            reason = self._count_trial(trial, path)
        if reason:
            self._record_aborted(step.planned, reason)
            self.stage.show_feedback(None, reason)
            self.say(f"trial {step.planned.number} must be repeated: {reason}")
        return not reason

    def _count_trial(self, trial: ExperimentTrial, path: Path) -> str:
        """Judges a trial by its log and adds the result to the journal of the experiment.

        A log that cannot be judged is moved back to the folder of its attempt, and the trial is
        repeated.

        Args:
            trial: The trial.
            path: The log, at its final path.

        Returns:
            The reason why the trial does not count. Empty if it counts.
        """
        last_attempt = self._list_attempts(trial.planned)[-1:]
        try:
            entry = trial.settle(path)
        except LogError as error:
            folder = last_attempt[0] if last_attempt else self.experiment.folder
            path.replace(folder / path.name)
            return str(error)

        self._trials.add(entry)
        for folder in last_attempt:
            shutil.rmtree(folder, ignore_errors=True)
        self.stage.show_feedback(entry)
        self.experiment.write_tables()

        planned = trial.planned
        total = len(self.experiment.plan.trials)
        outcome_text = "succeeded" if entry.succeeded else "failed"
        completion_s = entry.measures["completion_s"]
        self.say(
            f"trial {planned.number} of {total}, {', '.join(planned.group)}, "
            f"{planned.condition}: {outcome_text} after {completion_s:.2f} s"
        )
        return ""


def _find_repeat_reason(watch: TrialWatch, result: SessionResult) -> str:
    """Returns the reason why a trial must be repeated, or an empty string.

    A trial in which an arm exceeded its limits is not repeated but counts as failed.
    """
    if result.interrupted:
        return "the experiment was interrupted"

    problems = "; ".join(result.problems)
    if watch.aborted:
        return watch.aborted
    if not result.log.exists():
        return problems or "there is no log"
    return "" if watch.diverged else problems


def run_with_people(
    experiment: Experiment, options: PageOptions, say: Callable[[str], None]
) -> int:
    """Resumes an experiment with people at its first incomplete step.

    The experiment is shown on web pages, one per participant and one for the experimenter.

    Args:
        experiment: The experiment, with its plan and the journals of completed steps.
        options: Address, encryption and further options of the page server.
        say: Function that prints a line for the user.

    Returns:
        Exit code of the command.

    Raises:
        LogRefused: A file could not be written to disk. All results so far are kept.
        UsageError: The experiment has synthetic participants.
    """
    clock = SystemClock()
    plan = experiment.plan
    stage = Stage(plan, clock)
    name = plan.protocol.name
    with Interrupt() as interrupt, closing(Connection().open()) as idle:
        for scenario in plan.scenarios.values():
            compile_core(scenario, say, interrupt)
        with PageServer(idle, clock, name, options, ends=True, say=say, stage=stage) as page:

            def run_session(
                watch: TrialWatch, folder: Path, begins: Callable[[], bool]
            ) -> SessionResult:
                """Runs the session of one trial and shows it on the pages of the experiment.

                Uses the page server `page`, the network connection `idle` that the pages
                observe between sessions, and the signal handler `interrupt` of the experiment.
                A signal that ends the session, such as Ctrl-C, also ends the experiment.

                Args:
                    watch: The trial and its current state.
                    folder: Folder for the log and for the output of the processes.
                    begins: Function that returns True once the session may start.

                Returns:
                    Result of the session, including the path of its log.
                """
                # `run_demo` passes the remaining arguments: the session and its addresses.
                show_session_on_pages = partial(_show_session, page, idle, watch)
                result = run_demo(
                    scenario=watch.trial.scenario,
                    folder=folder,
                    console=Console(quiet=True),
                    attend=show_session_on_pages,
                    begins=begins,
                )
                # Both are the number of the signal that arrived, or 0. The first signal is
                # kept.
                interrupt.number = interrupt.number or result.interrupted
                return result

            def ends() -> bool:
                """Returns True once Ctrl-C or an experimenter's page has requested a stop."""
                return interrupt.is_requested() or page.end_requested.is_set()

            sessions = ExperimentSessions(
                experiment=experiment,
                stage=stage,
                clock=clock,
                run_session=run_session,
                ends=ends,
                say=say,
            )
            if sessions.run():
                clock.sleep_until(clock.monotonic_ns() + FAREWELL_NS)
    return interrupt.exit_code if interrupt.is_requested() else 0


@contextmanager
def _show_session(
    page: PageServer,
    idle: Bus,
    watch: TrialWatch,
    session: str,
    endpoints: Sequence[str],
    _say: Callable[[str], None],
) -> Iterator[Callable[[], bool]]:
    """Context manager that shows the session of a trial on the pages of the experiment.

    Has the signature of a `SessionAttendant`. After the session, the pages observe the
    experiment's own network connection, which carries no messages, so the connection to the
    session can be closed.

    Args:
        page: Server of the pages.
        idle: Network connection of the experiment.
        watch: Judge of the trial.
        session: Name of the session.
        endpoints: Network addresses at which the session can be reached.

    Yields:
        A function that returns True once the session should end.
    """
    with closing(Connection(connect=endpoints).open()) as bus:
        page.show(bus, session)
        try:
            yield lambda: watch.over or page.end_requested.is_set()
        finally:
            page.show(idle, watch.trial.protocol.name)
