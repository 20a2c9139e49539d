"""A SpaceMouse at an arm that moves along one axis at a time: that along which its cap is pushed furthest.

    trilat demo play --duration 60
    python examples/spacemouse_hand.py play m1

Hold the first button and push the cap; the second one lets go. On Linux; this user may read the SpaceMouse
(docs/devices.md).
"""

import argparse

import trilat_net as tn


class OneAxis(tn.SpaceMouse):
    """A SpaceMouse of which only the fastest axis moves."""

    place_m, before_m = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)

    def read(self) -> tn.DeviceState:
        """Returns where it has been led, axis by axis."""
        state = super().read()
        fastest = max(range(3), key=lambda axis: abs(state.velocity_m_s[axis]))
        place = list(self.place_m)
        place[fastest] += state.position_m[fastest] - self.before_m[fastest]
        self.place_m, self.before_m = (place[0], place[1], place[2]), state.position_m
        return tn.DeviceState(self.place_m, state.velocity_m_s, state.buttons)


def main() -> None:
    """Leads an arm until the session ends or Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="its name, as in play")
    parser.add_argument("site", help="whose arm the device holds")
    parser.add_argument(
        "--device", default="", help="as /dev/hidraw3; by default the first one"
    )
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    options = parser.parse_args()
    device = OneAxis(options.device)
    tn.session(options.session, connect=options.connect).lead(options.site, device)


if __name__ == "__main__":
    main()
