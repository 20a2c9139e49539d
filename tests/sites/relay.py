"""Many members on one clock, one at a time: live loops beside each other, with the same run
every time.

A member that sleeps hands over to the member whose deadline is next; equal deadlines go in
order of joining. Work takes no time, so that no member is ever late, unless a test uses
`stall`. Members are greenlets of one thread: to hand over costs less than a microsecond.
"""

import heapq
from collections.abc import Callable

from greenlet import greenlet

LONGEST_NS = 3_600 * 10**9
"""A time that no session of a test reaches."""


class Relay:
    """Time shared by runners, of which one runs at a time; events happen between them."""

    def __init__(
        self, start_ns: int = 10**9, epoch_unix_ns: int = 1_700_000_000_000_000_000
    ) -> None:
        self.now_ns = start_ns
        self._epoch_unix_ns = epoch_unix_ns
        self._deadlines: dict[int, int] = {}
        self._runners: list[greenlet] = []
        self._happenings: list[tuple[int, int, Callable[[], None]]] = []
        self._numbered = 0
        self._failed: list[BaseException] = []
        self.results: dict[str, object] = {}

    def add(
        self, name: str, run: Callable[["RelayClock"], object], at_ns: int = 0
    ) -> "RelayClock":
        """Adds a runner that begins at a time; `run` gets its clock."""
        seat = len(self._runners)
        clock = RelayClock(self, seat)

        def body() -> None:
            try:
                self._pass_time(seat)
                self.results[name] = run(clock)
            except BaseException as error:
                self._failed.append(error)
            finally:
                del self._deadlines[seat]

        self._deadlines[seat] = max(at_ns, self.now_ns)
        self._runners.append(greenlet(body))
        return clock

    def happens(self, at_ns: int, act: Callable[[], None]) -> None:
        self._numbered += 1
        heapq.heappush(self._happenings, (max(at_ns, self.now_ns), self._numbered, act))

    def run(self) -> dict[str, object]:
        while self._deadlines:
            self._runners[self._next()].switch()
        if self._failed:
            raise self._failed[0]
        return self.results

    def set_start(self, seat: int, at_ns: int) -> None:
        self._deadlines[seat] = max(at_ns, self.now_ns)

    def _pass_time(self, seat: int) -> None:
        """Advances the time to this runner's deadline, and runs the events until then."""
        deadline_ns = self._deadlines[seat]
        while self._happenings and self._happenings[0][0] <= deadline_ns:
            at_ns, _, act = heapq.heappop(self._happenings)
            self.now_ns = max(self.now_ns, at_ns)
            act()
        self.now_ns = max(self.now_ns, deadline_ns)
        if self.now_ns > LONGEST_NS:
            raise TimeoutError("an hour has passed: somebody waits for what never comes")

    def sleep(self, seat: int, deadline_ns: int) -> None:
        """Returns when no other runner has a deadline before this runner's."""
        self._deadlines[seat] = max(deadline_ns, self.now_ns)
        if (following := self._next()) != seat:
            self._runners[following].switch()
        self._pass_time(seat)

    def _next(self) -> int:
        return min(self._deadlines, key=lambda seat: (self._deadlines[seat], seat))

    def unix_ns(self) -> int:
        return self._epoch_unix_ns + self.now_ns


class Killed(Exception):  # noqa: N818 - it is no error of the program
    """Ends a runner at its next sleep."""


class RelayClock:
    def __init__(self, relay: Relay, seat: int) -> None:
        self._relay = relay
        self._seat = seat
        self._stalls: list[tuple[int, int]] = []
        self._acts: list[tuple[int, Callable[[], None]]] = []
        self.dies_ns: int | None = None
        """The time at which the clock's runner is killed."""
        self.wall_ahead_ns = 0
        """The offset of the wall clock; the monotonic clock has none."""

    def begins(self, at_ns: int) -> None:
        self._relay.set_start(self._seat, at_ns)

    def stall(self, at_ns: int, for_ns: int) -> None:
        """Delays the end of the first sleep that would end at or after a time."""
        self._stalls.append((at_ns, for_ns))

    def at(self, at_ns: int, act: Callable[[], None]) -> None:
        self._acts.append((at_ns, act))

    def monotonic_ns(self) -> int:
        return self._relay.now_ns

    def unix_ns(self) -> int:
        return self._relay.unix_ns() + self.wall_ahead_ns

    def identity(self) -> str:
        return "relay"

    def sleep_until(self, deadline_ns: int) -> None:
        if self._stalls and deadline_ns >= self._stalls[0][0]:
            deadline_ns += self._stalls.pop(0)[1]
        if deadline_ns > self._relay.now_ns:
            self._relay.sleep(self._seat, deadline_ns)
        while self._acts and self._relay.now_ns >= self._acts[0][0]:
            self._acts.pop(0)[1]()
        if self.dies_ns is not None and self._relay.now_ns >= self.dies_ns:
            raise Killed
