"""Connection of an external arm's program to its site (`plant = "external"`).

Invariant: the arm sends its position as often as it likes; the torque to apply stands in the record that the
site publishes at every tick, so the arm receives exactly what the log holds. Without a valid torque,
`torque` returns None and the arm must brake.

    with ArmPort.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as port:
        while not port.over:
            port.send(*robot.joints())
            tau = port.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()
"""

from collections.abc import Sequence

from . import topics
from .bus import Bus
from .clock import Clock, SystemClock
from .membership import new_boot
from .requests import ArmMeasurement
from .site_port import SitePort
from .wire import encode
from .zenoh_bus import ZenohBus

BRAKE_NS = 100_000_000
"""Time of a fault after which the brakes are to hold the arm."""


class ArmPort(SitePort):
    """The connection of an arm to its site; a context, which closes it. `record` is the site's newest one."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        super().__init__(bus, clock, session, site)
        self._boot = new_boot()
        self._n = 0
        self._publish = bus.publisher(topics.key(session, site, topics.MEASURED))

    @classmethod
    def connected(cls, session: str, site: str, connect: Sequence[str]) -> "ArmPort":
        """Returns a port that reaches a site over Zenoh.

        Args:
            session: the session's name, by default the scenario's.
            site: the site of the arm.
            connect: the site's endpoints, as it prints them when it waits for its arm.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        return cls(ZenohBus([], list(connect)), SystemClock(), session, site)

    def send(self, q: Sequence[float], qd: Sequence[float], tau_x: Sequence[float] = ()) -> None:
        """Sends what was measured of the arm.

        Args:
            q: joint angles, rad.
            qd: joint velocities, rad/s.
            tau_x: torque of operator and environment, N m per joint, where the arm measures it; in the
                paper's sign: the torque ON the arm is its negative.

        Raises:
            ValueError: tau_x is not as long as q, or not finite.
        """
        message = ArmMeasurement(
            site=self._site,
            boot=self._boot,
            n=self._n,
            q=[float(angle) for angle in q],
            qd=[float(speed) for speed in qd],
            sent_ns=self._clock.monotonic_ns(),
            tau_x=[float(torque) for torque in tau_x],
        )
        self._n += 1
        self._publish(encode(message))

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, N m per joint; None if the arm must brake.

        It must before the first tick, after the run, while no record newer than `FRESH_NS` has arrived, and
        `BRAKE_NS` after a fault began, when its torque has come down to damping and gravity.
        """
        record, fresh = self.record, self.fresh
        if not fresh or record is None:
            return None
        since_ns = record.mem[len(record.q_des)] if record.mode == "fault" else record.t_ns
        return tuple(record.tau) if record.t_ns - since_ns < BRAKE_NS else None
