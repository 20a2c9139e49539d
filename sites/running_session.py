"""A running session from Python: orders, changes, pings and hands, and processes of a session.

Invariant:
    - Each call connects to the session, as its command does, and keeps no connection open.
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

GATHERING_NS = 500_000_000
"""Time for further sites to reply, after the first one of a session that sites may leave."""
STATES_KEPT = 4096
"""Number of a peer's latest records among which its sample in use is looked up."""
AHEAD_S = 0.5
"""Time from the newest known tick to a requested end; sites report their tick every 100 ms."""


SOURCE = "the operator"
"""Who gives the orders of this interface and of its commands, as events of sites name it."""


class ShareHistory:
    """The shares of a site in its peers, by the changes that are known so far."""

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._later_ramps = scenario.scripted_ramps(site)
        self._ramp = scenario.ramp(site, scenario.dominance[site], -1, 0.0)
        self._shares_before = self._ramp.alpha

    def add_change(self, change: str) -> None:
        """Adds a change, as an event of the site holds it; other changes are ignored."""
        with suppress(ScenarioError):  # a change that cannot be parsed comes from a stranger
            ramp = parse_core_change(self._scenario, self._site, change).ramp
            # An older ramp is one that has been added before.
            if ramp is not None and ramp.start_ns >= self._ramp.start_ns:
                self._later_ramps.append(ramp)

    def advance_to(self, t_ns: int) -> tuple[float, ...]:
        """Returns the shares at `t_ns`, ns since the epoch; the time must not decrease."""
        for ramp in sorted(ramp for ramp in self._later_ramps if ramp.start_ns <= t_ns):
            self._shares_before = self._interpolate(ramp.start_ns)
            self._ramp = ramp
        self._later_ramps = [ramp for ramp in self._later_ramps if ramp.start_ns > t_ns]
        return self._interpolate(t_ns)

    def _interpolate(self, t_ns: int) -> tuple[float, ...]:
        """Returns the shares at a time after the start of the present ramp."""
        ramp = self._ramp
        _, end_ns, shares_after = ramp
        if t_ns >= end_ns:
            return shares_after
        part = (t_ns - ramp.start_ns) / (end_ns - ramp.start_ns)
        pairs = zip(self._shares_before, shares_after, strict=True)
        return tuple(before + part * (after - before) for before, after in pairs)


class RunningSession:
    """A running session, as `session` returns it.

    Most methods return the replies of the sites, a sentence each.

    Args:
        name: the session's name.
        connection: the endpoints and keys.
        bus: a bus that reaches the session; without it, each call opens a connection.
        clock: the clock of this process.
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
        """Yields a connection to the session.

        Args:
            member: the member whose keys are used; "" stands for any member's.
            timeout_s: longest wait for a reply, s.

        Raises:
            SessionError: no site replies.
        """
        if self._bus is not None:
            yield self._bus
            return
        if member:
            self._connection.require(member)
        with connect_to_session(
            self._connection,
            self._clock,
            self.name,
            embedded_names_reader(self.name),
            stopped=lambda: False,
            timeout_s=timeout_s,
        ) as bus:
            assert bus is not None  # None only if `stopped` returns True
            yield bus

    @contextmanager
    def reach_site(self, site: str, timeout_s: float) -> Iterator[tuple[Bus, Scenario]]:
        """Waits until a site runs; yields a connection to the session, and its scenario.

        Args:
            site: the name of the site.
            timeout_s: longest wait, s.

        Raises:
            SessionError: the session has no such site, or the site does not run in time.
        """
        with self.reach(timeout_s=timeout_s) as bus:
            give_up_ns = self._clock.monotonic_ns() + int(timeout_s * 1e9)
            while True:
                is_last_try = self._clock.monotonic_ns() >= give_up_ns
                with nullcontext() if is_last_try else suppress(SessionError):
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
        """Leads an arm by a device until the session ends; as `trilat hand --device`.

        Args:
            site: the site of the arm. The live hand of its scenario has the settings of the
                device.
            device: the device.
            stopped: returns True to end the call earlier.
            say: prints a line for the user.
            timeout_s: longest wait until the session runs, s.

        Raises:
            SessionError: there is no such session, or it does not begin.
            UsageError: no device can lead that arm.
        """
        with (
            self.reach_site(site, timeout_s) as (bus, scenario),
            open_hand(
                bus=bus,
                clock=self._clock,
                session=self.name,
                site=site,
                scenario=scenario,
                source=type(device).__name__,
                repeats=False,
            ) as hand,
        ):
            live = scenario.sites[site].find_live_hand(is_open=True)
            if live is None or live.mode != "tip":
                raise UsageError(
                    f"a device leads an end effector: the hand of {site} is not of mode 'tip'"
                )
            device_hand = DeviceHand(
                hand=hand,
                device=device,
                settings=live.device,
                clock=self._clock,
                reach=scenario.arms[site].reach,
            )
            device_hand.run(stopped, lambda text: say(f"{site}: {text}"))
            say(f"{site}: {device_hand.describe()}")

    def stop(self, *sites: str) -> list[str]:
        """Stops some arms, or all, at once while the session goes on; as `trilat stop`."""
        return _read_replies(self.send_order(sites, "stop"))

    def enable(self, *sites: str) -> list[str]:
        """Lets stopped arms follow again; as `trilat enable`."""
        return _read_replies(self.send_order(sites, "enable"))

    def reset(self, *sites: str) -> list[str]:
        """Ends the fault of sites, unless its reason persists; as `trilat reset`."""
        return _read_replies(self.send_order(sites, "reset"))

    def send_order(self, sites: Sequence[str], order: OrderName) -> list[ChangeReply]:
        """Sends an order to some sites, and returns their replies.

        Args:
            sites: the sites. () stands for all sites, under `glide` for those that are present.
            order: the order.

        Raises:
            SessionError: the session has not begun or has no such site, or a site does not
                reply.
        """
        with self.reach("" if order == "stop" else OPERATOR) as bus:
            scenario, infos = self._find_sites(bus)
            for name in sites:
                if name not in scenario.names:
                    known = f"its sites are {', '.join(scenario.names)}"
                    raise SessionError(f"session {self.name!r} has no site {name!r}; {known}")
            addressed = list(sites) or _list_present(scenario, infos)
            for name in addressed:
                if name not in infos or not infos[name].running:
                    state = "has not begun" if name in infos else "did not answer"
                    raise SessionError(f"session {self.name!r}: {name} {state}")
            request = ChangeRequest(order=order, source=SOURCE)
            return [self._send_change(bus, name, request) for name in addressed]

    def _send_change(self, bus: Bus, site: str, request: ChangeRequest) -> ChangeReply:
        return send_change(
            bus=bus, clock=self._clock, session=self.name, site=site, request=request
        )

    def end(self) -> list[str]:
        """Ends the session in order, all sites at the same time; as `trilat stop --end`.

        Raises:
            SessionError: the session has not begun, or a site does not reply.
        """
        with self.reach() as bus:
            scenario, infos = self._find_sites(bus)
            present = _list_present(scenario, infos)
            if missing := [name for name in present if name not in infos]:
                raise SessionError(
                    f"session {self.name!r}: {', '.join(missing)} of its sites did not answer"
                )
            if waiting := [name for name in present if not infos[name].running]:
                names = ", ".join(waiting)
                raise SessionError(
                    f"session {self.name!r} has not begun: {names} waits for the others"
                )
            times_s = [infos[name].ticks / scenario.sites[name].rate_hz for name in present]
            request = ChangeRequest(stop_s=max(times_s) + AHEAD_S)
            return [self._send_change(bus, name, request).text for name in present]

    def _find_sites(self, bus: Bus) -> tuple[Scenario, dict[str, Info]]:
        """Returns the scenario of the session, and the replies of its sites by name.

        Sites of a session that they may leave have `GATHERING_NS` to reply after the first one.

        Raises:
            SessionError: no site replies.
        """
        clock = self._clock
        infos: dict[str, Info] = {}
        scenario: Scenario | None = None
        begun_ns = 0
        for info in self._find_members(bus):
            if scenario is None and info.scenario:
                scenario = parse_embedded(info.scenario, self.name)
            if scenario is not None and info.member in scenario.sites:
                infos[info.member] = info
                begun_ns = begun_ns or clock.monotonic_ns()
                waited_ns = clock.monotonic_ns() - begun_ns
                has_waited = scenario.sites_may_return and waited_ns > GATHERING_NS
                if len(infos) == len(scenario.names) or has_waited:
                    return scenario, infos
        if scenario is None:
            raise SessionError(
                f"no site of session {self.name!r} answers; "
                "other endpoints are named with --connect"
            )
        return scenario, infos

    def _find_members(self, bus: Bus) -> Iterator[Info]:
        return find_members(
            bus, self._clock, self.name, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S
        )

    def _find_running(self, bus: Bus, site: str) -> Info:
        """Returns the reply of a running site.

        Raises:
            SessionError: the session has no such site or has not begun, or the site does not
                reply in time.
        """
        read_names = embedded_names_reader(self.name)
        for info in self._find_members(bus):
            if info.member == site and not info.running:
                raise SessionError(
                    f"session {self.name!r} has not begun: {site} waits for the others"
                )
            if info.member == site:
                return info
            names = read_names(info.scenario) if info.scenario else ()
            if names and site not in names:
                known = f"its sites are {', '.join(names)}"
                raise SessionError(f"session {self.name!r} has no site {site!r}; {known}")
        raise SessionError(
            f"site {site!r} of session {self.name!r} does not answer; "
            "other endpoints are named with --connect"
        )

    def set_link(self, link: str, **to: Any) -> str:
        """Changes settings of a link such as "m1->s", as in `delay_ms=350`.

        It does the same as `trilat set link`.
        """
        return self._change(link.partition("->")[2], link=link, to=to)

    def set_dominance(self, site: str, shares: Mapping[str, float], ramp_s: float = 1.0) -> str:
        """Changes a site's shares in its peers, as in `{"m1": 0.9, "m2": 0.1}`.

        It does the same as `trilat set dominance`.
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
            SessionError: the session has no such site or has not begun, or the site does not
                reply.
        """
        with self.reach() as bus:
            self._find_running(bus, site)
            return self._send_change(bus, site, request)

    @contextmanager
    def records(self, *sites: str) -> Iterator[Callable[[], list[State]]]:
        """Subscribes to the records of some sites, by default of all.

        It yields a function that returns the records that have arrived since its last call.

        >>> with tn.session("paper").records("s") as receive:  # doctest: +SKIP
        ...     [record.q_des for record in receive()]
        """
        with self.reach("") as bus:
            inboxes = [
                bus.inbox(topics.key(self.name, site, topics.STATE), 4096)
                for site in sites or ("*",)
            ]

            def receive() -> list[State]:
                return [record for inbox in inboxes for record in read_records(inbox)]

            yield receive

    @contextmanager
    def states(self, as_site: str = "") -> Iterator[Callable[[], dict[str, State]]]:
        """Subscribes to all sites; yields a function that returns a record of each, by name.

        Without `as_site` these are the newest records. With `as_site` they are the records that
        the user of that site is shown: the site's own newest record, and of each peer the
        record whose sample is in use, delayed by the link or by the picture
        (`[sites.NAME.view]`). A peer is missing if that record was made before the
        subscription, or more than `STATES_KEPT` ticks ago.

        >>> with tn.session("paper").states(as_site="m1") as find:  # doctest: +SKIP
        ...     find()["s"].q
        """
        with self.reach("") as bus:
            inbox = bus.inbox(topics.key(self.name, "*", topics.STATE), STATES_KEPT)
            kept: dict[str, deque[State]] = {}
            pictures: dict[str, PictureDelay] = {}

            def find() -> dict[str, State]:
                for record in read_records(inbox):
                    kept.setdefault(record.site, deque(maxlen=STATES_KEPT)).append(record)
                newest = {site: records[-1] for site, records in kept.items()}
                if not as_site:
                    return newest
                if as_site not in newest:
                    return {}
                if as_site not in pictures:
                    info = self._find_running(bus, as_site)
                    scenario = parse_embedded(info.scenario, self.name)
                    pictures[as_site] = PictureDelay(scenario, as_site)
                local_record = newest[as_site]
                shown = {as_site: local_record}
                ticks = pictures[as_site].advance_to(local_record.tick, local_record.used)
                for peer, tick in ticks.items():
                    for record in reversed(kept.get(peer, deque())):
                        if record.tick == tick:
                            shown[peer] = record
                            break
                return shown

            yield find

    def mark(self, text: str) -> str:
        """Marks this moment in the log by a text, which is an event of a site."""
        with self.reach() as bus:
            scenario, infos = self._find_sites(bus)
            first = next(name for name in scenario.names if name in infos)
            return self._send_change(bus, first, ChangeRequest(mark=text)).text

    @contextmanager
    def episode(self, name: str) -> Iterator[Callable[[bool], None]]:
        """Marks the beginning and the end of an episode.

        It yields a function that records whether the episode has succeeded.

        >>> with tn.session("paper").episode("reach 3") as judge:  # doctest: +SKIP
        ...     judge(True)
        """
        judgements: list[bool] = []
        self.mark(f"episode {name} begins")
        try:
            yield judgements.append
        finally:
            judgement = judgements[-1] if judgements else None
            outcome = {True: "succeeded", False: "failed", None: "ended"}[judgement]
            self.mark(f"episode {name} {outcome}")

    @contextmanager
    def shares(self, site: str) -> Iterator[Callable[[], dict[str, float]]]:
        """Subscribes to a site; yields a function that returns its present shares, by peer."""
        with self.reach("") as bus:
            info = self._find_running(bus, site)
            records = bus.inbox(topics.key(self.name, site, topics.STATE), 256)
            events = bus.inbox(topics.key(self.name, site, topics.EVENT), 256)
            scenario = parse_embedded(info.scenario, self.name)
            now_ns = 0
            history = ShareHistory(scenario, site)
            for event in list_past_events(bus, self._clock, self.name, site):
                history.add_change(event.command)

            def find() -> dict[str, float]:
                nonlocal now_ns
                for event in read_messages(events, Event):
                    history.add_change(event.command)
                now_ns = max([now_ns, *(record.t_ns for record in read_records(records))])
                shares = history.advance_to(now_ns)
                return dict(zip(scenario.peers(site), shares, strict=True))

            yield find

    def ping(self, count: int = 50, timeout_s: float = 3.0) -> PingReport:
        """Measures round trips, clock offsets and links of the session; as `trilat ping`."""
        report = ping_session(
            connection=self._connection,
            clock=self._clock,
            session=self.name,
            count=count,
            timeout_s=timeout_s,
            stopped=lambda: False,
        )
        assert report is not None  # None only if `stopped` returns True
        return report


def session(
    name: str,
    *,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> RunningSession:
    """Returns a running session, to stop, change and measure it.

    Its methods do the same as `trilat stop`, `set` and `ping`.

    >>> paper = tn.session("paper")  # doctest: +SKIP
    >>> paper.set_link("m1->s", delay_ms=350)  # doctest: +SKIP
    >>> paper.stop("s"), paper.enable("s"), paper.ping()  # doctest: +SKIP

    Args:
        name: the session's name.
        connect: endpoints, as for --connect; by default the session's own on this machine.
        router: endpoints of routers to go through instead, as for --router.
        keys: the folder of the operator's keys, as for --keys. To stop arms and to ping, the
            keys of any member suffice.

    Raises:
        UsageError: an endpoint or the keys cannot be used.
    """
    connection = resolve_member_connection(None, connect, router)
    return RunningSession(name, secure_connection(connection, keys, insecure=False))


def start(*words: str | Path) -> "subprocess.Popen[bytes]":
    """Starts a process of a session, as in a terminal.

    It runs until its end, or until it is terminated. The commands are `trilat site`, `hand`,
    `record`, `router`, `replay`, `watch`, `live` and `ros2`.

    >>> recorder = tn.start("record", "--session", "paper", "-o", "run.mcap")  # doctest: +SKIP
    >>> player = tn.start("replay", "run.mcap", "--rate", "2")  # doctest: +SKIP
    >>> player.wait()  # doctest: +SKIP

    Args:
        words: the command and its arguments, without `trilat`.
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
    """Joins a live session as a hand at one arm; a context manager that releases the arm.

    >>> with tn.hand("play", "m1") as hand:  # doctest: +SKIP
    ...     hand.move(1.2, 0.4)
    ...     hand.force, hand.pose

    Args:
        session: the session's name, by default the scenario's.
        site: the site of the arm; its scenario must have an operator of kind "live".
        connect: endpoints, as for --connect; by default the session's own on this machine.
        router: endpoints of routers to go through instead, as for --router.
        keys: the folder of the operator's keys, as for --keys.
        source: a name of the holder, for events.
        timeout_s: longest wait until the session runs, s.

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
    """Returns a hand at a site of a scenario.

    Args:
        bus: a bus that reaches the site.
        clock: the clock of this process.
        session: the session's name.
        site: the site of the arm.
        scenario: the scenario of the session.
        source: a name of the holder, for events.
        repeats: whether a thread repeats the hand's last message, see `Hand`.

    Raises:
        UsageError: nobody can hold that arm.
    """
    find_site(scenario, site)
    live = scenario.sites[site].find_live_hand(is_open=True)
    if live is None:
        open_sites = ", ".join(scenario.open_hands)
        remedy = f"; they can at {open_sites}" if open_sites else ""
        raise UsageError(
            f"nobody can take hold of {site}: "
            f"the scenario has no operator of kind 'live' there{remedy}"
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
    """Returns the texts of replies that all accept.

    Raises:
        RunFailed: a site has refused; the message begins with the refusals.
    """
    accepted = [reply.text for reply in replies if reply.accepted]
    refused = [reply.text for reply in replies if not reply.accepted]
    if refused:
        raise RunFailed("; ".join([*refused, *accepted]))
    return accepted


def _list_present(scenario: Scenario, infos: dict[str, Info]) -> list[str]:
    """Returns the sites that an order to all sites is for.

    These are all sites of the scenario. If sites may leave the session, they are only the
    running ones, unless no site runs.
    """
    running = [name for name in scenario.names if name in infos and infos[name].running]
    return running if running and scenario.sites_may_return else list(scenario.names)
