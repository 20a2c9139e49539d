"""A replay answers requests for the past like a site."""

from hypothesis import given
from hypothesis import strategies as st

from sites.retransmit_buffer import ChannelBuffer
from trilat_net.app.play.batch import BatchBuilder
from trilat_net.app.play.site_stand_ins import PlayedHistory
from trilat_net.net.requests import BACKFILL_BYTES, BACKFILL_MESSAGES

CHANNEL = 3
OTHER = 4


def make_history(
    numbers: list[int], played: int, size: int = 1, kept_ns: int | None = None
) -> PlayedHistory:
    memory = PlayedHistory(kept_ns)
    gathering = BatchBuilder()
    for index, number in enumerate(numbers):
        gathering.add(index, CHANNEL, number, number.to_bytes(2, "big") * size)
        gathering.add(index, OTHER, number, b"other")
    for piece in gathering.ordered().pieces(40):
        memory.add(piece)
    if played:
        memory.next_numbers[CHANNEL] = numbers[played - 1] + 1
    return memory


def answer_naively(numbers: list[int], first: int, last: int) -> tuple[int, list[int]]:
    """Returns messages from the first number there is, one after the other, until a gap."""
    next_number = numbers[-1] + 1 if numbers else 0
    if first >= next_number:
        return first, []
    begin = next(n for n in numbers if n >= first)
    run = []
    for number in range(begin, min(last, begin + BACKFILL_MESSAGES - 1) + 1):
        if number not in numbers:
            break
        run.append(number)
    return begin, run


@given(
    st.lists(st.integers(0, 120), unique=True, max_size=60).map(sorted),
    st.data(),
    st.integers(0, 130),
    st.integers(0, 130),
)
def test_answers_go_up_to_the_next_gap(
    numbers: list[int], data: st.DataObject, first: int, more: int
) -> None:
    played = data.draw(st.integers(0, len(numbers)))
    memory = make_history(numbers, played)
    told_first, payloads = memory.find_messages(CHANNEL, first, first + more)
    assert (told_first, [int.from_bytes(p, "big") for p in payloads]) == answer_naively(
        numbers[:played], first, first + more
    )


@given(st.integers(0, 150), st.integers(0, 150), st.integers(0, 150), st.sampled_from([1, 900]))
def test_without_gaps_answers_equal_a_sites(
    count: int, first: int, more: int, size: int
) -> None:
    """Messages of 2 bytes, and of 1800, of which fewer fit an answer."""
    ring = ChannelBuffer(200, 400_000)
    for number in range(count):
        ring.store(number.to_bytes(2, "big") * size)
    memory = make_history(list(range(count)), count, size)
    messages = memory.find_messages(CHANNEL, first, first + more)
    assert messages == ring.read_chunk(first, first + more)
    assert sum(map(len, messages[1])) <= BACKFILL_BYTES


def test_unplayed_messages_are_not_sent() -> None:
    memory = make_history(list(range(30)), 10)
    assert len(memory.find_messages(CHANNEL, 0, 29)[1]) == 10
    assert memory.find_messages(CHANNEL, 10, 29) == (10, [])


def test_forgotten_messages_are_missing() -> None:
    memory = make_history(list(range(200)), 200, kept_ns=50)
    first, payloads = memory.find_messages(CHANNEL, 0, 199)
    assert 130 <= first <= 150
    assert int.from_bytes(payloads[0], "big") == first


def test_forgetting_removes_everything_before() -> None:
    memory = make_history(list(range(30)), 30)
    memory.clear()
    assert memory.find_messages(CHANNEL, 3, 9) == (30, [])
    assert memory.find_messages(CHANNEL, 40, 50) == (40, [])
    assert memory.find_messages(99, 0, 9) == (0, [])
