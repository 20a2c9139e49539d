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

from ..errors import WireError
from . import topics
from .bus import Bus
from .clock import Clock, SystemClock
from .membership import new_boot, read_events
from .messages import State
from .requests import ArmMeasurement
from .wire import decode, encode
from .zenoh_bus import ZenohBus

FRESH_NS = 100_000_000
"""Age at which a torque is invalid: the site is late, or gone."""


class ArmPort:
    """The connection of an arm to its site; a context, which closes it. `record` is the site's newest one."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self.record: State | None = None
        self._bus, self._clock, self._site = bus, clock, site
        self._boot = new_boot()
        self._n = 0
        self._came_ns = 0
        self._present = self._gone = False
        self._publish = bus.publisher(topics.key(session, site, topics.MEASURED))
        self._records = bus.stamped(topics.key(session, site, topics.STATE), clock.monotonic_ns, 64)
        self._events = bus.inbox(topics.key(session, site, topics.EVENT), 256)
        self._presence = bus.presence(topics.presence_key(session, site))

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

    def __enter__(self) -> "ArmPort":
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

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

        It must before the first tick, after the run, and while no record newer than `FRESH_NS` has arrived.
        """
        self._read_messages()
        record = self.record
        if record is None or self._gone or record.mode == "diverged":
            return None
        if self._clock.monotonic_ns() - self._came_ns > FRESH_NS:
            return None
        return tuple(record.tau)

    @property
    def over(self) -> bool:
        """True once the site's run has ended, or the site is gone."""
        self._read_messages()
        return self._gone

    def _read_messages(self) -> None:
        while (message := self._records.poll()) is not None:
            try:
                record = decode(message[0], State)
            except WireError:
                continue  # a stranger's
            if self.record is None or record.boot == self.record.boot:
                self.record, self._came_ns = record, message[1]
        for event in read_events(self._events):
            if event.kind == "end" and self.record is not None and event.boot == self.record.boot:
                self._gone = True
        for _, alive in topics.read_presence(self._presence):
            self._present = self._present or alive
            self._gone = self._gone or (self._present and not alive)
