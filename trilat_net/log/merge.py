"""Merge of the parts of a session's log.

A log has several parts if it was split, or continued by another recorder.

Invariant:
    - A message in several parts counts once.
    - Parts that disagree on a message, and parts of different sessions, are refused.
    - The order of the arguments does not matter.
"""

import hashlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Hashable, Sequence
from contextlib import suppress
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
    """Returns the contents of one or more parts of a session as one log.

    Of the accounts of several parts, only the counts that belong to no channel are kept, summed
    up.

    Args:
        parts: the parts, in any order.

    Raises:
        LogError: the parts are of different sessions, or disagree on a message, or a part
            cannot be read.
    """
    if len(parts) == 1:
        return parts[0]
    for other in parts[1:]:
        _check_same_session(parts[0], other)
    ordered = sorted(parts, key=_first_time)
    first = ordered[0]
    last = ordered[-1]
    _check_digests(parts)
    damaged = [damage for part in ordered for damage in part.damaged]
    topic_names = dict.fromkeys(topic for part in ordered for topic in part.channels)
    all_ended = all(part.ended for part in parts)
    all_present = sorted(map(_part_index, parts)) == [*range(1, len(parts) + 1)]
    states = list(DigestState)  # from best to worst
    chains = [part.chain for part in parts]
    worst_chain = max(chains, key=lambda chain: states.index(chain.state))
    return LogContents(
        sources=tuple(part.source for part in ordered),
        session=first.session,
        scenario=first.scenario,
        metadata={**first.metadata, ACCOUNTS: _sum_other_counts(ordered)},
        channels={topic: _merge_channel(topic, ordered) for topic in topic_names},
        complete=all_ended and not damaged and all_present,
        ended=last.ended,
        damaged=damaged,
        chain=worst_chain,
    )


def _check_same_session(first: LogContents, other: LogContents) -> None:
    """Raises a `LogError` unless two parts are of the same session."""
    expected = identify_session(first)
    actual = identify_session(other)
    differences = [
        f"{name} {actual[name]}, not {expected[name]}"
        for name in expected
        if expected[name] != actual[name]
    ]
    if differences:
        session = f"the session in {first.source}: {'; '.join(differences)}"
        raise LogError(f"{other.source}: is no part of {session}")


def _check_digests(parts: Sequence[LogContents]) -> None:
    """Raises a `LogError` unless every part follows the part whose digest it states."""
    finished = {_part_index(part): part for part in parts if DIGESTS in part.metadata}
    for part in parts:
        stated = part.metadata.get(PART, {}).get(PREVIOUS_DIGEST_KEY)
        before = finished.get(_part_index(part) - 1)
        if not stated or before is None:
            continue
        if before.metadata[DIGESTS].get("records") != stated:
            raise LogError(
                f"{part.source}: does not follow {before.source}: it followed another file"
            )


def _first_time(part: LogContents) -> tuple[int, str]:
    """Returns the first log time of a part, and its name, as a sorting key."""
    first_times = [channel.log_ns[0] for channel in part.channels.values() if channel.log_ns]
    return min(first_times, default=1 << 63), part.source


def _part_index(part: LogContents) -> int:
    """Returns the index of a part, from 1; 0 if the part states no valid index."""
    text = part.metadata.get(PART, {}).get("index", "1")
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _sum_other_counts(parts: Sequence[LogContents]) -> dict[str, str]:
    """Returns the recorders' counts that belong to no channel, such as dropped messages.

    A recorder continues its counts from part to part, so that its last part has the totals.
    """
    last_counts: dict[int | str, dict[str, str]] = {}
    for part in parts:
        recorder = _recorder_boot(part) or part.source
        last_counts[recorder] = part.metadata.get(ACCOUNTS, {})
    sums: Counter[str] = Counter()
    for counts in last_counts.values():
        for name, count in counts.items():
            if not name.startswith("/") and count.isdecimal():
                sums[name] += int(count)
    return {name: str(count) for name, count in sums.items()}


def _recorder_boot(part: LogContents) -> int:
    """Returns the boot of the recorder that wrote a part.

    The boot is 0 if the part has no readable message of the recorder.
    """
    kinds: dict[str, Any] = {topics.STATS: RecorderStats, topics.EVENT: Event}
    for channel, kind in kinds.items():
        topic = "/" + topics.key(part.session["session"], topics.RECORDER, channel)
        messages = part.channels.get(topic)
        if messages is not None and messages.payloads:
            with suppress(WireError):  # reading the messages reports the error
                message: RecorderStats | Event = decode(messages.payloads[-1], kind, READABLE)
                return message.boot
            return 0
    return 0


def identify_session(part: LogContents) -> dict[str, str]:
    """Returns the facts that all parts of a session share, and that identify the session."""
    names = ("session", "driver", "epoch_unix_ns")
    facts = {name: part.session.get(name, "unknown") for name in names}
    facts["scenario"] = hashlib.sha256(part.scenario).hexdigest()[:16]
    return facts


def _merge_channel(topic: str, parts: Sequence[LogContents]) -> ChannelMessages:
    """Returns the messages of a topic in all parts, each once, in the order of the parts."""
    topic_parts = [part for part in parts if topic in part.channels]
    if len(topic_parts) == 1:
        return topic_parts[0].channels[topic]
    merged = ChannelMessages()
    # Index of each message in `merged`, by its key.
    merged_indices: dict[Hashable, int] = {}
    # Number of merged messages after each part.
    part_ends: list[int] = []
    for part in topic_parts:
        channel = part.channels[topic]
        # Messages are compared with earlier parts only: a part may repeat its own messages.
        new_indices: dict[Hashable, int] = {}
        for number, key in enumerate(_list_keys(topic, channel, part.source)):
            payload = channel.payloads[number]
            index = merged_indices.get(key)
            if index is None:
                new_indices[key] = len(merged.payloads)
                merged.add(payload, channel.log_ns[number], channel.publish_ns[number])
            elif merged.payloads[index] != payload:
                other = topic_parts[bisect_right(part_ends, index)]
                message = _describe_message(topic, key)
                raise LogError(
                    f"{other.source} and {part.source} differ: {message} is not the same"
                )
        merged_indices |= new_indices
        part_ends.append(len(merged.payloads))
    return merged


def _list_keys(topic: str, channel: ChannelMessages, source: str) -> Sequence[Hashable]:
    """Returns a key for each message of a topic, which is equal for equal messages.

    Raises:
        LogError: a message cannot be read.
    """
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
                keys: list[Hashable] = []
                for event, payload in zip(events, payloads, strict=True):
                    # Events have no number before version 3; then their content is the key.
                    keys.append((event.boot, event.n) if event.n >= 0 else payload)
                return keys
        statistics = [decode(payload, RecorderStats, READABLE) for payload in payloads]
        return [(message.boot, message.t_ns) for message in statistics]
    except WireError as error:
        raise LogError(f"{source}: a message on {topic} cannot be read: {error}") from None


def _describe_message(topic: str, key: Hashable) -> str:
    """Returns a noun phrase for the message with a key, see `_list_keys`."""
    member, kind = topic.split("/")[-2:]
    match key:
        case int():
            noun = "record" if kind == topics.STATE else "statistics"
            return f"the {noun} of tick {key} of {member}"
        case (_, int(n)):
            if kind == topics.EVENT:
                return f"event {n} of {member}"
            return f"statistics of the {member} at {n} ns"
    return f"a message of {member}"
