"""Sessions with a page: one that is started for it, or one that runs already.

Invariant: the page is an onlooker of Zenoh like any other; the session neither waits for it nor needs it, and
runs on if it fails. A browser is opened only where there is one.
"""

import os
import socket
import sys
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass

from trilat_net.errors import UsageError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.zenoh_bus import ZenohBus

from .page_server import LOOPBACK, PageServer
from .session_view import SessionView

LONGEST_S = 3600.0
"""A session with a page runs for so long at most, unless told otherwise, s."""


@dataclass(frozen=True, slots=True)
class PageOptions:
    """How a page is served.

    Attributes:
        host: address to listen at.
        port: 0: any.
        insecure: true: another address than this machine's is allowed, though nothing is encrypted.
        opens: true: a browser is opened where there is one.
    """

    host: str = "127.0.0.1"
    port: int = 0
    insecure: bool = False
    opens: bool = True

    def check(self) -> None:
        """Refuses an address that is taken, and to serve others without being told that it is not safe.

        Raises:
            UsageError: with the reason.
        """
        if self.host not in LOOPBACK and not self.insecure:
            raise UsageError(
                f"--host {self.host}: whoever reads the network reads the page's token and could take part; "
                "say --insecure if that network is yours, or leave out --host and use an SSH tunnel"
            )
        try:
            family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
            socket.create_server((self.host, self.port), family=family).close()
        except OSError as error:
            raise UsageError(f"{self.host}:{self.port}: cannot listen: {error.strerror}") from None


@contextmanager
def attend_with_page(
    options: PageOptions, clock: Clock, session: str, endpoints: Sequence[str], say: Callable[[str], None]
) -> Iterator[Callable[[], bool]]:
    """The `SessionAttendant` that serves a page, until that asks for the end of the session."""
    with (
        closing(ZenohBus([], endpoints)) as bus,
        serve_page(bus, clock, session, options, say, ends=True) as page,
    ):
        yield page.end_requested.is_set


@contextmanager
def serve_page(
    bus: Bus, clock: Clock, session: str, options: PageOptions, say: Callable[[str], None], *, ends: bool
) -> Iterator[PageServer]:
    """Serves a page inside the block, and opens a browser at it."""
    host, port = options.host, options.port
    with PageServer(bus, clock, session, host=host, port=port, ends=ends, say=say) as page:
        say(f"the page: {page.address}")
        with suppress(OSError, webbrowser.Error):
            if options.opens and _has_browser():
                webbrowser.open(page.address)
        yield page
        for reason, count in sorted((+page.refused).items()):
            say(f"the page refused {count} messages or requests: {reason}")


def _has_browser() -> bool:
    """True if this process may open a browser that somebody sees."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        return False
    return sys.stdout.isatty()


@contextmanager
def show_on_page(
    options: PageOptions, clock: Clock, session: str, say: Callable[[str], None], bus: Bus
) -> Iterator[tuple[SessionView, Callable[[], None]]]:
    """The `SessionOnlooker` of a page."""
    with serve_page(bus, clock, session, options, say, ends=False) as page:
        yield page.view, lambda: None
