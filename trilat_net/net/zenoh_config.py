"""Composes the Zenoh configuration of a member, and checks the user's Zenoh file.

Zenoh is the library that transports the messages. The settings of a member differ from Zenoh's
defaults in three points that matter for a control loop at 1 kHz:

- The transmission queue holds 16 batches instead of 2, because a loop that is late sends the
  messages of several ticks in one burst.
- A publisher does not wait for space in the queue (1 ms by default), because the loop must not
  wait. Receivers count the dropped messages.
- The option `express`, which sends each message separately, stays off. Bursts of thousands of
  small messages only fit into the queue as batches.

With keys, Zenoh's access control restricts which messages each kind of member may publish,
receive, query and answer. A router forwards messages for others, and is therefore allowed to do
everything. The size of messages is limited too, but not their rate, since Zenoh's rate limit
would drop messages in a burst.

Invariant:
    - Members only connect to endpoints that are named explicitly, so two sessions on one
      machine never connect by accident. Zenoh's automatic discovery (multicast and gossip) is
      off.
    - No setting in a user's file is silently overridden. Either the file is accepted, or it is
      rejected with a message that lists all unsuitable settings and the required values.
    - With keys, everything that is not explicitly allowed is denied. A member can only publish
      under its own name, because its connections present a certificate with that name.
"""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from ..errors import UsageError, count_nouns, suggest_nearest
from ..files import open_regular
from . import topics

LEASE_MS = 5_000
"""Time with no sign of life after which Zenoh closes a connection, in ms.

A member may be suspended for less than this time without losing the connection or any messages.
A member that is killed is noticed immediately because its connection is closed, and a silent
member is noticed from the age of its samples.
"""

BATCHES = 16
"""Number of batches that a transmission queue can hold."""
_BATCH_BYTES = 65_535
"""Size of a batch, in bytes."""
MOST_PUT_BYTES = 262_144
"""Maximum size of an accepted published message, in bytes.

This is enough for ten records of the longest arms.
"""
_MOST_QUERY_BYTES = 65_536
"""Maximum size of an accepted query, in bytes."""

ZenohMode = Literal["peer", "client", "router"]
"""Whether a process connects to other members, connects to a router, or acts as a router."""
Endpoint = str | Mapping[str, Any]
"""An address such as "tcp/127.0.0.1:7447", or a group of addresses in Zenoh's format."""

_QUEUES = [
    "control",
    "real_time",
    "interactive_high",
    "interactive_low",
    "data_high",
    "data",
    "data_low",
    "background",
]
"""Names of the transmission queues of a Zenoh connection, in order of priority."""

_CONNECT_TIMEOUT_MS = {"router": -1, "peer": -1, "client": 0}
"""Zenoh's setting `connect/timeout_ms` for each mode: -1 retries without limit, 0 does not
retry.

A client cannot open its session without its router. `Connection.open_bus` retries until the
router is running.
"""
_CONNECT_EXIT_ON_FAILURE = {"router": False, "peer": False, "client": True}
"""Zenoh's setting `connect/exit_on_failure` for each mode."""
_LISTEN_TIMEOUT_MS = {"router": 0, "peer": 0, "client": 0}
"""Zenoh's setting `listen/timeout_ms` for each mode. These are Zenoh's defaults."""
_LISTEN_EXIT_ON_FAILURE = {"router": True, "peer": True, "client": True}
"""Zenoh's setting `listen/exit_on_failure` for each mode. These are Zenoh's defaults."""


def _limit_sizes(name: str, messages: list[str], size: int) -> dict[str, Any]:
    """Returns a Zenoh filter that drops incoming messages above a certain size.

    Otherwise, another program could fill the memory of a member with huge messages.

    Args:
        name: Name of the filter.
        messages: Kinds of messages to which the limit applies, in Zenoh's terms.
        size: Maximum size, in bytes.
    """
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": messages,
        "key_exprs": ["**"],
        "size_limit": size,
    }


_SIZE_LIMITS = [
    _limit_sizes("puts", ["put", "delete"], MOST_PUT_BYTES),
    _limit_sizes("queries", ["query"], _MOST_QUERY_BYTES),
]
"""Size limits of every member, with and without keys."""


def make_zenoh_config(
    listen: Sequence[Endpoint],
    connect: Sequence[Endpoint],
    mode: ZenohMode = "peer",
    user_settings: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Returns the complete Zenoh configuration for one process of a session.

    Args:
        listen: Endpoints on which the member listens.
        connect: Endpoints to which the member connects.
        mode: Mode of the member: "peer", "client" or "router".
        user_settings: Settings that take precedence, from a user's file (`ZenohFile.settings`)
            or from keys.
    """
    retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
    session_settings: dict[str, Any] = {
        "mode": mode,
        "listen": {"endpoints": list(listen), "exit_on_failure": _LISTEN_EXIT_ON_FAILURE[mode]},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": _CONNECT_TIMEOUT_MS[mode],
            "exit_on_failure": _CONNECT_EXIT_ON_FAILURE[mode],
            "retry": retry,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "unicast": {"open_timeout": 2_000, "accept_timeout": 2_000},
            "link": {
                "tx": {
                    "lease": LEASE_MS,
                    "keep_alive": 4,
                    "batch_size": _BATCH_BYTES,
                    "queue": {
                        "size": dict.fromkeys(_QUEUES, BATCHES),
                        "congestion_control": {"drop": {"wait_before_drop": 0}},
                        "batching": {"enabled": True},
                    },
                }
            },
            "shared_memory": {"enabled": False},
        },
        "low_pass_filter": _SIZE_LIMITS,
    }
    return merge_settings(session_settings, user_settings or {})


def merge_settings(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Merges nested settings, with overrides taking precedence over the base settings.

    Args:
        base: The base settings.
        overrides: Values that replace those of `base`, at any level. Settings that appear only
            in `base` are kept.
    """
    merged = dict(base)
    for key, value in overrides.items():
        base_value = merged.get(key)
        if isinstance(base_value, dict) and isinstance(value, dict):
            merged[key] = merge_settings(base_value, value)
        else:
            merged[key] = value
    return merged


_Requirement = tuple[Callable[[Any], bool], str]
"""Requirement for a value: a function that checks the value, and an error message."""


def _require_value(required: object, text: str) -> _Requirement:
    """Returns the requirement that a user's Zenoh setting has a certain value and type.

    Args:
        required: The required value.
        text: The required value and the reason, as stated in the error message.
    """

    def is_required_value(value: Any) -> bool:
        """Returns True if a Zenoh setting has the required value and type.

        The type is compared because 0 == False in Python.
        """
        return value == required and isinstance(value, type(required))

    return is_required_value, text


def _require_minimum(minimum: int, text: str) -> _Requirement:
    """Returns the requirement that a setting is an integer not below a minimum.

    Args:
        minimum: The smallest allowed value.
        text: The required value and the reason, as stated in the error message.
    """

    def is_large_enough(value: Any) -> bool:
        return isinstance(value, int) and value >= minimum

    return is_large_enough, text


def _require_session_value(session_values: Mapping[str, Any]) -> _Requirement:
    """Returns the requirement for a key that the session sets itself, depending on the mode.

    Args:
        session_values: Mapping from mode to the value set by the session. The checked value is
            such a mapping too, see `_expand_mode`.
    """

    def equals_session_value(mode: str, value: Any) -> bool:
        """Returns True if a user's value for one Zenoh mode is the one that a session uses.

        The types must be equal too. False for a mode for which a session sets no value.
        """
        if mode not in session_values:
            return False
        session_value = session_values[mode]
        is_equal: bool = value == session_value
        return is_equal and type(value) is type(session_value)

    def are_session_values(values: Any) -> bool:
        """Returns True if a mode-dependent Zenoh setting agrees with the session's values.

        The modes are "peer", "client" and "router".
        """
        if not isinstance(values, dict):
            return False
        return all(equals_session_value(mode, value) for mode, value in values.items())

    listed_values = ", ".join(
        f"{mode} {json.dumps(value)}" for mode, value in session_values.items()
    )
    return are_session_values, f"left out, or as a session sets it itself: {listed_values}"


_MUST_BE_OFF = _require_value(False, "false: members connect only at named endpoints")
_MUST_BE_EMPTY = _require_value([], "empty: it would change or thin out a session's messages")
_TX = "transport/link/tx"

REQUIREMENTS: Mapping[str, _Requirement] = {
    "connect/timeout_ms": _require_session_value(_CONNECT_TIMEOUT_MS),
    "connect/exit_on_failure": _require_session_value(_CONNECT_EXIT_ON_FAILURE),
    "listen/timeout_ms": _require_session_value(_LISTEN_TIMEOUT_MS),
    "listen/exit_on_failure": _require_session_value(_LISTEN_EXIT_ON_FAILURE),
    "scouting/multicast/enabled": _MUST_BE_OFF,
    "scouting/gossip/enabled": _MUST_BE_OFF,
    **{
        f"{_TX}/queue/size/{queue}": _require_minimum(
            BATCHES, f"{BATCHES}: a burst of catch-up ticks must fit into the queue"
        )
        for queue in _QUEUES
    },
    f"{_TX}/queue/congestion_control/drop/wait_before_drop": _require_value(
        0, "0: a loop never waits for room"
    ),
    f"{_TX}/queue/batching/enabled": _require_value(
        True, "true: without batches a burst of catch-up ticks does not fit into the queue"
    ),
    f"{_TX}/batch_size": _require_minimum(
        _BATCH_BYTES, f"{_BATCH_BYTES}: a burst of catch-up ticks must fit"
    ),
    f"{_TX}/lease": _require_minimum(
        LEASE_MS, f"{LEASE_MS} or more: a stall shorter than that loses no message"
    ),
    "transport/unicast/lowlatency": _require_value(
        False, "false: it sends in the loop, without a queue"
    ),
    "transport/shared_memory/enabled": _require_value(
        False, "false: a receiver that stalls would lose messages"
    ),
    "qos/publication": _MUST_BE_EMPTY,
    "qos/network": _MUST_BE_EMPTY,
    "downsampling": _MUST_BE_EMPTY,
    "low_pass_filter": (
        lambda stated: stated in ([], _SIZE_LIMITS),
        "left out: a session sets it",
    ),
}
"""Requirements of a session, keyed by path in Zenoh's configuration."""

_FILE_KEYS = r"transport/(link/tls/\w+_(certificate|private_key)|auth/usrpwd/dictionary_file)"
"""Pattern of the keys whose values are file names.

The check opens these files to report unreadable ones early. Zenoh opens them only when it
connects, and then retries forever.
"""


@dataclass(frozen=True, slots=True)
class ZenohFile:
    """Checked settings from a user's Zenoh file.

    Attributes:
        source: Name of the file, for error messages.
        mode: Mode given in the file. Empty if the file gives none.
        settings: All settings except the mode and the endpoints.
    """

    source: str
    mode: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    _endpoints: Mapping[str, Any] = field(default_factory=dict)

    def endpoints(
        self, side: Literal["listen", "connect"], mode: ZenohMode
    ) -> list[Endpoint] | None:
        """Returns the endpoints that the Zenoh file names for listening or for connecting.

        Args:
            side: "listen" for the endpoints on which the member listens, or "connect" for those
                to which it connects.
            mode: Mode of the member. The file may name different endpoints for each mode.

        Returns:
            The endpoints, or None if the file names none.
        """
        endpoints = self._endpoints.get(side)
        # A dictionary is either a group of locators or a table by mode.
        if isinstance(endpoints, dict) and "locators" not in endpoints:
            endpoints = endpoints.get(mode)
        if endpoints is None:
            return None
        return list(endpoints) if isinstance(endpoints, list) else [endpoints]

    @classmethod
    def check(
        cls, source: str, stated: object, refusal: Callable[[Mapping[str, Any]], str]
    ) -> "ZenohFile":
        """Checks that a user's Zenoh settings meet the requirements of a session.

        Args:
            source: Name of the file, for error messages.
            stated: Parsed content of the file.
            refusal: Function that returns Zenoh's reason for rejecting settings, or an empty
                string if Zenoh accepts them.

        Returns:
            The checked content.

        Raises:
            UsageError: The file is not a Zenoh configuration, or contradicts the requirements
                of a session. The message lists all offending keys.
        """
        if not isinstance(stated, dict):
            raise UsageError(
                f"{source}: a Zenoh configuration must be a single object in braces"
            )
        settings = _remove_nulls(stated)

        reason = refusal(settings)
        if reason:
            refused = list(_find_refused_keys(settings, refusal, ()))
            problems = [f"{'/'.join(path)}: {_suggest_key(path, why)}" for path, why in refused]
            raise UsageError(_list_problems(source, problems or [reason]))

        problems = list(_find_problems(settings))
        if problems:
            raise UsageError(_list_problems(source, problems))

        for path in (*_SET_BY_MODE, "low_pass_filter"):
            # The check has shown that the session's own value is the same.
            _drop_key(settings, path)

        mode = settings.pop("mode", "")
        endpoints = {
            side: settings[side].pop("endpoints")
            for side in ("listen", "connect")
            if "endpoints" in settings.get(side, {})
        }
        return cls(source, mode, settings, endpoints)


def _list_problems(source: str, problems: Sequence[str]) -> str:
    """Returns a one-line error message with all problems of a user's Zenoh file.

    Args:
        source: Name of the file.
        problems: One string per problem, at least one.
    """
    if len(problems) == 1:
        return f"{source}: {problems[0]}"
    count = count_nouns(len(problems), "setting")
    return f"{source}: {count} cannot be accepted: {'; '.join(problems)}"


def _find_problems(settings: Mapping[str, Any]) -> Iterator[str]:
    """Finds settings in a user's Zenoh file with which a session would not work.

    Args:
        settings: Content of the file.

    Yields:
        One string per problem, which begins with the key.
    """
    for key, value in _iterate_leaves(settings, ()):
        checked_value = _expand_mode(settings, value) if key in _SET_BY_MODE else value
        if key in REQUIREMENTS:
            is_met, requirement_text = REQUIREMENTS[key]
            if not is_met(checked_value):
                text = json.dumps(value)
                short_text = text if len(text) <= 60 else f"{text[:57]}..."
                yield f"{key}: {short_text} must be {requirement_text}"
        if re.fullmatch(_FILE_KEYS, key):
            try:
                open_regular(Path(str(value))).close()
            except OSError as error:
                yield f"{key}: {value} cannot be read: {error.strerror}"
    if settings.get("access_control") and "enabled" not in settings["access_control"]:
        yield "access_control: must have `enabled: true`, without which Zenoh admits everybody"


_SET_BY_MODE = (
    "connect/timeout_ms",
    "connect/exit_on_failure",
    "listen/timeout_ms",
    "listen/exit_on_failure",
)
"""Keys that are set by a session itself, depending on the mode of the member."""


def _expand_mode(settings: Mapping[str, Any], value: Any) -> Any:
    """Returns the value of a key as a dictionary keyed by mode.

    A value that is not a dictionary applies to the mode given in the file, or to peers if the
    file gives no mode.

    Args:
        settings: Content of the file.
        value: Value of the key.
    """
    return value if isinstance(value, dict) else {settings.get("mode", "peer"): value}


def _drop_key(settings: dict[str, Any], path: str) -> None:
    """Removes a key such as "transport/unicast" from nested settings, if it is present.

    Args:
        settings: The settings, which are modified in place.
        path: Keys of the levels, separated by "/".
    """
    *folders, last = path.split("/")
    for folder in folders:
        settings = settings.get(folder, {})
    settings.pop(last, None)


def _remove_nulls(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a copy of nested settings, excluding keys whose value is null.

    A key with the value null sets nothing, so it must not be checked as if the user had chosen
    it.
    """
    return {
        key: _remove_nulls(value) if isinstance(value, dict) else value
        for key, value in settings.items()
        if value is not None
    }


def _iterate_leaves(
    settings: Mapping[str, Any], path: tuple[str, ...]
) -> Iterator[tuple[str, Any]]:
    """Yields the path and value of each setting in nested settings.

    If there is a requirement for a group of settings, the group is yielded as one entry.

    Args:
        settings: Settings below `path`.
        path: Keys of the levels above.
    """
    for key, value in settings.items():
        key_path = (*path, key)
        joined = "/".join(key_path)
        if isinstance(value, dict) and joined not in REQUIREMENTS:
            yield from _iterate_leaves(value, key_path)
        else:
            yield joined, value


def _find_refused_keys(
    settings: Mapping[str, Any],
    refusal: Callable[[Mapping[str, Any]], str],
    path: tuple[str, ...],
) -> Iterator[tuple[tuple[str, ...], str]]:
    """Finds the settings that Zenoh rejects, by trying each one separately.

    Args:
        settings: Settings below `path`.
        refusal: Function that returns Zenoh's reason for rejecting settings, or an empty
            string.
        path: Keys of the levels above.

    Yields:
        The path of each rejected setting, and the reason. If a group of settings is rejected,
        the rejected settings within the group are yielded.
    """
    for key, value in settings.items():
        key_path = (*path, key)
        single_setting: Any = value
        for level in reversed(key_path):
            single_setting = {level: single_setting}
        reason = refusal(single_setting)
        if not reason:
            continue
        refused_within: list[tuple[tuple[str, ...], str]] = []
        if isinstance(value, dict):
            refused_within = list(_find_refused_keys(value, refusal, key_path))
        yield from refused_within or [(key_path, reason)]


def _suggest_key(path: Sequence[str], reason: str) -> str:
    """Explains why a Zenoh setting is rejected, suggesting a similar name for an unknown one.

    Args:
        path: Path of the key.
        reason: Zenoh's reason.
    """
    unknown_field = re.match(r"unknown field `([^`]*)`, expected (?:one of )?(.*)", reason)
    if unknown_field is None or not path or unknown_field[1] != path[-1]:
        return reason
    unknown_key, valid_text = unknown_field.groups()
    valid_keys = re.findall(r"`([^`]*)`", valid_text)
    hint = suggest_nearest(unknown_key, valid_keys)
    hint = hint or f"; the possible keys are {valid_text.replace('`', '')}"
    return f"Zenoh has no such key{hint}"


RECORDER = topics.RECORDER
OPERATOR = "operator"
ROUTER = "router"
BRIDGE = "bridge"
PROTOCOLS = ("tls", "quic")
"""Protocols that are allowed with keys."""

_MOST_REPLY_BYTES = 8_388_608
"""Maximum size of an accepted reply, in bytes, which is that of a reply with resent records."""
MOST_SESSIONS = 64
"""Maximum number of connections of a member with keys."""


class _Role(NamedTuple):
    """The channels that one kind of member may use.

    A channel is a kind of message, see `topics`.

    Attributes:
        receives: Channels that the member receives from all members.
        queries: Channels on which the member queries all members.
        publishes: Channels that the member publishes under its own name.
        replies: Channels on which the member answers queries to its own name.
        receives_addressed: Channels that the member receives under its own name.
        publishes_to: Channels that the member publishes under the name of the receiving member.
    """

    receives: tuple[str, ...]
    queries: tuple[str, ...]
    publishes: tuple[str, ...] = ()
    replies: tuple[str, ...] = ()
    receives_addressed: tuple[str, ...] = ()
    publishes_to: tuple[str, ...] = ()


SITE_ROLE = _Role(
    publishes=(
        topics.SAMPLE,
        topics.STATE,
        topics.LINK,
        topics.EVENT,
        topics.MEASURED,
        topics.VIEW,
    ),
    replies=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
    receives=(topics.SAMPLE, topics.LINK, topics.EVENT),
    queries=(topics.INFO, topics.PING, topics.STOP),
    receives_addressed=(topics.STATE, topics.MEASURED, topics.HAND, topics.ENABLE),
)
"""Role of a site."""
ROLES = {
    RECORDER: _Role(
        publishes=(topics.EVENT, topics.STATS),
        replies=(topics.INFO, topics.PING),
        receives=(topics.STATE, topics.LINK, topics.EVENT),
        queries=(topics.INFO, topics.PING, topics.PAST, topics.STOP),
    ),
    OPERATOR: _Role(
        receives=(
            topics.SAMPLE,
            topics.STATE,
            topics.LINK,
            topics.EVENT,
            topics.STATS,
            topics.VIEW,
        ),
        queries=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
        publishes_to=(topics.HAND, topics.ENABLE),
    ),
    BRIDGE: _Role(
        receives=(topics.STATE, topics.EVENT),
        queries=(topics.INFO, topics.PAST, topics.SET, topics.STOP),
        publishes_to=(topics.HAND, topics.MEASURED),
    ),
}
"""Mapping from the name of each member that is not a site to its role."""


def make_access_rules(members: Sequence[str]) -> dict[str, Any]:
    """Returns the Zenoh settings that let each member send only what its role requires.

    A member proves its role through the name in its certificate.

    Args:
        members: Names of all members of the session. All members other than the recorder, the
            operator and the router are sites.
    """
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for member in members:
        if member == ROUTER:
            keys = [f"{topics.ROOT}/**"]
            member_rules = [_make_rule(["ingress", "egress"], _ALL_MESSAGES, keys)]
        else:
            member_rules = list(_derive_rules(member, ROLES.get(member, SITE_ROLE)))
        # A role without channels of some kind gives a rule without keys.
        member_rules = [rule for rule in member_rules if rule["key_exprs"]]

        named_rules = [
            {"id": f"{member} {index}", "permission": "allow", **rule}
            for index, rule in enumerate(member_rules)
        ]
        rules += named_rules
        rule_ids = [rule["id"] for rule in named_rules]
        policies.append({"rules": rule_ids, "subjects": [member]})

    subjects = [
        {"id": member, "cert_common_names": [member], "link_protocols": list(PROTOCOLS)}
        for member in members
    ]
    control = {"enabled": True, "default_permission": "deny", "rules": rules}
    return {
        "access_control": {**control, "subjects": subjects, "policies": policies},
        "low_pass_filter": [
            *_SIZE_LIMITS,
            _limit_sizes("replies", ["reply"], _MOST_REPLY_BYTES),
        ],
    }


_LIVELINESS = "liveliness_token", "declare_liveliness_subscriber", "liveliness_query"
"""Kinds of messages that show which members are present."""
_ALL_MESSAGES = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_subscriber",
    "declare_queryable",
    *_LIVELINESS,
)
"""All kinds of messages, which a router may forward."""


def _derive_rules(member: str, role: _Role) -> Iterator[dict[str, Any]]:
    """Derives the access rules of a member from its role.

    Zenoh checks the rules at the other end of a connection: "ingress" applies to messages that
    arrive from the member, and "egress" to messages sent to it.

    Args:
        member: Name of the member.
        role: Role of the member.
    """

    def keys(owner: str, channels: Sequence[str]) -> list[str]:
        """Returns the keys under which a member publishes on the given channels.

        The keys match any session.

        Args:
            owner: Name of the member. "*" stands for any member.
            channels: Names of the channels.
        """
        return [topics.key("*", owner, channel) for channel in channels]

    published = keys(member, role.publishes) + keys("*", role.publishes_to)
    received = keys("*", role.receives) + keys(member, role.receives_addressed)
    local_presence = [topics.presence_key("*", member)]
    all_presences = [topics.presence_key("*", "*")]
    watch_presence = ["declare_liveliness_subscriber", "liveliness_query"]

    # Messages from the member: what it publishes, subscribes to, replies and queries, its own
    # token, and its subscription to the tokens of the others.
    yield _make_rule(["ingress"], ["put"], published)
    yield _make_rule(["ingress"], ["declare_subscriber"], received)
    yield _make_rule(["ingress"], ["declare_queryable", "reply"], keys(member, role.replies))
    yield _make_rule(["ingress"], ["query"], keys("*", role.queries))
    yield _make_rule(["ingress"], ["liveliness_token"], local_presence)
    yield _make_rule(["ingress"], watch_presence, all_presences)

    # Messages to the member: the counterparts of these messages.
    published_by_all = keys("*", (*role.publishes, *role.publishes_to))
    yield _make_rule(["egress"], ["put"], received)
    yield _make_rule(["egress"], ["declare_subscriber"], published_by_all)
    yield _make_rule(["egress"], ["query"], keys("*", role.replies))
    yield _make_rule(["egress"], ["declare_queryable", "reply"], keys("*", role.queries))
    yield _make_rule(["egress"], _LIVELINESS, all_presences)


def _make_rule(flows: list[str], messages: Sequence[str], keys: list[str]) -> dict[str, Any]:
    """Returns a rule of Zenoh's access control that allows certain messages.

    Args:
        flows: Directions: "ingress" for messages from the member, "egress" for those to it.
        messages: Kinds of messages, in Zenoh's terms.
        keys: Keys of the messages.
    """
    return {"flows": flows, "messages": list(messages), "key_exprs": keys}
