"""Decides which simulations can be computed together with vector instructions.

Vector instructions evaluate the same equations for several runs. Runs can therefore be computed
together if they differ only in numerical values, such as gains or start poses. Properties that
determine the equations, for example the type of control law, form the structure of a run.
`RunStructure.find_obstacle` explains why a run must be computed alone.

Invariant:
    - Two runs with the same structure use the same compiled code and the same data tables.
"""

from typing import Any, NamedTuple

import numba
import numpy as np

from ..arms.exogenous import OWN_KINDS
from ..step.compiled_run import CompiledRun
from ..step.site_setup import StaleAction
from .lane_laws import LaneLaw
from .lane_rows import Constants

SITE_CONSTANTS: tuple[str, ...] = (
    "rate_hz",
    "first",
    "digital",
    "law",
    "external",
    "ramps",
    "on_stale",
    "theta_known",
    "needs_model",
    "remembered",
    "asked",
    "order",
    "skipped",
    "degrades",
    "regrouped",
    "holds",
    "joints",
    "shared",
    "parameters",
    "task",
    "sent",
    "reason",
)
"""Fields of a site's row that are equal in runs of one structure and constant in each run."""
_CHANGED_BY_GLIDE = ("reason", "regrouped")
"""Those of these fields that are not constant under the rule `glide`."""
_ACTOR_CONSTANTS = ("kind", "sampled", "table_first", "table_count")
"""Fields in the row of an operator or environment that are equal in runs of one structure."""


class SiteStructure(NamedTuple):
    """Properties of one site that determine its equations, such as its type of control law.

    Sites with equal properties share code.

    Attributes:
        constants: Names and values of the constant fields of the site.
        actors: Names and values of the constant fields of each operator and environment,
            operators first.
        first_environment: Index of the first environment, or -1 if there is none.
        law: Compiled law of the site.
        prismatic: For each joint of a chain, 1 if it is prismatic, 0 if it is revolute.
    """

    constants: Constants
    actors: tuple[Constants, ...]
    first_environment: int
    law: LaneLaw
    prismatic: tuple[int, ...]


class RunStructure(NamedTuple):
    """Properties of a run that determine which code is compiled for it.

    Runs that differ only in numerical values, such as gains or delays, have equal structures
    and share their code.

    Attributes:
        sites: Structure of each site.
        peers: Number of peers from which each site receives samples.
        ramps: Largest number of planned changes of the dominance factors of one site.
        table: Shape and content of the data table of the operators and environments.
        duration_s: Planned duration of the run, s.
        settled_rad: Position error below which an arm counts as settled, rad.
    """

    sites: tuple[SiteStructure, ...]
    peers: int
    ramps: int
    table: tuple[tuple[int, ...], bytes]
    duration_s: float
    settled_rad: float

    @classmethod
    def find(cls, run: CompiledRun) -> "RunStructure":
        """Returns the properties of a run that must match for runs to be computed together.

        For example, the result is the same for two runs with the same control laws but
        different gains.

        Args:
            run: The run, for which `find_obstacle` must return an empty string.
        """
        memory = run.memory
        tables = memory.tables
        sites = []
        pairs = zip(tables.site, tables.actors, memory.sums, strict=True)
        for i, (site, actors, sums) in enumerate(pairs):
            rows = _list_actors(actors)
            columns = None if tables.channel is None else tables.channel.columns[i]
            names = SITE_CONSTANTS
            if site[0]["on_stale"] == StaleAction.GLIDE:
                names = tuple(name for name in names if name not in _CHANGED_BY_GLIDE)
            structure = SiteStructure(
                constants=_read_constants(site[0], names),
                actors=tuple(_read_constants(row, _ACTOR_CONSTANTS) for row in rows),
                first_environment=int(sums["first_environment"]),
                law=LaneLaw.describe(memory.compiled_laws.get(i), columns),
                prismatic=_list_prismatic(tables.chain, i, int(site[0]["joints"])),
            )
            sites.append(structure)
        return cls(
            sites=tuple(sites),
            peers=tables.links.shape[1],
            ramps=tables.ramps.shape[1],
            table=(tables.table.shape, tables.table.tobytes()),
            duration_s=run.duration_s,
            settled_rad=memory.settled_rad,
        )

    @staticmethod
    def find_obstacle(run: CompiledRun, *, hand_site: int = -1) -> str:
        """Explains to the user why a run cannot be simulated side by side with other runs.

        Args:
            run: The run before its first tick.
            hand_site: Index of the site whose arm the caller moves in place of the site's
                operator program. -1 if there is no such site.

        Returns:
            The reason, for example "control laws in plain Python", or an empty string if the
            run can be simulated side by side with others.
        """
        config: Any = numba.config
        tables = run.memory.tables
        if config.DISABLE_JIT:
            return "Numba is disabled"
        if run.memory.has_plain_law:
            return "control laws in plain Python"
        if run.programmed_sites - {hand_site}:
            return "programs that move an arm"

        kinds = {int(row["kind"]) for actors in tables.actors for row in _list_actors(actors)}
        if kinds.intersection(OWN_KINDS):
            return "user-written operators or environments"
        return ""


def _read_constants(row: np.void, names: tuple[str, ...]) -> Constants:
    """Returns integer fields of a row as pairs of name and value."""
    return tuple((name, int(row[name])) for name in names)


def _list_actors(actors: Any) -> list[Any]:
    """Returns the rows of a site's torque sources, excluding rows that only pad the array."""
    return [row for row in actors if row["sampled"] in (0, 1)]


def _list_prismatic(chain: Any, i: int, joints: int) -> tuple[int, ...]:
    """Returns 1 for each prismatic joint of a site and 0 for others; () for planar arms."""
    return () if chain is None else tuple(chain["prismatic"][i, :joints].tolist())
