"""The page's server: its files and its socket, from one `websockets` server in a thread of its own.

Invariant: newest state wins. A page gets its next frame when it has drawn one of those before, so that a slow
page sees fewer frames and nobody waits for it. A page of another origin, without the token, with too many or
too large messages is refused and counted; nothing of it reaches a site. One thread serves all pages and takes
in the session's messages.
"""

import asyncio
import hmac
import secrets
import threading
from collections import Counter, deque
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from trilat_net.errors import UsageError, WireError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock

from .page_orders import (
    MAX_MESSAGE_BYTES,
    EndSession,
    MarkMoment,
    MoveHand,
    OrderDesk,
    PageHands,
    PageMessage,
    Seen,
    SetLink,
    SetShares,
    TakePart,
    read_page_message,
)
from .session_frames import SessionFrames, show_event
from .session_view import SessionView

FRAMES_PER_S = 30
FRAMES_AHEAD = 2
"""Frames that a page may have got and not drawn yet: one is on its way while it draws the other."""
MESSAGES_PER_S = 240
"""Messages that a page may send on average; one that sends many more is closed."""
BURST = 480
MOST_EXCESS = 1_000
MOST_PAGES = 16
WAITING_FRAMES = 10
"""Frames between two looks at who is there, before a session begins."""
POINTS_PER_FRAME = 240
"""Points of the plots that one frame brings at most; a page that was away longer has a gap."""
_TOO_LARGE, _POLICY_VIOLATION = 1009, 1008
"""Codes with which a socket is closed, RFC 6455."""
LOOPBACK = ("127.0.0.1", "::1", "localhost")

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "LICENSE": "text/plain; charset=utf-8",
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def _list_assets() -> dict[str, tuple[str, bytes]]:
    """Returns every file of the page by its path, with its kind."""
    plots = (resources.files("trilat_net.reporting") / "assets").iterdir()
    files = {}
    for file in [*(resources.files("live") / "assets").iterdir(), *plots]:
        kind = _KINDS.get(file.name.rpartition(".")[2].rpartition("-")[2])
        if kind is not None and not file.name.startswith("report.") and "/" + file.name not in files:
            files["/" + file.name] = kind, file.read_bytes()
    files["/"] = files["/index.html"]
    return files


class Page:
    """One connected page.

    Attributes:
        hands: what it holds.
        takes_part: true if its orders count.
        wake: set when there is a frame that it has not got.
    """

    def __init__(self, connection: ServerConnection, hands: PageHands, *, takes_part: bool) -> None:
        self.connection, self.hands, self.takes_part = connection, hands, takes_part
        self.wake = asyncio.Event()
        self.drawn = self.sent = 0
        self.notified = 0
        self.unseen: deque[int] = deque()
        self.points = self.energies = self.events = 0
        self._allowed, self._filled_ns, self._excess = float(BURST), 0, 0

    def allows(self, now_ns: int) -> bool:
        """True if a message may come now; a bucket that fills at MESSAGES_PER_S."""
        self._allowed += (now_ns - self._filled_ns) * 1e-9 * MESSAGES_PER_S if self._filled_ns else 0.0
        self._allowed, self._filled_ns = min(self._allowed, BURST), now_ns
        if self._allowed < 1.0:
            self._excess += 1
            return False
        self._allowed -= 1.0
        return True

    @property
    def floods(self) -> bool:
        """True if it has sent so much more than it may that it must go."""
        return self._excess > MOST_EXCESS


class PageServer:
    """Serves one session's page; a context, inside of which the server's thread runs.

    Args:
        bus: a connection of its own to the session.
        clock: the time.
        session: the session's name.
        host: address to listen at; another than this machine's needs the token.
        port: 0: any.
        ends: true if pages may end the session.

    Attributes:
        address: where a browser finds the page, token included.
        end_requested: set once a page has asked for the end.
        refused: what was refused, by reason.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        ends: bool = False,
    ) -> None:
        self._bus, self._clock, self._host, self._port, self._ends = bus, clock, host, port, ends
        self._met = 0
        self.view = SessionView(bus, clock, session)
        self._frames = SessionFrames(self.view)
        self._desk = OrderDesk(bus, clock, session)
        self.refused: Counter[str] = self._desk.refused
        self._token = "" if host in LOOPBACK else secrets.token_urlsafe(16)
        self._files = _list_assets()
        self._pages: set[Page] = set()
        self._frame: dict[str, Any] | None = None
        self._n = 0
        self._notices: list[dict[str, Any]] = []
        self.end_requested = threading.Event()
        self.address = ""
        self._ready = threading.Event()
        self._problem: OSError | None = None
        self._failure: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="page", daemon=True)

    def __enter__(self) -> "PageServer":
        self._thread.start()
        self._ready.wait()
        if self._problem is not None:
            raise UsageError(f"{self._host}:{self._port}: cannot listen: {self._problem.strerror}")
        return self

    def __exit__(self, *_: object) -> None:
        if self._loop is not None and self._stop is not None:
            with suppress(RuntimeError):  # its loop has ended already
                self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(5.0)
        if self._failure is not None:
            raise self._failure

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await serve(
                *(self._attend, self._host, self._port),
                process_request=self._answer,
                max_size=MAX_MESSAGE_BYTES,
                max_queue=32,
                compression=None,
                ping_interval=5,
                ping_timeout=10,
                close_timeout=1,
            )
        except OSError as error:
            self._problem = error
            self._ready.set()
            return
        async with server:
            self._port = server.sockets[0].getsockname()[1]
            shown = f"[{self._host}]" if ":" in self._host else self._host
            self.address = f"http://{shown}:{self._port}/" + (f"?token={self._token}" if self._token else "")
            self._ready.set()
            tasks = [asyncio.create_task(self._tick()), asyncio.create_task(self._stop.wait())]
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in tasks:
                task.cancel()
            self._failure = next((task.exception() for task in done), None)

    async def _tick(self) -> None:
        """Takes in the session's messages and makes a frame, thirty times a second."""
        while True:
            begun_ns = self._clock.monotonic_ns()
            self.view.poll()
            self._desk.poll()
            frame = self._frames.make()
            self._frame = frame or self._frame
            self._n += 1
            for site, accepted, text in self._desk.replies:
                self._notices.append({"n": self._n, "site": site, "ok": accepted, "text": text})
            self._desk.replies.clear()
            del self._notices[:-20]
            for page in self._pages:
                page.wake.set()
            spent_s = (self._clock.monotonic_ns() - begun_ns) * 1e-9
            await asyncio.sleep(max(0.002, 1.0 / FRAMES_PER_S - spent_s))

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answers a request for a file; None lets a socket open."""
        target = urlsplit(request.path)
        if (problem := self._problem_of(request, target.query)) is not None:
            self.refused[problem] += 1
            return connection.respond(HTTPStatus.FORBIDDEN, problem + "\n")
        if target.path == "/socket":
            if len(self._pages) >= MOST_PAGES:
                self.refused["too many pages"] += 1
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many pages\n")
            return None
        if (file := self._files.get(target.path)) is None:
            return connection.respond(HTTPStatus.NOT_FOUND, "there is no such file\n")
        kind, content = file
        headers = Headers(
            {
                "Content-Type": kind,
                "Content-Length": str(len(content)),
                "Content-Security-Policy": _POLICY,
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cache-Control": "no-store" if target.path in ("/", "/index.html") else "no-cache",
                "Connection": "close",
            }
        )
        return Response(HTTPStatus.OK, "OK", headers, content)

    def _problem_of(self, request: Request, query: str) -> str | None:
        """Returns why a request is refused; None if it is not."""
        host = request.headers.get("Host", "")
        name = urlsplit(f"//{host}").hostname or ""
        if not self._token and name not in LOOPBACK:
            return "foreign host"  # a name of somebody else's that leads here
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"http://{host}":
            return "foreign origin"
        path = urlsplit(request.path).path
        if self._token and path in ("/", "/index.html", "/socket"):
            given = parse_qs(query).get("token", [""])[0]
            if not hmac.compare_digest(given.encode(), self._token.encode()):
                return "no token"
        return None

    async def _attend(self, connection: ServerConnection) -> None:
        """Serves one page until it goes."""
        self._met += 1
        hands = PageHands(self._bus, self._clock, self.view.session, f"page {self._met}")
        page = Page(connection, hands, takes_part=not any(other.takes_part for other in self._pages))
        self._pages.add(page)
        sending = asyncio.create_task(self._send(page))
        try:
            async for text in connection:
                self._take(page, text)
                if page.floods:  # what else it has sent is not even read
                    await connection.close(_POLICY_VIOLATION, "too many messages")
                    break
        except ConnectionClosed as closed:
            self.refused["too large"] += closed.sent is not None and closed.sent.code == _TOO_LARGE
        finally:
            page.hands.release()
            sending.cancel()
            self._pages.discard(page)

    def _take(self, page: Page, text: str | bytes) -> None:
        """Takes a message of a page, unless it sends more than it may."""
        if not page.allows(self._clock.monotonic_ns()):
            self.refused["too many"] += 1
            return
        try:
            message = read_page_message(text)
        except WireError as error:
            self.refused[error.reason] += 1
            return
        self._obey(page, message)

    def _obey(self, page: Page, message: PageMessage) -> None:
        if isinstance(message, Seen):
            page.drawn = min(message.n, page.sent)
            while page.unseen and page.unseen[0] <= page.drawn:
                page.unseen.popleft()
            page.wake.set()
        elif isinstance(message, TakePart):
            page.takes_part = message.want
            if not message.want:
                page.hands.release()
        elif not page.takes_part:
            self.refused["does not take part"] += 1
        elif isinstance(message, SetLink | SetShares):
            self._desk.order(message)
        elif isinstance(message, MarkMoment):
            if self.view.scenario is not None:
                self._desk.mark(self.view.scenario.names[0], message.text)
        elif isinstance(message, MoveHand):
            self._move_hand(page, message)
        elif isinstance(message, EndSession) and self._ends:
            self.end_requested.set()

    def _move_hand(self, page: Page, order: MoveHand) -> None:
        site = self.view.sites.get(order.site)
        if site is None or site.hand is None:
            self.refused["nobody can hold it"] += 1
            return
        page.hands.move(order, pushes=site.hand.mode == "force")

    async def _send(self, page: Page) -> None:
        """Sends a page what is newest, again and again, each time it has drawn what it got."""
        encode: Callable[[Any], bytes] = msgspec.json.encode
        greeted = False
        with suppress(ConnectionClosed):
            while True:
                await page.wake.wait()
                page.wake.clear()
                if len(page.unseen) >= FRAMES_AHEAD or page.sent == self._n:
                    continue
                begins = self._frame is not None
                if not begins and page.sent and self._n - page.sent < WAITING_FRAMES:
                    continue
                page.notified, page.sent = page.sent, self._n
                page.unseen.append(page.sent)
                if not greeted or not begins:
                    greeted = begins
                    about = {**self._frames.describe(), "n": self._n, "ends": self._ends}
                    await page.connection.send(encode({"hello": about}), text=True)
                    continue
                await page.connection.send(encode(self._frame_for(page)), text=True)

    def _frame_for(self, page: Page) -> dict[str, Any]:
        """Returns the newest frame with what is new to a page."""
        frames, view = self._frames, self.view
        first = page.points == 0 and page.energies == 0
        most = 100_000 if first else POINTS_PER_FRAME
        points = frames.points.since(page.points, most)
        energies = frames.energies.since(page.energies, most)
        sites = (self._frame or {}).get("sites", {})
        held = [name for name, site in sites.items() if page.hands.holds(name, site.get("source", 0))]
        events = [show_event(event) for event in view.events.since(page.events, 100)]
        page.points, page.energies, page.events = (
            frames.points.count,
            frames.energies.count,
            view.events.count,
        )
        return {
            "n": self._n,
            **(self._frame or {}),
            "points": points,
            "energies": energies,
            "events": events,
            "notices": [one for one in self._notices if one["n"] > page.notified],
            "pages": len(self._pages),
            "takes_part": page.takes_part,
            "holds": held,
            "refused": sum(self.refused.values()),
        }
