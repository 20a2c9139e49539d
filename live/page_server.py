"""The page's server: its socket, and its files by HTTP, from one `websockets` server in a
thread of its own.

It is an onlooker of a session that is started for it, or of one that runs already: the session
neither waits for it nor needs it, and runs on if it fails. In an experiment it shows one
session after the other, with a stage around them. A browser is opened only where there is one.

Invariant: newest state wins. A page gets its next frame when it has drawn one of those before,
so that a slow page sees fewer frames and nobody waits for it. A page of another origin, without
a token, with messages that are too many, too large or not of its role is refused and counted;
nothing of it reaches a site. Places are kept by role (`page_entrance`). One thread serves all
pages and takes in the session's messages.
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
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.member_keys import CERTIFICATE, HERE, PRIVATE_KEY, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.process import raise_priority

from .page_entrance import Strangers, choose_to_leave, is_full
from .page_files import PageFiles
from .page_opening import BrowserOpening
from .page_orders import (
    MAX_MESSAGE_BYTES,
    AnswerPage,
    EndSession,
    MarkMoment,
    MessageLimits,
    MoveHand,
    OrderDesk,
    PageHands,
    PageMessage,
    ReleaseArms,
    Role,
    RoleLinks,
    Seen,
    SetLink,
    SetShares,
    ShowAges,
    StageMessage,
    StopArms,
    TakePart,
    read_page_message,
)
from .session_frames import SessionFrames, show_event
from .session_view import SessionView

if TYPE_CHECKING:  # an experiment's libraries are for experiments alone
    from .experiment_stage import Stage

NICE = -5
"""Priority of the page's threads and of those that bring its messages: above normal, below the
sites' own.
"""
FRAMES_PER_S = 30
FRAMES_AHEAD = 2
"""Frames that a page may have got and not drawn yet: one is on its way while it draws the
other.
"""
MOST_EXCESS = 1_000
"""A page that sends so many more messages than it may is closed."""
OPENING_S = 3.0
"""Time for a connection to say what it wants: for the encryption, and again for its request, s.
"""
ANSWER_NS = 10_000_000_000
"""A page that holds an arm may say for so long whether another one takes part."""
RESTART_S = 1.0
TURN_NS = 10_000_000
WAITING_FRAMES = 10
"""Frames between two looks at who is there, before a session begins."""
POINTS_PER_FRAME = 240
"""Points of the plots that one frame brings at most; a page that was away longer has a gap."""
_POLICY_VIOLATION = 1008
_BROKEN = {1002: "broken frames", 1007: "no text", 1009: "too large"}
"""Codes with which a socket is closed, RFC 6455."""
_SILENT = logging.getLogger("trilat.page")
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False
"""For the library of sockets: what strangers send is counted, and prints no tracebacks."""

OFFERED_NS = 600_000_000_000
"""So long an open page has report and log at most."""
LONGEST_S = 3600.0
"""A session with a page runs for so long at most, unless told otherwise, s."""

_NO_HTTP = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"


class Visitor(ServerConnection):
    """One connection: what is no request of a page is counted, and answered with 400 if it is
    not HTTP.
    """

    refused: Counter[str]
    strangers: Strangers
    _heard = _counted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begins the connection."""
        super().connection_made(transport)
        self.strangers.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends the connection."""
        self.strangers.remove(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Takes in what has come."""
        self._heard = True  # browsers open connections ahead, and close some of them unused
        super().data_received(data)

    def send_data(self) -> None:
        """Sends what is to be sent."""
        problem = self.protocol.handshake_exc
        if problem is not None and self._heard and not self._counted:
            self._counted = True
            self.refused["malformed request"] += 1
            if self.request is None and isinstance(problem, InvalidMessage):
                self.transport.write(_NO_HTTP)
        super().send_data()


class Page:
    """One connected page.

    Attributes:
        role: what it may do, and as which site it is shown the arms.
        asks: the pages that it has asked whether it may take part, and when, ns.
        wake: set when there is a frame that it has not got.
        excess: how many messages it has sent that were too many.
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
        self.asks: tuple[set[Page], int] | None = None
        self.wake = asyncio.Event()
        self.drawn = self.sent = self.notified = 0
        self.unseen: deque[int] = deque()
        self.points = self.energies = self.events = 0
        self.greeted = False
        self.limits = MessageLimits()
        self.excess = 0


@dataclass(frozen=True, slots=True)
class PageOptions:
    """How a page is served.

    Attributes:
        port: 0: any.
        insecure: true: another address than this machine's is allowed, though nothing is
            encrypted.
        opens: true: a browser is opened where there is one.
        tls: the folder of a member's keys, by which page and socket are encrypted; None: they
            are not.
    """

    host: str = "127.0.0.1"
    port: int = 0
    insecure: bool = False
    opens: bool = True
    tls: Path | None = None

    def make_context(self) -> ssl.SSLContext | None:
        """Returns the keys by which the page is encrypted, or None.

        Raises:
            UsageError: they cannot be used.
        """
        if self.tls is None:
            return None
        read_member_keys(self.tls)  # refuses those that have ended, or that others can read
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(self.tls / CERTIFICATE, self.tls / PRIVATE_KEY)
        return context

    def check(self) -> None:
        """Refuses an address that is taken, and to serve others without being told that it is
        not safe.

        Raises:
            UsageError: with the reason.
        """
        if self.make_context() is None and self.host not in HERE and not self.insecure:
            raise UsageError(
                f"--host {self.host}: whoever reads the network reads the page's token and could take part; "
                "give the keys of a member with --tls, say --insecure if that network is yours, or leave out "
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
    """Serves one session's page; a context, at whose beginning a browser is opened at it.

    Args:
        options: how it is served.
        ends: true if pages may end the session.
        say: tells the people at the terminal what went wrong.
        stage: what is asked of people between sessions and in them, in an experiment.

    Attributes:
        address: where a browser finds the page of an experimenter, token included.
        end_requested: set once a page has asked for the end.
        files: what it sends by HTTP.
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
        self._host = options.host
        self._port = options.port
        self._tls = options.make_context()
        self._scheme = "http" if self._tls is None else "https"
        self._pages: set[Page] = set()
        self.refused: Counter[str] = Counter()
        self._next: tuple[Bus, str] | None = None
        self._turn_to(bus, session)
        self._is_local = options.host in HERE
        self._opens = options.opens
        self._links = RoleLinks()
        self._told = False
        self.files = PageFiles()
        self._ages = stage is None or stage.shows_ages
        self._met = self._n = 0
        self.end_requested = threading.Event()
        self.address = ""
        self._opening = BrowserOpening("")
        self._closing: set[asyncio.Task[None]] = set()
        self._ready = threading.Event()
        self._problem: OSError | None = None
        self._ending = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    def __enter__(self) -> "PageServer":
        self._thread.start()
        self._ready.wait()
        if self._problem is not None:
            raise UsageError(
                f"{self._host}:{self._port}: cannot listen: {self._problem.strerror}"
            )
        self._say(f"experimenter: {self.address}")
        screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if (
            self._opens
            and sys.stdout.isatty()
            and (screen or not sys.platform.startswith("linux"))
        ):
            self._opening = BrowserOpening(self.address)
            self._opening.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        if self._loop is not None and self._stop is not None:
            with suppress(RuntimeError):  # its loop has ended already
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(5.0)
        self._opening.forget()

    def show(self, bus: Bus, session: str) -> None:
        """Shows another session from now on; the bus of the one before is no longer used on
        return.
        """
        self._next = bus, session
        while self._next is not None and self._thread.is_alive():
            self._clock.sleep_until(self._clock.monotonic_ns() + TURN_NS)

    def _turn_over(self) -> None:
        if self._next is not None:
            try:
                self._turn_to(*self._next)
            finally:
                self._next = None

    def _turn_to(self, bus: Bus, session: str) -> None:
        self._bus = bus
        self.view = SessionView(bus, self._clock, session)
        self._frames = SessionFrames(self.view)
        self._desk = OrderDesk(bus, self._clock, session, self.refused)
        self._frame: dict[str, Any] | None = None
        self._known: dict[str, dict[str, Any]] = {}
        self._notices: list[dict[str, Any]] = []
        for page in self._pages:
            page.hands = PageHands(bus, self._clock, session, f"page {page.number}")
            page.points = page.energies = page.events = 0
            page.greeted = False

    def _run(self) -> None:
        """Serves pages until the end, and again after whatever ended it."""
        raise_priority(NICE)
        while not self._ending.is_set() and self._problem is None:
            try:
                asyncio.run(self._serve())
            except Exception as error:
                if not self._ready.is_set():
                    self._problem = (
                        error if isinstance(error, OSError) else OSError(0, str(error))
                    )
                else:
                    self._count_failure("server", error)
                    self._ending.wait(RESTART_S)
            self._ready.set()

    def tell_refused(self) -> None:
        """Tells the people at the terminal what was refused."""
        for reason, count in sorted((+self.refused).items()):
            self._say(f"the page refused {count_nouns(count, 'message')} or requests: {reason}")

    def _count_failure(self, of: str, error: Exception) -> None:
        """Counts a failure, and says it the first time: no failure of the page is one of the
        session.
        """
        reason = f"{of} failed: {type(error).__name__}"
        self.refused[reason] += 1
        with suppress(OSError, ValueError):  # no terminal any more
            if self.refused[reason] == 1:
                self._say(f"the page goes on, though its {reason}: {error}")

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._stop = asyncio.Event()
        counted = {"refused": self.refused, "strangers": Strangers(self.refused)}
        timeouts: dict[str, Any] = {}
        if self._tls is not None:
            timeouts = {"ssl_handshake_timeout": OPENING_S, "ssl_shutdown_timeout": 1.0}
        server = await serve(
            *(self._attend, self._host, self._port),
            ssl=self._tls,
            process_request=self._answer,
            create_connection=type("Counted", (Visitor,), counted),
            max_size=MAX_MESSAGE_BYTES,
            max_queue=32,
            compression=None,
            ping_interval=5,
            ping_timeout=30,  # a busy machine is no dead page
            open_timeout=OPENING_S,
            close_timeout=1,
            logger=_SILENT,
            **timeouts,
        )
        async with server, asyncio.TaskGroup() as tasks:
            self._pages.clear()
            self._port = server.sockets[0].getsockname()[1]
            self.address = self._links.link(self._base, Role())
            self._ready.set()
            ticking = tasks.create_task(self._tick())
            await self._stop.wait()
            ticking.cancel()

    @property
    def _base(self) -> str:
        return f"{self._scheme}://{f'[{self._host}]' if ':' in self._host else self._host}:{self._port}/"

    def _tell_links(self) -> None:
        """Tells the links of the other roles at the terminal, once the scenario is known."""
        scenario = self.view.scenario
        if self._told or (scenario is None and self._stage is None):
            return
        self._told = True
        sites = {} if scenario is None else scenario.sites
        users = [name for name, spec in sites.items() if spec.role == "master"]
        users = users if self._stage is None else [*self._stage.users]
        for role in (*(Role("user", site) for site in users), Role("watcher")):
            self._say(
                f"{role.kind} {role.site}".rstrip() + f": {self._links.link(self._base, role)}"
            )

    async def _tick(self) -> None:
        """Takes in the session's messages and makes a frame, thirty times a second; failures
        end a turn.
        """
        while True:
            begun_ns = self._clock.monotonic_ns()
            polls = self._desk.poll, self.view.poll, self._turn_over, self._poll_stage
            for step in (*polls, self._tell_links, self._settle_asked, self._make_frame):
                try:
                    step()
                except Exception as error:
                    self._count_failure(step.__qualname__, error)
            for page in self._pages:
                page.wake.set()
            spent_s = (self._clock.monotonic_ns() - begun_ns) * 1e-9
            await asyncio.sleep(max(0.002, 1.0 / FRAMES_PER_S - spent_s))

    def _poll_stage(self) -> None:
        if self._stage is not None:
            users = [
                (page.role.site, page.number)
                for page in self._pages
                if page.role.kind == "user"
            ]
            for moment in self._stage.poll(self.view, users):
                self._desk.mark(next(iter(self.view.sites)), moment)

    def _make_frame(self) -> None:
        self._n += 1
        for site, channel, accepted, text in self._desk.replies:
            notice = {"n": self._n, "site": site, "of": channel, "ok": accepted, "text": text}
            self._notices.append(notice)
        self._desk.replies.clear()
        del self._notices[:-20]
        self._frame = self._frames.make() or self._frame
        self._known.clear()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers a request for a file; None lets a socket open."""
        try:
            target = urlsplit(request.path)
            problem = self._problem_of(request, target.query)
        except (ValueError, LookupError):  # no address; two hosts
            self.refused["malformed request"] += 1
            return connection.respond(HTTPStatus.BAD_REQUEST, "malformed request\n")
        if problem is not None:
            self.refused[problem] += 1
            return connection.respond(HTTPStatus.FORBIDDEN, problem + "\n")
        if target.path == "/socket":
            role = self._links.find(target.query)
            if role is not None and role.kind == "watcher" and is_full(self._pages, role):
                self.refused["too many watchers"] += 1
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many watchers\n")
            return None
        found = self.files.find(target.path)
        return found or connection.respond(HTTPStatus.NOT_FOUND, "there is no such file\n")

    def _problem_of(self, request: Request, query: str) -> str | None:
        host = request.headers.get("Host", "")
        name = urlsplit(f"//{host}").hostname or ""
        if self._is_local and name not in HERE:
            return "foreign host"  # a name of somebody else's that leads here
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"{self._scheme}://{host}":
            return "foreign origin"
        if urlsplit(request.path).path == "/socket" and self._links.find(query) is None:
            return "no token"
        return None

    async def _attend(self, connection: ServerConnection) -> None:
        """Serves one page until it goes."""
        assert connection.request is not None
        role = self._links.find(urlsplit(connection.request.path).query)
        assert role is not None  # or it would have been refused
        self._met += 1
        hands = PageHands(self._bus, self._clock, self.view.session, f"page {self._met}")
        alone = role.kind == "experimenter" and not any(
            one.takes_part for one in self.experimenters
        )
        page = Page(connection, self._met, role, hands, takes_part=alone or role.kind == "user")
        self._make_room(role)
        self._pages.add(page)
        if isinstance(connection, Visitor):
            connection.strangers.remove(connection)
        if role.kind == "experimenter":
            self._opening.forget()
        sending = asyncio.create_task(self._send(page))
        try:
            async for text in connection:
                self._take(page, text)
                if page.excess > MOST_EXCESS:  # what else it has sent is not even read
                    await connection.close(_POLICY_VIOLATION, "too many messages")
                    break
        except ConnectionClosed as closed:
            if closed.sent is not None and closed.sent.code in _BROKEN:
                self.refused[_BROKEN[closed.sent.code]] += 1
        finally:
            page.hands.release()
            sending.cancel()
            self._pages.discard(page)

    def _make_room(self, role: Role) -> None:
        """Closes the page that gives way to a new page of a role, if all places of that role
        are taken.
        """
        page = choose_to_leave(self._pages, role)
        if page is None:
            return
        self._pages.discard(page)
        page.takes_part = False
        page.hands.release()
        self.refused[f"too many pages of {role.kind}s"] += 1
        close = page.connection.close(_POLICY_VIOLATION, "a newer page took its place")
        task = asyncio.get_running_loop().create_task(close)
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    def _take(self, page: Page, text: str | bytes) -> None:
        """Takes a message of a page, unless it sends more than it may; its failure is its own."""
        now_ns = self._clock.monotonic_ns()
        if not page.limits.allows(PageMessage, now_ns):
            page.excess += 1
            self.refused["too many"] += 1
            return
        try:
            message = read_page_message(text)
            lets_go = isinstance(message, MoveHand) and not message.grip
            if lets_go or page.limits.allows(type(message), now_ns):
                self._obey(page, message)
            else:
                self.refused[f"too many: {type(message).__struct_config__.tag}"] += 1
        except WireError as error:
            self.refused[error.reason] += 1
        except Exception as error:
            self._count_failure("message", error)

    def _obey(self, page: Page, message: PageMessage) -> None:
        view = self.view
        if not page.role.may(message):
            self.refused["not of its role"] += 1
        elif isinstance(message, Seen):
            page.drawn = min(message.n, page.sent)
            while page.unseen and page.unseen[0] <= page.drawn:
                page.unseen.popleft()
            page.wake.set()
        elif isinstance(message, StopArms):  # of whoever sees the page
            self._desk.stop(view.sites, page.role.noun)
        elif isinstance(message, TakePart):
            self._ask_to_take_part(page, message.want)
        elif isinstance(message, AnswerPage):
            self._let_take_part(page, message)
        elif not page.takes_part:
            self.refused["does not take part"] += 1
        elif isinstance(message, SetLink | SetShares):
            self._desk.order(message, view.sites, view.links, page.role.noun)
        elif isinstance(message, ReleaseArms):
            self._desk.release(message, view.sites, page.role.noun)
        elif isinstance(message, MarkMoment):
            if view.scenario is not None:
                self._desk.mark(view.scenario.names[0], message.text)
        elif isinstance(message, ShowAges):
            self._ages = message.shown
        elif isinstance(message, MoveHand):
            site = view.sites.get(message.site)
            if site is None or site.hand is None:
                self.refused["nobody can hold it"] += 1
            else:
                page.hands.move(message, pushes=site.hand.mode == "force")
        elif isinstance(message, StageMessage):
            asked = self._stage is not None and self._stage.take(
                page.role.site, page.number, message
            )
            self.refused["was not asked"] += not asked
        elif isinstance(message, EndSession) and self._ends:
            self.end_requested.set()

    def _ask_to_take_part(self, page: Page, want: bool) -> None:
        """Lets a page take part, or no longer; while others hold an arm they are asked first."""
        if not want:
            page.takes_part = False
            page.asks = None
            page.hands.release()
        elif not page.takes_part and page.asks is None:
            holders = {other for other in self.experimenters - {page} if self._list_held(other)}
            page.asks = (holders, self._clock.monotonic_ns()) if holders else None
            page.takes_part = not holders

    @property
    def experimenters(self) -> set[Page]:
        """The pages of experimenters that are open."""
        return {page for page in set(self._pages) if page.role.kind == "experimenter"}

    def _let_take_part(self, page: Page, answer: AnswerPage) -> None:
        for other in self._pages:
            if other.number == answer.page and other.asks is not None and page in other.asks[0]:
                other.takes_part = answer.yes
                other.asks = None
                return
        self.refused["was not asked"] += 1

    def _settle_asked(self) -> None:
        """Lets pages take part that nobody has answered, if whom they asked has gone or holds
        no arm.
        """
        now_ns = self._clock.monotonic_ns()
        for page in self._pages:
            here = page.asks[0] & self._pages if page.asks is not None else set()
            if page.asks is not None and (not here or now_ns - page.asks[1] > ANSWER_NS):
                page.takes_part = not any(map(self._list_held, here))
                page.asks = None

    def _list_held(self, page: Page) -> list[str]:
        sites = (self._frame or {}).get("sites", {})
        return [
            name
            for name, site in sites.items()
            if page.hands.holds(name, site.get("source", 0))
        ]

    async def _send(self, page: Page) -> None:
        """Sends a page what is newest, again and again, each time it has drawn what it got."""
        encode: Callable[[Any], bytes] = msgspec.json.encode
        with suppress(ConnectionClosed):
            while True:
                await page.wake.wait()
                page.wake.clear()
                if len(page.unseen) >= FRAMES_AHEAD or page.sent == self._n:
                    continue
                begins = self._frame is not None
                if not begins and page.sent and self._n - page.sent < WAITING_FRAMES:
                    continue
                scenario = self.view.scenario
                if scenario is not None and page.role.site not in ("", *scenario.names):
                    return await page.connection.close(
                        _POLICY_VIOLATION, "the session has no such site"
                    )
                page.notified = page.sent
                page.sent = self._n
                page.unseen.append(page.sent)
                try:
                    payload = encode(
                        self._frame_for(page) if page.greeted and begins else self._greet(page)
                    )
                except Exception as error:
                    self._count_failure("frame", error)
                    continue
                page.greeted = begins
                await page.connection.send(payload, text=True)

    def _greet(self, page: Page) -> dict[str, Any]:
        role = page.role
        about = self._frames.describe_narrowed() if role.site else self._frames.describe()
        ends = self._ends and role.kind == "experimenter"
        shown = {
            "role": role.kind,
            "as": role.site,
            "n": self._n,
            "ends": ends,
            **self._describe_stage(page),
        }
        return {"hello": {**about, **shown}}

    def _describe_stage(self, page: Page, t_s: float | None = None) -> dict[str, Any]:
        if self._stage is None:
            return {}
        return {"stage": self._stage.describe(page.role.kind, page.role.site, page.number, t_s)}

    def _frame_for(self, page: Page) -> dict[str, Any]:
        notices = [one for one in self._notices if one["n"] > page.notified]
        if page.role.kind != "experimenter":
            # The answers of sites name keys and commands, which only an experimenter can use.
            stops = [
                notice for notice in notices if notice["of"] == topics.STOP and not notice["ok"]
            ]
            notices = [
                {**notice, "text": f"{notice['site']} was not stopped"} for notice in stops
            ]
        shown = self._show_as(page.role.site) if page.role.site else self._show_all(page)
        return {
            "n": self._n,
            **shown,
            "results": list(self.files.results) if page.role == Role() else [],
            "notices": notices,
            "ages": self._ages,
            "pages": len(self._pages),
            "takes_part": page.takes_part,
            "asks": page.asks is not None,
            "asked": [
                one.number
                for one in self._pages
                if one.asks is not None and page in one.asks[0]
            ],
            "holds": self._list_held(page),
            "refused": sum(self.refused.values()),
            **self._describe_stage(page, shown["t"]),
        }

    def _show_as(self, site: str) -> dict[str, Any]:
        """Returns what a site knows at this frame."""
        if site not in self._known:
            assert self._frame is not None
            self._known[site] = self._frames.narrow(self._frame, site, ages=self._ages)
        return {**self._known[site], "points": [], "energies": [], "events": []}

    def _show_all(self, page: Page) -> dict[str, Any]:
        """Returns what is, and what has been added to plots and events since the page's last
        frame.
        """
        frames = self._frames
        view = self.view
        first = page.points == 0 and page.energies == 0
        most = 100_000 if first else POINTS_PER_FRAME
        points = frames.points.since(page.points, most)
        energies = frames.energies.since(page.energies, most)
        events = [show_event(event) for event in view.events.since(page.events, 100)]
        page.points = frames.points.count
        page.energies = frames.energies.count
        page.events = view.events.count
        return {**(self._frame or {}), "points": points, "energies": energies, "events": events}


class PageAttendant(ExitStack):
    """The page of a session that is run here; a context, as the page outlives the session for
    its report.
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
        """The `SessionAttendant` that serves the page, until that asks for the end of the
        session.
        """
        bus = self.enter_context(closing(ZenohBus([], endpoints)))
        page = PageServer(bus, self._clock, session, self._options, ends=True, say=say)
        self._page = self.enter_context(page)
        yield self._page.end_requested.is_set
        self._page.tell_refused()

    def offer(self, paths: Iterable[Path]) -> None:
        """Offers files of the ended session to experimenters while their page is open, or until
        Ctrl-C.

        The address of a file cannot be guessed, and only these pages are told.
        """
        page = self._page
        clock = self._clock
        assert page is not None  # a session was attended
        page.view.finish()  # its processes are gone, whatever they could still say
        page.files.offer(paths)
        give_up_ns = clock.monotonic_ns() + OFFERED_NS
        with suppress(KeyboardInterrupt):
            while page.experimenters and clock.monotonic_ns() < give_up_ns:
                clock.sleep_until(clock.monotonic_ns() + OFFERED_NS // 3000)


@contextmanager
def show_on_page(
    options: PageOptions, clock: Clock, session: str, say: Callable[[str], None], bus: Bus
) -> Iterator[tuple[SessionView, Callable[[], None]]]:
    """The `SessionOnlooker` of a page."""
    with PageServer(bus, clock, session, options, say=say) as page:
        yield page.view, lambda: None
        page.tell_refused()
