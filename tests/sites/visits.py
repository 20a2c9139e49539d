"""A ping of a session that starts or runs, on the clock of a party of members."""

from collections.abc import Callable
from functools import partial

from tests.net.manual_clock import ManualClock
from tests.net.parties import SESSION, Party
from tests.net.waiting import sleep_for_ns
from trilat_net.app.ros2_ping import TopicDelays
from trilat_net.app.session_ping import PingReport, SessionPing
from trilat_net.net import topics
from trilat_net.net.clock import SkewedClock
from trilat_net.net.messages import VERSION, LinkStats
from trilat_net.net.ros2.ros2_graph import Attachment
from trilat_net.net.wire import encode

S = 1_000_000_000


class Visit:
    def __init__(self, party: Party, count: int = 10) -> None:
        self._party = party
        self.begun_ns = party.clock.monotonic_ns()
        self.probe = SessionPing(party.network.join(), party.clock, SESSION, count)

    def look(self, timeout_ns: int = S) -> SessionPing:
        for n in range(2_000_000_000):
            if self.probe.is_over(timeout_ns, self.begun_ns):
                break
            self.probe.poll()
            if n % 10 == 0:
                for member in self._party.members.values():
                    member.poll()
            sleep_for_ns(self._party.clock, 2_000_000)
        return self.probe


def link_stats() -> LinkStats:
    counts = {
        name: {} for name in ("age_us", "accepted", "late", "duplicate", "refused", "dropped")
    }
    zeros = dict.fromkeys(("overruns", "late_max_us", "busy_max_us"), 0)
    facts = {"v": VERSION, "site": "m", "boot": 1, "tick": 5, "t_ns": 5, "mode": "run"}
    return LinkStats(**facts, **counts, **zeros, delay_us={"s": 120})


def ping_sites() -> PingReport:
    party = Party(("m", "s"))
    party.start("m")
    party.start("s", on_clock=SkewedClock(party.clock, 3 * S, 50_000))
    visit = Visit(party)
    party.say("m", encode(link_stats()), topics.LINK)
    return visit.look().report()


class Publishers:
    """A graph of ROS with two publishers of a topic; the second one loses a third of its messages."""

    def tap(self, topic: str, take: Callable[[str, Attachment], None]) -> None:
        del topic
        self._take = take
        self._n = 0

    def publish(self, clock: ManualClock) -> bool:
        """Publishes at one instant; the first takes 2 ms, and every tenth message 12 ms."""
        self._n += 1
        kind = "std_msgs::msg::dds_::String_"
        now_ns = clock.unix_ns()
        late_ns = 12_000_000 if self._n % 10 == 0 else 2_000_000
        self._take(kind, Attachment(self._n, now_ns - late_ns, b"a" * 16))
        if self._n % 3:  # its clock is ahead
            self._take(kind, Attachment(self._n, now_ns + 5_000, b"b" * 16))
        return False


def ping_publishers(lasts_s: float = 2.0) -> TopicDelays:
    """Returns the measured delays of these publishers, a message every 10 ms."""
    graph = Publishers()
    clock = ManualClock(0, 10**18)
    stopped = partial(graph.publish, clock)
    return TopicDelays.measure(graph, clock, "chatter", lasts_s, stopped)  # type: ignore[arg-type]
