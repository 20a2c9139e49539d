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


def ordered(given: Messages) -> tuple[list[int], list[int]]:
    columns = np.array(given, dtype=np.int64).reshape(-1, 3)
    order, due_ns = order_for_play(columns[:, 0], columns[:, 1], columns[:, 2])
    return order.tolist(), due_ns.tolist()


@given(messages)
def test_messages_come_once_in_time_order(given: Messages) -> None:
    order, due_ns = ordered(given)
    assert sorted(order) == list(range(len(given)))
    assert due_ns == sorted(due_ns)


@given(messages)
def test_channels_play_in_order_of_their_numbers(given: Messages) -> None:
    order, _ = ordered(given)
    for channel in range(4):
        own_places = [
            (given[message_index][2], message_index)
            for message_index in order
            if given[message_index][1] == channel
        ]
        assert own_places == sorted(own_places)


@given(messages)
def test_messages_are_early_only_before_later_numbers(given: Messages) -> None:
    order, due_ns = ordered(given)
    for message_index, due in zip(order, due_ns, strict=True):
        t_ns, channel, number = given[message_index]
        behind = [
            t
            for n, (t, c, k) in enumerate(given)
            if c == channel and (k, n) >= (number, message_index)
        ]
        assert due == min(behind) <= t_ns


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), max_size=30))
def test_ascending_numbers_give_a_time_sort(
    given: list[tuple[int, int]],
) -> None:
    """As in every complete log; channels' times there never go back."""
    latest: dict[int, int] = {}
    rising = []
    for number, (step, channel) in enumerate(given):
        latest[channel] = latest.get(channel, 0) + step
        rising.append((latest[channel], channel, number))
    order, due_ns = ordered(rising)
    assert order == sorted(range(len(rising)), key=lambda n: rising[n][0])
    assert due_ns == [rising[n][0] for n in order]


def test_records_filled_in_later_play_in_place() -> None:
    """By its time of sending; and by its time of arrival right before its successor."""
    state, other = 0, 1
    by_sending = [(0, state, 0), (2, state, 2), (2, other, 0), (1, state, 1)]
    assert ordered(by_sending) == ([0, 3, 1, 2], [0, 1, 2, 2])
    by_arrival = [(0, state, 0), (2, state, 2), (2, other, 0), (9, state, 1)]
    assert ordered(by_arrival) == ([0, 3, 1, 2], [0, 2, 2, 2])
