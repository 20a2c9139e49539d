"""Reads the files of a session's log, and merges them into one log.

A log has several files (parts) if the recorder split it, or if several recorders recorded the
session, one after another or simultaneously.

Invariant:
    - A message that occurs in several parts is written once.
    - Parts of different sessions are rejected, and so are parts that contain different messages
      with the same number.
    - The order in which the user lists the parts does not matter.
"""

import hashlib
import os
from bisect import bisect_right
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import LogError, WireError
from ..files import open_regular
from ..net import READABLE, Event, LinkStats, RecorderStats, decode, topics
from .log_layout import ACCOUNTS, PART, describe_unfinished
from .mcap_reader import ChannelMessages, LogContents, Progress, shift_progress
from .record_columns import RecordColumns
from .running_digest import DIGESTS, PREVIOUS_DIGEST_KEY, DigestState


def read_session(
    sources: Sequence[str | Path | BinaryIO], progress: Progress | None
) -> LogContents:
    """Reads the log of one session from a file, or from the files of all its parts.

    Args:
        sources: Paths, or binary files opened for reading, in any order.
        progress: Function that is called repeatedly with the number of bytes read and the total
            over all files.

    Returns:
        The contents of all files, as if they were one file.

    Raises:
        LogError: A file cannot be read, or the files belong to different sessions or contain
            different versions of a message.
    """
    return _merge_parts(_read_parts(sources, progress))


def read_sessions(files: Sequence[Path], progress: Progress | None) -> list[LogContents]:
    """Reads the logs of one or several sessions.

    Args:
        files: Paths of the files, in any order.
        progress: Function that is called repeatedly with the number of bytes read and the total
            over all files.

    Returns:
        The contents of each session. Files of the same session are merged.

    Raises:
        LogError: A file cannot be read, or files of a session contain different versions of a
            message.
    """
    sessions: dict[str, list[LogContents]] = {}
    for part in _read_parts(files, progress):
        sessions.setdefault(str(_identify_session(part)), []).append(part)
    return list(map(_merge_parts, sessions.values()))


def _read_parts(
    sources: Sequence[str | Path | BinaryIO], progress: Progress | None
) -> list[LogContents]:
    """Reads the contents of files, and reports the overall progress.

    All files are opened before the first one is read, so that a missing file is reported
    immediately.
    """
    parts: list[LogContents] = []
    with ExitStack() as stack:
        files = [_open_source(source, stack) for source in sources]
        sizes = [_measure_size(stream) for stream, _ in files]
        bytes_before = 0
        for (stream, name), size in zip(files, sizes, strict=True):
            with _convert_errors(name):
                shifted = shift_progress(progress, bytes_before, sum(sizes))
                parts.append(LogContents.read(stream, name, shifted))
            bytes_before += size
    return parts


def _open_source(source: str | Path | BinaryIO, stack: ExitStack) -> tuple[BinaryIO, str]:
    """Opens one file of a log. A file that the caller has already opened is used as it is.

    Args:
        source: Path, or binary file opened for reading.
        stack: Context that closes the files opened here.

    Returns:
        The open file, and its name for error messages.
    """
    if isinstance(source, str | Path):
        with _convert_errors(str(source)):
            stream = stack.enter_context(open_regular(Path(source)))
        return stream, str(source)
    if hasattr(source, "seek"):
        return source, "log"
    raise LogError(
        f"a log must be given as a path or as a file opened for reading, not {source!r:.80}"
    )


@contextmanager
def _convert_errors(name: str) -> Iterator[None]:
    """Converts an operating system error to a `LogError` that names the file."""
    try:
        yield
    except OSError as error:
        raise LogError(
            f"{name} cannot be read: {error.strerror}{describe_unfinished(Path(name))}"
        ) from None


def _measure_size(stream: BinaryIO) -> int:
    """Returns the number of bytes from the current position to the end of a stream."""
    position = stream.tell()
    end = stream.seek(0, os.SEEK_END)
    stream.seek(position)
    return end - position


def _merge_parts(parts: Sequence[LogContents]) -> LogContents:
    """Merges the contents of the files into which the log of a session was divided.

    The recorder states at the end of each file how many messages it received. The counts of
    individual channels do not apply to the merged log and are left out. All other counts, such
    as that of dropped messages, are added up.

    Args:
        parts: One or more parts, in any order.

    Returns:
        The contents of all parts, as if they were one file.

    Raises:
        LogError: The parts belong to different sessions or contain different versions of a
            message, or a part cannot be read.
    """
    if len(parts) == 1:
        return parts[0]
    for other in parts[1:]:
        _check_same_session(parts[0], other)
    _check_digests(parts)

    ordered = sorted(parts, key=_first_time)
    first = ordered[0]
    last = ordered[-1]
    damaged = [damage for part in ordered for damage in part.damaged]
    topic_names = dict.fromkeys(topic for part in ordered for topic in part.channels)
    all_ended = all(part.ended for part in parts)
    all_present = sorted(map(_part_index, parts)) == [*range(1, len(parts) + 1)]

    states = list(DigestState)  # in order from the best to the worst
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
    """Raises LogError if two files belong to the logs of different sessions.

    Raises:
        LogError: The files belong to different sessions. The message lists the differences.
    """
    expected = _identify_session(first)
    actual = _identify_session(other)
    differences = [
        f"{name} is {actual[name]}, not {expected[name]}"
        for name in expected
        if expected[name] != actual[name]
    ]
    if differences:
        session = f"the session in {first.source}: {'; '.join(differences)}"
        raise LogError(f"{other.source} is not a part of {session}")


def _check_digests(parts: Sequence[LogContents]) -> None:
    """Raises LogError unless every part of a log continues the part before it.

    At the end of a part, the recorder writes a digest (checksum) of its messages. The next part
    repeats this digest at its beginning.

    Raises:
        LogError: A part states the digest of another file.
    """
    finished_parts = {_part_index(part): part for part in parts if DIGESTS in part.metadata}
    for part in parts:
        stated_digest = part.metadata.get(PART, {}).get(PREVIOUS_DIGEST_KEY)
        previous_part = finished_parts.get(_part_index(part) - 1)
        if not stated_digest or previous_part is None:
            continue
        if previous_part.metadata[DIGESTS].get("records") != stated_digest:
            raise LogError(
                f"{part.source} is not the continuation of {previous_part.source}: it was "
                "recorded after another file"
            )


def _first_time(part: LogContents) -> tuple[int, str]:
    """Returns a sort key for parts: the arrival time of the first message, and the name."""
    first_times = [channel.log_ns[0] for channel in part.channels.values() if channel.log_ns]
    return min(first_times, default=1 << 63), part.source


def _part_index(part: LogContents) -> int:
    """Returns the index of a part, counted from 1, or 0 if the part states no valid index."""
    text = part.metadata.get(PART, {}).get("index", "1")
    return int(text) if text.isdecimal() and len(text) < 10 else 0


def _sum_other_counts(parts: Sequence[LogContents]) -> dict[str, str]:
    """Adds up the recorders' counts that belong to no channel, such as dropped messages.

    A recorder continues its counts from part to part, so the last part of a recorder contains
    its totals. The totals of different recorders are added.

    Args:
        parts: The parts, in the order of their first messages.
    """
    last_counts: dict[int | str, dict[str, str]] = {}
    for part in parts:
        recorder = _recorder_boot(part) or part.source
        last_counts[recorder] = part.metadata.get(ACCOUNTS, {})

    sums: Counter[str] = Counter()
    for counts in last_counts.values():
        for name, count in counts.items():
            is_channel = name.startswith("/")
            if not is_channel and count.isdecimal():
                sums[name] += int(count)
    return {name: str(count) for name, count in sums.items()}


def _recorder_boot(part: LogContents) -> int:
    """Returns the random number that identifies the process that recorded a file.

    0 if the file has no readable message of the recorder.
    """
    kinds: dict[str, Any] = {topics.STATS: RecorderStats, topics.EVENT: Event}
    for channel, kind in kinds.items():
        topic = "/" + topics.key(part.session["session"], topics.RECORDER, channel)
        messages = part.channels.get(topic)
        if messages is not None and len(messages):
            # A message that cannot be decoded is reported when the log is read.
            with suppress(WireError):
                message: RecorderStats | Event = decode(
                    messages.payload(len(messages) - 1), kind, READABLE
                )
                return message.boot
            return 0
    return 0


def _identify_session(part: LogContents) -> dict[str, str]:
    """Collects the facts that identify a session and are the same in all parts of its log.

    Files can be read as one log only if these facts are equal.

    Args:
        part: Contents of one part.

    Returns:
        The metadata of the session, excluding fields that differ between parts.
    """
    names = ("session", "driver", "epoch_unix_ns")
    facts = {name: part.session.get(name, "unknown") for name in names}
    facts["scenario"] = hashlib.sha256(part.scenario).hexdigest()[:16]
    return facts


def _merge_channel(topic: str, parts: Sequence[LogContents]) -> ChannelMessages:
    """Merges the messages of a topic from several files of the same log, in file order.

    Messages are recognised by a key, such as the tick of a record. A message that an earlier
    file already contains is left out.

    Args:
        topic: The topic. At least one part contains it.
        parts: The parts, in order.

    Raises:
        LogError: Two parts contain different messages with the same key.
    """
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
        payloads = channel.payloads
        # Messages are compared only with earlier parts, because a part may repeat its own
        # messages.
        new_indices: dict[Hashable, int] = {}
        keys = _list_keys(topic, payloads, part.source)
        for number, (key, payload) in enumerate(zip(keys, payloads, strict=True)):
            index = merged_indices.get(key)
            if index is None:
                new_indices[key] = len(merged)
                merged.add(payload, channel.log_ns[number], channel.publish_ns[number])
            elif merged.payload(index) != payload:
                other = topic_parts[bisect_right(part_ends, index)]
                message = _describe_message(topic, key)
                raise LogError(
                    f"{other.source} and {part.source} differ: {message} is not the same in "
                    "both"
                )
        merged_indices |= new_indices
        part_ends.append(len(merged))
    return merged


def _list_keys(topic: str, payloads: Sequence[bytes], source: str) -> Sequence[Hashable]:
    """Returns a key for each message of a topic, used to recognise copies of a message.

    Several recorders may have recorded the same message. Its copies have the same key, and
    different messages have different keys.

    Args:
        topic: The topic.
        payloads: Encoded messages of the topic.
        source: Name of the file for error messages.

    Raises:
        LogError: A message cannot be decoded.
    """
    try:
        match topic.rpartition("/")[2]:
            case topics.STATE:
                record_ticks: list[int] = RecordColumns(payloads).ticks().tolist()
                return record_ticks
            case topics.LINK:
                return [decode(payload, LinkStats, READABLE).tick for payload in payloads]
            case topics.EVENT:
                events = [decode(payload, Event, READABLE) for payload in payloads]
                keys: list[Hashable] = []
                for event, payload in zip(events, payloads, strict=True):
                    # Events have no number before version 3. In this case, their content is the
                    # key.
                    keys.append((event.boot, event.n) if event.n >= 0 else payload)
                return keys
        statistics = [decode(payload, RecorderStats, READABLE) for payload in payloads]
        return [(message.boot, message.t_ns) for message in statistics]
    except WireError as error:
        raise LogError(f"{source}: a message on {topic} cannot be read: {error}") from None


def _describe_message(topic: str, key: Hashable) -> str:
    """Returns a noun phrase for a message, for use in a sentence about differing files.

    For example, the key 12 in the topic of the records of "m1" becomes "the record of tick 12
    of m1". For the keys see `_list_keys`.
    """
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
