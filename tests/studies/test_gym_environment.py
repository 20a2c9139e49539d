"""An experiment as a Gymnasium environment: checked by it, a function of its seed, and saved as logs."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import trilat_net as tn
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.studies.gym_environment import ENV_ID, Judgement, ReachTask, Scene, TeleoperationEnv

VARY = {"link.delay_ms": (0.0, 300.0)}


def episode(env: Any, seed: int, steps: int = 25) -> tuple[list[Any], list[float]]:
    """Observations and rewards of an episode whose actions are a function of what is observed."""
    observation, _ = env.reset(seed=seed)
    seen, rewards = [observation], []
    for n in range(steps):
        action = observation["pose"] + 0.05 * np.array([np.sin(n / 5), np.cos(n / 5)])
        observation, reward, ended, truncated, _ = env.step(action)
        seen.append(observation)
        rewards.append(float(reward))
        if ended or truncated:
            break
    return seen, rewards


def assert_same(a: Any, b: Any) -> None:
    for one, other in zip(a, b, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert np.asarray(value).tobytes() == np.asarray(other[name]).tobytes(), name


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")
@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_gymnasiums_checker_finds_nothing(mode: str) -> None:
    check_env(tn.make_env("paper", mode=mode, duration_s=1, vary=VARY), skip_render_check=True)


def test_an_episode_is_a_function_of_its_seed() -> None:
    env, other = (tn.make_env("paper", duration_s=2, vary=VARY) for _ in range(2))
    for seed in (1, 2, 1):
        (seen, rewards), (again, too) = episode(env, seed), episode(other, seed)
        assert_same(seen, again)
        assert rewards == too
    assert episode(env, 1)[1] != episode(env, 2)[1]


def test_the_vector_form_gives_the_same_bits() -> None:
    keys = {"scenario": "paper", "duration_s": 2, "vary": VARY}
    several = gymnasium.make_vec(ENV_ID, 2, "sync", **keys)
    seen, _ = several.reset(seed=[5, 6])
    single = [TeleoperationEnv(**keys) for _ in range(2)]
    firsts = [env.reset(seed=seed)[0] for env, seed in zip(single, (5, 6), strict=True)]
    for _ in range(5):
        actions = seen["pose"] + 0.03
        seen, rewards, *_ = several.step(actions)
        for n, env in enumerate(single):
            firsts[n], reward, *_ = env.step(actions[n])
            assert reward == rewards[n]
            for name, value in firsts[n].items():
                assert value.tobytes() == seen[name][n].tobytes()
    several.close()


def test_an_episode_is_saved_as_a_log_that_verifies(tmp_path: Path) -> None:
    env = tn.make_env("paper", duration_s=1, vary=VARY)
    with pytest.raises(UsageError, match="once it has a step"):
        env.save(tmp_path / "none.mcap")
    seen, _ = episode(env, 3)
    log = tn.open_log(env.save(tmp_path / "episode.mcap"))
    assert tn.verify(log, virtual=True).passed
    for n, observation in enumerate(seen[:-1]):
        assert np.array_equal(log["m2"].q[20 * n], observation["q"])
    with pytest.raises(UsageError, match="exists"):
        env.save(tmp_path / "episode.mcap")


def test_delay_is_what_the_user_knows_by() -> None:
    env = tn.make_env("paper", duration_s=1)
    observation, _ = env.reset(seed=1, options={"link.delay_ms": 240})
    for _ in range(20):
        observation, *_ = env.step(observation["pose"])
    assert observation["age_s"].min() >= 0.24
    assert observation["age_s"].max() <= 0.242


def test_dominance_says_who_intervenes() -> None:
    shares = {"dominance.s": {"m1": 0.8, "m2": 0.2}}
    _, info = tn.make_env("paper", shares, duration_s=1).reset(seed=1)
    assert info["is_intervention"]
    assert info["dominance"] == {"m1": 0.8, "m2": 0.2}
    assert info["teleop_action"].shape == (2,)


def test_episodes_end_at_their_duration() -> None:
    env = tn.make_env("paper", duration_s=0.2)
    env.reset(seed=1)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]


class Still(ReachTask):
    """Is done at once."""

    def judge(self, scene: Scene) -> Judgement:  # noqa: ARG002 - as all tasks
        return Judgement(2.0, succeeded=True)


def test_a_task_of_ones_own_judges() -> None:
    env = tn.make_env("paper", duration_s=1, task=Still())
    env.reset(seed=1)
    _, reward, ended, _, info = env.step(env.action_space.sample())
    assert (reward, ended, info["success"]) == (2.0, True, True)


def test_reach_draws_places_evenly_and_sees_who_stays() -> None:
    task, random = ReachTask(radius_m=0.3), np.random.default_rng(1)
    start = np.array([1.0, 0.5])
    scene = Scene(0.0, {}, {"s": start}, None, {})  # type: ignore[arg-type]
    goals = []
    for _ in range(2000):
        task.begin(random, scene)
        goals.append(task.goal - start)
    apart = np.linalg.norm(goals, axis=1)
    assert apart.max() <= 0.3
    assert np.mean(apart < 0.15) == pytest.approx(0.25, abs=0.03)
    there = [scene._replace(t_s=t_s, end_effector_m={"s": task.goal}) for t_s in (0.1, 0.2, 0.3)]
    assert [task.judge(one).succeeded for one in there] == [False, False, True]


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"user": "m9"}, "m9"),
        ({"rate_hz": 333}, "must divide the tick rate of m2"),
        ({"leads": "nobody"}, "nobody"),
    ],
)
def test_an_environment_that_cannot_be_is_refused(keys: dict[str, Any], problem: str) -> None:
    with pytest.raises((UsageError, ScenarioError), match=problem):
        tn.make_env("paper", **keys)


def test_an_action_that_is_none_is_refused() -> None:
    env = tn.make_env("paper", duration_s=1)
    env.reset(seed=1)
    with pytest.raises(UsageError, match="which is not finite"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(UsageError, match="3 numbers, not 2"):
        tn.make_env("paper", duration_s=1).step(np.zeros(3))
