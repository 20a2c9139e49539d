"""Invariants of every session under any faults: laws of its records, tick by tick.

Each invariant examines the messages of the sites, as seen on a way without faults, or the log.
"""

from collections.abc import Callable, Iterator, Sequence, Set
from itertools import groupby, pairwise

import msgspec
import numpy as np

from trilat_net.errors import TrilatError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log
from trilat_net.net.messages import State
from trilat_net.scenario import Scenario

from .fault_schedule import SITES
from .fault_session import FaultSession, Published
from .rest_invariants import (
    RESIDUAL,
    RESTING,
    check_energy,
    check_rest,
    check_speed,
    check_storage,
    check_travel,
)

SILENT_TICKS = 20
_LIFE = {
    ("waiting", "return"),
    ("return", "run"),
    ("return", "hold"),
    ("run", "hold"),
    ("hold", "return"),
}
_FREE = ("waiting", "return", "run", "hold")
LEGAL = {
    *_LIFE,
    *((mode, latched) for mode in _FREE for latched in ("fault", "stopped")),
    *((latched, after) for latched in ("fault", "stopped") for after in ("waiting", "return")),
    ("stopped", "fault"),
}
"""How a site may change its mode; every start begins with `waiting`."""
STEP_SHARE = 1.1
"""The largest permitted step of a torque between ticks, relative to the run without faults."""
START_TICKS = 100
FAST_ENOUGH_RAD_S = 5.0
"""A limit of speed that no arm exceeds by itself."""
QUICK_ENOUGH_NM_S = 300.0
"""Below this limit of a torque's rate the law itself may swing up as it follows."""


def split_stretches(states: Sequence[State]) -> Iterator[list[State]]:
    for _, of_boot in groupby(states, key=lambda state: state.boot):
        yield list(of_boot)


def check_edges(session: FaultSession) -> Iterator[str]:
    """I1: modes change only along the edges of `session_life`."""
    for name, states in session.published.states.items():
        for stretch in split_stretches(states):
            # it may be ordered before its first tick
            if stretch[0].mode not in (
                "waiting",
                "stopped",
            ):
                yield f"{name} begins with {stretch[0].mode} at tick {stretch[0].tick}"
            for before, after in pairwise(stretch):
                if before.mode != after.mode and (before.mode, after.mode) not in LEGAL:
                    yield f"{name} goes from {before.mode} to {after.mode} at tick {after.tick}"


def check_limits(session: FaultSession) -> Iterator[str]:
    """I2: published numbers are finite and within the limits, except the speed that made a
    fault.
    """
    for name, states in session.published.states.items():
        setup = session.scenario.setup(name)
        keys = ("q", "qd", "tau", "q_des", "qd_des")
        rows = {key: np.array([getattr(state, key) for state in states]) for key in keys}
        finite = np.isfinite(np.hstack(list(rows.values()))).all(axis=1)
        within = (np.abs(rows["tau"]) <= setup.tau_limit_nm).all(axis=1)
        slow = (np.abs(rows["qd"]) <= setup.qd_limit_rad_s).all(axis=1)
        within &= slow | np.array([state.mode == "fault" for state in states])
        for row in np.flatnonzero(~finite):
            yield f"{name} publishes what is not finite at tick {states[row].tick}"
        for row in np.flatnonzero(~within):
            yield f"{name} is beyond its limits at tick {states[row].tick}"


def count_silence(stretch: Sequence[State]) -> Iterator[tuple[State, int]]:
    """Yields the records of a start, each with the age in ticks of its most silent peer's last
    sample.
    """
    used = dict(stretch[0].used)
    since = dict.fromkeys(stretch[0].used, stretch[0].tick)
    for state in stretch:
        for peer, tick in state.used.items():
            if tick != used[peer]:
                used[peer] = tick
                since[peer] = state.tick
        yield state, state.tick - min(since.values())


def check_silence(session: FaultSession) -> Iterator[str]:
    """I3 and I7: a site follows only if a sample of every peer came into use within the last 20
    ticks.
    """
    for name, states in session.published.states.items():
        for stretch in split_stretches(states):
            for state, silent in count_silence(stretch):
                if state.mode in ("run", "return") and (
                    silent > SILENT_TICKS or min(state.used.values()) < 0
                ):
                    yield f"{name} is in {state.mode} at tick {state.tick}, {silent} ticks after a new sample"


def find_holds(session: FaultSession) -> Iterator[int]:
    """Returns, for every hold, the ticks since the last sample of a peer came into use."""
    for states in session.published.states.values():
        for stretch in split_stretches(states):
            before = ""
            for state, silent in count_silence(stretch):
                if state.mode == "hold" != before:
                    yield silent
                before = state.mode


def check_order(session: FaultSession) -> Iterator[str]:
    """I4: the samples in use of a peer never go back, nor beyond the present."""
    for name, states in session.published.states.items():
        for stretch in split_stretches(states):
            for before, after in pairwise(stretch):
                if any(after.used[peer] < used for peer, used in before.used.items()):
                    yield f"{name} goes back to an older sample at tick {after.tick}"
                if max(after.used.values()) > after.tick:
                    yield f"{name} uses a sample of the future at tick {after.tick}"


def largest_steps(published: Published, from_tick: int) -> dict[str, float]:
    """Returns the largest step of a torque between ticks, N m, by mode, in all starts, from a
    tick on.

    The first 0.1 s of a start count as the mode `start`.
    """
    most: dict[str, float] = {}
    for states in published.states.values():
        for stretch in split_stretches(states):
            tau = np.array([state.tau for state in stretch])
            steps = np.abs(np.diff(tau, axis=0)).max(axis=1, initial=0.0)
            modes = np.array(
                ["start" if n < START_TICKS else state.mode for n, state in enumerate(stretch)][
                    1:
                ]
            )
            for mode in set(modes[from_tick:]):
                largest = float(steps[from_tick:][modes[from_tick:] == mode].max())
                most[str(mode)] = max(most.get(mode, 0.0), largest)
    return most


def check_torque(session: FaultSession, undisturbed_nm: float) -> Iterator[str]:
    """I6: the torque steps by no more than its rate allows, or little more than without faults.

    An arm that comes to rest may in addition step by its braking torque: B |qd| against its
    motion.
    """
    allowed_nm = allowed_step(session.scenario, undisturbed_nm) * (1.0 + RESIDUAL)
    for name, states in session.published.states.items():
        still = session.scenario.setup(name).rest
        assert still is not None
        for stretch in split_stretches(states):
            tau, qd = (
                np.array([getattr(state, key) for state in stretch]) for key in ("tau", "qd")
            )
            resting = np.array([state.mode in RESTING for state in stretch])[1:, None]
            steps = np.diff(tau, axis=0)
            brake = -np.asarray(still.damping) * qd[1:] * resting
            beyond = (
                np.maximum(steps - np.maximum(brake, 0.0), np.minimum(brake, 0.0) - steps)
                > allowed_nm
            )
            for row in np.flatnonzero(beyond.any(axis=1))[:1]:
                most = np.abs(steps[row]).max()
                at = stretch[row + 1]
                yield f"{name}: a torque steps by {most:.4g} N m at tick {at.tick} in {at.mode}"


def allowed_step(scenario: Scenario, undisturbed_nm: float) -> float:
    """Returns the largest allowed step of a torque between ticks without brakes, N m."""
    setup = scenario.setup(SITES[0])
    return max(
        STEP_SHARE * undisturbed_nm, float(np.max(setup.limits.tau_rate)) / setup.rate_hz
    )


def check_liveness(session: FaultSession) -> Iterator[str]:
    """I8: once all faults are mended, all sites follow each other, or are in fault by tight
    limits.

    Arms that start fast may come to rest farther apart than sites approach on their own: they
    wait.
    """
    rate_hz = session.scenario.sites[SITES[0]].rate_hz
    timetable = session.timetable
    last = round(timetable.length_s * rate_hz)
    limits = session.scenario.setup(SITES[0])
    tight = np.max(limits.qd_limit_rad_s) < FAST_ENOUGH_RAD_S
    tight |= np.min(limits.limits.tau_rate) < QUICK_ENOUGH_NM_S
    tight &= any(states[-1].mode == "fault" for states in session.published.states.values())
    starts_fast = any(limits.qd0)
    for name, states in session.published.states.items():
        modes = {
            state.mode for state in states if state.tick >= last - timetable.engaged_s * rate_hz
        }
        if starts_fast and "waiting" in modes and modes <= {"hold", "run", "return", "waiting"}:
            continue
        if modes != {"run"} and not (
            tight and modes <= {"hold", "run", "return", "waiting", "fault"}
        ):
            yield f"{name} ends in {' and '.join(sorted(modes)) or 'silence'}"


def check_starts(session: FaultSession) -> Iterator[str]:
    """I9: the starts of a site follow one another, and every tick occurs once."""
    for name, states in session.published.states.items():
        boots = [boot for boot, _ in groupby(states, key=lambda state: state.boot)]
        if len(set(boots)) < len(boots):
            yield f"{name}: two starts at one time"
        for before, after in pairwise(states):
            if after.tick <= before.tick:
                yield f"{name} makes tick {after.tick} after {before.tick}"


def check_log(session: FaultSession) -> Iterator[str]:
    """I10: published records stand in the log, or are counted; and every record follows from
    its inputs.
    """
    if any(fault.kind == "full disk" for fault in session.faults):
        return  # its log ends where the disk does
    try:
        log = open_log(session.path)
        verification = verify_log(log)
    except TrilatError as error:
        yield f"the log cannot be read: {error}"
        return
    fed = {fault.of[1] for fault in session.faults if fault.kind == "nonsense"}
    altered = {
        name: find_altered(states, log[name].states)
        for name, states in session.published.states.items()
    }
    if verification.differing and not fed:
        yield f"{verification.differing} records differ when they are executed again"
    if any(altered.values()):
        if "recorder" not in fed:
            yield f"records in the log are not as they were published: {altered}"
        elif not verification.differing:
            yield f"nobody finds records that came otherwise than they were made: {altered}"
        return
    touched = any("recorder" in fault.of or fault.kind == "cut all" for fault in session.faults)
    for name in session.published.states:
        recorded_ticks = set(log[name].tick.tolist())
        lost = len(find_heard(session.published, name, recorded_ticks) - recorded_ticks)
        if lost != log.missing(name) or (lost and not touched):
            yield f"{name}: {lost} records are not in the log, which counts {log.missing(name)}"


def find_heard(published: Published, name: str, recorded: Set[int]) -> set[int]:
    """Returns the ticks of a site's records that another member knows.

    Of a killed start these are the ticks up to the newest one that reached a site which is
    present when the next start begins. Records that no member received before the kill do not
    count, and neither do the last 20 ms if they are all that is not `there`.
    """
    starts = list(split_stretches(published.states[name]))
    heard = {state.tick for state in starts[-1]}
    for start, following in pairwise(starts):
        newest_ticks = [start[0].tick - 1]
        for other, states in published.states.items():
            first_unheard = (
                [peer for peer in published.states if peer != other].index(name)
                if other != name
                else -1
            )
            for stretch in split_stretches(states) if other != name else ():
                if stretch[-1].tick >= following[0].tick:
                    newest_ticks += [
                        tick
                        for state in stretch
                        for peer, tick, _ in state.rx
                        if peer == first_unheard
                    ]
        newest = max(tick for tick in newest_ticks if tick <= start[-1].tick)
        last = max((tick for tick in recorded if tick <= newest), default=-1)
        newest = last if newest - last <= SILENT_TICKS else newest
        heard |= {state.tick for state in start if state.tick <= newest}
    return heard


TELEMETRY = {"late_us": 0, "busy_us": 0, "sent_ns": 0, "echo": []}
"""Fields of a record that no execution reproduces, and that enter no computation."""


def find_altered(published: Sequence[State], recorded: Sequence[State]) -> list[int]:
    records = {state.tick: state for state in published}
    others = [state for state in recorded if records.get(state.tick) != state]
    same = msgspec.structs.replace
    return [
        state.tick
        for state in others
        if state.tick not in records
        or same(state, **TELEMETRY) != same(records[state.tick], **TELEMETRY)
    ]


Invariant = Callable[[FaultSession], Iterator[str]]

INVARIANTS: dict[str, Invariant] = {
    "I1 edges": check_edges,
    "I2 limits": check_limits,
    "I3, I7 silence": check_silence,
    "I4 order": check_order,
    "I5 storage": check_storage,
    "I8 liveness": check_liveness,
    "I9 starts": check_starts,
    "I10 log": check_log,
    "I12 energy": check_energy,
    "I13 rest": check_rest,
    "I14 travel": check_travel,
    "I15 speed": check_speed,
}
