"""The closed loop linearised about its equilibrium: roots, delay margin, stability edges, haptic ports.

Invariant: the equations are written anew in plain NumPy and share nothing with the core's leaves, so that
roots and runs check each other; the simulation only supplies the pose at which a run settles.

Definitions, equations and sources are in docs/linear.md and docs/ports.md.
"""

from .equilibrium import find_equilibrium
from .linear_analysis import LinearAnalysis, analyse_linear_loop
from .linear_edge import (
    GrowthColumn,
    LinearEdge,
    compute_growth_column,
    find_root_crossings,
    iterate_linear_edges,
)
from .linear_loop import DelayedTerm, LinearLoop
from .operating_point import Equilibrium

__all__ = [
    "DelayedTerm",
    "Equilibrium",
    "GrowthColumn",
    "LinearAnalysis",
    "LinearEdge",
    "LinearLoop",
    "analyse_linear_loop",
    "compute_growth_column",
    "find_equilibrium",
    "find_root_crossings",
    "iterate_linear_edges",
]
