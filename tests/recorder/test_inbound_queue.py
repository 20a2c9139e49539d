"""Messages are stamped where they come in; the queue is bounded and what overflows is counted."""

import pytest

from recorder import inbound_queue as module
from recorder.inbound_queue import InboundQueue
from trilat_net.net.clock import ManualClock


def test_messages_are_stamped_on_arrival_and_come_out_oldest_first() -> None:
    clock = ManualClock(100)
    tap = InboundQueue(clock)
    tap.take("a", b"1")
    clock.sleep_until(250)
    tap.take("b", b"2")
    clock.sleep_until(900)
    messages = tap.drain()
    assert next(messages) == ("a", b"1", 100)
    tap.take("c", b"3")  # while it is drained
    assert list(messages) == [("b", b"2", 250), ("c", b"3", 900)]


def test_a_full_queue_counts_what_it_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CAPACITY", 5)
    tap = InboundQueue(ManualClock())
    for n in range(8):
        tap.take("a", bytes([n]))
    assert tap.overflowed == {"a": 3}
    assert [message.payload for message in tap.drain()] == [bytes([n]) for n in range(5)]
    tap.take("a", b"again")
    assert [message.payload for message in tap.drain()] == [b"again"]
    assert tap.overflowed == {"a": 3}
