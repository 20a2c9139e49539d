"""The bus over Eclipse Zenoh; the only importer of `zenoh`.

Law: explicit endpoints and nothing else. No multicast, no gossip, no shared memory: two sessions on one
host, or on a crowded network, never meet by accident.

Three defaults of Zenoh do not suit a 1 kHz loop and are set here: a transmission queue of 2 batches (16
here: a burst of catch-up ticks must fit), a publisher that waits 1 ms for room (0: a loop never waits; the
receiver counts what was dropped), and `express`, which sends each message by itself and is left off:
batching is what makes bursts of thousands of small messages fit.
"""

import json
import re
from collections.abc import Callable, Sequence
from typing import Any

import zenoh
from zenoh import CongestionControl, Locality, Priority, handlers

from ..errors import UsageError
from .bus import RING, Inbox, Presence, Questions

LEASE_MS = 5_000
"""A stall shorter than this loses no connection, hence no message. A killed peer is seen at once by its
closed connection; a silent one by the age of its samples."""

ASK_TIMEOUT_S = 1.0


def configuration(listen: Sequence[str], connect: Sequence[str]) -> dict[str, Any]:
    """Returns the Zenoh configuration of a member of a session."""
    queue = {
        "size": dict.fromkeys(
            (
                "control",
                "real_time",
                "interactive_high",
                "interactive_low",
                "data_high",
                "data",
                "data_low",
                "background",
            ),
            16,
        ),
        "congestion_control": {"drop": {"wait_before_drop": 0}},
        "batching": {"enabled": True},
    }
    return {
        "mode": "peer",
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"open_timeout": 2_000, "accept_timeout": 2_000},
            "link": {"tx": {"lease": LEASE_MS, "keep_alive": 4, "queue": queue}},
            "shared_memory": {"enabled": False},
        },
    }


class _Ring:
    def __init__(self, subscriber: Any) -> None:
        self._try_recv = subscriber.try_recv
        self._subscriber = subscriber

    def poll(self) -> tuple[str, bytes] | None:
        sample = self._try_recv()
        return None if sample is None else (str(sample.key_expr), sample.payload.to_bytes())


class _Replies:
    def __init__(self, replies: Any) -> None:
        self._replies = replies

    def poll(self) -> tuple[str, bytes] | None:
        try:
            reply = self._replies.try_recv()
        except zenoh.ZError:  # every answer has come: the channel is closed
            return None
        if reply is None or reply.ok is None:
            return None
        return str(reply.ok.key_expr), reply.ok.payload.to_bytes()


class _PresenceRing:
    def __init__(self, subscriber: Any, own: set[str]) -> None:
        self._subscriber = subscriber
        self._own = own

    def poll(self) -> tuple[str, bool] | None:
        while (sample := self._subscriber.try_recv()) is not None:
            key = str(sample.key_expr)
            if key not in self._own:  # liveliness knows no locality: own tokens come too
                return key, sample.kind == zenoh.SampleKind.PUT
        return None


class _Question:
    def __init__(self, query: zenoh.Query, key: str) -> None:
        self._query = query
        self._key = key

    def answer(self, payload: bytes) -> None:
        with self._query as query:  # a query ends for the asker only when it is dropped
            query.reply(self._key, payload)


class _QuestionRing:
    def __init__(self, queryable: Any, key: str) -> None:
        self._queryable = queryable
        self._key = key

    def poll(self) -> _Question | None:
        query = self._queryable.try_recv()
        return None if query is None else _Question(query, self._key)


class ZenohBus:
    """A `Bus` over a Zenoh session of its own.

    Args:
        listen: endpoints to listen at, as in "tcp/127.0.0.1:7447".
        connect: endpoints to connect to, again and again until they answer.

    Raises:
        UsageError: an endpoint is malformed, or cannot be listened at.
    """

    def __init__(self, listen: Sequence[str] = (), connect: Sequence[str] = ()) -> None:
        try:
            config = zenoh.Config.from_json5(json.dumps(configuration(listen, connect)))
            self._session: Any = zenoh.open(config)
        except zenoh.ZError as error:
            raise UsageError(_open_problem(str(error), listen, connect)) from None
        self._kept: list[Any] = []
        self._tokens: set[str] = set()

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """See `Bus`."""
        publisher = self._session.declare_publisher(
            key,
            congestion_control=CongestionControl.DROP,
            priority=Priority.REAL_TIME,
            express=False,
        )
        self._kept.append(publisher)
        put: Callable[[bytes], None] = publisher.put
        return put

    def inbox(self, key: str, capacity: int = RING) -> Inbox:
        """See `Bus`."""
        return _Ring(
            self._session.declare_subscriber(
                key, handlers.RingChannel(capacity), allowed_origin=Locality.REMOTE
            )
        )

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """See `Bus`."""

        def forward(sample: zenoh.Sample) -> None:
            callback(str(sample.key_expr), sample.payload.to_bytes())

        self._kept.append(
            self._session.declare_subscriber(
                key, handlers.Callback(forward, indirect=False), allowed_origin=Locality.REMOTE
            )
        )

    def questions(self, key: str) -> Questions:
        """See `Bus`."""
        return _QuestionRing(
            self._session.declare_queryable(key, handlers.RingChannel(64), allowed_origin=Locality.REMOTE),
            key,
        )

    def ask(self, key: str) -> Inbox:
        """See `Bus`."""
        return _Replies(
            self._session.get(
                key,
                handlers.FifoChannel(256),  # a ring forgets its answers when the last one has come
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.QueryConsolidation(zenoh.ConsolidationMode.NONE),
                timeout=ASK_TIMEOUT_S,
                allowed_destination=Locality.REMOTE,
            )
        )

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.add(key)
        self._kept.append(self._session.liveliness().declare_token(key))

    def presence(self, key: str) -> Presence:
        """See `Bus`."""
        return _PresenceRing(
            self._session.liveliness().declare_subscriber(key, handlers.RingChannel(256), history=True),
            self._tokens,
        )

    def close(self) -> None:
        """See `Bus`."""
        if not self._session.is_closed():
            self._session.close()
        self._kept.clear()


def _open_problem(error: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    """Puts Zenoh's refusal to open a session into one sentence."""
    endpoints = ", ".join([*listen, *connect])
    if "in use" in error or "AddrInUse" in error:
        return (
            f"cannot listen at {', '.join(listen)}: the port is in use; "
            "end the program that has it, or choose another one with --listen tcp/127.0.0.1:PORT"
        )
    reason = re.sub(r" at /\S+:\d+\.?", "", error.splitlines()[0])[:300]
    return f"cannot open a Zenoh session with {endpoints}: {reason}"
