"""Devices in a person's hand, which are read for their motion and may render a force.

Each device has a file in this folder with a class that implements `Device`. To add a device,
add its file: no list of devices needs a change.

Invariant:
    - The class of a device has the name of the file, without underscores.
    - All devices use the coordinates of the person who holds them: x to the right, y ahead, z
      up. The units are m, m/s and N.
    - Buttons are named "a", "b", "c" in their order.
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
        position_m: the position, in m, in a frame with any origin: only changes are used.
        velocity_m_s: the velocity, in m/s.
        buttons: whether each button is pressed, by name.
    """

    position_m: Vector
    velocity_m_s: Vector
    buttons: Mapping[str, bool]


class Device(Protocol):
    """A device that is read `rate_hz` times a second.

    A device is a context manager, which is entered again after each loss of the connection.

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
        """Renders a force in N to the person who holds the device."""


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
    members = vars(module).items()
    device_class = next(member for key, member in members if key.lower() == class_name)
    device: Device = device_class(address) if address else device_class()
    return device
