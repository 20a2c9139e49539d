"""Moves an arm with a Haply Inverse3 whose force is smoothed.

Smoothing prevents the device from vibrating when the arm touches a stiff wall.

    trilat demo play --duration 60
    python examples/haply_hand.py play m1

The first button of the grip takes hold of the arm and is the clutch. The second button releases
the arm. The scenario of the session defines how the device moves the arm
(docs/sessions/devices.md).
"""

import argparse

import trilat_net as tn

SMOOTH_S = 0.005


class Smoothed(tn.HaplyInverse3):
    """An Inverse3 whose force passes a low-pass filter with the time constant SMOOTH_S."""

    felt_n = (0.0, 0.0, 0.0)

    def render(self, force_n: tuple[float, float, float]) -> None:
        """Applies the filtered force to the user's hand, N."""
        weight = 1.0 / (1.0 + SMOOTH_S * self.rate_hz)
        x, y, z = (
            old + weight * (new - old) for old, new in zip(self.felt_n, force_n, strict=True)
        )
        self.felt_n = (x, y, z)
        super().render(self.felt_n)


def main() -> None:
    """Moves an arm until the session ends or until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument("site", help="site whose arm the device moves")
    parser.add_argument(
        "--address", default="ws://127.0.0.1:10001", help="address of Haply's service"
    )
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    options = parser.parse_args()
    device = Smoothed(options.address)
    tn.session(options.session, connect=options.connect).lead(options.site, device)


if __name__ == "__main__":
    main()
