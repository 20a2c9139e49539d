"""What each member of a session may send, hear, ask and answer, as rules of Zenoh's access control.

Invariant: everything that is not named here is denied, at every member and at routers. A member speaks under
its own name alone: its links show a certificate, and the name in it is the one that stands in its keys. A
router carries what others said; it is trusted with all of it. Sizes are limited here, rates are not: Zenoh
would thin out bursts, in which samples of ticks that are made up for arrive, and events of one tick.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from . import topics
from .zenoh_config import SIZE_LIMITS, limit_sizes

RECORDER, OPERATOR, ROUTER, BRIDGE = topics.RECORDER, "operator", "router", "bridge"
PROTOCOLS = ("tls", "quic")

MOST_REPLY_BYTES = 8_388_608
"""The largest answer that a link takes: records sent again."""
MOST_SESSIONS = 64


class _Role(NamedTuple):
    """The channels of a kind of member.

    Attributes:
        publishes: under its own name.
        answers: questions to its own name.
        hears: of everybody.
        hears_own: what is addressed to its own name.
        asks: of everybody.
        addresses: publishes under everybody's name: what is addressed to them.
    """

    publishes: tuple[str, ...]
    answers: tuple[str, ...]
    hears: tuple[str, ...]
    asks: tuple[str, ...]
    hears_own: tuple[str, ...] = ()
    addresses: tuple[str, ...] = ()


SITE_ROLE = _Role(
    publishes=(topics.SAMPLE, topics.STATE, topics.LINK, topics.EVENT, topics.MEASURED),
    answers=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
    hears=(topics.SAMPLE, topics.LINK, topics.EVENT),
    asks=(topics.INFO, topics.PING, topics.STOP),
    hears_own=(topics.STATE, topics.MEASURED, topics.HAND, topics.ENABLE),
)
RECORDER_ROLE = _Role(
    publishes=(topics.EVENT, topics.STATS),
    answers=(topics.INFO, topics.PING),
    hears=(topics.STATE, topics.LINK, topics.EVENT),
    asks=(topics.INFO, topics.PING, topics.PAST, topics.STOP),
)
OPERATOR_ROLE = _Role(
    publishes=(),
    answers=(),
    hears=(topics.SAMPLE, topics.STATE, topics.LINK, topics.EVENT, topics.STATS),
    asks=(topics.INFO, topics.PING, topics.PAST, topics.SET, topics.STOP),
    addresses=(topics.HAND, topics.ENABLE),
)
BRIDGE_ROLE = _Role(
    publishes=(),
    answers=(),
    hears=(topics.STATE, topics.EVENT),
    asks=(topics.INFO, topics.PAST, topics.SET, topics.STOP),
    addresses=(topics.HAND, topics.MEASURED),
)
ROLES = {RECORDER: RECORDER_ROLE, OPERATOR: OPERATOR_ROLE, BRIDGE: BRIDGE_ROLE}
"""Of members that are no sites."""


def make_access_rules(members: Sequence[str]) -> dict[str, Any]:
    """Returns Zenoh's settings that hold members, a router among them or not, to their roles."""
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for member in members:
        relayed = [_rule(["ingress", "egress"], _EVERY, [f"{topics.ROOT}/**"])]
        own = relayed if member == ROUTER else _hold(member, ROLES.get(member, SITE_ROLE))
        kept = (rule for rule in own if rule["key_exprs"])
        named = [{"id": f"{member} {n}", "permission": "allow", **rule} for n, rule in enumerate(kept)]
        rules += named
        policies.append({"rules": [rule["id"] for rule in named], "subjects": [member]})
    subjects = [
        {"id": member, "cert_common_names": [member], "link_protocols": list(PROTOCOLS)} for member in members
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
    yield _rule(["egress"], ["declare_subscriber"], keys("*", (*role.publishes, *role.addresses)))
    yield _rule(["egress"], ["query"], keys("*", role.answers))
    yield _rule(["egress"], ["declare_queryable", "reply"], keys("*", role.asks))
    yield _rule(["egress"], _ALIVE, everyone)


def _rule(flows: list[str], messages: Sequence[str], keys: list[str]) -> dict[str, Any]:
    return {"flows": flows, "messages": list(messages), "key_exprs": keys}
