"""Merge of the parts of a session: a recording that was split, or continued by another recorder.

Invariant: a message in several parts is taken once; parts that disagree on a message and parts of
different sessions are refused. The order in which the parts are given does not matter.
"""

import hashlib
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Hashable, Sequence

from ..errors import LogError, WireError
from ..net import topics
from ..net.messages import READABLE, Event, LinkStats, RecorderStats
from ..net.wire import decode
from . import record_columns
from .log_layout import ACCOUNTS, PART
from .mcap_reader import ChannelMessages, LogContents

MessageKeys = Callable[[Sequence[bytes]], Sequence[Hashable]]
"""Tells what makes each message of a channel one of its kind: its tick, or its number."""


def merge_parts(parts: Sequence[LogContents]) -> LogContents:
    """Returns the parts of a session as one.

    Args:
        parts: one or more, in any order. Where they are several, the accounts are left with what is none of
            a channel, summed up: what is missing of a channel is for the whole to say.

    Raises:
        LogError: they are of different sessions, or tell a message differently, or one cannot be read.
    """
    if len(parts) == 1:
        return parts[0]
    for other in parts[1:]:
        _same_session(parts[0], other)
    ordered = sorted(parts, key=_begins)
    first, last = ordered[0], ordered[-1]
    names = dict.fromkeys(topic for part in ordered for topic in part.channels)
    whole = all(part.ended and not part.damaged for part in parts)
    return LogContents(
        tuple(part.source for part in ordered),
        first.session,
        first.scenario,
        {**first.metadata, ACCOUNTS: _other_counts(ordered)},
        {topic: _joined(topic, ordered) for topic in names},
        whole and sorted(map(_place, parts)) == [*range(1, len(parts) + 1)],
        last.ended,
        [damage for part in ordered for damage in part.damaged],
    )


def _begins(part: LogContents) -> tuple[int, str]:
    """Orders parts: by their first message, those without any last."""
    first = [channel.log_ns[0] for channel in part.channels.values() if channel.log_ns]
    return min(first, default=1 << 63), part.source


def _place(part: LogContents) -> int:
    """Returns which part it says it is; one that was never split is the first."""
    text = part.metadata.get(PART, {}).get("index", "1")
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _other_counts(parts: Sequence[LogContents]) -> dict[str, str]:
    """Returns what recorders have counted besides channels, as messages that were dropped, by reason.

    A recorder counts on from part to part, so that its last part has it all.
    """
    last: dict[int | str, dict[str, str]] = {
        _recorder(part) or part.source: part.metadata.get(ACCOUNTS, {}) for part in parts
    }
    sums: Counter[str] = Counter()
    for counts in last.values():
        sums.update(
            {name: int(n) for name, n in counts.items() if not name.startswith("/") and n.isdecimal()}
        )
    return {name: str(count) for name, count in sums.items()}


def _recorder(part: LogContents) -> int:
    """Returns the boot of the recorder that wrote a part; 0 where it said nothing there."""
    session = part.session["session"]
    said, told = (
        part.channels.get("/" + topics.key(session, topics.RECORDER, channel))
        for channel in (topics.STATS, topics.EVENT)
    )
    try:
        if said is not None and said.payloads:
            return decode(said.payloads[-1], RecorderStats, READABLE).boot
        if told is not None and told.payloads:
            return decode(told.payloads[-1], Event, READABLE).boot
    except WireError:
        pass  # told where its messages are read
    return 0


def _same_session(part: LogContents, other: LogContents) -> None:
    ours, theirs = _facts(part), _facts(other)
    differ = [f"{name} {theirs[name]}, not {ours[name]}" for name in ours if ours[name] != theirs[name]]
    if differ:
        raise LogError(f"{other.source}: is no part of the session in {part.source}: {'; '.join(differ)}")


def _facts(part: LogContents) -> dict[str, str]:
    """Returns what the parts of a session have in common."""
    told = {name: part.session.get(name, "unknown") for name in ("session", "driver", "epoch_unix_ns")}
    return {**told, "scenario": hashlib.sha256(part.scenario).hexdigest()[:16]}


def _joined(topic: str, parts: Sequence[LogContents]) -> ChannelMessages:
    """Returns a topic's messages of all parts, each once, in the order of the parts."""
    whole = ChannelMessages()
    having = [part for part in parts if topic in part.channels]
    if len(having) == 1:
        return having[0].channels[topic]
    places: dict[Hashable, int] = {}
    ends: list[int] = []
    for part in having:
        channel = part.channels[topic]
        fresh: dict[Hashable, int] = {}
        for n, number in enumerate(_numbers(topic, channel, part.source)):
            payload = channel.payloads[n]
            place = places.get(number)
            if place is None:
                fresh[number] = len(whole.payloads)
                whole.add(payload, channel.log_ns[n], channel.publish_ns[n])
            elif whole.payloads[place] != payload:
                told = having[bisect_right(ends, place)].source
                raise LogError(f"{told} and {part.source} differ: {_named(topic, number)} is not the same")
        places |= fresh
        ends.append(len(whole.payloads))
    return whole


def _numbers(topic: str, channel: ChannelMessages, source: str) -> Sequence[Hashable]:
    kind = topic.rpartition("/")[2]
    try:
        return _NUMBERED[kind](channel.payloads)
    except WireError as error:
        raise LogError(f"{source}: a message on {topic} cannot be read: {error}") from None


def _named(topic: str, number: Hashable) -> str:
    member, kind = topic.split("/")[-2:]
    match number:
        case int():
            what = "record" if kind == topics.STATE else "statistics"
            return f"the {what} of tick {number} of {member}"
        case (_, int(n)):
            return (
                f"event {n} of {member}" if kind == topics.EVENT else f"statistics of the {member} at {n} ns"
            )
    return f"a message of {member}"


def _link_numbers(payloads: Sequence[bytes]) -> Sequence[Hashable]:
    return [decode(payload, LinkStats, READABLE).tick for payload in payloads]


def _event_numbers(payloads: Sequence[bytes]) -> Sequence[Hashable]:
    """Tells events by boot and number; those of before version 3 by what they say."""
    events = (decode(payload, Event, READABLE) for payload in payloads)
    return [
        (event.boot, event.n) if event.n >= 0 else payload
        for event, payload in zip(events, payloads, strict=True)
    ]


def _stats_numbers(payloads: Sequence[bytes]) -> Sequence[Hashable]:
    return [(s.boot, s.t_ns) for s in (decode(payload, RecorderStats, READABLE) for payload in payloads)]


def _state_numbers(payloads: Sequence[bytes]) -> Sequence[Hashable]:
    ticks: list[int] = record_columns.decode_ticks(payloads).tolist()
    return ticks


_NUMBERED: dict[str, MessageKeys] = {
    topics.STATE: _state_numbers,
    topics.LINK: _link_numbers,
    topics.EVENT: _event_numbers,
    topics.STATS: _stats_numbers,
}
