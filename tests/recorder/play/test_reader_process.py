"""A log that is read while it plays is the same log."""

import io
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recorder.play.batch import BatchBuilder, MessageBatch, unpack_batch
from recorder.play.reader_process import (
    BATCH_FRAME,
    END_FRAME,
    ERROR_FRAME,
    FRAME_HEADER,
    TOPIC_FRAME,
    MessageSorter,
    ProcessSource,
    ReaderOrder,
    RoundEnd,
    feed_player,
    split_batch,
)
from recorder.play.session_reader import PlayedMessage, PlaySelection, preload_messages
from tests.net.waiting import until
from trilat_net.errors import LogError

from .logs import write

LARGE = 1 << 28


class Given:
    """A reading whose messages are given."""

    header = None

    def __init__(self, messages: list[PlayedMessage]) -> None:
        self._messages = messages

    def messages(self) -> list[PlayedMessage]:
        return self._messages


def sorter(messages: list[PlayedMessage], horizon_ns: int, step_ns: int) -> MessageSorter:
    return MessageSorter(Given(messages), horizon_ns, step_ns)  # type: ignore[arg-type]


def whole(messages: list[PlayedMessage]) -> list[tuple[int, int, int, bytes]]:
    gathering = BatchBuilder()
    for message in messages:
        gathering.add(*message)
    return list(gathering.ordered().messages())


@given(
    steps=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2), st.integers(0, 30)), max_size=60),
    step_ns=st.integers(1, 20),
)
def test_what_stands_within_the_horizon_of_its_turn_is_put_in_its_turn(
    steps: list[tuple[int, int, int]], step_ns: int
) -> None:
    """Messages come up to 30 ns late in the file; a channel's times go with its numbers."""
    t_ns, made = 0, [0, 0, 0]
    sent = []
    for step, channel, delay in steps:
        t_ns += step
        sent.append((t_ns + delay, PlayedMessage(t_ns, channel, made[channel], bytes([len(sent)]))))
        made[channel] += 1
    messages = [message for _, message in sorted(sent, key=lambda entry: entry[0])]
    sorting = sorter(messages, 30, step_ns)
    blocks = list(sorting.batches())
    assert [message for block in blocks for message in block.messages()] == whole(messages)
    assert sorting.strays == 0


def test_what_stands_further_away_is_played_all_the_same_and_counted() -> None:
    rising = [PlayedMessage(t, 0, t, b"") for t in range(1, 100)]
    sorting = sorter([*rising, PlayedMessage(0, 0, 0, b"stray")], 30, 10)
    played = [message for block in sorting.batches() for message in block.messages()]
    assert len(played) == 100
    assert sorting.strays == 1


def test_what_would_be_too_much_to_hold_is_given_before_its_time() -> None:
    """A file that says that everything was sent at once."""
    sorting = MessageSorter(
        Given([PlayedMessage(0, 0, n, bytes(100)) for n in range(1000)]), limit_bytes=20_000
    )  # type: ignore[arg-type]
    blocks = list(sorting.batches())
    assert [n for block in blocks for _, _, n, _ in block.messages()] == list(range(1000))
    assert max(map(len, blocks)) <= 20_000 // 100
    assert sorting.strays == 0


@given(st.lists(st.binary(max_size=9), max_size=40), st.integers(1, 20))
def test_portions_are_the_whole_in_pieces_of_some_size(payloads: list[bytes], size: int) -> None:
    gathering = BatchBuilder()
    for n, payload in enumerate(payloads):
        gathering.add(n, 0, n, payload)
    parts = list(split_batch(gathering.ordered(), size))
    assert [payload for part in parts for _, _, _, payload in part.messages()] == payloads
    assert all(sum(len(p) for _, _, _, p in part.messages()) <= size + 9 for part in parts)


def frames(written: bytes) -> list[tuple[bytes, bytes]]:
    found = []
    while written:
        kind, size = FRAME_HEADER.unpack_from(written)
        found.append((kind, written[FRAME_HEADER.size : FRAME_HEADER.size + size]))
        written = written[FRAME_HEADER.size + size :]
    return found


def joined(blocks: list[MessageBatch]) -> list[tuple[int, int, int, bytes]]:
    return [message for block in blocks for message in block.messages()]


def test_it_writes_what_would_have_been_loaded(log_file: Path) -> None:
    sink = io.BytesIO()
    feed_player(ReaderOrder([str(log_file)], PlaySelection(), loop=False), sink)
    found = frames(sink.getvalue())
    facts, block = preload_messages([log_file], PlaySelection(), LARGE)
    assert block is not None
    assert [body.decode() for kind, body in found if kind == TOPIC_FRAME] == facts.topics
    assert joined([unpack_batch(body) for kind, body in found if kind == BATCH_FRAME]) == list(
        block.messages()
    )
    assert found[-1] == (END_FRAME, msgspec.json.encode(RoundEnd(0, {})))


def test_what_it_cannot_read_it_says(tmp_path: Path) -> None:
    sink = io.BytesIO()
    feed_player(ReaderOrder([str(tmp_path / "missing.mcap")], PlaySelection(), loop=False), sink)
    ((kind, body),) = frames(sink.getvalue())
    assert kind == ERROR_FRAME
    assert "missing.mcap: cannot be read" in body.decode()


def taken(source: ProcessSource) -> list[MessageBatch]:
    """A round of a source, whose process writes while this one reads."""
    blocks = []

    def over() -> bool:
        source.fill()
        while (block := source.poll()) is not None:
            blocks.append(block)
        return source.ended

    until(over, 30.0)
    return blocks


def test_a_process_of_its_own_gives_round_after_round(log_file: Path) -> None:
    facts, block = preload_messages([log_file], PlaySelection(), LARGE)
    assert block is not None
    topics = list(facts.topics)
    source = ProcessSource([log_file], PlaySelection(), facts, loop=True)
    try:
        for _ in range(3):
            assert joined(taken(source)) == list(block.messages())
            source.restart()
            assert not source.ended
        assert facts.topics == topics
    finally:
        source.close()
        source.close()


def test_what_the_process_cannot_read_is_an_error_here(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", [("m1", 0, 0, 0)])
    facts, _ = preload_messages([path], PlaySelection(), LARGE)
    path.unlink()
    source = ProcessSource([path], PlaySelection(), facts, loop=False)
    try:
        with pytest.raises(LogError, match=r"run\.mcap: cannot be read"):
            taken(source)
    finally:
        source.close()
