"""Serves the web page of a session: its files over HTTP, and its data over a WebSocket.

A page shows the arms while they move. Depending on its role, it may also hold an arm, change
the delay of links, or stop the arms. The server sends frames, which describe the current state,
and receives messages from the page. It reads the messages that the sites exchange, as a
recorder does.

The server runs in a thread of its own. The session neither waits for the server nor needs it:
if the server fails, the session continues. In an experiment with people, the server shows one
session after another, and a `Stage` controls the steps between them. If the machine has a
browser, the server opens it.

Invariant:
    - A page receives a new frame only after drawing an earlier one. A slow page therefore sees
      fewer frames, and no other part of the program waits for it. Each frame has the newest
      state.
    - Requests from pages of another web site, requests with no token, and messages that are too
      many, too large or not allowed for the role of the page are refused and counted. Their
      contents never reach a site.
    - The number of pages of each role is limited (see `page_entrance`).
    - A single thread serves all pages and receives the messages of the session, so no locks are
      needed.
"""

import asyncio
import logging
import os
import socket
import ssl
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidMessage
from websockets.http11 import Request, Response

from trilat_net.errors import UsageError, WireError, count_nouns
from trilat_net.net import (
    CERTIFICATE,
    HERE,
    PRIVATE_KEY,
    Bus,
    Clock,
    Connection,
    read_member_keys,
    topics,
)
from trilat_net.process import raise_priority

from .page_entrance import Strangers, choose_page_to_close
from .page_files import PageFiles
from .page_opening import BrowserOpening
from .page_orders import (
    MAX_MESSAGE_BYTES,
    AnswerPage,
    EndSession,
    MessageLimits,
    MoveHand,
    OrderDesk,
    PageHands,
    PageMessage,
    Role,
    RoleLinks,
    Seen,
    ShowAges,
    SiteOrder,
    StageMessage,
    StopArms,
    TakePart,
)
from .session_frames import SessionFrames
from .session_view import SessionView

# The libraries of experiments are loaded for experiments only.
if TYPE_CHECKING:
    from .experiment_stage import Stage

NICE = -5
"""Priority of the page's threads, and of the threads that deliver its messages.

Above normal priority, but below that of the sites.
"""
FRAMES_PER_S = 30
"""Frame rate, in 1/s."""
FRAMES_AHEAD = 2
"""Maximum number of undrawn frames of a page: one in transit and one being drawn."""
MAX_EXCESS = 1_000
"""Number of messages above the permitted rate after which a page is closed."""
REQUEST_TIMEOUT_S = 3.0
"""Maximum time for the TLS handshake, and again for the request, in s."""
ANSWER_TIMEOUT_NS = 10_000_000_000
"""Time for a page that holds an arm to answer another page's request to take part, in ns."""
RESTART_S = 1.0
"""Time between a failure of the server and its restart, in s."""
SWITCH_POLL_NS = 10_000_000
"""Time between two checks for a request to switch sessions, in ns."""
WAITING_FRAME_STEP = 10
"""Number of frame periods between two frames before a session starts."""
POINTS_PER_FRAME = 240
"""Maximum number of plot points in a frame. After a longer absence, plots have a gap."""
_POLICY_VIOLATION = 1008
"""WebSocket close code sent by the server on a policy violation (RFC 6455)."""
_BROKEN = {1002: "broken frames", 1007: "no text", 1009: "too large"}
"""WebSocket close codes sent by the library (RFC 6455), with the reason to count."""
_SILENT = logging.getLogger("trilat.page")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False
"""Logger of the WebSocket library, silenced because strangers could flood it."""

RESULTS_TIMEOUT_NS = 600_000_000_000
"""How long after the session an open page can load the report and the log, in ns."""
MAX_DURATION_S = 3600.0
"""Default maximum duration of a session with a page, in s."""

_NO_HTTP = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class _Visitor(ServerConnection):
    """Connection of a browser to the server.

    Any program can connect. Data that are not a valid browser request are counted and answered
    with HTTP status 400.

    Attributes:
        refused: Mapping from reason to number of refused connections and messages.
        strangers: Open connections that do not belong to a web page yet.
    """

    refused: Counter[str]
    strangers: Strangers
    _has_received = False
    _is_counted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Adds a new connection to `strangers`, the connections that have no page yet.

        Args:
            transport: The connection.
        """
        super().connection_made(transport)
        self.strangers.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Removes a closed connection from `strangers`, the connections that have no page yet.

        Args:
            exc: Error that closed the connection, or `None` if it was closed normally.
        """
        self.strangers.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Processes data from the browser, and records that this connection has sent data.

        Browsers open some connections in advance and close them unused. Since they send no
        data, they can be distinguished from connections that sent an invalid request.

        Args:
            data: The bytes received.
        """
        # Connections that browsers open in advance and close unused are not counted.
        self._has_received = True
        super().data_received(data)

    def send_data(self) -> None:
        """Sends pending data to the browser, and counts refused connections.

        A connection is refused if the data from the browser were not a valid request to open a
        WebSocket. If the data were not even HTTP, the reply has the HTTP status 400.
        """
        problem = self.protocol.handshake_exc
        # A browser may also close a connection unused, which is no problem.
        is_new_refusal = problem is not None and self._has_received and not self._is_counted
        if is_new_refusal:
            self._is_counted = True
            self.refused["malformed request"] += 1
            if self.request is None and isinstance(problem, InvalidMessage):
                self.transport.write(_NO_HTTP)
        super().send_data()


class _Page:
    """State of one open page: its rights, and the data sent to it.

    Each frame sent to the page describes the complete current state, so a slow page may miss
    some frames.

    Attributes:
        connection: WebSocket connection to the page.
        number: Number of the page, starting at 1.
        role: Rights of the page's user, and the site whose view the page shows.
        hands: Connections through which the page holds and moves arms.
        takes_part: True if the page may send orders.
        asks: The other pages that must agree before this page may take part, and the time of
            its request in ns. `None` if the page has not asked to take part.
        wake: Set when there is a frame that the page has not received.
        drawn: Number of the last frame that the page has drawn.
        sent: Number of the last frame that was sent to the page.
        notified: Number of the frame that was sent before the last frame.
        unseen: Numbers of the frames that were sent but have not been drawn yet.
        points: Number of plot points that the page has received.
        energies: Number of energy plot points that the page has received.
        events: Number of events that the page has received.
        greeted: True if the page has received the description of the running session.
        limits: Limits on the page's message rates.
        excess: Number of messages that exceeded the common limit for all kinds of messages.
    """

    def __init__(
        self,
        connection: ServerConnection,
        number: int,
        role: Role,
        hands: PageHands,
        *,
        takes_part: bool,
    ) -> None:
        self.connection = connection
        self.number = number
        self.role = role
        self.hands = hands
        self.takes_part = takes_part
        self.asks: tuple[set[_Page], int] | None = None

        # Frames that were sent and drawn.
        self.wake = asyncio.Event()
        self.drawn = 0
        self.sent = 0
        self.notified = 0
        self.unseen: deque[int] = deque()

        # Numbers of entries of growing lists that the page has received.
        self.points = 0
        self.energies = 0
        self.events = 0
        self.greeted = False

        self.limits = MessageLimits()
        self.excess = 0


@dataclass(frozen=True, slots=True)
class PageOptions:
    """Command-line options for serving the web page of a session.

    Attributes:
        host: Address to listen on.
        port: Port to listen on. If 0, any free port is used.
        insecure: True to allow an unencrypted address outside this machine.
        opens: True to open a browser if there is one.
        tls: Folder with the keys of a member of the session, used for encryption. If `None`,
            connections are not encrypted.
    """

    host: str = "127.0.0.1"
    port: int = 0
    insecure: bool = False
    opens: bool = True
    tls: Path | None = None

    def make_context(self) -> ssl.SSLContext | None:
        """Returns the TLS context for connections to browsers.

        Returns:
            The context with the certificate and private key from the folder `tls`, or `None` if
            connections are not encrypted.

        Raises:
            UsageError: The keys cannot be used, for example because they have expired.
        """
        if self.tls is None:
            return None
        # Keys that have expired, or that other users can read, are refused.
        read_member_keys(self.tls)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(self.tls / CERTIFICATE, self.tls / PRIVATE_KEY)
        return context

    def check(self) -> None:
        """Raises UsageError if the address is insecure or the server cannot listen on it.

        An address outside this machine must be encrypted, or declared as `insecure`.

        Raises:
            UsageError: The address is in use, or neither encrypted nor declared as insecure.
        """
        is_encrypted = self.make_context() is not None
        is_local = self.host in HERE
        if not (is_encrypted or is_local or self.insecure):
            raise UsageError(
                f"--host {self.host}: anyone who can listen on this network can read the "
                "token of the page and take part; give the keys of a member with --tls, "
                "give --insecure if you trust everybody on this network, or leave out "
                "--host and use an SSH tunnel"
            )

        try:
            family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
            socket.create_server((self.host, self.port), family=family).close()
        except OSError as error:
            raise UsageError(
                f"{self.host}:{self.port}: cannot listen: {error.strerror}"
            ) from None


class PageServer:
    """Serves the page of a session, as a context manager.

    Entering the context starts the server and opens a browser.

    Args:
        bus: Network connection that reaches the session.
        clock: Clock of this process.
        session: Name of the session.
        options: Address, encryption and further options of the server.
        ends: True if experimenters may end the session from their page.
        say: Function that prints a line for the user.
        stage: The steps of an experiment with people, or `None` if there is no experiment.

    Attributes:
        address: Link for an experimenter, including the token.
        end_requested: Set when a page has requested the end of the session.
        files: Files served over HTTP.
        refused: Mapping from reason to number of refused messages and requests.
        view: Current state of the session.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        options: PageOptions = PageOptions(),
        *,
        ends: bool = False,
        say: Callable[[str], None] = lambda _: None,
        stage: "Stage | None" = None,
    ) -> None:
        self._clock = clock
        self._ends = ends
        self._say = say
        self._stage = stage

        # Address of the server, and encryption.
        self._host = options.host
        self._port = options.port
        self._tls = options.make_context()
        self._scheme = "http" if self._tls is None else "https"

        # Connected pages, and the session that they show.
        self._pages: set[_Page] = set()
        self.refused: Counter[str] = Counter()
        self._next_session: tuple[Bus, str] | None = None
        self._switch_session(bus, session)
        self._is_local = options.host in HERE

        # Links for the users, and the opening of the first page in a browser.
        self._opens = options.opens
        self._links = RoleLinks()
        self._links_are_printed = False
        self.files = PageFiles()
        self._shows_ages = stage is None or stage.shows_ages
        self._page_count = 0
        self._frame_number = 0
        self.end_requested = threading.Event()
        self.address = ""
        self._opening = BrowserOpening("")

        # State of the server's thread.
        self._closing: set[asyncio.Task[None]] = set()
        self._ready = threading.Event()
        self._problem: OSError | None = None
        self._ending = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def __enter__(self) -> "PageServer":
        """Starts the server thread, prints the experimenter's link, and opens a browser.

        A browser is opened only if the options allow it, the output is a terminal, and the
        machine has a display.

        Raises:
            UsageError: The server cannot listen on its address.
        """
        self._thread.start()
        self._ready.wait()
        if self._problem is not None:
            raise UsageError(
                f"{self._host}:{self._port}: cannot listen: {self._problem.strerror}"
            )

        self._say(f"experimenter: {self.address}")
        if self._opens and sys.stdout.isatty() and _has_screen():
            self._opening = BrowserOpening(self.address)
            self._opening.open()
        return self

    def __exit__(self, *_: object) -> None:
        """Shuts down the server and closes its pages, waiting at most 5 s for its thread."""
        self._ending.set()
        if self._loop is not None and self._stop is not None:
            # The loop of the server may have ended already.
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(5.0)
        self._opening.remove_file()

    def show(self, bus: Bus, session: str) -> None:
        """Switches to another session.

        Waits until the server thread no longer uses the bus of the previous session, so the
        caller may close it.

        Args:
            bus: Network connection that reaches the session.
            session: Name of the session.
        """
        self._next_session = bus, session
        while self._next_session is not None and self._thread.is_alive():
            self._clock.sleep_until(self._clock.monotonic_ns() + SWITCH_POLL_NS)

    def _switch_session_if_requested(self) -> None:
        """Switches to the session requested by the last call of `show`.

        Only the server thread uses the state of a session. `show` runs in another thread, and
        waits until this method has switched sessions or failed.
        """
        if self._next_session is not None:
            bus, session = self._next_session
            try:
                self._switch_session(bus, session)
            finally:
                self._next_session = None

    def _switch_session(self, bus: Bus, session: str) -> None:
        """Switches to another session, and sends its state to all pages from the beginning.

        For each page, the server keeps track of how many plot points and events it has
        received, so that only new ones are sent. These counts restart at 0 for the new session,
        and each page is sent the constants of the new session ("greeted").

        Args:
            bus: Network connection that reaches the session.
            session: Name of the session.
        """
        self._bus = bus
        self.view = SessionView(bus, self._clock, session)
        self._frames = SessionFrames(self.view)
        # The counts of refused messages continue over all sessions.
        self._desk = OrderDesk(bus, self._clock, session, self.refused)

        # The newest frame, which is a message with the present state of the session. The second
        # attribute holds the newest frames for the users of sites, by the name of the site.
        self._frame: dict[str, Any] | None = None
        self._frames_as_site: dict[str, dict[str, Any]] = {}
        # Latest replies of the sites to orders of the pages.
        self._notices: list[dict[str, Any]] = []

        for page in self._pages:
            page.hands = PageHands(bus, self._clock, session, f"page {page.number}")
            page.points = 0
            page.energies = 0
            page.events = 0
            page.greeted = False

    def _run(self) -> None:
        """Runs the server in its thread until shutdown, restarting it after a failure.

        A failure before the server was ready is stored and raised by `__enter__`, because the
        user must know that there is no page.
        """
        raise_priority(NICE)
        while not self._ending.is_set() and self._problem is None:
            try:
                asyncio.run(self._serve())
            except Exception as error:
                if self._ready.is_set():
                    self._count_failure("server", error)
                    self._ending.wait(RESTART_S)
                elif isinstance(error, OSError):
                    self._problem = error
                else:
                    self._problem = OSError(0, str(error))
            self._ready.set()

    def report_refusals(self) -> None:
        """Prints the number of refused messages and requests, one line per reason."""
        for reason, count in sorted((+self.refused).items()):
            self._say(f"the page refused {count_nouns(count, 'message')} or requests: {reason}")

    def _count_failure(self, part: str, error: Exception) -> None:
        """Counts an error of the server, and prints the first error of each kind.

        The server is not involved in controlling the arms, and continues after any error.

        Args:
            part: Part of the page that failed, for example "frame".
            error: The error.
        """
        reason = f"{part} failed: {type(error).__name__}"
        self.refused[reason] += 1
        if self.refused[reason] == 1:
            # The terminal may have been closed.
            with suppress(OSError, ValueError):
                self._say(f"the page continues, though its {reason}: {error}")

    async def _serve(self) -> None:
        """Accepts connections from browsers and serves pages until the server is shut down.

        Sets `address`, the link with the actual port, before reporting that the server is
        ready.
        """
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        members = {"refused": self.refused, "strangers": Strangers(self.refused)}
        timeouts: dict[str, Any] = {}
        if self._tls is not None:
            timeouts = {"ssl_handshake_timeout": REQUEST_TIMEOUT_S, "ssl_shutdown_timeout": 1.0}
        server = await serve(
            self._serve_page,
            self._host,
            self._port,
            ssl=self._tls,
            process_request=self._answer_http,
            create_connection=type("Counted", (_Visitor,), members),
            max_size=MAX_MESSAGE_BYTES,
            max_queue=32,
            compression=None,
            ping_interval=5,
            # This time is long, because on a busy machine the page is slow but still alive.
            ping_timeout=30,
            open_timeout=REQUEST_TIMEOUT_S,
            close_timeout=1,
            logger=_SILENT,
            **timeouts,
        )
        async with server, asyncio.TaskGroup() as tasks:
            self._pages.clear()
            self._port = server.sockets[0].getsockname()[1]
            self.address = self._links.link(self._base_address, Role())
            self._ready.set()
            ticking = tasks.create_task(self._tick())
            await self._stop.wait()
            ticking.cancel()

    @property
    def _base_address(self) -> str:
        """Address of the page, excluding its token, for example "http://127.0.0.1:8080/"."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"{self._scheme}://{host}:{self._port}/"

    def _print_links(self) -> None:
        """Prints the links with which users and watchers can open their pages.

        Users are people who hold a master arm, or the participants of an experiment. The links
        are printed once, when the scenario, which names the arms, is known.
        """
        scenario = self.view.scenario
        are_users_known = scenario is not None or self._stage is not None
        if self._links_are_printed or not are_users_known:
            return

        self._links_are_printed = True
        if self._stage is not None:
            users = [*self._stage.users]
        else:
            sites = {} if scenario is None else scenario.sites
            users = [
                name for name, site_settings in sites.items() if site_settings.role == "master"
            ]

        roles = [Role("user", site) for site in users]
        for role in (*roles, Role("watcher")):
            name = f"{role.kind} {role.site}".rstrip()
            self._say(f"{name}: {self._links.link(self._base_address, role)}")

    async def _tick(self) -> None:
        """Receives the messages of the session and updates the pages, 30 times per second.

        If one step fails, the failure is counted and the remaining steps are still executed.
        """
        while True:
            started_ns = self._clock.monotonic_ns()
            steps = (
                self._desk.poll,
                self.view.poll,
                self._switch_session_if_requested,
                self._poll_stage,
                self._print_links,
                self._settle_requests,
                self._make_frame,
            )
            for step in steps:
                try:
                    step()
                except Exception as error:
                    self._count_failure(step.__qualname__, error)

            for page in self._pages:
                page.wake.set()
            elapsed_s = (self._clock.monotonic_ns() - started_ns) * 1e-9
            remaining_s = 1.0 / FRAMES_PER_S - elapsed_s
            await asyncio.sleep(max(0.002, remaining_s))

    def _poll_stage(self) -> None:
        """Lets the experiment judge new records of the arms, and writes its marks to the log.

        An example of a mark is "trial 3 begins". Does nothing if there is no experiment.
        """
        if self._stage is None:
            return
        user_pages = [page for page in self._pages if page.role.kind == "user"]
        users = [(page.role.site, page.number) for page in user_pages]
        for moment in self._stage.poll(self.view, users):
            self._desk.mark(next(iter(self.view.sites)), moment)

    def _make_frame(self) -> None:
        """Composes the next frame, from which web pages draw the current state.

        Also collects the sites' replies to requests from pages, and keeps the latest 20.
        """
        self._frame_number += 1
        for site, channel, is_accepted, text in self._desk.replies:
            notice = {
                "n": self._frame_number,
                "site": site,
                "of": channel,
                "ok": is_accepted,
                "text": text,
            }
            self._notices.append(notice)
        self._desk.replies.clear()
        del self._notices[:-20]

        self._frame = self._frames.make_frame() or self._frame
        self._frames_as_site.clear()

    def _answer_http(self, connection: ServerConnection, request: Request) -> Response | None:
        """Returns the response to an HTTP request from a browser.

        Called by the WebSocket library for each request, before it opens a WebSocket.

        Returns:
            A response with a file or an error, or `None` to open a WebSocket.
        """
        try:
            target = urlsplit(request.path)
            problem = self._find_refusal(request, target.query)
        except (ValueError, LookupError):
            # The address is invalid, or the request has two hosts.
            self.refused["malformed request"] += 1
            return connection.respond(HTTPStatus.BAD_REQUEST, "malformed request\n")
        if problem is not None:
            self.refused[problem] += 1
            return connection.respond(HTTPStatus.FORBIDDEN, problem + "\n")

        if target.path == "/socket":
            role = self._links.find(target.query)
            if (
                role is not None
                and role.kind == "watcher"
                and choose_page_to_close(self._pages, role) is not None
            ):
                self.refused["too many watchers"] += 1
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many watchers\n")
            return None

        response = self.files.find(target.path)
        return response or connection.respond(HTTPStatus.NOT_FOUND, "there is no such file\n")

    def _find_refusal(self, request: Request, query: str) -> str | None:
        """Returns the reason why a request must be refused, or `None` if it is accepted.

        For example, requests from pages of other web sites are refused, since they could move
        an arm without its user's knowledge.

        Args:
            request: The request.
            query: Query string of its address, including the token.
        """
        host = request.headers.get("Host", "")
        name = urlsplit(f"//{host}").hostname or ""
        # The name of another web site may resolve to this machine (DNS rebinding).
        if self._is_local and name not in HERE:
            return "foreign host"

        origin = request.headers.get("Origin")
        if origin is not None and origin != f"{self._scheme}://{host}":
            return "foreign origin"
        if urlsplit(request.path).path == "/socket" and self._links.find(query) is None:
            return "no token"
        return None

    async def _serve_page(self, connection: ServerConnection) -> None:
        """Exchanges messages with one page until its connection is closed.

        A user may move the arm of the user's site immediately. An experimenter's page controls
        the session unless another experimenter's page already does.
        """
        assert connection.request is not None
        role = self._links.find(urlsplit(connection.request.path).query)
        assert role is not None, "a request without a role has been refused"
        self._page_count += 1
        hands = PageHands(self._bus, self._clock, self.view.session, f"page {self._page_count}")

        takes_part = role.kind == "user"
        if role.kind == "experimenter":
            takes_part = not any(other.takes_part for other in self.experimenters)
        page = _Page(connection, self._page_count, role, hands, takes_part=takes_part)

        self._close_page_for(role)
        self._pages.add(page)
        if isinstance(connection, _Visitor):
            connection.strangers.remove(connection)
        if role.kind == "experimenter":
            self._opening.remove_file()

        sending = asyncio.create_task(self._send(page))
        try:
            async for text in connection:
                self._receive(page, text)
                # Further messages of the page are not even read.
                if page.excess > MAX_EXCESS:
                    await connection.close(_POLICY_VIOLATION, "too many messages")
                    break
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code in _BROKEN:
                self.refused[_BROKEN[closed.sent.code]] += 1
        finally:
            page.hands.release()
            sending.cancel()
            self._pages.discard(page)

    def _close_page_for(self, role: Role) -> None:
        """Closes an older page of a role if the number of such pages is at its limit.

        Any arms held by the person at that page are released.

        Args:
            role: Role of the new page.
        """
        page = choose_page_to_close(self._pages, role)
        if page is None:
            return

        self._pages.discard(page)
        page.takes_part = False
        page.hands.release()
        self.refused[f"too many pages of {role.kind}s"] += 1
        close = page.connection.close(_POLICY_VIOLATION, "a newer page took its place")
        task = asyncio.get_running_loop().create_task(close)
        # A task without a reference could be removed by the garbage collector.
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    def _receive(self, page: _Page, text: str | bytes) -> None:
        """Decodes and handles a message from a page, unless the page sends too many messages.

        A message that releases an arm is always handled, because continuing to hold the arm
        could be dangerous.
        """
        now_ns = self._clock.monotonic_ns()
        if not page.limits.allows(PageMessage, now_ns):
            page.excess += 1
            self.refused["too many"] += 1
            return

        try:
            message = PageMessage.read(text)
            is_release = isinstance(message, MoveHand) and not message.grip
            if is_release or page.limits.allows(type(message), now_ns):
                self._handle_message(page, message)
            else:
                self.refused[f"too many: {type(message).__struct_config__.tag}"] += 1
        except WireError as error:
            self.refused[error.reason] += 1
        except Exception as error:
            self._count_failure("message", error)

    def _handle_message(self, page: _Page, message: PageMessage) -> None:
        """Carries out the request in a page's message if the page has the right to do so.

        Otherwise, the request is counted as refused, with the reason. Rights depend on the role
        of the person, for example a watcher. Most requests also require that the page takes
        part, that is, may move arms and change settings.

        Args:
            page: The page.
            message: The decoded message.
        """
        if not page.role.may(message):
            self.refused["not of its role"] += 1
        # Requests that are allowed for every page, whether it takes part or not.
        elif isinstance(message, Seen):
            self._note_drawn_frame(page, message.n)
        elif isinstance(message, StopArms):
            self._desk.stop(self.view.sites, page.role.noun)
        elif isinstance(message, TakePart):
            self._request_part(page, message.want)
        elif isinstance(message, AnswerPage):
            self._answer_request(page, message)
        elif not page.takes_part:
            self.refused["does not take part"] += 1
        else:
            self._control_session(page, message)

    def _note_drawn_frame(self, page: _Page, frame_number: int) -> None:
        """Records that a page has drawn a frame and can receive newer ones.

        This prevents flooding a slow browser.

        Args:
            page: The page.
            frame_number: Number of the frame, as reported by the page.
        """
        page.drawn = min(frame_number, page.sent)  # a page may state any number
        while page.unseen and page.unseen[0] <= page.drawn:
            page.unseen.popleft()
        page.wake.set()

    def _control_session(self, page: _Page, message: PageMessage) -> None:
        """Carries out a page's request to move an arm or change the session.

        For example, an experimenter may change the delay of a link, or a user may move an arm
        with the mouse.

        Args:
            page: The page, which has the right to control the session.
            message: The decoded message, which is permitted for the role of the page's user.
        """
        view = self.view

        if isinstance(message, SiteOrder):
            # Marks are accepted before all sites run.
            first_site = "" if view.scenario is None else view.scenario.names[0]
            self._desk.accept(message, view.sites, view.links, first_site, page.role.noun)
        elif isinstance(message, ShowAges):
            self._shows_ages = message.shown
        elif isinstance(message, MoveHand):
            site = view.sites.get(message.site)
            if site is None or site.hand is None:
                self.refused["nobody can hold it"] += 1
            else:
                page.hands.move(message, pushes=site.hand.mode == "force")
        elif isinstance(message, StageMessage):
            site_name = page.role.site
            stage = self._stage
            if stage is None or not stage.accept(site_name, page.number, message):
                self.refused["was not asked"] += 1
        elif isinstance(message, EndSession) and self._ends:
            self.end_requested.set()

    def _request_part(self, page: _Page, want: bool) -> None:
        """Handles a page's request to obtain or give up the right to control the session.

        If other pages hold an arm, the right is granted only if they agree.

        Args:
            page: The page.
            want: True to request the right, False to give it up.
        """
        if not want:
            page.takes_part = False
            page.asks = None
            page.hands.release()
        elif not page.takes_part and page.asks is None:
            others = self.experimenters - {page}
            holders = {other for other in others if self._list_held_sites(other)}
            if holders:
                page.asks = (holders, self._clock.monotonic_ns())
            else:
                page.takes_part = True

    @property
    def experimenters(self) -> set[_Page]:
        """Open web pages of experimenters.

        A page controls the session only if its attribute `takes_part` is True.
        """
        return {page for page in set(self._pages) if page.role.kind == "experimenter"}

    def _answer_request(self, page: _Page, answer: AnswerPage) -> None:
        """Applies a page's answer to another page's request to control the session.

        An answer to a request that does not exist or was sent to other pages is counted as
        refused.

        Args:
            page: The page that answers.
            answer: Whether the other page may take part.
        """
        for other in self._pages:
            if other.number != answer.page or other.asks is None:
                continue
            asked_pages, _ = other.asks
            if page in asked_pages:
                other.takes_part = answer.yes
                other.asks = None
                return
        self.refused["was not asked"] += 1

    def _settle_requests(self) -> None:
        """Decides on requests for control of a session that were not answered in time.

        A page obtains control if the pages that were asked have been closed, or if the time is
        up and they no longer hold an arm.
        """
        now_ns = self._clock.monotonic_ns()
        for page in self._pages:
            if page.asks is None:
                continue
            asked_pages, asked_ns = page.asks
            remaining_pages = asked_pages & self._pages
            is_too_late = now_ns - asked_ns > ANSWER_TIMEOUT_NS
            if not remaining_pages or is_too_late:
                is_arm_held = any(map(self._list_held_sites, remaining_pages))
                page.takes_part = not is_arm_held
                page.asks = None

    def _list_held_sites(self, page: _Page) -> list[str]:
        """Lists the sites whose arms are held by the person at a page.

        The holder of an arm is known only from the records of its site. Empty before the first
        record.
        """
        sites = (self._frame or {}).get("sites", {})
        held_sites: list[str] = []
        for name, site in sites.items():
            if page.hands.holds(name, site.get("source", 0)):
                held_sites.append(name)
        return held_sites

    async def _send(self, page: _Page) -> None:
        """Coroutine that sends a page the newest frame each time it has drawn an earlier one.

        The first message is a greeting with the constants of the session. A page for a site
        that is not in the session is closed. The coroutine ends with the connection.
        """
        encode: Callable[[Any], bytes] = msgspec.json.encode
        with suppress(ConnectionClosed):
            while True:
                await page.wake.wait()
                page.wake.clear()
                has_begun = self._frame is not None
                if not self._is_frame_due(page, has_begun=has_begun):
                    continue
                scenario = self.view.scenario
                if scenario is not None and page.role.site not in ("", *scenario.names):
                    return await page.connection.close(
                        _POLICY_VIOLATION, "the session has no such site"
                    )

                page.notified = page.sent
                page.sent = self._frame_number
                page.unseen.append(page.sent)
                try:
                    if page.greeted and has_begun:
                        message = self._describe_frame(page)
                    else:
                        message = self._describe_greeting(page)
                    payload = encode(message)
                except Exception as error:
                    self._count_failure("frame", error)
                    continue

                page.greeted = has_begun
                await page.connection.send(payload, text=True)

    def _is_frame_due(self, page: _Page, *, has_begun: bool) -> bool:
        """Returns True if the page should now receive the newest frame.

        A page that has not drawn the previous frame yet is not sent another, so that messages
        do not pile up.

        Args:
            page: The page.
            has_begun: False before the session has a frame. Pages then receive messages at a
                low rate.
        """
        is_page_behind = len(page.unseen) >= FRAMES_AHEAD
        has_newest_frame = page.sent == self._frame_number
        if is_page_behind or has_newest_frame:
            return False

        if has_begun or not page.sent:
            return True
        return self._frame_number - page.sent >= WAITING_FRAME_STEP

    def _describe_greeting(self, page: _Page) -> dict[str, Any]:
        """Returns the first message to a page, which contains the constants of the session.

        The message has the single key "hello". Its value contains the constants, the role of
        the page's user ("role"), the site whose view the page shows ("as", empty for the view
        of all sites), the number of the current frame ("n"), whether the page may end the
        session ("ends"), and the step of the experiment if there is one.
        """
        role = page.role
        frames = self._frames
        # The user of a site must not see constants that reveal the condition of an experiment.
        is_view_of_one_site = bool(role.site)
        if is_view_of_one_site:
            constants = frames.describe_session_as_user()
        else:
            constants = frames.describe()
        may_end_session = self._ends and role.kind == "experimenter"
        fields = {
            **constants,
            "role": role.kind,
            "as": role.site,
            "n": self._frame_number,
            "ends": may_end_session,
            **self._describe_stage(page),
        }
        return {"hello": fields}

    def _describe_stage(self, page: _Page, t_s: float | None = None) -> dict[str, Any]:
        """Describes the current step of an experiment, if there is one, for a page.

        Args:
            page: The page.
            t_s: Time of the pose shown on the page, in s, or `None` if the page shows no arms.
        """
        if self._stage is None:
            return {}
        role = page.role
        return {"stage": self._stage.describe(role.kind, role.site, page.number, t_s)}

    def _describe_frame(self, page: _Page) -> dict[str, Any]:
        """Returns the newest frame for a page: the state of the session and of the page itself.

        The content depends on the role of the page's user.

        Args:
            page: The page.

        Returns:
            The frame as JSON-compatible values: the time, the arms and links as seen by the
            page's user, the fields that are explained below, and the step of the experiment if
            there is one.
        """
        site = page.role.site
        # The user of a site sees the other arms delayed. Other roles see all arms at present.
        state = self._describe_as_site(site) if site else self._describe_all(page)
        # The default role is that of an experimenter who sees all sites.
        is_full_experimenter = page.role == Role()
        return {
            # Number of the frame, which the page sends back once it has drawn the frame.
            "n": self._frame_number,
            **state,
            # Files of the ended session that can be loaded, and new replies of sites to orders.
            "results": list(self.files.results) if is_full_experimenter else [],
            "notices": self._list_notices(page),
            # Whether the page shows the ages of the other arms' poses.
            "ages": self._shows_ages,
            # Number of open pages.
            "pages": len(self._pages),
            # Whether this page may give orders, whether it waits for the permission of other
            # pages to do so, and the numbers of the pages that wait for its own permission.
            "takes_part": page.takes_part,
            "asks": page.asks is not None,
            "asked": self._list_requests(page),
            # Names of the sites whose arms this page holds.
            "holds": self._list_held_sites(page),
            # Number of refused messages and requests of all pages.
            "refused": sum(self.refused.values()),
            # "t" is the time of the arms in the frame, in s.
            **self._describe_stage(page, state["t"]),
        }

    def _list_requests(self, page: _Page) -> list[int]:
        """Returns the numbers of the pages that wait for this page's permission."""
        numbers: list[int] = []
        for other in self._pages:
            if other.asks is not None:
                asked_pages, _ = other.asks
                if page in asked_pages:
                    numbers.append(other.number)
        return numbers

    def _list_notices(self, page: _Page) -> list[dict[str, Any]]:
        """Returns the sites' replies that a page has not received yet.

        The replies contain keys and commands, which only an experimenter can use. Pages of
        other roles are only told which sites refused to stop.
        """
        notices = [notice for notice in self._notices if notice["n"] > page.notified]
        if page.role.kind == "experimenter":
            return notices

        refused_stops: list[dict[str, Any]] = []
        for notice in notices:
            is_refused_stop = notice["of"] == topics.STOP and not notice["ok"]
            if is_refused_stop:
                text = f"{notice['site']} was not stopped"
                refused_stops.append({**notice, "text": text})
        return refused_stops

    def _describe_as_site(self, site: str) -> dict[str, Any]:
        """Returns the frame for the user of one arm, in which the other arms appear delayed.

        The frame has no plots or events, which would reveal the current state. All pages of the
        arm receive the same frame.

        Args:
            site: Name of the site of the arm.
        """
        if site not in self._frames_as_site:
            assert self._frame is not None
            self._frames_as_site[site] = self._frames.describe_as(
                self._frame, site, ages=self._shows_ages
            )
        hidden_fields: dict[str, Any] = {"points": [], "energies": [], "events": []}
        return {**self._frames_as_site[site], **hidden_fields}

    def _describe_all(self, page: _Page) -> dict[str, Any]:
        """Returns the frame for a page that sees everything, with new points and events.

        Updates how many points and events the page has received. The first message contains all
        stored points and events.

        Args:
            page: The page of an experimenter or watcher.
        """
        frames = self._frames
        view = self.view
        is_first = page.points == 0 and page.energies == 0
        # Greater than the number of stored points.
        limit = 100_000 if is_first else POINTS_PER_FRAME
        points = frames.points.since(page.points, limit)
        energies = frames.energies.since(page.energies, limit)
        events = frames.list_events(page.events, 100)

        page.points = frames.points.count
        page.energies = frames.energies.count
        page.events = view.events.count
        return {**(self._frame or {}), "points": points, "energies": energies, "events": events}


def _has_screen() -> bool:
    """Returns True if this machine can display a browser.

    On Linux, this is determined from the variables DISPLAY and WAYLAND_DISPLAY.
    """
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class PageAttendant(ExitStack):
    """Serves the page of a session run by this process, as for `trilat live`.

    Used as a context manager. The page stays open after the session to show the report.

    Args:
        options: Address, encryption and further options of the server.
        clock: Clock of this process.
    """

    def __init__(self, options: PageOptions, clock: Clock) -> None:
        super().__init__()
        self._options = options
        self._clock = clock
        self._page: PageServer | None = None

    @contextmanager
    def attend(
        self, session: str, endpoints: Sequence[str], say: Callable[[str], None]
    ) -> Iterator[Callable[[], bool]]:
        """Context manager that serves the web page of a session while it runs.

        This method can be passed as the `SessionAttendant` (the function that watches a session
        and may end it) of functions such as `run_demo`.

        Args:
            session: Name of the session.
            endpoints: Network addresses at which the session can be reached.
            say: Function that prints a line for the user.

        Yields:
            A function that returns True once a page has requested the end of the session.
        """
        bus = self.enter_context(closing(Connection(connect=endpoints).open()))
        page = PageServer(bus, self._clock, session, self._options, ends=True, say=say)
        self._page = self.enter_context(page)
        yield self._page.end_requested.is_set
        self._page.report_refusals()

    def offer_results(self, paths: Iterable[Path]) -> None:
        """Offers files of the ended session to experimenters while their pages are open.

        Stops on Ctrl-C. The address of a file cannot be guessed, and is sent only to these
        pages.

        Args:
            paths: Paths of the files, such as the report and the log.
        """
        page = self._page
        clock = self._clock
        assert page is not None, "`attend` has been called"
        # The processes of the session have ended.
        page.view.finish()
        page.files.add_results(paths)
        offer_ends_ns = clock.monotonic_ns() + RESULTS_TIMEOUT_NS
        with suppress(KeyboardInterrupt):
            poll_period_ns = RESULTS_TIMEOUT_NS // 3000
            while page.experimenters and clock.monotonic_ns() < offer_ends_ns:
                clock.sleep_until(clock.monotonic_ns() + poll_period_ns)


@contextmanager
def show_on_page(
    options: PageOptions, clock: Clock, session: str, say: Callable[[str], None], bus: Bus
) -> Iterator[tuple[SessionView, Callable[[], None]]]:
    """Context manager that serves a web page for a session run by other processes.

    Used by `trilat live --session` as the argument `show` of `watch_session`.

    Args:
        options: Address, encryption and further options of the server.
        clock: Clock of this process.
        session: Name of the session.
        say: Function that prints a line for the user.
        bus: Network connection that reaches the session.

    Yields:
        The state of the session, and a function to update the display. The function does
        nothing, since the server updates the page itself.
    """
    with PageServer(bus, clock, session, options, say=say) as page:
        yield page.view, lambda: None
        page.report_refusals()
