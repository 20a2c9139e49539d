"""Lists the commands and functions of the optional packages, such as trilat-studies.

If a user calls `trilat sweep` and trilat-studies is not installed, the program needs to
recognise the command to tell the user what to install. The lists also define the order of the
commands in the help. The packages register the commands themselves (see `entry_points`).
"""

PACKAGE_COMMANDS = {
    "trilat-people": {
        "experiment-new": "Writes a commented protocol that runs without changes.",
        "experiment-check": (
            "Prints the plan of a protocol, or everything that is wrong with the protocol."
        ),
        "experiment-run": (
            "Runs an experiment with synthetic participants in virtual time, or with people."
        ),
        "experiment-analyse": (
            "Compares the conditions of an experiment, in tables, figures and a paragraph "
            "for a paper."
        ),
        "experiment-power": "Computes how many participants are needed to detect an effect.",
        "experiment-status": (
            "Prints the progress of an experiment, and checks that its logs were not changed."
        ),
        "hand": "Runs your program, or a device that you hold, as a user.",
        "identify-hand": (
            "Identifies the mass, damping and stiffness of the hand that holds an arm."
        ),
        "live": "Runs a scenario live on a web page, where you lead the arms.",
        "watch": "Shows a running session in the terminal.",
    },
    "trilat-studies": {
        "bench": "Compares control laws on the same tasks and links.",
        "compare": "Compares logs, or tuned control laws, side by side.",
        "sweep": "Maps where a scenario is stable, over a grid of settings.",
        "test": "Checks scenarios against their own expectations.",
        "tune": "Finds the largest gains for an arm on links with a delay.",
    },
    "trilat-ros2": {"ros2": "Connects a session to ROS 2."},
}
"""Commands of each package, with the first sentence of their help."""
PACKAGE_FUNCTIONS = {
    "trilat-people": (
        "HaplyInverse3 SpaceMouse analyse_experiment check_experiment compute_experiment_power "
        "identify_hand new_experiment open_experiment run_experiment"
    ),
    "trilat-studies": ("bench check compare make_env margin sweep trials tune tune_arm"),
}
"""Names that each package defines in `trilat_net`, separated by spaces."""
PACKAGE_HOOKS = {"trilat-people": "device-hand"}
"""Functions of each package that are called by methods of this program, separated by spaces."""
