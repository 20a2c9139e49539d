"""Many members on one clock, one at a time: live loops in threads, and yet the same run every time.

Whoever sleeps hands over to the one whose deadline is next; equal deadlines go in order of joining. Work
takes no time, so that nobody is ever late, unless a test says `stall`.
"""

import threading
from collections.abc import Callable


class Relay:
    """Time shared by runners, of which one at a time runs."""

    def __init__(self, start_ns: int = 10**9, epoch_unix_ns: int = 1_700_000_000_000_000_000) -> None:
        self.now_ns = start_ns
        self._epoch_unix_ns = epoch_unix_ns
        self._turn = threading.Condition()
        self._deadlines: dict[int, int] = {}
        self._runners: list[threading.Thread] = []
        self._failed: list[BaseException] = []
        self.results: dict[str, object] = {}

    def add(self, name: str, run: Callable[["RelayClock"], object], at_ns: int = 0) -> "RelayClock":
        """Adds a runner that begins at a time; `run` gets its clock."""
        seat = len(self._runners)
        clock = RelayClock(self, seat)

        def body() -> None:
            try:
                self.wait(seat)
                self.results[name] = run(clock)
            except BaseException as error:
                self._failed.append(error)
            finally:
                with self._turn:
                    del self._deadlines[seat]
                    self._turn.notify_all()

        self._deadlines[seat] = max(at_ns, self.now_ns)
        self._runners.append(threading.Thread(target=body, name=name, daemon=True))
        return clock

    def run(self) -> dict[str, object]:
        """Runs all to their end; returns what each returned, or raises what one raised."""
        for runner in self._runners:
            runner.start()
        for runner in self._runners:
            runner.join(60)
            assert not runner.is_alive(), f"{runner.name} hangs"
        if self._failed:
            raise self._failed[0]
        return self.results

    def wait(self, seat: int) -> None:
        """Returns when nobody else has anything to do before this runner's deadline."""
        with self._turn:
            self._turn.notify_all()
            self._turn.wait_for(lambda: self._next() == seat)
            self.now_ns = max(self.now_ns, self._deadlines[seat])

    def sleep(self, seat: int, deadline_ns: int) -> None:
        with self._turn:
            self._deadlines[seat] = max(deadline_ns, self.now_ns)
        self.wait(seat)

    def _next(self) -> int:
        return min(self._deadlines, key=lambda seat: (self._deadlines[seat], seat))

    def unix_ns(self) -> int:
        return self._epoch_unix_ns + self.now_ns


class Killed(Exception):  # noqa: N818 - it is no error of the program
    """Ends a runner wherever it sleeps."""


class RelayClock:
    """One runner's `Clock`."""

    def __init__(self, relay: Relay, seat: int) -> None:
        self._relay, self._seat = relay, seat
        self._stalls: list[tuple[int, int]] = []
        self._acts: list[tuple[int, Callable[[], None]]] = []
        self.dies_ns: int | None = None
        """When its runner is killed."""

    def stall(self, at_ns: int, for_ns: int) -> None:
        """The first sleep that would end at a time or after it ends so much later."""
        self._stalls.append((at_ns, for_ns))

    def at(self, at_ns: int, act: Callable[[], None]) -> None:
        """Does something in the first sleep that ends at a time or after it."""
        self._acts.append((at_ns, act))

    def monotonic_ns(self) -> int:
        return self._relay.now_ns

    def unix_ns(self) -> int:
        return self._relay.unix_ns()

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
