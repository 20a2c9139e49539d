"""Two members with keys, and a wire between them that turns over one bit; a program, as Zenoh may die of it.

    python -m tests.net.flipped_bit KEYS

It prints every payload that comes, and `again` once the connection was made again.
"""

import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.net import topics
from trilat_net.net.member_keys import read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

from .waiting import drained, until


class Flipping:
    """A wire to a place that turns over one bit of its traffic on request."""

    def __init__(self, to: str) -> None:
        self._to = ("127.0.0.1", int(to.rpartition(":")[2]))
        self._door = socket.create_server(("127.0.0.1", 0))
        self.place = f"tls/127.0.0.1:{self._door.getsockname()[1]}"
        self.flips = self.flipped = self.connections = 0
        self._ends = [self._door]
        self._threads: list[threading.Thread] = []
        self._begin(self._serve)

    def _begin(self, act: Callable[..., None], *ends: socket.socket) -> None:
        self._threads.append(threading.Thread(target=act, args=ends))
        self._threads[-1].start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                self._ends += (
                    inner := self._door.accept()[0],
                    other := socket.create_connection(self._to),
                )
                self.connections += 1
                self._begin(self._carry, inner, other)
                self._begin(self._carry, other, inner)

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := bytearray(source.recv(65536)):
                if self.flipped < self.flips and sink.getpeername() == self._to:
                    self.flipped += 1
                    data[-1] ^= 1
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        for end in self._ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(20.0)
        for end in self._ends:
            end.close()


def main(folder: Path) -> None:
    (endpoint,) = (
        free_endpoint.replace("tcp", "tls") for free_endpoint in find_free_endpoints(1)
    )
    receiver = ZenohBus([endpoint], settings=read_member_keys(folder / "m1").settings)
    wire = Flipping(endpoint)
    sender = ZenohBus([], [wire.place], settings=read_member_keys(folder / "m2").settings)
    key = topics.key("x", "m2", topics.EVENT)
    try:
        inbox = receiver.inbox(key)
        say = sender.publisher(key)

        def comes() -> bool:
            say(b"true")
            payloads = [payload.decode() for _, payload in drained(inbox)]
            print(*payloads, flush=True)
            return "true" in payloads

        until(comes)
        before = wire.connections
        wire.flips = 1
        until(lambda: comes() and wire.connections > before)
        assert wire.flipped == 1
        print("again", flush=True)
        until(comes)
    finally:
        sender.close()
        receiver.close()
        wire.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
