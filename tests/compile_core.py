"""Compiles the core for the layouts that tests of a push run, a process each: `python -m tests.compile_core`.

Else every worker of a test run that begins without compiled code compiles all of them by itself.
"""

import multiprocessing
import sys

import trilat_net
from tests.chains import six_joints
from tests.task_arms import planar_task
from trilat_net.analysis.certificate.stability_certificate import certify
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario, parse_scenario

TEXTS = {"paper": "", "six joints": six_joints(0.05), "task space": planar_task(0.05)}


def compile_layout(name: str) -> None:
    """Runs a scenario for a moment, tick by tick and fused, and looks at its log."""
    text = TEXTS[name]
    scenario = parse_scenario(text) if text else load_scenario(name, {"duration_s": 0.05})
    certify(trilat_net.simulate(scenario))
    FusedRun(scenario).advance_watching(scenario.duration_s)


def main() -> int:
    """Compiles all of them; the exit code is 1 if one failed, which its tests will say better."""
    processes = [multiprocessing.Process(target=compile_layout, args=(name,)) for name in TEXTS]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    return int(any(process.exitcode for process in processes))


if __name__ == "__main__":
    sys.exit(main())
