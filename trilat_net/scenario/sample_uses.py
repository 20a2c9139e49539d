"""Computes which messages of other arms a controller used and a user saw, without a run.

In each control period, an arm sends its state to the other arms. These messages are delayed and
lost at random, but the random numbers follow from a seed in the scenario, the description of
the experiment. They can therefore be drawn again. For example, a report can show what a user
saw although the log does not contain it.

Invariant:
    - The random numbers of a connection are the same as in a run.
    - The picture that a user sees depends only on the scenario, its seed and the number of the
      control period.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np

from ..core import (
    LINK_MODEL_DTYPE,
    LOST,
    IntArray,
    LinkModel,
    LinkSetup,
    Row,
    link_dtype,
    link_key,
    schedule_deliveries,
)
from ..records import NS_PER_S
from .delay_models import LinkBase
from .scenario_types import Scenario

_BLOCK = 8192
"""Number of samples that are scheduled at once."""


class LinkSchedule:
    """Computes when each message on a simulated network link should arrive at the receiver.

    Every arm's process sends its state (a sample) once per control period. The arrival times
    follow from the delays and losses in the description of the experiment, and are computed by
    the same function as during a run. Each delay model applies to messages that are sent at or
    after its start time.

    Args:
        setup: Setup of the link, as the kernel reads it.
        changed_models: Models of delay and loss that the link gets by changes during the run.

    Attributes:
        models: All models of the link, in the order of their start times.
        row: State of the link: a row of the array that the kernel reads.
    """

    def __init__(self, setup: LinkSetup, changed_models: Sequence[LinkModel] = ()) -> None:
        points: list[tuple[int, int]] = []
        models: list[LinkModel] = []
        for model, trace in zip(setup.models, setup.traces, strict=True):
            if trace is not None:
                model = model._replace(trace_first=len(points), trace_count=len(trace))
                for t_us, delay_us in trace:
                    points.append((int(t_us), int(delay_us)))
            models.append(model)
        models += changed_models
        # The sort is stable, so if two models have the same start time, the changed model
        # applies.
        models.sort(key=lambda model: model.from_ns)
        self.models = np.array(models, LINK_MODEL_DTYPE)
        self._points = np.array([*points, *setup.outages], dtype=np.int64).reshape(-1, 2)

        row: Row = np.zeros(1, link_dtype(0))[0]
        row.rate_hz = setup.rate_hz
        row.key = setup.key
        row.models = len(self.models)
        row.used = -1
        row.scheduled = -1
        row.outage_first = len(points)
        row.outage_count = len(setup.outages)
        self.row = row
        self._block = np.empty(_BLOCK, dtype=np.int64)

    def draw(self, end: int) -> IntArray:
        """Computes when the next messages of the link are due at the receiver.

        The first of these messages is the one after the last message of the previous call.

        Args:
            end: Number of the sample after the last one.

        Returns:
            Due times in ns after the epoch, one per sample. A sample that is lost has the value
            LOST.
        """
        first = int(self.row.scheduled) + 1
        due_ns = np.empty(max(0, end - first), dtype=np.int64)
        for start in range(first, end, _BLOCK):
            stop = min(start + _BLOCK, end)
            schedule_deliveries(
                sample=stop - 1,
                link=self.row,
                models=self.models,
                dues=self._block,
                points=self._points,
            )
            positions = np.arange(start, stop) % _BLOCK
            due_ns[start - first : stop - first] = self._block[positions]
        return due_ns

    def draw_releases(self, end: int, receiver_hz: int) -> tuple[IntArray, IntArray]:
        """Computes when the next messages of the link are used by the receiver.

        A message is used in the first control period of the receiver that begins at or after
        its arrival. Lost messages are left out.

        Args:
            end: Number of the message before which the computation ends.
            receiver_hz: Rate of the receiver's control loop, in Hz.

        Returns:
            Two arrays of the same length: the numbers of the messages, and for each the number
            of the receiver's control period in which it is first used.
        """
        samples = np.arange(int(self.row.scheduled) + 1, end)
        due_ns = self.draw(end)
        stamp_ns = samples * NS_PER_S // int(self.row.rate_hz)
        # A sample never comes into use at its own sending time.
        ticks = first_ticks(np.maximum(due_ns, stamp_ns + 1), receiver_hz)
        is_delivered = due_ns != LOST
        return samples[is_delivered], ticks[is_delivered]


def first_ticks(due_ns: IntArray, rate_hz: int) -> IntArray:
    """Returns the first control period of the receiver at or after each delivery time.

    It is `core.ticks.first_tick_at` for an array of times.

    Args:
        due_ns: Times in ns after the epoch (the common start time).
        rate_hz: Tick rate, in Hz.

    Returns:
        Numbers of the ticks, one per time.
    """
    return -(-due_ns * rate_hz // NS_PER_S)


@lru_cache(maxsize=256)
def draw_used_samples(
    link: LinkBase, key: int, receiver_hz: int, sender_hz: int, duration_s: float
) -> IntArray:
    """Computes which message of another arm is in use in each control period of an arm.

    Messages are delayed and lost by the network link between the two arms; other links of the
    arm are not considered. A message is called a sample.

    Args:
        link: Link over which the samples arrive.
        key: Key of the link's random draws.
        receiver_hz: Tick rate of the site, in Hz.
        sender_hz: Tick rate of the peer, in Hz.
        duration_s: Duration of the run, in s.

    Returns:
        Number of the sample in every tick, shape (ticks,). -1 before the first sample.
    """
    setup = LinkSetup(
        peer="peer",
        alpha=1.0,
        rate_hz=sender_hz,
        q0=(),
        key=key,
        models=(link.to_core_model(),),
        traces=(link.points,),
    )
    used = draw_link_samples(setup, receiver_hz, duration_s)
    used.flags.writeable = False
    return used


def draw_link_samples(setup: LinkSetup, receiver_hz: int, duration_s: float) -> IntArray:
    """Computes which message is in use in each control period, for a link with all its changes.

    Args:
        setup: The link of an arm, with its planned changes and outages, see `Scenario.setup`.
        receiver_hz: Tick rate of the receiving site, in Hz.
        duration_s: Duration of the run, in s.

    Returns:
        Number of the sample in every tick, shape (ticks,). -1 before the first sample.
    """
    sent = round(duration_s * setup.rate_hz)
    samples, releases = LinkSchedule(setup).draw_releases(sent, receiver_hz)
    ticks = max(2, round(duration_s * receiver_hz))
    return _list_newest(samples, releases, ticks)


def _list_newest(samples: IntArray, releases: IntArray, ticks: int) -> IntArray:
    """Returns, for each control period, the newest message that has been received by then.

    Args:
        samples: Numbers of the samples.
        releases: Tick in which each sample comes into use.
        ticks: Number of ticks.

    Returns:
        Numbers of samples, shape (ticks,). -1 before the first sample.
    """
    newest = np.full(ticks, -1, dtype=np.int64)
    is_within = releases < ticks
    np.maximum.at(newest, releases[is_within], samples[is_within])
    return np.maximum.accumulate(newest)


def count_silences(used: IntArray, receiver_hz: int, silence_ns: int) -> int:
    """Counts how often an arm receives nothing new from another arm for longer than a limit.

    The time before the first message does not count.

    Args:
        used: Number of the sample in use in every tick. -1 before the first sample.
        receiver_hz: Tick rate of the site, in Hz.
        silence_ns: Longest time without a new sample that is not counted as a silence, in ns.
    """
    new_sample_ticks = np.flatnonzero(np.diff(used, prepend=-1) > 0)
    if not len(new_sample_ticks):
        return 0
    gap_ticks = np.diff(new_sample_ticks, append=len(used))
    gaps_ns = gap_ticks * NS_PER_S // receiver_hz
    # Without a silence, the distance between new samples is one period.
    period_ns = NS_PER_S // receiver_hz
    return int(np.count_nonzero(gaps_ns - period_ns > silence_ns))


class PictureDelay:
    """Delay of the picture in which the user of a site sees the other arms.

    A site is the process that runs one arm, and its user is the person who moves the arm. The
    picture is transmitted over a network connection of its own, with its own random delays and
    losses. It changes in the first control period in which a newer state of another arm has
    arrived.

    The table `[sites.NAME.view]` of a scenario describes the delay. Without the table, the user
    sees the states that the controller uses.

    Args:
        scenario: Description of the experiment.
        site: Name of the site whose user looks at the picture.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._receiver_hz = scenario.sites[site].rate_hz
        self._links: dict[str, tuple[int, LinkSchedule]] = {}
        view = scenario.sites[site].view
        peers = scenario.peers(site) if view is not None else ()
        for peer in peers:
            assert view is not None
            rate_hz = scenario.sites[peer].rate_hz
            outages = []
            for start_s, end_s in view.outages_s:
                outages.append((round(start_s * 1e9), round(end_s * 1e9)))
            setup = LinkSetup(
                peer=peer,
                alpha=1.0,
                rate_hz=rate_hz,
                q0=(),
                key=link_key(scenario.seed, f"view {peer}->{site}"),
                models=(view.to_core_model(),),
                traces=(view.points,),
                outages=tuple(outages),
            )
            self._links[peer] = (rate_hz, LinkSchedule(setup))
        # Samples that are not shown yet, and the ticks in which they will be shown.
        self._waiting = {peer: np.empty((2, 0), dtype=np.int64) for peer in self._links}
        self._shown = dict.fromkeys(self._links, -1)

    def advance_to(self, tick: int, used: Mapping[str, int]) -> Mapping[str, int]:
        """Returns the state of each other arm that the user sees in one control period.

        The states are called samples, and the other arms peers.

        Args:
            tick: The tick. It must not be earlier than the tick of the previous call.
            used: For each peer, the sample that the controller uses in this tick.

        Returns:
            Number of the shown sample of each peer. -1 before the first sample.
        """
        for peer, releases in self._draw_until(tick):
            samples, ticks = np.concatenate((self._waiting[peer], releases), axis=1)
            is_released = ticks <= tick
            self._waiting[peer] = np.stack((samples, ticks))[:, ~is_released]
            released = samples[is_released]
            if len(released):
                self._shown[peer] = max(self._shown[peer], int(released[-1]))
        return {**used, **self._shown}

    def list_shown_samples(self, ticks: int) -> dict[str, IntArray]:
        """Returns the states of the other arms that the user sees in all control periods.

        The picture is delayed, so it shows states of earlier periods.

        Args:
            ticks: Number of control periods of the user's site, from the start of the run.

        Returns:
            For each other site, by name, the number of the shown message in every period, shape
            (ticks,). It is -1 before the first message. Empty if the scenario describes no
            delay of the picture; then the user sees what the controller uses.
        """
        return {
            peer: _list_newest(samples, releases, ticks)
            for peer, (samples, releases) in self._draw_until(ticks - 1)
        }

    def _draw_until(self, tick: int) -> Iterator[tuple[str, tuple[IntArray, IntArray]]]:
        """Yields the states that other arms sent, and the tick from which the user sees each.

        A tick is a control period of this arm.

        Args:
            tick: Tick of the site.
        """
        for peer, (rate_hz, schedule) in self._links.items():
            # A sample that is sent at the time of the tick itself is not shown yet.
            end = -(-tick * rate_hz // self._receiver_hz)
            yield peer, schedule.draw_releases(end, self._receiver_hz)
