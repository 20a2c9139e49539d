"""Devices in a person's hand: their position, velocity and buttons, and their force.

Invariant:
    - A device is one class, which is found by its file in this folder; nothing else lists the
      devices.
    - All devices use the coordinates of the person who holds them: x to the right, y ahead, z
      up; units m, m/s, N.
    - Buttons are named "a", "b", "c" from the first on.
"""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import ClassVar, NamedTuple, Protocol, Self

from trilat_net.errors import UsageError

Vector = tuple[float, float, float]


class DeviceState(NamedTuple):
    """The measured state of a device.

    >>> tn.DeviceState((0.0, -0.12, 0.15), (0.0, 0.0, 0.0), {"a": True}).buttons["a"]
    True

    Attributes:
        position_m: its position, m, in a frame with any origin: only changes are used.
        velocity_m_s: its velocity, m/s.
        buttons: whether each button is pressed, by its name.
    """

    position_m: Vector
    velocity_m_s: Vector
    buttons: Mapping[str, bool]


class Device(Protocol):
    """A device that is read `rate_hz` times a second.

    It is a context manager that is entered again after each loss of the connection.

    >>> tn.session("play").lead("m1", MyDevice())  # doctest: +SKIP
    """

    rate_hz: ClassVar[int]

    def __enter__(self) -> Self:
        """Connects to the device; raises OSError if the device is not present."""

    def __exit__(self, *_: object) -> None:
        """Ends the device's force, and closes the connection."""

    def read(self) -> DeviceState:
        """Returns the newest state; raises OSError if the device is silent or gone."""

    def render(self, force_n: Vector) -> None:
        """Renders a force to the person who holds the device, N."""


def open_device(text: str) -> Device:
    """Returns the device that a text such as "spacemouse" names.

    Args:
        text: the name of the device and, after "=", its address, as in
            "haply_inverse3=ws://127.0.0.1:10001".

    Raises:
        UsageError: there is no such device.
    """
    name, _, address = text.partition("=")
    known = sorted(module_info.name for module_info in iter_modules(__path__))
    if name not in known:
        raise UsageError(
            f"--device is one of {', '.join(known)}, with its =ADDRESS if need be, not {text!r}"
        )
    module = import_module(f"{__name__}.{name}")
    class_name = name.replace("_", "")
    device_class = next(
        member for word, member in vars(module).items() if word.lower() == class_name
    )
    device: Device = device_class(address) if address else device_class()
    return device
