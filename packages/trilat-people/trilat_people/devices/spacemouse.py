"""Driver for 3Dconnexion SpaceMouse devices on Linux, which reads their hidraw file.

A SpaceMouse has a cap that is pushed and turned by hand, away from its rest position. The
deflection is interpreted as a velocity and integrated to obtain a position. A deflected cap
reports continuously, so the cap is at rest if no report has arrived for `STILL_NS`.
"""

import os
import struct
from pathlib import Path
from typing import ClassVar, Self

from trilat_net.app import DeviceState, Vector
from trilat_net.net import Clock, SystemClock

STILL_NS = 100_000_000
"""Time with no report after which the cap counts as not deflected, in ns."""
SPEED_M_S = 0.2 / 350.0
"""Velocity per count of an axis, in m/s. A fully deflected cap reports 350 counts."""
_MAKER_IDS = (":0000256F:", ":0000046D:0000C62")
"""USB vendor identifiers of a SpaceMouse in a uevent file: 3Dconnexion, formerly Logitech."""
_MOTION_REPORT = 1
"""Identifier of reports that contain the deflection of the cap."""
_BUTTON_REPORT = 3
"""Identifier of reports that contain the buttons."""


class SpaceMouse:
    """3Dconnexion SpaceMouse: an input device with no force feedback.

    The deflection of the cap is integrated to obtain a position. The first two buttons are "a"
    and "b".

    >>> tn.session("play").lead("m1", tn.SpaceMouse("/dev/hidraw3"))  # doctest: +SKIP

    Args:
        address: Path of the hidraw file. If empty, the first SpaceMouse found is used.
        clock: Clock of this machine. If `None`, a new clock is created.
    """

    rate_hz: ClassVar[int] = 125

    def __init__(self, address: str = "", clock: Clock | None = None) -> None:
        self._address = address
        self._clock = clock or SystemClock()
        self._file = -1

    def __enter__(self) -> Self:
        self._file = os.open(self._address or self.find(), os.O_RDONLY | os.O_NONBLOCK)
        self._position_m: Vector = (0.0, 0.0, 0.0)
        self._velocity_m_s = self._position_m
        self._button_bits = 0
        now_ns = self._clock.monotonic_ns()
        # Time of the last report, and time until which the velocity is integrated.
        self._reported_ns = now_ns
        self._read_ns = now_ns
        return self

    @staticmethod
    def find(devices: Path = Path("/sys/class/hidraw")) -> str:
        """Returns the path of the first connected SpaceMouse, such as "/dev/hidraw3".

        Args:
            devices: Folder in which Linux lists the hidraw devices.

        Raises:
            FileNotFoundError: No SpaceMouse is connected.
        """
        for uevent in sorted(devices.glob("*/device/uevent")):
            identity = uevent.read_text(encoding="utf-8")
            if any(maker in identity for maker in _MAKER_IDS):
                return f"/dev/{uevent.parts[-3]}"
        raise FileNotFoundError("no SpaceMouse is connected")

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self) -> DeviceState:
        """Returns the current state of the device.

        The deflection of the cap is interpreted as a velocity and integrated to obtain a
        position.

        Returns:
            The position relative to that at the time of connection, the velocity, and the
            buttons.
        """
        now_ns = self._clock.monotonic_ns()
        while self._read_report(now_ns):
            pass

        if now_ns - self._reported_ns > STILL_NS:
            self._velocity_m_s = (0.0, 0.0, 0.0)

        elapsed_s = (now_ns - self._read_ns) * 1e-9
        self._read_ns = now_ns
        x, y, z = self._position_m
        x_velocity, y_velocity, z_velocity = self._velocity_m_s
        self._position_m = (
            x + elapsed_s * x_velocity,
            y + elapsed_s * y_velocity,
            z + elapsed_s * z_velocity,
        )

        buttons = {"a": bool(self._button_bits & 1), "b": bool(self._button_bits & 2)}
        return DeviceState(self._position_m, self._velocity_m_s, buttons)

    def _read_report(self, now_ns: int) -> bool:
        """Reads the next report of the device, and stores its velocity or buttons.

        Args:
            now_ns: Current time, in ns.

        Returns:
            True if a report was read, in which case another may follow; False if no report was
            waiting.

        Raises:
            ConnectionError: The device was disconnected.
        """
        try:
            report = os.read(self._file, 64)
        except BlockingIOError:
            return False
        if not report:
            raise ConnectionError("the SpaceMouse was disconnected")

        kind = report[0]
        if kind == _MOTION_REPORT and len(report) >= 7:
            # The axes of the device point to the right, towards the person, and down.
            right, near, down = struct.unpack_from("<3h", report, 1)
            self._velocity_m_s = (SPEED_M_S * right, -SPEED_M_S * near, -SPEED_M_S * down)
            self._reported_ns = now_ns
        elif kind == _BUTTON_REPORT and len(report) >= 2:
            self._button_bits = report[1]
        return True

    def render(self, force_n: Vector) -> None:
        """Does nothing, since a SpaceMouse has no motors.

        Args:
            force_n: Ignored.
        """
