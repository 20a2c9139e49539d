"""Controls a running session from Python: stops arms, changes links, moves arms, reads records.

A session is a set of processes (sites) that each control one arm and exchange the states of
their arms over the network. `session` returns a `RunningSession`, whose methods send requests
to the sites and return their replies. `hand` lets a program act as the operator of an arm.
`start` starts one of the session's processes, as a user would from a terminal.

The commands `trilat stop`, `enable`, `reset`, `set`, `ping` and `hand` use the same functions.

Invariant:
    - Each call opens a connection to the session and closes it before returning, like the
      command of the same name. A `RunningSession` therefore remains usable if sites come and go
      between calls.
    - In a `with` block over a `RunningSession`, all calls share one connection, which is closed
      at the end of the block.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from trilat_net.entry_points import HOOKS, load_entry
from trilat_net.errors import RunFailed, SessionError, UsageError
from trilat_net.scenario import Scenario, parse_embedded

from ..net import (
    OPERATOR,
    REPLY_TIMEOUT_S,
    Bus,
    ChangeReply,
    ChangeRequest,
    Clock,
    Connection,
    Event,
    Hand,
    Info,
    OrderName,
    SessionMembers,
    State,
    SystemClock,
)
from .input_device import Device
from .session_ping import PingReport, ping_session
from .session_search import SessionSearch
from .share_history import ShareHistory
from .visible_states import STATES_KEPT, VisibleStates

RETRY_NS = 50_000_000
"""Time between two attempts to reach a site, in ns."""
AHEAD_S = 0.5
"""Time from the newest known tick of any site to the tick at which a session is ended, in s.

Sites report their tick every 100 ms. Therefore the known ticks are slightly out of date.
"""


SOURCE = "the operator"
"""Name of the person who sends the requests of this module, as the log mentions it."""


def _never_stopped() -> bool:
    """Returns False: the argument `stopped` of calls that end only after a time limit."""
    return False


class RunningSession:
    """A running session that can be controlled and observed from Python.

    Use `session` to create the object. Most methods send a request to one or more sites (the
    processes that each control one arm) and return the replies, one sentence per site.

    Args:
        name: Name of the session.
        connection: Endpoints of the session, and the keys of a member.
        bus: An open network connection to the session. If `None`, each call opens a connection.
        clock: Clock of this process. If `None`, a new clock is created.
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
        # For each `with` block that is entered: how to leave it, and the connection before it.
        self._blocks: list[tuple[ExitStack, Bus | None]] = []

    def __enter__(self) -> "RunningSession":
        """Opens one network connection to the session, which all calls in the `with` block use.

        Without a `with` block, each call opens a connection of its own, which takes longer.

        Raises:
            SessionError: No site of the session replies in time.
        """
        with ExitStack() as opening:
            bus = opening.enter_context(self.reach(""))
            self._blocks.append((opening.pop_all(), self._bus))
        self._bus = bus
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the network connection of the `with` block. The session itself goes on."""
        opened, self._bus = self._blocks.pop()
        opened.close()

    @contextmanager
    def reach(
        self, member: str = OPERATOR, timeout_s: float = REPLY_TIMEOUT_S
    ) -> Iterator[Bus]:
        """Opens a network connection to the session, as a context manager.

        If the members of the session authenticate with keys, a site accepts a request only from
        a member that is allowed to send it. Most requests need the operator's keys.

        Args:
            member: Name of the member that sends the requests. If this object has keys, they
                must belong to that member. If `member` is empty, the keys of any member are
                accepted.
            timeout_s: Maximum time to wait for the reply of a site, in s.

        Yields:
            The connection. It is closed at the end of the `with` block, unless it was passed to
            this object.

        Raises:
            SessionError: No site replies in time.
            UsageError: The keys belong to another member.
        """
        if self._bus is not None:
            yield self._bus
            return

        if member:
            self._connection.require(member)
        with self._connection.open_session(
            self._clock,
            self.name,
            self._read_site_names,
            stopped=_never_stopped,
            timeout_s=timeout_s,
        ) as bus:
            assert bus is not None  # it is None only if the call was stopped
            yield bus

    @contextmanager
    def reach_site(self, site: str, timeout_s: float) -> Iterator[tuple[Bus, Scenario]]:
        """Waits until a site is running, and connects to its session, as a context manager.

        The connection is closed at the end of the `with` block.

        Args:
            site: Name of the site.
            timeout_s: Maximum time to wait, in s.

        Yields:
            The network connection, and the scenario of the session.

        Raises:
            SessionError: The session has no such site, or the site is not running in time.
        """
        with self.reach(timeout_s=timeout_s) as bus:
            give_up_ns = self._clock.monotonic_ns() + int(timeout_s * 1e9)
            while True:
                # Errors are ignored until the last attempt, which raises its error.
                is_last_try = self._clock.monotonic_ns() >= give_up_ns
                ignore_error = nullcontext() if is_last_try else suppress(SessionError)
                with ignore_error:
                    info = self._search(bus).find_running(site)
                    break
                self._clock.sleep_until(self._clock.monotonic_ns() + RETRY_NS)

            scenario = parse_embedded(info.scenario, self.name)
            yield bus, scenario

    def _search(self, bus: Bus) -> SessionSearch:
        """Returns the search for the sites of this session over a network connection."""
        return SessionSearch(bus, self._clock, self.name)

    def lead(
        self,
        site: str,
        device: Device,
        *,
        stopped: Callable[[], bool] = _never_stopped,
        say: Callable[[str], None] = print,
        timeout_s: float = REPLY_TIMEOUT_S,
    ) -> None:
        """Moves an arm with an input device, such as a 3D mouse, until the session ends.

        The command `trilat hand --device` does the same.

        Args:
            site: Name of the site that controls the arm. The device settings for this site are
                part of the scenario.
            device: The input device.
            stopped: Function that returns True to end the call early.
            say: Function that prints a line for the user.
            timeout_s: Maximum time to wait until the session runs, in s.

        Raises:
            SessionError: The session does not exist, or does not begin in time.
            UsageError: The scenario does not allow an input device to move that arm, or the
                package trilat-people is not installed.
        """
        make_device_hand = load_entry(HOOKS, "device-hand", "RunningSession.lead")
        with (
            self.reach_site(site, timeout_s) as (bus, scenario),
            self.open_hand(
                bus, site, scenario, source=type(device).__name__, repeats=False
            ) as hand,
        ):
            device_hand = make_device_hand(
                hand=hand,
                device=device,
                scenario=scenario,
                site=site,
                clock=self._clock,
            )
            device_hand.run(stopped, lambda text: say(f"{site}: {text}"))
            say(f"{site}: {device_hand.describe()}")

    def open_hand(
        self,
        bus: Bus,
        site: str,
        scenario: Scenario,
        source: str = "",
        *,
        repeats: bool = True,
    ) -> Hand:
        """Opens a connection through which a program moves an arm of a running session.

        The program takes the place of the person who would otherwise hold the arm.

        Args:
            bus: Network connection that reaches the site.
            site: Site of the arm.
            scenario: Scenario of the session.
            source: Name of the program or person, used in events of the session.
            repeats: True to repeat the last message regularly from a thread, so that the site
                knows that the program is still running; see `Hand`.

        Raises:
            UsageError: The scenario does not allow a live operator at that arm.
        """
        scenario.find_site(site)
        live = scenario.sites[site].find_live_hand(is_open=True)
        if live is None:
            open_sites = ", ".join(scenario.open_hands)
            remedy = f"; the sites with such an operator are {open_sites}" if open_sites else ""
            raise UsageError(
                f"nobody can move the arm of {site}: "
                f"the scenario has no operator of kind 'live' at this site{remedy}"
            )

        compute_pose = tuple if live.mode == "joint" else scenario.arms[site].end_effector
        return Hand(
            bus=bus,
            clock=self._clock,
            session=self.name,
            site=site,
            operator=live.actor,
            compute_pose=compute_pose,
            source=source,
            repeats=repeats,
        )

    def stop(self, *sites: str) -> list[str]:
        """Stops the given arms at once, while the rest of the session continues.

        The command `trilat stop` does the same.

        Args:
            *sites: Names of the sites whose arms are stopped. If no name is given, all arms
                stop.

        Returns:
            The sites' replies, one sentence each, in the order of the sites.
        """
        return _read_replies(self.send_order(sites, "stop"))

    def enable(self, *sites: str) -> list[str]:
        """Lets stopped arms follow the other arms of the session again.

        The command `trilat enable` does the same.

        Args:
            *sites: Names of the sites. Default: all sites.

        Returns:
            The sites' replies, one sentence each, in the order of the sites.
        """
        return _read_replies(self.send_order(sites, "enable"))

    def reset(self, *sites: str) -> list[str]:
        """Clears the faults of arms, for example a fault due to missing measurements.

        The arms can then be enabled again. A fault whose cause persists is not cleared. The
        command `trilat reset` does the same.

        Args:
            *sites: Names of the sites. Default: all sites.

        Returns:
            The sites' replies, one sentence each, in the order of the sites.
        """
        return _read_replies(self.send_order(sites, "reset"))

    def send_order(self, sites: Sequence[str], order: OrderName) -> list[ChangeReply]:
        """Sends an order such as "stop" to the given sites, and waits for their replies.

        If any of the sites is not running, the order is sent to none of them. A misspelled name
        is therefore reported before any arm reacts.

        Args:
            sites: Names of the sites. If empty, the order is sent to all sites, or to all sites
                that are present if the scenario allows sites to leave.
            order: The order: "stop", "enable" or "reset".

        Returns:
            The reply of each site, which says whether the site accepts or refuses the order.

        Raises:
            SessionError: The session has not begun or has no such site, or a site does not
                reply.
        """
        # In a session with keys, every member may stop arms, but only the operator may do more.
        member = "" if order == "stop" else OPERATOR
        with self.reach(member) as bus:
            scenario, infos = self._search(bus).find_all()
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
        """Sends a request to the process of one arm, and returns its reply.

        Args:
            bus: Network connection.
            site: Name of the process, the site of the arm.
            request: The requested change.

        Returns:
            The reply, which says whether the site accepts or refuses the change.

        Raises:
            SessionError: The site does not reply in time.
        """
        return SessionMembers(bus, self._clock, self.name).send_change(site, request)

    def end(self) -> list[str]:
        """Ends the session for all arms at the same time, as `trilat stop --end` does.

        The end is scheduled about half a second ahead, so that all processes receive the
        request in time.

        Returns:
            The sites' replies, one sentence each, in the order of the sites.

        Raises:
            SessionError: The session has not begun, or a site does not reply.
        """
        with self.reach() as bus:
            scenario, infos = self._search(bus).find_all()
            present = _list_present(scenario, infos)

            missing = [name for name in present if name not in infos]
            if missing:
                raise SessionError(
                    f"session {self.name!r}: these sites did not answer: {', '.join(missing)}"
                )

            waiting = [name for name in present if not infos[name].running]
            if waiting:
                names = ", ".join(waiting)
                raise SessionError(
                    f"session {self.name!r} has not begun: these sites wait for the others: "
                    f"{names}"
                )

            # The end lies ahead of every site's present time, so that no site has passed it.
            times_s = [infos[name].ticks / scenario.sites[name].rate_hz for name in present]
            end_s = max(times_s) + AHEAD_S
            request = ChangeRequest(stop_s=end_s)
            return [self._send_change(bus, name, request).text for name in present]

    def _read_site_names(self, text: str) -> tuple[str, ...]:
        """Returns the names of the sites from the text of the scenario in a site's reply."""
        return parse_embedded(text, self.name).names

    def set_link(self, link: str, **to: Any) -> str:
        """Changes settings of a link while the session runs, as `trilat set link` does.

        A link is a one-way connection between two sites. Its settings include, for example, an
        additional delay or loss.

        Args:
            link: Name of the link, for example "m1->s" for the direction from site m1 to site
                s.
            **to: The new settings, for example `delay_ms=350`.

        Returns:
            The reply, as a sentence, of the receiving site, which carries out the change.

        Raises:
            RunFailed: The site has refused the change.
        """
        return self._change(link.partition("->")[2], link=link, to=to)

    def set_dominance(self, site: str, shares: Mapping[str, float], ramp_s: float = 1.0) -> str:
        """Changes the weights with which an arm follows the other arms.

        This can hand the lead from one operator to another, for example from a trainer to a
        trainee. The command `trilat set dominance` does the same.

        Args:
            site: Name of the site.
            shares: New weight of each peer that the site follows, for example `{"m1": 0.9,
                "m2": 0.1}`.
            ramp_s: Duration of the change, in s.

        Returns:
            The reply of the site, as a sentence.

        Raises:
            RunFailed: The site has refused the change.
        """
        return self._change(site, dominance=site, to=dict(shares), ramp_s=ramp_s)

    def _change(self, site: str, **change: Any) -> str:
        """Requests a change from one running arm, and raises an error if it is refused.

        Args:
            site: Name of the site, the process that controls the arm.
            **change: Fields of a `ChangeRequest`.

        Returns:
            The text of the reply.

        Raises:
            RunFailed: The site has refused the change.
        """
        reply = self.change(site, ChangeRequest(**change))
        if not reply.accepted:
            raise RunFailed(f"refused: {reply.text}")
        return reply.text

    def change(self, site: str, request: ChangeRequest) -> ChangeReply:
        """Asks a running site to change a setting, such as the delay of a link.

        The site carries out the change at its next tick.

        Args:
            site: Name of the site.
            request: The requested change.

        Returns:
            The reply, which says whether the site accepts or refuses the change.

        Raises:
            SessionError: The session has no such site or has not begun, or the site does not
                reply.
        """
        with self.reach() as bus:
            self._search(bus).find_running(site)
            return self._send_change(bus, site, request)

    @contextmanager
    def records(self, *sites: str) -> Iterator[Callable[[], list[State]]]:
        """Subscribes to the records of the given sites, as a context manager.

        A record holds everything that a site measured and computed in one tick of its control
        loop.

        >>> with tn.session("paper").records("s") as receive:  # doctest: +SKIP
        ...     [record.q_des for record in receive()]

        Args:
            *sites: Names of the sites. Default: all sites.

        Yields:
            A function that returns the records that have arrived since its last call.
        """
        with self.reach("") as bus:
            members = SessionMembers(bus, self._clock, self.name)
            readers = [
                members.subscribe(State, site, capacity=STATES_KEPT)
                for site in sites or ("*",)  # all sites
            ]

            def receive() -> list[State]:
                """Returns the records of the subscribed sites that arrived since the last call.

                The list is empty if no record has arrived.
                """
                return [record for read_new in readers for record in read_new()]

            yield receive

    @contextmanager
    def states(self, as_site: str = "") -> Iterator[Callable[[], dict[str, State]]]:
        """Subscribes to the latest record of each site, as a context manager.

        With `as_site`, the records show what the user of that site sees: the latest record of
        the site itself and, for each peer, the record of the sample that the user currently
        sees. That sample is older than the peer's latest one, because the link delays it, or
        because the scenario delays the picture in which the user sees the other arms
        (`[sites.NAME.view]`). A peer is missing if the record of that sample was published
        before the subscription, or more than `STATES_KEPT` ticks ago.

        >>> with tn.session("paper").states(as_site="m1") as find:  # doctest: +SKIP
        ...     find()["s"].q

        Args:
            as_site: Name of the site whose view is returned. If empty, the latest records are
                returned.

        Yields:
            A function that returns one record per site, keyed by site name.
        """
        with self.reach("") as bus:
            yield VisibleStates(bus, self._clock, self.name, as_site).read

    def mark(self, text: str) -> str:
        """Adds a text mark to the log at the current time.

        For example, a user can mark an unusual event in order to find it in the log later. Of
        the sites that are present, the first one in the scenario publishes the mark as an
        event, which the recorder stores.

        Args:
            text: Text of the mark, for people who read the log.

        Returns:
            The reply of the site, as a sentence.
        """
        with self.reach() as bus:
            scenario, infos = self._search(bus).find_all()
            first_present = next(name for name in scenario.names if name in infos)
            reply = self._send_change(bus, first_present, ChangeRequest(mark=text))
            return reply.text

    @contextmanager
    def episode(self, name: str) -> Iterator[Callable[[bool], None]]:
        """Marks a named part of the run (an episode) in the log. This is a context manager.

        The beginning and the end of the `with` block are stored as marks. Tools that read the
        log can then divide the run into episodes, for example one per attempt at a task.

        >>> with tn.session("paper").episode("reach 3") as judge:  # doctest: +SKIP
        ...     judge(True)

        Args:
            name: Name of the episode.

        Yields:
            A function to be called with True if the episode has succeeded, otherwise with
            False. If it is called several times, the last call counts. If it is never called,
            the log only says that the episode ended.
        """
        judgements: list[bool] = []
        self.mark(f"episode {name} begins")
        try:
            yield judgements.append
        finally:
            outcome = "ended"
            if judgements:
                has_succeeded = judgements[-1]
                outcome = "succeeded" if has_succeeded else "failed"
            self.mark(f"episode {name} {outcome}")

    @contextmanager
    def shares(self, site: str) -> Iterator[Callable[[], dict[str, float]]]:
        """Subscribes to the weights with which an arm follows the others, as a context manager.

        These weights, the dominance factors, may change during the session.

        Args:
            site: Name of the site.

        Yields:
            A function that returns the current weights, keyed by peer name.
        """
        with self.reach("") as bus:
            info = self._search(bus).find_running(site)
            members = SessionMembers(bus, self._clock, self.name)
            read_records = members.subscribe(State, site, capacity=256)
            read_events = members.subscribe(Event, site, capacity=256)
            scenario = parse_embedded(info.scenario, self.name)
            now_ns = 0  # time of the newest record, since the start of the session
            history = ShareHistory(scenario, site)
            # The weights may have been changed before this subscription.
            for event in members.list_past_events(site):
                history.add_change(event.command)

            def find() -> dict[str, float]:
                """Returns the weight with which the arm follows each peer, keyed by peer name.

                The weights are those at the time of the latest record received from the site.
                """
                nonlocal now_ns
                for event in read_events():
                    history.add_change(event.command)
                for record in read_records():
                    now_ns = max(now_ns, record.t_ns)
                shares = history.advance_to(now_ns)
                return dict(zip(scenario.peers(site), shares, strict=True))

            yield find

    def ping(self, count: int = 50, timeout_s: float = 3.0) -> PingReport:
        """Measures round-trip times to the members of the session, and their clock offsets.

        The members are the sites and the recorders. The command `trilat ping` does the same.

        Args:
            count: Number of pings to each member.
            timeout_s: Maximum time to wait for replies, in s.

        Returns:
            The round-trip time to each member, the offset of its clock, and the delays of the
            links between the sites.
        """
        report = ping_session(
            connection=self._connection,
            clock=self._clock,
            session=self.name,
            count=count,
            timeout_s=timeout_s,
            stopped=_never_stopped,
        )
        assert report is not None  # it is None only if the call was stopped
        return report


def session(
    name: str,
    *,
    connect: Sequence[str] | None = None,
    router: Sequence[str] | None = None,
    keys: str | Path | None = None,
) -> RunningSession:
    """Returns an object that controls and observes a running session.

    Its methods do the same as commands such as `trilat stop`, `trilat set` and `trilat ping`.
    Each call opens a separate connection, unless the object is used in a `with` statement.

    >>> with tn.session("paper") as paper:  # doctest: +SKIP
    ...     paper.mark("look here")
    >>> paper = tn.session("paper")  # doctest: +SKIP
    >>> paper.set_link("m1->s", delay_ms=350)  # doctest: +SKIP
    >>> paper.stop("s"), paper.enable("s"), paper.ping()  # doctest: +SKIP

    Args:
        name: Name of the session.
        connect: Endpoints of the session, as for --connect. If `None`, the session's own
            endpoint on this machine is used.
        router: Endpoints of routers to connect through instead, as for --router.
        keys: Folder with the operator's keys, as for --keys. The keys of any member are enough
            to stop arms and to ping.

    Raises:
        UsageError: An endpoint or the keys cannot be used.
    """
    connection = Connection.of_member(None, connect, router)
    return RunningSession(name, connection.secure(keys, insecure=False))


def start(*arguments: str | Path) -> "subprocess.Popen[bytes]":
    """Starts one of a session's processes, as a user would from a terminal.

    The process runs until it ends by itself, or until the caller terminates it. The available
    commands are `trilat site`, `hand`, `record`, `router`, `replay`, `watch`, `live` and
    `ros2`.

    >>> recorder = tn.start("record", "--session", "paper", "-o", "run.mcap")  # doctest: +SKIP
    >>> player = tn.start("replay", "run.mcap", "--rate", "2")  # doctest: +SKIP
    >>> player.wait()  # doctest: +SKIP

    Args:
        *arguments: The command and its arguments, without `trilat`.

    Returns:
        The running process.
    """
    return subprocess.Popen([sys.executable, "-m", "trilat_net", *map(str, arguments)])


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
    """Lets a program act as the operator of an arm in a live session, as a context manager.

    The arm is released at the end of the `with` block.

    >>> with tn.hand("play", "m1") as hand:  # doctest: +SKIP
    ...     hand.move(1.2, 0.4)
    ...     hand.force, hand.pose

    Args:
        session: Name of the session. By default, a session has the name of its scenario.
        site: Site of the arm. In the scenario, it must have an operator of kind "live".
        connect: Endpoints of the session, as for --connect. If `None`, the session's own
            endpoint on this machine is used.
        router: Endpoints of routers to connect through instead, as for --router.
        keys: Folder with the operator's keys, as for --keys.
        source: Name of the program or person, used in events of the session.
        timeout_s: Maximum time to wait until the session runs, in s.

    Yields:
        The connection to the arm.

    Raises:
        SessionError: The session does not exist, or does not begin in time.
        UsageError: The scenario does not allow a live operator at that arm, or an endpoint
            cannot be used.
    """
    connection = Connection.of_member(None, connect, router).secure(keys, insecure=False)
    running = RunningSession(session, connection)
    with (
        running.reach_site(site, timeout_s) as (bus, scenario),
        running.open_hand(bus, site, scenario, source) as port,
    ):
        yield port


def _read_replies(replies: Sequence[ChangeReply]) -> list[str]:
    """Returns the texts of the sites' replies, if all sites have accepted a request.

    Args:
        replies: Reply of each site, the process that controls an arm.

    Returns:
        The text of each reply.

    Raises:
        RunFailed: A site has refused the request. The message lists the refusals first.
    """
    accepted = [reply.text for reply in replies if reply.accepted]
    refused = [reply.text for reply in replies if not reply.accepted]
    if refused:
        raise RunFailed("; ".join([*refused, *accepted]))
    return accepted


def _list_present(scenario: Scenario, infos: dict[str, Info]) -> list[str]:
    """Lists the sites to which a request to all arms is sent.

    These are all sites of the scenario. If the scenario allows sites to leave, they are only
    the running sites, as long as at least one site runs.
    """
    running = [name for name in scenario.names if name in infos and infos[name].running]
    if running and scenario.sites_may_return:
        return running
    return list(scenario.names)
