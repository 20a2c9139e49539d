"""How a recorder comes into a session that is running already.

Law: it believes the members who run: who they are, the epoch and the boots that they started with. It waits
for those that are there to be asked, and for nobody who is gone. Sites do not come late: their arm would have
to be where it is not.
"""

from collections.abc import Collection
from typing import NamedTuple

from . import topics
from .meeting import Meeting
from .messages import Info
from .pinging import Pinger

GATHER_NS = 1_500_000_000
"""How long to wait for the other members of a session whose first has been met."""


class RunningSince(NamedTuple):
    """Tick 0 of a running session, on the own clock as it stands now against the member's, and the boots."""

    mono_ns: int
    unix_ns: int
    boots: dict[str, int]


class Latecomer:
    """A recorder's eye for sessions that run.

    Args:
        meeting: who has been met.
        pinger: where clocks stand.
    """

    def __init__(self, meeting: Meeting, pinger: Pinger) -> None:
        self._meeting, self._pinger = meeting, pinger
        self._first_ns: int | None = None

    def poll(self, now_ns: int) -> RunningSince | None:
        """Returns the session's beginning, once all its members that are there have been met.

        Args:
            now_ns: the own clock.
        """
        running = self._running()
        if not running:
            self._first_ns = None
            return None
        if self._first_ns is None:
            self._first_ns = now_ns
        sites = set(running[0].boots) - {topics.RECORDER}
        if {info.member for info in running} < sites and now_ns - self._first_ns < GATHER_NS:
            return None
        return self._beginning(running, now_ns)

    def _running(self) -> list[Info]:
        """Returns what the members of one running session say of themselves."""
        infos = [
            info
            for _, info in sorted(self._meeting.met.items())
            if info.running and info.scenario and info.boots.get(info.member) == info.boot
        ]
        return [info for info in infos if info.boots == infos[0].boots]

    def _beginning(self, running: Collection[Info], now_ns: int) -> RunningSince | None:
        """Returns the epoch by a clock that is the own one, or else by one that is known."""
        own = self._meeting.own.clock
        for info in sorted(running, key=lambda info: info.clock != own):
            if info.clock == own:
                offset_ns = 0
            elif self._pinger.know([info.boot]):
                # as the clocks stand now: what they drifted apart since the epoch is nobody's to know
                offset_ns = self._pinger.estimate(info.boot).offset_at(now_ns)
            else:
                continue
            return RunningSince(info.epoch_mono_ns - offset_ns, info.epoch_unix_ns, dict(info.boots))
        return None
