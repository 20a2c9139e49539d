"""Predicts stability, delay margins and haptic properties of the arms by linear analysis.

The control loop of all arms, with its delays and ticks, is linearised about a pose in which all
arms rest. Its characteristic roots tell whether small motions die away. docs/studies/linear.md
and docs/studies/ports.md have the definitions, equations and sources.

Invariant:
    - The equations are written a second time in plain NumPy and share nothing with the compiled
      core, so that roots and simulated runs check each other.
    - The simulation only supplies the pose at which a run comes to rest.
"""

from .equilibrium import find_equilibrium
from .linear_analysis import analyse_linear_loop
from .linear_edge import iterate_linear_edges

__all__ = ["analyse_linear_loop", "find_equilibrium", "iterate_linear_edges"]
