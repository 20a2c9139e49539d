"""Devices in somebody's hand: where they are, how they move, their buttons, and the force that
they render.

Invariant: a device is one class, found by its file in this folder, and nothing else lists them.
All speak of whoever holds them: x to the right, y ahead, z up; m, m/s, N. Their buttons are
"a", "b", "c", from the first.
"""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import ClassVar, NamedTuple, Protocol, Self

from trilat_net.errors import UsageError

Vector = tuple[float, float, float]


class DeviceState(NamedTuple):
    """What a device measures: its place, of which only changes count, its velocity, and what is
    pressed.

    >>> tn.DeviceState((0.0, -0.12, 0.15), (0.0, 0.0, 0.0), {"a": True}).buttons["a"]
    True
    """

    position_m: Vector
    velocity_m_s: Vector
    buttons: Mapping[str, bool]


class Device(Protocol):
    """A device, read `rate_hz` times a second; a context, which is entered again after each
    loss of it.

    >>> tn.session("play").lead("m1", MyDevice())  # doctest: +SKIP
    """

    rate_hz: ClassVar[int]

    def __enter__(self) -> Self:
        """Connects to it; an `OSError` says that it is not there."""

    def __exit__(self, *_: object) -> None:
        """Takes its force away, and lets it go."""

    def read(self) -> DeviceState:
        """Returns its newest state; an `OSError` says that it is silent or gone."""

    def render(self, force_n: Vector) -> None:
        """Lets whoever holds it feel a force, N."""


def open_device(text: str) -> Device:
    """Returns the device of a text such as "spacemouse" or
    "haply_inverse3=ws://127.0.0.1:10001".

    Raises:
        UsageError: there is no such device.
    """
    name, _, address = text.partition("=")
    known = sorted(found.name for found in iter_modules(__path__))
    if name not in known:
        raise UsageError(
            f"--device is one of {', '.join(known)}, with its =ADDRESS if need be, not {text!r}"
        )
    module = import_module(f"{__name__}.{name}")
    kind = next(
        one for word, one in vars(module).items() if word.lower() == name.replace("_", "")
    )
    made: Device = kind(*([address] if address else []))
    return made
