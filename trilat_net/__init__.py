"""trilat-net: dual-user (trilateral) teleoperation over a real network.

    import trilat_net as tn

    log = tn.simulate("paper", set={"control.Kd": 5})
    log["m1"].t_s, log["m1"].q
    tn.certify(log)

One `Site.step` and three drivers: live over a network, in virtual time, and again from a log. The same code
gives the same numbers, bit for bit. What a function finds is an object with `summary()`, `to_frame()` and
`to_dict()`; docs/python.md lists them all.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from sites.hand_session import hand
    from sites.live_run import run

    from .api import (
        certify,
        check_file,
        compare,
        export,
        info,
        linear,
        margin,
        metrics,
        recover,
        report,
        simulate,
        sweep,
        tune,
        verify,
    )
    from .core.compiled_law import compiled
    from .execution.rerun import rerun
    from .log.log_reader import open_log
    from .reporting.figures.registry import figure
    from .scenario import load_scenario
    from .studies.trials.trial import trials
    from .studies.trials.trial_runner import check

    __version__: str

__all__ = [
    "__version__",
    "certify",
    "check",
    "check_file",
    "compare",
    "compiled",
    "export",
    "figure",
    "hand",
    "info",
    "linear",
    "load_scenario",
    "margin",
    "metrics",
    "open_log",
    "recover",
    "report",
    "rerun",
    "run",
    "simulate",
    "sweep",
    "trials",
    "tune",
    "verify",
]

_MODULES = {
    "check": "trilat_net.studies.trials.trial_runner",
    "compiled": "trilat_net.core.compiled_law",
    "figure": "trilat_net.reporting.figures.registry",
    "hand": "sites.hand_session",
    "load_scenario": "trilat_net.scenario",
    "open_log": "trilat_net.log.log_reader",
    "rerun": "trilat_net.execution.rerun",
    "run": "sites.live_run",
    "trials": "trilat_net.studies.trials.trial",
}
"""Where names are; the others are in `api`."""


def __getattr__(name: str) -> _Any:
    """Imports the parts on first use: `trilat --help` needs none of them, and Numba takes a second."""
    if name == "__version__":
        from importlib.metadata import version

        return version("trilat-net")
    if name in __all__:
        return getattr(_import_module(_MODULES.get(name, "trilat_net.api")), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
