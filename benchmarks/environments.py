"""Compares the processor times of environments that advance side by side and of one environment, in turn."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from trilat_studies.gym_environment import Judgement, ReachTask, Scene, make_env

ENVS = 64
ROUNDS = 7
STEPS = 150
"""Number of steps of half an episode: both forms begin the next episodes after every second round."""
BENT = {f"sites.{name}.q0_rad": [0.4, 1.2] for name in ("m1", "m2", "s")}
VARY = {"link.delay_ms": (0.0, 300.0)}
GAINS = np.random.default_rng(1).normal(0.0, 0.05, (8, 2))


class OwnTask(ReachTask):
    """A task that is judged in Python, one environment after the other."""

    def judge(self, scene: Scene) -> Judgement:
        """Judges a step."""
        return super().judge(scene)


class Case(NamedTuple):
    """An environment, and the source of its actions."""

    label: str
    settings: Mapping[str, Any]
    act: Callable[[Any, Any], Any]
    bar: str
    has_resets: bool = True


def draw(_: Any, drawn: Any) -> Any:
    """Returns actions that were drawn in advance."""
    return drawn


def decide(observation: Any, _: Any) -> Any:
    """Returns the actions of a linear policy for one observation or for many."""
    parts = [observation[name] for name in ("q", "qd", "goal", "target")]
    return np.tanh(np.concatenate(parts, axis=-1) @ GAINS)


CASES = (
    Case("steps alone, actions given", {"duration_s": 60.0}, draw, "6", has_resets=False),
    Case("steps alone, a policy in NumPy", {"duration_s": 60.0}, decide, "4", has_resets=False),
    Case("episodes of 6 s, actions given", {}, draw, "none"),
    Case("episodes of 6 s, a policy in NumPy", {}, decide, "4"),
    Case("episodes of 6 s, a task of one's own", {"task": OwnTask("s")}, draw, "none"),
)


def run() -> list[str]:
    lines = [
        f"{ENVS} environments of paper side by side, on one core, compared with one alone:"
    ]
    return lines + [_compare(case) for case in CASES]


def _compare(case: Case) -> str:
    """Measures both forms alternately."""
    settings = {"duration_s": 6.0, "vary": VARY, "user": "m2", **case.settings}
    envs = make_env("paper", BENT, num_envs=ENVS, autoreset_mode="SameStep", **settings)
    env = make_env("paper", BENT, **settings)
    assert not envs.obstacle
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, ENVS, 2))
    batch, _ = envs.reset(seed=1)
    observation, _ = env.reset(seed=1)

    def step_all() -> None:
        nonlocal batch
        for drawn in actions:
            batch, *_ = envs.step(case.act(batch, drawn))

    def step_one() -> None:
        nonlocal observation
        for drawn in actions[:, 0]:
            observation, _, ends, is_cut, _ = env.step(case.act(observation, drawn))
            if ends or is_cut:
                observation, _ = env.reset()

    rounds = 2 if case.has_resets else 1  # a round has as many resets as the others
    pairs = []
    for n in range(ROUNDS + 1):
        pair = []
        for work, count in ((step_all, ENVS), (step_one, 1)):
            begun = time.process_time()
            for _ in range(rounds):
                work()
            pair.append((time.process_time() - begun) / (rounds * STEPS * count))
        if n:  # the first round compiles
            pairs.append(pair)
    ratio = statistics.median(alone_s / side_s for side_s, alone_s in pairs)
    side_us, alone_us = (1e6 * min(times) for times in zip(*pairs, strict=True))
    return (
        f"  {case.label}: {side_us:.1f} us a step, alone {alone_us:.1f} us; "
        f"{ratio:.1f} times as fast (median of {ROUNDS}; bar: >= {case.bar})"
    )
