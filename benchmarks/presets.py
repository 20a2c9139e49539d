"""Every preset as a live session over Zenoh, ten seconds each, against virtual time."""

import shutil
import tempfile
from pathlib import Path

from rich.console import Console

from sites.demo import run_demo
from sites.display import Display
from trilat_net.experiment import compare_with_virtual, open_log, verify
from trilat_net.scenario import Scenario, load
from trilat_net.scenario.presets import PRESETS

DURATION_S = 10.0


def run() -> list[str]:
    print(f"every preset, {DURATION_S:g} s live: records identical to virtual time, of all")
    for name in PRESETS:
        scenario = load("free", {"duration_s": DURATION_S, "link.preset": name})
        folder = Path(tempfile.mkdtemp(prefix="trilat-preset-"))
        try:
            print(f"  {name:20} {_session(scenario, folder)}", flush=True)
        finally:
            shutil.rmtree(folder)
    return []


def _session(scenario: Scenario, folder: Path) -> str:
    with Display(scenario, Console(quiet=True)) as display:
        outcome = run_demo(scenario, folder, display)
    if outcome.problems or not outcome.log.exists():
        return "; ".join(outcome.problems)
    log = open_log(outcome.log)
    again, twins = verify(log), compare_with_virtual(log)
    want = sum(map(scenario.ticks, scenario.names))
    return (
        f"verify {again.identical}/{want}, fed {twins.fed.identical}/{want}, "
        f"plain {twins.plain.identical}/{want}, {len(twins.late)} late samples"
    )
