"""The SpaceMouse of 3Dconnexion, by the reports of Linux' hidraw.

The device has a cap that a person pushes and turns, and that springs back. The deflection of
the cap stands for a velocity, from which this module integrates a position.

Invariant:
    - A cap that reports nothing for `STILL_NS` is at rest, because a deflected cap reports all
      the time.
    - No web page needs to be open, unlike with WebHID.
"""

import os
import struct
from pathlib import Path
from typing import ClassVar, Self

from trilat_net.net.clock import Clock, SystemClock

from . import DeviceState, Vector

STILL_NS = 100_000_000
"""Time without a report after which the cap is at rest, in ns."""
SPEED_M_S = 0.2 / 350.0
"""Velocity for each count of an axis, in m/s; a fully deflected cap reports 350 counts."""
_MAKER_IDS = (":0000256F:", ":0000046D:0000C62")
"""Parts of the identities of SpaceMice: of 3Dconnexion, and of Logitech, the earlier maker."""
_MOTION_REPORT = 1
_BUTTON_REPORT = 3


def find_spacemouse(devices: Path = Path("/sys/class/hidraw")) -> str:
    """Returns the path of the first SpaceMouse.

    Raises:
        FileNotFoundError: no SpaceMouse is connected.
    """
    for uevent in sorted(devices.glob("*/device/uevent")):
        identity = uevent.read_text(encoding="utf-8")
        if any(maker in identity for maker in _MAKER_IDS):
            return f"/dev/{uevent.parts[-3]}"
    raise FileNotFoundError("no SpaceMouse is connected")


class SpaceMouse:
    """A SpaceMouse; its first two buttons are "a" and "b", and it renders no force.

    >>> tn.session("play").lead("m1", tn.SpaceMouse("/dev/hidraw3"))  # doctest: +SKIP

    Args:
        address: the path of the device; by default the first SpaceMouse.
        clock: the clock of this machine.
    """

    rate_hz: ClassVar[int] = 125

    def __init__(self, address: str = "", clock: Clock | None = None) -> None:
        self._address = address
        self._clock = clock or SystemClock()
        self._file = -1

    def __enter__(self) -> Self:
        self._file = os.open(self._address or find_spacemouse(), os.O_RDONLY | os.O_NONBLOCK)
        self._position_m: Vector = (0.0, 0.0, 0.0)
        self._velocity_m_s = self._position_m
        self._button_bits = 0
        now_ns = self._clock.monotonic_ns()
        # Time of the last report, and time until which the velocity is integrated.
        self._reported_ns = now_ns
        self._read_ns = now_ns
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self) -> DeviceState:
        """Returns the state, with the position integrated from the deflections of the cap."""
        now_ns = self._clock.monotonic_ns()
        while self._read_report(now_ns):
            pass
        if now_ns - self._reported_ns > STILL_NS:
            self._velocity_m_s = (0.0, 0.0, 0.0)
        elapsed_s = (now_ns - self._read_ns) * 1e-9
        self._read_ns = now_ns
        x, y, z = self._position_m
        vx, vy, vz = self._velocity_m_s
        self._position_m = (
            x + elapsed_s * vx,
            y + elapsed_s * vy,
            z + elapsed_s * vz,
        )
        buttons = {"a": bool(self._button_bits & 1), "b": bool(self._button_bits & 2)}
        return DeviceState(self._position_m, self._velocity_m_s, buttons)

    def _read_report(self, now_ns: int) -> bool:
        """Reads a report and stores its contents; returns False if there is no report.

        Raises:
            ConnectionError: the device is not connected any more.
        """
        try:
            report = os.read(self._file, 64)
        except BlockingIOError:
            return False
        if not report:
            raise ConnectionError("the SpaceMouse is gone")
        kind = report[0]
        if kind == _MOTION_REPORT and len(report) >= 7:
            # The device counts towards the right, towards the person, and down.
            right, near, down = struct.unpack_from("<3h", report, 1)
            self._velocity_m_s = (SPEED_M_S * right, -SPEED_M_S * near, -SPEED_M_S * down)
            self._reported_ns = now_ns
        elif kind == _BUTTON_REPORT and len(report) >= 2:
            self._button_bits = report[1]
        return True

    def render(self, force_n: Vector) -> None:
        """Does nothing: a SpaceMouse has no motors."""
