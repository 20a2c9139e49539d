"""A running session from Python: orders, changes, pings, hands at its arms; and processes of a
session.

Invariant: each call connects, as its command does, and holds no connection afterwards.
"""

import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from trilat_net.errors import RunFailed, ScenarioError, SessionError, UsageError
from trilat_net.net import topics
from trilat_net.net.arm_client import Hand
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection, resolve_member_connection, secure_connection
from trilat_net.net.discovery import (
    REPLY_TIMEOUT_S,
    connect_to_session,
    find_members,
    list_past_events,
    send_change,
)
from trilat_net.net.membership import read_messages, read_records
from trilat_net.net.messages import Event, Info, State
from trilat_net.net.requests import ChangeReply, ChangeRequest, OrderName
from trilat_net.net.zenoh_config import OPERATOR
from trilat_net.scenario import Scenario, embedded_names_reader, find_site, parse_embedded
from trilat_net.scenario.run_changes import parse_core_change
from trilat_net.scenario.sample_uses import PictureDelay

from .device_hand import DeviceHand
from .devices import Device
from .session_ping import PingReport, ping_session

GATHER_NS = 500_000_000
"""Time for further sites to answer, after the first one of a session that some may have left.
"""
STATES_KEPT = 4096
"""Records of each site that are looked at for the sample which another one has in use."""
AHEAD_S = 0.5
"""From the newest tick that is known to the end: sites say ten times a second where they are.
"""


SOURCE = "the operator"
"""Who gives the orders of this interface and of its commands, in the sites' events."""


class ShareHistory:
    """The shares of a site in its peers, by the changes that are known."""

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._later = scenario.scripted_ramps(site)
        self._ramp = scenario.ramp(site, scenario.dominance[site], -1, 0.0)
        self._before = self._ramp.alpha

    def take(self, change: str) -> None:
        """Takes a change of the site, as its events have it; one of anything else changes
        nothing.
        """
        with suppress(ScenarioError):  # a stranger's
            ramp = parse_core_change(self._scenario, self._site, change).ramp
            # else it was shown before
            if ramp is not None and ramp.start_ns >= self._ramp.start_ns:
                self._later.append(ramp)

    def at(self, t_ns: int) -> tuple[float, ...]:
        """Returns the shares at a time since the epoch, ns, which never goes back."""
        for ramp in sorted(one for one in self._later if one.start_ns <= t_ns):
            self._before = self._find(ramp.start_ns)
            self._ramp = ramp
        self._later = [one for one in self._later if one.start_ns > t_ns]
        return self._find(t_ns)

    def _find(self, t_ns: int) -> tuple[float, ...]:
        _, end_ns, after = ramp = self._ramp
        if t_ns >= end_ns:
            return after
        part = (t_ns - ramp.start_ns) / (end_ns - ramp.start_ns)
        return tuple(a + part * (b - a) for a, b in zip(self._before, after, strict=True))


class RunningSession:
    """A session that runs; see `session`. Methods return what the sites answer, a sentence
    each.

    With a `bus` that reaches it, they use that one and connect no more.
    """

    def __init__(
        self,
        name: str,
        connection: Connection,
        bus: Bus | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.name = name
        self._connection = connection
        self._bus = bus
        self._clock = clock or SystemClock()

    @contextmanager
    def reach(
        self, member: str = OPERATOR, timeout_s: float = REPLY_TIMEOUT_S
    ) -> Iterator[Bus]:
        """Yields a connection to the session; with keys those of a member, or with "" of
        anybody.

        Raises:
            SessionError: no site answers.
        """
        if self._bus is not None:
            yield self._bus
            return
        if member:
            self._connection.require(member)
        there = self._connection, self._clock, self.name, embedded_names_reader(self.name)
        with connect_to_session(*there, stopped=lambda: False, timeout_s=timeout_s) as bus:
            assert bus is not None  # nothing stops it
            yield bus

    @contextmanager
    def reach_site(self, site: str, timeout_s: float) -> Iterator[tuple[Bus, Scenario]]:
        """Does as `reach`, and waits until a site runs; yields the scenario as well."""
        with self.reach(timeout_s=timeout_s) as bus:
            give_up_ns = self._clock.monotonic_ns() + int(timeout_s * 1e9)
            while True:
                with (
                    suppress(SessionError)
                    if self._clock.monotonic_ns() < give_up_ns
                    else nullcontext()
                ):
                    info = self._find_running(bus, site)
                    break
                self._clock.sleep_until(self._clock.monotonic_ns() + 50_000_000)
            yield bus, parse_embedded(info.scenario, self.name)

    def lead(
        self,
        site: str,
        device: Device,
        *,
        stopped: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = print,
        timeout_s: float = REPLY_TIMEOUT_S,
    ) -> None:
        """Leads the arm of a site by a device until the session ends, as `trilat hand
        --device`.

        The live hand of its scenario says how. `stopped` may end it sooner; `timeout_s` is the
        longest wait until the session runs.

        Raises:
            SessionError: there is no such session, or it does not begin.
            UsageError: no device can lead that arm.
        """
        with self.reach_site(site, timeout_s) as (bus, scenario):
            who = type(device).__name__
            with open_hand(
                bus=bus,
                clock=self._clock,
                session=self.name,
                site=site,
                scenario=scenario,
                source=who,
                repeats=False,
            ) as held:
                live = scenario.sites[site].find_live_hand(is_open=True)
                if live is None or live.mode != "tip":
                    raise UsageError(
                        f"a device leads an end effector: the hand of {site} is not of mode 'tip'"
                    )
                reach = scenario.arms[site].reach
                led = DeviceHand(
                    hand=held,
                    device=device,
                    settings=live.device,
                    clock=self._clock,
                    reach=reach,
                )
                led.run(stopped, lambda text: say(f"{site}: {text}"))
                say(f"{site}: {led.describe()}")

    def stop(self, *sites: str) -> list[str]:
        """Stops arms at once, all or some, while the session goes on; as `trilat stop`."""
        return _read_replies(self.order(sites, "stop"))

    def enable(self, *sites: str) -> list[str]:
        """Lets arms that were stopped follow again; as `trilat enable`."""
        return _read_replies(self.order(sites, "enable"))

    def reset(self, *sites: str) -> list[str]:
        """Ends the fault of sites, unless its reason is still there; as `trilat reset`."""
        return _read_replies(self.order(sites, "reset"))

    def order(self, sites: Sequence[str], order: OrderName) -> list[ChangeReply]:
        """Gives some sites an order; () stands for all of them, under `glide` for those that
        are there.

        Raises:
            SessionError: the session has not begun or has no such site, or a site does not
                answer.
        """
        with self.reach("" if order == "stop" else OPERATOR) as bus:
            scenario, found = self._meet_sites(bus)
            for name in sites:
                if name not in scenario.names:
                    known = f"its sites are {', '.join(scenario.names)}"
                    raise SessionError(f"session {self.name!r} has no site {name!r}; {known}")
            asked = list(sites) or _list_present(scenario, found)
            for name in asked:
                if name not in found or not found[name].running:
                    state = "has not begun" if name in found else "did not answer"
                    raise SessionError(f"session {self.name!r}: {name} {state}")
            request = ChangeRequest(order=order, source=SOURCE)
            return [
                send_change(
                    bus=bus, clock=self._clock, session=self.name, site=name, request=request
                )
                for name in asked
            ]

    def end(self) -> list[str]:
        """Ends the session in order, all sites at one time; as `trilat stop --end`.

        Raises:
            SessionError: the session has not begun, or a site does not answer.
        """
        with self.reach() as bus:
            scenario, found = self._meet_sites(bus)
            asked = _list_present(scenario, found)
            if lacking := [name for name in asked if name not in found]:
                raise SessionError(
                    f"session {self.name!r}: {', '.join(lacking)} of its sites did not answer"
                )
            if waiting := [name for name in asked if not found[name].running]:
                who = f"{', '.join(waiting)} waits for the others"
                raise SessionError(f"session {self.name!r} has not begun: {who}")
            stop_s = (
                max(found[name].ticks / scenario.sites[name].rate_hz for name in asked)
                + AHEAD_S
            )
            request = ChangeRequest(stop_s=stop_s)
            return [
                send_change(
                    bus=bus, clock=self._clock, session=self.name, site=name, request=request
                ).text
                for name in asked
            ]

    def _meet_sites(self, bus: Bus) -> tuple[Scenario, dict[str, Info]]:
        clock = self._clock
        session = self.name
        found: dict[str, Info] = {}
        scenario: Scenario | None = None
        begun_ns = 0
        for info in find_members(
            bus, clock, session, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S
        ):
            if scenario is None and info.scenario:
                scenario = parse_embedded(info.scenario, session)
            if scenario is not None and info.member in scenario.sites:
                found[info.member] = info
                begun_ns = begun_ns or clock.monotonic_ns()
                gathered = (
                    scenario.sites_may_return and clock.monotonic_ns() - begun_ns > GATHER_NS
                )
                if len(found) == len(scenario.names) or gathered:
                    return scenario, found
        if scenario is None:
            raise SessionError(
                f"no site of session {session!r} answers; other endpoints are named with --connect"
            )
        return scenario, found

    def _find_running(self, bus: Bus, site: str) -> Info:
        """Returns what a site answers that runs.

        Raises:
            SessionError: the session has no such site, or has not begun, or the site does not
                answer in time.
        """
        clock = self._clock
        session = self.name
        names = embedded_names_reader(self.name)
        for info in find_members(
            bus, clock, session, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S
        ):
            if info.member == site and not info.running:
                raise SessionError(
                    f"session {session!r} has not begun: {site} waits for the others"
                )
            if info.member == site:
                return info
            sites = names(info.scenario) if info.scenario else ()
            if sites and site not in sites:
                known = f"its sites are {', '.join(sites)}"
                raise SessionError(f"session {session!r} has no site {site!r}; {known}")
        raise SessionError(
            f"site {site!r} of session {session!r} does not answer; other endpoints are named with --connect"
        )

    def set_link(self, link: str, **to: Any) -> str:
        """Changes keys of a link such as "m1->s", as in `delay_ms=350`; as `trilat set link`."""
        return self._change(link.partition("->")[2], link=link, to=to)

    def set_dominance(self, site: str, shares: Mapping[str, float], ramp_s: float = 1.0) -> str:
        """Changes a site's shares in its peers, as in `{"m1": 0.9, "m2": 0.1}`; as `trilat set
        dominance`.
        """
        return self._change(site, dominance=site, to=dict(shares), ramp_s=ramp_s)

    def _change(self, site: str, **change: Any) -> str:
        reply = self.change(site, ChangeRequest(**change))
        if not reply.accepted:
            raise RunFailed(f"refused: {reply.text}")
        return reply.text

    def change(self, site: str, request: ChangeRequest) -> ChangeReply:
        """Requests a change from the site that carries it out, and returns its reply.

        Raises:
            SessionError: the session has no such site, has not begun, or the site does not
                reply.
        """
        with self.reach() as bus:
            self._find_running(bus, site)
            return send_change(
                bus=bus, clock=self._clock, session=self.name, site=site, request=request
            )

    @contextmanager
    def records(self, *sites: str) -> Iterator[Callable[[], list[State]]]:
        """Listens to sites, by default to all; yields a function that returns the records that
        came since.

        >>> with tn.session("paper").records("s") as take:  # doctest: +SKIP
        ...     [record.q_des for record in take()]
        """
        with self.reach("") as bus:
            rings = [
                bus.inbox(topics.key(self.name, site, topics.STATE), 4096)
                for site in sites or ("*",)
            ]

            def take() -> list[State]:
                return [record for ring in rings for record in read_records(ring)]

            yield take

    @contextmanager
    def states(self, as_site: str = "") -> Iterator[Callable[[], dict[str, State]]]:
        """Listens to all sites; yields a function that returns a record of each, by name.

        That is the newest one; with `as_site` what that site's user is shown: its own newest
        record, and of each peer the one whose sample it has in use, delayed as its links are,
        or the one that its picture shows (`[sites.NAME.view]`). There is none of a peer whose
        sample was made before this listened, or more than `STATES_KEPT` ticks ago.

        >>> with tn.session("paper").states(as_site="m1") as find:  # doctest: +SKIP
        ...     find()["s"].q
        """
        with self.reach("") as bus:
            ring = bus.inbox(topics.key(self.name, "*", topics.STATE), STATES_KEPT)
            kept: dict[str, deque[State]] = {}
            pictures: dict[str, PictureDelay] = {}

            def find() -> dict[str, State]:
                for record in read_records(ring):
                    kept.setdefault(record.site, deque(maxlen=STATES_KEPT)).append(record)
                newest = {site: records[-1] for site, records in kept.items()}
                if not as_site or as_site not in newest:
                    return {} if as_site else newest
                if as_site not in pictures:
                    info = self._find_running(bus, as_site)
                    pictures[as_site] = PictureDelay(
                        parse_embedded(info.scenario, self.name), as_site
                    )
                own = newest[as_site]
                shown = pictures[as_site].advance_to(own.tick, own.used)
                back = {peer: reversed(kept.get(peer, deque())) for peer in shown}
                seen = {
                    at: next((r for r in back[at] if r.tick == k), None)
                    for at, k in shown.items()
                }
                return {
                    as_site: own,
                    **{peer: one for peer, one in seen.items() if one is not None},
                }

            yield find

    def mark(self, text: str) -> str:
        """Marks this moment in the log by a text: an event of a site."""
        with self.reach() as bus:
            scenario, found = self._meet_sites(bus)
            first = next(name for name in scenario.names if name in found)
            return send_change(
                bus=bus,
                clock=self._clock,
                session=self.name,
                site=first,
                request=ChangeRequest(mark=text),
            ).text

    @contextmanager
    def episode(self, name: str) -> Iterator[Callable[[bool], None]]:
        """Marks the begin and the end of an episode; yields a function that says whether it
        succeeded.

        >>> with tn.session("paper").episode("reach 3") as judge:  # doctest: +SKIP
        ...     judge(True)
        """
        judged: list[bool] = []
        self.mark(f"episode {name} begins")
        try:
            yield judged.append
        finally:
            how = {True: "succeeded", False: "failed", None: "ended"}[
                judged[-1] if judged else None
            ]
            self.mark(f"episode {name} {how}")

    @contextmanager
    def shares(self, site: str) -> Iterator[Callable[[], dict[str, float]]]:
        """Listens to a site; yields a function that returns its present shares in its peers, by
        name.
        """
        with self.reach("") as bus:
            info = self._find_running(bus, site)
            kinds = topics.STATE, topics.EVENT
            records, events = (
                bus.inbox(topics.key(self.name, site, kind), 256) for kind in kinds
            )
            scenario = parse_embedded(info.scenario, self.name)
            now_ns = 0
            history = ShareHistory(scenario, site)
            for event in list_past_events(bus, self._clock, self.name, site):
                history.take(event.command)

            def find() -> dict[str, float]:
                nonlocal now_ns
                for event in read_messages(events, Event):
                    history.take(event.command)
                now_ns = max([now_ns, *(record.t_ns for record in read_records(records))])
                return dict(zip(scenario.peers(site), history.at(now_ns), strict=True))

            yield find

    def ping(self, count: int = 50, timeout_s: float = 3.0) -> PingReport:
        """Measures round trips, clock offsets and links of the session; as `trilat ping`."""
        found = ping_session(
            connection=self._connection,
            clock=self._clock,
            session=self.name,
            count=count,
            timeout_s=timeout_s,
            stopped=lambda: False,
        )
        assert found is not None  # nothing stops it
        return found


def session(
    name: str,
    *,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> RunningSession:
    """Returns a running session, to stop, change and measure it; as `trilat stop`, `set`,
    `ping`.

    >>> paper = tn.session("paper")  # doctest: +SKIP
    >>> paper.set_link("m1->s", delay_ms=350)  # doctest: +SKIP
    >>> paper.stop("s"), paper.enable("s"), paper.ping()  # doctest: +SKIP

    Args:
        name: the session's name.
        connect: endpoints, as of --connect; without them the session's default ones on this
            machine.
        router: endpoints of routers to go through instead, as of --router.
        keys: folder of the operator's keys, as of --keys; of any member's, to stop arms and to
            ping.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    connection = resolve_member_connection(None, connect, router)
    return RunningSession(name, secure_connection(connection, keys, insecure=False))


def start(*words: str | Path) -> "subprocess.Popen[bytes]":
    """Starts a process of a session, as in a terminal; it runs until its end, or until it is
    terminated.

    The commands are `trilat site`, `hand`, `record`, `router`, `replay`, `watch`, `live` and
    `ros2`.

    >>> recorder = tn.start("record", "--session", "paper", "-o", "run.mcap")  # doctest: +SKIP
    >>> player = tn.start("replay", "run.mcap", "--rate", "2")  # doctest: +SKIP
    >>> player.wait()  # doctest: +SKIP

    Args:
        words: the words of the command, without `trilat`.
    """
    return subprocess.Popen([sys.executable, "-m", "trilat_net", *map(str, words)])


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
        connect: endpoints, as of --connect; without them the session's default ones on this
            machine.
        router: endpoints of routers to go through instead, as of --router.
        keys: folder of the operator's keys, as of --keys.
        source: who this is, for people.
        timeout_s: longest wait until the session runs.

    Raises:
        SessionError: there is no such session, or it does not begin.
        UsageError: nobody can hold that arm, or an endpoint cannot be used.
    """
    connection = secure_connection(
        resolve_member_connection(None, connect, router), keys, insecure=False
    )
    with (
        RunningSession(session, connection).reach_site(site, timeout_s) as (bus, scenario),
        open_hand(
            bus=bus,
            clock=SystemClock(),
            session=session,
            site=site,
            scenario=scenario,
            source=source,
        ) as port,
    ):
        yield port


def open_hand(
    bus: Bus,
    clock: Clock,
    session: str,
    site: str,
    scenario: Scenario,
    source: str = "",
    *,
    repeats: bool = True,
) -> Hand:
    """Returns a hand at a site of a scenario, on a bus that reaches it.

    Raises:
        UsageError: nobody can hold that arm.
    """
    find_site(scenario, site)
    live = scenario.sites[site].find_live_hand(is_open=True)
    if live is None:
        able = ", ".join(scenario.open_hands)
        others = f"; they can at {able}" if able else ""
        raise UsageError(
            f"nobody can take hold of {site}: the scenario has no operator of kind 'live' there{others}"
        )
    compute_pose = tuple if live.mode == "joint" else scenario.arms[site].end_effector
    return Hand(
        bus=bus,
        clock=clock,
        session=session,
        site=site,
        operator=live.actor,
        compute_pose=compute_pose,
        source=source,
        repeats=repeats,
    )


def _read_replies(replies: Sequence[ChangeReply]) -> list[str]:
    if refused := [reply.text for reply in replies if not reply.accepted]:
        raise RunFailed(
            "; ".join([*refused, *(reply.text for reply in replies if reply.accepted)])
        )
    return [reply.text for reply in replies]


def _list_present(scenario: Scenario, found: dict[str, Info]) -> list[str]:
    """Returns the sites of a session; of one that sites may leave, those that run, if there are
    any.
    """
    running = [name for name in scenario.names if name in found and found[name].running]
    return running if running and scenario.sites_may_return else list(scenario.names)
