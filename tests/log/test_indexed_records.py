"""Compiled reading of records: the values of the decoders, or a record that it leaves to them."""

import random

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.core.step.site_setup import Layout
from trilat_net.errors import WireError
from trilat_net.log.packed.indexed_records import IndexedRecords
from trilat_net.log.packed.packed_messages import PackedMessages
from trilat_net.log.record_columns import RecordColumns
from trilat_net.net.messages import MODE_WORDS, READABLE, State
from trilat_net.net.wire import decode, encode_state
from trilat_net.records import Arrival, Mode, TickRecord

PEERS = ("m2", "a_peer_with_a_long_name")
LAYOUTS = (
    Layout(),
    Layout(joints=6, shared=3, parameters=60, chain=True, task=True, hand=9),
    Layout(sent=3, bodies=14),
)
INTS = ("t_ns", "rx_crc", "late_us", "busy_us", "sent_ns")

sizes = st.sampled_from((0, 7, 8, 15, 16, 31, 32, 40, 58))
"""Bits of a number, around those at which its encoding becomes longer."""
numbers = st.floats(allow_nan=False, allow_infinity=False).map(lambda x: x / 64)


@st.composite
def draw_integer(draw: st.DrawFn, least: int = -(2**58), most: int = 2**58) -> int:
    bits = draw(sizes)
    number = draw(st.integers(-(2**bits) - 2, 2**bits + 2))
    return min(max(number, least), most)


@st.composite
def draw_payload(draw: st.DrawFn, layout: Layout) -> bytes:
    """A record as a site writes it."""
    lengths = layout.lengths()
    vectors = {
        name: draw(st.lists(numbers, min_size=count, max_size=count))
        for name, count in lengths.items()
    }
    arrivals = draw(
        st.lists(
            st.tuples(st.integers(0, 40), draw_integer(0, 2**40 - 1), draw_integer()),
            max_size=20,
        )
    )
    record = TickRecord(
        tick=draw(draw_integer(0, 2**40 - 1)),
        t_ns=draw(draw_integer()),
        mode=draw(st.sampled_from(list(Mode))),
        used=[draw(draw_integer()) for _ in PEERS],
        rx_crc=draw(draw_integer(0, 2**32 - 1)),
        cmd=draw(st.lists(st.sampled_from(["{}", "x" * 40, "y" * 300]), max_size=2)),
        mem=draw(st.lists(numbers, max_size=20)),
        **vectors,
    )
    return encode_state(
        site="m1",
        boot=draw(st.integers(0, 2**64 - 1)),
        peers=PEERS,
        output=record,
        arrivals=[Arrival(peer, tick, (), (), latency) for peer, tick, latency in arrivals],
        late_us=draw(draw_integer()),
        busy_us=draw(draw_integer()),
        sent_ns=draw(draw_integer()),
        echo=draw(
            st.lists(st.tuples(draw_integer(), draw_integer(), draw_integer()), max_size=3)
        ),
    )


def index_payloads(payloads: list[bytes], layout: Layout) -> IndexedRecords | None:
    return IndexedRecords.of_payloads(PackedMessages.pack(payloads), "m1", PEERS, layout)


def assert_equal_columns(
    payloads: list[bytes], records: IndexedRecords, layout: Layout
) -> None:
    """Every column equals that of the decoders, bit for bit."""
    columns = RecordColumns(payloads)
    assert records.ticks.tolist() == columns.ticks().tolist()
    for field in INTS:
        assert (records.ints(field) == columns.ints(field)).all()
    expected = columns.vectors(layout, *layout.lengths(), "wrench")
    for field, rows in records.vectors([*layout.lengths(), "wrench"]).items():
        assert rows.shape == expected[field].shape
        assert rows.tobytes() == expected[field].tobytes()
    vector_words = records.vector_words(list(layout.columns()))
    joined = np.concatenate([expected[field] for field in layout.columns()], axis=1)
    assert vector_words.tobytes() == joined.tobytes()
    used = columns.per_peer("used", PEERS, -1)
    assert records.used.T.tolist() == [used[peer].tolist() for peer in PEERS]
    for mine, theirs in zip(records.arrivals, columns.arrivals(), strict=True):
        assert np.array_equal(mine, theirs)
    modes = columns.objects("mode").tolist()
    assert records.modes.tolist() == modes
    assert [MODE_WORDS[Mode(code)] for code in records.mode_codes.tolist()] == modes
    memories = columns.objects("mem").tolist()
    assert records.memories.tolist() == memories
    states = [decode(payload, State, READABLE, layout) for payload in payloads]
    assert [boot % 2**64 for boot in records.boots.tolist()] == [s.boot for s in states]
    assert records.change_counts.tolist() == [len(state.cmd) for state in states]


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=25)
@given(data=st.data())
def test_written_records_are_read_without_decoding(layout: Layout, data: st.DataObject) -> None:
    payloads = data.draw(st.lists(draw_payload(layout), min_size=1, max_size=4))
    records = index_payloads(payloads, layout)
    assert records is not None
    assert_equal_columns(payloads, records, layout)
    order = np.arange(len(payloads))[::-1]
    assert_equal_columns(payloads[::-1], records.select(order), layout)


@pytest.mark.parametrize("layout", LAYOUTS)
@settings(max_examples=60)
@given(data=st.data(), seed=st.integers(0, 2**32))
def test_a_changed_record_is_decoded_alike_or_left(
    layout: Layout, data: st.DataObject, seed: int
) -> None:
    """Many bytes of a record are changed, one or a few at a time."""
    payload = data.draw(draw_payload(layout))
    draws = random.Random(seed)
    for _ in range(60):
        changed = bytearray(payload)
        for _ in range(draws.choice((1, 1, 1, 2, 5))):
            place = draws.randrange(len(changed))
            match draws.randrange(4):
                case 0:
                    changed[place] ^= 1 << draws.randrange(8)
                case 1:
                    changed[place] = draws.choice((0x7F, 0x80, 0x90, 0xC0, 0xCF, 0xD3, 0xFF))
                case 2:
                    del changed[place]
                case _:
                    changed.insert(place, draws.randrange(256))
        records = index_payloads([bytes(changed)], layout)
        if records is None:
            continue
        try:
            decode(bytes(changed), State, READABLE, layout)
        except WireError as error:
            pytest.fail(f"a record was read that cannot be decoded: {error}")
        assert_equal_columns([bytes(changed)], records, layout)


GOOD = TickRecord(
    7, 7, Mode.RUN, *[[0.5] * count for count in Layout().lengths().values()], [6, 6], 5, [], []
)  # fmt: skip


def decode_good_record() -> dict[str, object]:
    payload = encode_state("m1", 1, PEERS, GOOD, [], 0, 0)
    return dict(msgspec.msgpack.decode(payload))


@pytest.mark.parametrize(
    "change",
    [
        {"v": 3},
        {"site": "m2"},
        {"boot": -1},
        {"tick": 2**40},
        {"tick": -1},
        {"t_ns": 2**63},
        {"mode": "walk"},
        {"mode": "ru"},
        {"q": [0.5]},
        {"q": [1, 2]},
        {"tau": [0.5, float("nan")]},
        {"mem": [float("inf")]},
        {"mem": [0.5] * 1038},
        {"used": {"m2": 1}},
        {"used": {PEERS[1]: 1, "m2": 1}},
        {"rx": [[0, 1]]},
        {"rx": [[0, 1, 2**59]]},
        {"rx": [[0, 1, 2**64 - 1]]},
        {"rx_crc": -1},
        {"cmd": ["ü"]},
        {"cmd": ["x" * 66_000]},
        {"sent_ns": 2**59},
        {"echo": [[0, 0, 0, 0]]},
        {"x": [0.5, 0.5]},
    ],
)
def test_an_unusual_record_is_left_to_the_decoders(change: dict[str, object]) -> None:
    good = msgspec.msgpack.encode(decode_good_record())
    assert index_payloads([good], Layout()) is not None
    unusual = msgspec.msgpack.encode({**decode_good_record(), **change})
    assert index_payloads([good, unusual], Layout()) is None


def test_reordered_fields_are_left_to_the_decoders() -> None:
    turned = dict(reversed(decode_good_record().items()))
    assert index_payloads([msgspec.msgpack.encode(turned)], Layout()) is None
