"""Lists optional packages and libraries, and names the command that installs a missing one.

If a user calls `trilat sweep` and trilat-studies is not installed, the program needs to
recognise the command to tell the user what to install. The lists also define the order of the
commands in the help. The packages register the commands themselves (see `entry_points`).

Invariant:
    - Importing this module loads no other module of the program, because `import trilat_net`
      imports this one.
"""

from importlib.util import find_spec

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
STUDY_LIBRARIES = ("loky", "matplotlib", "scipy")
"""Libraries that are installed with `trilat-net` but not with `trilat-net-core`
(pyproject.toml).
"""

EXTRAS = {
    "dask": "cluster",
    "distributed": "cluster",
    "gymnasium": "gym",
    "mujoco": "sim",
    "pandas": "frames",
    "polars": "frames",
    "pyarrow": "lerobot",
    "rerun": "view",
    "statsmodels": "stats",
}
"""Mapping from optional library to the extra of trilat-net that installs it (pyproject.toml).
"""


def require_libraries(*names: str) -> None:
    """Raises UsageError if a library required by a command is not installed.

    Called at the start of a long command, which would otherwise fail only at its end, for
    example when drawing a figure.

    Args:
        names: Names of the libraries. Defaults to all of `STUDY_LIBRARIES`.

    Raises:
        UsageError: A library is not installed. The message contains the command that installs
            it.
    """
    from .errors import UsageError

    required = names or STUDY_LIBRARIES
    missing = [name for name in required if find_spec(name) is None]
    if missing:
        libraries = ", ".join(missing)
        raise UsageError(
            f"this command needs {libraries}, which trilat-net-core does not include: "
            "pip install trilat-net"
        )


def describe_missing_library(function: str, error: ModuleNotFoundError) -> str:
    """Returns the error message for a function whose library is not installed.

    Args:
        function: Name of the function.
        error: The import error, which names the missing module.

    Returns:
        The message, including the command that installs the library.

    Raises:
        ModuleNotFoundError: The missing module belongs to this program, which is a bug.
    """
    from .files import Extra

    package = (error.name or "").partition(".")[0]
    if package in ("", "recorder", "sites", "trilat_net"):
        raise error
    distribution = package.replace("_", "-")
    if distribution in PACKAGE_COMMANDS:
        remedy = f"a separate package: pip install {distribution}"
    elif package in STUDY_LIBRARIES:
        remedy = "which trilat-net-core does not include: pip install trilat-net"
    elif package in EXTRAS:
        remedy = f"which is not installed: {Extra(EXTRAS[package]).install_command}"
    else:
        # A library that every installation of this program has, or that another library needs.
        remedy = f"which is not installed: pip install {package}"
    return f"{function} needs {package}, {remedy}"
