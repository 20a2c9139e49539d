"""A channel of every kind, and its effect on samples."""

import numpy as np

from tests.core.channels import Ints, channel, due
from trilat_net.core.links.channel import LOST
from trilat_net.core.links.delay import DelayKind, LinkModel, TraceEnd

KINDS: dict[str, LinkModel] = {
    "constant": LinkModel(location=200_000.0),
    "uniform": LinkModel(kind=DelayKind.UNIFORM, location=200_000.0, scale=150_000.0),
    "normal": LinkModel(kind=DelayKind.NORMAL, location=20_000.0, scale=30_000.0),
    "gamma": LinkModel(kind=DelayKind.GAMMA, extra=2.5, scale=20_000.0),
    "gamma below 1": LinkModel(kind=DelayKind.GAMMA, extra=0.4, scale=50_000.0),
    "lognormal": LinkModel(kind=DelayKind.LOG_NORMAL, location=10.8, scale=0.6),
    "hyperexponential": LinkModel(
        kind=DelayKind.HYPER_EXPONENTIAL,
        location=15_000.0,
        scale=10_000.0,
        extra=150_000.0,
        weight=0.2,
    ),
    "ar1": LinkModel(kind=DelayKind.AR1, location=200_000.0, scale=30_000.0, weight=0.9),
    "sine": LinkModel(
        kind=DelayKind.SINE, location=100_000.0, scale=80_000.0, extra=20_000.0, weight=0.5
    ),
    "trace": LinkModel(kind=DelayKind.TRACE, at_end=TraceEnd.LOOP, trace_count=3),
    "measured": LinkModel(kind=DelayKind.MEASURED),
    "bursts": LinkModel(location=5_000.0, loss_bad=0.9, enter=0.3, leave=0.4),
    "single losses": LinkModel(location=5_000.0, loss_good=0.4),
    "copies": LinkModel(
        kind=DelayKind.UNIFORM, location=200_000.0, scale=150_000.0, duplicate=0.5
    ),
    "in order": LinkModel(
        kind=DelayKind.UNIFORM, location=50_000.0, scale=50_000.0, in_order=1
    ),
    "play-out": LinkModel(
        kind=DelayKind.UNIFORM, location=50_000.0, scale=50_000.0, playout_us=60_000
    ),
}
POINTS = np.array([(0, 7_000), (2_000, LOST), (3_000, 11_000)], dtype=np.int64)


def fates(name: str, count: int, seed: int = 1) -> Ints:
    return due(channel([KINDS[name]], seed, points=POINTS), count)
