"""Encoding and decoding of messages.

Invariant: decoding never trusts its input. A payload yields a message of this schema version with finite
numbers in range, or a `WireError` whose reason is counted; encoding refuses what decoding would.

Payloads are MessagePack maps with string keys and plain lists, encoded by `msgpack` and decoded by
`msgspec` straight into the types of `messages` and `requests`.
"""

import math
from collections.abc import Collection, Sequence
from operator import attrgetter
from typing import Any, TypeVar

import msgpack
import msgspec

from ..core.ticks import Arrival, TickRecord
from ..errors import WireError
from .messages import (
    SAMPLE_VECTORS,
    STATE_VECTORS,
    VERSION,
    Event,
    Info,
    LinkStats,
    PeerSample,
    RecorderStats,
    State,
)
from .requests import (
    MEASUREMENT_VECTORS,
    ArmMeasurement,
    Backfill,
    BackfillRequest,
    ChangeReply,
    ChangeRequest,
    Pong,
)

MAX_BYTES = 65_536
MAX_INFO_BYTES = 64 * 1024 * 1024
MAX_PAST_BYTES = 2 * MAX_BYTES
"""Most bytes of a message; of an `Info`, which holds a whole scenario, traces and all; of a `Past`, which
holds messages."""

_pack = msgpack.Packer().pack
_DECODERS: dict[type[msgspec.Struct], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind)
    for kind in (
        *(State, PeerSample, LinkStats, Event, Info, RecorderStats),
        *(Pong, ChangeRequest, ChangeReply, BackfillRequest, Backfill, ArmMeasurement),
    )
}
_LIMITS: dict[type[msgspec.Struct], int] = {Info: MAX_INFO_BYTES, Backfill: MAX_PAST_BYTES}
_isfinite = math.isfinite

_SAMPLE_CHECK = (tuple(SAMPLE_VECTORS), attrgetter(*SAMPLE_VECTORS), tuple(SAMPLE_VECTORS.values()))
_STATE_CHECK = (tuple(STATE_VECTORS), attrgetter(*STATE_VECTORS), tuple(STATE_VECTORS.values()))
_MEASUREMENT_CHECK = (
    tuple(MEASUREMENT_VECTORS),
    attrgetter(*MEASUREMENT_VECTORS),
    tuple(MEASUREMENT_VECTORS.values()),
)


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

    Args:
        site: the site's name.
        boot: its process start.
        peers: its peers in scenario order.
        output: the record.
        arrivals: what the tick took in.
        late_us: wake-up minus deadline, us.
        busy_us: computing time of the tick before, us.
        sent_ns: when it is sent, ns since the epoch on the own clock; None in virtual time: as nominal.
        echo: of each peer the newest sample that came: (index of the peer, its tick, arrival as `sent_ns`).

    Raises:
        WireError: a number is not finite.
    """
    (tick, t_ns, mode, q, qd, q_des, qd_des, tau, tau_x, theta_hat, used, rx_crc, cmd, mem) = output
    numbers = [*q, *qd, *q_des, *qd_des, *tau, *tau_x, *theta_hat, *mem]
    # a sum is finite only if its terms are; the second look is for terms whose sum overflows
    if not _isfinite(sum(numbers)) and not all(map(_isfinite, numbers)):
        raise WireError("not finite", f"{site} at tick {tick}")
    packed: bytes = _pack(
        {
            "v": VERSION,
            "site": site,
            "boot": boot,
            "tick": tick,
            "t_ns": t_ns,
            "mode": mode.name.lower(),
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
    )
    return packed


def encode(
    message: LinkStats
    | Event
    | Info
    | RecorderStats
    | Pong
    | ChangeRequest
    | ChangeReply
    | BackfillRequest
    | Backfill
    | ArmMeasurement,
) -> bytes:
    """Returns the payload of any message but a `State`."""
    packed: bytes = _pack(msgspec.structs.asdict(message))
    return packed


M = TypeVar(
    "M",
    State,
    PeerSample,
    LinkStats,
    Event,
    Info,
    RecorderStats,
    Pong,
    ChangeRequest,
    ChangeReply,
    BackfillRequest,
    Backfill,
    ArmMeasurement,
)


def decode(payload: bytes, kind: type[M], versions: Collection[int] = (VERSION,)) -> M:
    """Returns the message that a payload holds.

    Args:
        payload: as it came.
        kind: the type that the key promises.
        versions: schema versions that are accepted: one from others, `messages.READABLE` from a file.

    Raises:
        WireError: it is oversized, malformed, of another version, not finite, or of the wrong length.
    """
    limit = _LIMITS.get(kind, MAX_BYTES)
    if len(payload) > limit:
        raise WireError("oversized", f"{len(payload)} bytes, at most {limit}")
    try:
        message: M = _DECODERS[kind].decode(payload)
    except (ValueError, RecursionError) as error:
        raise WireError("malformed", str(error)) from None
    if message.v not in versions:
        raise WireError("version", f"schema version {message.v}, this is {VERSION}")
    if isinstance(message, PeerSample | State | ArmMeasurement):
        _check_numbers(message)
    return message


def _check_numbers(message: PeerSample | State | ArmMeasurement) -> None:
    """Refuses vectors of the wrong length and numbers that are not finite."""
    if isinstance(message, ArmMeasurement):
        fields, vectors_of, lengths = _MEASUREMENT_CHECK
        number = message.n
    else:
        fields, vectors_of, lengths = _STATE_CHECK if isinstance(message, State) else _SAMPLE_CHECK
        number = message.tick
    vectors = vectors_of(message)
    # a sum is finite only if its terms are; what follows is for the message that fails, and for finite
    # terms whose sum overflows
    if tuple(map(len, vectors)) == lengths and _isfinite(sum(map(sum, vectors))):
        return
    for name, vector, length in zip(fields, vectors, lengths, strict=True):
        if len(vector) != length:
            raise WireError("malformed", f"{name} has {len(vector)} numbers, not {length}")
        if not all(map(_isfinite, vector)):
            raise WireError("not finite", f"{name} of {message.site} at {number}")
