"""Compares how a person takes over from a failing policy: along a ramp, at once, or not at all.

A small policy is trained without delay (examples/train_over_delay.py). It then leads the slave
over a network with 200 ms delay and bursts of loss, where it fails. A model of a person holds
the other master. After two seconds the person gets the lead, along a ramp of two seconds or at
once, and moves to the goal. For twenty goals, the example prints

- success: how often the slave stays within 5 cm of its goal in the last second;
- jump: the largest step of a reference while the lead changes, divided by the largest step of
  the motion itself; none if the lead does not change;
- without control: the time in which the slave did not follow anybody.

It takes about a minute:

    make extras EXTRAS=gym  # after the first release: pip install 'trilat-net[gym]'
    python examples/takeover.py
"""

import argparse
import math
from typing import Any

import numpy as np
from train_over_delay import FIRM, NETWORKS, STUDIES, interval, train

import trilat_net as tn

TAKEN_S = 2.0
"""Time at which the person gets the lead, in s."""
RAMP_S = 2.0
LASTS_S = 10.0
NEAR_M = 0.05
WAYS = {"not taken over": None, "at once": 0.001, f"ramp of {RAMP_S:g} s": RAMP_S}


def run(weights: np.ndarray, seed: int, ramp_s: float | None) -> dict[str, float]:
    """Simulates one goal, and returns success, distance, jump, and time without control.

    Args:
        weights: weights of the policy.
        seed: seed of the goal and of the network.
        ramp_s: duration of the change of the lead, in s. If `None`, the policy keeps the lead.
    """
    random = np.random.default_rng(seed)
    base = STUDIES["reach"].scenario
    start_m = tn.load_scenario("paper", base).arms["s"].end_effector(base["sites.s.q0_rad"])
    angle = random.uniform(0.0, 2.0 * math.pi)
    distance_m = random.uniform(0.15, 0.3)
    goal_m = [
        start_m[0] + distance_m * math.cos(angle),
        start_m[1] + distance_m * math.sin(angle),
    ]
    policy = {"goal_m": goal_m, "weights": weights.tolist()}
    hand = {
        "kind": "own",
        "class": "reach_policy:ReachPolicy",
        "rate_hz": 25,
        **FIRM,
        "settings": policy,
    }
    person = {"kind": "tip_spring", "to_m": goal_m, **FIRM}
    overrides: dict[str, Any] = {
        **base,
        **NETWORKS["200 ms, bursts"],
        "dominance.s": {"m1": 0.1, "m2": 0.9},
        "sites.m1.hands": [{**person, "move_start_s": TAKEN_S, "move_end_s": TAKEN_S + 3.0}],
        "sites.m2.hands": [{**hand, "force_limit_n": 200.0}],
        "seed": seed,
    }
    if ramp_s is not None:
        change = {
            "at_s": TAKEN_S,
            "dominance": "s",
            "to": {"m1": 0.9, "m2": 0.1},
            "ramp_s": ramp_s,
        }
        overrides["timeline"] = [change]
    log = tn.simulate("paper", overrides, duration_s=LASTS_S)
    slave = log["s"]
    last_second = slave.q[slave.t_s >= LASTS_S - 1.0]
    positions_m = np.array([log.scenario.arms["s"].end_effector(q) for q in last_second[::10]])
    distances_m = np.linalg.norm(positions_m - goal_m, axis=1)
    lead_jump = tn.metrics(log).run["lead_jump"].value
    return {
        "success": float((distances_m < NEAR_M).all()),
        "distance_mm": 1e3 * float(distances_m.mean()),
        "jump": math.nan if lead_jump is None else float(lead_jump),
        "without_control_s": float((slave.mode != "run").sum()) / slave.rate_hz,
    }


def describe_jump(runs: list[dict[str, float]]) -> str:
    """Returns the mean jump of some runs and its interval, or "none" if no lead changed."""
    jumps = np.array([result["jump"] for result in runs])
    if np.isnan(jumps).all():
        return "none"
    mean, low, high = interval(jumps)
    return f"{mean:.2f} [{low:.2f}, {high:.2f}]"


def main() -> None:
    """Trains the policy, simulates all goals, and prints the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--goals", type=int, default=20)
    options = parser.parse_args()
    weights = train(STUDIES["reach"], "no delay", 0)
    print(f"{options.goals} goals, 95 % intervals of the mean")
    for name, ramp_s in WAYS.items():
        runs = [run(weights, seed, ramp_s) for seed in range(options.goals)]
        success = interval(np.array([result["success"] for result in runs]))
        distance = interval(np.array([result["distance_mm"] for result in runs]))
        without_s = max(result["without_control_s"] for result in runs)
        print(
            f"  {name:<14}  success {success[0]:.2f} [{success[1]:.2f}, {success[2]:.2f}]"
            f"  distance {distance[0]:.1f} mm [{distance[1]:.1f}, {distance[2]:.1f}]"
            f"  jump {describe_jump(runs)}"
            f"  without control {without_s:g} s"
        )


if __name__ == "__main__":
    main()
