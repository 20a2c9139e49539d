"""Takes a log into memory before it is played, if it is small enough.

Law (L6): bounded. What is larger is read by a process of its own while it plays (`feed`): in this one a
thread that reads would hold up the thread that plays.
"""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from .. import collector
from ..errors import LogError, UsageError
from ..log.chunks import Progress
from .block import Block, Gathering
from .pace import seconds
from .reading import Facts, Reading
from .selection import Selection

SEARCH = 100_000
"""In how many messages more to look for sites that have not been heard yet."""


def load(
    paths: Sequence[Path], selection: Selection, limit_bytes: int, progress: Progress | None = None
) -> tuple[Facts, Block | None]:
    """Returns what files say of their session, and the messages to be played, in order.

    Args:
        paths: the files; of several, the parts of one session in their order.
        selection: what is played.
        limit_bytes: most that may be held.
        progress: told how much is read.

    Returns:
        The facts; and the messages, or None where they are more than the limit.

    Raises:
        LogError: a file is missing, or no log of trilat-net.
        UsageError: nothing is to be played.
    """
    reading = Reading(paths, selection, progress)
    gathering = Gathering()
    with collector.paused():
        messages = reading.messages()
        for message in messages:
            gathering.add(*message)
            if gathering.memory > limit_bytes:
                break
        else:
            if reading.facts is None:
                raise LogError(f"{paths[0]}: holds nothing")
            if not len(gathering):
                raise UsageError(_nothing(paths[0], selection, reading.facts))
            return reading.facts, gathering.ordered()
        for _ in islice(messages, SEARCH):
            assert reading.facts is not None  # there was a message
            if reading.facts.boots.keys() >= reading.facts.scenario.sites.keys():
                break
    assert reading.facts is not None
    return reading.facts, None


def _nothing(path: Path, selection: Selection, facts: Facts) -> str:
    """Says why there is nothing to play, and what there would be."""
    if facts.last_ns < facts.first_ns:
        return f"{path}: holds no message"
    span = f"from {seconds(facts.first_ns):.3f} s to {seconds(facts.last_ns):.3f} s"
    if selection.start_ns is not None and selection.start_ns > facts.last_ns:
        return f"--start {seconds(selection.start_ns):g} s: is beyond the end; the log goes {span}"
    if selection.stop_ns is not None and selection.stop_ns < facts.first_ns:
        return f"--stop {seconds(selection.stop_ns):g} s: is before the beginning; the log goes {span}"
    return (
        f"{path}: has no message for this selection; its topics are like "
        f"trilat/{facts.session}/{facts.scenario.names[0]}/state, and it goes {span}"
    )
