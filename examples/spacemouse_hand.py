"""Moves an arm with a SpaceMouse along one axis at a time.

The axis is the one along which the cap is pushed furthest.

    trilat demo play --duration 60
    python examples/spacemouse_hand.py play m1

Hold the first button and push the cap to move the arm; the second button releases the arm.
Works on Linux, if your user may read the device (docs/sessions/devices.md).
"""

import argparse

import trilat_net as tn


class OneAxis(tn.SpaceMouse):
    """A SpaceMouse that moves along its fastest axis only."""

    position_m = (0.0, 0.0, 0.0)
    previous_m = (0.0, 0.0, 0.0)

    def read(self) -> tn.DeviceState:
        """Returns the position to which the device was moved, axis by axis."""
        state = super().read()
        fastest = max(range(3), key=lambda axis: abs(state.velocity_m_s[axis]))
        x, y, z = (
            old + (new - previous if axis == fastest else 0.0)
            for axis, (old, new, previous) in enumerate(
                zip(self.position_m, state.position_m, self.previous_m, strict=True)
            )
        )
        self.position_m = (x, y, z)
        self.previous_m = state.position_m
        return tn.DeviceState(self.position_m, state.velocity_m_s, state.buttons)


def main() -> None:
    """Moves an arm until the session ends or until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", help="name of the session, for example play")
    parser.add_argument("site", help="site whose arm the device moves")
    parser.add_argument(
        "--device", default="", help="for example /dev/hidraw3; default: the first SpaceMouse"
    )
    parser.add_argument(
        "--connect", action="append", help="endpoint of the session; repeatable"
    )
    options = parser.parse_args()
    device = OneAxis(options.device)
    tn.session(options.session, connect=options.connect).lead(options.site, device)


if __name__ == "__main__":
    main()
