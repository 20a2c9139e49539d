"""Simulates a run in compiled code, and keeps its records as a log that is never encoded.

`SimulatedLog` executes each tick in Python and writes a message for it. `simulate_columns` is
the faster alternative for studies that evaluate thousands of runs and need the records of some
of them.

Invariant:
    - The columns are bit-identical to those of the log that `SimulatedLog` returns.
"""

from typing import Any

import numpy as np

from ..core import Array
from ..log import Log, UnwrittenLog
from ..records import NS_PER_S
from ..scenario import Scenario
from .fused import FusedRun
from .virtual import SimulatedLog

_BLOCK_TICKS = 4096
"""Interval at which the records are copied, in ticks of the fastest site."""


def simulate_columns(scenario: Scenario) -> Log:
    """Simulates an experiment, and returns a log with the columns of its records.

    The log contains the columns computed by the simulation: times, modes, motions, torques,
    estimates, sent values, and the samples in use. An ordinary log is returned if these columns
    do not describe the run completely (see `_is_described_by_columns`), or if the run ends
    early.

    Args:
        scenario: The scenario.

    Raises:
        ScenarioError: The scenario cannot run in virtual time.
        LawFailed: A user's control law failed.
    """
    if not _is_described_by_columns(scenario):
        return SimulatedLog(scenario)
    run = FusedRun(scenario, keep=_BLOCK_TICKS + 1)
    blocks: dict[str, list[Array]] = {name: [] for name in scenario.names}
    for batch in run.iterate_batches():
        for name, (_, rows) in zip(scenario.names, batch, strict=True):
            blocks[name].append(rows)
    if run.diverged_s is not None:
        return SimulatedLog(scenario)

    columns = {}
    for i, name in enumerate(scenario.names):
        rows = np.concatenate(blocks[name])
        used = run.read_samples_in_use(i, len(rows))
        ticks = np.arange(len(rows), dtype=np.int64)
        site_columns: dict[str, Any] = {
            "mode": np.full(len(rows), "run", dtype=object),
            "t_ns": ticks * NS_PER_S // scenario.sites[name].rate_hz,
            "used": dict(zip(scenario.peers(name), used.T, strict=True)),
        }
        for field, place in scenario.layout(name).columns().items():
            site_columns[field] = rows[:, place]
        columns[name] = site_columns
    return UnwrittenLog(scenario, columns)


def _is_described_by_columns(scenario: Scenario) -> bool:
    """Returns True if the arrays computed by the simulation describe a run completely.

    Some information exists only in a written log: changes of settings, the actions of live
    operators, the motion of objects in an environment, and the modes of a site that reacts to
    missing samples.

    Args:
        scenario: The scenario.
    """
    if scenario.timeline or any(link.outages_s for link in scenario.links.values()):
        return False
    for name, site in scenario.sites.items():
        lengths = scenario.layout(name).lengths()
        if lengths.get("hand") or lengths.get("bodies") or site.on_stale.action != "use":
            return False
    return True
