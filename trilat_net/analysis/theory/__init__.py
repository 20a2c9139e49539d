"""Predicts by linear analysis whether coupled arms are stable, and what their operators feel.

The control loop of all arms, with its delays and sampling, is linearised about a pose in which
all arms are at rest. Its characteristic roots show whether small motions decay. The delay
margin, for example, is the largest network delay for which they do. docs/studies/linear.md and
docs/studies/ports.md contain the definitions, equations and literature.

Invariant:
    - The equations are implemented a second time in plain NumPy and share nothing with the
      compiled simulation. Roots and simulated runs thus verify each other.
    - The simulation only supplies the pose at which a run comes to rest.
"""

from .equilibrium import find_equilibrium
from .linear_analysis import LinearAnalysis
from .linear_edge import iterate_linear_edges

__all__ = ["LinearAnalysis", "find_equilibrium", "iterate_linear_edges"]
