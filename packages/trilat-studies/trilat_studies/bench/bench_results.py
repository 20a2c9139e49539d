"""Summarises benchmark results as tables, in Markdown, CSV and JSON.

For each law, the tables show over how many links it is stable, which properties its runs have,
and the means of the measured quantities. A cell is one law in one task over one link, and has
one run per random seed.

Invariant:
    - The output depends only on the runs. It contains no time of day, so equal results give
      identical bytes.
    - A mean or share over at least `LEAST_SEEDS` seeds has its 95 % confidence interval.
    - Every run that is not stable is visible in the tables.
    - Laws are not ranked, because it depends on the application which quantity matters.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.analysis import EndBehaviour, Stability
from trilat_net.errors import count_nouns
from trilat_net.presentation import Block, TextTable, format_number
from trilat_net.results import Result
from trilat_net.work import MeanInterval, encode_csv, wilson_interval

from ..side_by_side import describe_runs_alone
from .bench_plan import STUDIES, TASKS, BenchCell, BenchPlan, TunedGains, explain_no_cell

LEAST_CONTACT_N = 1.0
"""Smallest mean wall force, in N, at which the slave is considered to touch the wall.

The mean is taken over the last quarter of the task.
"""
PASSIVE_J = -1e-3
"""Value of `BenchRun.energy_j`, in J, at or above which a run counts as passive.

It is slightly below 0, because the energy is a numerical integral.
"""
CONFIRMATION_LENGTHS = 2.0
"""Ratio of the duration of a confirming repetition to that of the original run."""
LEAST_SEEDS = 20
"""Smallest number of runs for which a confidence interval is computed."""


def name_run(key: str, to_s: float) -> str:
    """Returns the name under which the journal stores the finished runs of a cell.

    Args:
        key: Key of the cell, see `BenchCell.key`.
        to_s: Duration of the runs, in s, if they repeat earlier runs for longer. It becomes
            part of the name. 0 for runs that are not repetitions.
    """
    return f"{key} to {to_s:g} s" if to_s else key


class BenchRun(msgspec.Struct, frozen=True):
    """A finished benchmark run, with its verdict and its measured quantities.

    Worker processes create these objects, and the journal of the suite stores them. For a run
    that diverged, `error_rad` and all later attributes are `None`.

    Attributes:
        name: Name of the cell, as in "contact/wave/rtt272".
        inputs: Digest of everything that determines the runs of the cell.
        seed: Random seed of the run.
        random: True if the run would differ with another seed.
        sha256: Digest of the scenario of the run.
        stability: Verdict from the end of the run and from its twins, which are repeated runs
            with a small disturbance (docs/reference/stability.md).
        behaviour: How the run ended, for example at rest or diverged.
        text: Explanation of the verdict.
        length_s: Duration of the judged run, in s.
        to_s: Requested duration in s, if this run repeats an earlier run that was not stable. 0
            for a run that is not a repetition.
        at_limit: True if a reliable verdict would have taken more ticks than the safety limit
            allows.
        confirmed: True if the repeated run was not stable either, False if its verdict was
            better and so refuted the first one. `None` if there was no repetition, because the
            first run diverged or was not judged "not stable".
        bounded: True if no joint exceeded the velocity `BOUND_RAD_S` or moved more than
            `THROWN_RAD` away from its start.
        energy_j: Minimum over time of the total energy that operators, friction and wall had
            put into the arms, in J.
        settled_s: Time from which all arms stay at their final poses, in s. `None` if there is
            no such time within the run.
        error_rad: RMS over time and joints of the difference between the slave and the average
            of the users (weighted with the dominance factors, with no delay), in rad.
        effort_nm: RMS of tau - G(q), the torque without gravity, over sites and joints, in N m.
        hand_nm: RMS torque of the operators over the joints of the arms that have an operator,
            in N m.
        wall_n: Mean force of the wall in the last quarter of the task, in N. `None` if there is
            no wall.
        force_peak_n: Largest force of the wall, in N. `None` if there is no wall.
        stiffness_n_m: Stiffness that the user feels 2 s after contact, in N/m, computed from
            two runs with different reaches. `None` unless both runs have such a contact.
        impedance_n_s_m: |Z| at 1 Hz that the user feels in contact, minus |Z| in free motion,
            in N s/m. `None` if there was no contact.
        free_impedance_n_s_m: |Z| at 1 Hz that the user feels in free motion, in N s/m. Measured
            in the task `contact` only.
    """

    name: str
    inputs: str
    seed: int
    random: bool
    sha256: str
    stability: Stability
    behaviour: EndBehaviour
    text: str
    length_s: float = 0.0
    to_s: float = 0.0
    at_limit: bool = False
    confirmed: bool | None = None
    bounded: bool = False
    energy_j: float | None = None
    settled_s: float | None = None
    error_rad: float | None = None
    effort_nm: float | None = None
    hand_nm: float | None = None
    wall_n: float | None = None
    force_peak_n: float | None = None
    stiffness_n_m: float | None = None
    impedance_n_s_m: float | None = None
    free_impedance_n_s_m: float | None = None

    @property
    def cell(self) -> str:
        """Name that identifies the runs of this cell in the journal of finished runs.

        It consists of the task, the law, the link, and a digest of the scenario and the gains.
        For a repetition over a longer time, it also contains the duration.
        """
        return name_run(f"{self.name} {self.inputs}", self.to_s)

    @property
    def needs_confirmation(self) -> bool:
        """True if this run was judged not stable, but might be stable over a longer time.

        False for a run that diverged, since a longer run would diverge at the same time, and
        for a run that is itself a repetition.
        """
        diverged = self.behaviour is EndBehaviour.DIVERGED
        is_first = not self.to_s
        return self.stability is Stability.NOT_STABLE and not diverged and is_first

    @property
    def confirmation_s(self) -> float:
        """Duration of the longer repetition of this run if it was judged not stable, in s.

        The repetition confirms the verdict if it is not stable either, and refutes the verdict
        otherwise.
        """
        return CONFIRMATION_LENGTHS * self.length_s

    @property
    def masked(self) -> bool:
        """True if the slave should have touched a wall in this run but did not.

        The quantities measured without contact describe free motion and would look better than
        those of a run with contact, so they are not shown.
        """
        return self.wall_n is not None and self.wall_n < LEAST_CONTACT_N


QUANTITIES = {
    "error_rad": "RMS distance of the slave from its users, rad",
    "effort_nm": "effort, RMS of tau - G(q), N m",
    "hand_nm": "RMS torque of the hands, N m",
    "force_peak_n": "largest force of the wall, N",
    "stiffness_n_m": "stiffness at the user's hand 2 s after contact, N/m",
    "impedance_n_s_m": "|Z| at 1 Hz at the user's hand in contact, minus free motion, N s/m",
    "free_impedance_n_s_m": "|Z| at 1 Hz at the user's hand in free motion, N s/m",
    "settled_s": "time from which all arms stay at their final poses, s",
}
"""Labels of the quantities that are averaged over the seeds of a cell."""
_QUANTITIES_OF_ALL = ("error_rad", "effort_nm", "settled_s")
_QUANTITIES_BY_TASK = {
    "free": ["hand_nm"],
    "disagree": ["hand_nm"],
    "contact": [
        "stiffness_n_m",
        "impedance_n_s_m",
        "free_impedance_n_s_m",
        "force_peak_n",
    ],
}
_JUDGEMENTS = (
    Stability.STABLE,
    Stability.SETTLED,
    Stability.OPEN,
    Stability.NOT_STABLE,
)


class BenchCellResult(NamedTuple):
    """Results of one control law in one task over one network link, with one run per seed.

    Attributes:
        cell: The law, task, link and gains of the runs.
        runs: The runs, in the order of the seeds.
    """

    cell: BenchCell
    runs: Sequence[BenchRun]

    @property
    def stable(self) -> int:
        """Number of runs that were judged stable.

        Runs that came to rest without being shown to be stable do not count.
        """
        return self.count(Stability.STABLE)

    def count(self, stability: Stability) -> int:
        """Counts the runs with a given verdict.

        Args:
            stability: The verdict to count, for example `Stability.NOT_STABLE`.
        """
        return sum(run.stability is stability for run in self.runs)

    @property
    def judgement(self) -> Stability:
        """The worst verdict of the runs in this cell.

        From worst to best: not stable, open (could not be decided), settled (only came to
        rest), stable.
        """
        worst_first = (Stability.NOT_STABLE, Stability.OPEN, Stability.SETTLED)
        occurring = [stability for stability in worst_first if self.count(stability)]
        return occurring[0] if occurring else Stability.STABLE

    @property
    def masked(self) -> bool:
        """True if the slave should have touched a wall but did not in at least one of the runs.

        The quantities of the cell are then not shown, because they do not describe the task.
        """
        return any(run.masked for run in self.runs)

    @property
    def is_passive(self) -> bool:
        """True if the control law never generated energy in these runs.

        In that case, the arms never returned more energy to their surroundings (including the
        operators) than they had received. False if a run diverged.
        """
        return self.energy_j is not None and self.energy_j >= PASSIVE_J

    @property
    def energy_j(self) -> float | None:
        """Lowest net energy that the environment had put into the arms at any time, in J.

        The environment consists of the operators, the friction and the wall. The minimum is
        taken over time and over all runs of this cell. A negative value means that the control
        law generated energy: the arms had returned more than they had received. `None` if a run
        diverged.
        """
        values = [run.energy_j for run in self.runs if run.energy_j is not None]
        return min(values) if len(values) == len(self.runs) else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """95 % confidence interval of the share of stable runs, computed with Wilson's method.

        `None` for fewer than `LEAST_SEEDS` runs, because the interval would be too wide to be
        useful.
        """
        if len(self.runs) < LEAST_SEEDS:
            return None
        return wilson_interval(self.stable, len(self.runs))

    def compute_mean(self, quantity: str) -> float | MeanInterval | None:
        """Computes the mean of a measured quantity over the runs, which differ in their seeds.

        Args:
            quantity: Name of the quantity, a key of `QUANTITIES`.

        Returns:
            The mean, with its 95 % confidence interval if there are at least `LEAST_SEEDS`
            runs. `None` if a run lacks the quantity, or if the slave should have touched a wall
            but did not in at least one run.
        """
        values = [getattr(run, quantity) for run in self.runs]
        if None in values or self.masked:
            return None
        if len(values) >= LEAST_SEEDS:
            return MeanInterval.of_values(values)
        return float(np.mean(values))


class BenchResults(Result):
    """Results of the benchmark, or of part of it, for printing, export and search.

    Attributes:
        plan: Plan of the benchmark.
        places: The results of all cells, in the order of the plan.
        runs: All runs, in the same order.
        alone: Maps each reason why runs were not computed side by side with others to the
            number of these runs. Not used in a benchmark that computes all runs one at a time.
    """

    def __init__(
        self,
        plan: BenchPlan,
        runs: dict[tuple[str, int], BenchRun],
        alone: Mapping[str, int] = {},
    ) -> None:
        self.plan = plan
        self.alone = alone
        self.places: list[BenchCellResult] = []
        for cell in plan.cells:
            cell_runs = [_confirm_run(runs, cell, seed) for seed in cell.seeds]
            self.places.append(BenchCellResult(cell, cell_runs))
        self.runs = [run for result in self.places for run in result.runs]

    def blocks(self) -> Iterator[Block]:
        """Yields the sections of the benchmark report.

        The report describes the study and counts the stable runs of each control law. It
        continues with one table of run properties per task, and one table per task and measured
        quantity, such as the error. In the study "round-trips", the last table shows the
        effects of delay and loss.
        """
        yield from _describe_bench(self)
        yield from filter(None, [describe_runs_alone(self.alone, len(self.runs))])
        yield ""
        yield _tabulate_verdicts(self)
        for task in self.plan.tasks:
            yield _tabulate_properties(self, task)
        for task, quantity in _list_quantities(self):
            if quantity != "effort_nm":
                yield ""
                yield f"{task}: {QUANTITIES[quantity]}"
                yield _tabulate_quantity(self, task, quantity)
        if self.plan.study == "round-trips":
            yield _tabulate_round_trips(self)

    def headline(self) -> str:
        """Returns one sentence with the benchmark's name and its number of runs and cells."""
        cells = count_nouns(len(self.places), "cell")
        runs = count_nouns(len(self.runs), "run")
        return f"{self.plan.study}: {cells}, {runs}"

    def to_dict(self) -> dict[str, Any]:
        """Converts the results to plain values that `trilat bench --json` prints.

        Returns:
            The study, the gains that its cells use, and the rows of all cells ("places").
        """
        entries = [
            msgspec.to_builtins(gains) | {"outcome": "settled"}
            for gains in _list_used_gains(self)
        ]
        return {"study": self.plan.study, "gains": entries, "places": self.to_rows()}

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns the results as the rows of the CSV file, one per cell."""
        return list(map(_build_row, self.places))

    def select(self, task: str, law: str = "", link: str = "") -> Iterator[BenchCellResult]:
        """Yields the results of one task, optionally limited to one control law or one link.

        Args:
            task: Name of the task, such as "contact".
            law: Name of the control law. If empty, all laws are selected.
            link: Name of the link. If empty, all links are selected.
        """
        for result in self.places:
            cell = result.cell
            if cell.task == task and law in ("", cell.law) and link in ("", cell.link):
                yield result

    def find(self, task: str, law: str, link: str) -> BenchCellResult | None:
        """Looks up the result of one control law in one task over one network link.

        Args:
            task: Name of the task.
            law: Name of the control law.
            link: Name of the link.

        Returns:
            The result, or `None` if the plan does not contain the cell.
        """
        return next(self.select(task, law, link), None)

    def encode_runs(self) -> str:
        """Encodes the runs of the benchmark as CSV text, with one row per run."""
        cells = {cell.name: cell for cell in self.plan.cells}
        rows = [
            _build_cell_columns(cells[run.name]) | msgspec.to_builtins(run) for run in self.runs
        ]
        return encode_csv(rows, [*_CELL_COLUMNS, *BenchRun.__struct_fields__])

    def build_page(self, command: str, pictures: Mapping[str, str] = {}) -> str:
        """Composes the Markdown page that reports the results of the benchmark.

        Args:
            command: The command that writes the page, quoted at the top.
            pictures: Maps the file name of each picture in the page's folder to the subject of
                the picture.
        """
        parts = [
            f"# The suite: {self.plan.study}",
            f"    {command}",
            "\n".join(f"- {line}" for line in _describe_bench(self)),
            _tabulate_verdicts(self).markdown(),
            f"{OPEN_MARK}: some run is open. {UNSTABLE_MARK}: some run is not stable. "
            "+-: 95 % interval over the seeds of a link.",
        ]

        parts += [f"![{text}]({name})" for name, text in pictures.items()]

        for task in self.plan.tasks:
            parts.append(f"## {task}: properties")
            parts.append(_tabulate_properties(self, task).markdown())

        for task, quantity in _list_quantities(self):
            parts.append(f"## {task}: {QUANTITIES[quantity]}")
            parts.append(_tabulate_quantity(self, task, quantity).markdown())

        if self.plan.study == "round-trips":
            parts.append("## Delay against loss")
            parts.append(_tabulate_round_trips(self).markdown())

        parts.append("## Gains")
        parts.append(_tabulate_gains(self).markdown())
        return "\n\n".join(parts) + "\n"


def _list_used_gains(results: BenchResults) -> list[TunedGains]:
    """Returns the tuned gains used in the simulations, without duplicates.

    Several tasks and network links may share the same gains.
    """
    gains_by_name = {str(cell.tuned): cell.tuned for cell in results.plan.cells}
    return list(gains_by_name.values())


def _confirm_run(runs: dict[tuple[str, int], BenchRun], cell: BenchCell, seed: int) -> BenchRun:
    """Returns a run, or its repetition over twice the duration if there is one.

    A run that is not stable is repeated. The longer run is decisive, and its values are used.

    Args:
        runs: All finished runs, by the name of the cell in the journal and by seed.
        cell: The law, task, link and gains of the runs.
        seed: Random seed of the run.
    """
    run = runs[cell.key, seed]
    if not run.needs_confirmation:
        return run
    repeated = runs.get((name_run(cell.key, run.confirmation_s), seed))
    if repeated is None:
        return run
    return msgspec.structs.replace(
        repeated,
        text=f"of {repeated.length_s:g} s: {repeated.text}",
        confirmed=repeated.stability is Stability.NOT_STABLE,
    )


_PRINTED_LINKS = (
    "rtt8",
    "rtt136",
    "rtt544",
    "rtt1088",
    "rtt136-loss50",
    "4g",
    "5g",
    "geo",
    "trace",
)
"""Links shown in tables when there are too many for the width of a page."""
OPEN_MARK = "?"
"""Mark in a table cell if the stability of at least one run is open."""
UNSTABLE_MARK = "!"
"""Mark in a table cell if at least one run is not stable."""


def _list_quantities(results: BenchResults) -> list[tuple[str, str]]:
    """Lists the tables of measured quantities that are printed for the tasks.

    Args:
        results: Results of the benchmark or of part of it.

    Returns:
        One pair per table, the name of a task that ran and the name of a quantity (a key of
        `QUANTITIES`).
    """
    tasks = results.plan.tasks
    pairs = [(task, quantity) for quantity in _QUANTITIES_OF_ALL for task in tasks]
    for task in tasks:
        pairs += [(task, quantity) for quantity in _QUANTITIES_BY_TASK.get(task, [])]
    return pairs


def name_law(law: str, form: str) -> str:
    """Returns the name of a control law for tables, as in "wave (two sites)".

    The note in parentheses is added if only two arms take part.

    Args:
        law: Name of the control law.
        form: Kind of scenario in which the law runs, a key of `BASES`. The form "three" has two
            users and a slave arm. All other forms have two arms.
    """
    return law if form == "three" else f"{law} (two sites)"


def _tabulate_verdicts(results: BenchResults) -> TextTable:
    """Returns a table with the number of links over which each law is stable, for each task.

    The table has one row per law and one column per task. An entry contains four counts: the
    links over which the law is stable, only settled, open (undecided) and not stable.

    Args:
        results: Results of the suite or of part of it.
    """
    tasks = results.plan.tasks
    rows = []
    for law, form in results.plan.laws:
        cells = [_count_verdicts(results, law, form, task) for task in tasks]
        rows.append([name_law(law, form), *cells])
    verdicts = " / ".join(_JUDGEMENTS)
    return TextTable((f"links: {verdicts}", *tasks), rows, align="lr")


def _count_verdicts(results: BenchResults, law: str, form: str, task: str) -> str:
    """Counts the links over which a law is stable, settled, open and not stable, for a table.

    Args:
        results: Results of the benchmark or of part of it.
        law: Name of the control law.
        form: Kind of scenario in which the law runs, a key of `BASES`.
        task: Name of the task.

    Returns:
        A string such as "12 / 0 / 1 / 3", or the reason why the law did not run in the task.
    """
    judgements = [result.judgement for result in results.select(task, law)]
    if not judgements:
        return explain_no_cell(law, form, task)
    return " / ".join(str(judgements.count(judgement)) for judgement in _JUDGEMENTS)


def _tabulate_properties(results: BenchResults, task: str) -> TextTable:
    """Returns a table of the properties of a task's runs, with one row per law.

    There is one column per property, such as passivity. An entry such as 3/12 means that all
    runs over 3 of the 12 links have the property. Two more columns show the smallest energy,
    and the number of links over which the slave did not touch the wall.

    Args:
        results: Results of the suite or of part of it.
        task: A task that ran.
    """
    headers = (
        task,
        "bounded",
        "passive",
        "least energy, J",
        "converged",
        "stable",
        "no contact",
    )

    rows = []
    for law, form in results.plan.laws:
        name = name_law(law, form)
        law_results = list(results.select(task, law))
        if law_results:
            rows.append([name, *_describe_properties(law_results)])
        else:
            rows.append([name, explain_no_cell(law, form, task)])
    return TextTable(headers, rows, align="lr")


def _describe_properties(law_results: Sequence[BenchCellResult]) -> list[str]:
    """Returns the properties of a control law in a task, as entries of a table row.

    Args:
        law_results: The results of the law in the task, one per link.
    """
    bounded = 0
    passive = 0
    converged = 0
    stable = 0
    masked = 0

    for result in law_results:
        bounded += all(run.bounded for run in result.runs)
        passive += result.is_passive
        converged += all(run.settled_s is not None for run in result.runs)
        stable += result.judgement is Stability.STABLE
        masked += result.masked

    link_count = len(law_results)
    return [
        f"{bounded}/{link_count}",
        f"{passive}/{link_count}",
        _format_least_energy(law_results),
        f"{converged}/{link_count}",
        f"{stable}/{link_count}",
        str(masked),
    ]


def _format_least_energy(law_results: Sequence[BenchCellResult]) -> str:
    """Formats the smallest energy of some results, in J, as a table entry.

    Returns:
        The energy, or a dash if all cells contain a run that diverged.
    """
    energies_j = [result.energy_j for result in law_results if result.energy_j is not None]
    if not energies_j:
        return "-"
    least_j = min(energies_j)
    if least_j >= -1e-9:
        # A negative energy this small is a rounding error of the sum over a run.
        least_j = 0.0
    return f"{least_j:.2g}"


def _tabulate_quantity(results: BenchResults, task: str, quantity: str) -> TextTable:
    """Returns a table of the mean of a quantity, with one row per law and one column per link.

    The mean is taken over the runs with different random seeds. An entry is marked if not all
    of its runs are stable. A law that cannot run in the task has no row. If there are many
    links, only some of them have a column.

    Args:
        results: Results of the benchmark or of part of it.
        task: Name of a task that ran.
        quantity: Name of the quantity, a key of `QUANTITIES`.
    """
    links = results.plan.links
    if len(links) > len(_PRINTED_LINKS):
        links = [link for link in links if link in _PRINTED_LINKS]
    rows = []
    for law, form in results.plan.laws:
        reason = explain_no_cell(law, form, task)
        if reason == "-":
            continue
        row = [name_law(law, form)]
        for link in links:
            result = results.find(task, law, link)
            row.append(reason if result is None else _describe_result(result, quantity))
        rows.append(row)
    return TextTable((task, *links), rows, align="lr")


def _describe_result(result: BenchCellResult, quantity: str) -> str:
    """Returns the table entry for the mean of a quantity, or the reason why there is no mean.

    Args:
        result: The result of a cell.
        quantity: A key of `QUANTITIES`.
    """
    marks = {Stability.NOT_STABLE: UNSTABLE_MARK, Stability.OPEN: OPEN_MARK}
    mark = marks.get(result.judgement, "")
    if result.masked:
        return f"no contact{mark}"
    if any(run.behaviour is EndBehaviour.DIVERGED for run in result.runs):
        return f"diverged{mark}"

    mean = result.compute_mean(quantity)
    if mean is None:
        if quantity == "settled_s":
            longest_s = max(run.length_s for run in result.runs)
            return f"not within {longest_s:g}{mark}"
        return mark or "none"
    text = str(mean) if isinstance(mean, MeanInterval) else f"{mean:.4g}"
    return text + mark


def _tabulate_round_trips(results: BenchResults) -> TextTable:
    """Returns a table that shows how the error of each law grows with delay and with losses.

    Each row is a task and a control law. The columns are the error at the shortest round trip,
    the ratio of the error at the longest round trip to that at the shortest, and the ratio of
    the error with losses to that without. The study "round-trips" repeats a published study
    that reports the same effects.

    Args:
        results: Results of the benchmark or of part of it.
    """
    rows = []
    for task in results.plan.tasks:
        for law, _ in results.plan.laws:
            short = _find_error(results, task, law, "rtt8")
            medium = _find_error(results, task, law, "rtt272")
            long = _find_error(results, task, law, "rtt1088")
            lossy = _find_error(results, task, law, "rtt272-loss50")
            rows.append(
                [
                    task,
                    law,
                    format_number(short, 4),
                    _format_ratio(long, short),
                    _format_ratio(lossy, medium),
                ]
            )
    headers = (
        "task",
        "law",
        "error at 8 ms, rad",
        "1088 ms / 8 ms",
        "272 ms, half lost / none lost",
    )
    return TextTable(headers, rows, align="llr")


def _find_error(results: BenchResults, task: str, law: str, link: str) -> float | None:
    """Returns the mean position error of a law in a task over a link, in rad.

    `None` if the law did not run over this link, or if an arm left its limits or did not touch
    the wall.
    """
    result = results.find(task, law, link)
    mean = None if result is None else result.compute_mean("error_rad")
    return mean.mean if isinstance(mean, MeanInterval) else mean


def _format_ratio(numerator: float | None, denominator: float | None) -> str:
    """Formats the ratio of two means as a table entry with three digits.

    The entry is "-" if a mean is missing or the denominator is 0.
    """
    if numerator is None or not denominator:
        return "-"
    return f"{numerator / denominator:.3g}"


def _describe_bench(results: BenchResults) -> Iterator[str]:
    """Yields lines that introduce the results.

    They state the study, the number of runs, the tasks, and the laws that did not run.

    Args:
        results: Results of the suite or of part of it.
    """
    plan = results.plan
    cells = count_nouns(len(plan.cells), "cell")
    runs = count_nouns(len(results.runs), "run")
    seeds = max(len(cell.seeds) for cell in plan.cells)
    yield f"{plan.study}: {STUDIES[plan.study].about}"
    yield f"{cells}, {runs}: one per cell without randomness, otherwise {seeds}"

    unstable = [run for run in results.runs if run.stability is Stability.NOT_STABLE]
    diverged = sum(run.behaviour is EndBehaviour.DIVERGED for run in unstable)
    confirmed = sum(bool(run.confirmed) for run in unstable)
    refuted = sum(run.confirmed is False for run in results.runs)
    yield (
        f"not stable: {count_nouns(len(unstable), 'run')}, of which {diverged} diverged; runs "
        f"of twice the length confirmed {confirmed}, and refuted {refuted} more"
    )
    limited = sum(run.at_limit for run in results.runs)
    if limited:
        yield f"ended by the safety limit of ticks: {count_nouns(limited, 'run')}"

    for task in plan.tasks:
        yield f"{task}: {TASKS[task].about}"
    for law, form in plan.laws:
        if form == "two":
            yield f"{law} is a law for two sites: it runs only in the tasks for one user"
    if plan.without:
        names = ", ".join(map(str, plan.without))
        yield f"no runs, because no candidate was stable at the pose with the margin: {names}"


def _tabulate_gains(results: BenchResults) -> TextTable:
    """Returns a table of the gains of each law at each round trip, and how they were selected.

    The column "stable" shows the number of stable candidates and of all candidates. The column
    "without margin" counts the candidates that had smaller errors but were rejected because
    they are not stable when delays grow.

    Args:
        results: Results of the suite or of part of it.
    """
    tunings = {str(gains): gains for gains in _list_used_gains(results)}
    tunings |= {str(gains): gains for gains in results.plan.without}
    rows = []
    for tuned in tunings.values():
        gains = ", ".join(f"{name} {value:g}" for name, value in tuned.gains.items())
        rows.append(
            [
                name_law(tuned.law, tuned.form),
                str(tuned.round_trip_ms),
                gains or "none",
                f"{tuned.settled}/{tuned.tried}",
                str(tuned.passed),
            ]
        )
    headers = ("law", "tuned at, ms", "gains", "stable", "without margin")
    return TextTable(headers, rows, align="lrlrr")


_FORMER_KEYS = ("reflected", "reflected_half", "observed", "least_j")
"""Keys of quantities that are no longer measured.

They remain in the JSON with the value null, because keys are never removed
(docs/reference/json.md).
"""
_CELL_COLUMNS = ("task", "law", "link", "form")


def _build_cell_columns(cell: BenchCell) -> dict[str, Any]:
    """Returns the columns that identify a cell in a table: task, law, link and form.

    The form is the kind of scenario: how many arms, and whether gravity acts on them.
    """
    return {name: getattr(cell, name) for name in _CELL_COLUMNS}


def _build_row(result: BenchCellResult) -> dict[str, Any]:
    """Returns the results of one cell as a table row for JSON and CSV.

    The row contains verdicts, and means with intervals. Values that do not exist are `None`,
    for example the force of the wall in a task without a wall.

    Args:
        result: Results of the cell.
    """
    share_low = None
    share_high = None
    if result.interval is not None:
        share_low, share_high = result.interval
    row = _build_cell_columns(result.cell)
    row["runs"] = len(result.runs)
    for stability in Stability:
        row[stability.value.replace(" ", "_")] = result.count(stability)
    row["share_low"] = share_low
    row["share_high"] = share_high

    for quantity in QUANTITIES:
        mean = result.compute_mean(quantity)
        if isinstance(mean, MeanInterval):
            row[quantity] = mean.mean
            row[f"{quantity}_half"] = mean.half
        else:
            row[quantity] = mean
            row[f"{quantity}_half"] = None

    row |= dict.fromkeys(_FORMER_KEYS)  # with the value None
    row |= {
        "judgement": result.judgement.value,
        "bounded": all(run.bounded for run in result.runs),
        "energy_j": result.energy_j,
        "length_s": max(run.length_s for run in result.runs),
        "contact": not result.masked,
        "confirmed": sum(run.confirmed is True for run in result.runs),
        "refuted": sum(run.confirmed is False for run in result.runs),
    }
    return row
