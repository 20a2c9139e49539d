"""The order of play: by time, and never against the numbers of a channel."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.app.play.batch import order_for_play

Messages = list[tuple[int, int, int]]
messages = st.lists(
    st.tuples(st.integers(-50, 50), st.integers(0, 3), st.integers(0, 12)),
    min_size=0,
    max_size=40,
)


def order_messages(messages_in: Messages) -> tuple[list[int], list[int]]:
    columns = np.array(messages_in, dtype=np.int64).reshape(-1, 3)
    order, due_ns = order_for_play(columns[:, 0], columns[:, 1], columns[:, 2])
    return order.tolist(), due_ns.tolist()


@given(messages)
def test_messages_come_once_in_time_order(messages_in: Messages) -> None:
    order, due_ns = order_messages(messages_in)
    assert sorted(order) == list(range(len(messages_in)))
    assert due_ns == sorted(due_ns)


@given(messages)
def test_channels_play_in_order_of_their_numbers(messages_in: Messages) -> None:
    order, _ = order_messages(messages_in)
    for channel in range(4):
        own_places = [
            (messages_in[message_index][2], message_index)
            for message_index in order
            if messages_in[message_index][1] == channel
        ]
        assert own_places == sorted(own_places)


@given(messages)
def test_messages_are_early_only_before_later_numbers(messages_in: Messages) -> None:
    order, due_ns = order_messages(messages_in)
    for message_index, due in zip(order, due_ns, strict=True):
        t_ns, channel, number = messages_in[message_index]
        behind = [
            t
            for n, (t, c, k) in enumerate(messages_in)
            if c == channel and (k, n) >= (number, message_index)
        ]
        assert due == min(behind) <= t_ns


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), max_size=30))
def test_ascending_numbers_give_a_time_sort(
    steps: list[tuple[int, int]],
) -> None:
    """The times of a channel never decrease, as in every complete log."""
    latest: dict[int, int] = {}
    rising = []
    for number, (step, channel) in enumerate(steps):
        latest[channel] = latest.get(channel, 0) + step
        rising.append((latest[channel], channel, number))
    order, due_ns = order_messages(rising)
    assert order == sorted(range(len(rising)), key=lambda n: rising[n][0])
    assert due_ns == [rising[n][0] for n in order]


def test_records_filled_in_later_play_in_place() -> None:
    """A late record plays at its time of sending, or right before its successor by the time of arrival."""
    state = 0
    other = 1
    by_sending = [(0, state, 0), (2, state, 2), (2, other, 0), (1, state, 1)]
    assert order_messages(by_sending) == ([0, 3, 1, 2], [0, 1, 2, 2])
    by_arrival = [(0, state, 0), (2, state, 2), (2, other, 0), (9, state, 1)]
    assert order_messages(by_arrival) == ([0, 3, 1, 2], [0, 2, 2, 2])
