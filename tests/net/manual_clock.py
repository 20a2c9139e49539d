"""A clock for tests."""


class ManualClock:
    """A clock that a test moves by hand; sleeping moves it to the deadline."""

    def __init__(self, start_ns: int = 0, epoch_unix_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._epoch_unix_ns = epoch_unix_ns

    def monotonic_ns(self) -> int:
        return self._now_ns

    def unix_ns(self) -> int:
        return self._epoch_unix_ns + self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)

    def identity(self) -> str:
        return "manual"
