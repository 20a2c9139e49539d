"""trilat-net: dual-user (trilateral) teleoperation over a real network.

Two users each move a master arm, and a slave arm follows both masters. Each arm has its own
control loop, and the loops exchange their states over a network with delay.

    import trilat_net as tn

    log = tn.simulate("paper", set={"control.Kd": 5})
    log["m1"].t_s, log["m1"].q
    tn.certify(log)

The control loop of an arm is the function `Site.step`. The same function runs live over a
network, in virtual time, and when a run is repeated from its log, so the results are
bit-identical. The functions of this package return objects with `summary()`, `to_frame()` and
`to_dict()`. They are listed in docs/studies/python.md.
"""

import os as _os
from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

# These packages register functions in `hooks` that packages below them call.
from . import log as _log  # noqa: F401
from . import presentation as _presentation  # noqa: F401
from .package_names import PACKAGE_FUNCTIONS as _PACKAGE_FUNCTIONS

if _TYPE_CHECKING:
    from trilat_people.devices.haply_inverse3 import HaplyInverse3 as HaplyInverse3
    from trilat_people.devices.spacemouse import SpaceMouse as SpaceMouse
    from trilat_people.experiment.experiment_analysis import (
        analyse_experiment as analyse_experiment,
    )
    from trilat_people.experiment.experiment_analysis import (
        compute_experiment_power as compute_experiment_power,
    )
    from trilat_people.experiment.experiment_run import check_experiment as check_experiment
    from trilat_people.experiment.experiment_run import new_experiment as new_experiment
    from trilat_people.experiment.experiment_run import open_experiment as open_experiment
    from trilat_people.experiment.experiment_run import run_experiment as run_experiment
    from trilat_people.hand_impedance import identify_hand as identify_hand
    from trilat_studies.arm_gains import tune_arm as tune_arm
    from trilat_studies.gym_environment import make_env as make_env
    from trilat_studies.log_comparison import compare as compare
    from trilat_studies.study_functions import bench as bench
    from trilat_studies.study_functions import margin as margin
    from trilat_studies.study_functions import sweep as sweep
    from trilat_studies.study_functions import tune as tune
    from trilat_studies.trials import check as check
    from trilat_studies.trials import trials as trials

    from trilat_net.app.demo_session import run as run
    from trilat_net.app.doctor import doctor as doctor
    from trilat_net.app.input_device import Device as Device
    from trilat_net.app.input_device import DeviceState as DeviceState
    from trilat_net.app.network_benchmark import ping_benchmark as ping_benchmark
    from trilat_net.app.running_session import hand as hand
    from trilat_net.app.running_session import session as session
    from trilat_net.app.running_session import start as start

    from .analysis import info as info
    from .app.api import certify as certify
    from .app.api import export as export
    from .app.api import linear as linear
    from .app.api import metrics as metrics
    from .app.api import report as report
    from .app.api import simulate as simulate
    from .app.api import twin as twin
    from .app.api import verify as verify
    from .app.api import view as view
    from .core import HandContext as HandContext
    from .core import HandView as HandView
    from .core import LawContext as LawContext
    from .core import LawInput as LawInput
    from .core import compiled as compiled
    from .execution import rerun as rerun
    from .log import check_file as check_file
    from .log import create_signing_keys as create_signing_keys
    from .log import expand_poses as expand_poses
    from .log import open_log as open_log
    from .log import recover as recover
    from .log import sign_log as sign_log
    from .net import ArmClient as ArmClient
    from .net import SwitchClient as SwitchClient
    from .net import add_keys as add_keys
    from .net import create_keys as create_keys
    from .net import read_member_keys as read_member_keys
    from .net import renew_keys as renew_keys
    from .presentation import figure as figure
    from .process import request_real_time_scheduling as request_real_time_scheduling
    from .scenario import PlantContext as PlantContext
    from .scenario import Scenario as Scenario
    from .scenario import SimulatedArm as SimulatedArm
    from .scenario import describe_scenario as describe_scenario
    from .scenario import import_trace as import_trace
    from .scenario import list_shipped as list_shipped
    from .scenario import load_scenario as load_scenario
    from .scenario import new_hand as new_hand
    from .scenario import new_law as new_law
    from .scenario import new_plant as new_plant
    from .scenario import read_template as read_template

    __version__: str

_NAMES = {
    "trilat_net.app.demo_session": "run",
    "trilat_net.app.doctor": "doctor",
    "trilat_net.app.input_device": "Device DeviceState",
    "trilat_net.app.network_benchmark": "ping_benchmark",
    "trilat_net.app.running_session": "hand session start",
    "trilat_net.app.api": "certify export linear metrics report simulate twin verify view",
    "trilat_net.analysis": "info",
    "trilat_net.core": "HandContext HandView LawContext LawInput compiled",
    "trilat_net.execution": "rerun",
    "trilat_net.log": "check_file create_signing_keys expand_poses open_log recover sign_log",
    "trilat_net.net": (
        "ArmClient SwitchClient add_keys create_keys read_member_keys renew_keys"
    ),
    "trilat_net.process": "request_real_time_scheduling",
    "trilat_net.presentation": "figure",
    "trilat_net.scenario": (
        "PlantContext Scenario SimulatedArm describe_scenario import_trace list_shipped "
        "load_scenario new_hand new_law new_plant read_template"
    ),
}
"""Public names of each module or package interface, separated by spaces."""
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}
"""The module or package interface that defines each public name."""
_PACKAGE_NAMES = " ".join(_PACKAGE_FUNCTIONS.values()).split()
"""Public names defined by optional packages such as trilat-studies."""
__all__ = sorted(["__version__", *_MODULES, *_PACKAGE_NAMES])


def __getattr__(name: str) -> _Any:
    """Imports the module of a public name when the name is first used.

    Python calls this function for names that the package does not contain. Importing everything
    at once would delay commands such as `trilat --help` by seconds; Numba alone takes one
    second. Other installed packages may add names (see `entry_points`).

    Raises:
        AttributeError: There is no such public name.
    """
    if name == "__version__":
        from .files import find_version

        return find_version()
    if name in _MODULES or name in _PACKAGE_NAMES or _is_added(name):
        return _import_name(name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _is_added(name: str) -> bool:
    """Returns True if another installed package adds a name to `trilat_net`.

    Python looks up an attribute of the same name before it imports a submodule. Submodule names
    are recognised by their files, because reading the entry points takes milliseconds.

    Args:
        name: Name of the attribute.
    """
    folders_and_modules = [
        f"{folder}/{name}{ending}" for folder in __path__ for ending in ("", ".py")
    ]
    is_module = any(map(_os.path.exists, folders_and_modules))
    if name.startswith("_") or is_module:
        return False

    from .entry_points import FUNCTIONS, find_entries

    return name in find_entries(FUNCTIONS)


def _import_name(name: str) -> _Any:
    """Imports a public function or class by name, for example `trilat_net.simulate`.

    If a required package is missing, a stand-in is returned that raises UsageError when called.
    The error is not raised here because programs also look up names without using them
    (`hasattr`, `dir`, editor completion).
    """
    from .errors import UsageError

    try:
        if name in _MODULES:
            return getattr(_import_module(_MODULES[name]), name)
        from .entry_points import FUNCTIONS, load_entry

        return load_entry(FUNCTIONS, name, f"trilat_net.{name}")
    except UsageError as error:
        return _make_stand_in(name, str(error))
    except ModuleNotFoundError as error:
        from .package_names import describe_missing_library

        return _make_stand_in(name, describe_missing_library(name, error))


def _make_stand_in(name: str, problem: str) -> _Any:
    """Returns a function that raises UsageError when it is called.

    The stand-in replaces a public function that cannot be imported, for example because an
    optional package is not installed.

    Args:
        name: Public name of the function or class that cannot be imported.
        problem: Error message, which names the missing package.
    """
    from .errors import UsageError

    def stand_in(*_args: _Any, **_settings: _Any) -> _Any:
        raise UsageError(problem)

    stand_in.__name__ = stand_in.__qualname__ = name
    stand_in.__doc__ = f"Is not available: {problem}"
    return stand_in


def __dir__() -> list[str]:
    from .entry_points import FUNCTIONS, find_entries

    return sorted({*__all__, *find_entries(FUNCTIONS)})
