"""A Gymnasium environment for training a policy that operates one arm over the network.

The policy takes the place of one user. In each step, it observes what that user can observe:
the state of the user's own arm, and the states of the other arms as they arrive over the
delayed network. Its action is a target for the arm, or a force on it. All arms are simulated,
as fast as possible.

Invariant:
    - An episode depends only on the scenario, the seed and the actions. If the episode is saved
      as a log, this log can be verified bit for bit.
    - A step is a fixed number of ticks. An invalid action is rejected without advancing or
      changing the episode.
    - The observations, and the time at which an action takes effect, are the same as for a
      user-written operator (`OwnHand`), so a trained policy can operate an arm in a live
      session without changes. The only difference is that orientations are observed as six
      numbers, which never jump (`expand_poses`).
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from msgspec.structs import replace

from trilat_net.core import POSITION, Array, HandView, SiteArrays, tick_ns
from trilat_net.errors import UsageError, count_nouns
from trilat_net.execution import FusedRun, SimulatedLog
from trilat_net.files import Extra
from trilat_net.log import expand_poses
from trilat_net.scenario import HAND_MODES, HandPlayer, HandSite, Scenario, load_scenario

from .reachable_places import can_reach

if TYPE_CHECKING:
    from trilat_net.presentation import EpisodePicture

try:
    import gymnasium
    from gymnasium import spaces
except ImportError:
    Extra("gym", "environments").import_module("gymnasium")
    raise

ENV_ID = "trilat_net/Teleoperation-v0"
"""Name of the environment in the registry of Gymnasium."""
FAR = 1e6
"""Bound on observed quantities that have no tighter bound, in rad, rad/s, m, N m or s."""
NEVER_NEGATIVE = ("alpha", "grip", "age_s")
"""Parts of an observation whose entries are never negative."""
WITH_ROUNDING = 1.000001
"""Factor by which the space is larger than a bound that an entry can reach exactly."""
MOST_DRAWS = {False: 1000, True: 100}
"""Largest number of random positions that a task draws to find one within reach.

It is smaller for arms with a chain of joints (True), because finding the pose for a position
requires a numerical search.
"""


class EpisodeError(UsageError, gymnasium.error.ResetNeeded):
    """Raised when a method of the environment is called while no episode is in progress.

    Either no episode has begun or the last one has ended. `TeleoperationEnv.reset` begins an
    episode.
    """


class Scene(NamedTuple):
    """True state of an episode at one step, from which the task computes the reward.

    It contains the current states of all arms, while the user sees the other arms with a delay.

    Attributes:
        t_s: Time since the start of the run, in s.
        q: Joint angles of each site, shape (n,), in rad.
        end_effector_m: Position of the end effector of each site, in m.
        view: State as the user observes it.
        bodies: Poses of simulated bodies, by the site that simulates them and by name. Each
            pose has the shape (7,), as in a record.
        can_reach: Function that returns whether the end effector of a site can reach a
            position, in m.
        draws: Largest number of random positions that a task may draw to find one within reach.
    """

    t_s: float
    q: dict[str, Array]
    end_effector_m: dict[str, Array]
    view: HandView
    bodies: dict[str, dict[str, Array]]
    can_reach: Callable[[str, Array], bool] = lambda _site, _position: True
    draws: int = MOST_DRAWS[False]


class Judgement(NamedTuple):
    """A task's evaluation of one step: the reward, and whether the task succeeded or failed.

    Attributes:
        reward: Reward of the step.
        succeeded: True if the task is complete, which ends the episode.
        failed: True if the task can no longer be completed, which ends the episode.
    """

    reward: float
    succeeded: bool = False
    failed: bool = False


class EpisodeTask(Protocol):
    """Interface for the task of an episode, which draws a goal and computes the rewards.

    Users can implement their own tasks with these methods. The environment calls `begin` at the
    start of each episode and `judge` after each step.
    """

    goal: Array
    """Goal as observed by the user. Its shape must never change."""
    bound: float
    """Bound on the entries of the goal. It must never change."""

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws the goal of a new episode. Called once per episode.

        Args:
            random: Random number generator.
            scene: State at the start of the episode.
        """

    def judge(self, scene: Scene) -> float | tuple[Any, ...]:
        """Computes the reward of a step and decides whether the episode ends.

        Args:
            scene: State after the step.

        Returns:
            The reward as a number, or a `Judgement`, or a plain tuple with the same entries.
        """


class ReachTask:
    """The task of bringing an end effector to a random position and keeping it there.

    The reward of a step is minus the distance from the goal, in m, times the duration of the
    step, in s. Once the end effector has stayed at the goal for `stay_s`, the reward is
    increased by 1 and the episode ends.

    Args:
        site: Site of the end effector.
        radius_m: Largest distance of the goal from the start, in m.
        within_m: Largest distance from the goal at which the goal counts as reached, in m.
        stay_s: Time for which the end effector must stay at the goal, in s.

    Attributes:
        site, within_m, stay_s: The arguments of the same names.
        reached_s: Latest time at which the end effector was not at the goal, in s.
        last_s: Time of the last step, in s.
    """

    def __init__(
        self,
        site: str = "s",
        radius_m: float = 0.3,
        within_m: float = 0.02,
        stay_s: float = 0.3,
    ) -> None:
        self.goal = np.zeros(2)
        self.bound = 100.0
        self.site = site
        self._radius_m = radius_m
        self.within_m = within_m
        self.stay_s = stay_s
        self.reached_s = 0.0
        self.last_s = 0.0

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws a goal uniformly from the part of a sphere that the end effector can reach.

        The centre of the sphere is the position of the end effector at the start.

        Args:
            random: Random number generator.
            scene: State at the start of the episode.

        Raises:
            UsageError: None of the drawn positions is within reach.
        """
        start_m = scene.end_effector_m[self.site]
        dimensions = len(start_m)
        for _ in range(scene.draws):
            direction = random.normal(size=dimensions)
            # The root makes the density uniform over the area or the volume.
            relative_radius = random.uniform() ** (1.0 / dimensions)
            distance_m = self._radius_m * relative_radius

            length = np.linalg.norm(direction)
            offset_m = distance_m * direction / length
            position_m = start_m + offset_m
            if scene.can_reach(self.site, position_m):
                break
        else:
            positions = count_nouns(scene.draws, "position")
            raise UsageError(
                f"the task has no goal: the end effector can reach none of {positions} "
                f"within {self._radius_m:g} m of the start of {self.site}; "
                "start from another pose (sites.NAME.q0_rad), or use your own task"
            )
        self.goal = position_m
        self.reached_s = scene.t_s
        self.last_s = scene.t_s

    def judge(self, scene: Scene) -> Judgement:
        """Computes the reward of a step and checks whether the reaching task is complete.

        The reward is minus the distance from the end effector to the goal, in m, times the
        duration of the step, in s, plus 1 when the task is complete. The task is complete when
        the end effector has stayed within the tolerance around the goal for the required time.

        Args:
            scene: State of the arms after the step.

        Returns:
            The reward, and whether the task is complete, which ends the episode.
        """
        from_goal_m = scene.end_effector_m[self.site] - self.goal
        distance_m = float(np.linalg.norm(from_goal_m))
        step_s = scene.t_s - self.last_s
        self.last_s = scene.t_s
        if distance_m > self.within_m:
            self.reached_s = scene.t_s  # the time at the goal starts again
        stayed_s = scene.t_s - self.reached_s
        succeeded = stayed_s >= self.stay_s
        reward = -distance_m * step_s + float(succeeded)
        return Judgement(reward, succeeded=succeeded)


class _ActedHand(HandPlayer):
    """Simulated operator that moves the user's arm according to a policy's actions.

    Args:
        hand_site: The arm that the operator holds, and the settings of the operator.
        actions: Action of each step of the episode. The environment appends to this list.
    """

    def __init__(self, hand_site: HandSite, actions: list[Array]) -> None:
        super().__init__(hand_site, None)
        self._actions = actions

    def request_action(self, k: int, arrays: SiteArrays) -> None:  # noqa: ARG002 - already observed
        """Takes the policy's action for the current step as the decision of the operator.

        The simulation calls this method whenever a decision of the simulated operator is due.

        Args:
            k: Tick in which the decision is due, from 0.
            arrays: State of the arm. Ignored, because the policy has already observed it.
        """
        action = self._actions[k // self.hand.period_ticks]
        self.hand.accept_decision(k, action.tolist())


class TeleoperationEnv(gymnasium.Env[dict[str, Array], Array]):
    """A Gymnasium environment in which a policy operates one arm of a simulated session.

    `make_env` creates this object and explains its arguments.

    Attributes:
        observation_names: With `flat`, the name of each entry of an observation, such as
            "q[0]". Entries of a matrix have two indices, the row and the column.
        observation_scales: Typical magnitude of each entry of an observation: a dictionary of
            arrays or, with `flat`, a single array. An observation divided by its scale is of
            order 1. The scales are derived from the reach of the arms and the scenario's limits
            on speed and torque.
        user: Site whose arm is moved by the actions.
        leads: Site that performs the task.
        ticks_per_step: Number of ticks per step.

    Raises:
        ScenarioError: The scenario or an override is not valid, or the scenario does not
            contain the site `user` or `leads`.
        UsageError: The rate is not valid, Gymnasium is missing, or another argument has an
            invalid value, which the message names.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        scenario: Any = "paper",
        set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the same name in all functions
        *,
        user: str = "m2",
        mode: str = "",
        rate_hz: int = 50,
        delay_ms: float = 20.0,
        duration_s: float | None = None,
        task: EpisodeTask | None = None,
        vary: Mapping[str, Sequence[Any]] = {},
        leads: str = "s",
        render_mode: str | None = None,
        flat: bool = False,
        normalize: bool = False,
    ) -> None:
        render_modes = self.metadata["render_modes"]
        if render_mode not in (None, *render_modes):
            modes = ", ".join(render_modes)
            raise UsageError(f"render_mode must be {modes} or None, not {render_mode!r}")
        _check_arguments(mode=mode, rate_hz=rate_hz, delay_ms=delay_ms, task=task)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": rate_hz}
        self._picture: EpisodePicture | None = None
        self._runs = False
        self._has_warned = False
        self.user = user
        self.leads = leads
        self._mode = mode
        self._rate_hz = rate_hz
        self._delay_s = delay_ms * 1e-3
        self._vary = vary
        self._normalize = normalize
        self.task: EpisodeTask = task or ReachTask(leads)
        loaded = load_scenario(scenario, set, duration_s=duration_s)
        self._base = self._prepare(loaded)
        self._check_varied_keys()
        user_spec = self._base.sites[user]
        tick_rate_hz = user_spec.rate_hz
        if tick_rate_hz % rate_hz:
            raise UsageError(f"rate_hz must divide the tick rate of {user}, {tick_rate_hz}")
        self.ticks_per_step = tick_rate_hz // rate_hz

        hand_site = self.build_hand_site(self._base)
        hand = hand_site.describe()
        limit = hand.limit if hand.mode == "force" else self._find_reach()
        dtype = np.float32 if flat else np.float64
        self.action_limit = limit
        self.action_size = hand.size
        shape = (hand.size,)
        bound = 1.0 if normalize else limit
        self.action_space: Any = spaces.Box(-bound, bound, shape, dtype)

        self._begin(self._base)
        random = np.random.default_rng(0)
        first_scene = self._build_scene()
        self.task.begin(random, first_scene)
        scene_with_goal = self._build_scene()
        self._dict_space = self._build_dict_space(scene_with_goal)
        self.observation_space: Any = self._dict_space
        self.observation_names: list[str] = []
        scales = self._scale_parts(scene_with_goal)
        self._part_scales = scales
        self.observation_scales: Any = scales
        if flat:
            self.observation_space = _flatten_space(self._dict_space)
            self.observation_names = _name_numbers(self._dict_space)
            flat_scales = [np.ravel(scales[name]) for name in self._dict_space]
            self.observation_scales = np.concatenate(flat_scales).astype(np.float32)
        self._flat = flat

    def _build_dict_space(self, scene: Scene) -> spaces.Dict:
        """Returns the observation space in the form of a dictionary of arrays.

        Args:
            scene: Any state of an episode. All observations have the same shapes as that of
                this state.
        """
        hand = self.build_hand_site(self._base).describe()
        arm = self._base.arms[self.user]
        bounds = {"alpha": 1.0, "grip": 1.0, "goal": self.task.bound}
        if hand.mode != "joint" and arm.chain is None:
            # No point of a planar arm is farther from the base than the arm's length. The
            # margin is for rounding.
            bounds["pose"] = WITH_ROUNDING * sum(arm.lengths_m)
            bounds["target"] = WITH_ROUNDING * self.action_limit
        boxes: dict[str, Any] = {}
        parts = self._observe(scene)
        for name, values in parts.items():
            bound = 1.0 if self._normalize else bounds.get(name, FAR)
            low = 0.0 if name in NEVER_NEGATIVE else -bound
            boxes[name] = spaces.Box(low, bound, values.shape, np.float64)
        return spaces.Dict(boxes)

    def _scale_parts(self, scene: Scene) -> dict[str, Array]:
        """Returns the typical magnitude of each entry of an observation, keyed by part.

        These magnitudes are not bounds of the space: an arm can exceed its speed limit in the
        last step of an episode, which ends it, and can turn any number of times.

        Args:
            scene: Any state of an episode.
        """
        base = self._base
        parts = self._observe(scene)
        scales = {name: np.ones(values.shape) for name, values in parts.items()}
        user_limits = base.sites[self.user].limits
        scales["qd"][:] = user_limits.qd_limit_rad_s
        scales["tau_x"][:] = user_limits.tau_limit_nm
        for index, peer in enumerate(base.peers(self.user)):
            limits = base.sites[peer].limits
            speeds = np.array(limits.qd_limit_rad_s)
            torques = np.array(limits.tau_limit_nm)
            if base.arms[peer].shares_pose:
                # These are the values of an end effector 1 m from the fastest and the strongest
                # joint.
                speeds = speeds.max()
                torques = torques.max()
            scales["peer_qd"][index] = speeds
            scales["peer_tau_x"][index] = torques

        reach_m = self._find_reach_m()
        if base.arms[self.user].shares_pose:
            # Entries of a rotation matrix follow the position.
            scales["q_des"][..., :POSITION] = reach_m
            scales["peer_q"][..., :POSITION] = reach_m
        else:
            scales["q_des"][:] = math.pi
            scales["peer_q"][:] = math.pi

        scales["q"][:] = math.pi
        scales["target"][:] = self.action_limit
        hand = self.build_hand_site(base).describe()
        scales["pose"][:] = math.pi if hand.mode == "joint" else reach_m
        scales["goal"][:] = reach_m if self._is_goal_position(scene) else self.task.bound
        return scales

    def _is_goal_position(self, scene: Scene) -> bool:
        """Returns True if the goal of the task has as many entries as a position.

        Goals may also be of another kind, such as joint angles.
        """
        return np.shape(self.task.goal) == scene.end_effector_m[self.leads].shape

    def _prepare(self, scenario: Scenario) -> Scenario:
        """Returns a scenario in which only the policy operates the user's arm.

        The operators that the scenario defines for this arm are removed, except for the
        settings of a live operator.

        Raises:
            ScenarioError: The scenario does not contain the site of the user or of the task.
        """
        scenario.find_site(self.user)
        scenario.find_site(self.leads)
        spec = scenario.sites[self.user]
        sites = dict(scenario.sites)
        sites[self.user] = spec.with_live_hand_only(self._mode)
        # The values that the removed operators would draw at random are removed too.
        removed_keys = f"{self.user}.hands"
        drawn = dict(scenario.drawn)
        for key in scenario.drawn:
            if removed_keys in key:
                del drawn[key]
        return replace(scenario, sites=sites, drawn=drawn)

    def _check_varied_keys(self) -> None:
        """Raises an error if `vary` has invalid keys or values, before the first episode.

        Raises:
            ScenarioError: A key does not exist, or a value is not valid for it.
            UsageError: A key has no values.
        """
        for key, values in self._vary.items():
            if isinstance(values, str) or not isinstance(values, Sequence) or not len(values):
                raise UsageError(
                    f"vary: {key} needs a pair of bounds or a list of values, not {values!r}"
                )
        for end in (0, -1):
            load_scenario(self._base, {key: values[end] for key, values in self._vary.items()})

    def build_hand_site(self, scenario: Scenario) -> HandSite:
        """Returns the arm that the agent moves, with its force or position limits.

        Args:
            scenario: Scenario of one episode, in which the agent is the live operator of the
                user's site.
        """
        spec = scenario.sites[self.user]
        hand = spec.find_live_hand()
        assert hand is not None
        return HandSite(
            scenario=scenario,
            name=self.user,
            spec=hand,
            rate_hz=self._rate_hz,
            delay_s=self._delay_s,
        )

    def _find_reach(self) -> float:
        """Returns the bound on an action in the modes "tip" (in m) and "joint" (in rad).

        In the mode "tip", an action is a position of the end effector, and the bound is its
        largest distance from the base. In the mode "joint", it is an angle.
        """
        hand_site = self.build_hand_site(self._base)
        if hand_site.spec.mode == "joint":
            return 2.0 * math.pi
        return self._find_reach_m()

    def _find_reach_m(self) -> float:
        """Returns the largest distance of the user's end effector from its base, in m."""
        arm = self._base.arms[self.user]
        spec = self._base.sites[self.user]
        if arm.chain is None:
            return float(sum(arm.lengths_m))
        # The reach of a chain is not known in closed form. This value is a safe upper bound.
        start_m = arm.end_effector(spec.q0_rad)
        start_distance_m = float(np.linalg.norm(start_m))
        return 1.5 * start_distance_m + 1.0

    def _begin(self, scenario: Scenario) -> None:
        """Prepares the simulated run of a new episode, up to its first step.

        The run is not started. Each step of the environment appends the action of the policy to
        `self._actions` and lets the run execute the ticks of the step. A simulated operator,
        `self._player`, holds the arm of the user's site. It shares this list and moves the arm
        according to the last action.

        Args:
            scenario: Scenario of the episode.
        """
        self.scenario = scenario
        self._k = 0  # ticks of the user's site so far
        self._actions = list[Array]()
        self._clipped_actions = 0
        hand_site = self.build_hand_site(scenario)
        self._player = _ActedHand(hand_site, self._actions)
        hands = {self.user: self._player}
        ticks = [scenario.ticks(name) for name in scenario.names]
        # The environment reads the state of the last tick only, so one record is kept.
        self._run = FusedRun(scenario, keep=1, hands=hands, runs_plants=True)
        self._run.plan(ticks)  # allocates memory for all ticks of the episode
        self._ticks = scenario.ticks(self.user)
        self._tick_rate_hz = scenario.sites[self.user].rate_hz

    def _build_scene(self) -> Scene:
        """Describes the current state of the episode, for the task and for observations.

        The joint angles, end effectors and bodies are the true state of the simulation. The
        view is that of the user's operator (the policy), who receives the states of other sites
        with a delay.

        Returns:
            The state. Its limit `draws` on the attempts to draw a position depends on the arm
            of the site that performs the task (`self.leads`), which is not always the user's
            arm.
        """
        names = self.scenario.names
        arms = self.scenario.arms
        q_rad = {}
        positions_m = {}
        for name, row in zip(names, self._run.q, strict=True):
            arm = arms[name]
            angles_rad = row[: arm.counts.joints]  # rows are as long as the longest arm needs
            q_rad[name] = angles_rad
            position_m = arm.end_effector(angles_rad.tolist())
            positions_m[name] = np.array(position_m)

        bodies = {}
        for site, plant in self._run.plants.items():
            body_names = self.scenario.bodies_m(site)
            # A pose has seven numbers: the position in m, and a unit quaternion.
            poses = np.reshape(plant.state.bodies, (-1, 7))
            bodies[site] = dict(zip(body_names, poses, strict=True))

        user_index = names.index(self.user)
        user_arrays = self._run.arrays(user_index)
        view = self._player.view(self._k, user_arrays)
        leading_arm = arms[self.leads]
        is_chain = leading_arm.chain is not None
        most_draws = MOST_DRAWS[is_chain]
        return Scene(
            t_s=self._k / self._tick_rate_hz,
            q=q_rad,
            end_effector_m=positions_m,
            view=view,
            bodies=bodies,
            can_reach=partial(self.can_reach, q_rad),
            draws=most_draws,
        )

    def can_reach(self, q: Mapping[str, Array], site: str, position_m: Array) -> bool:
        """Returns True if the end effector of an arm can reach a position.

        Tasks that draw random goals use this to make sure that every goal can be reached.

        Args:
            q: Joint angles of each site from which the search for a pose starts, in rad.
            site: Name of the site.
            position_m: The position, in m.
        """
        return can_reach(self.scenario, site, q[site], position_m)

    def _format_observation(self, scene: Scene) -> Any:
        """Returns the user's observation of a state, in the format of the observation space."""
        return self.format_parts(self._observe(scene))

    def format_parts(self, parts: dict[str, Array], count: int | None = None) -> Any:
        """Converts observations to the agent's format: a dictionary, or one array (`flat`).

        Args:
            parts: The parts of an observation, by name. With several observations, each part
                has an additional first axis. The dictionary is modified.
            count: Number of observations, or `None` if there is a single one with no additional
                axis.
        """
        if self._normalize:
            for name, values in parts.items():
                scaled = values / self._part_scales[name]
                parts[name] = np.clip(scaled, -1.0, 1.0)
        if not self._flat:
            return parts
        shape = (-1,) if count is None else (count, -1)
        arrays = [parts[name].reshape(shape) for name in self._dict_space]
        numbers = np.concatenate(arrays, axis=-1)
        return numbers.astype(np.float32)

    def _observe(self, scene: Scene) -> dict[str, Array]:
        """Collects the agent's observation of a state, as a mapping from name to array.

        Parts whose names begin with "peer_", and `alpha` and `age_s`, have one row per peer.
        """
        view = scene.view
        peers = view.peers
        peer_q = [peer.q for peer in peers]
        peer_qd = [peer.qd for peer in peers]
        peer_tau_x = [peer.tau_x for peer in peers]
        alpha = [peer.alpha for peer in peers]
        age_s = [peer.age_s for peer in peers]

        parts = {
            "q": view.q,
            "qd": view.qd,
            "pose": view.pose,
            "q_des": view.q_des,
            "tau_x": view.tau_x,
            "target": view.target,
            "peer_q": np.array(peer_q),
            "peer_qd": np.array(peer_qd),
            "peer_tau_x": np.array(peer_tau_x),
            "alpha": np.array(alpha),
            "age_s": np.array(age_s),
            "grip": np.array([view.grip]),
            "goal": np.array(self.task.goal, dtype=np.float64),
        }

        user_arm = self._base.arms[self.user]
        if user_arm.shares_pose:
            # A rotation vector jumps where it passes half a turn.
            parts["q_des"] = expand_poses(parts["q_des"])
            parts["peer_q"] = expand_poses(parts["peer_q"])
        return parts

    def _describe_step(self, scene: Scene, *, succeeded: bool) -> dict[str, Any]:
        """Returns the information dictionary of a step.

        The first two keys have the same names as in gym-hil, a library in which a human teacher
        can take over from the policy. The teacher is the user, other than the policy, with the
        largest dominance factor at the site that performs the task. The teacher intervenes
        while this factor is larger than that of the policy.

        Args:
            scene: State after the step.
            succeeded: True if the task is complete.
        """
        leading_site = self.scenario.names.index(self.leads)
        leading_arrays = self._run.arrays(leading_site)
        links = np.asarray(leading_arrays.links)
        peers = self.scenario.peers(self.leads)
        factors = links["alpha"].tolist()
        dominance = dict(zip(peers, factors, strict=True))

        user_dominance = dominance.get(self.user, 0.0)

        teachers = dict(dominance)
        teachers.pop(self.user, None)
        teacher = max(teachers, key=lambda name: teachers[name], default=self.user)
        teacher_dominance = teachers.get(teacher, 0.0)

        return {
            "is_intervention": teacher_dominance > user_dominance,
            "teleop_action": scene.end_effector_m[teacher],
            "dominance": dominance,
            "t_s": scene.t_s,
            "success": succeeded,
            "clipped_actions": self._clipped_actions,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins a new episode and draws its random goal and settings.

        Args:
            seed: Random seed. If `None`, the random sequence of earlier episodes continues.
            options: Overrides for this episode only, such as {"link.delay_ms": 200}.

        Returns:
            The first observation, and the information dictionary, whose key "drawn" contains
            the random settings of this episode.

        Raises:
            ScenarioError: The options or the drawn values are not valid.
            UsageError: The task has no goal within reach.
        """
        self._runs = False
        super().reset(seed=seed)

        overrides = {}
        for key, values in self._vary.items():
            overrides[key] = _draw(self.np_random, values)
        seed_of_run = self.np_random.integers(2**31)
        overrides["seed"] = int(seed_of_run)
        overrides |= options or {}

        scenario = load_scenario(self._base, overrides)
        self._begin(scenario)
        scene = self._build_scene()
        self.task.begin(self.np_random, scene)

        self._runs = True
        observation = self._format_observation(scene)
        info = self._describe_step(scene, succeeded=False)
        info["drawn"] = overrides
        return observation, info

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies an action to the arm and simulates one step of the episode.

        Args:
            action: Target for the arm or force on it, depending on the mode.

        Returns:
            The observation; the reward; True if the task succeeded or failed, or if an arm left
            its limits; True if the episode reached its full duration; and the information
            dictionary.

        Raises:
            UsageError: The action is not valid. The episode does not advance.
            EpisodeError: No episode has begun, or the last one has ended.
        """
        valid_action = self._check_action(action)
        if not self._runs:
            raise EpisodeError("there is no episode, or it has ended: call reset first")
        self._actions.append(valid_action)
        self._k += self.ticks_per_step
        next_ns = tick_ns(self._k, self._tick_rate_hz)
        try:
            # The tick at `next_ns` belongs to the next step, whose action is not known yet.
            self._run.step_to(next_ns - 1)
        except ValueError as error:
            raise UsageError(f"an action: {error}") from None

        scene = self._build_scene()
        judgement = self.judge(scene)
        diverged = self._run.diverged_s is not None
        terminated = judgement.succeeded or judgement.failed or diverged
        next_k = self._k + self.ticks_per_step
        has_next_step = next_k <= self._ticks
        truncated = not (terminated or has_next_step)
        self._runs = not (terminated or truncated)
        info = self._describe_step(scene, succeeded=judgement.succeeded)
        observation = self._format_observation(scene)
        return observation, judgement.reward, terminated, truncated, info

    def judge(self, scene: Scene) -> Judgement:
        """Lets the task compute the reward of a step and decide whether the episode ends.

        Args:
            scene: State after the step.
        """
        result = self.task.judge(scene)
        return Judgement(*result) if isinstance(result, tuple) else Judgement(result)

    @property
    def is_running(self) -> bool:
        """True if `reset` has started an episode that has not ended yet."""
        return self._runs

    @property
    def run(self) -> FusedRun:
        """The simulation of the current episode.

        A vector environment may advance it directly, together with other episodes, instead of
        calling `step`.
        """
        return self._run

    @property
    def total_ticks(self) -> int:
        """Number of ticks in a complete episode."""
        return self._ticks

    @property
    def plants(self) -> Mapping[str, Any]:
        """User-written simulation models of arms, by site name."""
        return self._run.plants

    def note_steps(self, actions: Sequence[Array], clipped_actions: int, *, ends: bool) -> None:
        """Records the actions of an episode that a vector environment has simulated.

        The episode can then be saved or drawn as if this environment had simulated the steps
        itself. The state of `run` must be the state after these steps.

        Args:
            actions: Actions of all steps of the episode, which have already been checked.
            clipped_actions: Number of these actions that were clipped.
            ends: True if the episode has ended.
        """
        self._actions[:] = actions
        self._k = len(actions) * self.ticks_per_step
        self._clipped_actions = clipped_actions
        self._runs = not ends

    def _check_action(self, action: Array) -> Array:
        """Returns an action as an array, with each entry clipped to its bounds.

        Raises:
            UsageError: The action has the wrong size, or an entry is not finite.
        """
        try:
            values = np.array(action, dtype=np.float64)
        except (TypeError, ValueError):
            size = count_nouns(self.action_size, "number")
            raise UsageError(f"an action must be {size}, not {action!r:.80}") from None

        if values.shape != (self.action_size,):
            content = f"an array of shape {values.shape}"
            if values.ndim == 1:
                content = count_nouns(values.size, "number")
            size = count_nouns(self.action_size, "number")
            raise UsageError(f"an action must have {size}, but this one has {content}")
        if not np.isfinite(values).all():
            raise UsageError(f"the action {values.tolist()} is not finite")

        clipped, exceeds = self.clip_actions(values)
        if exceeds:
            self._clipped_actions += 1
            self.warn_of_clipping(values, stacklevel=4)
        return clipped

    def clip_actions(self, values: Array) -> tuple[Array, Any]:
        """Clips actions to their allowed range and reports which of them exceeded it.

        Args:
            values: One action, or several actions as rows, as passed by the policy.
        """
        limit = self.action_limit
        if self._normalize:
            values = limit * values
        # A bound in float32 may exceed the limit by its rounding.
        exceeds = (np.abs(values) > WITH_ROUNDING * limit).any(axis=-1)
        return np.clip(values, -limit, limit), exceeds

    def warn_of_clipping(self, values: Array, stacklevel: int) -> None:
        """Issues a Python warning the first time that an action is out of range.

        Args:
            values: The action as passed by the policy.
            stacklevel: Stack level of the code of the user, as in `warnings.warn`. Level 1 is
                this method.
        """
        if self._has_warned:
            return
        self._has_warned = True
        bound = 1.0 if self._normalize else self.action_limit
        warnings.warn(
            f"the action {values.tolist()} exceeds the bound {bound:g} of the action space and "
            "is clipped; info['clipped_actions'] counts such actions",
            stacklevel=stacklevel,
        )

    def render(self) -> Any:
        """Draws an image of the arms and the goal in their current state.

        Returns:
            An image of shape (height, width, 3), or `None` if the environment has no render
            mode.

        Raises:
            EpisodeError: No episode has begun.
        """
        if self.render_mode is None:
            return None
        if not (self._runs or self._actions):
            raise EpisodeError("there is no episode to draw: call reset first")
        # imported here, because the import of Matplotlib takes a second
        from trilat_net.presentation import EpisodePicture

        if self._picture is None:
            self._picture = EpisodePicture(self.scenario, self.leads)
        scene = self._build_scene()
        goal = self.task.goal if self._is_goal_position(scene) else None
        title = f"t = {scene.t_s:.2f} s"
        return self._picture.draw(scene.q, scene.bodies, goal, title)

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the episode so far to a log, which can be verified.

        Since the environment keeps no records, the run is simulated again with the same
        actions.

        Args:
            path: Path of the log.
            force: True to replace an existing file.

        Returns:
            The path of the log.

        Raises:
            UsageError: The episode has no step yet, or the file exists.
        """
        if not self._actions:
            raise UsageError("an episode has no log before its first step")
        hand_site = self.build_hand_site(self.scenario)
        player = _ActedHand(hand_site, self._actions)
        hands = {self.user: player.track}
        elapsed_s = self._k / self._tick_rate_hz
        scenario = replace(self.scenario, duration_s=elapsed_s)
        log_path = Path(path)
        SimulatedLog.record_scenario(
            scenario, log_path, force=force, hands=hands, policies=[self.user]
        )
        return log_path


def _flatten_space(parts: spaces.Dict) -> spaces.Box:
    """Returns the space of flat observations, a single float32 array.

    Args:
        parts: Observation space in the form of a dictionary.
    """
    lows = []
    highs = []
    for box in parts.values():
        if isinstance(box, spaces.Box):
            lows.append(np.ravel(box.low))
            highs.append(np.ravel(box.high))
    low = np.concatenate(lows)
    high = np.concatenate(highs)
    return spaces.Box(
        low=low.astype(np.float32),
        high=high.astype(np.float32),
        dtype=np.float32,
    )


def _name_numbers(parts: spaces.Dict) -> list[str]:
    """Returns the name of each entry of a flat observation, such as "peer_q[1][0]".

    Args:
        parts: Observation space in the form of a dictionary.
    """
    names = []
    for part, box in parts.items():
        shape = box.shape or ()
        for indices in np.ndindex(shape):
            subscripts = [f"[{index}]" for index in indices]
            names.append(part + "".join(subscripts))
    return names


def _check_arguments(
    *, mode: str, rate_hz: int, delay_ms: float, task: EpisodeTask | None
) -> None:
    """Raises UsageError if an argument of an environment is not valid.

    Args:
        mode: Meaning of an action.
        rate_hz: Number of steps per second.
        delay_ms: Time from an observation until its action takes effect, in ms.
        task: Task of the episodes. `None` for the default task.

    Raises:
        UsageError: An argument is not valid. The message names its value and the valid values.
    """
    if mode not in ("", *HAND_MODES):
        choices = ", ".join(map(repr, HAND_MODES))
        raise UsageError(f"mode must be {choices} or empty, not {mode!r}")
    if isinstance(rate_hz, bool) or not isinstance(rate_hz, int) or rate_hz < 1:
        raise UsageError(f"rate_hz must be a whole number of steps per second, not {rate_hz!r}")
    if isinstance(delay_ms, str) or not 0.0 <= delay_ms < math.inf:
        raise UsageError(f"delay_ms must be a time of at least 0 ms, not {delay_ms!r}")
    if task is not None and not (hasattr(task, "begin") and hasattr(task, "judge")):
        raise UsageError(f"task must have the methods begin and judge, unlike {task!r}")


def _draw(random: np.random.Generator, values: Sequence[Any]) -> Any:
    """Draws a random value for a scenario key that varies from episode to episode.

    Args:
        random: Random number generator.
        values: A tuple of two bounds, or a sequence of possible values.
    """
    has_numbers = all(isinstance(value, int | float) for value in values)
    is_pair = isinstance(values, tuple) and len(values) == 2
    if is_pair and has_numbers:
        return float(random.uniform(*values))
    index = int(random.integers(len(values)))
    return values[index]


if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point="trilat_studies.gym_environment:TeleoperationEnv")
