"""Stand-ins for LeRobot's robot and teleoperator interfaces, used where LeRobot is not
installed.

They reproduce the names of modules, abstract methods and events of LeRobot 0.6, and how LeRobot
registers a configuration and finds its device. Where LeRobot can be imported, the tests run
against LeRobot.
"""

import abc
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any

PLUGINS = sorted(Path(__file__).parents[3].glob("lerobot_*"))
"""Folders of the plugins."""
_BOTH = ["is_connected", "connect", "is_calibrated", "calibrate", "configure", "disconnect"]
ABSTRACT = {
    "Robot": [
        *_BOTH,
        "action_features",
        "observation_features",
        "get_observation",
        "send_action",
    ],
    "Teleoperator": [
        *_BOTH,
        "action_features",
        "feedback_features",
        "get_action",
        "send_feedback",
    ],
}


class TeleopEvents(Enum):
    SUCCESS = "success"
    FAILURE = "failure"
    RERECORD_EPISODE = "rerecord_episode"
    IS_INTERVENTION = "is_intervention"
    TERMINATE_EPISODE = "terminate_episode"


def _config() -> type:
    @dataclass(kw_only=True)
    class Config:
        id: str | None = None
        calibration_dir: Path | None = None

        known = {}  # noqa: RUF012

        @classmethod
        def register_subclass(cls, name: str) -> Any:
            return lambda kind: cls.known.setdefault(name, kind)

        @property
        def type(self) -> str:
            return next(name for name, kind in self.known.items() if kind is self.__class__)

    return Config


def _device(name: str) -> type:
    def begin(self: Any, config: Any) -> None:
        self.id = config.id

    methods = {method: abc.abstractmethod(lambda *_, **__: None) for method in ABSTRACT[name]}
    return abc.ABCMeta(name, (), {"__init__": begin, **methods})


def _modules() -> dict[str, ModuleType]:
    modules = {
        name: ModuleType(name) for name in ("lerobot", "lerobot.utils", "lerobot.utils.errors")
    }
    for room, name in (("robots", "Robot"), ("teleoperators", "Teleoperator")):
        modules[f"lerobot.{room}"] = ModuleType(f"lerobot.{room}")
        modules[f"lerobot.{room}"].__dict__.update(
            {name: _device(name), f"{name}Config": _config()}
        )
    modules["lerobot.teleoperators.utils"] = ModuleType("lerobot.teleoperators.utils")
    modules["lerobot.teleoperators.utils"].__dict__["TeleopEvents"] = TeleopEvents
    for error in ("DeviceNotConnectedError", "DeviceAlreadyConnectedError"):
        modules["lerobot.utils.errors"].__dict__[error] = type(error, (ConnectionError,), {})
    return modules


@contextmanager
def plugins() -> Iterator[dict[str, ModuleType]]:
    """Imports all plugins by the names of their folders, with LeRobot or with the stand-ins."""
    before = dict(sys.modules)
    try:
        importlib.import_module("lerobot")
    except ImportError:
        sys.modules.update(_modules())
    names = [path.name for path in PLUGINS]
    sys.path[:0] = map(str, PLUGINS)
    try:
        yield {name: importlib.import_module(name) for name in names}
    finally:
        del sys.path[: len(names)]
        for name in [
            module
            for module in sys.modules
            if module not in before and module.startswith("lerobot")
        ]:
            del sys.modules[name]


def make_device(config: Any) -> Any:
    """Makes a device as LeRobot does: from the module of its configuration, by the name without
    `Config`.
    """
    kind = type(config)
    return getattr(
        importlib.import_module(kind.__module__), kind.__name__.removesuffix("Config")
    )(config)
