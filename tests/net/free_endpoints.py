"""Endpoints on this machine whose ports no program uses."""

import socket
from contextlib import ExitStack


def find_free_endpoints(count: int) -> list[str]:
    """Returns endpoints on this machine whose ports are currently unused.

    Another program may take a port before the caller does.

    Args:
        count: Number of endpoints to find.
    """
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for bound in sockets:
            bound.bind(("127.0.0.1", 0))
        return [f"tcp/127.0.0.1:{bound.getsockname()[1]}" for bound in sockets]
