"""Finds a running session from outside and connects to it.

Used by programs that are not (yet) part of a session: the recorder before it joins, and the
commands that stop arms, change network delays or measure the network.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace

from ..errors import ScenarioError, SessionError
from . import topics
from .bus import Bus
from .clock import Clock
from .connection import Connection, DefaultEndpoints
from .known_sites import find_known_endpoints
from .membership import liveliness_token
from .session_members import SessionMembers

SiteNamesOf = Callable[[str], tuple[str, ...]]
"""Function that returns the names of the sites from the text of a scenario, in scenario order.

It raises `ScenarioError` if the text is not a scenario.
"""


@contextmanager
def connect_to_session(
    connection: Connection,
    clock: Clock,
    session: str,
    names: SiteNamesOf,
    *,
    stopped: Callable[[], bool],
    timeout_s: float | None,
    say: Callable[[str], None] = lambda _: None,
    recorder_boot: int | None = None,
) -> Iterator[Bus | None]:
    """Connects to the sites of a session, as a context manager that closes the connection.

    If the endpoints are not known (`connection.connect` is None), they are found in one of two
    ways. If files on this machine show that all sites of the session run here, their endpoints
    are used. Otherwise, the first site of the session is queried at its default endpoint on
    this machine. It returns the names of the other sites, which determine their default
    endpoints.

    Args:
        connection: Endpoints and mode of the caller.
        clock: Clock of the caller.
        session: Name of the session.
        names: Function that returns the names of the sites in a scenario. If it returns no
            names, only the first site is connected.
        stopped: Function that returns True to cancel the search.
        timeout_s: Longest wait for the first site or for a router, in s. If None, there is no
            limit.
        say: Function that prints a line for the user.
        recorder_boot: Boot of the caller (the random number that identifies this start of its
            process) if the caller is a recorder. The recorder is then announced during the
            search, so that the session waits for it. None for other callers.

    Yields:
        The network connection, or None if `stopped` returned True.

    Raises:
        SessionError: No site or router replies in time.
        UsageError: An endpoint cannot be used.
    """
    with ExitStack() as stack:

        def connect(target: Connection) -> Bus | None:
            """Opens a network connection, which is closed at the end of the `with` block.

            Returns None if `stopped` has returned True.
            """
            bus = target.open_bus(clock=clock, stopped=stopped, timeout_s=timeout_s, say=say)
            return None if bus is None else stack.enter_context(closing(bus))

        # A recorder does not use the known sites: it must announce itself to the first site.
        if connection.connect is None and recorder_boot is None:
            connection = replace(connection, connect=find_known_endpoints(session, connection))
        if connection.connect is None:
            default_endpoints = DefaultEndpoints(session)
            first_endpoint = default_endpoints.of_site(0)
            first_bus = connect(replace(connection, listen=(), connect=[first_endpoint]))
            sites = None
            if first_bus is not None:
                if recorder_boot is not None:
                    token = liveliness_token(session, topics.RECORDER, recorder_boot)
                    first_bus.announce(token)
                sites = _query_sites(
                    bus=first_bus,
                    clock=clock,
                    session=session,
                    parse_site_names=names,
                    stopped=stopped,
                    timeout_s=timeout_s,
                )
            if sites is None:  # the caller has stopped the search
                yield None
                return
            endpoints = list(default_endpoints.by_site(sites).values()) or [first_endpoint]
            connection = replace(connection, connect=endpoints)
        yield connect(connection)


def _query_sites(
    bus: Bus,
    clock: Clock,
    session: str,
    parse_site_names: SiteNamesOf,
    stopped: Callable[[], bool],
    timeout_s: float | None,
) -> tuple[str, ...] | None:
    """Queries the members of a session for the names of its sites.

    A site replies with its scenario, which names all sites of the session.

    Args:
        bus: Network connection through which the first site can be reached.
        clock: Clock of the caller.
        session: Name of the session.
        parse_site_names: Function that returns the names of the sites from the text of a
            scenario. It raises `ScenarioError` if the text is not a scenario.
        stopped: Function that returns True to cancel the search.
        timeout_s: Longest wait for a reply, in s. If None, the wait lasts until `stopped`
            returns True.

    Returns:
        The names, from the first reply that contains a scenario, or None if `stopped` returned
        True.

    Raises:
        SessionError: No member with a scenario replies in time.
    """
    members = SessionMembers(bus, clock, session)
    for info in members.find(stopped=stopped, timeout_s=timeout_s):
        try:
            if info.scenario:
                return parse_site_names(info.scenario)
        except ScenarioError:  # not a scenario of this program
            continue

    # The search has ended, because the caller has stopped it or because the time is over. The
    # second case cannot occur without a limit, so `timeout_s` is a number below.
    if stopped():
        return None
    raise SessionError(
        f"no site of session {session!r} answered at {DefaultEndpoints(session).of_site(0)} "
        f"within {timeout_s:g} s; check the name of the session, or name other endpoints with "
        "--connect"
    )
