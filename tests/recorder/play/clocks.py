"""A clock for players that moves a little at every reading, so that waiting loops end."""


class LookedAt:
    """A clock that goes on by a microsecond at every reading, and sleeps as far as it is asked to.

    Args:
        oversleep_ns: how much longer than asked it sleeps.
    """

    def __init__(self, start_ns: int = 1_000_000_000, oversleep_ns: int = 0) -> None:
        self.now_ns = start_ns
        self.oversleep_ns = oversleep_ns

    def monotonic_ns(self) -> int:
        self.now_ns += 1_000
        return self.now_ns

    def unix_ns(self) -> int:
        return 5_000_000_000_000 + self.now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        if deadline_ns > self.now_ns:
            self.now_ns = deadline_ns + self.oversleep_ns

    def identity(self) -> str:
        return "looked at"
