"""Takes hold of an arm of a live session: what `trilat_net.hand` does."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from trilat_net.core.chain import build_chain, place_end_effector, place_joints
from trilat_net.core.vectors import Vector
from trilat_net.errors import SessionError, UsageError
from trilat_net.net.access_rules import OPERATOR
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import resolve_member_connection, secure_connection
from trilat_net.net.discovery import SiteNamesOf, connect_to_session, find_site_info
from trilat_net.net.hand_port import Hand
from trilat_net.net.member_keys import read_member_keys
from trilat_net.net.messages import Info
from trilat_net.scenario import Scenario, embedded_names_reader, find_site, parse_embedded
from trilat_net.scenario.arms import ArmModel
from trilat_net.scenario.operators import find_live_hand


@contextmanager
def hand(
    session: str,
    site: str,
    *,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
    source: str = "",
    timeout_s: float = 5.0,
) -> Iterator[Hand]:
    """Takes part in a live session as a hand at one arm; a context, which lets go at its end.

    >>> with tn.hand("play", "m1") as hand:  # doctest: +SKIP
    ...     hand.move(1.2, 0.4)
    ...     hand.force, hand.pose

    Args:
        session: the session's name, by default the scenario's.
        site: the site of the arm; its scenario must have an operator of kind "live".
        connect: endpoints, as of --connect; without them the session's default ones on this machine.
        router: endpoints of routers to go through instead, as of --router.
        keys: folder of the operator's keys, as of --keys.
        source: who this is, for people.
        timeout_s: longest wait until the session runs.

    Raises:
        SessionError: there is no such session, or it does not begin.
        UsageError: nobody can hold that arm, or an endpoint cannot be used.
    """
    clock = SystemClock()
    known = None if keys is None else read_member_keys(Path(keys))
    connection = resolve_member_connection(None, connect, router, None, [], None)
    connection = secure_connection(connection, known, insecure=False).require(OPERATOR)

    names = embedded_names_reader(session)
    reached = connect_to_session(
        connection, clock, session, names, stopped=lambda: False, timeout_s=timeout_s
    )
    with reached as bus:
        assert bus is not None  # nothing stops it
        info = _await_running(bus, clock, session, site, names, timeout_s)
        with open_hand(bus, clock, session, site, parse_embedded(info.scenario, session), source) as port:
            yield port


def _await_running(
    bus: Bus, clock: Clock, session: str, site: str, names: SiteNamesOf, timeout_s: float
) -> Info:
    """Returns the identity of a site once its session runs."""
    give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
    while True:
        try:
            info = find_site_info(bus, clock, session, site, names)
            if info.running:
                return info
            problem = SessionError(f"session {session!r} has not begun: {site} waits for the others")
        except SessionError as error:
            problem = error
        if clock.monotonic_ns() > give_up_ns:
            raise problem
        clock.sleep_until(clock.monotonic_ns() + 50_000_000)


def open_hand(bus: Bus, clock: Clock, session: str, site: str, scenario: Scenario, source: str = "") -> Hand:
    """Returns a hand at a site of a scenario, on a bus that reaches it.

    Raises:
        UsageError: nobody can hold that arm.
    """
    find_site(scenario, site)
    live = find_live_hand(scenario.sites[site].hands)
    if live is None:
        able = [name for name, spec in scenario.sites.items() if find_live_hand(spec.hands) is not None]
        others = f"; they can at {', '.join(able)}" if able else ""
        raise UsageError(
            f"nobody can take hold of {site}: the scenario has no operator of kind 'live' there{others}"
        )
    place = _find_place(scenario.arms[site]) if live.mode != "joint" else tuple
    return Hand(bus, clock, session, site, live.actor, place, source)


def _find_place(arm: ArmModel) -> Callable[[Vector], Sequence[float]]:
    """Returns the function that places an arm's end effector by its joint angles."""
    if arm.chain is None:
        return arm.end_effector
    rows, tip = build_chain(arm.chain.joints), np.array(arm.chain.tip_m)

    def place(q: Vector) -> Sequence[float]:
        """Returns the place of the end effector, m."""
        place_joints(rows, np.asarray(q, dtype=np.float64))
        return place_end_effector(rows, tip)

    return place
