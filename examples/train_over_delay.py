"""Trains policies over different networks: does the network of the training matter?

For each of twenty seeds, an evolution strategy trains one policy without delay and one over 200
ms delay with bursts of loss, with the same budget. Both are tested on both networks, with goals
that neither has seen. The result is the distance of the slave from its goal, or of a pushed box
from its goal, with 95 % intervals over the seeds. A task takes at most ten minutes on two
cores:

    make extras EXTRAS=gym,sim  # after the first release: pip install 'trilat-net[gym,sim]'
    python examples/train_over_delay.py --out policies.png
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
"""A person holds m1 still and has two fifths of the authority over the slave.

The slave therefore does not simply follow the program, which has to observe it.
"""
SCENE = {
    "class": "scene:Scene",
    "bodies": {"box": [0.2, 0.2, 0.2]},
    "ahead_m": 0.15,
    "friction": 0.2,
}


class PushTask:
    """Task: the slave pushes a box to a goal. It cannot pull the box back.

    The reward of a step is the decrease of the box's distance from its goal, m.

    Attributes:
        goal: position of the slave's end effector at which the box reaches its goal, m. The
            policy observes it.
        box_goal_m: goal of the box along the x axis, m.
        distance_m: present distance of the box from its goal, m.
    """

    bound = 100.0

    def __init__(self) -> None:
        self.goal = np.zeros(2)
        self.box_goal_m = 0.0
        self.distance_m = 0.0

    def begin(self, random: np.random.Generator, scene: Any) -> None:
        """Draws a goal 5 to 20 cm in front of the box."""
        start_m = scene.bodies["s"]["box"][0]
        tip_m = scene.end_effector_m["s"]
        self.box_goal_m = start_m + random.uniform(0.05, 0.2)
        self.distance_m = abs(start_m - self.box_goal_m)
        self.goal = np.array([self.box_goal_m - 0.13, tip_m[1]])

    def judge(self, scene: Any) -> float:
        """Returns the reward of a step."""
        previous_m = self.distance_m
        self.distance_m = abs(scene.bodies["s"]["box"][0] - self.box_goal_m)
        return previous_m - self.distance_m


class Study(NamedTuple):
    """A task, and the settings of its training.

    Attributes:
        scenario: keys of the scenario in which the task is done.
        make_task: returns a new task. If `None`, the task is that of the environment, reaching.
        rounds: number of rounds of the evolution strategy.
        pairs: number of pairs of opposite perturbations per round.
        rate: step size of the first round; it falls to zero linearly.
        measure: meaning of the cost of an episode.
    """

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
STEP_HZ = 25
EPISODE_S = 4.0
SPREAD = 0.15
"""Standard deviation of the perturbations of a weight."""
TESTS = 12
"""Number of episodes of a test."""
FIRST = np.array([0.2, 0.0, 0.0, 0.0])
"""Weights with which the training starts."""


def make_env(study: Study, network: str) -> Any:
    """Returns the environment of a task over a network."""
    return tn.make_env(
        "paper",
        {**study.scenario, **NETWORKS[network]},
        task=study.make_task(),
        user="m2",
        rate_hz=STEP_HZ,
        duration_s=EPISODE_S,
        mode="tip",
    )


def play(env: Any, weights: np.ndarray, seed: int) -> float:
    """Returns the cost of an episode, m. `Study.measure` states its meaning."""
    observation, _ = env.reset(seed=seed)
    total = 0.0
    for _ in range(int(EPISODE_S * STEP_HZ)):
        action = decide(
            weights=weights,
            goal_m=observation["goal"],
            pose=observation["pose"],
            slave_q=observation["peer_q"][1],
            slave_qd=observation["peer_qd"][1],
        )
        within = np.clip(action, env.action_space.low, env.action_space.high)
        observation, reward, ended, _, info = env.step(within)
        total -= reward - float(info["success"])
        if ended and not info["success"]:
            return EPISODE_S  # an episode that ends early without success costs most
        if ended:
            break
    task = env.unwrapped.task
    return float(task.distance_m) if isinstance(task, PushTask) else total / EPISODE_S


def train(study: Study, network: str, seed: int) -> np.ndarray:
    """Returns the weights that an evolution strategy finds.

    In each round, pairs of opposite perturbations are tried. The weights move along each
    perturbation in proportion to the difference of the two costs.
    """
    env = make_env(study, network)
    random = np.random.default_rng(seed)
    weights = FIRST.copy()
    for n in range(study.rounds):
        directions = random.normal(size=(study.pairs, len(weights)))
        episode = int(random.integers(2**31))
        costs = np.zeros((study.pairs, 2))
        for pair, direction in enumerate(directions):
            for column, sign in enumerate((1.0, -1.0)):
                tried = weights + sign * SPREAD * direction
                costs[pair, column] = play(env, tried, episode + pair)
        gain = costs[:, 1] - costs[:, 0]
        scale = max(float(np.abs(gain).max()), 1e-9)
        rate = study.rate * (1.0 - n / study.rounds)
        weights = weights + rate * (gain / scale) @ directions / study.pairs
    return weights


def run_seed(name: str, seed: int) -> dict[str, Any]:
    """Trains and tests the policies of one seed.

    Args:
        name: name of the task.
        seed: the seed.

    Returns:
        The weights by network of training, and the costs by networks of training and of test.
    """
    sys.path.insert(0, str(Path(__file__).parent / "mujoco"))
    study = STUDIES[name]
    weights = {network: train(study, network, seed) for network in NETWORKS}
    costs = {}
    for tested in NETWORKS:
        env = make_env(study, tested)
        for trained in NETWORKS:
            tests = [
                play(env, weights[trained], 10_000_019 * (seed + 1) + n) for n in range(TESTS)
            ]
            costs[f"{trained} -> {tested}"] = float(np.mean(tests))
    return {
        "seed": seed,
        "weights": {network: array.tolist() for network, array in weights.items()},
        "costs": costs,
    }


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """Returns the mean, and its 95 % interval from 10 000 bootstrap samples."""
    random = np.random.default_rng(0)
    means = random.choice(values, (10_000, len(values))).mean(axis=1)
    return float(values.mean()), *map(float, np.quantile(means, [0.025, 0.975]))


def report(found: list[dict[str, Any]], measure: str) -> dict[str, tuple[float, float, float]]:
    """Prints the mean cost of each combination of networks, and the difference in question.

    Args:
        found: results of all seeds, see `run_seed`.
        measure: meaning of the cost.

    Returns:
        The mean and its interval, in mm, by combination.
    """
    columns = {
        name: np.array([result["costs"][name] for result in found])
        for name in found[0]["costs"]
    }
    calm, hard = NETWORKS
    columns["difference"] = columns[f"{calm} -> {hard}"] - columns[f"{hard} -> {hard}"]
    print(f"{measure}, mm, {len(found)} seeds, 95 % interval of the mean")
    spans = {name: interval(1e3 * values) for name, values in columns.items()}
    for name, (mean, low, high) in spans.items():
        label = f"trained -> tested: {name}"
        if "->" not in name:
            label = f"tested at {hard}: trained at {calm}, minus trained there"
        print(f"  {label:<62} {mean:7.1f}  [{low:.1f}, {high:.1f}]")
    return spans


def draw(found: list[dict[str, Any]], measure: str, path: Path) -> None:
    """Draws the cost of every seed and the means, with a row per combination of networks."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 2.8), layout="constrained")
    rows = [(trained, tested) for tested in NETWORKS for trained in NETWORKS]
    for row, (trained, tested) in enumerate(rows):
        costs_m = [result["costs"][f"{trained} -> {tested}"] for result in found]
        costs_mm = 1e3 * np.array(costs_m)
        colour = f"C{list(NETWORKS).index(trained)}"
        axes.plot(costs_mm, np.full(len(costs_mm), row), "o", alpha=0.4, color=colour)
        axes.plot(costs_mm.mean(), row, "|", markersize=20, markeredgewidth=2, color="black")
    labels = [f"trained: {trained}\ntested: {tested}" for trained, tested in rows]
    axes.set_yticks(range(len(rows)), labels)
    axes.set_xlabel(f"{measure}, mm;\ndots: seeds, bars: their means")
    axes.set_xlim(left=0.0)
    axes.invert_yaxis()
    figure.savefig(path, dpi=150)
    print(path)


def main() -> None:
    """Trains and tests the policies of all seeds, and prints and draws the result."""
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
