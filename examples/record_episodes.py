"""Records demonstrations for a policy: episodes in the log, each of which succeeded or failed.

A program leads master m1 to a place around its start, waits there, and judges by the distance
whether it arrived. With `--alone`, lead m1 yourself with the mouse on the page: an episode then
succeeds if m1 ends near the place that the terminal names. A second hand moves master m2 to the
position of m1, as `lerobot-record` does, because a policy will also hold m2. In a log in which
nobody holds m2, its forces are zero, and LeRobot cannot find a scale for them. Run two
terminals:

    trilat demo play --duration 60 -o reach-log
    python examples/record_episodes.py play

When the session has ended, `trilat log export reach-log/run.mcap --to lerobot -o reach
--set observations=plugin --set environment_state=yes --set episodes=marks --set task=reach`
makes a dataset of the episodes (docs/studies/lerobot.md).
"""

import argparse
import math
import random
import time
from collections.abc import Callable
from typing import Any

import trilat_net as tn

RADIUS_M = 0.15
"""Distance of the places from the start, in m."""
NEAR_M = 0.03
"""Largest distance at which an episode has succeeded, in m."""
MOVING_SHARE = 0.6
"""Share of an episode in which the program moves. It waits in the rest."""
PERIOD_S = 0.02


def main() -> None:
    """Connects to the session, and records the episodes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    parser.add_argument("--episodes", type=int, default=5, help="number of episodes")
    parser.add_argument("--seconds", type=float, default=4.0, help="duration of an episode")
    parser.add_argument("--seed", type=int, default=1, help="seed of the places")
    parser.add_argument("--alone", action="store_true", help="let a person lead m1")
    options = parser.parse_args()
    connect = options.connect
    with (
        tn.session(options.session, connect=connect) as session,
        tn.hand(options.session, "m1", source="teacher", connect=connect) as hand,
        tn.hand(options.session, "m2", source="follower", connect=connect) as follower,
    ):
        results = record(
            session=session,
            hand=hand,
            follower=follower,
            leads=not options.alone,
            episodes=options.episodes,
            seconds=options.seconds,
            draw=random.Random(options.seed),
            now_s=time.monotonic,
            wait_s=time.sleep,
        )
    print(f"{sum(results)} of {len(results)} episodes succeeded")


def record(
    session: Any,
    hand: Any,
    follower: Any,
    *,
    leads: bool,
    episodes: int,
    seconds: float,
    draw: random.Random,
    now_s: Callable[[], float],
    wait_s: Callable[[float], None],
) -> list[bool]:
    """Records episodes, and returns for each one whether it succeeded.

    Args:
        session: the running session.
        hand: the operator of m1.
        follower: the operator of m2, which goes where m1 is.
        leads: False if a person moves m1.
        episodes: number of episodes. The end of the session ends them earlier.
        seconds: duration of an episode, in s.
        draw: source of the random places.
        now_s: returns the present time, in s.
        wait_s: waits for a time, in s.
    """
    results: list[bool] = []
    x_m, y_m = hand.pose
    for n in range(1, episodes + 1):
        if hand.over:
            break
        angle = draw.uniform(0.0, 2.0 * math.pi)
        goal_m = x_m + RADIUS_M * math.cos(angle), y_m + RADIUS_M * math.sin(angle)
        print(f"episode {n}: to {goal_m[0]:.2f}, {goal_m[1]:.2f} m")
        with session.episode(f"reach {n}") as judge:
            begin_m = hand.pose
            start_s = now_s()
            while (t_s := now_s() - start_s) < seconds and not hand.over:
                if leads:
                    share = min(1.0, t_s / (MOVING_SHARE * seconds))
                    smooth = share * share * (3.0 - 2.0 * share)
                    place = zip(begin_m, goal_m, strict=True)
                    hand.move(*(begin + smooth * (goal - begin) for begin, goal in place))
                follower.move(*hand.pose)
                wait_s(PERIOD_S)
            results.append(math.dist(hand.pose, goal_m) <= NEAR_M)
            judge(results[-1])
    return results


if __name__ == "__main__":
    main()
