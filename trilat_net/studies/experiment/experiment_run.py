"""An experiment in its folder: a verified log for each trial, journals, and tables in the end.

Invariant: a folder belongs to one plan, by its digest. A trial in the journal is never made
again, and one that was interrupted is made anew, whole: nothing is there twice and nothing is
lost, wherever it was killed. The tables are a function of the journals. People and synthetic
participants never share a folder.
"""

import json
import math
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...errors import UsageError, count_nouns
from ...files import digest_file, make_results_folder, make_subfolder, write_whole
from ...reporting.result_text import Block, TextTable
from ...results import Result
from ...scenario import parse_scenario
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from ..study_folder import RunJournal, build_resume_hint, encode_csv
from .completion_times import COMPLETION, find_median, is_completed
from .protocol import Choices, ExperimentPlan, PlannedTrial, plan_experiment, read_protocol
from .questionnaires import CHOICE, find_form
from .staircase import COMPARISON, Staircase
from .trial_run import TrialEntry, run_trial

PROTOCOL_FILE = "protocol.toml"
PLAN_FILE = "protocol.json"
JOURNAL_FILE = "trials.journal"
NOTES_FILE = "notes.journal"
TRIALS_FILE = "trials.csv"  # fmt: skip
LOGS = "logs"


class Note(msgspec.Struct, frozen=True):
    """What happened with people besides the trials that are done, in a journal of its own.

    Attributes:
        cell: what it is of, once: a step and a participant, or a trial that was aborted.
        kind: "consent", "questionnaire" or "aborted".
        who: the participant; of a trial all of them.
        number: of the trial that it is, comes before, or comes after.
        unix_s: when, by the machine's clock.
        text: of a questionnaire its name; why a trial was aborted.
        answers: by item; None for an item that was left out.
    """

    cell: str
    kind: str
    who: str
    number: int
    unix_s: float
    text: str = ""
    answers: dict[str, float | None] = {}
    seed: int = 0


class ExperimentStatus(NamedTuple):
    """How far an experiment is.

    Attributes:
        done: trials that are in the journal.
        total: trials of the plan.
        next: the first trial that is left; None: all are done.
    """

    done: int
    total: int
    next: PlannedTrial | None


class Experiment(Result):
    """An experiment in its folder.

    Attributes:
        folder: where it is.
        plan: its protocol and trials.
        unit: whose a row of its table is: "pair" or "participant".
    """

    def __init__(self, folder: Path, plan: ExperimentPlan) -> None:
        self.folder = folder
        self.plan = plan
        self.unit = "pair" if len(plan.protocol.users) > 1 else "participant"
        self._remedy = build_resume_hint("experiment", "run", str(folder))

    def open_trials(self, *, people: bool | None = None) -> RunJournal[TrialEntry]:
        """Opens the journal of trials, to read it or to go on with people or synthetic
        participants.

        Raises:
            UsageError: its trials are of the others.
        """
        if people is not None and any(
            one.people != people for one in self.read_entries().values()
        ):
            whose = "synthetic participants: go on without" if people else "people: go on with"
            raise UsageError(
                f"{self.folder}: its trials are of {whose} --live, or begin another experiment"
            )
        return RunJournal(
            self.folder / JOURNAL_FILE, self.plan.digest, TrialEntry, self._remedy
        )

    def open_notes(self) -> RunJournal[Note]:
        """Opens the journal of consents, answers and aborted trials."""
        return RunJournal(self.folder / NOTES_FILE, self.plan.digest, Note, self._remedy)

    def read_entries(self) -> dict[int, TrialEntry]:
        """Returns the trials that are done, by number."""
        with self.open_trials() as journal:
            return {entry.cell: entry for entry in journal.done.values()}

    def read_notes(self) -> list[Note]:
        """Returns what happened with people besides, in order."""
        if not (self.folder / NOTES_FILE).exists():
            return []
        with self.open_notes() as journal:
            return list(journal.done.values())

    def list_choices(self) -> Choices:
        """Returns what was chosen of the pairs of a staircase so far."""
        notes = self.read_notes() if self.plan.protocol.staircase else ()
        chosen = ((note.number, note.answers[CHOICE]) for note in notes if note.text == CHOICE)
        return {number: choice for number, choice in chosen if choice is not None}

    def _choose(self, stairs: Staircase) -> None:
        """Notes what synthetic participants choose, of all pairs: a function of the plan."""
        chosen = dict[int, float]()
        with self.open_notes() as notes:
            for step in self.plan.list_steps():
                if step.form is None or step.form.name != CHOICE:
                    continue
                last = step.planned
                who = "-".join(step.planned.group)
                right = self.plan.judge_choices(last, chosen)
                more = 1 + (last.phase == COMPARISON)
                choice = stairs.draw_choice(stairs.list_differences(right)[-1], more, last.seed)
                chosen[last.number] = choice
                answers: dict[str, float | None] = {CHOICE: choice}
                notes.add(
                    Note(f"{step.key} {who}", step.kind, who, last.number, 0.0, CHOICE, answers)
                )

    def status(self) -> ExperimentStatus:
        """Returns how far it is."""
        done = self.read_entries()
        left = (one for one in self.plan.trials if one.number not in done)
        return ExperimentStatus(len(done), len(self.plan.trials), next(left, None))

    def run(
        self, jobs: int | None = None, show: Progress = ignore_progress, on: Workers = None
    ) -> "Experiment":
        """Makes the trials that are left, with synthetic participants, and writes the tables."""
        logs = make_subfolder(self.folder / LOGS)
        plan = self.plan
        with self.open_trials(people=False) as journal:
            if plan.protocol.staircase is not None:
                self._choose(plan.protocol.staircase)
            choices = self.list_choices()
            done = {entry.cell for entry in journal.done.values()}
            left = [one for one in plan.trials if one.number not in done]
            tasks = [
                (plan.protocol, plan.find_scenario(one, choices).text, one, plan.digest, logs)
                for one in left
            ]
            with open_worker_pool(jobs, on, most=len(tasks) or 1, hint=self._remedy) as pool:
                journal.run_pending(pool, run_trial, tasks, len(done), len(plan.trials), show)
        self.write_tables()
        return self

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row for each trial that is done, in the order of the plan."""
        done = self.read_entries()
        choices = self.list_choices()
        stairs = self.plan.protocol.staircase
        return [
            {
                "trial_number": planned.number,
                self.unit: "-".join(planned.group),
                "condition": planned.condition,
                "block": planned.block,
                "trial": planned.trial,
                "practice": int(planned.practice),
                **({"phase": planned.phase} if planned.phase else {}),
                **({} if stairs is None else self._tell_pair(planned, choices)),
                "catch": int(planned.catch),
                "people": int(entry.people),
                "succeeded": int(entry.succeeded),
                **entry.measures,
                "log": f"{LOGS}/{planned.file}",
                "log_sha256": entry.sha256,
            }
            for planned in self.plan.trials
            if (entry := done.get(planned.number)) is not None
        ]

    def _tell_pair(self, planned: PlannedTrial, choices: Choices) -> dict[str, Any]:
        if planned.practice:
            return {"difference": None, "right": None}
        difference, right = self.plan.find_pair(planned, choices)
        return {"difference": difference, "right": None if right is None else int(right)}

    def list_answers(self) -> list[dict[str, Any]]:
        """Returns a row for each item that somebody was asked; the value of a missing answer is
        None.
        """
        return [
            {
                **row,
                "questionnaire": note.text,
                "item": item,
                "value": value,
                "unix_s": note.unix_s,
            }
            for row, note in self._list_answered()
            for item, value in note.answers.items()
        ]

    def list_scores(self) -> list[dict[str, Any]]:
        """Returns a row for each questionnaire that somebody was asked, with its score by its
        name.

        The score is None if an answer is missing.
        """
        forms = {form.name: find_form(form) for form in self.plan.protocol.questionnaires}
        return [
            {**row, note.text: forms[note.text].score(note.answers)}
            for row, note in self._list_answered()
            if note.text in forms
        ]

    def _list_answered(self) -> Iterator[tuple[dict[str, Any], Note]]:
        """Yields whose answers of which block there are, and these."""
        of = {
            (one.group, one.block): one.condition for one in self.plan.trials if not one.catch
        }
        for note in self.read_notes():
            last = self.plan.trials[note.number - 1]
            row = {self.unit: "-".join(last.group), "participant": note.who}
            if note.answers:
                yield (
                    {**row, "condition": of[last.group, last.block], "block": last.block},
                    note,
                )

    def write_tables(self) -> Path:
        """Writes trials.csv, tidy: a row for each trial, with the digest of its log; returns
        its path.

        With people also questionnaires.csv, and events.csv: who agreed, and which trials were
        aborted.
        """
        happened = [
            {
                "unix_s": one.unix_s,
                "event": one.kind,
                "who": one.who,
                "trial_number": one.number,
                "text": one.text,
            }
            for one in self.read_notes()
        ]
        tables = {"questionnaires.csv": self.list_answers(), "events.csv": happened}
        for name, rows in {TRIALS_FILE: self.to_rows(), **tables}.items():
            if rows or name == TRIALS_FILE:
                write_whole(
                    self.folder / name, encode_csv(rows), force=True, remedy=self._remedy
                )
        return self.folder / TRIALS_FILE

    def to_dict(self) -> dict[str, Any]:
        """Returns its plan and how far it is, as `trilat experiment status --json`."""
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
        """Yields its text: a row for each condition.

        A trial that was not completed has no completion time: of those there is a median, in
        which it counts as longer than any.
        """
        status = self.status()
        rows = [row for row in self.to_rows() if not (row["practice"] or row["catch"])]
        yield (
            f"{self.plan.protocol.name}: {status.done} of "
            f"{count_nouns(status.total, 'trial')}, in {self.folder}"
        )
        table = []
        for condition in self.plan.protocol.conditions:
            of = [row for row in rows if row["condition"] == condition]
            if of:
                completed = sum(map(is_completed, of))
                means = [sum(row[key] for row in of) / len(of) for key in _SHOWN]
                counts = str(len(of)), str(completed), _describe_median(of)
                table.append((condition, *counts, *(f"{mean:.3g}" for mean in means)))
        heads = ("condition", "trials", "completed", "completion_s, median", *_SHOWN)
        yield TextTable(heads, table, align="l" + "r" * (len(heads) - 1))
        if status.next is not None:
            yield f"next: trial {status.next.number}, {', '.join(status.next.group)}, {status.next.condition}"
        yield from (
            f"trial {note.number}, {note.who}, was aborted and is made again: {note.text}"
            for note in self.read_notes()
            if note.kind == "aborted"
        )


def _describe_median(rows: list[dict[str, Any]]) -> str:
    """Returns the median completion time of trials, s, or that it was not reached."""
    times_s = [row[COMPLETION] if is_completed(row) else math.inf for row in rows]
    median_s = find_median(times_s)
    return f"{median_s:.3g}" if math.isfinite(median_s) else "not reached"


_SHOWN = ("error_end_mm", "error_rms_mm", "path_m", "sparc")


def new_experiment(file: str | Path, *, pair: bool = False, force: bool = False) -> Path:
    """Writes a protocol with comments, which runs as it is; the command is `trilat experiment
    new`.

    >>> tn.new_experiment("reaching.toml").name
    'reaching.toml'

    Args:
        file: where it is written.
        pair: true: of two people who hold a master each; false: of one.
        force: whether it may replace a file.

    Raises:
        UsageError: the file exists.
    """
    template = (
        resources.files("trilat_net")
        / "scenarios"
        / f"_experiment{'_pair' if pair else ''}.txt"
    )
    write_whole(Path(file), template.read_text(encoding="utf-8"), force=force)
    return Path(file)


def check_experiment(file: str | Path) -> ExperimentPlan:
    """Returns the plan of a protocol, if it can be carried out; the command is `trilat
    experiment check`.

    >>> len(tn.check_experiment(tn.new_experiment("reaching.toml")).trials)
    240

    Raises:
        UsageError: it cannot; the error names everything that is wrong.
    """
    return plan_experiment(read_protocol(file), Path(file).parent)


def begin_experiment(file: str | Path, out: str | Path | None = None) -> Experiment:
    """Returns an experiment in a new folder; by default the next free runs/experiment-NAME-N."""
    plan = check_experiment(file)
    folder = make_results_folder(
        None if out is None else Path(out), f"experiment-{plan.protocol.name}", force=None
    )
    write_whole(folder / PROTOCOL_FILE, Path(file).read_text(encoding="utf-8"))
    texts = {name: scenario.text for name, scenario in plan.scenarios.items()}
    trials = [{**one._asdict(), "log": f"{LOGS}/{one.file}"} for one in plan.trials]
    protocol = msgspec.to_builtins(plan.protocol)
    facts = {"digest": plan.digest, "protocol": protocol, "trials": trials, "scenarios": texts}
    write_whole(folder / PLAN_FILE, json.dumps(facts, indent=1) + "\n")
    return Experiment(folder, plan)


def open_experiment(folder: str | Path) -> Experiment:
    """Returns the experiment of a folder, as it was planned; the command is `trilat experiment
    status`.

    >>> tn.open_experiment("runs/experiment-reaching-001").status().done  # doctest: +SKIP
    240

    Raises:
        UsageError: there is none, or its plan was changed.
    """
    path = Path(folder)
    try:
        facts = json.loads((path / PLAN_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise UsageError(
            f"{path}: holds no experiment; `trilat experiment run FILE` begins one"
        ) from None
    scenarios = {
        name: parse_scenario(text, str(path)) for name, text in facts["scenarios"].items()
    }
    protocol = read_protocol(path / PROTOCOL_FILE)
    plan = plan_experiment(protocol, scenarios=scenarios)
    if plan.digest != facts["digest"]:
        raise UsageError(
            f"{path}: its protocol was changed after it began: begin another experiment"
        )
    return Experiment(path, plan)


def run_experiment(
    source: str | Path,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    on: Workers = None,
    progress: Callable[[int, int], None] = ignore_progress,
) -> Experiment:
    """Runs an experiment with synthetic participants; the command is `trilat experiment run`.

    >>> done = tn.run_experiment(tn.new_experiment("reaching.toml"), "reaching")  # doctest:
    +SKIP
    >>> done.to_frame().groupby("condition").completion_s.mean()  # doctest: +SKIP

    Args:
        source: the protocol's file, or the folder of an experiment that was begun: it goes on.
        out: the folder; by default the next free runs/experiment-NAME-N.
        jobs: how many processes; None for one per core.
        on: what runs the trials instead: a Dask scheduler's address or an executor.
        progress: called with the trials done, and in all.

    Raises:
        UsageError: the protocol cannot be carried out, or the folder holds something else.
    """
    begun = open_experiment(source) if Path(source).is_dir() else begin_experiment(source, out)
    return begun.run(jobs, progress, on)


def list_log_problems(experiment: Experiment) -> Iterator[str]:
    """Yields the trials that are done whose log is missing, or is not the one that they wrote."""
    done = experiment.read_entries()
    for planned in experiment.plan.trials:
        entry = done.get(planned.number)
        path = experiment.folder / LOGS / planned.file
        if entry is None:
            continue
        if not path.exists():
            yield f"{path}: is missing"
        elif digest_file(path) != entry.sha256:
            yield f"{path}: is not the log that the trial wrote"
