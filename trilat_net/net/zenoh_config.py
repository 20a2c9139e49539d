"""What a session needs of Zenoh.

Law: explicit endpoints and nothing else. No multicast, no gossip, no shared memory: two sessions on one
host, or on a crowded network, never meet by accident.

Three defaults of Zenoh do not suit a 1 kHz loop: a transmission queue of 2 batches (16 here: a burst of
catch-up ticks must fit), a publisher that waits 1 ms for room (0: a loop never waits; the receiver counts
what was dropped), and `express`, which sends each message by itself and is left off: batching is what
makes bursts of thousands of small messages fit.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

LEASE_MS = 5_000
"""A stall shorter than this loses no connection, hence no message. A killed peer is seen at once by its
closed connection; a silent one by the age of its samples."""

BATCHES, BATCH_BYTES = 16, 65_535

Mode = Literal["peer", "client", "router"]
Endpoint = str | Mapping[str, Any]
"""As in "tcp/127.0.0.1:7447", or one of Zenoh's groups of locators."""

QUEUES = (
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
)
"""Zenoh's queues of a link, by priority."""


def configuration(
    listen: Sequence[Endpoint],
    connect: Sequence[Endpoint],
    mode: Mode = "peer",
    own: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Returns the Zenoh configuration of a member of a session.

    Args:
        listen: where it listens.
        connect: where it connects to; a client takes the first that answers.
        mode: what it is to Zenoh.
        own: the `settings` of a `ZenohFile`.
    """
    tries = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    needed: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            # a client's session opens with its router; where that is not there yet, `open_bus` tries again
            "timeout_ms": 0 if mode == "client" else -1,
            "exit_on_failure": mode == "client",
            "retry": tries,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"open_timeout": 2_000, "accept_timeout": 2_000},
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "keep_alive": 4,
                    "batch_size": BATCH_BYTES,
                    "queue": {
                        "size": dict.fromkeys(QUEUES, BATCHES),
                        "congestion_control": {"drop": {"wait_before_drop": 0}},
                        "batching": {"enabled": True},
                    },
                }
            },
            "shared_memory": {"enabled": False},
        },
    }
    return _merged(needed, own or {})


def _merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in own.items():
        under = both.get(key)
        both[key] = _merged(under, value) if isinstance(under, dict) and isinstance(value, dict) else value
    return both
