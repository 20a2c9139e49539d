"""Steps several Gymnasium environments together, on the SIMD vector unit of one core.

Training a policy requires millions of steps. Environments that differ only in numerical
parameters are therefore simulated side by side with vector instructions. Each environment
occupies one lane, a position in the vector registers. NumPy computes the observations and
rewards of all environments together.

Each sub-environment is a `TeleoperationEnv`, which starts its own episodes and can draw and
save them.

Invariant:
    - Observations, rewards and information are identical, bit for bit, to those that
      `gymnasium.vector.SyncVectorEnv` returns when it steps the sub-environments one by one.
    - A sub-environment whose current episode cannot share the vector instructions is stepped on
      its own. If this applies to all sub-environments, the attribute `obstacle` states the
      reason.
    - If an action is rejected, no sub-environment advances.
"""

import copy
import math
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

from trilat_net.core import Array, HandView, LaneEpisodes, PeerView, tick_ns
from trilat_net.errors import UsageError

from .teleoperation_environment import (
    MOST_DRAWS,
    EpisodeError,
    ReachTask,
    Scene,
    TeleoperationEnv,
)

Flags = NDArray[np.bool_]


class TeleoperationVectorEnv(SyncVectorEnv[Any, Any]):
    """Several environments, in each of which a policy operates one arm, simulated together.

    `make_env(..., num_envs=8)` creates this object. It has the interface of Gymnasium's vector
    environments: `step` takes one action per environment and returns one observation for each.

    Args:
        env: The first sub-environment. The others are copies of it.
        num_envs: Number of sub-environments.
        autoreset_mode: When the next episode begins after one has ended: "NextStep", "SameStep"
            or "Disabled", as in Gymnasium.

    Attributes:
        obstacle: Reason why sub-environments are stepped one by one. Empty if they are computed
            side by side.

    Raises:
        UsageError: The number of environments or the mode is not valid.
    """

    def __init__(
        self,
        env: TeleoperationEnv,
        num_envs: int,
        autoreset_mode: str = "NextStep",
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise UsageError(f"num_envs must be a whole number of at least 1, not {num_envs!r}")
        modes = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in modes:
            names = ", ".join(map(repr, modes))
            raise UsageError(f"autoreset_mode must be one of {names}, not {autoreset_mode!r}")

        envs = [env, *(_copy_env(env) for _ in range(num_envs - 1))]
        super().__init__(
            [partial(_return, member) for member in envs], autoreset_mode=autoreset_mode
        )

        self._members = envs
        self._parts: list[_LaneEnvs] = []
        self.obstacle = _explain_steps(env)
        if not self.obstacle and num_envs < LaneEpisodes.least_runs:
            self.obstacle = f"fewer than {LaneEpisodes.least_runs} environments"
        elif self.obstacle:
            warnings.warn(
                f"the environments are stepped one by one, because of {self.obstacle}",
                stacklevel=3,
            )
        if not self.obstacle:
            for first in range(0, num_envs, LaneEpisodes.most_runs):
                members = envs[first : first + LaneEpisodes.most_runs]
                self._parts.append(_LaneEnvs(members, first))

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes in all environments, or only where "reset_mask" is True.

        Args:
            seed: Random seed of the first environment, increased by 1 for each further one; or
                a list with one seed per environment. If `None`, the random sequences of earlier
                episodes continue.
            options: Overrides for these episodes only, as in `TeleoperationEnv.reset`, and
                "reset_mask", an array of booleans.

        Returns:
            The observations and the information dictionary.
        """
        if self._parts and options and "reset_mask" in options:
            # The observations of environments whose episodes continue.
            self._env_obs = [
                _select_observation(self._observations, i) for i in range(self.num_envs)
            ]
        return super().reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, Array, Flags, Flags, dict[str, Any]]:
        """Applies one action to each environment and advances all of them by one step.

        Args:
            actions: The actions, one per environment.

        Returns:
            The observations; the rewards; for each environment, True if its task succeeded or
            failed, or if an arm left its limits; for each environment, True if the episode
            reached its full duration; and the information dictionary of Gymnasium's vector
            environments.

        Raises:
            UsageError: An action is not valid. No environment advances.
            EpisodeError: An environment that is to be stepped has no episode in progress.
        """
        is_reset = self._autoreset_envs.copy()
        if self.autoreset_mode == AutoresetMode.DISABLED:
            assert not is_reset.any(), "an ended episode must be reset first (reset_mask)"
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            is_reset[:] = False
        values = self._read_actions(actions, ~is_reset)
        if not self._parts:
            return super().step(actions)
        checked, exceeds = self._members[0].clip_actions(values)
        exceeds &= ~is_reset
        if exceeds.any():
            first = int(np.flatnonzero(exceeds)[0])
            self._members[0].warn_of_clipping(values[first], stacklevel=3)

        results = _Results(self.num_envs)
        for part in self._parts:
            part.load(~is_reset)
        for part in self._parts:
            part.step(checked, exceeds, ~is_reset, results)
        infos = results.infos
        self._rewards = results.rewards
        self._terminations = results.terminations
        self._truncations = results.truncations

        observations: dict[int, Any] = {}
        for i in np.flatnonzero(~results.is_stepped).tolist():
            member = self._members[i]
            if is_reset[i]:
                observations[i], info = member.reset()
            else:
                action = np.asarray(actions[i])
                observations[i], reward, ends, is_cut, info = member.step(action)
                self._rewards[i] = reward
                self._terminations[i] = ends
                self._truncations[i] = is_cut
            infos = self._add_info(infos, info, i)
        batch = self._join(results.observations, observations)
        self._autoreset_envs = self._terminations | self._truncations
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            batch, infos = self._reset_ended(batch, infos)
        # The caller may change the arrays that it receives.
        self._observations = _copy_observations(batch)
        return (
            batch,
            self._rewards.copy(),
            self._terminations.copy(),
            self._truncations.copy(),
            infos,
        )

    def _read_actions(self, actions: Any, is_needed: Flags) -> Array:
        """Converts the actions of all environments to an array and checks them.

        An environment that is about to begin an episode ignores its action, which need not be
        finite.

        Args:
            actions: The actions, one per environment.
            is_needed: True for environments that use their action.

        Returns:
            The actions, shape (environments, action size).

        Raises:
            UsageError: The shape is wrong, or an entry is not finite.
        """
        shape = (self.num_envs, self._members[0].action_size)
        try:
            values = np.array(actions, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(
                f"actions must be an array of shape {shape}, not {actions!r:.80}"
            ) from None
        if values.shape != shape:
            raise UsageError(f"actions must have the shape {shape}, not {values.shape}")
        is_finite = np.isfinite(values).all(axis=1)
        invalid = np.flatnonzero(~is_finite & is_needed)
        if len(invalid):
            first = int(invalid[0])
            raise UsageError(f"action {first}, {values[first].tolist()}, is not finite")
        return values

    def _join(self, batched: Any, single: Mapping[int, Any]) -> Any:
        """Inserts observations of single environments into those of all environments.

        Args:
            batched: Observations of all environments, which are modified in place. If `None`,
                the observations of the previous step are used.
            single: The observations to insert, by index of the environment.

        Returns:
            The observations of all environments.
        """
        if batched is None:
            batched = self._observations
        is_array = isinstance(batched, np.ndarray)
        for index, observation in single.items():
            if is_array:
                batched[index] = observation
            else:
                for name, values in observation.items():
                    batched[name][index] = values
        return batched

    def _reset_ended(self, batch: Any, infos: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Begins the next episode of each environment whose episode ended in this step.

        This is Gymnasium's reset mode "SameStep".

        Args:
            batch: Observations of all environments, which are modified in place.
            infos: Information of all environments.

        Returns:
            The observations, in which those of new episodes replace those of ended episodes;
            and the information, with "final_obs" and "final_info" of the ended episodes.
        """
        observations = {}
        for index in np.flatnonzero(self._autoreset_envs).tolist():
            final = {
                "final_obs": _copy_observations(_select_observation(batch, index)),
                "final_info": _select(infos, index),
            }
            infos = self._add_info(infos, final, index)
            observations[index], info = self._members[index].reset()
            # The first information of the next episode replaces the last information of this
            # episode.
            infos = self._add_info(infos, info, index)
        return self._join(batch, observations), infos

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls the method `name` of each environment, or reads the attribute of that name.

        While episodes are simulated together, their environments are not updated. The states of
        the episodes are therefore first written back to the environments.
        """
        self._write_back()
        return super().call(name, *args, **kwargs)

    def render(self) -> tuple[Any, ...]:
        """Returns one image of the arms per environment, as Gymnasium expects."""
        self._write_back()
        return super().render()

    def _write_back(self) -> None:
        """Copies the states of the episodes simulated together back into their environments.

        The environments can then draw and save their episodes.
        """
        for part in self._parts:
            part.write_back()


class _Results:
    """Results of one step of all environments, in the format that Gymnasium expects.

    At most 64 environments are simulated together. Larger numbers are split into parts, each of
    which writes its results into this object.

    Args:
        count: Number of environments.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.is_stepped = np.zeros(count, np.bool_)
        self.rewards = np.zeros(count)
        self.terminations = np.zeros(count, np.bool_)
        self.truncations = np.zeros(count, np.bool_)
        self.observations: Any = None
        self.infos: dict[str, Any] = {}

    def put_info(self, infos: dict[str, Any], key: str, indices: Any, values: Any) -> None:
        """Writes one entry of the information dictionary for all environments.

        For each entry, Gymnasium also stores an array of booleans under the same key with a
        leading "_", which is True for the environments that have the entry.

        Args:
            infos: The dictionary, or a dictionary nested in it.
            key: Key of the entry.
            indices: Environments to which the values belong, as a NumPy index.
            values: The values, one per environment, or a dictionary of such values for several
                entries.
        """
        has_entry = infos.setdefault(f"_{key}", np.zeros(self.count, np.bool_))
        has_entry[indices] = True
        if isinstance(values, dict):
            nested_infos = infos.setdefault(key, {})
            for name, numbers in values.items():
                self.put_info(nested_infos, name, indices, numbers)
            return
        if key not in infos:
            infos[key] = np.zeros((self.count, *values.shape[1:]), values.dtype)
        infos[key][indices] = values

    def put_observations(self, indices: Any, observations: Any, is_all: bool) -> None:
        """Writes the new observations of some environments into the arrays of all environments.

        A vector environment always returns the observations of all its environments, but a call
        may have simulated only some of them.

        Args:
            indices: Indices of the simulated environments, as a NumPy index.
            observations: The observations, as an array or as a mapping from name to array.
            is_all: True if these are the observations of all environments.
        """
        if is_all:
            self.observations = observations
        elif isinstance(observations, np.ndarray):
            if self.observations is None:
                shape = (self.count, *observations.shape[1:])
                self.observations = np.zeros(shape, observations.dtype)
            self.observations[indices] = observations
        else:
            if self.observations is None:
                self.observations = {
                    name: np.zeros((self.count, *values.shape[1:]), values.dtype)
                    for name, values in observations.items()
                }
            for name, values in observations.items():
                self.observations[name][indices] = values


class _LaneEnvs:
    """Environments that are simulated together, each in one lane of the vector registers.

    An episode is assigned to its lane before its first step, provided that its scenario has the
    same structure as those of the other lanes. Otherwise the environment is stepped on its own.

    Args:
        envs: The environments, at most `LaneEpisodes.most_runs`.
        first: Index of the first of these environments in the vector environment.
    """

    def __init__(self, envs: Sequence[TeleoperationEnv], first: int) -> None:
        self._envs = list(envs)
        self._first = first
        env = envs[0]
        names = env.scenario.names
        self._names = names
        self._user = names.index(env.user)
        self._leads = names.index(env.leads)

        hand_site = env.build_hand_site(env.scenario)
        self._is_joint = hand_site.spec.mode == "joint"
        self._delay_ticks = hand_site.make_hand().delay_ticks
        self._period = env.ticks_per_step
        self._rate_hz = env.scenario.sites[env.user].rate_hz

        self._lanes = LaneEpisodes(
            env.run,
            len(envs),
            hand_site=self._user,
            hand_row=_find_hand_row(env),
            period_ticks=self._period,
        )

        count = len(envs)
        # Runs and tasks of the episodes in the lanes, `None` for an empty lane.
        self._runs: list[Any] = [None] * count
        self._tasks: list[Any] = [None] * count
        self._is_loaded = np.zeros(count, np.bool_)
        self._is_reach = np.zeros(count, np.bool_)

        self._steps = np.zeros(count, np.int64)
        self._total_ticks = np.zeros(count, np.int64)
        self._clipped = np.zeros(count, np.int64)
        self._actions = np.zeros((count, 0, env.action_size))

        self._lengths_m = np.zeros((len(names), count, 2))
        self._reach = _ReachTasks(count)
        self._goals: Array = np.zeros((count, *np.shape(env.task.goal)))

    def load(self, is_stepped: Flags) -> None:
        """Loads episodes that have begun since the last step, in place of those that ended.

        Each episode is simulated in the lane of its environment.

        Args:
            is_stepped: True for environments of the vector environment that are to be stepped.

        Raises:
            EpisodeError: An environment that is to be stepped has no episode in progress.
        """
        for lane, env in enumerate(self._envs):
            if not is_stepped[self._first + lane]:
                continue
            if not env.is_running:
                raise EpisodeError("there is no episode, or it has ended: call reset first")
            if self._runs[lane] is not env.run:
                self._load_episode(lane, env)
            if self._tasks[lane] is not env.task:
                self._load_task(lane, env)

    def _load_episode(self, lane: int, env: TeleoperationEnv) -> None:
        """Adds a new episode to those that are simulated side by side, if possible.

        Args:
            lane: Lane of the episode.
            env: The environment.
        """
        self._runs[lane] = env.run
        self._tasks[lane] = None
        can_share = not _explain_steps(env, compiles=False)
        self._is_loaded[lane] = (
            can_share and self._lanes.find_structure(env.run) == self._lanes.structure
        )
        if not self._is_loaded[lane]:
            return

        rules = env.build_hand_site(env.scenario).make_rules()
        self._lanes.load(lane, env.run, rules)
        self._steps[lane] = 0
        self._clipped[lane] = 0
        self._total_ticks[lane] = env.total_ticks
        # the array of actions must hold the longest episode
        steps = env.total_ticks // self._period
        if steps > self._actions.shape[1]:
            longer = np.zeros((len(self._envs), steps, env.action_size))
            earlier_steps = self._actions.shape[1]
            longer[:, :earlier_steps] = self._actions
            self._actions = longer

        arms = env.scenario.arms
        self._lengths_m[:, lane] = [arms[name].lengths_m for name in self._names]

    def _load_task(self, lane: int, env: TeleoperationEnv) -> None:
        """Copies the task of an episode, so that `step` can judge many tasks together.

        Only tasks of the class `ReachTask` are judged together. Other tasks are judged one by
        one.

        Args:
            lane: Lane of the episode.
            env: The environment.
        """
        self._tasks[lane] = env.task
        task = env.task
        self._is_reach[lane] = type(task) is ReachTask
        if isinstance(task, ReachTask) and self._is_reach[lane]:
            self._reach.load(lane, task, self._names.index(task.site))
            self._goals[lane] = task.goal

    def step(
        self, actions: Array, exceeds: Flags, is_stepped: Flags, results: _Results
    ) -> None:
        """Simulates one step of several episodes side by side and stores the results.

        Args:
            actions: Checked actions of all environments of the vector environment.
            exceeds: True for actions that were clipped.
            is_stepped: True for environments that are to be stepped.
            results: Object in which the results are stored.
        """
        count = len(self._envs)
        block = slice(self._first, self._first + count)
        is_active = self._is_loaded & is_stepped[block]
        if not is_active.any():
            return
        lanes = np.arange(count)
        rows = self._steps[is_active]
        self._actions[lanes[is_active], rows] = actions[block][is_active]
        self._clipped[is_active] += exceeds[block][is_active]
        self._advance(is_active)
        self._steps[is_active] += 1
        state = _State(self, self._lanes, count)

        where = lanes[is_active]
        is_all = len(where) == results.count
        target: Any = slice(None) if is_all else where + self._first
        rewards = np.zeros(count)
        succeeded = np.zeros(count, np.bool_)
        failed = np.zeros(count, np.bool_)
        reaches = is_active & self._is_reach
        if reaches.any():
            own_rewards, own_success = self._reach.judge(state, reaches)
            rewards[reaches] = own_rewards[reaches]
            succeeded[reaches] = own_success[reaches]
        for lane in np.flatnonzero(is_active & ~self._is_reach).tolist():
            env = self._envs[lane]
            judgement = env.judge(state.build_scene(lane))
            rewards[lane] = judgement.reward
            succeeded[lane] = judgement.succeeded
            failed[lane] = judgement.failed
            self._goals[lane] = env.task.goal
        terminations = succeeded | failed | self._lanes.has_ended
        has_next_step = (self._steps + 1) * self._period <= self._total_ticks
        truncations = ~(terminations | has_next_step)

        results.is_stepped[target] = True
        results.rewards[target] = rewards[where]
        results.terminations[target] = terminations[where]
        results.truncations[target] = truncations[where]
        env = self._envs[0]
        parts = state.observe(self._goals)
        if not is_all:
            parts = {name: values[where] for name, values in parts.items()}
        results.put_observations(target, env.format_parts(parts, len(where)), is_all)
        for key, values in self._describe(state, succeeded).items():
            results.put_info(results.infos, key, target, _take(values, where, is_all))
        for lane in np.flatnonzero(is_active & (terminations | truncations)).tolist():
            self._write_lane(lane, ends=True)

    def _advance(self, is_active: Flags) -> None:
        """Simulates one step, which consists of many ticks, of all active episodes.

        The operator applies an action only after its delay. If this moment lies within a step,
        the step is simulated in two parts.

        Args:
            is_active: True for lanes that are stepped.
        """
        # The action of a step takes effect after the delay, in this step or in a later one,
        # always at the same tick of a step.
        delay_steps, offset = divmod(self._delay_ticks, self._period)
        effective_steps = self._steps - delay_steps
        has_action = effective_steps >= 0
        lanes = np.arange(len(self._envs))
        goals = self._actions[lanes, np.maximum(effective_steps, 0)]

        spans = [(self._period, has_action)]
        if offset:
            no_action = np.zeros_like(has_action)
            spans = [(offset, no_action), (self._period - offset, has_action)]
        for ticks, is_acting in spans:
            self._lanes.advance(
                ticks,
                is_idle=~is_active,
                acts=is_acting,
                goals=goals,
                locate=self._locate,
            )

    def _locate(self, q: Array) -> Array:
        """Returns the pose of the user's arm in the coordinates of an action, for each lane.

        The coordinates are joint angles, or the position of the end effector. The compiled
        operators use this pose as the position from which an action starts.

        Args:
            q: Joint angles in each lane, shape (lanes, 2), in rad.
        """
        return q if self._is_joint else self.place_end_effectors(self._user, q)

    def place_end_effectors(self, i: int, q: Array) -> Array:
        """Returns the end-effector position of one arm in all episodes, shape (lanes, 2), in m.

        Args:
            i: Index of the site.
            q: Joint angles in each lane, shape (lanes, 2), in rad.
        """
        # Same functions and order of operations as in `ArmModel.end_effector`, to give equal
        # bits: NumPy's sine differs in the last bits.
        upper_arm = q[:, 0].tolist()
        forearm = (q[:, 0] + q[:, 1]).tolist()
        lengths_m = self._lengths_m[i]
        position_m = np.empty((len(q), 2))
        for axis, function in enumerate((math.cos, math.sin)):
            upper = lengths_m[:, 0] * np.array([*map(function, upper_arm)])
            lower = lengths_m[:, 1] * np.array([*map(function, forearm)])
            position_m[:, axis] = upper + lower
        return position_m

    def _describe(self, state: "_State", succeeded: Flags) -> dict[str, Any]:
        """Returns the information of a step for all lanes, as in `TeleoperationEnv`.

        A teacher is a user other than the policy. The teacher with the largest dominance factor
        intervenes while the site of the task follows this teacher more than the policy.

        Args:
            state: State after the step.
            succeeded: True for lanes whose task is complete.
        """
        env = self._envs[0]
        peers = env.scenario.peers(env.leads)
        alpha = state.read_links("alpha", self._leads)[:, :, 0]
        dominance = {name: alpha[:, p] for p, name in enumerate(peers)}

        count = len(self._envs)
        lanes = np.arange(count)
        user_dominance = dominance.get(env.user, np.zeros(count))

        teachers = [p for p, name in enumerate(peers) if name != env.user]
        if teachers:
            teacher_alpha = alpha[:, teachers]
            strongest = np.argmax(teacher_alpha, axis=1)
            teacher_dominance = teacher_alpha[lanes, strongest]
            site_of_teacher = np.array([self._names.index(peers[p]) for p in teachers])
            teacher_sites = site_of_teacher[strongest]
        else:
            teacher_dominance = np.zeros(count)
            teacher_sites = np.full(count, self._user)

        return {
            "is_intervention": teacher_dominance > user_dominance,
            "teleop_action": state.end_effectors_m[teacher_sites, lanes],
            "dominance": dominance,
            "t_s": state.t_s,
            "success": succeeded,
            "clipped_actions": self._clipped.copy(),
        }

    def write_back(self) -> None:
        """Copies the states of the episodes in progress back into their environments.

        Episodes are simulated together in common arrays, but drawn and saved one by one.
        """
        for lane, env in enumerate(self._envs):
            is_here = self._is_loaded[lane] and self._runs[lane] is env.run
            if is_here and env.is_running and self._steps[lane]:
                self._write_lane(lane, ends=False)

    def _write_lane(self, lane: int, *, ends: bool) -> None:
        """Copies the state of one episode from the common arrays into its environment.

        Args:
            lane: Lane of the episode.
            ends: True if the episode has ended.
        """
        env = self._envs[lane]
        self._lanes.write_back(lane)
        actions = self._actions[lane, : self._steps[lane]].copy()
        env.note_steps(list(actions), int(self._clipped[lane]), ends=ends)
        if self._is_reach[lane]:
            self._reach.write_back(lane, self._tasks[lane])

    @property
    def envs(self) -> list[TeleoperationEnv]:
        """The environments whose episodes are simulated side by side."""
        return self._envs

    @property
    def names(self) -> tuple[str, ...]:
        """Site names, such as "m1", which are the same in all environments."""
        return self._names

    @property
    def user(self) -> int:
        """Index of the site whose arm the policy moves."""
        return self._user

    @property
    def is_joint(self) -> bool:
        """True if an action is a set of joint angles, False if it is a position."""
        return self._is_joint

    @property
    def k(self) -> NDArray[np.int64]:
        """Number of ticks that each episode has lasted so far."""
        return self._steps * self._period

    @property
    def rate_hz(self) -> int:
        """Tick rate of the arm that the policy moves, in Hz."""
        return self._rate_hz


class _State:
    """State of all episodes that are simulated together, used to compute observations.

    Args:
        envs: The environments.
        lanes: Their runs.
        count: Number of environments.
    """

    def __init__(self, envs: _LaneEnvs, lanes: LaneEpisodes, count: int) -> None:
        self._envs = envs
        self._lanes = lanes
        self._count = count
        self.t_s = envs.k / envs.rate_hz
        self.q = lanes.read_site("q")
        self.end_effectors_m = np.array(
            [envs.place_end_effectors(i, q) for i, q in enumerate(self.q)]
        )
        self._view: dict[str, Array] = {}
        self._peer_ticks: list[list[int]] = []
        self._new: list[list[bool]] = []

    def read_links(self, name: str, i: int) -> Array:
        """Returns a quantity for each link to site `i`, shape (lanes, peers, entries)."""
        return np.ascontiguousarray(self._lanes.read_links(name, i).transpose(1, 0, 2))

    def _find_view(self) -> dict[str, Array]:
        """Returns the view of the user's operator in each lane, with the names of `HandView`.

        The arrays have one row per lane and are computed once per step.
        """
        if self._view:
            return self._view

        user = self._envs.user
        lanes = self._lanes
        now_ns = _tick_ns(self._envs.k, self._envs.rate_hz)
        used = np.maximum(self.read_links("used", user)[:, :, 0], 0)
        stamps_ns = _tick_ns(used, self._envs.rate_hz)

        q = self.q[user]
        count = self._count
        self._view = {
            "q": q,
            "qd": lanes.read_site("qd")[user],
            "pose": q.copy() if self._envs.is_joint else self.end_effectors_m[user].copy(),
            "q_des": lanes.read_site("q_des")[user],
            "tau_x": 0.0 - lanes.read_site("on_arm")[user],
            "target": lanes.hands.arrays.target[:count].copy(),
            "peer_q": self.read_links("q", user),
            "peer_qd": self.read_links("qd", user),
            "peer_tau_x": self.read_links("tau_x", user),
            "alpha": self.read_links("alpha", user)[:, :, 0],
            "age_s": np.multiply(now_ns[:, None] - stamps_ns, 1e-9, dtype=np.float64),
            "grip": lanes.hands.arrays.grip[:count, None].copy(),
        }
        return self._view

    def observe(self, goals: Array) -> dict[str, Array]:
        """Computes the observations of all episodes, with the keys of `TeleoperationEnv`.

        Args:
            goals: Goals of the tasks.
        """
        parts = {**self._find_view(), "goal": goals.copy()}
        return {name: parts[name] for name in sorted(parts)}

    def build_scene(self, lane: int) -> Scene:
        """Returns the state of one episode in the form that its task accepts.

        User-written tasks are designed for a single environment, so they evaluate one episode
        at a time.

        Args:
            lane: Lane of the episode.
        """
        env = self._envs.envs[lane]
        user = self._envs.user
        view = {name: values[lane].copy() for name, values in self._find_view().items()}
        if not self._peer_ticks:
            self._peer_ticks = self.read_links("used", user)[:, :, 0].tolist()
            self._new = self._lanes.read_new(user).T.tolist()
        new = self._new[lane]
        peers = tuple(
            PeerView(
                alpha=float(view["alpha"][p]),
                tick=tick,
                age_s=float(view["age_s"][p]),
                new=int(new[p]),
                q=view["peer_q"][p],
                qd=view["peer_qd"][p],
                tau_x=view["peer_tau_x"][p],
            )
            for p, tick in enumerate(self._peer_ticks[lane])
        )
        k = int(self._envs.k[lane])
        names = self._envs.names
        q = {name: self.q[i, lane].copy() for i, name in enumerate(names)}
        return Scene(
            t_s=float(self.t_s[lane]),
            q=q,
            end_effector_m={
                name: self.end_effectors_m[i, lane].copy() for i, name in enumerate(names)
            },
            view=HandView(
                k=k,
                t_s=k / self._envs.rate_hz,
                q=view["q"],
                qd=view["qd"],
                pose=view["pose"],
                q_des=view["q_des"],
                tau_x=view["tau_x"],
                target=view["target"],
                grip=float(view["grip"][0]),
                peers=peers,
            ),
            bodies={},
            can_reach=partial(env.can_reach, q),
            draws=MOST_DRAWS[False],
        )


class _ReachTasks:
    """State of the task `ReachTask` (move to a point) in several episodes, as arrays.

    Computing the rewards of all episodes together is faster.

    Args:
        count: Number of lanes.
    """

    def __init__(self, count: int) -> None:
        self._sites = np.zeros(count, np.int64)
        self._goals_m = np.zeros((count, 2))
        self._within_m = np.zeros(count)
        self._stay_s = np.zeros(count)
        self._reached_s = np.zeros(count)
        self._last_s = np.zeros(count)

    def load(self, lane: int, task: ReachTask, site: int) -> None:
        """Copies the goal and the rest of the state of one task into the arrays of all tasks.

        Args:
            lane: Lane of the episode.
            task: The task.
            site: Index of the site of the end effector.
        """
        self._sites[lane] = site
        self._goals_m[lane] = task.goal
        self._within_m[lane] = task.within_m
        self._stay_s[lane] = task.stay_s
        self._reached_s[lane] = task.reached_s
        self._last_s[lane] = task.last_s

    def write_back(self, lane: int, task: ReachTask) -> None:
        """Copies the state of one episode's task from the common arrays back into the task."""
        task.reached_s = float(self._reached_s[lane])
        task.last_s = float(self._last_s[lane])

    def judge(self, state: _State, is_judged: Flags) -> tuple[Array, Flags]:
        """Computes the rewards of a step in all episodes, and finds the completed tasks.

        The results equal those of `ReachTask.judge`.

        Args:
            state: State after the step.
            is_judged: True for lanes whose tasks are judged.
        """
        lanes = np.arange(len(self._sites))
        from_goals_m = state.end_effectors_m[self._sites, lanes] - self._goals_m
        # Row by row, as in np.linalg.norm of one vector, for equal bits.
        distances_m = np.sqrt([row.dot(row) for row in from_goals_m])
        step_lengths_s = state.t_s - self._last_s
        reached_s = np.where(distances_m > self._within_m, state.t_s, self._reached_s)
        succeeded = state.t_s - reached_s >= self._stay_s
        rewards = -distances_m * step_lengths_s + succeeded.astype(np.float64)
        self._reached_s[is_judged] = reached_s[is_judged]
        self._last_s[is_judged] = state.t_s[is_judged]
        return rewards, succeeded


def _tick_ns(ticks: NDArray[np.int64], rate_hz: int) -> NDArray[np.int64]:
    """Returns the nominal times of ticks, in ns, computed as in `tick_ns`."""
    # the Python function behind the compiled one, because it accepts arrays
    plain: Any = getattr(tick_ns, "py_func", tick_ns)
    times: NDArray[np.int64] = plain(ticks, rate_hz)
    return times


def _take(values: Any, where: NDArray[np.int64], is_all: bool) -> Any:
    """Selects the values of some lanes, from an array or from each array of a dictionary."""
    if isinstance(values, dict):
        return {name: _take(numbers, where, is_all) for name, numbers in values.items()}
    return values if is_all else values[where]


def _return(env: TeleoperationEnv) -> TeleoperationEnv:
    """Returns its argument. Used with `partial` to create a factory of environments."""
    return env


def _copy_env(env: TeleoperationEnv) -> TeleoperationEnv:
    """Returns an environment with the same settings but its own copy of the task."""
    other = copy.copy(env)
    other.task = copy.deepcopy(env.task)
    return other


def _find_hand_row(env: TeleoperationEnv) -> int:
    """Returns the index of the live operator of the user's site among its operators."""
    spec = env.scenario.sites[env.user]
    hand = spec.find_live_hand()
    assert hand is not None  # every episode has one, see `TeleoperationEnv`
    return spec.hands.index(hand)


def _explain_steps(env: TeleoperationEnv, *, compiles: bool = True) -> str:
    """Explains why the current episode of an environment cannot be simulated with others.

    Args:
        env: The environment.
        compiles: True to find out whether the laws can be compiled for lanes.

    Returns:
        The reason. Empty if the episode can be simulated with others.
    """
    if env.plants:
        return "programs that move an arm"
    if any(arm.chain is not None for arm in env.scenario.arms.values()):
        return "arms that are chains of joints"
    hand_site = env.build_hand_site(env.scenario)
    obstacle = LaneEpisodes.explain_hand(
        hand_site.make_rules(), env.ticks_per_step, env.action_limit
    )
    if obstacle or not compiles:
        return obstacle
    return LaneEpisodes.explain_run(env.run, env.scenario.names.index(env.user))


def _select(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Extracts the information about one environment from that of all environments.

    Args:
        infos: Information of all environments.
        index: Index of the environment.
    """
    info: dict[str, Any] = {}
    for key, values in infos.items():
        # An ended episode has no entries from the episode before it.
        is_internal = key.startswith(("_", "final_"))
        if is_internal or not infos[f"_{key}"][index]:
            continue
        if isinstance(values, dict):
            info[key] = _select(values, index)
        elif values.ndim > 1:
            info[key] = values[index].copy()
        else:
            info[key] = (
                values[index].item() if isinstance(values[index], np.generic) else values[index]
            )
    return info


def _copy_observations(batch: Any) -> Any:
    """Copies observations, which are either one array or a dictionary of arrays."""
    if isinstance(batch, np.ndarray):
        return batch.copy()
    return {name: values.copy() for name, values in batch.items()}


def _select_observation(batch: Any, i: int) -> Any:
    """Extracts the observation of one environment from those of all environments."""
    if isinstance(batch, np.ndarray):
        return batch[i]
    return {name: values[i] for name, values in batch.items()}
