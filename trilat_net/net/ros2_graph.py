"""A member of the graph of ROS 2 over Zenoh, as rmw_zenoh has it on the wire; no ROS is needed.

It has a Zenoh session of its own, as a client of ROS's router (rmw_zenohd) or of any other.

Source: ros2/rmw_zenoh, docs/design.md and rmw_zenoh_cpp/src/detail (at 99a6a2bd).

Invariant: every message bears an attachment of 33 bytes, since a peer aborts at one that it
cannot parse. Its numbers begin at 1. A name of ROS has no empty part, so that no token has one
either. Nothing that comes from ROS raises here: what bears no attachment is counted and passed
over. A publisher drops a message rather than delay its caller.
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
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "rcl_interfaces/msg/Log": "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs/msg/Float64MultiArray": "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""By type the SHA-256 of its definition (REP 2016), the same in Iron to Lyrical."""
DISTROS = ("humble", "jazzy", "kilted", "lyrical")
_NO_HASH = "TypeHashNotSupported"
"""What Humble writes in place of a hash."""
P = ParamSpec("P")
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


class EndpointKind(StrEnum):
    """What an endpoint of a node is, as its token says it."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"


class QualityOfService(NamedTuple):
    """Quality of service of an endpoint.

    Attributes:
        reliable: whether messages are sent again until they arrive.
        latched: whether who comes later gets the last ones (transient local).
        depth: how many are kept.
    """

    reliable: bool = True
    latched: bool = False
    depth: int = 10

    def encode(self) -> str:
        """Returns it as tokens have it; what is the default of ROS 2 is left out."""
        depth = "" if self.depth == 42 else self.depth
        return f"{'' if self.reliable else 2}:{1 if self.latched else ''}:,{depth}:,:,:,,"


class Attachment(NamedTuple):
    """What comes with every message, request and reply.

    Attributes:
        number: of the message, from 1 on.
        gid: 16 bytes that name the sender; of a reply, who asked.
    """

    number: int
    sent_unix_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Returns its 33 bytes."""
        return _ATTACHMENT.pack(self.number, self.sent_unix_ns, _GID_BYTES, self.gid)


def parse_attachment(found: Any) -> Attachment | None:
    """Returns the attachment in some bytes, or in those of Zenoh; None if it is none."""
    data = b"" if found is None else bytes(found)
    if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
        return None
    number, sent_unix_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(number, sent_unix_ns, gid)


def find_type_hash(kind: str, distro: str) -> str:
    """Returns the hash of a type as a distribution of ROS 2 writes it."""
    return _NO_HASH if distro == "humble" else f"RIHS01_{TYPE_HASHES[kind]}"


def name_dds_type(kind: str) -> str:
    """Returns a type as keys and tokens have it: `std_msgs::msg::dds_::String_` of
    `std_msgs/msg/String`.
    """
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def topic_key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """Returns the key of a topic, or of a service."""
    return f"{domain}/{name}/{name_dds_type(kind)}/{type_hash}"


class GraphPlace(NamedTuple):
    """A node of ROS: its domain, the identity of its Zenoh session, its namespace and name."""

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """Returns the token by which others see it."""
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
        """Returns the token of one of its endpoints; its number is its own in the session."""
        about = f"{_mangle('/' + name)}/{name_dds_type(kind)}/{type_hash}/{qos.encode()}"
        return f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{end}/{self._path()}/{about}"

    def _path(self) -> str:
        return f"%/{_mangle('/' + self.namespace) if self.namespace else '%'}/{self.name}"


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def find_misfit(token: str, domain: int, kind: str) -> str:
    """Returns where a publisher, by its token, differs from a domain and a type; "" if it fits
    both.
    """
    _, its_domain, *_, its_type, its_hash, _ = token.split("/")
    if its_domain != str(domain):
        return f"in domain {its_domain}, and this is domain {domain}"
    if its_type != name_dds_type(kind):
        return f"as {its_type}, and here it is {name_dds_type(kind)}"
    known = its_hash in (find_type_hash(kind, "jazzy"), _NO_HASH)
    return "" if known else f"with another definition of {kind}, {its_hash}"


def make_gid(token: str) -> bytes:
    """Returns 16 bytes that name an endpoint."""
    return hashlib.sha256(token.encode()).digest()[:_GID_BYTES]


_SETTINGS = {"timestamping": {"enabled": {"client": True}}}
"""A latched topic tells by their times which of its messages are the last."""
SENSOR = QualityOfService(reliable=False, depth=5)
"""What a subscription asks for: it matches every publisher."""


_MOST_REASONS = 64
"""Of refusals that are told apart, since strangers may invent further ones."""


class Refusals:
    """What came from ROS and was not taken: counted by its reason; the first of each reason is
    said.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.counts: Counter[str] = Counter()
        self._say = say
        self._lock = threading.Lock()

    def add(self, reason: str) -> None:
        """Counts one, in whatever thread."""
        with self._lock:
            if reason not in self.counts and len(self.counts) >= _MOST_REASONS:
                reason = "further reasons, which are counted together"
            self.counts[reason] += 1
            first = self.counts[reason] == 1
        if first:
            self._say(f"refused: {reason}")

    def guard(self, topic: str, act: Callable[P, None]) -> Callable[P, None]:
        """Returns what does as `act`, and counts what it raises as refusals of a topic."""

        def guarded(*args: P.args, **named: P.kwargs) -> None:
            try:
                act(*args, **named)
            except (ValueError, TrilatError) as error:
                self.add(f"{topic} {error}")

        return guarded


class TopicPublisher:
    """Publishes on a topic."""

    def __init__(self, declared: Any, gid: bytes, clock: Clock, *, latched: bool) -> None:
        self._declared = declared
        self._gid = gid
        self._clock = clock
        self._latched = latched
        self._number = 0

    @property
    def has_subscribers(self) -> bool:
        """True while somebody listens, or may come later: else a message need not be made."""
        return self._latched or bool(self._declared.matching_status.matching)

    def put(self, data: bytes) -> None:
        """Publishes a message."""
        self._number += 1
        attachment = Attachment(self._number, self._clock.unix_ns(), self._gid)
        self._declared.put(data, attachment=attachment.encode())


class Ros2Graph:
    """The graph of ROS as one node of it sees it; a context, which takes that node from the
    graph.

    Args:
        refusals: takes what comes and cannot be taken.
        routers: endpoints of ROS's router, of which the first that answers is taken.
        namespace, name: of the node.
        domain: ROS_DOMAIN_ID.
        distro: of `DISTROS`, the distribution of ROS 2 whose form it writes.

    Raises:
        RouterSilent: no router answers, or not yet.
        UsageError: an endpoint cannot be right, or is that of a program that forwards nothing.
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
            raise UsageError(
                f"{', '.join(map(str, routers))} is no router, and forwards nothing: with --ros name that of "
                "ROS (ros2 run rmw_zenoh_cpp rmw_zenohd, at port 7447), or trilat router"
            )
        self._place = GraphPlace(domain, str(self._session.zid()), namespace, name)
        self._distro = distro
        self._clock = clock
        self._endpoints = 0
        self.refusals = refusals
        # not Zenoh's own thread for it: one that waits there when the interpreter ends aborts the process
        self._answers = ThreadPoolExecutor(1, "services")
        self._kept: list[Any] = [self._session.liveliness().declare_token(self._place.token())]

    def __enter__(self) -> "Ros2Graph":
        return self

    def __exit__(self, *_: object) -> None:
        if not self._session.is_closed():
            self._session.close()
        self._kept.clear()
        self._answers.shutdown(cancel_futures=True)

    @property
    def connected(self) -> bool:
        """False while the router is gone; it is joined again when it comes back."""
        return bool(self._session.info.routers_zid())

    def publisher(self, topic: str, kind: str, qos: QualityOfService) -> TopicPublisher:
        """Returns what publishes messages of a type, in CDR, on a topic."""
        key, gid = self._declare(EndpointKind.PUBLISHER, topic, kind, qos)
        how: dict[str, Any] = {
            "congestion_control": CongestionControl.DROP,
            "reliability": Reliability.RELIABLE if qos.reliable else Reliability.BEST_EFFORT,
        }
        if qos.latched:
            cache = zenoh.ext.CacheConfig(max_samples=qos.depth)
            how |= {"cache": cache, "publisher_detection": True}
            declared: Any = zenoh.ext.declare_advanced_publisher(self._session, key, **how)
        else:
            declared = self._session.declare_publisher(key, **how)
        self._kept.append(declared)  # else who comes later would find nobody
        return TopicPublisher(declared, gid, self._clock, latched=qos.latched)

    def subscribe(
        self, topic: str, kind: str, take: Callable[[bytes, Attachment], None]
    ) -> None:
        """Gives the messages of a topic to `take`, in a thread of Zenoh's; what that raises is
        refused.

        Publishers of another domain, type or definition are named by their tokens, and not
        heard.
        """
        self._declare(EndpointKind.SUBSCRIPTION, topic, kind, SENSOR)
        guarded = self.refusals.guard(topic, take)

        def seen(sample: zenoh.Sample) -> None:
            misfit = find_misfit(str(sample.key_expr), self._place.domain, kind)
            if sample.kind == zenoh.SampleKind.PUT and misfit:
                self.refusals.add(f"{topic} is published {misfit}")

        watcher = handlers.Callback(seen, indirect=False)
        everywhere = f"@ros2_lv/*/*/*/*/MP/*/*/*/{_mangle('/' + topic)}/**"
        self._kept.append(
            self._session.liveliness().declare_subscriber(everywhere, watcher, history=True)
        )

        def heard(sample: zenoh.Sample, attachment: Attachment) -> None:
            guarded(sample.payload.to_bytes(), attachment)

        for type_hash in (find_type_hash(kind, "jazzy"), _NO_HASH):
            self._listen(topic_key(self._place.domain, topic, kind, type_hash), topic, heard)

    def tap(self, topic: str, take: Callable[[str, Attachment], None]) -> None:
        """Gives the type and the attachment of every message of a topic to `take`, in a thread
        of Zenoh's.

        It listens unseen: no subscription of it is in the graph.
        """

        def heard(sample: zenoh.Sample, attachment: Attachment) -> None:
            take(str(sample.key_expr).rsplit("/", 2)[1], attachment)

        self._listen(f"{self._place.domain}/{topic}/*/*", topic, heard)

    def _listen(
        self, key: str, topic: str, take: Callable[[zenoh.Sample, Attachment], None]
    ) -> None:

        def heard(sample: zenoh.Sample) -> None:
            attachment = parse_attachment(sample.attachment)
            if attachment is None:
                self.refusals.add(f"{topic}: a message without an attachment of ROS")
            else:
                take(sample, attachment)

        self._kept.append(
            self._session.declare_subscriber(key, handlers.Callback(heard, indirect=False))
        )

    def serve(self, service: str, kind: str, answer: Callable[[bytes], bytes]) -> None:
        """Answers the requests of a service, one after another with those of others, in a
        thread for them.
        """
        key, _ = self._declare(EndpointKind.SERVER, service, kind, QualityOfService())

        def reply(query: zenoh.Query) -> None:
            with query:  # it ends for its sender only when it is dropped
                asked = parse_attachment(query.attachment)
                if asked is None or query.payload is None:
                    self.refusals.add(f"{service}: a request without an attachment of ROS")
                    return
                told = asked._replace(sent_unix_ns=self._clock.unix_ns())
                query.reply(
                    query.key_expr, answer(query.payload.to_bytes()), attachment=told.encode()
                )

        handler: Any = handlers.Callback(
            lambda query: self._answers.submit(reply, query), indirect=False
        )
        self._kept.append(self._session.declare_queryable(key, handler, complete=True))

    def _declare(
        self, end: EndpointKind, name: str, kind: str, qos: QualityOfService
    ) -> tuple[str, bytes]:
        self._endpoints += 1
        type_hash = find_type_hash(kind, self._distro)
        token = self._place.endpoint_token(
            number=self._endpoints, end=end, name=name, kind=kind, type_hash=type_hash, qos=qos
        )
        self._kept.append(self._session.liveliness().declare_token(token))
        return topic_key(self._place.domain, name, kind, type_hash), make_gid(token)
