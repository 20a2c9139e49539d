"""Driver for the Haply Inverse3 haptic device.

Communicates with the manufacturer's service, a program on the same machine, by JSON messages
over a WebSocket. The service replies to each force with one state of the device, so a new state
arrives only after the next force has been sent, even if the force is zero.

If a message from the service cannot be parsed, the state is returned with a non-finite
position, which `DeviceHand` ignores.
"""

import math
from contextlib import ExitStack, suppress
from typing import Any, ClassVar, Self
from urllib.parse import urldefrag

import msgspec
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from trilat_net.app import DeviceState, Vector
from trilat_net.net import check_hosts

SILENCE_S = 0.15
"""Silence of the service after which the connection is closed, in s.

Shorter than the silence after which the site releases the arm.
"""
_NO_POSITION = (math.nan, math.nan, math.nan)
"""Position of a state that could not be parsed."""
_PARSE_ERRORS = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    msgspec.MsgspecError,
)
"""Errors that a message with unexpected content may raise."""
_CONNECT_OPTIONS: dict[str, Any] = {
    "compression": None,
    "proxy": None,
    "ping_interval": None,
    "close_timeout": 0.2,
}
"""WebSocket options for low latency."""


class HaplyInverse3:
    """Haply Inverse3: an input device with force feedback.

    Connects to the device and its wireless grip through version 3 of the manufacturer's
    service, which must be running on this or another machine.

    >>> tn.session("play").lead("m1", tn.HaplyInverse3())  # doctest: +SKIP

    Args:
        address: Address of the service. If it ends with "#values", forces are sent under the
            key `values` instead of `vector`, as older versions of the service expect.
    """

    rate_hz: ClassVar[int] = 1000

    def __init__(self, address: str = "ws://127.0.0.1:10001") -> None:
        self._address, key = urldefrag(address)
        self._force_key = key or "vector"
        self._open = ExitStack()
        self._socket: ClientConnection | None = None
        self._configuration: dict[str, Any] = {}
        self._id = ""
        self._was_connected = False

    def __enter__(self) -> Self:
        # The address is checked only before the first connection, because later the service may
        # be unavailable for a while.
        if not self._was_connected:
            check_hosts([self._address])

        try:
            connection = connect(self._address, open_timeout=2.0, **_CONNECT_OPTIONS)
            self._socket = self._open.enter_context(connection)
        except (OSError, ValueError, WebSocketException) as error:
            raise ConnectionError(
                f"no Inverse3 service answers at {self._address}: {error}"
            ) from None

        self._was_connected = True
        # The first message also names this program to the service.
        self._configuration = {"session": {"configure": {"profile": {"name": "trilat-net"}}}}
        self._id = ""
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self.render((0.0, 0.0, 0.0))
        self._open.close()

    def read(self) -> DeviceState:
        """Waits for the next state of the device: position, velocity and buttons.

        Raises:
            ConnectionError: The service reports no device, or has closed the connection.
            TimeoutError: The service sends no state within `SILENCE_S`.
        """
        assert self._socket is not None, "the context has been entered"
        try:
            message = msgspec.json.decode(self._socket.recv(SILENCE_S))
            return self._parse_state(message)
        except TimeoutError:
            raise TimeoutError(f"the service at {self._address} is silent") from None
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        except _PARSE_ERRORS:
            return DeviceState(_NO_POSITION, _NO_POSITION, {})

    def _parse_state(self, message: Any) -> DeviceState:
        """Extracts position, velocity and buttons from a message of the service.

        Uses the first Inverse3 in the message, and the buttons of all grips.

        Args:
            message: Decoded message from the service.

        Raises:
            ConnectionError: The service reports no Inverse3.
        """
        if not message.get("inverse3"):
            raise ConnectionError(f"the service at {self._address} has no Inverse3")

        device = message["inverse3"][0]
        self._id = str(device["device_id"])
        state = device["state"]

        buttons: dict[str, bool] = {}
        for grip in message.get("wireless_verse_grip", []):
            for name, is_pressed in grip["state"].get("buttons", {}).items():
                buttons[name] = bool(is_pressed)
        return DeviceState(
            position_m=_parse_vector(state["cursor_position"]),
            velocity_m_s=_parse_vector(state["cursor_velocity"]),
            buttons=buttons,
        )

    def render(self, force_n: Vector) -> None:
        """Sends a force to the device, which applies it to the person.

        The message also requests the next state. Nothing is sent before the first state has
        arrived, since that state contains the identity of the device.

        Args:
            force_n: Force along x, y and z, in N.
        """
        if self._socket is None or not self._id:
            return

        force = {self._force_key: dict(zip("xyz", force_n, strict=True))}
        command = {"device_id": self._id, "commands": {"set_cursor_force": force}}
        message = self._configuration | {"inverse3": [command]}
        try:
            self._socket.send(msgspec.json.encode(message), text=True)
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        self._configuration = {}


def _parse_vector(point: dict[str, float]) -> Vector:
    """Converts a point of the service, {"x": ..., "y": ..., "z": ...}, to a tuple of floats."""
    return float(point["x"]), float(point["y"]), float(point["z"])
