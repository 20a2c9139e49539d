"""Six commands agree about every run, because one function decides for all of them."""

import csv
import json
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from trilat_studies.bench import plan_bench
from trilat_studies.bench.bench_run import BenchRunItem, JudgedRun
from trilat_studies.sweep.sweep_cell import classify_cell

import trilat_net as tn
from tests.certificate.drawn_loops import draw_experiment
from tests.cli.running import trilat
from trilat_net.analysis.judge import certify_run
from trilat_net.analysis.run_end import Stability
from trilat_net.analysis.theory.linear_analysis import LinearAnalysis
from trilat_net.analysis.twins.twin_growth import PushedTwins, TwinGrowth
from trilat_net.scenario import Scenario, load_scenario

DRAWN_S = 10.0
"""Duration of a drawn run. A shorter run has other words, but the same ones by every command."""
SHIPPED_S = 8.0
"""Largest duration of the run of a shipped scenario."""
THEOREM = "the theorem (continuous time; every premise checked here holds)"
"""A basis that needs all records of a run. A sweep and a bench keep them only where nothing else decides."""
SAME_RATE = 1e-6
"""Largest difference of the rates of one root, relative and in 1/s: 2 or 6 roots are computed."""
SIMPLE_SEEDS = (0, 5, 13, 31, 2001, 2013)
"""Seeds for `make test`: noise, growth, an adaptive law, a long period, a wall."""
BLOCK = 50
SEEDS = (*range(250), *range(2000, 2250))
BLOCKS = [SEEDS[first : first + BLOCK] for first in range(0, len(SEEDS), BLOCK)]


class Statement(NamedTuple):
    """What a command says about a run.

    Attributes:
        command: Name of the command.
        word: The decision about the whole run. Empty if the command makes none.
        rests_on: What the decision rests on.
        roots: Verdict on small motions: "stable", "unstable", "at the edge", or empty.
        rate_per_s: Real part of the slowest root, in 1/s. None without roots.
        pushes: Growth of every push as (push, joint, trend, rate in 1/s). None without twins.
        is_about_run: False if the command states that its verdict is about a rest to which the
            run does not come.
    """

    command: str
    word: str = ""
    rests_on: str = ""
    roots: str = ""
    rate_per_s: float | None = None
    pushes: list[tuple[str, ...]] | None = None
    is_about_run: bool = True

    @property
    def says_stable(self) -> bool:
        """True if the command says that the run or its small motions are stable."""
        return self.is_about_run and (self.word or self.roots) == "stable"

    @property
    def says_unstable(self) -> bool:
        """True if the command says the opposite."""
        return self.is_about_run and (self.word or self.roots) in ("not stable", "unstable")


def list_pushes(growth: TwinGrowth) -> list[tuple[str, ...]]:
    """Returns the growth of every push, with rates as texts, so that NaN equals itself."""
    return [
        (push.push.name, push.joint, push.trend.name, f"{push.rate_per_s:.9g}")
        for push in growth.pushes
    ]


def _strip_basis(rests_on: str) -> str:
    """Returns a basis without what only a log shows.

    That is the theorem, which may precede the basis, and which joint diverged and how.
    """
    if rests_on.startswith("diverged: "):
        return "diverged"
    return rests_on.removeprefix(THEOREM).removeprefix("; ")


def list_statements(scenario: Scenario) -> list[Statement]:
    """Returns what the functions behind the commands say about the run of a scenario."""
    log = tn.simulate(scenario)
    certificate = certify_run(log)
    roots = certificate.roots
    twins = certificate.twins
    assert roots is not None
    assert twins is not None
    decision = certificate.decision
    certified = Statement(
        command="certify",
        word=decision.stability.value,
        rests_on=_strip_basis(decision.rests_on),
        roots=roots.verdict,
        rate_per_s=roots.rate_per_s,
        pushes=list_pushes(twins),
    )
    cell = classify_cell(scenario.text, scenario.duration_s)
    swept = Statement("sweep", cell.stability, _strip_basis(cell.rests_on))
    suite_run = JudgedRun.simulate(scenario, scenario.duration_s)
    benched = Statement(
        command="bench",
        word=suite_run.stability.value,
        rests_on=_strip_basis(suite_run.rests_on),
        roots=suite_run.roots.verdict,
        rate_per_s=suite_run.roots.rate_per_s,
    )
    statements = [certified, swept, benched]
    if roots.verdict:
        analysis = LinearAnalysis.compute(scenario)
        root = analysis.decisive.rightmost
        linear = Statement(
            command="linear",
            roots=analysis.verdict,
            rate_per_s=None if root is None else root.s.real,
            is_about_run=not analysis.is_far_from_rest,
        )
        assert linear.is_about_run or any(
            "away from this rest" in note for note in analysis.notes
        )
        statements.append(linear)
    if not twins.why:
        growth = PushedTwins.of_log(log).growth
        statements.append(Statement("twin", pushes=list_pushes(growth)))
    assert (
        cell.verdict.stable
        is {
            Stability.STABLE: True,
            Stability.SETTLED: True,
            Stability.NOT_STABLE: False,
            Stability.OPEN: None,
        }[decision.stability]
    )
    return statements


def find_disagreement(statement: Statement, other: Statement) -> str:
    """Returns in which way two commands disagree about a run. Empty if they agree."""
    both = f"{statement}, {other}"
    if (
        statement.word
        and other.word
        and (statement.word, statement.rests_on) != (other.word, other.rests_on)
    ):
        return f"words: {both}"
    if statement.roots and other.roots and statement.roots != other.roots:
        return f"verdicts on small motions: {both}"
    if statement.rate_per_s is not None and other.rate_per_s is not None:
        tolerance_per_s = SAME_RATE * (1.0 + abs(statement.rate_per_s))
        if abs(statement.rate_per_s - other.rate_per_s) > tolerance_per_s:
            return f"rates: {both}"
    if (
        statement.pushes is not None
        and other.pushes is not None
        and statement.pushes != other.pushes
    ):
        return f"pushes: {both}"
    if (statement.says_stable and other.says_unstable) or (
        statement.says_unstable and other.says_stable
    ):
        return f"contradiction: {both}"
    return ""


def find_disagreements(name: str, scenario: Scenario) -> list[str]:
    """Compares all commands pairwise about the run of a scenario."""
    pairs = combinations(list_statements(scenario), 2)
    return [f"{name}: {text}" for text in (find_disagreement(*pair) for pair in pairs) if text]


def draw_short(seed: int) -> Scenario:
    """Returns a drawn scenario with a shorter run."""
    return msgspec.structs.replace(draw_experiment(seed).scenario, duration_s=DRAWN_S)


@pytest.mark.parametrize(
    "seeds",
    [
        pytest.param(SIMPLE_SEEDS, id="sample"),
        *(
            pytest.param(block, id=f"{block[0]}-{block[-1]}", marks=pytest.mark.long)
            for block in BLOCKS
        ),
    ],
)
@pytest.mark.push
def test_commands_agree_on_drawn_runs(seeds: tuple[int, ...]) -> None:
    """Every two commands agree on every run.

    Commands agree if all of the following holds:

    - Those that judge a whole run, `certify`, the report, `compare`, `sweep` and `bench`, give
      the same word and the same basis (`rests_on`). The report and `compare` call the function
      of `certify` (see `test_commands_themselves_agree`). Where roots or a law's own condition
      decide, a sweep and a bench keep no records and so do not name the theorem, whose function
      V needs all of them: that phrase may precede the common basis. A sweep is compared at its
      longest duration.
    - `linear` states the verdict on small motions and the rate of the slowest root that the
      roots of the certificate have. If these do not exist, `linear` says why, or analyses
      another rest, and states which: it is not compared.
    - `twin` states the same growth of every push as the twins of the certificate.
    - No command says "stable" where another one says "unstable" or "not stable". `linear` says
      of a rest to which the run does not come that its verdict is not about the run.
    """
    disagreements = [
        text for seed in seeds for text in find_disagreements(str(seed), draw_short(seed))
    ]
    assert disagreements == []


@pytest.mark.parametrize(
    "name",
    [
        "p_d_margin_two",
        "contact",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in tn.list_shipped()
            if name not in ("p_d_margin_two", "contact")
        ),
    ],
)
@pytest.mark.push
def test_commands_agree_on_shipped_scenarios(name: str) -> None:
    shipped = load_scenario(name)
    scenario = msgspec.structs.replace(shipped, duration_s=min(SHIPPED_S, shipped.duration_s))
    assert find_disagreements(name, scenario) == []


DAMPING = ("0.7", "2.5")
"""Of P+d with 10 N m/rad over 200 ms: one unstable loop, one stable loop."""
RUN = ("--set", "rate_hz=100", "--duration", "12")
LINEAR = ("--set", "rate_hz=100", "--set", "duration_s=12")


def read_statement(folder: Path, *command: str) -> Any:
    """Runs a command, and returns what it prints as JSON."""
    return json.loads(trilat(*command, "--json", cwd=folder).out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a log for each damping, and a sweep of both."""
    folder = tmp_path_factory.mktemp("commands")
    for d in DAMPING:
        settings = ("--set", f"control.d={d}")
        trilat("sim", "p_d_margin", *RUN, *settings, "-o", f"{d}.mcap", cwd=folder)
    over = f"control.d={','.join(DAMPING)}"
    options = ("--longest", "12", "--jobs", "1", "-o", "sweep")
    trilat("sweep", "p_d_margin", *RUN, "--over", over, *options, cwd=folder).succeeds()
    return folder


@pytest.mark.push
def test_commands_themselves_agree(folder: Path) -> None:
    """The commands print the statements of the functions above, as far as JSON and tables contain them."""
    with (folder / "sweep" / "results.csv").open(encoding="utf-8") as stream:
        cells = list(csv.DictReader(stream))
    compared = read_statement(folder, "compare", *(f"{d}.mcap" for d in DAMPING))
    said = set()
    for d, cell in zip(DAMPING, cells, strict=True):
        certified = read_statement(folder, "certify", f"{d}.mcap")
        said.add(certified["stability"])
        assert (cell["stability"], cell["rests_on"]) == (
            certified["stability"],
            certified["rests_on"],
        )
        judgement, *_ = compared["remarks"][d]
        assert judgement.startswith(f"{certified['stability']}: ")
        assert f"rests on: {certified['rests_on']}" in judgement

        linear = read_statement(
            folder, "linear", "p_d_margin", "--set", f"control.d={d}", *LINEAR, "--no-ports"
        )
        roots = certified["roots"]
        assert linear["verdict"] == roots["verdict"]
        slowest = linear["as_computed"]["roots"][0]["re_per_s"]
        assert slowest == pytest.approx(roots["rate_per_s"], rel=SAME_RATE, abs=SAME_RATE)

        pushed = read_statement(folder, "twin", f"{d}.mcap")["pushes"]
        without_text = [{key: row[key] for key in row if key != "text"} for row in pushed]
        assert without_text == certified["twins"]["pushes"]
    assert said == {"not stable", "stable"}


@pytest.mark.long
def test_a_report_agrees_with_its_certificate(folder: Path) -> None:
    name = f"{DAMPING[0]}.mcap"
    certified = read_statement(folder, "certify", name)
    verdict = read_statement(folder, "report", name)["verdict"]
    assert verdict.startswith(f"{certified['stability']}: ")
    assert f"rests on: {certified['rests_on']}" in verdict


@pytest.mark.long
def test_a_suite_run_agrees_with_its_certificate() -> None:
    """The run may have been made longer, and its certificate follows that length."""
    plan = plan_bench(
        laws=["p_d"], study="round-trips", tasks=["free"], links=["rtt8"], seeds=1
    )
    cell = plan.cells[0]
    suite_run = BenchRunItem(cell, 1).run()
    scenario = msgspec.structs.replace(cell.build(1).scenario, duration_s=suite_run.length_s)
    decision = certify_run(tn.simulate(scenario)).decision
    assert suite_run.stability is decision.stability
    assert suite_run.text in ("; ".join(decision.reasons), decision.rests_on)
