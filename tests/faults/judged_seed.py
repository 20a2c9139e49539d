"""The judgement of one seed: its session is run twice, and every invariant is checked."""

import gc
import hashlib
import math
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

from tests.faults.fault_schedule import describe_faults

from .fault_schedule import WHOLE, ArmSettings, Fault, Timetable, draw_faults, draw_settings
from .fault_session import DEFAULT_ARMS, FaultSession, run_faults
from .invariants import INVARIANTS, START_TICKS, check_torque, find_holds, largest_steps
from .rest_invariants import find_rises

TORQUE = "I6 torque"
AGAIN = "I11 again"


class Judged(NamedTuple):
    """The result of a session with faults.

    Attributes:
        faults: The faults of the session.
        arms: The settings of its arms.
        violations: Descriptions by invariant; empty if all invariants held.
        visited: Counts of entered modes, events, dropped messages, and ends of sites.
        holds: Ticks from the last sample that came into use to each hold.
        steps_nm: The largest step of a torque between ticks, by mode.
        rises_j: Rise of the storage in a tick of a hold, as returned by `find_rises`.
    """

    faults: Sequence[Fault]
    arms: ArmSettings
    violations: dict[str, list[str]]
    visited: Counter[str]
    holds: list[int]
    steps_nm: dict[str, float]
    rises_j: tuple[float, float]

    def __str__(self) -> str:
        lines = [
            f"  {name}: {text}" for name, texts in self.violations.items() for text in texts[:3]
        ]
        return "\n".join([f"  {self.arms}", describe_faults(self.faults), *lines])


def judge_seed(seed: int, *, again: bool = True, timetable: Timetable = WHOLE) -> Judged:
    faults = draw_faults(seed, timetable)
    arms = draw_settings(seed) if timetable == WHOLE else DEFAULT_ARMS
    return judge_faults(faults, seed, again=again, timetable=timetable, arms=arms)


def time_seed(seed: int) -> tuple[Judged, float]:
    """Judges the faults of a seed, run twice; also returns the processor time, s."""
    find_undisturbed_step()
    began_s = time.process_time()
    return judge_seed(seed), time.process_time() - began_s


def judge_faults(
    faults: Sequence[Fault],
    seed: int = 0,
    *,
    again: bool = False,
    timetable: Timetable = WHOLE,
    arms: ArmSettings = DEFAULT_ARMS,
) -> Judged:
    undisturbed_nm = find_undisturbed_step(timetable)
    with collector_at_rest():
        with tempfile.TemporaryDirectory() as folder:
            session = run_faults(faults, Path(folder), seed, timetable, arms)
            violations_by_name = {
                name: list(check(session)) for name, check in INVARIANTS.items()
            }
            violations_by_name[TORQUE] = list(check_torque(session, undisturbed_nm))
            digest = digest_session(session)
        if again:
            with tempfile.TemporaryDirectory() as folder:
                if (
                    digest_session(run_faults(faults, Path(folder), seed, timetable, arms))
                    != digest
                ):
                    violations_by_name[AGAIN] = [
                        "the same seed publishes or records other bytes"
                    ]
        violations = {name: texts for name, texts in violations_by_name.items() if texts}
        rises_j = [rises for _, rises in find_rises(session)] or [(-math.inf, -math.inf)]
        return Judged(
            faults,
            arms,
            violations,
            count_visited(session),
            list(find_holds(session)),
            largest_steps(session.published, 0),
            (
                float(max(at_rest for at_rest, _ in rises_j)),
                float(max(before for _, before in rises_j)),
            ),
        )


@contextmanager
def collector_at_rest() -> Iterator[None]:
    """Suspends the garbage collector, as in a live site, and collects once at the end."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.collect()


@cache
def find_undisturbed_step(timetable: Timetable = WHOLE) -> float:
    """Returns the largest step of a torque in the session without faults, after its first 0.1 s, N m."""
    with tempfile.TemporaryDirectory() as folder:
        undisturbed = run_faults((), Path(folder), timetable=timetable)
        return max(largest_steps(undisturbed.published, START_TICKS).values())


def digest_session(session: FaultSession) -> str:
    """Returns the SHA-256 of all published messages, and of the log as far as it was written."""
    digest = hashlib.sha256()
    for payload in session.payloads():
        digest.update(payload)
    for path in sorted(session.path.parent.glob("run*")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def count_visited(session: FaultSession) -> Counter[str]:
    visited: Counter[str] = Counter()
    for states in session.published.states.values():
        before = ""
        for state in states:
            if state.mode != before:
                visited[f"mode {state.mode}"] += 1
            before = state.mode
    visited.update(f"event {event.kind}" for event in session.published.events)
    visited.update(f"dropped {reason}" for reason in session.dropped())
    visited.update(f"fault {fault.kind}" for fault in session.faults)
    visited.update(f"end {type(end).__name__}" for end in (session.ends or {}).values())
    return visited
