"""The effect of a channel on each sample: loss, bursts, copies, outages, order; golden fates (L4)."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.core.builders import (
    KINDS,
    POINTS,
    SEEDS,
    Ints,
    compute_due_ns,
    compute_fates,
    compute_stamps_ns,
    make_channel,
)
from tests.programs import run_python
from trilat_net.core.links.channel import LOST
from trilat_net.scenario.delay_models import LinkBase
from trilat_net.scenario.delay_models.kernel_delays import (
    ConstantDelay,
    GammaDelay,
    NoDelay,
    UniformDelay,
)

COUNT = 1_000_000
SIGMAS = 4.0

# Loss.

LOSSES: list[LinkBase] = [
    NoDelay(loss=0.05),
    NoDelay(loss=0.5),
    NoDelay(loss=0.05, loss_burst=1),
    NoDelay(loss=0.02, loss_burst=8),
    NoDelay(loss=0.3, loss_burst=3),
    NoDelay(loss=0.5, loss_burst=1),
    NoDelay(loss=0.05, loss_burst=2, loss_bad=0.8),
    NoDelay(loss=0.1, loss_burst=1.2, loss_bad=0.5),
]


def list_burst_lengths(lost: np.ndarray) -> Ints:
    """Returns the lengths of runs of losses, without a run that the end truncates."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost]).astype(np.int8)))
    begin = edges[::2]
    end = edges[1::2]
    return end - begin[: len(end)]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "link", LOSSES, ids=lambda link: f"{link.loss}-{link.loss_burst}-{link.loss_bad}"
)
def test_loss_and_burst_follow_their_model(link: LinkBase, seed: int) -> None:
    """Gilbert and Elliott; single losses are the chain without memory, whose mean burst is 1 /
    (1 - p).

    The variance of the rate includes the chain's correlation 1 - enter - leave; lengths are
    geometric.
    """
    model = link.to_core_model()
    lost = compute_due_ns(make_channel([model], seed), COUNT) == LOST
    p = link.loss
    h = link.loss_bad
    variance = p * (1 - p)
    if link.loss_burst:
        memory = 1 - model.enter - model.leave
        share = model.enter / (model.enter + model.leave)
        assert share * h == pytest.approx(p, rel=1e-12)
        variance += 2 * h * h * share * (1 - share) * memory / (1 - memory)
    assert abs(lost.mean() - p) <= SIGMAS * math.sqrt(variance / COUNT)
    lengths = list_burst_lengths(lost)
    mean = link.loss_burst or 1 / (1 - p)
    allowed = SIGMAS / math.sqrt(len(lengths))
    assert abs(lengths.mean() - mean) <= allowed * math.sqrt(mean * (mean - 1))
    for length in (1, 2, 3):
        share = (1 - 1 / mean) ** (length - 1) / mean
        assert abs(np.mean(lengths == length) - share) <= allowed * math.sqrt(
            share * (1 - share)
        )


@pytest.mark.parametrize("seed", SEEDS)
def test_first_samples_are_lost_with_stationary_probability(seed: int) -> None:
    """A chain begins in its stationary distribution, over links of one seed."""
    model = NoDelay(loss=0.4, loss_burst=50).to_core_model()
    first = [
        compute_due_ns(make_channel([model], seed, f"a{n}->s"), 1)[0] == LOST
        for n in range(4000)
    ]
    assert abs(np.mean(first) - 0.4) <= SIGMAS * math.sqrt(0.24 / 4000)


def test_directions_and_seeds_lose_independently() -> None:
    model = NoDelay(loss=0.5).to_core_model()
    series = [
        compute_due_ns(make_channel([model], seed, name), 100_000) == LOST
        for seed, name in ((1, "m1->s"), (1, "s->m1"), (2, "m1->s"))
    ]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert abs(np.corrcoef(series[a], series[b])[0, 1]) < SIGMAS / math.sqrt(100_000)


def test_losses_are_independent_of_delays() -> None:
    """The delays of the samples that arrive are those of the link without loss."""
    link = UniformDelay(delay_ms=100, half_width_ms=50)
    whole = compute_due_ns(make_channel([link.to_core_model()]), 10_000)
    holed = compute_due_ns(
        make_channel(
            [
                UniformDelay(
                    delay_ms=100, half_width_ms=50, loss=0.3, loss_burst=4
                ).to_core_model()
            ]
        ),
        10_000,
    )
    kept = holed != LOST
    assert 0.6 < kept.mean() < 0.8
    assert (holed[kept] == whole[kept]).all()


# Duplicates.


@pytest.mark.parametrize("seed", SEEDS)
def test_copies_have_their_share(seed: int) -> None:
    link_channel = make_channel([NoDelay(duplicate=0.07).to_core_model()], seed)
    compute_due_ns(link_channel, COUNT)
    assert abs(int(link_channel.row.copies) / COUNT - 0.07) <= SIGMAS * math.sqrt(
        0.07 * 0.93 / COUNT
    )


def test_the_earlier_of_sample_and_copy_counts() -> None:
    """A sample and its copy have separate delays, and the smaller of two uniform numbers has its mean at a third."""
    link = UniformDelay(delay_ms=100, half_width_ms=60)
    single = compute_due_ns(make_channel([link.to_core_model()]), 100_000)
    link_channel = make_channel(
        [UniformDelay(delay_ms=100, half_width_ms=60, duplicate=1.0).to_core_model()]
    )
    doubled = compute_due_ns(link_channel, 100_000)
    assert link_channel.row.copies == 100_000
    assert (doubled <= single).all()
    smaller_ms = (doubled - compute_stamps_ns(100_000)) / 1e6
    assert smaller_ms.mean() == pytest.approx(
        40 + 120 / 3, abs=SIGMAS * 120 / math.sqrt(18 * 100_000)
    )


# Outages, order, play-out.


def test_an_outage_takes_the_samples_stamped_within_it() -> None:
    cut = np.array(
        [(10_000_000, 20_000_000), (15_000_000, 25_500_000), (40_000_000, 40_000_001)]
    )
    lost = np.flatnonzero(
        compute_due_ns(make_channel([NoDelay().to_core_model()], points=cut, outages=3), 60)
        == LOST
    )
    assert lost.tolist() == [*range(10, 26), 40]


def test_in_order_no_sample_overtakes_an_older_one() -> None:
    keys = {"delay_ms": 50.0, "deviation_ms": 30.0, "loss": 0.1}
    free = compute_due_ns(make_channel([GammaDelay(**keys).to_core_model()]), 20_000)
    ordered = compute_due_ns(
        make_channel([GammaDelay(**keys, order="in_order").to_core_model()]), 20_000
    )
    kept = free != LOST
    assert ((ordered == LOST) == ~kept).all()
    assert (ordered[kept] == np.maximum.accumulate(free[kept])).all()
    assert (np.diff(free[kept]) < 0).any()


def test_newly_ordered_links_hold_samples_back() -> None:
    first = ConstantDelay(delay_ms=50.0)
    then = ConstantDelay(delay_ms=1.0, order="in_order")
    due_ns = compute_due_ns(
        make_channel([first.to_core_model(), then.to_core_model(10_000_000)]), 80
    )
    assert due_ns[:10].tolist() == [(50 + m) * 10**6 for m in range(10)]
    assert due_ns[10:].tolist() == [max(59, m + 1) * 10**6 for m in range(10, 80)]


@given(playout_ms=st.floats(0, 300))
def test_play_out_holds_samples_for_its_budget(playout_ms: float) -> None:
    free = compute_due_ns(
        make_channel([UniformDelay(delay_ms=100, half_width_ms=100).to_core_model()]), 500
    )
    due_ns = compute_due_ns(
        make_channel(
            [
                UniformDelay(
                    delay_ms=100, half_width_ms=100, playout_ms=playout_ms
                ).to_core_model()
            ]
        ),
        500,
    )
    assert (
        due_ns == np.maximum(free, compute_stamps_ns(500) + round(playout_ms * 1000) * 1000)
    ).all()


# Changes of model.


def test_a_model_holds_from_its_first_stamp_on() -> None:
    models = [
        ConstantDelay(delay_ms=d).to_core_model(n)
        for d, n in ((5, 0), (9, 3_000_001), (2, 7_000_000), (1, 7_000_000))
    ]
    delays = compute_due_ns(make_channel(models), 10) - compute_stamps_ns(10)
    assert (delays // 10**6).tolist() == [5, 5, 5, 5, 9, 9, 9, 1, 1, 1]


def test_delays_are_unaffected_by_changed_loss() -> None:
    keys = {"delay_ms": 80.0, "deviation_ms": 20.0}
    whole = compute_due_ns(make_channel([GammaDelay(**keys).to_core_model()]), 2000)
    changed = compute_due_ns(
        make_channel(
            [
                GammaDelay(**keys).to_core_model(),
                GammaDelay(**keys, loss=0.2).to_core_model(500 * 10**6),
            ]
        ),
        2000,
    )
    assert (changed[:500] == whole[:500]).all()
    kept = changed != LOST
    assert (changed[kept] == whole[kept]).all()
    assert not kept[500:].all()


# The same whatever asks, and in what steps.


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=15)
@given(
    steps=st.lists(st.integers(1, 60), min_size=1, max_size=30),
    pages=st.sampled_from([64, 128, 8192]),
)
def test_fates_do_not_depend_on_steps(name: str, steps: list[int], pages: int) -> None:
    link_channel = make_channel([KINDS[name]], points=POINTS, pages=pages)
    parts = [compute_due_ns(link_channel, int(n)) for n in np.cumsum(steps)]
    assert np.concatenate(parts).tolist() == compute_fates(name, sum(steps)).tolist()


GOLDEN = {
    "constant": [200000, 201000, 202000, 203000, 204000, 205000, 206000, 207000],
    "uniform": [252402, 74689, 251295, 207262, 69951, 55734, 292243, 201240],
    "normal": [12830, 40710, 44349, 27078, 71582, 76766, 46118, 33932],
    "gamma": [36671, 6209, 71172, 21077, 112805, 121568, 72225, 57498],
    "gamma below 1": [26014, 1495, 13849, 4859, 38016, 142075, 34033, 58040],
    "lognormal": [42472, 13812, 78648, 28089, 130962, 143044, 79304, 63311],
    "hyperexponential": [27262, 114240, 18009, 24154, 40996, 288369, 53441, 24477],
    "ar1": [192830, 165301, 179612, 168253, 193468, 218086, 226546, 228513],
    "sine": [138354, 159172, 174295, 182342, 182623, 175207, 160918, 141254],
    "trace": [7000, 8000, -1, 14000, 11000, 12000, -1, 18000],
    "measured": [0, 1000, 2000, 3000, 4000, 5000, 6000, 7000],
    "bursts": [-1, 6000, 7000, -1, 9000, -1, 11000, 12000],
    "single losses": [5000, 6000, -1, -1, 9000, 10000, -1, -1],
    "copies": [252402, 74689, 251295, 66003, 69951, 55734, 291384, 201240],
    "in order": [67467, 67467, 68432, 68432, 68432, 68432, 84748, 84748],
    "play-out": [67467, 61000, 68432, 63000, 64000, 65000, 84748, 67000],
}


@pytest.mark.parametrize("name", KINDS)
def test_golden_fates(name: str) -> None:
    """The due times of the first eight samples of m1->s with seed 1, us, or LOST."""
    due_us = [LOST if ns == LOST else ns // 1000 for ns in compute_fates(name, 8).tolist()]
    assert due_us == GOLDEN[name]


_PROGRAM = """
from tests.core.philox_reference import make_table
from tests.core.builders import KINDS, compute_fates
for kind, shape in ((0, 0.0), (1, 0.0), (2, 0.3), (2, 4.0)):
    print(" ".join(number.hex() for number in make_table(300, kind, shape).tolist()))
for name in KINDS:
    print(name, compute_fates(name, 200).tolist())
"""


@pytest.mark.long
def test_uncompiled_draws_and_fates_have_equal_bits() -> None:
    plain = run_python(_PROGRAM, compiled=False)
    assert plain.count("0x") == 300 * (2 + 1 + 1 + 1)
    assert plain.count("[") == len(KINDS)
    assert plain == run_python(_PROGRAM, compiled=True)
