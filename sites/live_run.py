"""A whole session on this machine from Python: what `trilat demo` does, without its report.

Invariant: in every case no process is left on return.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from trilat_net.errors import RunFailed
from trilat_net.files import make_results_folder
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import Scenario, load_scenario

from .demo_session import run_demo
from .monitor import SessionDisplay


def run(
    scenario: str | Path | Mapping[str, Any] | Scenario,
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    duration_s: float | None = None,
    seed: int | None = None,
    out: str | Path | None = None,
    force: bool = False,
    quiet: bool = True,
) -> Log:
    """Runs a scenario live, a process per site and a recorder over Zenoh, and returns its log.

    The command is `trilat demo`, which reports on the log too: `tn.report(log)`.

    >>> log = tn.run("two_sites", duration_s=2)
    >>> tn.verify(log).passed
    True

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a scenario.
        set: overrides, as in `{"control.Kd": 5}`.
        duration_s: the duration of the run, s; by default the scenario's.
        seed: the seed; by default the scenario's.
        out: folder of the log; by default the next free runs/NAME-N.
        force: whether it may hold something already.
        quiet: whether nothing is printed while it runs.

    Raises:
        ScenarioError: the scenario or an override is not valid.
        RunFailed: a process failed, or the run was interrupted; it says what the log holds.
    """
    chosen = load_scenario(scenario, set, duration_s=duration_s, seed=seed)
    folder = make_results_folder(None if out is None else Path(out), chosen.name, force=force)
    with SessionDisplay(chosen, Console(quiet=quiet)) as display:
        result = run_demo(chosen, folder, display)
    problems = ["interrupted"] if result.interrupted else result.problems
    if problems:
        kept = f"; {result.log} holds what there was" if result.log.exists() else ""
        raise RunFailed("; ".join(problems) + kept)
    log = open_log(result.log)
    log.warn_if_diverged()
    return log
