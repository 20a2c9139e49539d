"""trilat-net: dual-user (trilateral) teleoperation over a real network.

    import trilat_net

    log = trilat_net.simulate("paper", set={"control.Kd": 5})
    log["m1"].t_s, log["m1"].q
    log = trilat_net.open_log("run.mcap")
    log.frame("m1")

One `Site.step`, three drivers: live over a network, in virtual time, and again from the log, the same code
gives the same numbers bit for bit.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .drawing.figure import figure
    from .experiment import simulate, verify
    from .log.reader import open_log
    from .trial.running import check
    from .trial.trial import trials
    from .whatif.rerun import rerun

__all__ = ["check", "figure", "open_log", "rerun", "simulate", "trials", "verify"]

_MODULES = {
    "rerun": "whatif.rerun",
    "check": "trial.running",
    "trials": "trial.trial",
    "open_log": "log.reader",
    "figure": "drawing.figure",
}


def __getattr__(name: str) -> Any:
    """Imports the parts on first use: `trilat --help` needs none of them, and Numba takes a second."""
    if name in __all__:
        return getattr(import_module(f".{_MODULES.get(name, 'experiment')}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
