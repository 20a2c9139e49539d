"""Compares ten seconds of every preset as a live session over Zenoh with virtual time."""

import shutil
import tempfile
from pathlib import Path

from rich.console import Console

from trilat_net.app.demo_session import run_demo
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import open_log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.link_presets import PRESETS

DURATION_S = 10.0


def run() -> list[str]:
    print(f"every preset, {DURATION_S:g} s live: records identical to virtual time, of all")
    for name in PRESETS:
        scenario = load_scenario("free", {"duration_s": DURATION_S, "link.preset": name})
        folder = Path(tempfile.mkdtemp(prefix="trilat-preset-"))
        try:
            print(f"  {name:20} {_session(scenario, folder)}", flush=True)
        finally:
            shutil.rmtree(folder)
    return []


def _session(scenario: Scenario, folder: Path) -> str:
    outcome = run_demo(scenario, folder, Console(quiet=True))
    if outcome.problems or not outcome.log.exists():
        return "; ".join(outcome.problems)
    log = open_log(outcome.log)
    verification = verify_log(log)
    comparison = compare_with_virtual(log)
    expected = sum(map(scenario.ticks, scenario.names))
    return (
        f"verify {verification.identical}/{expected}, "
        f"fed {comparison.fed.identical}/{expected}, "
        f"plain {comparison.plain.identical}/{expected}, {len(comparison.late)} late samples"
    )
