"""A log that is read while it plays gives the same messages."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from multiprocessing import Pipe, get_context
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.waiting import until
from tests.recorder.play.logs import preload_paths, write_event_log
from trilat_net.app.play.batch import BatchBuilder, MessageBatch, PlayedMessage
from trilat_net.app.play.message_source import MessageSource, feed_player, sort_messages
from trilat_net.app.play.session_reader import PlaySelection, SessionHeader, SessionReader
from trilat_net.errors import LogError, RuntimeFault


def check_whole(messages: list[PlayedMessage]) -> list[PlayedMessage]:
    gathering = BatchBuilder()
    for message in messages:
        gathering.add(*message)
    return list(gathering.ordered().messages())


def join_blocks(blocks: list[MessageBatch]) -> list[PlayedMessage]:
    return [message for block in blocks for message in block.messages()]


def sorted_in(
    messages: list[PlayedMessage], *how: int, **limits: int
) -> tuple[list[PlayedMessage], int]:
    sorted_messages = list(sort_messages(messages, *how, **limits))
    return join_blocks([batch for batch, _ in sorted_messages]), sum(
        strays for _, strays in sorted_messages
    )


@given(
    steps=st.lists(
        st.tuples(st.integers(0, 9), st.integers(0, 2), st.integers(0, 30)), max_size=60
    ),
    step_ns=st.integers(1, 20),
)
def test_messages_within_the_horizon_are_put_in_order(
    steps: list[tuple[int, int, int]], step_ns: int
) -> None:
    """Messages come up to 30 ns late in the file; a channel's times ascend with its numbers."""
    t_ns = 0
    numbers = [0, 0, 0]
    sent = []
    for step, channel, delay in steps:
        t_ns += step
        sent.append((t_ns + delay, (t_ns, channel, numbers[channel], bytes([len(sent)]))))
        numbers[channel] += 1
    messages = [message for _, message in sorted(sent, key=lambda entry: entry[0])]
    assert sorted_in(messages, 30, step_ns) == (check_whole(messages), 0)


def test_distant_messages_are_played_and_counted() -> None:
    rising = [(t, 0, t, b"") for t in range(1, 100)]
    played, strays = sorted_in([*rising, (0, 0, 0, b"stray")], 30, 10)
    assert (len(played), strays) == (100, 1)


def test_times_before_the_epoch_are_too_far() -> None:
    before = [(t, 0, t, b"") for t in range(-50, 50)]
    assert sorted_in(before, 30, 10) == (before, 0)


def test_messages_beyond_the_memory_limit_are_given_early() -> None:
    """A file in which all messages have one time."""
    many = [(0, 0, n, bytes(100)) for n in range(1000)]
    assert sorted_in(many, limit_bytes=20_000) == (many, 0)
    assert (
        max(len(batch) for batch, _ in sort_messages(many, limit_bytes=20_000)) <= 20_000 // 100
    )


@contextmanager
def open_source(path: Path, *, loop: bool) -> Iterator[tuple[MessageSource, SessionHeader]]:
    header, _ = SessionReader([path], PlaySelection()).preload(0)
    with closing(MessageSource(header, None)) as source:
        source.start_reader([path], PlaySelection(), loop=loop)
        yield source, header
    source.close()  # again


def read_batches(source: MessageSource) -> list[MessageBatch]:
    blocks = []

    def over() -> bool:
        source.fill()
        while (block := source.poll()) is not None:
            blocks.append(block)
        return source.ended

    until(over, 30.0)
    return blocks


def iterate_rounds(source: MessageSource, count: int) -> Iterator[list[PlayedMessage]]:
    for _ in range(count):
        yield join_blocks(read_batches(source))
        source.restart()


def test_reading_processes_give_the_same_rounds(log_file: Path) -> None:
    preloaded, block = preload_paths(log_file)
    with open_source(log_file, loop=True) as (source, header):
        assert list(iterate_rounds(source, 3)) == [list(block.messages())] * 3
        assert header.topics == preloaded.topics
        assert (source.strays, header.torn) == (0, {})


def _kill_source(source: MessageSource, _path: Path) -> None:
    assert source._process is not None
    source._process.kill()


@pytest.mark.parametrize(
    ("happens", "error", "says"),
    [
        (lambda _, path: path.unlink(), LogError, r"run\.mcap cannot be read"),
        (_kill_source, RuntimeFault, "the process that reads the log ended with exit code -9"),
    ],
)
def test_unreadable_messages_are_errors_here(
    happens: Callable[[MessageSource, Path], None],
    error: type[Exception],
    says: str,
    tmp_path: Path,
) -> None:
    path = write_event_log(tmp_path / "run.mcap", [("m1", 0, 0, 0)])
    header, _ = SessionReader([path], PlaySelection()).preload(0)
    with closing(MessageSource(header, None)) as source:
        source.start_reader([path], PlaySelection(), loop=True)
        happens(source, path)
        with pytest.raises(error, match=says):
            list(iterate_rounds(source, 1000))


def test_processes_without_player_end_alone(log_file: Path) -> None:
    ours, theirs = Pipe(duplex=False)
    reader = get_context("spawn").Process(
        target=feed_player, args=(theirs, [log_file], PlaySelection(), True), daemon=True
    )
    reader.start()
    theirs.close()
    ours.close()
    until(lambda: not reader.is_alive(), 30.0)
    assert reader.exitcode == 0
