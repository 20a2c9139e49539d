"""Defines the interface of input devices, with which a person moves an arm and feels its force.

Each device is a class in a file of its own in this folder. `open_device` finds the class by the
name of the file, so that a further device needs no entry in any list.

Invariant:
    - All devices use the coordinates of the person who holds them: x to the right, y ahead and
      z up. The units are m, m/s and N.
    - The buttons are named "a", "b", "c" in their order.
"""

from collections.abc import Mapping
from importlib import import_module
from pkgutil import iter_modules
from typing import ClassVar, NamedTuple, Protocol, Self

from trilat_net.errors import UsageError

Vector = tuple[float, float, float]
"""Three coordinates: x to the right, y ahead, z up."""


class DeviceState(NamedTuple):
    """Measured state of an input device: the motion of its handle, and its buttons.

    >>> tn.DeviceState((0.0, -0.12, 0.15), (0.0, 0.0, 0.0), {"a": True}).buttons["a"]
    True

    Attributes:
        position_m: Position in m. The origin is arbitrary, because only changes are used.
        velocity_m_s: Velocity in m/s.
        buttons: For each button by its name, True if it is pressed.
    """

    position_m: Vector
    velocity_m_s: Vector
    buttons: Mapping[str, bool]


class Device(Protocol):
    """Interface of an input device with which a person moves a robot arm.

    An example is a haptic device. Its motion moves the target that the arm follows. The device
    is read `rate_hz` times a second. To support another device, a user writes a class with
    these methods.

    A device is a context manager. If the connection to the device is lost, the `with` block is
    left and entered again.

    >>> tn.session("play").lead("m1", MyDevice())  # doctest: +SKIP
    """

    rate_hz: ClassVar[int]

    def __enter__(self) -> Self:
        """Connects to the device. Raises OSError if the device is not present."""

    def __exit__(self, *_: object) -> None:
        """Ends the force of the device, and closes the connection."""

    def read(self) -> DeviceState:
        """Returns the newest state of the device.

        Raises:
            OSError: The device is silent or gone.
        """

    def render(self, force_n: Vector) -> None:
        """Applies a force to the person who holds the device.

        A device without motors does nothing.

        Args:
            force_n: Coordinates x, y and z of the force, in N.
        """


def open_device(text: str) -> Device:
    """Creates the object for the input device that the option --device names.

    Args:
        text: Value of the option: the name of the device, optionally followed by "=" and its
            address, as in "spacemouse" or "haply_inverse3=ws://127.0.0.1:10001".

    Raises:
        UsageError: There is no such device.
    """
    name, _, address = text.partition("=")
    known = sorted(module_info.name for module_info in iter_modules(__path__))
    if name not in known:
        raise UsageError(
            f"--device must be one of {', '.join(known)}, "
            f"optionally followed by =ADDRESS, not {text!r}"
        )
    module = import_module(f"{__name__}.{name}")
    class_name = name.replace("_", "")
    members = vars(module).items()
    device_class = next(member for key, member in members if key.lower() == class_name)
    device: Device = device_class(address) if address else device_class()
    return device
