"""Virtual runs as arrays, each made once per test session."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.run_changes import LinkTables, resolve_change, to_core_change

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """One site's records, rows are ticks."""

    t_s: Array
    q: Array
    qd: Array
    q_des: Array
    qd_des: Array
    tau: Array
    tau_x: Array
    theta_hat: Array
    used: NDArray[np.int64]
    ch: Array


@dataclass(frozen=True)
class Run:
    scenario: Scenario
    sites: dict[str, Trajectory]

    def stack(self, field: str) -> Array:
        """Returns the field of every site, shape (N, K, ...)."""
        return np.array([getattr(site, field) for site in self.sites.values()])


def trajectories(scenario: Scenario) -> Run:
    records: dict[str, list[Any]] = {name: [] for name in scenario.names}
    for site, _, output in virtual.execute_virtual(scenario):
        records[site.name].append(output)
    return Run(
        scenario,
        {
            name: Trajectory(
                t_s=np.array([o.tick for o in outputs]) / scenario.sites[name].rate_hz,
                **{
                    field: np.array([getattr(o, field) for o in outputs])
                    for field in (
                        "q",
                        "qd",
                        "q_des",
                        "qd_des",
                        "tau",
                        "tau_x",
                        "theta_hat",
                        "used",
                        "ch",
                    )
                },
            )
            for name, outputs in records.items()
        },
    )


def sampled(scenario: Scenario, times_s: Array | tuple[float, ...]) -> Array:
    """Returns the last records before some times, shape (N, K, 17), of a compiled run: quick
    for few times.
    """
    fused_run = FusedRun(scenario)
    rows = []
    for t_s in times_s:
        fused_run.advance_to(float(t_s))
        rows.append(fused_run.records)
    return np.stack(rows, axis=1)


@cache
def _run(name: str, overrides: tuple[tuple[str, Any], ...]) -> Run:
    return trajectories(load_scenario(name, dict(overrides)))


def run(name: str, overrides: Mapping[str, Any] | None = None) -> Run:
    """Returns a shipped scenario in virtual time; the same call returns the same run."""
    return _run(name, tuple(sorted((overrides or {}).items())))


def simulate_with_commands(
    scenario: Scenario, site: str, *requests: tuple[float, dict[str, Any]]
) -> Log:
    """Returns the log of a run in virtual time in which a site gets commands.

    Args:
        scenario: The scenario of the run.
        site: Name of the site.
        requests: Times of the commands, in s, and the commands as `trilat set` sends them.
    """
    schedule: dict[int, list[Any]] = {}
    for at_s, request in requests:
        tables = LinkTables(scenario.links, ())
        change = resolve_change(scenario, tables, request, round(at_s * 1e9))
        tick = round(at_s * scenario.sites[site].rate_hz)
        schedule.setdefault(tick, []).append(to_core_change(scenario, change))
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream, commands={site: schedule})
    stream.seek(0)
    return open_log(stream)
