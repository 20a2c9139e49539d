"""The closed loop linearised about its equilibrium: roots, delay margin, stability edges,
haptic ports.

Invariant: the equations are written anew in plain NumPy and share nothing with the core's
leaves, so that roots and runs check each other; the simulation only supplies the pose at which
a run settles.

Definitions, equations and sources are in docs/linear.md and docs/ports.md.
"""

from .equilibrium import find_equilibrium
from .linear_analysis import analyse_linear_loop
from .linear_edge import iterate_linear_edges

__all__ = ["analyse_linear_loop", "find_equilibrium", "iterate_linear_edges"]
