"""The wire of ROS 2 over Zenoh: strings that rmw_zenoh documents, and hashes that rosbags computes anew."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from trilat_net.errors import UsageError
from trilat_net.net.ros2_graph import (
    TYPE_HASHES,
    Attachment,
    EndpointKind,
    GraphPlace,
    QualityOfService,
    check_ros_name,
    find_type_hash,
    make_gid,
    parse_attachment,
    topic_key,
)

STRING, LOG = "std_msgs/msg/String", "rcl_interfaces/msg/Log"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
LISTENER = GraphPlace(2, "aac3178e146ba6f1fc6e6a4085e77f21", "", "listener")


def test_keys_are_those_of_the_design_of_rmw_zenoh() -> None:
    assert topic_key(0, "chatter", STRING, find_type_hash(STRING, "jazzy")) == (
        f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    )
    assert topic_key(2, "add_two_ints", "example_interfaces/srv/AddTwoInts", ADD_HASH) == (
        f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}"
    )
    assert topic_key(0, "a/b", STRING, find_type_hash(STRING, "humble")).endswith("/TypeHashNotSupported")


def test_tokens_are_those_of_the_design_of_rmw_zenoh() -> None:
    root = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0"
    assert LISTENER.token() == f"{root}/0/NN/%/%/listener"
    heard = (10, EndpointKind.SUBSCRIPTION, "chatter", STRING, STRING_HASH, QualityOfService())
    assert LISTENER.endpoint_token(*heard) == (
        f"{root}/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    server = GraphPlace(2, "f9980ee0495eaafb3e38f0d19e2eae12", "", "add_two_ints_server")
    kind = "example_interfaces/srv/AddTwoInts"
    served = server.endpoint_token(
        10, EndpointKind.SERVER, "add_two_ints", kind, ADD_HASH, QualityOfService()
    )
    assert served == (
        "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
        f"example_interfaces::srv::dds_::AddTwoInts_/{ADD_HASH}/::,10:,:,:,,"
    )
    talker = GraphPlace(0, "999bf91283606d2068c7524e5badfa6c", "robot1", "talker")
    assert talker.endpoint_token(
        1, EndpointKind.PUBLISHER, "rosout", LOG, "RIHS01_e28c", QualityOfService()
    ).startswith("@ros2_lv/0/999bf91283606d2068c7524e5badfa6c/0/1/MP/%/%robot1/talker/%rosout/rcl_interfaces")


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (QualityOfService(), "::,10:,:,:,,"),
        (QualityOfService(reliable=False, depth=5), "2::,5:,:,:,,"),
        (QualityOfService(latched=True, depth=1), ":1:,1:,:,:,,"),
        (QualityOfService(depth=42), "::,:,:,:,,"),
    ],
)
def test_a_quality_of_service_leaves_out_the_defaults(qos: QualityOfService, text: str) -> None:
    assert qos.encode() == text


TRIGGER, NAME, INFO = "std_srvs/srv/Trigger", Nodetype.NAME, "service_msgs/msg/ServiceEventInfo"
ASKED, TOLD, EVENT = (f"{TRIGGER}_{part}" for part in ("Request", "Response", "Event"))
SERVICE = {
    INFO: (
        [],
        [
            ("event_type", (Nodetype.BASE, ("uint8", 0))),
            ("stamp", (NAME, "builtin_interfaces/msg/Time")),
            ("client_gid", (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16))),  # char is uint8 in ROS 2
            ("sequence_number", (Nodetype.BASE, ("int64", 0))),
        ],
    ),
    ASKED: ([], []),
    TOLD: ([], [("success", (Nodetype.BASE, ("bool", 0))), ("message", (Nodetype.BASE, ("string", 0)))]),
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
def test_hashes_of_types_are_those_of_every_distribution(store: str) -> None:
    types = get_typestore(Stores[f"ROS2_{store}"])
    types.fielddefs.update(SERVICE)
    for kind, digest in TYPE_HASHES.items():
        assert types.hash_rihs01(kind) == f"RIHS01_{digest}"


@given(st.integers(1, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_an_attachment_has_33_bytes_and_comes_back(number: int, sent_unix_ns: int, gid: bytes) -> None:
    sent = Attachment(number, sent_unix_ns, gid)
    assert len(sent.encode()) == 33
    assert sent.encode()[16] == 0x10
    assert parse_attachment(sent.encode()) == sent


@given(st.binary(max_size=70))
def test_what_is_no_attachment_is_none(data: bytes) -> None:
    found = parse_attachment(data)
    assert found is None or found.encode() == data


def test_names_of_endpoints_differ() -> None:
    tokens = [
        LISTENER.endpoint_token(n, EndpointKind.PUBLISHER, "a", STRING, STRING_HASH, QualityOfService())
        for n in range(50)
    ]
    assert len({make_gid(token) for token in tokens}) == 50
    assert {len(make_gid(token)) for token in tokens} == {16}


@pytest.mark.parametrize("name", ["", "/", "a//b", "a-b", "1a", "a/1", "a/", "é"])
def test_a_name_that_ros_refuses_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="is no name of ROS 2"):
        check_ros_name(name, "session")


def test_a_name_of_ros_is_taken_without_its_slash() -> None:
    assert check_ros_name("/lab/arm_1", "session") == "lab/arm_1"
