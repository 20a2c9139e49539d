"""Exchanges messages with ROS 2 programs over Zenoh, without a ROS installation.

ROS 2 programs that use the middleware rmw_zenoh exchange their messages over Zenoh, a library
that transports messages over a network. `Ros2Graph` opens its own Zenoh session as a client of
ROS's router (rmw_zenohd) or another Zenoh router, and uses the same wire format. To ROS
programs it appears as a node with topics and services, as if this program used a ROS library.

The wire format has three elements:

- One key per topic: domain / name / DDS type / hash of the type's definition.
- An attachment of 33 bytes per message: the message number, the time of sending, and an
  identifier of the sender.
- One liveliness token per node and per endpoint, which announces it to other programs.

Source: ros2/rmw_zenoh, docs/develop/design.md and rmw_zenoh_cpp/src/detail (at 99a6a2bd).

Invariant:
    - Every message has an attachment, and its number is at least 1. A ROS program aborts if it
      receives a message whose attachment it cannot parse.
    - No part of a ROS name is empty, because a token must not have empty parts.
    - Messages from ROS programs never raise an error in this process. Messages without an
      attachment are counted and skipped.
    - Publishing never delays the caller. If the network cannot keep up, messages are dropped.
"""

import hashlib
import struct
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from enum import StrEnum
from typing import Any, NamedTuple, ParamSpec

import zenoh
from zenoh import CongestionControl, Reliability, handlers

from ...errors import TrilatError, UsageError
from .. import Clock, Endpoint, check_hosts, open_zenoh

TYPE_HASHES = {
    "diagnostic_msgs/msg/DiagnosticArray": (
        "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
    ),
    "geometry_msgs/msg/PoseStamped": (
        "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
    ),
    "geometry_msgs/msg/TwistStamped": (
        "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
    ),
    "geometry_msgs/msg/WrenchStamped": (
        "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"
    ),
    "rcl_interfaces/msg/Log": (
        "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac"
    ),
    "sensor_msgs/msg/JointState": (
        "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    ),
    "std_msgs/msg/Float64MultiArray": (
        "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f"
    ),
    "std_msgs/msg/String": ("df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    "std_srvs/srv/Trigger": (
        "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
    ),
    "tf2_msgs/msg/TFMessage": (
        "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    ),
}
"""SHA-256 of each type's definition (REP 2016). It is the same from ROS 2 Iron to Lyrical."""
DISTROS = ("humble", "jazzy", "kilted", "lyrical")
"""ROS 2 distributions with which messages can be exchanged."""
_NO_HASH = "TypeHashNotSupported"
"""String that ROS 2 Humble writes in place of the hash of a message type."""
P = ParamSpec("P")
_ATTACHMENT = struct.Struct("<qqB16s")
"""Layout of an attachment: number, time of sending, length of the identifier, and identifier.
"""
_GID_BYTES = 16


class EndpointKind(StrEnum):
    """Kind of an endpoint of a ROS 2 node: a publisher, a subscription, or a service.

    The value is the string that denotes this kind in the endpoint's liveliness token, a key
    that announces the endpoint to other programs.
    """

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"


class QualityOfService(NamedTuple):
    """Quality of service of a publisher, subscription or service, as defined by ROS 2.

    Attributes:
        reliable: True if lost messages are resent until they arrive.
        latched: True if late subscribers receive the most recent messages ("transient local").
        depth: Number of messages that are kept.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10

    def encode(self) -> str:
        """Encodes the quality of service for use in a liveliness token.

        As in ROS 2 itself, values equal to the defaults are left out.
        """
        reliability = "" if self.reliable else "2"
        durability = "1" if self.latched else ""
        depth = "" if self.depth == 42 else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


class Attachment(NamedTuple):
    """Sender, number and time that ROS 2 programs attach to every Zenoh message.

    Attributes:
        number: Number of the message, from 1.
        sent_unix_ns: Time of sending, in ns of Unix time.
        gid: 16 bytes that identify the sender. In a response, they identify the sender of the
            request.
    """

    number: int
    sent_unix_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Encodes the number, time and sender of a message as 33 bytes in the ROS 2 format."""
        return _ATTACHMENT.pack(self.number, self.sent_unix_ns, _GID_BYTES, self.gid)

    @classmethod
    def decode(cls, content: Any) -> "Attachment | None":
        """Decodes the number, time and sender that ROS 2 attaches to each Zenoh message.

        Args:
            content: The bytes, or the `ZBytes` object of Zenoh. None if the message has no
                attachment.

        Returns:
            The attachment, or None if there is none or it is not in the ROS format.
        """
        data = b"" if content is None else bytes(content)
        if len(data) != _ATTACHMENT.size:
            return None
        number, sent_unix_ns, gid_length, gid = _ATTACHMENT.unpack(data)
        if gid_length != _GID_BYTES:
            return None
        return cls(number, sent_unix_ns, gid)


def find_type_hash(kind: str, distro: str) -> str:
    """Returns the hash that identifies a version of a message type in a ROS 2 distribution.

    Args:
        kind: Name of the type, such as "std_msgs/msg/String".
        distro: Name of the distribution, one of `DISTROS`.
    """
    return _NO_HASH if distro == "humble" else f"RIHS01_{TYPE_HASHES[kind]}"


def _name_dds_type(kind: str) -> str:
    """Returns the name of a ROS message type in DDS notation.

    Over Zenoh, ROS uses this notation in the keys of messages, and in the tokens that announce
    publishers and subscriptions. For example, "std_msgs/msg/String" becomes
    "std_msgs::msg::dds_::String_".

    Args:
        kind: Name of the message type in ROS.
    """
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


class Ros2Member(NamedTuple):
    """Address of a ROS 2 node, used to compose its liveliness tokens.

    A liveliness token is a key that announces a node, or one of its endpoints, to other
    programs.

    Attributes:
        domain: Number of the ROS domain (ROS_DOMAIN_ID). Nodes in other domains are invisible.
        zid: Identity of the node's Zenoh session.
        namespace: Namespace of the node. Empty for the root namespace.
        name: Name of the node.
    """

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """Returns the liveliness token that announces the node to ROS 2 programs.

        The node is visible to them for as long as this program declares the token to Zenoh.
        """
        return f"@ros2_lv/{self.domain}/{self.zid}/0/0/NN/{self._path()}"

    def endpoint_token(
        self,
        number: int,
        end: EndpointKind,
        name: str,
        kind: str,
        type_hash: str,
        qos: QualityOfService,
    ) -> str:
        """Returns the liveliness token of one publisher, subscription or service of the node.

        Args:
            number: Number of the endpoint, unique within the Zenoh session.
            end: Kind of the endpoint.
            name: Name of the topic or service.
            kind: Name of its type, such as "std_msgs/msg/String".
            type_hash: Hash of that type, which differs between versions of the type.
            qos: Quality of service, such as whether lost messages are resent.
        """
        node = f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{end}/{self._path()}"
        return f"{node}/{_mangle('/' + name)}/{_name_dds_type(kind)}/{type_hash}/{qos.encode()}"

    def topic_key(self, name: str, kind: str, type_hash: str) -> str:
        """Returns the Zenoh key under which the messages of a ROS topic or service are sent.

        Args:
            name: Name of the topic or service.
            kind: Name of its type, such as "std_msgs/msg/String".
            type_hash: Hash of the type, which differs between versions of the type.
        """
        return f"{self.domain}/{name}/{_name_dds_type(kind)}/{type_hash}"

    def describe_mismatch(self, token: str, kind: str) -> str:
        """Explains why messages from a publisher do not reach a subscription of this node.

        Args:
            token: Liveliness token of the publisher.
            kind: Message type of the subscription.

        Returns:
            The end of a sentence that names the difference. Empty if the publisher matches.
        """
        _, token_domain, *_, token_type, token_hash, _ = token.split("/")
        if token_domain != str(self.domain):
            return f"in domain {token_domain}, but this subscription is in domain {self.domain}"
        if token_type != _name_dds_type(kind):
            return f"as {token_type}, but this subscription expects {_name_dds_type(kind)}"
        if token_hash not in (find_type_hash(kind, "jazzy"), _NO_HASH):
            return f"with another definition of {kind}, {token_hash}"
        return ""

    def _path(self) -> str:
        """Returns the part of liveliness tokens that names the node, "%/NAMESPACE/NAME".

        The first % stands for the root enclave, to which security rules may be attached. A node
        with no namespace has a % in place of the namespace.
        """
        namespace = _mangle("/" + self.namespace) if self.namespace else "%"
        return f"%/{namespace}/{self.name}"


def _mangle(name: str) -> str:
    """Returns a name as written in ROS 2 tokens: "/arm/joints" becomes "%arm%joints".

    This is necessary because a token is itself a path whose parts are separated by slashes.
    """
    return name.replace("/", "%")


def make_gid(token: str) -> bytes:
    """Derives the 16 bytes that identify a ROS 2 publisher or subscriber from its token.

    Args:
        token: Liveliness token of the endpoint, which is unique.
    """
    return hashlib.sha256(token.encode()).digest()[:_GID_BYTES]


_SETTINGS = {"timestamping": {"enabled": {"client": True}}}
"""Zenoh settings of the session.

Messages need time stamps, which late subscribers of a latched topic use to find the most recent
messages.
"""
SENSOR = QualityOfService(reliable=False, depth=5)
"""Quality of service of all subscriptions of this program.

It requests unreliable delivery, which every publisher can provide. ROS would not connect a
subscription that requests reliable delivery to an unreliable publisher.
"""


_MAX_REASONS = 64
"""Number of reasons that are counted separately.

The number is limited because reasons contain text from other programs, which may differ every
time.
"""


class Refusals:
    """Counts the messages from ROS programs that could not be used, grouped by reason.

    A faulty ROS program cannot stop this process, because errors in its messages are only
    counted and reported to the user.

    Args:
        report: Function that receives a sentence when a reason occurs for the first time.

    Attributes:
        counts: Mapping from reason to number of rejected messages.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()
        self._report = report
        self._lock = threading.Lock()

    def add(self, reason: str) -> None:
        """Counts a rejected message, and informs the user when a reason first occurs.

        Safe to call from any thread.

        Args:
            reason: Why the message was rejected.
        """
        with self._lock:
            if reason not in self.counts and len(self.counts) >= _MAX_REASONS:
                reason = "further reasons, which are counted together"
            self.counts[reason] += 1
            is_first = self.counts[reason] == 1
        if is_first:
            self._report(f"refused: {reason}")

    def guard(self, topic: str, act: Callable[P, None]) -> Callable[P, None]:
        """Wraps a function that processes messages, counting its errors as rejected messages.

        Args:
            topic: Name of the topic of the messages, which is put in front of each reason.
            act: Function that processes a message. It raises ValueError or TrilatError to
                reject the message.

        Returns:
            A function with the same arguments that does not raise these errors.
        """

        def guarded(*args: P.args, **named: P.kwargs) -> None:
            """Passes a message to `act`, and counts it as rejected if `act` raises an error.

            Otherwise, the error would go unnoticed in a thread of Zenoh.
            """
            try:
                act(*args, **named)
            except (ValueError, TrilatError) as error:
                self.add(f"{topic} {error}")

        return guarded


class TopicPublisher:
    """Publishes messages on one ROS 2 topic, to which ROS programs can subscribe.

    Created by `Ros2Graph.publisher`.

    Args:
        declared: The publisher object of Zenoh.
        gid: 16 bytes that identify the publisher to ROS 2 programs, see `make_gid`.
        clock: Clock for the times of sending.
        latched: True if late subscribers receive the most recent messages.
    """

    def __init__(
        self,
        declared: Any,
        gid: bytes,
        clock: Clock,
        *,
        latched: bool,
    ) -> None:
        """Stores a publisher for a ROS 2 topic, whose messages are numbered from 1."""
        self._declared = declared
        self._gid = gid
        self._clock = clock
        self._latched = latched
        self._number = 0

    @property
    def has_subscribers(self) -> bool:
        """True if a message would be received by anyone, and is therefore worth composing.

        Always True for a latched topic, whose last message is delivered to later subscribers.
        """
        return self._latched or bool(self._declared.matching_status.matching)

    def put(self, data: bytes) -> None:
        """Publishes a message on the topic, with the next number and the time of sending.

        Args:
            data: The message, encoded in CDR (the binary format of ROS 2).
        """
        self._number += 1
        attachment = Attachment(self._number, self._clock.unix_ns(), self._gid)
        self._declared.put(data, attachment=attachment.encode())


ROUTER_ADVICE = (
    "start it by: ros2 run rmw_zenoh_cpp rmw_zenohd, or without ROS by: "
    "trilat router --listen tcp/127.0.0.1:7447"
)
"""How to start the router that ROS needs."""


class Ros2Graph:
    """A ROS 2 node of this program, with its publishers, subscriptions and services.

    The bridge creates one node per session. Use it as a context manager to remove the node at
    the end.

    Args:
        refusals: Counts the rejected messages.
        routers: Endpoints of the router of ROS. The first one that answers is used.
        namespace: Namespace of the node.
        name: Name of the node.
        clock: Clock for the times of sending.
        domain: Number of the ROS domain (ROS_DOMAIN_ID). Nodes in other domains are invisible.
        distro: Distribution of ROS 2, one of `DISTROS`. It determines the format of type
            hashes.

    Raises:
        SessionError: No router answers (yet).
        UsageError: An endpoint is invalid, or belongs to a program that is not a router.
    """

    def __init__(
        self,
        refusals: Refusals,
        routers: Sequence[Endpoint],
        namespace: str,
        name: str,
        clock: Clock,
        domain: int = 0,
        distro: str = "jazzy",
    ) -> None:
        """Connects to a Zenoh router of ROS 2, and announces a node to ROS 2 programs."""
        check_hosts(routers)
        self._session = open_zenoh(
            listen=[],
            connect=routers,
            mode="client",
            settings=_SETTINGS,
            silent="no router of ROS answers at {}",
        )

        is_peer_instead_of_router = not self.connected and self._session.info.peers_zid()
        if is_peer_instead_of_router:
            self._session.close()
            endpoints = ", ".join(map(str, routers))
            raise UsageError(
                f"{endpoints} is not a router and does not forward messages: with --ros, name "
                "the ROS router (ros2 run rmw_zenoh_cpp rmw_zenohd, at port 7447), or a router "
                "that was started with trilat router"
            )

        self._node = Ros2Member(domain, str(self._session.zid()), namespace, name)
        self._distro = distro
        self._clock = clock
        self._endpoints = 0
        self.refusals = refusals
        # Services run in this thread and not in a thread of Zenoh. A thread of Zenoh that still
        # waits when the interpreter ends would abort the process.
        self._service_thread = ThreadPoolExecutor(1, "services")
        # The objects must stay referenced: Zenoh removes what Python has deleted.
        self._declarations: list[Any] = [
            self._session.liveliness().declare_token(self._node.token())
        ]

    def __enter__(self) -> "Ros2Graph":
        return self

    def __exit__(self, *_: object) -> None:
        if not self._session.is_closed():
            self._session.close()
        self._declarations.clear()
        self._service_thread.shutdown(cancel_futures=True)

    @property
    def connected(self) -> bool:
        """True while this program is connected to the Zenoh router of ROS 2.

        If the router is restarted, this is False until the connection is restored.
        """
        return bool(self._session.info.routers_zid())

    def publisher(self, topic: str, kind: str, qos: QualityOfService) -> TopicPublisher:
        """Creates a publisher for a topic, and announces it to ROS programs.

        Args:
            topic: Name of the topic.
            kind: Name of the message type.
            qos: Quality of service, such as whether lost messages are resent.

        Returns:
            The publisher, which sends messages that are encoded in CDR.
        """
        key, gid = self._declare(EndpointKind.PUBLISHER, topic, kind, qos)
        options: dict[str, Any] = {
            "congestion_control": CongestionControl.DROP,
            "reliability": Reliability.RELIABLE if qos.reliable else Reliability.BEST_EFFORT,
        }
        if qos.latched:
            cache = zenoh.ext.CacheConfig(max_samples=qos.depth)
            options |= {"cache": cache, "publisher_detection": True}
            declared: Any = zenoh.ext.declare_advanced_publisher(self._session, key, **options)
        else:
            declared = self._session.declare_publisher(key, **options)
        self._declarations.append(declared)  # late subscribers need the publisher
        return TopicPublisher(declared, gid, self._clock, latched=qos.latched)

    def subscribe(
        self, topic: str, kind: str, receive: Callable[[bytes, Attachment], None]
    ) -> None:
        """Subscribes to a topic, and announces the subscription to ROS programs.

        The subscription is then listed by ROS tools such as `ros2 topic info`. Messages do not
        arrive from a publisher that uses another ROS domain, another message type or another
        version of the type. The user is informed once about each such publisher, see
        `Refusals`.

        Args:
            topic: Name of the topic.
            kind: Name of the message type.
            receive: Function that receives the payload and attachment of each message. It is
                called in a thread of Zenoh. If it raises an error, the message counts as
                rejected.
        """
        self._declare(EndpointKind.SUBSCRIPTION, topic, kind, SENSOR)
        self._report_mismatches(topic, kind)
        receive_or_refuse = self.refusals.guard(topic, receive)

        def receive_sample(sample: zenoh.Sample, attachment: Attachment) -> None:
            receive_or_refuse(sample.payload.to_bytes(), attachment)

        # The key of a topic contains the hash of the message type. Publishers of ROS 2 Humble
        # write a fixed text instead of the hash.
        newer_hash = find_type_hash(kind, "jazzy")
        humble_hash = _NO_HASH
        for type_hash in (newer_hash, humble_hash):
            key = self._node.topic_key(topic, kind, type_hash)
            self._declare_subscriber(key, topic, receive_sample)

    def _report_mismatches(self, topic: str, kind: str) -> None:
        """Reports the publishers of a topic whose messages cannot be received here.

        Every ROS publisher has a liveliness token, a Zenoh key that states its domain, topic
        and message type. The tokens of all publishers of the topic are observed, including
        those that already exist.

        Args:
            topic: Name of the topic.
            kind: Name of the message type that is subscribed to.
        """

        def check_publisher(token: zenoh.Sample) -> None:
            """Counts a rejection if the messages of a new publisher cannot reach this node.

            Zenoh calls this function with the token of each publisher that appears or
            disappears. A mismatch is, for example, another message type on the same topic.
            """
            has_appeared = token.kind == zenoh.SampleKind.PUT
            mismatch = self._node.describe_mismatch(str(token.key_expr), kind)
            if has_appeared and mismatch:
                self.refusals.add(f"{topic} is published {mismatch}")

        handler = handlers.Callback(check_publisher, indirect=False)
        all_publishers = f"@ros2_lv/*/*/*/*/MP/*/*/*/{_mangle('/' + topic)}/**"
        self._declarations.append(
            self._session.liveliness().declare_subscriber(all_publishers, handler, history=True)
        )

    def tap(self, topic: str, receive: Callable[[str, Attachment], None]) -> None:
        """Receives the messages of a topic, of any type, without being listed as a subscriber.

        The subscription is not announced to ROS and does not show up in ROS tools.

        Args:
            topic: Name of the topic.
            receive: Function that receives the type and attachment of each message, in a thread
                of Zenoh.
        """

        def receive_sample(sample: zenoh.Sample, attachment: Attachment) -> None:
            _, dds_type, _ = str(sample.key_expr).rsplit("/", 2)
            receive(dds_type, attachment)

        self._declare_subscriber(f"{self._node.domain}/{topic}/*/*", topic, receive_sample)

    def _declare_subscriber(
        self, key: str, topic: str, receive: Callable[[zenoh.Sample, Attachment], None]
    ) -> None:
        """Creates a Zenoh subscriber that rejects messages without an attachment.

        Args:
            key: Zenoh key, which may contain wildcards.
            topic: Name of the topic, for the reasons given when messages are rejected.
            receive: Function that receives all other messages.
        """

        def receive_sample(sample: zenoh.Sample) -> None:
            """Passes messages from ROS 2 programs to `receive`, and rejects all others."""
            attachment = Attachment.decode(sample.attachment)
            if attachment is None:
                self.refusals.add(f"{topic}: a message without an attachment of ROS")
            else:
                receive(sample, attachment)

        handler = handlers.Callback(receive_sample, indirect=False)
        self._declarations.append(self._session.declare_subscriber(key, handler))

    def serve(self, service: str, kind: str, answer: Callable[[bytes], bytes]) -> None:
        """Offers a service to ROS programs.

        The requests of all services are processed one after another in a separate thread, so
        `answer` may take a while.

        Args:
            service: Name of the service.
            kind: Name of its type, such as "std_srvs/srv/Trigger".
            answer: Function that receives a request and returns the response, both encoded in
                CDR (the binary format of ROS 2).
        """
        key, _ = self._declare(EndpointKind.SERVER, service, kind, QualityOfService())

        def reply(query: zenoh.Query) -> None:
            """Computes and sends the response to a ROS program's request (service call)."""
            # A query ends for its sender only when the query object is dropped.
            with query:
                request = Attachment.decode(query.attachment)
                if request is None or query.payload is None:
                    self.refusals.add(f"{service}: a request without an attachment of ROS")
                    return
                attachment = request._replace(sent_unix_ns=self._clock.unix_ns())
                response = answer(query.payload.to_bytes())
                query.reply(query.key_expr, response, attachment=attachment.encode())

        handler: Any = handlers.Callback(
            lambda query: self._service_thread.submit(reply, query), indirect=False
        )
        self._declarations.append(self._session.declare_queryable(key, handler, complete=True))

    def _declare(
        self,
        end: EndpointKind,
        name: str,
        kind: str,
        qos: QualityOfService,
    ) -> tuple[str, bytes]:
        """Announces a publisher, subscription or service to ROS programs.

        The announcement is a liveliness token, a Zenoh key that exists while this program is
        connected.

        Args:
            end: Kind of the endpoint.
            name: Name of the topic or service.
            kind: Name of its type.
            qos: Quality of service.

        Returns:
            The Zenoh key of the endpoint, and the 16 bytes that identify it.
        """
        self._endpoints += 1
        type_hash = find_type_hash(kind, self._distro)
        token = self._node.endpoint_token(
            number=self._endpoints, end=end, name=name, kind=kind, type_hash=type_hash, qos=qos
        )
        self._declarations.append(self._session.liveliness().declare_token(token))
        return self._node.topic_key(name, kind, type_hash), make_gid(token)
