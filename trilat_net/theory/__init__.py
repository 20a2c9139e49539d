"""Linear analysis of the closed loop: roots, delay margin, stability edges, haptic ports.

The loop is linearised about its equilibrium. Definitions, equations and sources are in
docs/linear.md and docs/ports.md.

Invariant:
    - The equations are written a second time in plain NumPy and share nothing with the compiled
      core, so that roots and runs check each other.
    - The simulation only supplies the pose at which a run comes to rest.
"""

from .equilibrium import find_equilibrium
from .linear_analysis import analyse_linear_loop
from .linear_edge import iterate_linear_edges

__all__ = ["analyse_linear_loop", "find_equilibrium", "iterate_linear_edges"]
