"""The bridge between a running session and ROS 2, and its command `trilat ros2`.

The package belongs to trilat-net, and registers its command there by an entry point of its
pyproject.toml.
"""
