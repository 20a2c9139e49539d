"""Computes how programs move the planar arms of several simulated runs at once.

A program, for example a policy in training, can act as the operator of an arm. It decides at a
fixed rate where to pull the arm. `OwnHand` computes the resulting motion for one run. This
module computes it for all runs of a training environment in one call, with the decisions of all
programs in one array. No Python code runs per simulation.

Invariant:
    - The results are bit-identical to those of `OwnHand.advance_span`, provided that each
      program decides in time. `SeveralHands.explain` states why a program is not supported.
"""

import math
from typing import NamedTuple

import numpy as np

from ..step.jit import leaf
from ..step.ticks import tick_ns
from ..step.vectors import Array, IntArray
from .live_hand import GLIDE_NS, GRIP_NS, SILENCE_NS, HandRules, find_glide_ns, glide

AXES = 2
"""Number of coordinates of an action."""
ACTION_NUMBERS = 1 + 2 * AXES
"""Number of values of an action in one tick: the grip, the target, and the target extrapolated
by one second.
"""


class _HandArrays(NamedTuple):
    """State and limits of the programs that pull the arms, for L simulations in parallel.

    Each row belongs to one simulation. The quantities are described in `HandMemory` and
    `HandRules`.

    Attributes:
        holds: 1 if the program holds the arm, shape (L,).
        grip: Firmness of the grip, 0 to 1, shape (L,).
        target: Position of the target, m or rad, or the force, N, shape (L, 2).
        rate: Velocity of the target, shape (L, 2).
        goal: Position towards which the target moves, or the force, shape (L, 2).
        arrives_ns: Time at which the target reaches the goal, ns since the start of the
            session.
        starts_at_arm: 1 if the target starts at the pose of the arm, 0 if it starts at zero.
        speed_limit: Largest speed of the target, m/s or rad/s.
        acceleration: Largest acceleration of the target, m/s^2 or rad/s^2.
        centre: Centre of the reachable shell, m, shape (L, 2).
        radii_m: Inner and outer radius of the shell, shape (L, 2); 0 and inf if there is no
            shell.
        low: Smallest coordinates of a goal, rad or m, shape (L, 2).
        high: Largest coordinates of a goal, rad or m, shape (L, 2).
    """

    holds: IntArray
    grip: Array
    target: Array
    rate: Array
    goal: Array
    arrives_ns: IntArray
    starts_at_arm: IntArray
    speed_limit: Array
    acceleration: Array
    centre: Array
    radii_m: Array
    low: Array
    high: Array


@leaf
def _put_nearest_goal(lane: int, goal: Array, hands: _HandArrays) -> None:
    """Stores the goal of a program, projected onto the reachable region.

    The goal is projected first onto a box and then onto a spherical shell, exactly as
    `HandReach.find_nearest` does for a single simulation.

    Args:
        lane: Index of the run among the runs that are computed in parallel.
        goal: The goal, shape (2,), m or rad.
        hands: State of the hands in all runs; the goal is written into it.
    """
    for i in range(AXES):
        hands.goal[lane, i] = min(max(goal[i], hands.low[lane, i]), hands.high[lane, i])
    inner_m = hands.radii_m[lane, 0]
    outer_m = hands.radii_m[lane, 1]
    has_shell = inner_m != 0.0 or outer_m != math.inf
    if not has_shell:
        return

    offset_x = hands.goal[lane, 0] - hands.centre[lane, 0]
    offset_y = hands.goal[lane, 1] - hands.centre[lane, 1]
    distance_m = math.sqrt(offset_x * offset_x + offset_y * offset_y)
    if inner_m <= distance_m <= outer_m:
        return

    allowed_m = min(max(distance_m, inner_m), outer_m)
    if distance_m == 0.0:
        # From the centre all directions are equally near: choose the first axis.
        offset_x = 1.0
        distance_m = 1.0
    factor = allowed_m / distance_m
    hands.goal[lane, 0] = hands.centre[lane, 0] + factor * offset_x
    hands.goal[lane, 1] = hands.centre[lane, 1] + factor * offset_y


@leaf
def _advance_hands(
    runs: int,
    first: IntArray,
    count: int,
    rate_hz: int,
    period_ticks: int,
    is_idle: IntArray,
    acts: IntArray,
    goals: Array,
    poses: Array,
    hands: _HandArrays,
    rows: Array,
    actions: Array,
) -> None:
    """Computes the grips and targets that programs apply to the arms of several simulations.

    Each simulation has one program. Its decision at the first tick remains in effect for all
    these ticks.

    Args:
        runs: Number of runs.
        first: First tick to compute in each run, shape (L,).
        count: Number of ticks to compute.
        rate_hz: Tick rate of the sites, Hz.
        period_ticks: Time between decisions, ticks.
        is_idle: 1 for runs that are not advanced, shape (L,).
        acts: 1 for runs in which a decision takes effect at the first tick, shape (L,).
        goals: The decisions that take effect: the position towards which the arm is pulled, m
            or rad, or the force, N, shape (L, 2).
        poses: Pose of the arm at the first tick, m or rad, shape (L, 2).
        hands: State of the hands in all runs; modified.
        rows: Buffer for the actions of one run, shape (ticks, 3 + 2 * 2).
        actions: Receives the grip, the target, and the target extrapolated by one second, for
            each tick and lane, shape (ticks, 5, L).
    """
    grip_step = 1e9 / (GRIP_NS * rate_hz)
    for lane in range(runs):
        if is_idle[lane]:
            continue
        if acts[lane]:
            t_ns = tick_ns(first[lane], rate_hz)
            glide_ns = GLIDE_NS
            if hands.holds[lane]:
                before_ns = tick_ns(first[lane] - period_ticks, rate_hz)
                glide_ns = find_glide_ns(t_ns - before_ns, rate_hz)
            else:
                # At its first tick a hold has no force, and its target has not moved yet:
                # `glide` adds a step to the grip, and to the target a velocity of -0.0, which
                # keeps all bits of the target, even those of -0.0.
                hands.holds[lane] = 1
                hands.grip[lane] = -grip_step
                for i in range(AXES):
                    hands.target[lane, i] = poses[lane, i] if hands.starts_at_arm[lane] else 0.0
                    hands.rate[lane, i] = -0.0
            hands.arrives_ns[lane] = t_ns + glide_ns
            _put_nearest_goal(lane, goals[lane], hands)
        if not hands.holds[lane]:
            for n in range(count):
                for i in range(ACTION_NUMBERS):
                    actions[n, i, lane] = 0.0
            continue
        hands.grip[lane] = glide(
            first=first[lane],
            rate_hz=rate_hz,
            grip=hands.grip[lane],
            arrives_ns=hands.arrives_ns[lane],
            speed_limit=hands.speed_limit[lane],
            acceleration=hands.acceleration[lane],
            goal=hands.goal[lane],
            target=hands.target[lane],
            rate=hands.rate[lane],
            rows=rows[:count],
        )
        for n in range(count):
            actions[n, 0, lane] = rows[n, 0]
            for i in range(AXES):
                target = rows[n, 3 + i]
                actions[n, 1 + i, lane] = target
                actions[n, 1 + AXES + i, lane] = target + rows[n, 3 + AXES + i]


class SeveralHands:
    """Computes the grips and targets that programs apply to the arms of several simulations.

    A training environment, for example, simulates many runs in parallel, with one program
    moving one arm in each run. One compiled call then replaces one call per run.

    Args:
        count: Number L of runs.
        most_ticks: Largest number of ticks that one call of `advance` computes.
        rate_hz: Tick rate of the sites, Hz.
        period_ticks: Time between decisions, ticks.

    Attributes:
        arrays: State and limits of the hands.
        actions: Grip, target, and the target extrapolated by one second, for each tick of the
            latest call to `advance` and each run, shape (ticks, 5, L).
    """

    axes = AXES

    def __init__(self, count: int, most_ticks: int, rate_hz: int, period_ticks: int) -> None:
        self._rate_hz = rate_hz
        self._period_ticks = period_ticks
        self._rows = np.zeros((most_ticks, 3 + 2 * AXES))
        self.actions = np.zeros((most_ticks, ACTION_NUMBERS, count))

        def numbers() -> Array:
            return np.zeros(count)

        def pairs() -> Array:
            return np.zeros((count, AXES))

        def integers() -> IntArray:
            return np.zeros(count, np.int64)

        self.arrays = _HandArrays(
            holds=integers(),
            grip=numbers(),
            target=pairs(),
            rate=pairs(),
            goal=pairs(),
            arrives_ns=integers(),
            starts_at_arm=integers(),
            speed_limit=numbers(),
            acceleration=numbers(),
            centre=pairs(),
            radii_m=pairs(),
            low=pairs(),
            high=pairs(),
        )

    @staticmethod
    def explain(rules: HandRules, period_ticks: int, largest_action: float) -> str:
        """Returns why a program is not supported by `SeveralHands`, or "" if it is supported.

        For a program that is not supported, the caller computes each simulation separately with
        `OwnHand`.

        Args:
            rules: Limits on the program's actions.
            period_ticks: Time between decisions, ticks.
            largest_action: Largest absolute value of any component of an action.
        """
        if rules.size != AXES:
            return "actions that do not have two numbers"
        if tick_ns(period_ticks, rules.rate_hz) > SILENCE_NS:
            return "steps that last so long that the hand lets go of the arm"
        if math.hypot(largest_action, largest_action) > rules.max_goal_norm:
            return "actions that are larger than the hand accepts"
        return ""

    def begin(self, run: int, rules: HandRules) -> None:
        """Resets one simulation to a state in which the program does not yet hold its arm.

        This method must be called for each simulation before its first tick.

        Args:
            run: Index of the run.
            rules: Limits on the program's actions.
        """
        hands = self.arrays
        reach = rules.reach
        hands.holds[run] = 0
        hands.grip[run] = 0.0
        hands.target[run] = 0.0
        hands.starts_at_arm[run] = rules.starts_at_arm
        hands.speed_limit[run] = rules.speed_limit
        hands.acceleration[run] = rules.acceleration_limit
        hands.centre[run] = reach.centre or (0.0, 0.0)
        hands.radii_m[run] = (0.0, math.inf)
        if reach.centre:
            hands.radii_m[run] = (reach.inner_m, reach.outer_m)
        hands.low[run] = reach.low or (-math.inf, -math.inf)
        hands.high[run] = reach.high or (math.inf, math.inf)

    def advance(
        self,
        runs: int,
        first: IntArray,
        count: int,
        *,
        is_idle: IntArray,
        acts: IntArray,
        goals: Array,
        poses: Array,
    ) -> None:
        """Computes how each program pulls its arm during the next ticks, for all simulations.

        Each simulation has one program and one arm.

        Args:
            runs: Number of runs to advance. Their values are the first entries of each array.
            first: First tick to compute in each run, shape (L,).
            count: Number of ticks to compute.
            is_idle: 1 for runs that are not advanced, shape (L,).
            acts: 1 for runs in which a decision takes effect at the first tick, shape (L,).
            goals: The decisions that take effect, shape (L, 2).
            poses: Pose of the arm at the first tick, m or rad, shape (L, 2).
        """
        _advance_hands(
            runs=runs,
            first=first,
            count=count,
            rate_hz=self._rate_hz,
            period_ticks=self._period_ticks,
            is_idle=is_idle,
            acts=acts,
            goals=goals,
            poses=poses,
            hands=self.arrays,
            rows=self._rows,
            actions=self.actions,
        )
