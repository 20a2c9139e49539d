"""Runs an experiment and stores its results in a folder: logs, journals and tables.

`Experiment.begin` creates the folder. `Experiment.run` runs the remaining trials with synthetic
participants, which are models of people; `trilat experiment run --live` runs them with people.
Each finished trial is appended to a journal file, so an interrupted experiment can be resumed.

Invariant:
    - A folder belongs to the plan whose digest it contains.
    - A trial in the journal is never run again, and an interrupted trial is repeated in full.
      Nothing is stored twice or lost, even if the process is killed.
    - The tables are computed from the journals.
    - People and synthetic participants never share a folder.
"""

import json
import math
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.errors import UsageError, count_nouns
from trilat_net.files import digest_file, make_folder, make_results_folder, write_whole
from trilat_net.presentation import Block, TextTable
from trilat_net.results import Result
from trilat_net.scenario import parse_embedded
from trilat_net.work import Progress, RunJournal, WorkerPool, Workers, encode_csv

from .completion_times import COMPLETION, find_median, is_completed
from .protocol import Choices, ExperimentPlan, ExperimentProtocol, PlannedTrial
from .questionnaires import CHOICE
from .staircase import COMPARISON, Staircase
from .trial_run import SyntheticTrial, TrialEntry

PROTOCOL_FILE = "protocol.toml"
PLAN_FILE = "protocol.json"
JOURNAL_FILE = "trials.journal"
NOTES_FILE = "notes.journal"
TRIALS_FILE = "trials.csv"  # fmt: skip
LOGS = "logs"


class Note(msgspec.Struct, frozen=True):
    """A journal entry of an experiment other than a finished trial.

    Records a consent, the answers to a questionnaire, or an aborted trial. Notes have a journal
    of their own.

    Attributes:
        cell: Unique key of the note. The key names the step of the experiment and the
            participant or, for an aborted trial, the attempt at the trial.
        kind: "consent", "questionnaire" or "aborted".
        who: Pseudonym of the participant. For an aborted trial, the pseudonyms of all its
            participants.
        number: Number of the trial to which the note belongs.
        unix_s: Unix time of the note on this machine's clock, in s.
        text: Name of the questionnaire, or the reason why the trial was aborted.
        answers: Mapping from item to answer; `None` for a missing answer.
        seed: Always 0. Present because journal entries of other studies have a seed.
    """

    cell: str
    kind: str
    who: str
    number: int
    unix_s: float
    text: str = ""
    answers: dict[str, float | None] = {}
    seed: int = 0


class _ExperimentStatus(NamedTuple):
    """Progress of an experiment: the number of finished trials and the next trial.

    Attributes:
        done: Number of trials in the journal.
        total: Number of trials in the plan.
        next: First unfinished trial, or `None` if all trials are finished.
    """

    done: int
    total: int
    next: PlannedTrial | None


class Experiment(Result):
    """An experiment stored in a folder: the plan, the finished trials and their results.

    Created by `Experiment.begin` or `open_experiment`.

    Args:
        folder: Folder with the plan, journals and logs of the experiment.
        plan: The protocol and its trials.

    Attributes:
        folder: Folder with the plan, journals and logs of the experiment.
        plan: The protocol and its trials.
        unit: "pair" if participants take part in pairs, otherwise "participant".
    """

    def __init__(self, folder: Path, plan: ExperimentPlan) -> None:
        self.folder = folder
        self.plan = plan
        self.unit = "pair" if len(plan.protocol.users) > 1 else "participant"
        self._remedy = RunJournal.build_resume_hint("experiment", "run", str(folder))

    def open_trials(self, *, people: bool | None = None) -> RunJournal[TrialEntry]:
        """Opens the journal of finished trials.

        An experiment must not mix trials of people with trials of synthetic participants, so a
        caller that adds trials must declare their kind.

        Args:
            people: True to add trials of people, False to add trials of synthetic participants,
                or `None` to open the journal for reading only.

        Raises:
            UsageError: The journal already contains trials of the other kind.
        """
        if people is not None:
            entries = self.read_entries().values()
            has_other_kind = any(entry.people != people for entry in entries)
            if has_other_kind:
                advice = "people: continue with"
                if people:
                    advice = "synthetic participants: continue without"
                raise UsageError(
                    f"{self.folder}: the finished trials were done by {advice} --live, "
                    "or start another experiment"
                )
        return RunJournal(
            self.folder / JOURNAL_FILE, self.plan.digest, TrialEntry, self._remedy
        )

    def open_notes(self) -> RunJournal[Note]:
        """Opens the journal of consents, questionnaire answers and aborted trials.

        Use the journal in a `with` statement to read or append notes.
        """
        return RunJournal(self.folder / NOTES_FILE, self.plan.digest, Note, self._remedy)

    def read_entries(self) -> dict[int, TrialEntry]:
        """Returns the result of each finished trial, by the number of the trial in the plan.

        For example, {1: TrialEntry(...), 2: TrialEntry(...)}. Empty before the first trial.
        """
        with self.open_trials() as journal:
            return {entry.cell: entry for entry in journal.done.values()}

    def read_notes(self) -> list[Note]:
        """Returns all notes of the experiment in chronological order.

        A note records a consent, the answers to a questionnaire, or an aborted trial.
        """
        if not (self.folder / NOTES_FILE).exists():
            return []
        with self.open_notes() as journal:
            return list(journal.done.values())

    def list_choices(self) -> Choices:
        """Returns the participants' choices in the perception test of the experiment.

        A staircase presents pairs of trials and asks in which of the two a quantity was larger.
        The choices determine the difference in the next pair.

        Returns:
            Mapping from the number of the second trial of a pair to the chosen trial, 1 or 2.
            Empty if there is no staircase. Pairs with no answer are left out.
        """
        if self.plan.protocol.staircase is None:
            return {}
        choices: dict[int, float] = {}
        for note in self.read_notes():
            choice = note.answers[CHOICE] if note.text == CHOICE else None
            if choice is not None:
                choices[note.number] = choice
        return choices

    def _draw_choices(self, staircase: Staircase) -> None:
        """Records the choices of synthetic participants for all pairs of a staircase.

        A staircase is a perception test with pairs of trials: a quantity has its standard value
        in one trial of a pair and a larger value in the other (the comparison trial). After the
        second trial, the participant chooses the one with the larger value. The difference in a
        pair depends on whether the earlier choices in the block were right.

        The choices depend only on the plan, so they can be drawn before any trial is run.

        Args:
            staircase: Settings of the test, including the model of the participant's imperfect
                perception.
        """
        # Chosen trial, 1 or 2, by the number of the second trial.
        choices: dict[int, float] = {}
        with self.open_notes() as notes:
            for step in self.plan.list_steps():
                is_choice = step.form is not None and step.form.name == CHOICE
                if not is_choice:
                    continue

                second_trial = step.planned
                were_right = self.plan.judge_choices(second_trial, choices)
                # The last difference belongs to this pair, for which no choice has been made
                # yet.
                difference = staircase.list_differences(were_right)[-1]
                comparison_trial = 2 if second_trial.phase == COMPARISON else 1

                choice = staircase.draw_choice(difference, comparison_trial, second_trial.seed)
                choices[second_trial.number] = choice
                participants = "-".join(second_trial.group)
                note = Note(
                    cell=f"{step.key} {participants}",
                    kind=step.kind,
                    who=participants,
                    number=second_trial.number,
                    unix_s=0.0,
                    text=CHOICE,
                    answers={CHOICE: choice},
                )
                notes.add(note)

    def status(self) -> _ExperimentStatus:
        """Returns the progress of the experiment: the finished trials and the next trial.

        Reads the journal from disk, so the experiment may be running in another process.
        """
        done = self.read_entries()
        remaining = [trial for trial in self.plan.trials if trial.number not in done]
        next_trial = remaining[0] if remaining else None
        return _ExperimentStatus(len(done), len(self.plan.trials), next_trial)

    def run(
        self, jobs: int | None = None, show: Progress | None = None, on: Workers = None
    ) -> "Experiment":
        """Runs the remaining trials with synthetic participants and writes the result tables.

        A synthetic participant is a model of a person who moves the arms. The trials run in
        virtual time. Trials already in the journal are skipped.

        Args:
            jobs: Number of processes. If `None`, one process per core.
            show: Function that is called with the number of finished trials and the total
                number.
            on: Address of a Dask scheduler, or an executor that runs the trials. If `None`,
                they run in processes on this machine.

        Returns:
            This experiment.
        """
        logs = make_folder(self.folder / LOGS, may_be_link=False)
        plan = self.plan
        with self.open_trials(people=False) as journal:
            if plan.protocol.staircase is not None:
                self._draw_choices(plan.protocol.staircase)
            choices = self.list_choices()
            finished_trials = {entry.cell for entry in journal.done.values()}
            tasks = []
            for trial in plan.trials:
                if trial.number not in finished_trials:
                    text = plan.find_scenario(trial, choices).text
                    tasks.append((plan.protocol, text, trial, plan.digest, logs))

            most_workers = len(tasks) or 1
            with WorkerPool.open(jobs, on, most=most_workers, hint=self._remedy) as pool:
                journal.run_pending(
                    pool,
                    SyntheticTrial.run_task,
                    tasks,
                    len(finished_trials),
                    len(plan.trials),
                    show,
                )

        self.write_tables()
        return self

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of the finished trials, in the order of the plan.

        Each row contains the participants, the condition and the measures of one trial.
        """
        finished_trials = self.read_entries()
        choices = self.list_choices()
        rows = []
        for planned in self.plan.trials:
            entry = finished_trials.get(planned.number)
            if entry is not None:
                rows.append(self._describe_trial(planned, entry, choices))
        return rows

    def _describe_trial(
        self, planned: PlannedTrial, entry: TrialEntry, choices: Choices
    ) -> dict[str, Any]:
        """Returns the row of a finished trial in the table trials.csv.

        Args:
            planned: The trial in the plan: number, participants, condition, block.
            entry: Its result from the journal: success, measures, and the digest of its log.
            choices: Choices of the participants in a staircase (see `list_choices`).
        """
        row: dict[str, Any] = {
            "trial_number": planned.number,
            self.unit: "-".join(planned.group),
            "condition": planned.condition,
            "block": planned.block,
            "trial": planned.trial,
            "practice": int(planned.practice),
        }
        if planned.phase:
            row["phase"] = planned.phase
        if self.plan.protocol.staircase is not None:
            row |= self._describe_pair(planned, choices)
        return {
            **row,
            "catch": int(planned.catch),
            "people": int(entry.people),
            "succeeded": int(entry.succeeded),
            **entry.measures,
            "log": f"{LOGS}/{planned.file}",
            "log_sha256": entry.sha256,
        }

    def _describe_pair(self, planned: PlannedTrial, choices: Choices) -> dict[str, Any]:
        """Returns two additional columns for a trial in a perception test (staircase).

        Such trials come in pairs that differ in one quantity, and the participant chooses the
        trial in which it was larger.

        Returns:
            "difference" between the two trials of the pair, and "right", which is 1 for a right
            choice and 0 for a wrong one. Both are `None` for practice trials, and "right" is
            `None` before the choice.
        """
        if planned.practice:
            return {"difference": None, "right": None}
        difference, is_right = self.plan.find_pair(planned, choices)
        right = None if is_right is None else int(is_right)
        return {"difference": difference, "right": right}

    def list_answers(self) -> list[dict[str, Any]]:
        """Returns the questionnaire answers as a table, with one row per item.

        These are the rows of questionnaires.csv. Missing answers are `None`.
        """
        rows: list[dict[str, Any]] = []
        for columns, note in self._read_answer_notes():
            for item, value in note.answers.items():
                row = {
                    **columns,
                    "questionnaire": note.text,
                    "item": item,
                    "value": value,
                    "unix_s": note.unix_s,
                }
                rows.append(row)
        return rows

    def list_scores(self) -> list[dict[str, Any]]:
        """Returns the scores of the completed questionnaires, one row per questionnaire.

        The column of the score is named after the questionnaire. A score is `None` if an answer
        is missing.
        """
        forms = {form.name: form.find_form() for form in self.plan.protocol.questionnaires}
        rows: list[dict[str, Any]] = []
        for columns, note in self._read_answer_notes():
            form = forms.get(note.text)
            if form is not None:
                rows.append({**columns, note.text: form.score(note.answers)})
        return rows

    def _read_answer_notes(self) -> Iterator[tuple[dict[str, Any], Note]]:
        """Yields the notes with answers to a questionnaire, each with identifying columns.

        The columns identify the participant, the block and the condition of the block. Choices
        in a perception test are also notes of this kind.
        """
        conditions: dict[tuple[tuple[str, ...], int], str] = {}
        for trial in self.plan.trials:
            if not trial.catch:  # the condition of a catch trial differs from that of its block
                conditions[trial.group, trial.block] = trial.condition

        for note in self.read_notes():
            if not note.answers:
                continue
            planned = self.plan.trials[note.number - 1]
            identifying_columns = {
                self.unit: "-".join(planned.group),
                "participant": note.who,
                "condition": conditions[planned.group, planned.block],
                "block": planned.block,
            }
            yield identifying_columns, note

    def write_tables(self) -> Path:
        """Writes the results as CSV tables into the folder of the experiment.

        trials.csv has one row per trial, including the digest of its log. For an experiment
        with people, also writes questionnaires.csv, and events.csv with consents and aborted
        trials.

        Returns:
            Path of trials.csv.
        """
        events = []
        for note in self.read_notes():
            event = {
                "unix_s": note.unix_s,
                "event": note.kind,
                "who": note.who,
                "trial_number": note.number,
                "text": note.text,
            }
            events.append(event)

        tables = {
            TRIALS_FILE: self.to_rows(),
            "questionnaires.csv": self.list_answers(),
            "events.csv": events,
        }

        for name, rows in tables.items():
            if rows or name == TRIALS_FILE:
                text = encode_csv(rows)
                write_whole(self.folder / name, text, force=True, remedy=self._remedy)
        return self.folder / TRIALS_FILE

    def to_dict(self) -> dict[str, Any]:
        """Returns the progress as plain values for `trilat experiment status --json`.

        "trials" is the number of planned trials, and "done" is the number of finished trials.
        """
        status = self.status()
        protocol = self.plan.protocol
        return {
            "name": protocol.name,
            "digest": self.plan.digest,
            "folder": str(self.folder),
            "groups": len(protocol.groups),
            "conditions": list(protocol.conditions),
            "trials": status.total,
            "done": status.done,
        }

    def blocks(self) -> Iterator[Block]:
        """Yields the progress report of the experiment, with a table of the conditions.

        The table contains the median completion time of each condition. Trials that were not
        completed count as longer than all others.
        """
        status = self.status()
        counted_rows = [row for row in self.to_rows() if not (row["practice"] or row["catch"])]
        total = count_nouns(status.total, "trial")
        yield f"{self.plan.protocol.name}: {status.done} of {total}, in {self.folder}"

        table_rows: list[tuple[str, ...]] = []
        for condition in self.plan.protocol.conditions:
            trials = [row for row in counted_rows if row["condition"] == condition]
            if trials:
                completed = sum(map(is_completed, trials))
                counts = [str(len(trials)), str(completed), _describe_median(trials)]
                means = [_describe_mean(trials, measure) for measure in _SHOWN_MEASURES]
                table_rows.append((condition, *counts, *means))
        headers = ("condition", "trials", "completed", "completion_s, median", *_SHOWN_MEASURES)
        yield TextTable(headers, table_rows, align="l" + "r" * (len(headers) - 1))

        trial = status.next
        if trial is not None:
            yield f"next: trial {trial.number}, {', '.join(trial.group)}, {trial.condition}"
        for note in self.read_notes():
            if note.kind == "aborted":
                trial_name = f"trial {note.number}, {note.who}"
                yield f"{trial_name}, was aborted and is repeated: {note.text}"

    @classmethod
    def begin(cls, file: str | Path, out: str | Path | None = None) -> "Experiment":
        """Creates the folder of a new experiment.

        The folder contains the protocol and the plan of all trials, with their scenarios, as
        JSON.

        Args:
            file: File of the protocol.
            out: The folder. If `None`, the next free runs/experiment-NAME-N.
        """
        plan = check_experiment(file)
        default_name = f"experiment-{plan.protocol.name}"
        out_path = None if out is None else Path(out)
        folder = make_results_folder(out_path, default_name, force=None)

        write_whole(folder / PROTOCOL_FILE, Path(file).read_text(encoding="utf-8"))
        trials = [{**trial._asdict(), "log": f"{LOGS}/{trial.file}"} for trial in plan.trials]
        facts = {
            "digest": plan.digest,
            "protocol": msgspec.to_builtins(plan.protocol),
            "trials": trials,
            "scenarios": {name: scenario.text for name, scenario in plan.scenarios.items()},
        }
        write_whole(folder / PLAN_FILE, json.dumps(facts, indent=1) + "\n")
        return cls(folder, plan)

    def list_log_problems(self) -> Iterator[str]:
        """Yields a sentence for each finished trial whose log is missing or has been modified.

        Logs are the evidence of what happened in a trial, and the journal contains their
        checksums.
        """
        finished_trials = self.read_entries()
        for planned in self.plan.trials:
            entry = finished_trials.get(planned.number)
            path = self.folder / LOGS / planned.file
            if entry is None:
                continue
            if not path.exists():
                yield f"{path} is missing"
            elif digest_file(path) != entry.sha256:
                yield f"{path} is not the log that the trial wrote"


_SHOWN_MEASURES = ("error_end_mm", "error_rms_mm", "path_m", "sparc")
"""Measures whose means are shown in the progress report."""


def _describe_mean(rows: list[dict[str, Any]], measure: str) -> str:
    """Formats the mean of a measure over trials with three digits.

    Args:
        rows: Rows of finished trials, at least one.
        measure: Name of the measure, for example "path_m".
    """
    mean = sum(row[measure] for row in rows) / len(rows)
    return f"{mean:.3g}"


def _describe_median(rows: list[dict[str, Any]]) -> str:
    """Formats the median completion time of trials, in s.

    A trial that was not completed counts as longer than all others. "not reached" if the median
    is such a time.
    """
    times_s = [row[COMPLETION] if is_completed(row) else math.inf for row in rows]
    median_s = find_median(times_s)
    return f"{median_s:.3g}" if math.isfinite(median_s) else "not reached"


def new_experiment(file: str | Path, *, pair: bool = False, force: bool = False) -> Path:
    """Writes a commented protocol that is ready to run, as `trilat experiment new` does.

    >>> tn.new_experiment("reaching.toml").name
    'reaching.toml'

    Args:
        file: Path of the protocol.
        pair: True for a protocol in which two people each hold a master arm.
        force: True to overwrite an existing file.

    Raises:
        UsageError: The file already exists.
    """
    template_name = "experiment_pair.txt" if pair else "experiment.txt"
    template = resources.files(__package__) / template_name
    write_whole(Path(file), template.read_text(encoding="utf-8"), force=force)
    return Path(file)


def check_experiment(file: str | Path) -> ExperimentPlan:
    """Validates the protocol of an experiment with people and plans its trials.

    Equivalent to the command `trilat experiment check`.

    >>> len(tn.check_experiment(tn.new_experiment("reaching.toml")).trials)
    240

    Args:
        file: Path of the protocol, a TOML file with the conditions, the task, and the numbers
            of participants and trials.

    Returns:
        The plan, which lists all trials in the order in which they are run.

    Raises:
        UsageError: The protocol cannot be carried out. The error lists all problems.
    """
    return ExperimentPlan.of_protocol(ExperimentProtocol.read(file), Path(file).parent)


def open_experiment(folder: str | Path) -> Experiment:
    """Opens the experiment in a folder, as `trilat experiment status` does.

    >>> tn.open_experiment("runs/experiment-reaching-001").status().done  # doctest: +SKIP
    240

    Raises:
        UsageError: The folder contains no experiment, or its plan was changed.
    """
    folder_path = Path(folder)
    try:
        stored_plan = json.loads((folder_path / PLAN_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise UsageError(
            f"{folder_path} contains no experiment; "
            "start an experiment with `trilat experiment run FILE`"
        ) from None

    # The trials are planned again, so that the digest reveals a changed protocol.
    scenarios = {}
    for name, text in stored_plan["scenarios"].items():
        scenarios[name] = parse_embedded(text, str(folder_path))
    protocol = ExperimentProtocol.read(folder_path / PROTOCOL_FILE)
    plan = ExperimentPlan.of_protocol(protocol, scenarios=scenarios)
    if plan.digest != stored_plan["digest"]:
        raise UsageError(
            f"{folder_path}: the protocol was changed after the experiment began; "
            "start another experiment"
        )
    return Experiment(folder_path, plan)


def run_experiment(
    source: str | Path,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress | None = None,
) -> Experiment:
    """Runs an experiment with synthetic participants, as `trilat experiment run` does.

    >>> done = tn.run_experiment(tn.new_experiment("reach.toml"), "reach")  # doctest: +SKIP
    >>> done.to_frame().groupby("condition").completion_s.mean()  # doctest: +SKIP

    Args:
        source: File of a protocol, or folder of an experiment to resume.
        out: Folder of the experiment. By default, the next free runs/experiment-NAME-N.
        jobs: Number of processes. If `None`, one per core.
        on: Address of a Dask scheduler, or an executor that runs the trials.
        progress: Function that is called with the number of finished trials and the total
            number.

    Raises:
        UsageError: The protocol cannot be carried out, or the folder contains something other
            than an experiment.
    """
    if Path(source).is_dir():
        experiment = open_experiment(source)
    else:
        experiment = Experiment.begin(source, out)
    return experiment.run(jobs, progress, on)
