"""All that a running site does about time: its grid, its stamps, and a meter for every peer.

Law: it steers the grid and measures; no number of a run depends on it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from .course import Course
from .grid import Grid
from .meter import Meter, Sent
from .offset import Estimate, OffsetEstimator, offset_text

FAULT_EVERY_NS = 1_000_000_000


class Peer(NamedTuple):
    """What is known of a peer's clock when the session begins.

    Attributes:
        name: the peer.
        epoch_ns: tick 0 on its clock.
        place: which of its peers this site is.
        estimate: where its clock stands.
        estimator: what the pings said, to be gone on with; None where both clocks are one.
    """

    name: str
    epoch_ns: int
    place: int
    estimate: Estimate
    estimator: OffsetEstimator | None


class News(NamedTuple):
    """Something that a log should say of a clock: the facts of an event."""

    kind: str
    text: str
    facts: Mapping[str, object]


class Timing:
    """A site's time.

    Args:
        epoch_ns: tick 0 on the own clock.
        rate_hz: the own tick rate.
        peers: what is known of the peers, in scenario order.
        leader: name of the site whose grid is the session's.

    Attributes:
        grid: when the own ticks are due.
        meters: per peer what its link measures, in scenario order.
    """

    def __init__(self, epoch_ns: int, rate_hz: int, peers: Sequence[Peer], leader: str) -> None:
        self.grid = Grid(epoch_ns, rate_hz)
        self._epoch_ns = epoch_ns
        self._names = [peer.name for peer in peers]
        self._sent = Sent()
        self.meters = [
            Meter(peer.epoch_ns, peer.place, self._sent, Course(peer.estimate), peer.estimator)
            for peer in peers
        ]
        self._turn = 0
        self._faults_ns = [-FAULT_EVERY_NS] * len(peers)
        self._followed: Meter | None = None
        self._leader_epoch_ns = 0
        for peer, meter in zip(peers, self.meters, strict=True):
            meter.course.bend(epoch_ns, peer.estimate)
            if peer.name == leader and peer.estimator is not None:
                self._followed, self._leader_epoch_ns = meter, peer.epoch_ns

    def opening(self) -> list[News]:
        """Returns what a log should say of the peers' clocks before tick 0."""
        return [
            _estimated(name, 0, self._epoch_ns, meter.course)
            for name, meter in zip(self._names, self.meters, strict=True)
            if meter.estimated
        ]

    def sent(self, tick: int, now_ns: int) -> int:
        """Notes when the record of a tick is sent, and returns it since the epoch, ns."""
        self._sent.put(tick, now_ns)
        return now_ns - self._epoch_ns

    def echo(self) -> list[tuple[int, int, int]]:
        """Returns of each peer the newest sample since the last call: (peer, tick, arrival), see `State`."""
        echo = []
        for index, meter in enumerate(self.meters):
            if meter.news is not None:
                tick, arrived_ns = meter.news
                meter.news = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def settle(self, k: int, now_ns: int) -> list[News]:
        """Goes by what was measured from tick k on; ten times a second.

        Args:
            k: the next tick.
            now_ns: the own clock.

        Returns:
            What a log should say of it.
        """
        news: list[News] = []
        due_ns = self.grid.deadline(k)
        self._estimate(k, now_ns, due_ns, news)
        for n, (name, meter) in enumerate(zip(self._names, self.meters, strict=True)):
            faulty = bool(meter.worst_ns) or meter.contradicted
            if faulty and now_ns - self._faults_ns[n] >= FAULT_EVERY_NS:
                self._faults_ns[n] = now_ns
                news.append(_fault(name, meter.worst_ns, meter.course.bound_ns))
                meter.forgive()
        if self._followed is not None:
            course = self._followed.course
            leader_ns = due_ns + course.at(due_ns) - self._leader_epoch_ns
            self.grid.steer(k, leader_ns - self.grid.nominal(k), course.estimate.drift)
        return news

    def _estimate(self, k: int, now_ns: int, due_ns: int, news: list[News]) -> None:
        """Lets one peer at a time be estimated anew, in turn, because that takes a part of a tick."""
        for _ in self.meters:
            self._turn = (self._turn + 1) % len(self.meters)
            meter = self.meters[self._turn]
            if meter.close(now_ns, due_ns) is not None:
                news.append(_estimated(self._names[self._turn], k, due_ns, meter.course))
                return

    def measured(self, now_ns: int) -> dict[str, Any]:
        """Returns what `LinkStats` says of time, by field, and begins anew."""
        figures = {name: meter.figures() for name, meter in zip(self._names, self.meters, strict=True)}
        courses = {name: meter.course for name, meter in zip(self._names, self.meters, strict=True)}
        return {
            "offset_us": {name: course.at(now_ns) // 1000 for name, course in courses.items()},
            "bound_us": {name: -(-course.bound_at(now_ns) // 1000) for name, course in courses.items()},
            "delay_us": {name: figure.delay_us for name, figure in figures.items()},
            "delay_max_us": {name: figure.delay_max_us for name, figure in figures.items()},
            "rtt_us": {name: figure.rtt_us for name, figure in figures.items()},
            "clock_faults": {name: figure.faults for name, figure in figures.items()},
            "grid_error_us": self.grid.error_ns // 1000,
            "slew_ppb": round(self.grid.slew),
        }


def _estimated(name: str, k: int, at_ns: int, course: Course) -> News:
    """Says where a peer's clock stands from tick k on."""
    estimate = course.estimate
    offset_ns = course.at(at_ns)
    apart = max(estimate.drift_high - estimate.drift, estimate.drift - estimate.drift_low)
    return News(
        "clock",
        f"clock of {name}: {offset_text(offset_ns, course.bound_ns)}, drift {estimate.drift / 1000:+.2f} ppm",
        {
            "about": name,
            "ticks": k,
            "offset_ns": offset_ns,
            "bound_ns": course.bound_ns,
            "drift_ppb": round(estimate.drift),
            "drift_bound_ppb": round(apart) + 1,
        },
    )


def _fault(name: str, before_ns: int, bound_ns: int) -> News:
    """Says that stamps cannot be right: a sample that came before it was sent, or windows that disagree."""
    what = f"its stamps contradict those before, beyond the bound of {bound_ns / 1000:.0f} us"
    if before_ns:
        what = f"a sample came {before_ns / 1e6:.3f} ms before it was sent"
    return News(
        "clock fault",
        f"clock of {name}: {what}; one of the two clocks has stepped",
        {"about": name, "offset_ns": before_ns, "bound_ns": bound_ns},
    )
