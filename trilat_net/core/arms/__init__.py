"""Kinematics and dynamics of robot arms, and the external torques that act on them.

Two arm models are available: the planar two-link arm of the paper, and serial chains with any
number of joints, usually read from a URDF file. The package also computes the torques exerted
by operators (people or programs that move an arm) and by walls and other objects that an arm
touches.
"""
