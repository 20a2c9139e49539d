"""What a recorder says of its own work, once a second: to whoever listens, and to its own log.

Law: it is bounded, whatever happens, and a wall clock that steps shows in it and nowhere else.
"""

from collections.abc import Callable

from trilat_net.log.accounting import Account
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.messages import RecorderStats
from trilat_net.net.session import Epoch
from trilat_net.net.wire import encode

from .recording import Recording
from .tap import Tap

EVERY_NS = 1_000_000_000
MOST_GAPS = 20
"""Gaps that are named of a channel; of many channels fewer."""
_ALL_GAPS = 600


class Report:
    """The statistics of one recording.

    Args:
        bus: the connection.
        clock: the time.
        session: the session's name.
        boot: the recorder's.
        epoch: tick 0.
        recording: what it is about.
        tap: where messages wait; its own statistics go into it.
        size: says how many bytes the log has.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        boot: int,
        epoch: Epoch,
        recording: Recording,
        tap: Tap,
        size: Callable[[], int],
    ) -> None:
        self._clock, self._boot, self._epoch = clock, boot, epoch
        self._recording, self._tap, self._size = recording, tap, size
        self._key = topics.key(session, topics.RECORDER, topics.STATS)
        self._publish = bus.publisher(self._key)
        self._flush_max_ns = 0
        self._due_ns = clock.monotonic_ns() + EVERY_NS

    def flushed(self, took_ns: int) -> None:
        """Books how long the operating system took to take the log so far, ns."""
        self._flush_max_ns = max(self._flush_max_ns, took_ns)

    def poll(self) -> None:
        """Says how it stands, if it is time to."""
        now_ns = self._clock.monotonic_ns()
        if now_ns >= self._due_ns:
            on_time = now_ns - self._due_ns < EVERY_NS
            self._due_ns = (self._due_ns if on_time else now_ns) + EVERY_NS
            self.say()

    def say(self) -> None:
        """Says how it stands, and writes it."""
        payload = encode(self._stats())
        self._flush_max_ns = 0
        self._tap.take(self._key, payload)
        self._publish(payload)

    def _stats(self) -> RecorderStats:
        accounts = {_short(key): account for key, account in self._recording.accounts.items()}
        most = max(1, min(MOST_GAPS, _ALL_GAPS // len(accounts)))
        now_ns = self._clock.monotonic_ns()

        def counted(what: Callable[[Account], int]) -> dict[str, int]:
            return {name: what(account) for name, account in accounts.items()}

        return RecorderStats(
            boot=self._boot,
            t_ns=now_ns - self._epoch.mono_ns,
            expected=counted(lambda account: account.expected),
            received=counted(lambda account: account.received),
            missing=counted(lambda account: account.missing),
            gaps={name: account.gap_texts(most) for name, account in accounts.items() if account.missing},
            duplicate=counted(lambda account: account.duplicate),
            reordered=counted(lambda account: account.reordered),
            refilled=counted(lambda account: account.refilled),
            overflowed={_short(key): self._tap.overflowed[key] for key in self._recording.accounts},
            silence_us=counted(lambda account: account.silence_ns // 1000),
            dropped=dict(self._recording.dropped),
            queued=len(self._tap),
            written_bytes=self._size(),
            flush_max_us=self._flush_max_ns // 1000,
            mono_ns=now_ns,
            unix_ns=self._clock.unix_ns(),
        )


def _short(key: str) -> str:
    """Returns member and channel of a key, as in "m1/state"."""
    return "/".join(key.split("/")[2:])
