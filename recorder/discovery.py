"""How a recorder that was told no endpoints finds a session on its own machine."""

from collections.abc import Callable, Mapping
from typing import Any

from trilat_net.errors import ScenarioError, SessionError, WireError
from trilat_net.net import topics
from trilat_net.net.clock import Clock
from trilat_net.net.endpoints import default_endpoint, default_endpoints
from trilat_net.net.meeting import ASK_EVERY_NS
from trilat_net.net.messages import Info
from trilat_net.net.voice import token
from trilat_net.net.wire import decode
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.scenario import embedded


class Discovery:
    """Asks the first site of a session, on this machine, where the others are.

    It announces the recorder meanwhile, so that the session does not begin without it.

    Args:
        session: the session's name.
        boot: the recorder's boot.
        own: settings of a person's own for Zenoh.
    """

    def __init__(self, session: str, boot: int, own: Mapping[str, Any] | None = None) -> None:
        self._session = session
        self._first = default_endpoint(session, 0)
        self._bus = ZenohBus([], [self._first], own=own)
        self._bus.announce(token(session, topics.RECORDER, boot))

    def endpoints(self, clock: Clock, stopped: Callable[[], bool], timeout_s: float | None) -> list[str]:
        """Returns the default endpoints of the session's sites, once the first has said who they are.

        Raises:
            SessionError: it did not answer in time.
        """
        begun_ns = clock.monotonic_ns()
        while not stopped():
            replies = self._bus.ask(topics.key(self._session, "*", topics.INFO))
            clock.sleep_until(clock.monotonic_ns() + ASK_EVERY_NS)
            while (reply := replies.poll()) is not None:
                try:
                    names = embedded(decode(reply[1], Info).scenario, self._session).names
                except (WireError, ScenarioError):
                    continue  # no site of ours
                return list(default_endpoints(self._session, names).values())
            if timeout_s is not None and clock.monotonic_ns() - begun_ns > timeout_s * 1e9:
                raise SessionError(
                    f"the recorder waited {timeout_s:g} s for the first site of session {self._session!r} "
                    f"at {self._first}; name other endpoints with --connect"
                )
        return [self._first]

    def close(self) -> None:
        """Leaves; by then the recorder has announced itself to all sites."""
        self._bus.close()
