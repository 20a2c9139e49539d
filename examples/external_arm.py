"""Connects an arm outside the program to a session, as the driver of a real robot would.

A simulated robot takes the place of the real one. It differs from the arm of the scenario in
ways that no controller knows: it is 10 % heavier, it has friction, and somebody leans on its
first joint. Run three terminals:

    trilat site m --scenario examples/external_arm.toml
    trilat site s --scenario examples/external_arm.toml
    python examples/external_arm.py s --connect tcp/127.0.0.1:PORT

PORT is the port that site s prints. A fourth terminal with `trilat record --session
external_arm` makes a log, which `trilat verify` executes again. `--scenario` selects another
scenario, for example with arms of seven joints. `--sensor` sends the external torque that the
robot measures.
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
VISCOUS = 0.1
"""Viscous friction of a joint with unit inertia, N m s/rad."""
COULOMB = 0.2
"""Dry friction of a joint with unit inertia, N m."""
LEAN_NM = 0.5


class Robot(tn.SimulatedArm):
    """A simulated arm with friction, brakes, and sensors of external torque.

    Args:
        scenario: the scenario of the session.
        site: the site whose arm this robot is.
    """

    def __init__(self, scenario: tn.Scenario, site: str) -> None:
        super().__init__(scenario, site, HEAVIER)
        self.tau_x = np.zeros_like(self.q)
        free_fall = self.accelerate(self.tau_x)  # the first call compiles
        unit_torques = np.eye(len(self.q))
        responses = [(self.accelerate(torque) - free_fall) @ torque for torque in unit_torques]
        self._inertias = 1.0 / np.array(responses)
        self._moved_s = 0.0

    def apply(self, tau: tuple[float, ...] | None) -> None:
        """Moves the robot for one period.

        A torque is meant for one period only. If the program was late and applied one torque
        for thirty periods, a light arm would swing and diverge.

        Args:
            tau: torque of each joint, N m. If `None`, the brakes hold the robot.
        """
        if tau is None:
            self.qd[:] = 0.0
            return
        self._moved_s += PERIOD_S
        # tau_x has the sign of the paper: the torque on the arm is its negative
        self.tau_x[0] = -LEAN_NM * math.sin(self._moved_s)
        friction = self._inertias * (VISCOUS * self.qd + COULOMB * np.tanh(self.qd / 0.01))
        self.move(np.array(tau) - self.tau_x - friction, PERIOD_S)


def main() -> None:
    """Drives the robot until the run of its site ends."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", help="site whose arm this robot is")
    parser.add_argument(
        "--scenario", default=SCENARIO, help="scenario of the session, for the arm's joints"
    )
    parser.add_argument("--session", help="name of the session; default: the scenario's name")
    parser.add_argument("--connect", required=True, help="endpoint at which the site listens")
    parser.add_argument(
        "--sensor", action="store_true", help="send the measured external torque"
    )
    options = parser.parse_args()

    scenario = tn.load_scenario(options.scenario)
    robot = Robot(scenario, options.site)
    session = options.session or scenario.name
    with tn.ArmClient.connected(session, options.site, [options.connect]) as client:
        print(f"scheduling: {tn.request_real_time_scheduling()}", flush=True)
        next_s = time.monotonic()
        while not client.over:
            client.send(robot.q, robot.qd, robot.tau_x if options.sensor else ())
            robot.apply(client.torque())
            # missed periods are skipped, see `Robot.apply`
            next_s = max(next_s + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))
    angles = ", ".join(f"{q:.3f}" for q in robot.q)
    print(f"over: the arm is at {angles} rad")


if __name__ == "__main__":
    main()
