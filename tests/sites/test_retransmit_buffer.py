"""A site's memory of its published messages: bounded, exact, and sent in bounded chunks."""

from types import SimpleNamespace
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from sites.retransmit_buffer import (
    EVENTS_KEPT,
    KEPT_S,
    RECORDS_KEPT,
    ChannelBuffer,
    RetransmitBuffer,
)
from tests.net.local_bus import LocalNetwork
from trilat_net.core.step.site_setup import Layout
from trilat_net.net import topics
from trilat_net.net.bus import Inbox
from trilat_net.net.messages import VERSION
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES, Backfill, BackfillRequest
from trilat_net.net.wire import MAX_BYTES, decode, encode

KEY = topics.key("t", "m1", topics.PAST)
BOOT = 7


class Desk:
    def __init__(self, rate_hz: int = 1000) -> None:
        network = LocalNetwork()
        self._asker = network.join()
        site: Any = SimpleNamespace(name="m1", rate_hz=rate_hz, layout=Layout())
        self.history = RetransmitBuffer(site, BOOT, network.join().query_inbox(KEY))

    def ask(self, payload: bytes) -> Inbox:
        replies = self._asker.query(KEY, payload)
        while self.history.answer_query():
            pass
        return replies

    def request_range(self, channel: str, first: int, last: int) -> Backfill:
        reply = self.ask(
            encode(BackfillRequest(channel=channel, first=first, last=last))
        ).poll()  # type: ignore[arg-type]
        assert reply is not None
        return decode(reply[1], Backfill)


memories = {
    "capacity": st.integers(1, 200),
    "size_bytes": st.integers(3000, 40_000),
    "sizes": st.lists(st.integers(0, 3000), max_size=300),
}


@given(**memories, first=st.integers(0, 400), length=st.integers(1, 400))
def test_rings_send_their_content_in_chunks(
    capacity: int, size_bytes: int, sizes: list[int], first: int, length: int
) -> None:
    """Repeated requests from behind the last answer return exactly the remaining part of a range."""
    ring = ChannelBuffer(capacity, size_bytes)
    payloads = [str(n).encode()[-size:].zfill(size) for n, size in enumerate(sizes)]
    for payload in payloads:
        ring.store(payload)
    last = first + length - 1
    sent = []
    at = first
    while True:
        begun, chunk = ring.read_chunk(at, last)
        assert begun == max(at, ring.oldest)
        assert len(chunk) <= BACKFILL_MESSAGES
        assert sum(map(len, chunk)) <= BACKFILL_BYTES
        if not chunk:
            break
        sent += [(begun + n, payload) for n, payload in enumerate(chunk)]
        at = begun + len(chunk)
    left = range(max(first, ring.oldest), min(last + 1, ring.next_number))
    assert sent == [(n, payloads[n]) for n in left]


@given(**memories)
def test_rings_forget_as_little_as_possible(
    capacity: int, size_bytes: int, sizes: list[int]
) -> None:
    """The rest fills the memory, except a piece of a message at its end, or fills the places."""
    ring = ChannelBuffer(capacity, size_bytes)
    for size in sizes:
        ring.store(b"x" * size)
    left = ring.next_number - ring.oldest
    assert left <= capacity
    assert sum(sizes[ring.oldest :]) <= size_bytes
    if ring.oldest and left < capacity:
        assert sum(sizes[ring.oldest - 1 :]) > size_bytes - 3000


def test_channels_are_sent_separately() -> None:
    desk = Desk()
    for n, ring in enumerate(desk.history.channels.values()):
        for m in range(n + 2):
            ring.store(b"%d %d" % (n, m))
    for n, channel in enumerate(desk.history.channels):
        past = desk.request_range(channel, 1, 9)
        assert (past.member, past.boot, past.channel) == ("m1", BOOT, channel)
        assert (past.first, past.made) == (1, n + 2)
        assert past.payloads == [b"%d %d" % (n, m) for m in range(1, n + 2)]


def test_memory_holds_a_minute_and_no_more() -> None:
    rings = Desk(1000).history.channels
    for ring, capacity in zip(rings.values(), (60_000, 10 * KEPT_S, EVENTS_KEPT), strict=True):
        for _ in range(capacity + 5):
            ring.store(b"x" * 600)
        assert ring.oldest == 5
    fast = Desk(20_000).history.channels[topics.STATE]
    for _ in range(RECORDS_KEPT + 1):
        fast.store(b"x" * 600)
    assert fast.oldest == 1


def test_the_largest_messages_fit_an_answer() -> None:
    """One message is always sent, however large it is."""
    desk = Desk()
    for _ in range(3):
        desk.history.channels[topics.EVENT].store(b"x" * MAX_BYTES)
    assert [len(payload) for payload in desk.request_range(topics.EVENT, 0, 9).payloads] == [
        MAX_BYTES
    ]


def test_invalid_requests_get_no_answer() -> None:
    desk = Desk()
    good = BackfillRequest(channel="state", first=0, last=3)
    for payload in (
        b"",
        b"\xff",
        encode(good)[:-1],
        encode(BackfillRequest(v=VERSION + 1, channel="state", first=0, last=0)),
    ):
        assert desk.ask(payload).poll() is None
    assert desk.ask(encode(good)).poll() is not None
