"""Measures the delays of messages on a ROS 2 topic, for `trilat ping --ros2`.

ROS 2 is the Robot Operating System. Every message contains the time at which it was sent, so
its delay is known on arrival.

Invariant:
    - The measurement does not disturb the publishers. This process only receives.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import RunFailed, SessionError
from ..net import Clock, SystemClock
from ..net.ros2 import ROUTER_ADVICE, Attachment, Refusals, Ros2Graph, check_ros_name
from ..records import NS_PER_S
from ..results import Result
from ..signals import Interrupt

_POLL_NS = 10_000_000
"""Pause between two checks whether the measurement is over, in ns."""
_BARS = " ▁▂▃▄▅▆▇█"
"""Bars of a histogram in text, by their height in eighths."""
_DELAY_KEYS = ("min", "p50", "p99", "max")


def ping_topic(
    topic: str,
    routers: Sequence[str],
    domain: int,
    lasts_s: float,
    report: Callable[[str], None],
) -> "TopicDelays":
    """Measures the delays of the messages on a ROS 2 topic, received through a Zenoh router.

    Ctrl-C ends the measurement early.

    Args:
        topic: Name of the topic.
        routers: Endpoints of the Zenoh router used by ROS. The first endpoint that answers is
            used.
        domain: ROS domain ID.
        lasts_s: Duration of the measurement, in s.
        report: Function that is called with a sentence about messages that could not be used.

    Raises:
        UsageError: The name of the topic is invalid.
        SessionError: No router answers.
        RunFailed: No program has published on the topic.
    """
    name = check_ros_name(topic, "topic")
    clock = SystemClock()
    try:
        graph = Ros2Graph(
            refusals=Refusals(report),
            routers=routers,
            namespace="",
            name="trilat_ping",
            clock=clock,
            domain=domain,
        )
    except SessionError as silent:
        raise SessionError(f"{silent}; {ROUTER_ADVICE}") from None

    with graph, Interrupt() as interrupt:
        return TopicDelays.measure(graph, clock, name, lasts_s, interrupt.is_requested)


@dataclass(frozen=True, repr=False)
class TopicDelays(Result):
    """Delays of the messages on a ROS 2 topic, for each program that publishes on the topic.

    A delay is the arrival time at this process minus the time stamp of the message. If the
    sender is on another machine, the delay includes the offset between the two clocks.

    Attributes:
        topic: Name of the topic.
        lasted_s: Duration of the measurement, in s.
        publishers: One table row per publisher, with the number and the delays of its messages.
    """

    topic: str
    lasted_s: float
    publishers: list[dict[str, Any]]

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns one table row per program that publishes on the topic.

        Each row contains the number of messages from that program, and their delays.
        """
        return self.publishers

    def blocks(self) -> Iterator[Any]:
        """Yields the table of delays that `trilat ping --ros2` prints.

        There is one row per publishing program. The last column is a histogram of the delays,
        from smallest to largest. The table class is imported inside this method, because a
        program that only reads the results does not need it.
        """
        from ..presentation import TextTable

        duration = f"{self.lasted_s:.3g} s"
        yield f"/{self.topic}, {duration}; times in us, from sending to arrival"

        rows = []
        has_negative_delay = False
        for publisher in self.publishers:
            delays_us = publisher["delay_us"]
            if delays_us["min"] < 0.0:
                has_negative_delay = True

            cells = [
                publisher["gid"][:8],
                publisher["type"],
                str(publisher["messages"]),
                str(publisher["lost"]),
                f"{publisher['rate_hz']:.1f}",
            ]
            cells += [f"{delays_us[key]:.0f}" for key in _DELAY_KEYS]
            cells.append(_draw_histogram(publisher["histogram"]["counts"]))
            rows.append(cells)
        headers = ("publisher", "type", "messages", "lost", "Hz", *_DELAY_KEYS, "min to max")
        yield TextTable(headers, rows, align="llrrrrrrrl")

        if has_negative_delay:
            yield "delays below 0: the publisher's clock is ahead of the clock of this machine"
        yield "between two machines, delays contain the offset of the clocks"

    @classmethod
    def measure(
        cls,
        graph: Ros2Graph,
        clock: Clock,
        topic: str,
        lasts_s: float,
        stopped: Callable[[], bool],
    ) -> "TopicDelays":
        """Measures the delays of messages on a ROS 2 topic, from sending to arrival.

        Receives messages for the given duration, then evaluates them for each publishing
        program.

        Args:
            graph: Connection to the ROS 2 programs.
            clock: Clock of this process.
            topic: Name of the topic.
            lasts_s: Duration of the measurement, in s.
            stopped: Function that returns True to end the measurement early.

        Raises:
            RunFailed: No program has published on the topic.
        """
        # Number and delay of each message, and the type of the messages, by publisher.
        samples: dict[bytes, list[tuple[int, int]]] = {}
        types: dict[bytes, str] = {}

        def receive(kind: str, attachment: Attachment) -> None:
            """Stores the number and the delay of a ROS 2 message under its publisher.

            Called in a Zenoh thread.

            Args:
                kind: Type of the message.
                attachment: Metadata of the message: its publisher, number and sending time.
            """
            delay_ns = clock.unix_ns() - attachment.sent_unix_ns
            types[attachment.gid] = kind
            samples.setdefault(attachment.gid, []).append((attachment.number, delay_ns))

        graph.tap(topic, receive)
        begun_ns = clock.monotonic_ns()
        while not stopped() and clock.monotonic_ns() - begun_ns < lasts_s * NS_PER_S:
            clock.sleep_until(clock.monotonic_ns() + _POLL_NS)
        lasted_s = (clock.monotonic_ns() - begun_ns) / NS_PER_S

        if not samples:
            raise RunFailed(
                f"no publisher sent a message on /{topic} in {lasted_s:.3g} s: check the topic "
                "with ros2 topic list, and the domain with --domain"
            )

        publishers = []
        # The lists are copied, because messages still arrive.
        for gid, publisher_samples in list(samples.items()):
            # DDS calls a type "std_msgs::msg::dds_::Bool_" that ROS calls "std_msgs/msg/Bool".
            kind = types[gid].replace("::dds_::", "/").replace("::", "/").removesuffix("_")
            delays = _describe_delays(list(publisher_samples), lasted_s)
            publishers.append({"gid": gid.hex(), "type": kind} | delays)
        return cls(topic, lasted_s, publishers)


def _draw_histogram(counts: Sequence[int]) -> str:
    """Draws a histogram as one line of text, with a block character for each bin.

    Args:
        counts: Number of messages in each bin. At least one bin must have a message.
    """
    largest = max(counts)
    bars = ""
    for count in counts:
        # Rounded up, so that a bin with a single message has a visible bar.
        height_eighths = math.ceil(8 * count / largest)
        bars += _BARS[height_eighths]
    return bars


def _describe_delays(samples: Sequence[tuple[int, int]], lasted_s: float) -> dict[str, Any]:
    """Returns the table row of one publisher on a ROS 2 topic, with a histogram of its delays.

    A publisher is a program that sends messages on the topic. The table lets the user compare
    the publishers.

    Args:
        samples: Number and delay in ns of each message that arrived. The publisher numbers its
            messages consecutively, so that a gap in the numbers shows lost messages.
        lasted_s: Duration of the measurement, in s.
    """
    numbers = {number for number, _ in samples}
    sent = max(numbers) - min(numbers) + 1

    delays_us = np.array([delay_ns for _, delay_ns in samples]) / 1e3
    counts, edges_us = np.histogram(delays_us, bins=20)
    quantiles_us = {}
    for name, percent in (("min", 0.0), ("p50", 50.0), ("p99", 99.0), ("max", 100.0)):
        quantiles_us[name] = float(np.percentile(delays_us, percent))

    return {
        "messages": len(samples),
        "lost": sent - len(numbers),
        "rate_hz": len(samples) / lasted_s,
        "delay_us": quantiles_us,
        "histogram": {"edges_us": edges_us.tolist(), "counts": counts.tolist()},
    }
