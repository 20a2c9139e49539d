"""A recording into memory, on a clock that the test moves, and sites that remember their
messages.
"""

import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec
from mcap.reader import make_reader

from recorder.session_recording import RecorderReport, Recording
from recorder.site_reception import InboundQueue
from tests.net import parties
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import TickInput
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.bus import Inbox
from trilat_net.net.membership import Epoch, EventPublisher
from trilat_net.net.messages import Event, Info
from trilat_net.net.requests import Backfill, BackfillRequest
from trilat_net.net.timing import LoopStats
from trilat_net.net.wire import decode, encode, encode_state, read_messages
from trilat_net.scenario import Scenario, load_scenario

SESSION = "t"
MONO_NS = 3_000_000_000
UNIX_NS = 1_700_000_000_000_000_000
MS = 1_000_000
S = 1_000_000_000
BOOTS = {"m": 11, "s": 12, topics.RECORDER: 13}
EPOCH = Epoch(MONO_NS, UNIX_NS, BOOTS)
SCENARIO = load_scenario("two_sites", {"duration_s": 0.05})
TICKS = SCENARIO.ticks("m")


def answer_info(name: str, **facts: object) -> Info:
    scenario = {"scenario_sha256": SCENARIO.sha256, "scenario": SCENARIO.text}
    return parties.answer_info(name, BOOTS[name], **{**scenario, **facts})


def encode_states(
    name: str, boot: int | None = None, scenario: Scenario = SCENARIO
) -> list[bytes]:
    site = Site(scenario.setup(name))
    boot = BOOTS[name] if boot is None else boot
    return [
        encode_state(name, boot, site.peers, site.step(TickInput(k)), [], 0, 0)
        for k in range(scenario.ticks(name))
    ]


def encode_statistics(name: str, tick: int = 0, scenario: Scenario = SCENARIO) -> bytes:
    site = Site(scenario.setup(name))
    stats = LoopStats(site, BOOTS[name]).pop_stats(site.step(TickInput(0)))
    t_ns = tick * S // scenario.sites[name].rate_hz
    return encode(msgspec.structs.replace(stats, tick=tick, t_ns=t_ns))


def encode_event(name: str, n: int, kind: str = "mode", **facts: object) -> bytes:
    event = Event(member=name, boot=BOOTS[name], kind=kind, text=kind, t_ns=n * MS, n=n)
    return encode(msgspec.structs.replace(event, **facts))


def encode_end(name: str, ticks: int = TICKS, boot: int | None = None, n: int = -1) -> bytes:
    boot = BOOTS[name] if boot is None else boot
    return encode_event(name, n, "end", boot=boot, t_ns=50 * MS, ticks=ticks)


class Memory:
    """The answers of a site to requests for its past, with a bounded number of messages each.

    Attributes:
        made: All messages that the site made, by channel.
        oldest: Number of the oldest remembered message, by channel.
        asked: Every request that reached the site.
        replies: Changes an answer on its way, and returns the payloads that arrive.
    """

    def __init__(self, network: LocalNetwork, name: str, chunk: int = 64) -> None:
        self.name = name
        self.chunk = chunk
        self.made: dict[str, Sequence[bytes]] = {"state": [], "link": [], "event": []}
        self.oldest = dict.fromkeys(self.made, 0)
        self.asked: list[BackfillRequest] = []
        self.replies: Callable[[bytes], Sequence[bytes]] = lambda payload: [payload]
        self._questions = network.join().query_inbox(topics.key(SESSION, name, topics.PAST))

    def answer(self) -> None:
        while (question := self._questions.poll()) is not None:
            decoded = decode(question.payload, BackfillRequest)
            self.asked.append(decoded)
            for payload in self.replies(encode(self.past(decoded))):
                question.reply(payload)

    def past(self, wanted: BackfillRequest) -> Backfill:
        numbers_made = self.made[wanted.channel]
        first = max(wanted.first, min(self.oldest[wanted.channel], len(numbers_made)))
        last = min(wanted.last, first + self.chunk - 1)
        return Backfill(
            member=self.name,
            boot=BOOTS[self.name],
            channel=wanted.channel,
            first=first,
            payloads=list(numbers_made[first : last + 1]),
            made=len(numbers_made),
        )


class Desk:
    """A recording into memory, with a clock that the test moves."""

    def __init__(
        self,
        scenario: Scenario = SCENARIO,
        clock: ManualClock | None = None,
        epoch: Epoch = EPOCH,
    ) -> None:
        self.clock = clock or ManualClock(MONO_NS)
        self.network = LocalNetwork()
        self.bus = self.network.join()
        listener = self.network.join()
        self._heard: Inbox = listener.inbox(topics.key(SESSION, topics.RECORDER, topics.EVENT))
        self.reports: Inbox = listener.inbox(topics.key(SESSION, topics.RECORDER, topics.STATS))
        self.stream = io.BytesIO()
        self.tap = InboundQueue(self.clock)
        key = topics.key(SESSION, topics.RECORDER, topics.EVENT)
        info = answer_info(topics.RECORDER, scenario="", scenario_sha256="")
        publisher = EventPublisher(
            self.bus, SESSION, info, lambda payload: self.tap.receive(key, payload)
        )
        writer = LogWriter(
            self.stream, scenario, SESSION, "live", epoch.unix_ns, collect_provenance()
        )
        self.recording = Recording(writer, scenario, SESSION, epoch, self.bus, publisher)
        self.report = RecorderReport(
            self.bus, self.clock, self.recording, self.tap, self.stream.tell
        )

    def wait(self, for_ns: int) -> None:
        sleep_for_ns(self.clock, for_ns)

    def take(self, name: str, channel: str, *payloads: bytes) -> None:
        for payload in payloads:
            self.wait(MS)
            self.tap.receive(topics.key(SESSION, name, channel), payload)
        self.write()

    def write(self) -> None:
        self.recording.write(self.tap, self.clock.monotonic_ns())

    def rounds(self, count: int, *sites: Memory, step_ns: int = 10 * MS) -> None:
        """Advances the time, while the recorder works and the given sites answer."""
        for _ in range(count):
            self.wait(step_ns)
            self.write()
            for site in sites:
                site.answer()

    def whole(self, *names: str) -> None:
        for name in names:
            self.take(name, topics.STATE, *encode_states(name))
            self.take(name, topics.LINK, encode_statistics(name))
            self.take(name, topics.EVENT, encode_end(name))

    def over(self) -> bool:
        return self.recording.is_over(self.clock.monotonic_ns())

    def said(self) -> list[Event]:
        return list(read_messages(self._heard, Event))

    def stored(self) -> list[tuple[str, int]]:
        heard = self.said()
        assert all(event.kind == "stored" for event in heard)
        return [(event.about, event.ticks) for event in heard]

    def log(self) -> Log:
        self.recording.finish(self.tap)
        self.stream.seek(0)
        return open_log(self.stream)

    def written(self) -> dict[str, list[bytes]]:
        payloads: dict[str, list[bytes]] = {}
        for topic, message in self.messages():
            payloads.setdefault(topic, []).append(message.data)
        return payloads

    def messages(self) -> Iterator[tuple[str, Any]]:
        self.recording.finish(self.tap)
        reader = make_reader(io.BytesIO(self.stream.getvalue()))
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic.startswith(f"/trilat/{SESSION}/"):
                yield channel.topic.removeprefix(f"/trilat/{SESSION}/"), message
