"""The wire of ROS 2 over Zenoh (rmw_zenoh): keys, liveliness tokens, quality of service and attachments.

Sources: ros2/rmw_zenoh, docs/design.md and rmw_zenoh_cpp/src/detail (read at 99a6a2bd); no ROS is needed.

Invariant: every message bears an attachment of 33 bytes, since a peer aborts at one that it cannot parse. Its
numbers begin at 1. A name of ROS has no empty part, so that no token has one either.
"""

import hashlib
import re
import struct
from enum import StrEnum
from typing import NamedTuple

from ..errors import UsageError

TYPE_HASHES = {
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
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
MAX_DOMAIN = 232
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


class EndpointKind(StrEnum):
    """What an endpoint of a node is, as its token says it."""

    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVER = "SS"
    CLIENT = "SC"


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
        sent_unix_ns: when it was sent.
        gid: 16 bytes that name the sender; of a reply, who asked.
    """

    number: int
    sent_unix_ns: int
    gid: bytes

    def encode(self) -> bytes:
        """Returns its 33 bytes."""
        return _ATTACHMENT.pack(self.number, self.sent_unix_ns, _GID_BYTES, self.gid)


def parse_attachment(data: bytes) -> Attachment | None:
    """Returns an attachment; None if it is none."""
    if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
        return None
    number, sent_unix_ns, _, gid = _ATTACHMENT.unpack(data)
    return Attachment(number, sent_unix_ns, gid)


def check_ros_name(name: str, what: str) -> str:
    """Returns a name of ROS without the slash before it.

    Raises:
        UsageError: it is none.
    """
    if not _NAME.fullmatch(bare := name.removeprefix("/")):
        raise UsageError(f"{what} {name!r} is no name of ROS 2: letters, digits and _ in parts between /")
    return bare


def find_type_hash(kind: str, distro: str) -> str:
    """Returns the hash of a type as a distribution of ROS 2 writes it."""
    return _NO_HASH if distro == "humble" else f"RIHS01_{TYPE_HASHES[kind]}"


def name_dds_type(kind: str) -> str:
    """Returns a type as keys and tokens have it: `std_msgs::msg::dds_::String_` of `std_msgs/msg/String`."""
    package, group, name = kind.split("/")
    return f"{package}::{group}::dds_::{name}_"


def topic_key(domain: int, name: str, kind: str, type_hash: str) -> str:
    """Returns the key of a topic, or of a service; with the hash `*` that of any version of the type."""
    return f"{domain}/{name}/{name_dds_type(kind)}/{type_hash}"


class NodeName(NamedTuple):
    """A node: its domain, the identity of its Zenoh session, its namespace and name."""

    domain: int
    zid: str
    namespace: str
    name: str

    def token(self) -> str:
        """Returns the token by which others see it."""
        return f"@ros2_lv/{self.domain}/{self.zid}/0/0/NN/{self._place()}"

    def endpoint_token(
        self, number: int, end: EndpointKind, name: str, kind: str, type_hash: str, qos: QualityOfService
    ) -> str:
        """Returns the token of one of its endpoints; its number is its own in the session."""
        about = f"{_mangle('/' + name)}/{name_dds_type(kind)}/{type_hash}/{qos.encode()}"
        return f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{end}/{self._place()}/{about}"

    def _place(self) -> str:
        return f"%/{_mangle('/' + self.namespace) if self.namespace else '%'}/{self.name}"


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def make_gid(token: str) -> bytes:
    """Returns 16 bytes that name an endpoint."""
    return hashlib.sha256(token.encode()).digest()[:_GID_BYTES]
