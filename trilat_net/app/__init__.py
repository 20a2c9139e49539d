"""The user-facing parts: the command line, the Python interface, a demo, and checks.

`cli` contains the `trilat` command, and `api` the Python functions of the package trilat_net.
Both only parse their arguments and call the packages that do the work.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # The command line
    "options",
    "run_and_report",
    "seconds",
    "value",
    # The Python interface
    "AnyScenario",
    "Overrides",
    # Sessions
    "RunningSession",
    "SessionDisplay",
    "SessionResult",
    "ShareHistory",
    "StatusRow",
    "compile_core",
    "run_demo",
    # Input devices
    "Device",
    "DeviceState",
    "Vector",
]

if TYPE_CHECKING:
    from .api import AnyScenario, Overrides
    from .cli import options
    from .cli.options import seconds, value
    from .cli.sessions import run_and_report
    from .demo_session import SessionResult, compile_core, run_demo
    from .input_device import Device, DeviceState, Vector
    from .monitor import SessionDisplay, StatusRow
    from .running_session import RunningSession
    from .share_history import ShareHistory
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "api": "AnyScenario Overrides",
            "cli.options": "options seconds value",
            "cli.sessions": "run_and_report",
            "demo_session": "SessionResult compile_core run_demo",
            "input_device": "Device DeviceState Vector",
            "monitor": "SessionDisplay StatusRow",
            "running_session": "RunningSession",
            "share_history": "ShareHistory",
        },
    )
