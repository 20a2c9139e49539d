"""Does it matter over which network a policy is trained? Two policies of each of twenty seeds, both tested.

Each seed trains one policy without delay and one over 200 ms with bursts of loss, by an evolution strategy,
with the same budget; both are then tested on both networks, on goals that neither has seen. What is printed
and drawn is how far the slave is from its goal, or where the box that it pushes ends from its own, with 95 %
intervals over seeds. At most ten minutes a task on two cores:

    pip install 'trilat-net[gym]'
    python examples/train_over_delay.py --out policies.png
    pip install 'trilat-net[sim]'
    python examples/train_over_delay.py --task box --out box.png
"""

import argparse
import json
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from reach_policy import decide

import trilat_net as tn

NETWORKS: dict[str, dict[str, Any]] = {
    "no delay": {"link.delay_ms": 0.0},
    "200 ms, bursts": {"link.delay_ms": 200.0, "link.loss": 0.3, "link.loss_burst": 50.0},
}
START = [-0.6, 1.2]
FIRM = {"stiffness_n_m": 2000.0, "damping_n_s_m": 200.0}
USERS: dict[str, Any] = {
    "dominance.s": {"m1": 0.4, "m2": 0.6},
    "sites.m1.hands": [{"kind": "tip_spring", **FIRM}],
    "sites.m2.hands": [{"kind": "live", "force_limit_n": 200.0, **FIRM}],
}
"""A person rests at m1 and has two fifths of the slave, so that the program has to see where the slave is."""
SCENE = {
    "class": "scene:Scene",
    "bodies": {"box": [0.2, 0.2, 0.2]},
    "ahead_m": 0.15,
    "friction": 0.2,
}


class PushTask:
    """The box that the slave pushes ahead is to end at a place; the user sees where the slave is to end.

    What was pushed too far cannot be pulled back. The reward is how much nearer the box has come, m.
    """

    bound = 100.0

    def __init__(self) -> None:
        self.goal, self.box_goal_m, self.apart_m = np.zeros(2), 0.0, 0.0

    def begin(self, random: np.random.Generator, scene: Any) -> None:
        """Draws the way of the box, 5 to 20 cm."""
        start_m, tip_m = scene.bodies["s"]["box"][0], scene.end_effector_m["s"]
        self.box_goal_m = start_m + random.uniform(0.05, 0.2)
        self.apart_m = abs(start_m - self.box_goal_m)
        self.goal = np.array([self.box_goal_m - 0.13, tip_m[1]])

    def judge(self, scene: Any) -> float:
        """Returns the reward of a step."""
        before_m = self.apart_m
        self.apart_m = abs(scene.bodies["s"]["box"][0] - self.box_goal_m)
        return before_m - self.apart_m


class Study(NamedTuple):
    """A task, the experiment in which it is done, and what its cost says."""

    scenario: dict[str, Any]
    make_task: Callable[[], Any]
    rounds: int
    pairs: int
    rate: float
    measure: str


STUDIES = {
    "reach": Study(
        {
            "control": {"law": "p_d", "K": 100.0, "d": 40.0},
            "rate_hz": 500,
            **{f"sites.{name}.q0_rad": START for name in ("m1", "m2", "s")},
            **USERS,
        },
        lambda: None,
        24,
        5,
        0.3,
        "mean distance of the slave from its goal",
    ),
    "box": Study(
        {
            "control": {"law": "p_d", "K": 100.0, "d": 40.0},
            "rate_hz": 250,
            **{f"sites.{name}.q0_rad": [-0.9, 1.6] for name in ("m1", "m2", "s")},
            "sites.s.plant": SCENE,
            **USERS,
        },
        PushTask,
        10,
        4,
        0.6,
        "distance of the box from its goal at the end",
    ),
}
STEP_HZ, EPISODE_S = 25, 4.0
SPREAD = 0.15
TESTS = 12
FIRST = np.array([0.2, 0.0, 0.0, 0.0])


def make_env(study: Study, network: str) -> Any:
    """Returns the environment of a network."""
    how = {"user": "m2", "rate_hz": STEP_HZ, "duration_s": EPISODE_S, "mode": "tip"}
    return tn.make_env(
        "paper", {**study.scenario, **NETWORKS[network]}, task=study.make_task(), **how
    )


def play(env: Any, weights: np.ndarray, seed: int) -> float:
    """Returns the cost of an episode, m; see `Study.measure`."""
    seen, _ = env.reset(seed=seed)
    total = 0.0
    for _ in range(int(EPISODE_S * STEP_HZ)):
        action = decide(
            weights, seen["goal"], seen["pose"], seen["peer_q"][1], seen["peer_qd"][1]
        )
        seen, reward, ended, _, info = env.step(action)
        total -= reward - float(info["success"])
        if ended and not info["success"]:
            return EPISODE_S
        if ended:
            break
    task = env.unwrapped.task
    return float(task.apart_m) if isinstance(task, PushTask) else total / EPISODE_S


def train(study: Study, network: str, seed: int) -> np.ndarray:
    """Returns the weights that an evolution strategy finds: pairs of opposite steps, weighed by cost."""
    env, random = make_env(study, network), np.random.default_rng(seed)
    weights = FIRST.copy()
    for n in range(study.rounds):
        steps = random.normal(size=(study.pairs, len(weights)))
        episode = int(random.integers(2**31))
        costs = [
            [play(env, weights + sign * SPREAD * step, episode + pair) for sign in (1.0, -1.0)]
            for pair, step in enumerate(steps)
        ]
        gain = np.array(costs)[:, 1] - np.array(costs)[:, 0]
        scale = max(float(np.abs(gain).max()), 1e-9)
        weights = (
            weights
            + study.rate * (1.0 - n / study.rounds) * (gain / scale) @ steps / study.pairs
        )
    return weights


def run_seed(name: str, seed: int) -> dict[str, Any]:
    """Returns what one seed finds: weights by network, and costs by network of training and of test."""
    sys.path.insert(0, str(Path(__file__).parent / "mujoco"))
    study = STUDIES[name]
    weights = {network: train(study, network, seed) for network in NETWORKS}
    costs = {}
    for there in NETWORKS:
        env = make_env(study, there)
        for here in NETWORKS:
            tests = [
                play(env, weights[here], 10_000_019 * (seed + 1) + n) for n in range(TESTS)
            ]
            costs[f"{here} -> {there}"] = float(np.mean(tests))
    return {
        "seed": seed,
        "weights": {name: one.tolist() for name, one in weights.items()},
        "costs": costs,
    }


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Returns the mean and a 95 % interval of it, by 10 000 bootstrap samples."""
    random = np.random.default_rng(0)
    means = random.choice(values, (10_000, len(values))).mean(axis=1)
    return float(values.mean()), *map(float, np.quantile(means, [0.025, 0.975]))


def report(found: list[dict[str, Any]], measure: str) -> dict[str, tuple[float, float, float]]:
    """Prints the table, and the paired difference that the question is about; returns the intervals."""
    columns = {
        name: np.array([one["costs"][name] for one in found]) for name in found[0]["costs"]
    }
    calm, hard = NETWORKS
    columns["difference"] = columns[f"{calm} -> {hard}"] - columns[f"{hard} -> {hard}"]
    print(f"{measure}, mm, {len(found)} seeds, 95 % interval of the mean")
    spans = {name: interval(1e3 * values) for name, values in columns.items()}
    for name, (mean, low, high) in spans.items():
        what = f"trained -> tested: {name}"
        if "->" not in name:
            what = f"at {hard}: trained at {calm}, minus trained there"
        print(f"  {what:<62} {mean:7.1f}  [{low:.1f}, {high:.1f}]")
    return spans


def draw(found: list[dict[str, Any]], measure: str, path: Path) -> None:
    """Draws every seed, and the means: a row for each network of a test and each of training."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 2.8), layout="constrained")
    rows = [(here, there) for there in NETWORKS for here in NETWORKS]
    for place, (here, there) in enumerate(rows):
        values = 1e3 * np.array([one["costs"][f"{here} -> {there}"] for one in found])
        colour = f"C{list(NETWORKS).index(here)}"
        axes.plot(values, np.full(len(values), place), "o", alpha=0.4, color=colour)
        axes.plot(values.mean(), place, "|", markersize=20, markeredgewidth=2, color="black")
    axes.set_yticks(
        range(len(rows)), [f"trained: {here}\ntested: {there}" for here, there in rows]
    )
    axes.set_xlabel(f"{measure}, mm;\na dot a seed, a bar their mean")
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)
    print(path)


def main() -> None:
    """Trains, tests, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=STUDIES, default="reach")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("policies.png"))
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs) as pool:
        found = list(pool.map(partial(run_seed, options.task), range(options.seeds)))
    measure = STUDIES[options.task].measure
    report(found, measure)
    options.out.with_suffix(".json").write_text(json.dumps(found, indent=1), newline="\n")
    draw(found, measure, options.out)


if __name__ == "__main__":
    main()
