"""A page without a browser: a socket that receives and acknowledges every frame."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from websockets.sync.client import ClientConnection, connect

from trilat_net.net.clock import SystemClock

PATIENCE_S = 60.0


def socket_address(link: str) -> str:
    """Returns the address of the socket that the page of a link opens, as `main.js` computes it."""
    parts = urlsplit(link)
    query = "&".join(filter(None, (parts.query, parts.fragment)))
    return f"ws://{parts.netloc}/socket" + (f"?{query}" if query else "")


def with_query(link: str, query: str) -> str:
    """Returns a page's link with a longer query before the token, such as a role or a view."""
    parts = urlsplit(link)
    return parts._replace(query="&".join(filter(None, (parts.query, query)))).geturl()


@contextmanager
def page_client(link: str) -> Iterator["PageClient"]:
    with connect(socket_address(link), max_size=None) as socket:
        yield PageClient(socket)


class PageClient:
    """A page of a session's server, as `main.js` behaves.

    Attributes:
        frame: the newest.
    """

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.frame: dict[str, Any] = {}
        self.hello: dict[str, Any] = {}

    def send(self, **message: Any) -> None:
        self.socket.send(json.dumps(message))

    def take(self) -> dict[str, Any]:
        message = json.loads(self.socket.recv(PATIENCE_S))
        self.hello, self.frame = (
            (message["hello"], {}) if "hello" in message else (self.hello, message)
        )
        self.send(do="seen", n=self.hello["n"] if "hello" in message else message["n"])
        return self.frame

    def shows(self, mode: str) -> None:
        clock = SystemClock()
        give_up_ns = clock.monotonic_ns() + int(PATIENCE_S * 1e9)
        while {site["mode"] for site in self.take().get("sites", {}).values()} != {mode}:
            assert clock.monotonic_ns() < give_up_ns, (mode, self.frame.get("sites"))
