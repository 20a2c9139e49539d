"""Creates Gymnasium environments for training a policy to operate an arm.

Gymnasium is a standard interface for reinforcement learning. `make_env` returns a single
environment or, with `num_envs`, several environments that are simulated together, which is
faster.
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
    """Creates an environment in which a policy operates one arm, or several such environments.

    See docs/studies/train-policies.md.

    >>> bent = {f"sites.{name}.q0_rad": [0.4, 1.0] for name in ("m", "s")}
    >>> env = tn.make_env("two_sites", bent, user="m", duration_s=1)
    >>> observation, info = env.reset(seed=1)
    >>> observation["peer_q"].shape
    (1, 2)

    Several environments are stepped side by side on one core. The results of each are identical
    to the last bit to those of a single environment:

    >>> envs = tn.make_env("two_sites", bent, user="m", duration_s=1, num_envs=8)
    >>> observations, infos = envs.reset(seed=1)  # the seeds 1 to 8
    >>> observations["peer_q"].shape
    (8, 1, 2)

    Args:
        scenario: Name of a shipped scenario, a path, a TOML string, its tables, or a
            `Scenario`.
        set: Overrides, such as `{"link.delay_ms": 100}`.
        num_envs: Number of environments that are stepped together, as one
            `gymnasium.vector.VectorEnv`. If `None`, a single environment is returned.
            Environments that cannot be computed side by side are stepped one by one, and the
            attribute `obstacle` states the reason. Each environment has its own copy of the
            task.
        autoreset_mode: When the next episode of an environment begins: "NextStep" (in the step
            after an episode ends), "SameStep" (in the step that ends it), or "Disabled".
        **settings: The following arguments, as keyword arguments.
        user: Site whose arm is moved by the actions.
        mode: Meaning of an action, "tip", "joint" or "force", as for a live operator. If empty,
            the mode of the scenario is kept.
        rate_hz: Number of steps per second.
        delay_ms: Time from an observation until its action takes effect, in ms.
        duration_s: Duration of an episode, in s. If `None`, the duration of the scenario is
            kept.
        task: Task of the episodes. By default, the site `leads` must bring its end effector to
            a random position.
        vary: Scenario keys that are drawn at random for each episode. A tuple of two numbers is
            a pair of bounds, such as `(0, 300)`; a list contains the possible values, such as
            `[0, 300]`.
        leads: Site that performs the task.
        render_mode: With "rgb_array", `render` returns an image of the arms and the goal. With
            `None`, `render` returns `None`.
        flat: True if observations are a single float32 array instead of a dictionary, and
            actions are float32.
        normalize: True if actions and observations are scaled to [-1, 1]. An action of 1 is
            then the largest target or force. Observations are divided by `observation_scales`
            and clipped.

    Raises:
        ScenarioError: The scenario or an override is not valid, or the scenario lacks the site.
        UsageError: The rate is not valid, Gymnasium is missing, or another argument has an
            invalid value, which the message names.
    """
    env = TeleoperationEnv(scenario, set, **settings)
    if num_envs is None:
        return env
    return TeleoperationVectorEnv(env, num_envs, autoreset_mode)
