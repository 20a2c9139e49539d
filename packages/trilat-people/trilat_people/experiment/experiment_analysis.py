"""Analyses an experiment with people: means, comparisons between conditions, and figures.

`analyse_experiment` reads the stored results and writes tables, figures and a report into the
folder of the experiment. `compute_experiment_power` is used before an experiment to plan the
number of participants.

Invariant:
    - The analysis depends only on the stored results.
    - Practice trials and catch trials are excluded.
    - A trial that was not completed is included. Its completion time is censored: it counts as
      longer than that of any completed trial (see `completion_times`).
    - Every number in a figure or a sentence is also in a table.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.core import Array
from trilat_net.errors import UsageError, count_nouns
from trilat_net.fields import split_unit
from trilat_net.files import find_version, make_folder, write_whole
from trilat_net.presentation import TextTable, format_number, style
from trilat_net.results import Result
from trilat_net.work import encode_csv

from .completion_times import (
    COMPLETION,
    CompletionComparison,
    CompletionTime,
    compare_times,
    find_unit_medians,
    is_completed,
    summarise_times,
)
from .condition_figures import draw_conditions, draw_learning, draw_times
from .experiment_run import Experiment, open_experiment
from .movement_measures import measure_throughput
from .statistics import (
    CONFIDENCE,
    RESAMPLES,
    Comparison,
    ConditionMean,
    MixedModel,
    Row,
    SimulatedPower,
    average_trials,
    compare_conditions,
    find_least_number,
    fit_mixed_model,
    power,
    simulate_power,
    summarise_conditions,
)

MEASURES = (
    "completion_s", "throughput_bits_s", "error_end_mm", "error_rms_mm", "path_m", "sparc",
    "force_mean_n", "force_mean_user1_n", "force_mean_user2_n", "wall_force_n",
    "error_force_n", "error_handover_mm", "first_settled", "internal_rms_n", "useful_rms_n",
    "internal_share", "first_effort_share", "first_work_j", "second_work_j", "first_taken_j",
    "second_taken_j", "succeeded",
)  # fmt: skip
"""Measures to compare between conditions if trials have them."""
_UNCOUNTED_PHASES = ("before", "training", "retention")
"""Training phases excluded from the comparison between conditions."""
FOLDER = "analysis"
"""Name of the analysis folder inside the folder of the experiment."""
NOT_REACHED = "not reached"
"""Text shown for a median if half or more of the trials were not completed."""


class _MissingAnswers(NamedTuple):
    """Number of missing answers to a questionnaire under one condition.

    Attributes:
        questionnaire: Name of the questionnaire.
        condition: Condition of the block. Empty for a questionnaire after the experiment.
        asked: Number of items, over all completed questionnaires.
        missing: Number of these items with no answer.
        forms: Number of completed questionnaires.
        unscored: Number of questionnaires with no score because an answer is missing.
    """

    questionnaire: str
    condition: str
    asked: int
    missing: int
    forms: int
    unscored: int


def _format_fact(value: Any, name: str = "") -> str:
    """Formats a fact about the study, for example "delay 50 ms" for {"delay_ms": 50}.

    A number is written in full and followed by the unit from the end of its name. Entries or
    items are joined with commas, and conditions with semicolons.

    Args:
        value: The fact: a number, a string, a mapping or a sequence.
        name: Name of the fact, which ends in the unit.
    """
    if isinstance(value, str):
        return value

    if isinstance(value, Mapping):
        entry_texts: list[str] = []
        for key, entry in value.items():
            quantity, _ = split_unit(key)
            entry_texts.append(f"{quantity} {_format_fact(entry, key)}".strip())
        return "; ".join(entry_texts) if name == "conditions" else ", ".join(entry_texts)
    if isinstance(value, Sequence):
        return ", ".join(_format_fact(entry, name) for entry in value)

    number = str(value) if isinstance(value, int) else repr(float(value)).removesuffix(".0")
    _, unit = split_unit(name)
    return f"{number} {unit}".strip()


class ExperimentAnalysis(Result):
    """Statistics of an experiment: comparisons between conditions, and facts to report.

    Everything is computed on construction, except for the figures, which are drawn by `write`.
    A unit is a participant or a pair, whichever is sampled independently. Every measure of the
    trials is summarised, even if all of its values are equal. The number of missing values is
    reported.

    Args:
        experiment: The experiment to analyse.
        exclude: Participants or pairs to exclude, each mapped to the reason for its exclusion.

    Attributes:
        unit: The independently sampled unit, "participant" or "pair".
        rows: Table of evaluated trials. If the experiment includes training, only trials of the
            phase "after" (directly after the training) are included.
        learning_rows: Table of the evaluated trials of all phases.
        throughput_rows: Throughput (a combined measure of speed and accuracy) by unit and
            condition.
        gain_rows: Improvement through training, by unit and condition.
        threshold_rows: Perception threshold from a staircase, by unit and condition.
        means: Mapping from measure to its mean under each condition. `completion_s` is included
            only if all trials were completed.
        comparisons: Mapping from measure to the comparisons of all pairs of conditions.
        times: Completion time under each condition, for a task with a time limit.
        time_comparisons: Comparison of the completion times of each pair of conditions, if some
            trials were not completed.
        missing_answers: Missing answers by questionnaire and condition.
        absent: Mapping from each applicable measure that has no value in any trial to the
            reason.
        models: Mixed models of the users' forces, with users nested in pairs.
        study: Facts to report in a paper: participants, conditions with the measured delays,
            law, gains, seed, and the analyses performed.
        paths: Paths of the files written.

    Raises:
        UsageError: No trial to evaluate has finished, or an excluded participant or pair does
            not exist.
    """

    def __init__(self, experiment: Experiment, exclude: Mapping[str, str] = {}) -> None:
        self._experiment = experiment
        self._exclude = exclude
        protocol = experiment.plan.protocol
        self.unit = experiment.unit
        self._check_excluded()

        # The evaluated trials: without practice trials, and without excluded participants.
        counted = [row for row in experiment.to_rows() if self._is_counted(row)]
        self.learning_rows = self._sort_by_condition(counted)
        self.rows = [
            row for row in self.learning_rows if row.get("phase") not in _UNCOUNTED_PHASES
        ]
        if not self.rows:
            raise UsageError(
                f"{experiment.folder}: there are no trials to analyse yet; practice trials, "
                "catch trials and trials of excluded participants do not count"
            )

        # Values that the analysis computes from the trials, one row for each participant.
        self.throughput_rows = list(self._find_throughput())
        self.gain_rows = list(self._find_gains())
        self.threshold_rows = self._sort_by_condition(list(self._find_thresholds()))
        scores = self._sort_by_condition(experiment.list_scores())
        self._scores = [row for row in scores if row[self.unit] not in exclude]

        # Completion times, of which some trials reached the time limit.
        self.times: list[CompletionTime] = []
        self.time_comparisons: list[CompletionComparison] = []
        if protocol.task.has_limit:
            self._summarise_times()

        # Each measure is compared between the conditions.
        forms = [form.name for form in protocol.questionnaires if form.after == "block"]
        self.absent = self._find_absent(forms)
        self.means: dict[str, list[ConditionMean]] = {}
        self.comparisons: dict[str, list[Comparison]] = {}
        for measure in (*MEASURES, *forms, *self._list_unit_measures()):
            self._compare_measure(measure)

        # Further results.
        self.missing_answers = list(self._count_missing_answers())
        self.models = list(self.fit_models())
        self.study = self._collect_study()
        self.paths: list[Path] = []

    def _check_excluded(self) -> None:
        """Raises UsageError if an excluded participant or pair does not exist.

        Otherwise, a misspelt name would silently have no effect.

        Raises:
            UsageError: An excluded name is not in the plan. The error lists the names in the
                plan.
        """
        groups = self._experiment.plan.protocol.groups
        names = {"-".join(group) for group in groups}
        unknown_names = sorted(self._exclude.keys() - names)
        if unknown_names:
            valid_names = ", ".join(sorted(names))
            raise UsageError(
                f"there is no {self.unit} {', '.join(unknown_names)}; "
                f"the {self.unit}s are {valid_names}"
            )

    def _is_counted(self, row: Mapping[str, Any]) -> bool:
        """Returns True if a trial is included in the statistics.

        Practice trials, catch trials and the trials of excluded participants are not.

        Args:
            row: Row of the trial, as in trials.csv.
        """
        is_excluded = row[self.unit] in self._exclude
        return not (is_excluded or row["practice"] or row["catch"])

    def _sort_by_condition(self, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Sorts table rows by condition, in the order of the experiment's protocol.

        The sort is stable.
        """
        conditions = list(self._experiment.plan.protocol.conditions)
        return sorted(rows, key=lambda row: conditions.index(row["condition"]))

    def _list_unit_measures(self) -> list[str]:
        """Lists the measures that have only one value per participant and condition.

        Examples are training gains ("gain_...") and perception thresholds ("threshold_..."). In
        an experiment with pairs, each pair has one value.
        """
        keys = [key for row in (*self.gain_rows[:1], *self.threshold_rows[:1]) for key in row]
        return [key for key in keys if key.startswith(("gain_", "threshold_"))]

    def _compare_measure(self, measure: str) -> None:
        """Computes the means of a measure per condition, and the tests between conditions.

        Measures with no value in any trial are skipped. Completion times are also skipped if
        some of them are censored (known only to exceed the limit), since their mean would be
        biased.

        Args:
            measure: Name of the measure, for example "path_m".
        """
        # A mean of censored times is biased, so `times` contains their medians instead.
        if measure == COMPLETION and self._has_censored_times():
            return
        rows = self.of(measure)
        has_numbers = any(row.get(measure) not in (None, "") for row in rows)
        if has_numbers:
            self.means[measure] = summarise_conditions(rows, measure, unit=self.unit)
            self.comparisons[measure] = compare_conditions(rows, measure, unit=self.unit)

    def _has_censored_times(self) -> bool:
        """Returns True if some of the trials were not completed.

        The completion times of such trials are only known to exceed the limit (censored), so
        the analysis uses medians in place of means.
        """
        return any(time.censored for time in self.times)

    @property
    def _limit_s(self) -> float:
        """Time limit of a trial after its target has appeared, in s."""
        return self._experiment.plan.protocol.task.longest_s

    @property
    def _is_reaching(self) -> bool:
        """True if the task is to reach targets, the only task with a throughput."""
        return self._experiment.plan.protocol.task.description.startswith("reaching")

    def _summarise_times(self) -> None:
        """Computes the median completion time of each condition.

        If some trials were not completed, also compares the conditions with sign tests, since a
        t test needs means.
        """
        self.times = summarise_times(self.rows, self._limit_s, unit=self.unit)
        if self._has_censored_times():
            self.time_comparisons = compare_times(self.rows, unit=self.unit)

    def _find_absent(self, forms: Sequence[str]) -> dict[str, str]:
        """Explains why measures that this experiment could have are missing.

        Args:
            forms: Names of the questionnaires that are answered after each block.

        Returns:
            Mapping from measure to the reason, for example {"tlx": "nobody has answered it"}.
        """
        reasons = {}
        for name in forms:
            scores = [row.get(name) for row in self.of(name)]
            if not scores:
                reasons[name] = "nobody has answered it"
            elif all(score is None for score in scores):
                reasons[name] = "every questionnaire lacks an answer"
        if self._is_reaching and not self.throughput_rows:
            reasons["throughput_bits_s"] = (
                f"no {self.unit} has enough completed trials under a condition"
            )
        return reasons

    def _count_missing_answers(self) -> Iterator[_MissingAnswers]:
        """Counts the missing answers to each questionnaire under each condition.

        A completed questionnaire, called a form, belongs to one participant and one block of
        trials. Counts both the items with no answer and the forms that have no score because at
        least one answer is missing.

        A questionnaire that is answered only once, after the experiment, does not belong to any
        condition; its condition is the empty string.

        Yields:
            The counts for each questionnaire and condition, excluding excluded participants.
        """
        protocol = self._experiment.plan.protocol
        when_answered = {form.name: form.after for form in protocol.questionnaires}
        answer_groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for row in self._experiment.list_answers():  # one row for each item
            name = row["questionnaire"]
            is_excluded = row[self.unit] in self._exclude
            if name in when_answered and not is_excluded:
                is_per_block = when_answered[name] == "block"
                condition = row["condition"] if is_per_block else ""
                answer_groups.setdefault((name, condition), []).append(row)

        for (name, condition), rows in answer_groups.items():
            answers_of_form: dict[tuple[str, int], list[float | None]] = {}
            for row in rows:
                form_key = (row["participant"], row["block"])
                answers_of_form.setdefault(form_key, []).append(row["value"])
            incomplete_forms = sum(None in answers for answers in answers_of_form.values())
            yield _MissingAnswers(
                questionnaire=name,
                condition=condition,
                asked=len(rows),
                missing=sum(row["value"] is None for row in rows),
                forms=len(answers_of_form),
                unscored=incomplete_forms,
            )

    def of(self, measure: str) -> Sequence[Row]:
        """Returns the rows of the result table that contains a measure.

        Depending on the measure, each row describes a trial, a participant or pair, or a
        completed questionnaire.

        Args:
            measure: Name of the measure, such as "completion_s".

        Returns:
            The rows, each a mapping from column name to value. Empty if no table contains the
            measure.
        """
        rows_by_kind = {
            "throughput": self.throughput_rows,
            "gain": self.gain_rows,
            "threshold": self.threshold_rows,
        }
        kind, separator, _ = measure.partition("_")
        if separator and kind in rows_by_kind:
            return rows_by_kind[kind]
        if measure in MEASURES:
            return self.rows
        return [row for row in self._scores if measure in row]

    def _find_throughput(self) -> Iterator[dict[str, Any]]:
        """Yields the throughput of each participant or pair under each condition, in bit/s.

        Throughput combines the speed and accuracy of aimed movements. It requires at least two
        completed trials, and is defined only for the reaching task.

        Yields:
            Rows with the name, the condition and "throughput_bits_s".
        """
        if not self._is_reaching:
            return

        trials_by_group: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for row in self.rows:
            group = (row[self.unit], row["condition"])
            trials_by_group.setdefault(group, []).append(row)

        for (unit, condition), trials in trials_by_group.items():
            completed_trials = [row for row in trials if row["succeeded"]]
            if len(completed_trials) < 2:
                continue
            throughput = measure_throughput(
                starts=_list_points(completed_trials, "start"),
                targets=_list_points(completed_trials, "target"),
                ends=_list_points(completed_trials, "end"),
                times_s=[row["completion_s"] for row in completed_trials],
            )
            if throughput is not None:
                yield {
                    self.unit: unit,
                    "condition": condition,
                    "throughput_bits_s": throughput.bits_s,
                }

    def _find_gains(self) -> Iterator[dict[str, Any]]:
        """Yields the improvement of each participant (or pair) through training, by condition.

        A gain is the mean before the training minus the mean directly after it (transfer) or in
        the later test (retention).
        """
        measure = self._experiment.plan.protocol.task.learning_measure
        means_by_phase: dict[str, dict[str, dict[str, float]]] = {}
        for phase in ("before", "after", "retention"):
            rows = [row for row in self.learning_rows if row.get("phase") == phase]
            if rows:
                means_by_phase[phase] = self._average_learning(rows, measure)

        means_before = means_by_phase.pop("before", {})
        for condition, means_by_unit in means_before.items():
            for unit, mean_before in means_by_unit.items():
                gains: dict[str, float] = {}
                for phase, phase_means in means_by_phase.items():
                    later_mean = phase_means.get(condition, {}).get(unit)
                    if later_mean:
                        gains[f"gain_{phase}_{measure}"] = mean_before - later_mean
                yield {self.unit: unit, "condition": condition, **gains}

    def _is_censored(self, measure: str) -> bool:
        """Returns True if a measure is the completion time and some trials were not completed.

        Unlike `_has_censored_times`, considers the trials of all phases, not only those
        directly after the training. The result determines whether means or medians are
        computed.

        Args:
            measure: Name of a measure.
        """
        has_limit = self._experiment.plan.protocol.task.has_limit
        if measure != COMPLETION or not has_limit:
            return False
        return not all(map(is_completed, self.learning_rows))

    def _average_learning(
        self, rows: Sequence[Row], measure: str
    ) -> dict[str, dict[str, float]]:
        """Returns the mean of a learning measure for each condition and participant or pair.

        If some trials were not completed, medians are used instead of means, and those that
        were not reached are omitted.
        """
        if not self._is_censored(measure):
            return average_trials(rows, measure, self.unit)
        reached_medians: dict[str, dict[str, float]] = {}
        for condition, medians in find_unit_medians(rows, self.unit).items():
            reached_medians[condition] = {
                unit: median for unit, median in medians.items() if math.isfinite(median)
            }
        return reached_medians

    def _find_thresholds(self) -> Iterator[dict[str, Any]]:
        """Yields the perception threshold of each participant under each condition.

        A staircase varies a difference until the participant can just perceive it. Blocks with
        too few reversals have no threshold, and neither do protocols with no staircase.

        Yields:
            Rows with the name, the condition, and the threshold under the name of its measure.
        """
        plan = self._experiment.plan
        choices = self._experiment.list_choices()
        staircase = plan.protocol.staircase
        if staircase is None:
            return

        # Each block has a staircase, which is identified by the first trial of the block.
        first_trials = [trial for trial in plan.trials if trial.trial == 1]
        for planned in first_trials:
            are_right = plan.judge_choices(planned, choices)
            threshold = staircase.find_threshold(are_right)
            unit = "-".join(planned.group)
            if threshold is not None and unit not in self._exclude:
                yield {
                    self.unit: unit,
                    "condition": planned.condition,
                    staircase.measure: threshold,
                }

    def _collect_study(self) -> dict[str, Any]:
        """Returns the facts about the study that a paper should report.

        Facts that do not apply, such as `pairs` in an experiment with single users, are
        omitted.

        Returns:
            Mapping from name to plain value. `conditions` maps each condition to the mean
            measured delay, `delay_ms`. `excluded` is the number of planned participants whose
            data are excluded. `computed` lists the analyses, for example "t tests".
        """
        plan = self._experiment.plan
        protocol = plan.protocol
        scenario = next(iter(plan.scenarios.values()))
        unit_count = len({row[self.unit] for row in self.rows})
        participant_count = unit_count * len(protocol.users)

        conditions: dict[str, dict[str, float]] = {}
        for name in protocol.conditions:
            delays_ms = [row["delay_ms"] for row in self.rows if row["condition"] == name]
            if delays_ms:
                conditions[name] = {"delay_ms": round(float(np.mean(delays_ms)), 1)}

        site = scenario.sites[protocol.users[0]]
        control = msgspec.to_builtins(site.control)
        law = control.pop("law")

        facts: dict[str, Any] = {
            "participants": participant_count,
            "pairs": unit_count if self.unit == "pair" else None,
            "excluded": len(protocol.groups) * len(protocol.users) - participant_count,
            "exclusions": dict(self._exclude) or None,
            "design": protocol.design,
            "blocks": len(protocol.conditions),
            "trials": protocol.trials,
            "training": protocol.training.describe() if protocol.training else None,
            "staircase": protocol.staircase.describe() if protocol.staircase else None,
            "conditions": conditions,
            "law": law,
            "gains": control,
            "rate_hz": site.rate_hz,
            "seed": protocol.seed,
            "measures": list(self.means),
            "unit": self.unit,
            "computed": self._list_computed(),
            "program": f"trilat-net {find_version()}",
            "digest": plan.digest,
        }
        return {name: value for name, value in facts.items() if value is not None}

    def _list_computed(self) -> list[str]:
        """Returns the names of the statistical methods used, for the report.

        An example is ["intervals of 95 %", "effect sizes"]. Empty for a single participant.
        """
        tests = list(chain.from_iterable(self.comparisons.values()))
        means = list(chain.from_iterable(self.means.values()))
        has_intervals = any(mean.interval is not None for mean in means)
        has_bootstrap = any(mean.bootstrap is not None for mean in means)
        has_sign_tests = any(test.p is not None for test in self.time_comparisons)
        is_computed = {
            f"intervals of {100 * CONFIDENCE:g} %": has_intervals,
            f"bootstrap with {RESAMPLES} resamples": has_bootstrap,
            "t tests with p corrected by Holm": any(test.p is not None for test in tests),
            "Wilcoxon tests": any(test.p_wilcoxon is not None for test in tests),
            "effect sizes": any(test.d_z is not None for test in tests),
            "sign tests of completion times": has_sign_tests,
            "mixed models": bool(self.models),
        }
        return [analysis for analysis, computed in is_computed.items() if computed]

    def write(self, folder: Path) -> "ExperimentAnalysis":
        """Writes the tables, figures and report of the analysis, and lists them in `paths`.

        Args:
            folder: Folder to write to.

        Returns:
            This analysis.
        """
        folder = make_folder(folder)
        self.paths = []
        for name, text in self._encode_files().items():
            self.paths.append(folder / name)
            write_whole(self.paths[-1], text, force=True)

        figures = self._draw_figures()
        page = folder / "report.md"
        write_whole(page, self.compose_page(list(figures)), force=True)
        self.paths.append(page)
        for name, figure in figures.items():
            self.paths.append(folder / f"{name}.png")
            style.write_figure(figure, self.paths[-1], style.REPORT_DPI)
        return self

    def _encode_files(self) -> dict[str, str]:
        """Returns a mapping from file name to content of all result files except figures.

        These are CSV tables and a JSON file. Tables of completion times and missing answers are
        included only if they have rows.
        """
        tables = {
            "conditions.csv": self._list_means(),
            "comparisons.csv": self.to_rows(),
        }
        optional_tables = {
            "completion_times.csv": [time._asdict() for time in self.times],
            "completion_comparisons.csv": [test._asdict() for test in self.time_comparisons],
            "missing_answers.csv": [answers._asdict() for answers in self.missing_answers],
        }
        tables |= {name: rows for name, rows in optional_tables.items() if rows}

        texts: dict[str, str] = {}
        for name, rows in tables.items():
            flat_rows = [dict(_flatten(row)) for row in rows]
            texts[name] = encode_csv(flat_rows)
        texts["analysis.json"] = json.dumps(self.to_dict(), indent=1) + "\n"
        return texts

    def _draw_figures(self) -> dict[str, Any]:
        """Draws one figure per measure, and one that shows learning over the trials.

        Returns:
            Mapping from file name, excluding the suffix, to figure. "learning" is included only
            if a block has more than one trial.
        """
        figures = {}
        for name in self.means:
            figures[name] = draw_conditions(self.of(name), name, unit=self.unit)

        if self.time_comparisons:
            figures[COMPLETION] = draw_times(self.rows, self._limit_s, unit=self.unit)

        trial_numbers = {row["trial"] for row in self.learning_rows}
        if len(trial_numbers) > 1:
            protocol = self._experiment.plan.protocol
            measure = "difference" if protocol.staircase else protocol.task.learning_measure
            limit_s = self._limit_s if self._is_censored(measure) else None
            figures["learning"] = draw_learning(
                self.learning_rows, measure, unit=self.unit, limit_s=limit_s
            )
        return figures

    def compose_page(self, figures: Sequence[str]) -> str:
        """Returns the Markdown page that reports the results of the experiment.

        Args:
            figures: Names of the PNG files in the folder of the page, without the suffix.
        """
        protocol = self._experiment.plan.protocol
        paragraphs = [f"# {protocol.title or protocol.name}"]
        for block in self.blocks():
            text = block.markdown() if isinstance(block, TextTable) else block
            if text.strip():
                paragraphs.append(text)
        paragraphs += [f"![{name}]({name}.png)" for name in figures]
        return "\n\n".join(paragraphs) + "\n"

    def fit_models(self) -> Iterator[MixedModel]:
        """Fits mixed models to the mean and peak force of users who act in pairs.

        A mixed model accounts for the dependence between the two users of a pair.

        Yields:
            One model per measure, as soon as it is fitted. Yields nothing if participants act
            alone, if there are too few pairs, or if the package statsmodels is not installed.
        """
        pairs = {row[self.unit] for row in self.rows}
        has_pairs = self.unit == "pair" and len(pairs) >= 2
        if not has_pairs or find_spec("statsmodels") is None:
            return

        for measure in ("force_mean", "force_peak"):
            # A trial of a pair becomes two rows, one for each user.
            rows: list[Row] = []
            for row in self.rows:
                for user, name in enumerate(row["pair"].split("-"), 1):
                    force_n = row[f"{measure}_user{user}_n"]
                    rows.append({**row, "participant": name, f"{measure}_n": force_n})
            # With too few pairs there is no model.
            with suppress(UsageError):
                yield fit_mixed_model(rows, f"{measure}_n")

    def _list_means(self) -> list[dict[str, Any]]:
        """Returns the table conditions.csv, with one row per measure and condition."""
        rows: list[dict[str, Any]] = []
        for measure, means in self.means.items():
            rows += [{"measure": measure, **mean._asdict()} for mean in means]
        return rows

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns the comparisons as a table, with one row per measure and pair of conditions.

        These are the rows of comparisons.csv and of the data frame of this result.
        """
        return [test._asdict() for test in chain.from_iterable(self.comparisons.values())]

    def to_dict(self) -> dict[str, Any]:
        """Returns all results as plain values for `trilat experiment analyse --json`.

        Includes the means of the conditions, their comparisons, completion times, missing
        answers, fitted models, and facts about the study, such as the control law.
        """
        models = {model.measure: model._asdict() for model in self.models}
        for model in models.values():
            model["effects"] = [effect._asdict() for effect in model["effects"]]

        return {
            "name": self._experiment.plan.protocol.name,
            "digest": self._experiment.plan.digest,
            "conditions": self._list_means(),
            "comparisons": self.to_rows(),
            "completion_times": [time._asdict() for time in self.times],
            "completion_comparisons": [test._asdict() for test in self.time_comparisons],
            "missing_answers": [answers._asdict() for answers in self.missing_answers],
            "absent": self.absent,
            "mixed_models": models,
            "study": self.study,
        }

    def blocks(self) -> Iterator[str | TextTable]:
        """Yields the parts of the report that `trilat experiment analyse` prints.

        These are a summary of completed trials, the means and comparisons of the measures, the
        fitted models, the number of missing questionnaire answers, the reasons why a measure
        has no value, and facts about the study, such as the control law. With a single
        participant or pair, there are no comparisons, and all measures are in one table.
        """
        yield from self._write_time_blocks()

        # One participant alone gives no comparison of means.
        units = {row[self.unit] for row in self.rows}
        if len(units) > 1:
            yield from self._write_measure_blocks()
        else:
            yield from self._write_single_unit_block(next(iter(units)))
        yield from self._write_model_blocks()

        for answers in self.missing_answers:
            condition_text = f", {answers.condition}" if answers.condition else ""
            unscored_text = ""
            if answers.missing:
                unscored_text = (
                    f"; {answers.unscored} of {answers.forms} have no score for that reason"
                )
            asked_text = count_nouns(answers.asked, "answer is", "answers are")
            yield (
                f"{answers.questionnaire}{condition_text}: {answers.missing} of "
                f"{asked_text} missing{unscored_text}"
            )

        for measure, reason in self.absent.items():
            yield f"{measure}: no number, because {reason}"
        if self.missing_answers or self.absent:
            yield ""

        for name, fact in self.study.items():
            yield f"{name}: {_format_fact(fact, name)}"

    def _write_time_blocks(self) -> Iterator[str | TextTable]:
        """Yields a table of completion times: trials, failures and median for each condition.

        If some trials were not completed, a second table compares the conditions. Yields
        nothing for a task with no time limit.
        """
        if not self.times:
            return

        yield (
            f"{COMPLETION}, median over {self.unit}s of the median of each {self.unit}'s trials"
        )
        yield "a trial that was not completed counts as longer than all others"

        rows = []
        for time in self.times:
            median_text = NOT_REACHED if time.median is None else f"{time.median:.4g}"
            row = (
                time.condition,
                str(time.trials),
                str(time.timed_out),
                str(time.censored - time.timed_out),
                str(time.number),
                median_text,
                _format_interval(time.interval),
            )
            rows.append(row)

        headers = (
            "condition",
            "trials",
            "timed out",
            "failed sooner",
            "n",
            "median",
            "interval",
        )
        yield TextTable(headers, rows, align="lrrrrrl")
        yield ""
        if self.time_comparisons:
            comparison_rows = [
                (
                    f"{test.second} - {test.first}",
                    f"{test.longer} of {test.number}",
                    f"{test.shorter} of {test.number}",
                    format_number(test.difference),
                    format_number(test.p),
                    format_number(test.p_holm),
                )
                for test in self.time_comparisons
            ]
            columns = ("difference", "longer", "shorter", "median", "p, sign test", "p, Holm")
            yield TextTable(columns, comparison_rows, align="lrrrrr")
            yield ""

    def _write_measure_blocks(self) -> Iterator[str | TextTable]:
        """Yields two tables for each measure: means of the conditions, and their comparisons.

        The second table is omitted if there is only one condition.
        """
        for measure, means in self.means.items():
            yield f"{measure}, mean over {self.unit}s, {100 * CONFIDENCE:g} % interval"
            rows = [
                (
                    mean.condition,
                    str(mean.number),
                    str(mean.missing),
                    f"{mean.mean:.4g}",
                    _format_interval(mean.interval),
                )
                for mean in means
            ]
            headers: tuple[str, ...] = ("condition", "n", "missing", "mean", "interval")
            yield TextTable(headers, rows, align="lrrrl")
            yield ""

            comparison_rows = [
                (
                    f"{test.second} - {test.first}",
                    format_number(test.difference),
                    _format_interval(test.interval),
                    format_number(test.t),
                    format_number(test.p_holm),
                    format_number(test.d_z),
                )
                for test in self.comparisons[measure]
            ]
            if comparison_rows:
                headers = ("difference", "mean", "interval", "t", "p, Holm", "d_z")
                yield TextTable(headers, comparison_rows, align="lrlrrr")
                yield ""

    def _write_model_blocks(self) -> Iterator[str | TextTable]:
        """Yields one table per mixed model: effects of the conditions on the users' forces.

        Models exist only if users act in pairs (see `fit_models`).
        """
        for model in self.models:
            yield f"{model.measure} of each user, mixed model against {model.reference}"
            rows = [
                (
                    effect.condition,
                    f"{effect.estimate:.4g}",
                    _format_interval(effect.interval),
                    format_number(effect.t),
                    format_number(effect.p),
                )
                for effect in model.effects
            ]
            yield TextTable(("condition", "effect", "interval", "t", "p"), rows, align="lrlrr")
            yield ""

    def _write_single_unit_block(self, unit: str) -> Iterator[str | TextTable]:
        """Yields one table of all measures, with one column per condition.

        Replaces the tables of means and comparisons, since a single participant or pair allows
        no intervals or tests.

        Args:
            unit: Name of the only participant or pair.
        """
        conditions = list(dict.fromkeys(row["condition"] for row in self.rows))
        yield (
            f"means over the trials of a condition; one {self.unit}, {unit}, "
            "allows no interval and no test"
        )
        rows = []
        for measure, means in self.means.items():
            mean_by_condition = {mean.condition: _describe_mean(mean) for mean in means}
            cells = [mean_by_condition.get(name, "-") for name in conditions]
            rows.append((measure, *cells))
        alignment = "l" + "r" * len(conditions)
        yield TextTable(("measure", *conditions), rows, align=alignment)
        yield ""


def analyse_experiment(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    exclude: Mapping[str, str] = {},
) -> ExperimentAnalysis:
    """Analyses an experiment and writes the results into its folder.

    Equivalent to the command `trilat experiment analyse`.

    >>> analysis = tn.analyse_experiment("runs/experiment-reaching-001")  # doctest: +SKIP
    >>> near, *_ = analysis.means["completion_s"]  # doctest: +SKIP
    >>> near.interval  # doctest: +SKIP
    (3.06, 3.22)

    Args:
        folder: Folder of the experiment.
        out: Folder for tables and figures. By default, the subfolder `analysis` of the
            experiment.
        exclude: Participants or pairs to exclude, each mapped to the reason for its exclusion.

    Raises:
        UsageError: There is no experiment, no trial has finished, or an excluded participant or
            pair does not exist.
    """
    experiment = open_experiment(folder)
    analysis = ExperimentAnalysis(experiment, exclude)
    if out is None:
        return analysis.write(make_folder(experiment.folder / FOLDER, may_be_link=False))
    return analysis.write(Path(out))


class PowerOfExperiment(Result):
    """Number of participants needed to detect an effect of a given size.

    Args:
        d_z: Effect size.
        participants: Planned number of participants, or `None`.
        seed: Seed of the simulated experiments.

    Attributes:
        d_z: Effect size: mean of the within-participant differences divided by their standard
            deviation.
        least: Mapping from desired power to the smallest number of participants.
        participants: Planned number of participants, or `None`.
        power: Power with the planned number of participants, computed from the noncentral t
            distribution.
        simulated: Power with the planned number of participants, from simulated experiments,
            with its 95 % interval.
    """

    def __init__(self, d_z: float, participants: int | None, seed: int) -> None:
        self.d_z = d_z
        self.participants = participants
        self.least = {}
        for desired_power in (0.8, 0.9, 0.95):
            self.least[desired_power] = find_least_number(d_z, wanted=desired_power)

        self.power: float | None = None
        self.simulated: SimulatedPower | None = None
        if participants is not None:
            self.power = power(d_z, participants)
            # The difference of two trials has sqrt(2) times the deviation of a trial. It must
            # be 1, so that the mean difference equals d_z.
            means = {"first": 0.0, "second": d_z}
            deviation = 0.5**0.5
            (self.simulated,) = simulate_power(
                means, participants, trial_deviation=deviation, seed=seed
            )

    def to_dict(self) -> dict[str, Any]:
        """Returns the result as plain values for `trilat experiment power --json`.

        Contains the effect size, the number of participants needed for each power, and the
        computed and simulated power for the planned number of participants.
        """
        simulated = None if self.simulated is None else self.simulated._asdict()
        least = []
        for desired_power, number in self.least.items():
            least.append({"power": desired_power, "participants": number})
        return {
            "d_z": self.d_z,
            "least": least,
            "participants": self.participants,
            "power": self.power,
            "simulated": simulated,
        }

    def blocks(self) -> Iterator[str | TextTable]:
        """Yields the parts of the report that `trilat experiment power` prints.

        A table lists the number of participants needed for each power (the probability of
        detecting a true effect). If a number of participants is planned, a sentence states the
        resulting power.
        """
        yield (
            "paired comparison of two conditions, two-sided, alpha 0.05, "
            f"effect d_z {self.d_z:g}"
        )
        rows = []
        for desired_power, number in self.least.items():
            rows.append((f"{desired_power:g}", str(number)))
        yield TextTable(("power", "participants"), rows, align="rr")
        if self.power is not None and self.simulated is not None:
            interval = _format_interval(self.simulated.interval)
            simulated_text = f"{self.simulated.found:.3f} {interval} of 500 drawn experiments"
            yield (
                f"with {count_nouns(self.participants, 'participant')}: power "
                f"{self.power:.3f}; found in {simulated_text}"
            )


def compute_experiment_power(
    effect: float, participants: int | None = None, *, seed: int = 1
) -> PowerOfExperiment:
    """Computes the number of participants needed to detect an effect.

    Equivalent to the command `trilat experiment power`.

    >>> tn.compute_experiment_power(0.5).least[0.8]
    34

    Args:
        effect: Effect size (Cohen's d_z): mean of the within-participant differences divided by
            their standard deviation.
        participants: Planned number of participants, for which the power is computed and
            simulated.
        seed: Seed of the simulated experiments.

    Raises:
        UsageError: Detecting the effect takes more participants than `find_least_number` tries.
    """
    return PowerOfExperiment(effect, participants, seed)


def _describe_mean(mean: ConditionMean) -> str:
    """Formats a mean: "1.234", or "1.234 (2 missing)" if values are missing."""
    missing = f" ({mean.missing} missing)" if mean.missing else ""
    return f"{mean.mean:.4g}{missing}"


def _list_points(rows: Sequence[Row], name: str) -> Array:
    """Returns one point of the movement in each of K trials, in m, shape (K, 2).

    Args:
        rows: The K trials.
        name: Name of the point: "start", "target" or "end".
    """
    return np.array([[row[f"{name}_{axis}_m"] for axis in "xy"] for row in rows])


def _format_interval(interval: tuple[float, float | None] | None) -> str:
    """Formats a confidence interval, for example as "[3.06, 3.22]".

    An upper end of `None` lies beyond the time limit and is written as `NOT_REACHED`. If there
    is no interval, the result is "-".
    """
    if interval is None:
        return "-"
    low, high = interval
    upper = NOT_REACHED if high is None else f"{high:.4g}"
    return f"[{low:.4g}, {upper}]"


def _flatten(row: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yields the column names and values of a CSV row, flattening nested values.

    For example, a confidence interval becomes two columns such as "interval_low".
    """
    for key, value in row.items():
        if key in ("interval", "bootstrap"):
            low, high = value or (None, None)
            yield f"{key}_low", low
            yield f"{key}_high", high
        else:
            yield key, value
