"""A user's own hand acts a fixed time after its observation, however long its decision takes
(L2 for hands).
"""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.core.life.live_hand import HandInForce, HandRules
from trilat_net.core.life.own_hand import PROGRAM, OwnHand

PLACE = (0.5, -0.25)
EVERY = 20
DELAY = 30
TICKS = 400


def make_hand(delay: int = DELAY, *, starts_at_arm: bool = True) -> OwnHand:
    rules = HandRules(2, 1000, 1.5, starts_at_arm, 100.0)
    return OwnHand(rules, EVERY, delay, lambda _: PLACE)


def advance_tick(hand: OwnHand, k: int) -> HandInForce:
    return HandInForce.read(hand.advance_to(k, lambda: PLACE).vector)


def advance_ticks(
    decisions: dict[int, tuple[int, Sequence[float] | None]], delay: int = DELAY
) -> list[HandInForce]:
    """Returns the hand's state at every tick, for decisions by the tick at which they come."""
    hand = make_hand(delay)
    hand_states = []
    for k in range(TICKS):
        for sent_tick, goal in (decision for at, decision in decisions.items() if at == k):
            hand.accept_decision(sent_tick, goal)
        hand_states.append(advance_tick(hand, k))
    return hand_states


@given(st.lists(st.integers(0, DELAY), min_size=5, max_size=5))
def test_decisions_that_come_in_time_act_alike(thinks: list[int]) -> None:
    """Each decision takes another computing time, no longer than the hand's delay."""
    goals = {EVERY * n: (0.5 + 0.01 * n, -0.25) for n in range(5)}
    prompt = advance_ticks({sent_tick: (sent_tick, goal) for sent_tick, goal in goals.items()})
    pairs = zip(goals.items(), thinks, strict=True)
    arrivals = sorted((sent_tick + took, sent_tick, goal) for (sent_tick, goal), took in pairs)
    in_order: dict[int, tuple[int, Sequence[float] | None]] = {}
    for arrival_tick, sent_tick, goal in arrivals:
        if arrival_tick not in in_order and all(
            sent_tick > other for other, _ in in_order.values()
        ):
            in_order[arrival_tick] = sent_tick, goal
    later = advance_ticks(in_order)
    first = min(in_order)
    assert [state.number for state in later[:first]] == [-1] * first
    if len(in_order) == len(goals):
        assert later == prompt


def test_hands_take_hold_after_their_delay() -> None:
    hand_states = advance_ticks({0: (0, (0.6, -0.25))})
    held = [k for k, state in enumerate(hand_states) if state.source == PROGRAM]
    assert held[0] == DELAY
    assert hand_states[DELAY].target == PLACE


def test_a_decision_that_is_late_acts_at_once() -> None:
    hand_states = advance_ticks({DELAY + 7: (0, (0.6, -0.25))})
    assert [state.source for state in hand_states[DELAY : DELAY + 9]] == [0] * 7 + [PROGRAM] * 2


def test_an_older_decision_is_ignored() -> None:
    both = advance_ticks({25: (20, (0.6, -0.25)), 26: (0, (9.0, 9.0))})
    assert both == advance_ticks({25: (20, (0.6, -0.25))})


def test_without_decision_the_grip_fades() -> None:
    hand_states = advance_ticks(
        {n: (n, (0.6, -0.25)) for n in range(0, 200, EVERY)} | {200: (200, None)}
    )
    assert hand_states[200 + DELAY].source == 0
    assert 0.0 < hand_states[200 + DELAY].grip <= 1.0
    assert hand_states[200 + DELAY + 101].grip == 0.0


def test_hands_say_when_they_need_the_arm() -> None:
    hand = make_hand(delay=50)
    assert [hand.find_next_event(k) for k in (0, 19, 20)] == [20, 20, 40]
    hand.accept_decision(0, (0.6, -0.25))
    assert [hand.find_next_event(k) for k in (41, 49, 50)] == [50, 50, 60]


@pytest.mark.parametrize(
    ("goal", "problem"),
    [
        ((1.0,), "1 number, not 2"),
        ((1.0, 2.0, 3.0), "3 numbers, not 2"),
        ((math.nan, 0.0), "not finite"),
        ((math.inf, 0.0), "not finite"),
        ((80.0, 80.0), "norm of 113.137, but at most 100 is accepted"),
    ],
)
def test_an_invalid_goal_is_refused(goal: tuple[float, ...], problem: str) -> None:
    hand = make_hand()
    with pytest.raises(ValueError, match=problem):
        hand.accept_decision(0, goal)
    assert advance_tick(hand, 0).source == 0


@given(
    st.lists(
        st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)) | st.none(),
        min_size=1,
        max_size=14,
    ),
    st.integers(0, 45),
    st.floats(0.05, 2.0),
    st.just(math.inf) | st.floats(1.0, 100.0),
)
def test_compiled_spans_equal_ticks_bit_for_bit(
    goals: list[tuple[float, float] | None],
    delay: int,
    speed_limit: float,
    acceleration_limit: float,
) -> None:
    """Goals come at every 20th tick, and then stop for longer than the silence that lets go."""
    rules = HandRules(
        2,
        1000,
        speed_limit,
        starts_at_arm=True,
        max_goal_norm=100.0,
        acceleration_limit=acceleration_limit,
    )
    by_tick, by_span = (OwnHand(rules, EVERY, delay, lambda _: PLACE) for _ in range(2))
    singles = []
    for k in range(EVERY * len(goals) + 500):
        if k % EVERY == 0 and k // EVERY < len(goals):
            by_tick.accept_decision(k, goals[k // EVERY])
        singles.append(by_tick.advance_to(k, lambda: PLACE).vector)
    k = 0
    spans = []
    while k < len(singles):
        if k % EVERY == 0 and k // EVERY < len(goals):
            by_span.accept_decision(k, goals[k // EVERY])
        rows = by_span.advance_span(k, len(singles), lambda: PLACE)
        spans += rows.tolist()
        k += len(rows)
    assert np.array(spans).tobytes() == np.array(singles).tobytes()
