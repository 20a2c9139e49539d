"""A node of ROS 2 over a Zenoh session of its own, a client of ROS's router (rmw_zenohd) or of any other.

Invariant: nothing that comes from ROS raises here: what bears no attachment is counted and passed over. A
publisher drops a message rather than delay its caller.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import zenoh
from zenoh import CongestionControl, Reliability, handlers

from ..errors import UsageError
from .ros2_wire import (
    Attachment,
    EndpointKind,
    NodeName,
    QualityOfService,
    find_type_hash,
    make_gid,
    parse_attachment,
    topic_key,
)
from .zenoh_bus import RouterSilent
from .zenoh_config import Endpoint, make_zenoh_config

_OWN = {"timestamping": {"enabled": {"client": True}}}
"""A latched topic tells by their times which of its messages are the last."""
SENSOR = QualityOfService(reliable=False, depth=5)
"""What a subscription asks for: it matches every publisher."""


class Ros2Node:
    """A node; a context, which takes it from the graph.

    Args:
        routers: endpoints of ROS's router, of which the first that answers is taken.
        namespace, name: of the node.
        domain: ROS_DOMAIN_ID.
        distro: of `DISTROS`, the distribution of ROS 2 whose form it writes.

    Attributes:
        passed_over: how many messages of others were not taken, by their reason.

    Raises:
        RouterSilent: no router answers, or not yet.
        UsageError: an endpoint cannot be right.
    """

    def __init__(
        self, routers: Sequence[Endpoint], namespace: str, name: str, domain: int = 0, distro: str = "jazzy"
    ) -> None:
        try:
            config = make_zenoh_config([], routers, "client", _OWN)
            self._session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            if "Unable to connect" in str(error):
                raise RouterSilent(f"no router of ROS answers at {', '.join(map(str, routers))}") from None
            raise UsageError(f"cannot open a session with {', '.join(map(str, routers))}: {error}") from None
        self._node = NodeName(domain, str(self._session.zid()), namespace, name)
        self._distro, self._endpoints = distro, 0
        self.passed_over: Counter[str] = Counter()
        self._kept: list[Any] = [self._session.liveliness().declare_token(self._node.token())]

    def __enter__(self) -> "Ros2Node":
        return self

    def __exit__(self, *_: object) -> None:
        if not self._session.is_closed():
            self._session.close()

    def publisher(self, topic: str, kind: str, qos: QualityOfService) -> Callable[[bytes], None]:
        """Returns what publishes messages of a type, in CDR, on a topic."""
        key, gid = self._declare(EndpointKind.PUBLISHER, topic, kind, qos)
        how: dict[str, Any] = {
            "congestion_control": CongestionControl.DROP,
            "reliability": Reliability.RELIABLE if qos.reliable else Reliability.BEST_EFFORT,
        }
        publisher: Any
        if qos.latched:
            cache = zenoh.ext.CacheConfig(max_samples=qos.depth)
            publisher = zenoh.ext.declare_advanced_publisher(
                self._session, key, cache=cache, publisher_detection=True, **how
            )
        else:
            publisher = self._session.declare_publisher(key, **how)
        self._kept.append(publisher)
        number = 0

        def publish(data: bytes) -> None:
            nonlocal number
            number += 1
            publisher.put(data, attachment=Attachment(number, time.time_ns(), gid).encode())

        return publish

    def subscribe(self, topic: str, kind: str, take: Callable[[bytes, Attachment], None]) -> None:
        """Gives the messages of a topic, of any version of its type, to `take`, in a thread of Zenoh's."""
        self._declare(EndpointKind.SUBSCRIPTION, topic, kind, SENSOR)

        def heard(sample: zenoh.Sample) -> None:
            attachment = _read_attachment(sample.attachment)
            if attachment is None:
                self.passed_over[f"{topic}: no attachment"] += 1
            else:
                take(sample.payload.to_bytes(), attachment)

        key = topic_key(self._node.domain, topic, kind, "*")
        self._kept.append(self._session.declare_subscriber(key, handlers.Callback(heard, indirect=False)))

    def serve(self, service: str, kind: str, answer: Callable[[bytes], bytes]) -> None:
        """Answers the requests of a service, in a thread of its own."""
        key, _ = self._declare(EndpointKind.SERVER, service, kind, QualityOfService())

        def reply(query: zenoh.Query) -> None:
            with query:  # it ends for its sender only when it is dropped
                asked = _read_attachment(query.attachment)
                if asked is None or query.payload is None:
                    self.passed_over[f"{service}: no attachment"] += 1
                    return
                told = asked._replace(sent_unix_ns=time.time_ns())
                query.reply(query.key_expr, answer(query.payload.to_bytes()), attachment=told.encode())

        handler = handlers.Callback(reply, indirect=True)
        self._kept.append(self._session.declare_queryable(key, handler, complete=True))

    def _declare(self, end: EndpointKind, name: str, kind: str, qos: QualityOfService) -> tuple[str, bytes]:
        """Shows an endpoint to others; returns its key, and what names it in attachments."""
        self._endpoints += 1
        type_hash = find_type_hash(kind, self._distro)
        token = self._node.endpoint_token(self._endpoints, end, name, kind, type_hash, qos)
        self._kept.append(self._session.liveliness().declare_token(token))
        return topic_key(self._node.domain, name, kind, type_hash), make_gid(token)


def _read_attachment(found: Any) -> Attachment | None:
    return None if found is None else parse_attachment(found.to_bytes())
