"""Linear analysis: the closed loop about the pose in which it rests, as a delay-differential equation.

Law: the equations are written out anew, in plain NumPy, so that roots and runs check each other; the
simulation is asked for nothing but where the loop rests.

Definitions, equations and sources stand in docs/linear.md.

    from trilat_net.linear import analyse

    found = analyse("free")
    found.verdict, found.continuous.rightmost.s, found.margin.words
"""

from .analysis import Analysis, analyse
from .edge import Edge, edge, edges
from .loop import Delayed, Loop, Rest, linearised
from .rest import rest_of

__all__ = ["Analysis", "Delayed", "Edge", "Loop", "Rest", "analyse", "edge", "edges", "linearised", "rest_of"]
