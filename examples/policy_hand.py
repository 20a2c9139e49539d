"""A program as second user: it leads the slave, a person takes over and gives back, and no reference jumps.

The program holds m2 and follows a circle with it. A person (here a second hand with a path of its own; leave
it out with `--alone` and use the mouse) holds m1. Who of the two leads the slave is its row of the dominance
matrix, changed by ramps of a second. The example prints the largest step of every reference q_id from tick to
tick, while somebody leads and while the lead changes. Two terminals:

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
RAMP_S, SPARE_S = 1.0, 0.5
RADIUS_M, TURN_S = 0.10, 3.0


def circle(start: Sequence[float], t_s: float, radius_m: float) -> tuple[float, float]:
    """Returns a point on a circle through the start, which it leaves slowly."""
    angle = 2.0 * math.pi * t_s / TURN_S
    size = radius_m * min(1.0, t_s / TURN_S)
    return start[0] - size * (1.0 - math.cos(angle)), start[1] + size * math.sin(angle)


class References:
    """The references of all sites, tick by tick, and how far they step."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, np.ndarray]] = {}
        self.steps: dict[str, list[tuple[float, float]]] = {}
        self.now_s = 0.0

    def add(self, records: Iterable[Any]) -> None:
        """Takes in records that have come."""
        for record in records:
            q_des = np.array(record.q_des)
            tick, before = self._last.get(record.site, (-2, q_des))
            self.now_s = record.t_ns * 1e-9
            if record.tick == tick + 1:
                step = float(np.abs(q_des - before).max())
                self.steps.setdefault(record.site, []).append((self.now_s, step))
            self._last[record.site] = record.tick, q_des

    def largest(self, site: str, spans: Sequence[tuple[float, float]]) -> float:
        """Returns the largest step of a site's reference within some times, rad."""
        within = (
            step for t_s, step in self.steps[site] if any(a <= t_s <= b for a, b in spans)
        )
        return max(within, default=0.0)


def main() -> None:
    """Leads the slave, hands over, and takes back."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as in play")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    parser.add_argument("--alone", action="store_true", help="leave m1 to a real person")
    parser.add_argument(
        "--seconds", type=float, default=15.0, help="in all; the lead changes at each third"
    )
    options = parser.parse_args()
    name, reached = options.session, {"connect": options.connect}
    session = tn.session(name, **reached)
    person = (
        nullcontext(None) if options.alone else tn.hand(name, "m1", source="person", **reached)
    )
    with tn.hand(name, "m2", source="policy", **reached) as program, person as other:
        report(*lead(session, program, other, options.seconds, time.monotonic, time.sleep))


def lead(
    session: Any,
    program: Any,
    person: Any,
    seconds: float,
    now_s: Callable[[], float],
    wait_s: Callable[[float], None],
) -> tuple[References, Sequence[tuple[float, float]]]:
    """Moves both hands for some time; returns the references, and when the lead changed, s."""
    references, ramps = References(), []
    leads = iter([(seconds / 3.0, "m1"), (2.0 * seconds / 3.0, "m2")])
    change_s, leader = next(leads)
    first, start = program.pose, (0.0, 0.0) if person is None else person.pose
    begun_s = now_s()
    with session.records() as take:
        while (t_s := now_s() - begun_s) < seconds and not program.over:
            program.move(*circle(first, t_s, RADIUS_M))
            if person is not None:
                person.move(*circle(start, t_s, 1.3 * RADIUS_M))
            references.add(take())
            if t_s >= change_s:
                shares = {"m1": 0.9, "m2": 0.1} if leader == "m1" else {"m1": 0.1, "m2": 0.9}
                said = session.set_dominance("s", shares, RAMP_S)
                ramps.append((references.now_s, references.now_s + RAMP_S + SPARE_S))
                print(f"{leader} leads: {said}")
                change_s, leader = next(leads, (math.inf, ""))
            wait_s(PERIOD_S)
        references.add(take())
    return references, ramps


def report(references: References, ramps: Sequence[tuple[float, float]]) -> None:
    """Prints how far each reference stepped from tick to tick, while the lead changed and between."""
    first_s = min(steps[0][0] for steps in references.steps.values()) + TURN_S / 2.0
    ends = [first_s, *(end_s for _, end_s in ramps)]
    still = list(zip(ends, [*(start_s for start_s, _ in ramps), math.inf], strict=True))
    for site in sorted(references.steps):
        moving, changing = references.largest(site, still), references.largest(site, ramps)
        print(
            f"{site}: q_id steps by {1e3 * moving:.4f} mrad at most while somebody leads, "
            f"{1e3 * changing:.4f} while the lead changes: {changing / moving:.2f} times"
        )


if __name__ == "__main__":
    main()
