"""Encoding and decoding of messages.

Invariant: decoding never trusts its input. A payload yields a message of this schema version with finite
numbers in range, or a `WireError` whose reason is counted; encoding refuses what decoding would.

Payloads are MessagePack maps with string keys and plain lists, encoded by `msgpack` and decoded by
`msgspec` straight into the types of `messages` and `requests`.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter
from typing import Any, TypeVar, get_args

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
"""Largest message; largest `Info`, which holds a whole scenario with its traces; largest `Backfill`."""

_Sent = (
    LinkStats
    | Event
    | Info
    | RecorderStats
    | Pong
    | ChangeRequest
    | ChangeReply
    | BackfillRequest
    | Backfill
    | ArmMeasurement
)
_pack = msgpack.Packer().pack
_DECODERS: dict[type[msgspec.Struct], msgspec.msgpack.Decoder[Any]] = {
    kind: msgspec.msgpack.Decoder(kind) for kind in (State, PeerSample, *get_args(_Sent))
}
_LIMITS: dict[type[msgspec.Struct], int] = {Info: MAX_INFO_BYTES, Backfill: MAX_PAST_BYTES}
_isfinite = math.isfinite


def _vector_check(
    lengths: Mapping[str, int],
) -> tuple[tuple[str, ...], Callable[[Any], Any], tuple[int, ...]]:
    return tuple(lengths), attrgetter(*lengths), tuple(lengths.values())


_CHECKS = {
    PeerSample: _vector_check(SAMPLE_VECTORS),
    State: _vector_check(STATE_VECTORS),
    ArmMeasurement: _vector_check(MEASUREMENT_VECTORS),
}


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
        arrivals: the samples that the tick took in.
        late_us: wake-up minus deadline, us.
        busy_us: computing time of the tick before, us.
        sent_ns: time of sending, ns since the epoch on the own clock; None in virtual time: nominal.
        echo: newest sample of each peer: (index of the peer, its tick, arrival as `sent_ns`).

    Raises:
        WireError: a number is not finite.
    """
    (tick, t_ns, mode, q, qd, q_des, qd_des, tau, tau_x, theta_hat, used, rx_crc, cmd, mem) = output
    numbers = [*q, *qd, *q_des, *qd_des, *tau, *tau_x, *theta_hat, *mem]
    # a sum is finite only if its terms are; the second check is for finite terms whose sum overflows
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


def encode(message: _Sent) -> bytes:
    """Returns the payload of any message but a `State`."""
    packed: bytes = _pack(msgspec.structs.asdict(message))
    return packed


M = TypeVar("M", bound=msgspec.Struct)


def decode(payload: bytes, kind: type[M], versions: Collection[int] = (VERSION,)) -> M:
    """Returns the message of a payload.

    Args:
        payload: the bytes received.
        kind: the type that the key promises.
        versions: accepted schema versions: one from the network, `messages.READABLE` from a file.

    Raises:
        WireError: it is oversized, malformed, of another version, not finite, or of the wrong length.
    """
    limit = _LIMITS.get(kind, MAX_BYTES)
    if len(payload) > limit:
        raise WireError("oversized", f"{len(payload)} bytes, at most {limit}")
    try:
        message: Any = _DECODERS[kind].decode(payload)
    except (ValueError, RecursionError) as error:
        raise WireError("malformed", str(error)) from None
    if message.v not in versions:
        raise WireError("version", f"schema version {message.v}, this is {VERSION}")
    check = _CHECKS.get(kind)
    if check is not None:
        names, vectors_of, lengths = check
        vectors = vectors_of(message)
        # a sum is finite only if its terms are; finite terms whose sum overflows pass the second check
        if tuple(map(len, vectors)) != lengths or not _isfinite(sum(map(sum, vectors))):
            _check_vectors(message, names, vectors, lengths)
    return message  # type: ignore[no-any-return]


def _check_vectors(
    message: Any, names: Sequence[str], vectors: Sequence[list[float]], lengths: Sequence[int]
) -> None:
    """Refuses vectors of the wrong length and numbers that are not finite."""
    for name, vector, length in zip(names, vectors, lengths, strict=True):
        if len(vector) != length:
            raise WireError("malformed", f"{name} has {len(vector)} numbers, not {length}")
        if not all(map(_isfinite, vector)):
            number = message.n if isinstance(message, ArmMeasurement) else message.tick
            raise WireError("not finite", f"{name} of {message.site} at {number}")
