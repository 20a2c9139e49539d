"""Messages in packed batches are the same messages."""

from hypothesis import given
from hypothesis import strategies as st

from trilat_net.app.play.batch import BatchBuilder, MessageBatch

messages = st.lists(
    st.tuples(
        st.integers(-(2**60), 2**60),
        st.integers(0, 3),
        st.integers(0, 2**40) | st.integers(0, 3),
        st.binary(max_size=9) | st.binary(max_size=1),
    ),
    max_size=20,
)
Messages = list[tuple[int, int, int, bytes]]


def gather_messages(messages_in: Messages, kept: MessageBatch | None = None) -> BatchBuilder:
    gathering = BatchBuilder(kept)
    for message in messages_in:
        gathering.add(*message)
    return gathering


@given(messages)
def test_payloads_stay_with_channel_and_number(messages_in: Messages) -> None:
    """Duplicates, as in two parts of one session, appear once."""
    block = gather_messages(messages_in).ordered()
    assert sorted(message[1:] for message in block.messages()) == sorted(
        {message[1:] for message in messages_in}
    )
    assert [block.payload(n) for n in range(len(block))] == [
        message[3] for message in block.messages()
    ]


@given(messages, st.integers(1, 7))
def test_pieces_and_own_bytes_are_the_whole(messages_in: Messages, size: int) -> None:
    block = gather_messages(messages_in).ordered()
    whole = list(block.messages())
    pieces = list(block.pieces(size))
    assert all(len(piece) and len(piece.compact().data) <= size + 9 for piece in pieces)
    assert [message for piece in pieces for message in piece.messages()] == whole
    assert [message for piece in pieces for message in piece.compact().messages()] == whole


@given(messages, messages)
def test_ordered_messages_may_be_ordered_again_with_more(
    first: Messages, two: Messages
) -> None:
    """The numbers of the messages ascend in the file, as in a complete log."""
    rising = [
        (t_ns, channel, n, payload + b".")
        for n, (t_ns, channel, _, payload) in enumerate(first + two)
    ]
    again = gather_messages(
        rising[len(first) :], gather_messages(rising[: len(first)]).ordered()
    )
    assert list(again.ordered().messages()) == list(
        gather_messages(rising).ordered().messages()
    )
