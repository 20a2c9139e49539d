"""Finds the sites of a running session over an open network connection.

The program that controls a session asks all members of the session for their identities. The
reply of a site contains the scenario, which names all sites.
"""

from collections.abc import Iterator

from trilat_net.errors import SessionError
from trilat_net.scenario import Scenario, parse_embedded

from ..net import REPLY_TIMEOUT_S, Bus, Clock, Info, SessionMembers

GATHERING_NS = 500_000_000
"""Time that further sites have to reply after the first reply, in ns.

It applies to sessions that sites may leave, in which some sites may never reply.
"""


class SessionSearch:
    """Finds the sites of a session, which are the processes that each control one arm.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str) -> None:
        self._bus = bus
        self._clock = clock
        self._session = session

    def find_all(self) -> tuple[Scenario, dict[str, Info]]:
        """Asks all sites of the session for their identities, and collects the replies.

        A site is the process that controls one robot arm. The search ends when all sites of the
        scenario have replied. If the scenario allows sites to leave, some may be absent. Then
        the search also ends `GATHERING_NS` after the first reply.

        Returns:
            The scenario of the session, and the replies, keyed by site name.

        Raises:
            SessionError: No site replies.
        """
        clock = self._clock
        infos: dict[str, Info] = {}
        scenario: Scenario | None = None
        first_reply_ns: int | None = None  # time of the first reply of a site

        for info in self._find_members():
            if scenario is None and info.scenario:
                scenario = parse_embedded(info.scenario, self._session)
            if scenario is None or info.member not in scenario.sites:
                continue

            infos[info.member] = info
            if first_reply_ns is None:
                first_reply_ns = clock.monotonic_ns()

            waited_ns = clock.monotonic_ns() - first_reply_ns
            is_complete = len(infos) == len(scenario.names)
            has_waited_enough = scenario.sites_may_return and waited_ns > GATHERING_NS
            if is_complete or has_waited_enough:
                return scenario, infos

        if scenario is None:
            raise SessionError(
                f"no site of session {self._session!r} answers; "
                "to try other endpoints, name them with --connect"
            )
        return scenario, infos

    def find_running(self, site: str) -> Info:
        """Waits for the reply of one site, and checks that the site is running.

        All members of the session are asked. The reply of any site contains the scenario, which
        shows whether the name of the wanted site is misspelled.

        Args:
            site: Name of the site, the process that controls one arm.

        Returns:
            The identity of the site.

        Raises:
            SessionError: The session has no such site or has not begun, or the site does not
                reply in time.
        """
        for info in self._find_members():
            if info.member == site:
                if not info.running:
                    raise SessionError(
                        f"session {self._session!r} has not begun: {site} waits for the others"
                    )
                return info

            names: tuple[str, ...] = ()
            if info.scenario:
                names = parse_embedded(info.scenario, self._session).names
            if names and site not in names:
                known = f"its sites are {', '.join(names)}"
                raise SessionError(f"session {self._session!r} has no site {site!r}; {known}")

        raise SessionError(
            f"site {site!r} of session {self._session!r} does not answer; "
            "to try other endpoints, name them with --connect"
        )

    def _find_members(self) -> Iterator[Info]:
        """Asks all processes of the session for their identities, and yields their replies.

        A process may reply several times. The replies end after `REPLY_TIMEOUT_S`.
        """
        members = SessionMembers(self._bus, self._clock, self._session)
        return members.find(stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S)
