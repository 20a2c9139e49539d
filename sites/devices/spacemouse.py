"""3Dconnexion's SpaceMouse, by the reports of Linux' hidraw: it moves to where its cap is
pushed.

Invariant: a cap that reports nothing for `STILL_NS` is at rest, as one that is pushed reports
all the time. No page need be open, as WebHID would need.
"""

import os
import struct
from pathlib import Path
from typing import ClassVar, Self

from trilat_net.net.clock import Clock, SystemClock

from . import DeviceState, Vector

STILL_NS = 100_000_000
SPEED_M_S = 0.2 / 350.0
"""For each count that an axis reports; a cap that is pushed all the way has 350."""
_MAKERS = ":0000256F:", ":0000046D:0000C62"


def find_spacemouse(devices: Path = Path("/sys/class/hidraw")) -> str:
    """Returns the path of the first SpaceMouse; an `OSError` says that there is none."""
    for about in sorted(devices.glob("*/device/uevent")):
        if any(maker in about.read_text(encoding="utf-8") for maker in _MAKERS):
            return f"/dev/{about.parts[-3]}"
    raise FileNotFoundError("no SpaceMouse is connected")


class SpaceMouse:
    """A SpaceMouse, by its path or the first one: its first buttons are "a" and "b"; it renders
    no force.

    >>> tn.session("play").lead("m1", tn.SpaceMouse("/dev/hidraw3"))  # doctest: +SKIP
    """

    rate_hz: ClassVar[int] = 125

    def __init__(self, address: str = "", clock: Clock | None = None) -> None:
        self._address = address
        self._clock = clock or SystemClock()
        self._file = -1

    def __enter__(self) -> Self:
        self._file = os.open(self._address or find_spacemouse(), os.O_RDONLY | os.O_NONBLOCK)
        self._place: Vector = (0.0, 0.0, 0.0)
        self._speed = self._place
        self._pressed = 0
        self._heard_ns = self._read_ns = self._clock.monotonic_ns()
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self) -> DeviceState:
        """Returns where its cap has led it."""
        now_ns = self._clock.monotonic_ns()
        while self._take_report(now_ns):
            pass
        if now_ns - self._heard_ns > STILL_NS:
            self._speed = (0.0, 0.0, 0.0)
        passed_s = (now_ns - self._read_ns) * 1e-9
        self._read_ns = now_ns
        (x, y, z) = self._place
        (u, v, w) = self._speed
        self._place = x + passed_s * u, y + passed_s * v, z + passed_s * w
        return DeviceState(
            self._place,
            self._speed,
            {"a": bool(self._pressed & 1), "b": bool(self._pressed & 2)},
        )

    def _take_report(self, now_ns: int) -> bool:
        try:
            report = os.read(self._file, 64)
        except BlockingIOError:
            return False
        if not report:
            raise ConnectionError("the SpaceMouse is gone")
        if report[0] == 1 and len(report) >= 7:
            right, near, down = struct.unpack_from("<3h", report, 1)
            self._speed = (SPEED_M_S * right, -SPEED_M_S * near, -SPEED_M_S * down)
            self._heard_ns = now_ns
        elif report[0] == 3 and len(report) >= 2:
            self._pressed = report[1]
        return True

    def render(self, force_n: Vector) -> None:
        """Does nothing: it has no motors."""
