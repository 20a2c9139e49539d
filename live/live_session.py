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

from sites.demo_session import SessionAttendant
from trilat_net.errors import SessionError, UsageError
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.connection import Connection
from trilat_net.net.discovery import connect_to_session
from trilat_net.net.zenoh_bus import ZenohBus
from trilat_net.process import Interrupt
from trilat_net.scenario import embedded_names_reader

from .page_server import LOOPBACK, PageServer

POLL_NS = 100_000_000
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


def attend_with_page(options: PageOptions, clock: Clock, say: Callable[[str], None]) -> SessionAttendant:
    """Returns what serves a page beside a session that is started for it, until the page asks for its end."""

    @contextmanager
    def attend(session: str, endpoints: Sequence[str]) -> Iterator[Callable[[], bool]]:
        with (
            closing(ZenohBus([], endpoints)) as bus,
            serve_page(bus, clock, session, options, say, ends=True) as page,
        ):
            yield page.end_requested.is_set

    return attend


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


def watch_with_page(
    session: str,
    connection: Connection,
    options: PageOptions,
    clock: Clock,
    say: Callable[[str], None],
    timeout_s: float,
) -> int:
    """Serves a page of a session that runs already, until it ends or a signal comes; returns the exit code.

    Raises:
        SessionError: the session is not there.
        UsageError: an endpoint or the page's address cannot be used.
    """
    with Interrupt() as interrupt:
        names, stopped = embedded_names_reader(session), interrupt.requested
        reached = connect_to_session(
            connection, clock, session, names, stopped=stopped, timeout_s=timeout_s, say=say
        )
        with reached as bus:
            if bus is None:
                return interrupt.exit_code
            with serve_page(bus, clock, session, options, say, ends=False) as page:
                give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
                while not (interrupt.requested() or page.view.ended):
                    now_ns = clock.monotonic_ns()
                    if now_ns > give_up_ns and not page.view.met:
                        raise SessionError(f"no site of session {session!r} answered within {timeout_s:g} s")
                    clock.sleep_until(now_ns + POLL_NS)
        if not interrupt.requested():
            say(f"session {session} has ended")
            return 0
        return interrupt.exit_code
