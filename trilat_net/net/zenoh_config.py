"""The Zenoh configuration of a session member, what each may send and hear, and checks of a
user's own file.

Invariant:
    - Explicit endpoints only, no multicast, gossip or shared memory, so two sessions on one
      host never meet by accident.
    - No setting of a user's file is overruled silently: it is taken, or refused with its key,
      its value and the value required. A setting that a session makes itself is taken if it has
      the session's value.
    - A file is refused once, with all its settings that contradict a session.

Three defaults of Zenoh do not suit a 1 kHz loop: a transmission queue of 2 batches (16 here,
for bursts of catch-up ticks), a publisher that waits 1 ms for room (0 here: the loop never
waits and the receiver counts drops), and `express`, which sends each message by itself; it
stays off because batching makes bursts of thousands of small messages fit.

What a member may send, hear, ask and answer are rules of Zenoh's access control: everything
that is not named is denied, at every member and at routers. A member speaks under its own name
alone: its links show a certificate, and the name in it is the one that stands in its keys. A
router carries what others said; it is trusted with all of it. Sizes are limited here, rates are
not: Zenoh would thin out bursts, in which samples of ticks that are made up for arrive, and
events of one tick.
"""

import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..errors import UsageError, count_nouns
from ..files import open_regular
from . import topics

LEASE_MS = 5_000
"""A stall shorter than this loses no connection, hence no message. A killed peer is seen at
once by its closed connection; a silent one by the age of its samples.
"""

BATCHES = 16
BATCH_BYTES = 65_535
MOST_PUT_BYTES = 262_144
MOST_QUERY_BYTES = 65_536
"""The largest messages that a link takes: ten records of the longest arms; an order."""

ZenohMode = Literal["peer", "client", "router"]
Endpoint = str | Mapping[str, Any]
"""As in "tcp/127.0.0.1:7447", or one of Zenoh's groups of locators."""

QUEUES = [
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
]
"""Zenoh's queues of a link, by priority."""


CONNECT_TIMEOUT_MS = {"router": -1, "peer": -1, "client": 0}
"""A client's session opens with its router; where that is not there yet, `open_bus` tries
again.
"""
CONNECT_EXIT_ON_FAILURE = {"router": False, "peer": False, "client": True}
LISTEN_TIMEOUT_MS = {"router": 0, "peer": 0, "client": 0}
"""Zenoh's default, which a session leaves as it is."""
LISTEN_EXIT_ON_FAILURE = {"router": True, "peer": True, "client": True}


def limit_sizes(name: str, messages: list[str], size: int) -> dict[str, Any]:
    """Returns the setting of Zenoh by which a member drops longer messages of others."""
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": messages,
        "key_exprs": ["**"],
        "size_limit": size,
    }


SIZE_LIMITS = [
    limit_sizes("puts", ["put", "delete"], MOST_PUT_BYTES),
    limit_sizes("queries", ["query"], MOST_QUERY_BYTES),
]


def make_zenoh_config(
    listen: Sequence[Endpoint],
    connect: Sequence[Endpoint],
    mode: ZenohMode = "peer",
    own: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Returns the Zenoh configuration of a session member, with the `settings` of a
    `ZenohFile`.
    """
    tries = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    needed: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": list(listen), "exit_on_failure": LISTEN_EXIT_ON_FAILURE[mode]},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": CONNECT_TIMEOUT_MS[mode],
            "exit_on_failure": CONNECT_EXIT_ON_FAILURE[mode],
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
        "low_pass_filter": SIZE_LIMITS,
    }
    return merge_settings(needed, own or {})


def merge_settings(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Returns settings with those of `own` in place of what they name."""
    both = dict(base)
    for key, value in own.items():
        under = both.get(key)
        both[key] = (
            merge_settings(under, value)
            if isinstance(under, dict) and isinstance(value, dict)
            else value
        )
    return both


_Requirement = tuple[Callable[[Any], bool], str]
"""Whether the value of a key in a user's file will do, and what it must be."""


def _exactly(value: object, must: str) -> _Requirement:
    return (lambda stated: stated == value and isinstance(stated, type(value)), must)


def _at_least(least: int, must: str) -> _Requirement:
    return (lambda stated: isinstance(stated, int) and stated >= least, must)


def _as_used(used: Mapping[str, Any]) -> _Requirement:
    """Returns the requirement of a key that a session sets itself, by the mode of the member.

    A file states it for a mode each, or once for the file's own mode (`_expand_mode`).
    """

    def is_used(stated: Any) -> bool:
        return isinstance(stated, dict) and all(
            mode in used and value == used[mode] and type(value) is type(used[mode])
            for mode, value in stated.items()
        )

    values = ", ".join(f"{mode} {json.dumps(value)}" for mode, value in used.items())
    return is_used, f"left out, or as a session sets it itself: {values}"


_NAMED = _exactly(False, "false: members meet at named endpoints and nowhere else")
_UNTOUCHED = _exactly([], "empty: it would change or thin out a session's messages")
_TX = "transport/link/tx"

REQUIREMENTS: Mapping[str, _Requirement] = {
    "connect/timeout_ms": _as_used(CONNECT_TIMEOUT_MS),
    "connect/exit_on_failure": _as_used(CONNECT_EXIT_ON_FAILURE),
    "listen/timeout_ms": _as_used(LISTEN_TIMEOUT_MS),
    "listen/exit_on_failure": _as_used(LISTEN_EXIT_ON_FAILURE),
    "scouting/multicast/enabled": _NAMED,
    "scouting/gossip/enabled": _NAMED,
    **{
        f"{_TX}/queue/size/{queue}": _at_least(
            BATCHES, f"{BATCHES}: a burst of catch-up ticks must fit into the queue"
        )
        for queue in QUEUES
    },
    f"{_TX}/queue/congestion_control/drop/wait_before_drop": _exactly(
        0, "0: a loop never waits for room"
    ),
    f"{_TX}/queue/batching/enabled": _exactly(
        True, "true: without batches a burst of catch-up ticks does not fit into the queue"
    ),
    f"{_TX}/batch_size": _at_least(
        BATCH_BYTES, f"{BATCH_BYTES}: a burst of catch-up ticks must fit"
    ),
    f"{_TX}/lease": _at_least(
        LEASE_MS, f"{LEASE_MS} or more: a stall shorter than that loses no message"
    ),
    "transport/unicast/lowlatency": _exactly(
        False, "false: it sends in the loop, without a queue"
    ),
    "transport/shared_memory/enabled": _exactly(
        False, "false: a receiver that stalls would lose messages"
    ),
    "qos/publication": _UNTOUCHED,
    "qos/network": _UNTOUCHED,
    "downsampling": _UNTOUCHED,
    "low_pass_filter": (
        lambda stated: stated in ([], SIZE_LIMITS),
        "left out: a session sets it",
    ),
}
"""Requirements of a session by the path of the key in Zenoh's configuration."""

_FILES = r"transport/(link/tls/\w+_(certificate|private_key)|auth/usrpwd/dictionary_file)"
"""Keys that name files. Zenoh opens those of a connecting side late, and then retries for ever.
"""


@dataclass(frozen=True, slots=True)
class ZenohFile:
    """A user's Zenoh configuration, checked: its mode, or "", its endpoints, and its other
    settings.
    """

    source: str
    mode: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    _endpoints: Mapping[str, Any] = field(default_factory=dict)

    def endpoints(
        self, side: Literal["listen", "connect"], mode: ZenohMode
    ) -> list[Endpoint] | None:
        """Returns its endpoints for a mode, or None without any."""
        stated = self._endpoints.get(side)
        if isinstance(stated, dict) and "locators" not in stated:
            stated = stated.get(mode)
        if stated is None:
            return None
        return list(stated) if isinstance(stated, list) else [stated]


def check_zenoh_file(
    source: str, stated: object, refusal: Callable[[Mapping[str, Any]], str]
) -> ZenohFile:
    """Checks the content of a user's file; `refusal` returns Zenoh's reason for refusing
    settings, or "".

    Raises:
        UsageError: it is no Zenoh configuration, or contradicts requirements of a session; the
            message has every key that does so.
    """
    if not isinstance(stated, dict):
        raise UsageError(f"{source}: a Zenoh configuration is one object in braces")
    settings = _without_nulls(stated)
    if reason := refusal(settings):
        refused = list(_find_refused_keys(settings, refusal, ()))
        problems = [f"{'/'.join(path)}: {_suggest_key(path, why)}" for path, why in refused]
        raise UsageError(_list_problems(source, problems or [reason]))
    if problems := list(_find_problems(settings)):
        raise UsageError(_list_problems(source, problems))
    for path in (*_SET_BY_MODE, "low_pass_filter"):
        _drop_key(settings, path)  # it says what a session does by itself
    mode = settings.pop("mode", "")
    endpoints = {
        side: settings[side].pop("endpoints")
        for side in ("listen", "connect")
        if "endpoints" in settings.get(side, {})
    }
    return ZenohFile(source, mode, settings, endpoints)


def _list_problems(source: str, problems: Sequence[str]) -> str:
    """Returns the problems of a file in one line."""
    if len(problems) == 1:
        return f"{source}: {problems[0]}"
    return f"{source}: {count_nouns(len(problems), 'setting')} cannot be taken: {'; '.join(problems)}"


def _find_problems(settings: Mapping[str, Any]) -> Iterator[str]:
    """Yields what contradicts a requirement of a session, each with its key."""
    for key, value in _leaves(settings, ()):
        compared = _expand_mode(settings, value) if key in _SET_BY_MODE else value
        need = REQUIREMENTS.get(key)
        if need is not None and not need[0](compared):
            text = json.dumps(value)
            shown = text if len(text) <= 60 else f"{text[:57]}..."
            yield f"{key}: {shown} must be {need[1]}"
        if re.fullmatch(_FILES, key):
            try:
                open_regular(Path(str(value))).close()
            except OSError as error:
                yield f"{key}: {value} cannot be read: {error.strerror}"
    if settings.get("access_control") and "enabled" not in settings["access_control"]:
        yield "access_control: has no `enabled: true`, without which Zenoh lets everybody in"


_SET_BY_MODE = (
    "connect/timeout_ms",
    "connect/exit_on_failure",
    "listen/timeout_ms",
    "listen/exit_on_failure",
)
"""Keys that a session sets itself, by the mode of the member."""


def _expand_mode(settings: Mapping[str, Any], value: Any) -> Any:
    """Returns the value of a key by mode: one that is stated once is that of the file's mode,
    or of peers.
    """
    return value if isinstance(value, dict) else {settings.get("mode", "peer"): value}


def _drop_key(settings: dict[str, Any], path: str) -> None:
    *folders, last = path.split("/")
    for folder in folders:
        settings = settings.get(folder, {})
    settings.pop(last, None)


def _without_nulls(stated: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _without_nulls(value) if isinstance(value, dict) else value
        for key, value in stated.items()
        if value is not None
    }


def _leaves(settings: Mapping[str, Any], path: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    for key, value in settings.items():
        here = (*path, key)
        if isinstance(value, dict) and "/".join(here) not in REQUIREMENTS:
            yield from _leaves(value, here)
        else:
            yield "/".join(here), value


def _find_refused_keys(
    settings: Mapping[str, Any],
    refusal: Callable[[Mapping[str, Any]], str],
    path: tuple[str, ...],
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yields every key that Zenoh refuses by itself, as deep as it goes, with Zenoh's reason."""
    for key, value in settings.items():
        here = (*path, key)
        alone: Any = value
        for part in reversed(here):
            alone = {part: alone}
        if reason := refusal(alone):
            deeper = (
                list(_find_refused_keys(value, refusal, here))
                if isinstance(value, dict)
                else []
            )
            yield from deeper or [(here, reason)]


def _suggest_key(path: Sequence[str], reason: str) -> str:
    unknown = re.match(r"unknown field `([^`]*)`, expected (?:one of )?(.*)", reason)
    if unknown is None or not path or unknown[1] != path[-1]:
        return reason
    near = difflib.get_close_matches(unknown[1], re.findall(r"`([^`]*)`", unknown[2]), 1)
    choice = f"did you mean {near[0]}?" if near else f"there are {unknown[2].replace('`', '')}"
    return f"no key of Zenoh's; {choice}"


RECORDER = topics.RECORDER
OPERATOR = "operator"
ROUTER = "router"
BRIDGE = "bridge"
PROTOCOLS = ("tls", "quic")

MOST_REPLY_BYTES = 8_388_608
"""The largest answer that a link takes: records sent again."""
MOST_SESSIONS = 64


class _Role(NamedTuple):
    """The channels of a kind of member.

    Attributes:
        hears, asks: of everybody.
        publishes, answers: under its own name.
        hears_own: what is addressed to its own name.
        addresses: publishes under everybody's name: what is addressed to them.
    """

    hears: tuple[str, ...]
    asks: tuple[str, ...]
    publishes: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()
    hears_own: tuple[str, ...] = ()
    addresses: tuple[str, ...] = ()


SITE_ROLE = _Role(
    publishes=(
        topics.SAMPLE,
        topics.STATE,
        topics.LINK,
        topics.EVENT,
        topics.MEASURED,
        topics.VIEW,
    ),
    answers=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
    hears=(topics.SAMPLE, topics.LINK, topics.EVENT),
    asks=(topics.INFO, topics.PING, topics.STOP),
    hears_own=(topics.STATE, topics.MEASURED, topics.HAND, topics.ENABLE),
)
ROLES = {
    RECORDER: _Role(
        publishes=(topics.EVENT, topics.STATS),
        answers=(topics.INFO, topics.PING),
        hears=(topics.STATE, topics.LINK, topics.EVENT),
        asks=(topics.INFO, topics.PING, topics.PAST, topics.STOP),
    ),
    OPERATOR: _Role(
        hears=(
            topics.SAMPLE,
            topics.STATE,
            topics.LINK,
            topics.EVENT,
            topics.STATS,
            topics.VIEW,
        ),
        asks=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
        addresses=(topics.HAND, topics.ENABLE),
    ),
    BRIDGE: _Role(
        hears=(topics.STATE, topics.EVENT),
        asks=(topics.INFO, topics.PAST, topics.SET, topics.STOP),
        addresses=(topics.HAND, topics.MEASURED),
    ),
}
"""Of members that are no sites."""


def make_access_rules(members: Sequence[str]) -> dict[str, Any]:
    """Returns Zenoh's settings that hold members, a router among them or not, to their roles."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for member in members:
        relayed = [_rule(["ingress", "egress"], _EVERY, [f"{topics.ROOT}/**"])]
        own = relayed if member == ROUTER else _hold(member, ROLES.get(member, SITE_ROLE))
        kept = (rule for rule in own if rule["key_exprs"])
        named = [
            {"id": f"{member} {n}", "permission": "allow", **rule}
            for n, rule in enumerate(kept)
        ]
        rules += named
        policies.append({"rules": [rule["id"] for rule in named], "subjects": [member]})
    subjects = [
        {"id": member, "cert_common_names": [member], "link_protocols": list(PROTOCOLS)}
        for member in members
    ]
    control = {"enabled": True, "default_permission": "deny", "rules": rules}
    return {
        "access_control": {**control, "subjects": subjects, "policies": policies},
        "low_pass_filter": [
            *SIZE_LIMITS,
            limit_sizes("replies", ["reply"], MOST_REPLY_BYTES),
        ],
    }


_ALIVE = "liveliness_token", "declare_liveliness_subscriber", "liveliness_query"
_EVERY = "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", *_ALIVE


def _hold(member: str, role: _Role) -> Iterator[dict[str, Any]]:
    """Yields what comes from a member (ingress) and what goes to it (egress)."""

    def keys(whose: str, channels: Sequence[str]) -> list[str]:
        """Returns the keys of some channels of a member, or of every one, in any session."""
        return [topics.key("*", whose, channel) for channel in channels]

    says = keys(member, role.publishes) + keys("*", role.addresses)
    hears = keys("*", role.hears) + keys(member, role.hears_own)
    everyone = [topics.presence_key("*", "*")]
    yield _rule(["ingress"], ["put"], says)
    yield _rule(["ingress"], ["declare_subscriber"], hears)
    yield _rule(["ingress"], ["declare_queryable", "reply"], keys(member, role.answers))
    yield _rule(["ingress"], ["query"], keys("*", role.asks))
    yield _rule(["ingress"], ["liveliness_token"], [topics.presence_key("*", member)])
    yield _rule(["ingress"], ["declare_liveliness_subscriber", "liveliness_query"], everyone)
    yield _rule(["egress"], ["put"], hears)
    yield _rule(
        ["egress"], ["declare_subscriber"], keys("*", (*role.publishes, *role.addresses))
    )
    yield _rule(["egress"], ["query"], keys("*", role.answers))
    yield _rule(["egress"], ["declare_queryable", "reply"], keys("*", role.asks))
    yield _rule(["egress"], _ALIVE, everyone)


def _rule(flows: list[str], messages: Sequence[str], keys: list[str]) -> dict[str, Any]:
    return {"flows": flows, "messages": list(messages), "key_exprs": keys}
