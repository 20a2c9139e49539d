"""A log that is read while it plays is the same log."""

import io
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.waiting import until
from trilat_net.errors import LogError
from trilat_net.playback.block import Block, Gathering, unpacked
from trilat_net.playback.feeding import Sorter, feed, portions
from trilat_net.playback.loading import load
from trilat_net.playback.reading import Message
from trilat_net.playback.selection import Selection
from trilat_net.playback.source import BLOCK, END, ERROR, FRAME, TOPIC, Feed

from .logs import write

LARGE = 1 << 28
ORDER = {"include": [], "exclude": [], "start_ns": None, "stop_ns": None, "time": "publish"}


class Given:
    """A reading whose messages are given."""

    facts = None

    def __init__(self, messages: list[Message]) -> None:
        self._messages = messages

    def messages(self) -> list[Message]:
        return self._messages


def sorter(messages: list[Message], horizon_ns: int, step_ns: int) -> Sorter:
    return Sorter(Given(messages), horizon_ns, step_ns)  # type: ignore[arg-type]


def whole(messages: list[Message]) -> list[tuple[int, int, int, bytes]]:
    gathering = Gathering()
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
        sent.append((t_ns + delay, Message(t_ns, channel, made[channel], bytes([len(sent)]))))
        made[channel] += 1
    messages = [message for _, message in sorted(sent, key=lambda entry: entry[0])]
    sorting = sorter(messages, 30, step_ns)
    blocks = list(sorting.blocks())
    assert [message for block in blocks for message in block.messages()] == whole(messages)
    assert sorting.strays == 0


def test_what_stands_further_away_is_played_all_the_same_and_counted() -> None:
    rising = [Message(t, 0, t, b"") for t in range(1, 100)]
    sorting = sorter([*rising, Message(0, 0, 0, b"stray")], 30, 10)
    played = [message for block in sorting.blocks() for message in block.messages()]
    assert len(played) == 100
    assert sorting.strays == 1


def test_what_would_be_too_much_to_hold_is_given_before_its_time() -> None:
    """A file that says that everything was sent at once."""
    sorting = Sorter(Given([Message(0, 0, n, bytes(100)) for n in range(1000)]), limit_bytes=20_000)  # type: ignore[arg-type]
    blocks = list(sorting.blocks())
    assert [n for block in blocks for _, _, n, _ in block.messages()] == list(range(1000))
    assert max(map(len, blocks)) <= 20_000 // 100
    assert sorting.strays == 0


@given(st.lists(st.binary(max_size=9), max_size=40), st.integers(1, 20))
def test_portions_are_the_whole_in_pieces_of_some_size(payloads: list[bytes], size: int) -> None:
    gathering = Gathering()
    for n, payload in enumerate(payloads):
        gathering.add(n, 0, n, payload)
    parts = list(portions(gathering.ordered(), size))
    assert [payload for part in parts for _, _, _, payload in part.messages()] == payloads
    assert all(sum(len(p) for _, _, _, p in part.messages()) <= size + 9 for part in parts)


def frames(written: bytes) -> list[tuple[bytes, bytes]]:
    found = []
    while written:
        kind, size = FRAME.unpack_from(written)
        found.append((kind, written[FRAME.size : FRAME.size + size]))
        written = written[FRAME.size + size :]
    return found


def joined(blocks: list[Block]) -> list[tuple[int, int, int, bytes]]:
    return [message for block in blocks for message in block.messages()]


def test_it_writes_what_would_have_been_loaded(log_file: Path) -> None:
    sink = io.BytesIO()
    feed({"paths": [str(log_file)], "loop": False, **ORDER}, sink)
    found = frames(sink.getvalue())
    facts, block = load([log_file], Selection(), LARGE)
    assert block is not None
    assert [body.decode() for kind, body in found if kind == TOPIC] == facts.topics
    assert joined([unpacked(body) for kind, body in found if kind == BLOCK]) == list(block.messages())
    assert found[-1] == (END, json.dumps({"strays": 0, "torn": {}}).encode())


def test_what_it_cannot_read_it_says(tmp_path: Path) -> None:
    sink = io.BytesIO()
    feed({"paths": [str(tmp_path / "missing.mcap")], "loop": False, **ORDER}, sink)
    ((kind, body),) = frames(sink.getvalue())
    assert kind == ERROR
    assert "missing.mcap: cannot be read" in body.decode()


def taken(source: Feed) -> list[Block]:
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
    facts, block = load([log_file], Selection(), LARGE)
    assert block is not None
    topics = list(facts.topics)
    source = Feed([log_file], Selection(), facts, loop=True)
    try:
        for _ in range(3):
            assert joined(taken(source)) == list(block.messages())
            source.again()
            assert not source.ended
        assert facts.topics == topics
    finally:
        source.close()
        source.close()


def test_what_the_process_cannot_read_is_an_error_here(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", [("m1", 0, 0, 0)])
    facts, _ = load([path], Selection(), LARGE)
    path.unlink()
    source = Feed([path], Selection(), facts, loop=False)
    try:
        with pytest.raises(LogError, match=r"run\.mcap: cannot be read"):
            taken(source)
    finally:
        source.close()
