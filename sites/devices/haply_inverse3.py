"""Haply's Inverse3, by the JSON of its service: one state for each message sent, so ours is the
cadence.

Invariant: each state is answered by one message with a force, a zero one at rest, which keeps
the connection alive. A message that cannot be read is a state that is nowhere, and moves
nothing.
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
"""A service that is silent for so long is given up, before the site lets go of a silent hand.
"""
_NOWHERE = (math.nan, math.nan, math.nan)
_UNREADABLE = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    OverflowError,
    msgspec.MsgspecError,
)
_PLAIN: dict[str, Any] = {
    "compression": None,
    "proxy": None,
    "ping_interval": None,
    "close_timeout": 0.2,
}


class HaplyInverse3:
    """An Inverse3 of Haply and its wireless grip, by the maker's service (version 3).

    >>> tn.lead("play", "m1", tn.HaplyInverse3("ws://127.0.0.1:10001"))  # doctest: +SKIP

    Args:
        address: of the service; "#values" at its end sends forces by that key, as older
            versions take them, and not by `vector`.
    """

    rate_hz: ClassVar[int] = 1000

    def __init__(self, address: str = "ws://127.0.0.1:10001") -> None:
        self._address, key = urldefrag(address)
        self._force_key = key or "vector"
        self._open = ExitStack()
        self._socket: ClientConnection | None = None
        self._first: dict[str, Any] = {}
        self._id = ""
        self._was_there = False

    def __enter__(self) -> Self:
        if not self._was_there:
            # a misspelt name never answers; one that did may be away for a while
            check_hosts([self._address])
        try:
            self._socket = self._open.enter_context(
                connect(self._address, open_timeout=2.0, **_PLAIN)
            )
        except (OSError, ValueError, WebSocketException) as error:
            raise ConnectionError(
                f"no service of an Inverse3 at {self._address}: {error}"
            ) from None
        self._was_there = True
        self._first = {"session": {"configure": {"profile": {"name": "trilat-net"}}}}
        self._id = ""
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self.render((0.0, 0.0, 0.0))
        self._open.close()

    def read(self) -> DeviceState:
        """Returns the state that the service sends next."""
        assert self._socket is not None  # it is entered
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
                _read(state["cursor_position"]), _read(state["cursor_velocity"]), buttons
            )
        except TimeoutError:
            raise TimeoutError(f"the service at {self._address} is silent") from None
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        except _UNREADABLE:
            return DeviceState(_NOWHERE, _NOWHERE, {})

    def render(self, force_n: Vector) -> None:
        """Sends a force, which asks for the next state."""
        if self._socket is None or not self._id:
            return
        force = {self._force_key: dict(zip("xyz", force_n, strict=True))}
        command = {"device_id": self._id, "commands": {"set_cursor_force": force}}
        try:
            self._socket.send(
                msgspec.json.encode(self._first | {"inverse3": [command]}), text=True
            )
        except WebSocketException:
            raise ConnectionError(
                f"the service at {self._address} has closed the connection"
            ) from None
        self._first = {}


def _read(point: dict[str, float]) -> Vector:
    return float(point["x"]), float(point["y"]), float(point["z"])
