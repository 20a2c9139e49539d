"""The bus over Eclipse Zenoh. Only this module and `ros2_graph` import `zenoh`.

Invariant:
    - Nothing here waits for the network.
    - A publisher drops a message rather than delay its caller, unless the publisher is patient.
    - Replies go into a ring.
    - A session that cannot be opened yet raises an error.
"""

import ctypes
import json
import os
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import zenoh
from zenoh import CongestionControl, Locality, Priority, handlers

from ..errors import SessionError, UsageError
from ..files import reading
from .bus import (
    RING_CAPACITY,
    BoundedRing,
    Inbox,
    PresenceInbox,
    QueryInbox,
    StampedInbox,
    StampingRing,
)
from .zenoh_config import Endpoint, ZenohFile, ZenohMode, check_zenoh_file, make_zenoh_config

QUERY_TIMEOUT_S = 3.0
SHARED_POOL = (
    "(rx:(worker_threads:4),tx:(handover:rx),acc:(handover:rx),"
    "net:(handover:rx),app:(handover:rx))"
)
"""Zenoh's runtime setting that makes all of its five pools share the threads of one."""
MAX_DEPTH = 100
"""Largest nesting of a configuration.

Zenoh's recursive parser overflows its stack on deep nesting.
"""


T = TypeVar("T")


def share_threads() -> None:
    """Makes all of Zenoh use one pool of threads instead of five, from the first session on.

    The threads of several pools wake one another, which costs time. One thread of the pool does
    the work. Closing a connection whose peer never received its last bytes holds a thread for
    up to 10 s (eclipse-zenoh/zenoh#1101); then the other threads serve the other members.

    Routers must not call this function: a router waits for room where it reads, and needs
    another thread that sends meanwhile.
    """
    os.environ.setdefault("ZENOH_RUNTIME", SHARED_POOL)


class RouterSilent(SessionError):  # noqa: N818 - it names an outcome
    """A router does not answer, or does not answer yet."""


class _ZenohRing(Generic[T]):
    """A ring of Zenoh.

    Args:
        channel: Zenoh's receiving channel.
        read: converts a received object into an entry, or into None to skip the object.
    """

    def __init__(self, channel: Any, read: Callable[[Any], T | None]) -> None:
        self._channel = channel
        self._try_recv = channel.try_recv
        self._read = read

    def poll(self) -> T | None:
        try:
            while (received := self._try_recv()) is not None:
                entry = self._read(received)
                if entry is not None:
                    return entry
        except zenoh.ZError:
            pass  # all replies to a query have arrived, so the channel is closed
        return None


def _make_sample_handler(receive: Callable[[Any], None]) -> Any:
    """Returns a Zenoh handler that calls `receive` with every sample, in threads of Zenoh.

    Each thread keeps its CPython thread state. Otherwise CPython would create that state anew
    for every message, and unmap it. A thread acquires the interpreter once more than it
    releases the interpreter, so its state lives as long as the process.
    """
    thread_states = threading.local()

    def handle(sample: Any) -> None:
        receive(sample)
        if not hasattr(thread_states, "state"):
            thread_states.state = ctypes.pythonapi.PyGILState_Ensure()

    return handlers.Callback(handle, indirect=False)


def _read_sample(sample: Any) -> tuple[str, bytes]:
    return str(sample.key_expr), sample.payload.to_bytes()


class _ZenohQuery(NamedTuple):
    query: zenoh.Query
    key: str

    @property
    def payload(self) -> bytes:
        return b"" if self.query.payload is None else self.query.payload.to_bytes()

    def reply(self, payload: bytes) -> None:
        # A query ends for its sender only when the query object is dropped.
        with self.query as query:
            query.reply(self.key, payload)


def open_zenoh(
    listen: Sequence[Endpoint],
    connect: Sequence[Endpoint],
    mode: ZenohMode,
    settings: Mapping[str, Any] | None,
    silent: str,
) -> Any:
    """Returns a Zenoh session with the settings of `make_zenoh_config`.

    Args:
        listen: endpoints at which the session listens.
        connect: endpoints to which the session connects.
        mode: "peer", "client" or "router".
        settings: settings of a user's file, which replace the settings of the program.
        silent: text of the error if no router answers, with {} in place of the endpoints.

    Raises:
        UsageError: an endpoint is malformed, or the session cannot listen there.
        RouterSilent: no router of a client answers.
    """
    # Logs nothing unless the environment has RUST_LOG.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    config = json.dumps(make_zenoh_config(listen, connect, mode, settings))
    try:
        return zenoh.open(zenoh.Config.from_json5(config))
    except zenoh.ZError as error:
        if mode == "client" and "Unable to connect" in str(error):
            raise RouterSilent(silent.format(_endpoint_texts(connect))) from None
        if "in use" in str(error) or "AddrInUse" in str(error):
            raise UsageError(
                f"cannot listen at {_endpoint_texts(listen)}: the port is in use; "
                "end the program that uses it, or choose another port with "
                "--listen tcp/127.0.0.1:PORT"
            ) from None
        endpoints = _endpoint_texts([*listen, *connect])
        raise UsageError(
            f"cannot open a Zenoh session with {endpoints}: {_first_line(error)}"
        ) from None


class ZenohBus:
    """A `Bus` over a separate Zenoh session.

    A peer or router retries until all endpoints answer. A client connects to the first endpoint
    that answers at once, and reconnects if the connection is lost. Peers reach the members that
    they connect to; clients and routers reach all members that a router reaches.

    Args:
        listen: endpoints at which the session listens.
        connect: endpoints to which the session connects.
        mode: "peer", "client" or "router".
        settings: settings of a user's file, which replace the settings of the program.

    Raises:
        UsageError: an endpoint is malformed, or the session cannot listen there.
        RouterSilent: no router of a client answers.
    """

    def __init__(
        self,
        listen: Sequence[Endpoint] = (),
        connect: Sequence[Endpoint] = (),
        mode: ZenohMode = "peer",
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        or_refused = ", or none lets this member in" if settings else ""
        self._session = open_zenoh(
            listen=listen,
            connect=connect,
            mode=mode,
            settings=settings,
            silent=f"no router answers at {{}}{or_refused}",
        )
        self._declarations: list[Any] = []  # Zenoh undeclares an object that is not referenced
        self._tokens: set[str] = set()

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """See `Bus`.

        A receiver that blocks a patient publisher for 5 s loses its connection.
        """
        publisher = self._session.declare_publisher(
            key,
            congestion_control=CongestionControl.BLOCK if patient else CongestionControl.DROP,
            priority=Priority.REAL_TIME,
            express=False,
            allowed_destination=Locality.REMOTE,
        )
        self._declarations.append(publisher)
        put: Callable[[bytes], None] = publisher.put
        return put

    def _subscribe(self, key: str, handler: Any) -> Any:
        return self._session.declare_subscriber(key, handler, allowed_origin=Locality.REMOTE)

    def _serve(self, key: str, handler: Any) -> Any:
        return self._session.declare_queryable(key, handler, allowed_origin=Locality.REMOTE)

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """See `Bus`."""
        return _ZenohRing(self._subscribe(key, handlers.RingChannel(capacity)), _read_sample)

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """See `Bus`."""
        ring = StampingRing(now_ns, read, capacity)
        receive = ring.receive  # looked up once, not for every message
        handler = _make_sample_handler(lambda sample: receive(sample.payload.to_bytes()))
        self._declarations.append(self._subscribe(key, handler))
        return ring

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """See `Bus`."""
        handler = _make_sample_handler(lambda sample: callback(*_read_sample(sample)))
        self._declarations.append(self._subscribe(key, handler))

    def query_inbox(self, key: str) -> QueryInbox:
        """See `Bus`."""
        # Polling a Python ring costs a loop less than polling a ring of Zenoh.
        ring: BoundedRing[_ZenohQuery] = BoundedRing(64)
        handler: Any = handlers.Callback(
            lambda query: ring.put(_ZenohQuery(query, key)), indirect=False
        )
        self._declarations.append(self._serve(key, handler))
        return ring

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """See `Bus`."""

        def answer_at_once(query: zenoh.Query) -> None:
            # A query ends for its sender only when the query object is dropped.
            with query:
                payload = answer(_ZenohQuery(query, key).payload)
                if payload is not None:
                    query.reply(key, payload)

        self._declarations.append(
            self._serve(key, handlers.Callback(answer_at_once, indirect=False))
        )

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """See `Bus`."""
        # Not a ring channel: it loses its replies when the last one has arrived.
        replies = self._session.get(
            key,
            handlers.FifoChannel(256),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE),
            timeout=QUERY_TIMEOUT_S,
            allowed_destination=Locality.REMOTE,
            payload=payload,
            # Replies inherit these settings, so that no member waits for a hanging receiver.
            congestion_control=CongestionControl.DROP,
            priority=Priority.REAL_TIME,
        )
        return _ZenohRing(
            replies, lambda reply: None if reply.ok is None else _read_sample(reply.ok)
        )

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.add(key)
        self._declarations.append(self._session.liveliness().declare_token(key))

    def presence(self, key: str) -> PresenceInbox:
        """See `Bus`."""

        def read(sample: zenoh.Sample) -> tuple[str, bool] | None:
            token = str(sample.key_expr)
            # Liveliness has no locality setting: tokens of this session arrive, too.
            if token in self._tokens:
                return None
            return token, sample.kind == zenoh.SampleKind.PUT

        tokens = self._session.liveliness().declare_subscriber(
            key, handlers.RingChannel(256), history=True
        )
        return _ZenohRing(tokens, read)

    def close(self) -> None:
        """See `Bus`."""
        if not self._session.is_closed():
            self._session.close()
        self._declarations.clear()


def read_zenoh_file(path: Path) -> ZenohFile:
    """Returns a user's Zenoh configuration from a file in JSON5 or JSON.

    Raises:
        UsageError: the file cannot be read, is not a configuration, or contradicts the
            requirements of a session.
    """
    try:
        with reading(path, UsageError) as stream:
            text = stream.read().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is no text in UTF-8") from None
    return check_zenoh_file(str(path), _parse_json5(str(path), text), _find_refusal)


def _parse_json5(source: str, text: str) -> object:
    """Returns the object in a JSON5 text, parsed by Zenoh.

    The key `metadata` of a Zenoh configuration may hold any value.
    """
    nesting = accumulate((character in "[{") - (character in "]}") for character in text)
    if max(nesting, default=0) > MAX_DEPTH:
        raise UsageError(f"{source}: no JSON5: nested deeper than {MAX_DEPTH}")
    try:
        config = zenoh.Config.from_json5(f"{{metadata: [\n{text}\n]}}")
    except zenoh.ZError as error:
        match = re.search(r"--> (\d+):(\d+)", str(error))
        expected = re.search(r"= (expected .*)", str(error))
        # The text begins in the second line of what Zenoh parses.
        position = f"line {int(match[1]) - 1}, column {match[2]}: " if match else ""
        reason = expected[1] if expected else _first_line(error)
        raise UsageError(f"{source}: {position}no JSON5: {reason}") from None
    objects: list[object] = json.loads(config.get_json("metadata"))
    if len(objects) != 1:
        raise UsageError(
            f"{source}: a Zenoh configuration is one object in braces; here are {len(objects)}"
        )
    return objects[0]


def _find_refusal(settings: Mapping[str, Any]) -> str:
    """Returns Zenoh's reason for refusing settings, or "" if Zenoh accepts them."""
    try:
        zenoh.Config.from_json5(json.dumps(settings))
    except zenoh.ZError as error:
        return _first_line(error)
    return ""


def _first_line(error: zenoh.ZError) -> str:
    """Returns the first line of an error, without its place in Zenoh's sources."""
    return re.sub(r" at /\S+:\d+\.?", "", str(error).strip().splitlines()[0])[:400]


def _endpoint_texts(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(map(str, endpoints))
