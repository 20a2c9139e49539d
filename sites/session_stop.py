"""Ends a session in order: every site at the same time since the epoch."""

from trilat_net.errors import SessionError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.discovery import REPLY_TIMEOUT_S, find_members, send_change
from trilat_net.net.messages import Info
from trilat_net.net.requests import ChangeRequest
from trilat_net.scenario import Scenario, parse_embedded

AHEAD_S = 0.5
"""From the newest tick that is known to the end: sites say ten times a second where they are."""


def stop_session(bus: Bus, clock: Clock, session: str) -> list[str]:
    """Asks every site of a session to end at one time; returns what each answers.

    Raises:
        SessionError: the session has not begun, or a site does not answer.
    """
    scenario, found = _meet_sites(bus, clock, session)
    lacking = [name for name in scenario.names if name not in found]
    waiting = [name for name, info in found.items() if not info.running]
    if lacking:
        raise SessionError(f"session {session!r}: {', '.join(lacking)} of its sites did not answer")
    if waiting:
        raise SessionError(f"session {session!r} has not begun: {', '.join(waiting)} waits for the others")
    stop_s = max(info.ticks / scenario.sites[name].rate_hz for name, info in found.items()) + AHEAD_S
    request = ChangeRequest(stop_s=stop_s)
    return [send_change(bus, clock, session, name, request).text for name in scenario.names]


def _meet_sites(bus: Bus, clock: Clock, session: str) -> tuple[Scenario, dict[str, Info]]:
    """Returns a session's scenario, and the sites that have answered."""
    found: dict[str, Info] = {}
    scenario: Scenario | None = None
    for info in find_members(bus, clock, session, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S):
        if scenario is None and info.scenario:
            scenario = parse_embedded(info.scenario, session)
        if scenario is not None and info.member in scenario.sites:
            found[info.member] = info
            if len(found) == len(scenario.names):
                break
    if scenario is None:
        raise SessionError(
            f"no site of session {session!r} answers; other endpoints are named with --connect"
        )
    return scenario, found
