"""Shares a slave between a program and a person who take turns to lead, without jumps.

The program moves master m2 along a circle. A person moves master m1; here a second program
takes the person's place (with `--alone`, move m1 with the mouse on the page). The slave's row
of the dominance matrix decides who leads, and changes along ramps of one second. The example
prints the largest step of each site's reference from one tick to the next, once while the lead
is constant and once while it changes. Run two terminals:

    trilat demo play --duration 60
    python examples/policy_hand.py play
"""

import argparse
import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np

import trilat_net as tn

PERIOD_S = 0.016
RAMP_S = 1.0
SPARE_S = 0.5
"""Time after a ramp until its effect has reached all sites, in s."""
RADIUS_M = 0.10
TURN_S = 3.0
"""Time for one turn around the circle, in s."""


def circle(start: Sequence[float], t_s: float, radius_m: float) -> tuple[float, float]:
    """Returns a position on a circle through the start. The radius grows during one turn."""
    angle = 2.0 * math.pi * t_s / TURN_S
    radius = radius_m * min(1.0, t_s / TURN_S)
    return start[0] - radius * (1.0 - math.cos(angle)), start[1] + radius * math.sin(angle)


class References:
    """Steps of the references of all sites, from one tick to the next.

    Attributes:
        steps: for each site, the time (s) and the size (rad) of every step.
        now_s: time of the newest record, in s.
    """

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, np.ndarray]] = {}
        self.steps: dict[str, list[tuple[float, float]]] = {}
        self.now_s = 0.0

    def add(self, records: Iterable[Any]) -> None:
        """Adds the steps of new records."""
        for record in records:
            q_des = np.array(record.q_des)
            last_tick, last_q_des = self._last.get(record.site, (-2, q_des))
            self.now_s = record.t_ns * 1e-9
            if record.tick == last_tick + 1:
                step = float(np.abs(q_des - last_q_des).max())
                self.steps.setdefault(record.site, []).append((self.now_s, step))
            self._last[record.site] = record.tick, q_des

    def largest(self, site: str, spans: Sequence[tuple[float, float]]) -> float:
        """Returns the largest step of a site's reference during some spans of time, in rad."""
        largest = 0.0
        for t_s, step in self.steps[site]:
            if any(start_s <= t_s <= end_s for start_s, end_s in spans):
                largest = max(largest, step)
        return largest


def main() -> None:
    """Connects both operators, moves the arms, and prints the largest steps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    parser.add_argument("--alone", action="store_true", help="let a real person move m1")
    parser.add_argument(
        "--seconds", type=float, default=15.0, help="duration; the lead changes at each third"
    )
    options = parser.parse_args()
    name = options.session
    connect = options.connect
    session = tn.session(name, connect=connect)
    program_hand = tn.hand(name, "m2", source="policy", connect=connect)
    person_hand: Any = nullcontext(None)
    if not options.alone:
        person_hand = tn.hand(name, "m1", source="person", connect=connect)
    with program_hand as program, person_hand as person:
        references, ramps = lead(
            session=session,
            program=program,
            person=person,
            seconds=options.seconds,
            now_s=time.monotonic,
            wait_s=time.sleep,
        )
    report(references, ramps)


def lead(
    session: Any,
    program: Any,
    person: Any,
    seconds: float,
    now_s: Callable[[], float],
    wait_s: Callable[[float], None],
) -> tuple[References, Sequence[tuple[float, float]]]:
    """Moves both masters for some time, and changes the lead at each third.

    Args:
        session: the running session.
        program: the operator of m2.
        person: the operator of m1. `None` if a real person moves m1.
        seconds: duration, in s.
        now_s: returns the present time, in s.
        wait_s: waits for a time, in s.

    Returns:
        The references of all sites, and the spans of time in which the lead changed.
    """
    references = References()
    ramps = []
    planned_changes = iter([(seconds / 3.0, "m1"), (2.0 * seconds / 3.0, "m2")])
    change_s, leader = next(planned_changes)
    program_start = program.pose
    person_start = (0.0, 0.0) if person is None else person.pose
    start_s = now_s()
    with session.records() as read_records:
        while (t_s := now_s() - start_s) < seconds and not program.over:
            program.move(*circle(program_start, t_s, RADIUS_M))
            if person is not None:
                person.move(*circle(person_start, t_s, 1.3 * RADIUS_M))
            references.add(read_records())
            if t_s >= change_s:
                weights = {"m1": 0.1, "m2": 0.9}
                if leader == "m1":
                    weights = {"m1": 0.9, "m2": 0.1}
                reply = session.set_dominance("s", weights, RAMP_S)
                ramps.append((references.now_s, references.now_s + RAMP_S + SPARE_S))
                print(f"{leader} leads: {reply}")
                change_s, leader = next(planned_changes, (math.inf, ""))
            wait_s(PERIOD_S)
        references.add(read_records())
    return references, ramps


def report(references: References, ramps: Sequence[tuple[float, float]]) -> None:
    """Prints the largest step of each reference, with a constant and with a changing lead."""
    first_s = min(steps[0][0] for steps in references.steps.values()) + TURN_S / 2.0
    starts_s = [first_s, *(end_s for _, end_s in ramps)]
    ends_s = [*(start_s for start_s, _ in ramps), math.inf]
    constant_spans = list(zip(starts_s, ends_s, strict=True))
    for site in sorted(references.steps):
        constant = references.largest(site, constant_spans)
        changing = references.largest(site, ramps)
        print(
            f"{site}: q_id steps by {1e3 * constant:.4f} mrad at most while somebody leads, "
            f"{1e3 * changing:.4f} while the lead changes: {changing / constant:.2f} times"
        )


if __name__ == "__main__":
    main()
