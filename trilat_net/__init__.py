"""trilat-net: dual-user (trilateral) teleoperation over a real network.

    import trilat_net

    log = trilat_net.simulate("paper", set={"control.Kd": 5})
    log["m1"].t_s, log["m1"].q
    log = trilat_net.open_log("run.mcap")
    log.frame("m1")

One `Site.step` and three drivers: live over a network, in virtual time, and again from a log. The same code
gives the same numbers, bit for bit.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from . import deprecated

if TYPE_CHECKING:
    from sites.hand_session import hand

    from .api import simulate
    from .core.compiled_law import compiled
    from .execution.rerun import rerun
    from .execution.verify import verify
    from .log.log_reader import open_log
    from .reporting.figures.registry import figure
    from .studies.trials.trial import trials
    from .studies.trials.trial_runner import check
    from .theory.end_pose import certify_with_roots as certify

__all__ = [
    "certify",
    "check",
    "compiled",
    "figure",
    "hand",
    "open_log",
    "rerun",
    "simulate",
    "trials",
    "verify",
]

_MODULES = {
    "certify": "theory.end_pose:certify_with_roots",
    "check": "studies.trials.trial_runner",
    "compiled": "core.compiled_law",
    "figure": "reporting.figures.registry",
    "hand": "sites.hand_session",
    "open_log": "log.log_reader",
    "rerun": "execution.rerun",
    "trials": "studies.trials.trial",
    "verify": "execution.verify",
}

deprecated.install()


def __getattr__(name: str) -> Any:
    """Imports the parts on first use: `trilat --help` needs none of them, and Numba takes a second."""
    if name in __all__:
        module, _, attribute = _MODULES.get(name, "api").partition(":")
        place = module if module.startswith("sites.") else f"{__name__}.{module}"
        return getattr(import_module(place), attribute or name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
