"""Executes every site again from its log and compares every computed field of every record.

Law (L3, L5): the log alone feeds `Site.step`. On the platform that made it (by fingerprint) a whole run is
executed and bit equality demanded; elsewhere each tick is recomputed from the two records before it, to
1e-9 (1 + |a|). A gap is reported; execution resumes behind it from two records in a row, and what could
not be judged is counted.
"""

from collections.abc import Callable

from .. import collector
from ..core.fingerprint import fingerprint
from ..log.chunks import Progress
from ..log.reader import Log
from .execution import Execution
from .verdict import Verdict

__all__ = ["EXECUTED", "Verdict", "executed_sites", "last_ticks", "verify"]

EXECUTED = "rerun_executed"
"""Entry of a session's metadata, of a log that a rerun wrote: the sites whose records follow from it."""


def verify(log: Log, progress: Progress | None = None) -> Verdict:
    """Executes every site of a log again.

    Args:
        log: the log.
        progress: told how many records are done, and how many there are.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: a law from outside is not there.
    """
    verdict = Verdict(whole_run=log.session.get("fingerprint") == fingerprint())
    with collector.paused():
        by_tick = {name: log[name].by_tick for name in log.sites}
        ends = last_ticks(log)
        sites = executed_sites(log)
        total = sum(len(log[name]) for name in sites)
        for name in sites:
            told = None if progress is None else _further(progress, verdict.records, total)
            Execution(log.scenario, log[name], log.changes(name), by_tick, ends, verdict).run(told)
    return verdict


def _further(progress: Progress, before: int, total: int) -> Callable[[int], None]:
    return lambda done: progress(before + done, total)


def executed_sites(log: Log) -> tuple[str, ...]:
    """Returns the sites whose records can be executed from the file.

    All of them, but in an open-loop rerun: there the others stand as they were recorded against sites that
    were otherwise.
    """
    named = log.session.get(EXECUTED)
    return tuple(name for name in log.sites if named is None or name in named.split())


def last_ticks(log: Log) -> dict[str, int]:
    """Returns the last tick that each site is known to have made, -1 where nothing is known.

    By its own word at the end; where it never said one, by its records and by what its peers had from it.
    """
    most = {name: log.scenario.ticks(name) for name in log.sites}
    said = {
        event.member: min(max(event.ticks, 0), most[event.member]) - 1
        for event in log.events
        if event.kind == "end" and event.member in most
    }
    last = {name: max((state.tick for state in log[name].states[-1:]), default=-1) for name in log.sites}
    for name in log.sites:
        peers = log[name].peers
        if said.keys() >= set(peers):
            continue
        for state in log[name].states:
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(peers) and tick < most[peers[peer]]:
                    last[peers[peer]] = max(last[peers[peer]], tick)
    return {name: said.get(name, known) for name, known in last.items()}
