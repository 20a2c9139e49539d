"""Encodes messages to bytes, and decodes and checks bytes from the network or from a log.

The bytes of a message are a MessagePack map with the field names as keys. The fields are
defined by the classes in `messages` and `requests`. The two messages that a site publishes in
every tick, the record and the sample, are encoded directly from the output of the simulation
kernel, which is faster than creating a message object first.

Invariant:
    - The decoder does not trust its input, because any program on the network can send
      messages. Each payload yields either a valid message of an accepted schema version, with
      all values finite and within their ranges, or a `WireError`.
    - The reason of a `WireError` is one of a small set of short strings. Receivers count
      dropped payloads per reason.
    - Records and samples that contain non-finite values are not encoded, since receivers would
      reject them.
"""

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from functools import cache
from itertools import chain
from operator import attrgetter
from typing import Any, TypeVar

import msgpack
import msgspec

from ..errors import WireError, count_nouns
from ..records import MAX_JOINTS, Arrival, Layout, TickRecord
from .bus import Inbox
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
from .requests import BACKFILL_BYTES, ArmMeasurement, Backfill, DirectMessage, HandMessage

MAX_BYTES = 65_536
"""Maximum payload of a message, in bytes. `Info` and `Backfill` may be larger."""
MAX_INFO_BYTES = 64 * 1024 * 1024
"""Maximum payload of an `Info`, in bytes. It contains a scenario with its recorded delays."""
_MAX_PAST_BYTES = 2 * MAX_BYTES
"""Maximum payload of a `Backfill`, in bytes."""
SAMPLE_BYTES = 2_048
"""Maximum size of a `PeerSample`, excluding the elements of its vectors, in bytes."""
_NUMBER_BYTES = 9
"""Size of an encoded floating-point number, in bytes."""

_Sendable = LinkStats | Event | Info | RecorderStats | DirectMessage
_MESSAGE_KINDS: list[type[msgspec.Struct]] = [
    State,
    PeerSample,
    LinkStats,
    Event,
    Info,
    RecorderStats,
]
_DECODERS = {
    kind: msgspec.msgpack.Decoder(kind)
    for kind in [*_MESSAGE_KINDS, *DirectMessage.__subclasses__()]
}
_SIZE_LIMITS: dict[type[msgspec.Struct], int] = {
    Info: MAX_INFO_BYTES,
    Backfill: _MAX_PAST_BYTES,
}
"""Maximum payloads of the messages that may exceed `MAX_BYTES`."""
_isfinite = math.isfinite
_encode = msgspec.msgpack.Encoder().encode


@cache
def _list_vector_lengths(kind: type[msgspec.Struct], layout: Layout) -> dict[str, int]:
    """Returns a mapping from each vector field of a message type to its length for a site.

    Args:
        kind: The message type.
        layout: Numbers of joints, peers and parameters of the site that sends the message.
    """
    if kind is State:
        # Vectors that the layout does not mention must be absent.
        return dict.fromkeys(STATE_VECTORS, 0) | layout.lengths()
    if kind is PeerSample:
        return dict.fromkeys(("q", "qd", "tau_x"), layout.shared) | {"ch": layout.sent}
    if kind is HandMessage:
        # The lengths are not checked here: the receiver knows which of the vectors it reads.
        return dict.fromkeys(("target", "force"), 0)
    if kind is ArmMeasurement:
        return dict.fromkeys(("q", "qd"), layout.joints)
    return {}


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
    """Encodes the result of one tick as a `State` (the record that is stored in the log).

    Args:
        site: Name of the site.
        boot: Random number that identifies this start of the site's process.
        peers: Names of the site's peers, in the order of `used` in the output.
        output: Result of the tick, as computed by the simulation kernel.
        arrivals: Samples that the tick used as inputs, in order of arrival.
        late_us: Lateness of the beginning of the tick, in us.
        busy_us: Computing time of the previous tick, in us.
        sent_ns: Time of sending, in ns since the epoch (the common start of the session) on the
            site's clock. If None, the nominal time of the tick is used, as in simulations.
        echo: Newest sample received from each peer, from which the peer can measure the delay
            to this site, see `State.echo`.

    Returns:
        The payload of the message.

    Raises:
        WireError: A value is not finite.
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
        *optional_vectors,
    ) = output
    x, xd, wrench, ch, hand, bodies = optional_vectors
    vectors = (q, qd, q_des, qd_des, tau, tau_x, theta_hat, mem, *optional_vectors)
    # A sum is finite only if all of its terms are, and one sum is faster than a check of each
    # term. The terms are checked one by one only if the sum is not finite, since the sum of
    # finite terms may overflow.
    if not _isfinite(sum(map(sum, vectors))):
        numbers = chain.from_iterable(vectors)
        if not all(map(_isfinite, numbers)):
            raise WireError("not finite", f"a value of {site} at tick {tick} is not finite")

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
        "rx": [(arrival.peer, arrival.tick, arrival.latency_us) for arrival in arrivals],
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
    site: str,
    boot: int,
    output: TickRecord,
    sent_ns: int,
    echo: Sequence[Sequence[int]],
) -> bytes:
    """Encodes the sample with which a site publishes its state in one tick to its peers.

    The sample is shorter than the record of the same tick, because it contains only what the
    peers need.

    Args:
        site: Name of the site.
        boot: Random number that identifies this start of the site's process.
        output: Result of the tick, as computed by the simulation kernel.
        sent_ns: Time of sending, in ns since the epoch (the common start of the session) on the
            site's clock.
        echo: Newest sample received from each peer, from which the peer can measure the delay
            to this site, see `State.echo`.

    Returns:
        The payload of a `PeerSample`.

    Raises:
        WireError: A value is not finite.
    """
    (q, qd, tau_x) = output.shared()
    ch = output.ch
    total = sum(q) + sum(qd) + sum(tau_x) + sum(ch)
    # As in `encode_state`, the terms are checked only if their sum is not finite.
    if not _isfinite(total) and not all(map(_isfinite, [*q, *qd, *tau_x, *ch])):
        raise WireError("not finite", f"a value of {site} at tick {output.tick} is not finite")

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
    if ch:
        fields["ch"] = ch
    return _encode(fields)


def join_states(payloads: Sequence[bytes]) -> Iterator[bytes]:
    """Joins consecutive records into blocks, which are cheaper to send than single records.

    Args:
        payloads: The encoded records.

    Yields:
        Blocks of at most `BACKFILL_BYTES`. A record that is longer forms a block of its own.
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
    """Splits a message that contains several records into one payload per record.

    The records are not decoded.

    Args:
        block: One or more encoded records, as joined by `join_states`.

    Yields:
        The payload of each record.

    Raises:
        WireError: The block is too large, or ends in the middle of a record.
    """
    if len(block) > MAX_BYTES:
        size = count_nouns(len(block), "byte")
        raise WireError("oversized", f"the block has {size}; at most {MAX_BYTES} are allowed")

    unpacker = msgpack.Unpacker(max_buffer_size=MAX_BYTES)
    unpacker.feed(block)
    start = 0
    # For an empty block the loop is entered as well: `skip` then raises the error.
    while start < len(block) or not block:
        try:
            unpacker.skip()
        except (msgpack.UnpackException, ValueError) as error:
            raise WireError(
                "malformed", f"a block of records cannot be read: {error}"
            ) from None
        end = unpacker.tell()
        yield block[start:end]
        start = end


def encode(message: _Sendable) -> bytes:
    """Encodes a message as the payload that is sent over the network.

    Records (`State`) and samples (`PeerSample`), which are sent in every tick, have faster
    encoders: `encode_state` and `encode_sample`.

    Args:
        message: The message.

    Returns:
        The payload, which `decode` converts back to an equal message.
    """
    return _encode(message)


M = TypeVar("M", bound=msgspec.Struct)


def decode(
    payload: bytes,
    kind: type[M],
    versions: Collection[int] = (VERSION,),
    layout: Layout | None = None,
) -> M:
    """Decodes a payload received from the network, and checks the message.

    Payloads may come from any program on the network, so everything that could harm the caller
    is checked: the size, the version, the lengths of vectors and all values.

    Args:
        payload: The encoded message.
        kind: Expected type of the message.
        versions: Accepted versions of the schema. Logs may contain older versions, see
            `READABLE`.
        layout: Numbers of joints, peers and arm parameters of the sender, which determine the
            lengths of the vectors in the message. If None, vectors of any length are accepted.

    Returns:
        The message.

    Raises:
        WireError: The payload is too large or malformed, has another schema version, contains a
            value that is not finite, or contains a vector of the wrong length.
    """
    return make_decoder(kind, tuple(versions), layout)(payload)  # type: ignore[no-any-return]


def read_messages(inbox: Inbox, kind: type[M], layout: Layout | None = None) -> Iterator[M]:
    """Removes all waiting messages from an inbox, and yields those of the given type.

    Payloads that cannot be decoded as this type are skipped without an error, because any
    program on the network can publish under the key of the inbox. Sites publish their records
    in blocks; if a record of a block cannot be decoded, the rest of the block is skipped too.

    Args:
        inbox: Queue of encoded messages.
        kind: Expected type of the messages.
        layout: Expected numbers of joints and peers, which determine the lengths of the vectors
            in a message. Messages with vectors of other lengths are treated as undecodable. If
            None, vectors of any length are accepted.

    Yields:
        The decoded messages, in order of arrival.
    """
    while (message := inbox.poll()) is not None:
        _key, block = message
        # Sites and recorders count the payloads that they cannot decode.
        with suppress(WireError):
            for payload in split_states(block) if kind is State else [block]:
                yield decode(payload, kind, layout=layout)


@cache
def make_decoder(
    kind: type[msgspec.Struct],
    versions: tuple[int, ...] = (VERSION,),
    layout: Layout | None = None,
) -> Callable[[bytes], Any]:
    """Returns a function that decodes payloads of one message type, as `decode` does.

    The decoder, the size limit and the vector lengths are looked up once instead of for every
    payload.

    Args:
        kind: Expected type of the messages.
        versions: Accepted versions of the schema, which defines the fields of the messages.
        layout: Numbers of joints, peers and parameters of the sender. If None, vectors of any
            length are accepted.

    Returns:
        The function, which raises WireError under the same conditions as `decode`.
    """
    max_bytes = _SIZE_LIMITS.get(kind, MAX_BYTES)
    parse = _DECODERS[kind].decode
    if kind is PeerSample and layout is not None:
        # Thousands of samples may wait in a ring, so their size is limited more tightly.
        max_bytes = SAMPLE_BYTES + _NUMBER_BYTES * (3 * layout.shared + layout.sent)
    lengths_by_name = _list_vector_lengths(kind, layout or Layout())
    get_vectors = attrgetter(*lengths_by_name) if lengths_by_name else None
    required_lengths = list(lengths_by_name.values()) if layout else None

    def decode_payload(payload: bytes) -> Any:
        """Decodes the payload of one message, and checks the message.

        The following variables of `make_decoder` depend only on the message type and on the
        sender's layout (its numbers of joints, peers and parameters):

        - `max_bytes`: largest size of a payload.
        - `parse`: decodes a payload, and checks the types and ranges of the fields.
        - `versions`: accepted versions of the schema. Messages from the network must have the
          version of this program. Logs may also have older versions.
        - `get_vectors`: returns the fields of a message that are vectors, such as the joint
          angles. None if the type has no vectors.
        - `lengths_by_name`: mapping from the name of each of these vectors to its length.
        - `required_lengths`: the same lengths as a list. If None, any lengths are accepted.

        Args:
            payload: The encoded message.

        Returns:
            The message.

        Raises:
            WireError: The payload is too large or malformed, has another schema version,
                contains a value that is not finite, or contains a vector of the wrong length.
        """
        if len(payload) > max_bytes:
            size = count_nouns(len(payload), "byte")
            raise WireError(
                "oversized", f"the message has {size}; at most {max_bytes} are allowed"
            )
        try:
            message: Any = parse(payload)
        except (ValueError, RecursionError) as error:
            raise WireError("malformed", str(error)) from None

        if message.v not in versions:
            raise WireError(
                "version",
                f"the message has schema version {message.v}, but this program uses version "
                f"{VERSION}",
            )

        if get_vectors is not None:
            vectors = get_vectors(message)
            # The comparison of lists is fast. If they differ, the call finds the wrong vector,
            # and raises an error that names it.
            if required_lengths is not None and [*map(len, vectors)] != required_lengths:
                _check_lengths(vectors, lengths_by_name)
            # A sum is finite only if all of its terms are, and one sum is faster than a check
            # of each term. The sum of finite terms may overflow. Therefore the terms are
            # checked one by one if the sum is not finite.
            if not _isfinite(sum(map(sum, vectors))):
                _check_finite(message, vectors, lengths_by_name)
        return message

    return decode_payload


def make_sample_reader(layout: Layout) -> Callable[[bytes], PeerSample | WireError]:
    """Returns a function that decodes samples, returning errors instead of raising them.

    The function returns the sample, or a `WireError` if the payload is invalid. It is called in
    network threads, where an exception would be lost.

    Args:
        layout: Numbers of joints, peers and parameters of the sender.
    """
    decoder: Callable[[bytes], PeerSample] = make_decoder(PeerSample, layout=layout)

    def read(payload: bytes) -> PeerSample | WireError:
        """Returns the decoded sample, or a `WireError` if the payload is invalid."""
        try:
            return decoder(payload)
        except WireError as error:
            return error

    return read


def _check_lengths(vectors: tuple[list[float], ...], lengths: dict[str, int]) -> None:
    """Raises WireError if a vector of a received message does not have the expected length.

    Such a message comes from a program that runs a different scenario.

    Args:
        vectors: The vectors of a message.
        lengths: Mapping from the name of each vector to its required length.

    Raises:
        WireError: A vector has another length. If it contains joint angles, the reason states
            the number of joints.
    """
    for vector, (name, length) in zip(vectors, lengths.items(), strict=True):
        count = len(vector)
        if count == length:
            continue
        reason = "malformed"
        # Only possible numbers of joints are named, so that the number of reasons is limited.
        if name == "q" and 1 <= count <= MAX_JOINTS:
            reason = f"of {count_nouns(count, 'joint')}; the scenario has {length}"
        raise WireError(reason, f"{name} has {count_nouns(count, 'number')}, not {length}")


def _check_finite(
    message: Any, vectors: tuple[list[float], ...], names: Collection[str]
) -> None:
    """Raises WireError for the first vector that contains a value that is not finite.

    Args:
        message: The message.
        vectors: The vectors of the message.
        names: Names of the vectors.

    Raises:
        WireError: A value is not finite.
    """
    for name, vector in zip(names, vectors, strict=True):
        if not all(map(_isfinite, vector)):
            is_request = isinstance(message, ArmMeasurement | HandMessage)
            position = f"message {message.n}" if is_request else f"tick {message.tick}"
            raise WireError(
                "not finite", f"{name} of {message.site} in {position} is not finite"
            )
