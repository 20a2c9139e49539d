"""Implements the network connection of a process (`Bus`) with the library Eclipse Zenoh.

Zenoh transports published messages, queries and replies between the processes of a session.
Only this module and `ros2_graph` import `zenoh`.

Invariant:
    - No method waits for the network, because the methods are called by the control loop of an
      arm.
    - If the network cannot keep up, a publisher drops messages instead of delaying its caller.
      Only publishers that were opened as patient wait.
    - Replies to a query are collected in a queue that the caller polls.
    - If a connection cannot be opened yet, an error is raised. The caller decides whether to
      try again.
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

from ..errors import SessionError, UsageError, count_nouns
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
from .zenoh_config import Endpoint, ZenohFile, ZenohMode, make_zenoh_config

_QUERY_TIMEOUT_S = 3.0
"""Time after which Zenoh discards a query that has received no replies, in s."""
_SHARED_POOL = (
    "(rx:(worker_threads:4),tx:(handover:rx),acc:(handover:rx),"
    "net:(handover:rx),app:(handover:rx))"
)
"""Zenoh's runtime setting that makes its five thread pools share the threads of one pool."""
MAX_DEPTH = 100
"""Maximum nesting depth of a user's Zenoh file.

Deeper nesting would overflow the stack of Zenoh's recursive parser.
"""


T = TypeVar("T")


def share_threads() -> None:
    """Makes Zenoh use one thread pool instead of five in sessions opened from now on.

    With several pools, threads in different pools wake each other up for every message, which
    costs time. One thread would be enough for the work, but the pool has four threads, because
    closing a connection can block a thread for up to 10 s if the peer never received the last
    bytes (eclipse-zenoh/zenoh#1101). The remaining threads then keep serving the other members.

    A router must not call this function. If the output queue of a router is full, the router
    blocks the thread that reads, and needs another pool to empty the queue.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _SHARED_POOL)


class RouterSilent(SessionError):  # noqa: N818 - it names an outcome
    """Error: the Zenoh router to which a process connects does not answer.

    The caller may try again, because the router may be started later.
    """


class _ZenohRing(Generic[T]):
    """Queue of objects received by Zenoh, such as messages, replies or tokens.

    Objects are converted when they are polled, not when they arrive.

    Args:
        channel: Zenoh channel in which the objects arrive.
        read: Function that converts an object to an entry. If it returns None, the object is
            skipped.
    """

    def __init__(self, channel: Any, read: Callable[[Any], T | None]) -> None:
        self._channel = channel
        self._try_recv = channel.try_recv
        self._read = read

    def poll(self) -> T | None:
        """Removes and returns the oldest usable entry, or returns None if there is none.

        An entry is a message or a reply. Entries for which `read` returns None, such as error
        replies, are skipped. Zenoh closes the queue of a query after the last reply; None is
        then returned as well.
        """
        try:
            while (received := self._try_recv()) is not None:
                entry = self._read(received)
                if entry is not None:
                    return entry
        except zenoh.ZError:
            pass  # all replies to a query have arrived, so the channel is closed
        return None


def _make_sample_handler(receive: Callable[[Any], None]) -> Any:
    """Returns a Zenoh handler that calls a function with every message, in threads of Zenoh.

    The handler also makes these calls cheaper. CPython keeps a data structure for each thread
    that runs Python code. Because Zenoh's threads are not created by Python, CPython creates
    the structure at the beginning of each call and deletes it at the end, which costs more than
    the call itself. The structure is deleted when the thread has left the interpreter as often
    as it has entered it. The handler therefore enters the interpreter one extra time in each
    thread and never leaves it, which keeps the structure.

    Args:
        receive: Function that receives each message.
    """
    thread_locals = threading.local()

    def handle(sample: Any) -> None:
        """Calls `receive` with a message, and makes later calls in this thread cheaper.

        The first call in a thread enters the interpreter one extra time without leaving it,
        which makes CPython keep its data structure for the thread.
        """
        receive(sample)
        is_first_call_in_thread = not hasattr(thread_locals, "kept_state")
        if is_first_call_in_thread:
            # There is deliberately no matching call of PyGILState_Release.
            thread_locals.kept_state = ctypes.pythonapi.PyGILState_Ensure()

    return handlers.Callback(handle, indirect=False)


def _read_sample(sample: Any) -> tuple[str, bytes]:
    """Returns the key and the payload of a published message."""
    return str(sample.key_expr), sample.payload.to_bytes()


class _ZenohQuery(NamedTuple):
    """A query from another process, received through Zenoh, that is waiting for a reply.

    Implements the interface `Query` from `bus`. The key is the address of the reply.
    """

    query: zenoh.Query
    key: str

    @property
    def payload(self) -> bytes:
        """Content of the query, as encoded by its sender. Empty if the query has no content."""
        return b"" if self.query.payload is None else self.query.payload.to_bytes()

    def reply(self, payload: bytes) -> None:
        """Replies to the query, which completes it for the sender. Only one reply is possible.

        Args:
            payload: The encoded reply.
        """
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
    """Opens a Zenoh session with the settings of `make_zenoh_config`.

    Args:
        listen: Endpoints on which the session listens.
        connect: Endpoints to which the session connects.
        mode: "peer" to connect to members directly, "client" to connect to a router, or
            "router" to act as a router.
        settings: Settings that override those of this program, from the user's file or from
            keys.
        silent: Error message if no router answers, with {} in place of the endpoints.

    Raises:
        UsageError: An endpoint is malformed, or the session cannot listen on it.
        RouterSilent: The session is a client, and no router answers.
    """
    # Zenoh logs only if the environment variable RUST_LOG is set.
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
    config = json.dumps(make_zenoh_config(listen, connect, mode, settings))
    try:
        return zenoh.open(zenoh.Config.from_json5(config))
    except zenoh.ZError as error:
        # Zenoh has one class of errors. They can be distinguished only by their texts.
        message = str(error)
        if mode == "client" and "Unable to connect" in message:
            raise RouterSilent(silent.format(_endpoint_texts(connect))) from None
        if "in use" in message or "AddrInUse" in message:
            raise UsageError(
                f"cannot listen on {_endpoint_texts(listen)}: the port is in use; "
                "end the program that uses it, or choose another port with "
                "--listen tcp/127.0.0.1:PORT"
            ) from None
        endpoints = _endpoint_texts([*listen, *connect])
        raise UsageError(
            f"cannot open a Zenoh session with {endpoints}: {_first_line(error)}"
        ) from None


class ZenohBus:
    """Network connection of a member over its own Zenoh session, see `Bus`.

    In the modes "peer" and "router", the session keeps trying until all endpoints answer. A
    client connects immediately to the first endpoint that answers, and reconnects when the
    connection is lost. A peer reaches the members to which it is connected. A client or a
    router reaches all members that can be reached through the router.

    Args:
        listen: Endpoints on which the session listens.
        connect: Endpoints to which the session connects.
        mode: "peer" to connect to members directly, "client" to connect to a router, or
            "router" to act as a router.
        settings: Settings that override those of this program, from the user's file or from
            keys.

    Raises:
        UsageError: An endpoint is malformed, or the session cannot listen on it.
        RouterSilent: The session is a client, and no router answers.
    """

    def __init__(
        self,
        listen: Sequence[Endpoint] = (),
        connect: Sequence[Endpoint] = (),
        mode: ZenohMode = "peer",
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        """Connects this process to the other processes of its network through Zenoh."""
        other_reason = ", or no router accepts this member" if settings else ""
        self._session = open_zenoh(
            listen=listen,
            connect=connect,
            mode=mode,
            settings=settings,
            silent=f"no router answers at {{}}{other_reason}",
        )
        self._declarations: list[Any] = []  # Zenoh undeclares an object that is not referenced
        self._tokens: set[str] = set()

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes payloads under a key.

        Args:
            key: The key, without wildcards.
            patient: If True, the function waits while the network cannot keep up; if False, it
                drops the message. A receiver that blocks a patient publisher for 5 s loses its
                connection.
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
        """Subscribes to messages through Zenoh, excluding those published by this connection.

        Args:
            key: Key of the messages; it may contain wildcards.
            handler: Zenoh handler that receives the messages.
        """
        return self._session.declare_subscriber(key, handler, allowed_origin=Locality.REMOTE)

    def _serve(self, key: str, handler: Any) -> Any:
        """Starts receiving queries through Zenoh, excluding those sent by this connection.

        Args:
            key: Key of the queries.
            handler: Zenoh handler that receives the queries.
        """
        return self._session.declare_queryable(key, handler, allowed_origin=Locality.REMOTE)

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a queue of the messages that other processes publish under a key.

        Args:
            key: The key, which may contain wildcards.
            capacity: Number of messages that the queue can hold. If it is full, the oldest
                message is dropped.
        """
        return _ZenohRing(self._subscribe(key, handlers.RingChannel(capacity)), _read_sample)

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a queue of decoded network messages, each with its time of arrival.

        Args:
            key: Key under which the messages are published. It may contain wildcards.
            now_ns: Function that reads the local clock, in ns.
            read: Function that decodes a payload in a thread of Zenoh. It must not raise an
                error.
            capacity: Number of messages that the queue can hold. If it is full, the oldest
                message is dropped.
        """
        ring = StampingRing(now_ns, read, capacity)
        receive = ring.receive  # looked up once, not for every message
        handler = _make_sample_handler(lambda sample: receive(sample.payload.to_bytes()))
        self._declarations.append(self._subscribe(key, handler))
        return ring

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls a function for each message under a key, immediately and in a thread of Zenoh.

        Args:
            key: The key, which may contain wildcards.
            callback: Function that receives the key and the payload of a message.
        """
        handler = _make_sample_handler(lambda sample: callback(*_read_sample(sample)))
        self._declarations.append(self._subscribe(key, handler))

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a queue of the queries that other members send under a key.

        The caller polls the queue and replies when it has time.

        Args:
            key: The key, which may contain wildcards.
        """
        # Polling a Python ring costs a loop less than polling a ring of Zenoh.
        ring: BoundedRing[_ZenohQuery] = BoundedRing(64)
        handler: Any = handlers.Callback(
            lambda query: ring.put(_ZenohQuery(query, key)), indirect=False
        )
        self._declarations.append(self._serve(key, handler))
        return ring

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Answers queries under a key immediately, in a thread of Zenoh.

        Args:
            key: Key of the queries, which may contain wildcards.
            answer: Function that receives the payload of a query and returns the payload of the
                reply. If it returns None, no reply is sent.
        """

        def answer_at_once(query: zenoh.Query) -> None:
            """Answers a query in the thread of Zenoh in which it arrived.

            No reply is sent if `answer` returns None.
            """
            # A query ends for its sender only when the query object is dropped.
            with query:
                payload = answer(_ZenohQuery(query, key).payload)
                if payload is not None:
                    query.reply(key, payload)

        self._declarations.append(
            self._serve(key, handlers.Callback(answer_at_once, indirect=False))
        )

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Sends a query to other processes, and returns a queue for their replies.

        Args:
            key: Key of the query. Every member that serves a matching key replies.
            payload: Payload of the query.
        """
        # A ring channel is not used, because it loses its replies when the last reply has
        # arrived.
        replies = self._session.get(
            key,
            handlers.FifoChannel(256),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE),
            timeout=_QUERY_TIMEOUT_S,
            allowed_destination=Locality.REMOTE,
            payload=payload,
            # Replies inherit these settings, so that no member waits for a receiver that hangs.
            congestion_control=CongestionControl.DROP,
            priority=Priority.REAL_TIME,
        )
        return _ZenohRing(
            replies, lambda reply: None if reply.ok is None else _read_sample(reply.ok)
        )

    def announce(self, key: str) -> None:
        """Announces this process to the other members until its connection ends.

        Args:
            key: Key of the liveliness token through which other members see this member.
        """
        self._tokens.add(key)
        self._declarations.append(self._session.liveliness().declare_token(key))

    def presence(self, key: str) -> PresenceInbox:
        """Returns a queue that reports which other members have appeared or disappeared.

        An entry consists of the key of a member's liveliness token and a flag, which is True if
        the token has appeared and False if it has disappeared. Tokens that already exist are
        reported first. The tokens of this connection are left out.

        Args:
            key: Key of the tokens, which may contain wildcards.
        """

        def read(sample: zenoh.Sample) -> tuple[str, bool] | None:
            """Determines from a Zenoh sample which process has appeared or disappeared.

            Returns:
                The key of the token, and True if it has appeared. None for a token of this
                connection.
            """
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
        """Closes the network connection of Zenoh. Repeated calls have no effect."""
        if not self._session.is_closed():
            self._session.close()
        self._declarations.clear()


def read_zenoh_file(path: Path) -> ZenohFile:
    """Reads a user's Zenoh configuration from a JSON5 or JSON file, and checks it.

    Args:
        path: Path of the file.

    Returns:
        The settings from the file, which are suitable for a session.

    Raises:
        UsageError: The file cannot be read, is not a Zenoh configuration, or contradicts the
            requirements of a session.
    """
    try:
        with reading(path, UsageError) as stream:
            text = stream.read().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise UsageError(f"{path} is not UTF-8 text") from None
    return ZenohFile.check(str(path), _parse_json5(str(path), text), _find_refusal)


def _parse_json5(source: str, text: str) -> object:
    """Parses JSON5 with the parser built into Zenoh.

    Zenoh can only parse complete configurations. The text is therefore embedded in a
    configuration under the key `metadata`, which may have any value.

    Args:
        source: Name of the file, for error messages.
        text: Content of the file.

    Returns:
        The parsed object, which is a dict if the text is a configuration.

    Raises:
        UsageError: The text is not JSON5, is nested too deeply, or contains several objects.
    """
    # Each opening bracket increases the nesting by 1, and each closing bracket decreases it.
    changes = {"[": 1, "{": 1, "]": -1, "}": -1}
    nesting = accumulate(changes.get(character, 0) for character in text)
    if max(nesting, default=0) > MAX_DEPTH:
        raise UsageError(f"{source}: not valid JSON5: nested more than {MAX_DEPTH} levels deep")

    try:
        config = zenoh.Config.from_json5(f"{{metadata: [\n{text}\n]}}")
    except zenoh.ZError as error:
        position = ""
        position_match = re.search(r"--> (\d+):(\d+)", str(error))
        if position_match:
            line, column = position_match.groups()
            # The text begins in the second line of what Zenoh parses.
            position = f"line {int(line) - 1}, column {column}: "
        reason_match = re.search(r"= (expected .*)", str(error))
        reason = reason_match[1] if reason_match else _first_line(error)
        raise UsageError(f"{source}: {position}not valid JSON5: {reason}") from None

    objects: list[object] = json.loads(config.get_json("metadata"))
    if len(objects) != 1:
        raise UsageError(
            f"{source}: a Zenoh configuration must be a single object in braces, but this file "
            f"has {count_nouns(len(objects), 'object')}"
        )
    return objects[0]


def _find_refusal(settings: Mapping[str, Any]) -> str:
    """Returns Zenoh's reason for rejecting a configuration, or an empty string if it is valid.

    Args:
        settings: The configuration, or a part of it.
    """
    try:
        zenoh.Config.from_json5(json.dumps(settings))
    except zenoh.ZError as error:
        return _first_line(error)
    return ""


def _first_line(error: zenoh.ZError) -> str:
    """Returns the first line of a Zenoh error, for use as the reason in a message to the user.

    The position in Zenoh's source code is removed, and a very long line is cut after 400
    characters.
    """
    return re.sub(r" at /\S+:\d+\.?", "", str(error).strip().splitlines()[0])[:400]


def _endpoint_texts(endpoints: Sequence[Endpoint]) -> str:
    """Joins endpoints into one string for messages: "tcp/127.0.0.1:7447, tcp/10.0.0.2:7447"."""
    return ", ".join(map(str, endpoints))
