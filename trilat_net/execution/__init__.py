"""Simulates experiments, and re-executes the runs stored in logs.

`virtual` simulates an experiment without real clocks or a network. `verification` re-executes a
log to check that it is correct. `what_if` re-executes a log with other settings, to show what
would have happened. `fused` simulates runs for studies, without writing logs.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Runs in virtual time
    "FusedRun",
    "SimulatedLog",
    "execute_virtual",
    "find_absent_samples",
    "record_virtual",
    # Execution of a log
    "LogCheckReport",
    "Rerun",
    "rerun",
    "verify_log",
]

if TYPE_CHECKING:
    from .fused import FusedRun
    from .log_checks import LogCheckReport
    from .verification import verify_log
    from .virtual import SimulatedLog, execute_virtual, record_virtual
    from .virtual_comparison import find_absent_samples
    from .what_if import Rerun, rerun
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "fused": "FusedRun",
            "log_checks": "LogCheckReport",
            "verification": "verify_log",
            "virtual": "SimulatedLog execute_virtual record_virtual",
            "virtual_comparison": "find_absent_samples",
            "what_if": "Rerun rerun",
        },
    )
