"""Decides which simulations can be computed together with vector instructions.

Vector instructions evaluate the same equations for several runs. Runs can therefore be computed
together if they differ in numbers only, such as gains or start poses. Properties that select
the equations, for example the kind of control law, form the structure of a run. `find_obstacle`
tells why a run must be computed alone.

Invariant:
    - Two runs with the same structure use the same compiled code and the same number tables.
"""

from collections.abc import Hashable
from typing import Any, NamedTuple

import numba
import numpy as np

from ...core import LIVE_KINDS, OWN_KINDS, SiteArrays, StaleAction
from ..fused import FusedRun
from .lane_laws import LaneLaw, describe_lane_law
from .lane_rows import Constants

SITE_CONSTANTS = (
    *("rate_hz", "first", "scheme", "law", "external", "ramps", "on_stale", "theta_known"),
    *("needs_model", "remembered", "asked", "order", "skipped", "degrades", "regrouped"),
    *("holds", "joints", "shared", "parameters", "task", "sent", "reason"),
)
"""Fields of a site's row that are equal in runs of one structure and constant in each run."""
_ACTOR_CONSTANTS = ("kind", "sampled", "table_first", "table_count")
"""Fields of the row of an operator or environment that are equal in runs of one structure."""


class SiteStructure(NamedTuple):
    """Properties of one site that select its equations, such as the kind of its control law.

    A site is a simulated arm with its controller. Sites with equal properties share code.

    Attributes:
        constants: Values of the fields of the site that select equations, by name.
        actors: The same for each operator and environment of the arm, the operators first.
        first_environment: Index of the first environment. -1 if there is none.
        law: Properties of a compiled control law.
    """

    constants: Constants
    actors: tuple[Constants, ...]
    first_environment: int
    law: LaneLaw


class RunStructure(NamedTuple):
    """Properties of a run that select its equations. Runs with equal properties share code.

    Runs that differ only in numbers, such as gains or delays, have equal structures.

    Attributes:
        sites: Structure of each site (arm controller).
        peers: Number of other sites from which each site receives samples (sent states).
        ramps: Largest number of planned changes of the dominance factors.
        table: Shape and content of the table of numbers of the operators and environments.
        duration_s: Duration of the scenario, s.
        settled_rad: Position error below which an arm counts as settled, rad.
    """

    sites: tuple[SiteStructure, ...]
    peers: int
    ramps: int
    table: tuple[tuple[int, ...], bytes]
    duration_s: float
    settled_rad: float


def _read_constants(row: np.void, names: tuple[str, ...]) -> Constants:
    """Returns the values of integer fields of a row, with their names."""
    return tuple((name, int(row[name])) for name in names)


def _list_actors(actors: Any) -> list[Any]:
    """Returns the rows of a site's torque sources, without rows that only fill the array."""
    return [row for row in actors if row["sampled"] in (0, 1)]


def find_obstacle(run: FusedRun, *, hand_site: int = -1) -> str:
    """Returns why a run cannot be computed together with other runs, for a message to the user.

    Args:
        run: The run before its first tick (control period).
        hand_site: Index of a site (arm controller) whose live operator the caller replaces,
            because it knows the actions of this operator. -1: there is none.

    Returns:
        The property of the run that lanes do not support. Empty if there is none.
    """
    config: Any = numba.config
    tables = run.memory.tables
    if config.DISABLE_JIT:
        return "Numba is disabled"
    if tables.chain is not None:
        obstacle = _find_obstacle_of_chains(tables)
        if obstacle:
            return obstacle
    if run.memory.has_plain_law:
        return "control laws in plain Python"
    if run.programmed_sites - {hand_site}:
        return "programs that move an arm"

    kinds = {int(row["kind"]) for actors in tables.actors for row in _list_actors(actors)}
    # Live operators whom no program replaces do nothing.
    if hand_site < 0 and kinds.intersection(LIVE_KINDS):
        return "hands that move an arm live"
    if kinds.intersection(OWN_KINDS):
        return "operators or environments that users wrote"
    if (tables.site["on_stale"] == StaleAction.GLIDE).any():
        return "on_stale.action 'glide'"
    if len(set(tables.site["rate_hz"].ravel().tolist())) > 1:
        return "tick rates that differ between sites"
    return ""


def _find_obstacle_of_chains(tables: SiteArrays) -> str:
    """Explains why runs with chains of joints cannot be computed together.

    Args:
        tables: Arrays of all sites (arm controllers) of a run.
    """
    if tables.channel is not None:
        return "compiled laws of arms that are chains of joints"
    counts = set(tables.site["joints"].ravel().tolist())
    if tables.site["task"].any():
        return "chains of joints whose sites share poses"
    if counts != {tables.links["q"].shape[2]}:
        return "chains with different numbers of joints"
    if tables.chain is not None and tables.chain["prismatic"].any():
        return "chains with prismatic joints"
    return ""


def find_structure(run: FusedRun) -> RunStructure:
    """Returns the properties of a run that decide with which other runs it can be computed.

    For example, two runs with the same control laws but different gains have the same result.

    Args:
        run: The run. There must be no obstacle, see `find_obstacle`.
    """
    memory = run.memory
    tables = memory.tables
    sites = []
    pairs = zip(tables.site, tables.actors, memory.sums, strict=True)
    for i, (site, actors, sums) in enumerate(pairs):
        rows = _list_actors(actors)
        columns = None if tables.channel is None else tables.channel.columns[i]
        structure = SiteStructure(
            constants=_read_constants(site[0], SITE_CONSTANTS),
            actors=tuple(_read_constants(row, _ACTOR_CONSTANTS) for row in rows),
            first_environment=int(sums["first_environment"]),
            law=describe_lane_law(memory.compiled_laws.get(i), columns),
        )
        sites.append(structure)
    return RunStructure(
        sites=tuple(sites),
        peers=tables.links.shape[1],
        ramps=tables.ramps.shape[1],
        table=(tables.table.shape, tables.table.tobytes()),
        duration_s=run.scenario.duration_s,
        settled_rad=memory.settled_rad,
    )


def describe_structure(run: FusedRun) -> Hashable:
    """Returns a key for sorting runs into groups, equal for runs that differ in numbers only.

    Args:
        run: The run before its first tick.

    Returns:
        The obstacle to computing the run together with others. Without an obstacle, its
        structure.
    """
    return find_obstacle(run) or find_structure(run)
