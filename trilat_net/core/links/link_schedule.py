"""Computes which messages of another arm a site uses, without simulating the run.

Messages are delayed and lost at random, but the random numbers are determined by the key of the
link, so they can be drawn again.

Invariant:
    - The random numbers of a link are the same as in a run.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...records import NS_PER_S
from ..step.site_setup import LinkSetup
from ..step.vectors import IntArray, Row
from .channel import LOST, schedule_deliveries
from .delay import LINK_MODEL_DTYPE, DelayKind, LinkModel
from .link import link_dtype

_BLOCK = 8192
"""Number of samples that are scheduled at once."""


class LinkSchedule:
    """Computes when each message on a simulated network link should arrive at the receiver.

    The arrival times follow from the delays and losses in the scenario, and are computed by the
    same function as during a run. Each delay model applies to messages sent at or after its
    start time.

    Args:
        setup: Setup of the link, as read by the kernel.
        changed_models: Delay and loss models to which the link switches during the run.

    Attributes:
        models: All models of the link, ordered by start time.
        row: State of the link, as a row of the array that the kernel reads.
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

        Continues with the message after the last one of the previous call.

        Args:
            end: Number of the sample at which to stop (exclusive).

        Returns:
            Due times in ns since the epoch, one per sample, or LOST for a lost sample.
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

    def find_measured(self, stamp_ns: IntArray) -> NDArray[np.bool_]:
        """Marks the messages whose only delay is that of the real network.

        Args:
            stamp_ns: Sending times of the messages, ns since the epoch, shape (M,).

        Returns:
            One Boolean per message, shape (M,).
        """
        model_index = np.searchsorted(self.models["from_ns"][1:], stamp_ns, side="right")
        is_measured: NDArray[np.bool_] = self.models["kind"][model_index] == DelayKind.MEASURED
        return is_measured

    def draw_releases(self, end: int, receiver_hz: int) -> tuple[IntArray, IntArray]:
        """Computes when the next messages of the link are first used by the receiver.

        A message is used in the first control period of the receiver that starts at or after
        its arrival. Lost messages are omitted.

        Args:
            end: Number of the message at which to stop (exclusive).
            receiver_hz: Rate of the receiver's control loop, in Hz.

        Returns:
            Two arrays of the same length: the numbers of the messages, and the receiver's tick
                in which each message is first used.
        """
        samples = np.arange(int(self.row.scheduled) + 1, end)
        due_ns = self.draw(end)
        stamp_ns = samples * NS_PER_S // int(self.row.rate_hz)
        # A sample never comes into use at its own sending time.
        ticks = self.first_ticks(np.maximum(due_ns, stamp_ns + 1), receiver_hz)
        is_delivered = due_ns != LOST
        return samples[is_delivered], ticks[is_delivered]

    def draw_used(self, end: int, receiver_hz: int, ticks: int) -> IntArray:
        """Computes which message is in use in each control period of the receiver.

        Args:
            end: Number of the message at which to stop (exclusive).
            receiver_hz: Rate of the receiver's control loop, in Hz.
            ticks: Number of control periods of the receiver.

        Returns:
            Message numbers, shape (ticks,), or -1 before the first message.
        """
        samples, releases = self.draw_releases(end, receiver_hz)
        newest = np.full(ticks, -1, dtype=np.int64)
        is_within = releases < ticks
        np.maximum.at(newest, releases[is_within], samples[is_within])
        return np.maximum.accumulate(newest)

    def draw_run(self, receiver_hz: int, duration_s: float) -> IntArray:
        """Computes which message is in use in each control period of a complete run.

        Args:
            receiver_hz: Rate of the receiver's control loop, in Hz.
            duration_s: Duration of the run, in s.

        Returns:
            Message numbers, shape (ticks,), or -1 before the first message.
        """
        sent = round(duration_s * self.row.rate_hz)
        ticks = max(2, round(duration_s * receiver_hz))
        return self.draw_used(sent, receiver_hz, ticks)

    @staticmethod
    def first_ticks(due_ns: IntArray, rate_hz: int) -> IntArray:
        """Returns the receiver's first tick at or after each delivery time.

        This is the vectorised form of `first_tick_at`.

        Args:
            due_ns: Delivery times in ns since the epoch (the common start time).
            rate_hz: Tick rate, in Hz.

        Returns:
            Tick numbers, one per delivery time.
        """
        return -(-due_ns * rate_hz // NS_PER_S)
