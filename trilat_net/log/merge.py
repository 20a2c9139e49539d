"""Merge of the parts of a session: a recording that was split, or continued by another
recorder.

Invariant: a message in several parts is taken once; parts that disagree on a message and parts
of different sessions are refused. The order in which the parts are given does not matter.
"""

import hashlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Hashable, Sequence
from contextlib import suppress
from itertools import chain
from typing import Any

from ..errors import LogError, WireError
from ..net import topics
from ..net.messages import READABLE, Event, LinkStats, RecorderStats
from ..net.wire import decode
from .log_layout import ACCOUNTS, PART
from .mcap_reader import ChannelMessages, LogContents
from .record_columns import decode_ticks
from .running_digest import DIGESTS, PREVIOUS_DIGEST_KEY, DigestState


def merge_parts(parts: Sequence[LogContents]) -> LogContents:
    """Returns the parts of a session, one or more in any order, as one.

    The accounts of several keep only the counts that are none of a channel, summed up.

    Raises:
        LogError: they are of different sessions, or disagree on a message, or one cannot be
            read.
    """
    if len(parts) == 1:
        return parts[0]
    ours = identify_session(parts[0])
    for other in parts[1:]:
        theirs = identify_session(other)
        differ = [
            f"{name} {theirs[name]}, not {ours[name]}"
            for name in ours
            if ours[name] != theirs[name]
        ]
        if differ:
            session = f"the session in {parts[0].source}: {'; '.join(differ)}"
            raise LogError(f"{other.source}: is no part of {session}")
    ordered = sorted(parts, key=_first_time)
    first = ordered[0]
    last = ordered[-1]
    _check_digests(parts)
    names = dict.fromkeys(topic for part in ordered for topic in part.channels)
    whole = all(part.ended and not part.damaged for part in parts)
    return LogContents(
        sources=tuple(part.source for part in ordered),
        session=first.session,
        scenario=first.scenario,
        metadata={**first.metadata, ACCOUNTS: _sum_other_counts(ordered)},
        channels={topic: _merge_channel(topic, ordered) for topic in names},
        complete=whole and sorted(map(_part_index, parts)) == [*range(1, len(parts) + 1)],
        ended=last.ended,
        damaged=[damage for part in ordered for damage in part.damaged],
        chain=max(
            (part.chain for part in parts),
            key=lambda chain: list(DigestState).index(chain.state),
        ),
    )


def _check_digests(parts: Sequence[LogContents]) -> None:
    finished = {_part_index(part): part for part in parts if DIGESTS in part.metadata}
    for part in parts:
        stated = part.metadata.get(PART, {}).get(PREVIOUS_DIGEST_KEY)
        before = finished.get(_part_index(part) - 1)
        if stated and before is not None and before.metadata[DIGESTS].get("records") != stated:
            raise LogError(
                f"{part.source}: does not follow {before.source}: that file was another one"
            )


def _first_time(part: LogContents) -> tuple[int, str]:
    first = [channel.log_ns[0] for channel in part.channels.values() if channel.log_ns]
    return min(first, default=1 << 63), part.source


def _part_index(part: LogContents) -> int:
    text = part.metadata.get(PART, {}).get("index", "1")
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _sum_other_counts(parts: Sequence[LogContents]) -> dict[str, str]:
    """Returns the recorders' counts that are none of a channel, as of dropped messages by
    reason.

    A recorder counts on from part to part, so that its last part has it all.
    """
    last: dict[int | str, dict[str, str]] = {
        _recorder_boot(part) or part.source: part.metadata.get(ACCOUNTS, {}) for part in parts
    }
    sums: Counter[str] = Counter()
    for name, n in chain.from_iterable(counts.items() for counts in last.values()):
        if not name.startswith("/") and n.isdecimal():
            sums[name] += int(n)
    return {name: str(count) for name, count in sums.items()}


def _recorder_boot(part: LogContents) -> int:
    """Returns the boot of the recorder that wrote a part; 0 if it has no message of its own
    there.
    """
    kinds: dict[str, Any] = {topics.STATS: RecorderStats, topics.EVENT: Event}
    for channel, kind in kinds.items():
        topic = "/" + topics.key(part.session["session"], topics.RECORDER, channel)
        messages = part.channels.get(topic)
        if messages is not None and messages.payloads:
            with suppress(WireError):  # raised when its messages are read
                message: RecorderStats | Event = decode(messages.payloads[-1], kind, READABLE)
                return message.boot
            return 0
    return 0


def identify_session(part: LogContents) -> dict[str, str]:
    """Returns what all parts of a session have in common, and no other session has."""
    facts = {
        name: part.session.get(name, "unknown")
        for name in ("session", "driver", "epoch_unix_ns")
    }
    return {**facts, "scenario": hashlib.sha256(part.scenario).hexdigest()[:16]}


def _merge_channel(topic: str, parts: Sequence[LogContents]) -> ChannelMessages:
    """Returns a topic's messages of all parts, each once, in the order of the parts."""
    merged = ChannelMessages()
    having = [part for part in parts if topic in part.channels]
    if len(having) == 1:
        return having[0].channels[topic]
    places: dict[Hashable, int] = {}
    ends: list[int] = []
    for part in having:
        channel = part.channels[topic]
        fresh: dict[Hashable, int] = {}
        for n, key in enumerate(_find_keys(topic, channel, part.source)):
            payload = channel.payloads[n]
            place = places.get(key)
            if place is None:
                fresh[key] = len(merged.payloads)
                merged.add(payload, channel.log_ns[n], channel.publish_ns[n])
            elif merged.payloads[place] != payload:
                names = f"{having[bisect_right(ends, place)].source} and {part.source}"
                raise LogError(
                    f"{names} differ: {_describe_message(topic, key)} is not the same"
                )
        places |= fresh
        ends.append(len(merged.payloads))
    return merged


def _find_keys(topic: str, channel: ChannelMessages, source: str) -> Sequence[Hashable]:
    payloads = channel.payloads
    try:
        match topic.rpartition("/")[2]:
            case topics.STATE:
                ticks: list[int] = decode_ticks(payloads).tolist()
                return ticks
            case topics.LINK:
                return [decode(payload, LinkStats, READABLE).tick for payload in payloads]
            case topics.EVENT:
                events = [decode(payload, Event, READABLE) for payload in payloads]
                # before version 3 events have no number; their content is the key
                keys = zip(events, payloads, strict=True)
                return [
                    (event.boot, event.n) if event.n >= 0 else payload
                    for event, payload in keys
                ]
        stats = (decode(payload, RecorderStats, READABLE) for payload in payloads)
        return [(one.boot, one.t_ns) for one in stats]
    except WireError as error:
        raise LogError(f"{source}: a message on {topic} cannot be read: {error}") from None


def _describe_message(topic: str, key: Hashable) -> str:
    member, kind = topic.split("/")[-2:]
    match key:
        case int():
            return f"the {'record' if kind == topics.STATE else 'statistics'} of tick {key} of {member}"
        case (_, int(n)):
            if kind == topics.EVENT:
                return f"event {n} of {member}"
            return f"statistics of the {member} at {n} ns"
    return f"a message of {member}"
