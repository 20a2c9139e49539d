"""A Gymnasium environment in which one user of an experiment acts over the network.

Invariant:
    - An episode is a run in virtual time and a function of the scenario, the seed and the
      actions; saved as a log it verifies.
    - A step is a fixed number of ticks. A refused action makes no step and changes nothing.
    - Steps follow a reset and end with the episode.
    - Observations, and the time at which an action takes effect, are those of a user-written
      hand (`OwnHand`), so that a trained policy can hold an arm live without changes. Only
      orientations are observed as six numbers, which never jump (`expand_poses`).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from msgspec.structs import replace

from ..core.own_hand import HandView
from ..core.site_arrays import SiteArrays
from ..core.ticks import tick_ns
from ..core.vectors import Array
from ..errors import UsageError, count_nouns
from ..execution.fused import FusedRun
from ..execution.virtual import record_virtual
from ..files import import_extra
from ..log.orientations import expand_poses
from ..scenario import Scenario, find_site, load_scenario
from ..scenario.operators.kernel_operators import LiveHand
from ..scenario.operators.program_hand import HandPlayer, HandSite
from ..scenario.own_plant import make_plant_players
from .reachable_places import can_reach

if TYPE_CHECKING:
    from ..reporting.episode_picture import EpisodePicture

try:
    import gymnasium
    from gymnasium import spaces
except ImportError:
    import_extra("gymnasium", "gym", "environments")
    raise

ENV_ID = "trilat_net/Teleoperation-v0"
FAR = 1e6
"""Bound of observed numbers without a tighter bound: rad, rad/s, m, N m, s."""
MOST_DRAWS = {False: 1000, True: 100}
"""Largest number of positions that a task draws until one is within reach.

It is smaller for chains (True), for which a pose is searched numerically.
"""


class EpisodeError(UsageError, gymnasium.error.ResetNeeded):
    """There is no episode in progress: it has not begun, or it has ended."""


class Scene(NamedTuple):
    """The true state of an episode at a step, which the user need not know.

    Attributes:
        t_s: time since the epoch, s.
        q: joint angles by site, rad, shape (n,).
        end_effector_m: position of the end effector by site, m.
        view: the user's view.
        bodies: poses of the bodies of plants, by site and then name, as in a record, shape
            (7,).
        can_reach: returns whether a site's end effector can reach a position, m.
        draws: largest number of positions that a task may draw until one is within reach.
    """

    t_s: float
    q: dict[str, Array]
    end_effector_m: dict[str, Array]
    view: HandView
    bodies: dict[str, dict[str, Array]]
    can_reach: Callable[[str, Array], bool] = lambda _site, _position: True
    draws: int = MOST_DRAWS[False]


class Judgement(NamedTuple):
    """The judgement of a step by its task.

    Attributes:
        reward: the reward.
        succeeded: the task is done, and the episode ends.
        failed: the task cannot be done any more, and the episode ends.
    """

    reward: float
    succeeded: bool = False
    failed: bool = False


class EpisodeTask(Protocol):
    """The task of an episode."""

    goal: Array
    """The goal that the user observes; its shape never changes."""
    bound: float
    """Bound of the goal's numbers, which never changes."""

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws the goal of an episode."""

    def judge(self, scene: Scene) -> float | tuple[Any, ...]:
        """Returns the reward of a step, or a `Judgement`, also as a tuple."""


class ReachTask:
    """Task to bring an end effector to a random position within its reach, and to stay there.

    The reward of a step is minus the distance, m, times the duration of the step, s. It is
    larger by 1 once the end effector has stayed at the goal for `stay_s`.

    Args:
        site: site of the end effector.
        radius_m: largest distance of the goal from the start, m.
        within_m: largest distance from the goal that counts as reached, m.
        stay_s: time to stay at the goal, s.
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
        self._site = site
        self._radius_m = radius_m
        self._within_m = within_m
        self._stay_s = stay_s
        self._reached_s = 0.0
        self._last_s = 0.0

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws a goal, uniformly over the part of the sphere that the end effector reaches.

        Raises:
            UsageError: no drawn position is within reach.
        """
        start_m = scene.end_effector_m[self._site]
        for _ in range(scene.draws):
            direction = random.normal(size=len(start_m))
            # the root makes the density uniform over the area or the volume
            share = random.uniform() ** (1.0 / len(start_m))
            offset_m = self._radius_m * share * direction / np.linalg.norm(direction)
            position_m = start_m + offset_m
            if scene.can_reach(self._site, position_m):
                break
        else:
            positions = count_nouns(scene.draws, "position")
            raise UsageError(
                f"the task has no goal: the end effector can reach none of {positions} "
                f"within {self._radius_m:g} m around the start of {self._site}; "
                "start from another pose (sites.NAME.q0_rad), or use your own task"
            )
        self.goal = position_m
        self._reached_s = scene.t_s
        self._last_s = scene.t_s

    def judge(self, scene: Scene) -> Judgement:
        """Returns the reward of a step, and whether the goal was kept for long enough."""
        from_goal_m = scene.end_effector_m[self._site] - self.goal
        distance_m = float(np.linalg.norm(from_goal_m))
        step_s = scene.t_s - self._last_s
        self._last_s = scene.t_s
        if distance_m > self._within_m:
            self._reached_s = scene.t_s
        stayed_s = scene.t_s - self._reached_s
        succeeded = stayed_s >= self._stay_s
        reward = -distance_m * step_s + float(succeeded)
        return Judgement(reward, succeeded=succeeded)


class ActedHand(HandPlayer):
    """The user's hand, which applies the actions of an episode.

    Args:
        hand_site: site and settings of the hand.
        actions: the action of each step; the environment appends to this list.
    """

    def __init__(self, hand_site: HandSite, actions: list[Array]) -> None:
        super().__init__(hand_site, None)
        self._actions = actions

    def request_action(self, k: int, arrays: SiteArrays) -> None:  # noqa: ARG002 - already observed
        """Passes the action of the current step to the hand as its decision."""
        action = self._actions[k // self.hand.period_ticks]
        self.hand.accept_decision(k, action.tolist())


class TeleoperationEnv(gymnasium.Env[dict[str, Array], Array]):
    """An experiment in which one user is trained; also called `tn.make_env`.

    See docs/policies.md.

    >>> bent = {f"sites.{name}.q0_rad": [0.4, 1.0] for name in ("m", "s")}
    >>> env = tn.make_env("two_sites", bent, user="m", duration_s=1)
    >>> observation, info = env.reset(seed=1)
    >>> observation["peer_q"].shape
    (1, 2)

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"link.delay_ms": 100}`.
        user: the site whose arm the actions move.
        mode: "tip", "joint" or "force", as for a live hand; by default the scenario's.
        rate_hz: number of steps per second.
        delay_ms: time from an observation to the effect of its action, ms.
        duration_s: duration of an episode, s; by default the scenario's.
        task: the task; by default the site `leads` brings its end effector to a position.
        vary: keys that each episode draws: from a list of values, or from a pair of bounds.
        leads: the site that does the task.
        render_mode: "rgb_array": `render` returns a picture of the arms and the goal; None:
            `render` returns None.
        flat: an observation is one array of float32 instead of a dictionary, and an action is
            float32.

    Attributes:
        observation_names: with `flat`, the name of each number of an observation, as in
            "q[0]". A number of a matrix has two indices, its row and its column.

    Raises:
        ScenarioError: the scenario or an override is not valid.
        UsageError: there is no such site, the rate is not valid, or Gymnasium is missing.
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
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            modes = ", ".join(self.metadata["render_modes"])
            raise UsageError(f"render_mode is {modes} or None, not {render_mode!r}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": rate_hz}
        self._picture: EpisodePicture | None = None
        self._runs = False
        self._user = user
        self._mode = mode
        self._rate_hz = rate_hz
        self._delay_s = delay_ms * 1e-3
        self._vary = vary
        self._leads = leads
        self.task: EpisodeTask = task or ReachTask(leads)
        self._base = self._prepare(load_scenario(scenario, set, duration_s=duration_s))
        tick_rate_hz = self._base.sites[user].rate_hz
        if tick_rate_hz % rate_hz:
            raise UsageError(f"rate_hz must divide the tick rate of {user}, {tick_rate_hz}")
        self._ticks_per_step = tick_rate_hz // rate_hz

        hand = self._build_hand_site(self._base).describe()
        limit = hand.limit if hand.mode == "force" else self._find_reach()
        dtype = np.float32 if flat else np.float64
        self._action_limit = limit
        self._action_size = hand.size
        self.action_space: Any = spaces.Box(-limit, limit, (hand.size,), dtype)

        self._begin(self._base)
        self.task.begin(np.random.default_rng(0), self._build_scene())
        self._dict_space = self._build_dict_space(self._build_scene())
        self.observation_space: Any = self._dict_space
        self.observation_names: list[str] = []
        if flat:
            self.observation_space = _flatten_space(self._dict_space)
            self.observation_names = _name_numbers(self._dict_space)
        self._flat = flat

    def _build_dict_space(self, scene: Scene) -> spaces.Dict:
        """Returns the space of observations as a dictionary.

        Args:
            scene: a state of an episode, whose observation has the shapes of all observations.
        """
        bounds = {"alpha": 1.0, "grip": 1.0, "goal": self.task.bound}
        boxes: dict[str, Any] = {}
        for name, values in self._observe(scene).items():
            bound = bounds.get(name, FAR)
            boxes[name] = spaces.Box(-bound, bound, values.shape, np.float64)
        return spaces.Dict(boxes)

    def _prepare(self, scenario: Scenario) -> Scenario:
        """Returns an experiment in which the user's arm has a live hand only."""
        find_site(scenario, self._user)
        find_site(scenario, self._leads)
        spec = scenario.sites[self._user]
        hand = spec.find_live_hand(is_open=True) or LiveHand()
        if self._mode:
            hand = replace(hand, mode=self._mode)
        sites = {**scenario.sites, self._user: replace(spec, hands=(hand,))}
        # the scenario's hands of the user are gone, and with them the values that they draw
        drawn = {
            key: distribution
            for key, distribution in scenario.drawn.items()
            if f"{self._user}.hands" not in key
        }
        return replace(scenario, sites=sites, drawn=drawn)

    def _build_hand_site(self, scenario: Scenario) -> HandSite:
        """Returns the site and the settings of the user's hand."""
        hand = scenario.sites[self._user].find_live_hand()
        assert hand is not None
        return HandSite(
            scenario=scenario,
            name=self._user,
            spec=hand,
            rate_hz=self._rate_hz,
            delay_s=self._delay_s,
        )

    def _find_reach(self) -> float:
        """Returns the largest distance of the user's end effector from its base, m.

        In the mode "joint" it is the largest angle of a joint, rad.
        """
        arm = self._base.arms[self._user]
        spec = self._base.sites[self._user]
        if self._build_hand_site(self._base).spec.mode == "joint":
            return 2.0 * math.pi
        if arm.chain is None:
            return float(sum(arm.lengths_m))
        # a chain's reach is not known in closed form: a generous bound
        start_distance_m = float(np.linalg.norm(arm.end_effector(spec.q0_rad)))
        return 1.5 * start_distance_m + 1.0

    def _begin(self, scenario: Scenario) -> None:
        """Prepares the run of an episode."""
        self.scenario = scenario
        self._k = 0
        self._actions = list[Array]()
        self._player = ActedHand(self._build_hand_site(scenario), self._actions)
        self._plants = make_plant_players(scenario)
        hands = {self._user: self._player}
        self._run = FusedRun(scenario, keep=1, hands=hands, plants=self._plants)
        self._run.plan([scenario.ticks(name) for name in scenario.names])
        self._ticks = scenario.ticks(self._user)
        self._tick_rate_hz = scenario.sites[self._user].rate_hz

    def _build_scene(self) -> Scene:
        """Returns the true state of the episode at the current step."""
        names = self.scenario.names
        arms = self.scenario.arms
        q = {}
        positions_m = {}
        for name, row in zip(names, self._run.q, strict=True):
            arm = arms[name]
            angles_rad = row[: arm.counts.joints]
            q[name] = angles_rad
            positions_m[name] = np.array(arm.end_effector(angles_rad.tolist()))
        bodies = {}
        for site, plant in self._plants.items():
            poses = np.reshape(plant.state.bodies, (-1, 7))
            bodies[site] = dict(zip(self.scenario.bodies_m(site), poses, strict=True))
        user_arrays = self._run.arrays(names.index(self._user))
        return Scene(
            t_s=self._k / self._tick_rate_hz,
            q=q,
            end_effector_m=positions_m,
            view=self._player.view(self._k, user_arrays),
            bodies=bodies,
            can_reach=partial(self._can_reach, q),
            draws=MOST_DRAWS[arms[self._leads].chain is not None],
        )

    def _can_reach(self, q: Mapping[str, Array], site: str, position_m: Array) -> bool:
        """True if a site's end effector can reach a position, m, from joint angles q."""
        return can_reach(self.scenario.arms[site], q[site], position_m)

    def _format_observation(self, scene: Scene) -> Any:
        """Returns an observation in the form of the observation space."""
        parts = self._observe(scene)
        if not self._flat:
            return parts
        arrays = [np.ravel(parts[name]) for name in self._dict_space]
        return np.concatenate(arrays).astype(np.float32)

    def _observe(self, scene: Scene) -> dict[str, Array]:
        """Returns the parts of an observation by name."""
        view = scene.view
        peers = view.peers
        parts = {
            "q": view.q,
            "qd": view.qd,
            "pose": view.pose,
            "q_des": view.q_des,
            "tau_x": view.tau_x,
            "target": view.target,
            "peer_q": np.array([peer.q for peer in peers]),
            "peer_qd": np.array([peer.qd for peer in peers]),
            "peer_tau_x": np.array([peer.tau_x for peer in peers]),
            "alpha": np.array([peer.alpha for peer in peers]),
            "age_s": np.array([peer.age_s for peer in peers]),
            "grip": np.array([view.grip]),
            "goal": np.array(self.task.goal, dtype=np.float64),
        }
        if self._base.arms[self._user].shares_pose:
            # a rotation vector jumps where it passes half a turn
            parts["q_des"] = expand_poses(parts["q_des"])
            parts["peer_q"] = expand_poses(parts["peer_q"])
        return parts

    def _describe_step(self, scene: Scene, *, succeeded: bool) -> dict[str, Any]:
        """Returns the facts of a step; the first two have the names of gym-hil.

        The teacher is the other user with the largest share in the site that does the task.
        """
        leading_site = self.scenario.names.index(self._leads)
        links = np.asarray(self._run.arrays(leading_site).links)
        peers = self.scenario.peers(self._leads)
        shares = dict(zip(peers, links["alpha"].tolist(), strict=True))
        user_share = shares.get(self._user, 0.0)
        teachers = {name: share for name, share in shares.items() if name != self._user}
        teacher = max(teachers, key=lambda name: teachers[name], default=self._user)
        return {
            "is_intervention": teachers.get(teacher, 0.0) > user_share,
            "teleop_action": scene.end_effector_m[teacher],
            "dominance": shares,
            "t_s": scene.t_s,
            "success": succeeded,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode: draws the varied keys, the randomness of links and the task.

        `options` are overrides of this episode only, as in {"link.delay_ms": 200}.

        Raises:
            ScenarioError: the options or the drawn values are not valid.
            UsageError: the task has no goal within reach.
        """
        self._runs = False
        super().reset(seed=seed)
        overrides = {}
        for key, values in self._vary.items():
            overrides[key] = _draw(self.np_random, values)
        overrides["seed"] = int(self.np_random.integers(2**31))
        overrides |= options or {}
        self._begin(load_scenario(self._base, overrides))
        scene = self._build_scene()
        self.task.begin(self.np_random, scene)
        self._runs = True
        return self._format_observation(scene), self._describe_step(scene, succeeded=False)

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Applies an action and advances the episode by one step.

        Raises:
            UsageError: the action is not valid; the episode does not advance.
            EpisodeError: there is no episode, or it has ended.
        """
        checked = self._check_action(action)
        if not self._runs:
            raise EpisodeError("there is no episode, or it has ended: call reset first")
        self._actions.append(checked)
        self._k += self._ticks_per_step
        next_ns = tick_ns(self._k, self._tick_rate_hz)
        try:
            self._run.step_to(next_ns - 1)
        except ValueError as error:
            raise UsageError(f"an action: {error}") from None
        scene = self._build_scene()
        result = self.task.judge(scene)
        judgement = Judgement(*result) if isinstance(result, tuple) else Judgement(result)
        diverged = self._run.diverged_s is not None
        terminated = judgement.succeeded or judgement.failed or diverged
        has_next_step = self._k + self._ticks_per_step <= self._ticks
        truncated = not (terminated or has_next_step)
        self._runs = not (terminated or truncated)
        info = self._describe_step(scene, succeeded=judgement.succeeded)
        observation = self._format_observation(scene)
        return observation, judgement.reward, terminated, truncated, info

    def _check_action(self, action: Array) -> Array:
        """Returns an action within its bounds.

        Raises:
            UsageError: the action has another number of values, or one that is not finite.
        """
        try:
            values = np.array(action, dtype=np.float64)
        except (TypeError, ValueError):
            size = count_nouns(self._action_size, "number")
            raise UsageError(f"an action: it is {size}, not {action!r:.80}") from None
        if values.shape != (self._action_size,):
            content = f"an array of shape {values.shape}"
            if values.ndim == 1:
                content = count_nouns(values.size, "number")
            raise UsageError(f"an action: it has {content}, not {self._action_size}")
        if not np.isfinite(values).all():
            raise UsageError(f"an action: it has {values.tolist()}, which is not finite")
        return np.clip(values, -self._action_limit, self._action_limit)

    def render(self) -> Any:
        """Returns a picture of the arms and the goal, shape (height, width, 3).

        None: the environment has no render mode.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        if not (self._runs or self._actions):
            raise EpisodeError("there is no episode to be drawn: call reset first")
        # imported here, because the import of Matplotlib takes a second
        from ..reporting.episode_picture import EpisodePicture, is_position

        if self._picture is None:
            self._picture = EpisodePicture(self.scenario, self._leads)
        scene = self._build_scene()
        goal = None
        if is_position(self.task.goal, scene.end_effector_m[self._leads]):
            goal = self.task.goal
        return self._picture.draw(scene.q, scene.bodies, goal, f"t = {scene.t_s:.2f} s")

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the steps of the episode to a log and returns its path; the log verifies.

        Raises:
            UsageError: the episode has no step yet, or the file exists.
        """
        if not self._actions:
            raise UsageError("an episode has a log once it has a step")
        player = ActedHand(self._build_hand_site(self.scenario), self._actions)
        hands = {self._user: player.track}
        elapsed_s = self._k / self._tick_rate_hz
        scenario = replace(self.scenario, duration_s=elapsed_s)
        record_virtual(scenario, Path(path), force=force, hands=hands)
        return Path(path)


def _flatten_space(parts: spaces.Dict) -> spaces.Box:
    """Returns the space of all numbers of an observation in one array of float32."""
    boxes = [box for box in parts.values() if isinstance(box, spaces.Box)]
    low = np.concatenate([np.ravel(box.low) for box in boxes])
    high = np.concatenate([np.ravel(box.high) for box in boxes])
    return spaces.Box(
        low=low.astype(np.float32),
        high=high.astype(np.float32),
        dtype=np.float32,
    )


def _name_numbers(parts: spaces.Dict) -> list[str]:
    """Returns the name of each number of a flat observation, as "peer_q[1][0]"."""
    names = []
    for part, box in parts.items():
        for indices in np.ndindex(box.shape or ()):
            subscripts = [f"[{index}]" for index in indices]
            names.append(part + "".join(subscripts))
    return names


def _draw(random: np.random.Generator, values: Sequence[Any]) -> Any:
    """Returns a random element of a list, or a random number between a pair of bounds."""
    are_numbers = all(isinstance(value, int | float) for value in values)
    if isinstance(values, tuple) and len(values) == 2 and are_numbers:
        return float(random.uniform(*values))
    return values[int(random.integers(len(values)))]


make_env = TeleoperationEnv
if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point=f"{__name__}:TeleoperationEnv")
