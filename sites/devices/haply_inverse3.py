"""Haply's Inverse3, by the JSON messages of its service.

The service replies to each message with one state, so this program sets the rate.

Invariant:
    - Each state is answered by one message with a force, also a zero force at rest, which keeps
      the connection alive.
    - A message that cannot be parsed becomes a state whose position is not finite; such a state
      moves nothing.
"""

import math
from contextlib import ExitStack, suppress
from typing import Any, ClassVar, Self
from urllib.parse import urldefrag

import msgspec
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from trilat_net.net.host_names import check_hosts

from . import DeviceState, Vector

SILENCE_S = 0.15
"""Silence after which the service is given up, before the site releases a silent hand."""
_NO_POSITION = (math.nan, math.nan, math.nan)
_UNREADABLE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    msgspec.MsgspecError,
)
_CONNECT_OPTIONS: dict[str, Any] = {
    "compression": None,
    "proxy": None,
    "ping_interval": None,
    "close_timeout": 0.2,
}


class HaplyInverse3:
    """An Inverse3 of Haply with its wireless grip, by the maker's service (version 3).

    >>> tn.lead("play", "m1", tn.HaplyInverse3("ws://127.0.0.1:10001"))  # doctest: +SKIP

    Args:
        address: the address of the service. "#values" at its end sends forces under the key
            `values`, as older versions of the service expect, instead of `vector`.
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
        if not self._was_connected:
            # Only before the first connection: a known service may be away for a while.
            check_hosts([self._address])
        try:
            self._socket = self._open.enter_context(
                connect(self._address, open_timeout=2.0, **_CONNECT_OPTIONS)
            )
        except (OSError, ValueError, WebSocketException) as error:
            raise ConnectionError(
                f"no service of an Inverse3 at {self._address}: {error}"
            ) from None
        self._was_connected = True
        self._configuration = {"session": {"configure": {"profile": {"name": "trilat-net"}}}}
        self._id = ""
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self.render((0.0, 0.0, 0.0))
        self._open.close()

    def read(self) -> DeviceState:
        """Returns the next state that the service sends."""
        assert self._socket is not None  # the context has been entered
        try:
            message = msgspec.json.decode(self._socket.recv(SILENCE_S))
            if not message.get("inverse3"):
                raise ConnectionError(f"the service at {self._address} has no Inverse3")
            self._id = str(message["inverse3"][0]["device_id"])
            state = message["inverse3"][0]["state"]
            grips = [
                grip["state"].get("buttons", {})
                for grip in message.get("wireless_verse_grip", [])
            ]
            buttons = {name: bool(pressed) for grip in grips for name, pressed in grip.items()}
            return DeviceState(
                _parse_vector(state["cursor_position"]),
                _parse_vector(state["cursor_velocity"]),
                buttons,
            )
        except TimeoutError:
            raise TimeoutError(f"the service at {self._address} is silent") from None
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        except _UNREADABLE:
            return DeviceState(_NO_POSITION, _NO_POSITION, {})

    def render(self, force_n: Vector) -> None:
        """Sends a force, N; the message also requests the next state."""
        if self._socket is None or not self._id:
            return
        force = {self._force_key: dict(zip("xyz", force_n, strict=True))}
        command = {"device_id": self._id, "commands": {"set_cursor_force": force}}
        try:
            self._socket.send(
                msgspec.json.encode(self._configuration | {"inverse3": [command]}), text=True
            )
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        self._configuration = {}


def _parse_vector(point: dict[str, float]) -> Vector:
    return float(point["x"]), float(point["y"]), float(point["z"])
