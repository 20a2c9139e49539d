"""The player on a clock of the test's own: every message once, in order, at its due time."""

import math
from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.app.play.batch import BatchBuilder, MessageBatch
from trilat_net.app.play.message_source import MessageSource
from trilat_net.app.play.player import (
    CUT_NS,
    LOOP_PAUSE_NS,
    SERVICE_EVERY_NS,
    Pace,
    Player,
    PlayProgress,
)
from trilat_net.app.play.session_reader import SessionHeader
from trilat_net.app.play.site_stand_ins import PlayedHistory
from trilat_net.scenario import load_scenario

from .clocks import LookedAt

MS = 1_000_000
messages = st.lists(st.tuples(st.integers(0, 60), st.integers(0, 2)), min_size=1, max_size=60)


def make_block(messages_in: Iterable[tuple[int, int]]) -> MessageBatch:
    gathering = BatchBuilder()
    for number, (t_ms, channel) in enumerate(sorted(messages_in)):
        gathering.add(t_ms * MS, channel, number, bytes([number]))
    return gathering.ordered()


HEADER = SessionHeader("s", load_scenario("paper"), "", "", 0)


def make_source(messages_in: Iterable[tuple[int, int]]) -> MessageSource:
    return MessageSource(HEADER, make_block(messages_in))


class Trickle:
    """A source that gives its messages in pieces, and sometimes nothing between two pieces."""

    whole = False
    strays = 0

    def __init__(self, blocks: list[MessageBatch | None]) -> None:
        self._blocks = blocks
        self._left = iter(blocks)
        self.ended = False

    def poll(self) -> MessageBatch | None:
        try:
            return next(self._left)
        except StopIteration:
            self.ended = True
            return None

    def fill(self) -> bool:
        return False

    def restart(self) -> None:
        self._left = iter(self._blocks)
        self.ended = False

    def close(self) -> None:
        pass


class Stage:
    """The inputs of a player, and its output: (when, on which channel, what)."""

    def __init__(
        self, source: MessageSource | Trickle, *, low_cpu: bool = False, stop_at: int = 10**9
    ) -> None:
        self.clock = LookedAt()
        self.memory = PlayedHistory()
        self.heard: list[tuple[int, int, int]] = []
        self.looks: list[tuple[int, PlayProgress]] = []
        self.stall_ns: dict[int, int] = {}
        self.player = Player(
            source,
            self.memory,
            self.clock,
            lambda channel: lambda payload: self._hear(channel, payload),
            lambda progress: self.looks.append((self.clock.now_ns, progress)),
            lambda: len(self.heard) >= stop_at,
            low_cpu=low_cpu,
        )

    def play(self, rate: float = 1.0, later_ns: int = 0, *, loop: bool = False) -> Pace:
        pace = Pace(self.clock.now_ns + later_ns, 0, rate)
        self.player.prepare()
        self.player.play(pace, loop=loop)
        return pace

    def _hear(self, channel: int, payload: bytes) -> None:
        self.heard.append((self.clock.now_ns, channel, payload[0]))
        self.clock.now_ns += self.stall_ns.get(len(self.heard), 0)


@pytest.mark.parametrize("low_cpu", [False, True])
@given(
    messages_in=messages,
    rate=st.sampled_from([0.5, 1.0, 4.0, math.inf]),
    cuts=st.lists(st.integers(0, 60)),
)
def test_messages_are_published_once_at_their_deadlines(
    messages_in: list[tuple[int, int]], rate: float, cuts: list[int], low_cpu: bool
) -> None:
    whole = make_block(messages_in)
    edges = sorted({0, len(whole), *(cut for cut in cuts if cut < len(whole))})
    pieces: list[MessageBatch | None] = []
    for begin, end in pairwise(edges):
        pieces += [whole.part(slice(begin, end)), None]
    for source in (MessageSource(HEADER, whole), Trickle(pieces)):
        stage = Stage(source, low_cpu=low_cpu)
        first_ns = stage.player.prepare()
        assert first_ns == whole.times_ns[0]
        pace = Pace(stage.clock.now_ns + 50 * MS, first_ns, rate)
        stage.player.play(pace)
        assert [number for _, _, number in stage.heard] == list(range(len(messages_in)))
        assert [channel for _, channel, _ in stage.heard] == whole.channels.tolist()
        for (heard_ns, _, _), t_ns in zip(stage.heard, whole.times_ns.tolist(), strict=True):
            assert heard_ns >= pace.due_ns(t_ns)
            if math.isfinite(rate):  # a source that trickles makes wait for a millisecond
                assert heard_ns <= pace.due_ns(t_ns) + (
                    len(pieces) * MS if isinstance(source, Trickle) else 10**5
                )
        assert sum(stage.player.counts) == len(messages_in)
        assert stage.memory.next_numbers == {c: n + 1 for _, c, n in stage.heard}


def test_late_messages_delay_no_later_ones() -> None:
    """A publisher that waits for 30 ms: messages due meanwhile follow at once, all others are in time."""
    stage = Stage(make_source((t, 0) for t in range(60)))
    stage.stall_ns[10] = 30 * MS
    pace = stage.play()
    late_ms = [round((ns - pace.due_ns(n * MS)) / MS) for ns, _, n in stage.heard]
    assert late_ms == [0] * 10 + list(range(29, 0, -1)) + [0] * 21
    assert 28_900 <= stage.player.lateness.max_us <= 29_100
    assert stage.player.stalls == 0
    assert stage.player.held_ns == pytest.approx(30 * MS, rel=0.01)


def test_publishers_waiting_for_seconds_are_counted() -> None:
    stage = Stage(make_source([(0, 0), (1, 0)]))
    stage.stall_ns[1] = CUT_NS
    stage.play()
    assert stage.player.stalls == 1


def test_rounds_have_the_same_messages() -> None:
    stage = Stage(make_source([(0, 0), (5, 1), (7, 0)]), stop_at=7)
    pace = stage.play(later_ns=MS, loop=True)
    assert [n for _, _, n in stage.heard] == [0, 1, 2, 0, 1, 2, 0]
    assert stage.player.rounds == 3
    round_ns = 7 * MS + LOOP_PAUSE_NS
    due_ns = [pace.due_ns(t * MS) + n * round_ns for n in range(3) for t in (0, 5, 7)][:7]
    assert [
        heard - due for (heard, _, _), due in zip(stage.heard, due_ns, strict=True)
    ] == pytest.approx([0] * 7, abs=10_000)
    assert stage.memory.find_messages(0, 0, 9) == (0, [b"\0"])


@pytest.mark.parametrize("count", [1, 5, 300])
def test_players_stop_on_request(count: int) -> None:
    """A player stops between two messages, at its next check."""
    stage = Stage(make_source((t % 60, 0) for t in range(250)), stop_at=count)
    stage.play()
    assert count <= len(stage.heard) <= count + 10 or len(stage.heard) == 250


def test_other_tasks_run_without_spare_time() -> None:
    """Other tasks run a hundred times a second at the highest rate, and a thousand times in idle periods."""
    stage = Stage(make_source((0, 0) for _ in range(200)))
    for n in range(200):
        stage.stall_ns[n] = MS
    stage.play(math.inf)
    looked = [ns for ns, _ in stage.looks]
    assert len(looked) >= 10
    assert (
        max(later - earlier for earlier, later in pairwise(looked)) <= SERVICE_EVERY_NS + 2 * MS
    )
    quiet = Stage(make_source([(0, 0), (60, 0)]))
    quiet.play()
    assert len(quiet.looks) >= 40
    assert [progress.published for _, progress in quiet.looks][-1] == 1


def test_empty_sources_play_nothing() -> None:
    stage = Stage(Trickle([None, None]))
    assert stage.player.prepare() is None
    assert stage.player.lateness.summary() is None
