"""A channel of every kind, and what it does to samples."""

import numpy as np

from tests.core.channels import Ints, channel, due
from trilat_net.core.channel import LOST
from trilat_net.core.delay import AtEnd, Delay, Model

KINDS: dict[str, Model] = {
    "constant": Model(location=200_000.0),
    "uniform": Model(kind=Delay.UNIFORM, location=200_000.0, scale=150_000.0),
    "normal": Model(kind=Delay.NORMAL, location=20_000.0, scale=30_000.0),
    "gamma": Model(kind=Delay.GAMMA, extra=2.5, scale=20_000.0),
    "gamma below 1": Model(kind=Delay.GAMMA, extra=0.4, scale=50_000.0),
    "lognormal": Model(kind=Delay.LOG_NORMAL, location=10.8, scale=0.6),
    "hyperexponential": Model(
        kind=Delay.HYPER_EXPONENTIAL, location=15_000.0, scale=10_000.0, extra=150_000.0, weight=0.2
    ),
    "ar1": Model(kind=Delay.AR1, location=200_000.0, scale=30_000.0, weight=0.9),
    "sine": Model(kind=Delay.SINE, location=100_000.0, scale=80_000.0, extra=20_000.0, weight=0.5),
    "trace": Model(kind=Delay.TRACE, at_end=AtEnd.LOOP, trace_count=3),
    "measured": Model(kind=Delay.MEASURED),
    "bursts": Model(location=5_000.0, loss_bad=0.9, enter=0.3, leave=0.4),
    "single losses": Model(location=5_000.0, loss_good=0.4),
    "copies": Model(kind=Delay.UNIFORM, location=200_000.0, scale=150_000.0, duplicate=0.5),
    "in order": Model(kind=Delay.UNIFORM, location=50_000.0, scale=50_000.0, in_order=1),
    "play-out": Model(kind=Delay.UNIFORM, location=50_000.0, scale=50_000.0, playout_us=60_000),
}
POINTS = np.array([(0, 7_000), (2_000, LOST), (3_000, 11_000)], dtype=np.int64)


def fates(name: str, count: int, seed: int = 1) -> Ints:
    return due(channel([KINDS[name]], seed, points=POINTS), count)
