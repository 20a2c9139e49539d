"""In which order messages are played.

Law: by time, and never reordered within a channel, whose order is that of its numbers. What stands in the
file later than its number says (a record that the recorder asked a site for afterwards) is played in its
place: where its time is later than that of the next one of its channel, together with that one. Messages of
one instant are played as the file has them.
"""

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def in_order(times_ns: Ints, channels: Ints, numbers: Ints) -> tuple[Ints, Ints]:
    """Returns the places of messages in the order of play, and when each is due.

    Args:
        times_ns: when each was sent or came, ns, shape (K,), in file order.
        channels: its channel, shape (K,).
        numbers: its number in its channel, shape (K,); equal ones stay in file order.

    Returns:
        The places, shape (K,), and the times in that order, ns, shape (K,): no time is less than the one
        before, and none is more than the given one.
    """
    places = np.arange(len(times_ns), dtype=np.int64)
    due_ns, file_places = times_ns.copy(), places.copy()
    for channel in np.unique(channels):
        own = np.flatnonzero(channels == channel)
        own = own[np.argsort(numbers[own], kind="stable")]
        # no message after the next one of its channel, in time or, within an instant, in place
        due_ns[own] = _no_later_than_the_next(times_ns[own])
        file_places[own] = _no_later_than_the_next(places[own])
    order = np.lexsort((numbers, file_places, due_ns)).astype(np.int64)
    return order, due_ns[order]


def _no_later_than_the_next(values: Ints) -> Ints:
    return np.minimum.accumulate(values[::-1])[::-1]
