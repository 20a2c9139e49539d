"""An arm outside of the program: what the driver of a real robot would be, with a simulated one in its place.

It stands in for an arm of any scenario: a tenth heavier than the scenario's and with friction, which no model
of the session knows, and somebody leans on its first joint. Three terminals:

    trilat site m --scenario examples/external_arm.toml
    trilat site s --scenario examples/external_arm.toml
    python examples/external_arm.py s --connect tcp/127.0.0.1:PORT    # the place that site s names

`--scenario` takes another one, as of arms of seven joints; `--sensor` sends the torque that it measures. A
fourth one with `trilat record --session external_arm` makes a log, which `trilat verify` executes again.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np

import trilat_net as tn

SCENARIO = Path(__file__).with_suffix(".toml")
PERIOD_S = 0.001
HEAVIER = 1.1
VISCOUS, COULOMB = 0.1, 0.2  # N m s/rad and N m for a joint that 1 N m accelerates by 1 rad/s^2
LEAN_NM = 0.5


class Robot(tn.SimulatedArm):
    """A chain of joints with friction, a brake, and sensors of the torque from outside."""

    def __init__(self, scenario: tn.Scenario, site: str) -> None:
        super().__init__(scenario, site, HEAVIER)
        self.tau_x = np.zeros_like(self.q)
        fall = self.accelerate(self.tau_x)  # compiles
        pushes = np.eye(len(self.q))
        self._size = 1.0 / np.array([(self.accelerate(push) - fall) @ push for push in pushes])
        self._moved_s = 0.0

    def apply(self, tau: tuple[float, ...] | None) -> None:
        """Moves on by a period under a torque; None: the brakes hold it.

        A torque is meant for one period: an arm of light drives that moves on by thirty under one, as a
        stalled program would that made up for them, swings and diverges.
        """
        if tau is None:
            self.qd[:] = 0.0
            return
        self._moved_s += PERIOD_S
        # the torque ON the arm is its negative
        self.tau_x[0] = -LEAN_NM * math.sin(self._moved_s)
        friction = self._size * (VISCOUS * self.qd + COULOMB * np.tanh(self.qd / 0.01))
        self.move(np.array(tau) - self.tau_x - friction, PERIOD_S)


def main() -> None:
    """Drives the robot until the site's run is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", help="whose arm this is")
    parser.add_argument(
        "--scenario", default=SCENARIO, help="of the session, for the arm's joints"
    )
    parser.add_argument("--session", help="its name, if it is not the scenario's")
    parser.add_argument("--connect", required=True, help="where that site listens")
    parser.add_argument(
        "--sensor", action="store_true", help="send the torque that the joints measure"
    )
    options = parser.parse_args()

    scenario = tn.load_scenario(options.scenario)
    robot = Robot(scenario, options.site)
    session = options.session or scenario.name
    with tn.ArmClient.connected(session, options.site, [options.connect]) as client:
        next_s = time.monotonic()
        while not client.over:
            client.send(robot.q, robot.qd, robot.tau_x if options.sensor else ())
            robot.apply(client.torque())
            # late periods are not made up for, see `apply`
            next_s = max(next_s + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
    print(f"over: the arm is at {', '.join(f'{q:.3f}' for q in robot.q)} rad")


if __name__ == "__main__":
    main()
