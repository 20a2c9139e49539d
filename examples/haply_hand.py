"""A Haply Inverse3 at an arm, whose force is smoothed: against vibration where the arm meets a stiff wall.

    trilat demo play --duration 60
    python examples/haply_hand.py play m1

The first button of its grip takes hold and is the clutch, the second one lets go; the scenario of the session
says how the device leads the arm (docs/devices.md).
"""

import argparse

import trilat_net as tn

SMOOTH_S = 0.005


class Smoothed(tn.HaplyInverse3):
    """An Inverse3 of which each force is a mean of the last ones."""

    felt_n = (0.0, 0.0, 0.0)

    def render(self, force_n: tuple[float, float, float]) -> None:
        """Renders a force that follows the wanted one within some milliseconds."""
        share = 1.0 / (1.0 + SMOOTH_S * self.rate_hz)
        x, y, z = (
            old + share * (new - old) for old, new in zip(self.felt_n, force_n, strict=True)
        )
        self.felt_n = (x, y, z)
        super().render(self.felt_n)


def main() -> None:
    """Leads an arm until the session ends or Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as in play")
    parser.add_argument("site", help="whose arm the device holds")
    parser.add_argument("--address", default="ws://127.0.0.1:10001", help="of Haply's service")
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    options = parser.parse_args()
    device = Smoothed(options.address)
    tn.session(options.session, connect=options.connect).lead(options.site, device)


if __name__ == "__main__":
    main()
