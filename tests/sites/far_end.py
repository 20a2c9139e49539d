"""The far end of a benchmark in a thread: it answers at a free endpoint of this machine."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tests.net.free_endpoints import find_free_endpoints
from trilat_net.app.network_benchmark import run_far_end


@contextmanager
def answering_far_end() -> Iterator[str]:
    """Yields the endpoint of a far end, which ends with the block."""
    ended = threading.Event()
    (endpoint,) = find_free_endpoints(1)
    far = threading.Thread(target=run_far_end, args=([endpoint], None, ended.is_set))
    far.start()
    try:
        yield endpoint
    finally:
        ended.set()
        far.join()
