"""An experiment as a Gymnasium environment: passes the checker, is a function of its seed, and
is saved as logs.
"""

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import polars as pl
import pytest
from gymnasium.utils.env_checker import check_env
from trilat_studies.gym_environment import (
    ENV_ID,
    Judgement,
    ReachTask,
    Scene,
    TeleoperationEnv,
)

import trilat_net as tn
from trilat_net.analysis.dominance_history import find_program
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.presentation.export import Exporter

VARY = {"link.delay_ms": (0.0, 300.0)}
BENT = {f"sites.{name}.q0_rad": [0.4, 1.2] for name in ("m1", "m2", "s")}


def episode(env: Any, seed: int, steps: int = 25) -> tuple[list[Any], list[float]]:
    """Observations and rewards of an episode whose actions are a function of the observations."""
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
    """Asserts that two sequences of observations consist of the same bits."""
    for one, other in zip(a, b, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            assert np.asarray(value).tobytes() == np.asarray(other[name]).tobytes(), name


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")
@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_gymnasiums_checker_finds_nothing(mode: str) -> None:
    check_env(tn.make_env("paper", mode=mode, duration_s=1, vary=VARY), skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")
@pytest.mark.parametrize("flat", [pytest.param(False, marks=pytest.mark.long), True])
def test_gymnasiums_checker_renders_as_well(flat: bool) -> None:
    environment = gymnasium.make(
        ENV_ID, scenario="paper", set=BENT, duration_s=1, render_mode="rgb_array", flat=flat
    )
    check_env(environment.unwrapped)


@pytest.mark.filterwarnings("ignore:the action")
def test_an_episode_is_a_function_of_its_seed() -> None:
    env, other = (tn.make_env("paper", duration_s=2, vary=VARY) for _ in range(2))
    for seed in (1, 2, 1):
        (seen, rewards), (again, too) = episode(env, seed), episode(other, seed)
        assert_same(seen, again)
        assert rewards == too
    assert episode(env, 1)[1] != episode(env, 2)[1]


@pytest.mark.filterwarnings("ignore:the action")
def test_the_vector_form_gives_the_same_bits() -> None:
    """Environments that Gymnasium steps together give the results of single ones."""
    keys = {"scenario": "paper", "duration_s": 2, "vary": VARY}
    several = gymnasium.make_vec(ENV_ID, 2, "sync", **keys)
    observations, _ = several.reset(seed=[5, 6])
    single_envs = [TeleoperationEnv(**keys) for _ in range(2)]
    single_observations = [
        env.reset(seed=seed)[0] for env, seed in zip(single_envs, (5, 6), strict=True)
    ]

    for _ in range(5):
        actions = observations["pose"] + 0.03
        observations, rewards, *_ = several.step(actions)
        for n, env in enumerate(single_envs):
            single_observations[n], reward, *_ = env.step(actions[n])
            assert reward == rewards[n]
            for name, value in single_observations[n].items():
                assert value.tobytes() == observations[name][n].tobytes()
    several.close()


@pytest.mark.filterwarnings("ignore:the action")
def test_a_saved_episode_is_a_log_that_verifies(tmp_path: Path) -> None:
    """The log of an episode has the observed angles, and passes the check of its ticks."""
    env = tn.make_env("paper", duration_s=1, vary=VARY)
    with pytest.raises(UsageError, match="before its first step"):
        env.save(tmp_path / "none.mcap")
    observations, _ = episode(env, 3)
    log = tn.open_log(env.save(tmp_path / "episode.mcap"))
    assert tn.verify(log, virtual=True).passed
    for n, observation in enumerate(observations[:-1]):
        assert np.array_equal(log["m2"].q[20 * n], observation["q"])
    with pytest.raises(UsageError, match="exists"):
        env.save(tmp_path / "episode.mcap")


def test_saved_episodes_name_a_program_as_mover(tmp_path: Path) -> None:
    """A dataset can so take the action of the program, also at equal shares."""
    env = tn.make_env("paper", BENT, user="m2", duration_s=1)
    episode(env, 3, steps=5)
    log = tn.open_log(env.save(tmp_path / "episode.mcap"))
    (taken,) = [event for event in log.events if event.kind == "hand"]
    assert (taken.member, taken.text) == ("m2", "m2: policy takes hold at t = 0.000 s")
    assert find_program(log) == "m2"
    assert find_program(tn.simulate("paper", duration_s=0.1)) == ""

    summary = Exporter("lerobot", tmp_path / "set").export(log)
    assert "the program is m2 (found in the log)" in summary
    frames = pl.read_parquet(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet")
    assert np.array_equal(frames["action"].to_numpy(), frames["action.m2"].to_numpy())
    assert not frames["intervention"].any()


def test_info_tells_what_an_episode_drew() -> None:
    env = tn.make_env("paper", BENT, duration_s=1, vary={"link.delay_ms": (0, 300)})
    _, info = env.reset(seed=4)
    assert 0.0 <= info["drawn"]["link.delay_ms"] <= 300.0
    assert {link.delay_ms for link in env.scenario.links.values()} == {
        info["drawn"]["link.delay_ms"]
    }


@pytest.mark.parametrize("normalize", [False, True])
def test_clipped_actions_are_counted_and_warned_of_once(*, normalize: bool) -> None:
    """Actions beyond the bounds are counted, and only the first of an episode warns."""
    env = tn.make_env("paper", BENT, mode="force", duration_s=1, normalize=normalize)
    _, info = env.reset(seed=1)
    assert info["clipped_actions"] == 0

    bound = env.action_space.high
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        infos = [env.step(factor * bound)[4] for factor in (1.0, 1.5, -2.0, 0.5)]
    assert [info["clipped_actions"] for info in infos] == [0, 1, 2, 2]

    (warning,) = caught
    assert "is clipped" in str(warning.message)
    assert env.reset()[1]["clipped_actions"] == 0


def test_the_user_sees_the_slave_with_delay() -> None:
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
    """A task that is done at once."""

    def judge(self, scene: Scene) -> Judgement:  # noqa: ARG002 - as all tasks
        return Judgement(2.0, succeeded=True)


def test_a_users_own_task_judges() -> None:
    env = tn.make_env("paper", duration_s=1, task=Still())
    env.reset(seed=1)
    _, reward, ended, _, info = env.step(env.action_space.sample())
    assert (reward, ended, info["success"]) == (2.0, True, True)


def test_reach_draws_places_evenly_and_detects_staying() -> None:
    """Goals are uniform over a disc, and a task succeeds after some time at its goal."""
    task, random = ReachTask(radius_m=0.3), np.random.default_rng(1)
    start = np.array([1.0, 0.5])
    scene = Scene(0.0, {}, {"s": start}, None, {})  # type: ignore[arg-type]
    goals = []
    for _ in range(2000):
        task.begin(random, scene)
        goals.append(task.goal - start)

    distances = np.linalg.norm(goals, axis=1)
    assert distances.max() <= 0.3
    assert np.mean(distances < 0.15) == pytest.approx(0.25, abs=0.03)

    scenes_at_goal = [
        scene._replace(t_s=t_s, end_effector_m={"s": task.goal}) for t_s in (0.1, 0.2, 0.3)
    ]
    judgements = [task.judge(scene_at_goal) for scene_at_goal in scenes_at_goal]
    assert [judgement.succeeded for judgement in judgements] == [False, False, True]


def test_an_invalid_action_is_refused() -> None:
    env = tn.make_env("paper", duration_s=1)
    env.reset(seed=1)
    with pytest.raises(UsageError, match="is not finite"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(UsageError, match="must have 2 numbers, but this one has 3 numbers"):
        tn.make_env("paper", duration_s=1).step(np.zeros(3))


def test_refused_actions_leave_no_trace() -> None:
    """The episode equals one without the refused actions."""
    env, other = (tn.make_env("paper", BENT, user="m2", duration_s=1) for _ in range(2))
    env.reset(seed=1)
    other.reset(seed=1)
    refused = (
        [np.nan, 0.0],
        [np.inf, 0.0],
        [1.0],
        [[1.0, 2.0]],
        "left",
        None,
        [0.1, 0.2, 0.3],
        5.0,
    )

    for n in range(6):
        for action in refused:
            with pytest.raises(UsageError, match="action"):
                env.step(action)
        action = np.array([0.5, 0.5 + 0.01 * n])
        result, expected = env.step(action), other.step(action)
        assert_same([result[0]], [expected[0]])
        assert result[1:4] == expected[1:4]


def test_steps_need_a_reset_first() -> None:
    """Neither a new environment nor one with a finished episode takes a step."""
    env = tn.make_env("paper", BENT, duration_s=0.1, render_mode="rgb_array")
    for order in (lambda: env.step(np.zeros(2)), env.render):
        with pytest.raises(UsageError, match="call reset first") as error:
            order()
        assert isinstance(error.value, gymnasium.error.ResetNeeded)

    for seed in (1, 2):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, cut, _ = returned = env.step(np.zeros(2))
            ended = returned[2] or cut
        with pytest.raises(UsageError, match="call reset first"):
            env.step(np.zeros(2))
        assert env.render().any()  # the end of an episode can still be drawn


def test_a_refused_reset_needs_another_one() -> None:
    env = tn.make_env("paper", BENT, duration_s=1)
    env.reset(seed=1)
    with pytest.raises(ScenarioError, match="delay"):
        env.reset(options={"link.delay": 5})
    with pytest.raises(UsageError, match="call reset first"):
        env.step(np.zeros(2))
    env.reset(seed=1)
    env.step(np.zeros(2))


@pytest.mark.parametrize("start", [{}, BENT], ids=["straight", "bent"])
def test_every_goal_lies_within_reach(start: dict[str, Any]) -> None:
    """Goals lie in the disc around the start, and no farther away than the arm is long."""
    env = tn.make_env("paper", start, user="m2", duration_s=1, vary=VARY)
    length_m = sum(env.scenario.arms["s"].lengths_m)
    goals = [env.reset(seed=seed)[0]["goal"] for seed in range(40)]
    start_m = np.array(env.scenario.arms["s"].end_effector(env.scenario.sites["s"].q0_rad))
    for goal in goals:
        assert np.linalg.norm(goal) < length_m
        assert np.linalg.norm(goal - start_m) <= 0.3
    assert len({tuple(goal) for goal in goals}) == 40


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["six_joints", "seven_joints", "unlike_arms"])
def test_goals_of_chains_are_reached_by_a_pose(scenario: str) -> None:
    env = tn.make_env(scenario, user=_first_master(scenario), duration_s=1)
    for seed in range(10):
        env.reset(seed=seed)
        scene = env._build_scene()
        assert scene.can_reach("s", env.task.goal)
        assert not scene.can_reach("s", env.task.goal + 10.0)


def _first_master(scenario: str) -> str:
    return next(name for name in tn.load_scenario(scenario).names if name != "s")


def test_a_task_without_reachable_goal_is_refused() -> None:
    task = ReachTask(radius_m=0.01)
    with pytest.raises(UsageError, match=r"the task has no goal: .* start from another pose"):
        tn.make_env("paper", {"arm.l2_m": 0.5, "sites.s.q0_rad": [0.4, 0.0]}, task=task)


def test_pictures_show_the_motion() -> None:
    """A picture is an array of pixels that changes as the arms move."""
    env = tn.make_env("paper", BENT, duration_s=1, render_mode="rgb_array")
    env.reset(seed=1)
    pictures = [env.render()]
    for _ in range(10):
        env.step(np.array([0.3, 1.2]))
    pictures.append(env.render())

    for picture in pictures:
        assert picture.shape == (240, 720, 3)
        assert picture.dtype == np.uint8
    assert (pictures[0] != pictures[1]).any()
    assert env.metadata["render_fps"] == 50

    silent = tn.make_env("paper", BENT, duration_s=1)
    silent.reset(seed=1)
    assert silent.render() is None


def test_flat_observations_are_the_same_numbers() -> None:
    """The flat vector contains the numbers of the named arrays, with a name for each."""
    env, env_with_names = (
        tn.make_env("paper", BENT, duration_s=1, vary=VARY, flat=flat) for flat in (True, False)
    )
    flat, by_array = env.reset(seed=3)[0], env_with_names.reset(seed=3)[0]
    for _ in range(5):
        assert flat.dtype == np.float32
        assert flat in env.observation_space
        by_name = dict(zip(env.observation_names, flat.tolist(), strict=True))
        assert by_name["peer_q[1][0]"] == np.float32(by_array["peer_q"][1, 0])
        assert by_name["goal[1]"] == np.float32(by_array["goal"][1])
        assert sum(part.size for part in by_array.values()) == len(flat)
        action = env.action_space.sample()
        assert action.dtype == np.float32
        flat, by_array = env.step(action)[0], env_with_names.step(action)[0]


@pytest.mark.parametrize("mode", ["tip", "force"])
def test_scaled_observations_are_of_order_one(mode: str) -> None:
    """Random episodes stay within three times the scales that the environment states."""
    env = tn.make_env("paper", BENT, mode=mode, duration_s=1, vary=VARY, flat=True)
    limits = env.scenario.sites["m2"].limits
    scales = dict(zip(env.observation_names, env.observation_scales.tolist(), strict=True))
    assert scales["qd[0]"] == limits.qd_limit_rad_s
    assert scales["tau_x[1]"] == limits.tau_limit_nm

    space = env.observation_space
    bounds = dict(
        zip(env.observation_names, zip(space.low, space.high, strict=True), strict=True)
    )
    assert bounds["pose[0]"][1] == pytest.approx(2.0)  # two links of 1 m
    assert bounds["grip[0]"] == (0.0, 1.0)

    env.action_space.seed(4)
    for seed in range(3):
        observation, ended = env.reset(seed=seed)[0], False
        while not ended:
            assert observation in space
            assert np.abs(observation / env.observation_scales).max() < 3.0
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
            ended = terminated or truncated


def test_gymnasiums_wrappers_scale_actions_and_observations() -> None:
    env = tn.make_env("paper", BENT, duration_s=1, flat=True)
    scaled = gymnasium.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    wrapped = gymnasium.wrappers.TransformObservation(
        scaled, lambda seen: seen / env.observation_scales, None
    )
    seen, _ = wrapped.reset(seed=1)
    assert np.abs(seen).max() < 3.0
    assert wrapped.action_space.high.tolist() == [1.0, 1.0]
    wrapped.step(wrapped.action_space.sample())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_normalized_environments_pass_the_checker(mode: str, flat: bool) -> None:
    """The checker warns of an action space that is not normalized; no warning is given here."""
    env = tn.make_env("paper", BENT, mode=mode, duration_s=1, flat=flat, normalize=True)
    check_env(env, skip_render_check=True)
    assert env.action_space.high.tolist() == 2 * [1.0]


@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_normalized_episodes_equal_scaled_ones(mode: str) -> None:
    """The same actions in other units give the same numbers, none of which is clipped here."""
    env, scaled = (
        tn.make_env("paper", BENT, mode=mode, duration_s=1, flat=True, normalize=normalize)
        for normalize in (False, True)
    )
    limit = env.action_space.high[0]
    observation, scaled_observation = env.reset(seed=2)[0], scaled.reset(seed=2)[0]
    random = np.random.default_rng(6)
    for _ in range(20):
        expected = observation / env.observation_scales
        assert np.abs(expected).max() <= 1.0
        assert scaled_observation == pytest.approx(expected, abs=1e-5)
        action = random.uniform(-0.2, 0.2, size=2)
        observation, reward = env.step(limit * action)[:2]
        scaled_observation, same_reward = scaled.step(action)[:2]
        assert same_reward == pytest.approx(reward, abs=1e-6)

    with pytest.warns(UserWarning, match="exceeds the bound 1"):
        beyond = scaled.step(np.array([5.0, -5.0]))[0]
    assert beyond in scaled.observation_space


class BufferedEnvs:
    """Several environments as Stable-Baselines3 runs them: one buffer, and a reset where an episode ends."""

    def __init__(self, makers: list[Any]) -> None:
        self.envs = [make() for make in makers]
        space = self.envs[0].observation_space
        self.seen = np.zeros((len(self.envs), *space.shape), dtype=space.dtype)
        self.last: list[np.ndarray] = []

    def reset(self, seed: int) -> np.ndarray:
        for n, env in enumerate(self.envs):
            self.seen[n], _ = env.reset(seed=seed + n, options=None)
        return self.seen.copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rewards, done = (
            np.zeros(len(self.envs), dtype=np.float32),
            np.zeros(len(self.envs), dtype=bool),
        )
        for n, env in enumerate(self.envs):
            self.seen[n], rewards[n], ended, truncated, _ = env.step(actions[n])
            done[n] = ended or truncated
            if done[n]:
                self.last.append(self.seen[n].copy())
                self.seen[n], _ = env.reset()
        return self.seen.copy(), rewards, done


def test_a_buffer_of_environments_runs_over_ends() -> None:
    """Environments that share a buffer of observations go on after the ends of episodes."""
    several = BufferedEnvs([lambda: tn.make_env("paper", BENT, duration_s=0.2, flat=True)] * 2)
    observations, ends = several.reset(seed=7), 0
    for _ in range(25):
        actions = np.stack([env.action_space.sample() for env in several.envs])
        observations, rewards, done = several.step(actions)
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        ends += int(done.sum())
    assert ends == 4
    assert len(several.last) == 4


@pytest.mark.parametrize("kind", ["sync", pytest.param("async", marks=pytest.mark.long)])
def test_vector_forms_take_flat_spaces(kind: str) -> None:
    keys = {"scenario": "paper", "set": BENT, "duration_s": 0.2, "flat": True}
    several = gymnasium.make_vec(ENV_ID, 2, kind, **keys)
    seen, _ = several.reset(seed=5)
    assert seen.dtype == np.float32
    cuts = sum(int(several.step(several.action_space.sample())[3].sum()) for _ in range(24))
    several.close()
    assert cuts == 4
