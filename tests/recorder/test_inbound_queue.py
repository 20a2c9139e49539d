"""Messages are stamped on arrival; the queue is bounded and losses are counted."""

import pytest

from recorder import site_reception as module
from recorder.site_reception import InboundQueue
from tests.net.manual_clock import ManualClock


def test_stamped_messages_come_out_oldest_first() -> None:
    clock = ManualClock(100)
    tap = InboundQueue(clock)
    tap.receive("a", b"1")
    clock.sleep_until(250)
    tap.receive("b", b"2")
    clock.sleep_until(900)
    messages = tap.drain()
    assert next(messages) == ("a", b"1", 100)
    tap.receive("c", b"3")  # while it is drained
    assert list(messages) == [("b", b"2", 250), ("c", b"3", 900)]


def test_full_queues_count_their_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CAPACITY", 5)
    tap = InboundQueue(ManualClock())
    for n in range(8):
        tap.receive("a", bytes([n]))
    assert tap.overflowed == {"a": 3}
    assert [message.payload for message in tap.drain()] == [bytes([n]) for n in range(5)]
    tap.receive("a", b"again")
    assert [message.payload for message in tap.drain()] == [b"again"]
    assert tap.overflowed == {"a": 3}


def test_a_flood_leaves_room_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "KEY_BYTES", 5_000)
    monkeypatch.setattr(module, "CAPACITY_BYTES", 8_000)
    tap = InboundQueue(ManualClock())
    for _ in range(100):
        tap.receive("flood", bytes(1_000))
    tap.receive("quiet", b"1")
    for _ in range(100):
        tap.receive("more", bytes(1_000))
    waiting = [(message.key, len(message.payload)) for message in tap.drain()]
    assert sum(size for _, size in waiting) < 10_000  # no more than one message beyond
    assert ("quiet", 1) in waiting
    assert tap.overflowed["flood"] + tap.overflowed["more"] == 201 - len(waiting)
    tap.receive("flood", b"again")  # what was drained makes room
    assert [message.payload for message in tap.drain()] == [b"again"]
