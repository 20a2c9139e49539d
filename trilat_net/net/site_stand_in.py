"""Stands in for a site whose process is absent, as seen by the other members of a session.

When a log is played back, the recorded messages are published again, but the sites themselves
are not running. To the other members, a `SiteStandIn` looks like the site.

Invariant:
    - The other members see a liveliness token, an identity, and replies to pings and to
      requests for past messages, as if they came from the site itself.
"""

from collections.abc import Callable

import msgspec

from . import topics
from .bus import Bus
from .clock import Clock
from .membership import describe_member
from .pinging import answer_backfill, answer_pings
from .requests import BackfillRequest
from .wire import encode

REFRESH_NS = 500_000_000
"""Time for which an encoded identity is reused, in ns.

Encoding takes long, because an identity contains a complete scenario.
"""


class SiteStandIn:
    """Announces a site in a session, and answers other members on behalf of the site.

    Args:
        bus: Network connection of the process that stands in for the site.
        clock: Clock of that process.
        session: Name of the session.
        site: Name of the site.
        boot: Random number that identifies the start of the site's process.
        fingerprint: Fingerprint of the floating-point arithmetic on the site's platform.
        scenario_text: TOML text of the scenario.

    Attributes:
        boot: Random number that identifies the start of the site's process.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
        boot: int,
        fingerprint: str,
        scenario_text: str,
    ) -> None:
        self.boot = boot
        self._clock = clock
        self._info = describe_member(site, boot, clock, fingerprint, scenario_text)
        # Time at which the identity was encoded, and the encoded identity.
        self._encoded: tuple[int, bytes] = (0, b"")
        self._identity_queries = bus.query_inbox(topics.key(session, site, topics.INFO))
        self._backfill_queries = bus.query_inbox(topics.key(session, site, topics.PAST))
        answer_pings(bus, clock, session, self._info)
        bus.announce(topics.presence_token(session, site, boot))

    def start_session(
        self, epoch_mono_ns: int, epoch_unix_ns: int, boots: dict[str, int]
    ) -> None:
        """Announces the session as running, which makes other members join it.

        Args:
            epoch_mono_ns: Start time of the session (tick 0) on the monotonic clock, in ns.
            epoch_unix_ns: The same time as Unix time, in ns.
            boots: Mapping from site to the random number that identifies the start of its
                process.
        """
        self._info = msgspec.structs.replace(
            self._info,
            running=True,
            epoch_mono_ns=epoch_mono_ns,
            epoch_unix_ns=epoch_unix_ns,
            boots=dict(boots),
        )
        self._encoded = (0, b"")

    def answer_identity_queries(self, count_ticks: Callable[[], int]) -> None:
        """Answers all pending queries for the identity of the site.

        Args:
            count_ticks: Function that returns how many ticks of the site have passed. It is
                called only if the identity has to be encoded again, because a recently encoded
                identity is reused.
        """
        while (query := self._identity_queries.poll()) is not None:
            query.reply(self._encode_identity(count_ticks))

    def _encode_identity(self, count_ticks: Callable[[], int]) -> bytes:
        """Returns the encoded identity of the site, which may be up to `REFRESH_NS` old."""
        encoded_ns, identity = self._encoded
        now_ns = self._clock.monotonic_ns()
        if not identity or now_ns - encoded_ns >= REFRESH_NS:
            identity = encode(msgspec.structs.replace(self._info, ticks=count_ticks()))
            self._encoded = (now_ns, identity)
        return identity

    def answer_backfill_query(
        self,
        find_boot: Callable[[], int],
        find_messages: Callable[[str, int, int], tuple[int, list[bytes], int]],
    ) -> int | None:
        """Answers the oldest request from a recorder for messages that it has missed.

        A recorder follows one start of the site's process, and only accepts replies from that
        start.

        Args:
            find_boot: Function that returns the random number that identifies the start of the
                site whose messages are sent.
            find_messages: Function that looks up messages from their channel and the numbers of
                the first and last one. It returns the number of the first message found, the
                payloads of consecutive messages, and the number of messages that the site has
                published.

        Returns:
            The number of messages in the reply, or None if no request was waiting.
        """
        query = self._backfill_queries.poll()
        if query is None:
            return None

        def find_requested(request: BackfillRequest) -> tuple[int, list[bytes], int]:
            """Looks up the messages that a request asks for."""
            return find_messages(request.channel, request.first, request.last)

        return answer_backfill(query, self._info.member, find_boot(), find_requested)
