"""A Gymnasium environment: one user of an experiment acts, by what that user knows over the
network.

Invariant:
- An episode is a run in virtual time and a function of the scenario, the seed and the actions;
  saved as a log it verifies.
- A step is a fixed number of ticks. A refused action makes no step and changes nothing.
- Steps follow a reset and end with the episode.
- What is observed, and when an action acts, is as of a hand of one's own (`OwnHand`), so that
  what is trained here can hold an arm live, unchanged. Only orientations are observed as six
  numbers, which never jump (`expand_poses`).
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
"""Bound of what is observed where nothing tighter is known: rad, rad/s, m, N m, s."""
MOST_DRAWS = {False: 1000, True: 100}
"""Places that a task draws at most until one is within reach; of chains fewer, whose poses are
searched.
"""


class EpisodeError(UsageError, gymnasium.error.ResetNeeded):
    """There is no episode: none has begun, or it has ended."""


class Scene(NamedTuple):
    """What is true of an episode at a step, and the user need not know.

    Attributes:
        t_s: time since the epoch, s.
        q: joint angles by site, rad, shape (n,).
        end_effector_m: place of the end effector by site, m.
        view: what the user sees.
        bodies: the poses of the bodies of plants, by site and then name, as a record has them,
            shape (7,).
        can_reach: says of a site and a place, m, whether its end effector can be brought there.
        draws: places that a task may draw at most until one is within reach.
    """

    t_s: float
    q: dict[str, Array]
    end_effector_m: dict[str, Array]
    view: HandView
    bodies: dict[str, dict[str, Array]]
    can_reach: Callable[[str, Array], bool] = lambda _site, _place: True
    draws: int = MOST_DRAWS[False]


class Judgement(NamedTuple):
    """What a task says of a step."""

    reward: float
    succeeded: bool = False
    failed: bool = False


class EpisodeTask(Protocol):
    """What is to be done in an episode."""

    goal: Array
    """What of it the user sees; its shape and its bounds, `bound`, never change."""
    bound: float

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws the task of an episode."""

    def judge(self, scene: Scene) -> float | tuple[Any, ...]:
        """Returns the reward of a step; or with it whether the task is done, as a `Judgement`
        or a tuple.
        """


class ReachTask:
    """The slave's end effector is brought to a place that is drawn within its reach, and stays
    there.

    The reward of a step is minus the distance, m, times the step, s; and 1 once it was there
    for `stay_s`.

    Args:
        site: whose end effector.
        radius_m: how far from its start the places lie, at most.
        within_m: how near it has to come.
        stay_s: for how long.
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
        self._since_s = self._last_s = 0.0

    def begin(self, random: np.random.Generator, scene: Scene) -> None:
        """Draws a place around the start, evenly over the part of the area that the end
        effector can reach.

        Raises:
            UsageError: none of the places that were drawn is within reach.
        """
        start = scene.end_effector_m[self._site]
        for _ in range(scene.draws):
            way = random.normal(size=len(start))
            share = random.uniform() ** (1.0 / len(start))
            place = start + self._radius_m * share * way / np.linalg.norm(way)
            if scene.can_reach(self._site, place):
                break
        else:
            around = f"{self._radius_m:g} m around the start of {self._site}"
            raise UsageError(
                "the task has no goal: the end effector can reach none of "
                f"{count_nouns(scene.draws, 'place')} "
                f"within {around}; start from another pose (sites.NAME.q0_rad), or give a task of your own"
            )
        self.goal = place
        self._since_s = self._last_s = scene.t_s

    def judge(self, scene: Scene) -> Judgement:
        """Returns the reward."""
        apart_m = float(np.linalg.norm(scene.end_effector_m[self._site] - self.goal))
        step_s = scene.t_s - self._last_s
        self._last_s = scene.t_s
        if apart_m > self._within_m:
            self._since_s = scene.t_s
        done = scene.t_s - self._since_s >= self._stay_s
        return Judgement(-apart_m * step_s + float(done), succeeded=done)


class ActedHand(HandPlayer):
    """The user's hand: at each step it does what it was told."""

    def __init__(self, at: HandSite, actions: list[Array]) -> None:
        super().__init__(at, None)
        self._actions = actions

    def request_action(self, k: int, arrays: SiteArrays) -> None:  # noqa: ARG002 - whoever acts has seen it
        """Decides by the action of the step."""
        self.hand.accept_decision(k, self._actions[k // self.hand.period_ticks].tolist())


class TeleoperationEnv(gymnasium.Env[dict[str, Array], Array]):
    """An experiment in which one user is trained, in steps, see docs/policies.md; also called
    `tn.make_env`.

    >>> bent = {f"sites.{name}.q0_rad": [0.4, 1.0] for name in ("m", "s")}
    >>> env = tn.make_env("two_sites", bent, user="m", duration_s=1)
    >>> observation, info = env.reset(seed=1)
    >>> observation["peer_q"].shape
    (1, 2)

    Args:
        scenario: the name of a shipped scenario, a path, a TOML text, its tables, or a
            scenario.
        set: overrides, as in `{"link.delay_ms": 100}`.
        user: the site whose arm is acted on.
        mode: "tip", "joint" or "force", as of a live hand; by default the scenario's.
        rate_hz: steps a second.
        delay_ms: from what is seen to what is done, ms.
        duration_s: of an episode, s; by default the scenario's.
        task: what is to be done; by default `leads` brings its end effector to a place.
        vary: what each episode draws, by key a list, or a pair of numbers.
        leads: the site that works.
        render_mode: "rgb_array": `render` returns a picture of the arms and the goal; None:
            nothing.
        flat: whether an observation is one array of float32 in place of a dictionary, and an
            action float32.

    Attributes:
        observation_names: with `flat` what each number of an observation is, as in
            "peer_q[1][0]".

    Raises:
        ScenarioError: the scenario or an override is not valid.
        UsageError: the site or the rate is none, or Gymnasium is not installed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        scenario: Any = "paper",
        set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - as in all of the interface
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
        if self._base.sites[user].rate_hz % rate_hz:
            raise UsageError(
                f"rate_hz must divide the tick rate of {user}, {self._base.sites[user].rate_hz}"
            )
        self._every = self._base.sites[user].rate_hz // rate_hz
        far = self._place(self._base).describe()
        self._most = far.limit if far.mode == "force" else self._find_reach()
        self._size = far.size
        kind = np.float32 if flat else np.float64
        self.action_space: Any = spaces.Box(-self._most, self._most, (far.size,), kind)
        self._begin(self._base)
        self.task.begin(np.random.default_rng(0), self._look())
        bounds = {"alpha": 1.0, "grip": 1.0, "goal": self.task.bound}
        boxes: dict[str, Any] = {}
        for name, one in self._observe(self._look()).items():
            most = bounds.get(name, FAR)
            boxes[name] = spaces.Box(-most, most, one.shape, np.float64)
        self._of_parts = spaces.Dict(boxes)
        self.observation_space: Any = _flatten_space(self._of_parts) if flat else self._of_parts
        self.observation_names = _name_numbers(self._of_parts) if flat else []
        self._flat = flat

    def _prepare(self, scenario: Scenario) -> Scenario:
        """Returns an experiment in which the user has a live hand and no other operator holds
        that arm.
        """
        find_site(scenario, self._user)
        find_site(scenario, self._leads)
        spec = scenario.sites[self._user]
        hand = spec.find_live_hand(is_open=True) or LiveHand()
        if self._mode:
            hand = replace(hand, mode=self._mode)
        sites = {**scenario.sites, self._user: replace(spec, hands=(hand,))}
        drawn = {
            key: one for key, one in scenario.drawn.items() if f"{self._user}.hands" not in key
        }
        return replace(scenario, sites=sites, drawn=drawn)

    def _place(self, scenario: Scenario) -> HandSite:
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
        """Returns how far from its base the user's end effector gets, m; or how far joints
        turn, rad.
        """
        arm = self._base.arms[self._user]
        spec = self._base.sites[self._user]
        if self._place(self._base).spec.mode == "joint":
            return 2.0 * math.pi
        if arm.chain is None:
            return float(sum(arm.lengths_m))
        return 1.5 * float(np.linalg.norm(arm.end_effector(spec.q0_rad))) + 1.0

    def _begin(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._k = 0
        self._actions = list[Array]()
        self._player = ActedHand(self._place(scenario), self._actions)
        self._plants = make_plant_players(scenario)
        self._run = FusedRun(
            scenario, keep=1, hands={self._user: self._player}, plants=self._plants
        )
        self._run.plan([scenario.ticks(name) for name in scenario.names])
        self._ticks = scenario.ticks(self._user)
        self._tick_rate_hz = scenario.sites[self._user].rate_hz

    def _look(self) -> Scene:
        names = self.scenario.names
        arms = self.scenario.arms
        run = self._run
        q = {
            name: row[: arms[name].counts.joints]
            for name, row in zip(names, run.q, strict=True)
        }
        places = {
            name: np.array(arms[name].end_effector(row.tolist())) for name, row in q.items()
        }
        view = self._player.view(self._k, run.arrays(names.index(self._user)))
        poses = {
            site: np.reshape(plant.state.bodies, (-1, 7))
            for site, plant in self._plants.items()
        }
        bodies = {
            site: dict(zip(self.scenario.bodies_m(site), at, strict=True))
            for site, at in poses.items()
        }
        reach = partial(self._can_reach, q)
        draws = MOST_DRAWS[arms[self._leads].chain is not None]
        return Scene(
            t_s=self._k / self._tick_rate_hz,
            q=q,
            end_effector_m=places,
            view=view,
            bodies=bodies,
            can_reach=reach,
            draws=draws,
        )

    def _can_reach(self, q: Mapping[str, Array], site: str, place_m: Array) -> bool:
        return can_reach(self.scenario.arms[site], q[site], place_m)

    def _return(self, scene: Scene) -> Any:
        """Returns an observation in the form of the observation space."""
        parts = self._observe(scene)
        if not self._flat:
            return parts
        return np.concatenate([np.ravel(parts[name]) for name in self._of_parts]).astype(
            np.float32
        )

    def _observe(self, scene: Scene) -> dict[str, Array]:
        view = scene.view
        own = {
            name: getattr(view, name)
            for name in ("q", "qd", "pose", "q_des", "tau_x", "target")
        }
        peers = {
            f"peer_{x}": np.array([getattr(one, x) for one in view.peers])
            for x in ("q", "qd", "tau_x")
        }
        if self._base.arms[
            self._user
        ].shares_pose:  # a rotation vector jumps where it passes half a turn
            own["q_des"], peers["peer_q"] = map(expand_poses, (own["q_des"], peers["peer_q"]))
        alpha, age_s = zip(*((one.alpha, one.age_s) for one in view.peers), strict=True)
        more = {
            "alpha": np.array(alpha),
            "age_s": np.array(age_s),
            "grip": np.array([view.grip]),
        }
        return {**own, **peers, **more, "goal": np.array(self.task.goal, dtype=np.float64)}

    def _inform(self, scene: Scene, *, succeeded: bool) -> dict[str, Any]:
        """Returns facts of a step; the first two by the names of gym-hil."""
        links = np.asarray(self._run.arrays(self.scenario.names.index(self._leads)).links)
        shares = dict(
            zip(self.scenario.peers(self._leads), links["alpha"].tolist(), strict=True)
        )
        others = {name: share for name, share in shares.items() if name != self._user}
        first = max(others, key=lambda name: others[name], default=self._user)
        return {
            "is_intervention": others.get(first, 0.0) > shares.get(self._user, 0.0),
            "teleop_action": scene.end_effector_m[first],
            "dominance": shares,
            "t_s": scene.t_s,
            "success": succeeded,
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode: draws what varies, its links' randomness and its task.

        `options` are overrides of this episode alone, as in {"link.delay_ms": 200}.

        Raises:
            ScenarioError: the options or what was drawn are not valid.
            UsageError: the task has no goal within reach.
        """
        self._runs = False
        super().reset(seed=seed)
        drawn = {key: _draw(self.np_random, of) for key, of in self._vary.items()}
        drawn |= {"seed": int(self.np_random.integers(2**31)), **(options or {})}
        self._begin(load_scenario(self._base, drawn))
        scene = self._look()
        self.task.begin(self.np_random, scene)
        self._runs = True
        return self._return(scene), self._inform(scene, succeeded=False)

    def step(self, action: Array) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Acts, and moves on by a step.

        Raises:
            UsageError: the action is not valid; the episode stays where it was.
            EpisodeError: there is no episode, or it has ended.
        """
        checked = self._check_action(action)
        if not self._runs:
            raise EpisodeError("there is no episode, or it has ended: call reset first")
        self._actions.append(checked)
        self._k += self._every
        try:
            self._run.step_to(tick_ns(self._k, self._tick_rate_hz) - 1)
        except ValueError as error:
            raise UsageError(f"an action: {error}") from None
        scene = self._look()
        diverged = self._run.diverged_s is not None
        said = self.task.judge(scene)
        said = Judgement(*said) if isinstance(said, tuple) else Judgement(said)
        ended = said.succeeded or said.failed or diverged
        truncated = self._k + self._every > self._ticks and not ended
        self._runs = not (ended or truncated)
        info = self._inform(scene, succeeded=said.succeeded)
        return self._return(scene), said.reward, ended, truncated, info

    def _check_action(self, action: Array) -> Array:
        """Returns an action within its bounds.

        Raises:
            UsageError: the action has another number of values, or one that is not finite.
        """
        try:
            values = np.array(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise UsageError(
                f"an action: it is {count_nouns(self._size, 'number')}, not {action!r:.80}"
            ) from None
        if values.shape != (self._size,):
            found = (
                f"{count_nouns(values.size, 'number')}"
                if values.ndim == 1
                else f"an array of shape {values.shape}"
            )
            raise UsageError(f"an action: it acts with {found}, not {self._size}")
        if not np.isfinite(values).all():
            raise UsageError(f"an action: it acts with {values.tolist()}, which is not finite")
        return np.clip(values, -self._most, self._most)

    def render(self) -> Any:
        """Returns a picture of the arms and of the goal, shape (height, width, 3); None without
        a mode.

        Raises:
            EpisodeError: no episode has begun.
        """
        if self.render_mode is None:
            return None
        if not (self._runs or self._actions):
            raise EpisodeError("there is no episode to be drawn: call reset first")
        # Matplotlib takes a second
        from ..reporting.episode_picture import (
            EpisodePicture,
            is_place,
        )

        if self._picture is None:
            self._picture = EpisodePicture(self.scenario, self._leads)
        scene = self._look()
        goal = (
            self.task.goal
            if is_place(self.task.goal, scene.end_effector_m[self._leads])
            else None
        )
        return self._picture.draw(scene.q, scene.bodies, goal, f"t = {scene.t_s:.2f} s")

    def save(self, path: str | Path, *, force: bool = False) -> Path:
        """Writes the episode so far as a log, which verifies.

        Raises:
            UsageError: there is no step yet, or the file exists.
        """
        if not self._actions:
            raise UsageError("an episode has a log once it has a step")
        player = ActedHand(self._place(self.scenario), self._actions)
        lasted = replace(self.scenario, duration_s=self._k / self._tick_rate_hz)
        record_virtual(lasted, Path(path), force=force, hands={self._user: player.track})
        return Path(path)


def _flatten_space(parts: spaces.Dict) -> spaces.Box:
    """Returns the space of all numbers of observations, one after the other, as float32."""
    low, high = (
        np.concatenate([np.ravel(getattr(box, end)) for box in parts.values()]).astype(
            np.float32
        )
        for end in ("low", "high")
    )
    return spaces.Box(low, high, dtype=np.float32)


def _name_numbers(parts: spaces.Dict) -> list[str]:
    """Returns what each number of a flat observation is."""
    return [
        name + "".join(f"[{index}]" for index in place)
        for name, box in parts.items()
        for place in np.ndindex(box.shape or ())
    ]


def _draw(random: np.random.Generator, of: Sequence[Any]) -> Any:
    """Returns one of a list, or of a pair of numbers one between them."""
    numbers = len(of) == 2 and all(isinstance(one, int | float) for one in of)
    if isinstance(of, tuple) and numbers:
        return float(random.uniform(*of))
    return of[int(random.integers(len(of)))]


make_env = TeleoperationEnv
if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point=f"{__name__}:TeleoperationEnv")
