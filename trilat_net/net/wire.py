"""Encoding and decoding of messages.

Invariant: decoding never trusts its input. A payload yields a message of this schema version
with finite numbers in range, or a `WireError` whose reason is counted; encoding refuses what
decoding would.

Payloads are MessagePack maps with string keys and plain lists, as the types of `messages` and
`requests`.
"""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, TypeVar

import msgpack
import msgspec

from ..core.chain import MAX_JOINTS
from ..core.site_setup import Layout
from ..core.ticks import Arrival, TickRecord
from ..errors import WireError, count_nouns
from .messages import (
    MODE_WORDS,
    STATE_VECTORS,
    VERSION,
    Event,
    Info,
    LinkStats,
    PeerSample,
    RecorderStats,
    State,
)
from .requests import BACKFILL_BYTES, ArmMeasurement, Backfill, HandMessage, Request

MAX_BYTES = 65_536
MAX_INFO_BYTES = 64 * 1024 * 1024
MAX_PAST_BYTES = 2 * MAX_BYTES
"""Largest message; largest `Info`, which holds a whole scenario with its traces; largest
`Backfill`.
"""
SAMPLE_BYTES = 2_048
NUMBER_BYTES = 9
"""Of a sample, besides its vectors; of one of their numbers."""

_Sent = LinkStats | Event | Info | RecorderStats | Request
_KINDS: list[type[msgspec.Struct]] = [State, PeerSample, LinkStats, Event, Info, RecorderStats]
_DECODERS = {
    kind: msgspec.msgpack.Decoder(kind) for kind in [*_KINDS, *Request.__subclasses__()]
}
_LIMITS: dict[type[msgspec.Struct], int] = {Info: MAX_INFO_BYTES, Backfill: MAX_PAST_BYTES}
_isfinite = math.isfinite
_encode = msgspec.msgpack.Encoder().encode


@cache
def _vectors(kind: type[msgspec.Struct], layout: Layout) -> dict[str, int]:
    if kind is State:
        return dict.fromkeys(STATE_VECTORS, 0) | layout.lengths()
    if kind is PeerSample:
        return dict.fromkeys(("q", "qd", "tau_x"), layout.shared) | {"ch": layout.sent}
    if kind is HandMessage:
        # its receiver knows which of them it takes
        return dict.fromkeys(("target", "force"), 0)
    return dict.fromkeys(("q", "qd"), layout.joints) if kind is ArmMeasurement else {}


def encode_state(
    site: str,
    boot: int,
    peers: Sequence[str],
    output: TickRecord,
    arrivals: Sequence[Arrival],
    late_us: int,
    busy_us: int,
    sent_ns: int | None = None,
    echo: Sequence[Sequence[int]] = (),
) -> bytes:
    """Returns the payload of one record.

    The arguments are the fields of `State`. Without `sent_ns`, in virtual time, it is the
    nominal time.

    Raises:
        WireError: a number is not finite.
    """
    (
        tick,
        t_ns,
        mode,
        q,
        qd,
        q_des,
        qd_des,
        tau,
        tau_x,
        theta_hat,
        used,
        rx_crc,
        cmd,
        mem,
        *task,
    ) = output
    x, xd, wrench, ch, hand, bodies = task
    vectors = (q, qd, q_des, qd_des, tau, tau_x, theta_hat, mem, *task)
    # a sum is finite only if its terms are; the second check is for finite terms whose sum overflows
    if not _isfinite(sum(map(sum, vectors))) and not all(
        map(_isfinite, chain.from_iterable(vectors))
    ):
        raise WireError("not finite", f"{site} at tick {tick}")
    fields = {
        "v": VERSION,
        "site": site,
        "boot": boot,
        "tick": tick,
        "t_ns": t_ns,
        "mode": MODE_WORDS[mode],
        "q": q,
        "qd": qd,
        "q_des": q_des,
        "qd_des": qd_des,
        "tau": tau,
        "tau_x": tau_x,
        "theta_hat": theta_hat,
        "used": dict(zip(peers, used, strict=True)),
        "rx": [(a.peer, a.tick, a.latency_us) for a in arrivals],
        "rx_crc": rx_crc,
        "cmd": cmd,
        "mem": mem,
        "late_us": late_us,
        "busy_us": busy_us,
        "sent_ns": t_ns if sent_ns is None else sent_ns,
        "echo": echo,
    }
    if x:
        fields |= {"x": x, "xd": xd, "wrench": wrench}
    if ch:
        fields["ch"] = ch
    if hand:
        fields["hand"] = hand
    if bodies:
        fields["bodies"] = bodies
    return _encode(fields)


def encode_sample(
    site: str, boot: int, output: TickRecord, sent_ns: int, echo: Sequence[Sequence[int]]
) -> bytes:
    """Returns the payload of a tick's `PeerSample`; the arguments are those of `encode_state`.

    Raises:
        WireError: a number is not finite.
    """
    (q, qd, tau_x) = output.shared()
    ch = output.ch
    total = sum(q) + sum(qd) + sum(tau_x) + sum(ch)
    if not _isfinite(total) and not all(map(_isfinite, [*q, *qd, *tau_x, *ch])):
        raise WireError("not finite", f"{site} at tick {output.tick}")
    fields = {
        "v": VERSION,
        "site": site,
        "boot": boot,
        "tick": output.tick,
        "q": q,
        "qd": qd,
        "tau_x": tau_x,
        "sent_ns": sent_ns,
        "echo": echo,
    }
    return _encode({**fields, "ch": ch} if ch else fields)


def join_states(payloads: Sequence[bytes]) -> Iterator[bytes]:
    """Yields blocks of records, one record behind the other, no longer than an answer of a
    site's buffer.
    """
    block: list[bytes] = []
    size = 0
    for payload in payloads:
        if block and size + len(payload) > BACKFILL_BYTES:
            yield b"".join(block)
            block = []
            size = 0
        block.append(payload)
        size += len(payload)
    if block:
        yield b"".join(block)


def split_states(block: bytes) -> Iterator[bytes]:
    """Yields the payloads of a block, which are not yet checked.

    Raises:
        WireError: the block is oversized, or ends in the middle of a record.
    """
    if len(block) > MAX_BYTES:
        raise WireError("oversized", f"{count_nouns(len(block), 'byte')}, at most {MAX_BYTES}")
    unpacker = msgpack.Unpacker(max_buffer_size=MAX_BYTES)
    unpacker.feed(block)
    start = 0
    while start < len(block) or not block:
        try:
            unpacker.skip()
        except (msgpack.UnpackException, ValueError) as error:
            raise WireError("malformed", f"a block of records: {error}") from None
        end = unpacker.tell()
        yield block[start:end]
        start = end


def encode(message: _Sent) -> bytes:
    """Returns the payload of any message but a `State`."""
    return _encode(message)


M = TypeVar("M", bound=msgspec.Struct)


def decode(
    payload: bytes,
    kind: type[M],
    versions: Collection[int] = (VERSION,),
    layout: Layout | None = None,
) -> M:
    """Returns the message of a payload, of the present schema version or of those that a file
    may have.

    Without the `layout` of its sender vectors may have any length.

    Raises:
        WireError: it is oversized, malformed, of another version, not finite, or of the wrong
            length.
    """
    return make_decoder(kind, tuple(versions), layout)(payload)  # type: ignore[no-any-return]


@cache
def make_decoder(
    kind: type[msgspec.Struct],
    versions: tuple[int, ...] = (VERSION,),
    layout: Layout | None = None,
) -> Callable[[bytes], Any]:
    """Returns `decode` for one kind of message, with all that it needs at hand."""
    limit = _LIMITS.get(kind, MAX_BYTES)
    parse = _DECODERS[kind].decode
    if kind is PeerSample and layout is not None:  # thousands may wait
        limit = SAMPLE_BYTES + NUMBER_BYTES * (3 * layout.shared + layout.sent)
    names = _vectors(kind, layout or Layout())
    vectors_of = attrgetter(*names) if names else None
    lengths = list(names.values()) if layout else None

    def read(payload: bytes) -> Any:
        if len(payload) > limit:
            raise WireError(
                "oversized", f"{count_nouns(len(payload), 'byte')}, at most {limit}"
            )
        try:
            message: Any = parse(payload)
        except (ValueError, RecursionError) as error:
            raise WireError("malformed", str(error)) from None
        if message.v not in versions:
            raise WireError("version", f"schema version {message.v}, this is {VERSION}")
        if vectors_of is not None:
            vectors = vectors_of(message)
            if lengths is not None and [*map(len, vectors)] != lengths:
                _check_lengths(vectors, names)
            # a sum is finite only if its terms are; finite terms whose sum overflows pass the second check
            if not _isfinite(sum(map(sum, vectors))):
                for name, vector in zip(names, vectors, strict=True):
                    if not all(map(_isfinite, vector)):
                        number = (
                            message.n if kind in (ArmMeasurement, HandMessage) else message.tick
                        )
                        raise WireError("not finite", f"{name} of {message.site} at {number}")
        return message

    return read


def make_reader(
    kind: type[msgspec.Struct], layout: Layout
) -> Callable[[bytes], Any | WireError]:
    """Returns a decoder that returns its error: for threads of the bus, in which nothing may be
    raised.
    """
    decoder = make_decoder(kind, layout=layout)

    def read(payload: bytes) -> Any | WireError:
        try:
            return decoder(payload)
        except WireError as error:
            return error

    return read


def _check_lengths(vectors: tuple[list[float], ...], lengths: dict[str, int]) -> None:
    for vector, (name, length) in zip(vectors, lengths.items(), strict=True):
        if (count := len(vector)) != length:
            joints = name == "q" and 1 <= count <= MAX_JOINTS  # so that reasons are few
            reason = (
                f"of {count_nouns(count, 'joint')}; the scenario has {length}"
                if joints
                else "malformed"
            )
            raise WireError(reason, f"{name} has {count_nouns(count, 'number')}, not {length}")
