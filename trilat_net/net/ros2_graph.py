"""A node in the graph of ROS 2 over Zenoh, without an installation of ROS.

The node follows the wire format of rmw_zenoh. It has a separate Zenoh session, which is a
client of ROS's router (rmw_zenohd) or of another Zenoh router.

Source: ros2/rmw_zenoh, docs/design.md and rmw_zenoh_cpp/src/detail (at 99a6a2bd).

Invariant:
    - Every message has an attachment of 33 bytes, because a peer aborts at an attachment that
      it cannot parse. The numbers of messages start at 1.
    - A ROS name has no empty part, so that no token has an empty part either.
    - Nothing that arrives from ROS raises an error here. Messages without an attachment are
      counted and skipped.
    - A publisher drops a message rather than delay its caller.
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

from ..errors import TrilatError, UsageError
from .clock import Clock
from .connection import find_endpoint_addresses
from .host_names import check_hosts
from .zenoh_bus import open_zenoh
from .zenoh_config import Endpoint

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
"""SHA-256 of each type's definition (REP 2016), the same from Iron to Lyrical."""
DISTROS = ("humble", "jazzy", "kilted", "lyrical")
_NO_HASH = "TypeHashNotSupported"
"""Text that Humble writes in place of a hash."""
P = ParamSpec("P")
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


class EndpointKind(StrEnum):
    """Kind of a node's endpoint, as its token states it."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"


class QualityOfService(NamedTuple):
    """Quality of service of an endpoint.

    Attributes:
        reliable: True if messages are sent again until they arrive.
        latched: True if late subscribers receive the last messages (transient local).
        depth: number of messages that are kept.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10

    def encode(self) -> str:
        """Returns the text in tokens, which leaves out the defaults of ROS 2."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.latched else ""
        depth = "" if self.depth == 42 else self.depth
        return f"{reliability}:{durability}:,{depth}:,:,:,,"


class Attachment(NamedTuple):
    """Attachment of every message, request and reply.

    Attributes:
        number: number of the message, from 1 on.
        sent_unix_ns: sending time, Unix ns.
        gid: 16 bytes that identify the sender; in a reply, the sender of the request.
    """

    number: int
    sent_unix_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Returns the attachment as 33 bytes."""
        return _ATTACHMENT.pack(self.number, self.sent_unix_ns, _GID_BYTES, self.gid)


def parse_attachment(content: Any) -> Attachment | None:
    """Returns the attachment in bytes, or in `ZBytes` of Zenoh; None if there is none."""
    data = b"" if content is None else bytes(content)
    if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
        return None
    number, sent_unix_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(number, sent_unix_ns, gid)


def find_type_hash(kind: str, distro: str) -> str:
    """Returns the hash of a message type in the form of a ROS 2 distribution."""
    return _NO_HASH if distro == "humble" else f"RIHS01_{TYPE_HASHES[kind]}"


def name_dds_type(kind: str) -> str:
    """Returns the name of a message type in keys and tokens.

    For std_msgs/msg/String that is std_msgs::msg::dds_::String_.
    """
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def topic_key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """Returns the Zenoh key of a topic, or of a service."""
    return f"{domain}/{name}/{name_dds_type(kind)}/{type_hash}"


class Ros2Member(NamedTuple):
    """Address of a node in the graph of ROS.

    Attributes:
        domain: domain of ROS (ROS_DOMAIN_ID).
        zid: identity of the node's Zenoh session.
        namespace: namespace of the node; "" for the root.
        name: name of the node.
    """

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """Returns the liveliness token by which other nodes see this node."""
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
        """Returns the liveliness token of one endpoint of the node.

        Args:
            number: number of the endpoint, unique in the Zenoh session.
            end: kind of the endpoint.
            name: name of the topic or service.
            kind: type of the messages.
            type_hash: hash of that type.
            qos: quality of service.
        """
        node = f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{end}/{self._path()}"
        return f"{node}/{_mangle('/' + name)}/{name_dds_type(kind)}/{type_hash}/{qos.encode()}"

    def _path(self) -> str:
        namespace = _mangle("/" + self.namespace) if self.namespace else "%"
        return f"%/{namespace}/{self.name}"


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def describe_mismatch(token: str, domain: int, kind: str) -> str:
    """Returns how a publisher differs from an expected domain and message type.

    Args:
        token: liveliness token of the publisher.
        domain: expected domain.
        kind: expected message type.

    Returns:
        The end of a sentence; "" if the publisher matches.
    """
    _, token_domain, *_, token_type, token_hash, _ = token.split("/")
    if token_domain != str(domain):
        return f"in domain {token_domain}, and this is domain {domain}"
    if token_type != name_dds_type(kind):
        return f"as {token_type}, and here it is {name_dds_type(kind)}"
    if token_hash not in (find_type_hash(kind, "jazzy"), _NO_HASH):
        return f"with another definition of {kind}, {token_hash}"
    return ""


def make_gid(token: str) -> bytes:
    """Returns 16 bytes that identify an endpoint."""
    return hashlib.sha256(token.encode()).digest()[:_GID_BYTES]


_SETTINGS = {"timestamping": {"enabled": {"client": True}}}
"""Latched topics need time stamps: these tell which messages are the last."""
SENSOR = QualityOfService(reliable=False, depth=5)
"""Quality of service of a subscription that matches every publisher."""


_MAX_REASONS = 64
"""Number of refusal reasons that are counted separately.

The number is limited because reasons contain texts of strangers.
"""


class Refusals:
    """Counts of the messages from ROS that were refused, by reason.

    Args:
        report: receives a text for the first refusal of each reason.

    Attributes:
        counts: number of refusals by reason.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()
        self._report = report
        self._lock = threading.Lock()

    def add(self, reason: str) -> None:
        """Counts a refusal; may be called in any thread."""
        with self._lock:
            if reason not in self.counts and len(self.counts) >= _MAX_REASONS:
                reason = "further reasons, which are counted together"
            self.counts[reason] += 1
            is_first = self.counts[reason] == 1
        if is_first:
            self._report(f"refused: {reason}")

    def guard(self, topic: str, act: Callable[P, None]) -> Callable[P, None]:
        """Returns a function that calls `act`, and counts its errors as refusals of a topic."""

        def guarded(*args: P.args, **named: P.kwargs) -> None:
            try:
                act(*args, **named)
            except (ValueError, TrilatError) as error:
                self.add(f"{topic} {error}")

        return guarded


class TopicPublisher:
    """Publisher of one topic.

    Args:
        declared: Zenoh's publisher.
        gid: 16 bytes that identify the publisher.
        clock: clock of the sending times.
        latched: True if late subscribers receive the last messages.
    """

    def __init__(self, declared: Any, gid: bytes, clock: Clock, *, latched: bool) -> None:
        self._declared = declared
        self._gid = gid
        self._clock = clock
        self._latched = latched
        self._number = 0

    @property
    def has_subscribers(self) -> bool:
        """True while there is a subscriber, or while the topic is latched.

        Otherwise the caller need not compose a message.
        """
        return self._latched or bool(self._declared.matching_status.matching)

    def put(self, data: bytes) -> None:
        """Publishes a message."""
        self._number += 1
        attachment = Attachment(self._number, self._clock.unix_ns(), self._gid)
        self._declared.put(data, attachment=attachment.encode())


class Ros2Graph:
    """The graph of ROS as one node sees it; a context manager, which removes the node on exit.

    Args:
        refusals: counts the messages that are refused.
        routers: endpoints of ROS's router; the first that answers is used.
        namespace: namespace of the node.
        name: name of the node.
        clock: clock of the sending times.
        domain: domain of ROS (ROS_DOMAIN_ID).
        distro: the distribution of ROS 2, one of `DISTROS`, whose type hashes are written.

    Raises:
        RouterSilent: no router answers, or no router answers yet.
        UsageError: an endpoint is invalid, or belongs to a program that forwards nothing.
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
        check_hosts(find_endpoint_addresses(routers))
        self._session = open_zenoh(
            listen=[],
            connect=routers,
            mode="client",
            settings=_SETTINGS,
            silent="no router of ROS answers at {}",
        )
        if not self.connected and self._session.info.peers_zid():
            self._session.close()
            endpoints = ", ".join(map(str, routers))
            raise UsageError(
                f"{endpoints} is no router, and forwards nothing: with --ros name that of ROS "
                "(ros2 run rmw_zenoh_cpp rmw_zenohd, at port 7447), or trilat router"
            )
        self._node = Ros2Member(domain, str(self._session.zid()), namespace, name)
        self._distro = distro
        self._clock = clock
        self._endpoints = 0
        self.refusals = refusals
        # Services do not use a thread of Zenoh: one that waits when the interpreter ends aborts
        # the process.
        self._service_thread = ThreadPoolExecutor(1, "services")
        # Zenoh undeclares an object that is not referenced.
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
        """False while the router is away; the session reconnects when the router is back."""
        return bool(self._session.info.routers_zid())

    def publisher(self, topic: str, kind: str, qos: QualityOfService) -> TopicPublisher:
        """Returns a publisher of messages, encoded in CDR.

        Args:
            topic: name of the topic.
            kind: type of the messages.
            qos: quality of service.
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
        """Subscribes to a topic, with an entry in the graph.

        Messages of publishers with another domain, type or definition do not arrive; such
        publishers are reported once, by their tokens.

        Args:
            topic: name of the topic.
            kind: type of the messages.
            receive: receives each payload and its attachment, in a thread of Zenoh; a message
                for which it raises an error counts as refused.
        """
        self._declare(EndpointKind.SUBSCRIPTION, topic, kind, SENSOR)
        self._report_mismatches(topic, kind)
        receive_guarded = self.refusals.guard(topic, receive)

        def receive_sample(sample: zenoh.Sample, attachment: Attachment) -> None:
            receive_guarded(sample.payload.to_bytes(), attachment)

        for type_hash in (find_type_hash(kind, "jazzy"), _NO_HASH):
            key = topic_key(self._node.domain, topic, kind, type_hash)
            self._declare_subscriber(key, topic, receive_sample)

    def _report_mismatches(self, topic: str, kind: str) -> None:
        """Counts publishers of a topic with another domain or type as refusals."""

        def check_publisher(sample: zenoh.Sample) -> None:
            mismatch = describe_mismatch(str(sample.key_expr), self._node.domain, kind)
            if sample.kind == zenoh.SampleKind.PUT and mismatch:
                self.refusals.add(f"{topic} is published {mismatch}")

        handler = handlers.Callback(check_publisher, indirect=False)
        all_publishers = f"@ros2_lv/*/*/*/*/MP/*/*/*/{_mangle('/' + topic)}/**"
        self._declarations.append(
            self._session.liveliness().declare_subscriber(all_publishers, handler, history=True)
        )

    def tap(self, topic: str, receive: Callable[[str, Attachment], None]) -> None:
        """Receives a topic without an entry in the graph.

        Args:
            topic: name of the topic.
            receive: receives the type and the attachment of every message, in a thread of
                Zenoh.
        """

        def receive_sample(sample: zenoh.Sample, attachment: Attachment) -> None:
            receive(str(sample.key_expr).rsplit("/", 2)[1], attachment)

        self._declare_subscriber(f"{self._node.domain}/{topic}/*/*", topic, receive_sample)

    def _declare_subscriber(
        self, key: str, topic: str, receive: Callable[[zenoh.Sample, Attachment], None]
    ) -> None:
        """Declares a Zenoh subscriber, which refuses messages without an attachment."""

        def receive_sample(sample: zenoh.Sample) -> None:
            attachment = parse_attachment(sample.attachment)
            if attachment is None:
                self.refusals.add(f"{topic}: a message without an attachment of ROS")
            else:
                receive(sample, attachment)

        handler = handlers.Callback(receive_sample, indirect=False)
        self._declarations.append(self._session.declare_subscriber(key, handler))

    def serve(self, service: str, kind: str, answer: Callable[[bytes], bytes]) -> None:
        """Serves a service, in a thread in which all services take turns.

        Args:
            service: name of the service.
            kind: type of the service.
            answer: returns the response to a request.
        """
        key, _ = self._declare(EndpointKind.SERVER, service, kind, QualityOfService())

        def reply(query: zenoh.Query) -> None:
            # A query ends for its sender only when the query object is dropped.
            with query:
                request = parse_attachment(query.attachment)
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
        self, end: EndpointKind, name: str, kind: str, qos: QualityOfService
    ) -> tuple[str, bytes]:
        """Declares the token of an endpoint; returns the endpoint's key and gid."""
        self._endpoints += 1
        type_hash = find_type_hash(kind, self._distro)
        token = self._node.endpoint_token(
            number=self._endpoints, end=end, name=name, kind=kind, type_hash=type_hash, qos=qos
        )
        self._declarations.append(self._session.liveliness().declare_token(token))
        return topic_key(self._node.domain, name, kind, type_hash), make_gid(token)
