"""Adds the command `trilat lag`, the function `trilat_net.measure_lags`, and a viewer of logs.

pip install .
trilat lag paper --seeds 3
trilat log view run.mcap --in lag
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import trilat_net as tn
from trilat_net.extension import (
    JsonOption,
    ScenarioArgument,
    UsageError,
    command,
    print_json,
    print_line,
    value,
)


def measure_lags(scenario: str, seeds: int = 1, duration_s: float | None = None) -> list[float]:
    """Returns the RMS error of the slave for each of the seeds 1, 2, ..., in rad.

    Args:
        scenario: Name of a shipped scenario, or path of a TOML file.
        seeds: Number of seeds.
        duration_s: Duration of each run, in s. Default: the scenario's duration.
    """
    lags_rad = []
    for seed in range(1, seeds + 1):
        log = tn.simulate(scenario, seed=seed, duration_s=duration_s)
        lags_rad.append(tn.metrics(log).sites["s"]["rms_error_rad"].value)
    return lags_rad


@command("paper --seeds 3")
def lag_command(
    scenario: ScenarioArgument,
    seeds: Annotated[int, value("--seeds", "N", "Number of seeds.")] = 1,
    duration: Annotated[
        float | None, value("--duration", "S", "Duration of a run, in s.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measures how far the slave lags behind, seed by seed."""
    if seeds < 1:
        raise UsageError(f"--seeds must be at least 1, not {seeds}")
    lags_rad = measure_lags(scenario, seeds, duration)
    if as_json:
        print_json({"rms_error_rad": lags_rad})
        return
    for number, lag_rad in enumerate(lags_rad, start=1):
        print_line(f"seed {number}: {lag_rad:.4f} rad")


def show_lags(files: Sequence[Path]) -> None:
    """Prints the largest distance of each arm of a log from the others, second by second.

    Args:
        files: The log, or its parts.
    """
    log = tn.open_log(*files)
    for name, arm in log.items():
        for second in range(int(arm.t_s[-1]) + 1):
            errors_rad = arm.e[(arm.t_s >= second) & (arm.t_s < second + 1)]
            if len(errors_rad):
                print_line(f"{name}, {second} s: {abs(errors_rad).max():.4f} rad")
