"""What an experiment found: means by condition, comparisons, a mixed model, figures, a methods
paragraph.

Invariant:
- It is a function of the journals. Practice and catch trials do not count.
- A trial that was not completed counts, and its completion time is censored: longer than any
  (see `completion_times`).
- Every measure that trials have is summarised, also where all values are equal; every one that
  is missing somewhere says how often. Every number of a figure or a sentence is in a table.
- The methods paragraph describes the analyses that were computed, and no others.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...errors import UsageError, count_nouns
from ...files import find_version, make_folder, make_subfolder, write_whole
from ...reporting import style
from ...reporting.result_text import Block, TextTable, compose, format_number
from ...results import Result
from ..study_folder import encode_csv
from .completion_times import (
    COMPLETION,
    CompletionComparison,
    CompletionTime,
    compare_times,
    find_unit_medians,
    is_completed,
    summarise_times,
    to_table,
)
from .condition_figures import draw_conditions, draw_learning, draw_times
from .experiment_run import Experiment, open_experiment
from .movement_measures import measure_throughput
from .statistics import (
    CONFIDENCE,
    Comparison,
    ConditionMean,
    MixedModel,
    Row,
    average_trials,
    compare_conditions,
    find_least_number,
    fit_mixed_model,
    power,
    simulate_power,
    summarise_conditions,
    write_methods,
)

MEASURES = (
    "completion_s", "throughput_bits_s", "error_end_mm", "error_rms_mm", "path_m", "sparc", "force_mean_n",
    "force_mean_user1_n", "force_mean_user2_n", "wall_force_n", "error_force_n", "error_handover_mm",
    "first_settled", "internal_rms_n", "useful_rms_n", "internal_share", "first_effort_share", "first_work_j",
    "second_work_j", "first_taken_j", "second_taken_j", "succeeded",
)  # fmt: skip
"""What is compared, as far as trials have it."""
FOLDER = "analysis"
NOT_REACHED = "not reached"
"""Said of a median if half of the trials or more were not completed."""


class MissingAnswers(NamedTuple):
    """How many items of a questionnaire were left out under a condition.

    Attributes:
        questionnaire: its name.
        condition: its block's; "" of a questionnaire after the experiment.
        asked: how many items were asked, of all who were asked.
        missing: how many of them have no answer.
        forms: how many questionnaires that is.
        unscored: how many of these have no score because an answer is missing.
    """

    questionnaire: str
    condition: str
    asked: int
    missing: int
    forms: int
    unscored: int


class ExperimentAnalysis(Result):
    """The statistics of an experiment.

    Attributes:
        rows: the trials that count, after a training if there is one; `learning_rows` has all
        of its phases. throughput_rows, gain_rows, threshold_rows: a row for each participant,
        or pair, and condition.
        means: by measure, for each condition; `completion_s` is among them if every trial was
            completed.
        comparisons: by measure, of every two conditions.
        times: of a task with a time limit, the completion time for each condition.
        time_comparisons: of every two conditions, if trials were not completed.
        missing_answers: of every questionnaire and condition.
        absent: measures that this experiment could have and that no trial has a number for,
            with the reasons.
        methods: the paragraph of a paper.
        paths: the files that were written.
    """

    def __init__(self, experiment: Experiment, exclude: Mapping[str, str] = {}) -> None:
        self._experiment = experiment
        self._exclude = exclude
        protocol = experiment.plan.protocol
        self.unit = experiment.unit
        order = list(protocol.conditions).index
        who = {"-".join(group) for group in protocol.groups}
        if unknown := sorted(exclude.keys() - who):
            raise UsageError(
                f"there is no {self.unit} {', '.join(unknown)}: there are {', '.join(sorted(who))}"
            )
        kept = (row for row in experiment.to_rows() if row[self.unit] not in exclude)
        counted = [row for row in kept if not (row["practice"] or row["catch"])]
        self.learning_rows = sorted(counted, key=lambda row: order(row["condition"]))
        left_out = ("before", "training", "retention")
        self.rows = [row for row in self.learning_rows if row.get("phase") not in left_out]
        if not self.rows:
            raise UsageError(f"{experiment.folder}: no trial that counts is done yet")
        self.throughput_rows = list(self._find_throughput())
        self.gain_rows = list(self._find_gains())
        self.threshold_rows = sorted(
            self._find_thresholds(), key=lambda row: order(row["condition"])
        )
        scores = sorted(experiment.list_scores(), key=lambda row: order(row["condition"]))
        self._scores = [row for row in scores if row[self.unit] not in exclude]
        forms = [form.name for form in protocol.questionnaires if form.after == "block"]
        self.means: dict[str, list[ConditionMean]] = {}
        self.comparisons: dict[str, list[Comparison]] = {}
        once = [key for row in (*self.gain_rows[:1], *self.threshold_rows[:1]) for key in row]
        own = [key for key in once if key.startswith(("gain_", "threshold_"))]
        self.times: list[CompletionTime] = []
        self.time_comparisons: list[CompletionComparison] = []
        if protocol.task.has_limit:
            self._summarise_times()
        self.absent = self._find_absent(forms)
        censored = any(time.censored for time in self.times)
        for measure in (*MEASURES, *forms, *own):
            rows = self.of(measure)
            is_measured = any(row.get(measure) not in (None, "") for row in rows)
            if is_measured and not (measure == COMPLETION and censored):
                self.means[measure] = summarise_conditions(rows, measure, unit=self.unit)
                self.comparisons[measure] = compare_conditions(rows, measure, unit=self.unit)
        self.missing_answers = list(self._count_missing_answers())
        self.models = list(self.fit_models())
        self.methods = self._write_methods()
        self.paths = list[Path]()

    @property
    def _limit_s(self) -> float:
        return self._experiment.plan.protocol.task.longest_s

    def _summarise_times(self) -> None:
        """Summarises the completion times, and compares them if trials were not completed."""
        self.times = summarise_times(self.rows, self._limit_s, unit=self.unit)
        if any(time.censored for time in self.times):
            self.time_comparisons = compare_times(self.rows, unit=self.unit)

    def _find_absent(self, forms: Sequence[str]) -> dict[str, str]:
        """Returns the measures that this experiment could have and lacks, each with the reason."""
        absent = {}
        for name in forms:
            scores = [row.get(name) for row in self.of(name)]
            if not scores:
                absent[name] = "nobody has answered it"
            elif all(score is None for score in scores):
                absent[name] = "every questionnaire lacks an answer"
        is_reaching = self._experiment.plan.protocol.task.description.startswith("reaching")
        if is_reaching and not self.throughput_rows:
            absent["throughput_bits_s"] = (
                f"no {self.unit} has enough completed trials under a condition"
            )
        return absent

    def _count_missing_answers(self) -> Iterator[MissingAnswers]:
        """Yields how many items were left out, for each questionnaire and condition."""
        protocol = self._experiment.plan.protocol
        after = {form.name: form.after for form in protocol.questionnaires}
        groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for row in self._experiment.list_answers():
            name = row["questionnaire"]
            if name in after and row[self.unit] not in self._exclude:
                condition = row["condition"] if after[name] == "block" else ""
                groups.setdefault((name, condition), []).append(row)
        for (name, condition), rows in groups.items():
            answers: dict[tuple[str, int], list[float | None]] = {}
            for row in rows:
                answers.setdefault((row["participant"], row["block"]), []).append(row["value"])
            yield MissingAnswers(
                questionnaire=name,
                condition=condition,
                asked=len(rows),
                missing=sum(row["value"] is None for row in rows),
                forms=len(answers),
                unscored=sum(None in values for values in answers.values()),
            )

    def of(self, measure: str) -> Sequence[Row]:
        """Returns the rows that have a measure."""
        found = {
            "throughput": self.throughput_rows,
            "gain": self.gain_rows,
            "threshold": self.threshold_rows,
        }
        kind, named, _ = measure.partition("_")
        if named and kind in found:
            return found[kind]
        return (
            self.rows
            if measure in MEASURES
            else [row for row in self._scores if measure in row]
        )

    def _find_throughput(self) -> Iterator[dict[str, Any]]:
        """Yields the throughput of each participant and condition, where the task is to reach."""
        by: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for row in self.rows:
            by.setdefault((row[self.unit], row["condition"]), []).append(row)
        for (who, condition), rows in by.items():
            done = [row for row in rows if row["succeeded"]]
            if (
                self._experiment.plan.protocol.task.description.startswith("reaching")
                and len(done) > 1
            ):
                left, aims, ends = (
                    np.array([[row[f"{name}_{axis}_m"] for axis in "xy"] for row in done])
                    for name in ("start", "target", "end")
                )
                found = measure_throughput(
                    left, aims, ends, [row["completion_s"] for row in done]
                )
                if found is not None:
                    yield {
                        self.unit: who,
                        "condition": condition,
                        "throughput_bits_s": found.bits_s,
                    }

    def _find_gains(self) -> Iterator[dict[str, Any]]:
        """Yields by how much each pair has become better by a training: at once (transfer), and
        later.
        """
        learnt = self._experiment.plan.protocol.task.learning_measure
        means = dict[str, Any]()
        for phase in ("before", "after", "retention"):
            if rows := [row for row in self.learning_rows if row.get("phase") == phase]:
                means[phase] = self._average_learnt(rows, learnt)
        for condition, each in means.pop("before", {}).items():
            for who, before in each.items():
                of = {
                    phase: found.get(condition, {}).get(who) for phase, found in means.items()
                }
                gains = {
                    f"gain_{phase}_{learnt}": before - mean
                    for phase, mean in of.items()
                    if mean
                }
                yield {self.unit: who, "condition": condition, **gains}

    def _is_censored(self, measure: str) -> bool:
        """Whether a measure is the completion time of trials of which some were not completed."""
        has_limit = self._experiment.plan.protocol.task.has_limit
        return (
            measure == COMPLETION
            and has_limit
            and not all(map(is_completed, self.learning_rows))
        )

    def _average_learnt(self, rows: Sequence[Row], learnt: str) -> dict[str, dict[str, float]]:
        """Returns what is learnt by condition and unit: means, or medians of times that may be
        censored.

        A median that is longer than the limit is left out.
        """
        if not self._is_censored(learnt):
            return average_trials(rows, learnt, self.unit)
        medians = find_unit_medians(rows, self.unit)
        return {
            condition: {who: median for who, median in each.items() if math.isfinite(median)}
            for condition, each in medians.items()
        }

    def _find_thresholds(self) -> Iterator[dict[str, Any]]:
        """Yields the threshold of each participant and condition, of a staircase that turned
        often enough.
        """
        plan = self._experiment.plan
        choices = self._experiment.list_choices()
        if (stairs := plan.protocol.staircase) is None:
            return
        for trial in (one for one in plan.trials if one.trial == 1):
            threshold = stairs.find_threshold(plan.judge_choices(trial, choices))
            if threshold is not None and (who := "-".join(trial.group)) not in self._exclude:
                yield {self.unit: who, "condition": trial.condition, stairs.measure: threshold}

    def _write_methods(self) -> str:
        plan = self._experiment.plan
        protocol = plan.protocol
        scenario = next(iter(plan.scenarios.values()))
        who = dict.fromkeys(row[self.unit] for row in self.rows)
        rows_of = {
            name: [row for row in self.rows if row["condition"] == name]
            for name in protocol.conditions
        }
        delays = {
            name: {"delay_ms": round(float(np.mean([row["delay_ms"] for row in rows])), 1)}
            for name, rows in rows_of.items()
            if rows
        }
        control = msgspec.to_builtins(scenario.sites[protocol.users[0]].control)
        reasons = ", ".join(
            f"{name}: {why}" if why else name for name, why in self._exclude.items()
        )
        facts: dict[str, Any] = {  # "": there is nothing to say of it
            "participants": len(who) * len(protocol.users),
            "pairs": len(who) if self.unit == "pair" else "",
            "excluded": len(protocol.groups) * len(protocol.users)
            - len(who) * len(protocol.users),
            "exclusions": reasons,
            "training": protocol.training.describe() if protocol.training else "",
            "staircase": protocol.staircase.describe() if protocol.staircase else "",
            "design": protocol.design,
            "blocks": len(protocol.conditions),
            "trials": protocol.trials,
            "conditions": delays,
            "law": control.pop("law"),
            "rate_hz": scenario.sites[protocol.users[0]].rate_hz,
            "gains": control,
            "seeds": [protocol.seed],
            "program": f"trilat-net {find_version()}",
            "digest": plan.digest,
            "measures": list(self.means),
            "unit": self.unit,
            "correction": "Holm",
            "computed": self._list_computed(),
            "completion": self._describe_times(),
            "answers": self._describe_missing_answers(),
        }
        return write_methods(facts)

    def _list_computed(self) -> list[str]:
        """Returns which analyses were computed, of those that a methods paragraph describes."""
        compared = [one for found in self.comparisons.values() for one in found]
        summarised = [one for found in self.means.values() for one in found]
        computed = {
            "intervals": any(one.interval is not None for one in summarised),
            "bootstrap": any(one.bootstrap is not None for one in summarised),
            "t tests": any(one.p is not None for one in compared),
            "wilcoxon": any(one.p_wilcoxon is not None for one in compared),
            "effect sizes": any(one.d_z is not None for one in compared),
            "sign tests": any(one.p is not None for one in self.time_comparisons),
            "mixed models": bool(self.models),
        }
        return [name for name, was in computed.items() if was]

    def _describe_times(self) -> str:
        """Returns the sentence on trials that were not completed; "" if all were."""
        trials = sum(time.trials for time in self.times)
        censored = sum(time.censored for time in self.times)
        if not censored:
            return ""
        timed_out = sum(time.timed_out for time in self.times)
        sooner = censored - timed_out
        failed = f" and {sooner} failed sooner" if sooner else ""
        return (
            f"{timed_out} of {count_nouns(trials, 'trial')} ran into the time limit of "
            f"{self._limit_s:g} s{failed}; their "
            "completion times are right-censored, and completion is summarised by the median of Kaplan and "
            f"Meier per {self.unit} and condition"
        )

    def _describe_missing_answers(self) -> str:
        """Returns the sentence on answers that are missing; "" if none is."""
        missing = sum(one.missing for one in self.missing_answers)
        asked = sum(one.asked for one in self.missing_answers)
        unscored = sum(one.unscored for one in self.missing_answers)
        if not missing:
            return ""
        plural = "questionnaire has" if unscored == 1 else "questionnaires have"
        return (
            f"{missing} of {count_nouns(asked, 'answer is', 'answers are')} missing; "
            f"{unscored} {plural} no score for that reason"
        )

    def write(self, folder: Path) -> "ExperimentAnalysis":
        """Writes tables, figures, the paragraph and all as JSON into a folder; `paths` names
        them.
        """
        made = make_folder(folder)
        tables = {
            "conditions.csv": self._list_means(),
            "comparisons.csv": self.to_rows(),
            "completion_times.csv": to_table(self.times),
            "completion_comparisons.csv": to_table(self.time_comparisons),
            "missing_answers.csv": [one._asdict() for one in self.missing_answers],
        }
        optional = ("completion_times.csv", "completion_comparisons.csv", "missing_answers.csv")
        tables = {name: rows for name, rows in tables.items() if rows or name not in optional}
        texts = {
            name: encode_csv([dict(_flatten(row)) for row in rows])
            for name, rows in tables.items()
        }
        whole = json.dumps(self.to_dict(), indent=1)
        texts |= {"methods.txt": f"{self.methods}\n", "analysis.json": f"{whole}\n"}
        for name, text in texts.items():
            write_whole(made / name, text, force=True)
        self.paths = [made / name for name in texts]
        figures = {
            name: draw_conditions(self.of(name), name, unit=self.unit) for name in self.means
        }
        if self.time_comparisons:
            figures[COMPLETION] = draw_times(self.rows, self._limit_s, unit=self.unit)
        if len({row["trial"] for row in self.learning_rows}) > 1:
            protocol = self._experiment.plan.protocol
            learnt = "difference" if protocol.staircase else protocol.task.learning_measure
            limit_s = self._limit_s if self._is_censored(learnt) else None
            figures["learning"] = draw_learning(
                self.learning_rows, learnt, unit=self.unit, limit_s=limit_s
            )
        page = made / "report.md"
        write_whole(page, self.compose_page(list(figures)), force=True)
        self.paths.append(page)
        for name, figure in figures.items():
            self.paths.append(made / f"{name}.png")
            style.write_figure(figure, self.paths[-1], style.REPORT_DPI)
        return self

    def compose_page(self, figures: Sequence[str]) -> str:
        """Returns the text of the analysis with its figures, as Markdown.

        Args:
            figures: names of the PNG files beside the page.
        """
        protocol = self._experiment.plan.protocol
        parts = [f"# {protocol.title or protocol.name}"]
        for block in compose(self):
            text = (
                block.markdown() if isinstance(block, TextTable) else "\n".join(block.lines())
            )
            parts += [text] if text.strip() else []
        parts += [f"![{name}]({name}.png)" for name in figures]
        return "\n\n".join(parts) + "\n"

    def fit_models(self) -> Iterator[MixedModel]:
        """Yields mixed models of the forces of users within pairs, where statsmodels is
        installed.
        """
        pairs = {row[self.unit] for row in self.rows}
        if self.unit == "participant" or len(pairs) < 2 or find_spec("statsmodels") is None:
            return
        for measure in ("force_mean", "force_peak"):
            rows = [
                {**row, "participant": name, measure + "_n": row[f"{measure}_user{place}_n"]}
                for row in self.rows
                for place, name in enumerate(row["pair"].split("-"), 1)
            ]
            with suppress(UsageError):  # too few pairs for it
                yield fit_mixed_model(rows, measure + "_n")

    def _list_means(self) -> list[dict[str, Any]]:
        return [
            {"measure": name, **one._asdict()}
            for name, means in self.means.items()
            for one in means
        ]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row for each comparison."""
        return [one._asdict() for found in self.comparisons.values() for one in found]

    def to_dict(self) -> dict[str, Any]:
        """Returns it as `trilat experiment analyse --json`."""
        facts = {
            "name": self._experiment.plan.protocol.name,
            "digest": self._experiment.plan.digest,
        }
        models = {model.measure: model._asdict() for model in self.models}
        for model in models.values():
            model["effects"] = [effect._asdict() for effect in model["effects"]]
        return {
            **facts,
            "conditions": self._list_means(),
            "comparisons": self.to_rows(),
            "completion_times": to_table(self.times),
            "completion_comparisons": to_table(self.time_comparisons),
            "missing_answers": [one._asdict() for one in self.missing_answers],
            "absent": self.absent,
            "mixed_models": models,
            "methods": self.methods,
        }

    def blocks(self) -> Iterator[Block]:
        """Yields its text: completion, the measures, what is missing, and the paragraph.

        With one unit there is nothing to compare it with, and all measures stand in one table.
        """
        yield from self._write_time_blocks()
        units = {row[self.unit] for row in self.rows}
        if len(units) > 1:
            yield from self._write_measure_blocks()
        else:
            yield from self._write_single_unit_block(next(iter(units)))
        yield from self._write_model_blocks()
        for one in self.missing_answers:
            under = f", {one.condition}" if one.condition else ""
            without = (
                (f"; {one.unscored} of {one.forms} have no score for that reason")
                if one.missing
                else ""
            )
            yield (
                f"{one.questionnaire}{under}: {one.missing} of "
                f"{count_nouns(one.asked, 'answer is', 'answers are')} missing{without}"
            )
        yield from (
            f"{name}: no number, because {reason}" for name, reason in self.absent.items()
        )
        if self.missing_answers or self.absent:
            yield ""
        yield self.methods

    def _write_time_blocks(self) -> Iterator[Block]:
        """Yields how many trials were completed, and how long that took."""
        if not self.times:
            return
        yield f"{COMPLETION}, median over {self.unit}s of the median of each {self.unit}'s trials"
        yield "a trial that was not completed counts as longer than any"
        rows = [
            (
                time.condition,
                str(time.trials),
                str(time.timed_out),
                str(time.censored - time.timed_out),
                str(time.number),
                NOT_REACHED if time.median is None else f"{time.median:.4g}",
                _span(time.interval),
            )
            for time in self.times
        ]
        heads = ("condition", "trials", "timed out", "failed sooner", "n", "median", "interval")
        yield TextTable(heads, rows, align="lrrrrrl")
        yield ""
        if self.time_comparisons:
            found = [
                (
                    f"{one.second} - {one.first}",
                    f"{one.longer} of {one.number}",
                    f"{one.shorter} of {one.number}",
                    format_number(one.difference),
                    format_number(one.p),
                    format_number(one.p_holm),
                )
                for one in self.time_comparisons
            ]
            columns = ("difference", "longer", "shorter", "median", "p, sign test", "p, Holm")
            yield TextTable(columns, found, align="lrrrrr")
            yield ""

    def _write_measure_blocks(self) -> Iterator[Block]:
        """Yields a table of conditions and one of comparisons for each measure."""
        for measure, means in self.means.items():
            yield f"{measure}, mean over {self.unit}s, {100 * CONFIDENCE:g} % interval"
            rows = [
                (
                    one.condition,
                    str(one.number),
                    str(one.missing),
                    f"{one.mean:.4g}",
                    _span(one.interval),
                )
                for one in means
            ]
            yield TextTable(
                ("condition", "n", "missing", "mean", "interval"), rows, align="lrrrl"
            )
            yield ""
            found = [
                (
                    f"{one.second} - {one.first}",
                    format_number(one.difference),
                    _span(one.interval),
                    format_number(one.t),
                    format_number(one.p_holm),
                    format_number(one.d_z),
                )
                for one in self.comparisons[measure]
            ]
            if found:
                heads = ("difference", "mean", "interval", "t", "p, Holm", "d_z")
                yield TextTable(heads, found, align="lrlrrr")
                yield ""

    def _write_model_blocks(self) -> Iterator[Block]:
        """Yields a table of effects for each mixed model."""
        for model in self.models:
            yield f"{model.measure} of each user, mixed model against {model.reference}"
            rows = [
                (
                    effect.condition,
                    f"{effect.estimate:.4g}",
                    _span(effect.interval),
                    format_number(effect.t),
                    format_number(effect.p),
                )
                for effect in model.effects
            ]
            yield TextTable(("condition", "effect", "interval", "t", "p"), rows, align="lrlrr")
            yield ""

    def _write_single_unit_block(self, who: str) -> Iterator[Block]:
        """Yields one table of all measures, a column for each condition."""
        conditions = list(dict.fromkeys(row["condition"] for row in self.rows))
        yield f"means over the trials of a condition; one {self.unit}, {who}, allows no interval and no test"
        rows = []
        for measure, means in self.means.items():
            by_condition = {one.condition: _describe_mean(one) for one in means}
            rows.append((measure, *(by_condition.get(name, "-") for name in conditions)))
        yield TextTable(("measure", *conditions), rows, align="l" + "r" * len(conditions))
        yield ""


def analyse_experiment(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    exclude: Mapping[str, str] = {},
) -> ExperimentAnalysis:
    """Returns the statistics of an experiment, written into its folder; `trilat experiment
    analyse`.

    >>> found = tn.analyse_experiment("runs/experiment-reaching-001")  # doctest: +SKIP
    >>> found.means["completion_s"][0].interval  # doctest: +SKIP
    (3.06, 3.22)

    Args:
        folder: of the experiment.
        out: where tables and figures go; by default its folder `analysis`.
        exclude: participants or pairs whose data do not count, with the reasons.

    Raises:
        UsageError: there is no experiment, no trial is done, or nobody is called what is
            excluded.
    """
    experiment = open_experiment(folder)
    return ExperimentAnalysis(experiment, exclude).write(
        make_subfolder(experiment.folder / FOLDER) if out is None else Path(out)
    )


class PowerOfExperiment(Result):
    """How many participants an effect needs.

    Attributes:
        d_z: the effect, mean over standard deviation of the differences within participants.
        least: the least number of participants by the power that is wanted.
        participants: how many there are to be; None: it is not asked.
        power: with so many, by the noncentral t.
        simulated: the same by drawn experiments, with its 95 % interval.
    """

    def __init__(self, d_z: float, participants: int | None, seed: int) -> None:
        self.d_z = d_z
        self.participants = participants
        self.least = {
            wanted: find_least_number(d_z, wanted=wanted) for wanted in (0.8, 0.9, 0.95)
        }
        self.power = self.simulated = None
        if participants is not None:
            means = {"first": 0.0, "second": d_z}
            deviation = 0.5**0.5
            self.power = power(d_z, participants)
            (self.simulated,) = simulate_power(
                means, participants, trial_deviation=deviation, seed=seed
            )

    def to_dict(self) -> dict[str, Any]:
        """Returns it as `trilat experiment power --json`."""
        drawn = None if self.simulated is None else self.simulated._asdict()
        least = [
            {"power": wanted, "participants": number} for wanted, number in self.least.items()
        ]
        return {
            "d_z": self.d_z,
            "least": least,
            "participants": self.participants,
            "power": self.power,
            "simulated": drawn,
        }

    def blocks(self) -> Iterator[Block]:
        """Yields its text."""
        yield f"paired comparison of two conditions, two-sided, alpha 0.05, effect d_z {self.d_z:g}"
        yield TextTable(
            ("power", "participants"),
            [(f"{p:g}", str(n)) for p, n in self.least.items()],
            align="rr",
        )
        if self.power is not None and self.simulated is not None:
            drawn = f"{self.simulated.found:.3f} {_span(self.simulated.interval)} of 500 drawn experiments"
            yield (
                f"with {count_nouns(self.participants, 'participant')}: power "
                f"{self.power:.3f}; found in {drawn}"
            )


def compute_experiment_power(
    effect: float, participants: int | None = None, *, seed: int = 1
) -> PowerOfExperiment:
    """Returns how many participants an effect needs; the command is `trilat experiment power`.

    >>> tn.compute_experiment_power(0.5).least[0.8]
    34

    Args:
        effect: mean over standard deviation of the differences within participants, Cohen's
            d_z.
        participants: how many there are to be, of whom the power is told and simulated.
        seed: of the experiments that are drawn.

    Raises:
        UsageError: the effect is too small to be found.
    """
    return PowerOfExperiment(effect, participants, seed)


def _describe_mean(mean: ConditionMean) -> str:
    """Returns a mean, with how many numbers are missing if any are."""
    return f"{mean.mean:.4g}" + (f" ({mean.missing} missing)" if mean.missing else "")


def _span(interval: tuple[float, float | None] | None) -> str:
    """Returns an interval, whose upper end may not have been reached."""
    if interval is None:
        return "-"
    low, high = interval
    return f"[{low:.4g}, {NOT_REACHED if high is None else format(high, '.4g')}]"


def _flatten(row: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yields the cells of a row; an interval has one for each end."""
    for key, one in row.items():
        if key in ("interval", "bootstrap"):
            low, high = one or (None, None)
            yield from ((f"{key}_low", low), (f"{key}_high", high))
        else:
            yield key, one
