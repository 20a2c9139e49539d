"""Moves an arm with a gamepad: the left stick moves the end effector.

The first button releases the arm.

    trilat demo play --duration 60
    python examples/gamepad_hand.py play m1

Works on Linux only. It needs python-evdev (`pip install evdev`), and a gamepad that your user
may read.
"""

import argparse
import sys
import time
from typing import Any

import trilat_net

PERIOD_S = 1.0 / 60.0
SPEED_M_S = 0.3
DEAD = 0.1
"""Deflection of the stick, as a share of the largest, below which it counts as centred."""


def find_gamepad(evdev: Any) -> Any:
    """Returns the first device with a left stick. Ends the program if there is none."""
    for path in evdev.list_devices():
        device = evdev.InputDevice(path)
        axes = dict(device.capabilities().get(evdev.ecodes.EV_ABS, []))
        if {evdev.ecodes.ABS_X, evdev.ecodes.ABS_Y} <= axes.keys():
            return device
    sys.exit("no gamepad here: none of the devices that this user may read has a left stick")


class Stick:
    """The left stick of a gamepad and its first button."""

    def __init__(self, evdev: Any, device: Any) -> None:
        self._device = device
        self._codes = evdev.ecodes
        axes = dict(device.capabilities()[evdev.ecodes.EV_ABS])
        self._ranges = {
            code: (axes[code].min, axes[code].max)
            for code in (self._codes.ABS_X, self._codes.ABS_Y)
        }
        self._values = dict.fromkeys(self._ranges, 0.0)
        self.released = False

    def poll(self) -> tuple[float, float]:
        """Returns the deflection of the stick to the right and up, each from -1 to 1.

        All events that have arrived since the last call are read.
        """
        while (event := self._device.read_one()) is not None:
            if event.type == self._codes.EV_ABS and event.code in self._ranges:
                low, high = self._ranges[event.code]
                value = 2.0 * (event.value - low) / (high - low) - 1.0
                self._values[event.code] = value if abs(value) > DEAD else 0.0
            elif event.type == self._codes.EV_KEY and event.code == self._codes.BTN_SOUTH:
                self.released = bool(event.value)
        return self._values[self._codes.ABS_X], -self._values[self._codes.ABS_Y]


def main() -> None:
    """Moves an arm until the session ends or until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument("site", help="site whose arm the gamepad moves")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    options = parser.parse_args()
    try:
        import evdev
    except ImportError:
        sys.exit("a gamepad needs python-evdev, which is not installed: pip install evdev")

    stick = Stick(evdev, find_gamepad(evdev))
    with trilat_net.hand(
        options.session, options.site, connect=options.connect, source="gamepad"
    ) as hand:
        target: list[float] | None = None
        while not hand.over:
            right, up = stick.poll()
            if stick.released:
                hand.release()
                target = None
            elif right or up or target:
                target = target or list(hand.pose)
                target[0] += SPEED_M_S * PERIOD_S * right
                target[1] += SPEED_M_S * PERIOD_S * up
                hand.move(*target)
            time.sleep(PERIOD_S)


if __name__ == "__main__":
    main()
