"""Messages on the wire: every finite number bit for bit, and invalid messages are refused."""

import json
import math
import struct
import subprocess
import sys
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.core.step.site_setup import Layout
from trilat_net.core.step.ticks import Arrival, Mode, TickRecord
from trilat_net.errors import WireError
from trilat_net.net.bus import BoundedRing
from trilat_net.net.messages import (
    MOST_PEERS,
    READABLE,
    TASK_VECTORS,
    VERSION,
    Event,
    Info,
    LinkStats,
    PeerSample,
    State,
    json_schema,
)
from trilat_net.net.requests import BACKFILL_BYTES, ChangeReply, ChangeRequest, Pong
from trilat_net.net.wire import (
    MAX_BYTES,
    MAX_INFO_BYTES,
    decode,
    encode,
    encode_sample,
    encode_state,
    join_states,
    read_messages,
    split_states,
)

from .parties import answer_info

STATE_VECTORS = Layout().lengths()

KINDS = (State, PeerSample, LinkStats, Event, Info, Pong, ChangeRequest, ChangeReply)
PEERS = ("m2", "s")
LIMITS = [
    0.0,
    -0.0,
    5e-324,
    -2.2e-308,
    math.pi,
    1.7976931348623157e308,
    -1.7976931348623157e308,
]

finite = st.one_of(st.sampled_from(LIMITS), st.floats(allow_nan=False, allow_infinity=False))
not_finite = st.sampled_from([math.nan, -math.nan, math.inf, -math.inf])
ticks = st.integers(0, 2**40 - 1)


def draw_row(length: int) -> st.SearchStrategy[list[float]]:
    return st.lists(finite, min_size=length, max_size=length)


outputs = st.builds(
    TickRecord,
    tick=ticks,
    t_ns=st.integers(0, 2**59 - 1),
    mode=st.sampled_from(Mode),
    used=st.lists(st.integers(-1, 2**40), min_size=2, max_size=2),
    rx_crc=st.integers(0, 2**32 - 1),
    cmd=st.lists(st.text(max_size=20), max_size=2),
    mem=st.lists(finite, max_size=3),
    ch=st.one_of(st.just(()), draw_row(3)),
    hand=st.one_of(st.just(()), draw_row(7)),
    bodies=st.one_of(st.just(()), draw_row(7)),
    **dict.fromkeys(TASK_VECTORS, st.just(())),
    **{name: draw_row(length) for name, length in STATE_VECTORS.items()},
)
arrivals = st.lists(
    st.builds(
        Arrival,
        st.integers(0, 1),
        ticks,
        draw_row(2),
        draw_row(2),
        st.integers(-(2**40), 2**40),
    )
)
boots = st.integers(0, 2**64 - 1)


def pack_numbers(numbers: Any) -> bytes:
    return struct.pack(f"<{len(numbers)}d", *numbers)


def make_state_payload(**changes: Any) -> bytes:
    vectors = {name: [0.5] * length for name, length in STATE_VECTORS.items()}
    output = TickRecord(
        tick=7, t_ns=7_000_000, mode=Mode.RUN, used=[-1, 3], rx_crc=1, cmd=[], mem=[], **vectors
    )
    record = msgpack.unpackb(
        encode_state("m1", 9, PEERS, output, [Arrival(1, 6, [0, 0], [0, 0], 2)], 0, 0)
    )
    return msgpack.packb({**record, **changes})


def make_sample_payload(**changes: Any) -> bytes:
    record = decode(make_state_payload(), State)
    fields = {name: getattr(record, name) for name in PeerSample.__struct_fields__}
    return msgpack.packb({**fields, **changes})


@settings(max_examples=40)
@given(output=outputs, arrivals_in=arrivals, boot=boots, late_us=st.integers(0, 2**40))
def test_records_return_bit_for_bit(
    output: TickRecord, arrivals_in: list[Arrival], boot: int, late_us: int
) -> None:
    data = encode_state("m1", boot, PEERS, output, arrivals_in, late_us, 12)
    state = decode(data, State)
    plain = msgpack.unpackb(data)
    for name in STATE_VECTORS:
        wanted = pack_numbers(getattr(output, name))
        assert pack_numbers(getattr(state, name)) == wanted
        assert pack_numbers(plain[name]) == wanted
    assert (state.tick, state.t_ns, state.boot) == (output.tick, output.t_ns, boot)
    assert state.mode == output.mode.name.lower() == plain["mode"]
    assert state.used == dict(zip(PEERS, output.used, strict=True)) == plain["used"]
    assert state.rx == [[a.peer, a.tick, a.latency_us] for a in arrivals_in] == plain["rx"]
    assert (state.rx_crc, state.late_us, state.busy_us) == (output.rx_crc, late_us, 12)


instants = st.integers(-(2**59), 2**59 - 1)


@settings(max_examples=30)
@given(
    output=outputs,
    sent_ns=instants,
    echo=st.lists(st.tuples(st.integers(0, 1), ticks, instants)),
)
def test_stamps_return_and_are_nominal_in_virtual_time(
    output: TickRecord, sent_ns: int, echo: list[tuple[int, int, int]]
) -> None:
    message = decode(encode_state("m1", 1, PEERS, output, [], 0, 0, sent_ns, echo), State)
    assert message.sent_ns == sent_ns
    assert [tuple(entry) for entry in message.echo] == echo
    virtual = decode(encode_state("m1", 1, PEERS, output, [], 0, 0), State)
    assert (virtual.sent_ns, virtual.echo) == (output.t_ns, [])


def test_version_1_records_are_read_in_files() -> None:
    record = msgpack.unpackb(make_state_payload(v=1))
    first = msgpack.packb(
        {name: record[name] for name in record if name not in ("sent_ns", "echo")}
    )
    assert decode(first, State, READABLE) == msgspec.structs.replace(
        decode(make_state_payload(sent_ns=0), State), v=1
    )
    with pytest.raises(WireError) as refused:
        decode(first, State)
    assert refused.value.reason == "version"
    assert VERSION in READABLE


pose = st.one_of(st.just(()), draw_row(3))


@settings(max_examples=40)
@given(
    output=outputs,
    task=st.tuples(pose, draw_row(3), draw_row(3)),
    echo=st.lists(st.tuples(ticks, ticks, instants), max_size=MOST_PEERS),
)
def test_sample_fields_equal_their_records(
    output: TickRecord,
    task: tuple[list[float], list[float], list[float]],
    echo: list[tuple[int, int, int]],
) -> None:
    if task[0]:
        output = output._replace(x=task[0], xd=task[1], wrench=task[2])
    small = decode(encode_sample("m1", 3, output, 77, echo), PeerSample)
    state = decode(encode_state("m1", 3, PEERS, output, [], 0, 0, 77, echo), State)
    for name in PeerSample.__struct_fields__:
        of_state = (
            {"q": "x", "qd": "xd", "tau_x": "wrench"}.get(name, name) if task[0] else name
        )
        ours = getattr(small, name)
        theirs = getattr(state, of_state)
        assert ours == theirs
        assert name not in ("q", "qd", "tau_x", "ch") or pack_numbers(ours) == pack_numbers(
            theirs
        )
    assert pack_numbers(state.ch) == pack_numbers(output.ch)
    assert b"wrench" in encode_state("m1", 3, PEERS, output, [], 0, 0) or not task[0]


@given(st.lists(st.integers(0, 20_000), min_size=1, max_size=12))
def test_blocks_hold_unchanged_records_in_order(sizes: list[int]) -> None:
    records = [make_state_payload(tick=n, cmd=["x" * size]) for n, size in enumerate(sizes)]
    blocks = list(join_states(records))
    assert [state for block in blocks for state in split_states(block)] == records
    assert all(len(block) <= max(BACKFILL_BYTES, *map(len, records)) for block in blocks)
    assert list(split_states(records[0])) == [records[0]]


@given(st.integers(1, 3), st.integers(1, 200))
def test_cut_blocks_keep_earlier_records(whole: int, cut: int) -> None:
    records = [make_state_payload(tick=n) for n in range(whole)]
    states = split_states(b"".join([*records, make_state_payload()[:cut]]))
    assert [next(states) for _ in records] == records
    with pytest.raises(WireError, match="malformed"):
        next(states)


@pytest.mark.parametrize("block", [b"", bytes(MAX_BYTES + 1), b"\xc1", b"\x91" * 10_000])
def test_an_invalid_block_is_refused(block: bytes) -> None:
    with pytest.raises(WireError):
        list(split_states(block))


@settings(max_examples=30)
@given(output=outputs, arrivals_in=arrivals)
def test_msgspec_and_msgpack_agree(output: TickRecord, arrivals_in: list[Arrival]) -> None:
    """Either library reads the other's bytes."""
    state = decode(encode_state("m1", 1, PEERS, output, arrivals_in, 0, 0), State)
    again = decode(msgspec.msgpack.encode(state), State)
    assert all(
        pack_numbers(getattr(again, name)) == pack_numbers(getattr(state, name))
        for name in STATE_VECTORS
    )
    assert again.rx == state.rx


@settings(max_examples=40)
@given(outputs, st.sampled_from(sorted(STATE_VECTORS)), not_finite, st.integers(0, 1))
def test_infinite_numbers_are_refused_at_both_ends(
    output: TickRecord, name: str, value: float, entry: int
) -> None:
    numbers = [*getattr(output, name)]
    numbers[entry] = value
    with pytest.raises(WireError) as refused:
        encode_state("m1", 1, PEERS, output._replace(**{name: numbers}), [], 0, 0)
    assert refused.value.reason == "not finite"
    record = msgpack.unpackb(encode_state("m1", 1, PEERS, output, [], 0, 0))
    data = msgpack.packb({**record, name: numbers})
    small = {field: record[field] for field in PeerSample.__struct_fields__ if field in record}
    kinds = {State: data} | (
        {PeerSample: msgpack.packb({**small, name: numbers})} if name in small else {}
    )
    for kind, bad in kinds.items():
        with pytest.raises(WireError) as refused:
            decode(bad, kind)
        assert refused.value.reason == "not finite"
    if name in small:
        with pytest.raises(WireError) as refused:
            encode_sample("m1", 1, output._replace(**{name: numbers}), 0, [])
        assert refused.value.reason == "not finite"


@pytest.mark.parametrize("count", [0, 1, 3])
def test_laws_send_their_declared_finite_numbers(count: int) -> None:
    numbers = [0.5] * count
    for kind, data in {
        State: make_state_payload(ch=numbers),
        PeerSample: make_sample_payload(ch=numbers),
    }.items():
        assert decode(data, kind, layout=Layout(sent=count)).ch == numbers
        with pytest.raises(WireError, match=rf"ch has {count} numbers?, not {count + 1}"):
            decode(data, kind, layout=Layout(sent=count + 1))
    output = decode(make_state_payload(), State)
    output = TickRecord(
        7, 0, Mode.RUN, *[output.q] * 6, output.theta_hat, [], 0, [], [], ch=[math.inf]
    )
    with pytest.raises(WireError, match="not finite"):
        encode_sample("m1", 1, output, 0, [])
    with pytest.raises(WireError, match="not finite"):
        decode(make_sample_payload(ch=[math.nan]), PeerSample)


@pytest.mark.parametrize("name", sorted(STATE_VECTORS))
@pytest.mark.parametrize("off", [-1, 1])
def test_a_vector_of_another_length_is_refused(name: str, off: int) -> None:
    with pytest.raises(WireError, match=f"{name} has"):
        decode(
            make_state_payload(**{name: [0.0] * (STATE_VECTORS[name] + off)}),
            State,
            layout=Layout(),
        )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"v": VERSION + 1}, "version"),
        ({"v": 0}, "version"),
        ({"v": "1"}, "malformed"),
        ({"tick": -1}, "malformed"),
        ({"tick": 2**40}, "malformed"),
        ({"tick": 1.5}, "malformed"),
        ({"boot": -1}, "malformed"),
        ({"q": "text"}, "malformed"),
        ({"q": [0.0, "1"]}, "malformed"),
        ({"q": [0.0, None]}, "malformed"),
        ({"rx": [[0, 1]]}, "malformed"),
        ({"rx": [[0, 1, 2, 3]]}, "malformed"),
        ({"used": {"m2": 0.5}}, "malformed"),
        ({"stranger": 1}, "malformed"),
        ({"sent_ns": 2**59}, "malformed"),
        ({"echo": [[0, 1, 2**60]]}, "malformed"),
        ({"echo": [[0, 1]]}, "malformed"),
    ],
)
def test_invalid_records_are_refused_by_reason(changes: dict[str, Any], reason: str) -> None:
    of_both = changes.keys() <= {*PeerSample.__struct_fields__, "stranger"}
    for kind, data in (
        (State, make_state_payload(**changes)),
        (PeerSample, make_sample_payload(**changes)),
    )[: 1 + of_both]:
        with pytest.raises(WireError) as refused:
            decode(data, kind)
        assert refused.value.reason == reason


@pytest.mark.parametrize("kind", KINDS)
def test_oversized_payloads_are_refused_unread(kind: type) -> None:
    limit = MAX_INFO_BYTES if kind is Info else MAX_BYTES
    with pytest.raises(WireError) as refused:
        decode(b"\xc1" * (limit + 1), kind)
    assert refused.value.reason == "oversized"


def only_wire_errors(data: bytes) -> None:
    """Asserts that bytes of any kind are decoded whole or raise `WireError`."""
    for kind in KINDS:
        try:
            message = decode(data, kind)
        except WireError:
            continue
        assert message.v == VERSION


@given(data=st.binary(max_size=300))
def test_random_bytes_raise_wire_errors_only(data: bytes) -> None:
    only_wire_errors(data)


def test_a_truncated_record_is_refused() -> None:
    data = make_state_payload()
    for end in range(len(data)):
        with pytest.raises(WireError):
            decode(data[:end], State)


@given(
    st.lists(
        st.tuples(st.integers(0, len(make_state_payload()) - 1), st.integers(0, 255)),
        min_size=1,
        max_size=4,
    )
)
def test_a_mutated_record_raises_wire_errors_only(changes: list[tuple[int, int]]) -> None:
    data = bytearray(make_state_payload())
    for at, byte in changes:
        data[at] = byte
    only_wire_errors(bytes(data))


@given(
    st.recursive(
        st.none()
        | st.booleans()
        | st.integers(-(2**63), 2**64 - 1)
        | st.floats()
        | st.text()
        | st.binary(),
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.dictionaries(st.text(max_size=6), inner, max_size=4)
        ),
        max_leaves=12,
    )
)
def test_any_other_messagepack_raises_wire_errors_only(value: Any) -> None:
    only_wire_errors(msgpack.packb(value))
    only_wire_errors(make_state_payload(q=value))


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1q", b"\xdc\x00\x01"])
def test_deep_nesting_is_refused(opening: bytes) -> None:
    only_wire_errors(opening * (MAX_BYTES // len(opening)))
    data = make_sample_payload(stranger=0)[:-1] + opening * 10_000 + b"\xc0"
    only_wire_errors(data)
    with pytest.raises(WireError):
        decode(data, PeerSample)


def test_false_lengths_are_refused() -> None:
    for head in (kind + b"\xff" * 4 for kind in (b"\xdf", b"\xdd", b"\xdb", b"\xc6")):
        only_wire_errors(head)
        only_wire_errors(make_state_payload(q=0)[:-1] + head)


@given(
    kind=st.text(max_size=20),
    text=st.text(max_size=200),
    boot=boots,
    others=st.dictionaries(st.text(max_size=8), boots, max_size=3),
)
def test_events_return(kind: str, text: str, boot: int, others: dict[str, int]) -> None:
    event = Event(
        member="m1", boot=boot, kind=kind, text=text, boots=others, epoch_mono_ns=2**58
    )
    assert decode(encode(event), Event) == event


@given(
    counts=st.dictionaries(st.sampled_from(PEERS), st.integers(-1, 2**40)),
    boot=boots,
    tick=ticks,
)
def test_statistics_and_infos_return(counts: dict[str, int], boot: int, tick: int) -> None:
    facts = {"v": VERSION, "site": "m1", "boot": boot, "tick": tick, "t_ns": 5, "mode": "run"}
    each = (
        "age_us",
        "accepted",
        "late",
        "duplicate",
        "refused",
        "dropped",
        "offset_us",
        "bound_us",
    )
    whole = {
        "late_max_us": 1,
        "busy_max_us": 2,
        "overruns": 3,
        "grid_error_us": -4,
        "slew_ppb": 5,
    }
    stats = LinkStats(**facts, **dict.fromkeys((*each, "delay_us"), counts), **whole)
    assert decode(encode(stats), LinkStats) == stats
    info = answer_info("s", boot)
    assert decode(encode(info), Info) == info


@pytest.mark.parametrize("kind", KINDS)
def test_json_schemas_are_objects_naming_every_field(
    kind: type[msgspec.Struct],
) -> None:
    """The form that viewers accept: an object at the root, no reference out of it, plain JSON."""
    schema = json_schema(kind)
    assert schema["type"] == "object"
    assert set(schema["properties"]) == set(kind.__struct_fields__)
    text = json.dumps(schema)
    assert json.loads(text) == schema
    assert "$ref" not in text
    assert "$id" not in text


def test_json_schemas_have_units() -> None:
    schema = json_schema(State)
    assert schema["properties"]["q"]["x-unit"] == "rad"
    assert schema["properties"]["tau"]["x-unit"] == "N m"


@pytest.mark.long
def test_schemas_are_equal_without_docstrings() -> None:
    """`python -OO` removes docstrings; a log has its schemas in its text and in its digests."""
    kinds = (State, LinkStats, Event)
    program = (
        "import json\nfrom trilat_net.net.messages import Event, LinkStats, State, json_schema\n"
        "print(json.dumps([json_schema(kind) for kind in (State, LinkStats, Event)]))"
    )
    done = subprocess.run(
        [sys.executable, "-OO", "-c", program], capture_output=True, check=True
    )
    assert json.loads(done.stdout) == [json_schema(kind) for kind in kinds]


def test_waiting_records_are_read_despite_strangers() -> None:
    ring: BoundedRing[tuple[str, bytes]] = BoundedRing(9)
    first = make_state_payload(tick=1)
    two = make_state_payload(tick=2)
    bad = b"\xc1"
    for sent in (first + two, b"no record", first + bad + two, b"", two):
        ring.put(("t/m1/state", sent))
    assert [record.tick for record in read_messages(ring, State)] == [1, 2, 1, 2]
