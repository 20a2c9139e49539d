"""The wire of ROS 2 over Zenoh: strings as documented by rmw_zenoh, hashes as computed by
rosbags, a router.
"""

import json
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import until
from trilat_net.errors import UsageError
from trilat_net.net.clock import SystemClock
from trilat_net.net.ros2.ros2_graph import (
    TYPE_HASHES,
    Attachment,
    EndpointKind,
    QualityOfService,
    Refusals,
    Ros2Graph,
    Ros2Member,
    find_type_hash,
    make_gid,
)
from trilat_net.net.ros2.ros2_names import check_ros_name
from trilat_net.net.zenoh_bus import RouterSilent
from trilat_net.net.zenoh_config import ZenohMode, make_zenoh_config

STRING = "std_msgs/msg/String"
LOG = "rcl_interfaces/msg/Log"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
NODE = Ros2Member(0, "aac3178e146ba6f1fc6e6a4085e77f21", "", "node")
LISTENER = Ros2Member(2, "aac3178e146ba6f1fc6e6a4085e77f21", "", "listener")


def test_keys_follow_the_design_of_rmw_zenoh() -> None:
    assert NODE.topic_key("chatter", STRING, find_type_hash(STRING, "jazzy")) == (
        f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    )
    assert LISTENER.topic_key(
        "add_two_ints", "example_interfaces/srv/AddTwoInts", ADD_HASH
    ) == (f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}")
    assert NODE.topic_key("a/b", STRING, find_type_hash(STRING, "humble")).endswith(
        "/TypeHashNotSupported"
    )


def test_tokens_follow_the_design_of_rmw_zenoh() -> None:
    root = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0"
    assert LISTENER.token() == f"{root}/0/NN/%/%/listener"
    heard = (10, EndpointKind.SUBSCRIPTION, "chatter", STRING, STRING_HASH, QualityOfService())
    assert LISTENER.endpoint_token(*heard) == (
        f"{root}/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    server = Ros2Member(2, "f9980ee0495eaafb3e38f0d19e2eae12", "", "add_two_ints_server")
    kind = "example_interfaces/srv/AddTwoInts"
    served = server.endpoint_token(
        10, EndpointKind.SERVER, "add_two_ints", kind, ADD_HASH, QualityOfService()
    )
    assert served == (
        "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,"
    )
    talker = Ros2Member(0, "999bf91283606d2068c7524e5badfa6c", "robot1", "talker")
    assert talker.endpoint_token(
        1, EndpointKind.PUBLISHER, "rosout", LOG, "RIHS01_e28c", QualityOfService()
    ).startswith(
        "@ros2_lv/0/999bf91283606d2068c7524e5badfa6c/0/1/MP/%/%robot1/talker/%rosout/rcl_interfaces"
    )


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (QualityOfService(), "::,10:,:,:,,"),
        (QualityOfService(reliable=False, depth=5), "2::,5:,:,:,,"),
        (QualityOfService(latched=True, depth=1), ":1:,1:,:,:,,"),
        (QualityOfService(depth=42), "::,:,:,:,,"),
    ],
)
def test_qualities_of_service_omit_the_defaults(qos: QualityOfService, text: str) -> None:
    assert qos.encode() == text


TRIGGER = "std_srvs/srv/Trigger"
NAME = Nodetype.NAME
INFO = "service_msgs/msg/ServiceEventInfo"
ASKED, TOLD, EVENT = (f"{TRIGGER}_{part}" for part in ("Request", "Response", "Event"))
SERVICE = {
    INFO: (
        [],
        [
            ("event_type", (Nodetype.BASE, ("uint8", 0))),
            ("stamp", (NAME, "builtin_interfaces/msg/Time")),
            (
                "client_gid",
                (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16)),
            ),  # char is uint8 in ROS 2
            ("sequence_number", (Nodetype.BASE, ("int64", 0))),
        ],
    ),
    ASKED: ([], []),
    TOLD: (
        [],
        [
            ("success", (Nodetype.BASE, ("bool", 0))),
            ("message", (Nodetype.BASE, ("string", 0))),
        ],
    ),
    EVENT: (
        [],
        [
            ("info", (NAME, INFO)),
            ("request", (Nodetype.SEQUENCE, ((NAME, ASKED), 1))),
            ("response", (Nodetype.SEQUENCE, ((NAME, TOLD), 1))),
        ],
    ),
    TRIGGER: (
        [],
        [
            ("request_message", (NAME, ASKED)),
            ("response_message", (NAME, TOLD)),
            ("event_message", (NAME, EVENT)),
        ],
    ),
}
"""A service as a type of its two messages and an event (REP 2016)."""


@pytest.mark.parametrize("store", ["HUMBLE", "IRON", "JAZZY", "KILTED", "LYRICAL"])
def test_type_hashes_are_those_of_all_distributions(store: str) -> None:
    types = get_typestore(Stores[f"ROS2_{store}"])
    types.fielddefs.update(SERVICE)
    for kind, digest in TYPE_HASHES.items():
        assert types.hash_rihs01(kind) == f"RIHS01_{digest}"


@given(
    st.integers(1, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16)
)
def test_attachments_have_33_bytes_and_return(
    number: int, sent_unix_ns: int, gid: bytes
) -> None:
    attachment = Attachment(number, sent_unix_ns, gid)
    assert len(attachment.encode()) == 33
    assert attachment.encode()[16] == 0x10
    assert Attachment.decode(attachment.encode()) == attachment


@given(st.binary(max_size=70))
def test_an_invalid_attachment_is_none(data: bytes) -> None:
    attachment = Attachment.decode(data)
    assert attachment is None or attachment.encode() == data


def test_names_of_endpoints_differ() -> None:
    tokens = [
        LISTENER.endpoint_token(
            n, EndpointKind.PUBLISHER, "a", STRING, STRING_HASH, QualityOfService()
        )
        for n in range(50)
    ]
    assert len({make_gid(token) for token in tokens}) == 50
    assert {len(make_gid(token)) for token in tokens} == {16}


@pytest.mark.parametrize("name", ["", "/", "a//b", "a-b", "1a", "a/1", "a/", "é"])
def test_names_refused_by_ros_are_refused(name: str) -> None:
    with pytest.raises(UsageError, match="is not a valid ROS 2 name"):
        check_ros_name(name, "session")


def test_ros_names_lose_their_leading_slash() -> None:
    assert check_ros_name("/lab/arm_1", "session") == "lab/arm_1"


@pytest.mark.parametrize(
    ("domain", "kind", "type_hash", "misfit"),
    [
        (0, STRING, STRING_HASH, ""),
        (0, STRING, "TypeHashNotSupported", ""),
        (3, STRING, STRING_HASH, "in domain 3, but this subscription is in domain 0"),
        (
            0,
            LOG,
            STRING_HASH,
            "as rcl_interfaces::msg::dds_::Log_, but this subscription expects std_msgs::msg::dds_::String_",
        ),
        (0, STRING, "RIHS01_0", "with another definition of std_msgs/msg/String, RIHS01_0"),
    ],
)
def test_mismatched_publishers_are_named(
    domain: int, kind: str, type_hash: str, misfit: str
) -> None:
    talker = Ros2Member(domain, "999bf91283606d2068c7524e5badfa6c", "robot1", "talker")
    sent = talker.endpoint_token(
        1, EndpointKind.PUBLISHER, "a/b", kind, type_hash, QualityOfService()
    )
    assert NODE.describe_mismatch(sent, STRING) == misfit


@given(
    st.lists(st.text(max_size=9).filter(lambda part: "/" not in part), min_size=10, max_size=15)
)
def test_foreign_tokens_have_misfits_and_raise_nothing(parts: list[str]) -> None:
    assert NODE.describe_mismatch("/".join(parts), STRING)


class Wire:
    """A router, a graph of ours at the router, and a stranger that uses Zenoh alone."""

    def __init__(self, place: str) -> None:
        self.place = place
        self.said = list[str]()
        self._kept = list[Any]()
        self.router = open_zenoh("router", place)
        self.stranger = open_zenoh("client", place)
        self.graph = Ros2Graph(
            Refusals(self.said.append), [place], "play", "trilat", SystemClock()
        )

    def say(self, key: str, data: bytes, attachment: bytes | None) -> None:
        with self.stranger.declare_publisher(key) as publisher:
            until(lambda: publisher.matching_status.matching)
            publisher.put(data, attachment=attachment)

    def hears(self, key: str) -> list[bytes]:
        """Returns the stranger's messages from now on, and of a latched topic also the earlier ones."""
        payloads: list[bytes] = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        take = lambda sample: payloads.append(sample.payload.to_bytes())  # noqa: E731
        self._kept.append(
            zenoh.ext.declare_advanced_subscriber(self.stranger, key, take, history=history)
        )
        return payloads

    def close(self) -> None:
        self.graph.__exit__()
        self.stranger.close()
        self.router.close()


def open_zenoh(mode: ZenohMode, place: str) -> Any:
    ends = ([], [place]) if mode == "client" else ([place], [])
    return zenoh.open(zenoh.Config.from_json5(json.dumps(make_zenoh_config(*ends, mode))))


@pytest.fixture
def wire() -> Iterator[Wire]:
    with closing(Wire(*find_free_endpoints(1))) as open_wire:
        yield open_wire


SENT = Attachment(1, 5, b"s" * 16)


def test_messages_of_other_types_are_refused(wire: Wire) -> None:
    messages: list[tuple[bytes, Attachment]] = []
    wire.graph.subscribe("a", STRING, lambda data, sent: messages.append((data, sent)))
    right = NODE.topic_key("a", STRING, STRING_HASH)
    for attachment in (None, b"", b"x" * 33):
        wire.say(right, b"bare", attachment)
    for kind, type_hash in ((LOG, STRING_HASH), (STRING, "RIHS01_0")):
        wire.stranger.put(
            NODE.topic_key("a", kind, type_hash), b"other", attachment=SENT.encode()
        )
    wire.say(NODE.topic_key("a", STRING, "TypeHashNotSupported"), b"humble", SENT.encode())
    wire.say(right, b"jazzy", SENT.encode())
    until(lambda: len(messages) == 2)
    assert messages == [(b"humble", SENT), (b"jazzy", SENT)]
    assert wire.graph.refusals.counts == {"a: a message without an attachment of ROS": 3}


def test_raising_messages_are_refused_without_effect(wire: Wire) -> None:
    payloads: list[bytes] = []

    def take(data: bytes, _: Attachment) -> None:
        payloads.append(data)
        raise ValueError("is none")

    wire.graph.subscribe("a", STRING, take)
    for data in (b"1", b"2"):
        wire.say(NODE.topic_key("a", STRING, STRING_HASH), data, SENT.encode())
    until(lambda: len(payloads) == 2)
    until(lambda: wire.graph.refusals.counts == {"a is none": 2})
    assert wire.said == ["refused: a is none"]


def test_mismatched_publishers_are_named_at_once(wire: Wire) -> None:
    wire.graph.subscribe("a", STRING, lambda *_, **__: None)
    ros_member = Ros2Member(3, str(wire.stranger.zid()), "", "talker")
    token = ros_member.endpoint_token(
        1, EndpointKind.PUBLISHER, "a", STRING, STRING_HASH, QualityOfService()
    )
    with_token = wire.stranger.liveliness().declare_token(token)
    until(
        lambda: (
            wire.said
            == ["refused: a is published in domain 3, but this subscription is in domain 0"]
        )
    )
    with_token.undeclare()


def test_requests_without_attachment_get_no_answer(wire: Wire) -> None:
    wire.graph.serve("end", TRIGGER, lambda _: b"done")
    key = NODE.topic_key("end", TRIGGER, find_type_hash(TRIGGER, "jazzy"))

    def ask(**how: Any) -> list[Any]:
        return [reply.ok for reply in wire.stranger.get(key, timeout=5.0, payload=b"", **how)]

    until(lambda: ask(attachment=SENT.encode()))
    (answer,) = ask(attachment=SENT.encode())
    attachment = Attachment.decode(answer.attachment.to_bytes())
    assert attachment is not None
    assert (answer.payload.to_bytes(), attachment.number, attachment.gid) == (
        b"done",
        1,
        SENT.gid,
    )
    assert ask() == []
    assert wire.said == ["refused: end: a request without an attachment of ROS"]


def test_returning_routers_carry_every_topic_again(wire: Wire) -> None:
    plain = wire.graph.publisher("a", STRING, QualityOfService())
    latched = wire.graph.publisher("b", STRING, QualityOfService(latched=True, depth=1))
    latched.put(b"kept")
    assert not plain.has_subscribers
    for _ in range(3):
        wire.stranger.close()
        wire.router.close()
        until(lambda: not wire.graph.connected)
        wire.router = open_zenoh("router", wire.place)
        until(lambda: wire.graph.connected)
        wire.stranger = open_zenoh("client", wire.place)
        now = wire.hears("0/a/**")
        until(lambda: plain.has_subscribers)
        plain.put(b"now")
        kept = wire.hears("0/b/**")
        until(now.copy)
        until(kept.copy)
        assert (now, kept) == ([b"now"], [b"kept"])


def test_peers_forward_nothing_and_name_the_cure() -> None:
    (endpoint,) = find_free_endpoints(1)
    with (
        closing(open_zenoh("peer", endpoint)),
        pytest.raises(UsageError, match=r"is not a router.*rmw_zenohd"),
    ):
        Ros2Graph(Refusals(print), [endpoint], "play", "trilat", SystemClock())


def test_an_absent_router_is_silent() -> None:
    with pytest.raises(RouterSilent, match="no router of ROS answers at tcp"):
        Ros2Graph(Refusals(print), find_free_endpoints(1), "play", "trilat", SystemClock())
