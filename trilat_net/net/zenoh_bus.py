"""The bus over Eclipse Zenoh; only it and `ros2_graph` import `zenoh`.

Invariant: nothing here waits for the network. A publisher drops a message rather than delay its
caller (except a patient one), queries go into a ring, and a session that cannot open yet raises
an error.
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

ASK_TIMEOUT_S = 3.0
ONE_POOL = "(rx:(worker_threads:4),tx:(handover:rx),acc:(handover:rx),net:(handover:rx),app:(handover:rx))"
MAX_DEPTH = 100
"""Nesting of a configuration; Zenoh's recursive parser overflows its stack on deep nesting."""


T = TypeVar("T")


def share_threads() -> None:
    """Puts all of Zenoh into one pool from the first session on, not five, whose threads wake
    one another.

    One thread of it does the work. Where a connection is closed with bytes that its peer never
    took, closing holds a thread for up to 10 s (eclipse-zenoh/zenoh#1101); the others then
    serve the other members. Not for a router: it waits for room where it reads, and needs a
    thread that sends meanwhile.
    """
    os.environ.setdefault("ZENOH_RUNTIME", ONE_POOL)


class RouterSilent(SessionError):  # noqa: N818 - it names an outcome
    """A router that does not answer, or not yet."""


class _ZenohRing(Generic[T]):
    """A ring of Zenoh's; `read` turns what it holds into an entry, or into None, which is
    passed over.
    """

    def __init__(self, source: Any, read: Callable[[Any], T | None]) -> None:
        self._source = source
        self._try_recv = source.try_recv
        self._read = read

    def poll(self) -> T | None:
        try:
            while (received := self._try_recv()) is not None:
                if (entry := self._read(received)) is not None:
                    return entry
        except zenoh.ZError:  # every answer to a query has arrived: the channel is closed
            pass
        return None


def _handle_samples(take: Callable[[Any], None]) -> Any:
    """Returns a handler that calls `take` in Zenoh's threads, each of which keeps its Python
    state.

    Else CPython makes that state anew for every message, and unmaps it. A thread asks for the
    interpreter once more than it gives it back, so its state lives as long as the process.
    """
    kept = threading.local()

    def handle(sample: Any) -> None:
        take(sample)
        if not hasattr(kept, "state"):
            kept.state = ctypes.pythonapi.PyGILState_Ensure()

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
        with self.query as query:  # a query ends for its sender only when it is dropped
            query.reply(self.key, payload)


def open_zenoh(
    listen: Sequence[Endpoint],
    connect: Sequence[Endpoint],
    mode: ZenohMode,
    own: Mapping[str, Any] | None,
    silent: str,
) -> Any:
    """Returns a Zenoh session with the settings of `make_zenoh_config`.

    Raises:
        UsageError: an endpoint is malformed, or cannot be listened at.
        RouterSilent: a client's router does not answer: the text `silent`, with the endpoints
            in place of {}.
    """
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # logs nothing without RUST_LOG
    try:
        return zenoh.open(
            zenoh.Config.from_json5(json.dumps(make_zenoh_config(listen, connect, mode, own)))
        )
    except zenoh.ZError as error:
        if mode == "client" and "Unable to connect" in str(error):
            raise RouterSilent(silent.format(_endpoint_texts(connect))) from None
        if "in use" in str(error) or "AddrInUse" in str(error):
            raise UsageError(
                f"cannot listen at {_endpoint_texts(listen)}: the port is in use; "
                "end the program that has it, or choose another one with --listen tcp/127.0.0.1:PORT"
            ) from None
        places = _endpoint_texts([*listen, *connect])
        raise UsageError(
            f"cannot open a Zenoh session with {places}: {_first_line(error)}"
        ) from None


class ZenohBus:
    """A `Bus` over a Zenoh session of its own, with the settings of a user's file.

    It connects again and again until all endpoints answer; a client connects to the first that
    answers now, and again if it loses it. Peers reach those that they connect to, clients and
    routers all that a router reaches.

    Raises:
        UsageError: an endpoint is malformed, or cannot be listened at.
        RouterSilent: a client's router does not answer.
    """

    def __init__(
        self,
        listen: Sequence[Endpoint] = (),
        connect: Sequence[Endpoint] = (),
        mode: ZenohMode = "peer",
        own: Mapping[str, Any] | None = None,
    ) -> None:
        refused = ", or none lets this member in" if own else ""
        self._session = open_zenoh(
            listen=listen,
            connect=connect,
            mode=mode,
            own=own,
            silent=f"no router answers at {{}}{refused}",
        )
        self._kept: list[Any] = []
        self._tokens: set[str] = set()

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """See `Bus`; a receiver that blocks a patient publisher for 5 s loses its connection."""
        publisher = self._session.declare_publisher(
            key,
            congestion_control=CongestionControl.BLOCK if patient else CongestionControl.DROP,
            priority=Priority.REAL_TIME,
            express=False,
            allowed_destination=Locality.REMOTE,
        )
        self._kept.append(publisher)
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
        take = ring.receive
        handler = _handle_samples(lambda sample: take(sample.payload.to_bytes()))
        self._kept.append(self._subscribe(key, handler))
        return ring

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """See `Bus`."""
        handler = _handle_samples(lambda sample: callback(*_read_sample(sample)))
        self._kept.append(self._subscribe(key, handler))

    def query_inbox(self, key: str) -> QueryInbox:
        """See `Bus`; a look into a ring of our own costs a loop less than one into Zenoh's."""
        ring: BoundedRing[_ZenohQuery] = BoundedRing(64)
        handler: Any = handlers.Callback(
            lambda query: ring.put(_ZenohQuery(query, key)), indirect=False
        )
        self._kept.append(self._serve(key, handler))
        return ring

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """See `Bus`."""

        def answer_at_once(query: zenoh.Query) -> None:
            with query:  # a query ends for its sender only when it is dropped
                payload = answer(_ZenohQuery(query, key).payload)
                if payload is not None:
                    query.reply(key, payload)

        self._kept.append(self._serve(key, handlers.Callback(answer_at_once, indirect=False)))

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """See `Bus`."""
        replies = self._session.get(
            key,
            handlers.FifoChannel(
                256
            ),  # a ring forgets its answers when the last one has arrived
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE),
            timeout=ASK_TIMEOUT_S,
            allowed_destination=Locality.REMOTE,
            payload=payload,
            # answers inherit these: no member that answers waits for a receiver that hangs
            congestion_control=CongestionControl.DROP,
            priority=Priority.REAL_TIME,
        )
        return _ZenohRing(
            replies, lambda reply: None if reply.ok is None else _read_sample(reply.ok)
        )

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.add(key)
        self._kept.append(self._session.liveliness().declare_token(key))

    def presence(self, key: str) -> PresenceInbox:
        """See `Bus`."""

        def read(sample: zenoh.Sample) -> tuple[str, bool] | None:
            token = str(sample.key_expr)  # liveliness has no locality: own tokens arrive too
            return (
                None if token in self._tokens else (token, sample.kind == zenoh.SampleKind.PUT)
            )

        tokens = self._session.liveliness().declare_subscriber(
            key, handlers.RingChannel(256), history=True
        )
        return _ZenohRing(tokens, read)

    def close(self) -> None:
        """See `Bus`."""
        if not self._session.is_closed():
            self._session.close()
        self._kept.clear()


def read_zenoh_file(path: Path) -> ZenohFile:
    """Returns a user's Zenoh configuration, a file in JSON5 or JSON.

    Raises:
        UsageError: it cannot be read, is no configuration, or contradicts what a session needs.
    """
    try:
        with reading(path, UsageError) as stream:
            text = stream.read().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is no text in UTF-8") from None
    return check_zenoh_file(str(path), _parse_json5(str(path), text), _find_refusal)


def _parse_json5(source: str, text: str) -> object:
    """Parses JSON5 with Zenoh's own parser: its `metadata` may be anything."""
    if max(accumulate((c in "[{") - (c in "]}") for c in text), default=0) > MAX_DEPTH:
        raise UsageError(f"{source}: no JSON5: nested deeper than {MAX_DEPTH}")
    try:
        config = zenoh.Config.from_json5(f"{{metadata: [\n{text}\n]}}")
    except zenoh.ZError as error:
        place = re.search(r"--> (\d+):(\d+)", str(error))
        expected = re.search(r"= (expected .*)", str(error))
        where = f"line {int(place[1]) - 1}, column {place[2]}: " if place else ""
        raise UsageError(
            f"{source}: {where}no JSON5: {expected[1] if expected else _first_line(error)}"
        ) from None
    objects: list[object] = json.loads(config.get_json("metadata"))
    if len(objects) != 1:
        raise UsageError(
            f"{source}: a Zenoh configuration is one object in braces; here are {len(objects)}"
        )
    return objects[0]


def _find_refusal(settings: Mapping[str, Any]) -> str:
    try:
        zenoh.Config.from_json5(json.dumps(settings))
    except zenoh.ZError as error:
        return _first_line(error)
    return ""


def _first_line(error: zenoh.ZError) -> str:
    return re.sub(r" at /\S+:\d+\.?", "", str(error).strip().splitlines()[0])[:400]


def _endpoint_texts(endpoints: Sequence[Endpoint]) -> str:
    return ", ".join(map(str, endpoints))
