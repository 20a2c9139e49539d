"""No command writes through a symbolic link that somebody planted in place of its outputs."""

import shutil
from pathlib import Path

import pytest
from study_builders import SHORT

from .running import shorten, trilat

LAW = ["--law", "p_d", "--budget", "4", "--jobs", "1", "--duration", "2", "--out", "fronts"]
SWEEP = ["--over", "link.delay_ms=0:20:20", "--jobs", "1", "-o", "swept"]
BENCH = [
    "--study",
    "round-trips",
    "--task",
    "contact",
    "--law",
    "p_d",
    "--link",
    "rtt8",
    "--jobs",
    "1",
]
FORCED = [
    ["sim", "two_sites", "--duration", "0.05", "-o", "out.mcap"],
    ["scenario", "new", "mine.toml"],
    ["new", "law", "mylaw.py"],
    ["new", "hand", "myhand.py"],
    ["new", "plant", "myplant.py"],
    ["experiment", "new", "mine.toml"],
    ["trace", "import", "ping", "ping.txt"],
    ["rerun", "run.mcap", "--replace", "s", "--set", "control.Kd=5", "-o", "again.mcap"],
    ["log", "recover", "run.mcap", "-o", "whole.mcap"],
    ["log", "sign", "run.mcap", "--key", "lab.key"],
    ["log", "export", "run.mcap", "--to", "csv", "-o", "tables"],
    ["log", "export", "run.mcap", "--to", "npz", "-o", "tables.npz"],
    ["log", "export", "run.mcap", "--to", "ros2", "-o", "bag.mcap"],
    ["figure", "run.mcap", "positions", "--format", "png"],
    ["figure", "run.mcap", "positions", "--format", "png", "-o", "drawn"],
    ["twin", "run.mcap", "-o", "twin.png"],
    ["linear", "two_sites", "--figure", "linear.png"],
]
SLOW = [
    ["report", "run.mcap"],
    ["report", "run.mcap", "-o", "page"],
    ["compare", "--tune", "trio.toml", *LAW],
]
CONTINUED = [
    ["test", "two_sites", "--junit", "junit.xml", "--jobs", "1"],
    ["sweep", "trio.toml", *SWEEP, "--map"],
    ["bench", *BENCH],
    ["experiment", "run", "reaching.toml", "--jobs", "1", "-o", "experiment"],
    ["experiment", "analyse", "experiment"],
    ["keys", "new", "keys", "m1", "s"],
    ["keys", "pair", "other"],
]
"""Commands without --force: most continue what is in their folder."""
QUICK = ("sim", "scenario", "new", "rerun", "trace")
CASES = [
    *([*command, "--force"] for command in FORCED),
    *([*command, "--force"] for command in SLOW),
    *CONTINUED,
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    trilat("sim", "two_sites", "--duration", "0.2", "-o", "run.mcap", cwd=folder).succeeds()
    (folder / "trio.toml").write_text(SHORT)
    rows = (
        f"[{n}.5] 64 bytes from 192.0.2.1: icmp_seq={n} ttl=64 time=1{n}.5 ms"
        for n in range(1, 9)
    )
    (folder / "ping.txt").write_text("\n".join(rows) + "\n")
    trilat("keys", "pair", "lab", cwd=folder).succeeds()
    return folder


def list_content(folder: Path) -> dict[Path, bytes | None]:
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(
            command,
            id=" ".join(command[:6]),
            marks=[] if command[0] in QUICK else [pytest.mark.long],
        )
        for command in CASES
    ],
)
def test_planted_links_redirect_no_command(
    arguments: list[str], inputs: Path, tmp_path: Path
) -> None:
    """Runs the command, puts links in place of each of its outputs, and runs it again."""
    work = tmp_path / "work"
    victim = tmp_path / "victim"
    shutil.copytree(inputs, work)
    if arguments[0] == "experiment" and arguments[1] != "new":
        trilat("experiment", "new", "reaching.toml", cwd=work).succeeds()
        shorten(work / "reaching.toml")
        if arguments[1] == "analyse":
            run = ["experiment", "run", "reaching.toml", "--jobs", "1", "-o", "experiment"]
            trilat(*run, cwd=work).succeeds()
    before = list_content(work)
    first = trilat(*arguments, cwd=work)
    assert first.code in (0, 1), first
    outputs = sorted(path for path in list_content(work) if path not in before)
    assert outputs
    for output in outputs:
        again = tmp_path / "again"
        victim.mkdir()
        (victim / "thesis.tex").write_text("years")
        shutil.copytree(work, again)
        is_folder = (again / output).is_dir()
        shutil.rmtree(again / output) if is_folder else (again / output).unlink()
        (again / output).symlink_to(victim if is_folder else victim / "thesis.tex")
        done = trilat(*arguments, cwd=again)
        assert "Traceback" not in done.err, output
        assert (victim / "thesis.tex").read_text() == "years", output
        # people link such folders to larger disks
        replaces_folder = is_folder and str(output) in (
            *arguments,
            "runs",
        )
        assert replaces_folder or [path.name for path in victim.iterdir()] == ["thesis.tex"], (
            output
        )
        shutil.rmtree(again)
        shutil.rmtree(victim)
