"""Devices for tests: one that follows a script, Haply's service as documented, and the reports of a cap."""

import json
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ClassVar, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from trilat_net.app.input_device import DeviceState, Vector
from trilat_net.net.clock import Clock

ZERO = (0.0, 0.0, 0.0)


class ScriptedDevice:
    """A device that is where its script has it, s after it was first entered.

    Attributes:
        rendered: times, s, and the forces that it was told to render.
        entered: how often it was.
    """

    rate_hz: ClassVar[int] = 200

    def __init__(
        self,
        clock: Clock,
        script: Callable[[float], DeviceState],
        hangs_s: tuple[float, float] = (1e9, 0.0),
    ) -> None:
        self._clock = clock
        self._script = script
        self._begun_ns = 0
        self._hangs_s = hangs_s  # from when, for how long
        self.rendered: list[tuple[float, Vector]] = []
        self.entered = 0

    @property
    def t_s(self) -> float:
        return (self._clock.monotonic_ns() - self._begun_ns) * 1e-9

    def __enter__(self) -> Self:
        self._begun_ns = self._begun_ns or self._clock.monotonic_ns()
        self.entered += 1
        return self

    def __exit__(self, *_: object) -> None:
        """Releases nothing, because the device holds nothing."""

    def read(self) -> DeviceState:
        if self.t_s >= self._hangs_s[0]:
            self._clock.sleep_until(self._clock.monotonic_ns() + round(1e9 * self._hangs_s[1]))
            self._hangs_s = (1e9, 0.0)
        return self._script(self.t_s)

    def render(self, force_n: Vector) -> None:
        self.rendered.append((self.t_s, force_n))


class HaplyService:
    """Haply's service on this machine: it greets, and answers each message with one state.

    Attributes:
        place_m, pressed: where its cursor is, and the buttons of its grip.
        asked: times, s, and the messages that came, decoded.
        presses_anew: whether its user lets the buttons go and presses them anew twice a second.
        silent: while it is set, it answers nothing.
        raw: a text that it sends once in place of a state.
    """

    def __init__(self, port: int = 0, force_key: str = "vector") -> None:
        self.place_m: Callable[[], Vector] = lambda: (0.0, -0.12, 0.15)
        self.pressed: set[str] = set()
        self.presses_anew = False
        self.asked: list[tuple[float, dict[str, Any]]] = []
        self.silent = threading.Event()
        self.raw = ""
        self._key = force_key
        self.devices = ["049D"]
        self.answered_s = 0.0
        self._server = serve(
            self._attend, "127.0.0.1", port, compression=None, ping_interval=None
        )
        self.port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._open: list[ServerConnection] = []
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    @property
    def address(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def kill(self) -> None:
        """Ends the service like a killed process: connections break, and the port is closed."""
        self._server.shutdown()
        for connection in self._open:
            with suppress(OSError):
                connection.socket.shutdown(2)
        self._thread.join(5.0)

    @property
    def forces(self) -> list[Vector]:
        """Returns the received forces, by the key under which the service knows them."""
        return [self._force(message) for _, message in self.asked]

    def _force(self, message: dict[str, Any]) -> Vector:
        force = message["inverse3"][0]["commands"]["set_cursor_force"].get(self._key)
        return (force["x"], force["y"], force["z"]) if force else ZERO

    def _attend(self, connection: ServerConnection) -> None:
        self._open.append(connection)
        with suppress(ConnectionClosed, OSError):
            connection.send(
                json.dumps({"session_id": 7} | self._state(config={"type": "inverse3"}))
            )
            for text in connection:
                self.asked.append((time.perf_counter(), json.loads(text)))
                while self.silent.is_set():
                    time.sleep(0.001)
                answer = self.raw or json.dumps(self._state())
                self.raw = ""
                self.answered_s = time.perf_counter()
                connection.send(answer)

    def _state(self, **more: Any) -> dict[str, Any]:
        force = self._force(self.asked[-1][1]) if self.asked else ZERO
        vectors = {"position": self.place_m(), "velocity": ZERO}
        state: dict[str, Any] = {
            f"cursor_{k}": dict(zip("xyz", v, strict=True)) for k, v in vectors.items()
        }
        state["current_cursor_force"] = dict(zip("xyz", force, strict=True))
        up = self.presses_anew and time.perf_counter() % 0.5 < 0.02
        buttons = {name: name in self.pressed and not up for name in "abc"}
        grip = {"orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, "buttons": buttons}
        return {
            "inverse3": [{"device_id": name, "state": state, **more} for name in self.devices],
            "wireless_verse_grip": [{"device_id": "61576", "state": grip}],
        }


class CapReports:
    """The file of a SpaceMouse, of which each read is one report: a pipe of packets."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe2(os.O_DIRECT)
        self.path = f"/proc/self/fd/{self._read}"

    def push(self, right: int, near: int, down: int) -> None:
        """Pushes the cap, in counts of its axes."""
        numbers = (right, near, down, 0, 0, 0)
        os.write(
            self._write,
            bytes([1]) + b"".join(n.to_bytes(2, "little", signed=True) for n in numbers),
        )

    def press(self, buttons: int) -> None:
        os.write(self._write, bytes([3, buttons, 0]))

    def write(self, report: bytes) -> None:
        os.write(self._write, report)

    def unplug(self) -> None:
        os.close(self._write)

    def close(self) -> None:
        os.close(self._read)
