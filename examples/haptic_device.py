"""Lets a haptic device move an arm of a session and feel its force, in a loop of 1 kHz.

A simulated device takes the place of a real one: a mass of 0.2 kg that moves in the plane with
friction, and that its user pushes with a constant force. In each millisecond, the loop sends
the position of the device to the arm, and applies the force of the arm to the device. The
device comes to rest where both forces are equal, so the user feels the stiffness of the
scenario. Run two terminals:

    trilat demo play --duration 60
    python examples/haptic_device.py play m1

To use your own device, replace `Device`: `position_m` reads the encoders, and `render` sets the
motors.
"""

import argparse
import time
from collections.abc import Sequence

import trilat_net

PERIOD_S = 0.001
PUSH_N = (0.0, 6.0)


class Device:
    """A simulated haptic device: a free mass with friction, pushed by its user."""

    MASS_KG = 0.2
    FRICTION_N_S_M = 4.0

    def __init__(self) -> None:
        self.position_m = [0.0, 0.0]
        self._speed = [0.0, 0.0]

    def render(self, force_n: Sequence[float], period_s: float) -> None:
        """Applies a force for one period. A real device would set its motors.

        Args:
            force_n: force on the user's hand, x and y, N.
            period_s: length of the period, in s.
        """
        for i, (arm_force, push) in enumerate(zip(force_n, PUSH_N, strict=True)):
            friction = self.FRICTION_N_S_M * self._speed[i]
            acceleration = (arm_force + push - friction) / self.MASS_KG
            self._speed[i] += period_s * acceleration
            self.position_m[i] += period_s * self._speed[i]


def main() -> None:
    """Connects the device to an arm for some seconds, and prints the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument("site", help="site whose arm the device moves")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()

    device = Device()
    rounds = 0
    late_rounds = 0
    connected = trilat_net.hand(
        options.session, options.site, connect=options.connect, source="haptic device"
    )
    with connected as hand:
        trilat_net.request_real_time_scheduling()
        start = hand.pose
        start_s = time.monotonic()
        next_s = start_s
        while next_s - start_s < options.seconds and not hand.over:
            hand.move(*(a + b for a, b in zip(start, device.position_m, strict=True)))
            device.render([-force for force in hand.force], PERIOD_S)
            rounds += 1
            next_s += PERIOD_S
            late_rounds += time.monotonic() > next_s
            time.sleep(max(0.0, next_s - time.monotonic()))
        felt = ", ".join(f"{-force:.2f}" for force in hand.force)
        moved = ", ".join(f"{1e3 * (b - a):.1f}" for a, b in zip(start, hand.pose, strict=True))
    offset = ", ".join(f"{1e3 * position:.1f}" for position in device.position_m)
    print(
        f"{rounds} rounds of 1 ms, {late_rounds} of them late; "
        f"the device stands at ({offset}) mm"
    )
    print(f"it feels ({felt}) N; the arm moved by ({moved}) mm")


if __name__ == "__main__":
    main()
