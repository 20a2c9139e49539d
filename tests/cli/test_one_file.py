"""A command and its study are one file: the program finds a command that was put beside the others."""

from pathlib import Path

from tests.dropped_files import put_beside, run_in_folder

STUDY = '''
"""How far the slave lags for each seed, kept in a journal."""

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from ...presentation import terminal_output as terminal
from ...presentation.result_text import TextTable
from ...work.executor import WorkerPool
from ...work.run_journal import RunJournal
from . import options


class Lag(msgspec.Struct, frozen=True):
    """The lag of one seed."""

    cell: str
    seed: int
    rms_error_rad: float


def measure_lag(item):
    """Measures one seed."""
    from ... import metrics, simulate

    scenario, seed = item
    found = metrics(simulate(scenario, {"duration_s": 0.2}, seed=seed))
    return Lag(scenario, seed, found.sites["s"]["rms_error_rad"].value)


@options.command("paper --seeds 3")
def lag_command(
    scenario: options.ScenarioArgument,
    seeds: Annotated[int, options.value("--seeds", "N", "How many.")] = 3,
    as_json: options.JsonOption = False,
) -> None:
    """Measures how far the slave lags, seed by seed."""
    with RunJournal(Path("lag.jsonl"), scenario, Lag, "make room") as journal, WorkerPool.open(1) as pool:
        left = [(scenario, seed) for seed in range(seeds) if (scenario, seed) not in journal.done]
        journal.run_pending(pool, measure_lag, left, seeds - len(left), seeds, lambda *_, **__: None)
        rows = {str(one.seed): one.rms_error_rad for one in journal.done.values()}
    terminal.print_json({"made": len(left), "rows": rows})
'''
LOOK = """
import contextlib, io, json, os, sys
os.environ["COLUMNS"] = "200"
sys.path.insert(0, sys.argv[1])
from trilat_net.app.cli import app

def run(*words):
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        app(words, standalone_mode=False)
    return said.getvalue()

print(json.dumps({
    "listed": run("--help"),
    "help": run("lag", "--help"),
    "first": json.loads(run("lag", "two_sites", "--seeds", "2", "--json")),
    "again": json.loads(run("lag", "two_sites", "--seeds", "3", "--json")),
}))
"""


def test_an_added_file_is_command_and_study(tmp_path: Path) -> None:
    put_beside(tmp_path, "app/cli", "lag.py", STUDY)
    output = run_in_folder(LOOK, tmp_path)
    assert "Measures how far the slave lags, seed by seed." in output["listed"]
    assert "lag" in output["listed"].partition("─ Make your own ─")[2]
    assert "Example: trilat lag paper --seeds 3" in output["help"]
    assert output["first"]["made"] == 2
    assert output["again"]["made"] == 1  # the journal has the others
    assert set(output["first"]["rows"]) < set(output["again"]["rows"]) == {"0", "1", "2"}
