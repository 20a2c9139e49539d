"""A person takes over from a policy that fails: by a ramp of the dominance factors, at once, or not at all.

A small policy is trained without delay (examples/train_over_delay.py) and leads the slave over 200 ms with
bursts of loss, where it fails. A model of a person holds the other master, and moves to the goal once it has
the lead: after two seconds, by a ramp of two seconds or at once. What is printed, over twenty
goals: how often the slave is within 5 cm of its goal for the last second, the largest step of any reference
while the lead changes over the largest step of the motion itself, and for how long nobody had control: ticks
in which the slave did not follow. About a minute:

    pip install 'trilat-net[gym]'
    python examples/takeover.py
"""

import argparse
import math
from typing import Any

import numpy as np
from train_over_delay import FIRM, NETWORKS, STUDIES, interval, train

import trilat_net as tn

TAKEN_S, RAMP_S, LASTS_S, NEAR_M = 2.0, 2.0, 10.0, 0.05
WAYS = {"not taken over": None, "at once": 0.001, f"ramp of {RAMP_S:g} s": RAMP_S}


def run(weights: np.ndarray, seed: int, ramp_s: float | None) -> dict[str, float]:
    """Returns what became of one goal: success, jump, and time without control."""
    random = np.random.default_rng(seed)
    base = STUDIES["reach"].scenario
    start_m = tn.load_scenario("paper", base).arms["s"].end_effector(base["sites.s.q0_rad"])
    angle, way_m = random.uniform(0.0, 2.0 * math.pi), random.uniform(0.15, 0.3)
    goal_m = [start_m[0] + way_m * math.cos(angle), start_m[1] + way_m * math.sin(angle)]
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
    last = slave.q[slave.t_s >= LASTS_S - 1.0]
    places = np.array([log.scenario.arms["s"].end_effector(q) for q in last[::10]])
    apart_m = np.linalg.norm(places - goal_m, axis=1)
    lead_jump = tn.metrics(log).run["lead_jump"].value
    return {
        "success": float((apart_m < NEAR_M).all()),
        "apart_mm": 1e3 * float(apart_m.mean()),
        "jump": math.nan if lead_jump is None else float(lead_jump),
        "without_control_s": float((slave.mode != "run").sum()) / slave.rate_hz,
    }


def main() -> None:
    """Trains, takes over, prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--goals", type=int, default=20)
    options = parser.parse_args()
    weights = train(STUDIES["reach"], "no delay", 0)
    print(f"{options.goals} goals, 95 % intervals of the mean")
    for name, ramp_s in WAYS.items():
        found = [run(weights, seed, ramp_s) for seed in range(options.goals)]
        shares = interval(np.array([one["success"] for one in found]))
        apart = interval(np.array([one["apart_mm"] for one in found]))
        jump = interval(np.array([one["jump"] for one in found]))
        without_s = max(one["without_control_s"] for one in found)
        print(
            f"  {name:<14}  success {shares[0]:.2f} [{shares[1]:.2f}, {shares[2]:.2f}]"
            f"  distance {apart[0]:.1f} mm [{apart[1]:.1f}, {apart[2]:.1f}]"
            f"  jump {jump[0]:.2f} [{jump[1]:.2f}, {jump[2]:.2f}]  without control {without_s:g} s"
        )


if __name__ == "__main__":
    main()
