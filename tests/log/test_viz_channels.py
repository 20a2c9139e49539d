"""The standard channels: every extreme is there, nothing else is, whatever order the records come in."""

import io
import math
import random
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.execution.builders import execute_ticks
from tests.log.builders import make_log, simulate_bytes
from tests.log.split_logs import read_messages
from trilat_net.core.step.ticks import Mode, TickRecord
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.log.ros2.ros2_messages import stack_signals
from trilat_net.log.ros2.viz_channels import VizChannels, decimate_min_max, offer_views
from trilat_net.log.view_rates import FULL_RATE_HZ
from trilat_net.net import topics
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.wire import decode, encode_state
from trilat_net.scenario import Scenario, load_scenario

SCENARIO = load_scenario("two_sites", {"duration_s": 0.5})
KEY = "trilat/lab/m/state"
EPOCH_NS = 1_700_000_000_000_000_000
BUCKET = 20  # ticks of a site at 1 kHz, at 100 Hz
SLOW = 200
CURVES = ("q", "q_des", "qd", "tau")
finite = st.floats(-1e6, 1e6) | st.integers(-2, 2).map(float)


@dataclass
class Seen:
    """A message as a reader of other people has it."""

    topic: str
    message: Any
    publish_ns: int
    log_ns: int


class Desk:
    """The views of a session, and what they put."""

    def __init__(
        self, views_hz: float, scenario: Scenario = SCENARIO, epoch_ns: int = 0
    ) -> None:
        self.seen: list[Seen] = []
        self.views = VizChannels(scenario, "lab", epoch_ns, views_hz, self._put)

    def _put(self, topic: str, data: bytes, publish_ns: int, log_ns: int) -> None:
        channel = self.views.channels[topic]
        self.seen.append(Seen(topic, (channel.kind, data), publish_ns, log_ns))

    def take(self, messages: Iterable[Any], key: str = KEY) -> None:
        for n, message in enumerate(messages):
            self.views.receivers[key](message, n)

    def finish(self) -> None:
        self.views.finish(max((seen.log_ns for seen in self.seen), default=0))

    def arrays(self, topic: str) -> list[tuple[int, list[float]]]:
        """Publish time and numbers of a channel's messages, in the order in which they were put."""
        return [(s.publish_ns, numbers_of(*s.message)) for s in self.seen if s.topic == topic]


@cache
def _make_decoder(kind: str) -> Any:
    from mcap.records import Schema

    from trilat_net.log.ros2 import cdr

    schema = Schema(id=1, name=kind, encoding="ros2msg", data=cdr.ROS2_SCHEMAS[kind])
    return DecoderFactory().decoder_for("cdr", schema)


def numbers_of(kind: str, data: bytes) -> list[float]:
    message = _make_decoder(kind)(data)
    if kind == "sensor_msgs/msg/JointState":
        return [*message.position, *message.velocity, *message.effort]
    return list(message.data)


def make_record(tick: int, numbers: Sequence[float], mode: Mode = Mode.RUN) -> TickRecord:
    """A record whose numbers are these, from q to theta_hat."""
    n = iter(numbers)
    vectors = [[next(n) for _ in range(size)] for size in (2, 2, 2, 2, 2, 2, 5)]
    q, qd, q_des, qd_des, tau, tau_x, theta_hat = vectors
    return TickRecord(
        tick, tick * 10**6, mode, q, qd, q_des, qd_des, tau, tau_x, theta_hat, [-1], 0, [], []
    )


def joint_row(record: TickRecord) -> list[float]:
    return [x for name in CURVES for x in getattr(record, name)]


def error_row(record: TickRecord) -> list[float]:
    return [a - b for a, b in zip(record.q, record.q_des, strict=True)]


def slow_row(record: TickRecord) -> list[float]:
    return [*record.tau_x, *record.theta_hat, float(record.mode)]


def error_arrays(desk: Desk) -> list[tuple[int, list[float]]]:
    return desk.arrays("/viz/m/error")


def slow_arrays(desk: Desk) -> list[tuple[int, list[float]]]:
    """The slow arrays put together again, in the order of `slow_row`."""
    parts = [desk.arrays(f"/viz/m/{name}") for name in ("tau_x", "theta_hat", "mode")]
    assert len({tuple(t for t, _ in part) for part in parts}) == 1
    return [
        (rows[0][0], [x for _, row in rows for x in row]) for rows in zip(*parts, strict=True)
    ]


def joint_arrays(desk: Desk) -> list[tuple[int, list[float]]]:
    """Returns the numbers of `joint_row` in the joint states; a reference has angles only."""
    rows = desk.arrays("/viz/m/joint_states")
    assert all(math.isnan(x) for _, row in rows for x in row[6:8] + row[10:])
    return [(t_ns, row[:6] + row[8:10]) for t_ns, row in rows]


@given(st.lists(st.lists(finite, min_size=3, max_size=3), min_size=1, max_size=30))
def test_an_envelope_is_the_extremes_in_their_order(
    rows: list[list[float]],
) -> None:
    columns = list(zip(*rows, strict=True))
    first, second = decimate_min_max(columns)
    for a, b, column in zip(first, second, columns, strict=True):
        assert {a, b} == {min(column), max(column)}
        assert column.index(a) <= column.index(b)


@st.composite
def draw_records(draw: st.DrawFn) -> list[TickRecord]:
    """Draws records of some ticks of a second, in any order, with small or arbitrary numbers."""
    ticks = draw(st.lists(st.integers(0, 450), unique=True, min_size=1, max_size=120))
    if draw(st.booleans()):
        ticks.sort()
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    numbers = rng.integers(-3, 4, (len(ticks), 17)) * rng.choice([1.0, 1e-9, 1e5], 17)
    modes = rng.choice([Mode.RUN, Mode.HOLD, Mode.DIVERGED], len(ticks), p=[0.9, 0.05, 0.05])
    return [
        make_record(tick, row.tolist(), Mode(mode))
        for tick, row, mode in zip(ticks, numbers, modes, strict=True)
    ]


def group_records(records: Iterable[TickRecord], length: int) -> dict[int, list[TickRecord]]:
    by: dict[int, list[TickRecord]] = defaultdict(list)
    for record in records:
        by[record.tick // length].append(record)
    return by


@given(draw_records())
def test_exactly_all_extremes_of_buckets_appear(records: list[TickRecord]) -> None:
    """The extremes appear in whatever order the records come."""
    desk = Desk(100.0)
    desk.take(records)
    desk.finish()
    for arrays_of, row_of, length in (
        (joint_arrays, joint_row, BUCKET),
        (error_arrays, error_row, BUCKET),
        (slow_arrays, slow_row, SLOW),
    ):
        put: dict[int, list[list[float]]] = defaultdict(list)
        for t_ns, row in arrays_of(desk):
            put[t_ns // (length * 10**6)].append(row)
        wanted = group_records(records, length)
        assert set(put) == set(wanted)
        for number, ones in wanted.items():
            columns = zip(*map(row_of, ones), strict=True)
            for column, shown in zip(columns, zip(*put[number], strict=True), strict=True):
                assert min(shown) == min(column)
                assert max(shown) == max(column)
                assert set(shown) <= set(column)


@given(draw_records())
def test_view_messages_keep_log_time_order(records: list[TickRecord]) -> None:
    desk = Desk(100.0, epoch_ns=EPOCH_NS)
    desk.take(records)
    desk.finish()
    have = {EPOCH_NS + record.t_ns for record in records}
    assert {seen.publish_ns for seen in desk.seen} <= have
    log_ns = [seen.log_ns for seen in desk.seen]
    assert log_ns == sorted(log_ns)
    if [record.tick for record in records] == sorted(record.tick for record in records):
        for topic in ("/viz/m/joint_states", "/viz/m/error", "/viz/m/theta_hat"):
            times = [t_ns for t_ns, _ in desk.arrays(topic)]
            assert times == sorted(set(times))


@given(draw_records(), st.randoms(use_true_random=False))
def test_disorder_within_a_bucket_is_invisible(
    records: list[TickRecord], chance: random.Random
) -> None:
    in_order = sorted(records, key=lambda record: record.tick)
    shuffled = sorted(in_order, key=lambda record: (record.tick // BUCKET, chance.random()))
    desks = Desk(100.0), Desk(100.0)
    for desk, ones in zip(desks, (in_order, shuffled), strict=True):
        desk.take(ones)
        desk.finish()
    first, second = ([(s.topic, s.message, s.publish_ns) for s in desk.seen] for desk in desks)
    assert Counter(first) == Counter(second)


def test_live_views_have_100_messages_a_second() -> None:
    """The second message of a bucket waits half a bucket, so that curves are even over the log time, too."""
    desk = Desk(100.0)
    desk.take(make_record(k, [float(k)] * 17) for k in range(1000))
    seen = [s for s in desk.seen if s.topic == "/viz/m/joint_states"]
    assert [s.publish_ns // 10**6 for s in seen] == list(range(0, 980, 10))
    assert [s.log_ns for s in seen] == list(range(20, 1000, 10))


@pytest.mark.parametrize("views_hz", [1000.0, 5000.0, FULL_RATE_HZ])
def test_full_views_hold_every_record(views_hz: float) -> None:
    records = [make_record(k, [math.sin(k * (n + 1)) for n in range(17)]) for k in range(101)]
    desk = Desk(views_hz)
    desk.take(records)
    desk.finish()
    assert joint_arrays(desk) == [(record.t_ns, joint_row(record)) for record in records]
    if views_hz == FULL_RATE_HZ:
        assert slow_arrays(desk) == [(record.t_ns, slow_row(record)) for record in records]


@given(draw_records())
def test_wire_and_simulated_records_look_equal(records: list[TickRecord]) -> None:
    states = [
        decode(encode_state("m", 1, ["s"], record, [], 0, 0), State) for record in records
    ]
    assert stack_signals(states) == stack_signals(records)


def test_waiting_records_are_bounded_by_buckets() -> None:
    """A sender that counts its ticks in leaps, back and forth, leaves nothing behind."""
    desk = Desk(100.0)
    desk.take(make_record((k * 7919) % 100_000, [0.0] * 17) for k in range(3000))
    (site,) = [buckets for buckets in desk.views._buckets if buckets._first_tick]
    assert len(site._records) + len(site._late_records) <= 2 * BUCKET
    assert len(site._slow_rows) <= SLOW // BUCKET * 2


def make_stats(**facts: Any) -> LinkStats:
    counts = {
        "accepted": {"s": 1},
        "late": {"s": 0},
        "duplicate": {"s": 0},
        "refused": {"s": 0},
    }
    return LinkStats(
        **{
            "v": 3, "site": "m", "boot": 1, "tick": 100, "t_ns": 100_000_000, "mode": "run",
            "age_us": {"s": 1500}, **counts, "dropped": {}, "late_max_us": 70, "busy_max_us": 40,
            "overruns": 0, **facts,
        }
    )  # fmt: skip


def test_statistics_have_units_and_unmeasured_are_nan() -> None:
    desk = Desk(100.0)
    clocks = {"offset_us": {"s": -2000}, "bound_us": {"s": 40}}
    delays = {"delay_us": {"s": 800}, "delay_max_us": {"s": 2500}}
    desk.take([make_stats(**clocks, **delays)], "trilat/lab/m/link")
    shown = {seen.topic.rpartition("/")[2]: numbers_of(*seen.message) for seen in desk.seen}
    assert shown == {
        "link_age": [1.5],
        "link_delay": [0.8, 2.5],
        "link_offset": [-2.0, 0.04],
        "timing": [70.0, 40.0],
    }
    nothing = Desk(100.0)
    nothing.take(
        [make_stats(age_us={"s": -1}, delay_us={"s": -1}, delay_max_us={"s": -1})],
        "trilat/lab/m/link",
    )
    by_topic = {
        seen.topic.rpartition("/")[2]: numbers_of(*seen.message) for seen in nothing.seen
    }
    assert math.isnan(by_topic["link_age"][0])
    assert all(map(math.isnan, by_topic["link_delay"] + by_topic["link_offset"]))


def test_virtual_time_shows_no_clocks_or_network() -> None:
    desk = Desk(100.0)
    desk.take([make_stats()], "trilat/lab/m/link")
    assert [seen.topic for seen in desk.seen] == ["/viz/m/link_age"]


@pytest.mark.parametrize(("kind", "level"), [("end", 20), ("lost", 30), ("diverged", 40)])
def test_events_become_text_with_levels(kind: str, level: int) -> None:
    desk = Desk(100.0, epoch_ns=EPOCH_NS)
    event = Event(member="m", boot=1, kind=kind, text="ü happened", t_ns=5)
    desk.views.receivers["trilat/lab/recorder/event"](event, EPOCH_NS + 9)
    text, line = desk.seen
    assert (text.topic, _make_decoder(text.message[0])(text.message[1]).data) == (
        "/viz/events",
        "m: ü happened",
    )
    entry = _make_decoder(line.message[0])(line.message[1])
    assert (line.topic, entry.level, entry.name, entry.msg) == (
        "/viz/log",
        level,
        "m",
        "ü happened",
    )
    assert entry.stamp.sec * 10**9 + entry.stamp.nanosec == EPOCH_NS + 5
    assert text.publish_ns == text.log_ns == line.publish_ns == line.log_ns == EPOCH_NS + 9


def test_early_events_have_their_arrival_time() -> None:
    desk = Desk(100.0, epoch_ns=EPOCH_NS)
    desk.views.receivers["trilat/lab/m/event"](
        Event(member="m", boot=1, kind="epoch", text=""), EPOCH_NS - 9
    )
    kind, data = desk.seen[1].message
    stamp = _make_decoder(kind)(data).stamp
    assert stamp.sec * 10**9 + stamp.nanosec == EPOCH_NS - 9


def test_views_leave_other_messages_unchanged() -> None:
    other_messages = []
    has_views = []
    for views_hz in (0.0, 100.0):
        scenario = load_scenario("paper", {"duration_s": 0.5})
        messages = read_messages(simulate_bytes(scenario, views_hz=views_hz))
        other_messages.append(
            [message for message in messages if not message.topic.startswith("/viz")]
        )
        has_views.append(len(messages) > len(other_messages[-1]))
    assert other_messages[0] == other_messages[1]
    assert has_views == [False, True]


def test_parts_end_with_all_extremes() -> None:
    """The extremes of the parts are those of the whole, so that none is lost between parts."""
    scenario = load_scenario("two_sites", {"duration_s": 0.2})
    outputs = execute_ticks(scenario)["m"]
    shown = []
    for part in (outputs[:77], outputs[77:]):
        stream = io.BytesIO()
        writer = LogWriter(
            stream,
            scenario,
            "lab",
            "live",
            EPOCH_NS,
            collect_provenance(),
            make_views=offer_views(scenario, 100.0),
        )
        for output in part:
            payload = encode_state("m", 1, ["s"], output, [], 0, 0)
            state = decode(payload, State)
            writer.add(KEY, payload, output.t_ns, EPOCH_NS + output.t_ns, output.tick, state)
        writer.finish({})
        reader = make_reader(
            io.BytesIO(stream.getvalue()), decoder_factories=[DecoderFactory()]
        )
        shown += [
            [*ros.position, *ros.velocity[:2], *ros.effort[:2]]
            for _, _, _, ros in reader.iter_decoded_messages("/viz/m/joint_states")
        ]
    whole = np.array([joint_row(output) for output in outputs])
    assert np.array_equal(np.max(shown, axis=0), whole.max(axis=0))
    assert np.array_equal(np.min(shown, axis=0), whole.min(axis=0))


def test_odd_rates_are_shown_as_asked() -> None:
    scenario = load_scenario("two_sites", {"sites.m.rate_hz": 333})
    desk = Desk(100.0, scenario)
    desk.take(make_record(k, [0.0] * 17) for k in range(333))
    desk.finish()
    assert 100 <= len(desk.arrays("/viz/m/joint_states")) <= 112


@pytest.mark.parametrize(
    "overrides", [{}, {"control.law": "tests.log.wide_law:Wide"}], ids=["shipped", "wide"]
)
def test_views_never_end_beyond_their_bound(overrides: dict[str, Any]) -> None:
    """The room that a log reserves covers the views of laws that send many quantities."""
    log = make_log("paper", {"duration_s": 0.22, **overrides})
    sizes: list[int] = []
    views = VizChannels(
        log.scenario, "lab", 0, 100.0, lambda _topic, data, *_times: sizes.append(len(data))
    )
    for site in log.sites:
        for n, state in enumerate(log[site].states):
            views.receivers[topics.key("lab", site, topics.STATE)](state, n)
    sizes.clear()
    views.finish(0)
    assert 0 < sum(sizes) <= views.most_bytes
