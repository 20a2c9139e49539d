"""Builders of runs in virtual time: their records as arrays, their logs, and compiled runs."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.execution.deliveries import TICKS
from tests.log.builders import (
    SHORT,
    Record,
    edit_log_bytes,
    make_log_bytes,
    open_bytes,
    simulate_bytes,
)
from trilat_net.core.step.ticks import PlantState, TickRecord
from trilat_net.execution import virtual
from trilat_net.execution.fused import FusedRun
from trilat_net.execution.what_if import Rerun
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import STATE_VECTORS, State
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.run_changes import LinkTables, resolve_change

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """The records of one site as arrays, with one row for each tick."""

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
class Trajectories:
    """The records of all sites of a run."""

    scenario: Scenario
    sites: dict[str, Trajectory]

    def stack(self, field: str) -> Array:
        """Returns the field of every site, shape (N, K, ...)."""
        return np.array([getattr(site, field) for site in self.sites.values()])


def execute_ticks(scenario: Scenario) -> dict[str, list[TickRecord]]:
    """Returns the records of each site of a run in virtual time, tick by tick."""
    records: dict[str, list[TickRecord]] = {name: [] for name in scenario.names}
    for step in virtual.execute_virtual(scenario):
        records[step.site.name].append(step.output)
    return records


def make_trajectories(scenario: Scenario) -> Trajectories:
    """Returns the records of a run in virtual time as arrays."""
    sites = {}
    for name, records in execute_ticks(scenario).items():
        columns = {
            field.name: np.array([getattr(record, field.name) for record in records])
            for field in fields(Trajectory)
            if field.name != "t_s"
        }
        ticks = np.array([record.tick for record in records])
        sites[name] = Trajectory(t_s=ticks / scenario.sites[name].rate_hz, **columns)
    return Trajectories(scenario, sites)


def run_fused(scenario: Scenario, until_s: float | None = None, **options: Any) -> FusedRun:
    """Returns a compiled run that is executed to its end, or until a time in s."""
    fused_run = FusedRun(scenario, **options)
    fused_run.advance_to(scenario.duration_s if until_s is None else until_s)
    return fused_run


def sample_records(scenario: Scenario, times_s: Array | tuple[float, ...]) -> Array:
    """Returns the last record of each site before each time, shape (N, K, 17), of a compiled run.

    The function is quick for few times.
    """
    fused_run = FusedRun(scenario)
    rows = []
    for t_s in times_s:
        fused_run.advance_to(float(t_s))
        rows.append(fused_run.records)
    return np.stack(rows, axis=1)


_trajectories: dict[str, Trajectories] = {}


def make_shipped_trajectories(
    name: str, overrides: Mapping[str, Any] | None = None
) -> Trajectories:
    """Returns the records of a shipped scenario as arrays, simulated once per process."""
    key = json.dumps([name, overrides or {}], sort_keys=True)
    if key not in _trajectories:
        _trajectories[key] = make_trajectories(load_scenario(name, dict(overrides or {})))
    return _trajectories[key]


def make_log_with_commands(
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
        schedule.setdefault(tick, []).append(scenario.to_core_change(change))
    return open_bytes(simulate_bytes(scenario, commands={site: schedule}))


OTHER_PLATFORM = {"fingerprint": "0" * 16}


def list_results(state: State) -> list[list[float]]:
    """Returns all results of a tick except the arrivals."""
    return [
        *(getattr(state, field) for field in STATE_VECTORS),
        list(state.used.values()),
        state.mem,
    ]


def list_tick_results(log: Log, site: str) -> list[tuple[int, str, list[list[float]]]]:
    """Returns the tick, mode and results of every record of a site."""
    return [(state.tick, state.mode, list_results(state)) for state in log[site].states]


def make_log_without(
    lost: Mapping[str, Collection[int]],
    data: bytes | None = None,
    session: dict[str, str] | None = None,
) -> Log:
    """Returns a log without some of its records.

    Args:
        lost: Ticks of the records that are dropped, by site.
        data: The log. By default, that of a short run of `paper`.
        session: New values of entries of the session's metadata.
    """

    def drop_lost(record: Record) -> Record | None:
        return None if record["tick"] in lost.get(record["site"], ()) else record

    whole = make_log_bytes("paper") if data is None else data
    return open_bytes(edit_log_bytes(whole, record=drop_lost, session=session))


def all_identical(again: Rerun) -> bool:
    """True if every executed record of every site has the bits of the log."""
    return all(
        effect.identical == effect.executed == len(again.before[name]) and effect.first is None
        for name, effect in again.sites.items()
    )


def make_external_arm_bytes() -> bytes:
    """Returns a log like that of a live session with an external arm.

    The motion of site s is prescribed, because no model computes the motion of a real arm.
    """
    outside = {"sites.s.plant": "external", "sites.s.arm.known": False}
    scenario = load_scenario("two_sites", dict(SHORT) | outside)
    motion = {k: PlantState([0.01 * k, -0.3], [0.25 * (k % 3), 1e-3 * k]) for k in range(TICKS)}
    execute_virtual = virtual.execute_virtual

    def execute_measured(scenario: Scenario, network: Any = None, **_: Any) -> Any:
        return execute_virtual(scenario, network, measured={"s": motion})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(virtual, "execute_virtual", execute_measured)
        patch.setattr(virtual.SimulatedLog, "check_scenario", lambda *_, **__: None)
        return simulate_bytes(scenario)
