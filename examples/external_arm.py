"""An arm outside of the program: what the driver of a real robot would be, with a simulated one in its place.

It stands in for the slave of `two_sites`. Its arm is heavier than the scenario's and has friction, which no
model here knows; it is stepped by the code below and by nothing of trilat-net. Three terminals:

    trilat site m --scenario two_sites --set sites.s.plant=external --set sites.s.arm.known=false
    trilat site s --scenario two_sites --set sites.s.plant=external --set sites.s.arm.known=false
    python examples/external_arm.py s --connect tcp/127.0.0.1:PORT    # the place that site s names

`trilat record --session two_sites` in a fourth one makes a log, which `trilat verify` executes again.
"""

import argparse
import math
import time

from trilat_net.net.arm_port import ArmPort

PERIOD_S = 0.001
M1, M2, L1, L2, G = 1.2, 1.1, 1.0, 1.0, 9.81  # point masses at the ends of the links
VISCOUS, COULOMB = 0.4, 0.6  # N m s/rad, N m


class Robot:
    """Two links with friction and a brake."""

    def __init__(self) -> None:
        self.q, self.qd = [0.0, 0.0], [0.0, 0.0]

    def accelerations(self, tau: tuple[float, ...], damping: float) -> tuple[float, float]:
        """Solves the equation of motion for the accelerations of both joints."""
        (q1, q2), (w1, w2) = self.q, self.qd
        c2, s2 = math.cos(q2), math.sin(q2)
        m22 = M2 * L2**2
        m12 = m22 + M2 * L1 * L2 * c2
        m11 = M1 * L1**2 + M2 * L1**2 + m22 + 2.0 * M2 * L1 * L2 * c2
        h = M2 * L1 * L2 * s2
        g2 = M2 * G * L2 * math.cos(q1 + q2)
        g1 = (M1 + M2) * G * L1 * math.cos(q1) + g2
        f1, f2 = (damping * w + COULOMB * math.tanh(w / 0.01) for w in (w1, w2))
        b1 = tau[0] + h * (2.0 * w1 * w2 + w2 * w2) - g1 - f1
        b2 = tau[1] - h * w1 * w1 - g2 - f2
        det = m11 * m22 - m12 * m12
        return (m22 * b1 - m12 * b2) / det, (m11 * b2 - m12 * b1) / det

    def apply(self, tau: tuple[float, ...] | None) -> None:
        """Moves on by a period under a torque; None: the brakes hold it."""
        if tau is None:
            self.qd = [0.0, 0.0]
            return
        accelerations = self.accelerations(tau, VISCOUS)
        self.qd = [w + PERIOD_S * a for w, a in zip(self.qd, accelerations, strict=True)]
        self.q = [q + PERIOD_S * w for q, w in zip(self.q, self.qd, strict=True)]


def main() -> None:
    """Drives the robot until the site's run is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("site", help="whose arm this is")
    parser.add_argument("--session", default="two_sites")
    parser.add_argument("--connect", required=True, help="where that site listens")
    options = parser.parse_args()

    robot = Robot()
    with ArmPort.connected(options.session, options.site, [options.connect]) as port:
        next_s = time.monotonic()
        while not port.over:
            port.send(robot.q, robot.qd)
            robot.apply(port.torque())
            next_s += PERIOD_S
            time.sleep(max(0.0, next_s - time.monotonic()))
    print(f"over: the arm is at {robot.q[0]:.3f}, {robot.q[1]:.3f} rad")


if __name__ == "__main__":
    main()
