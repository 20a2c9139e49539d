"""Lists which commands and functions belong to which package of this program.

The packages register them by entry points themselves (`entry_points`). The lists give the order
of the help, and name the package to install if it is missing.
"""

PACKAGE_COMMANDS = {
    "trilat-studies": {
        "bench": "Compares control laws on the same tasks and links.",
        "compare": "Compares logs, or tuned control laws, side by side.",
        "identify-hand": (
            "Identifies the mass, damping and stiffness of the hand that holds an arm."
        ),
        "sweep": "Maps where a scenario is stable, over a grid of settings.",
        "test": "Checks scenarios against their own expectations.",
        "tune": "Finds the largest gains for an arm on links with a delay.",
    },
    "trilat-ros2": {"ros2": "Connects a session to ROS 2."},
}
"""The commands of each package, with the first sentence of their help."""
PACKAGE_FUNCTIONS = {
    "trilat-studies": (
        "bench check compare identify_hand make_env margin sweep trials tune tune_arm"
    ),
}
"""The names in `trilat_net` that each package defines, separated by spaces."""
