"""Interface for input devices that move an arm and let a person feel the arm's force.

To support another device, write a class with the methods of `Device`, and pass an instance to
`RunningSession.lead`.

Invariant:
    - All devices use the coordinates of the person who holds them: x to the right, y ahead and
      z up. The units are m, m/s and N.
    - The buttons are named "a", "b", "c", in the device's own order.
"""

from collections.abc import Mapping
from typing import ClassVar, NamedTuple, Protocol, Self

Vector = tuple[float, float, float]
"""Three coordinates: x to the right, y ahead, z up."""


class DeviceState(NamedTuple):
    """Measured state of an input device: the motion of its handle, and its buttons.

    >>> tn.DeviceState((0.0, -0.12, 0.15), (0.0, 0.0, 0.0), {"a": True}).buttons["a"]
    True

    Attributes:
        position_m: Position in m. The origin is arbitrary, because only changes matter.
        velocity_m_s: Velocity in m/s.
        buttons: For each button, keyed by its name, True if it is pressed.
    """

    position_m: Vector
    velocity_m_s: Vector
    buttons: Mapping[str, bool]


class Device(Protocol):
    """Interface of an input device with which a person moves a robot arm.

    An example is a haptic device, whose motion moves the target that the arm follows. The
    device is read `rate_hz` times a second. To support another device, write a class with the
    methods of this class.

    A device is a context manager. If the connection to the device is lost, the `with` block is
    left and entered again.

    >>> tn.session("play").lead("m1", MyDevice())  # doctest: +SKIP
    """

    rate_hz: ClassVar[int]

    def __enter__(self) -> Self:
        """Connects to the input device, such as a haptic handle.

        Raises:
            OSError: The device is not present.
        """

    def __exit__(self, *_: object) -> None:
        """Sets the device's force to zero, and closes the connection to the device."""

    def read(self) -> DeviceState:
        """Returns the latest motion of the device's handle and the state of its buttons.

        Called `rate_hz` times a second.

        Raises:
            OSError: The device does not respond or has been disconnected. The caller then
                leaves the device's `with` block and reconnects.
        """

    def render(self, force_n: Vector) -> None:
        """Exerts a force, in N, on the hand that holds the handle, using the device's motors.

        For a device without motors, this method does nothing.

        Args:
            force_n: Force vector (x, y, z), in N.
        """
