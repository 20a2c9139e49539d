"""High rates and many sites, live: they start, end, and what was made is in the log or accounted for."""

from pathlib import Path

import pytest

from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import parse_scenario

from .processes import Process, Stage

PATIENCE_S = 420.0
"""On two processors a dozen sites start for a minute, and may make up for what they missed for minutes."""


def write_chain_scenario(folder: Path, count: int) -> Path:
    """A scenario of so many sites, each of which follows the one before it and the first one."""
    names = [f"a{n}" for n in range(count)]
    path = folder / "many.toml"
    rows = [f"[dominance.{name}]\n{names[n - 1]} = 1.0\n" for n, name in enumerate(names)]
    sites = [f"[sites.{name}]\n" for name in names]
    path.write_text(
        f"name = 'many'\nduration_s = 10.0\n[link]\ndelay_ms = 100\n{''.join([*sites, *rows])}"
    )
    assert len(parse_scenario(path.read_text()).names) == count
    return path


def run_demo(stage: Stage, *words: str) -> tuple[Process, Log]:
    running = stage.start(
        "demo", "demo", *words, "--duration", "10", "--out", str(stage.folder / "out")
    )
    assert running.code(PATIENCE_S) == 0, running
    return running, open_log(stage.folder / "out" / "run.mcap")


def assert_accounted(log: Log) -> None:
    """Of every site the end is in the log, and every record that it made is there or counted as missing."""
    assert log.complete
    for name in log.sites:
        (made,) = (
            event.ticks for event in log.events if (event.member, event.kind) == (name, "end")
        )
        assert made == log.scenario.ticks(name)
        assert len(log[name]) + log.missing(name) == made
    verdict = verify_log(log)
    assert verdict.passed
    assert verdict.differing == 0
    assert verdict.identical > 0


@pytest.mark.long
def test_three_sites_at_four_kilohertz(stage: Stage) -> None:
    _, log = run_demo(stage, "paper", "--set", "rate_hz=4000")
    assert_accounted(log)
    assert sum(len(log[name]) for name in log.sites) == 120_000


@pytest.mark.long
def test_many_sites_at_one_kilohertz(stage: Stage) -> None:
    _, log = run_demo(stage, str(write_chain_scenario(stage.folder, 12)))
    assert_accounted(log)
    assert len(log.sites) == 12
