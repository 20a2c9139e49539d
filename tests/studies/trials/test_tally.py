"""What is kept of a run: the same however it is cut into blocks, and what a look at the whole gives."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.studies.record_batches import RecordBatch
from trilat_net.studies.trials.measure_run import BUCKET_NS, SiteStats

PERIOD_NS = 10_000_000
RECORDS = 400


def records(seed: int) -> RecordBatch:
    """Four seconds at 100 Hz with peers at 100 and 50 Hz; the second is heard of from tick 20 on."""
    rng = np.random.default_rng(seed)
    k = np.arange(RECORDS)
    used = np.array([k - 5, np.where(k < 20, -1, k // 2 - rng.integers(2, 9, RECORDS))]).T
    return RecordBatch(k * PERIOD_NS, *rng.normal(size=(5, RECORDS, 2)), np.maximum(used, -1))


def tallied(rows: RecordBatch, cuts: list[int], synchronised_rad: float = 1.0) -> SiteStats:
    tally = SiteStats([100, 50], synchronised_rad)
    edges = [0, *sorted(cuts), RECORDS]
    for first, last in pairwise(edges):
        tally.add(RecordBatch(*(part[first:last] for part in rows)))
    return tally


@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(0, RECORDS), max_size=12))
def test_the_cut_into_blocks_has_no_influence(seed: int, cuts: list[int]) -> None:
    rows = records(seed)
    cut, whole = tallied(rows, cuts), tallied(rows, [])
    for figure in ("records", "peak_error_rad", "peak_torque_nm", "peak_speed_rad_s", "apart_ns", "last_ns"):
        assert getattr(cut, figure) == getattr(whole, figure)
    assert cut.age_max_ms.tolist() == whole.age_max_ms.tolist()
    assert cut.peaks().tolist() == whole.peaks().tolist()
    assert cut.rms_error_rad == pytest.approx(whole.rms_error_rad)
    assert cut.mean_age_ms == pytest.approx(whole.mean_age_ms)
    end, end_of_whole = cut.end(cut.last_ns), whole.end(whole.last_ns)
    assert all(np.array_equal(a, b) for a, b in zip(end, end_of_whole, strict=True))


@given(seed=st.integers(0, 1000))
def test_its_figures_are_those_of_all_records(seed: int) -> None:
    rows = records(seed)
    tally = tallied(rows, [37, 38, 290])
    error = np.abs(rows.q - rows.q_des)
    assert tally.peak_error_rad == error.max()
    assert tally.peak_torque_nm == np.abs(rows.tau).max()
    assert tally.peak_speed_rad_s == np.abs(rows.qd).max()
    assert tally.rms_error_rad == pytest.approx(max(np.sqrt(np.mean(error[:, j] ** 2)) for j in (0, 1)))
    apart = [t for t, e in zip(rows.t_ns, error, strict=True) if e.max() >= 1.0]
    assert tally.apart_ns == (apart[-1] if apart else -1)
    assert tally.end(tally.last_ns).t_ns.tolist() == rows.t_ns[-100:].tolist()
    ages = [(rows.t_ns[k] - rows.used[k, 1] * 20_000_000) * 1e-6 for k in range(20, RECORDS)]
    assert tally.mean_age_ms[1] == pytest.approx(np.mean(ages))
    assert tally.age_max_ms[1] == pytest.approx(max(ages))
    for bucket, peak in enumerate(tally.peaks()):
        assert peak == error[rows.t_ns // BUCKET_NS == bucket].max()


def test_what_it_keeps_does_not_grow_with_the_records() -> None:
    tally, block = SiteStats([100, 50], 1.0), records(1)
    for n in range(30):
        tally.add(block._replace(t_ns=block.t_ns + n * RECORDS * PERIOD_NS))
    assert len(tally.end(0).t_ns) <= 2 * RECORDS
    assert len(tally.end(tally.last_ns).t_ns) == 100


def test_a_link_that_never_had_a_sample_has_no_age() -> None:
    rows = records(1)
    rows.used[:, 1] = -1
    assert tallied(rows, [])._age_records[1] == 0
    assert tallied(rows, []).mean_age_ms[1] is None


def test_a_bucket_without_records_says_so() -> None:
    rows = records(1)
    keep = (rows.t_ns // BUCKET_NS) != 7
    tally = SiteStats([100, 50], 1.0)
    tally.add(RecordBatch(*(part[keep] for part in rows)))
    assert [n for n, peak in enumerate(tally.peaks()) if peak < 0] == [7]
