"""Connections of an external arm's program (`plant = "external"`) and of its dead-man switch to their site.

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
from pathlib import Path
from typing import Self

from ..core.ticks import LifeReason
from . import topics
from .access_rules import OPERATOR
from .bus import Bus
from .clock import Clock, SystemClock
from .connection import Connection, secure_connection
from .membership import new_boot
from .requests import ArmEnable, ArmMeasurement
from .site_port import SitePort
from .wire import encode
from .zenoh_bus import ZenohBus

BRAKE_NS = 100_000_000
"""Time of a fault, or since a dead-man switch was let go, after which the brakes are to hold the arm."""


class OutsidePort(SitePort):
    """The connection of a program that sends to a site, under one of its keys; a context, which closes it."""

    channel = ""
    """The last part of that key."""
    member = ""
    """Whose keys it takes; "": those of its site."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        super().__init__(bus, clock, session, site)
        self._boot = new_boot()
        self._n = 0
        self._publish = bus.publisher(topics.key(session, site, self.channel))

    @classmethod
    def connected(
        cls, session: str, site: str, connect: Sequence[str], keys: str | Path | None = None
    ) -> Self:
        """Returns a port that reaches a site over Zenoh.

        Args:
            session: the session's name, by default the scenario's.
            site: the site of the arm.
            connect: the site's endpoints, as it prints them when it waits for its arm.
            keys: folder of keys, as of --keys: an arm has those of its site, a switch those of the operator.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        reached = secure_connection(Connection((), list(connect)), keys, insecure=False)
        reached.require(cls.member or site)
        bus = ZenohBus([], reached.reach(list(connect)), own=reached.own)
        return cls(bus, SystemClock(), session, site)


class EnablePort(OutsidePort):
    """The dead-man switch of an arm: what its program says for as long as somebody holds it.

    with EnablePort.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as switch:
        while not switch.over:
            switch.send(held=button.is_pressed())  # at least every 100 ms
            time.sleep(0.02)
    """

    channel, member = topics.ENABLE, OPERATOR

    def send(self, *, held: bool) -> None:
        """Says that somebody holds it, or has let it go."""
        now_ns = self._clock.monotonic_ns()
        self._publish(
            encode(ArmEnable(site=self._site, boot=self._boot, n=self._n, held=held, sent_ns=now_ns))
        )
        self._n += 1


class ArmPort(OutsidePort):
    """The connection of an arm to its site; a context, which closes it. `record` is the site's newest one."""

    channel = topics.MEASURED

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
        `BRAKE_NS` after a fault began, or a dead-man switch was let go: until then its torque brings it to
        rest.
        """
        record, fresh = self.record, self.fresh
        if not fresh or record is None:
            return None
        shared = len(record.q_des)
        released = record.mode == "stopped" and record.mem[2 * shared + 1] == LifeReason.RELEASED
        since_ns = record.mem[shared] if record.mode == "fault" or released else record.t_ns
        return tuple(record.tau) if record.t_ns - since_ns < BRAKE_NS else None
