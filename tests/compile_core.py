"""Compiles the core on all processors, a process for each part: `python -m tests.compile_core [PART...]`.

Without names for the layouts that most tests run: else every worker of a long test run that begins without
compiled code compiles all of them by itself. `make setup` names what the first demo and its report need. With
`--into FOLDER` the layouts of the scenarios that ship are compiled for the generic processor of the platform,
into a folder for a wheel (`.ci/compile-wheel`).
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path

import trilat_net
from sites.site_parts import warm_up
from tests.scenario.builders import planar_task_text, six_joint_text
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.errors import count_nouns
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.signals import Interrupt
from trilat_net.workers import count_cores, worker_pool

OF_TESTS = ("paper", "six joints", "task space")
SHIPPED = ("paper", "six_joints", "seven_joints", "unlike_arms")


def read_part(name: str) -> Scenario:
    """Returns a moment of the scenario of a part."""
    texts = {"six joints": six_joint_text, "task space": planar_task_text}
    if name in texts:
        return parse_scenario(texts[name](0.05))
    return load_scenario(name, {"duration_s": 0.05})


def compile_part(part: str) -> str:
    """Runs a scenario for a moment, tick by tick and fused, and looks at its log."""
    scenario = read_part(part)
    with tempfile.TemporaryDirectory() as folder:
        file = trilat_net.simulate(scenario).save(Path(folder) / "run.mcap")
        Certificate.of_log(trilat_net.open_log(file))
        trilat_net.verify(file)
        if part in SHIPPED:
            for site in scenario.names:
                warm_up(scenario, site)
            trilat_net.verify(file, virtual=True, resume_every=20)
            trilat_net.report(file, Path(folder) / "report")
    FusedRun(scenario).run_and_sample(scenario.duration_s)
    return part


def compile_parts(parts: Sequence[str], cores: int) -> None:
    """Compiles parts in parallel, and prints the progress."""
    parts_text = count_nouns(len(parts), "part")
    cores_text = count_nouns(cores, "processor")
    print(
        f"compiling {parts_text} of the core on {cores_text}, half a minute each ...",
        flush=True,
    )
    with Interrupt() as interrupt, interrupt.raising(), worker_pool(cores) as pool:
        running = [pool.submit(compile_part, part) for part in parts]
        for done, future in enumerate(as_completed(running), 1):
            print(f"compiled {done} of {len(parts)}: {future.result()}", flush=True)


def main(arguments: Sequence[str]) -> None:
    """Compiles the named parts."""
    if arguments[:1] != ["--into"]:
        parts = arguments or OF_TESTS
        compile_parts(parts, min(count_cores(), len(parts)))
        return
    with tempfile.TemporaryDirectory() as cache:  # workers see this environment
        os.environ.update(NUMBA_CPU_NAME="generic", XDG_CACHE_HOME=cache)
        compile_parts(
            arguments[2:] or SHIPPED, 1
        )  # two at once may overwrite what an index says
        within = shutil.ignore_patterns("*-within*")
        shutil.copytree(
            Path(cache) / "trilat-net", arguments[1], ignore=within, dirs_exist_ok=True
        )


if __name__ == "__main__":
    main(sys.argv[1:])
