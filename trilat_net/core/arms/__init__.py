"""Computes how robot arms move: kinematics, dynamics, and the torques that act on them.

There are two models: the planar two-link arm of the paper, and chains of any number of joints,
for example from a URDF file. The package also contains the torques of the operators (humans or
programs that move an arm) and of the walls and bodies that an arm touches.
"""
