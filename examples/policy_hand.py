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
from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np

from sites.running_session import open_hand
from trilat_net.net import topics
from trilat_net.net.arm_port import Hand
from trilat_net.net.bus import Bus, Inbox
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import resolve_member_connection
from trilat_net.net.discovery import connect_to_session, find_site_info, send_change
from trilat_net.net.messages import State
from trilat_net.net.requests import ChangeRequest
from trilat_net.net.wire import decode, split_states
from trilat_net.scenario import Scenario, parse_embedded

PERIOD_NS = 16_000_000
RAMP_S, AHEAD_S = 1.0, 0.1
RADIUS_M, TURN_S = 0.10, 3.0


def circle(start: Sequence[float], t_s: float, radius_m: float) -> tuple[float, float]:
    """Returns a point on a circle through the start, which it leaves slowly."""
    angle = 2.0 * math.pi * t_s / TURN_S
    size = radius_m * min(1.0, t_s / TURN_S)
    return start[0] - size * (1.0 - math.cos(angle)), start[1] + size * math.sin(angle)


class References:
    """The references of all sites, tick by tick, and how far they step."""

    def __init__(self, bus: Bus, session: str) -> None:
        self._inbox: Inbox = bus.inbox(topics.key(session, "*", topics.STATE), 4096)
        self._last: dict[str, tuple[int, np.ndarray]] = {}
        self.steps: dict[str, list[tuple[float, float]]] = {}

    def poll(self) -> None:
        """Takes in the records that have come."""
        while (message := self._inbox.poll()) is not None:
            for payload in split_states(message[1]):
                record = decode(payload, State)
                q_des = np.array(record.q_des)
                tick, before = self._last.get(record.site, (-2, q_des))
                if record.tick == tick + 1:
                    step = float(np.abs(q_des - before).max())
                    self.steps.setdefault(record.site, []).append((record.t_ns * 1e-9, step))
                self._last[record.site] = record.tick, q_des

    def largest(self, site: str, spans: Sequence[tuple[float, float]]) -> float:
        """Returns the largest step of a site's reference within some times, rad."""
        within = (step for t_s, step in self.steps[site] if any(a <= t_s <= b for a, b in spans))
        return max(within, default=0.0)


def main() -> None:
    """Leads the slave, hands over, and takes back."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as in play")
    parser.add_argument("--connect", action="append", help="endpoint of the session; repeatable")
    parser.add_argument("--alone", action="store_true", help="leave m1 to a real person")
    parser.add_argument("--seconds", type=float, default=15.0, help="in all; the lead changes at each third")
    options = parser.parse_args()
    clock, session = SystemClock(), options.session
    connection = resolve_member_connection(None, options.connect, None, None, [], None)

    def names(text: str) -> tuple[str, ...]:
        return parse_embedded(text, session).names

    reached = connect_to_session(connection, clock, session, names, stopped=lambda: False, timeout_s=10.0)
    with reached as bus:
        assert bus is not None
        scenario = parse_embedded(find_site_info(bus, clock, session, "s", names).scenario, session)
        report(*lead(bus, clock, session, scenario, options.seconds, alone=options.alone))


def lead(
    bus: Bus, clock: Clock, session: str, scenario: Scenario, seconds: float, *, alone: bool
) -> tuple[References, Sequence[tuple[float, float]]]:
    """Moves both hands for some time; returns the references, and when the lead changed, s."""
    references, ramps = References(bus, session), []
    with ExitStack() as stack:
        program = stack.enter_context(open_hand(bus, clock, session, "m2", scenario, "policy"))
        person: Hand | None = None
        if not alone:
            person = stack.enter_context(open_hand(bus, clock, session, "m1", scenario, "person"))
        leads = iter([(seconds / 3.0, "m1"), (2.0 * seconds / 3.0, "m2")])
        change_s, leader = next(leads)
        first, start = program.pose, (0.0, 0.0) if person is None else person.pose
        begun_ns = clock.monotonic_ns()
        while (t_s := 1e-9 * (clock.monotonic_ns() - begun_ns)) < seconds and not program.over:
            program.move(*circle(first, t_s, RADIUS_M))
            if person is not None:
                person.move(*circle(start, t_s, 1.3 * RADIUS_M))
            references.poll()
            if t_s >= change_s:
                shares = {"m1": 0.9, "m2": 0.1} if leader == "m1" else {"m1": 0.1, "m2": 0.9}
                reply = send_change(
                    bus, clock, session, "s", ChangeRequest(dominance="s", to=shares, ramp_s=RAMP_S)
                )
                from_s = reply.tick / scenario.sites["s"].rate_hz
                ramps.append((from_s, from_s + RAMP_S))
                print(f"{leader} leads from t = {from_s:.3f} s on, by a ramp of {RAMP_S:g} s")
                change_s, leader = next(leads, (math.inf, ""))
            clock.sleep_until(clock.monotonic_ns() + PERIOD_NS)
        references.poll()
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
