"""Channels alone: the fates of a link's samples as an array."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from trilat_net.core.links.channel import schedule_deliveries
from trilat_net.core.links.delay import LINK_MODEL_DTYPE, LinkModel
from trilat_net.core.links.link import link_dtype
from trilat_net.core.links.philox import link_key
from trilat_net.core.step.vectors import Points
from trilat_net.scenario.delay_models import LinkBase

Ints = NDArray[np.int64]
SEEDS = (1, *(pytest.param(n, marks=pytest.mark.long) for n in (2, 3, 20_240_229, 2**63 - 1)))
LINK_NAME = "m1->s"
_BLOCK = 8192


class Channel(NamedTuple):
    """The arguments of `schedule_deliveries`: a link's row, its models, its due times and its points."""

    row: Any
    models: NDArray[Any]
    dues: Ints
    points: Points


def channel(
    models: Sequence[LinkModel],
    seed: int = 1,
    name: str = LINK_NAME,
    rate_hz: int = 1000,
    points: Points | None = None,
    outages: int = 0,
    pages: int = _BLOCK,
) -> Channel:
    """Returns a channel at its beginning; the last `outages` of its points are outages."""
    table = np.empty((0, 2), dtype=np.int64) if points is None else points
    row: Any = np.zeros(1, link_dtype(2))[0]
    row.rate_hz, row.key, row.models = rate_hz, link_key(seed, name), len(models)
    row.used = row.scheduled = -1
    row.outage_first, row.outage_count = len(table) - outages, outages
    return Channel(
        row,
        np.array([tuple(model) for model in models], LINK_MODEL_DTYPE),
        np.zeros(pages, dtype=np.int64),
        table,
    )


def due(made: Channel, count: int) -> Ints:
    """Returns when the samples up to `count` are due, ns, or LOST; shape (count,) from a fresh channel."""
    row, models, dues, points = made
    first = int(row.scheduled) + 1
    parts = []
    for start in range(first, count, len(dues)):
        end = min(start + len(dues), count)
        schedule_deliveries(end - 1, row, models, dues, points)
        parts.append(dues[np.arange(start, end) % len(dues)])
    return np.concatenate(parts)


def stamps(count: int, rate_hz: int = 1000) -> Ints:
    return np.arange(count, dtype=np.int64) * 10**9 // rate_hz


def delays_us(link: LinkBase, seed: int, count: int) -> Ints:
    """Returns the delays of a link's first samples, us; none may be lost."""
    points = link.points
    model = link.to_core_model()._replace(trace_count=0 if points is None else len(points))
    ns = due(channel([model], seed, points=points), count) - stamps(count)
    assert (ns >= 0).all()
    assert (ns % 1000 == 0).all()
    return ns // 1000
