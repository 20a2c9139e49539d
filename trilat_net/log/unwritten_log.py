"""Provides logs of simulations whose records stay in arrays and are not encoded as messages.

The functions that analyse a recorded run read the columns of its log, such as the joint angles
of all records. `UnwrittenLog` provides the same columns for arrays that a simulation left in
memory, so a simulated run can be analysed in the same way. Encoding these arrays as messages
and decoding them again would take twenty times as long as the simulation.

Invariant:
    - Reading a column that was not provided raises an error.
    - The log is complete: it has a record of every tick of the scenario, and no events.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import Array
from ..errors import LogError
from ..scenario import Scenario
from .log_contents import LogContents
from .log_reader import Log
from .running_digest import DigestState, Integrity
from .site_log import SiteLog, freeze

_NAME = "run"
"""Name of the log for error messages."""


class _UnwrittenSiteLog(SiteLog):
    """Results of one arm in a simulation without a log file, with one row per tick.

    Provides the arrays of `SiteLog`.

    Args:
        scenario: Scenario of the run.
        site: Name of the site.
        columns: Maps the names of record fields to arrays with one row per tick of the site.
    """

    def __init__(self, scenario: Scenario, site: str, columns: Mapping[str, Any]) -> None:
        super().__init__(
            name=site,
            peers=scenario.peers(site),
            rate_hz=scenario.sites[site].rate_hz,
            payloads=(),
            source=_NAME,
            layout=scenario.layout(site),
            channel=scenario.channel(site),
            axes=scenario.arms[site].axes,
        )
        self.indexed = None
        self.tick = freeze(np.arange(scenario.ticks(site), dtype=np.int64))
        # The properties of a site log look up columns here before they decode messages.
        self.__dict__.update(freeze(dict(columns)))
        self.__dict__["_changes"] = {}

    def __len__(self) -> int:
        return len(self.tick)

    @property
    def diverged_s(self) -> float | None:
        """Always None, since no arm exceeded its limits: every planned tick was executed."""
        return None

    def _read_from(self, *_: Any) -> Any:
        raise LogError(f"{_NAME}: {self.name} has no such column, because no log was written")

    def _read_vectors(self, *fields: str) -> dict[str, Array]:
        lengths = self.layout.lengths()
        for field in fields:
            if lengths.get(field):
                raise LogError(f"{_NAME}: {self.name} has no column {field}")
        return {field: freeze(np.zeros((len(self), 0))) for field in fields}


class UnwrittenLog(Log):
    """Log of a completed simulation, whose records are arrays in memory and not messages.

    Args:
        scenario: Scenario of the run.
        columns: For each site, maps the names of record fields (see `SiteLog`) to arrays with
            one row per tick.
    """

    def __init__(self, scenario: Scenario, columns: Mapping[str, Mapping[str, Any]]) -> None:
        contents = LogContents(
            sources=(_NAME,),
            session={"session": scenario.name, "driver": "virtual"},
            scenario=scenario.text.encode(),
            metadata={},
            channels={},
            complete=True,
            ended=True,
            damaged=[],
            chain=Integrity(DigestState.INTACT, ""),
        )
        super().__init__(contents)
        for site, site_columns in columns.items():
            self._sites[site] = _UnwrittenSiteLog(scenario, site, site_columns)
