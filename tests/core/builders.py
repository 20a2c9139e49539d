"""Builders of the parts of a site in the core: setups, sites, arrivals and channels."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.core.chain_references import chain_references
from tests.scenario.builders import make_scenario
from trilat_net.core.arms.chain import ChainJoint
from trilat_net.core.links.channel import LOST, schedule_deliveries
from trilat_net.core.links.delay import LINK_MODEL_DTYPE, DelayKind, LinkModel
from trilat_net.core.links.link import link_dtype
from trilat_net.core.links.philox import link_key
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.site_setup import (
    ChainSetup,
    Gains,
    Law,
    LinkSetup,
    SiteSetup,
    TaskSetup,
)
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickInput, TickRecord
from trilat_net.core.step.vectors import Points
from trilat_net.execution import virtual
from trilat_net.scenario.delay_models import LinkBase

VECTORS = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")


def make_site_setup(site: str = "m1", scenario: str = "paper", **overrides: Any) -> SiteSetup:
    """Returns the setup of a site; `__` stands for the dot of an overridden key."""
    return make_scenario(scenario, **overrides).setup(site)


def make_site_with_delay(rate_hz: int, peer_rate_hz: int, delay_ns: int) -> Site:
    """Returns a site with a single peer behind a constant delay, whose reference is the sample in use."""
    return make_site_with_link(rate_hz, peer_rate_hz, [LinkModel(location=delay_ns / 1000)])


def make_site_with_link(
    rate_hz: int,
    peer_rate_hz: int,
    models: Sequence[LinkModel],
    trace: Points | None = None,
    outages: tuple[tuple[int, int], ...] = (),
) -> Site:
    """Returns a site with a single peer behind any link, which has the name and seed of `make_channel`."""
    link = LinkSetup(
        "peer",
        1.0,
        peer_rate_hz,
        (0.5, -0.25),
        link_key(1, LINK_NAME),
        tuple(models),
        (trace,) * len(models),
        outages,
    )
    return Site(make_site_setup()._replace(rate_hz=rate_hz, links=(link,)))


def make_arrival(tick: int, peer: int = 0) -> Arrival:
    """Returns a sample that carries its own number."""
    return Arrival(peer, tick, (1e-3 * (tick + 1), -1e-3 * (tick + 1)), (1e-4 * tick, 0.0))


def step_site(site: Site, ticks: Iterable[TickInput]) -> list[TickRecord]:
    """Returns the records of a site that is stepped through ticks."""
    return [site.step(tick) for tick in ticks]


def describe_bits(output: TickRecord) -> str:
    """Returns all results of a tick as text, without rounding."""
    numbers = [number for field in VECTORS for number in getattr(output, field)]
    return " ".join(number.hex() for number in numbers) + str(output[-2:])


def execute_as_text(scenario: str, **overrides: object) -> list[str]:
    """Returns every record of a run in virtual time as text."""
    run = virtual.execute_virtual(make_scenario(scenario, **overrides))
    return [f"{site.name} {output.tick} {describe_bits(output)}" for site, _, output in run]


CHAIN = chain_references()["arm7"].chain
THETA = np.concatenate([joint.inertia for joint in CHAIN.joints])
PLACE = TaskSetup((1.0,) * 3, 0.5)
POSE = TaskSetup((1.0,) * 6, 1.0, posture_rate=0.7)


def make_task_arrays(task: TaskSetup) -> SiteArrays:
    """Returns the arrays of a site whose arm of seven joints follows in task space."""
    joints = tuple(
        ChainJoint(joint.kind == "prismatic", joint.axis, joint.rotation, joint.origin_m)
        for joint in CHAIN.joints
    )
    chain = ChainSetup(
        joints, tip_m=CHAIN.tip_origin_m, tip_rotation=CHAIN.tip_rotation, task=task
    )
    numbers = {"theta": THETA, "g_m_s2": 9.81, "lengths_m": (0.0, 0.0), "tau_limit_nm": 1e3}
    return SiteArrays.build(
        SiteSetup(
            name="a",
            rate_hz=1000,
            digital=False,
            gains=Gains(Law.ADAPTIVE, Lambda=(2.0,), Kp=(1.0,), Kd=(1.0,)),
            qd_limit_rad_s=100.0,
            q0=(0.0, -0.4, 0.2, -1.7, 0.1, 1.5, 0.3),
            qd0=(0.0,) * 7,
            actors=(),
            links=(LinkSetup("b", 1.0, 1000, (0.0,) * len(task.axes)),),
            chain=chain,
            **numbers,
        ),
        pages=8,
    )


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


def make_channel(
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
    row.rate_hz = rate_hz
    row.key = link_key(seed, name)
    row.models = len(models)
    row.used = -1
    row.scheduled = -1
    row.outage_first = len(table) - outages
    row.outage_count = outages
    return Channel(
        row,
        np.array([tuple(model) for model in models], LINK_MODEL_DTYPE),
        np.zeros(pages, dtype=np.int64),
        table,
    )


def compute_due_ns(channel: Channel, count: int) -> Ints:
    """Returns the due times of the samples up to `count`, in ns, or LOST.

    The shape is (count,) for a fresh channel.
    """
    row, models, dues, points = channel
    first = int(row.scheduled) + 1
    parts = []
    for start in range(first, count, len(dues)):
        end = min(start + len(dues), count)
        schedule_deliveries(end - 1, row, models, dues, points)
        parts.append(dues[np.arange(start, end) % len(dues)])
    return np.concatenate(parts)


def compute_stamps_ns(count: int, rate_hz: int = 1000) -> Ints:
    """Returns the nominal stamps of the first samples, in ns."""
    return np.arange(count, dtype=np.int64) * 10**9 // rate_hz


def draw_delays_us(link: LinkBase, seed: int, count: int) -> Ints:
    """Returns the delays of the first samples of a link that loses no sample, in us."""
    points = link.points
    model = link.to_core_model()._replace(trace_count=0 if points is None else len(points))
    due_ns = compute_due_ns(make_channel([model], seed, points=points), count)
    delay_ns = due_ns - compute_stamps_ns(count)
    assert (delay_ns >= 0).all()
    assert (delay_ns % 1000 == 0).all()
    return delay_ns // 1000


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
    "trace": LinkModel.follow_trace("loop")._replace(trace_count=3),
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


def compute_fates(name: str, count: int, seed: int = 1) -> Ints:
    """Returns the due times of the first samples of a channel in `KINDS`, in ns, or LOST."""
    return compute_due_ns(make_channel([KINDS[name]], seed, points=POINTS), count)
