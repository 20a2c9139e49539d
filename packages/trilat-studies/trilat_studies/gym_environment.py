"""Makes Gymnasium environments, in which a policy is trained to operate an arm.

Gymnasium is a common interface of reinforcement learning. `make_env` returns one environment,
or with `num_envs` several that are simulated together, which is faster.
"""

from collections.abc import Mapping, Sequence
from typing import Any, overload

from .teleoperation_environment import (
    ENV_ID,
    EpisodeError,
    EpisodeTask,
    Judgement,
    ReachTask,
    Scene,
    TeleoperationEnv,
)
from .vector_environment import TeleoperationVectorEnv

__all__ = [
    "ENV_ID",
    "EpisodeError",
    "EpisodeTask",
    "Judgement",
    "ReachTask",
    "Scene",
    "TeleoperationEnv",
    "TeleoperationVectorEnv",
    "make_env",
]


@overload
def make_env(
    scenario: Any = "paper",
    set: Mapping[str, Any] | Sequence[str] = (),
    *,
    num_envs: None = None,
    **settings: Any,
) -> TeleoperationEnv: ...
@overload
def make_env(
    scenario: Any = "paper",
    set: Mapping[str, Any] | Sequence[str] = (),
    *,
    num_envs: int,
    autoreset_mode: str = "NextStep",
    **settings: Any,
) -> TeleoperationVectorEnv: ...
def make_env(
    scenario: Any = "paper",
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the same name in all functions
    *,
    num_envs: int | None = None,
    autoreset_mode: str = "NextStep",
    **settings: Any,
) -> TeleoperationEnv | TeleoperationVectorEnv:
    """Makes an environment in which a policy operates one arm, or several environments.

    See docs/studies/train-policies.md.

    >>> bent = {f"sites.{name}.q0_rad": [0.4, 1.0] for name in ("m", "s")}
    >>> env = tn.make_env("two_sites", bent, user="m", duration_s=1)
    >>> observation, info = env.reset(seed=1)
    >>> observation["peer_q"].shape
    (1, 2)

    Several environments advance side by side on one core. Each gives the same bits as if it
    were alone:

    >>> envs = tn.make_env("two_sites", bent, user="m", duration_s=1, num_envs=8)
    >>> observations, infos = envs.reset(seed=1)  # the seeds 1 to 8
    >>> observations["peer_q"].shape
    (8, 1, 2)

    Args:
        scenario: Name of a shipped scenario, a path, a TOML text, its tables, or a scenario.
        set: Overrides, as in `{"link.delay_ms": 100}`.
        num_envs: Number of environments that advance together, as one environment of the class
            `gymnasium.vector.VectorEnv`. If `None`, a single environment is returned. If the
            environments cannot be computed side by side, they are stepped one by one, and the
            attribute `obstacle` states the reason. Each environment has a copy of the task.
        autoreset_mode: When the next episode of an environment begins: "NextStep" after an
            episode has ended, "SameStep" at its end, or "Disabled".
        **settings: The arguments that follow, by their names.
        user: Site whose arm the actions move.
        mode: Meaning of an action, "tip", "joint" or "force", as for a live operator. If empty,
            the mode of the scenario is kept.
        rate_hz: Number of steps per second.
        delay_ms: Time from an observation until its action takes effect, in ms.
        duration_s: Duration of an episode, in s. If `None`, the duration of the scenario is
            kept.
        task: Task of the episodes. By default, the site `leads` must bring its end effector to
            a random position.
        vary: Keys of the scenario that each episode draws at random. A tuple of two numbers is
            a pair of bounds, `(0, 300)`; a list has the possible values, `[0, 300]`.
        leads: Site that does the task.
        render_mode: With "rgb_array", `render` returns a picture of the arms and the goal. With
            `None`, `render` returns `None`.
        flat: True if observations are one array of float32 instead of a dictionary, and actions
            are float32.
        normalize: True if actions and observations are numbers in [-1, 1]. An action of 1 is
            then the largest target or force. Observations are divided by
            `observation_scales`, and numbers beyond these scales are clipped.

    Raises:
        ScenarioError: The scenario or an override is not valid.
        UsageError: There is no such site, the rate is not valid, or Gymnasium is missing. The
            same error is raised if another argument has an invalid value, which the message
            names.
    """
    env = TeleoperationEnv(scenario, set, **settings)
    if num_envs is None:
        return env
    return TeleoperationVectorEnv(env, num_envs, autoreset_mode)
