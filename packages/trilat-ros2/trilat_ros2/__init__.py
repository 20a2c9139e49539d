"""Connects a running session with ROS 2 programs. The command is `trilat ros2`.

ROS programs can observe the arms, command them, and stop them. The package is a separate
distribution that registers its command through an entry point in its pyproject.toml.
"""
