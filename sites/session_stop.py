"""Orders to the sites of a session: to stop and to go on; and its end, at the same time since the epoch."""

from collections.abc import Sequence

from trilat_net.errors import SessionError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.discovery import REPLY_TIMEOUT_S, find_members, send_change
from trilat_net.net.messages import Info
from trilat_net.net.requests import ChangeReply, ChangeRequest, OrderName
from trilat_net.scenario import Scenario, parse_embedded

GATHER_NS = 500_000_000
"""Time for further sites to answer, after the first one of a session that some may have left."""
AHEAD_S = 0.5
"""From the newest tick that is known to the end: sites say ten times a second where they are."""


def order_sites(
    bus: Bus, clock: Clock, session: str, sites: Sequence[str], order: OrderName
) -> list[ChangeReply]:
    """Gives some sites of a session an order, "stop", "enable" or "reset"; () stands for all of them.

    Under `glide` these are the ones that are there: others may have left.

    Raises:
        SessionError: the session has not begun or has no such site, or a site does not answer.
    """
    scenario, found = _meet_sites(bus, clock, session)
    for name in sites:
        if name not in scenario.names:
            raise SessionError(
                f"session {session!r} has no site {name!r}; its sites are {', '.join(scenario.names)}"
            )
    asked = list(sites) or _list_present(scenario, found)
    for name in asked:
        if name not in found or not found[name].running:
            raise SessionError(
                f"session {session!r}: {name} {'has not begun' if name in found else 'did not answer'}"
            )
    request = ChangeRequest(order=order)
    return [send_change(bus, clock, session, name, request) for name in asked]


def _list_present(scenario: Scenario, found: dict[str, Info]) -> list[str]:
    """Returns the sites of a session; of one that sites may leave, those that run, if there are any."""
    running = [name for name in scenario.names if name in found and found[name].running]
    return running if running and scenario.sites_may_return else list(scenario.names)


def stop_session(bus: Bus, clock: Clock, session: str) -> list[str]:
    """Asks every site of a session to end at one time; returns what each answers.

    Raises:
        SessionError: the session has not begun, or a site does not answer.
    """
    scenario, found = _meet_sites(bus, clock, session)
    asked = _list_present(scenario, found)
    lacking = [name for name in asked if name not in found]
    waiting = [name for name in asked if name in found and not found[name].running]
    if lacking:
        raise SessionError(f"session {session!r}: {', '.join(lacking)} of its sites did not answer")
    if waiting:
        raise SessionError(f"session {session!r} has not begun: {', '.join(waiting)} waits for the others")
    stop_s = max(found[name].ticks / scenario.sites[name].rate_hz for name in asked) + AHEAD_S
    request = ChangeRequest(stop_s=stop_s)
    return [send_change(bus, clock, session, name, request).text for name in asked]


def _meet_sites(bus: Bus, clock: Clock, session: str) -> tuple[Scenario, dict[str, Info]]:
    """Returns a session's scenario, and the sites that have answered."""
    found: dict[str, Info] = {}
    scenario: Scenario | None = None
    begun_ns = 0
    for info in find_members(bus, clock, session, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S):
        if scenario is None and info.scenario:
            scenario = parse_embedded(info.scenario, session)
        if scenario is not None and info.member in scenario.sites:
            found[info.member] = info
            begun_ns = begun_ns or clock.monotonic_ns()
            gathered = scenario.sites_may_return and clock.monotonic_ns() - begun_ns > GATHER_NS
            if len(found) == len(scenario.names) or gathered:
                break
    if scenario is None:
        raise SessionError(
            f"no site of session {session!r} answers; other endpoints are named with --connect"
        )
    return scenario, found
