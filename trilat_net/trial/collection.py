"""Feeds tallies: from a run in virtual time while it goes on, or from a log.

Law: both feed the same tallies with the same records; what drove a run has no say in how it is measured.
"""

from array import array

import msgspec
import numpy as np

from .. import collector
from ..core.arm import JOINTS
from ..core.grid import NS_PER_S
from ..core.site import Site
from ..core.tick import Mode, Output
from ..log.reader import Log
from ..replay.comparison import late_samples
from ..scenario import Expect, Scenario
from ..sim import virtual
from .figures import Figures, measured
from .rows import Rows
from .stretch import Stretch
from .tally import Tally

BLOCK = 1000
"""How many records of a site are held before its tally takes them in."""


def run_virtual(scenario: Scenario) -> Figures:
    """Runs a scenario in virtual time and returns its figures."""
    held: dict[str, _Held] = {}
    diverged_at_s: float | None = None
    with collector.paused():
        for site, _, output in virtual.run(scenario):
            if output.tick == 0:
                held[site.name] = _Held(site, _tally(scenario, site.name))
            held[site.name].take(output)
            if output.mode is Mode.DIVERGED and diverged_at_s is None:
                diverged_at_s = output.t_ns / NS_PER_S
    for part in held.values():
        part.flush()
    tallies = {name: part.tally for name, part in held.items()}
    made = sum(tally.records for tally in tallies.values())
    return measured(
        scenario,
        tallies,
        diverged_at_s=diverged_at_s,
        late_samples=sum(count.late for part in held.values() for count in part.site.counts()),
        missing=0 if diverged_at_s is not None else sum(map(scenario.ticks, scenario.names)) - made,
    )


def measure_log(log: Log, expect: Expect | None = None) -> Figures:
    """Returns the figures of a log.

    Args:
        log: the log.
        expect: what will be asked of it; by default what its own scenario expects.

    Raises:
        LogError: a record cannot be read.
    """
    scenario = log.scenario if expect is None else msgspec.structs.replace(log.scenario, expect=expect)
    made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    last = [log[name].record(-1) for name in log.sites if len(log[name])]
    diverged_ns = [state.t_ns for state in last if state.mode == "diverged"]
    tallies = {name: _tally(scenario, name) for name in log.sites}
    missing = 0
    for name, tally in tallies.items():
        part = log[name]
        used = np.array([part.used[peer] for peer in part.peers]).T
        tally.add(Rows(part.t_ns, part.q, part.qd, part.q_des, part.tau, part.tau_x, used))
        wanted = made.get(name, 0) if diverged_ns else scenario.ticks(name)
        missing += max(0, wanted - len(part))
    return measured(
        scenario,
        tallies,
        diverged_at_s=min(diverged_ns) / NS_PER_S if diverged_ns else None,
        late_samples=len(late_samples(log)),
        missing=missing,
    )


def _tally(scenario: Scenario, site: str) -> Tally:
    peer_rates = [scenario.sites[peer].rate_hz for peer in scenario.peers(site)]
    stretches = [
        Stretch(window, scenario.sites[site]) if window.site in ("", site) else None
        for window in scenario.expect.windows
    ]
    return Tally(peer_rates, scenario.expect.synchronised_rad, stretches)


class _Held:
    """One site's records that its tally has not taken in yet."""

    def __init__(self, site: Site, tally: Tally) -> None:
        self.site, self.tally = site, tally
        self._t_ns, self._used = array("q"), array("q")
        self._floats = array("d")

    def take(self, output: Output) -> None:
        """Takes one record."""
        self._t_ns.append(output.t_ns)
        self._used.extend(output.used)
        floats = self._floats
        floats.extend(output.q)
        floats.extend(output.qd)
        floats.extend(output.q_des)
        floats.extend(output.tau)
        floats.extend(output.tau_x)
        if len(self._t_ns) >= BLOCK:
            self.flush()

    def flush(self) -> None:
        """Hands over what is held."""
        t_ns = np.array(self._t_ns, dtype=np.int64)
        used = np.array(self._used, dtype=np.int64).reshape(len(t_ns), len(self.site.peers))
        q, qd, q_des, tau, tau_x = np.array(self._floats).reshape(len(t_ns), 5, JOINTS).transpose(1, 0, 2)
        self.tally.add(Rows(t_ns, q, qd, q_des, tau, tau_x, used))
        for held in (self._t_ns, self._used, self._floats):
            del held[:]
