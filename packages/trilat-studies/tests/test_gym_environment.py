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
from study_builders import assert_same_bits
from trilat_studies.gym_environment import ENV_ID, Judgement, ReachTask, Scene, TeleoperationEnv

import trilat_net as tn
from trilat_net.analysis.shared_slave import SharedSlave
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.presentation.export import Exporter

VARY = {"link.delay_ms": (0.0, 300.0)}
BENT = {f"sites.{name}.q0_rad": [0.4, 1.2] for name in ("m1", "m2", "s")}


def make_paper_env(**settings: Any) -> Any:
    """Returns the environment of the paper's scenario over 1 s, from straight arms."""
    return tn.make_env("paper", **{"duration_s": 1, **settings})


def make_bent_env(**settings: Any) -> Any:
    """Returns the same environment with bent arms."""
    return make_paper_env(set=BENT, **settings)


def run_episode(env: Any, seed: int, steps: int = 25) -> tuple[list[Any], list[float]]:
    """Returns observations and rewards of an episode whose actions follow from observations."""
    observation, _ = env.reset(seed=seed)
    observations = [observation]
    rewards = []
    for n in range(steps):
        action = observation["pose"] + 0.05 * np.array([np.sin(n / 5), np.cos(n / 5)])
        observation, reward, ended, truncated, _ = env.step(action)
        observations.append(observation)
        rewards.append(float(reward))
        if ended or truncated:
            break
    return observations, rewards


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")
@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_gymnasiums_checker_finds_nothing(mode: str) -> None:
    check_env(make_paper_env(mode=mode, vary=VARY), skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")
@pytest.mark.parametrize("flat", [pytest.param(False, marks=pytest.mark.long), True])
def test_gymnasiums_checker_renders_as_well(flat: bool) -> None:
    environment = gymnasium.make(
        ENV_ID, scenario="paper", set=BENT, duration_s=1, render_mode="rgb_array", flat=flat
    )
    check_env(environment.unwrapped)


@pytest.mark.filterwarnings("ignore:the action")
def test_an_episode_is_a_function_of_its_seed() -> None:
    """Two environments give the same bits for a seed, and other rewards for another seed."""
    env = make_paper_env(duration_s=2, vary=VARY)
    other = make_paper_env(duration_s=2, vary=VARY)
    for seed in (1, 2, 1):
        assert_same_bits(run_episode(env, seed), run_episode(other, seed))
    assert run_episode(env, 1)[1] != run_episode(env, 2)[1]


@pytest.mark.filterwarnings("ignore:the action")
def test_the_vector_form_gives_the_same_bits() -> None:
    """Environments that Gymnasium steps together give the results of single ones."""
    keys = {"scenario": "paper", "duration_s": 2, "vary": VARY}
    several = gymnasium.make_vec(ENV_ID, 2, "sync", **keys)
    observations, _ = several.reset(seed=[5, 6])
    single_envs = [TeleoperationEnv(**keys) for _ in range(2)]
    for env, seed in zip(single_envs, (5, 6), strict=True):
        env.reset(seed=seed)

    for _ in range(5):
        actions = observations["pose"] + 0.03
        observations, rewards, *_ = several.step(actions)
        for n, env in enumerate(single_envs):
            observation, reward, *_ = env.step(actions[n])
            assert reward == rewards[n]
            for name, value in observation.items():
                assert value.tobytes() == observations[name][n].tobytes()
    several.close()


@pytest.mark.filterwarnings("ignore:the action")
def test_a_saved_episode_is_a_log_that_verifies(tmp_path: Path) -> None:
    """The log of an episode has the observed angles, and passes the check of its ticks."""
    env = make_paper_env(vary=VARY)
    with pytest.raises(UsageError, match="before its first step"):
        env.save(tmp_path / "none.mcap")
    observations, _ = run_episode(env, 3)
    log = tn.open_log(env.save(tmp_path / "episode.mcap"))
    assert tn.verify(log, virtual=True).passed
    for n, observation in enumerate(observations[:-1]):
        assert np.array_equal(log["m2"].q[20 * n], observation["q"])
    with pytest.raises(UsageError, match="exists"):
        env.save(tmp_path / "episode.mcap")


def test_saved_episodes_name_a_program_as_mover(tmp_path: Path) -> None:
    """A log and its dataset name the program as the mover, also at equal shares."""
    env = make_bent_env(user="m2")
    run_episode(env, 3, steps=5)
    log = tn.open_log(env.save(tmp_path / "episode.mcap"))
    (taken,) = [event for event in log.events if event.kind == "hand"]
    assert (taken.member, taken.text) == ("m2", "m2: policy takes hold at t = 0.000 s")
    assert SharedSlave(log).program == "m2"
    assert SharedSlave(tn.simulate("paper", duration_s=0.1)).program == ""

    summary = Exporter("lerobot", tmp_path / "set").export(log)
    assert "the program is m2 (found in the log)" in summary
    frames = pl.read_parquet(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet")
    assert np.array_equal(frames["action"].to_numpy(), frames["action.m2"].to_numpy())
    assert not frames["intervention"].any()


def test_info_tells_what_an_episode_drew() -> None:
    """The drawn values are those of the scenario, and lie in their ranges."""
    env = make_bent_env(vary={"link.delay_ms": (0, 300)})
    _, info = env.reset(seed=4)
    drawn_ms = info["drawn"]["link.delay_ms"]
    assert 0.0 <= drawn_ms <= 300.0
    assert {link.delay_ms for link in env.scenario.links.values()} == {drawn_ms}


@pytest.mark.parametrize("normalize", [False, True])
def test_clipped_actions_are_counted_and_warned_of_once(*, normalize: bool) -> None:
    """Actions beyond the bounds are counted, and only the first of an episode warns."""
    env = make_bent_env(mode="force", normalize=normalize)
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
    """Samples that the user sees are as old as the delay, or up to one period older."""
    env = make_paper_env()
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
    for step in range(1, 11):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        assert not terminated
        assert truncated == (step == 10)


class InstantTask(ReachTask):
    """A task that is done at once."""

    def judge(self, scene: Scene) -> Judgement:  # noqa: ARG002 - as all tasks
        return Judgement(2.0, succeeded=True)


def test_a_users_own_task_judges() -> None:
    env = make_paper_env(task=InstantTask())
    env.reset(seed=1)
    _, reward, terminated, _, info = env.step(env.action_space.sample())
    assert reward == 2.0
    assert terminated
    assert info["success"]


START_M = np.array([1.0, 0.5])
START_SCENE = Scene(0.0, {}, {"s": START_M}, None, {})  # type: ignore[arg-type]


def test_reach_draws_goals_evenly_over_a_disc() -> None:
    """A quarter of the goals lies within half of the radius."""
    task = ReachTask(radius_m=0.3)
    random = np.random.default_rng(1)
    distances_m = []
    for _ in range(2000):
        task.begin(random, START_SCENE)
        distances_m.append(np.linalg.norm(task.goal - START_M))
    assert max(distances_m) <= 0.3
    assert np.mean(np.array(distances_m) < 0.15) == pytest.approx(0.25, abs=0.03)


def test_reach_succeeds_after_staying_at_its_goal() -> None:
    task = ReachTask(radius_m=0.3)
    task.begin(np.random.default_rng(1), START_SCENE)
    for t_s, succeeded in ((0.1, False), (0.2, False), (0.3, True)):
        scene = START_SCENE._replace(t_s=t_s, end_effector_m={"s": task.goal})
        assert task.judge(scene).succeeded is succeeded


def test_an_invalid_action_is_refused() -> None:
    env = tn.make_env("paper", duration_s=1)
    env.reset(seed=1)
    with pytest.raises(UsageError, match="is not finite"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(UsageError, match="must have 2 numbers, but this one has 3 numbers"):
        tn.make_env("paper", duration_s=1).step(np.zeros(3))


def test_refused_actions_leave_no_trace() -> None:
    """The episode equals one without the refused actions."""
    env = make_bent_env(user="m2")
    other = make_bent_env(user="m2")
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
        observation, *outcome, _ = env.step(action)
        expected_observation, *expected_outcome, _ = other.step(action)
        assert_same_bits(observation, expected_observation)
        assert outcome == expected_outcome


def test_steps_need_a_reset_first() -> None:
    """A new environment takes no step and draws no picture."""
    env = make_bent_env(render_mode="rgb_array")
    for method in (lambda: env.step(np.zeros(2)), env.render):
        with pytest.raises(UsageError, match="call reset first") as error:
            method()
        assert isinstance(error.value, gymnasium.error.ResetNeeded)


def test_a_finished_episode_is_drawn_without_steps() -> None:
    """After the end of an episode its picture remains, and a step needs a reset."""
    env = make_bent_env(duration_s=0.1, render_mode="rgb_array")
    for seed in (1, 2):
        env.reset(seed=seed)
        truncated = False
        while not truncated:
            _, _, _, truncated, _ = env.step(np.zeros(2))
        with pytest.raises(UsageError, match="call reset first"):
            env.step(np.zeros(2))
        assert env.render().any()


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
    env = make_paper_env(set=start, user="m2", vary=VARY)
    slave = env.scenario.arms["s"]
    start_m = np.array(slave.end_effector(env.scenario.sites["s"].q0_rad))
    goals_m = []
    for seed in range(40):
        observation, _ = env.reset(seed=seed)
        goals_m.append(observation["goal"])
    for goal_m in goals_m:
        assert np.linalg.norm(goal_m) < sum(slave.lengths_m)
        assert np.linalg.norm(goal_m - start_m) <= 0.3
    assert len({tuple(goal_m) for goal_m in goals_m}) == 40


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["six_joints", "seven_joints", "unlike_arms"])
def test_goals_of_chains_are_reached_by_a_pose(scenario: str) -> None:
    env = tn.make_env(scenario, user=find_first_master(scenario), duration_s=1)
    for seed in range(10):
        env.reset(seed=seed)
        scene = env._build_scene()
        assert scene.can_reach("s", env.task.goal)
        assert not scene.can_reach("s", env.task.goal + 10.0)


def find_first_master(scenario: str) -> str:
    return next(name for name in tn.load_scenario(scenario).names if name != "s")


def test_a_task_without_reachable_goal_is_refused() -> None:
    task = ReachTask(radius_m=0.01)
    with pytest.raises(UsageError, match=r"the task has no goal: .* start from another pose"):
        tn.make_env("paper", {"arm.l2_m": 0.5, "sites.s.q0_rad": [0.4, 0.0]}, task=task)


def test_pictures_show_the_motion() -> None:
    """A picture is an array of pixels that changes as the arms move."""
    env = make_bent_env(render_mode="rgb_array")
    env.reset(seed=1)
    first = env.render()
    for _ in range(10):
        env.step(np.array([0.3, 1.2]))
    last = env.render()

    for picture in (first, last):
        assert picture.shape == (240, 720, 3)
        assert picture.dtype == np.uint8
    assert (first != last).any()
    assert env.metadata["render_fps"] == 50


def test_without_render_mode_there_are_no_pictures() -> None:
    env = make_bent_env()
    env.reset(seed=1)
    assert env.render() is None


def test_flat_observations_are_the_same_numbers() -> None:
    """The flat vector contains the numbers of the named arrays, with a name for each."""
    flat_env = make_bent_env(vary=VARY, flat=True)
    env = make_bent_env(vary=VARY)
    vector, _ = flat_env.reset(seed=3)
    arrays, _ = env.reset(seed=3)
    for _ in range(5):
        assert vector.dtype == np.float32
        assert vector in flat_env.observation_space
        by_name = dict(zip(flat_env.observation_names, vector.tolist(), strict=True))
        assert by_name["peer_q[1][0]"] == np.float32(arrays["peer_q"][1, 0])
        assert by_name["goal[1]"] == np.float32(arrays["goal"][1])
        assert sum(array.size for array in arrays.values()) == len(vector)
        action = flat_env.action_space.sample()
        assert action.dtype == np.float32
        vector, *_ = flat_env.step(action)
        arrays, *_ = env.step(action)


@pytest.mark.parametrize("mode", ["tip", "force"])
def test_scaled_observations_are_of_order_one(mode: str) -> None:
    """Random episodes stay within three times the scales that the environment states."""
    env = make_bent_env(mode=mode, vary=VARY, flat=True)
    env.action_space.seed(4)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        has_ended = False
        while not has_ended:
            assert observation in env.observation_space
            assert np.abs(observation / env.observation_scales).max() < 3.0
            observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
            has_ended = terminated or truncated


@pytest.mark.parametrize("mode", ["tip", "force"])
def test_scales_and_bounds_have_physical_meaning(mode: str) -> None:
    """Speeds and torques scale with their limits, and places are bounded by the arm's reach."""
    env = make_bent_env(mode=mode, vary=VARY, flat=True)
    scales = dict(zip(env.observation_names, env.observation_scales.tolist(), strict=True))
    limits = env.scenario.sites["m2"].limits
    assert scales["qd[0]"] == limits.qd_limit_rad_s
    assert scales["tau_x[1]"] == limits.tau_limit_nm

    low = dict(zip(env.observation_names, env.observation_space.low, strict=True))
    high = dict(zip(env.observation_names, env.observation_space.high, strict=True))
    assert high["pose[0]"] == pytest.approx(2.0)  # two links of 1 m
    assert low["grip[0]"] == 0.0
    assert high["grip[0]"] == 1.0


def test_gymnasiums_wrappers_scale_actions_and_observations() -> None:
    env = make_bent_env(flat=True)
    scaled = gymnasium.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))
    wrapped = gymnasium.wrappers.TransformObservation(
        scaled, lambda observation: observation / env.observation_scales, None
    )
    observation, _ = wrapped.reset(seed=1)
    assert np.abs(observation).max() < 3.0
    assert wrapped.action_space.high.tolist() == [1.0, 1.0]
    wrapped.step(wrapped.action_space.sample())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_normalized_environments_pass_the_checker(mode: str, flat: bool) -> None:
    """The checker warns of an action space that is not normalized; no warning is given here."""
    env = make_bent_env(mode=mode, flat=flat, normalize=True)
    check_env(env, skip_render_check=True)
    assert env.action_space.high.tolist() == 2 * [1.0]


@pytest.mark.parametrize("mode", ["tip", "joint", "force"])
def test_normalized_episodes_equal_scaled_ones(mode: str) -> None:
    """The same actions in other units give the same numbers, none of which is clipped here."""
    env = make_bent_env(mode=mode, flat=True, normalize=False)
    scaled = make_bent_env(mode=mode, flat=True, normalize=True)
    limit = env.action_space.high[0]
    observation, _ = env.reset(seed=2)
    scaled_observation, _ = scaled.reset(seed=2)
    random = np.random.default_rng(6)
    for _ in range(20):
        expected = observation / env.observation_scales
        assert np.abs(expected).max() <= 1.0
        assert scaled_observation == pytest.approx(expected, abs=1e-5)
        action = random.uniform(-0.2, 0.2, size=2)
        observation, reward, *_ = env.step(limit * action)
        scaled_observation, scaled_reward, *_ = scaled.step(action)
        assert scaled_reward == pytest.approx(reward, abs=1e-6)


def test_actions_beyond_normalized_bounds_are_clipped() -> None:
    env = make_bent_env(flat=True, normalize=True)
    env.reset(seed=2)
    with pytest.warns(UserWarning, match="exceeds the bound 1"):
        observation, *_ = env.step(np.array([5.0, -5.0]))
    assert observation in env.observation_space


class BufferedEnvs:
    """Several environments as Stable-Baselines3 runs them: one buffer, and a reset where an episode ends."""

    def __init__(self, envs: list[Any]) -> None:
        self.envs = envs
        space = envs[0].observation_space
        self._buffer = np.zeros((len(envs), *space.shape), dtype=space.dtype)
        self.last_observations: list[np.ndarray] = []

    def reset(self, seed: int) -> np.ndarray:
        """Begins an episode in each environment, and returns the first observations."""
        for n, env in enumerate(self.envs):
            self._buffer[n], _ = env.reset(seed=seed + n, options=None)
        return self._buffer.copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns observations, rewards and whether the episodes have ended."""
        rewards = np.zeros(len(self.envs), dtype=np.float32)
        has_ended = np.zeros(len(self.envs), dtype=bool)
        for n, env in enumerate(self.envs):
            self._buffer[n], rewards[n], terminated, truncated, _ = env.step(actions[n])
            has_ended[n] = terminated or truncated
            if has_ended[n]:
                self.last_observations.append(self._buffer[n].copy())
                self._buffer[n], _ = env.reset()
        return self._buffer.copy(), rewards, has_ended


def test_a_buffer_of_environments_runs_over_ends() -> None:
    """Environments that share a buffer of observations go on after the ends of episodes."""
    several = BufferedEnvs([make_bent_env(duration_s=0.2, flat=True) for _ in range(2)])
    several.reset(seed=7)
    episodes = 0
    for _ in range(25):
        actions = np.stack([env.action_space.sample() for env in several.envs])
        observations, rewards, has_ended = several.step(actions)
        assert np.isfinite(observations).all()
        assert np.isfinite(rewards).all()
        episodes += int(has_ended.sum())
    assert episodes == 4
    assert len(several.last_observations) == 4


@pytest.mark.parametrize("kind", ["sync", pytest.param("async", marks=pytest.mark.long)])
def test_vector_forms_take_flat_spaces(kind: str) -> None:
    keys = {"scenario": "paper", "set": BENT, "duration_s": 0.2, "flat": True}
    several = gymnasium.make_vec(ENV_ID, 2, kind, **keys)
    observations, _ = several.reset(seed=5)
    assert observations.dtype == np.float32
    episodes = 0
    for _ in range(24):
        _, _, _, truncated, _ = several.step(several.action_space.sample())
        episodes += int(truncated.sum())
    several.close()
    assert episodes == 4
