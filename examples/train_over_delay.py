"""Does it matter over which network a policy is trained? Two policies of each of twenty seeds, both tested.

Each seed trains one policy without delay and one over 200 ms with bursts of loss, by an evolution strategy,
with the same budget; both are then tested on both networks, on places that neither has seen. What is printed
and drawn is the mean distance of the slave from its goal, with 95 % intervals over seeds. About ten minutes
on two cores:

    pip install 'trilat-net[gym]'
    python examples/train_over_delay.py --out policies.png
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from reach_policy import decide

import trilat_net as tn

NETWORKS: dict[str, dict[str, Any]] = {
    "no delay": {"link.delay_ms": 0.0},
    "200 ms, bursts": {"link.delay_ms": 200.0, "link.loss": 0.3, "link.loss_burst": 50.0},
}
START = [-0.6, 1.2]
FIRM = {"stiffness_n_m": 2000.0, "damping_n_s_m": 200.0}
SCENARIO: dict[str, Any] = {
    "control": {"law": "p_d", "K": 100.0, "d": 40.0},
    "dominance.s": {"m1": 0.4, "m2": 0.6},
    "rate_hz": 500,
    **{f"sites.{name}.q0_rad": START for name in ("m1", "m2", "s")},
    "sites.m1.hands": [{"kind": "tip_spring", **FIRM}],
    "sites.m2.hands": [{"kind": "live", "force_limit_n": 200.0, **FIRM}],
}
"""A person rests at m1 and has two fifths of the slave, so that the program has to see where the slave is."""
STEP_HZ, EPISODE_S = 25, 4.0
ROUNDS, PAIRS, SPREAD, RATE = 24, 5, 0.15, 0.3
TESTS = 12
FIRST = np.array([0.2, 0.0, 0.0, 0.0])


def make_env(network: str) -> Any:
    """Returns the environment of a network."""
    how = {"user": "m2", "rate_hz": STEP_HZ, "duration_s": EPISODE_S, "mode": "tip"}
    return tn.make_env("paper", {**SCENARIO, **NETWORKS[network]}, **how)


def play(env: Any, weights: np.ndarray, seed: int) -> float:
    """Returns how far the slave is from the goal in an episode, on average over its time, m."""
    seen, _ = env.reset(seed=seed)
    total = 0.0
    for _ in range(int(EPISODE_S * STEP_HZ)):
        action = decide(weights, seen["goal"], seen["pose"], seen["peer_q"][1], seen["peer_qd"][1])
        seen, reward, ended, _, info = env.step(action)
        total -= reward - float(info["success"])
        if ended and not info["success"]:
            return EPISODE_S
        if ended:
            break
    return total / EPISODE_S


def train(network: str, seed: int) -> np.ndarray:
    """Returns the weights that an evolution strategy finds: pairs of opposite steps, weighed by cost."""
    env, random = make_env(network), np.random.default_rng(seed)
    weights = FIRST.copy()
    for n in range(ROUNDS):
        steps = random.normal(size=(PAIRS, len(weights)))
        episode = int(random.integers(2**31))
        costs = [
            [play(env, weights + sign * SPREAD * step, episode + pair) for sign in (1.0, -1.0)]
            for pair, step in enumerate(steps)
        ]
        gain = np.array(costs)[:, 1] - np.array(costs)[:, 0]
        scale = max(float(np.abs(gain).max()), 1e-9)
        weights = weights + RATE * (1.0 - n / ROUNDS) * (gain / scale) @ steps / PAIRS
    return weights


def run_seed(seed: int) -> dict[str, Any]:
    """Returns what one seed finds: weights by network, and costs by network of training and of test."""
    weights = {network: train(network, seed) for network in NETWORKS}
    costs = {}
    for there in NETWORKS:
        env = make_env(there)
        for here in NETWORKS:
            tests = [play(env, weights[here], 10_000_019 * (seed + 1) + n) for n in range(TESTS)]
            costs[f"{here} -> {there}"] = float(np.mean(tests))
    return {"seed": seed, "weights": {name: one.tolist() for name, one in weights.items()}, "costs": costs}


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Returns the mean and a 95 % interval of it, by 10 000 bootstrap samples."""
    random = np.random.default_rng(0)
    means = random.choice(values, (10_000, len(values))).mean(axis=1)
    return float(values.mean()), *map(float, np.quantile(means, [0.025, 0.975]))


def report(found: list[dict[str, Any]]) -> dict[str, tuple[float, float, float]]:
    """Prints the table, and the paired difference that the question is about; returns the intervals."""
    columns = {name: np.array([one["costs"][name] for one in found]) for name in found[0]["costs"]}
    calm, hard = NETWORKS
    columns["difference"] = columns[f"{calm} -> {hard}"] - columns[f"{hard} -> {hard}"]
    print(f"mean distance of the slave from its goal, mm, {len(found)} seeds, 95 % interval of the mean")
    spans = {name: interval(1e3 * values) for name, values in columns.items()}
    for name, (mean, low, high) in spans.items():
        what = f"trained -> tested: {name}"
        if "->" not in name:
            what = f"at {hard}: trained at {calm}, minus trained there"
        print(f"  {what:<62} {mean:7.1f}  [{low:.1f}, {high:.1f}]")
    return spans


def draw(found: list[dict[str, Any]], path: Path) -> None:
    """Draws every seed, and the means: a row for each network of a test and each of training."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 2.8), layout="constrained")
    rows = [(here, there) for there in NETWORKS for here in NETWORKS]
    for place, (here, there) in enumerate(rows):
        values = 1e3 * np.array([one["costs"][f"{here} -> {there}"] for one in found])
        colour = f"C{list(NETWORKS).index(here)}"
        axes.plot(values, np.full(len(values), place), "o", alpha=0.4, color=colour)
        axes.plot(values.mean(), place, "|", markersize=20, markeredgewidth=2, color="black")
    axes.set_yticks(range(len(rows)), [f"trained: {here}\ntested: {there}" for here, there in rows])
    axes.set_xlabel("mean distance from the goal, mm; a dot a seed, a bar their mean")
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)
    print(path)


def main() -> None:
    """Trains, tests, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("policies.png"))
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        found = list(pool.map(run_seed, range(options.seeds)))
    report(found)
    options.out.with_suffix(".json").write_text(json.dumps(found, indent=1), newline="\n")
    draw(found, options.out)


if __name__ == "__main__":
    main()
