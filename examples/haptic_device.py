"""A haptic device at an arm: the loop that one of 1 kHz needs, with a simulated device in its place.

The device is a mass of 0.2 kg in the plane with some friction, and its user pushes it with a steady force. In
each millisecond the loop reads where the device is, tells the hand, and lets the device push back with what
the hand feels. It rests where both are equal: the scenario's stiffness, felt. Two terminals:

    trilat demo play --duration 60
    python examples/haptic_device.py play m1

For a device of your own give `Device` its driver: `position_m` reads its encoders, `render` sets its motors.
"""

import argparse
import time
from collections.abc import Sequence

import trilat_net

PERIOD_S = 0.001
PUSH_N = (0.0, 6.0)


class Device:
    """A simulated device: a free mass with friction, pushed by its user."""

    MASS_KG, FRICTION_N_S_M = 0.2, 4.0

    def __init__(self) -> None:
        self.position_m, self._speed = [0.0, 0.0], [0.0, 0.0]

    def render(self, force_n: Sequence[float], period_s: float) -> None:
        """Pushes back with a force for a time; a real one would set its motors."""
        for i, (felt, push) in enumerate(zip(force_n, PUSH_N, strict=True)):
            acceleration = (felt + push - self.FRICTION_N_S_M * self._speed[i]) / self.MASS_KG
            self._speed[i] += period_s * acceleration
            self.position_m[i] += period_s * self._speed[i]


def main() -> None:
    """Renders an arm on the device for some seconds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as in play")
    parser.add_argument("site", help="whose arm the device holds")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()

    device, late, rounds = Device(), 0, 0
    connected = trilat_net.hand(
        options.session, options.site, connect=options.connect, source="haptic device"
    )
    with connected as hand:
        start = hand.pose
        begun_s = next_s = time.monotonic()
        while next_s - begun_s < options.seconds and not hand.over:
            hand.move(*(a + b for a, b in zip(start, device.position_m, strict=True)))
            device.render([-one for one in hand.force], PERIOD_S)
            rounds += 1
            next_s += PERIOD_S
            late += time.monotonic() > next_s
            time.sleep(max(0.0, next_s - time.monotonic()))
        felt = ", ".join(f"{-one:.2f}" for one in hand.force)
        moved = ", ".join(f"{1e3 * (b - a):.1f}" for a, b in zip(start, hand.pose, strict=True))
    offset = ", ".join(f"{1e3 * one:.1f}" for one in device.position_m)
    print(f"{rounds} rounds of 1 ms, {late} of them late; the device stands at ({offset}) mm")
    print(f"it feels ({felt}) N; the arm moved by ({moved}) mm")


if __name__ == "__main__":
    main()
