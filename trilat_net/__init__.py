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
    from sites.network_benchmark import ping_benchmark
    from sites.running_session import doctor, session, start

    from .analysis.twin_growth import twin
    from .api import (
        bench,
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
        view,
    )
    from .core.compiled_law import compiled
    from .execution.rerun import rerun
    from .log.log_reader import open_log
    from .log.log_signature import create_signing_keys, sign_log
    from .net.member_keys import create_keys, read_member_keys
    from .reporting.figures.registry import figure
    from .scenario import list_shipped, load_scenario, read_template
    from .scenario.describe import describe_scenario
    from .scenario.law_skeleton import new_law
    from .scenario.measured_traces import import_trace
    from .studies.trials.trial import trials
    from .studies.trials.trial_report import check

    __version__: str

__all__ = [
    "__version__",
    "bench",
    "certify",
    "check",
    "check_file",
    "compare",
    "compiled",
    "create_keys",
    "create_signing_keys",
    "describe_scenario",
    "doctor",
    "export",
    "figure",
    "hand",
    "import_trace",
    "info",
    "linear",
    "list_shipped",
    "load_scenario",
    "margin",
    "metrics",
    "new_law",
    "open_log",
    "ping_benchmark",
    "read_member_keys",
    "read_template",
    "recover",
    "report",
    "rerun",
    "run",
    "session",
    "sign_log",
    "simulate",
    "start",
    "sweep",
    "trials",
    "tune",
    "twin",
    "verify",
    "view",
]

_MODULES = {
    "check": "trilat_net.studies.trials.trial_report",
    "compiled": "trilat_net.core.compiled_law",
    "create_keys": "trilat_net.net.member_keys",
    "create_signing_keys": "trilat_net.log.log_signature",
    "describe_scenario": "trilat_net.scenario.describe",
    "doctor": "sites.running_session",
    "figure": "trilat_net.reporting.figures.registry",
    "hand": "sites.hand_session",
    "import_trace": "trilat_net.scenario.measured_traces",
    "list_shipped": "trilat_net.scenario",
    "load_scenario": "trilat_net.scenario",
    "new_law": "trilat_net.scenario.law_skeleton",
    "open_log": "trilat_net.log.log_reader",
    "ping_benchmark": "sites.network_benchmark",
    "read_member_keys": "trilat_net.net.member_keys",
    "read_template": "trilat_net.scenario",
    "rerun": "trilat_net.execution.rerun",
    "run": "sites.live_run",
    "session": "sites.running_session",
    "sign_log": "trilat_net.log.log_signature",
    "start": "sites.running_session",
    "twin": "trilat_net.analysis.twin_growth",
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
