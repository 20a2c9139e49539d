"""Executes every site again from its log and compares every computed field of every record.

Law (L3, L5): the log alone feeds `Site.step`. On the platform that made it (by fingerprint) a whole run is
executed and bit equality demanded; elsewhere each tick is recomputed from the two records before it, to
1e-9 (1 + |a|). A gap is reported; execution resumes behind it from two records in a row, and what could
not be judged is counted.
"""

from .. import collector
from ..core.fingerprint import fingerprint
from ..log.reader import Log
from .execution import Execution
from .verdict import Verdict

__all__ = ["Verdict", "last_ticks", "verify"]


def verify(log: Log) -> Verdict:
    """Executes every site of a log again.

    Args:
        log: the log.

    Raises:
        LogError: a record cannot be read.
    """
    verdict = Verdict(whole_run=log.session.get("fingerprint") == fingerprint())
    with collector.paused():
        by_tick = {name: {state.tick: state for state in log[name].states} for name in log.sites}
        ends = last_ticks(log)
        for name in log.sites:
            Execution(log.scenario, log[name], log.changes(name), by_tick, ends, verdict).run()
    return verdict


def last_ticks(log: Log) -> dict[str, int]:
    """Returns the last tick that each site is known to have made, -1 where nothing is known.

    By its own word at the end; where it never said one, by its records and by what its peers had from it.
    """
    said = {event.member: event.ticks - 1 for event in log.events if event.kind == "end"}
    last = {name: max((state.tick for state in log[name].states[-1:]), default=-1) for name in log.sites}
    for name in log.sites:
        peers = log[name].peers
        if said.keys() >= set(peers):
            continue
        for state in log[name].states:
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(peers) and tick < log.scenario.ticks(peers[peer]):
                    last[peers[peer]] = max(last[peers[peer]], tick)
    return {name: said.get(name, known) for name, known in last.items()}
