"""Python's cycle collector, and when it had better rest.

Law: it is paused only around code whose many objects cannot form cycles (records, lists of numbers); it
would walk through all of them again and again and find nothing, for most of the time that reading a log
takes.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def paused() -> Iterator[None]:
    """Keeps the collector from running inside the block."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def settle() -> None:
    """Puts all that exists out of the collector's sight: from now on a round looks at what is new alone.

    A full round over all that a program has imported takes a quarter of a second.
    """
    gc.collect()
    gc.freeze()


def off_for_good() -> None:
    """Puts all that exists out of the collector's sight and stops it: for a loop that must not pause."""
    settle()
    gc.disable()
