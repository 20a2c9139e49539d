"""Connects a running session with ROS 2 programs, by the command `trilat ros2`.

ROS programs can observe the arms, command them, and stop them. The package is a distribution of
its own, which registers its command by an entry point of its pyproject.toml.
"""
