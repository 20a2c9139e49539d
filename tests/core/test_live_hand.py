"""A live hand: its holder, its target, and continuity of its force and target."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.core.life.live_hand import (
    ANOTHER_HOLDS,
    GRIP_NS,
    OUT_OF_ORDER,
    RELEASED,
    SILENCE_NS,
    SILENT,
    TAKEN,
    HandCommand,
    HandInForce,
    HandMemory,
    HandReach,
    HandRules,
    HandStep,
    find_stopping_speed,
)

RULES = HandRules(size=2, rate_hz=1000, speed_limit=1.5)
ARM = (1.0, 0.5)


def advance_ticks(
    messages: dict[int, Sequence[HandCommand]], ticks: int, rules: HandRules = RULES
) -> list[HandStep]:
    """Returns the hand's state in each tick, with the given messages before some ticks."""
    memory = HandMemory()
    steps = []
    for k in range(ticks):
        t_ns = k * 10**9 // rules.rate_hz
        step = rules.advance(memory, t_ns, messages.get(k, ()), lambda: ARM)
        memory = step.memory
        steps.append(step)
    return steps


def list_hands(steps: list[HandStep]) -> list[HandInForce]:
    """Returns the message in force in each tick."""
    return [HandInForce.read(step.vector) for step in steps]


def message_at(
    k: int, target: tuple[float, ...], n: int | None = None, **fields: Any
) -> dict[int, Any]:
    """Returns a message of hand 7 that comes at tick k."""
    message = {
        "source": 7,
        "number": k if n is None else n,
        "grip": True,
        "target": target,
        "sent_ns": k * 10**6,
    }
    return {k: [HandCommand(**{**message, **fields})]}


def test_holds_begin_without_force_and_grow() -> None:
    steps = advance_ticks(message_at(10, (1.2, 0.5)), 150)
    before, first, *rest = list_hands(steps)[9:]
    assert before == HandInForce.read(HandInForce.list_empty(2))
    assert first.target == ARM
    assert first.grip == 0.0
    assert steps[10].changes == ((7, TAKEN),)
    grips = [hand.grip for hand in rest]
    assert np.allclose(np.diff([0.0, *grips[:100]]), 1e6 / GRIP_NS)
    assert grips[-1] == 1.0


def test_the_target_glides_linearly_between_messages() -> None:
    """Sixty messages a second of a hand that moves at 0.6 m/s: the target moves at 0.6 m/s
    without steps.
    """
    messages: dict[int, Any] = {}
    for n in range(60):
        k = round(n * 1000 / 60)
        messages |= message_at(k, (1.0 + 0.6 * k / 1000, 0.5))
    moved = np.array([hand.target[0] for hand in list_hands(advance_ticks(messages, 1000))])
    speed = np.diff(moved)[200:] * 1000
    assert speed == pytest.approx(0.6, abs=0.05)
    assert moved[-1] == pytest.approx(1.0 + 0.6 * 0.99, abs=0.02)


def test_the_speed_of_the_target_is_limited() -> None:
    steps = list_hands(advance_ticks(message_at(0, (50.0, 0.5)), 180))
    rates = [math.hypot(*hand.rate) for hand in steps]
    assert max(rates) == pytest.approx(1.5)
    assert steps[-1].target[0] == pytest.approx(1.0 + 1.5 * 0.179)


def test_a_silent_hand_lets_go_and_fades() -> None:
    steps = advance_ticks(message_at(0, (1.1, 0.5)) | message_at(150, (1.1, 0.5), n=0), 500)
    held = list_hands(steps)
    changes = {k: step.changes for k, step in enumerate(steps) if step.changes}
    last_ns = SILENCE_NS + 150_000_000
    assert changes == {0: ((7, TAKEN),), last_ns // 10**6 + 1: ((7, SILENT),)}
    gone = next(k for k, hand in enumerate(held) if k > 200 and hand.grip == 0.0)
    assert gone * 10**6 <= last_ns + GRIP_NS + 2 * 10**6
    fading = held[last_ns // 10**6 + 1 : gone]
    assert {hand.target for hand in fading} == {held[300].target}
    assert {hand.rate for hand in fading} == {(0.0, 0.0)}


def test_the_next_holder_follows_a_release() -> None:
    release = message_at(50, (), n=50, grip=False)
    second = {
        40: [HandCommand(9, 0, True, (2.0, 2.0), 0)],
        160: [HandCommand(9, 1, True, (1.0, 0.6), 0)],
    }
    steps = advance_ticks(message_at(0, (1.1, 0.5)) | release | second, 200)
    assert steps[40].refused == (ANOTHER_HOLDS,)
    assert steps[50].changes == ((7, RELEASED),)
    assert steps[160].changes == ((9, TAKEN),)
    again = list_hands(steps)[160]
    assert again.target == ARM
    assert again.grip == 0.0


@pytest.mark.parametrize("source", [7, 9], ids=["the same", "another"])
@pytest.mark.parametrize("starts_at_arm", [True, False], ids=["a target", "a force"])
def test_a_new_holder_continues_a_fading_grip(source: int, starts_at_arm: bool) -> None:
    """After 20 ms of fading the grip was 0.79, and fell to 0 in one tick."""
    rules = RULES._replace(starts_at_arm=starts_at_arm)
    again = {220: [HandCommand(source, 220, True, (1.0, 0.6), 0)]}
    steps = advance_ticks(
        message_at(0, (1.1, 0.5))
        | message_at(150, (1.1, 0.5), n=0)
        | message_at(199, (), grip=False)
        | again,
        400,
        rules,
    )
    assert [steps[k].changes for k in (199, 220)] == [((7, RELEASED),), ((source, TAKEN),)]
    held = list_hands(steps)
    assert held[220].grip == pytest.approx(0.79)
    assert held[220].target == held[219].target
    grips = [hand.grip for hand in held]
    assert np.abs(np.diff(grips)).max() <= 1e6 / GRIP_NS + 1e-12
    assert max(math.dist(a.target, b.target) for a, b in pairwise(held[1:])) <= 1.5e-3 + 1e-12
    assert grips[-1] == 1.0


def test_an_overtaken_message_changes_nothing() -> None:
    """A message that comes after the same hand has let go does not take hold again either."""
    late = {
        30: [HandCommand(7, 5, True, (9.0, 9.0), 0)],
        70: [HandCommand(7, 49, True, (9.0, 9.0), 0)],
    }
    steps = advance_ticks(
        message_at(10, (1.1, 0.5)) | message_at(50, (), n=50, grip=False) | late, 200
    )
    assert steps[30].refused == steps[70].refused == (OUT_OF_ORDER,)
    assert steps[-1].vector == HandInForce.list_empty(2)


def test_a_silent_hand_resumes_its_goal() -> None:
    steps = advance_ticks(message_at(0, (1.1, 0.5)) | message_at(400, (1.1, 0.5), n=0), 402)
    assert [change for step in steps for _, change in step.changes] == [TAKEN, SILENT, TAKEN]


def test_a_force_begins_at_zero() -> None:
    rules = HandRules(size=2, rate_hz=1000, starts_at_arm=False)
    steps = list_hands(advance_ticks(message_at(0, (8.0, 0.0)), 120, rules))
    assert steps[0].target == (0.0, 0.0)
    assert steps[-1].target == pytest.approx((8.0, 0.0))


COMMANDS = st.builds(
    HandCommand,
    source=st.integers(1, 3),
    number=st.integers(0, 20),
    grip=st.booleans(),
    target=st.tuples(*[st.floats(-100.0, 100.0)] * 2),
    sent_ns=st.integers(-(2**58), 2**58),
)


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.integers(0, 400), st.lists(COMMANDS, max_size=4), max_size=40))
def test_grips_are_continuous_and_targets_limited(messages: Any) -> None:
    steps = list_hands(advance_ticks(messages, 500))
    most = 1e6 / GRIP_NS + 1e-12
    for before, now in pairwise(steps):
        assert abs(now.grip - before.grip) <= most
        assert math.hypot(*now.rate) <= 1.5 + 1e-9
        if before.source and now.source == before.source and now.grip > 0.0:
            moved = math.dist(before.target, now.target)
            assert moved <= 1.5e-3 + 1e-12
    assert all(
        math.isfinite(x) for hand in steps for x in (*hand.target, *hand.rate, hand.grip)
    )


# The acceleration of a target

LIMIT_M_S2 = 20.0
LIMITED = RULES._replace(acceleration_limit=LIMIT_M_S2)
H_S = 1e-3


@given(
    speed=st.floats(1e-6, 10.0),
    acceleration=st.floats(0.1, 100.0),
    h_s=st.sampled_from([1e-4, 1e-3, 5e-3]),
)
def test_stopping_distance_matches_stopping_speed(
    speed: float, acceleration: float, h_s: float
) -> None:
    """Eq.

    (L1): the ways of ticks at v, v - a h, ... add up to the distance whose stopping speed v is.
    """
    step = acceleration * h_s
    ways = [h_s * (speed - n * step) for n in range(int(speed / step) + 1)]
    assert find_stopping_speed(sum(ways), acceleration, h_s) == pytest.approx(speed, rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.integers(0, 400), st.lists(COMMANDS, max_size=4), max_size=40))
def test_target_keeps_both_limits_whatever_messages_come(messages: Any) -> None:
    """The limits hold also for messages that let go, fall silent, or take over a fading grip."""
    steps = list_hands(advance_ticks(messages, 600, LIMITED))
    assert all(math.hypot(*now.rate) <= 1.5 + 1e-9 for now in steps)
    for before, now in pairwise(steps):
        if now.grip > 0.0 and before.grip > 0.0:
            assert math.dist(before.rate, now.rate) <= LIMIT_M_S2 * H_S + 1e-12
            moved = [x + v * H_S for x, v in zip(before.target, before.rate, strict=True)]
            assert now.target == pytest.approx(moved, abs=1e-12)


@settings(max_examples=12, deadline=None)
@given(goal=st.tuples(st.floats(-1.0, 3.0), st.floats(-1.0, 2.0)), limit=st.floats(5.0, 200.0))
def test_targets_reach_still_goals_without_overshoot(
    goal: tuple[float, float], limit: float
) -> None:
    rules = RULES._replace(acceleration_limit=limit)
    way = [x - start for x, start in zip(goal, ARM, strict=True)]
    distance = math.hypot(*way)
    # a hand repeats its last message while nothing changes
    messages = {k: message_at(k, goal, n=0)[k] for k in range(0, 3000, 50)}
    steps = list_hands(advance_ticks(messages, 3000, rules))
    for now in steps:
        moved = [x - start for x, start in zip(now.target, ARM, strict=True)]
        along = sum(a * b for a, b in zip(moved, way, strict=True)) / max(distance, 1e-9)
        assert along <= distance + 1e-9
        assert math.hypot(*moved) == pytest.approx(abs(along), abs=1e-9)
    assert steps[-1].target == pytest.approx(goal, abs=1e-9)
    assert math.hypot(*steps[-1].rate) < 1e-9


def test_targets_overshoot_returning_goals_by_stopping_distance() -> None:
    messages = (
        message_at(0, (4.0, 0.5))
        | message_at(199, (4.0, 0.5), n=0)
        | message_at(200, (1.1, 0.5))
    )
    messages |= {k: message_at(k, (1.1, 0.5), n=200)[k] for k in range(250, 2000, 50)}
    steps = list_hands(advance_ticks(messages, 2000, LIMITED))
    way = max(now.target[0] for now in steps) - steps[200].target[0]
    assert 0.0 < way <= 1.5**2 / (2.0 * LIMIT_M_S2) + 1.5 * H_S / 2.0
    assert min(now.target[0] for now in steps[400:]) >= 1.1 - 1e-9
    assert steps[-1].target == pytest.approx((1.1, 0.5))


@pytest.mark.parametrize("gap", [10, 25, 60, 150])
def test_bursty_messages_never_jerk_the_force(gap: int) -> None:
    """A hand at 0.3 m/s whose states come in bursts: its spring and damper change by 0.85 N in a tick."""
    stiffness_n_m = 300.0
    damping_n_s_m = 20.0
    messages: dict[int, Any] = {}
    for k in range(0, 3000, 10):
        tip_m = (1.0 + 0.1 * math.sin(3.0 * k * H_S), 0.5)
        # every other 100 ms the machine hands over late
        arrives = k + gap if (k // 100) % 2 else k
        messages.setdefault(arrives - arrives % gap, []).extend(message_at(k, tip_m)[k])
    for limits, least, most in ((LIMITED, 0.0, 0.85), (RULES, 0.0 if gap == 10 else 2.0, 40.0)):
        steps = list_hands(advance_ticks(messages, 3000, limits))
        force = [
            stiffness_n_m * now.target[0] + damping_n_s_m * now.rate[0]
            for now in steps
            if now.source
        ]
        assert least <= np.abs(np.diff(force)).max() <= most + 1e-9


# The reach of an arm


def test_goals_beyond_reach_move_to_nearest_place() -> None:
    ring = HandReach((0.0, 0.0), 0.5, 2.0)
    assert ring.find_nearest((3.0, 4.0)) == pytest.approx((1.2, 1.6))
    assert ring.find_nearest((0.0, 0.1)) == pytest.approx((0.0, 0.5))
    assert math.hypot(*ring.find_nearest((0.0, 0.0))) == 0.5
    assert ring.find_nearest((1.0, -1.0)) == (1.0, -1.0)
    box = HandReach(low=(-1.0, -math.inf), high=(1.0, 2.0))
    assert box.find_nearest((-3.0, 5.0)) == (-1.0, 2.0)
    assert HandReach().find_nearest((50.0, 60.0)) == (50.0, 60.0)


@settings(max_examples=15, deadline=None)
@given(st.dictionaries(st.integers(0, 400), st.lists(COMMANDS, max_size=2), max_size=30))
def test_targets_leave_reach_by_stopping_distance_only(messages: Any) -> None:
    rules = LIMITED._replace(reach=HandReach((0.0, 0.0), 0.0, 2.0))
    steps = list_hands(advance_ticks(messages, 500, rules))
    stopping_m = 1.5**2 / (2.0 * LIMIT_M_S2) + 1.5 * H_S / 2.0
    assert all(math.hypot(*now.target) <= 2.0 + stopping_m for now in steps)
