"""Names of `trilat_studies.gym_environment`, which files of users import from here."""

from trilat_studies.gym_environment import (
    ENV_ID,
    EpisodeError,
    EpisodeTask,
    Judgement,
    ReachTask,
    Scene,
    TeleoperationEnv,
    make_env,
)

__all__ = [
    "ENV_ID",
    "EpisodeError",
    "EpisodeTask",
    "Judgement",
    "ReachTask",
    "Scene",
    "TeleoperationEnv",
    "make_env",
]
