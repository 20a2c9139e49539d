"""Environments that advance side by side give the bits of environments one by one."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from study_builders import assert_same_bits
from trilat_studies.gym_environment import (
    EpisodeError,
    Judgement,
    ReachTask,
    Scene,
    TeleoperationEnv,
)

import trilat_net as tn
from trilat_net.errors import UsageError

pytestmark = pytest.mark.filterwarnings("ignore:the action")
BENT = {f"sites.{name}.q0_rad": [0.4, 1.2] for name in ("m", "s")}
VARY = {"link.delay_ms": (0.0, 300.0)}
BASE: dict[str, Any] = {
    "scenario": "two_sites",
    "set": BENT,
    "user": "m",
    "duration_s": 0.5,
    "vary": VARY,
}


class EndingTask:
    """A task that ends at a drawn step and reads all numbers of the scene."""

    bound = 10.0

    def __init__(self) -> None:
        self.goal = np.zeros(3)
        self.steps = 0
        self.last_step = 0

    def begin(self, random: np.random.Generator, _: Scene) -> None:
        self.goal = random.normal(size=3)
        self.steps = 0
        self.last_step = int(random.integers(3, 12))

    def judge(self, scene: Scene) -> Judgement:
        self.steps += 1
        self.goal = self.goal + 0.01
        view = scene.view
        peer = view.peers[0]
        vectors = [*view[2:8], *scene.q.values(), *scene.end_effector_m.values(), *peer[4:]]
        reward = sum(float(np.sum(vector)) for vector in vectors)
        reward += view.k + view.t_s + view.grip + scene.t_s
        reward += peer.alpha + peer.tick + peer.age_s + 10 * peer.new
        succeeded = self.steps >= self.last_step
        return Judgement(reward, succeeded=succeeded, failed=self.steps == 7)


CASES: dict[str, dict[str, Any]] = {
    "drawn delays": {},
    "lossy links": {"vary": {**VARY, "link.loss": (0.0, 0.9)}},
    "success": {"task": ReachTask("s", within_m=0.28, stay_s=0.1)},
    "own task": {"task": EndingTask()},
    "limits": {"vary": {**VARY, "limits.qd_limit_rad_s": (0.2, 3.0)}},
    "limits, late": {"delay_ms": 33.0, "vary": {"limits.qd_limit_rad_s": (0.2, 3.0)}},
    "slow policy": {"delay_ms": 250.0, "rate_hz": 5, "duration_s": 2.0},
    "flat": {"flat": True, "normalize": True},
    "straight arm": {"set": {"sites.m.q0_rad": [0.0, 0.0], "sites.s.q0_rad": [0.4, 1.2]}},
}
LONG_CASES: dict[str, dict[str, Any]] = {
    "force": {"mode": "force", "vary": {**VARY, "limits.qd_limit_rad_s": (0.2, 3.0)}},
    "joint": {"mode": "joint", "delay_ms": 7.0, "rate_hz": 20},
    "three sites": {
        "scenario": "paper",
        "user": "m2",
        "set": {f"sites.{name}.q0_rad": [0.4, 1.2] for name in ("m1", "m2", "s")},
    },
    "silent peers": {"set": {**BENT, "on_stale.action": "glide"}, "delay_ms": 150.0},
    "a law of its own": {"set": {**BENT, "control.law": "wave", "scheme": "digital"}},
}


def make_both(settings: dict[str, Any], count: int, mode: str) -> tuple[Any, SyncVectorEnv]:
    """Returns environments side by side, and the same environments one by one."""
    settings = {**BASE, **settings}
    fast = tn.make_env(**copy.deepcopy(settings), num_envs=count, autoreset_mode=mode)
    single = [TeleoperationEnv(**copy.deepcopy(settings)) for _ in range(count)]
    slow = SyncVectorEnv([lambda env=env: env for env in single], autoreset_mode=mode)
    return fast, slow


def draw_actions(env: VectorEnv, random: np.random.Generator) -> Any:
    """Returns actions of which some exceed the bounds."""
    largest = np.minimum(env.action_space.high, 2.1)
    actions = random.uniform(-1.05, 1.05, largest.shape) * largest
    return actions.astype(env.action_space.dtype)


def assert_same_steps(fast: Any, slow: Any, steps: int) -> int:
    """Asserts that all results of both are equal, and returns the number of ended episodes."""
    random = np.random.default_rng(0)
    ends = 0
    for n in range(steps):
        actions = draw_actions(fast, random)
        results = fast.step(actions)
        assert_same_bits(results, slow.step(actions), f"step {n}")
        ends += int((results[2] | results[3]).sum())
    return ends


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    "case", [*CASES, *(pytest.param(name, marks=pytest.mark.long) for name in LONG_CASES)]
)
def test_every_environment_has_its_own_bits(case: str, mode: str) -> None:
    """Random actions, ends and resets give the same results as one by one."""
    fast, slow = make_both({**CASES, **LONG_CASES}[case], 5, mode)
    assert fast.obstacle == ""
    assert_same_bits(fast.reset(seed=3), slow.reset(seed=3))
    assert assert_same_steps(fast, slow, 45) > 0


def test_more_environments_than_lanes_agree() -> None:
    """Environments beyond the number of lanes form further groups."""
    fast, slow = make_both({"task": ReachTask("s", within_m=0.28, stay_s=0.1)}, 70, "NextStep")
    seeds = list(range(70, 0, -1))
    assert_same_bits(fast.reset(seed=seeds), slow.reset(seed=seeds))
    assert assert_same_steps(fast, slow, 12) > 0


def test_structures_may_differ_between_episodes() -> None:
    """An episode with another control law advances alone, beside those in lanes."""
    vary = {**VARY, "control.law": ["adaptive", "p_d"]}
    fast, slow = make_both({"vary": vary}, 6, "NextStep")
    assert fast.obstacle == ""
    assert_same_bits(fast.reset(seed=1), slow.reset(seed=1))
    assert assert_same_steps(fast, slow, 60) > 6


@pytest.mark.filterwarnings("ignore:the environments are stepped")
@pytest.mark.parametrize(
    ("settings", "count", "word"),
    [
        ({}, 1, "fewer than"),
        ({"scenario": "six_joints", "set": {}, "user": "m1", "duration_s": 0.1}, 4, "chains"),
        ({"set": {**BENT, "sites.s.rate_hz": 500}}, 4, "tick rates"),
        ({"rate_hz": 4}, 4, "lets go"),
    ],
)
def test_unsupported_environments_are_stepped_alone(
    settings: dict[str, Any], count: int, word: str
) -> None:
    """What lanes do not support has the same interface, and says why."""
    fast, slow = make_both({**settings, "vary": {}}, count, "NextStep")
    assert word in fast.obstacle
    assert fast.num_envs == count
    assert_same_bits(fast.reset(seed=3), slow.reset(seed=3))
    assert_same_steps(fast, slow, 6)


def test_the_interface_is_that_of_gymnasium() -> None:
    """Spaces are batched, and results lie in them."""
    env = tn.make_env(**BASE, num_envs=4)
    assert isinstance(env, VectorEnv)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    for single, batched in (
        (env.single_observation_space, env.observation_space),
        (env.single_action_space, env.action_space),
    ):
        assert batched == batch_space(single, 4)
        assert is_space_dtype_shape_equiv(batched, batch_space(single, 4))
    env.action_space.seed(1)
    observations, _ = env.reset(seed=1)
    assert observations in env.observation_space
    for _ in range(4):
        observations, rewards, ended, cut, infos = env.step(0.5 * env.action_space.sample())
        assert observations in env.observation_space
        assert rewards.shape == ended.shape == cut.shape == (4,)
        assert infos["_t_s"].all()
    env.close()


def test_results_are_not_changed_later() -> None:
    """The arrays of one step keep their numbers in the next steps."""
    env = tn.make_env(**BASE, num_envs=4)
    env.reset(seed=1)
    actions = np.full((4, 2), 0.5)
    results = env.step(actions)
    kept = copy.deepcopy(results)
    for _ in range(30):
        env.step(actions)
    assert_same_bits(results, kept)


def test_masked_resets_begin_chosen_episodes() -> None:
    """With automatic resets disabled, a mask chooses the episodes that begin."""
    fast, slow = make_both({}, 4, "Disabled")
    assert_same_bits(fast.reset(seed=3), slow.reset(seed=3))
    random = np.random.default_rng(0)
    for n in range(1, 20):
        actions = draw_actions(fast, random)
        assert_same_bits(fast.step(actions), slow.step(actions))
        if n % 6 == 0:
            mask = np.array([True, n == 6, False, n == 12])
            result = fast.reset(options={"reset_mask": mask.copy()})
            assert_same_bits(result, slow.reset(options={"reset_mask": mask.copy()}))


def make_six_steps() -> tuple[Any, SyncVectorEnv]:
    """Returns environments after six steps, side by side and one by one."""
    fast, slow = make_both({"render_mode": "rgb_array"}, 4, "NextStep")
    for env in (fast, slow):
        env.reset(seed=2)
        for _ in range(6):
            env.step(np.full((4, 2), 0.5))
    return fast, slow


def test_pictures_show_the_present_state() -> None:
    """Each sub-environment draws the state after the latest step."""
    fast, slow = make_six_steps()
    for picture, expected in zip(fast.render(), slow.render(), strict=True):
        assert np.array_equal(picture, expected)


def test_saved_episodes_have_the_same_bytes(tmp_path: Path) -> None:
    """The log of a sub-environment is that of the same environment alone."""
    logs = []
    for label, env in zip(("fast", "slow"), make_six_steps(), strict=True):
        paths = [tmp_path / f"{label}{n}.mcap" for n in range(4)]
        for member, path in zip(env.get_attr("unwrapped"), paths, strict=True):
            member.save(path)
        logs.append([tn.open_log(path) for path in paths])
    for log, expected in zip(*logs, strict=True):
        assert log["m"].q.shape == (120, 2)
        assert np.array_equal(log["m"].q, expected["m"].q)


def test_refused_actions_advance_no_environment() -> None:
    """A wrong action leaves all environments where they were."""
    env, other = (tn.make_env(**BASE, num_envs=4) for _ in range(2))
    actions = np.full((4, 2), 0.5)
    with pytest.raises(EpisodeError, match="reset"):
        env.step(actions)
    for both in (env, other):
        both.reset(seed=2)
    bad = actions.copy()
    bad[3, 1] = np.nan
    for wrong, word in ((bad, "action 3"), (actions[:3], "shape"), ("no", "array")):
        with pytest.raises(UsageError, match=word):
            env.step(wrong)
    assert_same_bits(env.step(actions), other.step(actions))


@pytest.mark.parametrize(
    ("argument", "word"),
    [({"num_envs": 0}, "num_envs"), ({"num_envs": 4, "autoreset_mode": "Soon"}, "autoreset")],
)
def test_impossible_numbers_are_refused(argument: dict[str, Any], word: str) -> None:
    """A message names the argument that has no meaning."""
    with pytest.raises(UsageError, match=word):
        tn.make_env(**BASE, **argument)


def test_long_delays_make_room_for_states() -> None:
    """Samples that wait longer than the first room for states are still found."""
    fast, slow = make_both(
        {"vary": {"link.delay_ms": (0.0, 900.0)}, "duration_s": 1.5}, 4, "NextStep"
    )
    assert_same_bits(fast.reset(seed=3), slow.reset(seed=3))
    actions = np.full((4, 2), 0.5)
    for _ in range(75):
        assert_same_bits(fast.step(actions), slow.step(actions))
