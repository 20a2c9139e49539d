"""Judges seeds on all cores: `python -m tests.faults`.

With --write the matrix of faults is made (docs/data/fault-matrix.csv), with its evidence: sessions and tests of each
fault (docs/data/faults.csv), how often each event came about (docs/data/fault-counts.csv), and how far torques
stepped (docs/data/fault-torques.txt). What came of the seeds is written to docs/reference/faults.md.
"""

import argparse
import csv
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from tests.faults.fault_session import make_fault_scenario

from .fault_matrix import LIVE, ROWS, Row
from .invariants import allowed_step
from .judged_seed import Judged, find_undisturbed_step, time_seed

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "faults.md"
MATRIX = ROOT / "docs" / "data" / "fault-matrix.csv"
TESTS = ROOT / "docs" / "data" / "faults.csv"
COUNTS = ROOT / "docs" / "data" / "fault-counts.csv"
TORQUES = ROOT / "docs" / "data" / "fault-torques.txt"
BEGIN = "<!-- made by python -m tests.faults --write -->"
END = "<!-- end -->"


class Seeds(NamedTuple):
    """What came of some seeds.

    Attributes:
        judged: each.
        took_s: what they took of a processor, s.
    """

    judged: Sequence[Judged]
    took_s: float

    @property
    def failed(self) -> list[tuple[int, Judged]]:
        return [
            (seed, judged_seed)
            for seed, judged_seed in enumerate(self.judged)
            if judged_seed.violations
        ]

    def of(self, kind: str) -> list[Judged]:
        if kind == "several":
            return [judged_seed for judged_seed in self.judged if len(judged_seed.faults) > 1]
        return [
            judged_seed
            for judged_seed in self.judged
            if kind in {fault.kind for fault in judged_seed.faults}
        ]


def judge_seeds(count: int, jobs: int | None) -> Seeds:
    judged = []
    took_s = 0.0
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for seed, (judged_seed, seed_s) in enumerate(
            pool.map(time_seed, range(count), chunksize=4)
        ):
            judged.append(judged_seed)
            took_s += seed_s
            if judged_seed.violations:
                print(f"seed {seed}:\n{judged_seed}\n", flush=True)
    return Seeds(judged, took_s)


def find_tests(wanted: Sequence[str]) -> list[str]:
    files = {
        path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
        for path in (ROOT / LIVE).glob("test_*.py")
    }
    names = []
    for name in wanted:
        if "/" in name:
            names.append(name)
            continue
        (file,) = (file for file, text in files.items() if f"def test_{name}(" in text)
        names.append(f"{file}::test_{name}")
    return names


def run_tests(names: Sequence[str]) -> dict[str, str]:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-rA",
        "-p",
        "no:cacheprovider",
        *dict.fromkeys(names),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    ends: dict[str, set[str]] = {}
    for word, name in re.findall(
        r"^(PASSED|FAILED|ERROR|SKIPPED) (\S+)", done.stdout, re.MULTILINE
    ):
        for listed in names:
            if name.startswith(listed):
                ends.setdefault(listed, set()).add(word)
    bad = {"FAILED", "ERROR"}
    return {name: "failed" if bad & bad_tests else "passed" for name, bad_tests in ends.items()}


class Evidence(NamedTuple):
    """What shows that a session bears a fault as required.

    Attributes:
        row: the fault.
        sessions: how many seeds made it.
        broken: in how many of these an invariant was violated.
        results: by test what became of it; "not run" where nothing did.
    """

    row: Row
    sessions: int
    broken: int
    results: dict[str, str]

    @property
    def holds(self) -> bool:
        return not self.broken and set(self.results.values()) <= {"passed"}


def find_evidence(row: Row, seeds: Seeds, ends: dict[str, str]) -> Evidence:
    sessions = [judged_seed for kind in row.kinds for judged_seed in seeds.of(kind)]
    broken = sum(bool(session.violations) for session in sessions)
    names = find_tests((*row.virtual, *row.real))
    results = {name: ends.get(name, "not run") for name in names}
    return Evidence(row, len(sessions), broken, results)


def describe_row(evidence: Evidence) -> tuple[str, str, str, str]:
    """Returns the row of the matrix: number, fault, what must happen, what was not tried."""
    row = evidence.row
    gap = row.gap if evidence.holds else "does not hold"
    return row.mark, row.fault, row.required, gap


def list_evidence(evidence: Evidence) -> list[tuple[str, str, str]]:
    """Returns the rows of the file of evidence: fault, what shows it, result."""
    row = evidence.row
    seeds = f"{evidence.sessions} sessions in virtual time"
    rows = [(row.mark, seeds, f"{evidence.broken} violations")] if row.kinds else []
    return rows + [(row.mark, name, result) for name, result in evidence.results.items()]


def write_table(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def describe_seeds(seeds: Seeds) -> list[str]:
    holds = [ticks for judged_seed in seeds.judged for ticks in judged_seed.holds]
    each_s = seeds.took_s / len(seeds.judged)
    count = len(seeds.judged)
    broken = len(seeds.failed)
    most = max(holds, default=0)
    return [
        f"{count} seeds, {broken} with a violation. Each takes {each_s:.1f} s of a processor: two sessions of "
        f"5 s, of which the second must give the same bytes. Held {len(holds)} times: at most {most} ticks "
        "after the last sample that came into use.",
    ]


def count_visits(seeds: Seeds) -> list[tuple[str, int]]:
    """Returns what sessions came by (modes, events, faults, what was dropped), each with its count."""
    visited: Counter[str] = sum(
        (judged_seed.visited for judged_seed in seeds.judged), Counter()
    )
    return sorted(visited.items())


def describe_torques(seeds: Seeds) -> str:
    """Returns lines about the largest steps of torques, and about the change of the storage at rest."""
    steps: dict[str, float] = {}
    for judged_seed in seeds.judged:
        for mode, step_nm in judged_seed.steps_nm.items():
            steps[mode] = max(steps.get(mode, 0.0), step_nm)
    stepped = ", ".join(f"{mode} {step_nm:.3g}" for mode, step_nm in sorted(steps.items()))
    undisturbed_nm = find_undisturbed_step()
    allowed_nm = allowed_step(make_fault_scenario(), undisturbed_nm)
    at_rest_j, before_j = (
        max(judged_seed.rises_j[mode_index] for judged_seed in seeds.judged)
        for mode_index in (0, 1)
    )
    return (
        f"Largest step of a torque in a tick, N m: {stepped} (`start`: the first 0.1 s of every start). "
        f"Allowed are {allowed_nm:.3g}, the larger of the limit of its rate and 1.1 times the "
        f"{undisturbed_nm:.3g} of the session without faults. The storage of an arm that comes to rest "
        f"changes in a tick by at most {at_rest_j:.2g} J once its reference rests; before, less the work of "
        f"that, by at most {before_j:.2g} J."
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=200, help="how many")
    parser.add_argument(
        "--write",
        action="store_true",
        help="run the matrix's tests too, and write docs/data and docs/reference/faults.md",
    )
    parser.add_argument("--jobs", type=int, help="processes at a time; all cores if left out")
    arguments = parser.parse_args()
    seeds = judge_seeds(arguments.seeds, arguments.jobs)
    lines = describe_seeds(seeds)
    torques = describe_torques(seeds)
    print("\n".join([*lines, "", torques]))
    if arguments.write:
        ends = run_tests(
            find_tests([name for row in ROWS for name in (*row.virtual, *row.real)])
        )
        all_evidence = [find_evidence(row, seeds, ends) for row in ROWS]
        write_table(
            MATRIX,
            ("number", "fault", "what must happen", "not tried"),
            [describe_row(evidence) for evidence in all_evidence],
        )
        write_table(
            TESTS,
            ("fault", "evidence", "result"),
            [line for evidence in all_evidence for line in list_evidence(evidence)],
        )
        write_table(COUNTS, ("event", "count"), count_visits(seeds))
        TORQUES.write_text(torques + "\n", "utf-8")
        text = PAGE.read_text("utf-8")
        before, _, rest = text.partition(BEGIN)
        block = "\n".join([BEGIN, "", *lines, "", END])
        PAGE.write_text(before + block + rest.partition(END)[2], "utf-8")
        print(
            "\n".join(
                " | ".join(describe_row(row_found))
                for row_found in all_evidence
                if not row_found.holds
            )
        )
    return int(bool(seeds.failed))


if __name__ == "__main__":
    sys.exit(main())
