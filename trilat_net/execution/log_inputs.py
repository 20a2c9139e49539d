"""What a recorded run got from outside, as the compiled run takes it.

Invariant: a run with these inputs is the recorded one, bit for bit. A sample that came before its own stamp
is handed over at the first tick after it: none is in use earlier (L2).
"""

import numpy as np

from ..core.delay import max_delay_us
from ..core.exogenous import LIVE_KINDS
from ..core.fused_run import RecordedFeed
from ..core.ticks import NS_PER_S
from ..core.vectors import Array, IntArray
from ..log.log_reader import Log
from ..scenario.law_consent import find_user_laws
from .fused import RunInputs


def explain_no_repetition(log: Log, *, own_laws: bool = False) -> str:
    """Returns why a run cannot be executed again from its log alone; "" if it can.

    Args:
        log: the log.
        own_laws: whether code of laws from outside may run.
    """
    scenario = log.scenario
    if scenario.external:
        arms = ", ".join(sorted(scenario.external))
        return f"how the arm of {arms}, outside of the program, would have replied is not known"
    if find_user_laws(scenario) and not own_laws:
        return "laws from outside may not run (--law FILE)"
    if set(log.executed_sites) != set(log.sites):
        return "sites that a rerun took over did not react"
    for name in log.sites:
        part = log[name]
        if not len(part) or not np.array_equal(part.tick, np.arange(len(part))):
            return f"records of {name} are missing"
    return ""


def read_run_inputs(log: Log) -> RunInputs:
    """Returns the inputs of a run that can be executed again, see `explain_no_repetition`.

    Raises:
        LogError: the log names a change that is none.
    """
    ticks = max(len(log[name]) for name in log.sites)
    listed = [
        (tick * NS_PER_S // log[name].rate_hz, (tick, i, change))
        for i, name in enumerate(log.scenario.names)
        for tick, taken in log.commands(name).items()
        for change in taken
    ]
    changes = [one for _, one in sorted(listed, key=lambda timed: timed[0])]
    models = [change.model for _, _, change in changes if change.model is not None]
    first, samples, late_ns = _list_arrivals(log, ticks)
    return RunInputs(
        RecordedFeed(first, samples, *_stack_hands(log, ticks)),
        changes,
        late_ns,
        max_delay_us(models, [None] * len(models)) if models else 0,
    )


def _list_arrivals(log: Log, ticks: int) -> tuple[IntArray, IntArray, int]:
    """Returns arrivals as a feed has them, and by how much the latest came after its stamp, ns.

    A run in virtual time has none to list: there every sample came at once.
    """
    names = log.scenario.names
    peers = max(len(names) - 1, 1)
    virtual = log.driver == "virtual"
    first = np.zeros((len(names), peers, 0 if virtual else ticks + 1), dtype=np.int64)
    listed: list[IntArray] = []
    total = late_ns = 0
    for i, part in enumerate([] if virtual else [log[name] for name in names]):
        counts, rows = part.arrivals
        came = np.repeat(part.tick, counts)
        for p, peer in enumerate(part.peers):
            known = (rows[:, 0] == p) & (rows[:, 1] >= 0) & (rows[:, 1] <= log[peer].last_tick)
            sent, stamps_ns = rows[known, 1], rows[known, 1] * NS_PER_S // log[peer].rate_hz
            at = np.maximum(came[known], -(-(stamps_ns + 1) * part.rate_hz // NS_PER_S))
            order = np.argsort(at, kind="stable")
            first[i, p] = total + np.searchsorted(at[order], np.arange(ticks + 1))
            listed.append(sent[order])
            total += len(sent)
            late_ns = max(late_ns, int((at * NS_PER_S // part.rate_hz - stamps_ns).max(initial=0)))
    return first, np.concatenate([*listed, np.zeros(0, np.int64)]), late_ns


def _stack_hands(log: Log, ticks: int) -> tuple[Array, IntArray]:
    setups = [log.scenario.setup(name)._replace(own=None) for name in log.scenario.names]
    live = [[n for n, one in enumerate(setup.actors) if one.acts in LIVE_KINDS] for setup in setups]
    size = max((setup.layout.hand - 3) // 2 for setup in setups)
    if not any(live):
        return np.zeros((len(setups), 0, 1)), np.full(len(setups), -1)
    hands = np.zeros((len(setups), ticks, 1 + 2 * size))
    for i, name in enumerate(log.scenario.names):
        if live[i]:
            own, acted = (setups[i].layout.hand - 3) // 2, log[name].hand
            target, rate = acted[:, 3 : 3 + own], acted[:, 3 + own :]
            hands[i, : len(acted), 0] = acted[:, 0]
            hands[i, : len(acted), 1 : 1 + own] = target
            hands[i, : len(acted), 1 + size : 1 + size + own] = target + rate
    return hands, np.array([one[0] if one else -1 for one in live])
