"""A sweep that is killed, again and again, comes to the same end, and makes no run twice."""

import random
import re
import signal
from pathlib import Path

import msgspec
import pytest

from tests.cli.running import trilat
from trilat_net.studies.sweep import open_sweep_folder, read_results
from trilat_net.studies.sweep.sweep_folder import JOURNAL_FILE

from .killing import begun, ended_at, lines
from .quick import SHORT

OPTIONS = ("--over", "control.Kd=1:4:0.1", "--over", "link.loss=0,0.1", "--seeds", "2", "--longest", "8")
RUNS = 31 * 3
LONGER = SHORT.replace("rate_hz = 100", "rate_hz = 500").replace("duration_s = 0.5", "duration_s = 8.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scenario, and the results of a sweep that nothing interrupted, in one process."""
    path = tmp_path_factory.mktemp("killed")
    (path / "trio.toml").write_text(LONGER)
    trilat("sweep", "trio.toml", *OPTIONS, "-o", "whole", "--jobs", "1", cwd=path).succeeds()
    return path


def keys(journal: Path) -> list[tuple[int, int]]:
    """The runs whose lines are whole, as often as they stand there."""
    whole = [line for line in journal.read_bytes().splitlines() if re.fullmatch(rb"{.*}\t[0-9a-f]{8}", line)]
    found = [msgspec.json.decode(line.partition(b"\t")[0]) for line in whole]
    return [(one["cell"], one["seed"]) for one in found]


def test_killed_at_random_and_resumed_it_comes_to_the_same_bytes(folder: Path) -> None:
    """SIGKILL to all its processes; two of them, where the whole one had one."""
    chance = random.Random(6)
    killed = 0
    done = 0
    for _ in range(3):
        resumed = ("--resume", "parts") if (folder / "parts").exists() else ()
        process = begun(folder, *(resumed or ("trio.toml", *OPTIONS, "-o", "parts")), "--jobs", "2")
        err = ended_at(process, folder / "parts", done + chance.randint(1, 18), signal.SIGKILL)
        killed += process.returncode == -signal.SIGKILL
        assert "Traceback" not in err
        before, done = done, lines(folder / "parts")
        assert done >= before
    assert killed >= 2
    assert not (folder / "parts" / "results.parquet").exists()
    text = trilat("sweep", "--resume", "parts", "--jobs", "2", cwd=folder).succeeds()
    assert f"{done} runs are done already" in text
    whole = (folder / "whole" / "results.parquet").read_bytes()
    assert (folder / "parts" / "results.parquet").read_bytes() == whole
    made = keys(folder / "parts" / JOURNAL_FILE)
    assert len(made) == len(set(made)) == RUNS


def test_ctrl_c_keeps_what_is_done_and_says_how_to_go_on(folder: Path) -> None:
    process = begun(folder, "trio.toml", *OPTIONS, "-o", "stopped", "--jobs", "2")
    err = ended_at(process, folder / "stopped", 12, signal.SIGINT)
    assert process.returncode == 130, err
    with open_sweep_folder(folder / "stopped").journal() as journal:
        kept = len(journal.done)
    assert err.splitlines() == [
        f"{kept} runs are done and kept; go on with: trilat sweep --resume stopped",
        "interrupted",
    ]
    assert 12 <= kept < RUNS
    text = trilat("sweep", "trio.toml", *OPTIONS, "-o", "stopped", cwd=folder).succeeds()
    assert f"{kept} runs are done already" in text
    assert read_results(folder / "stopped").rows == read_results(folder / "whole").rows
