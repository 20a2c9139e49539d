"""Records the messages of a running session in a log.

The recorder runs in its own process (`record_process`), so that a slow disk cannot delay the
control loops of the arms. It imports the network and the log, but neither the simulation, the
control laws nor the scenarios.
"""

from typing import TYPE_CHECKING

from trilat_net.hooks import import_on_use

__all__ = [
    "AWAY_NS",
    "GapRepair",
    "InboundQueue",
    "ReadScenario",
    "record_session",
]

if TYPE_CHECKING:
    from .backfill import GapRepair
    from .record_process import ReadScenario, record_session
    from .site_reception import AWAY_NS, InboundQueue
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "backfill": "GapRepair",
            "record_process": "ReadScenario record_session",
            "site_reception": "AWAY_NS InboundQueue",
        },
    )
